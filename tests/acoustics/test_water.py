"""Absorption and speed of sound against published and independently computed numbers."""

import sys
import warnings
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.acoustics.water import (
    absorption_ainslie_mccolm,
    absorption_francois_garrison,
    sound_speed_mackenzie,
    sound_speed_teos10,
)
from sonar_gl.core.extras import install_command
from tests.support.errors import error_of

WATERS = {  # temperature, salinity, depth, pH: (Francois-Garrison, Ainslie-McColm) dB/m at 450, 900, 1200 kHz
    (10, 0.001, 0, 7): ((0.062939, 0.251750, 0.447554), (0.068514, 0.274052, 0.487203)),
    (4, 8, 0, 7.9): ((0.089070, 0.334412, 0.588766), (0.092410, 0.349167, 0.615370)),
    (10, 35, 0, 8): ((0.109663, 0.299463, 0.495414), (0.115779, 0.322309, 0.535607)),
    (10, 35, 50, 8): ((0.109198, 0.298629, 0.494205), (0.115186, 0.321104, 0.533776)),
    (15, 35, 10, 8.1): ((0.118418, 0.278466, 0.442289), (0.124703, 0.297943, 0.475344)),
    (27, 35, 10, 8.1): ((0.168070, 0.294143, 0.410253), (0.180504, 0.311336, 0.428496)),
    (4, 35, 1000, 7.9): ((0.104244, 0.340498, 0.585262), (0.105971, 0.348256, 0.599281)),
    (-1.5, 30, 0, 8.2): ((0.124807, 0.449698, 0.786541), (0.121418, 0.436188, 0.762537)),
    (22, 40, 200, 8.2): ((0.152985, 0.286573, 0.417668), (0.163002, 0.303326, 0.440009)),
}
AT_720_KHZ = {  # the same at 720 kHz
    (10, 0.001, 0, 7): (0.1611, 0.1754),
    (4, 8, 0, 7.9): (0.2167, 0.2259),
    (10, 35, 0, 8): (0.208645, 0.223461),
    (10, 35, 50, 8): (0.2080, 0.2225),
    (15, 35, 10, 8.1): (0.2023, 0.2155),
    (27, 35, 10, 8.1): (0.2382, 0.2543),
    (4, 35, 1000, 7.9): (0.2272, 0.2320),
    (-1.5, 30, 0, 8.2): (0.2938, 0.2851),
    (22, 40, 200, 8.2): (0.2248, 0.2388),
}
SIX_DIGITS, FOUR_DIGITS = 6e-7, 6e-5  # a little more than half the last printed digit


@pytest.mark.parametrize("water", WATERS)
def test_absorption_in_nine_waters(water):
    frequencies = np.array([450e3, 900e3, 1200e3])
    formulas = absorption_francois_garrison, absorption_ainslie_mccolm
    for formula, at_720_khz, expected in zip(formulas, AT_720_KHZ[water], WATERS[water], strict=True):
        np.testing.assert_allclose(formula(frequencies, *water), expected, rtol=0, atol=SIX_DIGITS)
        assert formula(720e3, *water) == pytest.approx(at_720_khz, rel=0, abs=FOUR_DIGITS)


@pytest.mark.parametrize("absorption_db_m", [None, 0.3])
@pytest.mark.parametrize("frequency_hz", [0, -9e5, np.nan, np.inf])
def test_absorption_at_no_frequency(absorption_db_m, frequency_hz):
    water = sg.Water(absorption_db_m=absorption_db_m)
    with pytest.raises(
        sg.Error, match=r"^frequency_hz must lie in 1\.\.1e\+09 .* give hertz, 900e3 for 900 kHz\)$"
    ):
        water.absorption(frequency_hz)
    with pytest.raises(sg.Error, match=r"^frequency_hz must be a number \(got '9e5'\)$"):
        water.absorption("9e5")


