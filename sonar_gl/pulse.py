"""How a pulse of finite bandwidth blurs range: its matched filter's response, over bins."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import uint64

from sonar_gl.compiled import compiled
from sonar_gl.patterns import HAMMING, aperture_field
from sonar_gl.types import Error, nearest_names

# F₁, F₂, … of a spectrum weighed by 1 + 2 Σ F_m cos(2πmf/B), |f| <= B/2
PULSE_TAPERS = {"uniform": (), "hamming": (HAMMING,)}
REST = 1e-3  # share of the energy that may lie outside a kernel
FIELD_REST, FIELD_NULLS = 1e-4, 50  # the same of a field, or where it ends anyway, in c/2B
PIECES = 2  # of c/2B, integrated over by so many nodes each: to 1e-9
NODES = np.polynomial.legendre.leggauss(8)
LONGEST = 1 << 16  # bins to each side that a kernel may have


def _series(taper: str) -> tuple[float, ...]:
    if taper not in PULSE_TAPERS:
        raise Error(f"pulse: unknown taper (got {taper!r}; {nearest_names(str(taper), PULSE_TAPERS)})")
    return PULSE_TAPERS[taper]


def _null_m(bandwidth_hz: float, sound_speed_m_s: float) -> float:
    """c/2B, metres: from the peak to the first null of the untapered response."""
    for name, value in (("bandwidth_hz", bandwidth_hz), ("sound_speed_m_s", sound_speed_m_s)):
        if not 0 < value < np.inf:  # NaN too
            raise Error(f"pulse: {name} must be a number above 0 (got {value:g})")
    return sound_speed_m_s / (2 * bandwidth_hz)


def amplitude_response(range_m, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0):
    """Amplitude of a point's echo so far from its range, after a matched filter; real, 1 at 0, float64.

    Parameters
    ----------
    range_m : metres from the point's range, any shape
    bandwidth_hz : of the pulse, evenly filled, hertz
    taper : "uniform": sinc x with x = 2 B r / c, −3 dB width 0.8859 c/2B, side lobes at −13.3 dB;
        "hamming": the spectrum weighed by 0.54 + 0.46 cos(2πf/B), width 1.303 c/2B, side lobes at −42.7 dB

    The Fourier transform of the spectrum: sinc x + Σ F_m (sinc(x − m) + sinc(x + m)). Raises Error if the
    taper is unknown, or a number is not above 0.
    Source: Cook, Bernfeld, Radar Signals, 1967; Harris, "On the use of windows for harmonic analysis with the
    discrete Fourier transform", Proc. IEEE 66, 51-83, 1978

    >>> round(float(amplitude_response(0.885893 / 2 * 0.025, 30e3) ** 2), 5)  # c/2B is 25 mm
    0.5
    """
    x = np.asarray(range_m, np.float64) / _null_m(bandwidth_hz, sound_speed_m_s)
    return aperture_field(x, _series(taper))


def _bins_within(half: np.ndarray, share: float) -> int:
    """Bins to each side that hold this much of the energy, given at 0, 1, … bins."""
    inside = half[0] + 2 * np.concatenate([[0.0], np.cumsum(half[1:])])
    return min(int(np.searchsorted(inside, share)), len(half) - 1)


def _mirrored(half: np.ndarray) -> np.ndarray:
    return np.concatenate([half[:0:-1], half])


def _reach(bin_size_m: float, null_m: float) -> int:
    """Bins to each side that surely hold all but REST: past x the energy of sinc² is 1/π²x."""
    if not 0 < bin_size_m < np.inf:  # NaN too
        raise Error(f"pulse: bin_size_m must be a number above 0 (got {bin_size_m:g})")
    return min(LONGEST, int(np.ceil(1.1 / (np.pi**2 * REST) * null_m / bin_size_m)) + 1)


@lru_cache(maxsize=16)
def bin_weights(
    bin_size_m: float, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0
) -> np.ndarray:
    """Shares of a bin's echo that come out in the bins about it, sum 1: (n,) float32, n odd, symmetric.

    What a bin holds is spread evenly over it, and the receiver reads at bins' centres: so each share is the
    power response integrated over one bin. Bins much coarser than c/2B give nearly [1]. Shares beyond those
    that hold all but 1e-3 are left out.

    Parameters
    ----------
    bin_size_m : length of a bin, metres
    bandwidth_hz, taper, sound_speed_m_s : of `amplitude_response`

    >>> bin_weights(0.025, 30e3, "hamming").astype(float).round(3).tolist()
    [0.001, 0.176, 0.647, 0.176, 0.001]
    """
    null_m, series = _null_m(bandwidth_hz, sound_speed_m_s), _series(taper)
    whole = null_m * (1 + 2 * sum(share**2 for share in series))  # Parseval
    reach = _reach(bin_size_m, null_m)
    pieces = int(np.ceil(PIECES * bin_size_m / null_m))
    if pieces > LONGEST:
        return _frozen(np.ones(1))
    width = bin_size_m / pieces
    half = np.zeros(reach + 1)
    for piece in range(pieces):
        middle = (np.arange(reach + 1) - 0.5) * bin_size_m + (piece + 0.5) * width
        for node, weight in zip(*NODES, strict=True):
            r = middle + node * width / 2
            half += weight * width / 2 * amplitude_response(r, bandwidth_hz, taper, sound_speed_m_s) ** 2
    kernel = _mirrored(half[: _bins_within(half, (1 - REST) * whole) + 1])
    return _frozen(kernel / kernel.sum())


@lru_cache(maxsize=16)
def field_weights(
    bin_size_m: float, bandwidth_hz: float, taper: str = "uniform", sound_speed_m_s: float = 1500.0
) -> np.ndarray:
    """What turns noise that differs from bin to bin into a field that the pulse correlates: (n,) float32.

    The amplitude response at bins, of unit power, n odd, symmetric; the last 1e-4 of its power is left out,
    or what lies beyond 50 c/2B. Bins coarser than c/2B see the spectrum folded, and the response is that of
    its root: so the correlation over bins stays what it is for fine ones, sinc x for "uniform".

    Parameters
    ----------
    bin_size_m, bandwidth_hz, taper, sound_speed_m_s : of `bin_weights`

    >>> field_weights(0.025, 30e3).tolist()
    [1.0]
    """
    null_m = _null_m(bandwidth_hz, sound_speed_m_s)
    ratio, series = bin_size_m / null_m, _series(taper)
    reach = _reach(bin_size_m, null_m)
    if ratio <= 1:
        half = amplitude_response(np.arange(reach + 1) * bin_size_m, bandwidth_hz, taper, sound_speed_m_s)
    else:
        f = (np.arange(4096) + 0.5) / 4096 - 0.5  # in cycles a bin
        power = np.zeros_like(f)
        for fold in range(-int(min(ratio, 64)), int(min(ratio, 64)) + 1):
            z = (f + fold) / ratio  # in bandwidths
            taper_at = 1 + 2 * sum(share * np.cos(2 * np.pi * m * z) for m, share in enumerate(series, 1))
            power += np.where(np.abs(z) <= 0.5, taper_at**2, 0.0)
        half = np.cos(2 * np.pi * np.outer(np.arange(reach + 1), f)) @ np.sqrt(power)
    half = np.where(np.abs(half) < 1e-9 * half[0], 0.0, half)  # nulls are nulls
    whole = half[0] ** 2 + 2 * (half[1:] ** 2).sum()
    reach = min(_bins_within(half**2, (1 - FIELD_REST) * whole), int(FIELD_NULLS / min(ratio, 1)))
    kernel = _mirrored(half[: reach + 1])
    return _frozen(kernel / np.sqrt((kernel**2).sum()))


def _frozen(kernel: np.ndarray) -> np.ndarray:
    kernel = kernel.astype(np.float32)
    kernel.setflags(write=False)
    return kernel


@compiled
def _convolve(rows, weights, out):
    """out (R, K) = rows (R, K + n − 1) weighed over n neighbours. n is a multiple of 4."""
    last = uint64(out.shape[1])
    for r in range(uint64(len(rows))):
        row, to = rows[r], out[r]
        for k in range(last):
            to[k] = 0
        for j in range(0, uint64(len(weights)), 4):  # four at a time: out is read and written less often
            a, b, c, d = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
            one, two, three, four = row[j:], row[j + 1 :], row[j + 2 :], row[j + 3 :]
            for k in range(last):
                to[k] += a * one[k] + b * two[k] + c * three[k] + d * four[k]


def convolve(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(R, K) float32: rows (R, K + n − 1) weighed over n neighbours by (n,) weights, float32 both."""
    n, spare = len(weights), -len(weights) % 4
    out = np.empty((len(rows), rows.shape[1] - n + 1), np.float32)
    padded = np.zeros((len(rows), rows.shape[1] + spare), np.float32)
    padded[:, : rows.shape[1]] = rows
    _convolve(padded, np.concatenate([weights, np.zeros(spare, np.float32)]), out)
    return out


def smear(intensity: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Echoes as the pulse blurs them along range: (B, K) float32; what leaves the ends is lost.

    Parameters
    ----------
    intensity : (B, K) float32, linear power
    weights : (n,) float32 of `bin_weights`, any odd n

    >>> smear(np.float32([[0, 0, 4, 0]]), np.float32([0.25, 0.5, 0.25])).tolist()
    [[0.0, 1.0, 2.0, 1.0]]
    """
    B, K = intensity.shape
    reach = min(len(weights) // 2, K - 1)
    weights = weights[len(weights) // 2 - reach : len(weights) // 2 + reach + 1]
    padded = np.zeros((B, K + 2 * reach), np.float32)
    padded[:, reach : reach + K] = intensity
    return convolve(padded, weights)
