"""An emulated Ping360, by the maker's own client."""

import asyncio
import random
import socket
import struct
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import brping
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import Error, MachineError
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.live.emulators.ping360 import FIRST_SETTINGS, Ping360Head, Ping360Server
from sonar_gl.live.emulators.ping360_messages import (
    AUTO_PAYLOAD,
    AUTO_TRANSMIT,
    PingMessage,
    Scan,
    TransducerSettings,
    parse_messages,
    parse_scan,
)
from sonar_gl.live.emulators.simulated_head import SimulatedHead
from tests.support.servers import running, simulated
from tests.support.waiting import WAIT_S


@pytest.fixture(scope="module")
def server():
    """Serve a small ball, 4 m to starboard of a sonar that looks along x, and a wall 6 m ahead of it."""
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.3), sg.pose(0, -4, 0))
    wall = sg.Body("wall", trimesh.creation.box((0.1, 20, 20)), sg.pose(6.05, 0, 0))
    scene = sg.Scene([ball, wall], np.eye(4), "ball and wall")

    def make():
        settings = sg.load_sonar("ping360"), sg.Acoustics.physical(), sg.Noise(), PoseTrack([np.eye(4)])
        return SimulatedHead(scene, *settings)

    with (
        simulated(make) as (simulation, head),
        running(Ping360Server(Ping360Head(head), simulation, port=0)) as one,
    ):
        yield one


class PatientClient(brping.Ping360):
    """The maker's client, but for its own waits of half a second and four: a machine that tests run on may be slow."""

    def wait_message(self, message_ids, timeout=0.5):
        return super().wait_message(message_ids, timeout if timeout < 0.5 else WAIT_S)


@pytest.fixture
def client(server):
    """Connect the maker's client."""
    client = PatientClient()
    client.connect_udp("127.0.0.1", server.port)
    assert client.initialize()
    yield client
    client.iodev.close()


def strongest_m(answer, sound_speed_m_s):
    """Return the range of the strongest sample."""
    sample_m = answer.sample_period * 25e-9 * sound_speed_m_s / 2
    return (np.frombuffer(bytes(answer.data), np.uint8).argmax() + 0.5) * sample_m


def test_counts_change_the_law_and_programs_the_gain():
    device = Ping360Head(SimpleNamespace(acoustics=sg.Acoustics.physical()), {"law": "db", "low_db": -40.0})
    assert device.sonar(FIRST_SETTINGS).counts == sg.Counts(low_db=-40.0, gain_db=10.0, exponent=0.26)


def test_each_angle_shows_what_lies_there(client):
    client.set_transmit_frequency(750)
    client.set_sample_period(400)
    client.set_number_of_samples(1100)
    client.set_gain_setting(0)
    speed_m_s = sg.Acoustics.physical().water.sound_speed()
    for angle, range_m in ((0, 6.0), (100, 3.7)):  # a quarter turn clockwise is starboard
        answer = client.transmitAngle(angle)
        assert (answer.angle, answer.number_of_samples, len(answer.data)) == (angle, 1100, 1100)
        assert (answer.transmit_frequency, answer.sample_period, answer.gain_setting) == (750, 400, 0)
        found_m = strongest_m(answer, speed_m_s)
        # the nearest point of either is its strongest; the pulse reaches over some samples
        assert abs(found_m - range_m) < 0.05
    assert not any(client.transmitAngle(300).data)  # nothing is to port


def test_turn_without_transmitting_has_no_echo(client):
    client.control_transducer(1, 0, 50, 32, 400, 750, 500, 0, 0)
    answer = client.wait_message([brping.definitions.PING360_DEVICE_DATA], WAIT_S)
    assert (answer.angle, len(answer.data)) == (50, 0)


def test_scan_goes_on_by_itself_until_the_motor_is_switched_off(client):
    client.control_auto_transmit(1, 0, 32, 400, 750, 200, 390, 10, 5, 7)
    kinds = [brping.definitions.PING360_AUTO_DEVICE_DATA]
    answers = [client.wait_message(kinds, WAIT_S) for _ in range(6)]
    assert [one.angle for one in answers] == [390, 395, 0, 5, 10, 5]
    for one in answers:  # each repeats what was asked for
        assert (one.mode, one.gain_setting, one.transmit_duration, one.sample_period) == (1, 0, 32, 400)
        assert (one.transmit_frequency, one.number_of_samples, one.data_length) == (750, 200, 200)
        assert (one.start_angle, one.stop_angle, one.num_steps, one.delay) == (390, 10, 5, 7)
    client.control_motor_off()
    assert client.wait_message([brping.definitions.COMMON_ACK], WAIT_S).acked_id == 2903


