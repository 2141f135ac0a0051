"""Styles of pictures: each turns a ping into a picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.core.warn import warn_caller
from sonar_gl.imaging.axes import draw_axes
from sonar_gl.imaging.colormaps import DEFAULT_COLORMAP
from sonar_gl.imaging.demarco2015 import demarco_image
from sonar_gl.imaging.fan_image import colorize, colours, fan_image
from sonar_gl.imaging.files import png_bytes
from sonar_gl.imaging.formats import FILMS
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import Counts

NOTEBOOK_HEIGHT = 500  # pixels, without axes: the picture and a cell fit on a screen
DARK_BLUE = 128  # the first colour of Jet


@dataclass(frozen=True)
class FanStyle:
    """Fan images in colour, or in gray of 16 bits. Raises Error if the colour map is unknown.

    height : of `fan_image`
    colormap : of `colorize`
    axes : whether the picture has `draw_axes`
    """

    height: int
    colormap: str
    axes: bool = False

    def __post_init__(self):
        colours(self.colormap)

    @property
    def setting_of_8_bits(self) -> str | None:
        """The setting by which pictures have 8 bits, since they are in colour or drawn on; None if 16 are possible."""
        if self.colormap != "gray":
            return f"colormap {self.colormap}"
        return "axes" if self.axes else None

    def holds_16_bits(self, law: Counts) -> bool:
        """Return whether pictures by a law of counts have its 16 bits."""
        return law.bits == 16 and self.setting_of_8_bits is None

    def __call__(self, ping: Ping) -> np.ndarray:
        """Return the picture of a ping: (H, W, 3) uint8 RGB; or its counts, (H, W) uint16, where it `holds_16_bits`."""
        law = ping.counts_law()
        picture = fan_image(ping, self.height, law)
        if self.holds_16_bits(law):
            return law.counts_of(picture)
        picture = colorize(picture, self.colormap)
        return draw_axes(picture, ping, self.colormap) if self.axes else picture


def notebook_png(ping: Ping) -> bytes | None:
    """Return the content of a PNG file of a ping's fan image with axes; None if the ping has no such picture."""
    try:
        return png_bytes(FanStyle(NOTEBOOK_HEIGHT, DEFAULT_COLORMAP, axes=True)(ping))
    except Error:
        return None


def what_lacks_16_bits(style: FanStyle, formats: Iterable[str]) -> str | None:
    """Return which setting of fan images, or which format, has no place for counts of 16 bits; None if all have.

    >>> what_lacks_16_bits(FanStyle(800, "copper", axes=False), ["png"])
    'colormap copper'
    """
    if set(formats) == {"npz"}:  # a file of intensities, and of the law
        return None
    if films := [one for one in FILMS if one in formats]:
        return f"format {films[0]}"
    return style.setting_of_8_bits


def shows_echo(picture: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: which pixels of a founding paper's picture are neither dark blue, no echo, nor black."""
    red, green, blue = np.moveaxis(picture, 2, 0)
    return (red > 0) | (green > 0) | ((blue != 0) & (blue != DARK_BLUE))


@dataclass(frozen=True)
class DemarcoStyle:
    """The founding paper's pictures. Warns of noise that they do not have.

    height, form, join, noise : of `demarco_image`
    seed : of the first ping; ping n has seed + n
    """

    height: int
    form: str
    join: str
    noise: Noise
    seed: int

    def __post_init__(self):
        noise = self.noise
        for is_wanted, missing in (
            (noise.speckle or noise.gaussian, "speckle and no gaussian noise"),
            (noise.has_receiver_noise or noise.interference_lines, "receiver noise and no interference"),
            (noise.dropped_beams, "dropped beams"),
        ):
            if is_wanted:
                warn_caller(f"pictures of style demarco2015 have no {missing}")

    def __call__(self, simulator, ping: Ping, number: int) -> np.ndarray:
        """Return the (H, W, 3) uint8 RGB picture at the pose of a ping."""
        seed = self.seed + number
        return demarco_image(simulator, ping.pose, seed, self.noise, self.height, self.form, self.join)
