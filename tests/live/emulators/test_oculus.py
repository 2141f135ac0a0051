"""An emulated Oculus, read by a decoder that was written from the layout of its messages."""

import asyncio
import errno
import gc
import os
import random
import socket
import struct
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.live import simulators
from sonar_gl.live.emulators import oculus
from sonar_gl.live.emulators.oculus import MODELS, OculusHead, OculusServer
from sonar_gl.live.emulators.oculus_messages import (
    FireMessage,
    OculusResult,
    parse_fire_message,
    status_message,
)
from sonar_gl.live.emulators.simulated_head import SimulatedHead
from tests.support.fan_ping import fan_ping
from tests.support.servers import running, simulated
from tests.support.waiting import WAIT_S, wait_until
from tools.oculus_raw import read_pings

METRES, BITS_16, GAINS, SIMPLE, ASSISTANCE, BEAMS_512 = 1, 2, 4, 8, 16, 64  # flags of liboculus' Constants.h
LOW, HIGH = 1, 2
# Byte and type (as NumPy names it) of each number of a message, counted by hand in the packed structures of liboculus'
# Oculus.h. The emulator shares nothing with them.
HEADER = {
    "oculusId": (0, "<u2"),
    "srcDeviceId": (2, "<u2"),
    "dstDeviceId": (4, "<u2"),
    "msgId": (6, "<u2"),
    "msgVersion": (8, "<u2"),
    "payloadSize": (10, "<u4"),
    "spare2": (14, "<u2"),
}
FIRE = HEADER | {
    "masterMode": (16, "u1"),
    "pingRate": (17, "u1"),
    "networkSpeed": (18, "u1"),
    "gammaCorrection": (19, "u1"),
    "flags": (20, "u1"),
    "range": (21, "<f8"),
    "gainPercent": (29, "<f8"),
    "speedOfSound": (37, "<f8"),
    "salinity": (45, "<f8"),
}
RESULT_1 = FIRE | {
    "pingId": (53, "<u4"),
    "status": (57, "<u4"),
    "frequency": (61, "<f8"),
    "temperature": (69, "<f8"),
    "pressure": (77, "<f8"),
    "speedOfSoundUsed": (85, "<f8"),
    "pingStartTime": (93, "<u4"),
    "dataSize": (97, "u1"),
    "rangeResolution": (98, "<f8"),
    "nRanges": (106, "<u2"),
    "nBeams": (108, "<u2"),
    "imageOffset": (110, "<u4"),
    "imageSize": (114, "<u4"),
    "messageSize": (118, "<u4"),
}
RESULT_2 = FIRE | {
    "extFlags": (53, "<u4"),  # and 32 bytes that are reserved
    "pingId": (89, "<u4"),
    "status": (93, "<u4"),
    "frequency": (97, "<f8"),
    "temperature": (105, "<f8"),
    "pressure": (113, "<f8"),
    "heading": (121, "<f8"),
    "pitch": (129, "<f8"),
    "roll": (137, "<f8"),
    "speedOfSoundUsed": (145, "<f8"),
    "pingStartTime": (153, "<f8"),
    "dataSize": (161, "u1"),
    "rangeResolution": (162, "<f8"),
    "nRanges": (170, "<u2"),
    "nBeams": (172, "<u2"),
    "spare": (174, "<u4"),  # the first of four
    "imageOffset": (190, "<u4"),
    "imageSize": (194, "<u4"),
    "messageSize": (198, "<u4"),
}
BEARINGS = {1: 122, 2: 202}  # where they begin
ASKED = FireMessage(1, LOW, 0, 127, METRES, 5.0, 50.0, 0.0, bytes(37))
REPORTED = OculusResult(
    ASKED,
    number=1,
    counts=np.zeros((1, 1), np.uint8),
    azimuth_rad=np.zeros(1),
    gain=np.ones(1, np.float32),
    bin_size_m=0.1,
    frequency_hz=1e6,
    temperature_c=8.0,
    pressure_bar=1.0,
    sound_speed_m_s=1500.0,
    heading_deg=0.0,
    pitch_deg=0.0,
    roll_deg=0.0,
    time_s=0.0,
)


