"""Live topics of ROS 2, decoded by two independent decoders and compared with the ping."""

import copy
import logging
import math
import pickle
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from trimesh.transformations import quaternion_matrix

import sonar_gl as sg
from sonar_gl.core.errors import Error, MachineError
from sonar_gl.gl.driver import CONTEXT_LOST, check_driver
from sonar_gl.ros import PoseSource, Publisher, PublisherSettings
from sonar_gl.ros.messages import BEAMS, message_types
from sonar_gl.ros.publisher import CLOCK_NS, StepResult
from sonar_gl.ros.publisher_settings import TOPICS
from sonar_gl.sonar.sonar import Sonar
from tests.support.forks import in_fork
from tests.support.loopback_transport import LoopbackTransport
from tests.support.pose_messages import odometry, pose_stamped, transforms
from tests.support.waiting import WAIT_S

SONAR = Sonar("tilted", 900e3, 8, 40, 60.0, 20.0, 2.0, 0.7, 4.7, tilt_deg=10.0, ping_rate_max_hz=15.0)
ACOUSTICS = sg.Acoustics.ideal()
NOISE = sg.Noise(gaussian=1e-3)
AT = sg.pose(0.5, -0.25, -2, 0.1, -0.05, 0.3)
MOUNT = (0.4, 0.1, -0.3, 0.0, 0.3, 0.0)
TIME_S, STAMP = 12.25, (12, 250_000_000)
FLOAT32 = 1e-6  # relative, of one rounding to float32 and of one step of arithmetic


@pytest.fixture(scope="module")
def scene():
    """A ball before a wall, to port."""
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.3), sg.pose(2.5, 1.0, -2), 0.8)
    wall = sg.Body("wall", trimesh.creation.box((0.2, 30, 30)), sg.pose(4.1, 0, 0), 0.05)
    return sg.Scene([ball, wall], AT, "ball and wall")


@pytest.fixture
def loopback():
    return LoopbackTransport()


def publisher_of(scene, *transports, in_background=False, **settings):
    return Publisher(scene, SONAR, transports, ACOUSTICS, NOISE, PublisherSettings(**settings), in_background)


def by_rosbags(topic, data):
    return message_types().decode(data, topic.msgtype)


def by_mcap(topic, data):
    """Decode by the definition that the topic brings along."""
    schema = Schema(id=1, data=topic.definition.encode(), encoding="ros2msg", name=topic.msgtype)
    return DecoderFactory().decoder_for("cdr", schema)(data)


def test_a_publisher_refuses_to_be_copied(scene, loopback):
    with publisher_of(scene, loopback) as publisher:
        for take in (copy.copy, copy.deepcopy, pickle.dumps):
            with pytest.raises(Error, match="a Publisher cannot be copied or pickled"):
                take(publisher)


DECODERS = pytest.mark.parametrize("decode", [by_rosbags, by_mcap])


@pytest.fixture(scope="module")
def sent(scene):
    """Return the ping of the first step, its points, and (topic, bytes) of what was published, by name."""
    transport = LoopbackTransport()
    settings = {"vehicle_frame": "base_link", "mount": MOUNT, "image_height": 64, "seed": 7}
    vehicle = AT @ np.linalg.inv(sg.pose(*MOUNT))
    with publisher_of(scene, transport, points_columns=16, points_rows=5, **settings) as publisher:
        assert publisher.step(TIME_S, vehicle) == StepResult(has_pinged=True)
    with sg.Simulator(scene, SONAR, ACOUSTICS, tolerance=0.05) as simulator:
        at = vehicle @ sg.pose(*MOUNT)
        ping = simulator.ping(at, NOISE, 7, ping_number=0, time_s=TIME_S)
        points = simulator.point_cloud(at, 16, 5)
    assert {time_ns for _, _, time_ns in transport.sent} == {12_250_000_000}
    assert len(transport.sent) == 7
    return ping, points, {topic.name: (topic, data) for topic, data, _ in transport.sent}


def decoded(sent, name, decode):
    message = decode(*sent[2][name])
    if hasattr(message, "header"):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == STAMP
    return message


def check_info(message, image):
    info = message.ping_info
    speed_m_s = np.float32(ACOUSTICS.water.sound_speed())
    assert (info.frequency, np.float32(info.sound_speed)) == (900e3, speed_m_s)
    np.testing.assert_array_equal(np.float32(info.tx_beamwidths), np.full(8, np.radians(20), np.float32))
    np.testing.assert_array_equal(np.float32(info.rx_beamwidths), np.full(8, np.radians(2), np.float32))
    assert (image.is_bigendian, image.dtype, image.beam_count) == (False, 0, 8)


def counts_port_first(ping):
    """Return the counts (K, B), range by range, beams from port to starboard."""
    return ping.counts()[::-1].T


