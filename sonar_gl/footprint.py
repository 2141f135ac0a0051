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


@compiled
def _integral(c0, c1, low, high):
    """Of (c0 + c1 s) s ds over [low, high]."""
    return (high - low) * (c0 * (high + low) / 2 + c1 * (high * high + high * low + low * low) / 3)


@compiled
def _spread(sums, c, tables, flat, r_first, per_metre, c0, c1, low, high):
    """Add the density (c0 + c1 s) s ds of s = 1/r in [low, high] to a row of bins."""
    K = sums.shape[1]
    low, high = max(low, tables[0, K]), min(high, tables[0, 0])
    if high <= low:
        return
    near = min(int((1.0 / high - r_first) * per_metre), K - 1)
    far = min(int((1.0 / low - r_first) * per_metre), K - 1)
    if near >= far:
        sums[c, near] += _integral(c0, c1, low, high)
        return
    sums[c, near] += _integral(c0, c1, tables[0, near + 1], high)
    sums[c, far] += _integral(c0, c1, low, tables[0, far])
    # unsigned: an index that may be negative keeps the compiler from using vectors, six times slower
    row, first, last = uint64(c), uint64(near + 1), uint64(far)
    if c1 == 0.0:
        height = np.float32(c0)
        for k in range(first, last):
            sums[row, k] += height * flat[k]
    else:
        for k in range(first, last):
            sums[row, k] += c0 * tables[1, k] + c1 * tables[2, k]


@compiled
def _spread_trapezoid(sums, c, tables, flat, r_first, per_metre, energy, s, wide, thin):
    """The same where the ramps count, or the footprint reaches past a plane's horizon."""
    near, far = s + wide + thin, s - wide - thin
    low, high = s - wide + thin, s + wide - thin
    height, slope = energy / (2 * wide), energy / (4 * wide * thin)
    if far < 0.0:  # a plane seen past its horizon: what the middle saw is spread over the part in view
        seen = _integral(slope * near, -slope, max(high, 0.0), near)
        if high > 0.0:
            seen += _integral(height, 0.0, max(low, 0.0), high)
        if low > 0.0:
            seen += _integral(-slope * far, slope, 0.0, low)
        height, slope = height * energy * s / seen, slope * energy * s / seen
    _spread(sums, c, tables, flat, r_first, per_metre, slope * near, -slope, high, near)
    _spread(sums, c, tables, flat, r_first, per_metre, height, 0.0, low, high)
    _spread(sums, c, tables, flat, r_first, per_metre, -slope * far, slope, far, low)


@compiled
def spread_footprint(sums, c, tables, flat, r_first, per_metre, energy, s, a, b):
    """Add energy times s = 1/r, spread as the sum of two uniforms on ±a and ±b about s, to a row of bins.

    On a plane the cosine of incidence is proportional to s, and so is the energy's density.
    """
    K = sums.shape[1]
    wide, thin = max(a, b), min(a, b)
    # short ramps are not worth drawing: those of neighbouring samples overlap and add up to the same
    if 8 * thin * per_metre >= s * s:
        if s + wide + thin > tables[0, K] and s - wide - thin < tables[0, 0]:
            _spread_trapezoid(sums, c, tables, flat, r_first, per_metre, energy, s, wide, thin)
        return
    near, far = s + wide, s - wide
    if far <= tables[0, K] or near >= tables[0, 0]:  # it reaches past the first or the last bin
        if near <= tables[0, K] or far >= tables[0, 0]:
            return
        height = energy / (2 * wide)
        if far < 0.0:
            height *= 2 * wide * s / (near * near / 2)
            far = 0.0
        _spread(sums, c, tables, flat, r_first, per_metre, height, 0.0, far, near)
        return
    # nearly all samples come here: one division gives both ends' ranges and the height
    wide = max(wide, 1e-12 * s)
    product = near * far
    inverse = 1.0 / (product * wide)
    first = int((far * inverse * wide - r_first) * per_metre)
    last = min(int((near * inverse * wide - r_first) * per_metre), K - 1)
    if first >= last:
        sums[c, last] += energy * s
        return
    height = energy * product * inverse / 2
    sums[c, first] += height * (near * near - tables[0, first + 1] ** 2) / 2
    sums[c, last] += height * (tables[0, last] ** 2 - far * far) / 2
    row, height = uint64(c), np.float32(height)
    for k in range(uint64(first + 1), uint64(last)):
        sums[row, k] += height * flat[k]


