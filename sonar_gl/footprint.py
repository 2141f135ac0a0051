"""The compiled sums: footprints of samples into columns and bins."""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl.compiled import compiled

# Surfaces are drawn so many times beyond the last bin, since near grazing a sample whose middle lies beyond
# it still reaches into it.
FAR_FACTOR = 8.0
SAME = 1e-5  # of a plane's 1/x and slope: well above float32's noise, well below what matters

# Loops over a strip's samples have no branches, so that the compiler makes vectors of them; what they find
# stands in rows of `work`. Indices are unsigned: one that may be negative keeps vectors from being used.
# Of each sample: 1/x on its ray, 0 where that met nothing; its plane in the strip's middle, 1/x at v = 0 and
# slopes along v and u; v of the ray; echo; where it begins. Then what `spread_footprints` takes; and what it
# makes of that: both ends, half the height, and the bins of both ends.
Q, REST, ALONG_V, ALONG_U, V_RAY, ECHO, BORDER = range(7)
ENERGY, S, A, B, NEAR, FAR, HALF_HEIGHT, FIRST, LAST = range(7, 16)


@compiled
def _ramp(s, start):
    """Of (s - start) s ds from start on."""
    t = max(s - start, 0.0)
    return t * t * (t / 3 + start / 2)


@compiled
def _below(s, middle, wide, thin):
    """The energy up to s of two boxes on ±wide and ±thin convolved, over 4 wide thin."""
    rise = _ramp(s, middle - wide - thin) - _ramp(s, middle - wide + thin)
    return rise - (_ramp(s, middle + wide - thin) - _ramp(s, middle + wide + thin))


@compiled
def _spread_trapezoid(sums, c, tables, r_first, per_metre, energy, s, wide, thin):
    """Add a footprint whose ramps count to a row of bins; the first and the last of these."""
    K = sums.shape[1]
    low, high = max(s - wide - thin, tables[0, K]), min(s + wide + thin, tables[0, 0])
    if high <= low:
        return uint64(K), uint64(0)
    scale = energy / (4 * wide * thin)
    if s < wide + thin:  # a plane seen past its horizon: what the middle saw is spread over the part in view
        scale = energy * s / (_below(s + wide + thin, s, wide, thin) - _below(0.0, s, wide, thin))
    row, first = uint64(c), uint64(int((1.0 / high - r_first) * per_metre))
    last = uint64(min(int((1.0 / low - r_first) * per_metre), K - 1))
    nearer = _below(high, s, wide, thin)
    for k in range(first, last):
        further = _below(tables[0, uint64(k + 1)], s, wide, thin)
        sums[row, k] += np.float32(scale * (nearer - further))
        nearer = further
    sums[row, last] += np.float32(scale * (nearer - _below(low, s, wide, thin)))
    return first, last


@compiled
def _find_boxes(work, first, last, s_first, s_last, r_first, per_metre):
    """Footprints of samples from `first` to before `last`, without their ramps, as far as there are bins."""
    energy, s, a, b = work[ENERGY], work[S], work[A], work[B]
    for m in range(uint64(first), uint64(last)):
        wide = max(a[m], b[m], 1e-9 * s[m])
        near, far = s[m] + wide, s[m] - wide
        past = far < 0.0  # the horizon, as above
        half_height = energy[m] * (s[m] if past else 0.25) / (near * near if past else wide)
        near, far = min(near, s_first), max(far, s_last)
        inverse = 1.0 / (near * far)  # one division for both ranges
        work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m] = near, far, half_height
        work[FIRST, m] = (far * inverse - r_first) * per_metre
        work[LAST, m] = (near * inverse - r_first) * per_metre


