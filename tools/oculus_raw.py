"""Raw pings of Blueprint Subsea's Oculus sonars, as the device sends them over the network.

`sonar_gl.live.emulators.oculus_messages` describes their layout.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.live.emulators.oculus_messages import (
    FIRE_SETTINGS,
    HEADER,
    OCULUS_ID,
    RESULT,
    RESULT_1,
    SENDS_GAIN,
)

SIMPLE_VERSION = 0  # messages of version 2 have longer settings
GAIN_BYTES = 4
EIGHT_BITS = 0  # code of the size of a number
MAX_BYTES = 1 << 28  # some thousand pings; a longer file is no short recording


class RawPing(NamedTuple):
    """A ping of the device. B beams, K bins.

    Attributes
    ----------
    counts : (B, K) uint8, the picture's numbers, beams by rising azimuth
    beam_azimuths_deg : (B,) azimuths, degrees, rising, positive to port; the device counts bearings to starboard
    bin_size_m : length of a bin, metres; the first one begins at 0
    frequency_hz, sound_speed_m_s : hertz, and metres per second that the device took for ranges
    """

    counts: np.ndarray
    beam_azimuths_deg: tuple[float, ...]
    bin_size_m: float
    frequency_hz: float
    sound_speed_m_s: float


def read_pings(path: str | Path) -> list[RawPing]:
    """Return the pings of a file of messages, one after the other; messages of other types are skipped.

    Raises
    ------
    Error
        if the file cannot be read, is cut off, or holds anything else.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise Error(f"{path}: a file of raw pings must have at most {MAX_BYTES} bytes (got {size})")
        data = path.read_bytes()
    except OSError as error:
        raise Error(f"{path}: the file of raw pings must be readable (got {error.strerror})") from None
    pings, start = [], 0
    while start < len(data):
        end = _message_end(path, data, start)
        if HEADER.unpack_from(data, start)[3] == RESULT:
            pings.append(_read_ping(f"{path}: the message at byte {start}", data[start:end]))
        start = end
    if not pings:
        raise Error(f"{path}: must hold a raw ping at least (got none in {len(data)} bytes)")
    return pings


def _message_end(path: Path, data: bytes, start: int) -> int:
    """Return where the message that starts at a byte ends."""
    left = len(data) - start
    if left < HEADER.size:
        raise Error(f"{path}: a message of an Oculus begins with {HEADER.size} bytes (got {left} at {start})")
    mark, *_, payload, _spare = HEADER.unpack_from(data, start)
    if mark != OCULUS_ID:
        raise Error(
            f"{path}: a message of an Oculus must begin with 0x{OCULUS_ID:04x} (got 0x{mark:04x} at byte {start})"
        )
    if left < HEADER.size + payload:
        raise Error(
            f"{path}: a message must be whole (got {left} of {HEADER.size + payload} bytes at {start})"
        )
    return start + HEADER.size + payload


def _read_ping(location: str, message: bytes) -> RawPing:
    """Return the ping of one message of type RESULT; errors begin with the location."""
    version = HEADER.unpack_from(message)[4]
    if version != SIMPLE_VERSION:
        raise Error(f"{location} must have version {SIMPLE_VERSION} (got {version})")
    fixed = HEADER.size + FIRE_SETTINGS.size + RESULT_1.size
    if len(message) < fixed:
        raise Error(f"{location} must have {fixed} bytes before its bearings (got {len(message)})")
    flags = FIRE_SETTINGS.unpack_from(message, HEADER.size)[4]
    result = RESULT_1.unpack_from(message, HEADER.size + FIRE_SETTINGS.size)
    frequency_hz, _temperature, _pressure, speed_m_s = result[2:6]
    number_size, bin_size_m, n_bins, n_beams, offset, picture_bytes, message_bytes = result[7:]
    if number_size != EIGHT_BITS:
        raise Error(f"{location} must have numbers of 8 bits (got size {number_size}; 1 is 16 bits)")
    if not (0 < frequency_hz < np.inf and 0 < speed_m_s < np.inf and 0 < bin_size_m < np.inf):
        raise Error(
            f"{location} must have a frequency, a sound speed and a bin above 0 "
            f"(got {frequency_hz:g} Hz, {speed_m_s:g} m/s, {bin_size_m:g} m)"
        )
    gain_bytes = GAIN_BYTES if flags & SENDS_GAIN else 0
    if n_bins < 1 or n_beams < 1 or picture_bytes != n_bins * (n_beams + gain_bytes):
        raise Error(
            f"{location} must have a picture of its bins and beams (got {picture_bytes} bytes for {n_bins} x {n_beams})"
        )
    if message_bytes != len(message) or not fixed + 2 * n_beams <= offset <= len(message) - picture_bytes:
        raise Error(
            f"{location} must contain its bearings and its picture "
            f"(got a picture of {picture_bytes} bytes at {offset} of {len(message)})"
        )
    bearings = np.frombuffer(message, "<i2", n_beams, fixed) / 100
    if (np.diff(bearings) <= 0).any():
        raise Error(f"{location} must have bearings that rise (got {bearings.tolist()[:3]}, ...)")
    picture = np.frombuffer(message, np.uint8, picture_bytes, offset).reshape(n_bins, -1)[:, gain_bytes:]
    azimuths = tuple((0.0 - bearings[::-1]).tolist())
    return RawPing(picture.T[::-1].copy(), azimuths, bin_size_m, frequency_hz, speed_m_s)
