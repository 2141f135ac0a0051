"""The panel with the ping's picture, what is read from it, and the time bar of a trajectory."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape

from sonar_gl.core.poses import pose_numbers
from sonar_gl.live.frame import LiveFrame, LiveState, Reading, Surface
from sonar_gl.live.pictures import outlined
from sonar_gl.live.session import LiveSession
from sonar_gl.live.view.actions import Actions
from sonar_gl.live.view.browser_state import FIELD, script_html
from sonar_gl.live.view.outline import SELECTED_COLOR
from sonar_gl.live.view.range_marks import MarkedPicture, marks_html

JPEG_QUALITY = 92  # below it, blocks of a JPEG look like speckle
PANEL = "Ping"  # page.js has the same
PANEL_WIDTH = 430  # pixels of the page
ROW = "display:flex;flex-wrap:wrap;column-gap:0.5em;font-size:12.5px;line-height:1.6;font-variant-numeric:tabular-nums"
# of name and value, first and second in a row: "roll pitch yaw" is the longest name; a phone has the second below
WIDTHS_EM = (8, 10), (5, 5)
NOTHING = "–"
UNSELECT = "Unselect"
SELECTED_NOTE = (
    "Green in 3D; its echoes are outlined in the picture. Drag its arrows, squares and arcs in 3D to move and turn it; "
    "Put all back, under Bodies, undoes that."
)
HELP = (
    ("W S", "ahead, back"),
    ("A D", "port, starboard"),
    ("E Q", "up, down"),
    ("← → ↑ ↓", "turn"),
    ("click", "at a body in 3D to select it, in the picture to mark its surface in 3D"),
    ("drag", "in 3D to look around"),
)
HELP_HTML = '<div style="padding:2px 10px;font-size:12px;line-height:1.5;opacity:.75">{}</div>'.format(
    "; ".join(f"<b>{keys}</b> {what}" for keys, what in HELP)
)
PENDING = "computing with the new settings ..."


class PingPanel:
    """The panel on the left.

    on_body : action of the name of a body that is selected; "" for none
    """

    def __init__(self, server, session: LiveSession, actions: Actions, on_body: Callable[[str], None]):
        self._session, self._actions = session, actions
        self.shows_marks = True  # lines of range and azimuth over the next picture
        self._marked: MarkedPicture | None = None  # what the lines on show are of
        panel = server.gui.add_panel()
        with panel.add_tab(PANEL):
            self._image = server.gui.add_image(
                session.frame.picture, format="jpeg", jpeg_quality=JPEG_QUALITY
            )
            self._marks = server.gui.add_html("")
            self._under = server.gui.add_html("")
            self._clicked = server.gui.add_html("")
            self._selected = server.gui.add_html("")
            self._unselect = server.gui.add_button(UNSELECT, visible=False)
            self._numbers = server.gui.add_html("")
            self._script = server.gui.add_html(script_html(keys_move_sonar=True))
            self.browser_state = server.gui.add_text(FIELD, "")
            if session.track is not None:
                self._add_time_bar(server)
            server.gui.add_html(HELP_HTML)
        actions.connect_button(self._unselect, lambda _: on_body(""))
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)
        panel.expand()  # on phones it would begin as a line
        self.read(None)

    def show(self, frame: LiveFrame) -> None:
        picture = frame.picture
        if frame.highlight is not None:
            picture = outlined(picture, frame.highlight, SELECTED_COLOR)
        self._image.image = picture
        marked = MarkedPicture.of(frame) if self.shows_marks else None
        if marked != self._marked:
            self._marks.content = "" if marked is None else marks_html(marked)
            self._marked = marked

    def show_numbers(self, frame: LiveFrame, state: LiveState) -> None:
        """Show the numbers of a frame, and what the session does now, such as that its pings fail."""
        self._numbers.content = _numbers_html(frame, state)
        if self._session.track is not None:
            self._actions.show(self._position, min(round(state.position_s, 1), self._position.max))
            label = "Pause" if state.is_playing else "Play"
            if self._play.label != label:
                self._play.label = label

    def read(self, reading: Reading | None) -> None:
        """Show what stands under the pointer; None outside the fan."""
        self._under.content = _reading_html(reading)

    def show_click(self, reading: Reading | None, surface: Surface | None) -> None:
        """Show what the last click in the picture has met; None outside the fan."""
        content = ""
        if reading is not None:
            seen = surface is not None and len(surface.points_m)
            text = f"{reading.body or 'no body'} at {reading.range_m:.2f} m, "
            text += "pink in 3D" if seen else "no surface in the main lobe"
            content = _rows_html([[("last click", text)]])
        self._clicked.content = content

    def show_selected(self, name: str) -> None:
        """Show which body is selected, and what can be done with it; "" for none."""
        content = "" if not name else _rows_html([[("selected", name)]]) + _note_html(SELECTED_NOTE)
        if self._selected.content != content:
            self._selected.content, self._unselect.visible = content, bool(name)

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


def rounded(number: float, decimals: int) -> str:
    """Return a number with some decimals, 0 without a sign."""
    return f"{round(number, decimals) + 0.0:.{decimals}f}"


def _rows_html(rows) -> str:
    """Return lines of names and values; a row may have several of them side by side.

    A value by itself goes on in a second line where it is too long for one, such as the name of a body.
    """
    lines = []
    for row in rows:
        alone = len(row) == 1
        value_style = "flex:1" if alone else "flex:1;white-space:nowrap"
        cells = "".join(
            f'<span style="display:flex;column-gap:0.5em;flex:{"1" if alone else f"1 0 {width + value_em}em"}">'
            f'<span style="opacity:.6;width:{width}em;flex-shrink:0">{escape(name)}</span>'
            f'<span style="{value_style};overflow-wrap:anywhere">{escape(value)}</span></span>'
            for (name, value), (width, value_em) in zip(row, WIDTHS_EM, strict=False)
        )
        lines.append(f'<div style="{ROW}">{cells}</div>')
    return f'<div style="padding:2px 10px 6px 10px">{"".join(lines)}</div>'


def _numbers_html(frame: LiveFrame, state: LiveState) -> str:
    x, y, z, roll, pitch, yaw = pose_numbers(frame.pose)
    angles = " ".join(f"{rounded(math.degrees(angle), 1)}°" for angle in (roll, pitch, yaw))
    place = " ".join(rounded(one, 2) for one in (x, y, z))
    estimate = NOTHING if frame.ping.error_estimate is None else f"{100 * frame.ping.error_estimate:.2g} %"
    is_pending = state.settings is not frame.settings
    rows = [
        [("ping rate", PENDING)]
        if is_pending
        else [
            ("ping rate", f"{frame.rate_hz:.1f} Hz" if frame.rate_hz else NOTHING),
            ("samples", f"{frame.samples:,}".replace(",", "\u2009")),
        ],
        [("error estimate", f"{estimate} at tolerance {100 * frame.settings.tolerance:g} %")],
        [("x y z", f"{place} m")],
        [("roll pitch yaw", angles)],
    ]
    text = state.problem or " ".join(frame.notes)
    problem = _note_html(text, "#ff8a80") if text else ""
    return '<hr style="opacity:.2;margin:0 10px 4px 10px">' + _rows_html(rows) + problem


def _note_html(text: str, color: str = "inherit") -> str:
    return f'<div style="padding:0 10px 6px 10px;color:{color};font-size:12.5px">{escape(text)}</div>'


def _reading_html(reading: Reading | None) -> str:
    body = range_text = azimuth = elevation = level = NOTHING
    if reading is not None:
        body = reading.body or NOTHING
        range_text = f"{reading.range_m:.2f} m"
        azimuth = f"{math.degrees(reading.azimuth_rad):+.1f}°"
        level_db = f"{reading.level_db:.1f} dB" if math.isfinite(reading.level_db) else "no echo"
        level = f"{level_db}, {reading.count} counts"
        if reading.elevation_rad is not None:
            elevation = f"{math.degrees(reading.elevation_rad):+.1f}°"
    return _rows_html(
        [
            [("under pointer", body)],
            [("range", range_text), ("azimuth", azimuth)],
            [("level", level), ("elevation", elevation)],
        ]
    )
