"""The fan image: the Cartesian picture of a ping, and its colours.

Convention: seen from above, forward is up, port on the left, and the scale is the same in every direction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from sonar_gl.core.checks import as_array, check_choice, check_kind, check_whole_number, holds_numbers, shown
from sonar_gl.core.errors import Error
from sonar_gl.imaging.colormaps import ANCHORS, DEFAULT_COLORMAP
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import Counts

MAX_HEIGHT = 16000  # cv2.remap counts pixels in 16 bits, and a picture may be twice as wide as high
MAX_BEAMS = 32000  # rows of an array that cv2.remap can count
SINGLE_BEAM_RAD = math.radians(1.0)  # width of a single beam if the ping has no sonar
_HALF_PIXEL = 0.5 + 1e-6  # whatever rounding does to a pixel beside the middle of an even width
_BLOCK_ROWS = 64  # rows of pixels computed at a time, which takes 20 MB less than all at once
_OUTSIDE = -16.0  # map coordinate of pixels outside the fan: so far off the array that no echo leaks in


class PixelRows(NamedTuple):
    """What the pixels of some rows of a fan image show, (n, W) each.

    rows : slice of the picture's rows
    azimuth_rad : of the pixels' centres, within half a turn of the fan's middle
    range_m : of the pixels' centres
    inside : bool, whether a pixel's centre lies in the fan, or, where the fan is narrower than a pixel, within half a
        pixel of its middle
    """

    rows: slice
    azimuth_rad: np.ndarray
    range_m: np.ndarray
    inside: np.ndarray


@dataclass(frozen=True)
class FanGeometry:
    """Scale, size and origin of a fan image. Pixel coordinates are whole numbers at the pixels' centres.

    height, width : pixels
    pixels_per_m : scale, the same along rows and columns
    sonar_row, sonar_column : the sonar's pixel; sonar_row may be height − ½, the bottom edge
    azimuth_edges_rad : (2,) edges of the fan, starboard first: half a spacing outside the outer beams
    range_edges_m : (2,) inner edge of the first bin and outer edge of the last
    """

    height: int
    width: int
    pixels_per_m: float
    sonar_row: float
    sonar_column: float
    azimuth_edges_rad: tuple[float, float]
    range_edges_m: tuple[float, float]

    @property
    def full_circle(self) -> bool:
        """Whether the first and the last beam are neighbours."""
        low, high = self.azimuth_edges_rad
        return high - low > 2 * math.pi - 1e-6

    def pixel(self, azimuth_rad, range_m):
        """Return (column, row) of a point at the sonar's height; positive azimuth is to port, on the left."""
        pixels = np.asarray(range_m) * self.pixels_per_m
        column = self.sonar_column - pixels * np.sin(azimuth_rad)
        return column, self.sonar_row - pixels * np.cos(azimuth_rad)

    def pixel_rows(self) -> Iterator[PixelRows]:
        """Yield azimuth and range of all pixels, some rows at a time: the inverse of `pixel`."""
        (low, high), (inner_m, outer_m) = self.azimuth_edges_rad, self.range_edges_m
        middle = (low + high) / 2
        for top in range(0, self.height, _BLOCK_ROWS):
            rows = slice(top, min(top + _BLOCK_ROWS, self.height))
            row, column = np.ogrid[rows, : self.width]
            forward, port = self.sonar_row - row, self.sonar_column - column
            pixels = np.hypot(forward, port)
            range_m = pixels / self.pixels_per_m
            azimuth = np.arctan2(port, forward)
            azimuth = middle + np.remainder(azimuth - middle + np.pi, 2 * np.pi) - np.pi
            inside = (range_m >= inner_m) & (range_m <= outer_m)
            if not self.full_circle:
                within = (azimuth >= low) & (azimuth <= high)
                # near the sonar no pixel's centre may lie between the edges, and echoes there would be lost
                aside = pixels * np.abs(np.sin(azimuth - middle))
                within |= (aside <= _HALF_PIXEL) & (pixels >= 1) & (np.abs(azimuth - middle) < math.pi / 2)
                inside &= within
            yield PixelRows(rows, azimuth, range_m, inside)


