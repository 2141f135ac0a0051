"""Footprints of a strip's samples: their energy, and the interval of s = 1/r that each covers."""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.strips import LEAST_AHEAD
from sonar_gl.beamform.kernels.work_table import (
    ALONG,
    ALONG_U,
    BORDER,
    ECHO,
    ECHO_RISE,
    ENERGY,
    FAR,
    LEAST_POWER,
    LINE_U,
    NEAR,
    NEAR_BIN,
    REST,
    ROW,
    SAMPLE,
    SLANT,
    TILT,
    WORK_COLUMNS,
    WORK_ROWS,
    A,
    B,
    S,
    whole_groups,
)
from sonar_gl.core.compiled import as_table, inlined, uncounted

# The share of a bin that a footprint, far longer than wide, covers at least if its density is to change along it. In
# shorter ones that moves too little echo to matter.
LEAST_SLANTED = 1 / 8
# Of its range: a longer footprint is kept within the range of its body. Half a sample beyond a face that is seen nearly
# edge-on may lie metres from it.
LONG_FOOTPRINT = 1 / 64


@uncounted
def find_footprints(work, strip, elevation_pattern, per_metre):
    """Find energy, centre, half-widths and slant of a strip's footprints.

    Within a footprint the elevation pattern is linear. That slants the footprints that `_is_slanted` names; in others
    the slants of neighbours make up for each other.

    elevation_pattern : (n,) two-way beam pattern at even sines of elevation from -1 to 1, or of no length
    per_metre : of BinTable
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    rest, along, along_u, echo, border = work[REST], work[ALONG], work[ALONG_U], work[ECHO], work[BORDER]
    line_u, tilt, first, last = work[LINE_U], work[TILT], strip.first, strip.last
    are_cones, width, sine, cosine = strip.are_cones, strip.width, strip.sine, strip.cosine
    # `find_intervals` writes the last three rows later
    energy, slant, inverse_length, power, change = (
        work[ENERGY],
        work[SLANT],
        work[NEAR],
        work[FAR],
        work[NEAR_BIN],
    )
    whole = whole_groups(first, last)
    for m in range(uint64(first), uint64(whole)):
        low, high = border[m], border[uint64(m + 1)]
        vc, height = (low + high) / 2, max(high - low, 0.0)
        uc = line_u[m] + tilt[m] * vc
        length2 = 1.0 + uc * uc + vc * vc
        one_over_L2 = 1.0 / length2
        one_over_L = math.sqrt(one_over_L2)
        # of cones, dk / du is (cosine (1 + v²) + sine u) / L³, with names as in `_u_on_cone`
        across = width
        if are_cones:
            across *= length2 / (max(cosine * (1.0 + vc * vc) + sine * uc, LEAST_AHEAD) * one_over_L)
        at = rest[m] + along[m] * vc
        energy[m] = echo[m] * across * height * one_over_L * one_over_L2
        work[S, m] = at * one_over_L
        work[A, m] = abs(along_u[m] - at * uc * one_over_L2) * one_over_L * across / 2
        work[B, m] = abs(along[m] - at * (vc + uc * tilt[m]) * one_over_L2) * one_over_L * height / 2
        slant[m], inverse_length[m], change[m] = 0.0, one_over_L, 0.0
    if strip.are_joined:
        bend_footprints(work, first, last, per_metre)
    n = elevation_pattern.shape[0]
    if n == 0 and not strip.are_joined:
        return
    # two loops, since compilers do not vectorise one that reads a table
    middle, last_step = (n - 1) / 2, np.int32(n - 2)
    for m in range(uint64(first), uint64(last if n else first)):
        place = middle + middle * (border[m] + border[uint64(m + 1)]) / 2 * inverse_length[m]
        i = uint64(min(max(np.int32(place), np.int32(0)), last_step))
        step = elevation_pattern[i + uint64(1)] - elevation_pattern[i]
        power[m] = elevation_pattern[i] + (place - i) * step
        slant[m] = step * middle
    for m in range(uint64(first), uint64(whole if n else first)):
        vc, one_over_L = (border[m] + border[uint64(m + 1)]) / 2, inverse_length[m]
        uc = line_u[m] + tilt[m] * vc
        energy[m] *= power[m]
        # from the middle to the upper end the sine rises by `rise`
        rise = (1.0 + uc * (uc - vc * tilt[m])) * one_over_L * one_over_L * one_over_L
        rise *= (border[uint64(m + 1)] - border[m]) / 2
        change[m] += slant[m] * rise / max(power[m], LEAST_POWER)
    for m in range(uint64(first), uint64(whole)):
        vc, one_over_L, s, b = (
            (border[m] + border[uint64(m + 1)]) / 2,
            inverse_length[m],
            work[S, m],
            work[B, m],
        )
        uc = line_u[m] + tilt[m] * vc
        # no more than leaves all densities positive
        rise = min(max(change[m], -1.0), 1.0)
        is_nearer_above = along[m] > s * one_over_L * (vc + uc * tilt[m])
        is_slanted = _is_slanted(s, work[A, m], b, per_metre)
        slant[m] = (rise if is_nearer_above else -rise) if is_slanted else 0.0


@uncounted
def bend_footprints(work, first, last, per_metre):
    """Let footprints of several rows end where their planes do, and follow the density in between.

    With s = f(v) along the strip, f = (REST + ALONG v) / √w and w = 1 + (LINE_U + TILT v)² + v², the middle of both
    ends is f + f″ h² / 2 for half the height h, and the mean f + f″ h² / 6. The solid angle per s is proportional to
    1 / D, where D = f′ w^(3/2) is linear in v. An even footprint has its middle at the mean.
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    rest, along, border, line_u, tilt = work[REST], work[ALONG], work[BORDER], work[LINE_U], work[TILT]
    energy, s, a, b, change = work[ENERGY], work[S], work[A], work[B], work[NEAR_BIN]
    echo_rise = work[ECHO_RISE]
    for m in range(uint64(first), uint64(whole_groups(first, last))):
        low, high = border[m], border[uint64(m + 1)]
        vc, half, line, lean = (low + high) / 2, max(high - low, 0.0) / 2, line_u[m], tilt[m]
        uc, at, curve = line + lean * vc, rest[m] + along[m] * vc, 1.0 + lean * lean
        over2 = 1.0 / (1.0 + uc * uc + vc * vc)
        turn = vc + uc * lean  # half of the derivative of w
        bend = 3.0 * at * turn * turn * over2 - 2.0 * along[m] * turn - at * curve
        is_slanted = _is_slanted(s[m], a[m], b[m], per_metre)
        bow = bend * over2 * math.sqrt(over2) * half * half / 2  # f″ h² / 2
        s[m] += bow if is_slanted else bow / 3
        # the nearest end of an even one is that of the plane, which may lie between the ends
        inner = b[m] * b[m] / max(-4.0 * bow, LEAST_POWER) - bow / 3
        even_b = inner if b[m] < -2.0 * bow else b[m] + bow * 2 / 3
        b[m] = b[m] if is_slanted else even_b
        energy[m] *= 1.0 + half * half / 2 * over2 * (5.0 * turn * turn * over2 - curve)
        slope = along[m] * line * lean - rest[m] * curve
        density = along[m] * (1.0 + line * line) - rest[m] * lean * line + vc * slope
        change[m] = echo_rise[m] - half * slope / density if is_slanted else 0.0


