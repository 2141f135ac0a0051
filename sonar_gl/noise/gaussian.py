"""Normal random numbers from a table of the inverse distribution, several times as fast as NumPy's own."""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numba import float32, uint64

from sonar_gl.core.compiled import compiled

# 31 random bits u give the magnitude of a number: a larger one has probability u / 2^31. As a float32, u has
# 31 exponents, and the table has POINTS entries for each. So it is as fine in the tail as in the middle, and
# linear interpolation between entries errs by less than 2e-5.
POINTS = 64
_SHIFT = 23 - 6  # bits of the mantissa below the 6 bits that select one of POINTS
_REST, _FIRST = (1 << _SHIFT) - 1, 127 * POINTS  # float32 stores the exponent of 1 as 127
BLOCK = 16384  # random numbers drawn at a time: a small buffer that stays in the cache


@lru_cache(maxsize=1)
def inverse_table() -> tuple[np.ndarray, np.ndarray]:
    """Return float32 magnitudes at the table's points, and their slopes per unit of the lower mantissa."""
    points = (_FIRST + np.arange(31 * POINTS + 1)).astype(np.int32) << _SHIFT
    inverse = NormalDist().inv_cdf
    # u is odd and stands for itself and half a step to each side; u = 2^31 is the median: magnitude 0
    magnitude = np.array([-inverse(u / 2.0**32) for u in points.view(np.float32).tolist()])
    slopes = np.append(np.diff(magnitude) / (1 << _SHIFT), 0.0)
    return magnitude.astype(np.float32), slopes.astype(np.float32)


def _random_bits(generator: np.random.Generator, count: int) -> np.ndarray:
    """Return (count,) int32 of random bits."""
    return generator.bit_generator.random_raw((count + 1) // 2).view(np.int32)[:count]


@compiled
def normals_from_bits(bits, magnitude, slopes, out):
    """Fill out (N,) float32 with normal numbers from bits (N,) int32.

    There are no branches: a random sign defeats branch prediction.
    """
    point = out.view(np.int32)
    for i in range(uint64(len(out))):
        out[i] = np.float32((bits[i] & 0x7FFFFFFF) | 1)
    for i in range(uint64(len(out))):
        index = uint64((point[i] >> _SHIFT) - _FIRST)
        size = magnitude[index] + slopes[index] * np.float32(point[i] & _REST)
        out[i] = np.copysign(size, np.float32(bits[i]))


@compiled
def _add(bits, magnitude, slopes, sigma, out):
    """Add sigma times normal numbers to out (N,) float32, clipped at 0."""
    normals = np.empty(1024, np.float32)  # small enough to stay in the cache
    for first in range(0, len(out), len(normals)):
        part = out[first : first + len(normals)]
        normals_from_bits(bits[first : first + len(normals)], magnitude, slopes, normals[: len(part)])
        for i in range(uint64(len(part))):
            part[i] = max(float32(0), part[i] + sigma * normals[i])


def add_normal(generator: np.random.Generator, sigma: float, out: np.ndarray) -> None:
    """Add normal random numbers of standard deviation sigma to out, in place; negative sums become 0.

    out : array of any shape, float32, contiguous
    """
    out = out.reshape(-1)
    for first in range(0, len(out), BLOCK):
        part = out[first : first + BLOCK]
        _add(_random_bits(generator, len(part)), *inverse_table(), np.float32(sigma), part)


def standard_normal(generator: np.random.Generator, shape) -> np.ndarray:
    """Return normal random numbers of mean 0 and variance 1: float32, at most 6.2 in magnitude.

    >>> standard_normal(np.random.Generator(np.random.SFC64(1)), (2, 3)).shape
    (2, 3)
    """
    out = np.empty(shape, np.float32)
    normals_from_bits(_random_bits(generator, out.size), *inverse_table(), out.reshape(-1))
    return out
