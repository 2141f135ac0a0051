"""The fan of a sonar: its sectors, its columns, and how it is laid out for a sampling.

The fan is divided into perspective views (sectors). Samples are summed into columns, which are cells of azimuth; a
beam is a weighted sum of columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, count, pairwise
from typing import NamedTuple

import numpy as np

from sonar_gl.core.checks import frozen_array
from sonar_gl.sonar.sampling import MAX_COLUMNS_PER_BEAM, MAX_ROWS, Sampling, fewest_rows
from sonar_gl.sonar.sector import (
    MAX_AZIMUTH_RAD,
    MAX_CONE_RAD,
    SHEAR,
    Sector,
    make_cone_strips,
    make_sector,
    make_strips,
    merge_close_azimuths,
)
from sonar_gl.sonar.sonar import Sonar

# The far plane lies at this multiple of the last bin's range: near grazing incidence, the footprint of a sample
# whose middle lies beyond the last bin still extends into it.
FAR_FACTOR = 8.0

# Distance of the near plane: surfaces nearer than this, such as the sonar's own housing, return no echo.
NEAR_M = 1e-3

# A sonar in the water sees what lies at least this much below the water's surface. Else rounding would decide, sample
# by sample, on faces in the surface itself, such as the lid of a tank that is filled to the brim.
SURFACE_MARGIN_M = 1e-3

# A perspective view samples its edges 1/cos² of the half-width more densely than its middle.
MAX_SECTOR_RAD = math.radians(60.0)
# A column takes the mean of a smooth beam pattern over its width. It is as wide as a sample, but at most half a beam
# spacing, and at most half a part of a beam, since the range of a slanted wall changes across a column. It is at least
# about the half-width of the pattern's support (about four beam widths) over this number. Upright ones are √2 times as
# wide in the lattice that a ping is compared with.
COLUMNS_PER_SUPPORT = 128
PARTS_PER_BEAM = 4  # of its −3 dB width
# Samples that are wider than upright columns are best as wide as so many of them, which divide the number of columns of
# a sector. Each sample of a row then serves as many strips as the others, and what is upright and thin counts by its
# width, wherever it lies. See `fitted_sampling`.
COLUMNS_PER_SAMPLE = 1, 2, 3, 4, 6, 8, 12, 24
# Where none fits, samples rather are narrow than wide: of as many, so many times narrower ones err about as much or
# less, and wider ones more.
RATHER_NARROWER = 2**0.25
# A column is weighed by the mean of the transmit beam over it, whatever its echo is at either end. Columns of boxes are
# as wide as a beam, but there are at least so many in the −3 dB width of the transmit beam.
COLUMNS_PER_TRANSMIT_BEAM = 16

# The skirts and side lobes of a pattern in elevation return little, so that their samples are this many times wider and
# higher than the others, and twice as many times again in each further sector.
SKIRTS_COARSER = 4
# They are summed into wide columns, as wide as the samples of the lowest of these sectors: strips as wide as the
# columns of the fan would be small parts of a sample, each of which costs as much as a sample. Each column takes its
# share of a wide one. The half-width of the pattern's support holds about so many: beams become 3 % wider there, and at
# most 6 % where a wide column is two columns.
WIDE_COLUMNS_PER_SUPPORT = 12
# A perspective view has rows even in tan φ. The rows of the side lobes become BAND_RAD (1 + tan² φ) higher from one
# sector to the next above it, where an angle takes as much more of tan φ; no sector has fewer than MIN_BAND_ROWS,
# within which 1/r is nearly linear: with 4, a bin of the first bottom return is 1.2 dB too low where two sectors meet.
# Each sector has a fixed cost, so that the last one is no lower than MIN_BAND_DEG.
BAND_RAD, MIN_BAND_ROWS, MIN_BAND_DEG = 0.75, 16, 1.0


class ColumnWidths(NamedTuple):
    """How wide columns may be under smooth beam patterns.

    max_width : of a column, in beam spacings, or in parts of a beam (PARTS_PER_BEAM) where those are narrower; without
        effect on boxes
    wide_per_support : the half-width of the beams' support holds at least so many wide columns, about
    """

    max_width: float = 0.5
    wide_per_support: float = WIDE_COLUMNS_PER_SUPPORT


USUAL_WIDTHS = ColumnWidths()


@dataclass(frozen=True, eq=False)
class Fan:
    """The views and columns of a sonar for one sampling.

    sectors : perspective views from starboard to port; then those of the side lobes in elevation
    column_edges_rad : (columns + 1,) float64, azimuths between which the columns lie, rising
    max_elevation_rad : elevation of the uppermost strips
    wide_edges : (W + 1,) int64, numbers of the column edges between which the W wide columns lie, in which the strips
        of the side lobes are where there are any
    are_cones : whether columns are cones about the axis of a line array, at the azimuths where it shows them
    """

    sonar: Sonar
    sampling: Sampling
    sectors: tuple[Sector, ...]
    column_edges_rad: np.ndarray = field(repr=False)
    max_elevation_rad: float
    wide_edges: np.ndarray = field(repr=False)
    are_cones: bool = False

    @cached_property
    def max_sine(self) -> float:
        """Sine of `max_elevation_rad`."""
        return math.sin(self.max_elevation_rad)

    @cached_property
    def n_columns(self) -> int:
        """Number of columns of the whole fan."""
        return len(self.column_edges_rad) - 1

    @cached_property
    def n_samples(self) -> int:
        """Number of samples of all sectors: beyond field of view and aperture, too, and in the side lobes."""
        return sum(sector.rows * sector.columns for sector in self.sectors)

    @cached_property
    def n_wide_columns(self) -> int:
        """Number of wide columns."""
        return len(self.wide_edges) - 1

    @property
    def wide_shares(self) -> np.ndarray:
        """(columns,) float32, the share of its wide column's echo that each column takes, by width; 1 without any."""
        if not self.n_wide_columns:
            return np.ones(self.n_columns, np.float32)
        wide_widths = np.diff(self.column_edges_rad[self.wide_edges])
        shares = np.diff(self.column_edges_rad) / np.repeat(wide_widths, np.diff(self.wide_edges))
        return shares.astype(np.float32)


