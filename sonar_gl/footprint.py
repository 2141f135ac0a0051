"""One footprint, spread over bins; and how functions are compiled."""

from __future__ import annotations

import numpy as np
from numba import njit, uint64


def compiled(function):
    """Numba's njit without the GIL; its machine code is kept on disk where there is a place for it."""
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function": no folder that can be written
        return njit(**options)(function)


def bin_tables(bin_edges_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3, K + 1): s = 1/r at the edges of bins, their integrals of s ds and s² ds; the former in float32."""
    s = 1.0 / np.maximum(bin_edges_m, 1e-6)
    out = np.zeros((3, len(s)))
    out[0] = s
    out[1, :-1] = (s[:-1] ** 2 - s[1:] ** 2) / 2
    out[2, :-1] = (s[:-1] ** 3 - s[1:] ** 3) / 3
    return out, out[1].astype(np.float32)


@compiled
def _integral(c0, c1, low, high):
    """Of (c0 + c1 s) s ds over [low, high]."""
    return (high - low) * (c0 * (high + low) / 2 + c1 * (high * high + high * low + low * low) / 3)


@compiled
def _spread(sums, c, tables, flat, r_first, per_metre, c0, c1, low, high):
    """Add the density (c0 + c1 s) s ds of s = 1/r in [low, high] to a row of bins."""
    K = sums.shape[1]
    low, high = max(low, tables[0, K]), min(high, tables[0, 0])
    if high <= low:
        return
    near = min(int((1.0 / high - r_first) * per_metre), K - 1)
    far = min(int((1.0 / low - r_first) * per_metre), K - 1)
    if near >= far:
        sums[c, near] += _integral(c0, c1, low, high)
        return
    sums[c, near] += _integral(c0, c1, tables[0, near + 1], high)
    sums[c, far] += _integral(c0, c1, low, tables[0, far])
    # unsigned: an index that may be negative keeps the compiler from using vectors, six times slower
    row, first, last = uint64(c), uint64(near + 1), uint64(far)
    if c1 == 0.0:
        height = np.float32(c0)
        for k in range(first, last):
            sums[row, k] += height * flat[k]
    else:
        for k in range(first, last):
            sums[row, k] += c0 * tables[1, k] + c1 * tables[2, k]


@compiled
def _spread_trapezoid(sums, c, tables, flat, r_first, per_metre, energy, s, wide, thin):
    """The same where the ramps count, or the footprint reaches past a plane's horizon."""
    near, far = s + wide + thin, s - wide - thin
    low, high = s - wide + thin, s + wide - thin
    height, slope = energy / (2 * wide), energy / (4 * wide * thin)
    if far < 0.0:  # a plane seen past its horizon: what the middle saw is spread over the part in view
        seen = _integral(slope * near, -slope, max(high, 0.0), near)
        if high > 0.0:
            seen += _integral(height, 0.0, max(low, 0.0), high)
        if low > 0.0:
            seen += _integral(-slope * far, slope, 0.0, low)
        height, slope = height * energy * s / seen, slope * energy * s / seen
    _spread(sums, c, tables, flat, r_first, per_metre, slope * near, -slope, high, near)
    _spread(sums, c, tables, flat, r_first, per_metre, height, 0.0, low, high)
    _spread(sums, c, tables, flat, r_first, per_metre, -slope * far, slope, far, low)


@compiled
def spread_footprint(sums, c, tables, flat, r_first, per_metre, energy, s, a, b):
    """Add energy times s = 1/r, spread as the sum of two uniforms on ±a and ±b about s, to a row of bins.

    On a plane the cosine of incidence is proportional to s, and so is the energy's density.
    """
    K = sums.shape[1]
    wide, thin = max(a, b), min(a, b)
    # short ramps are not worth drawing: those of neighbouring samples overlap and add up to the same
    if 2 * thin * per_metre >= s * s and 4 * thin >= wide:
        if s + wide + thin > tables[0, K] and s - wide - thin < tables[0, 0]:
            _spread_trapezoid(sums, c, tables, flat, r_first, per_metre, energy, s, wide, thin)
        return
    near, far = s + wide, s - wide
    if far <= tables[0, K] or near >= tables[0, 0]:  # it reaches past the first or the last bin
        if near <= tables[0, K] or far >= tables[0, 0]:
            return
        height = energy / (2 * wide)
        if far < 0.0:
            height *= 2 * wide * s / (near * near / 2)
            far = 0.0
        _spread(sums, c, tables, flat, r_first, per_metre, height, 0.0, far, near)
        return
    # nearly all samples come here: one division gives both ends' ranges and the height
    wide = max(wide, 1e-12 * s)
    product = near * far
    inverse = 1.0 / (product * wide)
    first = int((far * inverse * wide - r_first) * per_metre)
    last = min(int((near * inverse * wide - r_first) * per_metre), K - 1)
    if first >= last:
        sums[c, last] += energy * s
        return
    height = energy * product * inverse / 2
    sums[c, first] += height * (near * near - tables[0, first + 1] ** 2) / 2
    sums[c, last] += height * (tables[0, last] ** 2 - far * far) / 2
    row, height = uint64(c), np.float32(height)
    for k in range(uint64(first + 1), uint64(last)):
        sums[row, k] += height * flat[k]
