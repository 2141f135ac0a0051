"""Axes of a fan image: range arcs, azimuth spokes and their labels, a title, and the bar of colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.imaging.fan_image import FanGeometry, colours, fan_geometry
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import DEFAULT_COUNTS, LEVEL_BOUND_DB, Counts

FONT = cv2.FONT_HERSHEY_SIMPLEX
# gray level, width, opacity: a dark rim shows light lines on bright echo
STROKES = ((0, 2, 0.2), (255, 1, 0.45))
SPOKE_STEPS_DEG = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 45, 90)
ARC_STEPS_M = tuple(n * 10.0**e for e in range(-4, 6) for n in (1, 2, 5))
MAX_NAME = 60  # letters of a name, so that a title can be read
TEXT_GRAY = 225
LABEL_SIZE = np.array([65, 24])  # pixels across and down that a label takes, at font size 1


def draw_axes(
    picture: np.ndarray, ping: Ping, colormap: str | None = None, counts: Counts | None = None
) -> np.ndarray:
    """Return a copy of a fan image's picture with range arcs (m), spokes (°, positive to port) and a title.

    Parameters
    ----------
    picture : (H, W, 3) uint8 RGB, of fan_image(ping, H, counts)
    colormap : of `colorize`; adds a bar of its colours, with their counts. None for pictures in other colours
    counts : of `fan_image`; None for that of the ping's sonar

    Returns
    -------
    array of shape (H + 2 margin, W + 2 margin + bar, 3), uint8 RGB, black outside the fan. The bar is equally wide
    for all pings of a sonar, whatever their gain

    Raises
    ------
    Error
        if the picture has another type or shape than this ping's fan image, or the colour map is unknown.
    """
    picture = np.asarray(picture)
    fan = fan_geometry(ping, len(picture)) if picture.ndim == 3 else None
    if fan is None or picture.dtype != np.uint8 or picture.shape != (fan.height, fan.width, 3):
        want = f", here ({fan.height}, {fan.width}, 3)" if fan else ""
        raise Error(
            "draw_axes needs the (H, W, 3) uint8 picture of this ping's fan image"
            f"{want} (got {picture.shape}, {picture.dtype})"
        )
    law = ping.counts_law(counts)
    if counts is None:
        counts = DEFAULT_COUNTS if ping.sonar is None else ping.sonar.counts
    bar = None if colormap is None else _Bar(colormap, law, counts.gain_percentile is not None)
    return _axes(fan).draw(picture, _title(ping, fan, law, colormap), bar)


class FanTicks(NamedTuple):
    """Round numbers at which a fan has lines: ranges of arcs, metres, and azimuths of spokes, degrees."""

    arcs_m: np.ndarray
    spokes_deg: np.ndarray


def fan_ticks(fan: FanGeometry, spoke_pixels: float, arc_pixels: float = 0.0) -> FanTicks:
    """Return as many spokes, at most eight or so, and arcs, at most seven, as lie this far apart or more.

    spoke_pixels : along the outer arc
    arc_pixels : along a spoke
    """
    (low, high), (inner_m, outer_m) = fan.azimuth_edges_rad, fan.range_edges_m
    parts = min(8.0, (high - low) * outer_m * fan.pixels_per_m / spoke_pixels)
    step_deg = _tick_step(math.degrees(high - low), parts, SPOKE_STEPS_DEG)
    first, last = (math.degrees(edge) / step_deg for edge in (low, high))
    spokes_deg = np.arange(math.ceil(first - 1e-6), math.floor(last + 1e-6) + 1) * step_deg
    if fan.full_circle and spokes_deg[-1] - spokes_deg[0] > 360 - 1e-6:  # −180° is +180°
        spokes_deg = spokes_deg[1:]
    arc_parts = 7.0 if arc_pixels == 0 else min(7.0, outer_m * fan.pixels_per_m / arc_pixels)
    step_m = _tick_step(outer_m, arc_parts, ARC_STEPS_M)
    arcs = np.arange(max(1, math.ceil(inner_m / step_m)), math.floor(outer_m / step_m + 1e-6) + 1)
    return FanTicks(arcs * step_m, spokes_deg)


def _title(ping: Ping, fan: FanGeometry, law: Counts, colormap: str | None) -> str:
    """Return the sonar's name, the range, and the gain of pictures whose law is known by their colours."""
    inner_m, outer_m = fan.range_edges_m
    parts = [] if ping.sonar is None else [_drawable(ping.sonar.name)]
    parts.append(f"{_metres(inner_m)} to {_metres(outer_m)} m")
    parts += [f"gain {law.gain_db:+.1f} dB"] if colormap is not None else []
    return ", ".join(parts)


