"""What a browser reports beside viser's own events: the pointer over the ping's picture, and the keys held."""

from __future__ import annotations

import json
from dataclasses import dataclass
from html import escape
from pathlib import Path

FIELD = "page state"  # label of the text field that carries it; page.js has the same
MAX_FRAME_S = 10.0
# any picture that a browser loads at once: scripts in HTML that is added to a page do not run, handlers do
_PIXEL = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="


@dataclass(frozen=True)
class BrowserState:
    """The state of one browser."""

    # (right, down) over the picture, 0..1 of its width and height; None where it is elsewhere
    pointer: tuple[float, float] | None = None
    clicks: int = 0  # number of clicks at the picture
    clicked: tuple[float, float] | None = None  # (right, down) of the last one
    keys: frozenset[str] = frozenset()  # names of `live.key_motion.KEYS` that are held
    # seconds that the browser lately took for a frame of the scene, 0..MAX_FRAME_S; 0 if it has not said so
    frame_s: float = 0.0

    @classmethod
    def read(cls, text: str) -> BrowserState:
        """Return the state that a browser has sent; an empty one for any text that is none.

        >>> BrowserState.read('{"pointer": [0.5, 0.25], "keys": ["w"]}').pointer
        (0.5, 0.25)
        >>> BrowserState.read("[[[") == BrowserState()
        True
        """
        try:
            values = json.loads(text)
        except (ValueError, RecursionError):
            return cls()
        if not isinstance(values, dict):
            return cls()
        clicks, keys, frame_s = values.get("clicks"), values.get("keys"), values.get("frame_s")
        return cls(
            _place(values.get("pointer")),
            clicks if type(clicks) is int else 0,
            _place(values.get("clicked")),
            frozenset(key for key in keys if isinstance(key, str)) if isinstance(keys, list) else frozenset(),
            float(frame_s) if type(frame_s) in (int, float) and 0 <= frame_s <= MAX_FRAME_S else 0.0,
        )


def _place(value) -> tuple[float, float] | None:
    """Return (right, down) within a picture; None if it is no such thing."""
    if not (isinstance(value, list) and len(value) == 2):
        return None
    if not all(type(one) in (int, float) and 0 <= one <= 1 for one in value):
        return None
    return float(value[0]), float(value[1])


def script_html(keys_move_sonar: bool) -> str:
    """Return the HTML that runs page.js in a browser, and tells it whether keys move the sonar or viser's camera."""
    script = Path(__file__).with_name("page.js").read_text(encoding="utf-8")
    keys = "<span data-keys-move-sonar></span>" if keys_move_sonar else ""
    return f'{keys}<img alt="" style="display:none" src="{_PIXEL}" onload="{escape(script)}">'
