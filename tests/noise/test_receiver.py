"""Receiver noise: levels, the TVG, its sum with echoes; and interference from other sonars."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.receiver import SIDE_LOBES, ambient_noise_db, thermal_noise_db
from sonar_gl.noise.settings import Noise
from tests.support.even_ping import FREQUENCY_HZ, SIGMAS, correlation, even_ping


def noisy(noise, ping) -> np.ndarray:
    return add_noise(ping, noise, seed=1).intensity.astype(np.float64)


def test_thermal_noise_level():
    assert thermal_noise_db(1e3) == -15 and thermal_noise_db(900e3) == pytest.approx(44.085, abs=1e-3)
    # twice the bandwidth is 3.01 dB more, a source louder by 1 dB is 1 dB less
    first, second = ambient_noise_db(900e3, 30e3, 205.0), ambient_noise_db(900e3, 60e3, 206.0)
    assert second - first == pytest.approx(2.0103, abs=1e-4)


@pytest.mark.parametrize("speckle", [True, False])
def test_noise_rises_with_the_tvg(speckle):
    acoustics = Acoustics.physical(tvg_k=30.0)
    ping = even_ping(200, 4000, 2.0, level=0.0, **acoustics.meta())
    r = ping.range_m
    expected = 2e-3 * r**3 * 10 ** (2 * acoustics.water.absorption(FREQUENCY_HZ) * r / 10)
    assert expected[-1] / expected[0] > 1e7  # from 1 to 51 m
    x = noisy(Noise(speckle=speckle, electronic_db=-30.0, ambient_db=-30.0), ping) / expected
    assert x.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(x.size))
    assert x.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / x.size))
    assert x[:, :400].mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(200 * 400))


@pytest.mark.parametrize("law", ["constant", "printed", "inverse"])
def test_other_range_laws_have_no_tvg(law):
    ping = even_ping(200, 1000, 2.0, level=0.0, **Acoustics.physical(range_law=law).meta())
    x = noisy(Noise(electronic_db=-20.0), ping)
    for bins in (slice(0, 500), slice(500, None)):
        assert x[:, bins].mean() == pytest.approx(0.01, rel=SIGMAS / np.sqrt(1e5))


def test_unknown_acoustics_have_no_tvg():
    noise, ping = Noise(electronic_db=-20.0), even_ping(100, 1000, 3.0, level=0.0)
    assert (noisy(noise, replace(ping, acoustics=None)) == noisy(noise, ping)).all()


def test_a_tvg_needs_the_sonar():
    ping = replace(even_ping(**Acoustics.physical().meta()), sonar=None)
    with pytest.raises(Error) as caught:
        add_noise(ping, Noise(electronic_db=-20.0), 0)
    assert str(caught.value) == (
        "noise: the ping must have a sonar for the absorption that its TVG assumes "
        "(got None; pings of a Simulator have one)"
    )


def test_echo_and_noise_add_as_fields():
    """Without speckle the amplitude is Rician: echo E and noise N give mean E + N, variance N² + 2 E N."""
    ping = even_ping(100, 4000, 2.0)
    x = noisy(Noise(electronic_db=-10.0), ping)
    assert x.mean() == pytest.approx(1.1, abs=SIGMAS * np.sqrt(0.21 / x.size))
    assert x.var() == pytest.approx(0.21, rel=SIGMAS * np.sqrt(3 / x.size))
    speckled = noisy(Noise(speckle=True, electronic_db=-10.0), ping)
    assert speckled.mean() == pytest.approx(1.1, rel=SIGMAS / np.sqrt(x.size))
    assert speckled.std() == pytest.approx(1.1, rel=SIGMAS * np.sqrt(2 / x.size))


@pytest.mark.parametrize(
    "noise", [Noise(electronic_db=0.0), Noise(speckle=True, follow_motion=True, electronic_db=0.0)]
)
def test_noise_correlates_between_beams_as_speckle_does(noise):
    x = noisy(noise, even_ping(64, 4000, 0.5, level=0.0, pose=np.eye(4)))
    assert correlation(x[1:], x[:-1]) == pytest.approx(0.5, abs=SIGMAS * 2 / np.sqrt(x.size / 2))


def test_interference():
    noise = Noise(interference_lines=3.0, interference_db=-20.0)
    ping = even_ping(64, 2000, 0.5, level=0.0)
    counts, brightest = [], []
    for number in range(100):
        x = add_noise(ping, noise, 0, number).intensity
        on = (x > 0).any(0)
        # every beam receives it, if only through side lobes
        assert (x[:, on] >= 0.99 * 0.01 * SIDE_LOBES).all() and not x[:, ~on].any()
        counts.append(np.count_nonzero(on))
        brightest.extend(x.max(0)[on].tolist())
    # 100 µs are 6 bins; pulses that overlap count once, those at the ends of the range in part
    assert np.mean(counts) == pytest.approx(18, abs=SIGMAS * 6 * np.sqrt(3 / 100) + 0.2)
    # at most half a spacing off the axis of a beam twice as wide: −0.7 dB
    assert np.median(brightest) == pytest.approx(0.01, rel=0.2) and min(brightest) > 0.008
    first, second = (add_noise(ping, noise, 5, 3).intensity.tobytes() for _ in range(2))
    assert first == second


@pytest.mark.parametrize(
    "noise",
    [
        Noise(electronic_db=100.0),
        Noise(speckle=True, electronic_db=100.0, interference_lines=9, interference_db=100),
    ],
)
def test_loud_noise_stays_finite(noise):
    ping = even_ping(16, 64, **Acoustics.physical(tvg_k=60.0, tvg_absorption_db_m=1e5).meta())
    x = add_noise(ping, noise, 0).intensity
    assert np.isfinite(x).all() and x.max() > 1e25