@DECODERS
def test_projected_image(sent, decode):
    ping, message = sent[0], decoded(sent, "/sonar/projected_image", decode)
    assert message.header.frame_id == "sonar_beams"
    check_info(message, message.image)
    azimuth = ping.azimuth_rad[::-1]
    directions = np.array([[d.x, d.y, d.z] for d in message.beam_directions])
    expected = np.stack([0 * azimuth, np.sin(azimuth), np.cos(azimuth)], axis=1)
    np.testing.assert_allclose(directions, expected, atol=1e-15)
    np.testing.assert_array_equal(np.float32(message.ranges), ping.range_m.astype(np.float32))
    assert bytes(message.image.data) == counts_port_first(ping).tobytes()
    assert counts_port_first(ping).std() > 10  # there is something to compare


@DECODERS
def test_raw_image(sent, decode):
    ping, message = sent[0], decoded(sent, "/sonar/raw_image", decode)
    assert message.header.frame_id == "sonar_beams"
    check_info(message, message.image)
    # bins of 0.1 m from 0.7 m on
    assert (message.samples_per_beam, message.sample0) == (40, 7)
    assert message.sample_rate == pytest.approx(ACOUSTICS.water.sound_speed() / 0.2, rel=FLOAT32)
    samples = message.sample0 + np.arange(message.samples_per_beam)
    range_m = (samples + 0.5) * message.ping_info.sound_speed / (2 * message.sample_rate)
    np.testing.assert_allclose(range_m, ping.range_m, rtol=FLOAT32)
    np.testing.assert_array_equal(message.tx_delays, np.zeros(8))
    np.testing.assert_array_equal(message.tx_angles, np.zeros(8))
    # with y to port, atan2(-y, z) is positive to starboard
    np.testing.assert_array_equal(np.float32(message.rx_angles), -ping.azimuth_rad[::-1].astype(np.float32))
    assert bytes(message.image.data) == counts_port_first(ping).tobytes()


@DECODERS
def test_angles_of_raw_beams_are_those_of_projected_ones(scene, decode):
    for y_sign in BEAMS:
        transport = LoopbackTransport()
        with publisher_of(scene, transport, y_sign=y_sign, topics={"points": None}) as publisher:
            publisher.step(0.0)
        found = {topic.name: decode(topic, data) for topic, data, _ in transport.sent}
        directions = found["/sonar/projected_image"].beam_directions
        angles = [math.atan2(-d.y, d.z) for d in directions]
        np.testing.assert_allclose(found["/sonar/raw_image"].rx_angles, angles, rtol=FLOAT32)


@DECODERS
def test_image(sent, decode):
    ping, message = sent[0], decoded(sent, "/sonar/image", decode)
    law = ping.counts_law()
    picture = law.counts_of(sg.fan_image(ping, 64, law))
    assert (message.height, message.width) == picture.shape and message.height == 64
    assert (message.encoding, message.is_bigendian, message.step) == ("mono8", 0, message.width)
    assert message.header.frame_id == "sonar_beams"
    assert bytes(message.data) == picture.tobytes()


@DECODERS
def test_points(sent, decode):
    (points, echo), message = sent[1], decoded(sent, "/sonar/points", decode)
    assert message.header.frame_id == "sonar"
    assert (message.height, message.width) == echo.shape and message.height >= 5
    fields = [(field.name, field.offset, field.datatype, field.count) for field in message.fields]
    assert fields == [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("intensity", 12, 7, 1)]
    assert (message.point_step, message.row_step) == (16, 16 * message.width)
    numbers = np.frombuffer(bytes(message.data), "<f4").reshape(*echo.shape, 4)
    assert (message.is_bigendian, message.is_dense) == (False, bool(np.isfinite(numbers).all()))
    np.testing.assert_array_equal(numbers[..., 3], echo.astype(np.float32))
    turn = SONAR.sonar_from_head[:3, :3]
    np.testing.assert_allclose(numbers[..., :3], points @ turn.T, rtol=FLOAT32, atol=FLOAT32)
    # from the head, 10 degrees down, into the housing, and from there into the world: on the ball or the wall
    homogeneous = np.concatenate([numbers[..., :3], np.ones((*echo.shape, 1))], axis=-1).reshape(-1, 4)
    world = (homogeneous @ AT.T)[np.isfinite(homogeneous).all(axis=1), :3]
    on_wall = np.abs(world[:, 0] - 4.0)
    on_ball = np.abs(np.linalg.norm(world - [2.5, 1.0, -2], axis=1) - 0.3)
    # the ball is a mesh of 1280 triangles, flatter than the sphere by up to 0.5 % of its radius
    assert np.all((on_wall < 1e-4) | (on_ball < 2e-3)) and (on_ball < 2e-3).sum() > 2


