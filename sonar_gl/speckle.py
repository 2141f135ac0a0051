"""Complex Gaussian fields, correlated over overlapping beams and along the pulse: speckle, receiver noise."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import float32, uint64

from sonar_gl.compiled import compiled
from sonar_gl.normals import standard_normal
from sonar_gl.patterns import first_of
from sonar_gl.pulse import convolve

# Multiplications of a matrix product that BLAS still makes in one thread: its threads stall on busy cores.
PRODUCT = 500_000


class Array(NamedTuple):
    """What makes the fields of neighbouring beams and bins alike. B beams.

    azimuth_rad : (B,) beam centres, radians, rising, as a tuple
    beam_width_rad : −3 dB width of a beam, radians; None = beams are independent
    series : F₁, F₂, … of the elements' weights 1 + 2 Σ F_m cos(2πmz/L), |z| <= L/2; () is uniform
    along : None, or (n,) float32 of unit power, n odd: the pulse's `field_weights`
    """

    azimuth_rad: tuple[float, ...]
    beam_width_rad: float | None
    series: tuple[float, ...] = ()
    along: np.ndarray | None = None


def aperture_width(series: tuple[float, ...] = ()) -> float:
    """−3 dB width of a line array in λ/L.

    >>> round(aperture_width((0.23 / 0.54,)), 4)  # Hamming
    1.303
    """
    return 2 * first_of(series, 0.5)


def aperture_weights(z, series: tuple[float, ...] = ()) -> np.ndarray:
    """Weights of elements at z, −1/2..1/2 of the array's length."""
    return 1 + 2 * sum((f * np.cos(2 * np.pi * m * z) for m, f in enumerate(series, 1)), np.zeros_like(z))


@lru_cache(maxsize=8)
def _beams_from_elements(
    azimuths_rad: tuple[float, ...], beam_width_rad: float, series: tuple[float, ...] = ()
) -> np.ndarray | None:
    """(B, M) float32 that turns M independent normals into B beams correlated as sinc(0.8859 D / width).

    The rows are what a line array does: each of M elements adds a wave over azimuth, cos and sin of one
    frequency, and the frequencies fill evenly the band that the aperture passes; a taper weighs them. Rows
    have unit power. The first M // 2 columns are sines about the middle of the fan, the others cosines.
    The sum repeats itself after a period, which must be longer than the fan by some widths; the whole
    circle is its own period. None where no two beams overlap: independent draws do then, beams a width
    apart share 2 % of their intensity's variance (of tapered arrays, beams 1.7 widths apart).
    """
    azimuth = np.asarray(azimuths_rad)
    apart = 1.7 if series else 0.95
    if len(azimuth) < 2 or np.diff(azimuth).min() >= apart * beam_width_rad:
        return None
    period = min(2 * np.pi, 1.2 * (azimuth[-1] - azimuth[0]) + 12 * beam_width_rad)
    elements = max(1, round(aperture_width(series) * period / beam_width_rad))
    if period < 2 * np.pi:
        period = elements * beam_width_rad / aperture_width(series)  # the width exact, the period nearly
    places = np.arange(elements) - (elements - 1) / 2
    waves = places * (2 * np.pi / period)
    phase = (azimuth - (azimuth[0] + azimuth[-1]) / 2)[:, None] * waves
    # waves come in pairs ±f: cos for one of a pair, sin for the other, √2 each; the wave 0 stands alone
    out = np.where(waves > 0, np.sqrt(2) * np.cos(phase), np.sqrt(2) * np.sin(phase))
    out[:, waves == 0] = 1.0
    if series:
        weights = aperture_weights(places / elements, series)
        out = (out * (weights / np.sqrt((weights**2).sum()))).astype(np.float32)
    else:
        out = (out / np.sqrt(elements)).astype(np.float32)
    out.setflags(write=False)
    return out


