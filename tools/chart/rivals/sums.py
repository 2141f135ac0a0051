"""The compiled sums of the rivals, over the hits of rays."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sonar_gl.beamform.kernels.spreading import SHORT_RAMP, spread_footprints
from sonar_gl.beamform.kernels.work_table import ENERGY, SLANT, A, B, S
from sonar_gl.core.compiled import compiled


@compiled
def point_bins(rays, rotation, faces, length, face, weight, column, first, last, r_first, per_metre, sums):
    """Add the echo of each hit to the one bin that it lies in.

    rays, length, face : as for `trace`; faces : (T, 8) normal, distance, μ, body; weight : (N,) steradians;
    column : (N,) of sums, (columns, K), added to
    """
    K = sums.shape[1]
    for i in range(first, last):
        if face[i] < 0 or length[i] < r_first:
            continue
        k = int((length[i] - r_first) * per_metre)
        if k >= K:
            continue
        n = faces[face[i]]
        cosine = 0.0
        for axis in range(3):
            d = (
                rotation[axis, 0] * rays[i, 0]
                + rotation[axis, 1] * rays[i, 1]
                + rotation[axis, 2] * rays[i, 2]
            )
            cosine += n[axis] * d
        sums[column[i], k] += n[4] * abs(cosine) * weight[i]


@compiled
def planes(rays, rotation, origin, faces, face, index, first, last, plane_echo):
    """Turn hits into the plane and echo that the raster's shader writes: 1/x, its slopes and μ cos θ r.

    rays : (N, 3) (1, -u, v) of the view; rotation : scene from view; index : (N,) into plane_echo, (S, 4)
    """
    for i in range(first, last):
        out = plane_echo[index[i]]
        if face[i] < 0:
            out[0] = out[1] = out[2] = out[3] = 0.0
            continue
        n = faces[face[i]]
        distance = n[3] - (n[0] * origin[0] + n[1] * origin[1] + n[2] * origin[2])
        inverse = 1.0 / distance
        px = (n[0] * rotation[0, 0] + n[1] * rotation[1, 0] + n[2] * rotation[2, 0]) * inverse
        py = (n[0] * rotation[0, 1] + n[1] * rotation[1, 1] + n[2] * rotation[2, 1]) * inverse
        pz = (n[0] * rotation[0, 2] + n[1] * rotation[1, 2] + n[2] * rotation[2, 2]) * inverse
        out[0] = px + py * rays[i, 1] + pz * rays[i, 2]
        out[1], out[2], out[3] = -py, pz, n[4] * abs(distance)


@compiled
def hits(rays, rotation, origin, faces, face, first, last, s, echo):
    """Fill 1/r, (N,) float32, 0 without a hit, and μ cos θ, (N,) float32, of rays of unit length."""
    for i in range(first, last):
        s[i] = echo[i] = 0.0
        if face[i] >= 0:
            n = faces[face[i]]
            cosine = distance = 0.0
            for axis in range(3):
                turned = rotation[axis]
                d = turned[0] * rays[i, 0] + turned[1] * rays[i, 1] + turned[2] * rays[i, 2]
                cosine += n[axis] * d
                distance -= n[axis] * origin[axis]
            s[i] = cosine / (distance + n[3])
            echo[i] = n[4] * abs(cosine)


@compiled
def _extrapolated(rays, rotation, origin, faces, f, i):
    """Return 1/r at which ray i meets the plane of face f."""
    n = faces[f]
    cosine, distance = 0.0, n[3]
    for axis in range(3):
        turned = rotation[axis]
        cosine += n[axis] * (turned[0] * rays[i, 0] + turned[1] * rays[i, 1] + turned[2] * rays[i, 2])
        distance -= n[axis] * origin[axis]
    return cosine / distance


@compiled
def _are_one(rays, rotation, origin, faces, face, s, i, j):
    """Return whether two rays met one surface: one body, and no jump beyond twice either plane's own."""
    if face[i] < 0 or face[j] < 0:
        return False
    if face[i] == face[j]:
        return True
    if faces[face[i], 5] != faces[face[j], 5]:
        return False
    there = abs(_extrapolated(rays, rotation, origin, faces, face[i], j) - s[i])
    here = abs(_extrapolated(rays, rotation, origin, faces, face[j], i) - s[j])
    return abs(s[i] - s[j]) <= 2 * max(here, there) + 0.01 * max(s[i], s[j])


