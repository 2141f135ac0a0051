"""Send pings over a transport on this machine, and print what is lost, how late it comes, and how memory grows.

    python -m tools.soak_ros                            # zenoh, 30 minutes at 20 Hz
    python -m tools.soak_ros --minutes 2 --rate 50
    python -m tools.soak_ros --transport dds
    python -m tools.soak_ros --source publisher         # pings that are made meanwhile

One process sends, another receives, and for zenoh a third one is the router. What is sent is one message of 256 beams
and 512 bins, again and again; or the pings of a `Publisher` whose sonar, P900-45 with noise, moves in the scene pylon.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import threading
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from time import perf_counter, perf_counter_ns, sleep, time_ns

import numpy as np

import sonar_gl as sg
from sonar_gl.ros import Publisher, PublisherSettings
from sonar_gl.ros.dds_transport import DdsTransport
from sonar_gl.ros.publisher_settings import TOPICS
from sonar_gl.ros.transport import Topic, Transport
from sonar_gl.ros.zenoh_transport import ZenohTransport
from tests.support.live_messages import (
    free_port,
    ping_message,
    sonar_topic,
    stamp_of,
    stamped,
    zenoh_router,
)
from tests.support.memory import resident_bytes

WAIT_S = 60.0  # for a process to start, or to end
PROBE_S = 0.02  # between probes, which are sent until both ends know of one another
LINGER_S = 1.0  # for the last messages to arrive
WARM_UP = 0.25  # share of the time whose growth of memory does not count: pools of threads and buffers fill
N_SAMPLES = 400  # of memory
DOMAINS = 100  # of DDS; ports of higher ones may be taken by other programs
DEPTH = 100  # messages that wait for the reader: not its pauses are examined here, but the way to it
STEPS = 10  # of a publisher's loop from ping to ping
TURN_S = 60.0  # in which the publisher's sonar moves to and fro


def zenoh_transport(port: int) -> Transport:
    """Return a transport of this process by the router at a port."""
    return ZenohTransport(f"tcp/127.0.0.1:{port}")


def dds_transport(port: int) -> Transport:
    """Return a transport of this process, in a domain that a port tells from those of other runs."""
    return DdsTransport(1 + port % DOMAINS)


TRANSPORTS = {"zenoh": zenoh_transport, "dds": dds_transport}
ROUTERS = {"zenoh": zenoh_router}  # transports that need one


class Memory:
    """Resident memory of this process over time, in an array that does not grow.

    Parameters
    ----------
    duration_s : for how long it is watched
    """

    def __init__(self, duration_s: float):
        self._period_s, self._start_s = duration_s / N_SAMPLES, perf_counter()
        self._rows, self._n = np.zeros((N_SAMPLES, 2)), 0

    def watch(self) -> None:
        """Take a sample if it is time for one."""
        passed_s = perf_counter() - self._start_s
        if self._n < N_SAMPLES and passed_s >= self._n * self._period_s:
            self._rows[self._n] = passed_s, resident_bytes()
            self._n += 1

    def growth(self) -> float:
        """Return the growth after the warm-up, bytes per minute: the slope of the line with the least squares.

        NaN if there were fewer than two samples.
        """
        rows = self._rows[int(WARM_UP * self._n) : self._n]
        if len(rows) < 2:
            return float("nan")
        return 60.0 * float(np.polyfit(rows[:, 0], rows[:, 1], 1)[0])


@dataclass(frozen=True)
class Received:
    """What a process received.

    Attributes
    ----------
    count : messages
    damaged : messages that differ from the one that was sent with their time
    disordered : messages that came after a later one, or twice
    dropped : messages that came while more waited than the topic keeps; None where the transport does not count them
    latency_s : (count,) from the time of the message to receiving
    growth : of its memory, bytes per minute
    """

    count: int
    damaged: int
    disordered: int
    dropped: int | None
    latency_s: np.ndarray
    growth: float


@dataclass(frozen=True)
class Soak:
    """What came of it.

    Attributes
    ----------
    sent : messages
    left_out : messages that would have come too late
    message_bytes : of the last one
    received : Received
    growth : of the sender's memory, bytes per minute
    worst_publish_s : the longest time that sending took
    """

    sent: int
    left_out: int
    message_bytes: int
    received: Received
    growth: float
    worst_publish_s: float

    @property
    def lost(self) -> int:
        """Messages that did not arrive."""
        return self.sent - self.received.count


class _Log:
    """Times and checksums of messages, in arrays that do not grow."""

    def __init__(self, most: int):
        self._times_ns, self._checksums, self.count = np.zeros(most, np.int64), np.zeros(most, np.uint32), 0

    def add(self, message: bytes) -> None:
        """Note a message."""
        self._times_ns[self.count] = stamp_of(message)
        self._checksums[self.count] = zlib.crc32(message)
        self.count += 1

    @property
    def times_ns(self) -> np.ndarray:
        """Time of each message, nanoseconds."""
        return self._times_ns[: self.count]

    @property
    def checksums(self) -> np.ndarray:
        """Checksum of each message."""
        return self._checksums[: self.count]


class _Reader:
    """Notes the messages that arrive, but for probes, whose time is 0."""

    def __init__(self, most: int, duration_s: float):
        self.is_connected, self._change = threading.Event(), threading.Condition()
        self.latency_s, self.log, self.memory = np.zeros(most), _Log(most), Memory(duration_s)

    def read(self, message: bytes) -> None:
        """Note a message."""
        time_now_ns, stamp_ns = time_ns(), stamp_of(message)
        self.is_connected.set()
        if stamp_ns == 0:
            return
        self.latency_s[self.log.count] = (time_now_ns - stamp_ns) / 1e9
        self.memory.watch()
        with self._change:
            self.log.add(message)
            self._change.notify()

    def linger(self, sent: int) -> None:
        """Wait until so many messages have come, though no longer than LINGER_S."""
        with self._change:
            self._change.wait_for(lambda: self.log.count >= sent, LINGER_S)

    def received(self, sent: _Log, dropped: int | None) -> Received:
        """Return what came of messages that were sent, in rising times."""
        log = self.log
        at = np.searchsorted(sent.times_ns, log.times_ns)
        there = np.append(sent.times_ns, -1)[at] == log.times_ns
        is_whole = there & (np.append(sent.checksums, 0)[at] == log.checksums)
        disordered = int((np.diff(log.times_ns) <= 0).sum())
        counts = log.count, int((~is_whole).sum()), disordered, dropped
        return Received(*counts, self.latency_s[: log.count], self.memory.growth())


def receive(kind: str, port: int, most: int, duration_s: float, pipe) -> None:
    """Receive until the other end of a pipe says what it has sent, and answer with what came."""
    transport, reader = TRANSPORTS[kind](port), _Reader(most, duration_s)
    transport.subscribe(sonar_topic(depth=DEPTH), reader.read)
    pipe.send("ready")
    reader.is_connected.wait(WAIT_S)
    pipe.send("connected")
    sent = pipe.recv()
    reader.linger(sent.count)
    transport.close()
    pipe.send(reader.received(sent, getattr(transport, "dropped", None)))


def route(kind: str, port: int, pipe) -> None:
    """Be the router until the other end of a pipe says so."""
    with ROUTERS[kind](port):
        pipe.send("ready")
        pipe.recv()


class _Sender(Transport):
    """A transport that notes what it sends, how long that takes, and how memory grows."""

    def __init__(self, transport: Transport, most: int, duration_s: float):
        self._transport, self.log, self.memory = transport, _Log(most), Memory(duration_s)
        self.worst_s, self.message_bytes = 0.0, 0

    def advertise(self, topic: Topic) -> None:
        self._transport.advertise(topic)

    def publish(self, topic: Topic, message: bytes, time_ns: int) -> None:
        self.log.add(message)
        before_s = perf_counter()
        self._transport.publish(topic, message, time_ns)
        self.worst_s = max(self.worst_s, perf_counter() - before_s)
        self.message_bytes = len(message)
        self.memory.watch()

    def subscribe(self, topic: Topic, receive: Callable[[bytes], None]) -> Callable[[], None]:
        return self._transport.subscribe(topic, receive)

    def close(self) -> None:
        self._transport.close()


def _rising_clock() -> Callable[[], int]:
    """Return a function that tells the time, nanoseconds, and never goes back, as the computer's clock may."""
    began_ns, counted_ns = time_ns(), perf_counter_ns()
    return lambda: began_ns + perf_counter_ns() - counted_ns


