"""The settings of `Acoustics`, and its range gain against identities."""

import json
import warnings
from dataclasses import FrozenInstanceError, asdict, fields, replace
from functools import partial

import numpy as np
import pytest

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import Water
from sonar_gl.core.errors import Error
from sonar_gl.sonar.sonar_files import load_sonar
from tests.support.errors import error_of


@pytest.fixture
def sonar():
    return load_sonar("p900-45")


def test_a_tvg_that_has_no_effect_is_warned_of():
    """`--profile ideal --acoustics tvg_k=30` changed nothing, without a word."""
    for key in ("tvg_k", "tvg_absorption_db_m"):
        text = f"{key}=1"
        with pytest.warns(
            UserWarning, match=f"{key} has no effect by the range law 'constant' of the profile 'ideal'"
        ):
            found = Acoustics.parse(text, "ideal")
        r, sonar = np.array([1.0, 10.0]), load_sonar("p900-45")
        assert found.range_gain(r, sonar).tolist() == Acoustics.ideal().range_gain(r, sonar).tolist()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            Acoustics.parse(text)
            Acoustics.parse(f"{text},range_law=sonar_equation", "ideal")
            Acoustics.parse("tvg_absorption_db_m=none", "ideal")


def test_an_absorption_of_the_tvg_in_db_per_km_is_warned_of():
    with pytest.warns(UserWarning) as caught:
        Acoustics(tvg_absorption_db_m=300.0)
    assert [str(one.message) for one in caught] == [
        "acoustics: tvg_absorption_db_m = 300 amplifies an echo at 1 m by 600 dB; if it is in dB per km, give 0.3"
    ]
    assert [one.filename for one in caught] == [__file__]


def test_profiles_take_fields_by_name():
    """`Acoustics.ideal(water=...)` raised a bare TypeError, while `Acoustics.physical(water=...)` worked."""
    cold = Water(temperature_c=4.0)
    assert Acoustics.ideal(water=cold) == Acoustics("ideal", water=cold)
    assert Acoustics.demarco2015("constant", water=cold) == Acoustics("demarco2015", "constant", water=cold)
    with pytest.raises(Error, match="temperature_c describes the water"):
        Acoustics.ideal(temperature_c=4.0)


def test_range_gain_of_the_ideal_profile_is_one(sonar):
    assert (Acoustics.ideal().range_gain(sonar.range_m, sonar) == 1).all()
    assert Acoustics.ideal().range_gain(sonar.range_m, sonar).dtype == np.float64


@pytest.mark.parametrize("frequency_hz", [375e3, 900e3, 3000e3])
def test_a_tvg_of_20_log_r_with_the_right_absorption_cancels_the_transmission_loss(sonar, frequency_hz):
    r = np.concatenate([[0.0, 1e-6, 1e-3], np.geomspace(0.1, 1e5, 1000)])
    gain = Acoustics.physical().range_gain(r, replace(sonar, frequency_hz=frequency_hz))
    np.testing.assert_allclose(gain, 1, rtol=0, atol=1e-12)


def test_range_gain_of_the_physical_profile_is_the_sonar_equation(sonar):
    """r^-2 · 10^(−2αr/10) · 10^(TVG/10), term by term."""
    acoustics = Acoustics.physical(water=Water(depth_m=0), tvg_k=33.0, tvg_absorption_db_m=0.25)
    r, alpha = sonar.range_m, 0.299463
    tvg_db = 33.0 * np.log10(r) + 2 * 0.25 * r
    expected = r**-2 * 10 ** (-2 * alpha * r / 10) * 10 ** (tvg_db / 10)
    # α has six digits: 2 · 5e-7 dB/m · 30 m is 7e-6 of the power
    np.testing.assert_allclose(acoustics.range_gain(r, sonar), expected, rtol=7e-6)


def test_range_gain_without_tvg(sonar):
    """The two-way transmission loss of a surface's echo per solid angle is 20 log r + 2αr."""
    acoustics = Acoustics.physical(water=Water(absorption_db_m=0.3), tvg_k=0, tvg_absorption_db_m=0)
    gain_db = 10 * np.log10(acoustics.range_gain(np.array([1.0, 10.0, 50.0]), sonar))
    np.testing.assert_allclose(gain_db, [-0.6, -20 - 6, -33.97940008672037 - 30], rtol=1e-14)


