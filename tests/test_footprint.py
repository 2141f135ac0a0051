"""The compiled sums against plain NumPy: the distribution of 1/r over a rectangle, cut into bins."""

import numpy as np
import pytest

from sonar_gl.footprint import spread_footprint
from sonar_gl.reduce import bin_tables, weigh_columns

EDGES = np.linspace(0.5, 30.5, 301)


def spread(s, a, b, energy=1.0, edges=EDGES):
    sums = np.zeros((3, len(edges) - 1), np.float32)
    tables, flat = bin_tables(edges)
    per_metre = (len(edges) - 1) / (edges[-1] - edges[0])
    spread_footprint(sums, 1, tables, flat, edges[0], per_metre, energy, s, a, b)
    assert not sums[0].any()
    assert not sums[2].any()
    return sums[1].astype(float)


def brute(s, a, b, edges=EDGES, n=4000):
    """Energy s ds by a fine grid over the rectangle; beyond the horizon (s <= 0) there is nothing."""
    t = (np.arange(n) + 0.5) / n * 2 - 1
    values = (s + a * t[:, None] + b * t[None, :]).ravel()
    values = values[values > 0]
    return np.histogram(1 / values, bins=edges, weights=values)[0] / n**2


@pytest.mark.parametrize(
    "s, a, b",
    [
        (0.103, 1e-9, 1e-9),  # facing: one bin
        (0.103, 0.0, 0.0),
        (0.1, 0.02, 0.0),  # a box
        (0.1, 0.0, 0.02),  # which way round does not matter
        (0.1, 0.02, 0.01),  # a trapezoid
        (0.1, 0.015, 0.015),  # a triangle
        (0.04, 0.03, 0.004),  # past the last bin
        (0.5, 1.2, 0.0),  # from before the first bin
        (0.3, 0.25, 0.04),
    ],
)
def test_spread_is_the_distribution_over_the_rectangle(s, a, b):
    got, want = spread(s, a, b), brute(s, a, b)
    if s - a - b <= 0:
        # a plane cut by its horizon: what the middle saw is spread over the part in view
        inside = np.linspace(-1, 1, 2001)
        visible = np.clip(s + a * inside[:, None] + b * inside[None, :], 0, None).mean()
        want *= s / visible
    np.testing.assert_allclose(got.sum(), want.sum(), rtol=2e-3)
    # 1 %: the grid of the brute force; ramps shorter than a quarter of the box are drawn as steps, which
    # moves thin / (2 wide) of a lone sample's energy, and none of a row of samples whose ramps overlap
    thin, wide = min(a, b), max(a, b, 1e-12)
    steps = thin / wide / 2 if 4 * thin < wide else 0.0
    assert np.abs(got - want).sum() <= (0.01 + steps) * want.sum()


def test_energy_is_kept_whatever_the_footprint():
    rng = np.random.default_rng(0)
    for _ in range(300):
        s = 1 / rng.uniform(2, 25)
        a, b = s * 0.05 * rng.random(2) ** 3
        assert spread(s, a, b).sum() == pytest.approx(s, rel=1e-5)  # all bins in range: s ∫ p = s


def test_nothing_lands_outside_the_bins():
    for s in (1 / 40.0, 1 / 0.4, 10.0):
        assert not spread(s, 1e-4, 1e-5).any()
    assert spread(1 / EDGES[0] * (1 - 1e-9), 0.0, 0.0).argmax() == 0
    assert spread(1 / EDGES[-1] * (1 + 1e-9), 0.0, 0.0).argmax() == 299


def test_neighbouring_rows_leave_neither_gap_nor_ring():
    """A grazing floor seen row by row: footprints tile, and their sum is smooth to the float."""
    h, rows = 3.0, np.linspace(-0.02, -0.16, 60)
    half = (rows[0] - rows[1]) / 2
    total = np.zeros(len(EDGES) - 1)
    for v in rows:
        total += spread(-v / h, 0.0, half / h, energy=1.0)
    inner = (EDGES[1:] < 29) & (EDGES[:-1] > h / 0.16 + 0.2)
    want = -np.diff(1 / EDGES**2) / 2 * h / (2 * half)
    np.testing.assert_allclose(total[inner], want[inner], rtol=1e-4)


def test_weigh_columns_is_a_matrix_product_round_the_circle():
    rng = np.random.default_rng(1)
    sums = rng.random((7, 11), np.float32)
    first, weights = np.array([-2, 0, 5]), rng.random((3, 4), np.float32)
    out = np.empty((3, 11), np.float32)
    weigh_columns(sums, first, weights, out)
    dense = np.zeros((3, 7))
    for b in range(3):
        for w in range(4):
            dense[b, (first[b] + w) % 7] += weights[b, w]
    np.testing.assert_allclose(out, dense @ sums, rtol=1e-5)
