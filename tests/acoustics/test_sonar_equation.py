"""The reverberation of a flat floor against the sonar equation; ranges shown with a wrong speed of sound.

The reverberation level of a floor, received and after the TVG, against that at the first range (Urick,
Principles of Underwater Sound, 3rd ed., 1983, chapters 2 and 8):

    RL(r) = −40 log r − 2 α r + S_b + 10 log A + TVG + 2 B

with Lambert's S_b = 20 log sin(grazing) + const., A = r ΔΨ Δr, TVG = k log r + 2 α_tvg r, and B the one-way
beam pattern at the floor's depression, where the beam is not a box.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from tests.support.settings import described

WITHIN_DB = 0.1
RANGES_M, HEIGHT_M, HALF_M = (5.0, 10.0, 20.0, 50.0), 2.0, 400.0
ABSORPTION_DB_M = {450e3: 0.109663, 900e3: 0.299463}  # Francois-Garrison at 10 °C, 35, 0 m, pH 8
ONE_WAY_AT_EDGE_DB = 10 * np.log10(0.5) / 2  # a transmitter and a receiver alike make −3 dB
CASES = {  # name: frequency, elevation aperture, settings; the aperture is a box unless they say otherwise
    "no TVG": (450e3, 60.0, {"tvg_k": 0.0, "tvg_absorption_db_m": 0.0}),
    "no TVG, 900 kHz": (900e3, 60.0, {"tvg_k": 0.0, "tvg_absorption_db_m": 0.0}),
    "20 log r + 2αr": (450e3, 60.0, {"tvg_k": 20.0}),
    "30 log r + 2αr": (450e3, 60.0, {"tvg_k": 30.0}),
    "40 log r + 2αr": (900e3, 60.0, {"tvg_k": 40.0}),
    "TVG for fresh water": (900e3, 60.0, {"tvg_k": 30.0, "tvg_absorption_db_m": 0.25}),
    "boxes in azimuth": (900e3, 60.0, {"beam_pattern": "box"}),
    "Taylor, projector": (900e3, 60.0, {"receive_taper": "taylor", "transmit_width_deg": 40.0}),
    "line array upright": (900e3, 30.0, {"elevation_pattern": "line_array"}),
    "line array, no TVG": (
        450e3,
        30.0,
        {"elevation_pattern": "line_array", "tvg_k": 0.0, "tvg_absorption_db_m": 0.0},
    ),
    "Gaussian upright": (450e3, 30.0, {"elevation_pattern": "gaussian", "tvg_k": 40.0}),
}
# others have the settings of these
SLOW_CASES = set(CASES) - {"no TVG", "TVG for fresh water", "Taylor, projector", "line array upright"}


def expected_db(frequency_hz, aperture_deg, settings) -> np.ndarray:
    """Return the level by the sonar equation at RANGES_M, (4,) dB relative to the first range."""
    r, alpha = np.array(RANGES_M), ABSORPTION_DB_M[frequency_hz]
    sine = HEIGHT_M / r  # of grazing, and of depression
    level = -40 * np.log10(r) - 2 * alpha * r + 20 * np.log10(sine) + 10 * np.log10(r)
    level += settings.get("tvg_k", 20.0) * np.log10(r) + 2 * settings.get("tvg_absorption_db_m", alpha) * r
    share = sine / np.sin(np.radians(aperture_deg / 2))
    pattern = settings.get("elevation_pattern")
    if pattern == "gaussian":
        level += 2 * ONE_WAY_AT_EDGE_DB * share**2
    if pattern == "line_array":
        at_edge = 0.318917  # sinc⁴ of it is 1/2: 0.637833 λ/L wide
        level += 40 * np.log10(np.sinc(at_edge * share))
    return level - level[0]


def measured_db(frequency_hz, aperture_deg, settings) -> np.ndarray:
    """Return the level of a ping's beams, (9, 4) dB, each relative to its first range."""
    bins = 505
    sonar = sg.Sonar("floor", frequency_hz, 9, bins, 45.0, aperture_deg, 2.0, 2.05, 2.05 + 0.1 * bins)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * HALF_M
    floor = sg.Body("floor", trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))
    settings = {"water": sg.Water(depth_m=0.0), "elevation_pattern": "box"} | settings
    sonar, acoustics = described(sonar, **settings)
    with sg.Simulator(sg.Scene([floor]), sonar, acoustics, tolerance=0.003) as simulator:
        ping = simulator.ping(sg.pose(0, 0, HEIGHT_M))
    at = [np.abs(ping.range_m - r).argmin() for r in RANGES_M]
    level = 10 * np.log10(ping.intensity[:, at].astype(float))
    return level - level[:, :1]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW_CASES else ()) for name in CASES]
)
def test_reverberation_of_a_floor_follows_the_sonar_equation(name):
    measured, expected = measured_db(*CASES[name]), expected_db(*CASES[name])
    np.testing.assert_allclose(measured, np.broadcast_to(expected, measured.shape), rtol=0, atol=WITHIN_DB)


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