def test_points_have_about_the_rows_that_are_set_and_the_message_states_how_many(scene, loopback):
    only = {kind: None for kind in TOPICS if kind != "points"}
    settings = PublisherSettings(rate_hz=10.0, topics=only)
    with Publisher(scene, sg.load_sonar("p900-45"), [loopback], ACOUSTICS, settings=settings) as publisher:
        publisher.step(0.0)
    (message,) = loopback.messages("/sonar/points")
    assert (settings.points_rows, settings.points_columns) == (32, 128)
    assert (message.height, message.width) == (36, 128)  # as docs/ros2.md says
    assert message.data.size == 36 * 128 * message.point_step


@DECODERS
def test_frames_lead_from_the_beams_to_the_world(sent, decode):
    static = {link.child_frame_id: link for link in decoded(sent, "/tf_static", decode).transforms}
    (moving,) = decoded(sent, "/tf", decode).transforms
    assert moving.header.frame_id == "world" and moving.child_frame_id == "base_link"
    assert {child: link.header.frame_id for child, link in static.items()} == {
        "sonar": "base_link",
        "sonar_beams": "sonar",
    }

    def matrix(link):
        r, t = link.transform.rotation, link.transform.translation
        out = quaternion_matrix([r.w, r.x, r.y, r.z])
        out[:3, 3] = t.x, t.y, t.z
        return out

    for link in (moving, *static.values()):
        assert (link.header.stamp.sec, link.header.stamp.nanosec) == STAMP
    world_from_sonar = matrix(moving) @ matrix(static["sonar"])
    np.testing.assert_allclose(world_from_sonar, AT, atol=1e-12)
    # the boresight is z of the beams' frame, 10 degrees below x of the housing; y is to port
    turn = matrix(static["sonar_beams"])[:3, :3]
    down = math.radians(10)
    np.testing.assert_allclose(turn @ [0, 0, 1], [math.cos(down), 0, -math.sin(down)], atol=1e-12)
    np.testing.assert_allclose(turn @ [0, 1, 0], [0, 1, 0], atol=1e-12)


def test_publishers_that_share_a_transport_keep_each_others_fixed_frames(scene, loopback):
    """A late subscriber gets the last message alone."""
    other, topics = LoopbackTransport(), {kind: None for kind in TOPICS if kind != "tf"}
    with (
        publisher_of(scene, loopback, name="front", topics=topics) as front,
        publisher_of(scene, loopback, other, name="side", topics=topics) as side,
    ):
        front.step(0.0)
        side.step(1.0)

    def links(transport):
        link = transport.messages("/tf_static")[-1].transforms
        return {one.child_frame_id: (one.header.frame_id, one.header.stamp.sec) for one in link}

    assert links(other) == {"side_beams": ("side", 1)}
    assert links(loopback) == {"front_beams": ("front", 0), "side_beams": ("side", 1)}


def test_without_a_pose_the_sonar_is_where_the_scene_has_it(scene, loopback):
    with publisher_of(scene, loopback, vehicle_frame="base_link", mount=MOUNT) as publisher:
        publisher.step(0.0)
    (link,) = loopback.messages("/tf")[0].transforms
    found = [getattr(link.transform.translation, axis) for axis in "xyz"]
    np.testing.assert_allclose(found, (AT @ np.linalg.inv(sg.pose(*MOUNT)))[:3, 3], atol=1e-12)


def test_a_ping_has_the_time_of_its_step_and_the_number_of_pings_before(scene, loopback):
    """By the bubbles, which rise, and by the noise, as in pings of a simulator."""
    wet = scene.with_more([sg.Bubbles("plume", sg.pose(2, 0.3, -2.6))])
    acoustics, times_s = replace(ACOUSTICS, bubbles=True), (1.25, 2.5)
    with Publisher(wet, SONAR, [loopback], acoustics, NOISE, PublisherSettings()) as publisher:
        for time_s in times_s:
            publisher.step(time_s)
    sent = [bytes(message.image.data) for message in loopback.messages("/sonar/projected_image")]
    with sg.Simulator(wet, SONAR, acoustics, tolerance=0.05) as simulator:
        pings = [simulator.ping(AT, NOISE, 0, ping_number=n, time_s=times_s[n]) for n in (0, 1)]
        assert sent == [counts_port_first(ping).tobytes() for ping in pings]
        other = simulator.ping(AT, NOISE, 0, ping_number=0, time_s=times_s[1])
        assert (other.counts() != pings[0].counts()).any()


def test_a_step_returns_the_ping_that_it_has_published(scene, loopback):
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        pings = [publisher.step(time_s, AT).ping for time_s in (0.0, 0.05, 0.1)]
    assert pings[1] is None
    sent = [bytes(message.image.data) for message in loopback.messages("/sonar/projected_image")]
    assert sent == [counts_port_first(ping).tobytes() for ping in pings[::2]]
    assert [ping.meta["time_s"] for ping in pings[::2]] == [0.0, 0.1]


