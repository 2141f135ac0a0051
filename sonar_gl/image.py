"""From a ping to a picture: the fan image and its colours.

Convention: seen from above, forward up, port on the left, the same scale in every direction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from sonar_gl.types import Error, Ping, nearest_names

MAX_HEIGHT = 16000  # cv2.remap counts pixels in 16 bits, and a picture may be twice as wide as high
LONE_BEAM_RAD = math.radians(1.0)  # width drawn for a single beam of which the ping says no more
_ROWS = 64  # that a map is worked out for at a time: 20 MB less than all at once
_OUTSIDE = -16.0  # where the map of a pixel outside the fan points: far enough that no echo leaks in


@dataclass(frozen=True)
class FanGeometry:
    """Where a fan image puts things. Pixel coordinates are whole numbers at the pixels' centres.

    Attributes
    ----------
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
        """Whether the last beam is the first one's neighbour."""
        low, high = self.azimuth_edges_rad
        return high - low > 2 * math.pi - 1e-6

    def pixel(self, azimuth_rad, range_m):
        """(column, row) of a point at sonar height; azimuth positive to port, which is on the left."""
        pixels = np.asarray(range_m) * self.pixels_per_m
        column = self.sonar_column - pixels * np.sin(azimuth_rad)
        return column, self.sonar_row - pixels * np.cos(azimuth_rad)


def fan_geometry(ping: Ping, height: int = 800) -> FanGeometry:
    """Scale, size and origin of the fan image of `ping`.

    Parameters
    ----------
    ping : its azimuth_rad (B,) and range_m (K,), and, where there is a single beam or bin, meta's
        sonar.azimuth_fov_deg and bin_size_m
    height : pixels, 1..16000

    Notes
    -----
    With h = the larger half-width of the fan and R its outer edge, h <= 90° gives H / R pixels per
    metre and ⌈2 H sin h⌉ columns; beyond 90° the fan goes on below the sonar and the scale becomes
    H / (R (1 − cos h)), down to H / 2R for the disc of a 360° fan.
    """
    if isinstance(height, bool) or not isinstance(height, (int, np.integer)) or not 1 <= height <= MAX_HEIGHT:
        raise Error(
            f"height of a fan image must be a whole number of pixels in 1..{MAX_HEIGHT} (got {height!r})"
        )
    height = int(height)
    azimuth, bins = np.asarray(ping.azimuth_rad, float), np.asarray(ping.range_m, float)
    if ping.intensity.shape != (azimuth.size, bins.size) or not ping.intensity.size:
        raise Error(
            "a ping's intensity must be (beams, bins), at least one of each "
            f"(got {ping.intensity.shape} with {azimuth.size} azimuths and {bins.size} ranges)"
        )
    if azimuth.size > 1:
        edges = [1.5 * azimuth[0] - 0.5 * azimuth[1], 1.5 * azimuth[-1] - 0.5 * azimuth[-2]]
    else:
        sonar = ping.meta.get("sonar")
        fov_deg = sonar.get("azimuth_fov_deg") if isinstance(sonar, Mapping) else None
        half_rad = math.radians(fov_deg) / 2 if fov_deg else LONE_BEAM_RAD / 2
        edges = [azimuth[0] - half_rad, azimuth[0] + half_rad]
    over = max(0.0, edges[1] - edges[0] - 2 * math.pi) / 2  # a table may leave the circle's ends uneven
    edges = (float(edges[0] + over), float(edges[1] - over))
    if bins.size > 1:
        half_bin_m = (bins[-1] - bins[0]) / (bins.size - 1) / 2
    else:
        half_bin_m = min(ping.meta.get("bin_size_m", math.inf) / 2, bins[0])
    outer_m = float(bins[-1] + half_bin_m)
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
        range_edges_m=(max(0.0, float(bins[0] - half_bin_m)), outer_m),
    )


