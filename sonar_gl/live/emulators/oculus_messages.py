"""Messages between Blueprint Subsea's Oculus sonars and the programs that use them.

The layout is that of the structures in thirdparty/Oculus/Oculus.h of github.com/apl-ocean-engineering/liboculus:
little-endian, packed without gaps. Each message begins with a header, which holds the length of what follows it.

- A program sends a *fire message*: mode, range, gain. The sonar pings with these settings until the next one.
- The sonar answers each ping with a *result*: the fire message, what the sonar did, a bearing for each beam, int16,
  hundredths of a degree, positive to starboard, and the image, range by range, at an offset that the message holds.
- The sonar announces itself by a *status*, once a second, to UDP port 52102. It serves results at TCP port 52100.

Fire messages and results have two versions: the second has longer fields. The time at which a ping starts is in
seconds in the second. For the first the layout has 32 bits and no unit: they count nanoseconds, and begin anew every
2³² ns, 4.29 s. In three consecutive pings of an M1200d, liboculus' test/data/three_pings_8bit.raw, it grows by
62 502 130 and 62 502 097, a sixteenth of a second. In microseconds these pings would lie a minute apart.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from ipaddress import IPv4Address

import numpy as np

from sonar_gl.core.errors import Error

OCULUS_ID = 0x4F53  # of every message
FIRE, RESULT, STATUS = 0x15, 0x23, 0x01  # types of messages; liboculus does not look at that of a status
HEADER = struct.Struct("<HHHHHIH")  # id, source, destination, type, version, length of the payload, spare
# mode, ping rate, network speed, gamma, flags, range, gain, speed of sound, salinity
FIRE_SETTINGS = struct.Struct("<BBBBBdddd")
FIRE_RESERVE_BYTES = 36  # of version 2: flags of extensions, and reserved
# ping, status, frequency, temperature, pressure, speed of sound, start time, size of a number, bin, bins, beams, offset
# of the image, its bytes, bytes of the message
RESULT_1 = struct.Struct("<IIddddIBdHHIII")
# the same with heading, pitch and roll before the speed of sound, and four spare numbers before the offset
RESULT_2 = struct.Struct("<IIdddddddd" + "BdHH4I" + "III")
# device, type, part, status; six versions and dates of firmware; address, mask, connected address; hardware address;
# eight temperatures, pressure
STATUS_BODY = struct.Struct("<IHHI6I4s4s4s6s9d")
IMAGE_OFFSET = 2048  # as in messages of an M1200d; bearings of 512 beams end before
RANGE_IN_METRES, SIXTEEN_BITS, SENDS_GAIN, GAIN_ASSISTANCE, BEAMS_512 = 0x01, 0x02, 0x04, 0x10, 0x40  # flags
LOW_FREQUENCY, HIGH_FREQUENCY = 1, 2  # modes
STANDBY = 5  # ping rate
PING_RATES_HZ = {0: 10.0, 1: 15.0, 2: 40.0, 3: 5.0, 4: 2.0}
IMAGING_SONAR, MAIN_PROGRAM_RUNS = 1, 3  # type of device, status
MAX_RANGE_M = 1e3
NANOSECONDS = 1_000_000_000
GREATEST_GAIN = 2**31 - 1


class WrongFireError(Error):
    """A fire message is wrong; `field` says what of it."""

    def __init__(self, field: str, why: str):
        super().__init__(why)
        self.field = field


@dataclass(frozen=True)
class FireMessage:
    """What a program asks an Oculus to do from now on."""

    version: int  # 1 or 2, of the fire message; the result has the layout of the same
    mode: int  # LOW_FREQUENCY or HIGH_FREQUENCY
    ping_rate: int  # code of PING_RATES_HZ, or STANDBY
    gamma: int  # exponent of amplitude times 255; 0 counts as 255
    flags: int  # sum of flags
    range: float  # metres, or per cent of the greatest range without the flag RANGE_IN_METRES
    gain_percent: float  # 0..100
    sound_speed_m_s: float  # metres per second; 0 leaves it to the sonar
    settings: bytes  # as they came, which the result repeats

    @property
    def n_beams(self) -> int:
        return 512 if self.flags & BEAMS_512 else 256

    @property
    def ping_rate_hz(self) -> float:
        """The ping rate that is asked for, hertz; 0 in standby, and 10 for codes that are not known."""
        return 0.0 if self.ping_rate == STANDBY else PING_RATES_HZ.get(self.ping_rate, 10.0)

    def describe(self, before: FireMessage | None = None) -> str:
        """Return mode, range and ping rate in words, and what else differs from the fire message before.

        >>> one = FireMessage(1, 2, 0, 127, RANGE_IN_METRES, 3.0, 50.0, 0.0, b"")
        >>> one.describe(FireMessage(1, 2, 0, 255, RANGE_IN_METRES, 3.0, 50.0, 0.0, b""))
        'mode 2, range 3 m, 10 Hz, gamma 127'
        """
        rate = f"{self.ping_rate_hz:g} Hz" if self.ping_rate_hz else "standby"
        unit = "m" if self.flags & RANGE_IN_METRES else "%"
        words = [f"mode {self.mode}", f"range {self.range:g} {unit}", rate]
        known = set() if before is None else set(before.other_settings())
        return ", ".join([*words, *(text for text in self.other_settings() if text not in known)])

    def other_settings(self) -> list[str]:
        """Return in words the settings that are named when they change."""
        speed_m_s = self.sound_speed_m_s
        return [
            f"gain {self.gain_percent:g} %",
            f"gamma {self.gamma}",
            "16 bits" if self.flags & SIXTEEN_BITS else "8 bits",
            f"{self.n_beams} beams",
            "gain assistance" if self.flags & GAIN_ASSISTANCE else "no gain assistance",
            "with gains" if self.flags & SENDS_GAIN else "no gains",
            f"{speed_m_s:g} m/s" if speed_m_s else "speed of sound of the water",
            f"version {self.version}",
        ]

    def range_m(self, greatest_m: float) -> float:
        """Return the range that is asked for, metres, of a device with this greatest one."""
        return self.range if self.flags & RANGE_IN_METRES else self.range / 100 * greatest_m


def parse_fire_message(version: int, payload: bytes) -> FireMessage:
    """Return a fire message from what follows its header; WrongFireError if that is too short, or a number is wrong."""
    size = FIRE_SETTINGS.size + (FIRE_RESERVE_BYTES if version == 2 else 0)
    if len(payload) < size:
        raise WrongFireError(
            "length", f"a fire message of version {version} must have {size} bytes (got {len(payload)})"
        )
    mode, rate, _network, gamma, flags, range_, gain, speed_m_s, _salinity = FIRE_SETTINGS.unpack_from(
        payload
    )
    if mode not in (LOW_FREQUENCY, HIGH_FREQUENCY):
        raise WrongFireError(
            "mode",
            f"a fire message must have mode 1, low frequency, or 2, high frequency (got {mode}; mode 0 needs messages "
            "that the maker does not publish)",
        )
    if not (math.isfinite(range_) and 0 < range_ <= MAX_RANGE_M):
        raise WrongFireError(
            "range", f"a fire message must have a range above 0 and up to {MAX_RANGE_M:g} (got {range_:g})"
        )
    if not (math.isfinite(gain) and 0 <= gain <= 100):
        raise WrongFireError("gain", f"a fire message must have a gain of 0 to 100 per cent (got {gain:g})")
    if speed_m_s != 0 and not 1000 <= speed_m_s <= 2000:
        raise WrongFireError(
            "speed of sound",
            f"a fire message must have a speed of sound of 1000 to 2000 m/s, or 0 (got {speed_m_s:g})",
        )
    return FireMessage(version, mode, rate, gamma, flags, range_, gain, speed_m_s, payload[:size])


@dataclass(frozen=True, eq=False)
class OculusResult:
    """What a sonar reports of one ping. B beams, K bins."""

    fire: FireMessage  # that it answers
    number: int  # of the ping
    counts: np.ndarray  # (B, K) uint8 or uint16, beams from starboard to port
    azimuth_rad: np.ndarray  # (B,) of the beams, radians, rising, positive to port
    gain: np.ndarray  # (K,) linear power gain of the receiver at each range; only their ratios are sent
    bin_size_m: float  # metres
    # frequency_hz, temperature_c, pressure_bar, sound_speed_m_s: of the sonar and the water
    frequency_hz: float
    temperature_c: float
    pressure_bar: float
    sound_speed_m_s: float
    # heading_deg, pitch_deg, roll_deg: degrees; of version 2
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    time_s: float  # seconds since the sonar was switched on

    def message(self, device_id: int) -> bytes:
        """Return the message that a sonar with this number sends."""
        n_beams, n_bins = self.counts.shape
        image, bearings = self._image(), np.round(-100 * np.degrees(self.azimuth_rad[::-1])).astype("<i2")
        size = IMAGE_OFFSET + len(image)
        number_code = self.counts.itemsize - 1
        shape, places = (number_code, self.bin_size_m, n_bins, n_beams), (IMAGE_OFFSET, len(image), size)
        did = self.number & 0xFFFFFFFF, 0, self.frequency_hz, self.temperature_c, self.pressure_bar
        if self.fire.version == 2:
            attitude = self.heading_deg, self.pitch_deg, self.roll_deg
            body = RESULT_2.pack(
                *did, *attitude, self.sound_speed_m_s, self.time_s, *shape, 0, 0, 0, 0, *places
            )
        else:
            started = int(self.time_s * NANOSECONDS) & 0xFFFFFFFF  # as the device: see above
            body = RESULT_1.pack(*did, self.sound_speed_m_s, started, *shape, *places)
        # an M1200d marks results of the first version by 0
        version = 2 if self.fire.version == 2 else 0
        head = HEADER.pack(OCULUS_ID, device_id, 0, RESULT, version, size - HEADER.size, 0)
        message = head + self.fire.settings + body + bearings.tobytes()
        return message.ljust(IMAGE_OFFSET, b"\0") + image

    def _image(self) -> bytes:
        """Return the image: for each range its gain, where that is asked for, and the counts of all beams.

        The layout gives gains 32 bits and no unit. liboculus (SimplePingResult.h, GainData_t) reads signed numbers, and
        oculus_driver of github.com/ENSTABretagneRobotics (helpers.h, ping_data_to_array) divides counts by their square
        roots: so they are powers here, the greatest of a ping as much as a signed number holds, the least 1.
        """
        numbers = self.counts[::-1].T
        rows = np.ascontiguousarray(numbers.astype(numbers.dtype.newbyteorder("<"))).view(np.uint8)
        if self.fire.flags & SENDS_GAIN:
            gains = np.maximum(np.rint(self.gain / self.gain.max() * GREATEST_GAIN), 1).astype("<u4")
            rows = np.hstack([gains[:, None].view(np.uint8), rows])
        return rows.tobytes()


def status_message(
    device_id: int, part_number: int, address: str, connected: str, temperature_c: float
) -> bytes:
    """Return the status by which a sonar announces itself.

    address, connected : IPv4 addresses of the sonar, and of the program that is connected to it, or "0.0.0.0"
    """
    places = [IPv4Address(text).packed for text in (address, "255.255.255.0", connected)]
    temperatures = (temperature_c,) * 8
    body = STATUS_BODY.pack(
        device_id,
        IMAGING_SONAR,
        part_number,
        MAIN_PROGRAM_RUNS,
        *(0,) * 6,
        *places,
        bytes(6),
        *temperatures,
        1.0,
    )
    return HEADER.pack(OCULUS_ID, device_id, 0, STATUS, 1, len(body), 0) + body