def test_absorption_of_published_examples():
    # documentation of arlpy: 50 kHz over 1 km in its default water, −10.71 dB
    assert absorption_francois_garrison(50e3, 27, 35, 10, 8.1) * 1000 == pytest.approx(10.710333, abs=5e-7)
    # documentation of UnderwaterAcoustics.jl: 100 kHz
    expected = 0.035611359656810865
    assert absorption_francois_garrison(100e3, 27, 35, 10, 8.1) == pytest.approx(expected, rel=1e-14)


def test_the_cold_fit_of_pure_water_includes_20_degrees():
    at, above = absorption_francois_garrison(900e3, np.array([20.0, 20.0 + 1e-9]), 35, 0, 8)
    assert 1e-5 < abs(above / at - 1) < 1e-3  # the two fits differ by 0.03 % there


def test_depth_term_of_ainslie_mccolm_is_divided_by_17_km():
    # without the division 1 km would reduce it by 56 % instead of 5.7 %
    deep, flat = absorption_ainslie_mccolm(900e3, 4, 0, np.array([1000.0, 0.0]), 8)
    assert deep / flat == pytest.approx(np.exp(-1 / 17), rel=1e-12)  # fresh water has no other term


def test_the_formulas_of_absorption_agree_within_10_percent_in_the_upper_sea():
    places = np.linspace(-2, 30, 9), np.linspace(0, 40, 5), np.linspace(0, 1000, 3)
    waters = np.meshgrid(np.geomspace(1e5, 3e6, 16), *places, indexing="ij")
    ratio = absorption_ainslie_mccolm(*waters, 8.0) / absorption_francois_garrison(*waters, 8.0)
    assert np.abs(ratio - 1).max() < 0.1


def test_absorption_broadcasts_its_arguments():
    assert absorption_francois_garrison(np.ones((3, 1)) * 9e5, np.ones(4), 35, 0, 8).shape == (3, 4)


def test_mackenzie_at_published_points():
    assert sound_speed_mackenzie(25, 35, 1000) == pytest.approx(1550.744027, abs=5e-7)
    assert sound_speed_mackenzie(40, 40, 10000) == pytest.approx(1718.773600, abs=5e-7)


def test_mackenzie_and_teos10_agree():
    """For 0..30 °C, salinity 30..40 and depths to 1 km they differ by 0.36 m/s at most."""
    t, s, d = np.meshgrid(np.linspace(0, 30, 31), np.linspace(30, 40, 11), np.linspace(0, 1000, 11))
    difference = np.abs(sound_speed_mackenzie(t, s, d) - sound_speed_teos10(t, s, d))
    assert 0.35 < difference.max() < 0.36
    fresh = np.abs(sound_speed_mackenzie(t, 0.0, d) - sound_speed_teos10(t, 0.0, d))
    assert 0.82 < fresh.max() < 0.85  # Mackenzie's fit does not include fresh water


def test_teos10_at_the_check_values_of_the_toolbox():
    """gsw publishes them for absolute salinity, conservative temperature and pressure."""
    import gsw

    sa = [34.7118, 34.8915, 35.0256, 34.8472, 34.7366, 34.7324]
    ct = [28.7856, 28.4329, 22.8103, 10.2600, 6.8863, 4.4036]
    p = [10, 50, 125, 250, 600, 1000]
    published = [
        1542.426412426373,
        1542.558891663385,
        1530.801535436184,
        1494.551099295,
        1487.622786765,
        1484.271672296,
    ]
    practical = np.array(sa) * 35 / 35.16504  # of the reference ocean
    depth, temperature = -gsw.z_from_p(p, 45.0), gsw.t_from_CT(sa, ct, p)
    np.testing.assert_allclose(
        sound_speed_teos10(temperature, practical, depth), published, rtol=0, atol=1e-6
    )