@pytest.mark.parametrize("missing", [False, True])
def test_points_are_dense_where_each_ray_met_something(missing):
    points = np.ones((2, 3, 3), np.float32)
    points[1, 2] = np.nan if missing else 1.0
    types = message_types()
    message = types.points(types.header(0, "sonar"), points, np.ones((2, 3), np.float32))
    assert message.is_dense is not missing


@DECODERS
def test_clock(sent, decode):
    clock = decoded(sent, "/clock", decode).clock
    assert (clock.sec, clock.nanosec) == STAMP


def test_topics_have_types_hashes_and_qualities(sent):
    topics = {name: topic for name, (topic, _) in sent[2].items()}
    assert {name: topic.msgtype for name, topic in topics.items()} == {
        "/sonar/projected_image": "marine_acoustic_msgs/msg/ProjectedSonarImage",
        "/sonar/raw_image": "marine_acoustic_msgs/msg/RawSonarImage",
        "/sonar/image": "sensor_msgs/msg/Image",
        "/sonar/points": "sensor_msgs/msg/PointCloud2",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/clock": "rosgraph_msgs/msg/Clock",
    }
    assert all(topic.reliable for topic in topics.values())
    assert [name for name, topic in topics.items() if topic.latched] == ["/tf_static"]
    # as `ros2 topic info -v` of ROS 2 Jazzy prints it
    image = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    assert topics["/sonar/image"].type_hash == image
    assert len({topic.type_hash for topic in topics.values()}) == 6  # of seven topics two have one type


def test_topics_are_renamed_and_left_out(scene, loopback):
    topics = {"image": "/fan", "raw_image": None, "points": None, "tf": None, "clock": None}
    with publisher_of(scene, loopback, name="rov/front", topics=topics) as publisher:
        publisher.step(1.0)
    assert {topic.name for topic, _, _ in loopback.sent} == {"/rov/front/projected_image", "/fan"}
    assert set(loopback.topics) == {"/rov/front/projected_image", "/fan"}


def test_a_colour_map_makes_the_image_rgb(scene, loopback):
    with publisher_of(scene, loopback, image_height=32, colormap="viridis") as publisher:
        publisher.step(0.0)
    (message,) = loopback.messages("/sonar/image")
    assert (message.encoding, message.step, len(message.data)) == (
        "rgb8",
        3 * message.width,
        96 * message.width,
    )


# ---- time ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fails", [False, True])
def test_a_ping_is_made_and_not_published_before_time_begins(scene, loopback, monkeypatch, fails):
    """What the first ping would have to compile, or to search, is there when its time comes."""
    real, made = sg.Simulator.ping, []

    def ping(simulator, *arguments, **more):
        made.append(len(loopback.sent))
        if fails and len(made) == 1:
            raise Error("nothing to see from here")
        return real(simulator, *arguments, **more)

    monkeypatch.setattr(sg.Simulator, "ping", ping)
    with publisher_of(scene, loopback) as publisher:
        assert made == [0] and not loopback.sent
        publisher.step(0.0)
        assert len(made) == 2 and publisher.counts.pings == 1 and publisher.counts.failed == 0


def test_the_sonar_keeps_its_own_rate_in_a_faster_loop(scene, loopback):
    with publisher_of(scene, loopback) as publisher:
        assert publisher.rate_hz == 15.0  # sound would allow 160
        results = [publisher.step(k / 1000) for k in range(1001)]
        assert publisher.counts.pings == 16 and publisher.counts.dropped == 0
    pinged_ms = [k for k, result in enumerate(results) if result.has_pinged]
    assert pinged_ms == [math.ceil(k * 1000 / 15 - 1e-9) for k in range(16)]
    stamps = [message.header.stamp for message in loopback.messages("/sonar/projected_image")]
    assert [stamp.sec * 1000 + stamp.nanosec / 1e6 for stamp in stamps] == pinged_ms
    clock = [message.clock for message in loopback.messages("/clock")]
    # in steps of its own, and at each ping
    expected_ns = {*range(0, 10**9 + 1, CLOCK_NS), *(ms * 10**6 for ms in pinged_ms)}
    assert [c.sec * 10**9 + c.nanosec for c in clock] == sorted(expected_ns)


def test_pings_that_come_too_late_are_dropped_and_counted(scene, loopback, caplog):
    with caplog.at_level(logging.INFO), publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        results = [publisher.step(time_s) for time_s in (0.0, 0.35, 0.4, 0.95)]
    assert [result.n_dropped for result in results] == [0, 2, 0, 4]
    assert (publisher.counts.pings, publisher.counts.dropped) == (4, 6)
    assert str(publisher.counts) == "4 pings published, 6 dropped as they came too late"
    assert caplog.messages == []  # a program that wants them has the counts, also after the end


