"""The compiled sums of ghosts: echoes that meet a mirror on their way out, on their way back, or on both.

S is the sonar, S' its image behind the mirror, which sees through the mirror what the sonar sees in it. The
samples of one are summed and looked up in the picture of the other: an echo that goes straight one way and
over the mirror the other needs both ways open.
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl import footprint, lookup
from sonar_gl.compiled import compiled, compiled_with
from sonar_gl.footprint import (
    ALONG_U,
    ALONG_V,
    BORDER,
    ECHO,
    ENERGY,
    FAR_FACTOR,
    LAST,
    REST,
    A,
    B,
    S,
    _find_borders,
    _find_shapes,
    _look,
    spread_footprints,
)
from sonar_gl.lookup import LEAST, SAME_PLACE, is_open, left_of, look_up

NEVER = 1e-9  # 1/x of a plane past its horizon
# Of each sample, for the other one: its place there, how far, whether that is before the surface; the sine of
# the angle at which the sound meets the mirror; what that leaves of it; the echo between both ways.
X, Y, Z, RANGE, SIDE, SINE, LEFT, BETWEEN = range(8)


@compiled
def _heard(elevation, top, sine):
    """What both ways together make of an elevation, from a table at even sines up to `top`."""
    place = (sine / top + 1.0) * (elevation.shape[0] - 1) / 2
    k = min(max(int(place), 0), elevation.shape[0] - 2)
    return max(elevation[k] + (place - k) * (elevation[k + 1] - elevation[k]), 0.0)


@compiled_with(footprint)
def _reach(work, there, first, last, uc, own, other, from_mirror, plane):
    """Where what a strip's samples met is for the other one, how far, and on which side of it that is."""
    rest, along_u, along_v, border = work[REST], work[ALONG_U], work[ALONG_V], work[BORDER]
    a, b, c, d = other[:, 0], other[:, 1], other[:, 2], other[:, 3]
    # the other's own place, in the frame of this sector
    ox = -(a[0] * d[0] + a[1] * d[1] + a[2] * d[2])
    oy = -(b[0] * d[0] + b[1] * d[1] + b[2] * d[2])
    oz = -(c[0] * d[0] + c[1] * d[1] + c[2] * d[2])
    for m in range(uint64(first), uint64(last)):
        vc = (border[m] + border[uint64(m + 1)]) / 2
        depth = 1.0 / max(rest[m] + along_v[m] * vc, NEVER)
        x = (a[0] - b[0] * uc + c[0] * vc) * depth + d[0]
        y = (a[1] - b[1] * uc + c[1] * vc) * depth + d[1]
        z = (a[2] - b[2] * uc + c[2] * vc) * depth + d[2]
        there[X, m], there[Y, m], there[Z, m] = x, y, z
        there[RANGE, m] = math.sqrt(x * x + y * y + z * z)
        there[SIDE, m] = 1.0 - ((rest[m] - along_u[m] * uc) * ox - along_u[m] * oy + along_v[m] * oz)
        there[SINE, m] = (plane[0] * x - plane[1] * y + plane[2] * z) / there[RANGE, m]
    if from_mirror:  # the mirror's normal in the frame of this sector; its port is the sonar's starboard
        nx = plane[0] * own[0, 0] - plane[1] * own[1, 0] + plane[2] * own[2, 0]
        ny = plane[0] * own[0, 1] - plane[1] * own[1, 1] + plane[2] * own[2, 1]
        nz = plane[0] * own[0, 2] - plane[1] * own[1, 2] + plane[2] * own[2, 2]
        for m in range(uint64(first), uint64(last)):
            vc = (border[m] + border[uint64(m + 1)]) / 2
            there[SINE, m] = (nx - ny * uc + nz * vc) / math.sqrt(1.0 + uc * uc + vc * vc)


