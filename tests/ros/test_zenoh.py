"""Topics of ROS 2 over zenoh, exchanged with programs that use zenoh as rmw_zenoh does, at 127.0.0.1 only."""

import random
import re
import socket
import sys
import threading
import time
import warnings
from contextlib import ExitStack

import pytest
import zenoh

from sonar_gl.core.errors import Error, MachineError
from sonar_gl.ros.messages import message_types
from sonar_gl.ros.rmw_zenoh import PUBLISHER, SUBSCRIPTION, RosNode, attachment, quality_text
from sonar_gl.ros.transport import Topic
from sonar_gl.ros.zenoh_transport import REMOTE_TIMEOUT_MS, ZenohTransport
from tests.support.forks import in_fork
from tests.support.listening import LOOPBACK, listening_ports
from tests.support.live_messages import (
    free_port,
    open_session,
    ping_message,
    sonar_topic,
    stamped,
    zenoh_router,
)
from tests.support.ros_decoders import DECODERS, by_rosbags, check_projected_image
from tests.support.ros_topics import topic_of
from tests.support.waiting import wait_until
from tests.support.zenoh_reader import reading
from tools.soak_ros import soak

# rmw_zenoh's design document, "Graph Cache": examples of demo_nodes_cpp
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
LISTENER = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
LISTENERS_SUBSCRIPTION = (
    f"@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/{CHATTER}/::,10:,:,:,,"
)
TALKERS_PUBLISHER = f"@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/{CHATTER}/::,7:,:,:,,"
TOKENS = "@ros2_lv/**"
TIME_NS = 1_700_000_000_123_456_789
IMAGE_KEY = "sonar/image/sensor_msgs::msg::dds_::Image_"


@pytest.fixture
def port():
    """Return a port for a router."""
    return free_port()


@pytest.fixture
def router(port):
    """Run a router."""
    with zenoh_router(port) as session:
        yield session


@pytest.fixture
def transports(port):
    """Make transports of 127.0.0.1 that are closed in the end."""
    with ExitStack() as stack:

        def make(host="127.0.0.1", **settings):
            one = ZenohTransport(f"tcp/{host}:{port}", **settings)
            stack.callback(one.close)
            return one

        yield make


@pytest.fixture
def peer(port, router):
    """Open a session as a program with rmw_zenoh has it."""
    with open_session("peer", [f"tcp/127.0.0.1:{port}"], ["tcp/127.0.0.1:0"]) as session:
        yield session


def tokens_of(session) -> set:
    return {str(reply.ok.key_expr) for reply in session.liveliness().get(TOKENS)}


def image_topic(**quality) -> Topic:
    return topic_of("/sonar/image", "sensor_msgs/msg/Image", **quality)


# ---- names and numbers --------------------------------------------------------------------------------


def test_tokens_and_keys_are_those_of_the_design_document():
    definition, digest = message_types().schema("std_msgs/msg/String")
    assert digest == STRING_HASH
    chatter = Topic("/chatter", "std_msgs/msg/String", digest, definition, depth=10)
    listener, talker = RosNode("listener", 2), RosNode("talker", 2)
    session = "aac3178e146ba6f1fc6e6a4085e77f21"
    assert listener.token(session) == LISTENER
    assert listener.entity_token(session, 10, SUBSCRIPTION, chatter) == LISTENERS_SUBSCRIPTION
    published = Topic("/chatter", "std_msgs/msg/String", digest, definition, depth=7)
    session = "8b20917502ee955ac4476e0266340d5c"
    assert talker.entity_token(session, 10, PUBLISHER, published) == TALKERS_PUBLISHER
    assert talker.key(chatter) == f"2/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert RosNode("talker", 0, type_hashes=False).key(chatter) == (
        "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    )


@pytest.mark.parametrize(
    ("quality", "text"),
    [
        # enumerators of rmw/types.h: best effort 2, transient local 1; defaults, among them depth 42, are empty
        ({}, "::,5:,:,:,,"),
        ({"reliable": False}, "2::,5:,:,:,,"),
        ({"latched": True, "depth": 1}, ":1:,1:,:,:,,"),
        ({"reliable": False, "latched": True, "depth": 42}, "2:1:,:,:,:,,"),
    ],
)
def test_quality_of_service_in_tokens(quality, text):
    assert quality_text(Topic("/a", "std_msgs/msg/String", "", "", **quality)) == text