def test_losses_are_reported_while_it_runs(scene, loopback, caplog, monkeypatch):
    monkeypatch.setattr("sonar_gl.ros.publisher.REPORT_S", 0.0)
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        publisher.step(0.0)
        publisher.step(0.05)
        assert caplog.messages == []
        publisher.step(0.3)
        assert caplog.messages == ["2 pings published, 2 dropped as they came too late"]
        publisher.step(0.31)
        assert len(caplog.messages) == 1


def test_messages_that_are_ignored_are_logged_once(scene, loopback, caplog, monkeypatch):
    monkeypatch.setattr("sonar_gl.ros.publisher.REPORT_S", 0.0)
    with publisher_of(scene, loopback, bodies_from="/bodies", rate_hz=10.0) as publisher:
        for k in range(3):
            loopback.inject("/bodies", transforms(("world", "link", AT)))
            publisher.step(k / 10)
        assert publisher.counts.refused == 3
    (message,) = caplog.messages
    assert "child frames must be names of bodies (got 'link')" in message


def test_time_that_jumps_back_begins_anew(scene, loopback):
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        for time_s in (100.0, 100.1, 0.0, 0.05, 0.1):
            publisher.step(time_s)
        assert (publisher.counts.pings, publisher.counts.jumps, publisher.counts.dropped) == (4, 1, 0)
    stamps = [m.header.stamp for m in loopback.messages("/sonar/projected_image")]
    assert [(s.sec, s.nanosec) for s in stamps] == [(100, 0), (100, 10**8), (0, 0), (0, 10**8)]
    assert [m.clock.sec for m in loopback.messages("/clock")] == [100, 100, 0, 0, 0]


def test_another_clock_is_warned_of_once(scene, loopback, caplog):
    types = message_types()
    with publisher_of(scene, loopback) as publisher:
        publisher.step(0.0)
        assert not caplog.messages  # of its own clock
        for k in range(3):
            loopback.inject("/clock", types.encode(types.clock(123 + k)))
            publisher.step((k + 1) / 100)
    (message,) = caplog.messages
    assert message.startswith("another program publishes /clock as well, so that time jumps to and fro")
    assert "(--clock ros)" in message and [m.clock.sec for m in loopback.messages("/clock")] == [0] * 4


def test_the_clock_of_another_is_right_where_this_publishes_none(scene, loopback, caplog):
    types = message_types()
    with publisher_of(scene, loopback, topics={"clock": None}) as publisher:
        publisher.clock()
        for k in range(3):
            loopback.inject("/clock", types.encode(types.clock(k)))
            publisher.step_at(k)
    assert not caplog.messages


class HeldTransport(LoopbackTransport):
    """Holds pings up until it is released."""

    def __init__(self):
        super().__init__()
        self.holds, self.is_free = threading.Event(), threading.Event()

    def publish(self, topic, message, time_ns):
        if topic.name == "/sonar/projected_image":
            self.holds.set()
            assert self.is_free.wait(WAIT_S)
        super().publish(topic, message, time_ns)


def test_in_the_background_a_later_step_returns_the_ping(scene):
    """Once, and the step after one with a mistake if that was the first since it was published."""
    transport = HeldTransport()
    with publisher_of(scene, transport, rate_hz=10.0, in_background=True) as publisher:
        try:
            assert publisher.step(0.0).ping is None
            assert publisher.step(0.01).ping is None  # it is not published yet
        finally:
            transport.is_free.set()
        while not publisher.counts.pings:
            time.sleep(0.001)
        time.sleep(0.05)  # the thread counts a ping shortly before it is done
        with pytest.raises(Error, match="no such body"):
            publisher.step(0.02, bodies={"no such body": None})
        end_s = time.monotonic() + WAIT_S
        while (ping := publisher.step(0.03).ping) is None:
            assert time.monotonic() < end_s
        assert ping.meta["time_s"] == 0.0
        assert publisher.step(0.04).ping is None


def test_in_the_background_a_slow_ping_holds_no_step_up(scene):
    transport = HeldTransport()
    with publisher_of(scene, transport, rate_hz=10.0, in_background=True) as publisher:
        assert publisher.step(0.0).has_pinged
        assert transport.holds.wait(WAIT_S)
        results = [publisher.step(k / 100) for k in range(1, 36)]  # each returns, though nothing is sent
        assert not any(result.has_pinged for result in results)
        # those of 0.1 and 0.2, at the times of the pings after them; that of 0.3 still waits
        assert [k for k, result in enumerate(results, 1) if result.n_dropped] == [20, 30]
        assert publisher.counts.dropped == 2
        clock = [message.clock.nanosec for message in transport.messages("/clock")]
        assert clock == list(range(0, 360_000_000, CLOCK_NS))
        transport.is_free.set()
        while not (result := publisher.step(0.36)).has_pinged:  # until the thread is done
            pass
        assert result.n_dropped == 0  # that of 0.3 is late by less than a period
    assert (publisher.counts.pings, publisher.counts.dropped) == (2, 2)
    stamps = [m.header.stamp.nanosec for m in transport.messages("/sonar/projected_image")]
    assert stamps == [0, 360_000_000]