@compiled
def accumulate(
    plane_echo,
    body_id,
    u,
    v,
    tan_elevation,
    part_column,
    part_u,
    part_width,
    bin_edges_m,
    tables,
    flat,
    footprint,
    body,
    moment,
    sums,
):
    """Sum some of one sector's samples into columns.

    A sample stands for a rectangle of an upright strip of the view's image plane, which its ray need not meet
    in the middle. The surface in it is the plane that the ray met, on which 1/r is linear in (u, v) but for
    the slow length of the ray: so the share of the rectangle nearer than r is the distribution of two
    convolved boxes, exact for planes at any grazing angle. It is cut at the aperture, where columns end, and
    where the plane meets that of the next sample up.

    Parameters
    ----------
    plane_echo : (R, C, 4) float32, body_id : (R, C) uint16, as the shader writes them
    u, v, tan_elevation : of `fan.Sector`
    part_column, part_u, part_width : (P,) of `fan.Parts`, or a slice of them
    bin_edges_m : (K + 1,); tables, flat : of `bin_tables`
    footprint : False drops a part of a sample whole into the bin of the hit point
    body : 0 for all, or the number of the one body to add
    moment : sum the echo times its elevation, in radians, instead of the echo
    sums : (columns, K) float32, μ cos θ times steradians; the rows of these parts are overwritten
    """
    K = sums.shape[1]
    r_first, r_last = bin_edges_m[0], bin_edges_m[K]
    per_metre = K / (r_last - r_first)
    R, C = plane_echo.shape[:2]
    q_unseen = 1.0 / (FAR_FACTOR * r_last)
    for p in range(part_u.shape[0]):
        c, uc = part_column[p], part_u[p]
        if p == 0 or part_column[p - 1] != c:
            row = uint64(c)
            for k in range(uint64(K)):
                sums[row, k] = 0.0
        u2 = 1.0 + uc * uc
        v_limit = tan_elevation * math.sqrt(u2)
        nearest, step = (uc - u[0]) / u[1] + 0.5, u[2] / u[1]
        # the rows that may touch the aperture: v of the nearest ray is linear in j but for the rounding of i
        bottom, rise = v[0] + v[1] * nearest, v[2] - v[1] * step
        first = max(int((-v_limit - bottom) / rise) - 2, 0)
        last = min(int((v_limit - bottom) / rise) + 3, R - 1)
        i, u0, v0, q, q0, along_v = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(first, last + 2):
            # the next sample up, in the row j, and the one below it, which is done when j is known
            i_here, u_here, v_here, q_here, q_ray, along_here = i, u0, v0, q, q0, along_v
            if j <= last:
                i = int(nearest - step * j)
                u0 = u[0] + u[1] * i + u[2] * j
                v0 = v[0] + v[1] * i + v[2] * j
                q0 = 0.0
                if 0 <= i < C:
                    q0, along_v = float(plane_echo[j, i, 0]), float(plane_echo[j, i, 2])
                    q = q0 + float(plane_echo[j, i, 1]) * (uc - u0)
            if j == first:
                high = -v_limit
                continue
            low, high = high, v_limit
            if j <= last:
                high = (v_here + v0) / 2
                if q_ray > 0.0 and q0 > 0.0:
                    # two planes that meet between their rays make an edge there, else it is half way;
                    # nearer than SAME they are one plane, and where they meet is noise
                    turn = along_here - along_v
                    noise = SAME * (max(q_ray, q0) + abs(along_here))  # of a plane and of its slope
                    meet = q - q_here + along_here * v_here - along_v * v0
                    if turn < 0.0:
                        turn, meet = -turn, -meet
                    if v_here * turn < meet < v0 * turn and abs(meet - high * turn) > noise:
                        high = meet / turn
                elif q_ray > 0.0 or q0 > 0.0:
                    # a plane that is out of sight where the other ray looks goes on to there or its horizon
                    along, rest, v_empty = along_here, q_here - along_here * v_here, v0
                    if q_ray <= 0.0:
                        along, rest, v_empty = along_v, q - along_v * v0, v_here
                    if rest + along * v_empty < q_unseen:
                        high = -rest / along
                        high = min(max(high, v_here), v0)
            v_low, v_high = max(low, -v_limit), min(high, v_limit)
            if v_high <= v_low or q_ray <= 0.0:
                continue
            strength = float(plane_echo[j - 1, i_here, 3])
            if strength <= 0.0:
                continue
            if body != 0 and body_id[j - 1, i_here] != body:
                continue
            vc = (v_low + v_high) / 2
            one_over_L2 = 1.0 / (u2 + vc * vc)
            one_over_L = math.sqrt(one_over_L2)
            energy = strength * part_width[p] * (v_high - v_low) * one_over_L * one_over_L2
            if moment:
                energy *= math.atan2(vc, math.sqrt(u2))
            if not footprint:
                r0 = math.sqrt(1.0 + u_here * u_here + v_here * v_here) / q_ray
                energy /= r0
                if r_first <= r0 < r_last:
                    k = min(int((r0 - r_first) * per_metre), K - 1)
                    sums[c, k] += energy
                continue
            at = q_here + along_here * (vc - v_here)
            if at <= 0.0:
                continue
            s = at * one_over_L
            a = abs(float(plane_echo[j - 1, i_here, 1]) - at * uc * one_over_L2)
            b = abs(along_here - at * vc * one_over_L2)
            a *= one_over_L * part_width[p] / 2
            b *= one_over_L * (v_high - v_low) / 2
            spread_footprint(sums, c, tables, flat, r_first, per_metre, energy, s, a, b)