def fan_image(ping: Ping, height: int = 800, scale: str = "db", db_range=(-60.0, 0.0)) -> np.ndarray:
    """The picture of a ping, seen from above: forward up, port on the left, sonar at the bottom.

    Parameters
    ----------
    ping : intensity (B, K), linear; azimuth_rad (B,), rising, evenly spaced or not; range_m (K,)
    height : pixels; the width follows from the fan
    scale : "db": 10 log10(intensity) from db_range[0] (0) to db_range[1] (1); "linear": intensity as
        it is, cut to 0..1. Both scales are fixed, so pictures of one sequence can be compared
    db_range : (darkest, brightest) in dB, 0 dB = intensity 1

    Returns
    -------
    array of shape (H, W), float32, 0..1; 0 outside the fan

    Raises
    ------
    Error
        if height, scale or db_range make no sense.

    Notes
    -----
    A pixel is the bilinear interpolation of the polar array, in dB for the scale "db". Where bins or
    beams are finer than pixels, the mean of the linear intensity over about a pixel is taken first
    (bins and beams by area, then beams over 1 / (r Δψ) of them at range r), so that an echo one bin
    or one beam wide is spread, never lost between pixels. The fan ends half a bin and half a beam
    spacing outside the outer ones; there the outer one is used. A 360° fan is joined at its ends.
    """
    if scale not in ("db", "linear"):
        raise Error(f"unknown scale {scale!r} of a fan image: {nearest_names(str(scale), ('db', 'linear'))}")
    try:
        low_db, high_db = (float(value) for value in db_range)
    except (TypeError, ValueError):
        raise Error(f"db_range must be two numbers, darkest and brightest dB (got {db_range!r})") from None
    if not (math.isfinite(low_db) and math.isfinite(high_db) and low_db < high_db):
        raise Error(
            f"db_range must rise from the darkest to the brightest dB (got {low_db:g} and {high_db:g})"
        )
    geometry = fan_geometry(ping, height)
    table = np.ascontiguousarray(ping.azimuth_rad, np.float64).tobytes()
    (n_beams, n_bins), bands, maps = _plan(geometry, ping.intensity.shape, table)
    polar = np.ascontiguousarray(ping.intensity, np.float32)
    if polar.shape != (n_beams, n_bins):
        polar = cv2.resize(polar, (n_bins, n_beams), interpolation=cv2.INTER_AREA)
    else:
        polar = polar.copy()  # what follows happens in place
    _blur_beams(polar, bands, geometry.full_circle)
    if scale == "db":
        cv2.max(polar, 10 ** (low_db / 10), dst=polar)
        cv2.log(polar, dst=polar)
        polar *= 10 / math.log(10) / (high_db - low_db)
        polar -= low_db / (high_db - low_db)
    np.clip(polar, 0.0, 1.0, out=polar)
    if geometry.full_circle:  # one beam of the other end at each end; the map counts it
        polar = cv2.copyMakeBorder(polar, 1, 1, 0, 0, cv2.BORDER_WRAP)
    return cv2.remap(polar, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


@lru_cache(maxsize=8)
def _plan(geometry: FanGeometry, shape: tuple[int, int], table: bytes):
    """What depends on the geometry alone: size after the area mean, beams' blur per bin, cv2's maps."""
    azimuth, scale = np.frombuffer(table, np.float64), geometry.pixels_per_m
    (low, high), (inner_m, outer_m) = geometry.azimuth_edges_rad, geometry.range_edges_m
    # cells no longer than a pixel anywhere: the widest spacing of the table, at the outer edge
    spacing = float(np.diff(azimuth, prepend=2 * low - azimuth[0]).max())
    n_beams = min(shape[0], math.ceil(shape[0] * min(1.0, spacing * outer_m * scale)), 32000)
    n_bins = min(shape[1], max(1, math.ceil((outer_m - inner_m) * scale - 1e-6)))
    # beams to a pixel at each bin, odd so that the mean stays centred
    cell_m = (outer_m - inner_m) / n_bins
    centre_m = inner_m + (np.arange(n_bins) + 0.5) * cell_m
    per_pixel = n_beams / ((high - low) * centre_m * scale)
    odd = np.minimum(2 * np.ceil((per_pixel - 1) / 2).clip(0) + 1, 2 * ((n_beams - 1) // 2) + 1).astype(int)
    starts = np.flatnonzero(np.diff(odd, prepend=0))
    stops = np.append(starts[1:], n_bins)
    bands = tuple((int(a), int(b), int(odd[a])) for a, b in zip(starts, stops, strict=True) if odd[a] > 1)

    maps = np.empty((2, geometry.height, geometry.width), np.float32)
    for top in range(0, geometry.height, _ROWS):
        row, column = np.ogrid[top : min(top + _ROWS, geometry.height), : geometry.width]
        forward, port = geometry.sonar_row - row, geometry.sonar_column - column
        range_m = np.hypot(forward, port) / scale
        psi = np.arctan2(port, forward)
        middle = (low + high) / 2
        psi = middle + np.remainder(psi - middle + np.pi, 2 * np.pi) - np.pi  # fans need not be centred on 0
        inside = (range_m >= inner_m) & (range_m <= outer_m) & (psi >= low) & (psi <= high)
        if geometry.full_circle:
            inside = (range_m >= inner_m) & (range_m <= outer_m)
        # index of the beam, the fan's edges half a beam outside the outer ones
        index = np.interp(
            psi,
            np.concatenate([[low], azimuth, [high]]),
            np.concatenate([[-0.5], np.arange(shape[0]), [shape[0] - 0.5]]),
        )
        beam = (index + 0.5) * (n_beams / shape[0]) - 0.5
        beam = beam + 1 if geometry.full_circle else beam.clip(0, n_beams - 1)
        bin_ = ((range_m - inner_m) / cell_m - 0.5).clip(0, n_bins - 1)
        for whole, part in zip(maps, (bin_, beam), strict=True):
            whole[top : top + _ROWS] = np.where(inside, part, _OUTSIDE)
    # places to 1/32, as all but new versions of OpenCV round them, in floats, which new ones are quicker with
    maps = cv2.convertMaps(*cv2.convertMaps(*maps, cv2.CV_16SC2), cv2.CV_32FC1)
    return (n_beams, n_bins), bands, maps


def _blur_beams(polar: np.ndarray, bands, full_circle: bool) -> None:
    """Mean, in place, over the beams that share a pixel; bands are (first bin, last bin + 1, beams)."""
    for start, stop, width in bands:
        part = polar[:, start:stop]
        if full_circle:
            pad = width // 2
            part = cv2.copyMakeBorder(part, pad, pad, 0, 0, cv2.BORDER_WRAP)
            polar[:, start:stop] = cv2.blur(part, (1, width))[pad : pad + len(polar)]
        else:
            polar[:, start:stop] = cv2.blur(part, (1, width), borderType=cv2.BORDER_REFLECT)


@lru_cache(maxsize=1)
def colormaps() -> tuple[str, ...]:
    """Names that `colorize` knows: "gray" and OpenCV's colour maps in lower case."""
    return ("gray", *sorted(name[9:].lower() for name in dir(cv2) if name.startswith("COLORMAP_")))


@lru_cache(maxsize=32)
def _colours(name: str) -> np.ndarray:
    """(256, 1, 3) uint8 RGB."""
    table = np.arange(256, dtype=np.uint8)[:, None]
    if name != "gray":
        table = cv2.applyColorMap(table, getattr(cv2, "COLORMAP_" + name.upper()))[:, :, ::-1]
    return np.ascontiguousarray(np.broadcast_to(table.reshape(256, 1, -1), (256, 1, 3)))


def colorize(image: np.ndarray, name: str = "jet") -> np.ndarray:
    """(H, W, 3) uint8 RGB picture of `image` (H, W), float 0..1, in one of the `colormaps`."""
    if name not in colormaps():
        raise Error(f"unknown colour map {name!r}: {nearest_names(str(name), colormaps())}")
    image = np.asarray(image)
    if image.ndim != 2 or image.dtype.kind != "f":
        raise Error(f"colorize needs an image of shape (H, W), float 0..1 (got {image.shape}, {image.dtype})")
    levels = cv2.convertScaleAbs(image.clip(0, 1).astype(np.float32, copy=False), alpha=255)
    return cv2.applyColorMap(levels, _colours(name))