def fan_geometry(ping: Ping, height: int = 800) -> FanGeometry:
    """Return scale, size and origin of the fan image of `ping`.

    Parameters
    ----------
    ping : its azimuth_rad (B,) and range_m (K,); a single beam or bin has the width that `sonar` states
    height : pixels, 1..16000

    Notes
    -----
    Let h be the larger half-width of the fan, R its outer edge and H the height. For h <= 90° the scale is
    H / R pixels per metre, and there are ⌈2 H sin h⌉ columns. Beyond 90° the fan continues below the sonar,
    and the scale becomes H / (R (1 − cos h)), down to H / 2R for the disc of a 360° fan.

    Raises
    ------
    Error
        if it is no `Ping`, the height is out of bounds, or the ping's arrays do not match.
    """
    check_kind("ping", ping, Ping, "sonar_gl.Ping(intensity, azimuth_rad, range_m) makes one of arrays")
    height = check_whole_number("height of a fan image", height, 1, MAX_HEIGHT, "give pixels")
    for name in ("intensity", "azimuth_rad", "range_m"):
        array = getattr(ping, name)
        if not holds_numbers(array):
            raise Error(
                f"a ping's {name} must be an array of numbers (got {shown(array)}; numpy.array makes one)"
            )
    azimuth, bins = np.asarray(ping.azimuth_rad, float), np.asarray(ping.range_m, float)
    if ping.intensity.shape != (azimuth.size, bins.size) or not ping.intensity.size:
        raise Error(
            "a ping's intensity must be (beams, bins), at least one of each "
            f"(got {ping.intensity.shape} with {azimuth.size} azimuths and {bins.size} ranges)"
        )
    _check_rising("azimuth_rad", azimuth, -2 * math.pi, 2 * math.pi, "radians, starboard first")
    _check_rising("range_m", bins, 0.0, math.inf, "metres")
    if azimuth.size > 1:
        edges = [1.5 * azimuth[0] - 0.5 * azimuth[1], 1.5 * azimuth[-1] - 0.5 * azimuth[-2]]
    else:
        half_rad = SINGLE_BEAM_RAD / 2 if ping.sonar is None else math.radians(ping.sonar.azimuth_fov_deg) / 2
        edges = [azimuth[0] - half_rad, azimuth[0] + half_rad]
    # uneven beams may extrapolate to more than a circle
    excess = max(0.0, edges[1] - edges[0] - 2 * math.pi) / 2
    edges = (float(edges[0] + excess), float(edges[1] - excess))
    if bins.size > 1:
        half_bin_m = (bins[-1] - bins[0]) / (bins.size - 1) / 2
    else:
        half_bin_m = min(ping.bin_size_m / 2, bins[0])
    inner_m, outer_m = float(bins[0] - half_bin_m), float(bins[-1] + half_bin_m)
    if inner_m < 1e-9 * outer_m:  # what rounding leaves of bins from 0 on
        inner_m = 0.0
    half = min(max(-edges[0], edges[1]), math.pi)
    scale = height / outer_m / (1 - min(0.0, math.cos(half)))
    width = max(1, math.ceil(2 * scale * outer_m * math.sin(min(half, math.pi / 2)) - 1e-6))
    return FanGeometry(
        height=height,
        width=width,
        pixels_per_m=scale,
        sonar_row=scale * outer_m - 0.5,
        sonar_column=(width - 1) / 2,
        azimuth_edges_rad=edges,
        range_edges_m=(inner_m, outer_m),
    )


def _check_rising(name: str, values: np.ndarray, low: float, high: float, hint: str) -> None:
    """Raise an `Error` unless values of a ping rise, within bounds; NaN does not."""
    if not (
        low <= values[0] and values[-1] <= high and (np.diff(values) > 0).all() and math.isfinite(values[-1])
    ):
        got = f"{values[0]:g} to {values[-1]:g}"
        bounds = f"from {low:g} on" if high == math.inf else f"within {low:.4g}..{high:.4g}"
        raise Error(f"a ping's {name} must rise, {bounds} (got {got}; give {hint})")


