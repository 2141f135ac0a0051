"""Moments of a body's echo in range bins: echo, and echo times elevation, incidence and range.

They are added as `spreading` adds echo, with the same bits of echo.
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.spreading import FEW_BINS, LEAST_WIDTH, energy_below, slanted_density
from sonar_gl.beamform.kernels.work_table import (
    ALONG,
    ALONG_U,
    BIN_ECHO,
    BIN_ELEVATION,
    BIN_INCIDENCE,
    BIN_RANGE,
    BORDER,
    ELEVATION,
    ELEVATION_RISE,
    ENERGY,
    FAR,
    FAR_BIN,
    HALF_HEIGHT,
    INCIDENCE,
    INCIDENCE_RISE,
    LEAST_POWER,
    LINE_U,
    NEAR,
    NEAR_BIN,
    REST,
    ROW,
    SAMPLE,
    SLANT,
    TILT,
    V_RAY,
    A,
    B,
    Q,
    S,
    whole_groups,
)
from sonar_gl.core.compiled import inlined, uncounted

# Rows of a body's cells, one cell per bin: echo, and echo times elevation, incidence, and range less `middle_m`,
# which is the mean range of a footprint that fills the bin.
CELL_ECHO, CELL_ELEVATION, CELL_INCIDENCE, CELL_RANGE = range(4)
MOMENTS = 4


@inlined
def find_angles(work, strip):
    """Find elevation and incidence of a strip's footprints, before `find_intervals`."""
    rest, along, along_u, border, s = work[REST], work[ALONG], work[ALONG_U], work[BORDER], work[S]
    line_u, tilt, elevation, incidence = work[LINE_U], work[TILT], work[ELEVATION], work[INCIDENCE]
    inverse_length, incidence_rise = work[NEAR], work[INCIDENCE_RISE]
    first, last = strip.first, strip.last
    for m in range(uint64(first), uint64(whole_groups(first, last))):
        # of the plane p · x = 1, whose other parts are the slopes
        x, along_v = rest[m] - along_u[m] * line_u[m], along[m] - along_u[m] * tilt[m]
        towards = max(s[m], 0.0)
        past2 = x * x + along_u[m] * along_u[m] + along_v * along_v - towards * towards
        past = math.sqrt(max(past2, 0.0))
        angle = atan(min(towards, past) / max(towards, past))
        incidence[m] = math.pi / 2 - angle if past > towards else angle
        incidence_rise[m] = past  # for `_find_rises`
        vc = (border[m] + border[uint64(m + 1)]) / 2
        elevation[m] = math.copysign(asin(abs(vc) * inverse_length[m]), vc)
    _find_rises(work, strip)


@inlined
def _find_rises(work, strip):
    """Find how elevation and incidence change with s within footprints, which end at a right angle at most."""
    rest, along, border, s = work[REST], work[ALONG], work[BORDER], work[S]
    line_u, tilt, a, b = work[LINE_U], work[TILT], work[A], work[B]
    elevation, incidence = work[ELEVATION], work[INCIDENCE]
    elevation_rise, incidence_rise = work[ELEVATION_RISE], work[INCIDENCE_RISE]
    for m in range(uint64(strip.first), uint64(whole_groups(strip.first, strip.last))):
        # the plane's vector has the part s along the ray, and this one across it
        past, low, high = incidence_rise[m], border[m], border[uint64(m + 1)]
        # by linear regression, if s changes across the strip, too: b² / (a² + b²), over b
        share = b[m] / max(a[m] * a[m] + b[m] * b[m], LEAST_POWER)
        share = share if b[m] > 1e-9 * s[m] else 0.0
        # cos θ is s over the length of the plane's vector; at normal incidence θ falls to 0 at an end. A footprint that
        # extends past the horizon ends there, at s = 0
        below = (math.pi / 2 - incidence[m]) * max(1.0, b[m] / max(s[m], LEAST_POWER))
        incidence_rise[m] = -share * min(b[m] / max(past, LEAST_POWER), incidence[m], below)
        vc, uc = (low + high) / 2, line_u[m] + tilt[m] * (low + high) / 2
        level2 = 1.0 + uc * uc
        length2 = level2 + vc * vc
        rise = (high - low) / 2 * math.sqrt(level2) / length2
        rise = share * min(rise, math.pi / 2 - abs(elevation[m]))
        is_nearer_above = along[m] * length2 > (rest[m] + along[m] * vc) * (vc + uc * tilt[m])
        elevation_rise[m] = rise if is_nearer_above else -rise