def send_message(sender: Transport, duration_s: float, rate_hz: float) -> int:
    """Send one message at a rate, each time with the time; return how many are left out as they would come too late."""
    topic, (_, message), count = sonar_topic(depth=DEPTH), ping_message(), most_messages(duration_s, rate_hz)
    start_s = next_s = perf_counter()
    sent, clock = 0, _rising_clock()
    while sent < count and next_s < start_s + duration_s:
        sleep(max(0.0, next_s - perf_counter()))
        now_ns = clock()
        sender.publish(topic, stamped(message, now_ns), now_ns)
        sent += 1
        # as a sonar does: what is late is left out, not made up for in a burst
        next_s = max(next_s + 1 / rate_hz, perf_counter())
    return count - sent


def send_pings(sender: Transport, duration_s: float, rate_hz: float) -> int:
    """Publish the pings of a sonar that moves; return how many are left out as they would come too late."""
    others = {kind: None for kind in TOPICS if kind != "projected_image"}
    settings, scene = PublisherSettings(rate_hz=rate_hz, topics=others), sg.load_scene("pylon")
    sonar, noise = sg.load_sonar("p900-45"), sg.Noise.physical()
    with Publisher(scene, sonar, [sender], noise=noise, settings=settings, in_background=True) as publisher:
        start_s, clock = perf_counter(), _rising_clock()
        while (passed_s := perf_counter() - start_s) < duration_s:
            angle_rad = 2 * math.pi * passed_s / TURN_S
            moved = sg.pose(x=math.sin(angle_rad), yaw=0.2 * math.sin(2 * angle_rad))
            publisher.step_at(clock(), scene.sonar_pose @ moved)
            sleep(1 / (STEPS * rate_hz))
    return publisher.counts.dropped


