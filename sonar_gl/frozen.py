"""Speckle that belongs to the place: a field that depends on the sonar's pose, not on the ping's number."""

from __future__ import annotations

from itertools import product

import numpy as np
from numba import float32, uint64

from sonar_gl.compiled import compiled
from sonar_gl.normals import standard_normal
from sonar_gl.pulse import amplitude_response
from sonar_gl.speckle import Array, aperture_weights, aperture_width

CELL_M = 0.5  # side of the squares of the sea, each of which has waves of its own
FADE_M = 0.1  # between two of them
CHUNK = 64  # waves that one stream of random numbers gives
WAVES = 64  # that an aperture hears at least, so that it slides smoothly: those at its ends count in part


def _anchors(place_m: float) -> list[tuple[int, float, float]]:
    """Cells along one axis: number, metres from its middle, amplitude; powers add up to 1."""
    u = place_m / CELL_M - 0.5
    cell = int(np.floor(u))
    share = min(max((u - cell - 0.5) * CELL_M / FADE_M + 0.5, 0.0), 1.0)
    both = ((cell, np.cos(share * np.pi / 2)), (cell + 1, np.sin(share * np.pi / 2)))
    return [(c, place_m - (c + 0.5) * CELL_M, float(w)) for c, w in both if w > 1e-6]


def _fraction_weights(array: Array, shift_bins: np.ndarray, response) -> tuple[np.ndarray, np.ndarray]:
    """(B, n) float32 of unit power that move a field by whole bins (B,) and what is left, and those bins."""
    whole = np.floor(shift_bins).astype(np.int64)
    rest = (shift_bins - whole)[:, None]
    if response is None:  # straight lines between two bins
        weights = np.hstack([1 - rest, rest])
    else:
        reach = len(array.along) // 2 + 1
        whole -= reach
        weights = response(rest - np.arange(-reach, reach + 1))
    return (weights / np.sqrt((weights**2).sum(1, keepdims=True))).astype(np.float32), whole


@compiled
def _sound(coefficients, first, start, real, imaginary, shift, weights, out):
    """Add to out (B, 2, K) what each beam hears of the waves' (M, 2, N) coefficients, moved along range.

    first : number of the first wave there; start : (B,) number of a beam's first
    real, imaginary : (B, W) of its W waves; shift : (B,) bins; weights : (B, n) over n bins
    """
    row = np.empty((2, coefficients.shape[2]), np.float32)
    last, n_bins = uint64(coefficients.shape[2]), uint64(out.shape[2])
    for b in range(uint64(len(out))):
        for k in range(last):
            row[0, k] = float32(0)
            row[1, k] = float32(0)
        for w in range(uint64(real.shape[1])):
            c, s = real[b, w], imaginary[b, w]
            if c == 0 and s == 0:
                continue
            wave = coefficients[uint64(start[b] - first + w)]
            x, y = wave[0], wave[1]
            for k in range(last):
                row[0, k] += c * x[k] - s * y[k]
                row[1, k] += c * y[k] + s * x[k]
        for j in range(uint64(weights.shape[1])):
            a, x = weights[b, j], row[:, uint64(shift[b] + j) :]
            for part in range(2):
                for k in range(n_bins):
                    out[b, part, k] += a * x[part, k]


def frozen_field(array: Array, n_bins: int, bin_size_m: float, wavelength_m: float, pose, random, pulse=None):
    """A complex Gaussian field of unit variance that the pose alone decides: (B, 2, K) float32.

    Parameters
    ----------
    array : its beams have a width; `along` only tells how many bins the pulse spans
    n_bins, bin_size_m, wavelength_m : K, metres, metres
    pose : (4, 4) world_from_sonar; heading and place in the plane count
    random : function (cell x, cell y, chunk) -> numpy.random.Generator
    pulse : None, or (bandwidth_hz, taper, sound_speed_m_s) of `pulse.amplitude_response`

    Notes
    -----
    A frozen field of waves lies on a line through the sonar, of all directions of the circle; a beam hears it
    with its aperture, at its azimuth in the world. So turning by a beam's spacing moves the pattern by a
    beam. Going aside of a beam by d slides the aperture by 2 d, for transmitter and receiver both move:
    of a uniform array of length L what is alike is (1 − 2d/L)² of the intensity's variance. Going along
    the beam by d moves its pattern by d in range. Sideways and along are those of each beam.
    Waves belong to squares of the sea, CELL_M wide, and fade one into the other: farther than that nothing
    is alike. Pitch, roll and heave leave the pattern as it is, and things do not change their bearing as the
    sonar passes them (near ones would, by d / r).
    """
    azimuth = np.arctan2(pose[1, 0], pose[0, 0]) + np.asarray(array.azimuth_rad)
    width = array.beam_width_rad
    # in an aperture, if they are alike after a circle
    waves = aperture_width(array.series) * 2 * np.pi / width
    turns = max(1, int(min(2 * np.pi / (1.2 * np.ptp(azimuth) + 12 * width), waves / WAVES)))
    length = waves / turns  # for they are so `turns` times in it
    spacing_m = wavelength_m * turns / (2 * np.pi)
    response, reach = None, 1
    if pulse is not None and array.along is not None:
        reach = len(array.along) // 2 + 2

        def response(bins):
            return amplitude_response(bins * bin_size_m, *pulse)

    margin = int(np.ceil(CELL_M / bin_size_m)) + reach
    out = np.zeros((len(azimuth), 2, n_bins), np.float32)
    for (cx, x, wx), (cy, y, wy) in product(_anchors(pose[0, 3]), _anchors(pose[1, 3])):
        along_m = x * np.cos(azimuth) + y * np.sin(azimuth)
        aside_m = y * np.cos(azimuth) - x * np.sin(azimuth)
        middle = 2 * aside_m / spacing_m
        start = np.ceil(middle - length / 2 - 0.5).astype(np.int64)
        waves = start[:, None] + np.arange(int(np.ceil(length)) + 1)
        place = waves - middle[:, None]
        weight = np.clip(length / 2 + 0.5 - np.abs(place), 0, 1)  # the outermost in part
        weight *= aperture_weights(np.clip(place / length, -0.5, 0.5), array.series)
        weight *= wx * wy * np.sqrt(0.5 / (weight**2).sum(1, keepdims=True))
        phase = waves * turns * azimuth[:, None]
        chunks = range(waves.min() // CHUNK, waves.max() // CHUNK + 1)
        size = CHUNK, 2, n_bins + 2 * margin
        coefficients = np.concatenate([standard_normal(random(cx, cy, chunk), size) for chunk in chunks])
        weights, shift = _fraction_weights(array, along_m / bin_size_m, response)
        matrix = (weight * np.cos(phase)).astype(np.float32), (weight * np.sin(phase)).astype(np.float32)
        _sound(coefficients, chunks[0] * CHUNK, start, *matrix, shift + margin, weights, out)
    return out
