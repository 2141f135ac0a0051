"""The coherent echo of specular lobes: Rice-distributed with the diffuse echo about it, where that alone speckles."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from sonar_gl import Acoustics, Body, Scene, Simulator, load_sonar, pose
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


def test_without_speckle_neither_the_part_nor_a_texture_matters():
    ping = even_ping(pose=pose(0.2, 0.2))
    noise = Noise(ambient_db=-20.0)
    half = np.full_like(ping.intensity, 0.5)
    part = replace(ping, coherent=half, texture_deviation=half)
    assert (add_noise(part, noise, 1).intensity == add_noise(ping, noise, 1).intensity).all()


def test_the_noisy_ping_has_no_such_part():
    ping = even_ping()
    assert add_noise(replace(ping, coherent=ping.intensity), FRESH, 1).coherent is None


@pytest.mark.slow
def test_a_steel_plate_face_on_is_steady():
    """30 dB above the receiver's noise, the level of steel varies by less than half a decibel.

    To the first order it varies by 10/ln 10 · √(2 D / C), with D the diffuse echo and the noise. The next order of
    D / C, 0.004, and 400 pings, whose standard error of a deviation is 3.5 %, allow SIGMAS of them.
    """
    plate = Body("plate", trimesh.creation.box((0.1, 2, 2)), pose(5, 0, 0), reflectivity="steel")
    sonar = replace(
        load_sonar("p900-45"), n_beams=9, azimuth_fov_deg=2, n_bins=64, range_min_m=4, range_max_m=6
    )
    levels = {}
    for specular in (True, False):
        acoustics = Acoustics.physical(specular=specular)
        with Simulator(Scene([plate]), sonar, acoustics, tolerance=0.05) as simulator:
            levels[specular] = simulator.ping(np.eye(4)).intensity
    at = np.unravel_index(levels[True].argmax(), levels[True].shape)
    whole, diffuse = (levels[specular][at].astype(float) for specular in (True, False))
    tvg = acoustics.tvg(sonar.range_m, sonar)[at[1]]
    noise = Noise(speckle=True, ambient_db=10 * np.log10(whole / tvg) - 30)
    with Simulator(Scene([plate]), sonar, Acoustics.physical(), tolerance=0.05) as simulator:
        found = [simulator.ping(np.eye(4), noise=noise, seed=seed).intensity[at] for seed in range(400)]
    deviation_db = np.std(10 * np.log10(found))
    assert deviation_db < 0.5
    expected = 10 / np.log(10) * np.sqrt(2 * (diffuse + whole / 1000) / (whole - diffuse))
    assert deviation_db == pytest.approx(expected, rel=SIGMAS * 0.035 + 0.004)
