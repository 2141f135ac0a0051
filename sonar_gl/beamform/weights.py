"""Beams as weighted sums of columns: by the beam patterns, over the solid angle of each beam."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.kernels.beams import BeamTiles, beam_tiles
from sonar_gl.sonar.fan import Fan
from sonar_gl.sonar.sector import cone_end_rad

BLOCK = 1 << 18  # numbers of `blocks_of`: 2 MB; the weights of most devices fill less, or little more
# Entries of the table of the elevation pattern, which is interpolated linearly: off by 1e-5 of the peak at most
# where the aperture is 4 degrees or more.
ELEVATIONS = 8193
# Cones, and places around each, at which the elevation pattern is integrated.
CONES, AROUND = 129, 1024
# Where the main lobe in elevation is lower than this, the table and the places around cones are finer in proportion.
LOW_LOBE_DEG = 1.0
# Nodes of Gauss' rule for the mean of a beam pattern over a column, by the column's width in `Acoustics.null_rad`: it
# errs by 4e-8 of the peak, less than weights in float32. For the mean of e^{2πix} over w it is
# (πw)^2n 2^2n n!^4 / ((2n + 1) (2n)!^3). Columns of few wide beams may be wider than 1.4, for which 8 do.
# Source: Davis, Rabinowitz, Methods of Numerical Integration, 2nd ed., 1984, section 2.7
GAUSS_NODES = (0.1, 3), (0.25, 4), (0.5, 5), (math.inf, 8)


@dataclass(frozen=True, eq=False)
class BeamWeights:
    """Beams as weighted sums of columns.

    first : (B,) int64, first column of each beam (may be negative: columns are modulo the fan's)
    weights : (B, W) float32, 1/sr, rows of equal length
    width_rad, height : (B,) integral of the receive pattern over azimuth, and of the elevation pattern over sines; of
        columns that are cones a mean with the weights `columns_sr`
    columns_sr : (C,) solid angle of each column, weighed by the elevation pattern
    """

    first: np.ndarray
    weights: np.ndarray
    width_rad: np.ndarray
    height: float
    columns_sr: np.ndarray

    @cached_property
    def tiles(self) -> BeamTiles:
        """The weights in tiles of beams."""
        return beam_tiles(self.first, self.weights)

    @cached_property
    def column_response(self) -> np.ndarray:
        """What all beams together return of the echo in a column: (C,) float64."""
        n_columns = len(self.columns_sr)
        columns = self.first[:, None] + np.arange(self.weights.shape[1])
        return np.bincount((columns % n_columns).ravel(), self.weights.ravel(), n_columns)

    @cached_property
    def received(self) -> np.ndarray:
        """Which columns of the fan any beam receives: (C,) bool, read-only."""
        out = np.zeros(len(self.columns_sr), bool)
        for beams in blocks_of(*self.weights.shape):
            columns = self.first[beams, None] + np.arange(self.weights.shape[1])
            out[columns[self.weights[beams] > 0] % len(out)] = True
        out.setflags(write=False)
        return out


def blocks_of(n_beams: int, n_each: int) -> Iterator[slice]:
    """Yield beams, as many at a time as have BLOCK numbers together, of n_each: all of them would fill gigabytes."""
    step = max(BLOCK // n_each, 1)
    yield from (slice(first, first + step) for first in range(0, n_beams, step))


def beam_weights(
    fan: Fan,
    pattern: Callable | None,
    reach_rad: float,
    transmit_pattern: Callable | None = None,
    elevation_pattern: Callable | None = None,
    whole_columns: bool = False,
    n_nodes: int = GAUSS_NODES[-1][1],
) -> BeamWeights:
    """Weigh columns by the beam pattern, over the solid angle of each beam.

    pattern : function (azimuth_rad, steer_rad) -> receive power pattern, 1 on the axis, or None for a box
    reach_rad : the pattern counts as zero further than this from the axis
    transmit_pattern : function (azimuth_rad) -> power pattern of the projector, or None for a uniform one.
        The beam's solid angle leaves it out: beams are weak where the projector is
    elevation_pattern : function (sine of elevation) -> two-way power pattern, or None for a box
    whole_columns : weigh columns as wholes, also where the reach ends within them
    n_nodes : of Gauss' rule for the mean of patterns over a column
    """
    reach_rad = min(reach_rad, math.pi)
    near = _columns_within(reach_rad, fan)
    height, columns_sr = _column_solid_angles(fan, elevation_pattern)
    # an upright column of the same width holds as much of the elevation pattern
    as_upright = columns_sr / (np.diff(fan.column_edges_rad) * height)
    axes, widths = fan.sonar.azimuth_rad, np.diff(near.edges_rad)
    nodes, node_weights = np.polynomial.legendre.leggauss(n_nodes)
    weights, width_rad = np.empty((len(axes), near.width), np.float32), np.empty(len(axes))
    for beams in blocks_of(len(axes), near.width * n_nodes):
        axis, columns = axes[beams, None], near.first[beams, None] + np.arange(near.width)
        low, high = near.edges_rad[columns] - axis, near.edges_rad[columns + 1] - axis
        if whole_columns:  # as many of all beams, of which some lie beyond the reach where columns are wider
            high = np.where((low < reach_rad - 1e-12) & (high > 1e-12 - reach_rad), high, low)
        else:
            low, high = np.clip(low, -reach_rad, reach_rad), np.clip(high, -reach_rad, reach_rad)
        received = high - low
        steer, power = axis[..., None], 1.0
        azimuths = steer + low[..., None] + received[..., None] * (nodes + 1) / 2
        if pattern is not None:
            power = pattern(azimuths, steer)
            received = received * (power @ (node_weights / 2))
        width_rad[beams] = (received * as_upright[(columns - near.origin) % fan.n_columns]).sum(axis=1)
        if transmit_pattern is not None:
            received = (high - low) * ((power * transmit_pattern(azimuths)) @ (node_weights / 2))
        # the sums of a column hold its whole width in azimuth
        weights[beams] = received / widths[columns] / (width_rad[beams] * height)[:, None]
    return BeamWeights(near.first - near.origin, weights, width_rad, height, columns_sr)


class _NearColumns(NamedTuple):
    """The columns that each beam may receive, equally many for all beams.

    edges_rad : of columns by rising azimuth; those of a fan all round are laid out three times, so that the columns of
        a beam never break at the seam
    origin : which of these columns is the fan's first
    first : (B,) of these columns, the first of each beam
    width : how many each beam has
    """

    edges_rad: np.ndarray
    origin: int
    first: np.ndarray
    width: int


def _columns_within(reach_rad: float, fan: Fan) -> _NearColumns:
    """Return the columns of which a part lies within reach of the axis of a beam."""
    edges, axes, origin = fan.column_edges_rad, fan.sonar.azimuth_rad, 0
    if edges[-1] - edges[0] > 2 * math.pi - 1e-9:
        turns = np.array([-2 * math.pi, 0, 2 * math.pi])[:, None]
        edges = np.append((edges[:-1] + turns).ravel(), edges[-1] + 2 * math.pi)
        origin = fan.n_columns
    first = np.searchsorted(edges, axes - reach_rad + 1e-12, side="right") - 1
    last = np.searchsorted(edges, axes + reach_rad - 1e-12, side="left")
    first, last = np.maximum(first, 0), np.minimum(last, len(edges) - 1)
    width = int((last - first).max())
    return _NearColumns(edges, origin, np.minimum(first, len(edges) - 1 - width), width)


def _column_solid_angles(fan: Fan, elevation_pattern: Callable | None) -> tuple[float, np.ndarray]:
    """Return `height` and `columns_sr` of BeamWeights; the pattern as of `beam_weights`."""
    height = 2 * fan.max_sine
    if elevation_pattern is not None:
        sines = fan.max_sine * np.linspace(-1, 1, 2 * elevations_of(fan) - 1)[1::2]
        height *= elevation_pattern(sines).mean()
    heights = _cone_heights(fan, elevation_pattern) if fan.are_cones else height
    return height, np.diff(fan.column_edges_rad) * heights


def gauss_nodes(width_rad: float, reach_rad: float, null_rad: float) -> int:
    """Return the nodes for columns of some width.

    reach_rad, null_rad : of `beam_weights` and `Acoustics.null_rad`
    """
    ends_in_step = reach_rad + width_rad > math.pi / 2  # behind the array, which no rule resolves
    in_nulls = math.inf if ends_in_step or not null_rad else width_rad / null_rad
    return next(count for widest, count in GAUSS_NODES if in_nulls <= widest)


def elevations_of(fan: Fan) -> int:
    """Return the number of even sines from -1 to 1 at which the pattern in elevation is tabulated."""
    return (ELEVATIONS - 1) * _times_finer(fan) + 1


def _times_finer(fan: Fan) -> int:
    """Return how many times finer a low main lobe is tabulated, a power of 2; 1 for those of devices."""
    return 2 ** max(math.ceil(math.log2(LOW_LOBE_DEG / fan.sonar.elevation_fov_deg)), 0)


def _cone_heights(fan: Fan, elevation_pattern: Callable | None) -> np.ndarray:
    """Return the integral of the elevation pattern over cones, per radian across, of each column, (C,).

    The direction at angle t around the cone that is shown at azimuth β is (cos β cos t, sin β, cos β sin t), and its
    solid angle cos β dβ dt.
    """
    edges = fan.column_edges_rad
    shown = np.linspace(edges[0], edges[-1], CONES)
    ends = cone_end_rad(shown, fan.max_sine)
    times_finer, power = _times_finer(fan), 1.0
    n_around = AROUND * times_finer
    if elevation_pattern is not None:
        # some cones at a time, since many places around all of them would take gigabytes
        parts = np.array_split(np.arange(CONES), times_finer)
        around = (2 * np.arange(n_around) + 1 - n_around) / n_around
        sines = (np.cos(shown[part])[:, None] * np.sin(ends[part][:, None] * around) for part in parts)
        power = np.concatenate([elevation_pattern(one).mean(axis=1) for one in sines])
    nodes, node_weights = np.polynomial.legendre.leggauss(8)  # columns of few samples are wide
    places = edges[:-1, None] + np.diff(edges)[:, None] * (nodes + 1) / 2
    return np.interp(places, shown, 2 * ends * np.cos(shown) * power) @ (node_weights / 2)
