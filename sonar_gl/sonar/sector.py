"""Sectors: perspective views of parts of the fan, with their lattice of samples and their strips.

A sample is one pixel of a sector. On the image plane, at unit distance from the sonar, it lies at u (to
starboard, u = −tan ψ') and v (up, v = tan φ / cos ψ'), where φ is the elevation and ψ' the azimuth relative to
the sector's middle.

A straight line array cannot tell the directions of a cone about its axis from each other: it measures the sine
k = sin ψ cos φ of the angle between a direction and the plane across its axis, and shows it at the azimuth asin k
(Van Trees, Optimum Array Processing, 2002, chapter 2). The strips of such an array are narrow cones, and other ones
upright planes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

# The lattice is sheared: each row is shifted by SHEAR samples against the row below, and each row rises by
# SHEAR_ROWS of the aperture's height from one side to the other. No straight edge, whether upright, level or
# oblique, then falls between the lines of the lattice over its whole length. SHEAR = 1/(3 + 1/golden ratio), which
# fractions approximate badly.
SHEAR = 0.2764
SHEAR_ROWS = 0.18
# All rows together are shifted by so much of their length at most, where there are many short ones. With a simple
# fraction of it, rays of some rows would lie on borders of strips, and rounding decide which strips they serve.
MAX_SHEAR = 0.2487

# Columns of cones end at this angle off the plane across the array, and cones at this azimuth: beyond it lies the array
# itself, where their strips would be as wide as the sector.
MAX_CONE_RAD, MAX_AZIMUTH_RAD = math.radians(84.0), math.radians(86.0)


class Uprights(NamedTuple):
    """P upright strips of a sector by rising u, side by side, so that each row of samples is divided between them.

    middle : (P,) float64, u of their middles
    end : (P + 1,) float64, where they end, from 0 where the first one begins
    """

    middle: np.ndarray
    end: np.ndarray


NO_UPRIGHTS = Uprights(np.empty(0), np.zeros(1))


@dataclass(frozen=True, eq=False)
class Strips:
    """The P strips of a sector's image plane, by rising azimuth or, of cones, by column.

    A strip ends where a column of the fan ends and is at most a tenth wider than a sample, a cone where the sector
    first holds it. In each row it takes the value of the nearest sample.

    column : (P,) int64, index of the fan's column that contains the strip; wide columns are counted on from the others
    middle : (P,) float64, u of the middle of an upright strip; sine k of the middle of a cone
    width : (P,) float64, in the unit of `middle`
    v_low, v_high : (P,) float64, v between which the strip lies
    are_cones : whether the strips are cones
    """

    column: np.ndarray
    middle: np.ndarray
    width: np.ndarray
    v_low: np.ndarray
    v_high: np.ndarray
    are_cones: bool = False

    @cached_property
    def uprights(self) -> Uprights:
        """The strips by rising u; none if they are cones."""
        if self.are_cones:
            return NO_UPRIGHTS
        return Uprights(self.middle[::-1].copy(), np.append(0.0, np.cumsum(self.width[::-1])))

    @cached_property
    def sines(self) -> tuple[float, float]:
        """Sines k between which cones lie; of upright strips minus infinity and infinity."""
        if not self.are_cones:
            return -math.inf, math.inf
        if not len(self.middle):
            return math.inf, -math.inf
        return float((self.middle - self.width / 2).min()), float((self.middle + self.width / 2).max())


@dataclass(frozen=True, eq=False)
class Sector:
    """One perspective view of part of the fan, R rows by C columns of samples.

    Each row is shifted against the row below by a fraction of a sample, and each column against its neighbour by a
    fraction of a row, so that an upright or level edge crosses the strips at another place in every row. The strips
    themselves are not sheared.

    azimuth_rad : azimuth of its middle, radians
    half_width_rad : half the azimuth that its strips cover; samples beyond it only fill sheared rows
    rows, columns : R, C
    u : (3,) float64; the sample at row j, column i lies at u[0] + u[1] i + u[2] j
    v : (3,) float64; the sample at row j, column i lies at v[0] + v[1] i + v[2] j
    tan_low, tan_high : tangents of the elevations between which its strips lie
    """

    azimuth_rad: float
    half_width_rad: float
    rows: int
    columns: int
    u: np.ndarray
    v: np.ndarray
    tan_low: float
    tan_high: float
    strips: Strips | None = field(default=None, repr=False)

    @property
    def steps(self) -> np.ndarray:
        """(2, 2) array, whose columns are the steps of (u, v) to the next sample of a row and to the next row."""
        return np.array([self.u[1:], self.v[1:]])

    def within(self, first_column: int, first_row: int, columns: int, rows: int) -> Sector:
        """Return the sector whose lattice is that of a window of the samples."""
        u, v = (
            np.array([w[0] + w[1] * first_column + w[2] * first_row, w[1], w[2]]) for w in (self.u, self.v)
        )
        return replace(self, u=u, v=v, columns=columns, rows=rows)

    def sample_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return u and v of all samples on the image plane, each (R, C) float64."""
        j, i = np.ogrid[0 : self.rows, 0 : self.columns]
        return self.u[0] + self.u[1] * i + self.u[2] * j, self.v[0] + self.v[1] * i + self.v[2] * j

    def holds_elevation(self, u, v) -> np.ndarray:
        """Return whether places on the image plane lie inside the sector's limits of elevation."""
        level = np.sqrt(1 + u * u)
        return (v > self.tan_low * level) & (v < self.tan_high * level)

    def is_received(self, u, v) -> np.ndarray:
        """Return whether places on the image plane lie in some strip of cones, or beams are upright."""
        low, high = self.strips.sines
        along = math.sin(self.azimuth_rad) - math.cos(self.azimuth_rad) * u
        sines = along / np.sqrt(1 + u * u + v * v)
        return (sines > low) & (sines < high)

    def rotation(self) -> np.ndarray:
        """Return (3, 3) sector_from_sonar, which turns the sector's middle onto the x axis."""
        c, s = math.cos(self.azimuth_rad), math.sin(self.azimuth_rad)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def projection(self, near_m: float, far_m: float) -> np.ndarray:
        """Return (4, 4) clip_from_sonar of OpenGL: the sheared perspective with samples on pixel centres.

        near_m, far_m : distances of the near and the far plane, metres
        """
        # pixel = inverse lattice of (u, v), where u = −y/x and v = z/x in the sector's frame
        inverse = np.linalg.inv(self.steps)
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
        sector_from_sonar = np.eye(4)
        sector_from_sonar[:3, :3] = self.rotation()
        return clip @ sector_from_sonar