def test_acoustics_uses_the_chosen_formulas():
    mackenzie = sg.Water(temperature_c=12.0, salinity_psu=33.0, depth_m=40.0)
    teos10 = replace(mackenzie, sound_speed_formula="teos10")
    assert mackenzie.sound_speed() == sound_speed_mackenzie(12, 33, 40)
    assert teos10.sound_speed() == sound_speed_teos10(12, 33, 40) != mackenzie.sound_speed()
    assert sg.Water(sound_speed_m_s=1450, sound_speed_formula="teos10").sound_speed() == 1450
    settings = (12.0, 33.0, 40.0, 8.0)
    assert mackenzie.absorption(9e5) == absorption_francois_garrison(9e5, *settings)
    short = replace(mackenzie, absorption_formula="ainslie_mccolm")
    assert short.absorption(9e5) == absorption_ainslie_mccolm(9e5, *settings)
    assert sg.Water(absorption_db_m=0.1, absorption_formula="ainslie_mccolm").absorption(9e5) == 0.1


def test_teos10_without_gsw_is_an_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsw", None)  # as if it were not installed
    assert error_of(sg.Water(sound_speed_formula="teos10").sound_speed) == (
        'sound_speed_formula "teos10" needs gsw, "mackenzie" does not (got no module gsw); to add it: '
        + install_command("teos10")
    )
    assert sg.Water().sound_speed() == pytest.approx(1490, abs=0.1)


NEGATIVE_ABSORPTION = (
    "absorption_db_m must lie in 0..100000 (got -0.3; give dB per metre one way, a thousandth of dB per km)"
)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"temperature_c": 283}, "temperature_c must lie in -2..40 (got 283; give °C)"),
        ({"temperature_c": None}, "temperature_c must be a number (got None)"),
        ({"salinity_psu": -1}, "salinity_psu must lie in 0..45 (got -1;"),
        ({"depth_m": -5}, "depth_m must lie in 0..12000 (got -5;"),
        ({"ph": 0}, "ph must lie in 7..9 (got 0; sea water has about 8)"),
        ({"ph": float("nan")}, "ph must lie in 7..9 (got nan; sea water has about 8)"),
        ({"absorption_db_m": -0.3}, NEGATIVE_ABSORPTION),
        ({"sound_speed_m_s": True}, "sound_speed_m_s must be a number (got True)"),
        ({"sound_speed_m_s": 1.5}, "sound_speed_m_s must lie in 1000..2000 (got 1.5;"),
        ({"absorption_formula": "thorp"}, "unknown absorption_formula (got 'thorp';"),
        ({"sound_speed_formula": "teos"}, "unknown sound_speed_formula (got 'teos'; did you mean 'teos10'?)"),
    ],
)
def test_fields_are_checked(settings, message):
    for make in (lambda: sg.Water(**settings), lambda: sg.Water(ph=7.9).changed(settings)):
        assert error_of(make).startswith(f"water: {message}")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"absorption_db_m": 300},
            "absorption_db_m = 300 takes 600 dB from an echo at 1 m; if it is in dB per km, give 0.3",
        ),
        (
            {"salinity_psu": 0.035},
            "salinity_psu = 0.035 is fresh water; if it is in kilograms per kilogram, give 35",
        ),
    ],
)
def test_numbers_of_other_units_are_warned_of(settings, message):
    for make in (lambda: sg.Water(**settings), lambda: sg.Water(ph=7.9).changed(settings)):
        with pytest.warns(UserWarning) as caught:
            make()
        assert [str(one.message) for one in caught] == [f"water: {message}"]
        assert [one.filename for one in caught] == [__file__]


def test_usual_and_unusual_waters_give_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for settings in ({}, {"salinity_psu": 0.0}, {"salinity_psu": 0.3}, {"absorption_db_m": 10.0}):
            sg.Water(**settings)


def test_water_is_a_value():
    water = sg.Water(temperature_c=4.0, salinity_psu=8.0)
    assert water == sg.Water.parse("temperature_c=4,salinity_psu=8") == sg.Water().changed(vars(water))
    assert hash(water) == hash(replace(water)) and water != sg.Water()
    with pytest.raises(FrozenInstanceError):
        water.temperature_c = 5.0