@compiled_with(footprint, lookup)
def _weigh(
    work, there, first, last, uc, elevation, top, own, ceiling, from_mirror, picture, sectors, other_picture,
    other_sectors, plane, needs_surface, loss,
):  # fmt: skip
    """Of a strip's samples: what the mirror leaves, and the echo per steradian between both ways."""
    for m in range(first, last):
        there[LEFT, m] = there[BETWEEN, m] = 0.0
        side = there[SIDE, m]
        if side <= 0.0 and not from_mirror:  # the other looks at the surface from behind
            continue
        left = left_of(there[SINE, m], loss)
        if work[ECHO, m] <= 0.0 or left < LEAST or there[SINE, m] <= 1e-6:
            continue
        vc = (work[BORDER, m] + work[BORDER, m + 1]) / 2
        q = work[REST, m] + work[ALONG_V, m] * vc
        if work[BORDER, m + 1] <= work[BORDER, m] or q <= NEVER:
            continue
        if ceiling[0] - ceiling[1] * uc + ceiling[2] * vc > ceiling[3] * q:
            continue
        if not from_mirror:  # what lies behind the mirror's plane meets no sound that comes by way of it
            behind = plane[0] * (own[0, 0] - own[0, 1] * uc + own[0, 2] * vc)
            behind += plane[1] * (own[1, 0] - own[1, 1] * uc + own[1, 2] * vc)
            behind += plane[2] * (own[2, 0] - own[2, 1] * uc + own[2, 2] * vc)
            if behind > plane[3] * q:
                continue
        x, y, z = there[X, m], there[Y, m], there[Z, m]
        # the image's directions are the sonar's with port and starboard exchanged
        leg_x, leg_y, leg_z = x, -y, z
        if from_mirror:
            leg_x = own[0, 0] - own[0, 1] * uc + own[0, 2] * vc
            leg_y = -(own[1, 0] - own[1, 1] * uc + own[1, 2] * vc)
            leg_z = own[2, 0] - own[2, 1] * uc + own[2, 2] * vc
        if not is_open(leg_x, leg_y, leg_z, picture, sectors, plane, needs_surface):
            continue
        there[LEFT, m] = left
        if side <= 0.0:
            continue
        seen, ahead = look_up(x, y, z, other_picture, other_sectors)
        if seen >= 0.0 and seen * ahead <= 1.0 + SAME_PLACE:
            between = min(work[ECHO, m] * side / there[RANGE, m], 1.0)
            if elevation.shape[0]:  # sounded in one direction, heard in the other
                here = _heard(elevation, top, vc / math.sqrt(1.0 + uc * uc + vc * vc))
                between *= math.sqrt(here * _heard(elevation, top, z / there[RANGE, m]))
            there[BETWEEN, m] = between


@compiled_with(footprint)
def _find_both(work, there, first, last, uc, width, other, once):
    """What `spread_footprints` takes of echoes that go one way straight and the other over the mirror."""
    rest, along_u, along_v, border = work[REST], work[ALONG_U], work[ALONG_V], work[BORDER]
    a, b, c, d = other[:, 0], other[:, 1], other[:, 2], other[:, 3]
    e0, e1, e2 = a[0] - b[0] * uc, a[1] - b[1] * uc, a[2] - b[2] * uc
    u2 = 1.0 + uc * uc
    for m in range(uint64(first), uint64(last)):
        low, high = border[m], border[uint64(m + 1)]
        vc, height = (low + high) / 2, max(high - low, 0.0)
        q = max(rest[m] + along_v[m] * vc, NEVER)
        length2 = u2 + vc * vc
        length, range_there = math.sqrt(length2), there[RANGE, m]
        s = 2.0 / (length / q + range_there)
        # across, where strips are narrow, by how both ranges change with u
        x, x_u = 1.0 / q, -along_u[m] / (q * q)
        r_u = (uc * x + length2 * x_u) / length
        r_u += there[X, m] / range_there * ((e0 + c[0] * vc) * x_u - b[0] * x)
        r_u += there[Y, m] / range_there * ((e1 + c[1] * vc) * x_u - b[1] * x)
        r_u += there[Z, m] / range_there * ((e2 + c[2] * vc) * x_u - b[2] * x)
        # up and down, where planes may run far, at both ends
        low_x, high_x = (
            1.0 / max(rest[m] + along_v[m] * low, NEVER),
            1.0 / max(rest[m] + along_v[m] * high, NEVER),
        )
        tx, ty, tz = (
            (e0 + c[0] * low) * low_x + d[0],
            (e1 + c[1] * low) * low_x + d[1],
            (e2 + c[2] * low) * low_x + d[2],
        )
        low_s = 2.0 / (math.sqrt(u2 + low * low) * low_x + math.sqrt(tx * tx + ty * ty + tz * tz))
        tx, ty, tz = (
            (e0 + c[0] * high) * high_x + d[0],
            (e1 + c[1] * high) * high_x + d[1],
            (e2 + c[2] * high) * high_x + d[2],
        )
        high_s = 2.0 / (math.sqrt(u2 + high * high) * high_x + math.sqrt(tx * tx + ty * ty + tz * tz))
        work[S, m], work[A, m], work[B, m] = s, abs(r_u) * s * s * width / 4, abs(high_s - low_s) / 2
        # r^-2 of the way there and back over that of the bin's gain, which is 1 / r'^2 of the mean range
        spreading = 1.0 / (s * range_there)
        strength = once * there[LEFT, m] * there[BETWEEN, m] * spreading * spreading
        work[ENERGY, m] = strength * width * height / (length * length2 * s)