class BeamShape(NamedTuple):
    """What the beams of a sonar ask of its fan.

    support_rad : half-width of the receive beam pattern's support, radians: the outer beams reach this far beyond
        their axes
    is_box : whether the beams are boxes of that half-width; columns then end where beams end
    dense_elevation_deg : up to this elevation samples are as dense as the sampling has them; without effect beyond the
        aperture
    max_elevation_deg : from there up to this elevation the fan has sectors of skirts and side lobes; below 90, and
        without effect inside the aperture
    are_cones : whether columns are cones; False for boxes
    transmit_width_rad : −3 dB width of the transmit beam; infinite where the fan is insonified evenly
    """

    support_rad: float
    is_box: bool = True
    dense_elevation_deg: float = 90.0
    max_elevation_deg: float = 0.0
    are_cones: bool = False
    transmit_width_rad: float = math.inf


def make_fan(
    sonar: Sonar,
    sampling: Sampling,
    beams: BeamShape,
    shear: float = SHEAR,
    widths: ColumnWidths = USUAL_WIDTHS,
) -> Fan:
    """Return the fan of a sonar: its sectors with their samples and strips, and its columns.

    shear : of the lattice, samples from row to row; a negative one gives the lattice's mirror image
    """
    views = _views_of(sonar, beams)
    (start, stop), n_sectors, half_width = views
    n_samples = _samples_across(sonar, sampling, views)
    samples_per_sector = max(2, math.ceil(n_samples - 1e-9))
    top_rad = math.radians(sonar.elevation_fov_deg) / 2
    max_elevation_rad = max(top_rad, math.radians(beams.max_elevation_deg))
    bands = _bands(sampling.rows, samples_per_sector, top_rad, max_elevation_rad, beams)
    dense, *others = (_sectors_of(band, (start, stop), half_width, shear, beams.are_cones) for band in bands)
    sectors = [*dense, *chain.from_iterable(others)]
    seams = start + 2 * half_width * np.arange(n_sectors + 1)
    sample_rad = 2 * half_width / n_samples
    if beams.is_box or beams.are_cones:
        edges = _column_edges(sonar, (start, stop), seams, sample_rad, beams, widths)
    else:
        limits = _limits_of_columns(sonar, views, beams, shear, widths)
        edges = _upright_edges(seams, limits.n_columns(samples_per_sector))
    wide_edges, of_side_lobes = np.zeros(1, np.int64), (edges, 0)
    if len(bands) > 1 and not beams.is_box:
        # The lattice that a ping is compared with has wider ones, so that the difference holds their error.
        widest = beams.support_rad / widths.wide_per_support * (math.sqrt(2) if shear < 0 else 1)
        width = min(SKIRTS_COARSER * sample_rad, widest)
        wide_edges = _wide_edges(edges, seams, width)
        if len(wide_edges) > 1:
            of_side_lobes = edges[wide_edges], len(edges) - 1
    lay = make_cone_strips if beams.are_cones else make_strips
    strips = [*lay(dense, edges), *lay(sectors[len(dense) :], *of_side_lobes)]
    sectors = tuple(replace(sector, strips=mine) for sector, mine in zip(sectors, strips, strict=True))
    edges = frozen_array(edges, np.float64, (None,), "column edges")
    return Fan(sonar, sampling, sectors, edges, max_elevation_rad, wide_edges, beams.are_cones)