def numbers_of(message, layout):
    """Return the numbers of a message by their names in Oculus.h."""
    return {
        name: np.frombuffer(message, kind, 1, offset)[0].item() for name, (offset, kind) in layout.items()
    }


def fire_bytes(
    version=1, mode=HIGH, rate=2, gamma=127, flags=METRES | SIMPLE | ASSISTANCE, range_m=3.0, gain=50.0
):
    """Return a fire message as liboculus' SonarConfiguration writes it: offsets of its packed structures."""
    size = 53 if version == 1 else 89
    out = bytearray(size)
    struct.pack_into("<HHHHHIH", out, 0, 0x4F53, 0, 0, 0x15, version, size - 16, 0)
    struct.pack_into("<BBBBB", out, 16, mode, rate, 0xFF, gamma, flags)
    struct.pack_into("<dddd", out, 21, range_m, gain, 0.0, 0.0)
    return bytes(out)


@pytest.fixture(scope="module")
def server():
    """Serve a wall with a ball before it, to starboard, as an M1200d sees them."""
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.1), sg.pose(1.5, -0.5, 0))
    wall = sg.Body("wall", trimesh.creation.box((0.1, 20, 20)), sg.pose(2.5, 0, 0), 0.01)
    scene = sg.Scene([ball, wall], np.eye(4), "ball and wall")

    def make():
        sonar = sg.load_sonar("oculus-m1200d-hf")
        # without far side lobes, by which the ball shows in all beams
        acoustics = sg.Acoustics.physical(far_side_lobes=False)
        return SimulatedHead(scene, sonar, acoustics, sg.Noise(), PoseTrack([np.eye(4)]))

    with simulated(make) as (simulation, head):
        device = OculusHead(MODELS["m1200d"], head)
        with running(OculusServer(device, simulation, port=0, status_to=None)) as one:
            yield one


@pytest.fixture
def connection(server):
    """Connect a program."""
    with socket.create_connection(("127.0.0.1", server.port), WAIT_S) as one:
        yield one


def read_exactly(connection, size):
    """Return so many bytes of a connection."""
    data = b""
    while len(data) < size:
        data += connection.recv(size - len(data)) or pytest.fail("the connection was closed")
    return data


def next_result(connection):
    """Return the next message of a connection: its header's numbers, and all its bytes."""
    head = read_exactly(connection, 16)
    fields = struct.unpack("<HHHHHIH", head)
    return fields, head + read_exactly(connection, fields[5])


def result_of(connection, fire):
    """Fire, and return the first message that answers it."""
    connection.sendall(fire)
    while True:
        fields, message = next_result(connection)
        if message[16 : len(fire)] == fire[16:]:
            return fields, message


@pytest.mark.parametrize("version", [1, 2])
def test_each_number_is_at_its_byte(version):
    """All numbers differ, and so do their bytes."""
    size, layout = {1: (53, RESULT_1), 2: (89, RESULT_2)}[version]
    asked = {
        "oculusId": 0x4F53, "srcDeviceId": 0, "dstDeviceId": 0, "msgId": 0x15, "msgVersion": version,
        "payloadSize": size - 16, "spare2": 0, "masterMode": 2, "pingRate": 3, "networkSpeed": 201,
        "gammaCorrection": 127, "flags": METRES | BITS_16 | ASSISTANCE, "range": 3.25, "gainPercent": 41.5,
        "speedOfSound": 1511.5, "salinity": 34.5,
    }  # fmt: skip
    sent = bytearray(size)
    for name, (offset, kind) in FIRE.items():
        sent[offset : offset + np.dtype(kind).itemsize] = np.array(asked[name], kind).tobytes()
    fire = parse_fire_message(version, bytes(sent[16:]))
    assert (fire.version, fire.mode, fire.ping_rate, fire.gamma, fire.flags) == (version, 2, 3, 127, 0x13)
    assert (fire.range, fire.gain_percent, fire.sound_speed_m_s) == (3.25, 41.5, 1511.5)
    counts = np.arange(6, dtype=np.uint16).reshape(2, 3)
    message = OculusResult(
        fire,
        number=0x01020304,
        counts=counts,
        azimuth_rad=np.radians([-12.34, 23.45]),
        gain=np.ones(3),
        bin_size_m=0.0625,
        frequency_hz=1.25e6,
        temperature_c=8.5,
        pressure_bar=2.75,
        sound_speed_m_s=1483.25,
        heading_deg=77.5,
        pitch_deg=-5.5,
        roll_deg=3.75,
        time_s=1.25,
    ).message(0x0708)
    assert numbers_of(message, layout) == asked | {
        "srcDeviceId": 0x0708, "msgId": 0x23, "msgVersion": {1: 0, 2: 2}[version], "payloadSize": 2048 + 12 - 16,
        "pingId": 0x01020304, "status": 0, "frequency": 1.25e6, "temperature": 8.5, "pressure": 2.75,
        "speedOfSoundUsed": 1483.25, "pingStartTime": {1: 1_250_000_000, 2: 1.25}[version], "dataSize": 1,
        "rangeResolution": 0.0625, "nRanges": 3, "nBeams": 2, "imageOffset": 2048, "imageSize": 12,
        "messageSize": 2048 + 12,
    } | ({} if version == 1 else {"extFlags": 0, "heading": 77.5, "pitch": -5.5, "roll": 3.75, "spare": 0})  # fmt: skip
    # hundredths of a degree, positive to starboard; port first
    assert np.frombuffer(message, "<i2", 2, BEARINGS[version]).tolist() == [-2345, 1234]
    assert np.frombuffer(message, "<u2", 6, 2048).tolist() == [3, 0, 4, 1, 5, 2]
    assert len(message) == 2048 + 12 and not any(message[BEARINGS[version] + 4 : 2048])


