"""A sector's lattice: where its samples look, which cells they stand for, how columns cut the cells.

A sector is one perspective view of part of the fan. A sample is one pixel of it; on the view's image plane
at unit distance it sits at u (to starboard, u = −tan ψ') and v (up, v = tan φ / cos ψ'), with ψ' the azimuth
from the sector's middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

# Rows look SHEAR cells apart from bottom to top, and columns of samples SHEAR_ROWS of the aperture apart from
# side to side, so that nothing upright or level falls between the grid's lines as a whole.
SHEAR = 16.0
SHEAR_ROWS = 0.25


@dataclass(frozen=True)
class Parts:
    """A sector's cells, cut where the fan's columns end: P parts by rising azimuth.

    Attributes
    ----------
    cell, column : (P,) int64, the cell that a part belongs to, the fan's column that it lies in
    u, width : (P,) its middle and its width in u
    """

    cell: np.ndarray
    column: np.ndarray
    u: np.ndarray
    width: np.ndarray


@dataclass(frozen=True)
class Sector:
    """One perspective view: C by R samples, of which each stands for one cell of a straight grid.

    The rays of a row are shifted against those of the row below by a fraction of a cell (and columns of
    rays by a fraction of a row), so that an upright or level edge meets another part of the cell in every
    row. The cells themselves stay upright, so that they can be cut where columns end once for all rows.

    Attributes
    ----------
    azimuth_rad : of its middle
    half_width_rad : half of the azimuth that it is answerable for
    rows, columns : R, C
    u : (3,) u of the ray (row j, column i) is u[0] + u[1] i + u[2] j
    v : (3,) v of the ray (row j, column i) is v[0] + v[1] i + v[2] j
    tan_elevation : tangent of half the elevation aperture
    n_cells : cells across, from starboard (the highest u) to port
    shift : (R,) int64, the ray (j, i) belongs to the cell shift[j] - i, if that is in 0..n_cells - 1
    below, above : (R,) how far a row's cells reach in v: half way to the next ray of the same cell
    parts : Parts
    """

    azimuth_rad: float
    half_width_rad: float
    rows: int
    columns: int
    u: np.ndarray
    v: np.ndarray
    tan_elevation: float
    n_cells: int
    shift: np.ndarray
    below: np.ndarray
    above: np.ndarray
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


def make_sector(azimuth, half_width, n_cells, rows, tan_elevation, shear) -> Sector:
    """A view whose rays fill all cells of ±half_width and the aperture wherever the shear shifts them."""
    tan_width = math.tan(half_width)
    du, dv = 2 * tan_width / n_cells, 2 * tan_elevation / rows
    top = tan_elevation / math.cos(half_width)  # where the aperture's curved edge is highest
    shear_u, shear_v = min(shear, n_cells / 4), min(SHEAR_ROWS * rows if shear else 0, n_cells)
    C = n_cells + 2 * math.ceil(shear_u / 2 + 0.5)
    R = 2 * math.ceil((2 * top / dv + shear_v) / 2)
    step_u, step_v = shear_u / R * du, shear_v / C * dv
    u = np.array([-(C - 1) / 2 * du - (R - 1) / 2 * step_u, du, step_u])
    v = np.array([-(R - 1) / 2 * dv - (C - 1) / 2 * step_v, step_v, dv])
    # cells are counted from the highest u down, as azimuth rises
    shift = np.floor((tan_width - u[0] - u[2] * np.arange(R)) / du).astype(np.int64)
    # where a cell passes to the next ray of the row above, the shear of v makes its step longer or shorter
    steps = (dv + step_v * np.diff(shift)) / 2
    below, above = np.append(dv / 2, steps), np.append(steps, dv / 2)
    return Sector(azimuth, half_width, R, C, u, v, tan_elevation, n_cells, shift, below, above)


def make_parts(sector: Sector, column_edges_rad) -> Parts:
    """Cut a sector's cells where columns end."""
    tan_width = math.tan(sector.half_width_rad)
    cells = sector.azimuth_rad + np.arctan(tan_width * np.linspace(-1, 1, sector.n_cells + 1))
    inside = (column_edges_rad > cells[0]) & (column_edges_rad < cells[-1])
    edges = distinct(np.concatenate([cells, column_edges_rad[inside]]))
    middles = (edges[1:] + edges[:-1]) / 2
    u = -np.tan(edges - sector.azimuth_rad)
    return Parts(
        cell=np.clip(np.searchsorted(cells, middles) - 1, 0, sector.n_cells - 1),
        column=np.clip(np.searchsorted(column_edges_rad, middles) - 1, 0, len(column_edges_rad) - 2),
        u=(u[1:] + u[:-1]) / 2,
        width=u[:-1] - u[1:],
    )
