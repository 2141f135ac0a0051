"""What `python -m tools.soak_ros` counts, by a transport in this process whose faults are known."""

import multiprocessing
import sys
import threading
import time

import pytest

from sonar_gl.ros.transport import Transport
from tests.support.live_messages import ping_message, stamp_of, stamped
from tools import soak_ros
from tools.soak_ros import soak

RATE_HZ, DURATION_S = 100.0, 0.4
AT = 2  # number of the message that a fault meets, counted from 0


class FaultyTransport(Transport):
    """Delivers at once, in the thread of the sender.

    Parameters
    ----------
    deliver : function (number, message) -> messages that arrive in its place; probes arrive as they are
    """

    dropped = 7  # as a transport counts them

    def __init__(self, deliver):
        self._deliver, self._receivers, self._number = deliver, [], 0

    def advertise(self, topic):
        pass

    def publish(self, topic, message, time_ns):
        arriving = [message]
        if stamp_of(message) != 0:
            arriving, self._number = self._deliver(self._number, message), self._number + 1
        for one in arriving:
            for receive in self._receivers:
                receive(one)

    def subscribe(self, topic, receive):
        self._receivers.append(receive)
        return lambda: None

    def close(self):
        pass


class InThread:
    """Runs a function in a thread of this process, in place of another process."""

    def __init__(self, function, *arguments):
        self.pipe, other = multiprocessing.Pipe()
        self._thread = threading.Thread(target=function, args=(*arguments, other), daemon=True)

    def __enter__(self):
        self._thread.start()
        assert self.pipe.recv() == "ready"
        return self.pipe

    def __exit__(self, *_):
        self._thread.join(20)


@pytest.fixture
def connect(monkeypatch):
    """A function that makes the transport "faulty", with faults of its own."""
    monkeypatch.setattr("tools.soak_ros._process", InThread)
    monkeypatch.setattr(soak_ros, "LINGER_S", 0.05)

    def set_up(deliver=lambda number, message: [message]):
        transport = FaultyTransport(deliver)
        monkeypatch.setitem(soak_ros.TRANSPORTS, "faulty", lambda port: transport)
        return transport

    return set_up


def late_by_one():
    """Return a `deliver` that holds one message back until the next one has arrived."""
    held = []

    def deliver(number, message):
        if number == AT:
            held.append(message)
            return []
        return [message, held.pop()] if held else [message]

    return deliver


def broken(message):
    return message[:-1] + bytes([message[-1] ^ 1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("deliver", "lost", "damaged", "disordered"),
    [
        (lambda number, message: [message], 0, 0, 0),
        (lambda number, message: [] if number == AT else [message], 1, 0, 0),
        (lambda number, message: [broken(message) if number == AT else message], 0, 1, 0),
        (lambda number, message: [message] * (1 + (number == AT)), -1, 0, 1),
        (late_by_one(), 0, 0, 1),
        # of a time at which none was sent, such as of another program
        (
            lambda number, message: [stamped(message, stamp_of(message) + 1) if number == AT else message],
            0,
            1,
            0,
        ),
    ],
    ids=["sound", "lost", "damaged", "twice", "late", "unknown"],
)
def test_each_fault_is_counted(connect, deliver, lost, damaged, disordered):
    connect(deliver)
    found = soak("faulty", DURATION_S, RATE_HZ)
    assert AT + 1 < found.sent <= RATE_HZ * DURATION_S
    assert found.sent + found.left_out == RATE_HZ * DURATION_S
    received = found.received
    assert (found.lost, received.damaged, received.disordered) == (lost, damaged, disordered)
    assert received.count == len(received.latency_s) == found.sent - lost
    assert received.dropped == FaultyTransport.dropped
    assert found.message_bytes == len(ping_message()[1])


@pytest.mark.slow
def test_a_slow_transport_makes_messages_late_not_a_burst(connect):
    def deliver(number, message):
        time.sleep(0.05)  # five periods
        return [message]

    connect(deliver)
    found = soak("faulty", DURATION_S, RATE_HZ)
    assert 1 <= found.sent <= 8 and found.lost == 0  # 0.4 s have room for eight
    assert found.left_out == RATE_HZ * DURATION_S - found.sent
    assert found.worst_publish_s >= 0.05


@pytest.mark.slow
def test_the_pings_of_a_publisher_arrive(connect):
    connect()
    found = soak("faulty", 0.5, 4.0, "publisher")
    assert 1 <= found.sent <= 3 and found.lost == 0
    assert (found.received.damaged, found.received.disordered) == (0, 0)
    assert found.message_bytes > 256 * 100  # a ping of 256 beams, not a probe


@pytest.mark.slow
def test_what_came_of_it_is_printed(connect, monkeypatch, capsys):
    connect(lambda number, message: [] if number == AT else [broken(message) if number == 0 else message])
    monkeypatch.setattr(
        sys, "argv", ["soak_ros", "--transport", "faulty", "--minutes", "0.005", "--rate", "100"]
    )
    soak_ros.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "faulty, source message, 0.005 minutes at 100 Hz"
    assert ", 1 lost; " in lines[1]
    assert lines[2] == "1 damaged, 0 out of order, 7 dropped by the reader"
    assert lines[3].startswith("latency: median ") and lines[4].startswith("publish: worst ")


@pytest.mark.parametrize("option", ["--minutes", "--rate"])
@pytest.mark.parametrize("value", ["0", "-1", "nan"])
def test_times_that_are_none_are_refused(monkeypatch, capsys, option, value):
    monkeypatch.setattr(soak_ros, "soak", lambda *_: pytest.fail("it begins"))
    monkeypatch.setattr(sys, "argv", ["soak_ros", option, value])
    with pytest.raises(SystemExit) as left:
        soak_ros.main()
    assert left.value.code == 2
    assert "--minutes and --rate must be greater than 0" in capsys.readouterr().err