@compiled
def spread_footprints(work, start, stop, sums, spans, c, tables, flat, r_first, per_metre):
    """Add energy times s = 1/r, spread as the sum of two uniforms on ±a and ±b about s, to a row of bins.

    On a plane the cosine of incidence is proportional to s, and so is the energy's density.

    Parameters
    ----------
    work : (LAST + 1, n) of which the rows ENERGY, S, A and B, from `start` to before `stop`, are read
    spans : (columns, 2), of rows of sums: stretched over the bins that are added to, first and past last
    """
    K = sums.shape[1]
    _find_boxes(work, start, stop, tables[0, 0], tables[0, K], r_first, per_metre)
    row, lowest, highest = uint64(c), uint64(K), uint64(0)
    for m in range(uint64(start), uint64(stop)):
        energy, s = work[ENERGY, m], work[S, m]
        if energy == 0.0 or s <= 0.0:
            continue
        wide, thin = max(work[A, m], work[B, m]), min(work[A, m], work[B, m])
        # short ramps are not worth drawing: those of neighbouring samples overlap and add up to the same
        if 8 * thin * per_metre >= s * s:
            first, last = _spread_trapezoid(sums, c, tables, r_first, per_metre, energy, s, wide, thin)
            lowest, highest = min(lowest, first), max(highest, last)
            continue
        near, far, half_height = work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m]
        if near <= far:  # out of the bins
            continue
        # written out here: a call for each sample takes as long as all the rest
        first, last = uint64(np.int32(work[FIRST, m])), uint64(min(np.int32(work[LAST, m]), K - 1))
        lowest, highest = min(lowest, first), max(highest, last)
        if first >= last:
            sums[row, last] += np.float32(half_height * (near - far) * (near + far))
            continue
        sums[row, first] += np.float32(half_height * (near * near - tables[0, uint64(first + 1)] ** 2))
        sums[row, last] += np.float32(half_height * (tables[0, last] ** 2 - far * far))
        height = np.float32(2 * half_height)
        for k in range(uint64(first + 1), last):
            sums[row, k] += height * flat[k]
    if lowest <= highest:
        spans[c, 0], spans[c, 1] = min(spans[c, 0], int(lowest)), max(spans[c, 1], int(highest) + 1)


@compiled
def _look(work, plane_echo, u, v, uc, nearest, step, first, n):
    """Gather the samples of a strip from the row `first` on; the first and the last of them with an echo."""
    q, rest, along_v, along_u = work[Q], work[REST], work[ALONG_V], work[ALONG_U]
    v_ray, echo = work[V_RAY], work[ECHO]
    lowest, highest = 0, -1
    for m in range(n):
        j = first + m
        i = int(nearest - step * j)
        v_ray[m] = v[0] + v[1] * i + v[2] * j
        q[m] = rest[m] = along_v[m] = along_u[m] = echo[m] = 0.0
        if 0 <= i < plane_echo.shape[1] and plane_echo[j, i, 0] > 0:
            q[m], along_u[m], along_v[m] = plane_echo[j, i, 0], plane_echo[j, i, 1], plane_echo[j, i, 2]
            rest[m] = q[m] + along_u[m] * (uc - u[0] - u[1] * i - u[2] * j) - along_v[m] * v_ray[m]
            if plane_echo[j, i, 3] > 0:
                echo[m] = plane_echo[j, i, 3]
                lowest, highest = m if highest < 0 else lowest, m
    return lowest, highest


@compiled
def _find_borders(work, first, last, q_unseen, v_limit):
    """Where each of a strip's samples begins, from `first` to before `last`."""
    q, rest, along_v, v_ray, border = work[Q], work[REST], work[ALONG_V], work[V_RAY], work[BORDER]
    for m in range(uint64(first), uint64(last)):
        below = uint64(m - 1)
        low, high = v_ray[below], v_ray[m]
        met_low, met_high = q[below] > 0.0, q[m] > 0.0
        border_here = (low + high) / 2
        # two planes that meet between their rays make an edge there, else it is half way;
        # nearer than SAME they are one plane, and where they meet is noise
        turn = along_v[below] - along_v[m]
        meet = (rest[m] - rest[below]) / turn
        noise = SAME * (max(q[below], q[m]) + abs(along_v[below]))  # of a plane and of its slope
        is_clear = abs((meet - border_here) * turn) > noise
        is_edge = met_low & met_high & (low < meet) & (meet < high) & is_clear
        # a plane that is out of sight where the other ray looks goes on to there or its horizon
        along = along_v[below] if met_low else along_v[m]
        plane = rest[below] if met_low else rest[m]
        is_lost = (met_low != met_high) & (plane + along * (high if met_low else low) < q_unseen)
        border_here = meet if is_edge else border_here
        border_here = min(max(-plane / along, low), high) if is_lost else border_here
        border[m] = min(max(border_here, -v_limit), v_limit)