def test_absorption_follows_the_frequency(sonar):
    acoustics = Acoustics.physical(tvg_absorption_db_m=0)
    low, high = (acoustics.range_gain([30.0], replace(sonar, frequency_hz=f))[0] for f in (450e3, 900e3))
    extra_db = 60 * (Water().absorption(900e3) - Water().absorption(450e3))
    assert 10 * np.log10(low / high) == pytest.approx(extra_db, rel=1e-12)
    assert extra_db == pytest.approx(60 * (0.299296 - 0.109570), abs=1e-3)  # at 10 m depth


def test_range_laws_of_demarco2015(sonar):
    r = np.array([0.0, 0.5, 1.0, 10.0, sonar.range_max_m])
    printed = Acoustics.demarco2015().range_gain(r, sonar)
    np.testing.assert_allclose(printed, (r / sonar.range_max_m) ** 2, rtol=1e-15)
    assert (printed[0], printed[-1]) == (0, 1)
    assert Acoustics.demarco2015("constant").range_gain(r, sonar).tolist() == [1, 1, 1, 1, 1]
    inverse = Acoustics.demarco2015(range_law="inverse").range_gain(r, sonar)
    np.testing.assert_allclose(inverse, [1, 1, 1, 0.01, sonar.range_max_m**-2], rtol=1e-15)


def test_the_printed_law_is_a_tvg_of_40_log_r(sonar):
    """Eq. (4) as printed is the sonar equation with a TVG of 40 log r + 2αr, scaled."""
    r = sonar.range_m
    tvg = Acoustics.physical(tvg_k=40).range_gain(r, sonar)
    printed = Acoustics.demarco2015().range_gain(r, sonar)
    np.testing.assert_allclose(printed * sonar.range_max_m**2, tvg, rtol=1e-13)


@pytest.mark.filterwarnings("ignore:.* if it is in dB:UserWarning")
@pytest.mark.filterwarnings("ignore:water. absorption_db_m")
@pytest.mark.parametrize("k", [0, 20, 60])
@pytest.mark.parametrize(("absorption", "assumed"), [(0, 1e5), (1e5, 0), (1e5, 1e5)])
def test_range_gain_is_finite_and_positive_in_float32(sonar, k, absorption, assumed):
    water = Water(absorption_db_m=absorption)
    acoustics = Acoustics.physical(water=water, tvg_k=k, tvg_absorption_db_m=assumed)
    gain = acoustics.range_gain(np.array([0.0, 1e-9, 0.5, 100.0, 1e5]), sonar).astype(np.float32)
    assert np.isfinite(gain).all() and (gain > 0).all()


def test_profiles():
    assert Acoustics() == Acoustics.physical() == Acoustics("physical")
    assert Acoustics("ideal") == Acoustics.ideal()
    assert [a.beam_pattern for a in (Acoustics.ideal(), Acoustics.demarco2015(), Acoustics())] == [
        "box",
        "box",
        "line_array",
    ]
    assert replace(Acoustics.ideal(), beam_pattern="line_array").range_law == "constant"
    with pytest.raises(FrozenInstanceError):
        Acoustics().tvg_k = 30


def test_terms_of_the_profiles():
    for profile, physical in (("ideal", False), ("demarco2015", False), ("physical", True)):
        model = Acoustics(profile)
        assert (model.specular, model.bubbles, model.multipath) == (physical, physical, "none")
        assert (model.pulse, model.transmit_beam) == (physical, physical)
        assert model.elevation_pattern == model.beam_pattern == ("line_array" if physical else "box")
        for name in ("specular", "pulse"):
            assert getattr(Acoustics(profile, **{name: not physical}), name) is not physical
        assert Acoustics(profile, elevation_pattern="gaussian").elevation_pattern == "gaussian"


@pytest.mark.parametrize("assumed", [None, 0.0, 0.4])
def test_range_gain_is_tvg_times_transmission_loss(sonar, assumed):
    acoustics = Acoustics.physical(tvg_k=33.0, tvg_absorption_db_m=assumed)
    r = np.concatenate([[0.0], sonar.range_m])
    without = replace(acoustics, tvg_k=0.0, tvg_absorption_db_m=0.0)
    tvg = acoustics.tvg(r, sonar)
    np.testing.assert_allclose(tvg * without.range_gain(r, sonar), acoustics.range_gain(r, sonar), rtol=1e-12)
    assert (without.tvg(r, sonar) == 1).all()
    assert np.isfinite(acoustics.tvg([1e5], sonar).astype(np.float32)).all()


