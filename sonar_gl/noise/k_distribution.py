"""Texture of the K distribution: the gamma-distributed backscatter of few or patchy scatterers."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled

# The table has POINTS entries per octave of its argument, linearly interpolated, from 2^OCTAVES[0] to
# 2^OCTAVES[1]. The bits of a float32 are the index: its exponent, and the upper 6 bits of its mantissa.
POINTS, OCTAVES = 64, (-30, 6)
SHAPES = 0.05, 1e4  # of texture; a larger one is none
_SHIFT = 23 - 6  # bits of the mantissa below the 6 bits that select one of POINTS
_FIRST = (OCTAVES[0] + 127) * POINTS


@lru_cache(maxsize=64)
def gamma_from_exponential(shape: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the table that maps an exponential variate of mean 1 to a Gamma(shape, 1/shape) one of mean 1.

    Both are exceeded with the same probability, e^-x.

    Returns values, slopes: float32, the gamma variate at x = 2^-30 .. 2^6, 64 points per octave, and its change per
    2^-17 of the distance between two points.
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


@lru_cache(maxsize=4)
def _tables(first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the tables of some levels of the shape ν = 2^(level / 2), stacked."""
    both = zip(*(gamma_from_exponential(2.0 ** (level / 2)) for level in range(first, last + 1)), strict=True)
    values, slopes = (np.stack(tables) for tables in both)
    return values, slopes


@compiled
def _find_ratios(intensity, deviation, smallest, largest):
    """Return the least and the greatest intensity (N,) over deviation (N,) float32 within bounds; 1, 0 if none is."""
    low, high = largest, smallest
    for i in range(uint64(len(intensity))):
        if deviation[i] > 0.0 and intensity[i] > 0.0:
            ratio = min(max(intensity[i] / deviation[i], smallest), largest)
            low, high = min(low, ratio), max(high, ratio)
    return low, high


@compiled
def _multiply(bits, deviation, values, slopes, first_level, largest, out):
    """Multiply out (N,) float32 by the tables' values at exponential variates, given as float32 bits (N,).

    deviation : (N,) float32
    values, slopes : (L, n) of levels
    first_level : the first of the levels
    largest : ratio of out to deviation from which on there is no texture
    """
    last, rest, top = values.shape[1] - 1, (1 << _SHIFT) - 1, values.shape[0] - 1
    for i in range(uint64(len(out))):
        if deviation[i] <= 0.0 or out[i] <= 0.0:
            continue
        ratio = out[i] / deviation[i]
        if ratio >= largest:
            continue
        level = min(max(4.0 * math.log2(ratio) - first_level, 0.0), float(top))
        lower = min(int(level), top - 1)
        share, within = np.float32(level - lower), np.float32(bits[i] & rest)
        index = min(max((bits[i] >> _SHIFT) - _FIRST, 0), last)
        below = values[lower, index] + slopes[lower, index] * within
        above = values[lower + 1, index] + slopes[lower + 1, index] * within
        out[i] *= below + share * (above - below)


def multiply_by_texture(intensity: np.ndarray, exponential: np.ndarray, deviation: np.ndarray) -> None:
    """Multiply intensity, in place, by a Gamma(ν, 1/ν) texture; times speckle it is K-distributed.

    intensity : (B, K) float32, contiguous
    exponential : (B, K) float32, contiguous, of mean 1: |g|² of a complex Gaussian field, whose correlation
        between bins the texture takes over
    deviation : (B, K) float32, contiguous, standard deviation of the product, so that ν is the square of intensity over
        deviation, within SHAPES; 0 for no texture. Speckle times texture has contrast √(1 + 2/ν), to 0.4 %: tables
        of two shapes are interpolated

    Source: Jakeman, Pusey, "A model for non-Rayleigh sea echo", IEEE Trans. Antennas Propag. 24, 806-814, 1976;
    Abraham, Lyons, "Novel physical interpretations of K-distributed reverberation", IEEE J. Oceanic Eng. 27, 800-813,
    2002
    """
    smallest, largest = (np.float32(math.sqrt(shape)) for shape in SHAPES)
    flat, deviation = intensity.reshape(-1), deviation.reshape(-1)
    low, high = _find_ratios(flat, deviation, smallest, largest)
    if low > high:
        return
    first_level = math.floor(4 * math.log2(low))
    tables = _tables(first_level, max(math.ceil(4 * math.log2(high)), first_level + 1))
    bits = exponential.view(np.int32).reshape(-1)
    _multiply(bits, deviation, *tables, first_level, largest, flat)