@compiled
def _find_shapes(work, first, last, uc, width, v_limit, elevation):
    """What `spread_footprints` takes, of a strip's samples from `first` to before `last`."""
    rest, along_v, along_u, echo, border = work[REST], work[ALONG_V], work[ALONG_U], work[ECHO], work[BORDER]
    u2 = 1.0 + uc * uc
    for m in range(uint64(first), uint64(last)):
        low, high = border[m], border[uint64(m + 1)]
        vc, height = (low + high) / 2, max(high - low, 0.0)
        one_over_L2 = 1.0 / (u2 + vc * vc)
        one_over_L = math.sqrt(one_over_L2)
        at = rest[m] + along_v[m] * vc
        work[ENERGY, m] = echo[m] * width * height * one_over_L * one_over_L2
        work[S, m] = at * one_over_L
        work[A, m] = abs(along_u[m] - at * uc * one_over_L2) * one_over_L * width / 2
        work[B, m] = abs(along_v[m] - at * vc * one_over_L2) * one_over_L * height / 2
    middle, v2 = (elevation.shape[0] - 1) / 2, v_limit * v_limit
    for m in range(first, last if elevation.shape[0] else first):
        vc = (border[m] + border[m + 1]) / 2
        place = middle + middle * vc * math.sqrt((u2 / v2 + 1.0) / (u2 + vc * vc))
        i = min(max(int(place), 0), elevation.shape[0] - 2)
        work[ENERGY, m] *= elevation[i] + (place - i) * (elevation[i + 1] - elevation[i])


@compiled
def _drop(work, sums, spans, c, u, nearest, step, bottom_row, first, last, r_first, per_metre):
    """Drop a strip's samples whole into the bins of their rays' own ranges."""
    for m in range(first, last):
        j = bottom_row + m
        u_ray, v_ray = u[0] + u[1] * int(nearest - step * j) + u[2] * j, work[V_RAY, m]
        s = work[Q, m] / math.sqrt(1.0 + u_ray * u_ray + v_ray * v_ray)
        k = (1.0 / s - r_first) * per_metre
        if 0.0 <= k < sums.shape[1]:
            sums[c, int(k)] += work[ENERGY, m] * s
            spans[c, 0], spans[c, 1] = min(spans[c, 0], int(k)), max(spans[c, 1], int(k) + 1)


@compiled
def accumulate(
    plane_echo, u, v, tan_elevation, part_column, part_u, part_width, bin_edges_m, tables, flat, footprint,
    elevation, sums, spans,
):  # fmt: skip
    """Sum some of one sector's samples into columns.

    A sample stands for a rectangle of an upright strip of the image plane, and the surface in it is the plane
    that its ray met. There 1/r is linear in (u, v) but for the slow length of the ray: the share before r
    is that of two convolved boxes, exact for planes. It is cut at the aperture, columns and edges of planes.

    Parameters
    ----------
    plane_echo : (R, C, 4) float32, as the shader writes it
    u, v, tan_elevation : of `fan.Sector`
    part_column, part_u, part_width : (P,) of `fan.Parts`, or a slice of them
    bin_edges_m, tables, flat : (K + 1,), of `bin_tables`; footprint : False drops samples whole into one bin
    elevation : what echoes are multiplied by, at even sines across the aperture, or of no length
    sums : (columns, K) float32, μ cos θ times steradians; the rows of these parts are overwritten
    spans : (columns, 2) int64, first bin and past the last beyond which a row of sums is zero; overwritten
    """
    R, K = plane_echo.shape[0], sums.shape[1]
    r_first, r_last = bin_edges_m[0], bin_edges_m[K]
    per_metre = K / (r_last - r_first)
    work = np.empty((LAST + 1, R + 1))
    for p in range(part_u.shape[0]):
        c, uc = part_column[p], part_u[p]
        if p == 0 or part_column[p - 1] != c:
            sums[c, spans[c, 0] : spans[c, 1]] = 0.0
            spans[c, 0], spans[c, 1] = K, 0
        v_limit = tan_elevation * math.sqrt(1.0 + uc * uc)
        nearest, step = (uc - u[0]) / u[1] + 0.5, u[2] / u[1]
        last_row = nearest - step * R
        if max(nearest, last_row) <= -1.0 or min(nearest, last_row) >= plane_echo.shape[1]:
            continue  # beside the window
        # the rows that may touch the aperture: v of the nearest ray is linear in j but for the rounding of i
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
        if footprint:
            spread_footprints(work, first, last, sums, spans, c, tables, flat, r_first, per_metre)
        else:
            _drop(work, sums, spans, c, u, nearest, step, bottom_row, first, last, r_first, per_metre)
