"""Statistics of sonar pictures in counts, for comparing pictures of different sonars.

A picture is (B, K), beams and bins. A display law gives counts that go as a power of the intensity.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

WINDOW = 31  # beams and bins over which a local mean is taken: wider than speckle, narrower than the scene
SERIES_TERMS = 200  # of the hypergeometric series, whose terms fall faster than n^-2


class Moments(NamedTuple):
    """Mean over standard deviation, and skewness, of some counts."""

    mean_per_std: float
    skewness: float


def flattened(counts: np.ndarray) -> np.ndarray:
    """Return a picture divided by its local mean, (B, K) float64: the scene's levels vanish, grain stays."""
    counts = np.asarray(counts, np.float64)
    mean = cv2.blur(counts, (WINDOW, WINDOW))
    return counts / np.maximum(mean, np.finfo(np.float64).tiny)


def moments(values: np.ndarray) -> Moments:
    """Return the moments of values of any shape.

    >>> moments(np.array([1.0, 1.0, 4.0])).skewness.round(4)
    0.7071
    """
    std = values.std()
    return Moments(values.mean() / std, ((values - values.mean()) ** 3).mean() / std**3)


def correlation(one: np.ndarray, other: np.ndarray, region: np.ndarray, beams: int = 0, bins: int = 0):
    """Return the correlation of two pictures, the second some beams and bins on, over a region.

    Parameters
    ----------
    one, other : (B, K)
    region : (B, K) bool; both of a pair of numbers lie in it
    """
    B, K = region.shape
    near, far = np.s_[: B - beams, : K - bins], np.s_[beams:, bins:]
    both = region[near] & region[far]
    return float(np.corrcoef(one[near][both], other[far][both])[0, 1])


def binary_patterns(counts: np.ndarray) -> np.ndarray:
    """Return the number of the uniform local binary pattern about each inner count, (B − 2, K − 2) uint8.

    Of eight neighbours in a circle each is a 1 if it is at least as bright as the middle. The 58 patterns with at
    most two changes around the circle have numbers of their own, and all others have one.

    Source: Ojala, Pietikäinen, Mäenpää, "Multiresolution gray-scale and rotation invariant texture classification
    with local binary patterns", IEEE Trans. Pattern Anal. 24, 971-987, 2002; with neighbours on the grid.
    """
    B, K = counts.shape
    code = np.zeros((B - 2, K - 2), np.uint8)
    circle = ((0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0))
    for bit, (b, k) in enumerate(circle):
        code |= (counts[b : B - 2 + b, k : K - 2 + k] >= counts[1:-1, 1:-1]).astype(np.uint8) << bit
    codes = np.arange(256)
    changes = codes ^ (codes >> 1 | (codes & 1) << 7)  # against the next neighbour of the circle
    uniform = np.unpackbits(changes.astype(np.uint8)[:, None], axis=1).sum(1) <= 2
    number = np.where(uniform, np.cumsum(uniform) - 1, uniform.sum())
    return number.astype(np.uint8)[code]


def pattern_shares(counts: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return the share of each uniform local binary pattern in a region, (59,) float64.

    Each pattern is counted once more than it occurs, so that no share is 0.
    """
    found = np.bincount(binary_patterns(counts)[region[1:-1, 1:-1]], minlength=59) + 1.0
    return found / found.sum()


def divergence(one: np.ndarray, other: np.ndarray) -> float:
    """Return the Kullback-Leibler divergence Σ p ln(p/q), of shares p = one from shares q = other, in nats.

    >>> round(divergence(np.array([0.5, 0.5]), np.array([0.25, 0.75])), 4)
    0.1438
    """
    one, other = np.asarray(one, np.float64), np.asarray(other, np.float64)
    return float((one * np.log(one / other)).sum())


def law_moments(power: float) -> Moments:
    """Return the moments of counts I^power for fully developed speckle, whose intensity I is exponential.

    E I^(n power) = Γ(1 + n power).

    >>> round(law_moments(0.5).mean_per_std, 4)  # Rayleigh's amplitude
    1.9131
    """
    first, second, third = (math.gamma(1 + n * power) for n in (1, 2, 3))
    variance = second - first**2
    return Moments(first / variance**0.5, (third - 3 * first * second + 2 * first**3) / variance**1.5)


def law_correlation(field_correlation: float, power: float) -> float:
    """Return the correlation of counts I^power of speckle whose complex fields correlate by ρ.

    E I₁^p I₂^p = Γ(1 + p)² ₂F₁(−p, −p; 1; |ρ|²). For p = 1 it is |ρ|².

    Source: Goodman, Speckle Phenomena in Optics, 2007: the joint density of two intensities, whose moments these are

    >>> round(law_correlation(0.5, 1.0), 6)
    0.25
    """
    term, total = 1.0, 0.0
    for n in range(1, SERIES_TERMS):
        term *= ((n - 1 - power) / n) ** 2 * field_correlation**2
        total += term
    first, second = math.gamma(1 + power), math.gamma(1 + 2 * power)
    return first**2 * total / (second - first**2)
