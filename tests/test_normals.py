"""Normals from a table: as far from the true ones as is said, and as independent as their bits."""

import math
from statistics import NormalDist

import numpy as np
import pytest

from sonar_gl.normals import BLOCK, _invert, _table, add_normal, standard_normal

SIGMAS = 5.0  # a tolerance of so many standard errors is missed by chance once in 1.7 million


def generator(seed=1):
    return np.random.Generator(np.random.SFC64(seed))


def inverted(bits):
    out = np.empty(len(bits), np.float32)
    _invert(np.asarray(bits, np.int32), *_table(), out)
    return out


def test_table_against_the_inverse_of_the_distribution():
    """From the middle to the last number of the tail, all octaves of probability alike."""
    rng = np.random.default_rng(0)
    u = np.concatenate([np.arange(1, 3000, 2), (2 ** (31 * rng.random(20_000))).astype(np.int64) | 1])
    wanted = np.array([-NormalDist().inv_cdf(n / 2**32) for n in u.tolist()])
    # straight lines over 1/64 octave: (1/64)^2 / 8 of the second derivative by octaves, which is below 0.6
    assert np.abs(inverted(u) - wanted).max() < 2e-5
    assert (inverted(u - 2**31) == -inverted(u)).all()  # the highest bit is the sign
    assert inverted([0, 1, 2**31 - 1, -(2**31), -1]) == pytest.approx(
        [6.2303, 6.2303, 0, -6.2303, 0], abs=1e-4
    )


def test_distribution():
    n = 5_000_000
    draws = standard_normal(generator(), n)
    assert draws.dtype == np.float32 and np.isfinite(draws).all()
    draws = draws.astype(np.float64)
    assert draws.mean() == pytest.approx(0, abs=SIGMAS / math.sqrt(n))
    assert draws.var() == pytest.approx(1, abs=SIGMAS * math.sqrt(2 / n))
    assert (draws**3).mean() == pytest.approx(0, abs=SIGMAS * math.sqrt(15 / n))
    assert (draws**4).mean() == pytest.approx(3, abs=SIGMAS * math.sqrt(96 / n))
    for x in (-4.5, -3, -2, -1, -0.1, 0.0, 0.01, 0.5, 1.5, 2.5, 3.5, 4.5):  # far tails too
        p = NormalDist().cdf(-x)
        assert (draws > x).mean() == pytest.approx(p, abs=SIGMAS * math.sqrt(p * (1 - p) / n))


def test_neighbours_are_strangers():
    """Two normals come of one number of 64 bits."""
    draws = standard_normal(generator(2), 4_000_000).astype(np.float64)
    for a, b in ((draws[::2], draws[1::2]), (draws[1:-1:2], draws[2::2])):
        for power in (1, 2):
            x, y = a**power, b**power
            assert abs(np.corrcoef(x, y)[0, 1]) < SIGMAS / math.sqrt(len(x))


def test_added_and_cut_at_0():
    for count in (1, 5, 1024, 1025, 3 * BLOCK + 7):
        out = np.full((count, 1), 0.5, np.float32)
        add_normal(generator(), 0.4, out)
        random = generator()
        normals = [standard_normal(random, min(BLOCK, count - k)) for k in range(0, count, BLOCK)]
        wanted = np.maximum(0.5 + np.float32(0.4) * np.concatenate(normals), 0)
        np.testing.assert_allclose(out[:, 0], wanted, rtol=0, atol=1e-6)  # float32, perhaps fused


def test_shapes_and_the_same_seed():
    for shape in (0, 1, 7, (3, 5), (2, 0), (4, 4, 4)):
        first, second = standard_normal(generator(), shape), standard_normal(generator(), shape)
        assert first.shape == np.empty(shape).shape and (first == second).all()
    random = generator()
    assert (standard_normal(random, 8) != standard_normal(random, 8)).all()