# ---- poses -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "topic", "make"),
    [
        ("odometry=/odom", "/odom", odometry),
        ("pose=/pose", "/pose", pose_stamped),
        ("tf=base_link", "/tf", lambda matrix: transforms(("world", "base_link", matrix))),
    ],
)
def test_messages_move_the_sonar(scene, loopback, source, topic, make):
    settings = {"pose_from": PoseSource.parse(source), "vehicle_frame": "base_link", "mount": MOUNT}
    vehicle = AT @ np.linalg.inv(sg.pose(*MOUNT))
    with publisher_of(scene, loopback, **settings) as publisher:
        assert publisher.step(0.0) == StepResult(waits_for_pose=True)
        loopback.inject(topic, make(vehicle))
        assert publisher.step(0.001).has_pinged
        loopback.inject(topic, b"\x00\x01\x00\x00nonsense")
        loopback.inject(topic, make(vehicle @ sg.pose(1.0)))
        assert publisher.step(0.101).has_pinged
        assert publisher.counts.refused == 1 and publisher.counts.dropped == 0
    near, far = (np.array(m.image.data).reshape(40, 8) for m in loopback.messages("/sonar/projected_image"))
    with sg.Simulator(scene, SONAR, ACOUSTICS, tolerance=0.05) as simulator:
        first = simulator.ping(AT, NOISE, 0, ping_number=0, time_s=0.001)
    # a quaternion and back: bins that lie at the edge of a count may fall on its other side
    assert np.abs(near.astype(int) - counts_port_first(first)).max() <= 1
    # the beam ahead meets the wall a metre nearer, which is ten bins
    assert near[:, 3].argmax() - far[:, 3].argmax() in (8, 9, 10, 11, 12)
    moving = [m for m in loopback.messages("/tf") if m.transforms[0].child_frame_id == "base_link"]
    # with poses from /tf nothing is sent there, since somebody else does
    assert (
        len([t for t, _, _ in loopback.sent if t.name == "/tf"])
        == (0 if topic == "/tf" else 2)
        == len(moving)
    )
    assert not loopback.topics[topic].reliable or topic == "/tf"


def test_bodies_are_moved_by_messages_and_by_the_caller(scene, loopback):
    aside = sg.pose(2.5, -0.1, -2)
    with publisher_of(scene, loopback, bodies_from="/bodies", rate_hz=10.0) as publisher:
        publisher.step(0.0)
        loopback.inject("/bodies", transforms(("world", "ball", aside), ("world", "boat", aside)))
        publisher.step(0.1)
        publisher.step(0.2, bodies={"ball": None})
        publisher.step(0.3, bodies={"ball": scene.bodies[0].pose})
        assert publisher.counts.refused == 1
    assert seen_balls(loopback, [[2.5, 1, -2], aside[:3, 3]]) == [
        [True, False], [False, True], [False, False], [True, False]
    ]  # fmt: skip


@pytest.mark.parametrize("pings_between", [True, False])
def test_a_model_that_is_placed_takes_along_what_a_step_before_has_moved(scene, loopback, pings_between):
    """Whether or not a ping was due between them: otherwise the two were taken as one, in which parts count."""
    ball, wall = scene.bodies
    scene = sg.Scene(
        [replace(ball, name="rov::ball"), wall], scene.sonar_pose, models={"rov": sg.pose(2.5, 1, -2)}
    )
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        publisher.step(0.0)
        assert (
            publisher.step(0.1 if pings_between else 0.03, bodies={"rov::ball": AT}).has_pinged
            == pings_between
        )
        publisher.step(0.2, bodies={"rov": sg.pose(2.5, -0.1, -2)})
    assert seen_balls(loopback, [[2.5, -0.1, -2]])[-1] == [True]


def seen_balls(loopback, centres):
    """Return for each point cloud whether it has points of a ball of radius 0.3 m at each of some centres."""
    out = []
    for message in loopback.messages("/sonar/points"):
        xyz = np.frombuffer(message.data, "<f4").reshape(-1, 4)[:, :3]
        points = xyz[np.isfinite(xyz).all(axis=1)] @ AT[:3, :3].T + AT[:3, 3]
        out.append([bool(np.linalg.norm(points - centre, axis=1).min() < 0.31) for centre in centres])
    return out


def test_a_body_is_where_the_step_said_though_the_loop_changes_its_array(scene, loopback):
    """A loop that keeps its poses in arrays of its own changes them before the ping takes them."""
    where = sg.pose(2.5, -0.1, -2)
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        publisher.step(0.0)
        publisher.step(0.05, bodies={"ball": where})  # not due yet
        where[1, 3] = 1.0
        publisher.step(0.1)
    assert seen_balls(loopback, [[2.5, -0.1, -2], [2.5, 1, -2]])[-1] == [True, False]