def test_meta_survives_json():
    acoustics = Acoustics.physical(tvg_k=30.0, water=Water(ph=7.9))
    assert Acoustics(**json.loads(json.dumps(acoustics.meta()))) == acoustics


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"profile": "phisical"}, "unknown profile (got 'phisical'; did you mean 'physical'?)"),
        ({"profile": None}, "unknown profile (got None; known are demarco2015, ideal, physical)"),
        ({"range_law": "print"}, "unknown range_law (got 'print'; did you mean 'printed'?)"),
        ({"beam_pattern": "dot"}, "unknown beam_pattern (got 'dot'; known are box, gaussian, line_array)"),
        ({"tvg_k": 61}, "tvg_k must lie in 0..60 (got 61; usual are 20, 30 and 40)"),
        ({"tvg_k": "20"}, "tvg_k must be a number (got '20')"),
        ({"tvg_k": None}, "tvg_k must be a number (got None)"),
        ({"tvg_absorption_db_m": -0.3}, "tvg_absorption_db_m must lie in 0..100000 (got -0.3;"),
        ({"water": {"temp_c": 4}}, "water: unknown key (got 'temp_c'; did you mean 'temperature_c'?)"),
        ({"water": {"ph": 20}}, "water: ph must lie in 7..9 (got 20; sea water has about 8)"),
        ({"water": 4}, "water must be a Water, or a table such as { temperature_c = 4 } (got 4)"),
        ({"beam_pattern": "boxes"}, "unknown beam_pattern (got 'boxes'; did you mean 'box'?)"),
        ({"elevation_pattern": True}, "unknown elevation_pattern (got True;"),
        ({"multipath": True}, "unknown multipath (got True; known are coherent, incoherent, none)"),
        ({"specular": "yes"}, "specular must be True or False (got 'yes')"),
        ({"bubbles": 1}, "bubbles must be True or False (got 1)"),
        ({"sonar_sound_speed_m_s": 1.5}, "sonar_sound_speed_m_s must lie in 1000..2000 (got 1.5;"),
        ({"pulse": 1}, "pulse must be True or False (got 1)"),
        ({"transmit_beam": "on"}, "transmit_beam must be True or False (got 'on')"),
    ],
)
def test_settings_are_checked(settings, message):
    assert error_of(Acoustics, **settings).startswith(f"acoustics: {message}")


@pytest.mark.parametrize(("old", "new"), [("taper", "receive_taper"), ("bandwidth_hz", "bandwidth_hz")])
def test_fields_that_have_moved_name_their_new_place(old, new):
    where = f"{old} describes the device, and is a field of Sonar now (write it as {new} there: "
    for make in (Acoustics, Acoustics.physical, partial(replace, Acoustics.ideal())):
        assert error_of(make, **{old: 1}).startswith(f"acoustics: {where}")
    assert error_of(Acoustics.parse, f"tvg_k=30,{old}=1").startswith(f"acoustics 'tvg_k=30,{old}=1': {where}")


@pytest.mark.parametrize("name", [field.name for field in fields(Water)])
def test_fields_of_the_water_name_their_new_place(name):
    where = f"{name} describes the water, and is a field of Water now (write it there: water=sonar_gl.Water({name}"
    for make in (Acoustics, Acoustics.physical, partial(replace, Acoustics.ideal())):
        assert error_of(make, **{name: 1}).startswith(f"acoustics: {where}")
    assert error_of(Acoustics.parse, f"tvg_k=30,{name}=1").startswith(
        f"acoustics 'tvg_k=30,{name}=1': {where}"
    )


def test_acoustics_in_other_water_differ_in_nothing_else():
    water = Water(temperature_c=4.0, salinity_psu=8.0)
    acoustics = Acoustics.physical(tvg_k=30.0).in_water(water)
    assert acoustics == Acoustics.physical(tvg_k=30.0, water=water)
    assert acoustics == Acoustics.physical(tvg_k=30.0, water={"temperature_c": 4.0, "salinity_psu": 8.0})
    assert acoustics.in_water(Water()) == Acoustics.physical(tvg_k=30.0)
    assert acoustics.meta()["water"] == asdict(water)


def test_the_range_law_of_demarco2015_is_checked():
    assert error_of(Acoustics.demarco2015, "invers") == (
        "acoustics: unknown range_law (got 'invers'; did you mean 'inverse'?)"
    )


def test_needed_has_moved():
    with pytest.raises(Error, match=r"call sonar_gl\.needed_acoustics with the same arguments"):
        Acoustics.needed("scene", sonar=None, tolerance=0.05)