@uncounted
def atan(t):
    """Return arctan of 0..1 to 2e-8; unlike the library's, the compiler can vectorise it.

    Source: Abramowitz, Stegun, "Handbook of Mathematical Functions", 4.4.49
    """
    x = t * t
    p = (0.0028662257 * x - 0.0161657367) * x + 0.0429096138
    p = ((p * x - 0.0752896400) * x + 0.1065626393) * x - 0.1420889944
    return (((p * x + 0.1999355085) * x - 0.3333314528) * x + 1.0) * t


@uncounted
def asin(x):
    """Return arcsin of 0..1 to 2e-8, with one square root.

    Source: Abramowitz, Stegun, "Handbook of Mathematical Functions", 4.4.46
    """
    p = ((-0.0012624911 * x + 0.0066700901) * x - 0.0170881256) * x + 0.0308918810
    p = (((p * x - 0.0501743046) * x + 0.0889789874) * x - 0.2145988016) * x + 1.5707963050
    return math.pi / 2 - math.sqrt(max(1.0 - x, 0.0)) * p


@inlined
def spread_moments(work, start, stop, cells, slot, sums, row, bins, short_ramp):
    """Do as `spread_footprints`, and the same into one body's cells; return the first bin and past the last."""
    bins_s, middle_m, density32, middle_s32 = bins.s, bins.middle_m, bins.density32, bins.middle_s32
    first_m, per_metre = bins.first_m, bins.per_metre
    K, slot, row = middle_m.shape[0], uint64(slot), uint64(row)
    lowest, highest = uint64(K), uint64(0)
    for m in range(uint64(start), uint64(stop)):
        energy, s = work[ENERGY, m], work[S, m]
        if energy == 0.0 or s <= 0.0:
            continue
        if 2 * min(work[A, m], work[B, m]) * per_metre >= short_ramp * s * s:
            first, last = _spread_moments_trapezoid(
                work, m, cells, slot, sums, row, bins_s, middle_m, first_m, per_metre
            )
            lowest, highest = min(lowest, first), max(highest, last)
            continue
        near, far, half_height = work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m]
        if near <= far:
            continue
        first, last = uint64(np.int32(work[NEAR_BIN, m])), uint64(min(np.int32(work[FAR_BIN, m]), K - 1))
        lowest, highest = min(lowest, first), max(highest, last)
        elevation, incidence = np.float32(work[ELEVATION, m]), np.float32(work[INCIDENCE, m])
        if first >= last:
            echo, part = half_height * (near - far) * (near + far), half_height * (near - far)
            sums[row, last] += np.float32(echo)
            range_ = np.float32(2 * part - echo * middle_m[last])
            _add_moments(cells, slot, last, np.float32(echo), elevation, incidence, range_)
            continue
        inner, outer = bins_s[uint64(first + 1)], bins_s[last]
        rise = work[SLANT, m] / max(work[A, m], work[B, m], LEAST_WIDTH * s)
        even_echo = max(half_height * (near * near - inner**2), 0.0)
        slanted = max(1.0 + rise * ((near + inner) / 2 - s), 0.0)
        echo = even_echo * slanted
        sums[row, first] += np.float32(echo)
        range_ = np.float32((2 * half_height * (near - inner) - even_echo * middle_m[first]) * slanted)
        _add_moments(cells, slot, first, np.float32(echo), *_angles_at(work, m, (near + inner) / 2), range_)
        even_echo = max(half_height * (outer**2 - far * far), 0.0)
        slanted = max(1.0 + rise * ((outer + far) / 2 - s), 0.0)
        echo = even_echo * slanted
        sums[row, last] += np.float32(echo)
        range_ = np.float32((2 * half_height * (outer - far) - even_echo * middle_m[last]) * slanted)
        _add_moments(cells, slot, last, np.float32(echo), *_angles_at(work, m, (outer + far) / 2), range_)
        height, middle_s = np.float32(2 * half_height), np.float32(s)
        steepness = np.float32(2 * half_height * rise)
        # not in the loop below: there the product would be rounded before it is added, and sums have other bits
        if rise == 0.0:
            for k in range(uint64(first + 1), last):
                sums[row, k] += height * density32[k]
        else:
            for k in range(uint64(first + 1), last):
                sums[row, k] += (height + steepness * (middle_s32[k] - middle_s)) * density32[k]
        elevation_rise = np.float32(work[ELEVATION_RISE, m])
        incidence_rise = np.float32(work[INCIDENCE_RISE, m])
        for k in range(uint64(first + 1), last):
            off = middle_s32[k] - middle_s
            echo32 = (height + steepness * off) * density32[k]
            cells[slot, CELL_ECHO, k] += echo32
            cells[slot, CELL_ELEVATION, k] += echo32 * (elevation + elevation_rise * off)
            cells[slot, CELL_INCIDENCE, k] += echo32 * (incidence + incidence_rise * off)
    return int(lowest), int(highest) + 1 if lowest <= highest else 0


