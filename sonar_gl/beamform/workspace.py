"""What the beamformers of a sonar share, so that another sampling costs neither time nor memory for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sonar_gl.beamform import kernels
from sonar_gl.core.array_pool import ArrayPools

# Initial room of labels: bodies in a column, runs of bins, numbers. Where it is too small, samples are summed twice;
# what is not used takes no memory.
SLOTS, RUNS, POOL = 16, 1 << 14, 1 << 22
BLOCK = 1 << 18  # numbers of `blocks_of`: 2 MB; the weights of most devices fill less, or little more


@dataclass(frozen=True, eq=False)
class BeamWeights:
    """Beams as weighted sums of columns.

    Attributes
    ----------
    first : (B,) int64, first column of each beam (may be negative: columns are modulo the fan's)
    weights : (B, W) float32, 1/sr, rows of equal length
    width_rad, height : (B,) integral of the receive pattern over azimuth, and of the elevation pattern over sines; of
        columns that are cones a mean with the weights `columns_sr`
    columns_sr : (C,) solid angle of each column, weighed by the elevation pattern
    """

    first: np.ndarray
    weights: np.ndarray
    width_rad: np.ndarray
    height: float
    columns_sr: np.ndarray

    @cached_property
    def tiles(self) -> kernels.BeamTiles:
        """The weights in tiles of beams."""
        return kernels.beam_tiles(self.first, self.weights)

    @cached_property
    def column_response(self) -> np.ndarray:
        """What all beams together return of the echo in a column: (C,) float64."""
        n_columns = len(self.columns_sr)
        columns = self.first[:, None] + np.arange(self.weights.shape[1])
        return np.bincount((columns % n_columns).ravel(), self.weights.ravel(), n_columns)

    @cached_property
    def received(self) -> np.ndarray:
        """Which columns of the fan any beam receives: (C,) bool, read-only."""
        out = np.zeros(len(self.columns_sr), bool)
        for beams in blocks_of(*self.weights.shape):
            columns = self.first[beams, None] + np.arange(self.weights.shape[1])
            out[columns[self.weights[beams] > 0] % len(out)] = True
        out.setflags(write=False)
        return out


def blocks_of(n_beams: int, n_each: int) -> Iterator[slice]:
    """Yield beams, as many at a time as have BLOCK numbers together, of n_each: all of them would fill gigabytes."""
    step = max(BLOCK // n_each, 1)
    yield from (slice(first, first + step) for first in range(0, n_beams, step))


@dataclass(frozen=True, eq=False)
class ColumnSums:
    """Sums of samples in columns and bins, rows of two larger arrays in which those of the wide columns follow.

    Attributes
    ----------
    sums : (columns, K) float32
    spans : (columns, 2) first and past last bin that may differ from 0
    all_sums, all_spans : the same, with the wide columns
    """

    sums: np.ndarray
    spans: np.ndarray
    all_sums: np.ndarray
    all_spans: np.ndarray


class LabelSums:
    """Sums of samples by body, of two halves of the columns; the arrays are replaced by larger ones as needed.

    Attributes
    ----------
    cells : (bodies, kernels.MOMENTS, K) float32 of each half
    stores : kernels.RunStore of each half
    """

    def __init__(self, n_bins: int):
        self.cells = [np.zeros((SLOTS, kernels.MOMENTS, n_bins), np.float32) for _ in range(2)]
        self.stores = [_empty_store(RUNS, POOL) for _ in range(2)]

    def clear(self, half: int) -> None:
        """Have the store of a half hold nothing."""
        self.stores[half] = self.stores[half]._replace(n_runs=0, n_pool=0)

    def take(self, half: int, room: kernels.LabelRoom) -> bool:
        """Note how much of a half is in use; return False, with an empty and larger one, if it was too small."""
        cells, store = self.cells[half], self.stores[half]
        if (len(cells), len(store.runs), len(store.pool)) == room[2:]:
            self.stores[half] = store._replace(n_runs=room.n_runs, n_pool=room.n_pool)
            return True
        if len(cells) < room.cells:
            self.cells[half] = np.zeros((room.cells, *cells.shape[1:]), np.float32)
        self.stores[half] = _empty_store(room.runs, room.pool)
        return False


def _empty_store(n_runs: int, n_pool: int) -> kernels.RunStore:
    """Return a store with room for so many runs, and numbers of them."""
    return kernels.RunStore(np.empty((n_runs, kernels.RUN), np.int64), 0, np.empty(n_pool, np.float32), 0)


class Workspace:
    """What beamformers of one sonar and its acoustics share. They must sum one at a time.

    Parameters
    ----------
    pools : of the arrays that are returned; None for its own

    Attributes
    ----------
    pools
    works : what the kernels sum each half of the strips in
    """

    def __init__(self, pools: ArrayPools | None = None):
        self.pools = ArrayPools() if pools is None else pools
        self._weights = self._sums = self._label_sums = None, None
        self._moments = None, None
        self.works = kernels.make_work(), kernels.make_work()

    def weights(self, column_edges_rad: np.ndarray, make: Callable[[], tuple]) -> tuple:
        """Return the weights of beams over some columns: BeamWeights, and FarLobes or None.

        Those of the last columns are kept: coarse samplings have the same columns. The weights of fine ones are large.
        """
        key = column_edges_rad.tobytes()
        if self._weights[0] != key:
            self._weights = key, make()
        return self._weights[1]

    def moments(
        self, n_column_moments: int, n_beam_moments: int, n_bins: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return room for the moments of blocks of columns, and of blocks of beams; arbitrary contents."""
        key = n_column_moments, n_beam_moments, n_bins
        if self._moments[0] != key:
            self._moments = key, tuple(np.empty((n, n_bins), np.float32) for n in key[:2])
        return self._moments[1]

    def column_sums(self, n_columns: int, n_bins: int, n_wide_columns: int = 0) -> ColumnSums:
        """Return room for sums; what was summed before may be there still, within its spans.

        There may be room for more wide columns, since image sources have two kinds of them.
        """
        key, n_rows = (n_columns, n_bins), n_columns + n_wide_columns
        if self._sums[0] != key or len(self._sums[1].all_sums) < n_rows:
            sums = np.zeros((n_rows, n_bins), np.float32)
            spans = np.tile([0, n_bins], (len(sums), 1))
            self._sums = key, ColumnSums(sums[:n_columns], spans[:n_columns], sums, spans)
        return self._sums[1]

    def label_sums(self, n_bins: int) -> LabelSums:
        """Return room for labels."""
        if self._label_sums[0] != n_bins:
            self._label_sums = n_bins, LabelSums(n_bins)
        return self._label_sums[1]
