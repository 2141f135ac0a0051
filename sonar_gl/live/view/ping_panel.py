"""The panel with the ping's picture, what is read from it, and the time bar of a trajectory."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from sonar_gl.core.poses import pose_numbers
from sonar_gl.live.frame import LiveFrame, LiveState, Reading
from sonar_gl.live.session import LiveSession
from sonar_gl.live.view.actions import Actions
from sonar_gl.live.view.browser_state import FIELD, script_html

JPEG_QUALITY = 92  # below it, blocks of a JPEG look like speckle
PANEL_WIDTH = 430  # pixels of the page
HIGHLIGHT_SHARE = 0.55  # brightness that pixels outside a highlighted body keep
ROW = "display:flex;font-size:12.5px;line-height:1.6;font-variant-numeric:tabular-nums"
NOTHING = "–"


class PingPanel:
    """The panel on the left.

    Parameters
    ----------
    server : viser.ViserServer
    session : LiveSession
    actions : Actions
    """

    def __init__(self, server, session: LiveSession, actions: Actions):
        self._session, self._actions = session, actions
        panel = server.gui.add_panel()
        with panel.add_tab("Ping"):
            self._image = server.gui.add_image(
                session.frame.picture, format="jpeg", jpeg_quality=JPEG_QUALITY
            )
            self._under = server.gui.add_html("")
            self._numbers = server.gui.add_html("")
            self._script = server.gui.add_html(script_html(keys_move_sonar=True))
            self.browser_state = server.gui.add_text(FIELD, "")
            if session.track is not None:
                self._add_time_bar(server)
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)
        self.read(None)

    def show(self, frame: LiveFrame) -> None:
        """Show the picture of a frame."""
        picture = frame.picture
        if frame.highlight is not None and frame.highlight.any():
            dim = (picture * HIGHLIGHT_SHARE).astype(np.uint8)
            picture = np.where(frame.highlight[..., None], picture | 32, dim)
        self._image.image = picture

    def show_numbers(self, frame: LiveFrame, state: LiveState) -> None:
        """Show the numbers of a frame, and what the session does now, such as that its pings fail."""
        self._numbers.content = _numbers_html(frame, state)
        if self._session.track is not None:
            self._show_time(state)

    def _show_time(self, state: LiveState) -> None:
        position_s = min(round(state.position_s, 1), self._position.max)
        if self._position.value != position_s and not self._actions.waits(id(self._position)):
            self._position.value = position_s
        label = "Pause" if state.is_playing else "Play"
        if self._play.label != label:
            self._play.label = label

    def read(self, reading: Reading | None) -> None:
        """Show what stands under the pointer; None outside the fan."""
        self._under.content = _reading_html(reading)

    def switch_keys(self, move_sonar: bool) -> None:
        """Have keys move the sonar, or else the browser's camera."""
        self._script.content = script_html(move_sonar)

    def _add_time_bar(self, server) -> None:
        session, duration_s = self._session, self._session.track.duration_s
        self._play = server.gui.add_button("Pause")
        step = max(0.1, round(duration_s / 1000, 1))
        self._position = server.gui.add_slider(
            "time, s", 0.0, max(duration_s, step), step, 0.0, hint="Time since the trajectory's first pose."
        )
        self._actions.connect(
            self._position, lambda value: session.seek(min(max(float(value), 0.0), duration_s))
        )
        self._actions.connect_button(
            self._play, lambda _: session.pause() if session.state().is_playing else session.play()
        )


def _rows_html(rows) -> str:
    """Return lines of names and values; a row may have several of them side by side."""
    lines = []
    for row in rows:
        cells = "".join(
            f'<span style="opacity:.6;width:{width}em;flex-shrink:0">{escape(name)}</span>'
            f'<span style="flex:1;white-space:nowrap">{escape(value)}</span>'
            for name, value, width in row
        )
        lines.append(f'<div style="{ROW}">{cells}</div>')
    return f'<div style="padding:2px 10px 6px 10px">{"".join(lines)}</div>'


def _numbers_html(frame: LiveFrame, state: LiveState) -> str:
    x, y, z, roll, pitch, yaw = pose_numbers(frame.pose)
    angles = " ".join(f"{math.degrees(angle):.1f}°" for angle in (roll, pitch, yaw))
    estimate = NOTHING if frame.error_estimate is None else f"{100 * frame.error_estimate:.2g} %"
    rows = [
        [
            ("ping rate", f"{frame.rate_hz:.1f} Hz", 7),
            ("samples", f"{frame.samples:,}".replace(",", "\u2009"), 5),
        ],
        [("error estimate", f"{estimate} at tolerance {100 * frame.settings.tolerance:g} %", 7)],
        [("x y z", f"{x:.2f} {y:.2f} {z:.2f} m", 7)],
        [("roll pitch yaw", angles, 7)],
    ]
    text = state.problem or " ".join(frame.notes)
    problem = f'<div style="padding:0 10px 6px 10px;color:#ff8a80;font-size:12.5px">{escape(text)}</div>'
    return '<hr style="opacity:.2;margin:0 10px 4px 10px">' + _rows_html(rows) + (problem if text else "")


def _reading_html(reading: Reading | None) -> str:
    body = range_text = azimuth = elevation = level = NOTHING
    if reading is not None:
        body = reading.body or NOTHING
        range_text = f"{reading.range_m:.2f} m"
        azimuth = f"{math.degrees(reading.azimuth_rad):+.1f}°"
        level = f"{reading.level_db:.1f} dB, {reading.count} counts"
        if reading.elevation_rad is not None:
            elevation = f"{math.degrees(reading.elevation_rad):+.1f}°"
    return _rows_html(
        [
            [("under pointer", body, 7)],
            [("range", range_text, 7), ("azimuth", azimuth, 5)],
            [("level", level, 7), ("elevation", elevation, 5)],
        ]
    )
