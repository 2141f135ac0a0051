"""Geometry of the fan: sectors, the sheared lattice of samples, columns, beams.

The fan is split into perspective views (sectors). A sample is one pixel of a view; on the view's image
plane at unit distance it sits at u (to starboard, u = −tan ψ') and v (up, v = tan φ / cos ψ'), with ψ'
the azimuth from the sector's middle. Samples are gathered into columns of equal azimuth, and a beam is a
weighted sum of columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, frozen_array

# A perspective view samples its edges 1/cos² of the half-width more densely than its middle.
MAX_SECTOR_RAD = math.radians(50.0)
# Rows look SHEAR columns apart from bottom to top (and columns SHEAR rows from side to side), so that
# nothing upright or level falls between the grid's lines as a whole.
SHEAR = 16.0
SHEAR_ROWS = 0.25
REDUCERS = ("footprint", "point")


@dataclass(frozen=True)
class Sampling:
    """How densely the fan is sampled.

    Parameters
    ----------
    columns_per_beam : samples across one beam spacing, in azimuth
    rows : samples up the elevation aperture
    reducer : "footprint" spreads a sample over the ranges that it covers, "point" drops it into one bin
    """

    columns_per_beam: float
    rows: int
    reducer: str = "footprint"

    def __post_init__(self):
        if not (
            isinstance(self.columns_per_beam, (int, float, np.number))
            and 0 < self.columns_per_beam <= 1024
        ):
            raise Error(f"columns_per_beam must be a number in 0..1024 (got {self.columns_per_beam!r})")
        if not (isinstance(self.rows, (int, np.integer)) and 1 <= self.rows <= 16000):
            raise Error(f"rows must be a whole number in 1..16000 (got {self.rows!r})")
        if self.reducer not in REDUCERS:
            raise Error(f"reducer must be one of {', '.join(REDUCERS)} (got {self.reducer!r})")


# tolerance: samples across a beam width (but at least two a beam), rows a degree of elevation
TABLE = (
    (0.05, 4.0, 1.6),
    (0.02, 8.0, 3.2),
    (0.01, 16.0, 9.6),
    (0.005, 24.0, 19.2),
    (0.002, 32.0, 38.4),
)


def choose_sampling(sonar: Sonar, tolerance: float) -> Sampling:
    """The samples for a tolerance, the share of the echo that may lie in wrong bins, from a fixed table.

    Raises
    ------
    Error
        if the tolerance lies outside 0.001..0.5.
    """
    if not (isinstance(tolerance, (int, float, np.number)) and 0.001 <= tolerance <= 0.5):
        raise Error(f"tolerance must be a number in 0.001..0.5 (got {tolerance!r}; 0.01 is one per cent)")
    _, per_width, per_degree = next((row for row in TABLE if row[0] <= tolerance), TABLE[-1])
    spacing = sonar.azimuth_fov_deg / sonar.n_beams
    columns = max(2.0, per_width * spacing / sonar.beam_width_deg)
    return Sampling(columns, max(8, math.ceil(per_degree * sonar.elevation_fov_deg)))


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


@dataclass(frozen=True)
class Fan:
    """All that the samples of a sonar need, fixed once per run.

    Attributes
    ----------
    sectors : perspective views from starboard to port
    column_edges_rad : (columns + 1,) azimuths between which the fan's columns lie, rising
    """

    sonar: Sonar
    sampling: Sampling
    sectors: tuple[Sector, ...]
    column_edges_rad: np.ndarray = field(repr=False)

    @property
    def n_columns(self) -> int:
        """Columns of the whole fan."""
        return len(self.column_edges_rad) - 1


def make_fan(
    sonar: Sonar, sampling: Sampling, reach_rad: float, box: bool = True, shear: float = SHEAR
) -> Fan:
    """Lay the sectors, samples and columns of a sonar.

    Parameters
    ----------
    reach_rad : how far from their axes the beams hear
    box : the beams are boxes of that half-width: columns end where beams end
    shear : of the lattice, in samples across the view
    """
    azimuths = sonar.azimuth_rad
    start, stop = azimuths[0] - reach_rad, azimuths[-1] + reach_rad
    if stop - start > 2 * math.pi - 1e-9:
        start, stop = -math.pi, math.pi
    span = stop - start
    n_sectors = max(1, math.ceil(span / MAX_SECTOR_RAD - 1e-9))
    n_samples = sampling.columns_per_beam * sonar.n_beams * span / math.radians(sonar.azimuth_fov_deg)
    n_cells = max(2, math.ceil(n_samples / n_sectors))
    half_width = span / n_sectors / 2
    tan_elevation = math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    sectors = [
        make_sector(start + half_width * (2 * k + 1), half_width, n_cells, sampling.rows, tan_elevation, shear)
        for k in range(n_sectors)
    ]
    if box:
        ends = np.concatenate([azimuths - reach_rad, azimuths + reach_rad])
        if span > 2 * math.pi - 1e-9:
            ends = (ends + math.pi) % (2 * math.pi) - math.pi
    else:
        # a smooth pattern changes little over half a spacing
        ends = np.linspace(start, stop, 1 + math.ceil(2 * span / np.diff(azimuths).min(initial=span)))
    seams = start + 2 * half_width * np.arange(n_sectors + 1)
    edges = _distinct(np.clip(np.concatenate([ends, seams]), start, stop))
    sectors = tuple(replace(sector, parts=make_parts(sector, edges)) for sector in sectors)
    return Fan(sonar, sampling, sectors, frozen_array(edges, np.float64, (None,), "column edges"))


def _distinct(azimuths) -> np.ndarray:
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
    edges = _distinct(np.concatenate([cells, column_edges_rad[inside]]))
    middles = (edges[1:] + edges[:-1]) / 2
    u = -np.tan(edges - sector.azimuth_rad)
    return Parts(
        cell=np.clip(np.searchsorted(cells, middles) - 1, 0, sector.n_cells - 1),
        column=np.clip(np.searchsorted(column_edges_rad, middles) - 1, 0, len(column_edges_rad) - 2),
        u=(u[1:] + u[:-1]) / 2,
        width=u[:-1] - u[1:],
    )


def beam_weights(fan: Fan, pattern, reach_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """What a beam hears of each column, over the beam's solid angle.

    Parameters
    ----------
    pattern : function (azimuth_rad, steer_rad) -> power pattern, 1 on the axis, or None for a box
    reach_rad : the pattern counts as zero further than this from the axis

    Returns
    -------
    first : (B,) int64, first column of each beam (may be negative: columns are modulo n_columns)
    weights : (B, W) float32, 1/sr, rows of equal length
    """
    sonar, n_columns = fan.sonar, fan.n_columns
    edges, axes = fan.column_edges_rad, sonar.azimuth_rad
    reach_rad = min(reach_rad, math.pi)
    # the columns laid out three times round, so that a beam's stretch never breaks at the seam
    turns = np.array([-2 * math.pi, 0, 2 * math.pi])[:, None]
    if edges[-1] - edges[0] > 2 * math.pi - 1e-9:
        edges = np.append((edges[:-1] + turns).ravel(), edges[-1] + 2 * math.pi)
        origin = n_columns
    else:
        origin = 0
    first = np.searchsorted(edges, axes - reach_rad + 1e-12, side="right") - 1
    last = np.searchsorted(edges, axes + reach_rad - 1e-12, side="left")
    first, last = np.maximum(first, 0), np.minimum(last, len(edges) - 1)
    width = int((last - first).max())
    first = np.minimum(first, len(edges) - 1 - width)
    low = edges[first[:, None] + np.arange(width)] - axes[:, None]
    high = edges[first[:, None] + np.arange(width) + 1] - axes[:, None]
    low, high = np.clip(low, -reach_rad, reach_rad), np.clip(high, -reach_rad, reach_rad)
    heard = high - low
    if pattern is not None:
        nodes, shares = np.polynomial.legendre.leggauss(8)
        offsets = low[..., None] + heard[..., None] * (nodes + 1) / 2
        steer = axes[:, None, None]
        heard = heard * (pattern(steer + offsets, steer) @ (shares / 2))
    solid_angle = heard.sum(axis=1) * 2 * math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    # a column hears of its whole width: its sums already hold the azimuth
    share = heard / np.diff(edges)[first[:, None] + np.arange(width)]
    return first - origin, np.ascontiguousarray(share / solid_angle[:, None], np.float32)
