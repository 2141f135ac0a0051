"""Footprints of echoes that go one way straight and the other by way of a reflector, by differences of exact ranges."""

import math

import numpy as np
import pytest

from sonar_gl.beamform.kernels import work_table
from sonar_gl.beamform.kernels.image_sources import (
    Interference,
    add_interference,
    find_other_leg,
    find_single_bounce,
)
from sonar_gl.beamform.kernels.strips import Strip
from tests.support.worlds import random_rotation

FIRST, LAST = 2, 42  # samples of the strip
STEP = 1e-5


class Samples:
    """Random planes that the samples of a strip met, and where the other one of the sonar and its image is."""

    def __init__(self, rng, are_cones):
        n = LAST + 1
        self.azimuth_rad, self.k = 0.7, 0.55  # of the sector, and the sine of the cone
        sine, cosine = math.sin(self.azimuth_rad), math.cos(self.azimuth_rad)
        self.strip = Strip(0, 0.013, FIRST, LAST, False, are_cones, sine, cosine)
        self.border = np.linspace(-0.3, 0.25, n)
        self.line_u, self.tilt = np.full(n, 0.12), np.zeros(n)
        if are_cones:  # the line through the places of the cone at both ends of a footprint
            u = [self.u_on_cone(self.k, v) for v in self.border]
            self.tilt[:-1] = np.diff(u) / np.diff(self.border)
            self.line_u[:-1] = u[:-1] - self.tilt[:-1] * self.border[:-1]
        self.q, self.slope_u, self.slope_v = rng.uniform((0.15, -0.2, -0.2), (0.3, 0.2, 0.2), (n, 3)).T
        self.other = np.column_stack([random_rotation(rng)[:3, :3], rng.uniform(-8, 8, 3)])

    def u_on_cone(self, k, v):
        """Return u where the direction (1, -u, v) of the sector has the sine k along the array."""
        sine, cosine = self.strip.sine, self.strip.cosine
        roots = np.roots([cosine**2 - k**2, -2 * sine * cosine, sine**2 - k**2 * (1 + v * v)])
        (u,) = (u for u in roots if (sine - cosine * u) * k > 0)
        return u

    def work(self):
        """Return `work` as strips are gathered."""
        out = work_table.make_work()
        rows = {
            work_table.BORDER: self.border,
            work_table.LINE_U: self.line_u,
            work_table.TILT: self.tilt,
            work_table.REST: self.q + self.slope_u * self.line_u,
            work_table.ALONG: self.slope_v + self.slope_u * self.tilt,
            work_table.ALONG_U: self.slope_u,
        }
        for row, values in rows.items():
            out[row, : len(values)] = values
        return out

    def place(self, m, u, v):
        """Return where a plane is met, in the frame of the sector."""
        return np.array([1.0, -u, v]) / (self.q[m] + self.slope_u[m] * u + self.slope_v[m] * v)

    def ranges(self, m, u, v):
        """Return how far that is from the one, and from the other."""
        place = self.place(m, u, v)
        return np.linalg.norm(place), np.linalg.norm(self.other[:, :3] @ place + self.other[:, 3])

    def s(self, m, u, v):
        return 2.0 / sum(self.ranges(m, u, v))

    def middle(self, m):
        v = (self.border[m] + self.border[m + 1]) / 2
        return self.line_u[m] + self.tilt[m] * v, v


@pytest.fixture(params=[False, True], ids=["upright", "cones"])
def samples(request):
    return Samples(np.random.default_rng(5), request.param)


def test_the_other_one_lies_before_a_plane_or_behind_it(samples):
    """SIDE is its distance from the plane over that of the one, positive on the same side."""
    work = samples.work()
    find_other_leg.py_func(work, samples.strip, samples.other)
    there = -samples.other[:, :3].T @ samples.other[:, 3]
    sides = []
    for m in range(FIRST, LAST):
        u, v = samples.middle(m)
        place = samples.place(m, u, v)
        expected = samples.other[:, :3] @ place + samples.other[:, 3]
        np.testing.assert_allclose(
            work[[work_table.X, work_table.Y, work_table.Z], m], expected, rtol=1e-12, atol=1e-12
        )
        normal = np.cross(samples.place(m, u + 0.1, v) - place, samples.place(m, u, v + 0.1) - place)
        side = normal @ (there - place) / (normal @ (-place))
        assert work[work_table.SIDE, m] == pytest.approx(side, rel=1e-9, abs=1e-9)
        sides.append(side)
    assert min(sides) < 0 < max(sides)