@compiled_with(footprint, lookup)
def accumulate_ghosts(
    plane_echo, body_id, u, v, tan_elevation, part_column, part_u, part_width, bin_edges_m, tables, flat,
    elevation, fresh, own, other, ceiling, from_mirror, once, picture, sectors, other_picture, other_sectors,
    plane, needs_surface, loss, sums, spans,
):  # fmt: skip
    """Sum some of one sector's samples into columns, as a mirror makes them heard.

    Parameters
    ----------
    plane_echo .. elevation : as of `footprint.accumulate`; of the sonar's own view, or of its image's
    fresh : begin with sums of zero
    own, other : (3, 4) from this sector's frame to its own sonar's and to the other one's
    ceiling : (4,) a · x > offset of what lies above the water's surface, in this sector's frame
    from_mirror : this is the image's view: echoes that meet the mirror twice are summed, too
    once : what the two ways of an echo that meets the mirror once make together, over one of them
    picture, sectors : what the sonar sees; other_picture, other_sectors : what the other one sees
    plane, needs_surface : of `lookup.is_open`; loss : of `lookup.left_of`
    sums, spans : as of `footprint.accumulate`
    """
    K = sums.shape[1]
    r_first, r_last = bin_edges_m[0], bin_edges_m[K]
    per_metre = K / (r_last - r_first)
    R = plane_echo.shape[0]
    work, there = np.empty((LAST + 1, R + 1)), np.empty((BETWEEN + 1, R + 1))
    top = tan_elevation / math.sqrt(1.0 + tan_elevation * tan_elevation)
    for p in range(part_u.shape[0]):
        c, uc = part_column[p], part_u[p]
        if fresh and (p == 0 or part_column[p - 1] != c):
            sums[c, spans[c, 0] : spans[c, 1]] = 0.0
            spans[c, 0], spans[c, 1] = K, 0
        v_limit = tan_elevation * math.sqrt(1.0 + uc * uc)
        nearest, step = (uc - u[0]) / u[1] + 0.5, u[2] / u[1]
        last_row = nearest - step * R
        if max(nearest, last_row) <= -1.0 or min(nearest, last_row) >= plane_echo.shape[1]:
            continue  # beside the window
        bottom, rise = v[0] + v[1] * nearest, v[2] - v[1] * step
        bottom_row = max(int((-v_limit - bottom) / rise) - 2, 0)
        n = min(int((v_limit - bottom) / rise) + 3, R - 1) - bottom_row + 1
        first, last = _look(work, plane_echo, u, v, uc, nearest, step, bottom_row, n)
        if first > last:
            continue
        last += 1
        work[BORDER, 0], work[BORDER, n] = -v_limit, v_limit
        _find_borders(work, max(first, 1), min(last + 1, n), 1.0 / (FAR_FACTOR * r_last), v_limit)
        _reach(work, there, first, last, uc, own, other, from_mirror, plane)
        _weigh(
            work, there, first, last, uc, elevation, top, own, ceiling, from_mirror, picture, sectors,
            other_picture, other_sectors, plane, needs_surface, loss,
        )  # fmt: skip
        if from_mirror:
            _find_shapes(work, first, last, uc, part_width[p], v_limit, elevation)
            for m in range(first, last):
                work[ENERGY, m] *= there[LEFT, m] * there[LEFT, m]
            spread_footprints(work, first, last, sums, spans, c, tables, flat, r_first, per_metre)
        _find_both(work, there, first, last, uc, part_width[p], other, once)
        spread_footprints(work, first, last, sums, spans, c, tables, flat, r_first, per_metre)
