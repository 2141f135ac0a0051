"""Places and mirrors looked up in a picture of what the sonar sees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.compiled import compiled

# What two pictures show of one place may differ by so much of its distance; less on a mirror, which is flat.
SAME_PLACE, SAME_PLANE = 2e-3, 2e-4
LEAST = 1e-4  # of the intensity: what leaves less is no mirror
GRID = 48  # directions to each side of a sector that are tried


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
    for k in range(sectors.shape[0]):
        t = sectors[k]
        ahead, beside = t[0] * x + t[1] * y, t[0] * y - t[1] * x
        if ahead <= 0.0 or abs(beside) > t[2] * ahead:
            continue
        u, v = -beside / ahead, z / ahead
        if v * v > t[3] * t[3] * (1.0 + u * u):
            return -1.0, 0.0
        du, dv = u - t[4], v - t[7]
        i, j = math.floor(t[10] * du + t[11] * dv + 0.5), math.floor(t[12] * du + t[13] * dv + 0.5)
        if not (0 <= i < t[15] and 0 <= j < t[16]):
            return 0.0, ahead  # no body is near
        at = picture[int(j), int(t[14] + i)]
        if at[0] <= 0.0:
            return 0.0, ahead
        # from the sample's own ray to this direction, in the plane that it met
        off_u, off_v = u - (t[4] + t[5] * i + t[6] * j), v - (t[7] + t[8] * i + t[9] * j)
        return max(at[0] + at[1] * off_u + at[2] * off_v, 0.0), ahead
    return -1.0, 0.0


@compiled
def mirrored(x, y, z, picture, sectors, plane, needs_surface, loss):
    """What a mirror leaves of sound that leaves the sonar for (x, y, z); 0 where it meets none.

    Parameters
    ----------
    picture, sectors : what the sonar sees
    plane : (4,) normal and offset of normal · x = offset in the sonar's frame, offset > 0
    needs_surface : the mirror is a body's and must be seen there; before the water's nothing may stand
    loss : of `reflectors.Mirror`
    """
    sine = (plane[0] * x + plane[1] * y + plane[2] * z) / math.sqrt(x * x + y * y + z * z)
    if sine <= 1e-6:
        return 0.0
    at = min(sine, 1.0) * (loss.shape[0] - 1)
    k = min(int(at), loss.shape[0] - 2)
    left = loss[k] + (at - k) * (loss[k + 1] - loss[k])
    if left < LEAST:
        return 0.0
    seen, ahead = look_up(x, y, z, picture, sectors)
    if seen < 0.0:
        return 0.0
    # the mirror's distance over that of what is seen there
    nearness = seen * ahead * plane[3] / (plane[0] * x + plane[1] * y + plane[2] * z)
    if nearness > 1.0 + SAME_PLANE or (needs_surface and nearness < 1.0 - SAME_PLANE):
        return 0.0
    return left


@compiled
def light(picture, sectors, plane, needs_surface, loss, range_max_m):
    """Of a picture's directions, some: what a mirror leaves of them, and their echo, in the same unit.

    Parameters
    ----------
    picture, sectors, plane, needs_surface, loss : of `mirrored`
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
                if along > 0.0 and plane[3] * length / along < range_max_m:
                    left += weight * mirrored(x, y, z, picture, sectors, plane, needs_surface, loss)
    return left, echo
