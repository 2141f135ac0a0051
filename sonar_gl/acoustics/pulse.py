"""The range response of a pulse of finite bandwidth after its matched filter, as kernels over range bins."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.acoustics.beam_pattern import HAMMING, aperture_field, aperture_weights
from sonar_gl.core.compiled import compiled
from sonar_gl.core.worker import SecondThread, run_rows

# F₁, F₂, … of the weights 1 + 2 Σ F_m cos(2πmf/B) of a spectrum, |f| <= B/2
PULSE_TAPERS = {"uniform": (), "hamming": (HAMMING,)}
# Share of the energy that `bin_weights` may leave out, by taper: of side lobes whose envelope has fallen below −50 dB,
# beyond 101 and 15 c/2B.
NEGLECTED_ENERGY = {"uniform": 1e-3, "hamming": 1.1e-4}
NEGLECTED_POWER = 1e-4  # share of the power that `field_weights` may leave out
MAX_FIELD_NULLS = 50  # or the length, in c/2B, at which `field_weights` end
INTERVALS_PER_NULL = 2  # of integration per c/2B, each with these nodes: accurate to 1e-9
GAUSS_LEGENDRE = np.polynomial.legendre.leggauss(8)
NEGLECTED_COARSE = 0.007  # share of the power that `coarse_weights` may leave out
MIN_COARSE, MAX_COARSE = 4, 16  # bins to each side
COARSE_POINTS = 128  # of their table per bin: linear interpolation errs by less than 1e-4
MAX_HALF_LENGTH = 1 << 16  # bins to each side of a kernel's centre
SILENCE = uint64(64)  # bins without an echo that a convolution leaves out at a time
FEW_PRODUCTS = 1_000_000  # of a convolution: 0.1 ms, as a hand-over to another thread may take


def _null_m(bandwidth_hz: float, sound_speed_m_s: float) -> float:
    """Return c/2B, metres, the distance from the peak to the first null of the untapered response."""
    return sound_speed_m_s / (2 * bandwidth_hz)


class PulseResponse(NamedTuple):
    """What determines the response of the matched filter, as the functions of this module take it.

    bandwidth_hz : of the pulse, hertz
    taper : weights of its spectrum, "uniform" or "hamming"
    sound_speed_m_s : that the sonar is set to
    """

    bandwidth_hz: float
    taper: str
    sound_speed_m_s: float


def amplitude_response(range_m, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0):
    """Return the amplitude of a point's echo after the matched filter, real, 1 at its range.

    Returns float64, of the shape of `range_m`.

    range_m : distance from the range of the point, metres, any shape
    bandwidth_hz : bandwidth B of the pulse, evenly filled, hertz
    taper : "uniform": sinc x with x = 2 B r / c, −3 dB width 0.8859 c/2B, side lobes at −13.3 dB. "hamming": the
        spectrum has the weights 0.54 + 0.46 cos(2πf/B), width 1.303 c/2B, side lobes at −42.7 dB
    sound_speed_m_s : c, metres per second

    The Fourier transform of the spectrum: sinc x + Σ F_m (sinc(x − m) + sinc(x + m)).

    Source: Cook, Bernfeld, Radar Signals, 1967; Harris, "On the use of windows for harmonic analysis with the
    discrete Fourier transform", Proc. IEEE 66, 51-83, 1978

    >>> round(float(amplitude_response(0.885893 / 2 * 0.025, 30e3) ** 2), 5)  # c/2B is 25 mm
    0.5
    """
    x = np.asarray(range_m, np.float64) / _null_m(bandwidth_hz, sound_speed_m_s)
    return aperture_field(x, PULSE_TAPERS[taper])


def resolution_cell_m(bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0) -> float:
    """Return the length of the resolution cell in range, metres: the energy of the power response, 1 at its peak.

    It is c/2B (1 + 2 Σ F_m²) by Parseval.

    bandwidth_hz, taper, sound_speed_m_s : as for `amplitude_response`

    >>> resolution_cell_m(30e3), round(resolution_cell_m(30e3, "hamming"), 5)
    (0.025, 0.03407)
    """
    return _null_m(bandwidth_hz, sound_speed_m_s) * (1 + 2 * sum(share**2 for share in PULSE_TAPERS[taper]))


def _half_length_within(half_energy: np.ndarray, energy: float) -> int:
    """Return the bins to each side that contain an energy.

    half_energy : energy of the bins at 0, 1, … from the centre of a symmetric kernel
    energy : the energy to contain
    """
    inside = half_energy[0] + 2 * np.concatenate([[0.0], np.cumsum(half_energy[1:])])
    return min(int(np.searchsorted(inside, energy)), len(half_energy) - 1)


def _symmetric(half: np.ndarray) -> np.ndarray:
    """Return a kernel of 2n − 1 values from its n values at 0, 1, … bins from the centre."""
    return np.concatenate([half[:0:-1], half])


def _sufficient_half_length(bin_size_m: float, null_m: float) -> int:
    """Return bins to each side that are enough with any taper: beyond x, sinc² has the energy 1/π²x, others less."""
    bins = int(np.ceil(1.1 / (np.pi**2 * NEGLECTED_ENERGY["uniform"]) * null_m / bin_size_m)) + 1
    return min(MAX_HALF_LENGTH, bins)


@lru_cache(maxsize=16)
def bin_weights(
    bin_size_m: float, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0
) -> np.ndarray:
    """Return what the matched filter puts of a bin's echo into the bins around it.

    The echo of a bin is spread evenly over it, and the receiver samples at the centres of bins: each share is thus
    the power response integrated over one bin. For bins much coarser than c/2B the result is nearly [1]. Side lobes
    are left out from where their envelope falls below −50 dB: NEGLECTED_ENERGY of all.

    The level of a receiver is that of the echo in its resolution cell. A bin that is longer than the cell holds its
    own echo, and the sum of the weights is 1. A shorter bin holds only a part of the cell's echo, and the sum is the
    cell over the bin: the level does not depend on the size of the bins.

    Returns (n,) float32, n odd, symmetric, sum 1 or more, read-only.

    bin_size_m : length of a bin, metres
    bandwidth_hz, taper, sound_speed_m_s : as for `amplitude_response`

    >>> bin_weights(0.05, 30e3, "hamming")[6:9].astype(float).round(3).tolist()  # the middle ones of 15
    [0.028, 0.944, 0.028]
    """
    null_m = _null_m(bandwidth_hz, sound_speed_m_s)
    cell_m = resolution_cell_m(bandwidth_hz, taper, sound_speed_m_s)
    half_length = _sufficient_half_length(bin_size_m, null_m)
    intervals = int(np.ceil(INTERVALS_PER_NULL * bin_size_m / null_m))
    if intervals > MAX_HALF_LENGTH:
        return _read_only_float32(np.ones(1))
    width = bin_size_m / intervals
    half = np.zeros(half_length + 1)
    for interval in range(intervals):
        middle = (np.arange(half_length + 1) - 0.5) * bin_size_m + (interval + 0.5) * width
        for node, weight in zip(*GAUSS_LEGENDRE, strict=True):
            r = middle + node * width / 2
            half += weight * width / 2 * amplitude_response(r, bandwidth_hz, taper, sound_speed_m_s) ** 2
    kernel = _symmetric(half[: _half_length_within(half, (1 - NEGLECTED_ENERGY[taper]) * cell_m) + 1])
    return _read_only_float32(kernel / kernel.sum() * max(1.0, cell_m / bin_size_m))


def _aliased_power(f: np.ndarray, ratio: float, series: tuple[float, ...]) -> np.ndarray:
    """Return the power spectrum of noise at the centres of bins that are `ratio` times c/2B long.

    f : frequencies, in cycles per bin, within half a cycle
    """
    power = np.zeros_like(f)
    for alias in range(-int(min(ratio, 64)), int(min(ratio, 64)) + 1):
        z = (f + alias) / ratio  # in bandwidths
        power += np.where(np.abs(z) <= 0.5, aperture_weights(z, series) ** 2, 0.0)
    return power


@lru_cache(maxsize=16)
def _coarse_table(ratio: float, taper: str) -> tuple[np.ndarray, np.ndarray]:
    """Return distances in bins, 0 or more, and the response of `coarse_weights` at them."""
    f = (np.arange(512) + 0.5) / 1024  # in cycles per bin
    root = np.sqrt(_aliased_power(f, ratio, PULSE_TAPERS[taper]))
    bins = np.arange(MAX_COARSE * COARSE_POINTS + 1) / COARSE_POINTS
    phases = np.outer(bins, f)
    phases *= 2 * np.pi
    return bins, np.cos(phases, out=phases) @ root


def is_coarse(bin_size_m: float, bandwidth_hz: float, taper: str, sound_speed_m_s: float) -> bool:
    """Return whether bins are c/2B long or longer, so that they alias the spectrum."""
    return bin_size_m >= (1 - 1e-9) * _null_m(bandwidth_hz, sound_speed_m_s)


@lru_cache(maxsize=16)
def coarse_reach(
    bin_size_m: float, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0
) -> int:
    """Return how many bins `coarse_weights` count on each side, MIN_COARSE to MAX_COARSE.

    Those beyond have NEGLECTED_COARSE of the power.

    >>> coarse_reach(0.034, 30e3, "hamming"), coarse_reach(0.034, 30e3)
    (4, 14)
    """
    bins, response = _coarse_table(bin_size_m / _null_m(bandwidth_hz, sound_speed_m_s), taper)
    half = response[(bins % 1) == 0.5] ** 2  # midway between bins, where it reaches furthest
    beyond = 1 - np.cumsum(half) / half.sum()
    reach = int(np.argmax(beyond <= NEGLECTED_COARSE)) + 1
    return max(MIN_COARSE, reach + reach % 2)


def coarse_weights(
    bins, bin_size_m: float, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0
) -> np.ndarray:
    """Return weights that move noise by parts of a bin, and correlate it as the pulse does: for bins of c/2B or more.

    The noise is independent from bin to bin. Samples of the amplitude response would not do: they alias amplitudes,
    whereas in noise powers alias. The response is that of `field_weights`, at any distance.

    Returns float64, of the shape of `bins`, of any common scale.

    bins : distances in bins, any shape
    bin_size_m, bandwidth_hz, taper, sound_speed_m_s : as for `bin_weights`

    >>> w = coarse_weights(np.arange(-2, 3), 0.025, 30e3)
    >>> np.abs(w / w[2]).round(3).tolist()  # the band of 25 mm is full
    [0.0, 0.0, 1.0, 0.0, 0.0]
    """
    table = _coarse_table(bin_size_m / _null_m(bandwidth_hz, sound_speed_m_s), taper)
    return np.interp(np.abs(bins), *table)


@lru_cache(maxsize=16)
def field_weights(
    bin_size_m: float, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0
) -> np.ndarray:
    """Return the kernel that correlates noise, independent from bin to bin, as the pulse does.

    It is the amplitude response at the centres of bins, of unit power. The outermost values are left out: 1e-4 of
    its power, or what lies beyond 50 c/2B. Bins coarser than c/2B alias the spectrum; the kernel is then the
    response of the root of the aliased power spectrum, so that the correlation over bins stays that of fine bins,
    sinc x for "uniform".

    Returns (n,) float32, n odd, symmetric, sum of squares 1, read-only.

    bin_size_m, bandwidth_hz, taper, sound_speed_m_s : as for `bin_weights`

    >>> field_weights(0.025, 30e3).tolist()
    [1.0]
    """
    null_m = _null_m(bandwidth_hz, sound_speed_m_s)
    ratio, series = bin_size_m / null_m, PULSE_TAPERS[taper]
    half_length = _sufficient_half_length(bin_size_m, null_m)
    if ratio <= 1:
        r = np.arange(half_length + 1) * bin_size_m
        half = amplitude_response(r, bandwidth_hz, taper, sound_speed_m_s)
    else:
        n, k = 4096, np.arange(half_length + 1)
        f = (np.arange(n) + 0.5) / n - 0.5  # in cycles per bin
        power = _aliased_power(f, ratio, series)
        # sums of cos 2πkf times the root
        half = (np.exp(1j * np.pi * k * (1 - 1 / n)) * np.fft.rfft(np.sqrt(power))[k]).real
    half = np.where(np.abs(half) < 1e-9 * half[0], 0.0, half)  # nulls are exactly 0
    total_power = half[0] ** 2 + 2 * (half[1:] ** 2).sum()
    half_length = _half_length_within(half**2, (1 - NEGLECTED_POWER) * total_power)
    half_length = min(half_length, int(MAX_FIELD_NULLS / min(ratio, 1)))
    kernel = _symmetric(half[: half_length + 1])
    return _read_only_float32(kernel / np.sqrt((kernel**2).sum()))


def _read_only_float32(kernel: np.ndarray) -> np.ndarray:
    kernel = kernel.astype(np.float32)
    kernel.setflags(write=False)
    return kernel


@compiled
def _is_silent(bits):
    """Return whether float32 numbers, (n,) given as int32, are all 0."""
    found = 0
    for k in range(uint64(len(bits))):
        found |= bits[k]
    return found == 0


@compiled
def _convolve(rows, before, weights, out):
    """Convolve rows (R, L), with `before` zeros before each and zeros behind, with n weights into out (R, K).

    n is a multiple of 4. Zeros at both ends of a row are left out, since specular echoes fill few bins.
    """
    last, length, n = uint64(out.shape[1]), uint64(rows.shape[1]), uint64(len(weights))
    # one row stays in the cache
    row = np.zeros(max(last, length + uint64(before)) + n, np.float32)
    for r in range(uint64(len(rows))):
        from_, bits = rows[r], rows[r].view(np.int32)
        start, end = uint64(0), length
        while start < end and _is_silent(bits[start : min(start + SILENCE, end)]):
            start += SILENCE
        while start < end and _is_silent(bits[max(start + SILENCE, end) - SILENCE : end]):
            end = max(start + SILENCE, end) - SILENCE
        for k in range(length):
            row[uint64(before) + k] = from_[k]
        for k in range(last):
            out[r, k] = 0
        end = min(end + uint64(before), last)
        start = min(start + uint64(before) - min(start + uint64(before), n - uint64(1)), end)
        to, near = out[r, start:end], row[start:]
        # four at a time, since out is then read and written less often
        for j in range(uint64(0), n, uint64(4)):
            a, b, c, d = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
            one, two, three, four = near[j:], near[j + 1 :], near[j + 2 :], near[j + 3 :]
            for k in range(end - start):
                to[k] += a * one[k] + b * two[k] + c * three[k] + d * four[k]


def convolve(
    rows: np.ndarray, weights: np.ndarray, before: int = 0, after: int = 0, thread: SecondThread | None = None
) -> np.ndarray:
    """Return rows convolved with weights, without the ends.

    Returns (R, before + L + after − n + 1) float32.

    rows : (R, L) float32
    weights : (n,) float32, symmetric
    before, after : zeros that are thought before and behind each row
    thread : does half of the rows, unless they are few
    """
    n = len(weights)
    out = np.empty((len(rows), before + rows.shape[1] + after - n + 1), np.float32)
    weights = np.concatenate([weights, np.zeros(-n % 4, np.float32)])

    def work(part: slice) -> None:
        _convolve(rows[part], before, weights, out[part])

    run_rows(thread if n * out.size > FEW_PRODUCTS else None, work, len(rows))
    return out


def matched_filter(
    intensity: np.ndarray, weights: np.ndarray, thread: SecondThread | None = None
) -> np.ndarray:
    """Return echoes spread along range by the pulse; energy that leaves the first or the last bin is lost.

    Returns (B, K) float32, linear power.

    intensity : (B, K) float32, linear power
    weights : (n,) float32 of `bin_weights`, any odd n
    thread : does half of the beams, unless they are few

    >>> matched_filter(np.float32([[0, 0, 4, 0]]), np.float32([0.25, 0.5, 0.25])).tolist()
    [[0.0, 1.0, 2.0, 1.0]]
    """
    centre = len(weights) // 2
    half_length = min(centre, intensity.shape[1] - 1)
    weights = weights[centre - half_length : centre + half_length + 1]
    return convolve(intensity, weights, before=half_length, after=half_length, thread=thread)