class _Views(NamedTuple):
    """How views divide the azimuths of a fan, beside each other: their ends, how many, and half the width of each."""

    ends_rad: tuple[float, float]
    count: int
    half_width_rad: float


def _views_of(sonar: Sonar, beams: BeamShape) -> _Views:
    start, stop = ends_of_fan_rad(sonar, beams)
    n = max(1, math.ceil((stop - start) / MAX_SECTOR_RAD - 1e-9))
    return _Views((start, stop), n, (stop - start) / n / 2)


def _samples_across(sonar: Sonar, sampling: Sampling, views: _Views) -> float:
    """Return the samples across each view that a sampling asks for, not always a whole number."""
    beam_rad = math.radians(sonar.azimuth_fov_deg) / sonar.n_beams
    return sampling.columns_per_beam * 2 * views.half_width_rad / beam_rad


def fitted_sampling(
    sonar: Sonar,
    sampling: Sampling,
    beams: BeamShape,
    shear: float = SHEAR,
    widths: ColumnWidths = USUAL_WIDTHS,
) -> Sampling:
    """Return about as many samples, each as wide as some whole columns of the fan, or some of them as one column.

    Unless beams are boxes or cones, whose columns have widths of their own, or there would be more than
    MAX_COLUMNS_PER_BEAM. There are more samples where rows are as few as they may be. Parameters are as for `make_fan`.
    """
    if beams.is_box or beams.are_cones:
        return sampling
    views = _views_of(sonar, beams)
    wanted = _samples_across(sonar, sampling, views)
    wider = wanted / _limits_of_columns(sonar, views, beams, shear, widths).fitted(wanted)
    rows = max(round(sampling.rows * wider), min(sampling.rows, fewest_rows(sonar)))
    columns_per_beam = min(sampling.columns_per_beam / wider, MAX_COLUMNS_PER_BEAM)
    return replace(sampling, columns_per_beam=columns_per_beam, rows=min(rows, MAX_ROWS))


