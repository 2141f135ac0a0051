"""Adds footprints to the range bins of a column, by closed forms of their density in s = 1/r."""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.work_table import (
    ENERGY,
    FAR,
    FAR_BIN,
    HALF_HEIGHT,
    NEAR,
    NEAR_BIN,
    ROW,
    SAMPLE,
    SLANT,
    V_RAY,
    WORK_COLUMNS,
    WORK_ROWS,
    A,
    B,
    Q,
    S,
    whole_groups,
)
from sonar_gl.core.compiled import as_table, inlined, uncounted

# The share of a bin up to which the ramps at both ends of a footprint are neglected. Those of neighbouring rows overlap
# and add up to the same; those of joined rows do not, as on a wall that the sonar sees at an angle.
SHORT_RAMP, SHORT_RAMP_OF_JOINED = 1 / 4, 1 / 8
# Of s. A footprint that ends where its body does may have none, and an edge of bins may lie there.
LEAST_WIDTH = 1e-9
# Trapezoids of more bins are spread over AT_A_TIME at a time: each bin that is left over takes as long as such a group.
FEW_BINS = 3


@uncounted
def spread_footprints(work, start, stop, sums, spans, c, bins, short_ramp):
    """Add energy times s = 1/r, spread as the sum of two uniforms on ±a and ±b about s, to a row of bins.

    On a plane the cosine of incidence is proportional to s, and so is the energy's density.

    work : of `make_work`, of which the rows ENERGY, S, A, B and SLANT, from `start` to before `stop`, are read
    spans : (columns, 2), of rows of sums: extended over the bins that are added to, first and past last
    bins : BinTable
    short_ramp : share of a bin up to which ramps are neglected
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    K, bins_s, density32, middle_s32 = sums.shape[1], bins.s, bins.density32, bins.middle_s32
    first_m, per_metre = bins.first_m, bins.per_metre
    find_intervals(work, start, stop, bins)
    row, lowest, highest = uint64(c), uint64(K), uint64(0)
    for m in range(uint64(start), uint64(stop)):
        energy, s = work[ENERGY, m], work[S, m]
        if energy == 0.0 or s <= 0.0:
            continue
        wide, thin = max(work[A, m], work[B, m]), min(work[A, m], work[B, m])
        if 2 * thin * per_metre >= short_ramp * s * s:
            slant = work[SLANT, m]
            first, last = _spread_trapezoid(sums, c, bins_s, first_m, per_metre, energy, s, wide, thin, slant)
            lowest, highest = min(lowest, first), max(highest, last)
            continue
        near, far, half_height = work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m]
        if near <= far:  # outside the bins
            continue
        # written out here: a call for each sample takes as long as all the rest
        first, last = uint64(np.int32(work[NEAR_BIN, m])), uint64(min(np.int32(work[FAR_BIN, m]), K - 1))
        lowest, highest = min(lowest, first), max(highest, last)
        if first >= last:
            sums[row, last] += np.float32(half_height * (near - far) * (near + far))
            continue
        inner, outer, rise, height = bins_s[uint64(first + 1)], bins_s[last], 0.0, np.float32(2 * half_height)
        if work[SLANT, m] == 0.0:
            for k in range(uint64(first + 1), last):
                sums[row, k] += height * density32[k]
        else:
            rise = work[SLANT, m] / max(wide, LEAST_WIDTH * s)
            steepness, middle_s = np.float32(2 * half_height * rise), np.float32(s)
            for k in range(uint64(first + 1), last):
                sums[row, k] += (height + steepness * (middle_s32[k] - middle_s)) * density32[k]
        # by rounding, an end at the edge of a bin may lie beyond it, and the density at an end below zero
        slanted = max(1.0 + rise * ((near + inner) / 2 - s), 0.0)
        sums[row, first] += np.float32(max(half_height * (near * near - inner**2), 0.0) * slanted)
        slanted = max(1.0 + rise * ((outer + far) / 2 - s), 0.0)
        sums[row, last] += np.float32(max(half_height * (outer**2 - far * far), 0.0) * slanted)
    if lowest <= highest:
        # a trapezoid may end by rounding in the bin past its last one
        spans[c, 0], spans[c, 1] = min(spans[c, 0], int(lowest)), max(spans[c, 1], min(int(highest) + 2, K))


@uncounted
def find_intervals(work, first, last, bins):
    """Find both ends of footprints, their heights and bins, ramps neglected, from `first` to before `last`."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    energy, s, a, b = work[ENERGY], work[S], work[A], work[B]
    s_first, s_last, first_m, per_metre = bins.s[0], bins.s[-1], bins.first_m, bins.per_metre
    last_bin = bins.s.shape[0] - 2.0
    for m in range(uint64(first), uint64(whole_groups(first, last))):
        wide = max(a[m], b[m], LEAST_WIDTH * s[m])
        near, far = s[m] + wide, s[m] - wide
        past = far < 0.0  # beyond the horizon, as in `_spread_trapezoid`
        half_height = energy[m] * (s[m] if past else 0.25) / (near * near if past else wide)
        near, far = min(near, s_first), max(far, s_last)
        inverse = 1.0 / (near * far)  # one division for both ranges
        work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m] = near, far, half_height
        # by rounding, what begins at the end of the last bin would begin beyond it
        work[NEAR_BIN, m] = min((far * inverse - first_m) * per_metre, last_bin)
        work[FAR_BIN, m] = (near * inverse - first_m) * per_metre


