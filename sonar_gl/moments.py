"""The compiled sums of labels: each body's echo, and its moments, in columns and bins."""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl import footprint, scatter
from sonar_gl.compiled import compiled, compiled_with
from sonar_gl.footprint import (
    ALONG_U,
    ALONG_V,
    BORDER,
    ENERGY,
    FAR_FACTOR,
    REST,
    S,
    _find_borders,
    _find_boxes,
    _find_shapes,
    _look,
)
from sonar_gl.scatter import (
    CELL,
    COUNT,
    ECHO,
    ECHO_ELEVATION,
    ECHO_INCIDENCE,
    ECHO_RANGE,
    ELEVATION,
    HEIGHT,
    HEIGHT_ELEVATION,
    HEIGHT_INCIDENCE,
    INCIDENCE,
    MOMENTS,
    ROWS,
    drop_body,
    middle_of,
    spread_body,
)

BODY, COLUMN, FIRST, PAST, PLACE = range(5)  # of a run, its bins, and where in the pool it begins


@compiled
def acos(c):
    """arccos of 0..1 to 2e-8; unlike the library's the compiler makes vectors of it.

    Source: Abramowitz, Stegun, "Handbook of Mathematical Functions", 4.4.46
    """
    p = -0.0012624911 * c + 0.0066700901
    p = ((p * c - 0.0170881256) * c + 0.0308918810) * c - 0.0501743046
    p = ((p * c + 0.0889789874) * c - 0.2145988016) * c + 1.5707963050
    return math.sqrt(max(1.0 - c, 0.0)) * p


@compiled_with(footprint, scatter)
def _find_angles(work, first, last, uc, v_limit, arcs, elevation):
    """Elevation and incidence of a strip's samples from `first` to before `last`."""
    rest, along_v, along_u, border, s = work[REST], work[ALONG_V], work[ALONG_U], work[BORDER], work[S]
    for m in range(uint64(first), uint64(last)):
        x = rest[m] - along_u[m] * uc  # of the plane p · x = 1, whose other parts are the slopes
        size = math.sqrt(x * x + along_u[m] * along_u[m] + along_v[m] * along_v[m])
        work[INCIDENCE, m] = acos(min(max(s[m], 0.0) / size, 1.0))
    u2, v2, middle = 1.0 + uc * uc, v_limit * v_limit, (arcs.shape[0] - 1) / 2
    for m in range(first, last):
        vc = (border[m] + border[m + 1]) / 2
        place = middle + middle * vc * math.sqrt((u2 / v2 + 1.0) / (u2 + vc * vc))
        i = min(max(int(place), 0), arcs.shape[0] - 2)
        work[ELEVATION, m] = arcs[i] + (place - i) * (arcs[i + 1] - arcs[i])
        if elevation.shape[0] and work[ENERGY, m] > 0.0:  # the table holds how it is heard, too
            work[ELEVATION, m] /= elevation[i] + (place - i) * (elevation[i + 1] - elevation[i])


@compiled_with(scatter)
def _slot_of(body, slots, n_slots, cells):
    """The place of a body's cells in a column, a new one at first; and the rest, larger if it was full."""
    slot = 0
    while slot < n_slots and slots[slot, 0] != body:
        slot += 1
    if slot < n_slots:
        return slot, slots, n_slots, cells
    if n_slots == slots.shape[0]:
        more = np.zeros((2 * n_slots, cells.shape[1], CELL)), np.empty((2 * n_slots, 3), np.int64)
        more[0][:n_slots], more[1][:n_slots] = cells, slots
        cells, slots = more
    slots[slot, 0], slots[slot, 1], slots[slot, 2] = body, cells.shape[1], 0
    return slot, slots, n_slots + 1, cells


@compiled_with(scatter)
def _close(cells, slot, first, past, flat, pool, place):
    """Lay a body's cells of one column in the pool, MOMENTS rows one after the other, and clear them."""
    n, slot, first, place = uint64(past - first), uint64(slot), uint64(first), uint64(place)
    height = by_elevation = by_incidence = count = 0.0
    for i in range(n):
        k, at = first + i, place + i
        count += cells[slot, k, COUNT]
        # where none is left over what remains of the sums is rounding
        height = height + cells[slot, k, HEIGHT] if count > 0.0 else 0.0
        by_elevation = by_elevation + cells[slot, k, HEIGHT_ELEVATION] if count > 0.0 else 0.0
        by_incidence = by_incidence + cells[slot, k, HEIGHT_INCIDENCE] if count > 0.0 else 0.0
        pool[at] = cells[slot, k, ECHO] + height * flat[k]
        pool[at + n] = cells[slot, k, ECHO_ELEVATION] + by_elevation * flat[k]
        pool[at + uint64(2) * n] = cells[slot, k, ECHO_INCIDENCE] + by_incidence * flat[k]
        pool[at + uint64(3) * n] = cells[slot, k, ECHO_RANGE]
    cells[slot, first : first + n] = 0.0