def fan_image(ping: Ping, height: int = 800, counts: Counts | None = None) -> np.ndarray:
    """Return the picture of a ping seen from above: forward up, port on the left, sonar at the bottom.

    Parameters
    ----------
    ping : intensity (B, K), linear; azimuth_rad (B,), rising, evenly spaced or not; range_m (K,)
    height : pixels; the width follows from the fan
    counts : law by which intensities become brightness; None for that of the ping's sonar. With a fixed gain, pictures
        of a sequence can be compared

    Returns
    -------
    array of shape (H, W), float32, 0..1: counts as a share of full scale, not rounded; 0 outside the fan

    Raises
    ------
    Error
        if it is no `Ping`, or the height is out of bounds.

    Notes
    -----
    The law acts on polar bins, as in the device, and a pixel is the bilinear interpolation of their counts, as in a
    viewer. Counts are not rounded before, which would only round twice. If bins or beams are finer than pixels, the
    linear intensity is first averaged over about a pixel: bins and beams by area, then at range r over 1 / (r Δψ)
    beams. So an echo one bin or one beam wide is spread over a pixel, not lost between pixels, unless it lies in the
    last half pixel beside the fan's edge. Where the whole fan is narrower than a pixel, it is drawn as wide as a pixel
    or two. Automatic gain is that of the ping's own bins, whatever the height. The fan ends half a bin and half a beam
    spacing outside the outer ones, and their values extend to its edge. The ends of a 360° fan are joined.
    """
    geometry, law = fan_geometry(ping, height), ping.counts_law(counts)
    plan = _plan(geometry, ping.intensity.shape, azimuth_key(ping))
    polar = np.ascontiguousarray(ping.intensity, np.float32)
    if polar.shape != plan.shape:
        polar = cv2.resize(polar, plan.shape[::-1], interpolation=cv2.INTER_AREA)
    elif plan.bands:
        polar = polar.copy()  # means are taken in place
    _average_beams(polar, plan.bands, geometry.full_circle)
    polar = law.share(polar)
    if geometry.full_circle:  # a beam of the other end on each side, which the map takes into account
        polar = cv2.copyMakeBorder(polar, 1, 1, 0, 0, cv2.BORDER_WRAP)
    return cv2.remap(polar, *plan.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def azimuth_key(ping: Ping) -> bytes:
    """Return the ping's azimuths as a key of caches: the bytes of (B,) float64."""
    return np.ascontiguousarray(ping.azimuth_rad, np.float64).tobytes()


@lru_cache(maxsize=4)
def nearest_cells(geometry: FanGeometry, shape: tuple[int, int], key: bytes) -> np.ndarray:
    """Return beam × bins + bin of the bin nearest to each pixel of a fan image, (H, W) int32, −1 outside the fan.

    geometry : `fan_geometry` of the ping
    shape : beams, bins
    key : the ping's `azimuth_key`
    """
    azimuth, n_bins = np.frombuffer(key, np.float64), shape[1]
    inner_m, outer_m = geometry.range_edges_m
    beam_edges = (azimuth[1:] + azimuth[:-1]) / 2
    cells = np.empty((geometry.height, geometry.width), np.int32)
    for rows, azimuth_rad, range_m, inside in geometry.pixel_rows():
        bin_ = ((range_m - inner_m) * (n_bins / (outer_m - inner_m))).astype(int).clip(0, n_bins - 1)
        beam = np.searchsorted(beam_edges, azimuth_rad, side="right")
        cells[rows] = np.where(inside, beam * n_bins + bin_, -1)
    return cells


class _Band(NamedTuple):
    """Bins [first, end) of which `n_beams` neighbouring beams, an odd number, share a pixel."""

    first: int
    end: int
    n_beams: int


class _Plan(NamedTuple):
    """How `fan_image` maps a polar array to pixels.

    shape : (beams, bins) after the mean by area
    bands : bins whose beams are averaged
    maps : bins and beams at the pixels, (H, W) float32 each, as cv2.remap takes them
    """

    shape: tuple[int, int]
    bands: tuple[_Band, ...]
    maps: tuple[np.ndarray, np.ndarray]


@lru_cache(maxsize=8)
def _plan(geometry: FanGeometry, shape: tuple[int, int], key: bytes) -> _Plan:
    """Return the plan for pings of this shape (beams, bins); `key` is their `azimuth_key`."""
    azimuth, scale = np.frombuffer(key, np.float64), geometry.pixels_per_m
    (low, high), (inner_m, outer_m) = geometry.azimuth_edges_rad, geometry.range_edges_m
    # cells no longer than a pixel anywhere: the widest spacing of beams counts, at the outer edge
    spacing = float(np.diff(azimuth, prepend=2 * low - azimuth[0]).max())
    n_beams = min(shape[0], math.ceil(shape[0] * min(1.0, spacing * outer_m * scale)), MAX_BEAMS)
    n_bins = min(shape[1], max(1, math.ceil((outer_m - inner_m) * scale - 1e-6)))
    # beams per pixel at each bin, odd so that the mean stays centred
    cell_m = (outer_m - inner_m) / n_bins
    centre_m = inner_m + (np.arange(n_bins) + 0.5) * cell_m
    per_pixel = n_beams / ((high - low) * centre_m * scale)
    odd = np.minimum(2 * np.ceil((per_pixel - 1) / 2).clip(0) + 1, 2 * ((n_beams - 1) // 2) + 1).astype(int)
    starts = np.flatnonzero(np.diff(odd, prepend=0))
    ends = np.append(starts[1:], n_bins)
    bands = (_Band(int(a), int(b), int(odd[a])) for a, b in zip(starts, ends, strict=True) if odd[a] > 1)

    bin_map, beam_map = np.empty((2, geometry.height, geometry.width), np.float32)
    # the fan's edges lie half a beam outside the outer beams
    known_azimuth = np.concatenate([[low], azimuth, [high]])
    known_beam = np.concatenate([[-0.5], np.arange(shape[0]), [shape[0] - 0.5]])
    for rows, azimuth_rad, range_m, inside in geometry.pixel_rows():
        beam = (np.interp(azimuth_rad, known_azimuth, known_beam) + 0.5) * (n_beams / shape[0]) - 0.5
        beam = beam + 1 if geometry.full_circle else beam.clip(0, n_beams - 1)
        bin_ = ((range_m - inner_m) / cell_m - 0.5).clip(0, n_bins - 1)
        bin_map[rows], beam_map[rows] = np.where(inside, (bin_, beam), _OUTSIDE)
    # Old versions of OpenCV round coordinates to 1/32, new ones do not: rounded here, so that all agree.
    # Floats, since new versions are faster with them.
    maps = cv2.convertMaps(*cv2.convertMaps(bin_map, beam_map, cv2.CV_16SC2), cv2.CV_32FC1)
    return _Plan((n_beams, n_bins), tuple(bands), maps)


def _average_beams(polar: np.ndarray, bands: tuple[_Band, ...], full_circle: bool) -> None:
    """Average, in place, over the beams that share a pixel."""
    for first, end, n_beams in bands:
        part = polar[:, first:end]
        if full_circle:
            pad = n_beams // 2
            part = cv2.copyMakeBorder(part, pad, pad, 0, 0, cv2.BORDER_WRAP)
            polar[:, first:end] = cv2.blur(part, (1, n_beams))[pad : pad + len(polar)]
        else:
            polar[:, first:end] = cv2.blur(part, (1, n_beams), borderType=cv2.BORDER_REFLECT)


@cache
def colormaps() -> tuple[str, ...]:
    """Return the names that `colorize` knows: those of ANCHORS, and OpenCV's colour maps in lower case."""
    return (*ANCHORS, *sorted(name[9:].lower() for name in dir(cv2) if name.startswith("COLORMAP_")))


def colours(name: str) -> np.ndarray:
    """Return a colour map's table, (256, 1, 3) uint8 RGB; raise an `Error` if the name is unknown."""
    return _colours(check_choice("colour map", name, colormaps()))


@lru_cache(maxsize=32)
def _colours(name: str) -> np.ndarray:
    if name not in ANCHORS:
        ramp = np.arange(256, dtype=np.uint8)[:, None]
        return np.ascontiguousarray(
            cv2.applyColorMap(ramp, getattr(cv2, "COLORMAP_" + name.upper()))[:, :, ::-1]
        )
    anchors = np.array([[int(one[k : k + 2], 16) for k in (0, 2, 4)] for one in ANCHORS[name].split()])
    at = np.linspace(0, 255, len(anchors))
    table = np.stack([np.interp(np.arange(256), at, channel) for channel in anchors.T], axis=-1)
    return np.rint(table).astype(np.uint8)[:, None]


def colorize(image: np.ndarray, name: str = DEFAULT_COLORMAP) -> np.ndarray:
    """Return the (H, W, 3) uint8 RGB picture of `image` (H, W), float 0..1, in one of the `colormaps`.

    Raises Error if the name is unknown or the image has another shape or type.
    """
    table, image = colours(name), as_array(image, "the image of colorize")
    is_float_image = image.ndim == 2 and image.dtype.kind == "f"
    if not is_float_image or not image.size:  # without a pixel OpenCV ends the process
        raise Error(
            f"colorize needs an image of shape (H, W), float 0..1 (got {image.shape}, {image.dtype}; "
            "sonar_gl.fan_image makes one of a ping)"
        )
    if image.dtype != np.float32 or not _is_within_0_1(image):
        image = image.clip(0, 1).astype(np.float32, copy=False)
    return cv2.applyColorMap(cv2.convertScaleAbs(image, alpha=255), table)


def _is_within_0_1(image: np.ndarray) -> bool:
    """Return whether all pixels lie within 0..1, in a third of the time that it takes to clip them."""
    low, high, *_ = cv2.minMaxLoc(image)
    return low >= 0 and high <= 1