@uncounted
def _is_slanted(s, a, b, per_metre):
    """Return whether density changes along a footprint: it covers a bin, or if it is narrow, LEAST_SLANTED of one."""
    return (a < b) & (b < s) & (2 * b * per_metre > s * s * (LEAST_SLANTED if 4 * a < b else 1.0))


@inlined
def is_long(work, m):
    """Return whether a footprint is so long that it is kept within the range of its body."""
    return (
        work[ENERGY, m] > 0.0 and work[S, m] > 0.0 and work[A, m] + work[B, m] > LONG_FOOTPRINT * work[S, m]
    )


@uncounted
def keep_within(work, m, furthest, nearest):
    """Move the ends of a footprint in s to where its body lies, between `furthest` and `nearest`; its echo stays."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    s, half = work[S, m], work[A, m] + work[B, m]
    if s - half >= furthest and s + half <= nearest:
        return
    far, near = max(s - half, furthest), min(s + half, nearest)
    share = max(near - far, 0.0) / (2 * half)
    middle = (far + near) / 2 if share > 0.0 else min(max(s, furthest), nearest)
    work[ENERGY, m] *= s / middle  # which is multiplied by s later
    work[S, m], work[A, m], work[B, m] = middle, share * work[A, m], share * work[B, m]


@uncounted
def keep_within_bodies(work, strip, body_id, body_spans, columns):
    """Keep a strip's long footprints within the ranges of their bodies.

    body_id : (R, C) uint16, in `whole_rows`; body_spans : of `ViewSamples`; columns : of Lattice
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    for m in range(uint64(strip.first), uint64(strip.last)):
        if is_long(work, m):
            i = uint64(min(max(np.int64(work[SAMPLE, m]), 0), columns - 1))
            number = uint64(body_id[uint64(work[ROW, m]), i])
            keep_within(work, m, body_spans[number, 0], body_spans[number, 1])