@pytest.mark.parametrize("wrong", [{"boat": AT}, {"ball": 2 * np.eye(4)}, {3: AT}, {"wall": AT, "boat": AT}])
def test_a_mistake_in_bodies_is_raised_by_its_step_and_loses_no_other(scene, loopback, wrong):
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        publisher.step(0.0)
        publisher.step(0.03, bodies={"ball": sg.pose(2.5, -0.1, -2)})
        with pytest.raises(
            Error, match=r"bodies must be bodies of the scene|the pose of body 'ball' must be"
        ):
            publisher.step(0.06, sg.pose(50), wrong)
        assert publisher.step(0.1).has_pinged
    assert seen_balls(loopback, [[2.5, -0.1, -2]])[-1] == [True]


def test_a_model_without_bodies_is_named_as_one_by_its_step(scene, loopback):
    scene = sg.Scene(scene.bodies, scene.sonar_pose, models={"rov": AT})
    message = r"bodies of the scene \(got 'rov', a model without bodies"
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher, pytest.raises(Error, match=message):
        publisher.step(0.06, AT, {"rov": AT})


def test_a_ping_that_fails_at_poses_of_others_is_counted_and_at_the_callers_raised(
    scene, loopback, monkeypatch, caplog
):
    def fail(*_, **__):
        raise Error("no ping there")

    settings = {"pose_from": PoseSource("pose", "/pose"), "rate_hz": 10.0}
    with publisher_of(scene, loopback, **settings) as publisher:
        loopback.inject("/pose", pose_stamped(AT))
        with monkeypatch.context() as patch:
            patch.setattr(sg.Simulator, "ping", fail)
            publisher.step(0.0)
            publisher.step(0.1)
            assert publisher.counts.failed == 2 and caplog.text.count("no ping there") == 1
            with pytest.raises(Error, match="no ping there"):
                publisher.step(0.2, AT)
        publisher.step(0.3)
        assert publisher.counts.pings == 1


def test_a_ping_that_fails_where_messages_moved_bodies_is_counted_though_the_pose_is_the_callers(
    scene, loopback, monkeypatch
):
    def ping(simulator, *_, **__):
        raise Error("no ping with the ball there")

    with publisher_of(scene, loopback, bodies_from="/bodies", rate_hz=10.0) as publisher:
        publisher.step(0.0, AT)
        monkeypatch.setattr(sg.Simulator, "ping", ping)
        loopback.inject("/bodies", transforms(("world", "ball", AT)))
        assert not publisher.step(0.05, AT).has_pinged  # between two pings the body moves,
        assert publisher.step(0.1, AT).has_pinged and publisher.step(0.2, AT).has_pinged  # and stays there
        assert (publisher.counts.pings, publisher.counts.failed) == (1, 2)
        with pytest.raises(Error, match="bodies must be bodies of the scene"):
            publisher.step(0.3, AT, {"boat": AT})


def test_a_lost_context_ends_it_whoevers_poses_they_are(scene, loopback, monkeypatch):
    """Nothing comes of the pings that follow."""

    class Lost:
        def take_errors(self):
            return {CONTEXT_LOST}

    def ping(simulator, *_, **__):
        check_driver(SimpleNamespace(extra=SimpleNamespace(gl=Lost()), extensions=set()))

    message = "must keep the sonar's OpenGL context"
    with publisher_of(scene, loopback, pose_from=PoseSource("pose", "/pose")) as publisher:
        monkeypatch.setattr(sg.Simulator, "ping", ping)
        loopback.inject("/pose", pose_stamped(AT))
        with pytest.raises(MachineError, match=message):
            publisher.step(0.0)
    with pytest.raises(MachineError, match=message):  # by the ping that is not published
        publisher_of(scene, loopback)


def test_a_closed_publisher_receives_nothing(scene, loopback):
    settings = {"pose_from": PoseSource("tf", "rov"), "bodies_from": "/bodies", "topics": {"clock": None}}
    with publisher_of(scene, loopback, **settings) as publisher:
        clock = publisher.clock()
        for name in ("/tf", "/tf_static", "/bodies", "/clock"):
            loopback.inject(name, b"nonsense")
        assert publisher.counts.refused == 4
    for name in ("/tf", "/tf_static", "/bodies", "/clock"):
        loopback.inject(name, b"nonsense")
    assert publisher.counts.refused == 4 and clock.wait(0.0) is None


def test_a_forked_process_leaves_its_parents_publisher_alone(scene, loopback):
    with publisher_of(scene, loopback, rate_hz=10.0) as publisher:
        publisher.step(0.0)
        assert in_fork(lambda: publisher.step(0.1), publisher.close) == [
            "a Publisher must be used in the process that made it; make one in each process",
            "done",
        ]
        assert publisher.step(0.1).has_pinged