def test_an_attachment_has_the_bytes_of_the_design_document():
    # 8 bytes for the number, 8 for the time, 1 for the length of the GID, 16 for the GID, little endian
    expected = "0201000000000000efcdab896745230110000102030405060708090a0b0c0d0e0f"
    assert attachment(0x102, 0x0123456789ABCDEF, bytes(range(16))).hex() == expected


WRONG_NAME = "Topic.name must be the full name of a topic: words of letters, digits and single _"


@pytest.mark.parametrize(
    ("name", "msgtype", "why"),
    [
        ("sonar/image", "sensor_msgs/msg/Image", WRONG_NAME),
        ("/sonar/**", "sensor_msgs/msg/Image", WRONG_NAME),
        ("/sonar__image", "sensor_msgs/msg/Image", WRONG_NAME),
        ("/sonar//image", "sensor_msgs/msg/Image", WRONG_NAME),
        ("/a", "sensor_msgs/Image", "the type of /a must be like 'sensor_msgs/msg/Image'"),
        ("/a", "*/msg/Image", "the type of /a must be like 'sensor_msgs/msg/Image'"),
    ],
)
def test_names_that_ros_does_not_allow_are_refused(name, msgtype, why):
    with pytest.raises(Error, match=re.escape(why)):
        RosNode("talker").key(Topic(name, msgtype, STRING_HASH, ""))


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"connect": "banana"}, "the address of a zenoh router must be like 'tcp/127.0.0.1:7447'"),
        ({"connect": "tcp/127.0.0.1"}, "must be like 'tcp/127.0.0.1:7447'"),
        ({"connect": "tcp/127.0.0.1:70000"}, "must be like 'tcp/127.0.0.1:7447'"),
        ({"connect": "tcp/127.0.0.1:0"}, "must be like 'tcp/127.0.0.1:7447'"),
        ({"connect": "udp/127.0.0.1:7447"}, "must be like 'tcp/127.0.0.1:7447'"),
        ({"connect": None}, "must be like 'tcp/127.0.0.1:7447' (got None)"),
        ({"domain": 233}, "the ROS domain must be a whole number in 0..232 (got 233; as in ROS_DOMAIN_ID)"),
        ({"domain": "1"}, "the ROS domain must be a whole number in 0..232"),
        ({"node": "my sonar"}, "must have letters, digits and '_' only, and begin with no digit"),
        ({"node": "2nd"}, "begin with no digit (got '2nd')"),
        ({"node": ""}, "begin with no digit (got '')"),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(settings, why):
    with pytest.raises(Error, match=re.escape(why)):
        ZenohTransport(**settings)


def test_the_error_without_the_extra_says_how_to_add_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)  # as if it were not installed
    with pytest.raises(Error, match=r"zenoh needs eclipse-zenoh \(got no module zenoh\).*\.\[live\]"):
        ZenohTransport()


