"""Complex Gaussian fields, correlated between overlapping beams and along the pulse."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import float32, uint64

from sonar_gl.acoustics.beam_pattern import aperture_field, aperture_weights, main_lobe_edge
from sonar_gl.acoustics.pulse import convolve
from sonar_gl.core.compiled import compiled, uncounted
from sonar_gl.core.worker import SecondThread, run_rows
from sonar_gl.noise.gaussian import standard_normal

# Multiplications in a matrix product that BLAS computes in one thread. More threads stall on busy cores.
ONE_THREAD_PRODUCT = 500_000
# Beam widths between the ends of a fan, across its back, from which on they share less than 2 % of their intensity's
# variance: the fan is no circle then.
CLOSING_WIDTHS = 2.0
# Beam widths beyond the fan after which a sum of waves repeats, and least number of waves: with fewer, intensities
# would correlate otherwise than the array says, by more than 0.001.
MARGIN_WIDTHS, LEAST_ELEMENTS = 15, 22
LOW_END = 0.018  # of the aperture, power over the mean: a pattern is cut off where it leaves an error of up to 0.001
# Nodes whose fields make those of beams: nodes per λ/L of azimuth, nodes that count for a beam, and the shape of the
# Kaiser window by which they do.
OVERSAMPLING, TAPS, KAISER = 1.25, 8, 14.8
MANY_BINS = 100_000  # of a look that two threads finish: 0.15 ms of work


class FieldCorrelation(NamedTuple):
    """What correlates the complex fields of neighbouring beams and bins. B beams.

    azimuth_rad : (B,) beam centres, radians, rising, as a tuple
    beam_width_rad : −3 dB width of a beam, radians; None for independent beams
    taper_series : F₁, F₂, … of the element weights 1 + 2 Σ F_m cos(2πmz/L), |z| <= L/2; () is uniform
    pulse_weights : (n,) float32, n odd, `acoustics.pulse.field_weights`; None for independent bins
    """

    azimuth_rad: tuple[float, ...]
    beam_width_rad: float | None
    taper_series: tuple[float, ...] = ()
    pulse_weights: np.ndarray | None = None


class BeamField(NamedTuple):
    """A complex Gaussian field of B beams, each interpolated between TAPS neighbours of N nodes.

    nodes : (N, 2, K) float32, the real and imaginary parts of the fields of nodes
    first, weights : (B,) int64 and (B, TAPS) float32, the first of the nodes of each beam and their weights
    scale : standard deviation of the field, per that of its real part
    """

    nodes: np.ndarray
    first: np.ndarray
    weights: np.ndarray
    scale: float

    def of_beams(self, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what kernels need of some beams: nodes, first and weights."""
        return self.nodes, self.first[rows], self.weights[rows]


_NO_FIELD = np.empty((0, 2, 0), np.float32), np.empty(0, np.int64), np.empty((0, TAPS), np.float32)


class BeamNodes(NamedTuple):
    """How white noise makes the fields of B beams: it is that of N nodes, or of waves that make those of nodes.

    Nodes mirror one another about the middle of the fan: of waves, one has the opposite sines and the same cosines as
    its mirror image.

    sines, cosines : (N / 2, M // 2) and (N / 2, M − M // 2) float32, weights of M waves in the first half of the nodes;
        None where nodes are white
    first, weights : (B,) int64 and (B, TAPS) float32, the first of the nodes of each beam and their weights
    """

    sines: np.ndarray | None
    cosines: np.ndarray | None
    first: np.ndarray
    weights: np.ndarray


def aperture_width(taper_series: tuple[float, ...]) -> float:
    """Return the −3 dB width of a line array's beam, in λ/L.

    >>> round(aperture_width((0.23 / 0.54,)), 4)  # Hamming
    1.303
    """
    return 2 * main_lobe_edge(taper_series, 0.5)


def has_low_ends(taper_series: tuple[float, ...]) -> bool:
    """Return whether a taper has less than LOW_END of its mean power at the ends of the aperture."""
    mean_power = 1 + 2 * sum(share**2 for share in taper_series)
    return bool(aperture_weights(0.5, taper_series) ** 2 < LOW_END * mean_power)


