"""Axes about a fan image's picture: range arcs, spokes and their labels."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonar_gl.image import fan_geometry
from sonar_gl.types import Error, Ping


def draw_axes(picture: np.ndarray, ping: Ping) -> np.ndarray:
    """A copy of a fan image's picture in a black margin, with range arcs (m) and spokes (°, port positive).

    Parameters
    ----------
    picture : (H, W, 3) uint8 RGB, of fan_image(ping, H); outside the fan it is painted black
    """
    picture = np.asarray(picture)
    fan = fan_geometry(ping, len(picture)) if picture.ndim == 3 else None
    if fan is None or picture.dtype != np.uint8 or picture.shape != (fan.height, fan.width, 3):
        want = f", here ({fan.height}, {fan.width}, 3)" if fan else ""
        raise Error(
            "draw_axes needs the (H, W, 3) uint8 picture of this ping's fan image"
            f"{want} (got {picture.shape}, {picture.dtype})"
        )
    letter = float(np.clip(fan.height / 1500, 0.35, 1.2))  # size of the font; 22 pixels high at 1
    margin = round(120 * letter)
    canvas = cv2.copyMakeBorder(picture, *[margin] * 4, cv2.BORDER_CONSTANT)
    (low, high), (inner_m, outer_m) = fan.azimuth_edges_rad, fan.range_edges_m

    def at(azimuth_rad, range_m, beyond=0.0):  # (..., 2) pixels on the canvas, `beyond` pixels further out
        pixel = fan.pixel(azimuth_rad, np.asarray(range_m) + beyond / fan.pixels_per_m)
        return np.stack(np.broadcast_arrays(*pixel), axis=-1) + margin

    def write(text, centre, degree=False):
        (wide, tall), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, letter, 1)
        x, y, pad = round(centre[0] - wide / 2), round(centre[1] + tall / 2), math.ceil(5 * letter)
        canvas[max(0, y - tall - pad) : y + pad, max(0, x - pad) : x + wide + pad] //= 4  # legible on echo
        style = ((225,) * 3, 1, cv2.LINE_AA)
        cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, letter, *style)
        if degree:  # the font has no such sign
            dot = (round(16 * (x + wide + 5 * letter)), round(16 * (y - tall + 2 * letter)))
            cv2.circle(canvas, dot, round(16 * max(1.5, 3.5 * letter)), *style, 4)

    arc = np.linspace(low, high, 361)
    sector = np.concatenate([at(arc, outer_m), at(arc[::-1], inner_m)])
    inside = cv2.fillPoly(np.zeros(canvas.shape[:2], np.uint8), [np.rint(sector).astype(np.int32)], 255)
    canvas[inside == 0] = 0
    pieces = min(8.0, (high - low) * outer_m * fan.pixels_per_m / (100 * letter))  # room for the labels
    step_deg = _nice(math.degrees(high - low), pieces, (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 45, 90))
    first, last = (math.degrees(edge) / step_deg for edge in (low, high))
    spokes_deg = np.arange(math.ceil(first - 1e-6), math.floor(last + 1e-6) + 1) * step_deg
    if fan.full_circle and spokes_deg[-1] - spokes_deg[0] > 360 - 1e-6:  # −180° is +180°
        spokes_deg = spokes_deg[1:]
    step_m = _nice(outer_m, 7, [n * 10.0**e for e in range(-4, 6) for n in (1, 2, 5)])
    arcs_m = np.arange(max(1, math.ceil(inner_m / step_m)), math.floor(outer_m / step_m + 1e-6) + 1) * step_m
    strokes = [at(arc, range_m) for range_m in (*arcs_m, outer_m)]
    edges = () if fan.full_circle else (low, high)
    strokes += [at(azimuth, [inner_m, outer_m]) for azimuth in (*np.radians(spokes_deg), *edges)]
    strokes = [np.rint(points * 16).astype(np.int32) for points in strokes]  # sixteenths of a pixel
    for colour, width, opacity in (
        (0, 2, 0.2),
        (255, 1, 0.45),
    ):  # a dark rim shows light lines on bright echo
        lines = cv2.polylines(
            np.zeros(canvas.shape[:2], np.uint8), strokes, False, 255, width, cv2.LINE_AA, 4
        )
        weight = lines[..., None] * np.float32(opacity / 255)
        canvas = np.rint(canvas * (1 - weight) + colour * weight).astype(np.uint8)
    outward = np.array([math.cos(low), -math.sin(low)])  # of the starboard edge: (right, down)
    places = [at(low, range_m) + outward * (45 * letter, 28 * letter) for range_m in arcs_m]
    for range_m, place in zip(arcs_m, places, strict=True):
        write(f"{range_m:g} m", place)
    labels = {deg: at(math.radians(deg), outer_m, 34 * letter) for deg in spokes_deg.tolist()}
    reach = np.array([65, 24]) * letter
    hidden = {abs(deg) for deg in labels for place in places if (abs(labels[deg] - place) < reach).all()}
    for deg, place in labels.items():
        if abs(deg) not in hidden:  # both sides or neither
            write(f"{deg:+g}" if deg else "0", place, degree=True)
    return canvas


def _nice(span: float, pieces: float, steps) -> float:
    """The smallest of `steps` that cuts `span` into no more than `pieces`."""
    return min((step for step in steps if span <= pieces * step * (1 + 1e-9)), default=steps[-1])
