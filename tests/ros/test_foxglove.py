"""Topics for Foxglove and Lichtblick, read by a client that was written from the protocol's description."""

import json
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import warnings
from contextlib import ExitStack, nullcontext
from pathlib import Path

import pytest

from sonar_gl.core.errors import Error, MachineError
from sonar_gl.core.hosts import wait_until_free
from sonar_gl.ros import foxglove_transport
from sonar_gl.ros.bag import WORLD
from sonar_gl.ros.foxglove_transport import MAX_BACKLOG, FoxgloveTransport
from tests.support.forks import in_fork
from tests.support.foxglove_client import Disconnected, FoxgloveClient
from tests.support.listening import LOOPBACK, listening_ports
from tests.support.live_messages import free_port, ping_message, sonar_topic, stamped
from tests.support.ros_decoders import DECODERS, by_rosbags, check_projected_image
from tests.support.ros_topics import topic_of
from tests.support.waiting import WAIT_S, wait_until

ROOT = Path(__file__).resolve().parents[2]
LAYOUT = ROOT / "examples" / "foxglove_layout.json"
TIME_NS = 1_700_000_000_123_456_789


@pytest.fixture
def transport():
    """Serve at a free port."""
    one = FoxgloveTransport(port=0)
    yield one
    one.close()


@pytest.fixture
def viewers(transport):
    """Connect viewers, which disconnect in the end."""
    with ExitStack() as stack:
        yield lambda: stack.enter_context(FoxgloveClient(transport.port))


def pose_topic(**quality):
    return topic_of("/pose", "geometry_msgs/msg/PoseStamped", **quality)


def test_a_topic_has_one_type(transport):
    transport.advertise(pose_topic())
    transport.advertise(pose_topic(depth=7))
    with pytest.raises(Error, match="a topic must have one type"):
        transport.publish(topic_of("/pose", "tf2_msgs/msg/TFMessage"), b"", 0)


def test_a_forked_process_leaves_its_parents_transport_alone(transport):
    topic = pose_topic()
    transport.advertise(topic)
    assert in_fork(lambda: transport.publish(topic, b"pose", 0), transport.close) == [
        "a FoxgloveTransport must be used in the process that made it; make one in each process",
        "done",
    ]
    transport.publish(topic, b"pose", 0)


def test_a_viewer_receives_pings(transport, viewers):
    topic, (ping, message) = sonar_topic(), ping_message(64, 300)
    transport.advertise(topic)
    viewer = viewers()
    assert (viewer.server["name"], viewer.server["supportedEncodings"]) == ("sonar_gl", ["cdr"])
    assert viewer.server["capabilities"] == ["clientPublish"]
    channel = viewer.subscribe(topic.name)
    assert channel == {
        "id": channel["id"],
        "topic": "/sonar/projected_image",
        "encoding": "cdr",
        "schemaName": "marine_acoustic_msgs/msg/ProjectedSonarImage",
        "schemaEncoding": "ros2msg",
        "schema": topic.definition,
    }
    sent = [stamped(message, TIME_NS + k) for k in range(5)]
    wait_subscribed(viewer)
    for k, one in enumerate(sent):
        transport.publish(topic, one, TIME_NS + k)
    received = [viewer.next_message() for _ in sent]
    assert received == [(7, TIME_NS + k, one) for k, one in enumerate(sent)]
    for k, (_, _, one) in enumerate(received):
        for decode in DECODERS:
            check_projected_image(decode(topic, one), ping, TIME_NS + k)


def wait_subscribed(viewer):
    """Return once a viewer's subscription has arrived: the server handles its requests in their order."""
    viewer.send("no request")
    viewer.next_text("status")


def test_a_late_viewer_receives_the_last_message_of_a_latched_topic(transport, viewers):
    topic, other = topic_of("/tf_static", "tf2_msgs/msg/TFMessage", latched=True), pose_topic()
    transport.publish(topic, b"first", 1)
    transport.publish(topic, b"last", 2)
    transport.publish(other, b"gone", 3)
    viewer = viewers()
    viewer.subscribe(other.name, 8)
    viewer.subscribe(topic.name, 7)
    assert viewer.next_message() == (7, 2, b"last")