# not cached: Numba would go on with a `spread_footprints` of before its file changed
@njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
def tubes(
    work,
    rays,
    rotation,
    origin,
    faces,
    face,
    s,
    echo,
    column,
    width,
    height,
    first,
    last,
    bins,
    sums,
):
    """Spread the mean echo of four neighbouring rays over the ranges between them.

    Where the four met one surface, 1/r over the tube is spread as two boxes, along azimuth and elevation;
    else each ray keeps a quarter of the tube, up to half way to its neighbours along its own plane.

    Parameters
    ----------
    work : of work_table.make_work, overwritten
    rays, face, s, echo : (R + 1) (C + 1) rays row by row, at the corners of R by C tubes
    column, width : (C,) fan column, radians of azimuth; height : (R,) steradians to a radian of azimuth
    first, last : which columns of tubes; bins : BinTable; sums : added to
    """
    C = len(column)
    spans = np.zeros((sums.shape[0], 2), np.int64)
    work[SLANT, : 4 * len(height)] = 0.0  # no footprint is slanted
    for i in range(first, last):
        c, n = column[i], 0
        for j in range(len(height)):
            a = j * (C + 1) + i
            b, d = a + 1, a + C + 1
            e = d + 1
            solid = width[i] * height[j]
            bottom = _are_one(rays, rotation, origin, faces, face, s, a, b)
            top = _are_one(rays, rotation, origin, faces, face, s, d, e)
            left = _are_one(rays, rotation, origin, faces, face, s, a, d)
            right = _are_one(rays, rotation, origin, faces, face, s, b, e)
            if bottom and top and left and right:
                middle = (s[a] + s[b] + s[d] + s[e]) / 4
                energy = (echo[a] + echo[b] + echo[d] + echo[e]) / 4 * solid / middle
                across = abs(s[b] + s[e] - s[a] - s[d]) / 4
                up = abs(s[d] + s[e] - s[a] - s[b]) / 4
                work[ENERGY, n], work[S, n], work[A, n], work[B, n] = energy, middle, across, up
                n += 1
                continue
            for own, beside, above, joined_across, joined_up in (
                (a, b, d, bottom, left),
                (b, a, e, bottom, right),
                (d, e, a, top, left),
                (e, d, b, top, right),
            ):
                if face[own] >= 0 and echo[own] > 0:
                    f = face[own]
                    there = (
                        s[beside]
                        if joined_across
                        else _extrapolated(rays, rotation, origin, faces, f, beside)
                    )
                    across = (there - s[own]) / 4
                    there = s[above] if joined_up else _extrapolated(rays, rotation, origin, faces, f, above)
                    up = (there - s[own]) / 4
                    middle = s[own] + across + up
                    energy = echo[own] * solid / 4 / middle
                    work[ENERGY, n], work[S, n], work[A, n], work[B, n] = energy, middle, abs(across), abs(up)
                    n += 1
        spread_footprints(work, 0, n, sums, spans, c, bins, SHORT_RAMP)


@compiled
def mean_bins(plane_echo, u, v, tan_elevation, column, part_u, part_width, r_first, per_metre, work, sums):
    """Add, strip by strip, the mean echo of the samples that fall into a bin; sums : (columns, K).

    plane_echo, u, v, tan_elevation and the strips as for `accumulate` of the package; work : (2, K)
    """
    K = sums.shape[1]
    for p in range(len(part_u)):
        work[:] = 0.0
        limit = tan_elevation * math.sqrt(1 + part_u[p] ** 2)
        for j in range(plane_echo.shape[0]):
            i = int((part_u[p] - u[0] - u[2] * j) / u[1] + 0.5)
            q = plane_echo[j, i, 0]
            u_here, v_here = u[0] + u[1] * i + u[2] * j, v[0] + v[1] * i + v[2] * j
            if q <= 0.0 or abs(v_here) > limit:
                continue
            r = math.sqrt(1 + u_here * u_here + v_here * v_here) / q
            if r >= r_first:
                k = int((r - r_first) * per_metre)
                if k < K:
                    work[0, k] += plane_echo[j, i, 3] / r
                    work[1, k] += 1.0
        for k in range(K):
            if work[1, k] > 0:
                sums[column[p], k] += part_width[p] * work[0, k] / work[1, k]