def test_result_holds_the_ping_that_was_asked_for(connection, tmp_path):
    fields, message = result_of(connection, fire_bytes())
    assert fields[0] == 0x4F53 and fields[3:5] == (0x23, 0) and fields[5] == len(message) - 16
    (tmp_path / "ping.raw").write_bytes(message)
    (raw,) = read_pings(tmp_path / "ping.raw")
    assert raw.counts.shape == (256, 1024) and raw.counts.dtype == np.uint8
    assert raw.frequency_hz == 2.1e6 and raw.bin_size_m == pytest.approx(3.0 / 1024)
    assert raw.sound_speed_m_s == pytest.approx(sg.Acoustics.physical().water.sound_speed())
    edge = np.sin(np.radians(30.0))
    even_in_sine_deg = np.degrees(np.arcsin(np.linspace(-edge, edge, 256)))
    assert raw.beam_azimuths_deg == pytest.approx(even_in_sine_deg, abs=0.0051)  # hundredths, rounded
    # many bins are at full scale; the nearest of them is the ball's nearest point, but for the pulse and the beam
    bins, beams = np.nonzero(raw.counts.T == 255)
    assert abs(raw.beam_azimuths_deg[beams[0]] - np.degrees(np.arctan2(-0.5, 1.5))) < 3.0
    assert abs((bins[0] + 0.5) * raw.bin_size_m - (np.hypot(0.5, 1.5) - 0.1)) < 0.02


def test_attitude_is_that_of_the_housing_by_the_signs_that_the_documentation_states():
    """Turned to starboard by a quarter less 0.1 rad, the bow 0.2 rad up, the starboard side 0.3 rad down."""
    pose = sg.pose(roll=0.3, pitch=-0.2, yaw=-(np.pi / 2 - 0.1))
    assert pose[2, 0] > 0 > pose[2, :3] @ [0, -1, 0]  # bow up, starboard down
    sonar = sg.load_sonar("oculus-m1200d-hf,n_beams=8,tilt_deg=10")
    ping = replace(fan_ping(), sonar=sonar, acoustics=sg.Acoustics.physical(), pose=pose)
    found = oculus.oculus_result(ping, ASKED, 0.0, 0)
    assert (found.heading_deg, found.pitch_deg, found.roll_deg) == pytest.approx(
        np.degrees([np.pi / 2 - 0.1, 0.2, 0.3])
    )


