"""A sector's lattice: where its samples look, and the parts of the view that they stand for.

A sector is one perspective view of part of the fan. A sample is one pixel of it; on the view's image plane
at unit distance it sits at u (to starboard, u = −tan ψ') and v (up, v = tan φ / cos ψ'), with ψ' the azimuth
from the sector's middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

# Each row looks SHEAR samples beside the one below, 1/(3 + 1/golden ratio), a number badly approached by
# fractions; columns of samples rise by SHEAR_ROWS of the aperture from side to side. So nothing upright,
# level or aslant falls between the lattice's lines as a whole.
SHEAR = 0.2764
SHEAR_ROWS = 0.18


@dataclass(frozen=True, eq=False)
class Parts:
    """The upright strips that a sector's samples stand for: P of them, by rising azimuth.

    A strip ends where one of the fan's columns does and is no wider than a sample, give or take a tenth. In
    each row the nearest ray stands for it.

    Attributes
    ----------
    column : (P,) int64, the fan's column that it lies in
    u, width : (P,) its middle and its width in u
    """

    column: np.ndarray
    u: np.ndarray
    width: np.ndarray


@dataclass(frozen=True, eq=False)
class Sector:
    """One perspective view: C by R samples.

    The rays of a row are shifted against those of the row below by a fraction of a sample (and columns of
    rays by a fraction of a row), so that an upright or level edge meets another part of the strips in every
    row. The strips themselves stay upright.

    Attributes
    ----------
    azimuth_rad : of its middle
    half_width_rad : half of the azimuth that it is answerable for
    rows, columns : R, C
    u : (3,) u of the ray (row j, column i) is u[0] + u[1] i + u[2] j
    v : (3,) v of the ray (row j, column i) is v[0] + v[1] i + v[2] j
    tan_elevation : tangent of half the elevation aperture
    parts : Parts
    """

    azimuth_rad: float
    half_width_rad: float
    rows: int
    columns: int
    u: np.ndarray
    v: np.ndarray
    tan_elevation: float
    parts: Parts = None

    def rays(self):
        """(R, C) u and (R, C) v of all rays."""
        j, i = np.mgrid[0 : self.rows, 0 : self.columns]
        return self.u[0] + self.u[1] * i + self.u[2] * j, self.v[0] + self.v[1] * i + self.v[2] * j

    def rotation(self) -> np.ndarray:
        """(3, 3) sector_from_sonar: turns the sector's middle onto the x axis."""
        c, s = math.cos(self.azimuth_rad), math.sin(self.azimuth_rad)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def projection(self, near_m: float, far_m: float) -> np.ndarray:
        """(4, 4) OpenGL clip_from_sonar: the sheared perspective that puts samples on pixel centres."""
        # pixel = inverse lattice of (u, v); u = −y/x and v = z/x of the sector's frame
        lattice = np.array([[self.u[1], self.u[2]], [self.v[1], self.v[2]]])
        inverse = np.linalg.inv(lattice)
        offset = 0.5 - inverse @ [self.u[0], self.v[0]]
        scale = np.array([2.0 / self.columns, 2.0 / self.rows])
        clip = np.zeros((4, 4))
        for row in range(2):
            clip[row, 0] = scale[row] * offset[row] - 1.0
            clip[row, 1] = -scale[row] * inverse[row, 0]
            clip[row, 2] = scale[row] * inverse[row, 1]
        clip[2, 0] = (far_m + near_m) / (far_m - near_m)
        clip[2, 3] = -2.0 * far_m * near_m / (far_m - near_m)
        clip[3, 0] = 1.0
        out = np.eye(4)
        out[:3, :3] = self.rotation()
        return clip @ out


def distinct(azimuths) -> np.ndarray:
    """Sorted, what lies nearer than a nanoradian taken for one."""
    azimuths = np.sort(azimuths)
    return azimuths[np.append(True, np.diff(azimuths) > 1e-9)]


def make_sector(azimuth, half_width, n_samples, rows, tan_elevation, shear) -> Sector:
    """A view with n_samples to a row over ±half_width, and as many more as the shear asks for."""
    tan_width = math.tan(half_width)
    du, dv = 2 * tan_width / n_samples, 2 * tan_elevation / rows
    top = tan_elevation / math.cos(half_width)  # where the aperture's curved edge is highest
    shear_v = min(SHEAR_ROWS * rows, n_samples) if shear else 0.0
    R = 2 * math.ceil((2 * top / dv + shear_v) / 2)
    shear_u = min(abs(shear) * R, n_samples / 4)
    C = n_samples + 2 * math.ceil(shear_u / 2 + 0.5)
    step_u, step_v = math.copysign(shear_u / R * du, shear), math.copysign(shear_v / C * dv, shear)
    u = np.array([-(C - 1) / 2 * du - (R - 1) / 2 * step_u, du, step_u])
    v = np.array([-(R - 1) / 2 * dv - (C - 1) / 2 * step_v, step_v, dv])
    return Sector(azimuth, half_width, R, C, u, v, tan_elevation)


def make_parts(sector: Sector, column_edges_rad) -> Parts:
    """Cut a sector into strips: at columns' edges, and wider columns into even pieces."""
    low, high = sector.azimuth_rad - sector.half_width_rad, sector.azimuth_rad + sector.half_width_rad
    inside = (column_edges_rad > low) & (column_edges_rad < high)
    edges = -np.tan(distinct(np.concatenate([[low], column_edges_rad[inside], [high]])) - sector.azimuth_rad)
    # hardly wider than a sample: a ray that is the nearest to no strip's middle would be lost
    pieces = np.maximum(np.ceil((edges[:-1] - edges[1:]) / sector.u[1] - 0.1), 1).astype(int)
    edges = np.concatenate(
        [np.linspace(edges[k], edges[k + 1], n, endpoint=False) for k, n in enumerate(pieces)] + [edges[-1:]]
    )
    u = (edges[1:] + edges[:-1]) / 2
    columns = np.searchsorted(column_edges_rad, sector.azimuth_rad - np.arctan(u)) - 1
    return Parts(np.clip(columns, 0, len(column_edges_rad) - 2), u, edges[:-1] - edges[1:])