def merge_close_azimuths(azimuths_rad) -> np.ndarray:
    """Return azimuths in rising order, without those less than a nanoradian above the one before.

    >>> merge_close_azimuths([0.5, 0.0, 0.5 + 1e-12]).tolist()
    [0.0, 0.5]
    """
    azimuths = np.sort(azimuths_rad)
    return azimuths[np.append(True, np.diff(azimuths) > 1e-9)]


def make_sector(
    azimuth_rad: float,
    half_width_rad: float,
    n_samples: int,
    rows: int,
    tan_limits: tuple[float, float],
    shear: float,
    are_cones: bool = False,
) -> Sector:
    """Return a sector, still without strips.

    azimuth_rad, half_width_rad : middle, and half of the azimuth that it covers, radians
    n_samples : samples of a row over that azimuth; rows get more samples as the shear requires
    rows : rows between the limits; the sector gets more rows as their curved edges and the shear require
    tan_limits : tangents of the lowest and the highest elevation
    shear : shift of each row against the row below, in samples; 0 gives a plain grid
    are_cones : whether it is for strips of cones
    """
    tan_width = math.tan(half_width_rad)
    low, high = tan_limits
    du, dv = 2 * tan_width / n_samples, (high - low) / rows
    # lines of equal elevation are curves, furthest from the middle at the sector's sides
    middle = math.cos(half_width_rad)
    bottom, top = min(low, low / middle), max(high, high / middle)
    rise = SHEAR_ROWS
    if are_cones:  # rows that rise as steeply as a strip leans would meet it more than once
        lean = _greatest_lean(azimuth_rad, half_width_rad, max(abs(low), abs(high)))
        rise = min(rise, tan_width / ((high - low) * max(lean, 1e-9)))
    shear_v = min(rise * rows, n_samples) if shear else 0.0
    R = 2 * math.ceil(((top - bottom) / dv + shear_v) / 2)
    shear_u = min(abs(shear) * R, MAX_SHEAR * n_samples)
    C = n_samples + 2 * math.ceil(shear_u / 2 + 0.5)
    step_u, step_v = math.copysign(shear_u / R * du, shear), math.copysign(shear_v / C * dv, shear)
    u = np.array([-(C - 1) / 2 * du - (R - 1) / 2 * step_u, du, step_u])
    v = np.array([(bottom + top) / 2 - (R - 1) / 2 * dv - (C - 1) / 2 * step_v, step_v, dv])
    return Sector(azimuth_rad, half_width_rad, R, C, u, v, low, high)