def test_second_version_has_attitude_and_its_own_offsets(connection):
    flags = METRES | SIMPLE | ASSISTANCE | BITS_16 | GAINS | BEAMS_512
    fields, message = result_of(connection, fire_bytes(2, LOW, flags=flags, range_m=6.0))
    assert fields[4] == 2
    frequency, temperature, pressure, heading, pitch, roll, speed, time_s = struct.unpack_from(
        "<8d", message, 97
    )
    size_code, bin_size_m, n_bins, n_beams = struct.unpack_from("<BdHH", message, 161)
    offset, image_bytes, message_bytes = struct.unpack_from("<III", message, 190)
    assert (frequency, heading, pitch, roll) == (1.2e6, 0.0, 0.0, 0.0)
    assert (size_code, n_bins, n_beams) == (1, 1024, 512) and bin_size_m == pytest.approx(6.0 / 1024)
    assert 0.0 < time_s < 1e5 and (temperature, pressure) == (10.0, pytest.approx(2.013, abs=1e-3))
    assert 1400 < speed < 1600
    row = 4 + 2 * n_beams
    assert (image_bytes, message_bytes) == (n_bins * row, len(message)) and offset + image_bytes == len(
        message
    )
    bearings = np.frombuffer(message, "<i2", n_beams, 202)
    assert (np.diff(bearings) > 0).all() and (bearings[0], bearings[-1]) == (-6500, 6500)
    rows = np.frombuffer(message, np.uint8, offset=offset).reshape(n_bins, row)
    gains, counts = rows[:, :4].copy().view("<u4")[:, 0], rows[:, 4:].copy().view("<u2")
    range_m, water = (np.arange(n_bins) + 0.5) * bin_size_m, sg.Acoustics.physical().water
    tvg_db = 20 * np.log10(range_m) + 2 * water.absorption(1.2e6) * range_m  # 20 log r, as by default
    relative = 10 ** ((tvg_db - tvg_db[-1]) / 10)
    assert gains[-1] == 2**31 - 1  # as much as fits into a signed number
    assert np.abs(gains - relative * gains[-1]).max() <= 1  # rounded
    assert counts.max() == 65535  # automatic gain brings the strongest echoes to full scale
    starboard, port = counts[:, n_beams // 2 :], counts[:, : n_beams // 2]
    # before the wall: the ball, to starboard, where bearings are positive
    near = slice(0, int(1.9 / bin_size_m))
    assert starboard[near].max() > 20_000 > 20 * port[near].max()


def test_gain_and_gamma_change_counts_as_they_say(connection):
    flags = METRES | SIMPLE | BITS_16
    counts = {}
    for gamma, gain in ((255, 10.0), (255, 20.0), (127, 10.0)):
        _, message = result_of(connection, fire_bytes(gamma=gamma, gain=gain, flags=flags))
        counts[gamma, gain] = np.frombuffer(message, "<u2", offset=2048).astype(float)
    inside = (counts[255, 10.0] > 1000) & (counts[255, 20.0] < 65535)
    assert inside.sum() > 100
    # 10 per cent more are 6 dB: amplitude times 1.995; counts of 1000 are rounded by 0.05 %
    assert counts[255, 20.0][inside] / counts[255, 10.0][inside] == pytest.approx(10**0.3, rel=1e-3)
    share, with_gamma = counts[255, 10.0][inside] / 65535, counts[127, 10.0][inside] / 65535
    assert with_gamma == pytest.approx(share ** (127 / 255), rel=1e-3)


def test_another_gain_needs_no_other_simulator(connection, monkeypatch):
    """A new simulator looks for its samples, and its first ping takes far longer than others."""
    result_of(connection, fire_bytes(gain=31.0))
    monkeypatch.setattr(simulators, "Simulator", None)  # none can be made from now on
    for gamma, gain, flags in ((255, 12.0, BITS_16), (127, 13.0, BITS_16), (127, 14.0, ASSISTANCE)):
        result_of(connection, fire_bytes(gamma=gamma, gain=gain, flags=METRES | SIMPLE | flags))


@pytest.mark.slow
def test_standby_stops_and_another_fire_message_goes_on(connection):
    result_of(connection, fire_bytes())
    connection.sendall(fire_bytes(rate=5))

    def another_begins():
        connection.settimeout(0.5)
        try:
            return connection.recv(1, socket.MSG_PEEK)
        except TimeoutError:
            return False
        finally:
            connection.settimeout(WAIT_S)

    while another_begins():  # one that has begun comes to its end, though a busy machine may pause in it
        next_result(connection)
    result_of(connection, fire_bytes(range_m=4.0))


@pytest.mark.slow
def test_two_programs_see_the_same_pings(connection, server):
    with socket.create_connection(("127.0.0.1", server.port), WAIT_S) as other:
        result_of(connection, fire_bytes(range_m=5.0))
        messages = [next_result(one)[1] for one in (other, connection) for _ in range(5)]
        numbers = [struct.unpack_from("<I", message, 53)[0] for message in messages]
        both = set(numbers[:5]) & set(numbers[5:])
        assert both
        for number in both:
            first, second = (m for m, n in zip(messages, numbers, strict=True) if n == number)
            assert first == second


def test_wrong_fire_message_changes_nothing(connection):
    result_of(connection, fire_bytes(range_m=3.5))
    for wrong in (fire_bytes(range_m=11.0), fire_bytes(range_m=float("nan")), fire_bytes(mode=0)):
        connection.sendall(wrong)
    for _ in range(3):
        _, message = next_result(connection)
        assert struct.unpack_from("<d", message, 21) == (3.5,)


def test_settings_that_no_ping_can_be_made_with_are_ignored(connection, monkeypatch, caplog):
    ping = SimulatedHead.ping

    def limited(head, sonar, *values):
        if sonar.range_max_m == 4.25:
            raise Error("the ping must succeed (got 4.25 m)")
        return ping(head, sonar, *values)

    monkeypatch.setattr(SimulatedHead, "ping", limited)
    connection.sendall(fire_bytes(range_m=4.25))
    end_s = time.monotonic() + WAIT_S
    why = "the ping must succeed (got 4.25 m)"
    while f"a fire message is ignored: {why} (others like it are only counted)" not in caplog.messages:
        assert time.monotonic() < end_s
        time.sleep(0.01)
    result_of(connection, fire_bytes(range_m=4.5))


def of_log(caplog, start):
    """Return the messages of the log that begin with some words, without these."""
    return [text.removeprefix(start) for text in caplog.messages if text.startswith(start)]


def test_wrong_fire_messages_of_a_kind_are_logged_once_for_each_program(server, caplog):
    """A program that goes on sending them, each with another number, would fill the disk."""
    before = server.counts.refused
    for expected in (before + 120, before + 240):
        with socket.create_connection(("127.0.0.1", server.port), WAIT_S) as program:
            for number in range(30):
                program.sendall(fire_bytes(range_m=11.0 + number))
                program.sendall(fire_bytes(gain=101.0 + number))
                program.sendall(fire_bytes(mode=3 + number))
                program.sendall(struct.pack("<HHHHHIH", 0x4F53, 0, 0, 0x15, 7 + number, 0, 0))
            wait_until(lambda expected=expected: server.counts.refused == expected)
    assert of_log(caplog, "a fire message is ignored: ") == 2 * [
        f"{why} (others like it are only counted)"
        for why in (
            "the range of oculus-m1200d-hf must be more than 0.1 m and at most 10 m (got 11 m)",
            "a fire message must have a gain of 0 to 100 per cent (got 101)",
            "a fire message must have mode 1, low frequency, or 2, high frequency (got 3; mode 0 needs messages that "
            "the maker does not publish)",
            "a fire message of version 7 must have 37 bytes (got 0)",
        )
    ]


def test_the_log_names_what_a_fire_message_changes(server, connection, caplog):
    caplog.set_level("INFO")
    result_of(connection, fire_bytes(range_m=3.125, gain=1.0, gamma=0))
    caplog.clear()
    flags = METRES | SIMPLE | ASSISTANCE
    for changes in (
        {},
        {},
        {"gain": 50.5},
        {"gamma": 255},
        {"flags": flags | BITS_16},
        {"flags": (flags | BEAMS_512) & ~ASSISTANCE},
        {"flags": flags | GAINS},
        {"version": 2, "rate": 5},
        {"mode": LOW, "flags": SIMPLE | ASSISTANCE},
    ):
        connection.sendall(fire_bytes(**{"range_m": 3.0, "gain": 50.0, "gamma": 127, **changes}))
    wait_until(lambda: "mode 1" in "".join(caplog.messages))
    same = "mode 2, range 3 m, 40 Hz"
    assert of_log(caplog, "fire message: ") == [
        f"{same}, gain 50 %, gamma 127",
        f"{same}, gain 50.5 %",
        f"{same}, gain 50 %, gamma 255",
        f"{same}, gamma 127, 16 bits",
        f"{same}, 8 bits, 512 beams, no gain assistance",
        f"{same}, 256 beams, gain assistance, with gains",
        "mode 2, range 3 m, standby, no gains, version 2",
        "mode 1, range 3 %, 40 Hz, version 1",
    ]


@pytest.mark.parametrize(
    "range_m, words",
    [
        (11.0, "at most 10 m"),
        (0.05, "more than 0.1 m"),
    ],
)
def test_range_of_the_device_is_kept(range_m, words):
    with pytest.raises(Error, match=words):
        OculusHead(MODELS["m1200d"], None).sonar(replace(ASKED, mode=HIGH, range=range_m))


def test_range_in_per_cent_is_of_the_greatest():
    fire = replace(ASKED, flags=0, range=25.0)
    assert OculusHead(MODELS["m1200d"], None).sonar(fire).range_max_m == 10.0


@pytest.mark.parametrize(
    "gamma, exponent",
    [(0, 0.5), (1, 0.01), (5, 0.01), (6, 0.5 * 6 / 255), (127, 0.5 * 127 / 255), (255, 0.5)],
)
def test_any_gamma_is_taken(gamma, exponent):
    assert OculusHead(MODELS["m1200d"], None).sonar(replace(ASKED, gamma=gamma)).counts.exponent == exponent


def test_counts_change_the_gain_that_a_program_leaves_to_the_device():
    device = OculusHead(MODELS["m1200d"], None, {"gain_percentile": 90.0})
    laws = [device.sonar(replace(ASKED, flags=flags)).counts for flags in (METRES | ASSISTANCE, METRES)]
    assert [(law.gain_percentile, law.gain_db) for law in laws] == [(90.0, 0.0), (None, 30.0)]


@pytest.mark.parametrize(
    ("rate", "rate_hz"), [(0, 10.0), (1, 15.0), (2, 40.0), (3, 5.0), (4, 2.0), (5, 0.0), (9, 10.0)]
)
def test_ping_rates_are_those_of_their_codes(rate, rate_hz):
    """PingRateType of Oculus.h: normal, high, highest, low, lowest and standby; a device goes on at the normal one."""
    assert replace(ASKED, ping_rate=rate).ping_rate_hz == rate_hz


@pytest.mark.parametrize(
    ("name", "part"), [("m370s", 1041), ("m750d", 1032), ("m1200d", 1042), ("m3000d", 2203)]
)
def test_models_have_their_part_numbers_and_presets(name, part):
    """OculusPartNumberType of Oculus.h."""
    model = MODELS[name]
    assert model.part_number == part and len(model.presets) == 2
    low, high = map(sg.load_sonar, model.presets)
    assert low.name.startswith(f"oculus-{name}") and high.name.startswith(f"oculus-{name}")
    assert low.frequency_hz < high.frequency_hz or name == "m370s"  # which has one frequency


class QuietHead:
    """In place of a head: keeps the acoustics of each ping, and makes none."""

    def __init__(self, acoustics):
        self.acoustics, self.used = acoustics, []

    def ping(self, sonar, acoustics, time_s, number):
        self.used.append(acoustics)
        ping = replace(fan_ping(), sonar=sonar, acoustics=acoustics, pose=np.eye(4))
        return replace(ping, range_m=sonar.range_m[: ping.intensity.shape[1]])


def test_ranges_follow_the_speed_of_sound_that_a_program_sets():
    """0 leaves it to the sonar; and the pressure is that of the water's depth, ten metres to a bar."""
    water = sg.Water(temperature_c=8.0, depth_m=25.0)
    head = QuietHead(sg.Acoustics.physical(water=water))
    device = OculusHead(MODELS["m1200d"], head)
    for asked_m_s, used_m_s in ((1600.0, 1600.0), (0.0, water.sound_speed())):
        result = device.ping(replace(ASKED, mode=HIGH, sound_speed_m_s=asked_m_s), 0.0, 1)
        assert head.used[-1].assumed_sound_speed_m_s() == result.sound_speed_m_s == used_m_s
        assert head.used[-1].water == water
        assert (result.temperature_c, result.pressure_bar) == (8.0, pytest.approx(1.01325 + 2.5))


@pytest.mark.parametrize(
    ("offset", "allowed", "refused", "words"),
    [
        (5, (1e-3, 1000.0), (0.0, 1000.1), "a range above 0 and up to 1000"),
        (13, (0.0, 100.0), (-0.1, 100.1), "a gain of 0 to 100 per cent"),
        (21, (0.0, 1000.0, 2000.0), (0.5, 999.0, 2001.0), "a speed of sound of 1000 to 2000 m/s, or 0"),
    ],
)
def test_numbers_of_a_fire_message_are_allowed_up_to_their_bounds(offset, allowed, refused, words):
    payload = bytearray(fire_bytes()[16:])
    for value in allowed:
        struct.pack_into("<d", payload, offset, value)
        parse_fire_message(1, bytes(payload))
    for value in refused:
        struct.pack_into("<d", payload, offset, value)
        with pytest.raises(Error, match=words):
            parse_fire_message(1, bytes(payload))


def test_short_fire_message_is_refused():
    with pytest.raises(Error, match="must have 73 bytes"):
        parse_fire_message(2, bytes(72))


def test_status_is_as_long_as_programs_expect():
    message = status_message(7, 1042, "192.168.1.9", "0.0.0.0", 12.5)
    assert len(message) == 142  # sizeof(OculusStatusMsg), the only length that liboculus accepts
    assert struct.unpack_from("<IHHI", message, 16) == (7, 1, 1042, 3)
    assert message[52:56] == bytes([192, 168, 1, 9])
    assert struct.unpack_from("<d", message, 70) == (12.5,)


def test_the_status_says_where_the_device_is_and_who_is_connected(monkeypatch):
    monkeypatch.setattr(oculus, "STATUS_S", 0.01)
    device = OculusHead(MODELS["m750d"], SimpleNamespace(acoustics=sg.Acoustics.physical()))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(WAIT_S)
        status_to = "localhost", listener.getsockname()[1]
        with running(OculusServer(device, None, "localhost", port=0, status_to=status_to)) as server:
            status = listener.recv(1000)
            assert struct.unpack_from("<HHHHHI", status) == (0x4F53, 1, 0, 1, 1, len(status) - 16)
            assert struct.unpack_from("<H", status, 22) == (1032,)  # partNumberM750d
            assert (status[52:56], status[60:64]) == (bytes([127, 0, 0, 1]), bytes(4))
            with socket.create_connection(("localhost", server.port), WAIT_S):
                while listener.recv(1000)[60:64] != bytes([127, 0, 0, 1]):
                    pass
            while listener.recv(1000)[60:64] != bytes(4):
                pass


def test_result_of_odd_sizes_fits_its_header():
    message = replace(
        REPORTED,
        fire=replace(ASKED, flags=METRES | GAINS),
        number=2**32 + 5,
        counts=np.arange(6, dtype=np.uint8).reshape(2, 3),
        azimuth_rad=np.array([-0.1, 0.1]),
        gain=np.ones(3, np.float32),
    ).message(1)
    assert struct.unpack_from("<I", message, 53) == (5,)  # numbers begin anew
    rows = np.frombuffer(message, np.uint8, offset=2048).reshape(3, 6)
    assert rows[:, 4:].tolist() == [[3, 0], [4, 1], [5, 2]]  # port's beam first, as its bearing is the lower
    assert np.frombuffer(message, "<i2", 2, 122).tolist() == [-573, 573]


@pytest.mark.parametrize(
    ("time_s", "nanoseconds"), [(0.0, 0), (1.5, 1_500_000_000), (4.5, 4_500_000_000 - 2**32)]
)
def test_start_time_counts_nanoseconds_in_the_first_version_and_seconds_in_the_second(time_s, nanoseconds):
    """Times that floats hold; in raw pings of an M1200d consecutive start times differ by 62.5 million."""
    first, second = (
        replace(REPORTED, fire=fire, time_s=time_s).message(1)
        for fire in (ASKED, replace(ASKED, version=2, settings=bytes(73)))
    )
    assert struct.unpack_from("<I", first, 93) == (nanoseconds,)
    assert struct.unpack_from("<d", second, 153) == (time_s,)


@pytest.mark.parametrize(
    "number",
    [
        errno.EHOSTUNREACH,
        *(pytest.param(one, marks=pytest.mark.slow) for one in (errno.ECONNRESET, errno.ETIMEDOUT)),
    ],
)
def test_a_program_that_the_network_loses_is_gone_without_a_traceback(number, monkeypatch, caplog):
    """The last two are no ConnectionError: a cable is pulled."""
    caplog.set_level("INFO")

    async def lost(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(asyncio.StreamReader, "readexactly", lost)
    with running(OculusServer(None, None, port=0, status_to=None)) as server:
        with socket.create_connection(("127.0.0.1", server.port), WAIT_S) as program:
            assert program.recv(1) == b""
        wait_until(lambda: any(text.endswith(" is gone") for text in caplog.messages))
    gc.collect()  # asyncio reports an exception that nobody has asked for when its task goes
    assert [record.message for record in caplog.records if record.name == "asyncio"] == []


def test_the_end_of_the_server_is_that_of_all_its_tasks():
    """Also of the task of a program that does not read: what it has not got would otherwise be waited for."""
    result = SimpleNamespace(message=lambda _: bytes(oculus.MAX_UNSENT_BYTES // 2))
    device = SimpleNamespace(sonar=lambda _: None, ping=lambda *_: result)

    async def serve(simulation):
        server, started = OculusServer(device, simulation, port=0, status_to=None), asyncio.Event()
        serving = asyncio.create_task(server.run(started.set))
        await asyncio.wait_for(started.wait(), WAIT_S)
        with socket.create_connection(("127.0.0.1", server.port)) as program:
            program.sendall(fire_bytes())
            while not server.counts.sent:
                await asyncio.sleep(0.001)
            serving.cancel()
            await asyncio.wait([serving])
            assert asyncio.all_tasks() == {asyncio.current_task()}

    with ThreadPoolExecutor(1) as simulation:
        asyncio.run(serve(simulation))


@pytest.mark.parametrize("count", [4_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_noise_on_the_network_neither_stops_nor_stalls_the_device(server, connection, count):
    """Packets of random bytes, headers of any length, fire messages of random numbers."""
    rng = random.Random(0)
    result_of(connection, fire_bytes(range_m=2.0))
    sent = 0
    while sent < count:
        with socket.create_connection(("127.0.0.1", server.port), WAIT_S) as other:
            kind = rng.randrange(3)
            try:
                for _ in range(1 + kind * 2000):
                    body = rng.randbytes(rng.randrange(60))
                    head = struct.pack(
                        "<HHHHHIH", 0x4F53, 0, 0, rng.choice((0x15, 0x22)), rng.randrange(3), len(body), 0
                    )
                    other.sendall(rng.randbytes(20) if kind == 0 else head + body)
                    sent += 1
            except OSError:  # the device has hung up
                pass
    start = time.monotonic()
    result_of(connection, fire_bytes(range_m=2.5))
    assert time.monotonic() - start < WAIT_S


@pytest.mark.slow
def test_programs_beyond_the_limit_are_disconnected_and_others_go_on(monkeypatch, caplog):
    """Each program may leave 16 MB unsent: without a limit a neighbour takes all memory."""
    monkeypatch.setattr(oculus, "MAX_PROGRAMS", 3)

    def connect():
        return socket.create_connection(("127.0.0.1", server.port), WAIT_S)

    def is_left_alone(program):
        program.settimeout(0.05)
        with pytest.raises(TimeoutError):
            program.recv(1)
        return True

    def is_refused(program):
        try:
            return program.recv(1) == b""
        except ConnectionResetError:
            return True

    with running(OculusServer(None, None, port=0, status_to=None)) as server:
        programs = [connect() for _ in range(3)]
        for _ in range(20):
            with connect() as another:
                assert is_refused(another)
        assert all(is_left_alone(program) for program in programs)
        said = [text for text in caplog.messages if "disconnected at once" in text]
        assert said == ["3 programs are connected, and others are disconnected at once"]
        programs.pop().close()

        def is_free():
            program = connect()
            programs.append(program)
            program.settimeout(0.05)
            try:
                return program.recv(1) != b""
            except ConnectionResetError:
                return False
            except TimeoutError:
                return True

        wait_until(is_free)
        for program in programs:
            program.close()
