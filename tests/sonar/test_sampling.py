"""Sampling and its levels."""

import math
from dataclasses import replace

import pytest

import sonar_gl as sg
from sonar_gl.sonar.sampling import (
    FINEST_LEVEL,
    extend_rows,
    level_of,
    part_of,
    sampling_at,
    sampling_of_width,
)


def test_sampling_of_a_width():
    sonar = sg.load_sonar("p900-45")
    aperture_deg = math.degrees(2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2))
    assert sampling_of_width(sonar, 0.2) == sg.Sampling(
        45 / 0.2 / sonar.n_beams, math.ceil(aperture_deg / 0.2)
    )
    # coarse samplings have a least number of columns and rows; fine ones are limited to what Sampling allows
    assert sampling_of_width(sonar, 90.0) == sg.Sampling(24 / sonar.n_beams, math.ceil(aperture_deg / 0.5))
    assert sampling_of_width(replace(sonar, n_beams=1), 1e-4) == sg.Sampling(1024, 16000)


def test_half_the_samples():
    half = part_of(sg.Sampling(2.0, 100, "point"), 0.5)
    assert half == sg.Sampling(2.0 * math.sqrt(0.5), 71, "point")
    assert part_of(sg.Sampling(2.0, 1), 0.25).rows == 1


def test_rows_extend_over_a_higher_aperture():
    """Rows stay as dense in the tangent of elevation: tan 20° / tan 10° = 2.0642 times as many."""
    sonar = sg.load_sonar("p900-45")
    higher = replace(sonar, elevation_fov_deg=40.0)
    assert extend_rows(sg.Sampling(2.0, 1000), sonar, higher) == sg.Sampling(2.0, 2065)
    assert extend_rows(sg.Sampling(2.0, 1000), sonar, sonar) == sg.Sampling(2.0, 1000)
    assert extend_rows(sg.Sampling(2.0, 16000), sonar, higher) == sg.Sampling(2.0, 16000)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 10), "columns_per_beam must be a number in 0..1024 (got 0)"),
        ((2, 0), "rows must be a whole number in 1..16000 (got 0)"),
        ((2, 10, "mean"), "reducer must be one of footprint, point (got 'mean')"),
    ],
)
def test_sampling_checks_its_arguments(arguments, message):
    with pytest.raises(sg.Error) as caught:
        sg.Sampling(*arguments)
    assert str(caught.value) == message


def test_the_finest_level_of_so_many_samples():
    sonar = sg.load_sonar("p900-45")
    for level in (0, 3, 12):
        n_samples = sampling_at(sonar, level).count(sonar)
        assert (
            level_of(sonar, n_samples)
            == level_of(sonar, sampling_at(sonar, level + 1).count(sonar) - 1)
            == level
        )
    assert level_of(sonar, 0) == 0 and level_of(sonar, 10**12) == FINEST_LEVEL
