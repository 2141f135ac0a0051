"""Runs: the moments of one body in one column, from its first bin to its last; sorted by body and column."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled

BODY, COLUMN, FIRST_BIN, PAST_BIN, PLACE = range(5)  # of a run: one body in one column; PLACE: in the pool
RUN = 5


class RunStore(NamedTuple):
    """Where runs are stored, and how much of it is in use.

    runs : (n, RUN) int64, BODY .. PLACE
    pool : (n,) float32, of each run MOMENTS rows of its bins
    """

    runs: np.ndarray
    n_runs: int
    pool: np.ndarray
    n_pool: int


class Runs(NamedTuple):
    """Runs of all bodies, sorted by body and column.

    bodies : (m,) numbers, rising; begins : (m + 1,) where the runs of each begin and end
    table : (n, RUN) of RunStore; owner : (n,) which of the two pools holds each
    share : (n,) float32, how much of what the pool holds belongs to the run
    pools : two, of RunStore
    """

    bodies: np.ndarray
    begins: np.ndarray
    table: np.ndarray
    owner: np.ndarray
    share: np.ndarray
    pools: tuple


def sort_runs(stores, n_columns: int, wide_edges: np.ndarray, wide_shares: np.ndarray) -> tuple:
    """Return the plain Runs of both halves, by body and column; each column takes its share of the run of a wide one.

    stores : of each half, tuple of RunStore
    n_columns, wide_edges, wide_shares : of `LabelColumns`
    """
    first, second = (RunStore(*one) for one in stores)
    runs = np.concatenate([first.runs[: first.n_runs], second.runs[: second.n_runs]])
    # wide columns, or the last entry of a table for others, which are one column
    wide = np.maximum(runs[:, COLUMN] - n_columns, -1)
    begins = np.where(wide < 0, runs[:, COLUMN], wide_edges[wide])
    widths = np.append(np.diff(wide_edges), 1)[wide]
    number = np.repeat(np.arange(len(runs)), widths)
    column = begins[number] + np.arange(len(number)) - np.repeat(np.cumsum(widths) - widths, widths)
    order = np.lexsort((column, runs[number, BODY]))  # runs of one body and column stay in their order
    number, column = number[order], column[order]
    table = runs[number]
    table[:, COLUMN] = column
    bodies, begins = np.unique(table[:, BODY], return_index=True)
    share = np.where(wide[number] < 0, np.float32(1), wide_shares[column])
    owner = (number >= first.n_runs).astype(np.int64)
    return bodies, np.append(begins, len(table)), table, owner, share, (first.pool, second.pool)


@compiled
def sum_body_echo(runs, response, gain, half, body_echo):
    """Sum the echo of a half of each body's runs in all beams.

    runs : tuple of Runs
    response : (columns of `LabelColumns`,) float64, what all beams together return of the echo in a column
    gain : (K,)
    half : 0 or 1
    body_echo : (numbers,) float64, added to: the echo with the gain
    """
    runs, K = Runs(*runs), gain.shape[0]
    row = np.zeros(K, np.float32)
    for m in range(runs.bodies.shape[0]):
        begin, end = runs.begins[m], runs.begins[m + 1]
        middle, lowest, highest = (begin + end) // 2, uint64(K), uint64(0)
        # bin by bin, and these at last: the compiler vectorises no sum over bins
        for n in range(middle if half else begin, end if half else middle):
            first, past = uint64(runs.table[n, FIRST_BIN]), uint64(runs.table[n, PAST_BIN])
            pool, at = runs.pools[runs.owner[n]], uint64(runs.table[n, PLACE])
            weight = np.float32(response[runs.table[n, COLUMN]] * runs.share[n])
            for k in range(past - first):
                row[first + k] += weight * pool[at + k]
            lowest, highest = min(lowest, first), max(highest, past)
        total = 0.0
        for k in range(lowest, max(lowest, highest)):
            total += np.float64(row[k]) * gain[k]
            row[k] = 0.0
        body_echo[runs.bodies[m]] += total
