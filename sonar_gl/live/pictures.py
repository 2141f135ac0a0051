"""Pictures of a live session's pings, and which bin each of their pixels shows."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from sonar_gl.imaging.fan_image import FanGeometry, azimuth_key, colorize, fan_geometry, fan_image
from sonar_gl.imaging.styles import holds_16_bits
from sonar_gl.live.settings import LiveSettings
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import Counts

OUTLINE_WIDTH = 2  # pixels: a JPEG has the colours of thinner lines washed out
OUTLINE_GAP = 7  # pixels


class PixelBins(NamedTuple):
    """Which bin each pixel shows: beam and bin, (H, W) int32 each, -1 outside the fan."""

    beam: np.ndarray
    bin: np.ndarray


def picture_of(ping: Ping, settings: LiveSettings) -> np.ndarray:
    """Return the picture of a ping as the settings show it, (H, W, 3) uint8 RGB."""
    return colorize(_share(ping, settings, ping.counts_law(settings.law)), settings.colormap)


def still_of(ping: Ping, settings: LiveSettings) -> np.ndarray:
    """Return the picture of a ping for a PNG file: of its counts, (H, W) uint16, where it `holds_16_bits`."""
    law = ping.counts_law(settings.law)
    if not holds_16_bits(law, settings.colormap):
        return picture_of(ping, settings)
    return law.counts_of(_share(ping, settings, law))


def _share(ping: Ping, settings: LiveSettings, law: Counts) -> np.ndarray:
    """Return the picture as shares of full scale, (H, W) float32."""
    if settings.form == "fan":
        return fan_image(ping, settings.height, law)
    polar = np.ascontiguousarray(ping.intensity.T[::-1, ::-1], np.float32)
    rows, columns = polar.shape
    # of beams or bins finer than pixels the mean is shown, as in a fan image, so that no echo is lost between pixels
    means_size = min(columns, settings.height), min(rows, settings.height)
    means = cv2.resize(polar, means_size, interpolation=cv2.INTER_AREA)
    size = settings.height, settings.height
    return cv2.resize(law.share(means), size, interpolation=cv2.INTER_NEAREST_EXACT)


def pixel_bins(ping: Ping, settings: LiveSettings) -> PixelBins:
    """Return which bin of a ping each pixel of its picture shows."""
    if settings.form == "polar":
        return _polar_bins(ping.intensity.shape, settings.height)
    return _fan_bins(fan_geometry(ping, settings.height), ping.intensity.shape, azimuth_key(ping))


@lru_cache(maxsize=4)
def _polar_bins(shape: tuple[int, int], height: int) -> PixelBins:
    """Return the bins of a polar picture's pixels."""
    middles = (np.arange(height) + 0.5) / height
    beam, bin_ = ((1 - middles) * shape[0]).astype(np.int32), ((1 - middles) * shape[1]).astype(np.int32)
    full = (height, height)
    return PixelBins(np.broadcast_to(beam[None], full), np.broadcast_to(bin_[:, None], full))


@lru_cache(maxsize=4)
def _fan_bins(geometry: FanGeometry, shape: tuple[int, int], key: bytes) -> PixelBins:
    """Return the bins of a fan image's pixels; `key` is the ping's `azimuth_key`."""
    azimuth = np.frombuffer(key, np.float64)
    (low, high), (inner_m, outer_m) = geometry.azimuth_edges_rad, geometry.range_edges_m
    edges = np.concatenate([[low], (azimuth[1:] + azimuth[:-1]) / 2, [high]])
    beams, bins = np.empty((2, geometry.height, geometry.width), np.int32)
    for rows, azimuth_rad, range_m, inside in geometry.pixel_rows():
        beam = (np.searchsorted(edges, azimuth_rad, side="right") - 1).clip(0, shape[0] - 1)
        bin_ = ((range_m - inner_m) / (outer_m - inner_m) * shape[1]).astype(int).clip(0, shape[1] - 1)
        beams[rows], bins[rows] = np.where(inside, (beam, bin_), -1)
    return PixelBins(beams, bins)


def outlined(picture: np.ndarray, mask: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Return a copy of a picture with an outline around some of its pixels, which keep their colours.

    Gaps of a few pixels between them, as speckle leaves, are not outlined.

    Parameters
    ----------
    picture : (H, W, 3) uint8
    mask : (H, W) bool
    color : RGB, 0..255
    """
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((OUTLINE_GAP,) * 2, np.uint8))
    around = cv2.dilate(closed, np.ones((1 + 2 * OUTLINE_WIDTH,) * 2, np.uint8)) > closed
    out = picture.copy()
    out[around] = color
    return out


def pixels_of(mask: np.ndarray, bins: PixelBins) -> np.ndarray:
    """Return which pixels show bins of a (B, K) bool mask, (H, W) bool."""
    return mask[bins.beam, bins.bin] & (bins.beam >= 0)
