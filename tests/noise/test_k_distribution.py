"""K-distributed texture: the gamma table, and moments of speckle times texture."""

import numpy as np
import pytest

from sonar_gl.noise.k_distribution import gamma_from_exponential, multiply_by_texture
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.settings import Noise
from tests.support.even_ping import SIGMAS, correlation, even_ping


@pytest.mark.parametrize("shape", [0.1, 0.5, 1.0, 2.0, 10.0, 1000.0])
def test_table_gives_gamma_variates(shape):
    """Quantiles against NumPy's gamma variates; shape 1 is the exponential itself."""
    u = (np.arange(200_000) + 0.5) / 200_000
    out = np.ones((1, len(u)), np.float32)
    multiply_by_texture(out, (-np.log1p(-u)).astype(np.float32)[None], shape)
    out = out[0].astype(np.float64)
    assert out.mean() == pytest.approx(1, rel=2e-3)  # the outermost quantile stands for its whole tail
    assert out.var() * shape == pytest.approx(1, rel=0.01)
    draws = np.sort(np.random.default_rng(0).gamma(shape, 1 / shape, len(u)))
    for q in (0.1, 0.5, 0.9, 0.99):
        probability = np.searchsorted(draws, out[int(q * len(u))]) / len(u)
        assert probability == pytest.approx(q, abs=SIGMAS * np.sqrt(q * (1 - q) / len(u)))
    if shape == 1:
        np.testing.assert_allclose(out, -np.log1p(-u), rtol=3e-4)
    assert np.isfinite(gamma_from_exponential(shape)[0]).all()


@pytest.mark.parametrize("shape", [1.0, 5.0])
def test_moments_of_the_k_distribution(shape):
    noise = Noise(speckle=True, speckle_shape=shape)
    x = add_noise(even_ping(100, 10_000, 2.0), noise, seed=1).intensity.astype(np.float64)
    n = x.size
    assert x.mean() == pytest.approx(1, abs=SIGMAS * np.sqrt((1 + 2 / shape) / n))
    second, fourth = (
        np.prod([1 + j / shape for j in range(m)]) * np.prod(np.arange(1, m + 1)) for m in (2, 4)
    )
    assert second - 1 == pytest.approx(1 + 2 / shape)  # contrast squared
    assert (x**2).mean() == pytest.approx(second, abs=SIGMAS * np.sqrt((fourth - second**2) / n))


def test_texture_leaves_the_speckle_pattern():
    """A texture of contrast 1 % hardly changes the pattern, so both have the same speckle stream."""
    ping = even_ping()
    plain, textured = (
        add_noise(ping, Noise(speckle=True, speckle_shape=shape), seed=1).intensity for shape in (None, 1e4)
    )
    assert correlation(plain, textured) == pytest.approx(1, abs=1e-3)
