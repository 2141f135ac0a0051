"""Bodies in a labelled ping and in its fan image: bounding boxes and maps, to train detectors on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled
from sonar_gl.core.errors import Error
from sonar_gl.imaging.fan_image import FanGeometry, azimuth_key, fan_geometry
from sonar_gl.ping import Ping

_NO_PIXEL = 32767  # first column and row of a bin without pixels: outside any picture


@dataclass(frozen=True, eq=False)
class Boxes:
    """The n bodies in view of a ping: those with the strongest echo in some bin.

    Attributes
    ----------
    body_id : (n,) uint16, their numbers, rising
    n_bins : (n,) int64, number of bins where the body's echo is the strongest; the boxes enclose these
    beams, bins : (n, 2) int64, first and last one. A body across the seam of a full circle has all beams
    pixels : (n, 4) int64, left column, top row, width and height of the box in the fan image, whole pixels.
        It encloses the body's pixels in `body_map`, or one pixel if the body's bins lie between pixels
    energy : (n,) float64, the body's `body_echo`
    """

    body_id: np.ndarray
    n_bins: np.ndarray
    beams: np.ndarray
    bins: np.ndarray
    pixels: np.ndarray
    energy: np.ndarray


def boxes_of(ping: Ping, height: int = 800) -> Boxes:
    """Return the bounding boxes of the bodies of a labelled ping.

    Parameters
    ----------
    ping : with `body_id` and `body_echo`
    height : of `fan_image`, pixels

    Raises
    ------
    Error
        if the ping has no labels, or they do not match, or the height is out of bounds.
    """
    geometry, plan = _geometry_and_plan(ping, height)
    found = np.empty((len(ping.body_echo), 9), np.int64)
    _find_extents(ping.body_id, plan.extents, found)
    body_id = np.flatnonzero(found[:, 0])
    body_id = body_id[body_id > 0]
    n_bins, beams, bins, pixels = np.split(found[body_id], [1, 3, 5], axis=1)
    for body in np.flatnonzero(pixels[:, 0] > pixels[:, 1]):  # its bins lie between pixels: the nearest pixel
        azimuth, range_m = ping.azimuth_rad[beams[body]].mean(), ping.range_m[bins[body]].mean()
        column, row = (round(float(x)) for x in geometry.pixel(azimuth, range_m))
        column, row = min(max(column, 0), geometry.width - 1), min(max(row, 0), geometry.height - 1)
        pixels[body] = column, column, row, row
    left, right, top, bottom = pixels.T
    return Boxes(
        body_id=body_id.astype(np.uint16),
        n_bins=n_bins[:, 0],
        beams=beams,
        bins=bins,
        pixels=np.stack([left, top, right - left + 1, bottom - top + 1], axis=1),
        energy=np.asarray(ping.body_echo)[body_id],
    )


def body_map(ping: Ping, height: int = 800) -> np.ndarray:
    """Return the number of the body in the bin nearest to each pixel of `fan_image`, (H, W) uint16.

    It is 0 outside the fan and where no body has an echo. Parameters and errors are those of `boxes_of`.
    """
    _, plan = _geometry_and_plan(ping, height)
    return np.append(ping.body_id, np.uint16(0))[plan.cells]  # cell −1, outside the fan, is the last one


class _Plan(NamedTuple):
    """How bins and pixels of a fan image belong together.

    Attributes
    ----------
    cells : (H, W) int32, beam × bins + bin of the bin nearest to each pixel, −1 outside the fan
    extents : (4, B, K) int16, first and last column, first and last row of the pixels of each bin
    """

    cells: np.ndarray
    extents: np.ndarray


def _geometry_and_plan(ping: Ping, height: int) -> tuple[FanGeometry, _Plan]:
    if ping.body_id is None or ping.body_echo is None:
        raise Error("a ping must have labels to find bodies in it (got none; make it with labels=True)")
    _check_labels(ping)
    geometry = fan_geometry(ping, height)
    return geometry, _plan(geometry, ping.body_id.shape, azimuth_key(ping))


def _check_labels(ping: Ping) -> None:
    """Raise an Error unless numbers of bodies are entries of `body_echo`: compiled functions take them as they are."""
    body_id, n_numbers = ping.body_id, len(ping.body_echo)
    if body_id.dtype.kind not in "iu" or body_id.shape != ping.intensity.shape:
        got = f"{body_id.dtype} of shape {body_id.shape}"
        raise Error(
            f"body_id of a ping must hold whole numbers of the shape of its intensity, {ping.intensity.shape} "
            f"(got {got})"
        )
    if body_id.size and not 0 <= int(body_id.min()) <= int(body_id.max()) < n_numbers:
        raise Error(
            f"body_id of a ping must lie in 0..{n_numbers - 1}, since its body_echo has {n_numbers} entries "
            f"(got {body_id.min()} to {body_id.max()})"
        )


@lru_cache(maxsize=4)
def _plan(geometry: FanGeometry, shape: tuple[int, int], key: bytes) -> _Plan:
    """Return the plan for pings of this shape (beams, bins); `key` is their `azimuth_key`."""
    azimuth, (n_beams, n_bins) = np.frombuffer(key, np.float64), shape
    inner_m, outer_m = geometry.range_edges_m
    beam_edges = (azimuth[1:] + azimuth[:-1]) / 2
    cells = np.empty((geometry.height, geometry.width), np.int32)
    for rows, azimuth_rad, range_m, inside in geometry.pixel_rows():
        bin_ = ((range_m - inner_m) * (n_bins / (outer_m - inner_m))).astype(int).clip(0, n_bins - 1)
        beam = np.searchsorted(beam_edges, azimuth_rad, side="right")
        cells[rows] = np.where(inside, beam * n_bins + bin_, -1)
    extents = np.empty((4, n_beams * n_bins), np.int16)
    extents[0::2], extents[1::2] = _NO_PIXEL, -1
    _grow_extents(cells, extents)
    return _Plan(cells, extents.reshape(4, n_beams, n_bins))


@compiled
def _grow_extents(cells, extents):
    """Grow the extents (4, B × K) of bins until they enclose their pixels."""
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            cell = cells[row, column]
            if cell >= 0:
                extents[0, cell] = min(extents[0, cell], column)
                extents[1, cell] = max(extents[1, cell], column)
                extents[2, cell] = min(extents[2, cell], row)
                extents[3, cell] = max(extents[3, cell], row)


@compiled
def _find_extents(body_id, extents, found):
    """Find, for each body, its number of bins and the first and last beam, bin, column and row.

    Parameters
    ----------
    body_id : (B, K) uint16
    extents : (4, B, K) int16, of `_Plan`
    found : (bodies, 9) int64, filled in this order
    """
    K = body_id.shape[1]
    for body in range(found.shape[0]):
        found[body] = 0
        found[body, 1], found[body, 3] = body_id.shape
        found[body, 5] = found[body, 7] = _NO_PIXEL
        found[body, 2] = found[body, 4] = found[body, 6] = found[body, 8] = -1
    for b in range(body_id.shape[0]):
        k = 0
        while k < K:
            body, first = body_id[b, k], k
            while k < K and body_id[b, k] == body:  # a run of bins of one body
                k += 1
            if body == 0:
                continue
            own = found[body]
            own[0] += k - first
            own[1], own[2] = min(own[1], b), max(own[2], b)
            own[3], own[4] = min(own[3], first), max(own[4], k - 1)
            left, right, top, bottom = np.int16(_NO_PIXEL), np.int16(-1), np.int16(_NO_PIXEL), np.int16(-1)
            for i in range(uint64(first), uint64(k)):
                left, right = min(left, extents[0, b, i]), max(right, extents[1, b, i])
                top, bottom = min(top, extents[2, b, i]), max(bottom, extents[3, b, i])
            own[5], own[6] = min(own[5], left), max(own[6], right)
            own[7], own[8] = min(own[7], top), max(own[8], bottom)