# ---- mistakes --------------------------------------------------------------------------------------


def test_wrong_arguments_of_a_step_change_nothing(scene, loopback):
    with publisher_of(scene, loopback) as publisher:
        for arguments, why in (
            ((-1.0,), "a time of ROS must lie in"),
            ((math.nan,), "a time of ROS must lie in"),
            ((0.0, 2 * np.eye(4)), "pose must be a rotation"),
            ((0.0, None, [AT]), "bodies must be a dict"),
            ((0.0, None, {"boat": AT}), "bodies must be bodies of the scene"),
        ):
            with pytest.raises(Error, match=why):
                publisher.step(*arguments)
        assert publisher.step(0.1).has_pinged
    publisher.close()
    with pytest.raises(Error, match="this Publisher is closed"):
        publisher.step(0.2)
    assert not loopback.is_closed


@pytest.mark.parametrize("time_ns", [-1, 0.5, 2**31 * 10**9, None])
def test_times_in_nanoseconds_are_whole_numbers(scene, loopback, time_ns):
    with publisher_of(scene, loopback) as publisher:
        with pytest.raises(Error, match="time_ns must be a whole number in 0"):
            publisher.step_at(time_ns)
        assert not loopback.sent and publisher.step_at(5).has_pinged


@pytest.mark.parametrize(
    ("transports", "why"),
    [
        (LoopbackTransport(), r"must be several, as in \[DdsTransport\(\)\] \(got LoopbackTransport\)"),
        (["dds"], "each of transports must be a Transport"),
    ],
)
def test_transports_are_several(scene, transports, why):
    with pytest.raises(Error, match=why):
        Publisher(scene, SONAR, transports)


def test_the_followed_clock_is_not_published(scene, loopback):
    with (
        publisher_of(scene, loopback) as one,
        pytest.raises(Error, match="must not be published and followed"),
    ):
        one.clock()
    with publisher_of(scene, loopback, topics={"clock": None}) as publisher:
        clock = publisher.clock()
        types = message_types()
        loopback.inject("/clock", types.encode(types.clock(123)))
        assert clock.wait(0.0) == 123 and clock.wait(0.0) is None


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"name": "3d"}, "the name of a sonar must be the full name of a topic"),
        ({"name": "a__b"}, "the name of a sonar must be the full name of a topic"),
        ({"rate_hz": 0}, "rate_hz must lie in 0.001..1000"),
        ({"rate_hz": math.nan}, "rate_hz must lie in"),
        ({"topics": {"pictures": "/a"}}, r"unknown topic \(got 'pictures'"),
        ({"topics": {"image": "fan"}}, "the topic 'image' must be the full name"),
        ({"topics": {"image": "/sonar/points"}}, "topics must have different names"),
        ({"world_frame": "/map"}, "world_frame must be the name of a frame"),
        ({"world_frame": "sonar"}, "frames of world, vehicle and sonar must differ"),
        ({"mount": MOUNT}, "a mount needs vehicle_frame"),
        ({"mount": (1, 2), "vehicle_frame": "v"}, "mount must be six numbers"),
        ({"mount": (0, 0, 0, 90, 0, 0), "vehicle_frame": "v"}, "mount: pose angles must be radians"),
        ({"pose_from": "odometry=/odom"}, "pose_from must be a PoseSource"),
        ({"pose_from": PoseSource("tf", "a"), "vehicle_frame": "b"}, "vehicle_frame must be the frame"),
        ({"bodies_from": "bodies"}, "bodies_from must be the full name of a topic"),
        ({"y_sign": "left"}, "unknown y_sign"),
        ({"image_height": 8}, "image_height must be a whole number in 16..8192"),
        ({"colormap": "mud"}, "unknown colour map"),
        ({"points_rows": 0}, "points_rows must be a whole number in 1..4096"),
    ],
)
def test_wrong_settings_are_refused(settings, why):
    with pytest.raises(Error, match=why):
        PublisherSettings(**settings)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("/odom", "must be odometry=TOPIC, pose=TOPIC or tf=FRAME"),
        ("twist=/a", "unknown source of poses"),
        ("pose=a", "full name of a topic"),
        ("tf=/base", "name of a frame"),
    ],
)
def test_wrong_sources_of_poses_are_refused(text, why):
    with pytest.raises(Error, match=why):
        PoseSource.parse(text)


def test_rates_that_no_sonar_has_are_warned_of(scene, loopback, caplog):
    with publisher_of(scene, loopback, rate_hz=20.0):
        assert "tilted makes at most 15 pings per second" in caplog.text


def test_every_kind_of_topic_is_tested(sent):
    assert {name.rpartition("/")[2] for name in sent[2]} == {*TOPICS, "tf_static"}


def test_settings_are_values():
    assert replace(PublisherSettings(), name="a").topic_names["image"] == "/a/image"
