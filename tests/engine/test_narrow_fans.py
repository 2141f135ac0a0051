"""Fans of a few degrees, such as single beams: the shape of their samples, and what these err."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.sonar.sampling import HIGHEST, LEAST_COLUMNS, MIN_COLUMNS, Sampling, sampling_at
from tests.support.closed_forms import box_beams, sphere_echo
from tests.support.sampled_scenes import IDEAL

SIDESCAN = sg.Sonar("one beam", 900e3, 1, 500, 0.3, 40.0, 0.3, 0.5, 12.0)
APERTURE_DEG = math.degrees(2 * math.tan(math.radians(20.0)))


def errors_of(sonar, sampling, scene, exact) -> float:
    """Return the error of a ping with given samples, by a closed form."""
    with sg.Simulator(scene, sonar, IDEAL, sampling) as simulator:
        ping = simulator.ping(np.eye(4))
    return ping_error(ping, replace(ping, intensity=exact))


@pytest.mark.parametrize("level", [0, 4, 8, 12, 16, 20])
@pytest.mark.parametrize("fov_deg", [0.3, 1.0, 2.0, 5.0])
def test_samples_of_a_narrow_fan_are_hardly_higher_than_wide(fov_deg, level):
    """Their number is that of MIN_COLUMNS as high as a level has them."""
    sampling = sampling_at(replace(SIDESCAN, azimuth_fov_deg=fov_deg, beam_width_deg=fov_deg), level)
    columns = sampling.columns_per_beam
    assert columns >= LEAST_COLUMNS
    if columns < MIN_COLUMNS:
        rows = math.ceil(max(APERTURE_DEG * 2 ** (level / 4), APERTURE_DEG * 2))
        assert sampling.rows == math.ceil(rows * MIN_COLUMNS / columns - 1e-9)
    if columns > LEAST_COLUMNS:
        assert APERTURE_DEG / sampling.rows <= HIGHEST * fov_deg / columns * (1 + 1e-9)


@pytest.mark.parametrize("distance_m", [5.03, 7.09, 9.05])
def test_a_single_beam_divides_its_samples_well(distance_m):
    """24 columns of them, by 84 rows, erred by five to eight times as much."""
    ball = sg.Body("ball", trimesh.creation.icosphere(5, 0.3), sg.pose(distance_m, 0, 0, 0.1, 0.2, 0.3), 1.0)
    exact = box_beams(
        SIDESCAN,
        lambda azimuth: sphere_echo(0.3, distance_m, azimuth, math.radians(20), SIDESCAN.bin_edges_m),
    )
    scene, sampling = sg.Scene([ball]), sampling_at(SIDESCAN, 4)
    as_before = Sampling(24.0, 84)
    assert sampling.count(SIDESCAN) == as_before.count(SIDESCAN)
    error = errors_of(SIDESCAN, sampling, scene, exact)
    assert 4 * error < errors_of(SIDESCAN, as_before, scene, exact)
