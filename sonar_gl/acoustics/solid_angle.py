"""Solid angles of beams: what they receive from all around, and by which echoes are normalised."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import DEFAULT_WATER
from sonar_gl.sonar.fan import BeamShape, ends_of_fan_rad
from sonar_gl.sonar.sector import cone_end_rad
from sonar_gl.sonar.sonar import Sonar

GAUSS_LEGENDRE = np.polynomial.legendre.leggauss(8)  # for each side lobe
# Intervals of a part of an integral; side lobes that are more and narrower are sampled at places as good as random.
MIN_LOBES, MAX_LOBES = 16, 512
MAIN_LOBES = 4  # to each side, which are a part of an integral over elevation
CONES = 513  # at which the integral around a cone is taken; it changes slowly from cone to cone


class BeamSolidAngles(NamedTuple):
    """The solid angles of a beam.

    receive_sr : of the receive pattern, one way, over the whole sphere: noise comes from all around
    echo_sr : of the receive pattern in azimuth and the two-way pattern in elevation, over the columns of the fan:
        intensities are normalised by it. A transmit beam in azimuth does not count
    """

    receive_sr: float
    echo_sr: float


def beam_solid_angles(sonar: Sonar, acoustics: Acoustics, beam: int | None = None) -> BeamSolidAngles:
    """Return the integrals of the patterns of a beam over solid angle.

    beam : its number; None: the one nearest to the boresight

    An upright beam at ψ_b has the solid angle ∫ B(ψ, ψ_b) dψ ∫ p(sin φ) d sin φ, B its pattern in azimuth and p that in
    elevation. A cone is ∫ B(β, ψ_b) cos β ∫ p(cos β sin t) dt dβ, where the direction at angle t around the cone that
    is shown at β is (cos β cos t, sin β, cos β sin t). Beams receive nothing from behind.

    >>> from sonar_gl.sonar.sonar_files import load_sonar
    >>> sonar = load_sonar("p900-45")  # beams of 1 x 20 degrees
    >>> [round(1e3 * sr, 3) for sr in beam_solid_angles(sonar, Acoustics.ideal())]  # 2 sin 10° of a radian in 57.3
    [6.061, 6.061]
    """
    azimuth_rad = sonar.azimuth_rad
    axis_rad = azimuth_rad[np.abs(azimuth_rad).argmin() if beam is None else beam]
    # no pattern depends on the water, which may change from ping to ping
    return _solid_angles(sonar, replace(acoustics, water=DEFAULT_WATER, multipath="none"), float(axis_rad))


class _Elevation(NamedTuple):
    """A pattern in elevation: a function of the sine, the sine at which it ends, and about the half of its width."""

    power: Callable
    max_sine: float
    lobe_sine: float

    def height(self) -> float:
        """Return its integral over the sine: the height of an upright beam."""
        sines, weights = self._nodes(self.max_sine)
        return float(self.power(sines) @ weights)

    def heights_of_cones(self, shown_rad, end_rad) -> np.ndarray:
        """Return its integral around cones, (n,) per radian across; they end at an angle around each."""
        around, weights = self._nodes(1.0)
        levels = np.cos(shown_rad)
        means = [
            self.power(level * np.sin(end * around)) @ weights
            for level, end in zip(levels, end_rad, strict=True)
        ]
        return levels * end_rad * means

    def _nodes(self, end: float) -> tuple[np.ndarray, np.ndarray]:
        main = MAIN_LOBES * self.lobe_sine
        near = [-main, 0.0, main] if main < end else [0.0]
        return _nodes([-end, *near, end], self.lobe_sine)


@lru_cache(maxsize=64)
def _solid_angles(sonar: Sonar, acoustics: Acoustics, axis_rad: float) -> BeamSolidAngles:
    are_cones, reach_rad = acoustics.has_cones(sonar), acoustics.receive_support_rad(sonar)
    beams = BeamShape(reach_rad, acoustics.beam_pattern == "box", are_cones=are_cones)
    half_turn, lobe_sine = (
        math.pi / 2 if are_cones else math.pi,
        math.sin(math.radians(sonar.elevation_fov_deg) / 2),
    )
    max_sine = math.sin(math.radians(acoustics.max_elevation_deg(sonar)))
    one_way, two_way = acoustics.one_way_elevation_pattern(sonar), acoustics.two_way_elevation_pattern(sonar)
    receive = echo = _Elevation(np.ones_like, max_sine, lobe_sine)  # a box
    if one_way is not None:
        receive, echo = _Elevation(one_way.power, 1.0, lobe_sine), _Elevation(two_way, max_sine, lobe_sine)

    def integral(ends_rad: tuple[float, float], elevation: _Elevation, end_of_cone: Callable) -> float:
        azimuth_rad, weights = _places(ends_rad, axis_rad, reach_rad, math.radians(sonar.beam_width_deg))
        received = weights * _receive_power(sonar, acoustics, azimuth_rad, axis_rad, reach_rad)
        if not are_cones:
            return float(received.sum()) * elevation.height()
        shown = np.linspace(*ends_rad, CONES)
        ends = end_of_cone(shown, elevation.max_sine)
        heights = elevation.heights_of_cones(shown, ends)
        return float(received @ np.interp(azimuth_rad, shown, heights))

    return BeamSolidAngles(
        receive_sr=integral((-half_turn, half_turn), receive, _end_of_whole_cone),
        echo_sr=integral(ends_of_fan_rad(sonar, beams), echo, cone_end_rad),
    )


def _end_of_whole_cone(shown_rad, max_sine: float):
    """Return the angle around cones at which they reach the elevation of a sine, or end at the array."""
    return np.arcsin(np.minimum(max_sine / np.cos(shown_rad), 1.0))


def _receive_power(sonar: Sonar, acoustics: Acoustics, azimuth_rad, axis_rad: float, reach_rad: float):
    """Return the receive pattern in azimuth: of the support, and beyond it that of the far side lobes."""
    away_rad = np.abs((azimuth_rad - axis_rad + math.pi) % (2 * math.pi) - math.pi)
    pattern, far_pattern = acoustics.receive_pattern(sonar), acoustics.far_pattern(sonar)
    near = 1.0 if pattern is None else pattern(azimuth_rad, axis_rad)
    far = 0.0
    if far_pattern is not None:
        far = far_pattern.power(far_pattern.coordinate(azimuth_rad) - far_pattern.coordinate(axis_rad))
        far = np.where((np.cos(azimuth_rad) > 0) | (sonar.steered == "alike"), far, 0.0)
    return np.where(away_rad <= reach_rad, near, far)


def _places(ends_rad: tuple[float, float], axis_rad: float, reach_rad: float, width_rad: float):
    """Return azimuths and weights of an integral over azimuth: its parts end where a pattern does."""
    turns = 2 * math.pi * np.arange(-1, 2)[:, None]
    steps = axis_rad + np.array([-math.pi / 2, -reach_rad, 0.0, reach_rad, math.pi / 2])
    steps = np.append((steps + turns).ravel(), [-math.pi / 2, math.pi / 2])
    first, last = ends_rad
    return _nodes(
        np.unique(np.concatenate([[first], steps[(steps > first) & (steps < last)], [last]])), width_rad
    )


def _nodes(ends, lobe: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places and weights of an integral over parts that end at `ends`, of a function with lobes so wide."""
    x, w = GAUSS_LEGENDRE
    parts = []
    for low, high in pairwise(ends):
        n = min(max(math.ceil((high - low) / lobe), MIN_LOBES), MAX_LOBES)
        parts.append(np.linspace(low, high, n, endpoint=False))
    starts = np.append(np.concatenate(parts), ends[-1])
    widths = np.diff(starts)
    places = starts[:-1, None] + widths[:, None] * (x + 1) / 2
    return places.ravel(), (widths[:, None] * w / 2).ravel()