def test_wrong_settings_are_refused_with_a_reason(client):
    client.control_transducer(1, 7, 50, 32, 400, 750, 500, 1, 0)
    answer = client.wait_message([brping.definitions.COMMON_NACK], WAIT_S)
    assert (answer.nacked_id, bytes(answer.nack_message)) == (2601, b"gain_setting must be 0 to 2 (got 7)\0")


def test_unknown_message_is_refused(client):
    client.request(1211, timeout=0.0)  # of another device
    answer = client.wait_message([brping.definitions.COMMON_NACK])
    assert (answer.nacked_id, bytes(answer.nack_message)) == (
        1211,
        b"this device does not have the message\0",
    )
    assert client.transmitAngle(7).angle == 7  # and the next one is answered


def test_scan_turns_back_at_both_ends():
    settings = TransducerSettings(1, 0, 0, 32, 400, 750, 200)
    assert [Scan(settings, 395, 5, 4, 0.0).angle(n) for n in range(6)] == [395, 399, 3, 399, 395, 399]
    assert [Scan(settings, 0, 399, 10, 0.0).angle(n) for n in (0, 1, 39, 40)] == [0, 10, 390, 0]
    assert Scan(settings, 20, 22, 5, 0.0).angle(3) == 20  # a sector narrower than a step
    assert [Scan(settings, 100, 100, 10, 0.0).angle(n) for n in (0, 1, 39, 40)] == [100, 110, 90, 100]


def test_a_sample_is_a_bin_of_its_time_at_the_speed_that_is_set():
    """25 ns is the unit of the period; sound goes there and back; the bandwidth is one over the pulse's length."""
    acoustics = sg.Acoustics.physical(sonar_sound_speed_m_s=1600.0)
    device = Ping360Head(SimpleNamespace(acoustics=acoustics))
    for gain, gain_db in ((0, 10.0), (1, 20.0), (2, 30.0)):
        sonar = device.sonar(TransducerSettings(1, gain, 7, 50, 400, 650, 300))
        assert (sonar.n_beams, sonar.n_bins, sonar.range_min_m, sonar.frequency_hz) == (1, 300, 0.0, 650e3)
        assert sonar.bin_size_m == pytest.approx(400 * 25e-9 * 1600.0 / 2, rel=1e-12)
        assert sonar.bandwidth_hz == pytest.approx(20e3, rel=1e-12)
        assert (sonar.counts.gain_db, sonar.counts.gain_percentile) == (gain_db, None)
    # a pulse of 1 µs would be shorter than its period
    assert device.sonar(TransducerSettings(1, 0, 7, 1, 400, 650, 300)).bandwidth_hz == 650e3


FIRST_AND_LAST = {  # of ping360.json
    "gain_setting": (0, 2),
    "angle": (0, 399),
    "transmit_duration_us": (1, 1000),
    "sample_period": (80, 40_000),
    "transmit_frequency_khz": (500, 1000),
    "n_samples": (1, 1200),
}


@pytest.mark.parametrize("name", FIRST_AND_LAST)
def test_settings_are_allowed_up_to_their_bounds(name):
    first, last = FIRST_AND_LAST[name]
    for value in (first, last):
        assert getattr(replace(FIRST_SETTINGS, **{name: value}), name) == value
    for value in (first - 1, last + 1):
        with pytest.raises(Error, match=rf"^{name} must be {first} to {last} \(got {value}\)$"):
            replace(FIRST_SETTINGS, **{name: value})


@pytest.mark.parametrize(
    ("name", "first", "last"), [("start", 0, 399), ("stop", 0, 399), ("step", 1, 10), ("delay_s", 0, 0.1)]
)
def test_scans_are_allowed_up_to_their_bounds(name, first, last):
    scan = Scan(FIRST_SETTINGS, 3, 5, 1, 0.0)
    for value in (first, last):
        assert getattr(replace(scan, **{name: value}), name) == value
    for value in (first - 1, last + 1):
        with pytest.raises(Error, match="of a scan must be"):
            replace(scan, **{name: value})


