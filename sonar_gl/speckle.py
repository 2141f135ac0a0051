"""Fully developed speckle, correlated over overlapping beams."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import float32, uint64

from sonar_gl.compiled import compiled
from sonar_gl.normals import standard_normal

APERTURE = 0.885892941379  # −3 dB width of a uniform line array in λ/L, twice the x of sinc²(x) = 1/2
# Multiplications of a matrix product that BLAS still makes in one thread: its threads stall on busy cores.
PRODUCT = 500_000


@lru_cache(maxsize=8)
def _beams_from_elements(azimuths_rad: tuple[float, ...], beam_width_rad: float) -> np.ndarray | None:
    """(B, M) float32 that turns M independent normals into B beams correlated as sinc(0.8859 D / width).

    The rows are what a line array does: each of M elements adds a wave over azimuth, cos and sin of one
    frequency, and the frequencies fill evenly the band that the aperture passes. Rows have unit power. The
    first M // 2 columns are sines about the middle of the fan, the others cosines.
    The sum repeats itself after a period, which must be longer than the fan by some widths; the whole
    circle is its own period. None where no two beams overlap: independent draws do then, beams a width
    apart share 2 % of their intensity's variance.
    """
    azimuth = np.asarray(azimuths_rad)
    if len(azimuth) < 2 or np.diff(azimuth).min() >= 0.95 * beam_width_rad:
        return None
    period = min(2 * np.pi, 1.2 * (azimuth[-1] - azimuth[0]) + 12 * beam_width_rad)
    elements = max(1, round(APERTURE * period / beam_width_rad))
    if period < 2 * np.pi:
        period = elements * beam_width_rad / APERTURE  # the width exact, the period nearly as asked
    waves = (np.arange(elements) - (elements - 1) / 2) * (2 * np.pi / period)
    phase = (azimuth - (azimuth[0] + azimuth[-1]) / 2)[:, None] * waves
    # waves come in pairs ±f: cos for one of a pair, sin for the other, √2 each; the wave 0 stands alone
    out = np.where(waves > 0, np.sqrt(2) * np.cos(phase), np.sqrt(2) * np.sin(phase))
    out[:, waves == 0] = 1.0
    out = (out / np.sqrt(elements)).astype(np.float32)
    out.setflags(write=False)
    return out


@lru_cache(maxsize=8)
def _halves(azimuths_rad: tuple[float, ...], beam_width_rad: float) -> tuple[np.ndarray, np.ndarray] | None:
    """The sines and the cosines of `_beams_from_elements`, of half the beams where the others mirror them."""
    factor = _beams_from_elements(azimuths_rad, beam_width_rad)
    if factor is None:
        return None
    azimuth, n_sines = np.asarray(azimuths_rad), factor.shape[1] // 2
    even = azimuth + azimuth[::-1]
    if np.ptp(even) < 1e-6 * beam_width_rad:
        factor = factor[: (len(factor) + 1) // 2]
    return np.ascontiguousarray(factor[:, :n_sines]), np.ascontiguousarray(factor[:, n_sines:])


@compiled
def _multiply(odd, even, first, out):
    """Multiply bins of out (B, K) from `first` on by |even ± odd|² / 2, minus for beams that are mirrored.

    odd, even : (beams that are not mirrored, 2 n), real parts of n bins and then imaginary parts
    """
    n, last = uint64(even.shape[1] // 2), uint64(first + even.shape[1] // 2)
    for b in range(uint64(len(even))):
        row, mirrored = out[b, first:last], uint64(len(out) - 1 - b)
        for k in range(n):
            real, imaginary = even[b, k] + odd[b, k], even[b, k + n] + odd[b, k + n]
            row[k] *= float32(0.5) * (real * real + imaginary * imaginary)
        if mirrored >= len(even):
            row = out[mirrored, first:last]
            for k in range(n):
                real, imaginary = even[b, k] - odd[b, k], even[b, k + n] - odd[b, k + n]
                row[k] *= float32(0.5) * (real * real + imaginary * imaginary)


def multiply_by_speckle(out: np.ndarray, azimuth_rad, beam_width_rad: float | None, random) -> None:
    """Multiply each bin of out, (B, K) float32, by |g|² of a complex Gaussian g of unit variance.

    Parameters
    ----------
    azimuth_rad : (B,) beam centres, radians, rising
    beam_width_rad : −3 dB width of a beam, radians; None = beams are independent
    random : numpy.random.Generator

    Notes
    -----
    |g|² is exponential: mean 1, contrast 1, standard deviation 5.57 dB. Bins are independent of one another.
    Beams D apart hear through one aperture: their fields correlate as sinc(0.8859 D / width), the
    Fourier transform of a uniform line array, their intensities as its square [1]_.

    References
    ----------
    .. [1] Goodman, Speckle Phenomena in Optics, 2007 (van Cittert-Zernike theorem)
    """
    halves = None
    if beam_width_rad:
        halves = _halves(tuple(np.asarray(azimuth_rad, np.float64).tolist()), float(beam_width_rad))
    B, K = out.shape
    if halves is None:
        beams, elements, block = B, B, 64
    else:
        sines, cosines = halves
        beams, elements = len(cosines), sines.shape[1] + cosines.shape[1]
        block = max(4, PRODUCT // (2 * cosines.size) // 8 * 8)
    odd, even = np.zeros((2, beams, 2 * block), np.float32)
    for first in range(0, K, block):
        n = min(block, K - first)
        if n < block:  # the last ones
            odd, even = np.zeros((2, beams, 2 * n), np.float32)
        parts = standard_normal(random, (elements, 2 * n))
        if halves is None:
            even = parts
        else:
            np.matmul(sines, parts[: sines.shape[1]], out=odd)
            np.matmul(cosines, parts[sines.shape[1] :], out=even)
        _multiply(odd, even, first, out)