@inlined
def _spread_moments_trapezoid(work, m, cells, slot, sums, row, bins_s, middle_m, first_m, per_metre):
    """As `_spread_trapezoid` of `spreading`, with moments; return first and last bin."""
    K, energy, s = middle_m.shape[0], work[ENERGY, m], work[S, m]
    wide, thin = max(work[A, m], work[B, m]), min(work[A, m], work[B, m])
    low, high = max(s - wide - thin, bins_s[K]), min(s + wide + thin, bins_s[0])
    if high <= low:
        return uint64(K), uint64(0)
    scale = energy / (4 * wide * thin)
    if s < wide + thin:
        scale = energy * s / (energy_below(s + wide + thin, s, wide, thin) - energy_below(0.0, s, wide, thin))
    first = uint64(min(int((1.0 / high - first_m) * per_metre), K - 1))
    last = uint64(min(int((1.0 / low - first_m) * per_metre), K - 1))
    nearer, range_nearer = energy_below(high, s, wide, thin), _below_range(high, s, wide, thin)
    rise = work[SLANT, m] / wide
    if last < first + uint64(FEW_BINS):
        for k in range(first, uint64(last + 1)):
            edge = bins_s[uint64(k + 1)] if k < last else low
            further, range_further = energy_below(edge, s, wide, thin), _below_range(edge, s, wide, thin)
            parts = nearer - further, range_nearer - range_further
            echo, at, range_ = _moments_between(high, edge, *parts, scale, rise, s, wide, middle_m[k])
            sums[row, k] += np.float32(echo)
            _add_moments(cells, slot, k, np.float32(echo), *_angles_at(work, m, at), np.float32(range_))
            nearer, range_nearer, high = further, range_further, edge
        return first, last
    # in whole groups, as there; bins past the last get nothing
    n = uint64(whole_groups(0, np.int64(last - first) + 1))
    n = n if first + n <= uint64(K) else last - first + uint64(1)
    echoes, elevations = work[BIN_ECHO], work[BIN_ELEVATION]
    incidences, ranges = work[BIN_INCIDENCE], work[BIN_RANGE]
    # read here, since the compiler takes any entry of a row for one that the loop writes
    elevation, elevation_rise = work[ELEVATION, m], work[ELEVATION_RISE, m]
    incidence, incidence_rise = work[INCIDENCE, m], work[INCIDENCE_RISE, m]
    for k in range(n):
        edge = max(bins_s[first + k + uint64(1)], low)
        further, range_further = energy_below(edge, s, wide, thin), _below_range(edge, s, wide, thin)
        parts = nearer - further, range_nearer - range_further
        echo, at, range_ = _moments_between(high, edge, *parts, scale, rise, s, wide, middle_m[first + k])
        echoes[k], ranges[k] = echo, range_
        elevations[k] = elevation + elevation_rise * (at - s)
        incidences[k] = incidence + incidence_rise * (at - s)
        nearer, range_nearer, high = further, range_further, edge
    # one row at a time: any two of them might overlap, and the compiler would do one bin after the other
    for k in range(n):
        sums[row, first + k] += np.float32(echoes[k])
    for k in range(n):
        cells[slot, CELL_ECHO, first + k] += np.float32(echoes[k])
    for k in range(n):
        cells[slot, CELL_ELEVATION, first + k] += np.float32(echoes[k]) * np.float32(elevations[k])
    for k in range(n):
        cells[slot, CELL_INCIDENCE, first + k] += np.float32(echoes[k]) * np.float32(incidences[k])
    for k in range(n):
        cells[slot, CELL_RANGE, first + k] += np.float32(ranges[k])
    return first, last


