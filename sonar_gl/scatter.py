"""The compiled sums of labels: samples of one body, spread over its cells of one column."""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl import footprint
from sonar_gl.compiled import compiled, compiled_with
from sonar_gl.footprint import (
    ENERGY,
    FAR,
    HALF_HEIGHT,
    LAST,
    NEAR,
    V_RAY,
    A,
    B,
    Q,
    S,
    _below,
)

# Beside what `footprint` finds of a sample: its elevation and its incidence, radians.
ELEVATION, INCIDENCE = LAST + 1, LAST + 2
ROWS = LAST + 3
# Of a cell, one body's in one bin: what begins or ends there of samples that fill bins (their height, that
# times elevation and incidence, how many), and what lies in it of those that do not (echo, that times
# elevation, incidence, and range less `middle_m`). What fills a bin has its `middle_m` for its mean range.
HEIGHT, HEIGHT_ELEVATION, HEIGHT_INCIDENCE, COUNT, ECHO, ECHO_ELEVATION, ECHO_INCIDENCE, ECHO_RANGE = range(8)
CELL, MOMENTS = 8, 4  # of which the last four are what is handed on
NEAR_BIN, FAR_BIN = footprint.FIRST, LAST


@compiled
def middle_of(bin_edges_s):
    """(K,) mean range of what fills a bin, whose density is s = 1/r: ∫ ds / ∫ s ds."""
    return 2.0 / (bin_edges_s[:-1] + bin_edges_s[1:])


@compiled
def _ramp_range(s, start):
    """As `footprint._ramp`, of (s - start) ds."""
    t = max(s - start, 0.0)
    return t * t / 2


@compiled
def _below_range(s, middle, wide, thin):
    """As `footprint._below`, of range times energy."""
    rise = _ramp_range(s, middle - wide - thin) - _ramp_range(s, middle - wide + thin)
    return rise - (_ramp_range(s, middle + wide - thin) - _ramp_range(s, middle + wide + thin))


@compiled_with(footprint)
def _spread_trapezoid(work, m, cells, edges, middle_m, r_first, per_metre):
    """As `footprint._spread_trapezoid`; the first bin and past the last."""
    K, energy, s = middle_m.shape[0], work[ENERGY, m], work[S, m]
    wide, thin = max(work[A, m], work[B, m]), min(work[A, m], work[B, m])
    low, high = max(s - wide - thin, edges[K]), min(s + wide + thin, edges[0])
    if high <= low:
        return K, 0
    scale = energy / (4 * wide * thin)
    if s < wide + thin:
        scale = energy * s / (_below(s + wide + thin, s, wide, thin) - _below(0.0, s, wide, thin))
    first, last = int((1.0 / high - r_first) * per_metre), int((1.0 / low - r_first) * per_metre)
    last = min(last, K - 1)
    nearer, range_nearer = _below(high, s, wide, thin), _below_range(high, s, wide, thin)
    for k in range(uint64(first), uint64(last + 1)):
        edge = edges[k + uint64(1)] if k < last else low
        further, range_further = _below(edge, s, wide, thin), _below_range(edge, s, wide, thin)
        echo = scale * (nearer - further)
        cells[k, ECHO] += echo
        cells[k, ECHO_ELEVATION] += echo * work[ELEVATION, m]
        cells[k, ECHO_INCIDENCE] += echo * work[INCIDENCE, m]
        cells[k, ECHO_RANGE] += scale * (range_nearer - range_further) - echo * middle_m[k]
        nearer, range_nearer = further, range_further
    return first, last + 1


@compiled_with(footprint)
def spread_body(work, start, stop, cells, edges, middle_m, r_first, per_metre):
    """As `footprint.spread_footprints`, into one body's cells; the first bin and past the last."""
    K = middle_m.shape[0]
    lowest, highest = K, 0
    for m in range(uint64(start), uint64(stop)):
        energy, s = work[ENERGY, m], work[S, m]
        if energy == 0.0 or s <= 0.0:
            continue
        if 8 * min(work[A, m], work[B, m]) * per_metre >= s * s:
            first, past = _spread_trapezoid(work, m, cells, edges, middle_m, r_first, per_metre)
            lowest, highest = min(lowest, first), max(highest, past)
            continue
        near, far, half_height = work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m]
        if near <= far:
            continue
        elevation, incidence = work[ELEVATION, m], work[INCIDENCE, m]
        first, last = uint64(np.int32(work[NEAR_BIN, m])), uint64(min(np.int32(work[FAR_BIN, m]), K - 1))
        lowest, highest = min(lowest, int(first)), max(highest, int(last) + 1)
        after = first + uint64(1)
        inner = edges[after] if first < last else far
        part = half_height * (near - inner)
        echo = part * (near + inner)
        cells[first, ECHO] += echo
        cells[first, ECHO_ELEVATION] += echo * elevation
        cells[first, ECHO_INCIDENCE] += echo * incidence
        cells[first, ECHO_RANGE] += 2 * part - echo * middle_m[first]
        if first >= last:
            continue
        outer, height = edges[last], 2 * half_height
        part = half_height * (outer - far)
        echo = part * (outer + far)
        cells[last, ECHO] += echo
        cells[last, ECHO_ELEVATION] += echo * elevation
        cells[last, ECHO_INCIDENCE] += echo * incidence
        cells[last, ECHO_RANGE] += 2 * part - echo * middle_m[last]
        if after < last:
            cells[after, HEIGHT] += height
            cells[after, HEIGHT_ELEVATION] += height * elevation
            cells[after, HEIGHT_INCIDENCE] += height * incidence
            cells[after, COUNT] += 1.0
            cells[last, HEIGHT] -= height
            cells[last, HEIGHT_ELEVATION] -= height * elevation
            cells[last, HEIGHT_INCIDENCE] -= height * incidence
            cells[last, COUNT] -= 1.0
    return lowest, highest


@compiled
def drop_body(work, start, stop, cells, middle_m, u, nearest, step, bottom_row, r_first, per_metre):
    """As `footprint._drop`, into one body's cells; the first bin and past the last."""
    K = middle_m.shape[0]
    lowest, highest = K, 0
    for m in range(start, stop):
        j = bottom_row + m
        u_ray, v_ray = u[0] + u[1] * int(nearest - step * j) + u[2] * j, work[V_RAY, m]
        s = work[Q, m] / math.sqrt(1.0 + u_ray * u_ray + v_ray * v_ray)
        k = (1.0 / s - r_first) * per_metre
        if work[ENERGY, m] > 0.0 and 0.0 <= k < K:
            cell, echo = cells[int(k)], work[ENERGY, m] * s
            cell[ECHO] += echo
            cell[ECHO_ELEVATION] += echo * work[ELEVATION, m]
            cell[ECHO_INCIDENCE] += echo * work[INCIDENCE, m]
            cell[ECHO_RANGE] += work[ENERGY, m] - echo * middle_m[int(k)]
            lowest, highest = min(lowest, int(k)), max(highest, int(k) + 1)
    return lowest, highest
