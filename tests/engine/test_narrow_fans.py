"""Fans of a few degrees, such as single beams: the shape of their samples, and what these err."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.sonar.sampling import HIGHEST, LEAST_COLUMNS, MIN_COLUMNS, Sampling, sampling_at
from sonar_gl.sonar.sector import SHEAR, make_sector
from tests.support.closed_forms import box_beams, plate_on_floor_echo, sphere_echo
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


@pytest.mark.parametrize("columns, rows", [(8, 252), (24, 1000), (32, 668), (16, 4000)])
@pytest.mark.parametrize("shear", [SHEAR, -SHEAR])
def test_few_columns_with_many_rows_meet_a_level_edge_at_different_heights(columns, rows, shear):
    """They met it at three or four heights, as each column rose by about 2/3 or 3/4 of a row."""
    sector = make_sector(0.0, 0.01, columns, rows, (-0.36, 0.36), shear)
    heights = np.sort(np.arange(columns) * sector.v[1] / sector.v[2] % 1)
    gaps = np.diff(np.append(heights, heights[0] + 1))
    assert gaps.max() < 2.7 / columns  # of multiples of the golden ratio at most 2.62 of the mean
    # in all columns a row lies no further than half its height inside the ends of the aperture
    _, v = sector.sample_coordinates()
    half = sector.v[2] / 2
    assert v[0].max() < half - 0.36 and v[-1].min() > 0.36 - half


def test_a_level_edge_before_a_single_beam():
    """It is 0.0011, and was 0.0021 when each column rose by two thirds of a row."""
    errors = []
    for top_m in np.linspace(0.9, 1.3, 12):
        exact = box_beams(
            SIDESCAN,
            lambda azimuth, top_m=top_m: plate_on_floor_echo(
                2.2, top_m, 9.03, azimuth, math.radians(20), SIDESCAN.bin_edges_m
            ),
        )
        plate = sg.Body(
            "plate", trimesh.creation.box((0.02, 20, top_m)), sg.pose(9.04, 0, top_m / 2 - 2.2), 1.0
        )
        floor = sg.Body("floor", trimesh.creation.box((200, 200, 1)), sg.pose(0, 0, -2.7), 1.0)
        errors.append(errors_of(SIDESCAN, Sampling(8.0, 252), sg.Scene([plate, floor]), exact))
    assert np.mean(errors) < 0.0015
