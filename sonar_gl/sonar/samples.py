"""Samples of the fan, which the renderer returns and the beamformer sums."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled
from sonar_gl.sonar.sector import Sector

NO_FACES, NO_BODIES = np.empty((0, 0), np.int32), np.empty((0, 0), np.uint16)
NO_SPANS = np.empty((0, 2))
# Samples about those with an echo: a footprint ends where the plane of a neighbour begins.
BESIDE_ECHO = 2


class SectorSamples(NamedTuple):
    """The samples of one sector, R rows by C columns.

    sector : Sector, whose lattice begins at the first of these samples
    plane_echo : (R, C, 4) float32: 1/x of the surface on the ray, 0 where it met nothing; slopes of 1/x along
        u and v; μ cos θ times slant range
    body_id : (R, C) uint16, number of the body, 0 where none; empty if it was not read
    face_id : (R, C) int32, number of the face, by which one sample may stand for neighbours in other rows; −1 where
        nothing returns an echo, −2 − row where the echo changes too quickly for that; empty if it is not known
    """

    sector: Sector
    plane_echo: np.ndarray
    body_id: np.ndarray
    face_id: np.ndarray = NO_FACES

    @property
    def lattice(self) -> tuple:
        """A plain tuple of `beamform.kernels.strips.Lattice`."""
        sector = self.sector
        turn = math.sin(sector.azimuth_rad), math.cos(sector.azimuth_rad)
        return sector.u, sector.v, sector.tan_low, sector.tan_high, sector.columns, *turn

    def with_echo(self) -> SectorSamples:
        """Return the window of these samples that holds all with an echo: few where few bodies return one."""
        sector = self.sector
        if not sector.columns:
            return self
        limits = _limits_of_echo(whole_rows(self.plane_echo), sector.columns)
        low, past, bottom, top = with_neighbours(limits, sector.columns, sector.rows)
        here = slice(bottom, top), slice(low, past)
        arrays = (one[here] if one.size else one for one in self[1:])
        return SectorSamples(sector.within(low, bottom, past - low, top - bottom), *arrays)


def with_neighbours(limits: Sequence[int], columns: int, rows: int) -> tuple[int, int, int, int]:
    """Return the limits of samples with an echo and of those beside them, which bound their footprints.

    limits : first and past the last column, first and past the last row; zeros are returned where there are none
    """
    low, past, bottom, top = limits
    if low >= past:
        return 0, 0, 0, 0
    low, bottom = max(low - BESIDE_ECHO, 0), max(bottom - BESIDE_ECHO, 0)
    return low, min(past + BESIDE_ECHO, columns), bottom, min(top + BESIDE_ECHO, rows)


@compiled
def _count_met(body_id, places):
    """Return how many samples of some sectors met a body; arguments of `ViewSamples` and `SectorTable`."""
    count = 0
    for s in range(places.shape[0]):
        left, columns, rows = places[s, 0], places[s, 1], places[s, 2]
        for j in range(rows):
            for i in range(uint64(left), uint64(left + columns)):
                count += body_id[j, i] != 0
    return count


@compiled
def _limits_of_echo(plane_echo, columns):
    """Return first and past the last column, and first and past the last row, of samples with an echo; zeros without.

    plane_echo : of `SectorSamples`, in `whole_rows`
    """
    low, past, bottom, top = columns, 0, 0, 0
    for j in range(plane_echo.shape[0]):
        greatest = np.float32(0.0)
        for i in range(columns):
            greatest = max(greatest, plane_echo[j, i, 3])
        if greatest <= np.float32(0.0):
            continue
        bottom, top = (bottom if top else j), j + 1
        i = 0
        while i < low and plane_echo[j, i, 3] <= np.float32(0.0):
            i += 1
        low, i = i, columns
        while i > past and plane_echo[j, i - 1, 3] <= np.float32(0.0):
            i -= 1
        past = i
    return (low, past, bottom, top) if top else (0, 0, 0, 0)


def whole_rows(window: np.ndarray) -> np.ndarray:
    """Return a window of an image with its rows as long as those of the image, without a copy.

    The rows begin where the window's do, and run on into what lies beside it. So the array is contiguous
    whatever the window, and kernels are compiled for contiguous arrays only. The last row may end past the
    image: read no more columns than the window has.
    """
    if window.flags.c_contiguous:
        return window
    pitch = window.strides[0] // window.strides[1]
    strides = window.strides
    return np.lib.stride_tricks.as_strided(window, (len(window), pitch, *window.shape[2:]), strides)


class SectorTable(NamedTuple):
    """Where the samples of a view's S sectors lie in its image, and their lattices, as kernels take them.

    places : (S, 3) int64, first column in the image, columns and rows
    u, v : (S, 3) float64, of `Sector`
    limits : (S, 4) float64, tangents of the lowest and the highest elevation; sine and cosine of the azimuth
    """

    places: np.ndarray
    u: np.ndarray
    v: np.ndarray
    limits: np.ndarray


def sector_table(sectors: Sequence[Sector], left: Sequence[int]) -> SectorTable:
    """Return the table of some sectors, whose samples begin at some columns of an image."""
    return SectorTable(
        np.array([(n, one.columns, one.rows) for one, n in zip(sectors, left, strict=True)], np.int64),
        np.array([one.u for one in sectors], np.float64),
        np.array([one.v for one in sectors], np.float64),
        np.array(
            [
                (one.tan_low, one.tan_high, math.sin(one.azimuth_rad), math.cos(one.azimuth_rad))
                for one in sectors
            ],
            np.float64,
        ),
    )


@dataclass(frozen=True, eq=False)
class ViewSamples:
    """The samples of the fan from one pose.

    sectors : SectorSamples of the fan's sectors
    plane_echo : (H, W, 4) float32, the image that contains the sectors side by side; None if a host rendered them
    left : column of the image at which the samples of each sector begin
    face_id, body_id : (H, W) int32 and uint16, of the same image; empty if they are not known
    table : plain tuple of SectorTable; None without an image
    body_spans : (bodies + 1, 2) float64 by number: 1/range of the furthest place of the body that may be visible, and
        of the nearest one of its box; empty if it is not known
    bubbles : (m, 4) azimuth, sine of elevation, range, steradians of point scatterers; None without plumes
    is_lit : whether the samples of each sector are the window that `SectorSamples.with_echo` finds
    n_faces : how many faces were drawn; 0 if that is not known
    """

    sectors: tuple[SectorSamples, ...]
    plane_echo: np.ndarray | None = None
    left: tuple[int, ...] = ()
    face_id: np.ndarray = field(default_factory=lambda: NO_FACES)
    body_id: np.ndarray = field(default_factory=lambda: NO_BODIES)
    table: tuple | None = None
    body_spans: np.ndarray = field(default_factory=lambda: NO_SPANS)
    bubbles: np.ndarray | None = None
    is_lit: bool = False
    n_faces: int = 0

    @cached_property
    def n_samples(self) -> int:
        """How many samples were drawn."""
        return sum(one.sector.columns * one.sector.rows for one in self.sectors)

    @cached_property
    def n_met(self) -> int:
        """How many samples met a body; all, where that is not known. First asked for while they are valid."""
        if self.table is None or not self.body_id.size:
            return self.n_samples
        return _count_met(self.body_id, self.table[0])

    def without_echo(self) -> ViewSamples:
        """Return this view with samples that return nothing."""
        image = None if self.plane_echo is None else np.zeros_like(self.plane_echo)
        sectors = (one._replace(plane_echo=np.zeros_like(one.plane_echo)) for one in self.sectors)
        return replace(self, sectors=tuple(sectors), plane_echo=image)

    def with_echo(self) -> ViewSamples:
        """Return the windows of this view's sectors that hold all samples with an echo, without bubbles."""
        if self.is_lit:
            return replace(self, bubbles=None)
        windows = tuple(one.with_echo() for one in self.sectors)
        return ViewSamples(windows, body_spans=self.body_spans, is_lit=True)
