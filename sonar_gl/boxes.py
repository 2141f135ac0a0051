"""Where bodies are in a labelled ping and in its fan image: boxes and maps, to train detectors with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import uint64

from sonar_gl.compiled import compiled
from sonar_gl.image import FanGeometry, fan_geometry
from sonar_gl.types import Error, Ping

_ROWS = 64  # of pixels that are worked out at a time
_NONE = 32767  # where the box of what has no pixel begins: beyond any picture


@dataclass(frozen=True, eq=False)
class Boxes:
    """The bodies in view of a ping, n of them: those that are the strongest somewhere.

    Attributes
    ----------
    body_id : (n,) uint16, their numbers, rising
    n_bins : (n,) int64, bins where each is the strongest; the boxes go round these
    beams, bins : (n, 2) int64, first and last one. A body across the seam of a full circle has all beams
    pixels : (n, 4) int64, of the fan image: left column, top row, width and height, in whole pixels. They go
        round the body's pixels in `body_map`; where it has none, bins being finer, there is one pixel
    energy : (n,) float64, the body's `body_echo`
    """

    body_id: np.ndarray
    n_bins: np.ndarray
    beams: np.ndarray
    bins: np.ndarray
    pixels: np.ndarray
    energy: np.ndarray


def boxes_of(ping: Ping, height: int = 800) -> Boxes:
    """Boxes round the bodies of a labelled ping.

    Parameters
    ----------
    ping : with `body_id` and `body_echo`
    height : of `fan_image`, pixels

    Raises
    ------
    Error
        if the ping has no labels, or the height makes no sense.
    """
    geometry, _, extents = _cells(ping, height)
    n_bodies = len(ping.body_echo)
    found = np.empty((n_bodies, 9), np.int64)
    _find(ping.body_id, extents, found)
    body_id = np.flatnonzero(found[:, 0])
    body_id = body_id[body_id > 0]
    n_bins, beams, bins, pixels = np.split(found[body_id], [1, 3, 5], axis=1)
    for row in np.flatnonzero(pixels[:, 0] > pixels[:, 1]):  # bins so much finer that no pixel is one of them
        azimuth, range_m = ping.azimuth_rad[beams[row]].mean(), ping.range_m[bins[row]].mean()
        column, line = (round(float(x)) for x in geometry.pixel(azimuth, range_m))
        column, line = min(max(column, 0), geometry.width - 1), min(max(line, 0), geometry.height - 1)
        pixels[row] = column, column, line, line
    left, right, top, bottom = pixels.T
    pixels = np.stack([left, top, right - left + 1, bottom - top + 1], axis=1)
    numbers = body_id.astype(np.uint16)
    return Boxes(numbers, n_bins[:, 0], beams, bins, pixels, np.asarray(ping.body_echo)[body_id])


def body_map(ping: Ping, height: int = 800) -> np.ndarray:
    """(H, W) uint16, for each pixel of `fan_image` the number of the body in the nearest bin; 0 for none.

    Parameters and errors are as of `boxes_of`.
    """
    _, cells, _ = _cells(ping, height)
    # the last one stands for what lies outside
    return np.append(ping.body_id, np.uint16(0))[cells]


def _cells(ping: Ping, height: int):
    if ping.body_id is None or ping.body_echo is None:
        raise Error("a ping must have labels to find bodies in it (got none; make it with labels=True)")
    geometry = fan_geometry(ping, height)
    table = np.ascontiguousarray(ping.azimuth_rad, np.float64).tobytes()
    return geometry, *_plan(geometry, ping.body_id.shape, table)


@lru_cache(maxsize=4)
def _plan(geometry: FanGeometry, shape: tuple[int, int], table: bytes):
    """What depends on the geometry alone: the nearest bin of each pixel, and the pixels of each bin.

    Returns
    -------
    (H, W) int32, beam × bins + bin, or -1 outside; (4, B, K) int16, first and last column, first and last row
    """
    azimuth, (n_beams, n_bins) = np.frombuffer(table, np.float64), shape
    (low, high), (inner_m, outer_m) = geometry.azimuth_edges_rad, geometry.range_edges_m
    between, middle = (azimuth[1:] + azimuth[:-1]) / 2, (low + high) / 2
    cells = np.empty((geometry.height, geometry.width), np.int32)
    for top in range(0, geometry.height, _ROWS):
        row, column = np.ogrid[top : min(top + _ROWS, geometry.height), : geometry.width]
        forward, port = geometry.sonar_row - row, geometry.sonar_column - column
        range_m = np.hypot(forward, port) / geometry.pixels_per_m
        psi = middle + np.remainder(np.arctan2(port, forward) - middle + np.pi, 2 * np.pi) - np.pi
        inside = (range_m >= inner_m) & (range_m <= outer_m)
        if not geometry.full_circle:
            inside &= (psi >= low) & (psi <= high)
        bin_ = ((range_m - inner_m) * (n_bins / (outer_m - inner_m))).astype(int).clip(0, n_bins - 1)
        beam = np.searchsorted(between, psi, side="right")
        cells[top : top + _ROWS] = np.where(inside, beam * n_bins + bin_, -1)
    extents = np.empty((4, n_beams * n_bins), np.int16)
    extents[0::2], extents[1::2] = _NONE, -1
    _surround(cells, extents)
    return cells, extents.reshape(4, n_beams, n_bins)


@compiled
def _surround(cells, extents):
    """Stretch the extents of bins over their pixels."""
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            cell = cells[row, column]
            if cell >= 0:
                extents[0, cell] = min(extents[0, cell], column)
                extents[1, cell] = max(extents[1, cell], column)
                extents[2, cell] = min(extents[2, cell], row)
                extents[3, cell] = max(extents[3, cell], row)


@compiled
def _find(body_id, extents, found):
    """Of each body its bins, first and last beam and bin, and first and last column and row of pixels.

    body_id : (B, K); extents : of `_plan`; found : (bodies, 9)
    """
    K = body_id.shape[1]
    for body in range(found.shape[0]):
        found[body] = 0
        found[body, 1], found[body, 3] = body_id.shape
        found[body, 5] = found[body, 7] = _NONE
        found[body, 2] = found[body, 4] = found[body, 6] = found[body, 8] = -1
    for b in range(body_id.shape[0]):
        k = 0
        while k < K:
            body, first = body_id[b, k], k
            while k < K and body_id[b, k] == body:
                k += 1
            if body == 0:
                continue
            mine = found[body]
            mine[0] += k - first
            mine[1], mine[2] = min(mine[1], b), max(mine[2], b)
            mine[3], mine[4] = min(mine[3], first), max(mine[4], k - 1)
            left, right, top, bottom = np.int16(_NONE), np.int16(-1), np.int16(_NONE), np.int16(-1)
            for i in range(uint64(first), uint64(k)):
                left, right = min(left, extents[0, b, i]), max(right, extents[1, b, i])
                top, bottom = min(top, extents[2, b, i]), max(bottom, extents[3, b, i])
            mine[5], mine[6] = min(mine[5], left), max(mine[6], right)
            mine[7], mine[8] = min(mine[7], top), max(mine[8], bottom)
