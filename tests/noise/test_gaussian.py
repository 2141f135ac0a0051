"""Normal random numbers: accuracy of the table, moments, tails and independence."""

import math
from statistics import NormalDist

import numpy as np
import pytest

from sonar_gl.noise.gaussian import BLOCK, add_normal, inverse_table, normals_from_bits, standard_normal
from tests.support.even_ping import SIGMAS


def generator(seed=1):
    return np.random.Generator(np.random.SFC64(seed))


def inverted(bits):
    out = np.empty(len(bits), np.float32)
    normals_from_bits(np.asarray(bits, np.int32), *inverse_table(), out)
    return out


def test_table_against_the_inverse_distribution():
    """From the middle to the end of the tail, with all octaves of probability sampled alike."""
    rng = np.random.default_rng(0)
    u = np.concatenate([np.arange(1, 3000, 2), (2 ** (31 * rng.random(20_000))).astype(np.int64) | 1])
    expected = np.array([-NormalDist().inv_cdf(n / 2**32) for n in u.tolist()])
    # linear interpolation over 1/64 octave errs by (1/64)²/8 of the second derivative per octave², below 0.6
    assert np.abs(inverted(u) - expected).max() < 2e-5
    assert (inverted(u - 2**31) == -inverted(u)).all()  # the highest bit is the sign
    extremes = inverted([0, 1, 2**31 - 1, -(2**31), -1])
    assert extremes == pytest.approx([6.2303, 6.2303, 0, -6.2303, 0], abs=1e-4)


def test_moments_and_tails():
    n = 2_000_000
    draws = standard_normal(generator(), n)
    assert draws.dtype == np.float32 and np.isfinite(draws).all()
    draws = draws.astype(np.float64)
    assert draws.mean() == pytest.approx(0, abs=SIGMAS / math.sqrt(n))
    assert draws.var() == pytest.approx(1, abs=SIGMAS * math.sqrt(2 / n))
    assert (draws**3).mean() == pytest.approx(0, abs=SIGMAS * math.sqrt(15 / n))
    assert (draws**4).mean() == pytest.approx(3, abs=SIGMAS * math.sqrt(96 / n))
    for x in (-4.5, -3, -2, -1, -0.1, 0.0, 0.01, 0.5, 1.5, 2.5, 3.5, 4.5):
        p = NormalDist().cdf(-x)
        assert (draws > x).mean() == pytest.approx(p, abs=SIGMAS * math.sqrt(p * (1 - p) / n))


def test_neighbouring_numbers_are_independent():
    """One 64-bit random number gives two normals: pairs within it and across it, and their squares."""
    draws = standard_normal(generator(2), 4_000_000).astype(np.float64)
    for a, b in ((draws[::2], draws[1::2]), (draws[1:-1:2], draws[2::2])):
        for power in (1, 2):
            assert abs(np.corrcoef(a**power, b**power)[0, 1]) < SIGMAS / math.sqrt(len(a))


@pytest.mark.parametrize("count", [1, 5, 1024, 1025, 3 * BLOCK + 7])
def test_add_normal_clips_at_0(count):
    out = np.full((count, 1), 0.5, np.float32)
    add_normal(generator(), 0.4, out)
    same = generator()
    normals = [standard_normal(same, min(BLOCK, count - k)) for k in range(0, count, BLOCK)]
    expected = np.maximum(0.5 + np.float32(0.4) * np.concatenate(normals), 0)
    np.testing.assert_allclose(out[:, 0], expected, rtol=0, atol=1e-6)  # float32, perhaps fused multiply-add


@pytest.mark.parametrize("shape", [0, 1, 7, (3, 5), (2, 0), (4, 4, 4)])
def test_shapes_and_the_same_seed(shape):
    first, second = standard_normal(generator(), shape), standard_normal(generator(), shape)
    assert first.shape == np.empty(shape).shape and (first == second).all()


def test_a_generator_continues():
    one = generator()
    assert (standard_normal(one, 8) != standard_normal(one, 8)).all()
