"""What goes between the bodies of a run and the driver: where bodies are, what is drawn of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.lattice import Sector

PER_BODY = 16  # floats: the rows of sonar_from_body, reflectivity, number, strength and slope of the lobe
REFLECTIVITY, LOBE = 12, 14  # of them; the strength of the latter
MARGIN = 2  # samples about what is seen, so that the outermost of a window meet nothing


class SectorView:
    """What is asked of a sector at every ping, and never changes."""

    def __init__(self, sector: Sector):
        u, v = sector.u, sector.v
        lattice = np.array([[u[1], u[2]], [v[1], v[2]]])
        self.sector, self.inverse, self.rotation = sector, np.linalg.inv(lattice), sector.rotation()
        self.corner, self.size = np.array([u[0], v[0]]), np.array([sector.columns, sector.rows], float)
        ends = np.array([(i, j) for i in (-0.5, sector.columns - 0.5) for j in (-0.5, sector.rows - 0.5)])
        ends = ends @ lattice.T + self.corner
        self.limits = np.concatenate([[ends[:, k].min(), ends[:, k].max()] for k in range(2)])
        self.sample_rad = min(u[1], v[2])


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """Where bodies are: (n, 4, 4) world_from_body, and (n,) bool, which of them are there at all.

    The rest is of one ping alone, or None.

    bubbles : (m, 4) x y z in the world and radius, metres, of all plumes' bubbles at the time of a ping, or
        None for no plumes
    time_s : of the ping, seconds, or None where nobody said
    reflectivity : (n,) float32 in place of the bodies' own, a factor where each face has its own
    acoustics, gain : Acoustics in the ping's own water, and (K,) float32 of each bin
    """

    poses: np.ndarray
    shown: np.ndarray
    bubbles: np.ndarray | None = None
    time_s: float | None = None
    reflectivity: np.ndarray | None = None
    acoustics: Acoustics | None = None
    gain: np.ndarray | None = None

    def rows(self, own) -> np.ndarray:
        """A copy of bodies' own rows, (n, PER_BODY), as they are in this ping."""
        out = own.copy()
        if self.reflectivity is not None:
            out[:, REFLECTIVITY] = self.reflectivity
        return out


@dataclass(frozen=True, eq=False)
class Placed:
    """Bodies as seen from one pose of the sonar.

    Attributes
    ----------
    matrices : (n, 3, 4) sonar_from_body, about the middle of its mesh
    rows : (n, PER_BODY) float32, what the shader knows of them
    shown : (n,) bool
    outside : whether back faces may be left out: the sonar is in the box of no closed body
    plane : (4,) a, of which a · (x, y, z, 1) > 0 in the sonar's frame alone is drawn, or None
    cut : (n,) bool, bodies that lie on both sides of it
    """

    matrices: np.ndarray
    rows: np.ndarray
    shown: np.ndarray
    outside: bool
    plane: np.ndarray | None
    cut: np.ndarray


class Draws:
    """Draws of one ping or several, gathered before they are sent; and samples that need no drawing.

    Attributes
    ----------
    draws : (n, 5) uint32: indices, instances, first index, first vertex, body's row
    indices : (m,) uint32 that they name; of no length where they name those of all patches
    places, values, bodies : (s, 2) int32, (s, 4) float32, (s,) uint16 of samples; see `sift.merge`
    """

    def __init__(self):
        self.counts = {"draws": 0, "indices": 0, "samples": 0}
        self.draws, self.indices = np.empty((64, 5), np.uint32), np.empty(1024, np.uint32)
        self.places, self.values = np.empty((1024, 2), np.int32), np.empty((1024, 4), np.float32)
        self.bodies = np.empty(1024, np.uint16)

    def clear(self) -> None:
        self.counts = dict.fromkeys(self.counts, 0)

    def room(self, kind: str, wanted: int, *names):
        """Arrays from where they are free, with room for so many more."""
        used, out = self.counts[kind], []
        for name in names or (kind,):
            array = getattr(self, name)
            if used + wanted > len(array):
                larger = np.empty((2 * (used + wanted), *array.shape[1:]), array.dtype)
                larger[:used] = array[:used]
                array = larger
                setattr(self, name, array)
            out.append(array[used:])
        return out


def window_of(found, columns: int, rows: int) -> tuple[int, int, int, int]:
    """What was found, in whole samples with a margin, inside the sector; all 0 for nothing."""
    out = []
    for low, high, count in ((found[0], found[1], columns), (found[2], found[3], rows)):
        first = int(min(max(low - MARGIN, 0), count)) if low < high else 0
        last = int(min(max(high + MARGIN + 1, 0), count)) if low < high else 0
        out.append((first, max(last - first, 0)))
    (first_column, columns), (first_row, rows) = out
    return (first_column, first_row, columns, rows) if columns and rows else (0, 0, 0, 0)


def before_plane(plane, matrices, bounds) -> tuple[np.ndarray, np.ndarray]:
    """How far before a plane, of `Placed`, boxes lie, at least and at most; (n, 3, 4) and (n, 2, 3)."""
    middles, halves = bounds.mean(axis=1), np.ptp(bounds, axis=1) / 2
    along = plane[:3] @ matrices[:, :, :3]
    middle = (along * middles).sum(axis=1) + matrices[:, :, 3] @ plane[:3] + plane[3]
    half = (np.abs(along) * halves).sum(axis=1)
    return middle - half, middle + half
