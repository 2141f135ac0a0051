"""Between the bodies of a scene and the driver: how they lie before a sector, and what is drawn of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sonar_gl.raster.cull import SectorGeometry
from sonar_gl.raster.small_triangles import SampleList
from sonar_gl.sonar.sector import Sector

PER_BODY = 16  # floats: the rows of sonar_from_body, reflectivity, number, strength and slope of the lobe
REFLECTIVITY, LOBE = 12, 14  # of these; LOBE is the strength
MAX_KEPT_ROWS = 1 << 20  # of samples this is 27 MB; four pings of half a degree a sample need about as many
MARGIN = 2  # samples about what is visible, so that the outermost of a window meet nothing


class SectorView:
    """Per-sector constants of drawing, computed once.

    Attributes
    ----------
    sector : Sector
    geometry : tuple of SectorGeometry
    sample_rad : least width of a sample
    """

    def __init__(self, sector: Sector):
        u, v = sector.u, sector.v
        lattice = np.array([[u[1], u[2]], [v[1], v[2]]])
        corner = np.array([u[0], v[0]])
        ends = np.array([(i, j) for i in (-0.5, sector.columns - 0.5) for j in (-0.5, sector.rows - 0.5)])
        ends = ends @ lattice.T + corner
        self.sector, self.sample_rad = sector, min(u[1], v[2])
        self.geometry = tuple(
            SectorGeometry(
                rotation=sector.rotation(),
                limits=np.concatenate([[ends[:, k].min(), ends[:, k].max()] for k in range(2)]),
                inverse=np.linalg.inv(lattice),
                corner=corner,
                size=np.array([sector.columns, sector.rows], float),
                u=u,
                v=v,
            )
        )

    @property
    def inverse(self) -> np.ndarray:
        """(2, 2) samples per (u, v)."""
        return SectorGeometry(*self.geometry).inverse


@dataclass(frozen=True, eq=False)
class BodiesInView:
    """Bodies as seen from one pose of the sonar.

    Attributes
    ----------
    matrices : (n, 3, 4) sonar_from_body, about the middle of its mesh
    rows : (n, PER_BODY) float32, what the shader knows of them
    present : (n,) bool
    outside : whether back faces may be culled: the sonar is in the box of no closed body
    plane : (4,) a; only a · (x, y, z, 1) > 0 in the sonar's frame is drawn; or None
    is_cut : (n,) bool, bodies that lie on both sides of it
    """

    matrices: np.ndarray
    rows: np.ndarray
    present: np.ndarray
    outside: bool
    plane: np.ndarray | None
    is_cut: np.ndarray


class Window(NamedTuple):
    """The samples of a sector whose rays may meet a body; all 0 where there are none."""

    first_column: int = 0
    first_row: int = 0
    columns: int = 0
    rows: int = 0


class SectorDraws(NamedTuple):
    """What a sector draws.

    Attributes
    ----------
    first, n_closed, n : its draws in the list; the first of them are of closed bodies
    samples : slice of the list's samples that were rasterised in software
    window : Window
    """

    first: int
    n_closed: int
    n: int
    samples: slice
    window: Window


class GrowingArrays:
    """Arrays that are filled together from the front, and grow."""

    def __init__(self, *arrays: np.ndarray):
        self.arrays, self.used = arrays, 0

    def reserve(self, count: int) -> tuple[np.ndarray, ...]:
        """Return the free part of each, with room for so many rows more."""
        if self.used + count > len(self.arrays[0]):
            old, size = self.arrays, self.used + count
            size = 2 * size if 2 * size <= MAX_KEPT_ROWS else size
            self.arrays = tuple(np.empty((size, *array.shape[1:]), array.dtype) for array in old)
            for array, before in zip(self.arrays, old, strict=True):
                array[: self.used] = before[: self.used]
        return tuple(array[self.used :] for array in self.arrays)

    def clear(self) -> None:
        """Drop all rows, and arrays of very many rows, since coarse pings would keep the memory of a fine one."""
        self.used = 0
        if len(self.arrays[0]) > MAX_KEPT_ROWS:
            self.arrays = tuple(np.empty((0, *array.shape[1:]), array.dtype) for array in self.arrays)

    def filled(self) -> tuple[np.ndarray, ...]:
        """Return the used part of each."""
        return tuple(array[: self.used] for array in self.arrays)


class DrawList:
    """Draws of one ping or several, gathered before they are sent; and samples that need no drawing.

    Attributes
    ----------
    draws : (n, 5) uint32: indices, instances, first index, first vertex, body's row
    indices : (m,) uint32 that they name; of no length where they name those of all patches
    samples : (s, 2) int32, (s, 4) float32, (s,) uint16 of SampleList
    """

    def __init__(self):
        self.draws = GrowingArrays(np.empty((64, 5), np.uint32))
        self.indices = GrowingArrays(np.empty(1024, np.uint32))
        self.samples = GrowingArrays(
            *SampleList(
                np.empty((1024, 2), np.int32), np.empty((1024, 4), np.float32), np.empty(1024, np.uint16)
            )
        )

    def clear(self) -> None:
        """Drop all."""
        for arrays in (self.draws, self.indices, self.samples):
            arrays.clear()


def window_about(extent, columns: int, rows: int) -> Window:
    """Return whole samples with a margin about (low column, high column, low row, high row), in the sector."""
    out = []
    for low, high, count in ((extent[0], extent[1], columns), (extent[2], extent[3], rows)):
        first = int(min(max(low - MARGIN, 0), count)) if low < high else 0
        last = int(min(max(high + MARGIN + 1, 0), count)) if low < high else 0
        out.append((first, max(last - first, 0)))
    (first_column, columns), (first_row, rows) = out
    return Window(first_column, first_row, columns, rows) if columns and rows else Window()


def distance_before_plane(plane, matrices, bounds) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest distance of boxes before a plane; (n, 3, 4) and (n, 2, 3)."""
    middles, halves = bounds.mean(axis=1), np.ptp(bounds, axis=1) / 2
    along = plane[:3] @ matrices[:, :, :3]
    middle = (along * middles).sum(axis=1) + matrices[:, :, 3] @ plane[:3] + plane[3]
    half = (np.abs(along) * halves).sum(axis=1)
    return middle - half, middle + half