def test_each_ping_has_noise_of_its_own():
    """Its number is that of no ping before, whatever the settings are."""
    head = SimpleNamespace(acoustics=sg.Acoustics.physical(), numbers=[])

    def ping(sonar, acoustics, time_s, number, turn):
        head.numbers.append(number)
        return SimpleNamespace(counts=lambda: np.zeros((1, sonar.n_bins), np.uint8))

    head.ping = ping
    device = Ping360Head(head)
    for _ in range(3):
        assert len(device.ping(FIRST_SETTINGS, 0.0)) == 200
    assert len(set(head.numbers)) == 3


@pytest.mark.parametrize("kind", [2000, 2600, 2903], ids=["number", "reset", "motor off"])
def test_what_needs_no_answer_is_acknowledged(client, kind):
    address = "127.0.0.1", client.iodev.getpeername()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.settimeout(WAIT_S)
        other.sendto(PingMessage(kind, b"\x01\x00").pack(0, 0), address)
        assert parse_messages(other.recv(1000)) == [PingMessage(1, kind.to_bytes(2, "little"))]


def test_the_last_settings_are_told_on_request(client):
    """Without a ping, as a program reads them that connects anew."""
    client.control_transducer(1, 2, 123, 40, 500, 800, 300, 0, 0)
    assert client.wait_message([brping.definitions.PING360_DEVICE_DATA], WAIT_S).angle == 123
    told = client.request(brping.definitions.PING360_DEVICE_DATA, timeout=WAIT_S)
    assert (told.gain_setting, told.angle, told.transmit_duration, told.sample_period) == (2, 123, 40, 500)
    assert (told.transmit_frequency, told.number_of_samples, told.data_length) == (800, 300, 0)


def test_messages_survive_noise_before_and_behind_them():
    first, second = PingMessage(6, b"\x04\x00"), PingMessage(2903)
    data = b"BRxB" + first.pack(0, 0) + b"\xffBR\x00" + second.pack(0, 0) + b"BR"
    assert parse_messages(data) == [first, second]
    broken = bytearray(first.pack(0, 0))
    broken[8] ^= 1
    assert parse_messages(bytes(broken)) == []


class CountedBytes(bytes):
    """Bytes that count how many of them are taken out in slices."""

    taken = 0

    def __getitem__(self, place):
        found = super().__getitem__(place)
        if isinstance(place, slice):
            self.taken += len(found)
        return found


@pytest.mark.parametrize("noise", [b"BR" * 30_000, b"BR\x00\x74\x00\x00" * 10_000])
def test_noise_that_begins_messages_is_not_summed_for_each_of_them(noise):
    """Sums of up to 64 kB for each "BR" held up the device for seconds."""
    datagram = CountedBytes(noise + PingMessage(6, b"\x04\x00").pack(0, 0))
    assert parse_messages(datagram)[-1:] == [PingMessage(6, b"\x04\x00")]
    assert datagram.taken == 2


def test_messages_are_those_whose_sums_are_right():
    """In random bytes of few values, by the definition, also where a message lies in another's payload."""

    def by_definition(data):
        found, start = [], 0
        while start + 10 <= len(data):
            size, kind = struct.unpack_from("<HH", data, start + 2)
            end = start + 8 + size
            total = sum(data[start:end]) % 2**16
            if data[start : start + 2] == b"BR" and data[end : end + 2] == total.to_bytes(2, "little"):
                found.append(PingMessage(kind, data[start + 8 : end]))
                start = end + 2
            else:
                start += 1
        return found

    rng, count = random.Random(0), 0
    for _ in range(2000):
        inner = PingMessage(rng.randrange(3), rng.randbytes(rng.randrange(4))).pack(0, 0)
        parts = inner, b"BR", b"BR\x00\x00", rng.randbytes(2), PingMessage(5, b"x" + inner + b"B").pack(1, 2)
        data = b"".join(rng.choice(parts) for _ in range(rng.randrange(6)))
        data = data[: rng.randrange(len(data) + 1)] if rng.random() < 0.3 else data
        assert parse_messages(data) == by_definition(data)
        count += len(by_definition(data))
    long = PingMessage(9, bytes([255]) * 60_000)  # its sum passes 2^16
    assert parse_messages(b"BR" + long.pack(0, 0) + b"BR") == [long]
    assert count > 1000