# ---- loopback -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("type_hashes", [pytest.param(True, id="jazzy"), pytest.param(False, id="humble")])
def test_another_program_receives_pings(port, router, transports, type_hashes):
    topic, (ping, message) = sonar_topic(), ping_message(64, 300)
    digest = topic.type_hash if type_hashes else "TypeHashNotSupported"
    typed = f"marine_acoustic_msgs::msg::dds_::ProjectedSonarImage_/{digest}"
    transport = transports(domain=3, node="fls", type_hashes=type_hashes)
    before_ns, sent = time.time_ns(), [stamped(message, TIME_NS + k) for k in range(40)]
    with reading(f"tcp/127.0.0.1:{port}", f"3/sonar/projected_image/{typed}", len(sent)) as program:
        probes = program.connect(lambda probe: transport.publish(topic, probe, 0))
        for one in sent:
            transport.publish(topic, one, TIME_NS)
            time.sleep(0.025)  # forty hertz
        messages = program.messages()
    after_ns = time.time_ns()
    assert [one["key"] for one in messages] == [f"3/sonar/projected_image/{typed}"] * len(sent)
    received = [bytes.fromhex(one["payload"]) for one in messages]
    assert received == sent
    for k, one in enumerate(received[:5]):
        for decode in DECODERS:
            check_projected_image(decode(topic, one), ping, TIME_NS + k)

    attached = [bytes.fromhex(one["attachment"]) for one in messages]
    numbers = [int.from_bytes(one[:8], "little") for one in attached]
    times_ns = [int.from_bytes(one[8:16], "little") for one in attached]
    assert numbers == list(range(probes + 1, probes + 1 + len(sent)))  # the first message has number 1
    assert [before_ns, *times_ns, after_ns] == sorted([before_ns, *times_ns, after_ns])
    assert {one[16:17] for one in attached} == {b"\x10"} and {len(one) for one in attached} == {33}
    assert len({one[17:] for one in attached}) == 1

    session = transport.session_id
    assert tokens_of(router) == {
        f"@ros2_lv/3/{session}/0/0/NN/%/%/fls",
        f"@ros2_lv/3/{session}/0/1/MP/%/%/fls/%sonar%projected_image/{typed}/::,5:,:,:,,",
    }


def test_a_topic_has_one_type(router, transports):
    transport = transports()
    transport.advertise(image_topic())
    transport.advertise(image_topic(depth=7))
    with pytest.raises(Error, match="a topic must have one type"):
        transport.publish(topic_of("/sonar/image", "tf2_msgs/msg/TFMessage"), b"", 0)


def test_a_forked_process_leaves_its_parents_transport_alone(router, transports):
    transport, topic = transports(), image_topic()
    transport.advertise(topic)
    assert in_fork(lambda: transport.publish(topic, b"image", 0), transport.close) == [
        "a ZenohTransport must be used in the process that made it; make one in each process",
        "done",
    ]
    transport.publish(topic, b"image", 0)


@pytest.mark.slow
def test_each_publisher_has_a_gid_of_its_own(peer, transports):
    first, second = image_topic(), topic_of("/clock", "rosgraph_msgs/msg/Clock")
    transport, other = transports(), transports(node="other")
    gids = {}
    kept = peer.declare_subscriber(
        "0/**", lambda sample: gids.setdefault(sample.payload.to_bytes(), sample.attachment.to_bytes()[17:])
    )

    def publish():
        transport.publish(first, b"a", 0)
        transport.publish(second, b"b", 0)
        other.publish(first, b"c", 0)
        return len(gids) == 3

    wait_until(publish)
    assert set(gids) == {b"a", b"b", b"c"} and len(set(gids.values())) == 3
    kept.undeclare()


def publish_once(transport, topic, message):
    transport.publish(topic, message, 0)
    return True


@pytest.mark.slow
def test_a_late_program_receives_the_last_message_of_a_latched_topic(port, router, transports):
    topic = topic_of("/tf_static", "tf2_msgs/msg/TFMessage", latched=True, depth=1)
    transport = transports()
    for message in (b"first", b"second", b"last"):
        transport.publish(topic, message, 0)
    key = f"0/tf_static/tf2_msgs::msg::dds_::TFMessage_/{topic.type_hash}"
    with reading(f"tcp/127.0.0.1:{port}", key, 1, "latched") as program:
        (late,) = program.messages()
    assert bytes.fromhex(late["payload"]) == b"last"
    assert int.from_bytes(bytes.fromhex(late["attachment"])[:8], "little") == 3
    received = []
    transports(node="other").subscribe(topic, received.append)
    wait_until(lambda: received)
    assert received == [b"last"]


@pytest.mark.slow
def test_a_topic_that_is_not_latched_keeps_nothing_for_late_programs(port, router, transports):
    topic, received = image_topic(), []
    transport = transports()
    transport.publish(topic, b"early", 0)
    transports(node="other").subscribe(topic, received.append)
    wait_until(lambda: publish_once(transport, topic, b"later") and received)
    assert set(received) == {b"later"}


