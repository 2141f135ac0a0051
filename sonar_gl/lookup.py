"""Places and mirrors looked up in a picture of what the sonar sees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.compiled import compiled

# What two pictures show of one place may differ by so much of its distance; less on a mirror, which is flat.
SAME_PLACE, SAME_PLANE = 2e-3, 2e-4
LEAST = 1e-4  # of the intensity: what leaves less is no mirror
GRID = 24  # directions to each side of a sector that are tried


@dataclass(frozen=True, eq=False)
class Lookup:
    """A picture in which places are looked up.

    Attributes
    ----------
    picture : (H, W, 4) of `render.Picture.plane_echo`
    sectors : (n, 17) azimuth's cosine and sine, tangents of half the width and of the elevation, lattice u
        and v, its inverse; then first column in the picture, columns and rows
    """

    picture: np.ndarray
    sectors: np.ndarray


def lookup(drawn) -> Lookup:
    """To look places up in a `render.Picture`."""
    rows = []
    for view, (i, j, columns, n_rows), left, _ in drawn.parts:
        s = view.sector
        u, v = (np.array([w[0] + w[1] * i + w[2] * j, w[1], w[2]]) for w in (s.u, s.v))
        about = math.cos(s.azimuth_rad), math.sin(s.azimuth_rad), math.tan(s.half_width_rad) * (1 + 1e-9)
        rows.append([*about, s.tan_elevation, *u, *v, *view.inverse.ravel(), left, columns, n_rows])
    return Lookup(drawn.plane_echo, np.array(rows, np.float64))


@compiled
def look_up(x, y, z, picture, sectors):
    """1/x of the surface that a picture shows in the direction (x, y, z), and the direction's own x.

    −1, 0 beside the fan.

    Parameters
    ----------
    picture : (H, W, 4) float32, sectors side by side, as the shader writes them
    sectors : (n, 17) of `Lookup`
    """
    # number by number: a row taken out would be counted in and out by both threads
    for k in range(sectors.shape[0]):
        c, s = sectors[k, 0], sectors[k, 1]
        ahead, beside = c * x + s * y, c * y - s * x
        if ahead <= 0.0 or abs(beside) > sectors[k, 2] * ahead:
            continue
        u, v = -beside / ahead, z / ahead
        if v * v > sectors[k, 3] * sectors[k, 3] * (1.0 + u * u):
            return -1.0, 0.0
        du, dv = u - sectors[k, 4], v - sectors[k, 7]
        i = math.floor(sectors[k, 10] * du + sectors[k, 11] * dv + 0.5)
        j = math.floor(sectors[k, 12] * du + sectors[k, 13] * dv + 0.5)
        if not (0 <= i < sectors[k, 15] and 0 <= j < sectors[k, 16]):
            return 0.0, ahead  # no body is near
        row, column = int(j), int(sectors[k, 14] + i)
        q = float(picture[row, column, 0])
        if q <= 0.0:
            return 0.0, ahead
        # from the sample's own ray to this direction, in the plane that it met
        off_u = du - (sectors[k, 5] * i + sectors[k, 6] * j)
        off_v = dv - (sectors[k, 8] * i + sectors[k, 9] * j)
        return max(q + picture[row, column, 1] * off_u + picture[row, column, 2] * off_v, 0.0), ahead
    return -1.0, 0.0


@compiled
def left_of(sine, loss):
    """What a mirror leaves of sound at a grazing angle of this sine; loss : of `reflectors.Mirror`."""
    at = min(max(sine, 0.0), 1.0) * (loss.shape[0] - 1)
    k = min(int(at), loss.shape[0] - 2)
    return loss[k] + (at - k) * (loss[k + 1] - loss[k])


@compiled
def is_open(x, y, z, picture, sectors, plane, needs_surface):
    """Whether sound that leaves the sonar for (x, y, z) meets a mirror, with nothing before it.

    Parameters
    ----------
    picture, sectors : what the sonar sees
    plane : (4,) normal and offset of normal · x = offset in the sonar's frame, offset > 0
    needs_surface : the mirror is a body's and must be seen there; of the water's surface nothing is seen
    """
    seen, ahead = look_up(x, y, z, picture, sectors)
    if seen < 0.0:
        return False
    # the mirror's distance over that of what is seen there
    nearness = seen * ahead * plane[3] / (plane[0] * x + plane[1] * y + plane[2] * z)
    return nearness <= 1.0 + SAME_PLANE and (nearness >= 1.0 - SAME_PLANE or not needs_surface)


@compiled
def light(picture, sectors, plane, needs_surface, loss, range_max_m):
    """Of a picture's directions, some: what a mirror leaves of them, and their echo, in the same unit.

    Parameters
    ----------
    picture, sectors, plane, needs_surface : of `is_open`; loss : of `left_of`
    """
    left = echo = 0.0
    for k in range(sectors.shape[0]):
        t = sectors[k]
        for row in range(GRID):
            for column in range(GRID):
                u = t[2] * ((2 * column + 1) / GRID - 1)
                v = t[3] * math.sqrt(1.0 + u * u) * ((2 * row + 1) / GRID - 1)
                x, y, z = t[0] + t[1] * u, t[1] - t[0] * u, v
                seen, _ = look_up(x, y, z, picture, sectors)
                length = math.sqrt(1.0 + u * u + v * v)
                weight = 1.0 / length**3
                if seen > 0.0 and length / seen < range_max_m:
                    i, j = t[10] * (u - t[4]) + t[11] * (v - t[7]), t[12] * (u - t[4]) + t[13] * (v - t[7])
                    at = picture[int(j + 0.5), int(t[14] + math.floor(i + 0.5))]
                    echo += weight * at[3] * seen / length
                along = plane[0] * x + plane[1] * y + plane[2] * z
                near = along > 0.0 and plane[3] * length / along < range_max_m
                if near and is_open(x, y, z, picture, sectors, plane, needs_surface):
                    left += weight * left_of(along / length, loss)
    return left, echo
