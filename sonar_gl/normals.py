"""Normal random numbers by a table of the distribution's inverse, several times as quick as NumPy's own."""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numba import float32, uint64

from sonar_gl.compiled import compiled

# A number's magnitude comes from 31 random bits u, the probability of a larger one being u / 2^31. As a
# float32 u has 31 exponents, and the table this many places for each: so it is as fine in the tail as in the
# middle, and straight lines between its places err by less than 2e-5.
PLACES = 64
_SHIFT = 23 - 6  # what is left of the mantissa, below its 6 bits that count PLACES
_REST, _FIRST = (1 << _SHIFT) - 1, 127 * PLACES  # the exponent of 1 is kept as 127
BLOCK = 16384  # numbers that are drawn at a time: little memory, which is used again


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Magnitudes at the places, and what one step of the rest of the mantissa adds; float32."""
    kept = (_FIRST + np.arange(31 * PLACES + 1)).astype(np.int32) << _SHIFT
    inverse = NormalDist().inv_cdf
    # u is odd and stands for itself and half a step to each side; 2^31 halves the distribution: magnitude 0
    magnitude = np.array([-inverse(u / 2.0**32) for u in kept.view(np.float32).tolist()])
    steps = np.append(np.diff(magnitude) / (1 << _SHIFT), 0.0)
    return magnitude.astype(np.float32), steps.astype(np.float32)


def _bits(random: np.random.Generator, count: int) -> np.ndarray:
    """(count,) int32, each of random bits."""
    return random.bit_generator.random_raw((count + 1) // 2).view(np.int32)[:count]


@compiled
def _invert(bits, magnitude, steps, out):
    """Fill out (N,) float32 with normals, from bits (N,) int32. No branches: signs cannot be foreseen."""
    kept = out.view(np.int32)
    for i in range(uint64(len(out))):
        out[i] = np.float32((bits[i] & 0x7FFFFFFF) | 1)
    for i in range(uint64(len(out))):
        place = uint64((kept[i] >> _SHIFT) - _FIRST)
        size = magnitude[place] + steps[place] * np.float32(kept[i] & _REST)
        out[i] = np.copysign(size, np.float32(bits[i]))


@compiled
def _add(bits, magnitude, steps, sigma, out):
    """Add sigma times normals to out (N,) float32, cut at 0."""
    normals = np.empty(1024, np.float32)  # at a time: they stay in the cache
    for first in range(0, len(out), len(normals)):
        part = out[first : first + len(normals)]
        _invert(bits[first : first + len(normals)], magnitude, steps, normals[: len(part)])
        for i in range(uint64(len(part))):
            part[i] = max(float32(0), part[i] + sigma * normals[i])


def add_normal(random: np.random.Generator, sigma: float, out: np.ndarray) -> None:
    """Add normal random numbers of standard deviation sigma to out, float32 and contiguous; cut at 0."""
    out = out.reshape(-1)
    for first in range(0, len(out), BLOCK):
        part = out[first : first + BLOCK]
        _add(_bits(random, len(part)), *_table(), np.float32(sigma), part)


def standard_normal(random: np.random.Generator, shape) -> np.ndarray:
    """Normal random numbers of mean 0 and variance 1, float32; up to 6.2 in magnitude.

    >>> standard_normal(np.random.Generator(np.random.SFC64(1)), (2, 3)).shape
    (2, 3)
    """
    out = np.empty(shape, np.float32)
    _invert(_bits(random, out.size), *_table(), out.reshape(-1))
    return out
