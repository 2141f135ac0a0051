"""The part of a sector's samples that can meet anything: water is not drawn."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.compiled import compiled
from sonar_gl.lattice import Sector

MARGIN = 2  # samples about what is seen, so that the outermost of a window meet nothing


@compiled
def _extend(found, x, y, z, inverse, u0, v0):
    """Stretch (low column, high column, low row, high row) to the sample that looks at a point."""
    u, v = -y / x - u0, z / x - v0
    for axis in range(2):
        at = inverse[axis, 0] * u + inverse[axis, 1] * v
        found[2 * axis] = min(found[2 * axis], at)
        found[2 * axis + 1] = max(found[2 * axis + 1], at)


@compiled
def _cover(bounds, rotations, offsets, cosine, sine, near_m, inverse, u0, v0, found):
    """Stretch `found` over the boxes of all bodies, as far as they lie before the sonar.

    bounds : (n, 2, 3) in the bodies' frames; rotations, offsets : (n, 3, 3), (n, 3) sonar_from_body
    """
    x, y, z = np.empty(8), np.empty(8), np.empty(8)
    for n in range(bounds.shape[0]):
        for corner in range(8):
            a = bounds[n, corner & 1, 0]
            b = bounds[n, (corner >> 1) & 1, 1]
            c = bounds[n, (corner >> 2) & 1, 2]
            r, o = rotations[n], offsets[n]
            ahead = r[0, 0] * a + r[0, 1] * b + r[0, 2] * c + o[0]
            aside = r[1, 0] * a + r[1, 1] * b + r[1, 2] * c + o[1]
            x[corner] = cosine * ahead + sine * aside
            y[corner] = cosine * aside - sine * ahead
            z[corner] = r[2, 0] * a + r[2, 1] * b + r[2, 2] * c + o[2]
            if x[corner] >= near_m:
                _extend(found, x[corner], y[corner], z[corner], inverse, u0, v0)
        # an edge that passes the sonar is seen from where it comes before it
        for k in range(8):
            for axis in range(3):
                m = k ^ (1 << axis)
                if x[k] < near_m <= x[m]:
                    t = (near_m - x[k]) / (x[m] - x[k])
                    ys, zs = y[k] + t * (y[m] - y[k]), z[k] + t * (z[m] - z[k])
                    _extend(found, near_m, ys, zs, inverse, u0, v0)


def window(sector: Sector, bounds, rotations, offsets, near_m: float) -> tuple[int, int, int, int]:
    """First column, first row, columns and rows of the samples whose rays may meet a body's box.

    Parameters
    ----------
    bounds : (n, 2, 3) low and high corner of each body's box, in its frame, metres
    rotations, offsets : (n, 3, 3) and (n, 3) sonar_from_body
    near_m : what is nearer is not seen
    """
    inverse = np.linalg.inv([[sector.u[1], sector.u[2]], [sector.v[1], sector.v[2]]])
    found = np.array([np.inf, -np.inf, np.inf, -np.inf])
    middle = sector.azimuth_rad
    _cover(
        bounds,
        rotations,
        offsets,
        math.cos(middle),
        math.sin(middle),
        near_m,
        inverse,
        sector.u[0],
        sector.v[0],
        found,
    )
    out = []
    for low, high, count in ((*found[:2], sector.columns), (*found[2:], sector.rows)):
        first = int(min(max(low - MARGIN, 0), count)) if low < high else 0
        last = int(min(max(high + MARGIN + 1, 0), count)) if low < high else 0
        out.append((first, max(last - first, 0)))
    (first_column, columns), (first_row, rows) = out
    if columns == 0 or rows == 0:
        return 0, 0, 0, 0
    return first_column, first_row, columns, rows