def _greatest_lean(azimuth_rad: float, half_width_rad: float, tan_elevation: float) -> float:
    """Return the greatest |du / dv| of cones in a sector: at the side furthest from the boresight."""
    aside = min(abs(azimuth_rad) + half_width_rad, MAX_AZIMUTH_RAD)
    within = aside - abs(azimuth_rad)
    sine, cosine = math.sin(abs(azimuth_rad)), math.cos(azimuth_rad)
    u = -math.tan(within)
    # of the cone through (u, v), see `beamform.kernels.strips`, where its derivative with v is zero
    v = min(tan_elevation / math.cos(within), math.sqrt(max(1 + sine * u / cosine, 0.0)))
    return (sine - cosine * u) * v / max(cosine * (1 + v * v) + sine * u, 1e-9)


def make_strips(sectors: Sequence[Sector], column_edges_rad, first_column: int = 0) -> list[Strips]:
    """Return the upright strips of some sectors: the fan's columns, divided evenly where they are wider than a sample.

    sectors : Sectors
    column_edges_rad : (columns + 1,) azimuths between which the columns of the fan lie, rising
    first_column : number of the first of these columns
    """
    laid, out = {}, []
    for one in sectors:
        key = one.azimuth_rad, one.half_width_rad, float(one.u[1])
        if key not in laid:  # sectors above and below the horizon have the same
            laid[key] = _uprights(one, column_edges_rad, first_column)
        columns, u, widths = laid[key]
        level = np.sqrt(1.0 + u * u)
        out.append(Strips(columns, u, widths, one.tan_low * level, one.tan_high * level))
    return out


