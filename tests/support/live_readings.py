"""What a live session reads out of a frame, bin by bin and pixel by pixel."""

import numpy as np

from sonar_gl.live.frame import LiveFrame
from sonar_gl.live.session import LiveSession


def bodies_in(session: LiveSession, frame: LiveFrame, bins: np.ndarray | None = None) -> np.ndarray:
    """Return the name of the body in bins of a frame's ping, (B, K) str; "" for none, and in other bins.

    bins : (B, K) bool, which to read; None for those with an echo, or noise
    """
    names = np.full(frame.ping.intensity.shape, "", object)
    for beam, bin in np.argwhere(frame.ping.intensity > 0 if bins is None else bins):
        names[beam, bin] = session.reading(frame, beam, bin).body
    return names


def brightest_pixel(session: LiveSession, frame: LiveFrame, body: str) -> tuple[int, int]:
    """Return row and column of the brightest pixel of a frame's picture that shows a body."""
    brightness = frame.picture.sum(axis=2, dtype=int)
    for place in np.argsort(brightness, axis=None)[::-1]:
        row, column = map(int, np.unravel_index(place, brightness.shape))
        reading = session.at(frame, row, column)
        if reading is not None and reading.body == body:
            return row, column
    raise AssertionError(f"no pixel shows {body}")