SOURCES = {"message": send_message, "publisher": send_pings}


def most_messages(duration_s: float, rate_hz: float) -> int:
    """Return how many messages there are at a rate."""
    return max(1, round(duration_s * rate_hz))


def soak(kind: str, duration_s: float, rate_hz: float, source: str = "message") -> Soak:
    """Send messages at a rate from this process to another one.

    Parameters
    ----------
    kind : key of TRANSPORTS
    duration_s, rate_hz : for how long, and how often
    source : key of SOURCES
    """
    port, most = free_port(), 1 + most_messages(duration_s, rate_hz)
    _, message = ping_message()
    probe, topic = stamped(message, 0), sonar_topic(depth=DEPTH)
    with ExitStack() as stack:
        if kind in ROUTERS:
            stack.enter_context(_process(route, kind, port))
        pipe = stack.enter_context(_process(receive, kind, port, most, duration_s))
        transport = TRANSPORTS[kind](port)
        stack.callback(transport.close)
        transport.advertise(topic)
        while not pipe.poll(PROBE_S):
            transport.publish(topic, probe, 0)
        _next(pipe)
        sender = _Sender(transport, most, duration_s)
        left_out = SOURCES[source](sender, duration_s, rate_hz)
        pipe.send(sender.log)
        what = sender.log.count, left_out, sender.message_bytes, _next(pipe)
        return Soak(*what, sender.memory.growth(), sender.worst_s)


class _process:  # noqa: N801, used like a function
    """Run a function in another process, with the end of a pipe as its last argument, while a block lasts."""

    def __init__(self, function, *arguments):
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self._process = context.Process(target=function, args=(*arguments, other), daemon=True)

    def __enter__(self):
        self._process.start()
        _next(self.pipe)
        return self.pipe

    def __exit__(self, *_):
        if self._process.is_alive():
            self.pipe.send(_Log(0))  # so many messages are waited for
        self._process.join(WAIT_S)
        self._process.terminate()


def _next(pipe):
    """Return what comes next from a pipe; a RuntimeError if nothing does."""
    if not pipe.poll(WAIT_S):
        raise RuntimeError(f"the other process says nothing for {WAIT_S:g} s")
    return pipe.recv()


def main():
    """Print what came of it."""
    parser = argparse.ArgumentParser(prog="python -m tools.soak_ros", description=__doc__.partition("\n")[0])
    parser.add_argument("--transport", choices=sorted(TRANSPORTS), default="zenoh")
    parser.add_argument("--source", choices=sorted(SOURCES), default="message", help="what is sent")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=20.0, help="messages per second")
    options = parser.parse_args()
    if not (options.minutes > 0 and options.rate > 0):
        parser.error("--minutes and --rate must be greater than 0")
    found = soak(options.transport, 60.0 * options.minutes, options.rate, options.source)
    received = found.received
    print(f"{options.transport}, source {options.source}, {options.minutes:g} minutes at {options.rate:g} Hz")
    print(
        f"messages of {found.message_bytes} bytes: {found.sent} sent, {received.count} received, {found.lost} lost; "
        f"{found.left_out} left out as too late"
    )
    dropped = "" if received.dropped is None else f", {received.dropped} dropped by the reader"
    print(f"{received.damaged} damaged, {received.disordered} out of order{dropped}")
    if received.count:
        median_s, worst_s = np.median(received.latency_s), received.latency_s.max()
        print(f"latency: median {1e3 * median_s:.2f} ms, worst {1e3 * worst_s:.1f} ms")
    print(f"publish: worst {1e3 * found.worst_publish_s:.1f} ms")
    print(
        f"growth of memory: sender {found.growth / 1e3:+.1f} kB, receiver {received.growth / 1e3:+.1f} kB per minute"
    )


if __name__ == "__main__":
    main()
