"""Texture of the K distribution: echoes of few or uneven scatterers, whose speckle is spikier."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import uint64

from sonar_gl.compiled import compiled

PLACES, OCTAVES = 64, (-30, 6)  # of the table: straight lines between 64 places an octave
_SHIFT = 23 - 6  # what is left of a float32's mantissa, below its 6 bits that count PLACES
_FIRST = (OCTAVES[0] + 127) * PLACES


@lru_cache(maxsize=8)
def gamma_from_exponential(shape: float) -> tuple[np.ndarray, np.ndarray]:
    """Table that turns an exponential of mean 1 into a Gamma(shape, 1/shape), also of mean 1; float32.

    Both have the same chance of being exceeded, e^-x; x from 2^-30 to 2^6, 64 places an octave, and what
    a step of 2^-17 of a place adds.
    """
    places = (np.arange((OCTAVES[1] - OCTAVES[0]) * PLACES + 1) + _FIRST).astype(np.int32) << _SHIFT
    x = places.view(np.float32).astype(np.float64)
    # the density over the logarithm of the size, summed from each end, so both tails are exact
    low = (np.log(x[0]) + np.log(shape) * 0.5) / min(shape, 1.0) - 30
    grid = np.linspace(low, np.log(shape + 12 * np.sqrt(shape * x[-1]) + 2 * x[-1]), 200_001)
    decay = shape * grid - np.exp(grid)
    density = np.exp(decay - decay.max())
    steps = (density[1:] + density[:-1]) / 2
    below, above = np.append(0.0, np.cumsum(steps)), np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    share, rest = below / (below + above), above / (below + above)
    with np.errstate(divide="ignore"):  # −log of being exceeded, by whichever tail is the smaller
        chance = np.where(share < rest, -np.log1p(-np.minimum(share, 0.5)), -np.log(rest))
    known = np.isfinite(chance) & (chance > 0)
    found = np.exp(np.interp(np.log(x), np.log(chance[known]), grid[known])) / shape
    found[-1] = found[-2]
    found = found.astype(np.float32)
    slope = np.append(np.diff(found) / np.float32(1 << _SHIFT), np.float32(0))
    return found, slope.astype(np.float32)


@compiled
def _multiply(bits, sizes, slopes, first, shift, out):
    """Multiply out (N,) float32 by the table's values at exponentials, given as the bits of float32."""
    last, rest = len(sizes) - 1, (1 << shift) - 1
    for i in range(uint64(len(out))):
        place = min(max((bits[i] >> shift) - first, 0), last)
        out[i] *= sizes[place] + slopes[place] * np.float32(bits[i] & rest)


def multiply_by_texture(out: np.ndarray, exponential: np.ndarray, shape: float) -> None:
    """Multiply out by the K distribution's texture, a Gamma(shape, 1/shape), so times speckle is K.

    Parameters
    ----------
    out : (B, K) float32, contiguous; exponential : (B, K) float32 of mean 1, a field's |g|², contiguous
    shape : ν; speckle times this has contrast √(1 + 2/ν)

    The texture is as alike in neighbouring bins as the exponential is: over a resolution cell.
    Source: Jakeman, Pusey, "A model for non-Rayleigh sea echo", IEEE Trans. Antennas Propag. 24, 806-814,
    1976; Abraham, Lyons, "Novel physical interpretations of K-distributed reverberation", IEEE J. Oceanic
    Eng. 27, 800-813, 2002
    """
    table = gamma_from_exponential(float(shape))
    _multiply(exponential.view(np.int32).reshape(-1), *table, _FIRST, _SHIFT, out.reshape(-1))
