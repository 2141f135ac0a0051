"""Sums of samples in columns and range bins for each body by itself, for labels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.footprints import find_footprints, is_long, keep_within
from sonar_gl.beamform.kernels.joined_rows import untried_after
from sonar_gl.beamform.kernels.moments import MOMENTS, bin_moments, find_angles, spread_moments
from sonar_gl.beamform.kernels.range_bins import BinTable
from sonar_gl.beamform.kernels.runs import BODY, COLUMN, FIRST_BIN, PAST_BIN, PLACE, RUN, RunStore
from sonar_gl.beamform.kernels.spreading import SHORT_RAMP, SHORT_RAMP_OF_JOINED, bin_points, find_intervals
from sonar_gl.beamform.kernels.strips import Lattice, StripTable, find_strip
from sonar_gl.beamform.kernels.work_table import ROW, SAMPLE, WORK_COLUMNS, WORK_ROWS
from sonar_gl.core.compiled import as_table, compiled, inlined


class ColumnBodies(NamedTuple):
    """The bodies of one column of `LabelColumns`, each in a slot.

    slots : (n, 3) int64, body, its first bin and past its last; the first `n_slots` are in use
    cells : (n, MOMENTS, K) float32, zeros of slots that are not in use
    """

    slots: np.ndarray
    n_slots: int
    cells: np.ndarray


class LabelRoom(NamedTuple):
    """How much of a RunStore is in use, `n_runs` and `n_pool`, and how long `cells`, `runs` and `pool` must be."""

    n_runs: int
    n_pool: int
    cells: int
    runs: int
    pool: int


@compiled
def sum_bodies(
    work,
    plane_echo,
    face_id,
    body_id,
    body_spans,
    lattice,
    strips,
    bins,
    spread,
    elevation_pattern,
    label_column,
    cells,
    store,
    sums,
    spans,
):
    """Sum some of one sector's samples into columns and bins, for each body by itself, and all of them.

    Parameters
    ----------
    work .. elevation_pattern : as in `sum_footprints`, but for body_id
    body_id : (C, R) uint16, column by column, as a strip reads it
    label_column : (columns,) int64, with the wide ones, that of `LabelColumns` which each is part of
    cells : of ColumnBodies, zeros before and after
    store : tuple of RunStore
    sums, spans : as in `sum_footprints`, with the same bits

    Returns
    -------
    plain tuple of LabelRoom: how much of the store is in use, and how long `cells`, `runs` and `pool` must be. Where
    one of them is shorter, the results are lost, and all samples must be summed again
    """
    lattice, strips, bins, store = Lattice(*lattice), StripTable(*strips), BinTable(*bins), RunStore(*store)
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    numbers, untried = np.empty(plane_echo.shape[0] + 1, np.int64), 0
    bodies, joined = ColumnBodies(np.empty((cells.shape[0], 3), np.int64), 0, cells), -1
    for p in range(strips.middle.shape[0]):
        is_tried = spread and untried == 0
        piece = (bins.piece_rad if is_tried else 0.0), bins.piece_m
        strip = find_strip(work, plane_echo, face_id, lattice, strips, p, bins.q_unseen, piece)
        untried = untried_after(untried, is_tried, strip.are_joined)
        start, last = strip.first, strip.last
        if start == last:
            continue
        column = strip.column
        if label_column[column] != joined:
            store = _store_runs(bodies, joined, store)
            bodies, joined = ColumnBodies(bodies.slots, 0, bodies.cells), label_column[column]
        find_footprints(work, strip, elevation_pattern, bins.per_metre)
        _find_numbers(work, strip, lattice.columns, body_id, numbers)
        if body_spans.shape[0] > 0:
            for m in range(uint64(start), uint64(last)):
                if is_long(work, m):
                    number = uint64(numbers[m])
                    keep_within(work, m, body_spans[number, 0], body_spans[number, 1])
        find_angles(work, strip)
        if spread:
            find_intervals(work, start, last, bins)
        else:
            bin_points(work, sums, spans, lattice.u, strip, bins)
        short_ramp = SHORT_RAMP_OF_JOINED if strip.are_joined else SHORT_RAMP
        while start < last:  # consecutive samples of one body at a time
            stop = start + 1
            while stop < last and numbers[stop] == numbers[start]:
                stop += 1
            slot, bodies = _slot_of(numbers[start], bodies)
            slots, cells = bodies.slots, bodies.cells
            if spread:
                low, high = spread_moments(work, start, stop, cells, slot, sums, column, bins, short_ramp)
                spans[column, 0], spans[column, 1] = min(spans[column, 0], low), max(spans[column, 1], high)
            else:
                low, high = bin_moments(work, start, stop, cells, slot, lattice.u, bins)
            slots[slot, 1], slots[slot, 2] = min(slots[slot, 1], low), max(slots[slot, 2], high)
            start = stop
    runs, n_runs, pool, n_pool = _store_runs(bodies, joined, store)
    return n_runs, n_pool, bodies.cells.shape[0], runs.shape[0], pool.shape[0]


@inlined
def _find_numbers(work, strip, columns, body_id, numbers):
    """Find the body of each of a strip's samples, whether it has energy or not: to ask would be a branch."""
    sample, row = work[SAMPLE], work[ROW]
    for m in range(uint64(strip.first), uint64(strip.last)):
        i = min(max(np.int64(sample[m]), 0), columns - 1)
        numbers[m] = body_id[uint64(i), uint64(row[m])]


