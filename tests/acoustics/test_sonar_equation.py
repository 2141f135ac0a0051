"""The reverberation of a flat floor against the sonar equation; ranges shown with a wrong speed of sound."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from tools import sonar_equation

WITHIN_DB = 0.1
# others have the settings of these
SLOW_CASES = set(sonar_equation.CASES) - {
    "no TVG",
    "TVG for fresh water",
    "Taylor, projector",
    "line array upright",
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW_CASES else ())
        for name in sonar_equation.CASES
    ],
)
def test_reverberation_of_a_floor_follows_the_sonar_equation(name):
    case = sonar_equation.CASES[name]
    measured, expected = sonar_equation.measured_db(*case), sonar_equation.expected_db(*case)
    np.testing.assert_allclose(measured, np.broadcast_to(expected, measured.shape), rtol=0, atol=WITHIN_DB)


def test_the_tool_prints_one_row_per_case(capsys, monkeypatch):
    monkeypatch.setattr(sonar_equation, "CASES", dict(list(sonar_equation.CASES.items())[:1]))
    sonar_equation.main()
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == 1 + 1
    assert all(float(row.split()[-2]) < WITHIN_DB for row in rows[1:])


SLOW = sg.Water(sound_speed_m_s=1450.0)
WRONG = {"water": SLOW, "sonar_sound_speed_m_s": 1500.0}
SONAR = sg.Sonar("narrow", 900e3, 5, 480, 1.0, 1.0, 1.0, 2.0, 14.0)


def wall(distance):
    return sg.Scene([sg.Body("wall", trimesh.creation.box((0.002, 50, 50)), sg.pose(distance + 0.001, 0, 0))])


def ping(scene, acoustics, sonar=SONAR):
    with sg.Simulator(scene, sonar, acoustics) as simulator:
        return simulator.ping(np.eye(4))


@pytest.mark.usefixtures("few_first_rays")
@pytest.mark.parametrize("make", [ping, lambda s, a: sg.reference_ping(s, SONAR, np.eye(4), a, 0.05)])
def test_a_wrong_speed_of_sound_scales_ranges(make):
    """A sonar set to 1500 m/s in water of 1450 m/s shows 10 m as 10.345 m, in bins at the ranges of its settings."""
    result = make(wall(10.0), sg.Acoustics.physical(**WRONG))
    shown = 10.0 * 1500 / 1450
    np.testing.assert_allclose(result.range_m, SONAR.range_m, rtol=1e-12)
    assert set(result.intensity.argmax(axis=1)) == {int((shown - 2.0) / SONAR.bin_size_m)}
    assert result.meta["sonar"]["range_max_m"] == SONAR.range_max_m
    assert result.meta["acoustics"]["sonar_sound_speed_m_s"] == 1500.0
    # against the same water and the right setting, only the range gain differs
    right = make(wall(10.0), sg.Acoustics.physical(water=SLOW))
    gain = sg.Acoustics.physical(**WRONG).range_gain(np.array([shown]), SONAR)[0]
    assert result.intensity.sum() / right.intensity.sum() == pytest.approx(gain, rel=2e-3)


@pytest.mark.parametrize("law", ["constant", "printed", "inverse", "sonar_equation"])
def test_range_gain_with_a_wrong_speed_of_sound(law):
    """The transmission loss follows the true range, the TVG the shown range."""
    water = replace(SLOW, absorption_db_m=0.3)
    acoustics = sg.Acoustics.physical(
        range_law=law, tvg_k=30.0, tvg_absorption_db_m=0.2, sonar_sound_speed_m_s=1500.0, water=water
    )
    shown = SONAR.range_m
    true = shown * 1450 / 1500
    expected = {
        "constant": np.ones_like(shown),
        "printed": (shown / SONAR.range_max_m) ** 2,
        "inverse": np.minimum(1, true**-2.0),
        "sonar_equation": true**-2 * 10 ** (-0.06 * true) * shown**3 * 10 ** (0.04 * shown),
    }[law]
    np.testing.assert_allclose(acoustics.range_gain(shown, SONAR), expected, rtol=1e-12)
    if law == "sonar_equation":
        np.testing.assert_allclose(acoustics.tvg(shown, SONAR), shown**3 * 10 ** (0.04 * shown), rtol=1e-12)


def test_the_no_echo_warning_has_shown_ranges():
    with pytest.warns(UserWarning, match=r"lies at 14\.48 m, beyond range_max_m = 14$"):
        ping(wall(14.0), sg.Acoustics.physical(**WRONG))


def test_the_right_speed_of_sound_changes_no_range():
    for settings in (
        {"water": SLOW},
        {"water": SLOW, "sonar_sound_speed_m_s": 1450.0},
    ):
        acoustics = sg.Acoustics.physical(**settings)
        seen = acoustics.true_range_sonar(SONAR)
        assert replace(seen, elevation_fov_deg=SONAR.elevation_fov_deg) == SONAR
        assert ping(wall(10.0), acoustics).intensity.tobytes() == ping(wall(10.0), None).intensity.tobytes()
