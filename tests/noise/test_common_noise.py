"""Noise that neighbouring channels have in common: a line ahead with the pattern of a group and the grain of noise."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.receiver import common_noise_pattern
from tests.support.even_ping import BEAM_WIDTH_RAD, SIGMAS, UNIFORM_WIDTH, correlation, even_ping

SELF_NOISE = sg.Noise(self_noise=True)
NOISES = [SELF_NOISE, sg.Noise.physical(), replace(sg.Noise.physical(), follow_motion=False)]
IDS = ["alone", "locked", "fresh"]
LEVEL, WIDTH_DEG, PINGS = 0.01, 6.0, 100


def common_ping(self_noise_db=-300.0, **settings) -> sg.Ping:
    """Return a ping of nothing but this noise, by an odd number of beams."""
    ping = even_ping(n_beams=65, level=0.0, pose=np.eye(4), **settings)
    levels = {"self_noise_db": self_noise_db, "common_noise_db": 10 * math.log10(LEVEL)}
    return replace(ping, sonar=replace(ping.sonar, **levels, common_noise_width_deg=WIDTH_DEG))


def noisy(ping, noise) -> np.ndarray:
    """Return (pings, B, K) float64."""
    return np.array([add_noise(ping, noise, 1, number).intensity for number in range(PINGS)], np.float64)


def group_pattern(azimuth_rad) -> np.ndarray:
    """Return sinc² of a uniform array that is WIDTH_DEG wide."""
    return np.sinc(UNIFORM_WIDTH / 2 * np.sin(azimuth_rad) / math.sin(math.radians(WIDTH_DEG / 2))) ** 2


def test_the_pattern_is_that_of_a_uniform_array_and_none_behind():
    azimuth = np.radians(np.linspace(-90, 90, 181))
    np.testing.assert_allclose(common_noise_pattern(azimuth, WIDTH_DEG), group_pattern(azimuth), atol=1e-12)
    assert common_noise_pattern([-2.0, math.pi, 2.0], WIDTH_DEG).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("noise", NOISES, ids=IDS)
def test_its_power_over_beams_is_the_pattern(noise):
    ping = common_ping()
    of_pings = noisy(ping, noise).mean(2)  # (pings, B): 256 independent bins in each
    expected = LEVEL * group_pattern(ping.azimuth_rad)
    assert expected.max() == LEVEL and expected.min() < 1e-3 * LEVEL
    error = SIGMAS * expected / math.sqrt(PINGS * 256)
    assert (np.abs(of_pings.mean(0) - expected) <= error + 1e-12 * LEVEL).all()


@pytest.mark.slow
@pytest.mark.parametrize("noise", NOISES, ids=IDS)
def test_it_has_the_grain_of_other_noise_and_is_new_in_each_ping(noise):
    """Exponential, beams correlate as sinc² of their distance, and its power adds to that of other self-noise."""
    ping = common_ping(self_noise_db=-20.0)
    ratio = noisy(ping, noise) / (0.01 + LEVEL * group_pattern(ping.azimuth_rad))[:, None]
    cells = PINGS * 256 * 65 / 8  # at least so many are independent
    assert ratio.mean() == pytest.approx(1, abs=SIGMAS / math.sqrt(cells))
    assert (ratio**2).mean() == pytest.approx(2, abs=SIGMAS * math.sqrt(20 / cells))
    for lag in (1, 3):
        apart = UNIFORM_WIDTH * math.radians(0.25 * lag) / BEAM_WIDTH_RAD
        found = correlation(ratio[:, :-lag], ratio[:, lag:])
        assert found == pytest.approx(np.sinc(apart) ** 2, abs=SIGMAS * math.sqrt(8 / cells))
    assert correlation(ratio[:-1], ratio[1:]) == pytest.approx(0, abs=SIGMAS / math.sqrt(cells))


def test_it_passes_through_the_tvg():
    ping = common_ping(range_law="sonar_equation", tvg_k=40.0)
    tvg = ping.acoustics.tvg(ping.range_m, ping.sonar)
    assert tvg[-1] > 100 * tvg[0]
    found = noisy(ping, SELF_NOISE)[:, 32] / (LEVEL * tvg)
    assert found.mean() == pytest.approx(1, abs=SIGMAS / math.sqrt(found.size))


def test_it_is_a_part_of_the_self_noise_and_off_by_default():
    ping = common_ping()
    assert add_noise(ping, sg.Noise(ambient_db=-300.0), 1).intensity.max() < 1e-20
    assert all(sonar.common_noise_db is None for sonar in map(sg.load_sonar, ("p900-45", "oculus-m1200d-hf")))
    assert sg.load_sonar("p900-45,common_noise_db=-70").common_noise_db == -70.0
    with pytest.raises(Error, match="common_noise_db must lie in -300"):
        replace(ping.sonar, common_noise_db=200.0)
    with pytest.raises(Error, match=r"common_noise_width_deg must lie in 0\.001"):
        replace(ping.sonar, common_noise_width_deg=0.0)
