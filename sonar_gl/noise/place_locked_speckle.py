"""Place-locked (spatially coherent) speckle: a field that the sonar's pose alone determines."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from itertools import product
from threading import Lock
from typing import NamedTuple

import numpy as np
from numba import float32, uint64

from sonar_gl.acoustics.pulse import PulseResponse, amplitude_response
from sonar_gl.core.compiled import compiled
from sonar_gl.core.worker import held
from sonar_gl.noise.gaussian import standard_normal
from sonar_gl.noise.speckle import FieldCorrelation, aperture_weights, aperture_width

# Side of the square cells of the sea, each with independent waves. Their middles lie at whole multiples of it, since
# sonars often lie at the origin or at round numbers: one cell makes the field there, at corners four do.
CELL_M = 0.5
FADE_M = 0.1  # width of the cross-fade between two cells
CHUNK = 64  # waves per random stream
# Nodes between which the fields of beams are interpolated: nodes per period of the field, nodes that count, shape
# of the Kaiser window, and how many for each beam are worth it.
OVERSAMPLING, TAPS, KAISER, MOST_NODES = 2.0, 8, 5.3, 0.8
# least number of waves in an aperture; the outermost count in part, so that it slides smoothly
MIN_WAVES = 64


class Cell(NamedTuple):
    """A cell of the sea along one axis.

    Attributes
    ----------
    number : whole number of the cell
    offset_m : the sonar's distance from the cell's middle, metres, signed
    amplitude : weight of the cell's field; squares add up to 1
    """

    number: int
    offset_m: float
    amplitude: float


def _cells_at(position_m: float) -> list[Cell]:
    """Return the cell at a position along one axis, or two of them within the cross-fade."""
    u = position_m / CELL_M
    cell = int(np.floor(u))
    share = min(max((u - cell - 0.5) * CELL_M / FADE_M + 0.5, 0.0), 1.0)
    both = ((cell, np.cos(share * np.pi / 2)), (cell + 1, np.sin(share * np.pi / 2)))
    return [Cell(c, position_m - c * CELL_M, float(w)) for c, w in both if w > 1e-6]


def _shift_weights(
    correlation: FieldCorrelation, shift_bins: np.ndarray, response
) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolation that moves the fields of B beams along range.

    Parameters
    ----------
    shift_bins : (B,) bins
    response : function of bins, the pulse's amplitude response; None interpolates linearly

    Returns
    -------
    weights : (B, n) float32 of unit power
    first : (B,) int64, bins from a bin to the first one that is weighted
    """
    first = np.floor(shift_bins).astype(np.int64)
    fraction = (shift_bins - first)[:, None]
    if response is None:
        weights = np.hstack([1 - fraction, fraction])
    else:
        reach = len(correlation.pulse_weights) // 2 + 1
        first -= reach
        weights = response(fraction - np.arange(-reach, reach + 1))
    return (weights / np.sqrt((weights**2).sum(1, keepdims=True))).astype(np.float32), first


class Nodes(NamedTuple):
    """Azimuths at which fewer fields than beams tell those of all beams, and how to interpolate them.

    Attributes
    ----------
    azimuth_rad : (N,) radians in the world, on a grid that does not depend on the sonar's heading
    first, weights : (B,) int64 and (B, TAPS) float32: the first of the nodes about each beam, and their weights
    span_rad : the greatest distance of the first and the last of them, at any heading
    """

    azimuth_rad: np.ndarray
    first: np.ndarray
    weights: np.ndarray
    span_rad: float