@pytest.mark.slow
def test_a_topic_does_not_wait_for_another_one(router, transports, monkeypatch):
    """As /clock for a ping that the network takes in slowly."""
    transport, holds, is_free = transports(), threading.Event(), threading.Event()

    def held(number, *arguments):
        if threading.current_thread() is not threading.main_thread():
            holds.set()
            assert is_free.wait(60.0)
        return attachment(number, *arguments)

    monkeypatch.setattr("sonar_gl.ros.zenoh_transport.attachment", held)
    slow = threading.Thread(target=transport.publish, args=(image_topic(), b"slow", 0))
    slow.start()
    assert holds.wait(60.0)
    transport.publish(topic_of("/clock", "rosgraph_msgs/msg/Clock"), b"quick", 0)
    assert slow.is_alive()
    is_free.set()
    slow.join()


# ---- messages of other programs -----------------------------------------------------------------------


def test_messages_of_other_programs_arrive_and_ones_own_do_not(peer, router, transports):
    topic = topic_of("/odom", "nav_msgs/msg/Odometry", reliable=False, depth=100)
    received, own, transport = [], [], transports()
    transport.subscribe(topic, received.append)
    transports(node="same").subscribe(topic, own.append)
    session = transport.session_id
    key = f"0/odom/nav_msgs::msg::dds_::Odometry_/{topic.type_hash}"
    token = f"@ros2_lv/0/{session}/0/1/MS/%/%/sonar_gl/%odom/{key.partition('odom/')[2]}/2::,100:,:,:,,"
    wait_until(lambda: token in tokens_of(router))
    publisher = peer.declare_publisher(key)
    wait_until(lambda: publisher.put(b"probe", attachment=attachment(1, 2, bytes(16))) or received)
    received.clear()
    for k in range(5):
        publisher.put(b"%d" % k, attachment=attachment(k, 0, bytes(16)))
    publisher.put(b"bare")  # a program without rmw_zenoh attaches nothing
    wait_until(lambda: b"bare" in received)
    assert [one for one in received if one != b"probe"] == [b"0", b"1", b"2", b"3", b"4", b"bare"]
    own.clear()
    received.clear()
    wait_until(lambda: publish_once(transport, topic, b"mine") and b"mine" in own)
    assert not received


@pytest.mark.slow
def test_a_subscription_is_withdrawn(peer, router, transports):
    topic, ended, kept, transport = topic_of("/odom", "nav_msgs/msg/Odometry"), [], [], transports()
    before = set(threading.enumerate())
    withdraw = transport.subscribe(topic, ended.append)
    (thread,) = (one for one in set(threading.enumerate()) - before if one.name == "inbox /odom")
    transport.subscribe(topic, kept.append)
    wait_until(lambda: len(tokens_of(router)) == 3)
    withdraw()
    withdraw()
    wait_until(lambda: len(tokens_of(router)) == 2)
    publisher = peer.declare_publisher(f"0/odom/nav_msgs::msg::dds_::Odometry_/{topic.type_hash}")
    wait_until(lambda: publisher.put(b"probe") or kept)
    assert ended == [] and not thread.is_alive() and transport.dropped == 0
    other = transport.subscribe(topic, ended.append)
    transport.close()
    other()


@pytest.mark.slow
def test_a_reader_that_raises_does_not_end_the_messages(peer, router, transports, caplog):
    topic, received = topic_of("/odom", "nav_msgs/msg/Odometry"), []

    def receive(message):
        received.append(message)
        raise ValueError("no odometry")

    transports().subscribe(topic, receive)
    publisher = peer.declare_publisher(f"0/odom/nav_msgs::msg::dds_::Odometry_/{topic.type_hash}")
    wait_until(lambda: publisher.put(b"probe") or len(received) > 3)
    assert len(caplog.records) == 1


