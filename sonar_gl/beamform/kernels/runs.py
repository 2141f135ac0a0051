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
    most = len(runs) * int(np.diff(wide_edges).max(initial=1))
    bodies, begins = np.empty(most, np.int64), np.empty(most + 1, np.int64)
    table, owner, share = (
        np.empty((most, RUN), np.int64),
        np.empty(most, np.int64),
        np.empty(most, np.float32),
    )
    wide = n_columns, wide_edges, wide_shares
    n, n_bodies = _sort_runs(runs, first.n_runs, *wide, bodies, begins, table, owner, share)
    sorted_ = bodies[:n_bodies], begins[: n_bodies + 1], table[:n], owner[:n], share[:n]
    return *sorted_, (first.pool, second.pool)


@compiled
def _sort_runs(runs, n_first, n_columns, wide_edges, wide_shares, bodies, begins, table, owner, share):
    """Fill the arrays of Runs, which may be longer, by counting; return how many runs and bodies there are.

    runs : (n, RUN) of both halves; n_first : how many are of the first
    """
    # chains of each column's runs, laid from the last one on, so that runs of one body and column stay in their order
    chain, following, run_of = (
        np.full(n_columns, -1),
        np.empty(len(owner), np.int64),
        np.empty(len(owner), np.int64),
    )
    highest, n, n_bodies = 0, 0, 0
    for i in range(len(runs)):
        highest = max(highest, runs[i, BODY])
    places = np.zeros(highest + 2, np.int64)
    for i in range(len(runs) - 1, -1, -1):
        begin, end = runs[i, COLUMN], runs[i, COLUMN] + 1
        if begin >= n_columns:
            begin, end = wide_edges[begin - n_columns], wide_edges[end - n_columns]
        places[runs[i, BODY] + 1] += end - begin
        for column in range(begin, end):
            following[n], run_of[n], chain[column] = chain[column], i, n
            n += 1
    for body in range(highest + 1):
        if places[body + 1] > 0:
            bodies[n_bodies], begins[n_bodies] = body, places[body]
            n_bodies += 1
        places[body + 1] += places[body]
    begins[n_bodies] = n
    for column in range(n_columns):
        entry = chain[column]
        while entry >= 0:
            i = run_of[entry]
            at = places[runs[i, BODY]]
            places[runs[i, BODY]] += 1
            for k in range(RUN):
                table[at, k] = runs[i, k]
            table[at, COLUMN], owner[at] = column, int(i >= n_first)
            share[at] = wide_shares[column] if runs[i, COLUMN] >= n_columns else np.float32(1.0)
            entry = following[entry]
    return n, n_bodies


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