def own_nodes(n_beams: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `first` and `weights` of a `BeamField` whose nodes are the beams, and more if there are fewer than TAPS.

    >>> own_nodes(9)[0].tolist()
    [0, 1, 1, 1, 1, 1, 1, 1, 1]
    """
    numbers = np.arange(n_beams)
    first = np.minimum(numbers, max(n_beams - TAPS, 0))
    return first, np.eye(TAPS, dtype=np.float32)[numbers - first]


@lru_cache(maxsize=8)
def beam_nodes(
    azimuth_rad: tuple[float, ...], beam_width_rad: float | None, taper_series: tuple[float, ...] = ()
) -> BeamNodes:
    """Return how independent normals make B beams with the correlation of a line array, of unit power.

    If no two beams overlap, they are independent: beams one width apart share 2 % of their intensity's variance, as do
    beams of tapered arrays 1.7 widths apart. Otherwise intensities correlate as the array says, within 0.001, but for
    the rounded width of beams in a full circle.

    The pattern of a beam, as a function of azimuth, has no periods shorter than the aperture passes. So white noise of
    nodes that are no farther apart than λ/L, weighed by the pattern, has the correlation of the array. The pattern of
    a taper that is low at the ends of the aperture, such as Hamming's, is cut off at TAPS nodes.

    Of other tapers, and in a full circle, each of M elements contributes a wave over azimuth, cosine and sine of one
    frequency. The frequencies fill the band that the aperture passes evenly, and the taper weights them. For a uniform
    array, beams D apart correlate as sinc(0.8859 D / width). A finite sum of waves is periodic. The period exceeds the
    fan by some beam widths. A fan whose ends nearly meet is a circle, which is its own period: the width of beams is
    rounded to a whole number of waves in it, by 6 % of beams 50 degrees wide. Waves are summed at nodes, which are
    fewer than beams that overlap much. A beam weighs nodes by a Kaiser window, whose transform the waves are divided
    by: a wave is off by less than 1e-4 of its amplitude.

    Source: Fessler, Sutton, "Nonuniform fast Fourier transforms using min-max interpolation", IEEE Trans. Signal
    Process. 51, 560-574, 2003
    """
    azimuth = np.asarray(azimuth_rad)
    independent_widths = 1.7 if taper_series else 0.95
    if (
        beam_width_rad is None
        or len(azimuth) < 2
        or np.diff(azimuth).min() >= independent_widths * beam_width_rad
    ):
        return BeamNodes(None, None, *own_nodes(len(azimuth)))
    fan_rad = azimuth[-1] - azimuth[0]
    is_circle = fan_rad > 2 * np.pi - CLOSING_WIDTHS * beam_width_rad
    period = 2 * np.pi if is_circle else fan_rad + MARGIN_WIDTHS * beam_width_rad
    elements = max(1, round(aperture_width(taper_series) * period / beam_width_rad))
    if not is_circle:  # the width is exact, the period follows from the number of elements
        elements = max(elements, LEAST_ELEMENTS)
        period = elements * beam_width_rad / aperture_width(taper_series)
    step_rad = period / elements / OVERSAMPLING
    half = math.ceil(fan_rad / step_rad / 2) + TAPS // 2  # of the number of nodes
    place = (azimuth - (azimuth[0] + azimuth[-1]) / 2) / step_rad + (half - 0.5)
    first = np.floor(place).astype(np.int64) - (TAPS // 2 - 1)
    off = place[:, None] - first[:, None] - np.arange(TAPS)
    if not is_circle and has_low_ends(taper_series):
        weights = aperture_field(off / OVERSAMPLING, taper_series)
        weights /= np.sqrt((weights**2).sum(axis=1, keepdims=True))
        return BeamNodes(None, None, first, weights.astype(np.float32))

    # In a circle each wave has a whole number of periods, or fields would change their sign where it closes. Of an even
    # number of waves, that is one more, and half the power of the outermost two.
    is_split = is_circle and elements % 2 == 0
    positions = (np.arange(elements + is_split) - (elements - 1 + is_split) / 2) / elements
    frequencies = positions / OVERSAMPLING  # in periods from node to node
    phase = 2 * np.pi * (np.arange(2 * half) - (half - 0.5))[:, None] * frequencies
    # frequencies come in pairs ±f: cosine for one, sine for the other, √2 each; 0 has no partner
    waves = np.where(frequencies > 0, np.sqrt(2) * np.cos(phase), np.sqrt(2) * np.sin(phase))
    waves[:, frequencies == 0] = 1.0
    root = np.sqrt(KAISER**2 - (np.pi * TAPS * frequencies) ** 2)
    waves *= aperture_weights(positions, taper_series) * root / np.sinh(root)
    if is_split:
        waves[:, [0, -1]] *= np.sqrt(0.5)
    weights = np.i0(KAISER * np.sqrt(np.maximum(1 - (2 * off / TAPS) ** 2, 0)))
    of_beams = sum(weights[:, [tap]] * waves[first + tap] for tap in range(TAPS))
    weights /= np.sqrt((of_beams**2).sum(axis=1, keepdims=True))
    halves = np.split(waves[:half], [elements // 2], axis=1)
    sines, cosines = (np.ascontiguousarray(part, np.float32) for part in halves)
    return BeamNodes(sines, cosines, first, weights.astype(np.float32))


def correlated_field(correlation: FieldCorrelation, n_bins: int, generator: np.random.Generator) -> BeamField:
    """Return a random field, of unit variance in the real and in the imaginary part.

    The fields of bins correlate as the autocorrelation of the pulse weights. Overlapping beams share the waves that the
    elements of their aperture receive. Scatterers surround the sonar, so the waves at different elements are
    independent, and the fields of beams correlate as the Fourier transform of the squared element weights. For a
    uniform line array that is sinc(0.8859 D / width) for beams D apart. Intensities correlate as its square.

    Source: Goodman, Speckle Phenomena in Optics, 2007 (van Cittert-Zernike theorem)
    """
    sines, cosines, first, weights = beam_nodes(*correlation[:3])
    pulse_weights = correlation.pulse_weights
    n_white = first[-1] + TAPS if sines is None else sines.shape[1] + cosines.shape[1]
    reach = 0 if pulse_weights is None else len(pulse_weights) - 1
    white = standard_normal(generator, (2 * n_white, n_bins + reach))
    if reach:
        white = convolve(white, pulse_weights)
    if sines is None:
        nodes = white.reshape(n_white, 2, n_bins)
    else:
        nodes = _sum_waves(sines, cosines, white.reshape(n_white, 2 * n_bins)).reshape(-1, 2, n_bins)
    return BeamField(nodes, first, weights, math.sqrt(0.5))


def _sum_waves(sines: np.ndarray, cosines: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return the sums of waves at N nodes, (N, n) float32; sines, cosines : of `BeamNodes`; white : (M, n)."""
    half, n = len(sines), white.shape[1]
    out = np.empty((2 * half, n), np.float32)
    block = max(8, ONE_THREAD_PRODUCT // cosines.size // 8 * 8)
    for start in range(0, n, block):
        part, to = white[:, start : start + block], out[:, start : start + block]
        odd, even = sines @ part[: sines.shape[1]], cosines @ part[sines.shape[1] :]
        np.add(even, odd, out=to[:half])
        np.subtract(even, odd, out=to[: half - 1 : -1])
    return out


@uncounted
def _weigh_nodes(nodes, first, part, weights, out):
    """Fill out (K,) with a part of the fields (N, 2, K), real or imaginary, of TAPS nodes by their weights (TAPS,)."""
    a, n = weights, first
    p, q, r, s = nodes[n, part], nodes[n + 1, part], nodes[n + 2, part], nodes[n + 3, part]
    t, u, v, w = nodes[n + 4, part], nodes[n + 5, part], nodes[n + 6, part], nodes[n + 7, part]
    for k in range(uint64(len(out))):
        x = a[1] * q[k] + a[0] * p[k]
        x = a[2] * r[k] + x
        x = a[3] * s[k] + x
        x = a[4] * t[k] + x
        x = a[5] * u[k] + x
        x = a[6] * v[k] + x
        out[k] = a[7] * w[k] + x


@uncounted
def _add_beam(field, beam, amplitude, work, total):
    """Add the field of a beam, times an amplitude (K,), to total (2, K); work : (K,), overwritten."""
    nodes, first, weights = field
    for part in range(2):
        _weigh_nodes(nodes, first[beam], part, weights[beam], work)
        row = total[part]
        for k in range(uint64(len(row))):
            row[k] += amplitude[k] * work[k]


@uncounted
def _look_at_beam(beam, echo, speckle, scale, steady, others, noise, noise_amplitude, work, out):
    """Do the work of `_look` for one beam; work : (4, K), overwritten."""
    row, to, total, amplitude = echo[beam], out[beam], work[:2], work[2]
    real, imaginary = total[0], total[1]
    if len(steady):
        for k in range(uint64(len(row))):
            real[k] = np.sqrt(steady[beam, k])
            amplitude[k] = np.sqrt(max(row[k] - steady[beam, k], float32(0))) * scale
    else:
        for k in range(uint64(len(row))):
            real[k] = float32(0)
            amplitude[k] = np.sqrt(row[k]) * scale
    for k in range(uint64(len(row))):
        imaginary[k] = float32(0)
    if len(others):
        for k in range(uint64(len(row))):
            real[k] += others[beam, 0, k]
            imaginary[k] += others[beam, 1, k]
    if len(noise[0]):
        _add_beam(noise, beam, noise_amplitude[min(beam, len(noise_amplitude) - 1)], work[3], total)
    if len(speckle[0]):
        _add_beam(speckle, beam, amplitude, work[3], total)
    else:
        for k in range(uint64(len(row))):
            real[k] += amplitude[k]
    for k in range(uint64(len(row))):
        to[k] = real[k] * real[k] + imaginary[k] * imaginary[k]


@compiled
def _look(echo, speckle, scale, steady, others, noise, noise_amplitude, out):
    """Fill out (B, K) as `look_at` does; of arrays of no length, terms are left out."""
    work = np.empty((4, echo.shape[1]), np.float32)
    for beam in range(len(echo)):
        _look_at_beam(beam, echo, speckle, scale, steady, others, noise, noise_amplitude, work, out)


def look_at(
    echo: np.ndarray,
    speckle: BeamField | None,
    steady: np.ndarray | None = None,
    others: np.ndarray | None = None,
    noise: BeamField | None = None,
    noise_power: np.ndarray | None = None,
    thread: SecondThread | None = None,
) -> np.ndarray:
    """Return one look |√(E − C) g + √C + s + √N n|² at echoes E, (B, K) float32.

    Terms that are None are left out; without speckle, g is 1.

    echo : (B, K) float32
    speckle, noise : g and n
    steady : C, (B, K) float32, the part of the echo that does not speckle; rounding may make it more than the echo
    others : s, (B, 2, K) float32, real and imaginary parts
    noise_power : N, (B, K) float32, or (1, K) for all beams
    thread : does half of the beams, unless there are few bins
    """
    scale, out = np.float32(1 if speckle is None else speckle.scale), np.empty(echo.shape, np.float32)
    echo, steady = (
        _read_only(np.empty((0, 0), np.float32) if one is None else one) for one in (echo, steady)
    )
    others = np.empty((0, 2, 0), np.float32) if others is None else others
    if noise is None:
        amplitude = np.empty((0, 0), np.float32)
    else:
        amplitude = np.multiply(np.sqrt(noise_power), np.float32(noise.scale), dtype=np.float32)

    def work(rows: slice) -> None:
        g, n = (_NO_FIELD if one is None else one.of_beams(rows) for one in (speckle, noise))
        of_noise = amplitude[rows] if len(amplitude) > 1 else amplitude
        _look(echo[rows], g, scale, steady[rows], others[rows], n, of_noise, out[rows])

    run_rows(thread if out.size > MANY_BINS else None, work, len(out))
    return out


def _read_only(array: np.ndarray) -> np.ndarray:
    """Return a contiguous view that cannot be written to: Numba compiles anew for one that can."""
    out = np.ascontiguousarray(array).view()
    out.setflags(write=False)
    return out


@compiled
def _add(field, scale, total):
    """Add the field of beams times scale, (B, K) or (1, K), to total (B, 2, K)."""
    work, only = np.empty(total.shape[2], np.float32), len(scale) - 1
    for beam in range(len(total)):
        _add_beam(field, beam, scale[min(beam, only)], work, total[beam])


def add_field(
    total: np.ndarray, amplitude: np.ndarray, correlation: FieldCorrelation, generator: np.random.Generator
) -> None:
    """Add a correlated complex Gaussian field of standard deviation `amplitude` to total, in place.

    total : (B, 2, K) float32, real and imaginary parts
    amplitude : (B, K) float32, or (1, K) for all beams; its square is E|field|²
    """
    field = correlated_field(correlation, total.shape[2], generator)
    scale = np.multiply(amplitude, np.float32(field.scale), dtype=np.float32)
    _add(field.of_beams(slice(None)), scale, total)
