"""Messages over DDS: to and from programs that describe the types by themselves, and to those of another vendor."""

import hashlib
import json
import os
import random
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from contextlib import contextmanager
from ctypes.util import find_library
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from rosbags.serde.errors import SerdeError

from sonar_gl.core.errors import Error
from sonar_gl.core.extras import install_command
from sonar_gl.ros import dds_transport
from sonar_gl.ros.dds_transport import DdsTransport
from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Topic
from tests.support.errors import error_of
from tests.support.forks import in_fork
from tests.support.ros_topics import (
    PROJECTED,
    decode,
    header,
    header_bytes,
    plain,
    projected_image,
    topic_of,
)
from tests.support.waiting import WAIT_S, wait_until
from tools import soak_ros
from tools.soak_ros import Memory, Received, Soak, soak

try:
    from cyclonedds import topic as dds_topics
    from cyclonedds.builtin import (
        BuiltinDataReader,
        BuiltinTopicDcpsPublication,
        BuiltinTopicDcpsSubscription,
    )
    from cyclonedds.core import DDSException, Policy, WaitSet
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic as DdsTopic

    from tests.support import dds_entities, dds_types
except ModuleNotFoundError as why:
    if why.name != "cyclonedds":
        raise
    pytest.skip("cyclonedds, of the extra live, is missing", allow_module_level=True)

ROOT = Path(__file__).resolve().parents[2]
LENGTH = struct.Struct("<I")