@uncounted
def _spread_trapezoid(sums, c, bins_s, first_m, per_metre, energy, s, wide, thin, slant):
    """Add a footprint with ramps of more than a fraction of a bin to a row of bins; return first and last
    bin.
    """
    K = sums.shape[1]
    low, high = max(s - wide - thin, bins_s[K]), min(s + wide + thin, bins_s[0])
    if high <= low:
        return uint64(K), uint64(0)
    scale = energy / (4 * wide * thin)
    # a plane beyond its horizon: the energy of the middle is spread over the part in view
    if s < wide + thin:
        scale = energy * s / (energy_below(s + wide + thin, s, wide, thin) - energy_below(0.0, s, wide, thin))
    row = uint64(c)
    first = uint64(min(int((1.0 / high - first_m) * per_metre), K - 1))  # as in `find_intervals`
    last = uint64(min(int((1.0 / low - first_m) * per_metre), K - 1))
    nearer, rise = energy_below(high, s, wide, thin), slant / wide if slant != 0.0 else 0.0
    # in whole groups, of which bins past the last get nothing
    end = uint64(whole_groups(np.int64(first), np.int64(last) + 1))
    if last >= first + uint64(FEW_BINS) and end <= uint64(K):
        for k in range(first, end):
            edge = max(bins_s[uint64(k + 1)], low)
            further = energy_below(edge, s, wide, thin)
            echo = scale * max(nearer - further, 0.0)
            sums[row, k] += np.float32(echo * slanted_density(rise, s, high, edge, wide))
            nearer, high = further, edge
        return first, last
    for k in range(first, last):
        edge = bins_s[uint64(k + 1)]
        further = energy_below(edge, s, wide, thin)
        echo = scale * max(nearer - further, 0.0)
        sums[row, k] += np.float32(echo * slanted_density(rise, s, high, edge, wide))
        nearer, high = further, edge
    echo = scale * max(nearer - energy_below(low, s, wide, thin), 0.0)
    sums[row, last] += np.float32(echo * slanted_density(rise, s, high, low, wide))
    return first, last


@uncounted
def _ramp(s, start):
    """Integrate (s - start) s ds from `start` on."""
    t = max(s - start, 0.0)
    return t * t * (t / 3 + start / 2)


@uncounted
def energy_below(s, middle, wide, thin):
    """Return 4 wide thin times the energy up to s of the convolution of boxes on ±wide and ±thin.

    It rises with s, but where `wide` far exceeds a bin, as on a plane seen edge-on, rounding makes it fall.
    """
    rise = _ramp(s, middle - wide - thin) - _ramp(s, middle - wide + thin)
    return rise - (_ramp(s, middle + wide - thin) - _ramp(s, middle + wide + thin))


@uncounted
def slanted_density(rise, s, nearer, further, wide):
    """Return the density between two places in s, over that of an even footprint about s; ramps are as at its ends.

    At an end without density rounding would make it negative.
    """
    return max(1.0 + rise * min(max((nearer + further) / 2 - s, -wide), wide), 0.0)


@inlined
def bin_points(work, sums, spans, u, strip, bins):
    """Add each of a strip's samples to the one bin that holds the range of its ray."""
    c = strip.column
    for m in range(strip.first, strip.last):
        j = work[ROW, m]
        u_ray, v_ray = u[0] + u[1] * work[SAMPLE, m] + u[2] * j, work[V_RAY, m]
        s = work[Q, m] / math.sqrt(1.0 + u_ray * u_ray + v_ray * v_ray)
        k = (1.0 / s - bins.first_m) * bins.per_metre
        if 0.0 <= k < sums.shape[1]:
            sums[c, int(k)] += work[ENERGY, m] * s
            spans[c, 0], spans[c, 1] = min(spans[c, 0], int(k)), max(spans[c, 1], int(k) + 1)
