"""The coherent echo of specular lobes: Rice-distributed with the diffuse echo about it, where that alone speckles."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_gl import pose
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.settings import Noise
from tests.support.even_ping import SIGMAS, even_ping

FRESH = Noise(speckle=True)
LOCKED = Noise(speckle=True, follow_motion=True)
PINGS, CELLS = 40, 64 * 256 // 8  # about so many cells of an even ping are independent: beams overlap by four


def noisy(noise, coherent, pings=PINGS, level=1.0, **parts) -> np.ndarray:
    """Return (pings, B, K) float64 of an echo of this level, of which a part is coherent; each by its own seed."""
    ping = even_ping(pose=pose(0.2, 0.2), level=level)
    parts = {"coherent": coherent} | parts
    ping = replace(ping, **{name: np.full_like(ping.intensity, part) for name, part in parts.items()})
    return np.array([add_noise(ping, noise, seed).intensity for seed in range(pings)], np.float64)


def check_rice(found, coherent, diffuse):
    """Compare the mean and the standard deviation of |√C + √D g|² with C + D and √(2 C D + D²).

    Goodman, Speckle Phenomena in Optics, 2007, section 3.2. The standard error of the mean is σ/√n; that of the
    standard deviation is at most √2 times that of an exponential, √(2/n) σ.
    """
    sigma, n = np.sqrt(2 * coherent * diffuse + diffuse**2), len(found) * CELLS
    assert found.mean() == pytest.approx(coherent + diffuse, abs=SIGMAS * sigma / np.sqrt(n))
    assert found.std() == pytest.approx(sigma, rel=SIGMAS * np.sqrt(2 / n))


@pytest.mark.parametrize("noise", [FRESH, LOCKED], ids=["fresh", "locked"])
@pytest.mark.parametrize("coherent", [0.0, 0.5, 0.99])
def test_intensity_is_rice_distributed(noise, coherent):
    check_rice(noisy(noise, coherent), coherent, 1 - coherent)


@pytest.mark.parametrize("noise", [FRESH, LOCKED], ids=["fresh", "locked"])
def test_receiver_noise_adds_its_field(noise):
    """20 dB below the whole echo: 0.01 of power about a coherent echo of 0.99 with 0.01 of diffuse echo."""
    check_rice(noisy(replace(noise, ambient_db=-20.0), 0.99), 0.99, 0.02)


@pytest.mark.parametrize("noise", [FRESH, LOCKED], ids=["fresh", "locked"])
def test_a_wholly_coherent_echo_is_steady(noise):
    # √1² in float32
    np.testing.assert_allclose(noisy(noise, 1.0, 2), 1.0, rtol=3e-7)
    above = noisy(noise, 1.0 + 1e-6, 2)  # rounding may leave the part larger than the whole
    np.testing.assert_allclose(above, 1.0, rtol=2e-6)


def test_looks_average_the_diffuse_echo_alone():
    found, n = noisy(replace(FRESH, looks=4), 0.5), PINGS * CELLS
    sigma = np.sqrt((2 * 0.5 * 0.5 + 0.5**2) / 4)
    assert found.mean() == pytest.approx(1, abs=SIGMAS * sigma / np.sqrt(n))
    assert found.std() == pytest.approx(sigma, rel=SIGMAS * np.sqrt(2 / n))


def test_texture_acts_on_the_diffuse_echo_alone():
    """D is Gamma-distributed with shape ν: its mean square is D² (1 + 1/ν), and that of |g|² is 2."""
    n, shape = PINGS * CELLS, 2.0
    found = noisy(FRESH, 0.5, texture_deviation=0.5 / np.sqrt(shape))
    sigma = np.sqrt(2 * 0.5 * 0.5 + 0.5**2 * (2 * (1 + 1 / shape) - 1))
    assert found.mean() == pytest.approx(1, abs=SIGMAS * sigma / np.sqrt(n))
    # the kurtosis of such a mixture is up to 3 times an exponential's
    assert found.std() == pytest.approx(sigma, rel=SIGMAS * np.sqrt(6 / n))


def test_without_speckle_the_part_does_not_matter():
    ping = even_ping(pose=pose(0.2, 0.2))
    noise = Noise(ambient_db=-20.0)
    part = replace(ping, coherent=np.full_like(ping.intensity, 0.5))
    assert (add_noise(part, noise, 1).intensity == add_noise(ping, noise, 1).intensity).all()


def test_the_noisy_ping_has_no_such_part():
    ping = even_ping()
    assert add_noise(replace(ping, coherent=ping.intensity), FRESH, 1).coherent is None