def _uprights(
    sector: Sector, column_edges_rad, first_column: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return column, middle and width of `Strips`."""
    low, high = sector.azimuth_rad - sector.half_width_rad, sector.azimuth_rad + sector.half_width_rad
    inside = (column_edges_rad > low) & (column_edges_rad < high)
    azimuths = merge_close_azimuths(np.concatenate([[low], column_edges_rad[inside], [high]]))
    edges = -np.tan(azimuths - sector.azimuth_rad)
    # hardly wider than a sample: a sample that is nearest to the middle of no strip would be lost
    pieces = np.maximum(np.ceil((edges[:-1] - edges[1:]) / sector.u[1] - 0.1), 1).astype(int)
    if len(pieces) < pieces.sum():
        first = np.repeat(np.cumsum(pieces) - pieces, pieces)
        steps = np.repeat((edges[1:] - edges[:-1]) / pieces, pieces)
        within = (np.arange(len(steps)) - first) * steps
        edges = np.append(np.repeat(edges[:-1], pieces) + within, edges[-1])
    u = (edges[1:] + edges[:-1]) / 2
    columns = np.searchsorted(column_edges_rad, sector.azimuth_rad - np.arctan(u)) - 1
    columns = first_column + np.clip(columns, 0, len(column_edges_rad) - 2)
    return columns, u, edges[:-1] - edges[1:]


def make_cone_strips(sectors: Sequence[Sector], column_edges_rad, first_column: int = 0) -> list[Strips]:
    """Return the strips of some sectors that are cones about the axis of a line array, up to MAX_AZIMUTH_RAD.

    sectors : Sectors
    column_edges_rad : (columns + 1,) azimuths at which the array shows the edges of the fan's columns, rising, within
        ±MAX_CONE_RAD
    first_column : number of the first of these columns
    """
    return [_cones(one, column_edges_rad, first_column) for one in sectors]


def _cones(sector: Sector, column_edges_rad, first_column: int) -> Strips:
    edges = np.sin(column_edges_rad)
    middles, widths = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    part = _parts_of_cones(sector, middles)
    # as wide as a sample where the sector first holds the cone
    lowest = np.where(
        part.low_rad * part.high_rad < 0, 0.0, np.minimum(abs(part.low_rad), abs(part.high_rad))
    )
    u, v = _on_image_plane(sector, middles[part.cone], lowest)
    sine, cosine = math.sin(sector.azimuth_rad), math.cos(sector.azimuth_rad)
    across = widths[part.cone] * (1 + u * u + v * v) ** 1.5 / (cosine * (1 + v * v) + sine * u)
    pieces = np.ones(len(widths), int)
    np.maximum.at(pieces, part.cone, np.ceil(across / sector.u[1] - 0.1).astype(int))
    first = np.repeat(np.cumsum(pieces) - pieces, pieces)
    columns, widths = np.repeat(np.arange(len(pieces)), pieces), np.repeat(widths / pieces, pieces)
    middles = np.repeat(edges[:-1], pieces) + widths * (np.arange(len(first)) - first + 0.5)
    part = _parts_of_cones(sector, middles)
    order = np.argsort(part.cone, kind="stable")
    cone, low, high = part.cone[order], part.low_rad[order], part.high_rad[order]
    middles = middles[cone]
    _, v_low = _on_image_plane(sector, middles, low)
    _, v_high = _on_image_plane(sector, middles, high)
    return Strips(first_column + columns[cone], middles, widths[cone], v_low, v_high, are_cones=True)


def cone_end_rad(shown_rad, max_sine: float):
    """Return the angle around the cones of some azimuths at which they end, from the horizon; see `make_cone_strips`.

    They end at the elevation of a sine, or at the azimuth MAX_AZIMUTH_RAD.
    """
    beside = np.tan(np.abs(shown_rad)) / math.tan(MAX_AZIMUTH_RAD)
    above = np.minimum(max_sine / np.cos(shown_rad), 1.0)
    return np.minimum(np.arcsin(above), np.arccos(np.minimum(beside, 1.0)))


class _ConeParts(NamedTuple):
    """Parts of cones that a sector holds: (n,) index of the cone, and the elevations between which the part lies."""

    cone: np.ndarray
    low_rad: np.ndarray
    high_rad: np.ndarray


def _parts_of_cones(sector: Sector, sines) -> _ConeParts:
    """Return the parts of the cones of some sines k that a sector holds: one, or one above and one below."""
    # mirrored to port: there a cone's azimuth, asin(k / cos φ), rises with |φ|
    k = np.abs(sines)
    first = np.where(sines < 0, -sector.azimuth_rad, sector.azimuth_rad) - sector.half_width_rad
    last = np.minimum(first + 2 * sector.half_width_rad, MAX_AZIMUTH_RAD)
    enters, leaves = _elevation_at(k, first), _elevation_at(k, last)
    leaves = np.where((last > 0) & (k <= np.sin(last)), leaves, -1.0)
    low, high = math.atan(sector.tan_low), math.atan(sector.tan_high)
    above_low, above_high = np.maximum(np.where(enters > 0, enters, -leaves), low), np.minimum(leaves, high)
    below_low, below_high = np.maximum(-leaves, low), np.minimum(-enters, high)
    above, below = above_low < above_high, (enters > 0) & (below_low < below_high)
    return _ConeParts(
        np.concatenate([np.flatnonzero(above), np.flatnonzero(below)]),
        np.concatenate([above_low[above], below_low[below]]),
        np.concatenate([above_high[above], below_high[below]]),
    )


def _elevation_at(k, azimuth_rad):
    """Return the elevation at which cones of sines k, positive, reach an azimuth; 0 if they lie beyond it."""
    sine = np.sin(azimuth_rad)
    return np.arccos(np.where(sine > k, k / np.where(sine > 0, sine, 1.0), 1.0))


def _on_image_plane(sector: Sector, k, elevation_rad):
    """Return u and v of the places on cones of sines k at some elevations."""
    within = np.arcsin(np.clip(k / np.cos(elevation_rad), -1, 1)) - sector.azimuth_rad
    return -np.tan(within), np.tan(elevation_rad) / np.cos(within)