class _ColumnLimits(NamedTuple):
    """The number of upright columns of a view: the fewest, which all COLUMNS_PER_SAMPLE divide, and the most, about."""

    fewest: int
    most: int

    def n_columns(self, n_samples: int) -> int:
        """Return the number of columns under so many samples across: as many, or about a whole part of them."""
        return max(math.ceil(n_samples / max(round(n_samples / self.most), 1)), self.fewest)

    def fitted(self, n_samples: float) -> int:
        """Return about as many samples, of which each has as many columns, or each column as many samples."""
        if n_samples >= self.fewest:
            return next(n for n in count(math.ceil(n_samples)) if n % self.n_columns(n) == 0)
        fitting = (self.fewest // n for n in COLUMNS_PER_SAMPLE)
        return min(fitting, key=lambda n: abs(math.log(n / (RATHER_NARROWER * n_samples))))


def _limits_of_columns(
    sonar: Sonar, views: _Views, beams: BeamShape, shear: float, widths: ColumnWidths
) -> _ColumnLimits:
    # the columns of the lattice that a ping is compared with are wider as its samples are
    plane = 2 * math.tan(views.half_width_rad) / (math.sqrt(2) if shear < 0 else 1)
    narrowest = beams.support_rad / COLUMNS_PER_SUPPORT
    widest = max(_widest_column_rad(sonar, views.ends_rad[1] - views.ends_rad[0], widths), narrowest)
    multiple = math.lcm(*COLUMNS_PER_SAMPLE)
    fewest = multiple * math.ceil(plane / widest / multiple)
    return _ColumnLimits(fewest, max(fewest, int(plane / narrowest)))


def _widest_column_rad(sonar: Sonar, span_rad: float, widths: ColumnWidths) -> float:
    spacing = np.diff(sonar.azimuth_rad).min(initial=span_rad)
    return widths.max_width * min(spacing, math.radians(sonar.beam_width_deg) / PARTS_PER_BEAM)


def _upright_edges(seams_rad: np.ndarray, n_columns: int) -> np.ndarray:
    """Return the azimuths between which upright columns lie, rising: as even on the plane of each view as samples are.

    seams_rad : (views + 1,) between which the views lie
    n_columns : of each view
    """
    half_width_rad = (seams_rad[1] - seams_rad[0]) / 2
    within = np.arctan(math.tan(half_width_rad) * np.linspace(-1, 1, n_columns + 1)[:-1])
    return np.append((seams_rad[:-1, None] + half_width_rad + within).ravel(), seams_rad[-1])


def ends_of_fan_rad(sonar: Sonar, beams: BeamShape) -> tuple[float, float]:
    """Return the azimuths between which the beams receive, radians; columns lie between them.

    >>> from sonar_gl.sonar.sonar_files import load_sonar
    >>> round(float(ends_of_fan_rad(load_sonar("gemini-720im"), BeamShape(0.1))[1]), 3)  # 45 degrees and 0.1
    0.885
    """
    azimuths = sonar.azimuth_rad
    start, stop = azimuths[0] - beams.support_rad, azimuths[-1] + beams.support_rad
    if stop - start > 2 * math.pi - 1e-9:
        start, stop = -math.pi, math.pi
    if beams.are_cones:
        return max(start, -MAX_CONE_RAD), min(stop, MAX_CONE_RAD)
    if sonar.steered == "straight" and not beams.is_box:  # such beams receive nothing from behind the array
        return max(start, -math.pi / 2), min(stop, math.pi / 2)
    return start, stop


class _Band(NamedTuple):
    """Sectors between two elevations: samples across and rows of each, and the tangents of the elevations."""

    samples: int
    rows: int
    tan_limits: tuple[float, float]


def _bands(
    rows: int, samples: int, top_rad: float, max_elevation_rad: float, beams: BeamShape
) -> list[_Band]:
    """Return the bands of a fan: the dense one about the horizon, and those of the skirts and side lobes.

    rows, samples : of the aperture, which ends at `top_rad`, and of each of its sectors across
    """
    row = 2 * math.tan(top_rad) / rows
    dense_rad = min(top_rad, math.radians(beams.dense_elevation_deg))
    tan_dense = math.tan(dense_rad)
    dense_rows = rows if dense_rad == top_rad else math.ceil(2 * tan_dense / row - 1e-9)
    bands = [_Band(samples, dense_rows, (-tan_dense, tan_dense))]
    if max_elevation_rad > dense_rad:
        limits = pairwise(_band_limits(tan_dense, math.tan(max_elevation_rad)))
        for number, (low, high) in enumerate(limits):
            coarser = SKIRTS_COARSER * 2**number
            # a degree of azimuth is less, too, where the sound looks up or down
            few = max(math.ceil(samples / (coarser * math.sqrt(1 + low * low)) - 1e-9), 2)
            band_rows = max(math.ceil((high - low) / (coarser * row * (1 + low * low)) - 1e-9), MIN_BAND_ROWS)
            bands += [_Band(few, band_rows, both) for both in ((low, high), (-high, -low))]
    return bands


def _sectors_of(
    band: _Band, ends_rad: tuple[float, float], half_width_rad: float, shear: float, are_cones: bool
) -> list[Sector]:
    """Return the sectors of a band, still without strips.

    ends_rad : azimuths between which the columns lie
    half_width_rad : of sectors that hold the columns at the horizon
    """
    samples, rows, limits = band
    first, last = ends_rad
    if are_cones:
        first, last = azimuths_of_cones(first, last, math.atan(max(map(abs, limits))))
    n = max(1, math.ceil((last - first) / MAX_SECTOR_RAD - 1e-9))
    half = (last - first) / n / 2
    if are_cones:  # as dense as in sectors that hold the columns at the horizon
        samples = max(math.ceil(samples * half / half_width_rad - 1e-9), 2)
    middles = (first + half * (2 * k + 1) for k in range(n))
    return [
        make_sector(middle, half, samples, rows, limits, shear, are_cones=are_cones) for middle in middles
    ]


def _column_edges(
    sonar: Sonar,
    ends_rad: tuple[float, float],
    seams_rad: np.ndarray,
    sample_rad: float,
    beams: BeamShape,
    widths: ColumnWidths,
) -> np.ndarray:
    """Return the azimuths between which the columns of boxes, or cones, lie, rising; they end where sectors do.

    ends_rad : of all columns
    seams_rad : ends of the sectors
    sample_rad : width of a sample, about
    """
    axes_rad = sonar.azimuth_rad
    start, stop = ends_rad
    span = stop - start
    if beams.is_box:
        ends = np.concatenate([axes_rad - beams.support_rad, axes_rad + beams.support_rad])
        if span > 2 * math.pi - 1e-9:
            ends = (ends + math.pi) % (2 * math.pi) - math.pi
    else:
        width = max(
            min(sample_rad, _widest_column_rad(sonar, span, widths)), beams.support_rad / COLUMNS_PER_SUPPORT
        )
        ends = np.linspace(start, stop, 1 + math.ceil(span / width - 1e-6))
    edges = merge_close_azimuths(np.clip(np.concatenate([ends, seams_rad]), start, stop))
    if beams.is_box and math.isfinite(beams.transmit_width_rad):
        return _divided(edges, beams.transmit_width_rad / COLUMNS_PER_TRANSMIT_BEAM)
    return edges


def azimuths_of_cones(first_rad: float, last_rad: float, elevation_rad: float) -> tuple[float, float]:
    """Return the azimuths between which cones lie, up to an elevation, which a line array shows between two azimuths.

    >>> np.degrees(azimuths_of_cones(-0.5, np.radians(60), np.radians(10))).round(1).tolist()
    [-29.1, 61.6]
    """
    level = max(math.cos(elevation_rad), 1e-9)
    ends = (math.asin(min(max(math.sin(one) / level, -1.0), 1.0)) for one in (first_rad, last_rad))
    first, last = (min(max(one, -MAX_AZIMUTH_RAD), MAX_AZIMUTH_RAD) for one in ends)
    return min(first, first_rad), max(last, last_rad)


def _divided(edges_rad: np.ndarray, widest_rad: float) -> np.ndarray:
    """Return the edges of columns, rising, of which those that are wider than the widest are divided evenly.

    >>> _divided(np.array([0.0, 1.0, 3.0]), 1.5).tolist()
    [0.0, 1.0, 2.0, 3.0]
    """
    pieces = np.maximum(np.ceil(np.diff(edges_rad) / widest_rad - 1e-9), 1).astype(int)
    parts = [
        np.linspace(*ends, n, endpoint=False) for ends, n in zip(pairwise(edges_rad), pieces, strict=True)
    ]
    return np.append(np.concatenate(parts), edges_rad[-1])


def _wide_edges(edges_rad: np.ndarray, seams_rad: np.ndarray, width_rad: float) -> np.ndarray:
    """Return the numbers of the column edges between which the wide columns lie; one number if they would be no wider.

    They end where sectors do. Those of a fan's mirror image are the mirror images of the fan's.

    edges_rad, seams_rad : of the columns and of the sectors, rising
    width_rad : of a wide column, about: whole columns make it
    """
    at_seams = np.searchsorted(edges_rad, seams_rad - 1e-9)
    out = [np.zeros(1, np.int64)]
    for first, last in pairwise(at_seams):
        n = last - first
        column_rad = np.diff(edges_rad[first : last + 1]).max()
        n_wide = math.ceil(n / max(round(width_rad / column_rad), 1))
        n_wide += (n - n_wide) % 2 * (n % 2)  # an odd number of columns has a middle one
        before = np.floor(np.arange(n_wide // 2 + 1) * n / n_wide + 0.5).astype(np.int64)  # to the middle
        after = n - before[: (n_wide + 1) // 2][::-1]
        out.append(first + np.concatenate([before, after])[1:])
    out = np.concatenate(out)
    return out if len(out) < len(edges_rad) else out[:1]


def _band_limits(tan_top: float, tan_max: float) -> list[float]:
    """Return tangents of elevations between which the sectors of the side lobes above an aperture lie, rising."""
    limits = [tan_top]
    tan_last = math.tan(math.atan(tan_max) - math.radians(MIN_BAND_DEG))
    while (following := limits[-1] + BAND_RAD * (1 + limits[-1] ** 2)) < tan_last:
        limits.append(following)
    return [*limits, tan_max]
