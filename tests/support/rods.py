"""Thin rods: random poses, true echoes, and ratios of measured to true echoes.

The true echo of a rod, a sum over beams and bins, changes as the sonar moves: with the number of overlapping beams, the
distance and the ends of the rod. So the tests compare the ratio of the measured to the true sum.
"""

import math
from dataclasses import dataclass

import numpy as np
import trimesh

import sonar_gl as sg

SHIFTS, STEP_M = 200, 0.001
KINDS = ("upright", "level", "any")
RODS = ((0.010, 6.0), (0.010, 15.0), (0.010, 30.0), (0.004, 6.0))  # diameter, range, metres
CABLES = ((0.020, 30.0), (0.050, 50.0))
WIDE_BEAMS_DEG, NARROW_BEAMS_DEG = 1.0, 45 / 256  # overlapping, contiguous


def rod_sonar(beam_width_deg=WIDE_BEAMS_DEG, range_max_m=40.0):
    """Return a sonar of 256 beams over 45 degrees, 512 bins and an elevation aperture of 20 degrees."""
    return sg.Sonar("rods", 900e3, 256, 512, 45.0, 20.0, beam_width_deg, 0.5, range_max_m)


@dataclass(frozen=True)
class Rod:
    """A cylinder between two ends, (3,) metres, world frame; the sonar is near the origin."""

    diameter_m: float
    start: np.ndarray
    stop: np.ndarray

    def body(self):
        mesh = trimesh.creation.cylinder(self.diameter_m / 2, segment=[self.start, self.stop], sections=32)
        return sg.Body("rod", mesh, reflectivity=1.0)


def random_rod(rng, diameter_m, range_m, kind, lengths_m=(0.3, 3.0), askew_deg=0.0):
    """Return a random rod in the middle of the fan: upright, level or of any orientation.

    askew_deg : least angle between the rod and the ray to it; nearly end on, a rod appears short
    """
    azimuth, elevation = np.radians(rng.uniform(-15, 15)), np.radians(rng.uniform(-4, 4))
    ahead, up = math.cos(elevation), math.sin(elevation)
    middle = range_m * np.array([ahead * math.cos(azimuth), ahead * math.sin(azimuth), up])
    along = rng.normal(size=3)
    if kind == "upright":
        along[:2] = 0.0
    elif kind == "level":
        along[2] = 0.0
    along /= np.linalg.norm(along)
    if np.linalg.norm(np.cross(along, middle)) < math.sin(math.radians(askew_deg)) * range_m:
        return random_rod(rng, diameter_m, range_m, kind, lengths_m, askew_deg)
    half = along * rng.uniform(*lengths_m) / 2
    return Rod(diameter_m, middle - half, middle + half)


def rod_of(diameter_m, range_m, beam_width_deg, k):
    """Return rod number k of a diameter, a range and a beam width, and the random generator after it."""
    rng = np.random.default_rng([7, *map(int, (1e3 * beam_width_deg, 1e4 * diameter_m, range_m, k))])
    return random_rod(rng, diameter_m, range_m, KINDS[k % 3]), rng


def shifts(rng):
    """Return positions of the sonar, (SHIFTS, 3): steps of 1 mm in a random direction across the boresight."""
    angle = rng.uniform(0, 2 * np.pi)  # of the direction
    return STEP_M * np.arange(SHIFTS)[:, None] * [0.0, math.cos(angle), math.sin(angle)]


def true_echo(rod, sonar, place):
    """Return the sum over beams and bins of a ping of the rod alone, profile `ideal`, sonar at `place`, not rotated.

    This is a quadrature of cos²θ dA / r² over the insonified half of the side and the insonified end; each point counts
    once for each box beam that covers its azimuth. A rod is convex, so no part of it is hidden.
    """
    along, around = 300, 16  # points
    start, stop = rod.start - place, rod.stop - place
    length, radius = np.linalg.norm(stop - start), rod.diameter_m / 2
    axis = (stop - start) / length
    middle = start + (np.arange(along)[:, None] + 0.5) / along * (stop - start)
    toward = -middle + (middle @ axis)[:, None] * axis  # to the sonar, across the axis
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    side = np.cross(axis, toward)
    angle = np.pi * ((np.arange(around) + 0.5) / around - 0.5)
    normal = np.cos(angle)[:, None, None] * toward + np.sin(angle)[:, None, None] * side
    point = middle + radius * normal
    area = radius * length * np.pi / (along * around)
    total = _surface_echo(point, normal, area, sonar).sum()
    end, outward = (start, -axis) if start @ axis > 0 else (stop, axis)
    if end @ outward < 0:
        total += _surface_echo(end, outward, np.pi * radius**2, sonar).sum()
    return float(total)


def _surface_echo(point, normal, area, sonar):
    """Return the echo of small pieces of surface, summed over beams."""
    r = np.linalg.norm(point, axis=-1)
    cosine = np.maximum(-(point * normal).sum(axis=-1) / r, 0)
    azimuth = np.arctan2(point[..., 1], point[..., 0])
    top = math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    axes, width = sonar.azimuth_rad, math.radians(sonar.beam_width_deg)
    beams = np.searchsorted(axes, azimuth + width / 2) - np.searchsorted(axes, azimuth - width / 2)
    inside = (np.abs(point[..., 2]) < top * r) & (r >= sonar.range_min_m) & (r < sonar.range_max_m)
    return beams * inside * cosine**2 * area / r**2 / (width * 2 * top)


def rng_of(*numbers):
    """Return a random generator seeded by lengths, to a thousandth."""
    return np.random.default_rng([round(1000 * number) for number in numbers])


def echo_ratios(rod, sonar, places, **settings):
    """Return the ratios of measured to true echo of a rod alone, (places,); settings: `sampling` or `tolerance`."""
    with sg.Simulator(sg.Scene([rod.body()]), sonar, sg.Acoustics.ideal(), **settings) as simulator:
        echoes = [simulator.ping(sg.pose(*place)).intensity.sum(dtype=np.float64) for place in places]
    return np.array(echoes) / [true_echo(rod, sonar, place) for place in places]


def echo_ratios_before_a_floor(rod, below_m, sonar, places, **settings):
    """Return the ratios of the rod's echo (`Ping.body_echo`) to the true one, and its true shares of the echo.

    The floor lies `below_m` below the lower end and has reflectivity 0.3.
    """
    slab = trimesh.creation.box((200, 200, 1))
    floor = sg.Body("floor", slab, sg.pose(0, 0, min(rod.start[2], rod.stop[2]) - below_m - 0.5), 0.3)
    scene = sg.Scene([rod.body(), floor])
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), **settings) as simulator:
        echoes = np.array([simulator.ping(sg.pose(*place), labels=True).body_echo for place in places])
    true = np.array([true_echo(rod, sonar, place) for place in places])
    return echoes[:, 1] / true, true / (true + echoes[:, 2])


def spread(ratios):
    """Return the rms deviation of the ratios from 1, which includes the bias; a lost rod has 1."""
    return float(np.sqrt(np.mean((ratios - 1) ** 2)))