def test_scan_of_wrong_length_is_refused():
    with pytest.raises(Error, match="must have 16 bytes"):
        parse_scan(b"\x01")


@pytest.mark.parametrize("count", [10_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_noise_on_the_network_neither_stops_nor_stalls_the_device(server, client, count):
    """Datagrams of random bytes, and whole messages with random payloads."""
    rng, address = random.Random(0), ("127.0.0.1", server.port)
    # no message that pings: those take their time by right
    kinds = 0, 1, 4, 5, 6, 2000, 2300, 2600, AUTO_TRANSMIT, 2903, 4711
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        for number in range(count):
            payload = rng.randbytes(rng.randrange(40))
            if number % 2:
                kind, size = rng.choice(kinds), struct.calcsize("<BBHHHHHHBB")
                if kind == AUTO_TRANSMIT and len(payload) == size:
                    payload = payload[1:]
                payload = PingMessage(kind, payload).pack(0, 0)
            other.sendto(payload, address)

    def answer_to(angle, wait_s):
        client.control_transducer(1, 0, angle, 32, 400, 750, 200, 1, 0)
        return client.wait_message([brping.definitions.PING360_DEVICE_DATA], wait_s)

    start = time.monotonic()
    while answer_to(9, 0.05) is None:  # the first requests may be dropped
        assert time.monotonic() - start < WAIT_S
    while (angle := answer_to(11, WAIT_S).angle) == 9:  # to a request that was repeated
        pass
    assert angle == 11


def test_settings_that_no_ping_can_be_made_with_are_refused(client, monkeypatch):
    ping = SimulatedHead.ping

    def limited(head, sonar, *values):
        if sonar.n_bins == 201:
            raise Error("the ping must succeed (got 201 bins)")
        return ping(head, sonar, *values)

    monkeypatch.setattr(SimulatedHead, "ping", limited)
    client.control_transducer(1, 0, 9, 32, 400, 750, 201, 1, 0)
    answer = client.wait_message([brping.definitions.COMMON_NACK], WAIT_S)
    assert (answer.nacked_id, bytes(answer.nack_message)) == (2601, b"the ping must succeed (got 201 bins)\0")
    client.control_auto_transmit(1, 0, 32, 400, 750, 201, 390, 10, 5, 0)
    assert client.wait_message([brping.definitions.COMMON_NACK], WAIT_S).nacked_id == 2602
    assert client.transmitAngle(7).angle == 7


def test_a_scan_that_the_machine_fails_ends_the_device():
    """As a single ping does: nothing comes of those that follow."""

    class LostHead:
        def ping(self, *_):
            raise MachineError("the driver must keep the sonar's OpenGL context")

    async def serve(simulation):
        server, started = Ping360Server(LostHead(), simulation, port=0), asyncio.Event()
        serving = asyncio.create_task(server.run(started.set))
        await asyncio.wait_for(started.wait(), WAIT_S)
        message = PingMessage(AUTO_TRANSMIT, AUTO_PAYLOAD.pack(1, 0, 32, 400, 750, 201, 390, 10, 5, 0)).pack(
            0, 0
        )
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.sendto(message, ("127.0.0.1", server.port))
            await asyncio.wait_for(serving, 5.0)

    with ThreadPoolExecutor(1) as simulation, pytest.raises(MachineError, match="must keep"):
        asyncio.run(serve(simulation))


@pytest.mark.parametrize("duration_us, frequency_khz", [(1, 500), (1, 999), (1000, 1000)])
def test_the_shortest_and_the_longest_pulse_are_made(client, duration_us, frequency_khz):
    client.control_transducer(1, 0, 9, duration_us, 400, frequency_khz, 200, 1, 0)
    answer = client.wait_message([brping.definitions.PING360_DEVICE_DATA], WAIT_S)
    assert (answer.transmit_duration, answer.transmit_frequency) == (duration_us, frequency_khz)
    assert len(answer.data) == 200


@pytest.mark.parametrize("n_samples, sample_period", [(1, 80), (1, 40_000), (1200, 80), (1200, 40_000)])
def test_the_nearest_and_the_farthest_range_are_made(client, n_samples, sample_period):
    client.control_transducer(1, 0, 9, 32, sample_period, 750, n_samples, 1, 0)
    answer = client.wait_message([brping.definitions.PING360_DEVICE_DATA], WAIT_S)
    assert (answer.sample_period, len(answer.data)) == (sample_period, n_samples)
