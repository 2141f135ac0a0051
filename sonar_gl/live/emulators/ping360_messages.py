"""Messages of Blue Robotics' Ping protocol, as a Ping360 uses them.

A message is "BR", the length of its payload, its type, the number of its source and its destination, the payload, and
the sum of all bytes before as uint16; little-endian, packed without gaps.

Source: github.com/bluerobotics/ping-protocol, src/definitions (common.json, ping360.json)
"""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass
from itertools import accumulate

from sonar_gl.core.errors import Error

HEAD = struct.Struct("<2sHHBB")
CHECKSUM = struct.Struct("<H")
ACK, NACK, DEVICE_INFORMATION, PROTOCOL_VERSION, GENERAL_REQUEST = 1, 2, 4, 5, 6
SET_DEVICE_ID, DEVICE_DATA, AUTO_DEVICE_DATA = 2000, 2300, 2301
RESET, TRANSDUCER, AUTO_TRANSMIT, MOTOR_OFF = 2600, 2601, 2602, 2903
TRANSDUCER_PAYLOAD = struct.Struct("<BBHHHHHBB")
AUTO_PAYLOAD = struct.Struct("<BBHHHHHHBB")
DATA_PAYLOAD = struct.Struct("<BBHHHHHH")
AUTO_DATA_PAYLOAD = struct.Struct("<BBHHHHHHBBHH")
SAMPLE_TICK_S = 25e-9  # unit of the sample period
GRADIANS = 400  # of a turn


@dataclass(frozen=True)
class PingMessage:
    """A message: its type and its payload."""

    kind: int
    payload: bytes = b""

    def pack(self, source: int, destination: int) -> bytes:
        body = HEAD.pack(b"BR", len(self.payload), self.kind, source, destination) + self.payload
        return body + CHECKSUM.pack(sum(body) & 0xFFFF)


def parse_messages(datagram: bytes) -> list[PingMessage]:
    """Return the messages in a datagram; bytes that are none are skipped.

    The time grows as the number of bytes: in noise each "BR" may begin a message of up to 64 kB.
    """
    messages, start = [], datagram.find(b"BR")
    sums = list(accumulate(datagram, initial=0))  # of the bytes before each
    while 0 <= start <= len(datagram) - HEAD.size - CHECKSUM.size:
        _, size, kind, _, _ = HEAD.unpack_from(datagram, start)
        end = start + HEAD.size + size
        is_whole = end + CHECKSUM.size <= len(datagram)
        if is_whole and CHECKSUM.unpack_from(datagram, end)[0] == (sums[end] - sums[start]) & 0xFFFF:
            messages.append(PingMessage(kind, datagram[start + HEAD.size : end]))
            start = end + CHECKSUM.size - 2
        start = datagram.find(b"BR", start + 2)
    return messages


@dataclass(frozen=True)
class TransducerSettings:
    """What a program asks a Ping360 to do."""

    # mode, gain_setting: as they came; gain 0 is low, 1 normal, 2 high
    mode: int
    gain_setting: int
    angle: int  # of the head, gradians
    transmit_duration_us: int  # length of the pulse, microseconds
    sample_period: int  # between samples, in units of 25 ns
    transmit_frequency_khz: int  # kilohertz
    n_samples: int  # of the echo

    def __post_init__(self):
        for name, low, high in (
            ("gain_setting", 0, 2),
            ("angle", 0, GRADIANS - 1),
            ("transmit_duration_us", 1, 1000),
            ("sample_period", 80, 40_000),
            ("transmit_frequency_khz", 500, 1000),
            ("n_samples", 1, 1200),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise Error(f"{name} must be {low} to {high} (got {value})")

    @property
    def sample_time_s(self) -> float:
        return self.sample_period * SAMPLE_TICK_S

    def data(self, counts: bytes) -> PingMessage:
        """Return the answer to these settings; `counts` are empty if the head turned without transmitting."""
        return PingMessage(DEVICE_DATA, DATA_PAYLOAD.pack(*astuple(self), len(counts)) + counts)


@dataclass(frozen=True)
class Scan:
    """A sector that the head scans to and fro by itself, or all round."""

    settings: TransducerSettings  # of its pings; `angle` does not count
    # start, stop: gradians
    start: int
    stop: int
    step: int  # gradians between pings
    delay_s: float  # seconds after each ping

    def __post_init__(self):
        for name, low, high in (("start", 0, GRADIANS - 1), ("stop", 0, GRADIANS - 1), ("step", 1, 10)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise Error(f"{name} of a scan must be {low} to {high} (got {value})")
        if not 0 <= self.delay_s <= 0.1:
            raise Error(f"delay of a scan must be 0 to 100 ms (got {1e3 * self.delay_s:g})")

    def angle(self, number: int) -> int:
        """Return the head's angle at the ping of a number, gradians."""
        width = (self.stop - self.start) % GRADIANS
        if width in (0, GRADIANS - 1):  # all round
            return (self.start + number * self.step) % GRADIANS
        steps = width // self.step
        there = number % (2 * steps) if steps else 0
        return (self.start + min(there, 2 * steps - there) * self.step) % GRADIANS

    def data(self, settings: TransducerSettings, counts: bytes) -> PingMessage:
        *fields, n_samples = astuple(settings)
        sector = self.start, self.stop, self.step, round(1e3 * self.delay_s)
        payload = AUTO_DATA_PAYLOAD.pack(*fields, *sector, n_samples, len(counts))
        return PingMessage(AUTO_DEVICE_DATA, payload + counts)


def parse_transducer(payload: bytes) -> tuple[TransducerSettings, bool]:
    """Return the settings of a message TRANSDUCER, and whether it asks to transmit; Error if it is wrong."""
    if len(payload) != TRANSDUCER_PAYLOAD.size:
        raise Error(f"a transducer message must have {TRANSDUCER_PAYLOAD.size} bytes (got {len(payload)})")
    *fields, transmit, _reserved = TRANSDUCER_PAYLOAD.unpack(payload)
    return TransducerSettings(*fields), transmit != 0


def parse_scan(payload: bytes) -> Scan:
    """Return the scan of a message AUTO_TRANSMIT; Error if it is wrong."""
    if len(payload) != AUTO_PAYLOAD.size:
        raise Error(f"an auto_transmit message must have {AUTO_PAYLOAD.size} bytes (got {len(payload)})")
    mode, gain, duration, period, frequency, samples, start, stop, step, delay = AUTO_PAYLOAD.unpack(payload)
    settings = TransducerSettings(mode, gain, 0, duration, period, frequency, samples)
    return Scan(settings, start, stop, step, delay / 1e3)