def test_a_viewer_that_goes_and_comes_again(transport, viewers):
    topic = pose_topic()
    for k in range(3):
        transport.publish(topic, b"nobody", 0)
        viewer = viewers()
        viewer.subscribe(topic.name)
        wait_subscribed(viewer)
        transport.publish(topic, b"%d" % k, k)
        assert viewer.next_message() == (7, k, b"%d" % k)
        viewer.close()


@pytest.mark.slow
def test_a_viewer_that_does_not_read_holds_up_nobody(transport, viewers):
    topic, size = pose_topic(), 1 << 20
    transport.advertise(topic)
    idle, viewer = viewers(), viewers()
    for one in (idle, viewer):
        one.subscribe(topic.name)
        wait_subscribed(one)
    # what is published is several times what may wait for a viewer
    for k in range(4 * MAX_BACKLOG):
        message = struct.pack("<I", k) + bytes(size)
        transport.publish(topic, message, k)
        assert viewer.next_message() == (7, k, message)
    # the idle one misses the oldest ones; the network's buffers and the client's hold some beside those that wait
    received = [idle.next_message()[1]]
    while received[-1] < 4 * MAX_BACKLOG - 1:
        received.append(idle.next_message()[1])
    assert received == sorted(set(received)) and len(received) < 2 * MAX_BACKLOG


# ---- messages of viewers ------------------------------------------------------------------------------


def test_messages_of_viewers_arrive(transport, viewers, caplog):
    topic, received, other = pose_topic(depth=100), [], []
    transport.subscribe(topic, received.append)
    transport.subscribe(topic_of("/pose", "nav_msgs/msg/Odometry"), other.append)
    viewer = viewers()
    viewer.advertise(1, "/pose", "geometry_msgs/msg/PoseStamped")
    viewer.advertise(2, "/pose", "geometry_msgs/msg/PoseStamped", "json")
    viewer.advertise(3, "/elsewhere", "geometry_msgs/msg/PoseStamped")
    for k in range(5):
        for channel in (1, 2, 3, 4):
            viewer.publish(channel, b"%d of %d" % (k, channel))
    viewer.publish(1, b"last")
    wait_until(lambda: b"last" in received)
    assert received == [b"0 of 1", b"1 of 1", b"2 of 1", b"3 of 1", b"4 of 1", b"last"] and not other
    ours = [record.getMessage() for record in caplog.records if record.name.startswith("sonar_gl")]
    assert ours == ["messages of a viewer on '/pose' are ignored: they must be in cdr, not in 'json'"]


def test_a_subscription_is_withdrawn(transport, viewers):
    topic, ended, kept = pose_topic(), [], []
    before = set(threading.enumerate())
    withdraw = transport.subscribe(topic, ended.append)
    (thread,) = (one for one in set(threading.enumerate()) - before if one.name == "inbox /pose")
    transport.subscribe(topic, kept.append)
    withdraw()
    withdraw()
    viewer = viewers()
    viewer.advertise(1, "/pose", "geometry_msgs/msg/PoseStamped")
    viewer.publish(1, b"a")
    wait_until(lambda: kept)
    assert ended == [] and not thread.is_alive() and transport.dropped == 0


@pytest.mark.parametrize("count", [100, pytest.param(100_000, marks=pytest.mark.slow)])
def test_random_messages_stall_nothing(transport, viewers, count):
    poses, images, read, rng = (
        pose_topic(),
        topic_of("/sonar/image", "sensor_msgs/msg/Image"),
        [],
        random.Random(1),
    )

    def receive(message):
        read.append(message == b"good" or by_rosbags(poses, message))  # raises, as a careless reader does

    transport.subscribe(poses, receive)
    transport.advertise(images)
    viewer = viewers()
    viewer.advertise(1, "/pose", "geometry_msgs/msg/PoseStamped")
    texts = "", "{", "[]", '{"op": 1}', '{"op": "advertise", "channels": 3}', '{"op": "subscribe"}', "\x00"
    for k in range(count):
        try:
            if k % 10:
                viewer.publish(1, rng.randbytes(rng.choice([0, 1, 4, 60, 5000])))
            else:
                viewer.send(rng.choice([rng.choice(texts), rng.randbytes(rng.choice([1, 3, 9, 200]))]))
        except Disconnected:  # the server does so to one who does not read its complaints
            viewer = viewers()
            viewer.advertise(1, "/pose", "geometry_msgs/msg/PoseStamped")
        if k % 100 == 0:
            transport.publish(images, b"x", 0)
    read.clear()
    viewer = viewers()
    viewer.advertise(1, "/pose", "geometry_msgs/msg/PoseStamped")
    wait_until(lambda: viewer.publish(1, b"good") or True in read)
    fresh = viewers()
    fresh.subscribe(images.name)
    wait_subscribed(fresh)
    transport.publish(images, b"still here", 5)
    assert fresh.next_message() == (7, 5, b"still here")