def _drawable(name: str) -> str:
    """Return a name in one line, of letters that OpenCV can draw: it crashes at a byte of a file's name in no encoding.

    >>> _drawable("my\\nsonar \\udce9")
    'my sonar ?'
    """
    name = "".join(letter if letter.isprintable() else "?" for letter in " ".join(name.split()))
    return name if len(name) <= MAX_NAME else f"{name[: MAX_NAME - 3]}..."


def _metres(value_m: float) -> str:
    """Return a range to three digits, without an exponent where it is long."""
    return f"{value_m:.3g}" if value_m < 999.5 else f"{value_m:.0f}"


@dataclass(frozen=True)
class _Bar:
    """What the bar beside a fan shows.

    law : of the counts, with the gain of this ping
    gain_varies : whether other pings of the sonar may have another gain
    """

    colormap: str
    law: Counts
    gain_varies: bool

    def labels(self, gain_db: float) -> list[str]:
        """Return the counts at 0, 1/4, 1/2, 3/4 and all of full scale, and what the ends stand for by a law in dB."""
        law = self.law
        labels = [f"{round(share * law.full_scale)}" for share in (0, 0.25, 0.5, 0.75, 1)]
        if law.law == "db":  # re a sphere of reflectivity 1 about the sonar
            labels[0] += f"  {law.low_db - gain_db:.0f} dB"
            labels[-1] += f"  {law.high_db - gain_db:.0f} dB"
        return labels


class _Line(NamedTuple):
    """The lines of a fan in one of STROKES, at the n pixels that they cross.

    pixels : (n,) place in the canvas, row by row
    kept, added : (n, 1) float32, share of the picture that stays visible, and gray level that is added to it
    """

    pixels: np.ndarray
    kept: np.ndarray
    added: np.ndarray


