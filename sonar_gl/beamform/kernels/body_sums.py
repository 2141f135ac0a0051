"""Sums of samples in columns and range bins for each body by itself, for labels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.footprints import find_footprints, is_long, keep_within
from sonar_gl.beamform.kernels.joined_rows import untried_after
from sonar_gl.beamform.kernels.moments import MOMENTS, bin_moments, find_angles, spread_moments
from sonar_gl.beamform.kernels.range_bins import BinTable
from sonar_gl.beamform.kernels.runs import BODY, COLUMN, FIRST_BIN, PAST_BIN, PLACE, RunStore
from sonar_gl.beamform.kernels.spreading import SHORT_RAMP, SHORT_RAMP_OF_JOINED, bin_points, find_intervals
from sonar_gl.beamform.kernels.strips import Lattice, StripTable, find_strip
from sonar_gl.beamform.kernels.work_table import ROW, SAMPLE, WORK_COLUMNS, WORK_ROWS
from sonar_gl.core.compiled import as_table, compiled, inlined, uncounted

# Of a slot: its body (BODY), and that body's first bin and past its last in the column that is summed.
FIRST, PAST = 1, 2
SLOT = 3


class LabelRoom(NamedTuple):
    """Room that bodies need: slots, one for each body in a column of `LabelColumns`; runs and numbers of a RunStore."""

    n_slots: int
    n_runs: int
    n_pool: int


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

    Returns a plain tuple of LabelRoom that `cells` and `store` need, with what is in use already. Where they have less,
    the runs are lost, and all samples must be summed again; the slots needed are a guess then.

    work .. elevation_pattern : as in `sum_footprints`, but for body_id
    body_id : (C, R) uint16, column by column, as a strip reads it
    label_column : (columns,) int64, with the wide ones, that of `LabelColumns` which each is part of
    cells : (slots, MOMENTS, K) float32, for the bodies of one column at a time; zeros before and after
    store : tuple of RunStore, to which runs are added
    sums, spans : as in `sum_footprints`, with the same bits
    """
    slots, numbers = np.empty((cells.shape[0], SLOT), np.int64), np.empty(plane_echo.shape[0] + 1, np.int64)
    samples = plane_echo, face_id, body_id, body_spans, Lattice(*lattice)
    spreading = BinTable(*bins), spread, elevation_pattern
    room = slots, numbers, cells, RunStore(*store)
    return _sum_strips(work, samples, StripTable(*strips), spreading, label_column, room, sums, spans)


@uncounted
def _sum_strips(work, samples, strips, spreading, label_column, room, sums, spans):
    """Do as `sum_bodies`.

    samples : plane_echo, face_id, body_id, body_spans, lattice
    spreading : bins, spread, elevation_pattern
    room : slots, (slots, SLOT) int64, and body numbers, (rows + 1,) int64, which are overwritten; cells; store
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    plane_echo, face_id, body_id, body_spans, lattice = samples
    bins, spread, elevation_pattern = spreading
    slots, numbers, cells, store = room
    n_slots, most_slots, n_runs, n_pool = 0, 0, store.n_runs, store.n_pool
    joined, untried = -1, 0
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
            n_runs, n_pool = _store_runs(slots, n_slots, cells, joined, store, n_runs, n_pool)
            n_slots, joined = 0, label_column[column]
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
            slot = _slot_of(numbers[start], slots, n_slots)
            most_slots = max(most_slots, slot + 1)
            if slot == slots.shape[0]:  # there are too few: the results are lost
                most_slots, slot = 2 * slot, slot - 1
            elif slot == n_slots:
                slots[slot, BODY], slots[slot, FIRST], slots[slot, PAST] = numbers[start], cells.shape[2], 0
                n_slots += 1
            if spread:
                low, high = spread_moments(work, start, stop, cells, slot, sums, column, bins, short_ramp)
                spans[column, 0], spans[column, 1] = min(spans[column, 0], low), max(spans[column, 1], high)
            else:
                low, high = bin_moments(work, start, stop, cells, slot, lattice.u, bins)
            slots[slot, FIRST], slots[slot, PAST] = min(slots[slot, FIRST], low), max(slots[slot, PAST], high)
            start = stop
    n_runs, n_pool = _store_runs(slots, n_slots, cells, joined, store, n_runs, n_pool)
    return most_slots, n_runs, n_pool


@inlined
def _find_numbers(work, strip, columns, body_id, numbers):
    """Find the body of each of a strip's samples, whether it has energy or not: to ask would be a branch."""
    sample, row = work[SAMPLE], work[ROW]
    for m in range(uint64(strip.first), uint64(strip.last)):
        i = min(max(np.int64(sample[m]), 0), columns - 1)
        numbers[m] = body_id[uint64(i), uint64(row[m])]


@inlined
def _slot_of(body, slots, n_slots):
    """Return the slot of a body in the column that is summed, or the first that is not in use."""
    slot = 0
    while slot < n_slots and slots[slot, BODY] != body:
        slot += 1
    return slot


@inlined
def _store_runs(slots, n_slots, cells, column, store, n_runs, n_pool):
    """Move the cells of a column's bodies to a RunStore, if they fit; return the runs and numbers that it needs."""
    runs, pool = store.runs, store.pool
    for slot in range(n_slots):
        first, past = slots[slot, FIRST], slots[slot, PAST]
        if first >= past:
            continue
        length = past - first
        fits = n_runs < runs.shape[0] and n_pool + MOMENTS * length <= pool.shape[0]
        for n in range(MOMENTS):
            mine, at = cells[slot, n], uint64(n_pool + n * length)
            if fits:
                for i in range(uint64(length)):
                    pool[at + i] = mine[uint64(first) + i]
            for k in range(uint64(first), uint64(past)):
                mine[k] = 0.0
        if fits:
            runs[n_runs, BODY], runs[n_runs, COLUMN] = slots[slot, BODY], column
            runs[n_runs, FIRST_BIN], runs[n_runs, PAST_BIN], runs[n_runs, PLACE] = first, past, n_pool
        n_runs, n_pool = n_runs + 1, n_pool + MOMENTS * length
    return n_runs, n_pool
