"""Pictures of a live session's pings, and which bin each of their pixels shows."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from sonar_gl.imaging.fan_image import azimuth_key, colorize, fan_geometry, fan_image, nearest_cells
from sonar_gl.live.settings import LiveSettings
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import Counts

OUTLINE_WIDTH = 2  # pixels: a JPEG has the colours of thinner lines washed out
OUTLINE_GAP = 7  # pixels


def picture_of(ping: Ping, settings: LiveSettings) -> np.ndarray:
    """Return the picture of a ping as the settings show it, (H, W, 3) uint8 RGB."""
    return colorize(_share(ping, settings, ping.counts_law(settings.law)), settings.colormap)


def still_of(ping: Ping, settings: LiveSettings) -> np.ndarray:
    """Return the picture of a ping for a PNG file: of its counts, (H, W) uint16, where it `holds_16_bits`."""
    law = ping.counts_law(settings.law)
    if not settings.style.holds_16_bits(law):
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


def pixel_cells(ping: Ping, settings: LiveSettings) -> np.ndarray:
    """Return beam × bins + bin of the bin of a ping that each pixel of its picture shows, as `nearest_cells` does."""
    if settings.form == "polar":
        return _polar_cells(ping.intensity.shape, settings.height)
    return nearest_cells(fan_geometry(ping, settings.height), ping.intensity.shape, azimuth_key(ping))


@lru_cache(maxsize=4)
def _polar_cells(shape: tuple[int, int], height: int) -> np.ndarray:
    middles = (np.arange(height) + 0.5) / height
    beam, bin_ = ((1 - middles) * shape[0]).astype(np.int32), ((1 - middles) * shape[1]).astype(np.int32)
    return beam * np.int32(shape[1]) + bin_[:, None]


def outlined(picture: np.ndarray, mask: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Return a copy of a picture with an outline around some of its pixels, which keep their colours.

    Gaps of a few pixels between them, as speckle leaves, are not outlined.

    picture : (H, W, 3) uint8
    mask : (H, W) bool
    color : RGB, 0..255
    """
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((OUTLINE_GAP,) * 2, np.uint8))
    around = cv2.dilate(closed, np.ones((1 + 2 * OUTLINE_WIDTH,) * 2, np.uint8)) > closed
    out = picture.copy()
    out[around] = color
    return out


def pixels_of(mask: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return which pixels, of `pixel_cells`, show bins of a (B, K) bool mask, (H, W) bool."""
    return mask.ravel()[cells] & (cells >= 0)
