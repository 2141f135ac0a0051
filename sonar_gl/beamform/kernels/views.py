"""Samples of a whole view of the fan, to find what it sees in a direction."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.core.compiled import uncounted
from sonar_gl.sonar.samples import ViewSamples

# One sector of a ViewIndex: its azimuth's cosine and sine; tangents of half its width and of its lowest and highest
# elevation.
# Its lattice: u = u0 + ui i + uj j and v = v0 + vi i + vj j of column i and row j, and the inverse,
# i = iu (u - u0) + iv (v - v0) and j likewise. Its window: first column in `plane_echo`, columns and rows.
# These names are part of the array's type, by which Numba keeps machine code: other files may use them, too.
SECTOR = np.dtype(
    [(name, np.float64) for name in ("cos", "sin", "tan_half_width", "tan_low", "tan_high")]
    + [(name, np.float64) for name in ("u0", "ui", "uj", "v0", "vi", "vj", "iu", "iv", "ju", "jv")]
    + [(name, np.int64) for name in ("left", "columns", "rows")]
)


class ViewIndex(NamedTuple):
    """All samples of one view of the fan, to find what it sees in a direction.

    plane_echo : (H, W, 4) float32, the windows of sectors side by side
    sectors : (n,) SECTOR
    """

    plane_echo: np.ndarray
    sectors: np.ndarray


def view_index(view: ViewSamples) -> ViewIndex:
    """Return the index of a view, of its own arrays."""
    rows = []
    for (sector, *_), left in zip(view.sectors, view.left, strict=True):
        u, v = sector.u.tolist(), sector.v.tolist()
        scale = 1.0 / (u[1] * v[2] - u[2] * v[1])
        inverse = scale * v[2], -scale * u[2], -scale * v[1], scale * u[1]
        azimuth = math.cos(sector.azimuth_rad), math.sin(sector.azimuth_rad)
        limits = math.tan(sector.half_width_rad) * (1 + 1e-9), sector.tan_low, sector.tan_high
        rows.append((*azimuth, *limits, *u, *v, *inverse, left, sector.columns, sector.rows))
    return ViewIndex(view.plane_echo, np.array(rows, SECTOR))


@uncounted
def find_surfaces(x, y, z, first, last, view, out):
    """Find what a view shows in some directions, all in the frame of its sonar.

    One call finds all of them: it takes as long to count the references to a view's arrays as to look into it, longer
    where two threads do.

    x, y, z : (n,) directions, of which those from `first` to before `last` are read
    view : tuple of ViewIndex
    out : (n,) 1 over the distance of the surface, in lengths of the direction; 0 where there is none, −1 outside
        the fan, where all zeros lie
    """
    view = ViewIndex(*view)
    plane_echo, sectors = view
    for n in range(first, last):
        k = find_sector(x[n], y[n], z[n], sectors)
        if k < 0:
            out[n] = -1.0
            continue
        out[n] = 0.0
        t = sectors[k]
        ahead, beside = t.cos * x[n] + t.sin * y[n], t.cos * y[n] - t.sin * x[n]
        du, dv = -beside / ahead - t.u0, z[n] / ahead - t.v0
        i = math.floor(t.iu * du + t.iv * dv + 0.5)
        j = math.floor(t.ju * du + t.jv * dv + 0.5)
        if not (0 <= i < t.columns and 0 <= j < t.rows):
            continue  # no body is near
        row, column = int(j), int(t.left + i)
        q = float(plane_echo[row, column, 0])
        if q > 0.0:
            # from the sample's own ray to this direction, in the plane that it met
            off_u, off_v = du - (t.ui * i + t.uj * j), dv - (t.vi * i + t.vj * j)
            q += plane_echo[row, column, 1] * off_u + plane_echo[row, column, 2] * off_v
            out[n] = max(q, 0.0) * ahead


@uncounted
def find_sector(x, y, z, sectors):
    """Return the number of the sector that holds a direction, −1 if none does.

    x, y, z : of the direction, in the frame of the sonar
    sectors : of `ViewIndex`
    """
    for k in range(sectors.shape[0]):
        t = sectors[k]
        ahead, beside = t.cos * x + t.sin * y, t.cos * y - t.sin * x
        if ahead <= 0.0 or abs(beside) > t.tan_half_width * ahead:
            continue
        u, v = -beside / ahead, z / ahead
        u2, v2 = 1.0 + u * u, v * abs(v)
        if v2 <= t.tan_high * abs(t.tan_high) * u2 and v2 >= t.tan_low * abs(t.tan_low) * u2:
            return k
    return -1
