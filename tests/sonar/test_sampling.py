"""Sampling and its levels."""

import math
from dataclasses import replace

import pytest

import sonar_gl as sg
from sonar_gl.sonar.sampling import (
    FINEST_LEVEL,
    check_tolerance,
    extend_rows,
    level_of,
    part_of,
    sampling_at,
    sampling_of_width,
    typical_level,
)


def test_sampling_of_a_width():
    sonar = sg.load_sonar("p900-45")
    aperture_deg = math.degrees(2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2))
    assert sampling_of_width(sonar, 0.2) == sg.Sampling(
        45 / 0.2 / sonar.n_beams, math.ceil(aperture_deg / 0.2)
    )
    # coarse samplings have a least number of columns and rows; fine ones are limited to what Sampling allows
    assert sampling_of_width(sonar, 90.0) == sg.Sampling(24 / sonar.n_beams, math.ceil(aperture_deg / 0.5))
    assert sampling_of_width(replace(sonar, elevation_fov_deg=1.0), 0.2).rows == 16  # not 5
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


def test_four_levels_halve_the_width_of_samples():
    """Level 0 has samples a degree wide; here no bound on columns counts, nor one on the height of rows."""
    sonar = sg.load_sonar("p900-45")
    for level in (0, 4, 8, 20):
        assert sampling_at(sonar, level).columns_per_beam * sonar.n_beams == pytest.approx(
            45 * 2 ** (level / 4)
        )
    per_deg = math.degrees(2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2))
    assert sampling_at(sonar, 20).rows == math.ceil(32 * per_deg)


def test_the_level_that_most_scenes_need_follows_the_error():
    """0.2 degrees do for a tolerance of 2 %, and errors fall as the width of samples to the power of 1.3."""
    assert typical_level(0.02) == round(4 * math.log2(1 / 0.2)) == 9
    for halvings in (-1, 1, 2):
        assert typical_level(0.02 * 2 ** (-1.3 * halvings)) == 9 + 4 * halvings
    assert typical_level(0.5) == 0 and typical_level(0.001) <= FINEST_LEVEL


def test_both_ends_of_the_tolerances_are_allowed():
    for tolerance in (0.001, 0.5):
        assert check_tolerance(tolerance) == tolerance
    for beyond in (math.nextafter(0.001, 0), math.nextafter(0.5, 1)):
        with pytest.raises(sg.Error, match=r"^tolerance must be a number in 0.001..0.5 \(got"):
            check_tolerance(beyond)


def test_columns_are_counted_as_whole_numbers_whatever_their_rounding():
    """0.29 times 100 is less than 29 in double precision."""
    sonar = replace(sg.load_sonar("p900-45"), n_beams=100)
    assert 0.29 * 100 < 29
    assert sg.Sampling(0.29, 7).count(sonar) == 29 * 7
