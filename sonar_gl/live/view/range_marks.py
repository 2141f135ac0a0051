"""Lines of equal range and azimuth over the ping's picture, which the browser draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from sonar_gl.imaging.axes import fan_ticks
from sonar_gl.imaging.fan_image import FanGeometry, azimuth_key, fan_geometry
from sonar_gl.live.frame import LiveFrame

LETTERS = 34  # lines of text along the longer side of a picture
SPOKE_LETTERS = 6  # heights of a letter from one spoke to the next, at least
LETTER_WIDTH = 0.6  # of its height, about
NARROW = 0.62  # of its height: labels of a narrower picture may stand beside it
# a dark rim shows light lines on bright echo
STROKES = (("#000", 3, 0.3), ("#fff", 1, 0.4))
TEXT_STYLE = "fill:#fff;stroke:#000;stroke-opacity:.7;paint-order:stroke;font-family:sans-serif"


@dataclass(frozen=True)
class MarkedPicture:
    """What the lines over a picture depend on."""

    geometry: FanGeometry  # of the ping
    azimuths: bytes  # `azimuth_key` of the ping
    form: str  # one of `live.settings.FORMS`

    @classmethod
    def of(cls, frame: LiveFrame) -> MarkedPicture:
        settings = frame.settings
        return cls(fan_geometry(frame.ping, settings.height), azimuth_key(frame.ping), settings.form)

    @property
    def size(self) -> tuple[int, int]:
        height = self.geometry.height
        return (self.geometry.width if self.form == "fan" else height), height

    def place(self, azimuth_rad: float, range_m: float) -> tuple[float, float]:
        """Return where a point is: pixels from the left and the upper edge."""
        if self.form == "fan":
            column, row = self.geometry.pixel(azimuth_rad, range_m)
            return float(column) + 0.5, float(row) + 0.5
        azimuths = np.frombuffer(self.azimuths, np.float64)
        (low, high), (inner_m, outer_m) = self.geometry.azimuth_edges_rad, self.geometry.range_edges_m
        shares = np.arange(len(azimuths) + 2) - 0.5
        shares[[0, -1]] = 0, len(azimuths)
        share = np.interp(azimuth_rad, [low, *azimuths, high], shares / len(azimuths))
        width, height = self.size
        return float((1 - share) * width), float((outer_m - range_m) / (outer_m - inner_m) * height)


def marks_html(marked: MarkedPicture) -> str:
    """Return the lines and their numbers as HTML that page.js lays over the picture."""
    (width, height), letter = marked.size, max(marked.size) / LETTERS
    ticks = fan_ticks(marked.geometry, SPOKE_LETTERS * letter)
    low, high = marked.geometry.azimuth_edges_rad
    inner_m, outer_m = marked.geometry.range_edges_m
    middle = (low + high) / 2
    paths = [_arc(marked, [low, middle, high], range_m) for range_m in ticks.arcs_m.tolist()]
    spokes = {deg: math.radians(deg) for deg in ticks.spokes_deg.tolist()}
    paths += [
        _line([marked.place(azimuth, range_m) for range_m in (inner_m, outer_m)])
        for azimuth in spokes.values()
    ]
    labels = [
        (f"{range_m:g} m", _beside(marked, range_m, f"{range_m:g} m", letter))
        for range_m in ticks.arcs_m.tolist()
    ]
    m_per_pixel = (outer_m - inner_m) / height if marked.form == "polar" else 1 / marked.geometry.pixels_per_m
    inside_m = outer_m - letter * m_per_pixel
    taken = [place for _, place in labels]
    angles = {
        deg: _moved_in(marked.place(azimuth, inside_m), letter, width) for deg, azimuth in spokes.items()
    }
    hidden = {abs(deg) for deg, place in angles.items() if not _has_room(place, taken, letter, width)}
    # both sides or neither
    labels += [
        (f"{deg:+g}°" if deg else "0°", place) for deg, place in angles.items() if abs(deg) not in hidden
    ]
    return _svg((width, height), "".join(paths), labels, letter)


def _beside(marked: MarkedPicture, range_m: float, text: str, letter: float) -> tuple[float, float]:
    """Return the middle of an arc's label: beside the starboard edge where it has room, else within the fan."""
    low = marked.geometry.azimuth_edges_rad[0]
    (right, down), (width, height) = marked.place(low, range_m), marked.size
    half, lower = LETTER_WIDTH * letter * len(text) / 2 + 0.4 * letter, 0.7 * letter
    if marked.form == "polar":  # below the line, at its starboard end
        return right - half, min(down + lower, height - lower)
    room = (width + max(width, NARROW * height)) / 2
    outwards = math.cos(low), -math.sin(low)
    beside = right + outwards[0] * half, max(down + outwards[1] * lower, lower)
    if beside[0] + half <= room and beside[1] + lower <= height:
        return beside
    return min(right, room) - half, min(down + lower, height - lower)


def _moved_in(place: tuple[float, float], letter: float, width: float) -> tuple[float, float]:
    """Return the place of an angle, no nearer to the picture's sides than its letters are wide, if it hardly moves."""
    half = 2 * LETTER_WIDTH * letter
    right = min(max(place[0], half), width - half)
    # as that of a spoke straight aside
    return (right, place[1]) if abs(right - place[0]) < 0.3 * letter else place


def _has_room(place: tuple[float, float], taken: Iterable, letter: float, width: float) -> bool:
    """Return whether an angle may be written at a place: inside the picture, and not over a range."""
    half = 2 * LETTER_WIDTH * letter
    if not half <= place[0] <= max(width - half, half) and width > 2 * half:
        return False
    return not any(
        abs(place[0] - other[0]) < 2.2 * half and abs(place[1] - other[1]) < 1.2 * letter for other in taken
    )


def _arc(marked: MarkedPicture, azimuths: list[float], range_m: float) -> str:
    points = [marked.place(azimuth, range_m) for azimuth in azimuths]
    if marked.form == "polar":
        return _line(points)
    radius = range_m * marked.geometry.pixels_per_m
    # two halves, since the ends of a whole circle meet
    return _line(points, lambda point: f"A{radius:.1f} {radius:.1f} 0 0 0 {_pair(point)}")


def _line(points: list[tuple[float, float]], step: Callable | None = None) -> str:
    first, *others = points
    return f"M{_pair(first)}" + "".join(map(step or (lambda point: f"L{_pair(point)}"), others))


def _pair(point: tuple[float, float]) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _svg(size: tuple[int, int], path: str, labels: list, letter: float) -> str:
    strokes = "".join(
        f'<path d="{path}" fill="none" vector-effect="non-scaling-stroke" stroke="{color}" stroke-width="{width}" '
        f'stroke-opacity="{opacity}"/>'
        for color, width, opacity in STROKES
    )
    texts = "".join(f'<text x="{right:.1f}" y="{down:.1f}">{text}</text>' for text, (right, down) in labels)
    style = f"{TEXT_STYLE};font-size:{letter:.1f}px;stroke-width:{0.2 * letter:.1f}px"
    return (
        f'<div data-marks style="display:none"><svg viewBox="0 0 {size[0]} {size[1]}" aria-hidden="true" '
        'style="width:100%;height:100%;overflow:visible;display:block">'
        f'{strokes}<g style="{style}" text-anchor="middle" dominant-baseline="central">{texts}</g></svg></div>'
    )