def test_single_bounce_footprints_are_those_of_the_mean_of_both_ranges(samples):
    work, strip = samples.work(), samples.strip
    rng = np.random.default_rng(6)
    work[work_table.REFLECTED, :LAST], work[work_table.BISTATIC, :LAST] = rng.uniform(0.1, 1, (2, LAST))
    find_other_leg.py_func(work, strip, samples.other)
    find_single_bounce.py_func(work, strip, FIRST, LAST, samples.other)
    for m in range(FIRST, LAST):
        u, v = samples.middle(m)
        s, (here, there) = samples.s(m, u, v), samples.ranges(m, u, v)
        assert work[work_table.S, m] == pytest.approx(s, rel=1e-12)
        across = strip.width
        if strip.are_cones:  # width is that of the sine of the cone, about the place of the sample
            length = math.sqrt(1 + u * u + v * v)
            k = (strip.sine - strip.cosine * u) / length
            more, less = (samples.u_on_cone(k + d, v) for d in (STEP, -STEP))
            across *= abs(more - less) / (2 * STEP)
        half = abs(samples.s(m, u + STEP, v) - samples.s(m, u - STEP, v)) / (2 * STEP) * across / 2
        # differences over 1e-5 err by its square, and by rounding over it
        assert work[work_table.A, m] == pytest.approx(half, rel=1e-6, abs=1e-12)
        low, high = samples.border[m], samples.border[m + 1]
        ends = [samples.s(m, samples.line_u[m] + samples.tilt[m] * end, end) for end in (low, high)]
        assert work[work_table.B, m] == pytest.approx(abs(ends[1] - ends[0]) / 2, rel=1e-9, abs=1e-14)
        solid_angle = across * (high - low) / (1 + u * u + v * v) ** 1.5
        # spreading there and back, over that of the mean range, by which the bin's gain is
        spreading = ((here + there) / 2 / there) ** 2
        strength = work[work_table.REFLECTED, m] * work[work_table.BISTATIC, m]
        assert work[work_table.ENERGY, m] * s == pytest.approx(strength * spreading * solid_angle, rel=1e-6)
        assert work[work_table.SLANT, m] == 0.0


@pytest.mark.parametrize("are_cones", [False, True], ids=["upright", "cones"])
@pytest.mark.parametrize("is_straight", [False, True], ids=["alike", "straight"])
def test_both_ways_interfere_by_the_bearings_that_they_arrive_from(are_cones, is_straight):
    """By the difference of sines of one straight array, else by the sine of the difference; not in opposite beams."""
    table, reach, shares = (
        0.7 * np.linspace(1, 0, 5),
        0.8,
        [],
    )  # linear in the square, so that the table is exact
    for seed in range(12):
        samples = Samples(np.random.default_rng(seed), are_cones)
        work, strip = samples.work(), samples.strip
        cosine, sine = math.cos(samples.azimuth_rad), math.sin(samples.azimuth_rad)
        own = np.array([[cosine, -sine, 0, 0], [sine, cosine, 0, 0], [0, 0, 1, 0]])
        work[work_table.ENERGY, :LAST] = 3.0
        find_other_leg.py_func(work, strip, samples.other)
        add_interference.py_func(work, strip, FIRST, LAST, own, Interference(table, reach, is_straight))
        for m in range(FIRST, LAST):
            place = samples.place(m, *samples.middle(m))
            here = own[:, :3] @ place
            there = (samples.other[:, :3] @ place + samples.other[:, 3]) * (1, -1, 1)
            if are_cones:
                azimuths = [math.asin(one[1] / np.linalg.norm(one)) for one in (here, there)]
            else:
                azimuths = [math.atan2(one[1], one[0]) for one in (here, there)]
            apart = azimuths[0] - azimuths[1]
            u = np.diff(np.sin(azimuths))[0] if is_straight else math.sin(apart)
            share = max(1 - (u / reach) ** 2, 0) if is_straight or math.cos(apart) > 0 else 0.0
            assert work[work_table.ENERGY, m] == pytest.approx(3 * (1 + 0.7 * share), rel=1e-9)
            shares.append(share)
    assert min(shares) == 0 and max(shares) > 0.9
    before = work[work_table.ENERGY].copy()
    add_interference.py_func(work, strip, FIRST, LAST, own, Interference(np.empty(0), 1.0, is_straight))
    np.testing.assert_array_equal(work[work_table.ENERGY], before)


def test_both_ways_by_a_level_reflector_double_to_the_last_bit():
    """Upright beams show both legs at one azimuth, but for rounding, which the table by squares does not see."""
    samples = Samples(np.random.default_rng(5), False)
    work, correlation = samples.work(), np.linspace(1, 0, 2049)
    cosine, sine = math.cos(samples.azimuth_rad), math.sin(samples.azimuth_rad)
    own = np.array([[cosine, -sine, 0, 0], [sine, cosine, 0, 0], [0, 0, 1, 0]])
    other = np.diag([1.0, -1.0, -1.0]) @ own + np.array([0, 0, 0, 3.0]) * np.array([[0], [0], [1]])
    work[work_table.ENERGY, :LAST] = energy = np.random.default_rng(6).uniform(0.1, 1, LAST)
    find_other_leg.py_func(work, samples.strip, other)
    add_interference.py_func(work, samples.strip, FIRST, LAST, own, Interference(correlation, 0.1, False))
    np.testing.assert_array_equal(work[work_table.ENERGY, FIRST:LAST], 2 * energy[FIRST:])
