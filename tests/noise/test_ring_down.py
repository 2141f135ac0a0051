"""Ring-down near the head and dropped beams: closed forms, steadiness, and what they leave alone."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.terms import price
from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.sonar.sonar_files import presets
from tests.support.even_ping import even_ping

RINGING = {"ring_down_db": 10.0, "ring_down_decay_db_m": 20.0, "self_noise_db": -300.0}
SELF_NOISE = sg.Noise(self_noise=True)
EPSILON = np.finfo(np.float32).eps


def ringing_ping(level=0.0, **acoustics):
    ping = even_ping(16, 200, level=level, **acoustics)
    return replace(ping, sonar=replace(ping.sonar, **RINGING))


def test_it_decays_by_so_many_db_per_metre_and_passes_the_tvg():
    settings = {"range_law": "sonar_equation", "tvg_k": 20.0, "tvg_absorption_db_m": 0.5}
    ping = ringing_ping(**settings)
    out = add_noise(ping, SELF_NOISE, seed=1).intensity
    r = ping.range_m
    expected_db = 10.0 - 20.0 * r + 20 * np.log10(r) + 2 * 0.5 * r
    # float32, and 10**x of float64 exponents: a few roundings
    np.testing.assert_allclose(out, np.tile(10 ** (expected_db / 10), (16, 1)), rtol=4 * EPSILON)
    flat = add_noise(ringing_ping(), SELF_NOISE, seed=1).intensity  # range law "constant": no TVG
    np.testing.assert_allclose(flat[3], 10 ** (1 - 2 * r), rtol=4 * EPSILON)


@pytest.mark.parametrize("speckle", [True, False])
def test_it_is_steady_has_no_speckle_and_leaves_the_other_terms_as_they_are(speckle):
    noise = sg.Noise(speckle=speckle, self_noise=True)
    ping = ringing_ping(level=1e-3)
    ping = replace(ping, sonar=replace(ping.sonar, self_noise_db=-30.0))
    silent = replace(ping, sonar=replace(ping.sonar, ring_down_db=None))
    for seed in (1, 2):
        added = np.float64(add_noise(ping, noise, seed).intensity) - add_noise(silent, noise, seed).intensity
        # rounding of the sums in float32, whose values are below 0.2
        np.testing.assert_allclose(added, np.tile(10 ** (1 - 2 * ping.range_m), (16, 1)), atol=0.2 * EPSILON)


def test_no_preset_has_a_ring_down():
    ringing = [name for name, sonar in presets().items() if sonar.ring_down_db is not None]
    assert ringing == [], "name a preset here whose document states its ringing"


def test_it_is_self_noise_and_of_sonars_that_state_it():
    ping = ringing_ping()
    assert add_noise(ping, sg.Noise(speckle=True), seed=1).intensity.max() == 0
    assert sg.load_sonar("p900-45,ring_down_db=-5").ring_down_db == -5
    with pytest.raises(Error, match="ring_down_decay_db_m must lie in"):
        sg.load_sonar("p900-45,ring_down_db=0,ring_down_decay_db_m=0")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no echo came back")
@pytest.mark.usefixtures("timed_once")
def test_plan_prices_it_with_the_receiver_noise():
    """Likewise the noise that channels have in common."""
    sonar = sg.Sonar("small", 900e3, 16, 60, 40.0, 16.0, 2.0, 0.5, 6.5)
    ball = sg.Scene([sg.Body("ball", trimesh.creation.icosphere(2, 0.5), sg.pose(4, 0, 0))], sg.pose())
    found = []
    for one in (replace(sonar, ring_down_db=60.0), replace(sonar, common_noise_db=60.0), sonar):
        found += [p for p in price(ball, one, 0.05) if p.name == "receiver noise"]
    assert [one.changes > 0.9 for one in found] == [True, True, False] and found[2].changes < 0.1


def test_dropped_beams_are_dark_and_the_others_stay():
    ping = even_ping(1000, 4, level=0.5)
    noise = sg.Noise(speckle=True, dropped_beams=0.1)
    out = add_noise(ping, noise, seed=5).intensity
    whole = add_noise(ping, replace(noise, dropped_beams=0.0), seed=5).intensity
    dark = (out == 0).all(axis=1)
    np.testing.assert_array_equal(out[~dark], whole[~dark])
    assert dark.sum() == pytest.approx(100, abs=5 * np.sqrt(1000 * 0.1 * 0.9))  # 5 standard errors
    again = add_noise(ping, noise, seed=5, ping_number=1).intensity
    assert ((again == 0).all(axis=1) != dark).any()  # another ping drops others
    assert (add_noise(ping, sg.Noise(dropped_beams=1.0), seed=5).intensity == 0).all()
    assert sg.Noise.parse("dropped_beams=0.02").dropped_beams == 0.02
    with pytest.raises(Error, match="dropped_beams must lie in 0"):
        sg.Noise(dropped_beams=1.5)
