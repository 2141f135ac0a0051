"""Complex Gaussian fields, correlated between overlapping beams and along the pulse."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import float32, uint64

from sonar_gl.acoustics.beam_pattern import aperture_weights, main_lobe_edge
from sonar_gl.acoustics.pulse import convolve
from sonar_gl.core.compiled import compiled
from sonar_gl.noise.gaussian import standard_normal

# Multiplications in a matrix product that BLAS computes in one thread. More threads stall on busy cores.
ONE_THREAD_PRODUCT = 500_000
# Beam widths between the ends of a fan, across its back, from which on they share less than 2 % of their intensity's
# variance: the fan is no circle then.
CLOSING_WIDTHS = 2.0
BINS_TOGETHER = (
    64  # of several such products: fewer would be added to parts of cache lines, in another page each
)


class FieldCorrelation(NamedTuple):
    """What correlates the complex fields of neighbouring beams and bins. B beams.

    Attributes
    ----------
    azimuth_rad : (B,) beam centres, radians, rising, as a tuple
    beam_width_rad : −3 dB width of a beam, radians; None for independent beams
    taper_series : F₁, F₂, … of the element weights 1 + 2 Σ F_m cos(2πmz/L), |z| <= L/2; () is uniform
    pulse_weights : (n,) float32, n odd, `acoustics.pulse.field_weights`; None for independent bins
    """

    azimuth_rad: tuple[float, ...]
    beam_width_rad: float | None
    taper_series: tuple[float, ...] = ()
    pulse_weights: np.ndarray | None = None


class FieldBlock(NamedTuple):
    """The field of some bins: even + odd in the first beams, even − odd in those that mirror them.

    Attributes
    ----------
    first_bin : number of the block's first bin
    odd, even : (products, beams that mirror no other, 2 n) float32: real parts of n bins, then imaginary parts; the
        bins of one product after those of the other
    """

    first_bin: int
    odd: np.ndarray
    even: np.ndarray


def aperture_width(taper_series: tuple[float, ...] = ()) -> float:
    """Return the −3 dB width of a line array's beam, in λ/L.

    >>> round(aperture_width((0.23 / 0.54,)), 4)  # Hamming
    1.303
    """
    return 2 * main_lobe_edge(taper_series, 0.5)


@lru_cache(maxsize=8)
def beam_matrix(
    azimuth_rad: tuple[float, ...], beam_width_rad: float, taper_series: tuple[float, ...] = ()
) -> np.ndarray | None:
    """Return the matrix that turns M independent normals into B beams with the correlation of a line array.

    Returns
    -------
    (B, M) float32 with rows of unit power, the first M // 2 columns sines about the middle of the fan and the
    others cosines; None if no two beams overlap. Independent draws serve then: beams one width apart share
    2 % of their intensity's variance, as do beams of tapered arrays 1.7 widths apart

    Notes
    -----
    Each of M elements contributes a wave over azimuth, cosine and sine of one frequency. The frequencies fill
    the band that the aperture passes evenly, and the taper weights them. For a uniform array, beams D apart
    correlate as sinc(0.8859 D / width). A finite sum of waves is periodic. The period exceeds the fan by some
    beam widths. A fan whose ends nearly meet is a circle, which is its own period: the width of beams is rounded
    to a whole number of waves in it, by 6 % of beams 50 degrees wide.
    """
    azimuth = np.asarray(azimuth_rad)
    independent_widths = 1.7 if taper_series else 0.95
    if len(azimuth) < 2 or np.diff(azimuth).min() >= independent_widths * beam_width_rad:
        return None
    is_circle = azimuth[0] + 2 * np.pi - azimuth[-1] < CLOSING_WIDTHS * beam_width_rad
    period = 2 * np.pi if is_circle else 1.2 * (azimuth[-1] - azimuth[0]) + 12 * beam_width_rad
    elements = max(1, round(aperture_width(taper_series) * period / beam_width_rad))
    if not is_circle:  # the width is exact, the period follows from the rounded number of elements
        period = elements * beam_width_rad / aperture_width(taper_series)
    positions = np.arange(elements) - (elements - 1) / 2
    frequencies = positions * (2 * np.pi / period)
    phase = (azimuth - (azimuth[0] + azimuth[-1]) / 2)[:, None] * frequencies
    # frequencies come in pairs ±f: cosine for one, sine for the other, √2 each; 0 has no partner
    out = np.where(frequencies > 0, np.sqrt(2) * np.cos(phase), np.sqrt(2) * np.sin(phase))
    out[:, frequencies == 0] = 1.0
    if taper_series:
        weights = aperture_weights(positions / elements, taper_series)
        out = (out * (weights / np.sqrt((weights**2).sum()))).astype(np.float32)
    else:
        out = (out / np.sqrt(elements)).astype(np.float32)
    out.setflags(write=False)
    return out


@lru_cache(maxsize=8)
def sines_and_cosines(
    azimuth_rad: tuple[float, ...], beam_width_rad: float, taper_series: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the sine and the cosine columns of `beam_matrix`, or None where that is None.

    A fan that is symmetric about its middle needs the rows of one half only: the mirror image of a beam has
    the opposite sines and the same cosines.
    """
    matrix = beam_matrix(azimuth_rad, beam_width_rad, taper_series)
    if matrix is None:
        return None
    azimuth, n_sines = np.asarray(azimuth_rad), matrix.shape[1] // 2
    if np.ptp(azimuth + azimuth[::-1]) < 1e-6 * beam_width_rad:
        matrix = matrix[: (len(matrix) + 1) // 2]
    return np.ascontiguousarray(matrix[:, :n_sines]), np.ascontiguousarray(matrix[:, n_sines:])


def _field_blocks(
    correlation: FieldCorrelation, n_bins: int, generator: np.random.Generator
) -> Iterator[FieldBlock]:
    """Yield a correlated field of unit variance per part, bins in blocks; the arrays are reused."""
    azimuth_rad, width_rad, taper_series, pulse_weights = correlation
    columns = sines_and_cosines(azimuth_rad, width_rad, taper_series) if width_rad else None
    if columns is None:
        beams = elements = len(azimuth_rad)
        block = 64
    else:
        sines, cosines = columns
        beams, elements = len(cosines), sines.shape[1] + cosines.shape[1]
        block = max(4, ONE_THREAD_PRODUCT // (2 * cosines.size) // 8 * 8)
    filtered = None
    if pulse_weights is not None and len(pulse_weights) > 1:
        white = standard_normal(generator, (2 * elements, n_bins + len(pulse_weights) - 1))
        filtered = convolve(white, pulse_weights).reshape(elements, 2, n_bins)
    n_blocks, together = n_bins // block, max(1, BINS_TOGETHER // block)
    parts = [(number, min(together, n_blocks - number), block) for number in range(0, n_blocks, together)]
    if n_bins % block:
        parts.append((n_blocks, 1, n_bins % block))
    odd, even = np.zeros((2, together, beams, 2 * block), np.float32)
    for number, n_products, n in parts:
        if n < block:  # the last block
            odd, even = np.zeros((2, 1, beams, 2 * n), np.float32)
        for product in range(n_products):
            first = (number + product) * block
            if filtered is None:
                normals = standard_normal(generator, (elements, 2 * n))
            else:
                normals = filtered[:, :, first : first + n].reshape(elements, 2 * n)
            if columns is None:
                even[product] = normals
            else:
                np.matmul(sines, normals[: sines.shape[1]], out=odd[product])
                np.matmul(cosines, normals[sines.shape[1] :], out=even[product])
        yield FieldBlock(number * block, odd[:n_products], even[:n_products])


@compiled
def _multiply(first, odd, even, out):
    """Multiply bins of out (B, K), from `first` on, by half the squared magnitude of a `FieldBlock`."""
    n = uint64(even.shape[2] // 2)
    for b in range(uint64(even.shape[1])):
        mirrored = uint64(len(out) - 1 - b)
        for product in range(uint64(len(even))):
            e, o = even[product, b], odd[product, b]
            start = uint64(first) + product * n
            row = out[b, start : start + n]
            for k in range(n):
                real, imaginary = e[k] + o[k], e[k + n] + o[k + n]
                row[k] *= float32(0.5) * (real * real + imaginary * imaginary)
            if mirrored >= even.shape[1]:
                row = out[mirrored, start : start + n]
                for k in range(n):
                    real, imaginary = e[k] - o[k], e[k + n] - o[k + n]
                    row[k] *= float32(0.5) * (real * real + imaginary * imaginary)


@compiled
def _add(first, odd, even, scale, total):
    """Add scale, (B, K) or (1, K), times a `FieldBlock` to bins of total (B, 2, K), from `first` on."""
    n, only = uint64(even.shape[2] // 2), uint64(len(scale) - 1)
    for b in range(uint64(even.shape[1])):
        mirrored = uint64(len(total) - 1 - b)
        for product in range(uint64(len(even))):
            e, o = even[product, b], odd[product, b]
            start = uint64(first) + product * n
            past = start + n
            weight = scale[min(uint64(b), only), start:past]
            real, imaginary = total[b, 0, start:past], total[b, 1, start:past]
            for k in range(n):
                real[k] += weight[k] * (e[k] + o[k])
                imaginary[k] += weight[k] * (e[k + n] + o[k + n])
            if mirrored >= even.shape[1]:
                weight = scale[min(mirrored, only), start:past]
                real, imaginary = total[mirrored, 0, start:past], total[mirrored, 1, start:past]
                for k in range(n):
                    real[k] += weight[k] * (e[k] - o[k])
                    imaginary[k] += weight[k] * (e[k + n] - o[k + n])


@compiled
def replace_by_look(field, total, intensity):
    """Replace echoes E, (B, K) float32, by one look |√E g + t|², in place.

    Parameters
    ----------
    field, total : g and t, (B, 2, K) float32, real and imaginary parts
    """
    for b in range(uint64(len(intensity))):
        row, x, y, p, q = intensity[b], field[b, 0], field[b, 1], total[b, 0], total[b, 1]
        for k in range(uint64(len(row))):
            amplitude = np.sqrt(row[k])
            real, imaginary = amplitude * x[k] + p[k], amplitude * y[k] + q[k]
            row[k] = real * real + imaginary * imaginary


def add_field(
    total: np.ndarray,
    amplitude: np.ndarray,
    correlation: FieldCorrelation,
    generator: np.random.Generator,
) -> None:
    """Add a correlated complex Gaussian field of standard deviation `amplitude` to total, in place.

    Parameters
    ----------
    total : (B, 2, K) float32, real and imaginary parts
    amplitude : (B, K) float32, or (1, K) for all beams; its square is E|field|²
    """
    scale = np.multiply(amplitude, np.float32(np.sqrt(0.5)), dtype=np.float32)
    for block in _field_blocks(correlation, total.shape[2], generator):
        _add(*block, scale, total)


def multiply_by_speckle(
    intensity: np.ndarray, correlation: FieldCorrelation, generator: np.random.Generator
) -> None:
    """Multiply each bin of the intensity, in place, by |g|² of a complex Gaussian field g of unit variance.

    Parameters
    ----------
    intensity : (B, K) float32

    Notes
    -----
    |g|² is exponential: mean 1, contrast 1, standard deviation 5.57 dB. The fields of bins correlate as the
    autocorrelation of the pulse weights. Overlapping beams share the waves that the elements of their
    aperture receive. Scatterers surround the sonar, so the waves at different elements are independent, and
    the fields of beams correlate as the Fourier transform of the squared element weights [1]_. For a uniform
    line array that is sinc(0.8859 D / width) for beams D apart. Intensities correlate as its square.

    References
    ----------
    .. [1] Goodman, Speckle Phenomena in Optics, 2007 (van Cittert-Zernike theorem)
    """
    for block in _field_blocks(correlation, intensity.shape[1], generator):
        _multiply(*block, intensity)
