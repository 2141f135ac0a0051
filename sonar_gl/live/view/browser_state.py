"""What a browser reports beside viser's own events: the pointer over the ping's picture, and the keys held."""

from __future__ import annotations

import json
from dataclasses import dataclass
from html import escape
from pathlib import Path

FIELD = "page state"  # label of the text field that carries it; page.js has the same
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
    frame_s: float = (
        0.0  # that the browser lately took for a frame of the scene, seconds; 0 if it has not said so
    )

    @classmethod
    def read(cls, text: str) -> BrowserState:
        """Return the state that page.js has written as JSON.

        >>> BrowserState.read('{"pointer": [0.5, 0.25], "keys": ["w"]}').pointer
        (0.5, 0.25)
        """
        sent = json.loads(text)
        pointer, clicked = (at and tuple(at) for at in (sent.get("pointer"), sent.get("clicked")))
        keys = frozenset(sent.get("keys", ()))
        return cls(pointer, sent.get("clicks", 0), clicked, keys, sent.get("frame_s", 0.0))


def script_html(keys_move_sonar: bool) -> str:
    """Return the HTML that runs page.js in a browser, and tells it whether keys move the sonar or viser's camera."""
    script = Path(__file__).with_name("page.js").read_text(encoding="utf-8")
    keys = "<span data-keys-move-sonar></span>" if keys_move_sonar else ""
    return f'{keys}<img alt="" style="display:none" src="{_PIXEL}" onload="{escape(script)}">'