@compiled_with(scatter)
def _close_all(cells, slots, n_slots, column, flat, runs, pool, n_runs, used):
    """Hand a column's cells on; runs and pool, larger ones where they were full, and how much is used."""
    for slot in range(n_slots):
        first, past = slots[slot, 1], slots[slot, 2]
        if first >= past:
            continue
        if n_runs == runs.shape[0]:
            more = np.empty((2 * n_runs, runs.shape[1]), runs.dtype)
            more[:n_runs] = runs
            runs = more
        wanted = used + MOMENTS * (past - first)
        if wanted > pool.shape[0]:
            larger = np.empty(2 * wanted, pool.dtype)
            larger[:used] = pool[:used]
            pool = larger
        _close(cells, slot, first, past, flat, pool, used)
        runs[n_runs, BODY], runs[n_runs, COLUMN] = slots[slot, 0], column
        runs[n_runs, FIRST], runs[n_runs, PAST], runs[n_runs, PLACE] = first, past, used
        n_runs, used = n_runs + 1, wanted
    return runs, pool, n_runs, used


@compiled_with(footprint, scatter)
def gather(
    plane_echo, body_id, u, v, tan_elevation, part_column, part_u, part_width, bin_edges_m, tables, spread,
    elevation, arcs, cells, runs, pool, n_runs, used,
):  # fmt: skip
    """Sum some of one sector's samples into columns, for each body by itself.

    Parameters
    ----------
    plane_echo, u .. part_width, bin_edges_m, tables, elevation : as of `footprint.accumulate`
    body_id : (R, C) uint16
    spread : False drops samples whole into one bin
    arcs : elevation, radians, at even sines across the aperture, times how it is heard
    cells : (slots, K, CELL) float64, zeros before and after
    runs : (n, 5) int64, BODY .. PLACE, in use up to n_runs
    pool : (n,) float32, in use up to used: of each run MOMENTS rows, of its bins' echo, and that times
        elevation, incidence, and range less `scatter.middle_of` the bin

    Returns
    -------
    cells, runs, pool, n_runs, used : of these larger ones, where they were full
    """
    R, K = plane_echo.shape[0], bin_edges_m.shape[0] - 1
    r_first, r_last = bin_edges_m[0], bin_edges_m[K]
    per_metre, edges, flat, middle_m = K / (r_last - r_first), tables[0], tables[1], middle_of(tables[0])
    work, slots, n_slots = np.empty((ROWS, R + 1)), np.empty((cells.shape[0], 3), np.int64), 0
    for p in range(part_u.shape[0]):
        c, uc = part_column[p], part_u[p]
        if p > 0 and part_column[p - 1] != c:
            runs, pool, n_runs, used = _close_all(
                cells, slots, n_slots, part_column[p - 1], flat, runs, pool, n_runs, used
            )
            n_slots = 0
        v_limit = tan_elevation * math.sqrt(1.0 + uc * uc)
        nearest, step = (uc - u[0]) / u[1] + 0.5, u[2] / u[1]
        last_row = nearest - step * R
        if max(nearest, last_row) <= -1.0 or min(nearest, last_row) >= plane_echo.shape[1]:
            continue
        bottom, rise = v[0] + v[1] * nearest, v[2] - v[1] * step
        bottom_row = max(int((-v_limit - bottom) / rise) - 2, 0)
        n = min(int((v_limit - bottom) / rise) + 3, R - 1) - bottom_row + 1
        first, last = _look(work, plane_echo, u, v, uc, nearest, step, bottom_row, n)
        if first > last:
            continue
        last += 1
        work[BORDER, 0], work[BORDER, n] = -v_limit, v_limit
        _find_borders(work, max(first, 1), min(last + 1, n), 1.0 / (FAR_FACTOR * r_last), v_limit)
        _find_shapes(work, first, last, uc, part_width[p], v_limit, elevation)
        _find_angles(work, first, last, uc, v_limit, arcs, elevation)
        _find_boxes(work, first, last, edges[0], edges[K], r_first, per_metre)
        start = first
        while start < last:  # samples of one body after the other
            body = body_id[bottom_row + start, int(nearest - step * (bottom_row + start))]
            stop = start + 1
            while stop < last:
                j = bottom_row + stop
                if work[ENERGY, stop] > 0.0 and body_id[j, int(nearest - step * j)] != body:
                    break
                stop += 1
            slot, slots, n_slots, cells = _slot_of(body, slots, n_slots, cells)
            if spread:
                found = spread_body(work, start, stop, cells[slot], edges, middle_m, r_first, per_metre)
            else:
                lattice = u, nearest, step, bottom_row
                found = drop_body(work, start, stop, cells[slot], middle_m, *lattice, r_first, per_metre)
            slots[slot, 1], slots[slot, 2] = min(slots[slot, 1], found[0]), max(slots[slot, 2], found[1])
            start = stop
    if part_u.shape[0]:
        runs, pool, n_runs, used = _close_all(
            cells, slots, n_slots, part_column[-1], flat, runs, pool, n_runs, used
        )
    return cells, runs, pool, n_runs, used