@lru_cache(maxsize=8)
def _halves(
    azimuths_rad: tuple[float, ...], beam_width_rad: float, series: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray] | None:
    """The sines and the cosines of `_beams_from_elements`, of half the beams where the others mirror them."""
    factor = _beams_from_elements(azimuths_rad, beam_width_rad, series)
    if factor is None:
        return None
    azimuth, n_sines = np.asarray(azimuths_rad), factor.shape[1] // 2
    even = azimuth + azimuth[::-1]
    if np.ptp(even) < 1e-6 * beam_width_rad:
        factor = factor[: (len(factor) + 1) // 2]
    return np.ascontiguousarray(factor[:, :n_sines]), np.ascontiguousarray(factor[:, n_sines:])


def _blocks(array: Array, n_bins: int, random):
    """Yields (first bin, odd, even) of some bins at a time: arrays that `_multiply` takes, used again."""
    halves = None
    if array.beam_width_rad:
        halves = _halves(array.azimuth_rad, array.beam_width_rad, array.series)
    if halves is None:
        beams = elements = len(array.azimuth_rad)
        block = 64
    else:
        sines, cosines = halves
        beams, elements = len(cosines), sines.shape[1] + cosines.shape[1]
        block = max(4, PRODUCT // (2 * cosines.size) // 8 * 8)
    whole = None
    if array.along is not None and len(array.along) > 1:
        longer = standard_normal(random, (2 * elements, n_bins + len(array.along) - 1))
        whole = convolve(longer, array.along).reshape(elements, 2, n_bins)
    odd, even = np.zeros((2, beams, 2 * block), np.float32)
    for first in range(0, n_bins, block):
        n = min(block, n_bins - first)
        if n < block:  # the last ones
            odd, even = np.zeros((2, beams, 2 * n), np.float32)
        if whole is None:
            parts = standard_normal(random, (elements, 2 * n))
        else:
            parts = whole[:, :, first : first + n].reshape(elements, 2 * n)
        if halves is None:
            even = parts
        else:
            np.matmul(sines, parts[: sines.shape[1]], out=odd)
            np.matmul(cosines, parts[sines.shape[1] :], out=even)
        yield first, odd, even


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


@compiled
def _add(odd, even, first, scale, total):
    """Add scale, (B, K) or (1, K), times (even ± odd) to bins of total (B, 2, K) from `first` on."""
    n, last = uint64(even.shape[1] // 2), uint64(first + even.shape[1] // 2)
    only = uint64(len(scale) - 1)
    for b in range(uint64(len(even))):
        mirrored = uint64(len(total) - 1 - b)
        weight = scale[min(uint64(b), only), first:last]
        real, imaginary = total[b, 0, first:last], total[b, 1, first:last]
        for k in range(n):
            real[k] += weight[k] * (even[b, k] + odd[b, k])
            imaginary[k] += weight[k] * (even[b, k + n] + odd[b, k + n])
        if mirrored >= len(even):
            weight = scale[min(mirrored, only), first:last]
            real, imaginary = total[mirrored, 0, first:last], total[mirrored, 1, first:last]
            for k in range(n):
                real[k] += weight[k] * (even[b, k] - odd[b, k])
                imaginary[k] += weight[k] * (even[b, k + n] - odd[b, k + n])


def add_field(total: np.ndarray, amplitude: np.ndarray, array: Array, random) -> None:
    """Add a complex Gaussian field of standard deviation `amplitude` to total.

    Parameters
    ----------
    total : (B, 2, K) float32, real and imaginary parts
    amplitude : (B, K) float32, or (1, K) for all beams alike: E|field|² is its square
    array, random : of the correlation; numpy.random.Generator
    """
    scale = np.multiply(amplitude, np.float32(np.sqrt(0.5)), dtype=np.float32)
    for first, odd, even in _blocks(array, total.shape[2], random):
        _add(odd, even, first, scale, total)


def multiply_by_speckle(
    out: np.ndarray, azimuth_rad, beam_width_rad: float | None, random, series=(), along=None
) -> None:
    """Multiply each bin of out, (B, K) float32, by |g|² of a complex Gaussian g of unit variance.

    Parameters
    ----------
    azimuth_rad, beam_width_rad, series, along : of `Array`
    random : numpy.random.Generator

    Notes
    -----
    |g|² is exponential: mean 1, contrast 1, standard deviation 5.57 dB. Bins are independent of one another,
    or share what the pulse smears: their fields correlate as the autocorrelation of `along`.
    Beams D apart hear through one aperture, whose elements hear independent waves, for scatterers lie all
    about: their fields correlate as the Fourier transform of the squared weights of the elements, which for
    a uniform line array is sinc(0.8859 D / width), their intensities as its square [1]_.

    References
    ----------
    .. [1] Goodman, Speckle Phenomena in Optics, 2007 (van Cittert-Zernike theorem)
    """
    azimuths = tuple(np.asarray(azimuth_rad, np.float64).tolist())
    array = Array(azimuths, beam_width_rad and float(beam_width_rad), tuple(series), along)
    for first, odd, even in _blocks(array, out.shape[1], random):
        _multiply(odd, even, first, out)