def _nodes(
    heading_rad: float, beams_rad: np.ndarray, width_rad: float, taper_series: tuple[float, ...]
) -> Nodes | None:
    """Return the nodes of a sonar; None where they would hardly be fewer than its (B,) beams, at any heading.

    Notes
    -----
    An aperture limits the field to one period per width / aperture_width() radians. OVERSAMPLING times as many nodes
    are interpolated by a sinc in a Kaiser window [1]_, which errs by 58 dB less than the field.

    References
    ----------
    .. [1] Oppenheim, Schafer, Discrete-Time Signal Processing, 3rd ed., 2010, section 7.5.3
    """
    n_circle = int(np.ceil(OVERSAMPLING * aperture_width(taper_series) * 2 * np.pi / width_rad))
    step = 2 * np.pi / n_circle
    most = int(np.ceil(np.ptp(beams_rad) / step)) + TAPS
    if most > MOST_NODES * len(beams_rad):
        return None
    place = (heading_rad + beams_rad) / step
    first = np.floor(place).astype(np.int64) - (TAPS // 2 - 1)
    numbers = np.arange(first.min(), first.max() + TAPS)
    off = place[:, None] - first[:, None] - np.arange(TAPS)
    window = np.i0(KAISER * np.sqrt(np.maximum(1 - (2 * off / TAPS) ** 2, 0)))
    weights = np.sinc(off) * window
    weights /= weights.sum(1, keepdims=True)
    return Nodes(numbers * step, first - first.min(), weights.astype(np.float32), (most - 1) * step)


@compiled
def _interpolate(fields, first, weights, out):
    """Fill out (B, 2, K) with the fields (N, 2, K) of nodes, interpolated by weights (B, TAPS) from `first` on."""
    n_bins = uint64(out.shape[2])
    for b in range(uint64(len(out))):
        for part in range(2):
            to = out[b, part]
            for k in range(n_bins):
                to[k] = float32(0)
            for t in range(uint64(weights.shape[1])):
                a, row = weights[b, t], fields[uint64(first[b] + t), part]
                for k in range(n_bins):
                    to[k] += a * row[k]


@compiled
def _sum_waves(coefficients, start, real, imaginary, shift, weights, out):
    """Add to out (B, 2, K) the waves that the aperture of each beam receives, shifted along range.

    Parameters
    ----------
    coefficients : (M, 2, N) float32, complex amplitudes of M waves at N bins
    start : (B,) number of each beam's first wave
    real, imaginary : (B, W) float32, weights of each beam's W waves, W even
    shift, weights : (B,) and (B, n), of `_shift_weights`
    """
    n_bins = uint64(out.shape[2])
    last = n_bins + uint64(weights.shape[1] - 1)  # bins that the interpolation takes
    row = np.empty((2, last), np.float32)
    for b in range(uint64(len(out))):
        first, past = uint64(shift[b]), uint64(shift[b]) + last
        for k in range(last):
            row[0, k] = float32(0)
            row[1, k] = float32(0)
        for w in range(uint64(0), uint64(real.shape[1]), uint64(2)):  # two at a time: sums stay in registers
            c, s, d, t = real[b, w], imaginary[b, w], real[b, w + 1], imaginary[b, w + 1]
            one, other = coefficients[uint64(start[b] + w)], coefficients[uint64(start[b] + w + 1)]
            x, y, p, q = one[0, first:past], one[1, first:past], other[0, first:past], other[1, first:past]
            for k in range(last):
                row[0, k] += (c * x[k] - s * y[k]) + (d * p[k] - t * q[k])
                row[1, k] += (c * y[k] + s * x[k]) + (d * q[k] + t * p[k])
        for j in range(uint64(weights.shape[1])):
            a, x = weights[b, j], row[:, uint64(j) :]
            for part in range(2):
                for k in range(n_bins):
                    out[b, part, k] += a * x[part, k]


RECENT_USES = 8  # of waves: two pings take those of four cells each


class Waves(NamedTuple):
    """Random waves of a cell of the sea.

    Attributes
    ----------
    chunks : their numbers, CHUNK waves each
    coefficients : (waves, 2, bins) float32, complex amplitudes, read-only
    """

    chunks: range
    coefficients: np.ndarray


class WaveCache:
    """The waves that the last pings received: those of a sonar that moves are mostly the same.

    Those that were not used for longest make room, unless that was a moment ago: of cells that are used in turn and do
    not all fit, each would go just before it is used again.

    Parameters
    ----------
    max_bytes : of the waves that it keeps
    """

    def __init__(self, max_bytes: int):
        self._max_bytes, self._lock = max_bytes, Lock()
        # with the number of their last use
        self._cells: OrderedDict[Hashable, tuple[int, Waves]] = OrderedDict()
        self._n_uses = 0

    def waves(self, key: Hashable, chunks: range, n_bins: int, generator) -> Waves:
        """Return waves of a cell: these chunks, or more.

        Parameters
        ----------
        key : with `n_bins` what determines the waves, besides the numbers of their chunks
        generator : function (chunk) -> numpy.random.Generator
        """
        key = key, n_bins
        with held(self._lock):
            _, old = self._cells.get(key, (0, None))
        if old is None or chunks.start < old.chunks.start or old.chunks.stop < chunks.stop:
            found = Waves(chunks, np.empty((len(chunks) * CHUNK, 2, n_bins), np.float32))
            for chunk in chunks:
                known = old is not None and chunk in old.chunks
                _chunk_of(found, chunk)[:] = (
                    _chunk_of(old, chunk) if known else standard_normal(generator(chunk), (CHUNK, 2, n_bins))
                )
            found.coefficients.setflags(write=False)
        else:
            found = old
        with held(self._lock):
            self._n_uses += 1
            self._cells.pop(key, None)
            if self._make_room(found.coefficients.nbytes):
                self._cells[key] = self._n_uses, found
        return found

    def _make_room(self, n_bytes: int) -> bool:
        """Return whether so many bytes fit, after those have gone that may go."""
        room = self._max_bytes - n_bytes - sum(waves.coefficients.nbytes for _, waves in self._cells.values())
        while room < 0 and self._cells:
            last_use, oldest = next(iter(self._cells.values()))
            if last_use > self._n_uses - RECENT_USES:
                return False
            room += oldest.coefficients.nbytes
            self._cells.popitem(last=False)
        return room >= 0


def _chunk_of(waves: Waves, chunk: int) -> np.ndarray:
    """Return the coefficients of a chunk."""
    first = (chunk - waves.chunks.start) * CHUNK
    return waves.coefficients[first : first + CHUNK]


def place_locked_field(
    correlation: FieldCorrelation,
    n_bins: int,
    bin_size_m: float,
    wavelength_m: float,
    pose,
    waves_of: Callable[[int, int, range, int], Waves],
    pulse: PulseResponse | None = None,
) -> np.ndarray:
    """Return a complex Gaussian field of unit variance that the sonar's pose alone determines.

    Parameters
    ----------
    correlation : its beams have a width; of its pulse weights only the length counts
    n_bins, bin_size_m, wavelength_m : K, metres, metres
    pose : (4, 4) world_from_sonar, or its first two rows; its heading and its horizontal position count
    waves_of : function (cell x, cell y, chunks, number of bins) of those waves, or more
    pulse : PulseResponse; None without one

    Returns
    -------
    (B, 2, K) float32, real and imaginary parts

    Notes
    -----
    Random waves from all directions of the circle lie on a line through the sonar. They are fixed in the
    world, and a beam receives them through its aperture, at its azimuth in the world.

    - Turning by the spacing of two beams moves the pattern by one beam.
    - Moving across a beam by d slides the aperture by 2 d, since transmitter and receiver both move: of a
      uniform array of length L, (1 − 2d/L)² of the intensity's variance stays correlated.
    - Moving along a beam by d moves its pattern by d in range.

    The cells of the sea, CELL_M wide, have independent waves and cross-fade, so patterns farther apart than a
    cell are uncorrelated. Pitch, roll and heave leave the pattern as it is. As an approximation, the bearing
    of a scatterer does not change as the sonar passes it; near ones would move by d / r.
    """
    heading, beams = np.arctan2(pose[1, 0], pose[0, 0]), np.asarray(correlation.azimuth_rad)
    width, taper_series = correlation.beam_width_rad, correlation.taper_series
    nodes = _nodes(heading, beams, width, taper_series)
    azimuth, span = (heading + beams, np.ptp(beams)) if nodes is None else (nodes.azimuth_rad, nodes.span_rad)
    # number of waves in an aperture, if the field repeats after one full circle ...
    waves = aperture_width(taper_series) * 2 * np.pi / width
    # ... and after the `repeats`-th part of it, which must be longer than the fan; the same at any heading
    repeats = max(1, int(min(2 * np.pi / (1.2 * span + 12 * width), waves / MIN_WAVES)))
    length = waves / repeats
    spacing_m = wavelength_m * repeats / (2 * np.pi)
    response, reach = None, 1
    if pulse is not None and correlation.pulse_weights is not None:
        reach = len(correlation.pulse_weights) // 2 + 2

        def response(bins):
            return amplitude_response(bins * bin_size_m, *pulse)

    margin = int(np.ceil(CELL_M / bin_size_m)) + reach
    out = np.zeros((len(azimuth), 2, n_bins), np.float32)
    for (cx, x, wx), (cy, y, wy) in product(_cells_at(pose[0, 3]), _cells_at(pose[1, 3])):
        along_m = x * np.cos(azimuth) + y * np.sin(azimuth)
        across_m = y * np.cos(azimuth) - x * np.sin(azimuth)
        middle = 2 * across_m / spacing_m
        start = np.ceil(middle - length / 2 - 0.5).astype(np.int64)
        n_waves = int(np.ceil(length)) + 1
        waves = start[:, None] + np.arange(n_waves + n_waves % 2)
        position = waves - middle[:, None]
        weight = np.clip(length / 2 + 0.5 - np.abs(position), 0, 1)  # the outermost waves count in part
        weight *= aperture_weights(np.clip(position / length, -0.5, 0.5), taper_series)
        weight *= wx * wy * np.sqrt(0.5 / (weight**2).sum(1, keepdims=True))
        # Less the phase of the way from the cell's middle to the sonar and back. The field of a cell would else turn by
        # that from beam to beam, each cell by its own, and neighbours would not correlate where cells cross-fade.
        phase = waves * repeats * azimuth[:, None] - (4 * np.pi / wavelength_m * along_m)[:, None]
        chunks = range(int(waves.min()) // CHUNK, int(waves.max()) // CHUNK + 1)
        chunks, coefficients = waves_of(cx, cy, chunks, n_bins + 2 * margin)
        weights, shift = _shift_weights(correlation, along_m / bin_size_m, response)
        matrix = (weight * np.cos(phase)).astype(np.float32), (weight * np.sin(phase)).astype(np.float32)
        _sum_waves(coefficients, start - chunks.start * CHUNK, *matrix, shift + margin, weights, out)
    if nodes is None:
        return out
    fields, out = out, np.empty((len(beams), 2, n_bins), np.float32)
    _interpolate(fields, nodes.first, nodes.weights, out)
    return out