@inlined
def _slot_of(body, bodies):
    """Return the slot of a body, a new one at first; and ColumnBodies, grown if full."""
    slots, n_slots, cells = bodies
    slot = 0
    while slot < n_slots and slots[slot, 0] != body:
        slot += 1
    if slot < n_slots:
        return slot, bodies
    if n_slots == slots.shape[0]:
        more_cells = np.zeros((2 * n_slots, MOMENTS, cells.shape[2]), np.float32)
        more_slots = np.empty((2 * n_slots, 3), np.int64)
        for old in range(n_slots):
            for n in range(MOMENTS):
                for k in range(cells.shape[2]):
                    more_cells[old, n, k] = cells[old, n, k]
                    cells[old, n, k] = 0.0  # the caller's, to whom these are lost
            for n in range(3):
                more_slots[old, n] = slots[old, n]
        cells, slots = more_cells, more_slots
    slots[slot, 0], slots[slot, 1], slots[slot, 2] = body, cells.shape[2], 0
    return slot, ColumnBodies(slots, n_slots + 1, cells)


@inlined
def _store_runs(bodies, column, store):
    """Move the cells of a column's bodies to a RunStore; return it, grown if full."""
    slots, n_slots, cells = bodies
    runs, n_runs, pool, used = store
    for slot in range(n_slots):
        first, past = slots[slot, 1], slots[slot, 2]
        if first >= past:
            continue
        if n_runs == runs.shape[0]:
            more_runs = np.empty((2 * n_runs, RUN), np.int64)
            for old in range(n_runs):
                for n in range(RUN):
                    more_runs[old, n] = runs[old, n]
            runs = more_runs
        length = past - first
        wanted = used + MOMENTS * length
        if wanted > pool.shape[0]:
            larger = np.empty(2 * wanted, np.float32)
            for old in range(used):
                larger[old] = pool[old]
            pool = larger
        for n in range(MOMENTS):
            mine, at = cells[slot, n], uint64(used + n * length)
            for i in range(uint64(length)):
                pool[at + i] = mine[uint64(first) + i]
            for k in range(uint64(first), uint64(past)):
                mine[k] = 0.0
        runs[n_runs, BODY], runs[n_runs, COLUMN] = slots[slot, 0], column
        runs[n_runs, FIRST_BIN], runs[n_runs, PAST_BIN], runs[n_runs, PLACE] = first, past, used
        n_runs, used = n_runs + 1, wanted
    return RunStore(runs, n_runs, pool, used)