@pytest.mark.slow
def test_wrong_requests_do_not_fill_the_log(transport, viewers, caplog):
    viewer = viewers()
    for _ in range(20):
        viewer.publish(99, b"on no channel")
        for request in ("no request", bytes([255])):
            viewer.send(request)
        for _ in range(3):
            viewer.next_text("status")
    assert not caplog.records


def test_bytes_that_are_no_websocket_stall_nothing(transport, viewers):
    topic, rng = pose_topic(), random.Random(2)
    transport.advertise(topic)
    for length in (0, 1, 40, 60_000) * 20:
        with socket.create_connection(("127.0.0.1", transport.port), 10.0) as connection:
            connection.sendall(rng.randbytes(length))
    viewer = viewers()
    viewer.subscribe(topic.name)
    wait_subscribed(viewer)
    transport.publish(topic, b"x", 1)
    assert viewer.next_message() == (7, 1, b"x")


# ---- where it listens, and the end --------------------------------------------------------------------


def test_it_listens_at_127_0_0_1_without_a_warning():
    before = listening_ports()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one = FoxgloveTransport(port=0)
    assert listening_ports() - before == {(LOOPBACK, one.port)}
    one.close()
    assert listening_ports() <= before


@pytest.mark.slow
@pytest.mark.parametrize("has_viewer", [False, True])
def test_a_closed_port_can_be_opened_at_once(has_viewer):
    """The server's own end of listening comes late in one of some ten cases: forty leave no doubt."""
    port = free_port()
    for _ in range(40):
        one = FoxgloveTransport(port=port)
        with FoxgloveClient(port) if has_viewer else nullcontext():
            one.close()
            assert port not in {number for _, number in listening_ports()}


def test_a_port_that_somebody_keeps_is_waited_for_and_told(monkeypatch, caplog):
    monkeypatch.setattr(foxglove_transport, "CLOSE_S", 0.1)
    one = FoxgloveTransport(port=0)
    port, other = one.port, socket.socket()

    def another_program_takes_it(host, port, limit_s):
        assert wait_until_free(host, port, WAIT_S)
        other.bind((host, port))
        other.listen()
        return wait_until_free(host, port, limit_s)

    monkeypatch.setattr(foxglove_transport, "wait_until_free", another_program_takes_it)
    with other:
        one.close()
    assert caplog.messages == [
        f"port {port} is still in use 0.1 s after the Foxglove server was closed, by it or by another program"
    ]


def make_idle(transport, viewer):
    """Have a viewer subscribe and read nothing of what is sent to it, more than buffers hold."""
    topic = pose_topic()
    transport.advertise(topic)
    viewer.subscribe(topic.name)
    wait_subscribed(viewer)
    for k in range(2 * MAX_BACKLOG):
        transport.publish(topic, bytes(1 << 20), k)
    waiting = [0]

    def is_stuck():
        waiting.append(viewer.waiting_bytes())
        return 0 < waiting[-2] == waiting[-1]

    wait_until(is_stuck, often_s=0.1)


def stops():
    """The threads that wait for viewers."""
    return [one for one in threading.enumerate() if one.name == "foxglove stop"]


@pytest.mark.slow
def test_a_viewer_that_does_not_read_holds_up_no_end(viewers, transport, monkeypatch, caplog):
    monkeypatch.setattr(foxglove_transport, "CLOSE_S", 0.2)
    port, viewer = transport.port, viewers()
    make_idle(transport, viewer)
    caplog.clear()
    began_s = time.monotonic()
    transport.close()
    assert 0.2 <= time.monotonic() - began_s < WAIT_S
    ours = [record.getMessage() for record in caplog.records if record.name.startswith("sonar_gl")]
    assert ours == [
        "a viewer does not read, and is not disconnected after 0.2 s; its connection ends with this program"
    ]
    assert port not in {number for _, number in listening_ports()}
    viewer.close()
    wait_until(lambda: not stops())