@uncounted
def _moments_between(nearer, further, energy, range_energy, scale, rise, s, wide, middle_m):
    """Return the echo of a trapezoid between two places in s, where it has its angles, and its moment of range.

    energy, range_energy : what lies there by `energy_below` and `_below_range`, to be multiplied by `scale`
    """
    slanted, even_echo = slanted_density(rise, s, nearer, further, wide), scale * max(energy, 0.0)
    at = min(max((nearer + further) / 2, s - wide), s + wide)
    return even_echo * slanted, at, (scale * range_energy - even_echo * middle_m) * slanted


@inlined
def _angles_at(work, m, s):
    """Return elevation and incidence of a footprint at s, float32."""
    off = s - work[S, m]
    elevation = work[ELEVATION, m] + work[ELEVATION_RISE, m] * off
    return np.float32(elevation), np.float32(work[INCIDENCE, m] + work[INCIDENCE_RISE, m] * off)


@uncounted
def _ramp_range(s, start):
    """As `_ramp` of `spreading`, for (s - start) ds."""
    t = max(s - start, 0.0)
    return t * t / 2


@uncounted
def _below_range(s, middle, wide, thin):
    """As `energy_below`, for range times energy."""
    rise = _ramp_range(s, middle - wide - thin) - _ramp_range(s, middle - wide + thin)
    return rise - (_ramp_range(s, middle + wide - thin) - _ramp_range(s, middle + wide + thin))


@inlined
def bin_moments(work, start, stop, cells, slot, u, bins):
    """As `bin_points`, into one body's cells; return the first bin and past the last."""
    middle_m = bins.middle_m
    K = middle_m.shape[0]
    lowest, highest = K, 0
    for m in range(start, stop):
        j = work[ROW, m]
        u_ray, v_ray = u[0] + u[1] * work[SAMPLE, m] + u[2] * j, work[V_RAY, m]
        s = work[Q, m] / math.sqrt(1.0 + u_ray * u_ray + v_ray * v_ray)
        bin_ = (1.0 / s - bins.first_m) * bins.per_metre
        if work[ENERGY, m] > 0.0 and 0.0 <= bin_ < K:
            k, echo = int(bin_), work[ENERGY, m] * s
            elevation, incidence = np.float32(work[ELEVATION, m]), np.float32(work[INCIDENCE, m])
            range_ = np.float32(work[ENERGY, m] - echo * middle_m[k])
            _add_moments(cells, slot, k, np.float32(echo), elevation, incidence, range_)
            lowest, highest = min(lowest, k), max(highest, k + 1)
    return lowest, highest


@uncounted
def _add_moments(cells, slot, k, echo, elevation, incidence, range_):
    """Add an echo with its elevation, incidence and echo times range less `middle_m` to a cell."""
    cells[slot, CELL_ECHO, k] += echo
    cells[slot, CELL_ELEVATION, k] += echo * elevation
    cells[slot, CELL_INCIDENCE, k] += echo * incidence
    cells[slot, CELL_RANGE, k] += range_