@pytest.mark.slow
@pytest.mark.parametrize("count", [3_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_random_messages_and_attachments_stall_nothing(peer, router, transports, count):
    poses, images, rng = topic_of("/odom", "nav_msgs/msg/Odometry"), image_topic(), random.Random(1)
    transport, read, seen = transports(), [], []

    def receive(message):
        read.append(message == b"good" or by_rosbags(poses, message))  # raises, as a careless reader does

    transport.subscribe(poses, receive)
    kept = peer.declare_subscriber(
        f"0/{IMAGE_KEY}/{images.type_hash}", lambda s: seen.append(s.payload.to_bytes())
    )
    publisher = peer.declare_publisher(f"0/odom/nav_msgs::msg::dds_::Odometry_/{poses.type_hash}")
    wait_until(lambda: publisher.put(b"good") or read)
    wait_until(lambda: publish_once(transport, images, b"probe") and seen)
    for k in range(count):
        header = rng.choice([b"", bytes([0, 1, 0, 0]), bytes([0, 0, 0, 0]), bytes([0, 3, 0, 0])])
        more = {} if k % 3 else {"attachment": rng.randbytes(rng.choice([0, 1, 17, 32, 33, 34, 300]))}
        publisher.put(header + rng.randbytes(rng.choice([0, 1, 3, 8, 60, 720, 5000])), **more)
        if k % 100 == 0:
            transport.publish(images, b"%d" % k, 0)
    last = b"%d" % (100 * ((count - 1) // 100))
    wait_until(lambda: last in seen)
    read.clear()
    wait_until(lambda: publisher.put(b"good") or True in read)
    kept.undeclare()


def test_bytes_that_are_no_zenoh_stall_nothing(peer, router, transports):
    topic, seen, rng = image_topic(), [], random.Random(2)
    before = listening_ports()
    transport = transports()
    ((_, port),) = listening_ports() - before
    kept = peer.declare_subscriber(
        f"0/{IMAGE_KEY}/{topic.type_hash}", lambda s: seen.append(s.payload.to_bytes())
    )
    for k in range(200):
        with socket.create_connection(("127.0.0.1", port), 10.0) as connection:
            data = rng.randbytes(rng.choice([0, 1, 40, 60_000]))
            # every second one begins with its length, as zenoh's do
            connection.sendall(len(data).to_bytes(2, "little") + data if k % 2 else data)
        transport.publish(topic, b"%d" % k, 0)
    wait_until(lambda: publish_once(transport, topic, b"last") and b"last" in seen)
    kept.undeclare()


def test_it_listens_at_127_0_0_1_only(router, transports):
    before = listening_ports()
    transports()
    ((address, _),) = listening_ports() - before
    assert address == LOOPBACK
    before = listening_ports()
    transports(host="0.0.0.0")  # this machine, by an address that does not say so: it is a client
    assert listening_ports() <= before  # servers of tests before this may end meanwhile


# ---- routers that come and go -------------------------------------------------------------------------


# by 0.0.0.0 the transport reaches this machine as if it were another one: it is a client, and all goes by the router
@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_router_that_disappears_and_returns(port, transports, host):
    topic, received, fixed = image_topic(), [], []
    latched = topic_of("/tf_static", "tf2_msgs/msg/TFMessage", latched=True, depth=1)
    with zenoh_router(port) as first:
        transport, reader = transports(host), transports(node="reader")
        transport.publish(latched, b"old", 0)
        reader.subscribe(topic, received.append)
        reader.subscribe(latched, fixed.append)
        wait_until(lambda: publish_once(transport, topic, b"before") and received and fixed)
        tokens = tokens_of(first)
    assert len(tokens) == 6 and fixed == [b"old"]
    received.clear()
    publish_once(transport, latched, b"new")
    for _ in range(20 if host == "127.0.0.1" else 100):
        transport.publish(topic, b"meanwhile", 0)
        time.sleep(0.01)
    # peers stay connected with one another; a client reaches nobody. What was sent before may arrive late
    assert (b"meanwhile" in received) == (host == "127.0.0.1")
    with zenoh_router(port) as second:
        wait_until(lambda: publish_once(transport, topic, b"after") and b"after" in received)
        wait_until(lambda: tokens_of(second) == tokens)
        wait_until(lambda: b"new" in fixed)
    assert fixed == [b"old", b"new"]


@pytest.mark.slow
def test_without_a_router_at_the_start_it_warns_and_waits(port, transports):
    topic, received = image_topic(), []
    with pytest.warns(UserWarning, match=f"no zenoh router answers at tcp/127.0.0.1:{port}") as noticed:
        transport = transports()
    assert noticed[0].filename == __file__  # of the caller's stack
    transport.publish(topic, b"lost", 0)
    with zenoh_router(port):
        reader = transports(node="reader")
        reader.subscribe(topic, received.append)
        wait_until(lambda: publish_once(transport, topic, b"found") and received)
    assert set(received) == {b"found"}


@pytest.mark.slow
def test_there_is_no_warning_with_a_router(router, transports):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        transports()


@pytest.mark.slow
def test_a_warning_that_is_an_error_leaves_no_session(port, monkeypatch):
    really_open, opened = zenoh.open, []

    def noted(config):
        opened.append(really_open(config))
        return opened[-1]

    monkeypatch.setattr(zenoh, "open", noted)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match="no zenoh router answers"):
            ZenohTransport(f"tcp/127.0.0.1:{port}")
    assert [session.is_closed() for session in opened] == [True]


def test_a_router_of_another_machine_is_warned_of(router, transports, port):
    with pytest.warns(UserWarning) as noticed:
        transports(host="0.0.0.0")
    assert [str(one.message) for one in noticed] == [
        f"zenoh leaves this machine by the router at tcp/0.0.0.0:{port}: who reaches it can read these topics and send "
        "poses"
    ]
    assert noticed[0].filename == __file__  # of the caller's stack


def test_a_router_of_another_machine_must_answer(port, transports, monkeypatch):
    assert REMOTE_TIMEOUT_MS == 3000  # docs/ros2.md; the test itself waits less
    monkeypatch.setattr("sonar_gl.ros.zenoh_transport.REMOTE_TIMEOUT_MS", 300)
    why = f"a zenoh router must answer at tcp/0.0.0.0:{port} (got no answer in 0.3 s; start it there, or give"
    with pytest.raises(MachineError, match=re.escape(why)):
        transports(host="0.0.0.0")


# ---- the end ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_closed_transport_leaves_nothing(router, transports):
    topic = image_topic()
    before_ports, before = listening_ports(), set(threading.enumerate())
    transport = transports()
    transport.subscribe(topic_of("/odom", "nav_msgs/msg/Odometry"), print)
    transport.publish(topic, b"x", 0)
    wait_until(lambda: len(tokens_of(router)) == 3)
    transport.close()
    transport.close()
    wait_until(lambda: not tokens_of(router))
    assert listening_ports() <= before_ports  # servers of tests before this may end meanwhile
    # threads of zenoh that called into Python stay known to it under names of their own
    assert not [one for one in set(threading.enumerate()) - before if one.name.startswith("inbox")]
    for use in (
        lambda: transport.publish(topic, b"x", 0),
        lambda: transport.advertise(topic_of("/new", "std_msgs/msg/String")),
        lambda: transport.subscribe(topic, print),
    ):
        with pytest.raises(Error, match="this ZenohTransport is closed; make a new one"):
            use()


@pytest.mark.slow
def test_ten_seconds_at_twenty_hertz_lose_nothing_and_keep_nothing():
    found = soak("zenoh", 10.0, 20.0)
    check_soak(found, 100, 200)
    # Half of what memory would grow by if each message stayed. In ten seconds buffers still fill: an eighth was seen.
    half = 0.5 * found.message_bytes * 20.0 * 60.0
    assert found.growth < half and found.received.growth < half


@pytest.mark.slow
def test_pings_that_are_made_meanwhile_are_not_lost_either():
    check_soak(soak("zenoh", 5.0, 10.0, "publisher"), 5, 51)


def check_soak(found, least, most):
    """All that was sent has arrived whole and in order."""
    received = found.received
    assert least < found.sent <= most  # less where the machine is busy: what is late is left out
    assert (received.count, found.lost) == (found.sent, 0)
    assert (received.damaged, received.disordered, received.dropped) == (0, 0, 0)