def received(message: bytes) -> bytes:
    """Return how a message arrives from Cyclone DDS: whole words, as Python's writer sends them."""
    return message.ljust(-(-len(message) // 4) * 4, b"\0")


@pytest.fixture
def domain():
    """A domain of this process; others on this machine may use it, too, so names of topics are random."""
    return 1 + os.getpid() % 100


@pytest.fixture
def name():
    """Name of a topic that nobody else has."""
    return f"/test_{uuid.uuid4().hex}/topic"


@pytest.fixture
def open_transport(domain):
    """Function -> DdsTransport on the loopback interface, closed in the end."""
    opened = []

    def make():
        opened.append(DdsTransport(domain))
        return opened[-1]

    yield make
    for transport in opened:
        transport.close()


@pytest.fixture
def participant(open_transport, domain):
    """A participant of this process that knows nothing of the transport."""
    open_transport()  # configures the domain
    return DomainParticipant(domain)


@contextmanager
def process(*command):
    """Run a program that says "ready"; yields it."""
    environment = {**os.environ, "CYCLONEDDS_URI": dds_entities.LOOPBACK_URI, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as running:
        try:
            assert running.stdout.readline() == "ready\n"
            yield running
        finally:
            running.kill()


def cyclone_reader(domain, name, msgtype, count):
    """Run a reader of Cyclone DDS in a process of its own."""
    arguments = str(domain), f"rt{name}", msgtype, str(count), str(WAIT_S)
    return process(sys.executable, "-m", "tests.support.dds_entities", *arguments)


@contextmanager
def published_meanwhile(transport, topic, message=None):
    """Publish fifty messages a second while the block lasts; a failure to is raised in the end."""
    done, failures = threading.Event(), []

    def run():
        number = 0
        try:
            while not done.wait(0.02):
                transport.publish(topic, message or header_bytes(number), 0)
                number += 1
        except Error as why:
            failures.append(why)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
    assert not failures


@pytest.fixture(scope="session")
def fast_dds_peer(request, tmp_path_factory):
    """Path of the compiled program of another vendor, which is the default of ROS 2; it is kept in pytest's cache.

    There is no cache with `-p no:cacheprovider`.
    """
    if shutil.which("g++") is None or not Path("/usr/include/fastrtps").is_dir():
        why = (
            "the program of another vendor needs a compiler and Fast DDS: apt-get install g++ libfastrtps-dev"
        )
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    source, library = ROOT / "tests/support/fast_dds_peer.cpp", find_library("fastrtps")  # with its version
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    cache = getattr(request.config, "cache", None)
    kept = tmp_path_factory.mktemp("fast_dds") if cache is None else cache.mkdir("fast_dds")
    program = kept / f"{library}_{digest[:16]}"
    if not program.exists():
        with tempfile.TemporaryDirectory(dir=program.parent) as folder:  # another worker may compile, too
            compiled = Path(folder, "peer")
            options = "-std=c++17", "-Wall", "-Werror", "-lfastrtps", "-lfastcdr"
            command = "g++", str(source), "-o", str(compiled), *options
            subprocess.run(command, check=True, timeout=WAIT_S)
            compiled.rename(program)
    return program


def dds_name(msgtype):
    """Return the name of a type in DDS; "std_msgs::msg::dds_::Header_" for std_msgs/msg/Header."""
    package, kind, short = msgtype.split("/")
    return f"{package}::{kind}::dds_::{short}_"


@pytest.fixture
def vendor(fast_dds_peer, domain, name):
    """Function (read or write, type, path of messages, more) that runs the other vendor's program."""

    def run(way, msgtype, path, *more):
        arguments = way, domain, f"rt{name}", dds_name(msgtype), int(WAIT_S), path, *more
        return process(fast_dds_peer, *map(str, arguments))

    return run


def messages_of(path):
    """Return the messages in a file of the other vendor's program."""
    data, messages, at = path.read_bytes(), [], 0
    while at < len(data):
        (length,) = LENGTH.unpack_from(data, at)
        messages.append(data[at + LENGTH.size : at + LENGTH.size + length])
        at += LENGTH.size + length
    return messages


def write_messages(path, messages):
    """Write a file for the other vendor's program."""
    path.write_bytes(b"".join(LENGTH.pack(len(message)) + message for message in messages))


# ---- what arrives -----------------------------------------------------------------------------------


def odometry():
    """Return an Odometry whose numbers are all different."""
    number = iter(range(1, 100))

    def three(kind):
        return kind(*(float(next(number)) for _ in range(3)))

    stamp = dds_types.Header(dds_types.Time(next(number), next(number)), "odom")
    place = dds_types.Pose(three(dds_types.Point), dds_types.Quaternion(0.5, -0.5, 0.5, -0.5))
    pose = dds_types.PoseWithCovariance(place, [float(next(number)) for _ in range(36)])
    twist = dds_types.Twist(three(dds_types.Vector3), three(dds_types.Vector3))
    return dds_types.Odometry(
        stamp,
        "base_link",
        pose,
        dds_types.TwistWithCovariance(twist, [-float(next(number)) for _ in range(36)]),
    )


def transforms(n):
    """Return a TFMessage with n transforms, each of other numbers."""
    types, matrix = message_types(), np.eye(4)
    links = []
    for number in range(n):
        matrix[:3, 3] = number + 0.25, -number, 0.5
        links.append(types.transform(number * 7, "world", f"frame_{'x' * number}", matrix))
    return types.make("tf2_msgs/TFMessage", links)


@pytest.mark.parametrize(
    ("msgtype", "message"),
    [
        (PROJECTED, projected_image(3, n_beams=32, n_bins=65)),
        pytest.param(PROJECTED, projected_image(4, n_beams=1, n_bins=1), marks=pytest.mark.slow),
        pytest.param("tf2_msgs/msg/TFMessage", transforms(5), marks=pytest.mark.slow),
        pytest.param("tf2_msgs/msg/TFMessage", transforms(0), marks=pytest.mark.slow),
        ("std_msgs/msg/Header", header(12, "Fächer, in UTF-8")),
    ],
    ids=["projected", "one_bin", "transforms", "no_transform", "text"],
)
def test_every_field_arrives_in_another_process(open_transport, domain, name, msgtype, message):
    topic = topic_of(name, msgtype)
    transport = open_transport()
    encoded = message_types().encode(message)
    with cyclone_reader(domain, name, msgtype, 1) as peer, published_meanwhile(transport, topic, encoded):
        fields = json.loads(peer.stdout.readline())
    assert fields == plain(message)


@pytest.mark.parametrize("count", [16, pytest.param(50, marks=pytest.mark.slow)])
def test_whole_pings_arrive_at_another_vendor_byte_for_byte(open_transport, name, vendor, tmp_path, count):
    topic, transport, path = topic_of(name, PROJECTED, depth=100), open_transport(), tmp_path / "messages"
    pings = [projected_image(number) for number in range(4)]
    sent = [message_types().encode(ping) for ping in pings]
    with vendor("read", PROJECTED, path, count) as peer:
        number = 0
        while peer.poll() is None:
            transport.publish(topic, sent[number % len(sent)], 0)
            number += 1
            time.sleep(0.02)
        assert peer.stdout.read() == f"{count}\n"
    arrived = messages_of(path)
    # the reader was there from some message on, and lost none since
    first = arrived.index(received(sent[0]))
    assert arrived[first:] == [received(sent[number % len(sent)]) for number in range(count - first)]
    assert [plain(decode(topic, message)) for message in arrived[first : first + 4]] == [
        plain(p) for p in pings
    ]


@pytest.mark.slow
def test_poses_of_another_vendor_arrive_as_sent(open_transport, name, vendor, tmp_path):
    sent = [header_bytes(number, "x" * number) for number in range(50)]
    path, arrived = tmp_path / "messages", []
    write_messages(path, sent)
    open_transport().subscribe(topic_of(name, depth=50), arrived.append)
    with vendor("write", "std_msgs/msg/Header", path, 5) as peer:
        assert peer.stdout.readline() == "50\n"
    wait_until(lambda: len(arrived) >= 50)
    assert arrived == [received(message) for message in sent]


def test_poses_of_another_program_arrive(open_transport, participant, name):
    topic, arrived = topic_of(name, "nav_msgs/msg/Odometry"), []
    open_transport().subscribe(topic, arrived.append)
    writing = dds_entities.writer(participant, f"rt{name}", topic.msgtype)
    fields = odometry()
    wait_until(lambda: writing.get_matched_subscriptions())
    writing.write(fields)
    wait_until(lambda: arrived)
    assert [plain(decode(topic, message)) for message in arrived] == [asdict(fields)]


def test_own_messages_do_not_come_back(open_transport, name):
    topic, own, others = topic_of(name), [], []
    transport, other = open_transport(), open_transport()
    transport.subscribe(topic, own.append)
    other.subscribe(topic, others.append)
    transport.publish(topic, header_bytes(1), 0)
    wait_until(lambda: others)
    other.publish(topic, header_bytes(2), 0)
    wait_until(lambda: own)
    assert (own, others) == ([received(header_bytes(2))], [received(header_bytes(1))])


@pytest.mark.parametrize("owner, method", [(DataReader, "take"), (WaitSet, "wait")])
def test_a_failure_of_dds_does_not_end_the_messages(open_transport, name, monkeypatch, caplog, owner, method):
    works, calls = getattr(owner, method), []

    def fail_once(self, *arguments, **more):
        found = works(self, *arguments, **more)
        if not calls:
            calls.append(found)
            raise DDSException(DDSException.DDS_RETCODE_ERROR)
        return found

    monkeypatch.setattr(owner, method, fail_once)
    topic, arrived, other = topic_of(name), [], open_transport()
    other.subscribe(topic, arrived.append)
    with published_meanwhile(open_transport(), topic):
        wait_until(lambda: arrived)
    (record,) = caplog.records
    assert record.getMessage() == "messages of DDS cannot be taken; they are waited for again"


def test_a_subscription_is_withdrawn(open_transport, participant, name):
    topic, ended, kept, transport = topic_of(name), [], [], open_transport()
    withdraw = transport.subscribe(topic, ended.append)
    transport.subscribe(topic, kept.append)
    writing = dds_entities.writer(participant, f"rt{name}", topic.msgtype)
    wait_until(lambda: len(writing.get_matched_subscriptions()) == 2)
    withdraw()
    withdraw()
    wait_until(lambda: len(writing.get_matched_subscriptions()) == 1)
    writing.write(dds_types.Header(dds_types.Time(1, 2), "a"))
    wait_until(lambda: kept)
    assert ended == []
    transport.close()
    withdraw()


@pytest.mark.slow
def test_three_seconds_at_twenty_hertz_lose_nothing():
    found = soak("dds", 3.0, 20.0)
    received = found.received
    assert 10 < found.sent <= 60  # less where the machine is busy: what is late is left out
    assert (received.count, received.damaged, received.disordered) == (found.sent, 0, 0)


def test_a_soak_in_which_nothing_arrives_is_reported(monkeypatch, capsys):
    nothing = Received(0, 0, 0, None, np.zeros(0), Memory(1.0).growth())
    monkeypatch.setattr("tools.soak_ros.soak", lambda *_: Soak(9, 0, 100, nothing, 0.0, 0.0))
    monkeypatch.setattr(sys, "argv", ["soak_ros", "--transport", "dds"])
    soak_ros.main()
    lines = "9 sent, 0 received, 9 lost; 0 left out as too late\n0 damaged, 0 out of order\npublish: "
    assert lines in capsys.readouterr().out


# ---- quality of service -----------------------------------------------------------------------------


def offer_of(transport, participant, topic):
    """Return what DDS tells other programs of the transport's writer of a topic."""
    transport.advertise(topic)
    told = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    found = wait_until(lambda: [each for each in told.take(100) if each.topic_name == f"rt{topic.name}"])
    return found[0]


@pytest.mark.parametrize(
    ("policies", "reliability", "durability"),
    [
        ({}, Policy.Reliability.Reliable(0), Policy.Durability.Volatile),
        ({"reliable": False}, Policy.Reliability.BestEffort, Policy.Durability.Volatile),
        ({"latched": True}, Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal),
    ],
    ids=["reliable", "best_effort", "latched"],
)
def test_a_topic_is_offered_as_ros_offers_it(
    open_transport, participant, name, policies, reliability, durability
):
    topic = topic_of(name, "tf2_msgs/msg/TFMessage", **policies)
    offer = offer_of(open_transport(), participant, topic)
    assert offer.type_name == "tf2_msgs::msg::dds_::TFMessage_"
    assert offer.qos[Policy.Reliability] == reliability
    assert offer.qos[Policy.Durability] == durability
    assert offer.qos[Policy.DataRepresentation] == Policy.DataRepresentation(True, False)
    assert offer.qos[Policy.Userdata].data == f"typehash={topic.type_hash};".encode()
    assert Policy.Partition not in offer.qos


def test_readers_meet_writers_that_offer_enough(open_transport, participant, name):
    """A best-effort reader takes all; a reliable or a transient local one refuses what offers less."""
    transport = open_transport()
    for policies, asks_too_much in [
        ({"reliable": False}, {"reliable": True}),
        ({"reliable": True}, {"latched": True}),
    ]:
        each = f"{name}_{len(policies)}_{policies['reliable']}"
        topic = topic_of(each, **policies)
        transport.advertise(topic)
        modest = dds_entities.reader(participant, f"rt{each}", topic.msgtype, reliable=False)
        demanding = dds_entities.reader(participant, f"rt{each}", topic.msgtype, **asks_too_much)
        wait_until(lambda: modest.get_matched_publications())  # noqa: B023
        wait_until(lambda: demanding.get_requested_incompatible_qos_status().total_count)  # noqa: B023
        assert demanding.get_matched_publications() == []


def test_a_program_that_writes_another_encoding_alone_is_not_met(open_transport, participant, name):
    arrived = []
    open_transport().subscribe(topic_of(name), arrived.append)
    writing = dds_entities.writer(participant, f"rt{name}", "std_msgs/msg/Header", xcdr2=True)
    wait_until(lambda: writing.get_offered_incompatible_qos_status().total_count)
    assert writing.get_matched_subscriptions() == []


def test_late_subscribers_receive_the_last_latched_message(open_transport, participant, name):
    transport = open_transport()
    topics = [topic_of(f"{name}_{latched}", latched=latched) for latched in (False, True)]
    for topic in topics:
        for number in range(3):
            transport.publish(topic, header_bytes(number), 0)
    arrived = [[], []]
    other = open_transport()
    for topic, messages in zip(topics, arrived, strict=True):
        other.subscribe(topic, messages.append)
    wait_until(lambda: arrived[1])
    for topic in topics:  # what comes next comes after all that was kept
        transport.publish(topic, header_bytes(9), 0)
    wait_until(lambda: received(header_bytes(9)) in arrived[0] and len(arrived[1]) > 1)
    assert arrived == [
        [received(header_bytes(9))],
        [received(header_bytes(2)), received(header_bytes(9))],
    ]


@pytest.mark.slow
def test_a_late_subscriber_receives_the_latched_messages_of_all_writers(open_transport, name):
    """As of /tf_static, which each node with fixed frames writes."""
    topic, arrived = topic_of(name, latched=True, depth=100), []
    for number in range(4):
        open_transport().publish(topic, header_bytes(number), 0)
    late = open_transport()
    holds, is_free = threading.Event(), threading.Event()
    late.subscribe(topic_of(f"{name}_held"), lambda _: (holds.set(), is_free.wait(WAIT_S)))
    with published_meanwhile(open_transport(), topic_of(f"{name}_held")):
        assert holds.wait(WAIT_S)
    late.subscribe(topic, arrived.append)  # whose messages wait for the thread that is held
    time.sleep(1.0)  # until they are there
    is_free.set()
    wait_until(lambda: len(arrived) >= 4)
    assert sorted(arrived) == [received(header_bytes(number)) for number in range(4)]


@pytest.mark.slow
def test_late_nodes_of_another_vendor_receive_the_last_latched_message(
    open_transport, name, vendor, tmp_path
):
    topic, transport, path = topic_of(name, latched=True), open_transport(), tmp_path / "messages"
    for number in range(3):
        transport.publish(topic, header_bytes(number), 0)
    with vendor("read", topic.msgtype, path, 1, "latched") as peer:
        assert peer.stdout.readline() == "1\n"
    assert messages_of(path) == [received(header_bytes(2))]


# ---- programs that come, go, stall and err ----------------------------------------------------------


@pytest.mark.slow
def test_a_reader_that_is_killed_and_returns_receives_again(open_transport, domain, name):
    topic, transport = topic_of(name), open_transport()
    with published_meanwhile(transport, topic):
        for _ in range(2):
            with cyclone_reader(domain, name, topic.msgtype, 1000) as peer:
                first = json.loads(peer.stdout.readline())["stamp"]["sec"]
                assert json.loads(peer.stdout.readline())["stamp"]["sec"] == first + 1
                peer.send_signal(signal.SIGKILL)


@pytest.mark.slow
def test_a_transport_that_disappears_and_returns_is_found_again(open_transport, domain, name):
    topic = topic_of(name)
    with cyclone_reader(domain, name, topic.msgtype, 1000) as peer:
        for number in (100, 200):
            transport = open_transport()
            with published_meanwhile(transport, topic, header_bytes(number)):
                wait_until(lambda: f'"sec": {number}' in peer.stdout.readline())  # noqa: B023
            transport.close()
        Domain(domain, dds_entities.LOOPBACK_URI)  # is free for other code again


@pytest.mark.slow
def test_a_writer_that_dies_and_returns_is_read_again(open_transport, name, vendor, tmp_path):
    path, arrived = tmp_path / "messages", []
    write_messages(path, [header_bytes(1), header_bytes(2)])
    open_transport().subscribe(topic_of(name), arrived.append)
    for _ in range(2):
        with vendor("write", "std_msgs/msg/Header", path, 5) as peer:  # dies without farewell
            assert peer.stdout.readline() == "2\n"
    wait_until(lambda: len(arrived) >= 4)
    assert arrived == [header_bytes(1), header_bytes(2)] * 2


@pytest.mark.slow
def test_a_reader_that_stalls_stalls_nobody(open_transport, domain, name):
    """A stopped program confirms nothing, and gets the last messages when it goes on."""
    topic, transport = topic_of(name, PROJECTED, depth=20), open_transport()
    sent = [message_types().encode(projected_image(number, n_beams=64)) for number in range(50)]
    with cyclone_reader(domain, name, PROJECTED, 1000) as peer:
        with published_meanwhile(transport, topic, sent[0]):
            assert json.loads(peer.stdout.readline())["header"]["stamp"]["sec"] == 0
        peer.send_signal(signal.SIGSTOP)
        for message in sent:
            transport.publish(topic, message, 0)
        peer.send_signal(signal.SIGCONT)
        last = decode(topic, sent[-1]).header.stamp.sec
        wait_until(lambda: json.loads(peer.stdout.readline())["header"]["stamp"]["sec"] == last)


@pytest.mark.slow
def test_a_program_that_stood_still_beyond_its_lease_is_found_again(open_transport, domain, name):
    topic, transport = topic_of(name), open_transport()
    with cyclone_reader(domain, name, topic.msgtype, 1000) as peer:
        with published_meanwhile(transport, topic, header_bytes(100)):
            wait_until(lambda: '"sec": 100' in peer.stdout.readline())
        peer.send_signal(signal.SIGSTOP)
        time.sleep(12.0)  # the lease of Cyclone DDS is 10 s
        peer.send_signal(signal.SIGCONT)
        with published_meanwhile(transport, topic, header_bytes(200)):
            wait_until(lambda: '"sec": 200' in peer.stdout.readline())


def test_a_function_that_fails_does_not_end_the_others(open_transport, name, caplog):
    topics = [topic_of(f"{name}_{number}") for number in range(2)]
    transport, other, arrived = open_transport(), open_transport(), []

    def fail(message):
        raise ValueError("no pose")

    other.subscribe(topics[0], fail)
    other.subscribe(topics[1], arrived.append)
    for number in range(3):
        for topic in topics:
            transport.publish(topic, header_bytes(number), 0)
        wait_until(lambda: len(arrived) > number)  # noqa: B023
    assert [record.message for record in caplog.records] == [
        f"a message of {topics[0].name!r} is lost: the function that receives it fails"
    ]


def test_a_function_may_close_its_transport(open_transport, name):
    topic, transport, other, arrived = topic_of(name), open_transport(), open_transport(), []

    def receive(message):
        arrived.append(message)
        other.close()

    other.subscribe(topic, receive)
    transport.publish(topic, header_bytes(0), 0)
    wait_until(lambda: arrived)
    with pytest.raises(Error, match="it was closed"):
        wait_until(lambda: other.publish(topic, header_bytes(1), 0))


def test_a_function_that_publishes_does_not_hold_up_the_end_of_its_transport(
    open_transport, name, monkeypatch, caplog
):
    patience_s = 20.0
    monkeypatch.setattr(dds_transport, "PATIENCE_S", patience_s)
    transport, other = open_transport(), open_transport()
    is_inside, may_answer = threading.Event(), threading.Event()

    def answer(message):
        is_inside.set()
        assert may_answer.wait(WAIT_S)
        other.publish(topic_of(name + "/answer"), message, 0)

    other.subscribe(topic_of(name), answer)
    transport.publish(topic_of(name), header_bytes(0), 0)
    assert is_inside.wait(WAIT_S)
    closing = threading.Thread(target=other.close)
    began_s = time.monotonic()
    closing.start()
    time.sleep(0.2)  # until it waits for the function
    may_answer.set()
    closing.join(WAIT_S)
    assert time.monotonic() - began_s < patience_s / 2
    assert caplog.messages == []


# ---- fuzzed messages and packets --------------------------------------------------------------------


def fuzzed(dice, message: bytes) -> bytes:
    """Return bytes with random mistakes, or random bytes."""
    kind = dice.randrange(4)
    if kind == 0:
        return dice.randbytes(dice.randrange(1, 80))
    if kind == 1:
        return message[: dice.randrange(1, len(message))]
    changed = bytearray(message)
    for _ in range(dice.randrange(1, 8)):
        changed[dice.randrange(len(changed))] = dice.randrange(256)
    if kind == 3:  # a length or count that is far too great
        at = dice.randrange(0, len(changed) - 4, 4)
        changed[at : at + 4] = dice.choice([b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x10"])
    return bytes(changed)


@pytest.mark.slow
@pytest.mark.parametrize("n", [100, 100_000])
def test_wrong_messages_of_another_vendor_do_no_harm(open_transport, name, vendor, tmp_path, n):
    """The other vendor's writer sends any bytes; right messages between the wrong ones arrive, in order."""
    dice, topic = random.Random(n), topic_of(name, "tf2_msgs/msg/TFMessage", depth=n)
    right = message_types().encode(transforms(3))
    path, arrived = tmp_path / "messages", []
    # the number of a right message is in its first time stamp, behind the header and the count
    numbered = [right[:8] + LENGTH.pack(number) + right[12:] for number in range(n // 10)]
    # the header and whole words are the business of DDS itself; the next test has packets without
    other = message_types().encode(transforms(2))
    wrong = [received(other[:4] + fuzzed(dice, other[4:])) for _ in range(n)]
    sent = [numbered[at // 10] if at % 10 == 9 else wrong[at] for at in range(n)]
    write_messages(path, sent)
    transport = open_transport()
    transport.subscribe(topic, arrived.append)
    own = topic_of(f"{name}_own")
    with published_meanwhile(transport, own):
        with vendor("write", topic.msgtype, path, 0) as peer:
            assert peer.stdout.readline() == f"{n}\n"
        wait_until(lambda: numbered[-1] in arrived[-20:])
    kept = set(numbered)
    assert [message for message in arrived if message in kept] == numbered
    # what has come of the others has the layout of its type
    assert len(arrived) < n
    for message in set(arrived[:300]) - kept:
        try:
            decode(topic, message)
        except SerdeError as why:
            assert "utf-8" in str(why)  # DDS does not look into text


def announcement(domain) -> bytes:
    """Return a packet by which a participant of this machine announces itself."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(("", 7400 + 250 * domain))
        group = socket.inet_aton("239.255.0.1") + socket.inet_aton("127.0.0.1")
        listening.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        listening.settimeout(WAIT_S)
        return listening.recv(65536)


def fuzzed_packet(dice, known: bytes) -> bytes:
    """Return a packet of a participant with random mistakes, or one in its name with random submessages."""
    if dice.randrange(2):
        return fuzzed(dice, known)
    packet = known[:20]  # protocol, version, vendor, and who sends
    for _ in range(dice.randrange(1, 4)):
        kind = dice.choice([0x06, 0x07, 0x08, 0x09, 0x0E, 0x12, 0x13, 0x15, 0x16, dice.randrange(256)])
        body = bytearray(dice.randbytes(dice.randrange(64)))
        entities = bytes.fromhex(dice.choice(["000100c7000100c2", "000003c7000003c2", "000004c7000004c2"]))
        at = 4 if kind in (0x15, 0x16) else 0  # data has flags and an offset first
        body[at : at + 8] = entities
        length = dice.choice([len(body), len(body), dice.randrange(65536)])
        packet += struct.pack("<BBH", kind, dice.randrange(256) | 1, length) + body
    return packet


@pytest.mark.slow
@pytest.mark.parametrize("n", [2000, 100_000])
def test_wrong_packets_neither_end_nor_stall_a_publisher(open_transport, domain, name, n):
    dice, topic, transport = random.Random(n), topic_of(name), open_transport()
    first = 7400 + 250 * domain
    ports = [first, first + 1, *(first + 10 + number for number in range(4))]
    known = announcement(domain)
    poses, arrived = topic_of(f"{name}_poses"), []
    transport.subscribe(poses, arrived.append)
    with published_meanwhile(transport, topic), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        for number in range(n):
            sending.sendto(fuzzed_packet(dice, known), ("127.0.0.1", dice.choice(ports)))
            if number % 100 == 0:
                time.sleep(0.001)  # otherwise the system drops most
        with cyclone_reader(domain, name, topic.msgtype, 3) as peer:
            assert all(json.loads(peer.stdout.readline()) for _ in range(3))
        with published_meanwhile(open_transport(), poses):
            wait_until(lambda: arrived)


# ---- mistakes of users ------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [-1, 233, 1.5, "0", True])
def test_a_domain_is_a_number_that_has_ports(wrong):
    with pytest.raises(Error, match="the ROS domain must be"):
        DdsTransport(wrong)


def test_the_domain_is_that_of_ros_unless_it_is_given(monkeypatch, domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    for transport in (DdsTransport(), DdsTransport(domain)):
        assert transport.domain == domain
        transport.close()
    monkeypatch.setenv("ROS_DOMAIN_ID", "zero")
    with pytest.raises(Error, match=r"ROS_DOMAIN_ID must be a whole number in 0..232 \(got 'zero'\)"):
        DdsTransport()
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    with pytest.raises(Error, match="ROS_DOMAIN_ID must"):
        DdsTransport()


@pytest.mark.parametrize("wrong", ["nonesuch", "192.0.2.77", 'lo"/>', "", 7])
def test_an_interface_is_one_of_this_machine(domain, wrong):
    with pytest.raises(Error, match="the interface of DDS must be"):
        DdsTransport(domain, wrong)


def test_a_domain_has_one_interface_in_a_process(open_transport, domain):
    open_transport()
    DdsTransport(domain, "lo").close()  # the same by another name
    with pytest.raises(Error, match="a process must use one interface for a DDS domain"):
        DdsTransport(domain, "eth7")


def test_a_domain_of_other_code_is_shared_on_demand(monkeypatch, domain, name, caplog):
    monkeypatch.setenv("CYCLONEDDS_URI", dds_entities.LOOPBACK_URI)
    other = DomainParticipant(domain)
    with pytest.raises(Error, match="must not be open in this process already"):
        DdsTransport(domain)
    transport = DdsTransport(domain, interface=None)
    try:
        reading = dds_entities.reader(other, f"rt{name}", "std_msgs/msg/Header")
        transport.publish(topic_of(name), header_bytes(3), 0)
        assert wait_until(lambda: dds_entities.take(reading))[0].stamp.sec == 3
    finally:
        transport.close()
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert f"DDS domain {domain} is open to the network" in caplog.text


def test_the_loopback_interface_needs_no_warning(open_transport, caplog):
    open_transport()
    assert caplog.records == []


def test_messages_have_the_layout_of_their_type(open_transport, name):
    transport, topic = open_transport(), topic_of(name)
    for wrong in (b"", b"\0\1\0\0", header_bytes(0)[:-4], b"\0\1\0\0" + b"\xff" * 40):
        with pytest.raises(Error, match=f"a message of '{name}' must be a std_msgs/msg/Header in CDR"):
            transport.publish(topic, wrong, 0)
    transport.publish(topic, header_bytes(0), 0)


def test_a_forked_process_leaves_its_parents_transport_alone(open_transport, name):
    transport, topic = open_transport(), topic_of(name)
    transport.advertise(topic)
    assert in_fork(lambda: transport.publish(topic, header_bytes(0), 0), transport.close) == [
        "a DdsTransport must be used in the process that made it; make one in each process",
        "done",
    ]
    transport.publish(topic, header_bytes(0), 0)


def test_a_topic_has_one_type_and_a_name(open_transport, name):
    transport = open_transport()
    transport.advertise(topic_of(name))
    had = f"got tf2_msgs/msg/TFMessage for {name!r}, which had std_msgs/msg/Header before"
    other = topic_of(name, "tf2_msgs/msg/TFMessage")
    assert error_of(transport.subscribe, other, print) == f"a topic must have one type ({had})"
    with pytest.raises(Error, match="which had std_msgs/msg/Header before, with another definition"):
        transport.advertise(Topic(name, "std_msgs/msg/Header", "", "string frame_id"))
    with pytest.raises(Error, match="must be a name that DDS allows"):
        transport.advertise(topic_of("/two words"))
    with pytest.raises(Error, match="its definition is not understood"):
        transport.advertise(Topic(name, "std_msgs/msg/WString", "", "wstring data"))


def test_transports_of_a_process_make_one_topic_at_a_time(open_transport, name, monkeypatch):
    """Cyclone DDS refused one of two that were made at once, of one type, with a "non specific error"."""
    transports, making, most = [open_transport() for _ in range(2)], [], []

    def make(*arguments):
        making.append(arguments)
        most.append(len(making))
        time.sleep(0.2)  # for the other thread to come
        try:
            return DdsTopic(*arguments)
        finally:
            making.pop()

    monkeypatch.setattr(dds_topics, "Topic", make)
    threads = [threading.Thread(target=one.advertise, args=(topic_of(name),)) for one in transports]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1, 1]


def test_a_closed_transport_says_so(open_transport, name):
    transport = open_transport()
    transport.close()
    transport.close()
    for act in (
        lambda: transport.publish(topic_of(name), header_bytes(0), 0),
        lambda: transport.advertise(topic_of(name)),
        lambda: transport.subscribe(topic_of(name), print),
    ):
        with pytest.raises(Error, match="the DDS transport must be open"):
            act()


@pytest.mark.parametrize("module", ["cyclonedds", "rosbags"])
def test_missing_packages_are_an_extra(monkeypatch, domain, module):
    for known in list(sys.modules):
        if known.split(".")[0] == module:
            monkeypatch.delitem(sys.modules, known)
    monkeypatch.setitem(sys.modules, module, None)
    message = error_of(DdsTransport, domain)
    assert message.endswith(install_command("live")) and f"got no module {module}" in message


@pytest.mark.slow
def test_a_program_that_does_not_close_ends_all_the_same(domain):
    program = f"""if True:
        from sonar_gl.ros.dds_transport import DdsTransport
        from tests.support.ros_topics import topic_of
        transport = DdsTransport({domain})
        transport.subscribe(topic_of("/{uuid.uuid4().hex}"), print)
        print("opened")
    """
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=WAIT_S,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "opened\n", "")


# ---- nodes of ROS 2 ----------------------------------------------------------------------------------


@pytest.mark.parametrize("distribution, length", [("jazzy", 16), ("humble", 24)])
def test_a_node_is_announced_with_its_readers_and_writers(domain, name, distribution, length):
    transport = DdsTransport(domain, node="front_sonar", distribution=distribution)
    try:
        other = DomainParticipant(domain)  # knows nothing of the transport
        found = {"reader": {}, "writer": {}}
        builtin = {
            "reader": BuiltinDataReader(other, BuiltinTopicDcpsSubscription),
            "writer": BuiltinDataReader(other, BuiltinTopicDcpsPublication),
        }
        discovery = DdsTopic(other, "ros_discovery_info", dds_types.DISCOVERY[distribution])
        reading = DataReader(other, discovery, qos=dds_entities.qos(latched=True, depth=1))
        transport.advertise(topic_of(name, "std_msgs/msg/Header"))
        withdraw = transport.subscribe(topic_of(f"{name}_in", "std_msgs/msg/Header"), print)

        def endpoint(kind, topic):
            for sample in builtin[kind].take(1000):
                found[kind][sample.topic_name] = sample
            return found[kind].get(f"rt{topic}")

        def node_with(n_readers):
            for message in dds_entities.take(reading):
                if list(message.gid.data[:16]) == list(written.participant_key.bytes):
                    assert len(message.gid.data) == length
                    seen.append(message)
            return seen and len(seen[-1].node_entities_info_seq[0].reader_gid_seq) == n_readers

        seen, zeros = [], [0] * (length - 16)
        written = wait_until(lambda: endpoint("writer", name))
        read = wait_until(lambda: endpoint("reader", f"{name}_in"))
        wait_until(lambda: node_with(1))
        (node,) = seen[-1].node_entities_info_seq
        assert (node.node_namespace, node.node_name) == ("/", "front_sonar")
        assert [list(one.data) for one in node.writer_gid_seq] == [list(written.key.bytes) + zeros]
        assert [list(one.data) for one in node.reader_gid_seq] == [list(read.key.bytes) + zeros]
        withdraw()
        wait_until(lambda: node_with(0))
    finally:
        transport.close()
