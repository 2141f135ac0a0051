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
    """Return the Runs of both halves, by body and column; each column takes its share of the run of a wide one.

    Parameters
    ----------
    stores : of each half, tuple of RunStore
    n_columns, wide_edges, wide_shares : of `LabelColumns`

    Returns
    -------
    plain tuple of Runs
    """
    n, highest = _count_runs(stores, n_columns, wide_edges)
    bodies, begins = np.empty(highest + 1, np.int64), np.empty(highest + 2, np.int64)
    table, owner, share = np.empty((n, RUN), np.int64), np.empty(n, np.int64), np.empty(n, np.float32)
    n_bodies = _sort_runs(stores, n_columns, wide_edges, wide_shares, bodies, begins, table, owner, share)
    return bodies[:n_bodies], begins[: n_bodies + 1], table, owner, share, (stores[0][2], stores[1][2])


@compiled
def _count_runs(stores, n_columns, wide_edges):
    """Return how many runs there are, those of wide columns once for each column, and the highest number of a body."""
    first, second = RunStore(*stores[0]), RunStore(*stores[1])
    n_first, n_all = first.n_runs, first.n_runs + second.n_runs
    n, highest = 0, 0
    for i in range(n_all):
        run = first.runs[i] if i < n_first else second.runs[i - n_first]
        wide = run[COLUMN] - n_columns
        n += 1 if wide < 0 else wide_edges[wide + 1] - wide_edges[wide]
        highest = max(highest, run[BODY])
    return n, highest


@compiled
def _sort_runs(stores, n_columns, wide_edges, wide_shares, bodies, begins, table, owner, share):
    """Fill the arrays of Runs, of which `bodies` and `begins` may be longer; return the number of bodies."""
    first, second = RunStore(*stores[0]), RunStore(*stores[1])
    n_first, n_all = first.n_runs, first.n_runs + second.n_runs
    # in their order, one for each column: which run, its column, its body
    entry = np.empty((3, table.shape[0]), np.int64)
    n = 0
    for i in range(n_all):
        run = first.runs[i] if i < n_first else second.runs[i - n_first]
        wide = run[COLUMN] - n_columns
        begin, end = (run[COLUMN], run[COLUMN] + 1) if wide < 0 else (wide_edges[wide], wide_edges[wide + 1])
        for column in range(begin, end):
            entry[0, n], entry[1, n], entry[2, n] = i, column, run[BODY]
            n += 1
    # by counting, and by the least significant key first: runs of one body and column stay in their order
    order, sorted_ = np.arange(n), np.empty(n, np.int64)
    for key, n_keys in ((1, n_columns), (2, bodies.shape[0])):
        places = np.zeros(n_keys + 1, np.int64)
        for i in range(n):
            places[entry[key, i] + 1] += 1
        for k in range(n_keys):
            places[k + 1] += places[k]
        for i in range(n):
            at = entry[key, order[i]]
            sorted_[places[at]] = order[i]
            places[at] += 1
        order, sorted_ = sorted_, order
    n_bodies = 0
    for i in range(n):
        k = entry[0, order[i]]
        run = first.runs[k] if k < n_first else second.runs[k - n_first]
        for number in range(RUN):
            table[i, number] = run[number]
        is_wide, column = run[COLUMN] >= n_columns, entry[1, order[i]]
        table[i, COLUMN], owner[i] = column, int(k >= n_first)
        share[i] = wide_shares[column] if is_wide else np.float32(1.0)
        if i == 0 or table[i, BODY] != table[i - 1, BODY]:
            bodies[n_bodies], begins[n_bodies] = table[i, BODY], i
            n_bodies += 1
    begins[n_bodies] = n
    return n_bodies


@compiled
def sum_body_echo(runs, response, gain, half, body_echo):
    """Sum the echo of a half of each body's runs in all beams.

    Parameters
    ----------
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
