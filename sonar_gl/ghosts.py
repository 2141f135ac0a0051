"""The compiled sums of ghosts: echoes that meet a mirror on their way out, on their way back, or on both.

S is the sonar, S' its image behind the mirror, which sees through the mirror what the sonar sees in it. The
samples of one are summed and looked up in the picture of the other: an echo that goes straight one way and
over the mirror the other needs both ways open.
"""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.compiled import compiled
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
from sonar_gl.lookup import SAME_PLACE, look_up, mirrored


@compiled
def _carry(m, x, u, v, out):
    """The point at depth x of the ray (1, −u, v) in another frame, by (3, 4) m; its distance there."""
    for k in range(3):
        out[k] = (m[k, 0] - m[k, 1] * u + m[k, 2] * v) * x + m[k, 3]
    return math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])


@compiled
def _heard(elevation, top, sine):
    """What both ways together make of an elevation, from a table at even sines up to `top`."""
    place = (sine / top + 1.0) * (elevation.shape[0] - 1) / 2
    k = min(max(int(place), 0), elevation.shape[0] - 2)
    return max(elevation[k] + (place - k) * (elevation[k + 1] - elevation[k]), 0.0)


@compiled
def _inverse_range(m, q, u, v, otherwise, out):
    """2 / (r + r') of the point where 1/x is q on the ray (1, −u, v)."""
    if q <= 1e-9:
        return otherwise
    return 2.0 / (math.sqrt(1.0 + u * u + v * v) / q + _carry(m, 1.0 / q, u, v, out))


@compiled
def _weigh(
    work, ways, first, last, uc, elevation, top, own, other, ceiling, from_mirror, picture, sectors,
    other_picture, other_sectors, plane, needs_surface, loss,
):  # fmt: skip
    """Of a strip's samples: what the mirror leaves, and the echo per steradian between both ways.

    ways : (2, n), overwritten
    """
    there, leg = np.empty(3), np.empty(3)
    # the other's place, in the frame of this sector
    ox = -(other[0, 0] * other[0, 3] + other[1, 0] * other[1, 3] + other[2, 0] * other[2, 3])
    oy = -(other[0, 1] * other[0, 3] + other[1, 1] * other[1, 3] + other[2, 1] * other[2, 3])
    oz = -(other[0, 2] * other[0, 3] + other[1, 2] * other[1, 3] + other[2, 2] * other[2, 3])
    for m in range(first, last):
        ways[0, m] = ways[1, m] = 0.0
        low, high = work[BORDER, m], work[BORDER, m + 1]
        vc = (low + high) / 2
        q = work[REST, m] + work[ALONG_V, m] * vc
        if work[ECHO, m] <= 0.0 or high <= low or q <= 0.0:
            continue
        if ceiling[0] - ceiling[1] * uc + ceiling[2] * vc > ceiling[3] * q:
            continue
        along_u, along_v = work[ALONG_U, m], work[ALONG_V, m]
        side = 1.0 - ((work[REST, m] - along_u * uc) * ox - along_u * oy + along_v * oz)
        if side <= 0.0 and not from_mirror:  # the other looks at the surface from behind
            continue
        range_there = _carry(other, 1.0 / q, uc, vc, there)
        if from_mirror:
            _carry(own, 1.0 / q, uc, vc, leg)
        else:
            leg[:] = there
        # the image's directions are the sonar's with port and starboard exchanged
        ways[0, m] = mirrored(leg[0], -leg[1], leg[2], picture, sectors, plane, needs_surface, loss)
        if ways[0, m] == 0.0 or side <= 0.0:
            continue
        seen, ahead = look_up(there[0], there[1], there[2], other_picture, other_sectors)
        if seen >= 0.0 and seen * ahead <= 1.0 + SAME_PLACE:
            ways[1, m] = min(work[ECHO, m] * side / range_there, 1.0)
            if elevation.shape[0]:  # sounded in one direction, heard in the other
                here = _heard(elevation, top, vc / math.sqrt(1.0 + uc * uc + vc * vc))
                ways[1, m] *= math.sqrt(here * _heard(elevation, top, there[2] / range_there))


@compiled
def _find_both(work, ways, first, last, uc, width, other):
    """What `spread_footprints` takes of echoes that go one way straight and the other over the mirror."""
    there = np.empty(3)
    for m in range(first, last):
        work[ENERGY, m] = 0.0
        if ways[1, m] == 0.0:
            continue
        low, high = work[BORDER, m], work[BORDER, m + 1]
        vc, height = (low + high) / 2, high - low
        rest, along_u, along_v = work[REST, m], work[ALONG_U, m], work[ALONG_V, m]
        q = rest + along_v * vc
        length = math.sqrt(1.0 + uc * uc + vc * vc)
        range_there = _carry(other, 1.0 / q, uc, vc, there)
        s = 2.0 / (length / q + range_there)
        # across, where strips are narrow, by how both ranges change with u
        x, x_u = 1.0 / q, -along_u / (q * q)
        r_u = (uc * x + (1.0 + uc * uc + vc * vc) * x_u) / length
        for k in range(3):
            r_u += (
                there[k]
                / range_there
                * ((other[k, 0] - other[k, 1] * uc + other[k, 2] * vc) * x_u - other[k, 1] * x)
            )
        low_v = _inverse_range(other, rest + along_v * low, uc, low, s, there)
        high_v = _inverse_range(other, rest + along_v * high, uc, high, s, there)
        work[S, m], work[A, m], work[B, m] = s, abs(r_u) * s * s * width / 4, abs(high_v - low_v) / 2
        # r^-2 of the way there and back over that of the bin's gain, which is 1 / r'^2 of the mean range
        spreading = 1.0 / (s * range_there)
        work[ENERGY, m] = ways[0, m] * ways[1, m] * spreading * spreading * width * height / (length**3 * s)


@compiled
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
    plane, needs_surface, loss : of `mirrored`
    sums, spans : as of `footprint.accumulate`
    """
    K = sums.shape[1]
    r_first, r_last = bin_edges_m[0], bin_edges_m[K]
    per_metre = K / (r_last - r_first)
    R = plane_echo.shape[0]
    work, ways = np.empty((LAST + 1, R + 1)), np.empty((2, R + 1))
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
        first, last = _look(work, plane_echo, body_id, 0, u, v, uc, nearest, step, bottom_row, n)
        if first > last:
            continue
        last += 1
        work[BORDER, 0], work[BORDER, n] = -v_limit, v_limit
        _find_borders(work, max(first, 1), min(last + 1, n), 1.0 / (FAR_FACTOR * r_last), v_limit)
        _weigh(
            work, ways, first, last, uc, elevation, top, own, other, ceiling, from_mirror, picture, sectors,
            other_picture, other_sectors, plane, needs_surface, loss,
        )  # fmt: skip
        if from_mirror:
            _find_shapes(work, first, last, uc, part_width[p], v_limit, elevation)
            for m in range(first, last):
                work[ENERGY, m] *= ways[0, m] * ways[0, m]
            spread_footprints(work, first, last, sums, spans, c, tables, flat, r_first, per_metre)
        _find_both(work, ways, first, last, uc, part_width[p], other)
        for m in range(first, last):
            work[ENERGY, m] *= once
        spread_footprints(work, first, last, sums, spans, c, tables, flat, r_first, per_metre)