class _Axes:
    """Draws the axes of one fan image. Positions are (..., 2) pixels on the canvas, column and row."""

    def __init__(self, fan: FanGeometry):
        self.fan = fan
        self.font_size = float(np.clip(fan.height / 1500, 0.35, 1.2))  # letters are 22 pixels high at 1
        self.margin = round(120 * self.font_size)
        # as many as have room for their labels
        spoke_pixels = 100 * self.font_size
        self.arcs_m, self.spokes_deg = fan_ticks(fan, spoke_pixels)
        if arc_pixels := self._arc_label_pixels():
            self.arcs_m, self.spokes_deg = fan_ticks(fan, spoke_pixels, arc_pixels)

    def draw(self, picture: np.ndarray, title: str, bar: _Bar | None) -> np.ndarray:
        """Return the picture with a margin, lines and labels, and with a bar, if there is one."""
        canvas = cv2.copyMakeBorder(picture, *[self.margin] * 4, cv2.BORDER_CONSTANT)
        canvas = cv2.bitwise_and(canvas, canvas, mask=self._inside)
        self._draw_lines(canvas)
        self._draw_labels(canvas)
        if bar is not None:
            canvas = np.hstack([canvas, self._strip(len(canvas), bar)])
        self._draw_title(canvas, title)
        return canvas

    def _arc_label_pixels(self) -> float:
        """Return how far apart arcs must lie so that their labels, along the starboard edge, do not overlap."""
        texts = [f"{arc_m:g} m" for arc_m in self.arcs_m]
        sizes = [cv2.getTextSize(text, FONT, self.font_size, 1)[0] for text in texts]
        across, down = np.max(sizes, axis=0, initial=0) + np.array([4 * self.font_size, 2])
        low = self.fan.azimuth_edges_rad[0]
        return float(min(across / max(abs(math.sin(low)), 1e-9), down / max(abs(math.cos(low)), 1e-9)))

    def _strip(self, height: int, bar: _Bar) -> np.ndarray:
        """Return the strip beside the fan, (height, W, 3), with the colours of 0 to full scale, from below."""
        size = self.font_size
        labels = bar.labels(bar.law.gain_db)
        # those of this ping, and the widest that other pings of the sonar may have
        texts = ["counts", *labels]
        for gain_db in (-LEVEL_BOUND_DB, LEVEL_BOUND_DB) if bar.gain_varies else ():
            texts += bar.labels(gain_db)
        widest = max(cv2.getTextSize(text, FONT, size, 1)[0][0] for text in texts)
        first, across = round(10 * size), round(34 * size)
        strip = np.zeros((height, first + across + widest + round(34 * size), 3), np.uint8)
        top, bottom = round(0.25 * height), round(0.75 * height)
        levels = np.rint(np.linspace(255, 0, bottom - top)).astype(int)
        strip[top:bottom, first : first + across] = colours(bar.colormap)[levels]
        column = first + across + round(12 * size)
        for text, row in zip(labels, np.linspace(bottom, top, len(labels)), strict=True):
            self._write_from(strip, text, column, row)
        self._write_from(strip, "counts", first, top - 36 * size)
        return strip

    def _draw_title(self, canvas: np.ndarray, title: str) -> None:
        """Write the title above all, in smaller letters if it is wider, and the sides into the lower corners."""
        height, width = canvas.shape[:2]
        size = self.font_size
        # letters have whole pixels, so that the width follows the size in steps
        while (needed := cv2.getTextSize(title, FONT, size, 1)[0][0]) > 0.96 * width:
            size *= min(0.96, 0.96 * width / needed)
        self._write(canvas, title, (width / 2, 22 * self.font_size), size=size)
        row, edge = height - 22 * self.font_size, round(10 * self.font_size)
        self._write_from(canvas, "port", edge, row)
        (starboard, _), _ = cv2.getTextSize("starboard", FONT, self.font_size, 1)
        self._write_from(canvas, "starboard", self.fan.width + 2 * self.margin - edge - starboard, row)

    def _position(self, azimuth_rad, range_m, beyond: float = 0.0) -> np.ndarray:
        """Return the position of azimuth and range, moved outwards by `beyond` pixels."""
        pixel = self.fan.pixel(azimuth_rad, np.asarray(range_m) + beyond / self.fan.pixels_per_m)
        return np.stack(np.broadcast_arrays(*pixel), axis=-1) + self.margin

    @cached_property
    def _inside(self) -> np.ndarray:
        """255 on the canvas where the fan is, elsewhere 0, uint8."""
        (inner_m, outer_m), arc = self.fan.range_edges_m, self._fan_arc()
        outline = np.concatenate([self._position(arc, outer_m), self._position(arc[::-1], inner_m)])
        return cv2.fillPoly(self._empty_mask(), [np.rint(outline).astype(np.int32)], 255)

    def _empty_mask(self) -> np.ndarray:
        """Return zeros of the canvas's height and width, uint8."""
        return np.zeros((self.fan.height + 2 * self.margin, self.fan.width + 2 * self.margin), np.uint8)

    def _fan_arc(self) -> np.ndarray:
        """Return azimuths from edge to edge, for polygons that follow an arc."""
        return np.linspace(*self.fan.azimuth_edges_rad, 361)

    @cached_property
    def _lines(self) -> list[_Line]:
        """The arcs, spokes and edges in each of STROKES."""
        (inner_m, outer_m), arc = self.fan.range_edges_m, self._fan_arc()
        lines = [self._position(arc, range_m) for range_m in (*self.arcs_m, outer_m)]
        edges = () if self.fan.full_circle else self.fan.azimuth_edges_rad
        azimuths = *np.radians(self.spokes_deg), *edges
        lines += [self._position(azimuth, [inner_m, outer_m]) for azimuth in azimuths]
        lines = [np.rint(points * 16).astype(np.int32) for points in lines]  # in sixteenths of a pixel
        out = []
        for level, width, opacity in STROKES:
            mask = cv2.polylines(self._empty_mask(), lines, False, 255, width, cv2.LINE_AA, 4).ravel()
            crossed = np.flatnonzero(mask)  # few pixels of all
            weight = mask[crossed, None] * np.float32(opacity / 255)
            out.append(_Line(crossed, 1 - weight, level * weight))
        return out

    def _draw_lines(self, canvas: np.ndarray) -> None:
        pixels = canvas.reshape(-1, 3)
        for line in self._lines:
            pixels[line.pixels] = np.rint(pixels[line.pixels] * line.kept + line.added).astype(np.uint8)

    def _draw_labels(self, canvas: np.ndarray) -> None:
        """Label arcs beside the starboard edge, and spokes beyond the outer arc where they have room."""
        low, size = self.fan.azimuth_edges_rad[0], self.font_size
        outwards = np.array([math.cos(low), -math.sin(low)])  # away from the starboard edge
        texts = [f"{range_m:g} m" for range_m in self.arcs_m]
        beside = [self._beside(text, outwards) for text in texts]
        arcs = [self._position(low, range_m) + by for range_m, by in zip(self.arcs_m, beside, strict=True)]
        for text, position in zip(texts, arcs, strict=True):  # no text ends beyond the picture
            half = cv2.getTextSize(text, FONT, size, 1)[0][0] / 2
            position[0] = min(position[0], canvas.shape[1] - half - 2)
        for text, position in zip(texts, arcs, strict=True):
            self._write(canvas, text, position)
        outer_m = self.fan.range_edges_m[1]
        spokes = {
            deg: self._position(math.radians(deg), outer_m, 34 * size) for deg in self.spokes_deg.tolist()
        }
        hidden = {
            abs(deg)
            for deg, position in spokes.items()
            if any((abs(position - arc) < LABEL_SIZE * size).all() for arc in arcs)
        }
        for deg, position in spokes.items():
            if abs(deg) not in hidden:  # both sides or neither
                self._write(canvas, f"{deg:+g}" if deg else "0", position, degrees=True)

    def _beside(self, text: str, outwards: np.ndarray) -> np.ndarray:
        """Return how far from the starboard edge text is written: farther where it is so long that it covers echoes."""
        size = self.font_size
        by = outwards * (45 * size, 28 * size)
        half = np.array(cv2.getTextSize(text, FONT, size, 1)[0]) / 2
        reach, across = outwards @ by, np.abs(outwards)
        if self.fan.full_circle or across @ half <= reach:  # a circle has no edge
            return by
        with_ground = half + math.ceil(5 * size) + 1  # and a line
        return by + outwards * (across @ with_ground - reach)

    def _write(
        self, canvas: np.ndarray, text: str, centre, degrees: bool = False, size: float | None = None
    ) -> None:
        """Write text about a position, on a darker ground; with a degree sign, which the font lacks."""
        size = self.font_size if size is None else size
        (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
        x, y, pad = round(centre[0] - width / 2), round(centre[1] + height / 2), math.ceil(5 * size)
        canvas[max(0, y - height - pad) : y + pad, max(0, x - pad) : x + width + pad] //= 4
        cv2.putText(canvas, text, (x, y), FONT, size, (TEXT_GRAY,) * 3, 1, cv2.LINE_AA)
        if degrees:
            radius = max(2.0, 3.5 * size)
            _draw_ring(canvas, (x + width + 1.5 * radius, y - height + 2 * size), radius)

    def _write_from(self, canvas: np.ndarray, text: str, column: int, row: float) -> None:
        """Write text that begins at a column, about a row."""
        (width, _), _ = cv2.getTextSize(text, FONT, self.font_size, 1)
        self._write(canvas, text, (column + width / 2, row))


def _draw_ring(canvas: np.ndarray, centre: tuple[float, float], radius: float) -> None:
    """Draw a ring one pixel wide about a position; one of a few pixels is a diamond by `cv2.circle`."""
    reach = radius + 1
    (left, right), (top, bottom) = ((max(0, math.ceil(at - reach)), int(at + reach) + 1) for at in centre)
    pixels = canvas[top:bottom, left:right]
    row, column = np.ogrid[top : top + pixels.shape[0], left : left + pixels.shape[1]]
    weight = np.clip(1 - np.abs(np.hypot(column - centre[0], row - centre[1]) - radius), 0, 1)[..., None]
    pixels[:] = np.rint(pixels * (1 - weight) + TEXT_GRAY * weight)


_axes = lru_cache(maxsize=4)(_Axes)  # so that lines are laid once for all pings of a sequence


def _tick_step(span: float, parts: float, steps) -> float:
    """Return the smallest of `steps` that cuts `span` into no more than `parts`."""
    return min((step for step in steps if span <= parts * step * (1 + 1e-9)), default=steps[-1])
