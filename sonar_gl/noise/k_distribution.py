"""Texture of the K distribution: the gamma-distributed backscatter of few or patchy scatterers."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled

# The table has POINTS entries per octave of its argument, linearly interpolated, from 2^OCTAVES[0] to
# 2^OCTAVES[1]. The bits of a float32 are the index: its exponent, and the upper 6 bits of its mantissa.
POINTS, OCTAVES = 64, (-30, 6)
_SHIFT = 23 - 6  # bits of the mantissa below the 6 bits that select one of POINTS
_FIRST = (OCTAVES[0] + 127) * POINTS


@lru_cache(maxsize=8)
def gamma_from_exponential(shape: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the table that maps an exponential variate of mean 1 to a Gamma(shape, 1/shape) one of mean 1.

    Both are exceeded with the same probability, e^-x.

    Returns
    -------
    values, slopes : float32, the gamma variate at x = 2^-30 .. 2^6, 64 points per octave, and its change per
        2^-17 of the distance between two points
    """
    points = (np.arange((OCTAVES[1] - OCTAVES[0]) * POINTS + 1) + _FIRST).astype(np.int32) << _SHIFT
    x = points.view(np.float32).astype(np.float64)
    # density over the logarithm of the variate, integrated from each end so that both tails are exact
    low = (np.log(x[0]) + np.log(shape) * 0.5) / min(shape, 1.0) - 30
    grid = np.linspace(low, np.log(shape + 12 * np.sqrt(shape * x[-1]) + 2 * x[-1]), 200_001)
    exponent = shape * grid - np.exp(grid)
    density = np.exp(exponent - exponent.max())
    steps = (density[1:] + density[:-1]) / 2
    below, above = np.append(0.0, np.cumsum(steps)), np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    lower, upper = below / (below + above), above / (below + above)
    with np.errstate(divide="ignore"):  # -log of the probability of exceedance, from the smaller tail
        decay = np.where(lower < upper, -np.log1p(-np.minimum(lower, 0.5)), -np.log(upper))
    known = np.isfinite(decay) & (decay > 0)
    values = np.exp(np.interp(np.log(x), np.log(decay[known]), grid[known])) / shape
    values[-1] = values[-2]
    values = values.astype(np.float32)
    slopes = np.append(np.diff(values) / np.float32(1 << _SHIFT), np.float32(0))
    return values, slopes.astype(np.float32)


@compiled
def _multiply(bits, values, slopes, first, shift, out):
    """Multiply out (N,) float32 by the table's values at exponential variates, given as float32 bits (N,)."""
    last, rest = len(values) - 1, (1 << shift) - 1
    for i in range(uint64(len(out))):
        index = min(max((bits[i] >> shift) - first, 0), last)
        out[i] *= values[index] + slopes[index] * np.float32(bits[i] & rest)


def multiply_by_texture(intensity: np.ndarray, exponential: np.ndarray, shape: float) -> None:
    """Multiply intensity, in place, by a Gamma(shape, 1/shape) texture; times speckle it is K-distributed.

    Parameters
    ----------
    intensity : (B, K) float32, contiguous
    exponential : (B, K) float32, contiguous, of mean 1: |g|² of a complex Gaussian field, whose correlation
        between bins the texture takes over
    shape : ν of the K distribution; speckle times texture has contrast √(1 + 2/ν)

    References
    ----------
    .. [1] Jakeman, Pusey, "A model for non-Rayleigh sea echo", IEEE Trans. Antennas Propag. 24, 806-814, 1976
    .. [2] Abraham, Lyons, "Novel physical interpretations of K-distributed reverberation", IEEE J. Oceanic
       Eng. 27, 800-813, 2002
    """
    table = gamma_from_exponential(float(shape))
    _multiply(exponential.view(np.int32).reshape(-1), *table, _FIRST, _SHIFT, intensity.reshape(-1))