@pytest.mark.slow
def test_ctrl_c_ends_the_wait_for_a_viewer_that_does_not_read(viewers, transport, monkeypatch):
    monkeypatch.setattr(foxglove_transport, "CLOSE_S", WAIT_S)
    viewer, received = viewers(), []
    make_idle(transport, viewer)
    transport.subscribe(pose_topic(), received.append)
    again = threading.Timer(0.2, signal.pthread_kill, (threading.get_ident(), signal.SIGINT))
    again.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            transport.close()
    finally:
        again.join()
    assert not [one for one in threading.enumerate() if one.name == "inbox /pose"]
    viewer.close()
    wait_until(lambda: not stops())


@pytest.mark.slow
def test_a_program_ends_while_a_viewer_does_not_read():
    program = (
        "from tests.ros.test_foxglove import *\n"
        "foxglove_transport.CLOSE_S = 0.1\n"
        "one = FoxgloveTransport(port=0)\n"
        "make_idle(one, FoxgloveClient(one.port))\n"
        "one.close()\n"
        "print(len(stops()), 'waits')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=WAIT_S, cwd=ROOT, check=False
    )
    assert (done.returncode, done.stdout) == (0, "1 waits\n")
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("a viewer does not read")


def test_another_address_is_warned_of():
    with pytest.warns(UserWarning, match="any machine that reaches 0.0.0.0 can see these topics"):
        FoxgloveTransport("0.0.0.0", 0).close()


def test_a_taken_port_is_refused_in_a_sentence(transport):
    why = f"must be able to listen at 127.0.0.1:{transport.port} (got address already in use; is another program"
    with pytest.raises(Error, match=re.escape(why)) as caught:
        FoxgloveTransport(port=transport.port)
    assert not isinstance(caught.value, MachineError)  # the caller can take another port


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"port": 70_000}, "port must be a whole number in 0..65535 (got 70000)"),
        ({"port": "8765"}, "port must be a whole number in 0..65535 (got '8765')"),
        ({"host": None}, "host must be a str (got NoneType; such as '127.0.0.1')"),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(settings, why):
    with pytest.raises(Error, match=re.escape(why)):
        FoxgloveTransport(**settings)


def test_an_unknown_host_is_refused_in_a_sentence():
    with pytest.warns(UserWarning), pytest.raises(Error, match=r"listen at no\.such\.host\.invalid:"):
        FoxgloveTransport("no.such.host.invalid", free_port())


def test_the_error_without_the_extra_says_how_to_add_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)  # as if it were not installed
    with pytest.raises(Error, match=r"Foxglove needs foxglove-sdk \(got no module foxglove\).*\.\[live\]"):
        FoxgloveTransport()


def test_a_closed_transport_refuses_use(transport, viewers):
    topic = pose_topic()
    transport.publish(topic, b"x", 0)
    transport.close()
    transport.close()
    for use in (
        lambda: transport.publish(topic, b"x", 0),
        lambda: transport.advertise(topic),
        lambda: transport.subscribe(topic, print),
    ):
        with pytest.raises(Error, match="this FoxgloveTransport is closed; make a new one"):
            use()
    with pytest.raises(OSError):
        viewers()


def test_the_layout_shows_the_default_topics():
    layout = json.loads(LAYOUT.read_text())
    panels = layout["configById"]
    assert sorted(panels) == sorted(panels_of(layout["layout"]))
    assert panels["Image!sonar"]["imageMode"]["imageTopic"] == "/sonar/image"
    assert panels["RawMessages!sonar"]["topicPath"] == "/sonar/projected_image.ping_info"
    space = panels["3D!sonar"]
    assert space["followTf"] == WORLD
    assert {name for name, topic in space["topics"].items() if topic["visible"]} == {"/tf", "/sonar/points"}


def panels_of(layout):
    """Names of the panels in a tree of them."""
    if isinstance(layout, str):
        return [layout]
    return panels_of(layout["first"]) + panels_of(layout["second"])
