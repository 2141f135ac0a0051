"""How the columns of a fan, and the strips in them, are divided into two halves, each of which one thread sums."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sonar_gl.beamform.kernels.strips import StripTable
from sonar_gl.sonar.fan import Fan


def half_of(n: int, half: int) -> tuple[int, int]:
    """Return first and past the last of n things that are done by a half."""
    middle = (n + 1) // 2
    return (middle, n) if half else (0, middle)


def parts_of_wide_columns(wide_edges, n_columns: int) -> tuple[tuple[int, int], ...]:
    """Return first and past the last wide columns whose columns are in the same half, of each half, and of the others.

    Wide columns are counted on from the columns.

    >>> parts_of_wide_columns(np.array([0, 2, 4, 7, 9]), 9)
    ((9, 11), (12, 13), (11, 12))
    """
    n_wide, middle = len(wide_edges) - 1, half_of(n_columns, 0)[1]
    wide = half_of(n_wide, 0)[1]
    first = min(wide, int(np.searchsorted(wide_edges, middle, side="right")) - 1)
    past = min(max(wide, int(np.searchsorted(wide_edges, middle))), n_wide)
    parts = (0, first), (past, n_wide), (first, past)
    return tuple((n_columns + begin, n_columns + end) for begin, end in parts)


def strips_of(fan: Fan) -> tuple[np.ndarray, tuple]:
    """Return where the strips of each sector begin, and past the last, and the plain StripTable of all sectors."""
    strips = [sector.strips for sector in fan.sectors]
    first = np.cumsum([0, *(len(one.column) for one in strips)], dtype=np.int64)
    *arrays, _ = StripTable._fields
    columns = (np.concatenate([getattr(one, name) for one in strips]) for name in arrays)
    return first, (*columns, fan.are_cones)


def strips_within(
    first: np.ndarray, table: tuple, half: Sequence[tuple[int, int]], received: np.ndarray
) -> tuple[np.ndarray, tuple]:
    """Return the strips of `strips_of` that lie in some columns, each from the first to before the last.

    received : bool of each column, whether a beam receives it
    """
    column, *_, are_cones = table
    mine = received[column] & np.logical_or.reduce([(low <= column) & (column < high) for low, high in half])
    before = np.append(0, np.cumsum(mine))
    return before[first], (*(one[mine] for one in table[:-1]), are_cones)


def by_sector(first: np.ndarray, table: tuple) -> list[tuple]:
    """Return a plain StripTable of each sector from `strips_of`."""
    *arrays, are_cones = table
    return [(*(one[begin:end] for one in arrays), are_cones) for begin, end in pairwise(first.tolist())]
