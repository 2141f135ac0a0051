"""Poses, bodies and times that come from other programs, right ones and wrong ones."""

import logging
import math
import random
import time

import numpy as np
import pytest
import trimesh
from trimesh.transformations import quaternion_from_matrix

from sonar_gl.core.poses import pose
from sonar_gl.ros.message_inputs import (
    BodiesInput,
    ClockInput,
    FrameInput,
    PoseInput,
    RefusedMessages,
)
from sonar_gl.ros.messages import message_types
from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.scene import Body, Scene
from tests.support.pose_messages import odometry, pose_stamped, transforms

PLACE = pose(3, -2, -5, 0.1, -0.2, 2.0)
ODOMETRY, STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
ROUNDING = 1e-12  # of a rotation by a quaternion and back


def bodies_at(*names, placed=None):
    return [
        Body(name, trimesh.creation.box((1, 1, 1)), np.eye(4) if placed is None else placed) for name in names
    ]


@pytest.fixture
def refused():
    return RefusedMessages()


@pytest.mark.parametrize(("msgtype", "make"), [(ODOMETRY, odometry), (STAMPED, pose_stamped)])
def test_poses_are_those_of_the_last_message(msgtype, make, refused):
    poses = PoseInput("/pose", msgtype, "world", refused)
    assert poses.latest() is None
    for placed in (pose(1, 2, 3), PLACE):
        poses.receive(make(placed))
        np.testing.assert_allclose(poses.latest(), placed, atol=ROUNDING)
    for frame in ("", "/world"):
        poses.receive(make(np.eye(4), frame=frame))
    np.testing.assert_array_equal(poses.latest(), np.eye(4))
    assert refused.total == 0


def test_big_endian_messages_are_read(refused):
    types, poses = message_types(), PoseInput("/pose", STAMPED, "world", refused)
    from rosbags.typesys import Stores, get_typestore

    message = types.decode(pose_stamped(PLACE), STAMPED)
    poses.receive(
        bytes(get_typestore(Stores.ROS2_HUMBLE).serialize_cdr(message, STAMPED, little_endian=False))
    )
    np.testing.assert_allclose(poses.latest(), PLACE, atol=ROUNDING)


@pytest.mark.parametrize(
    ("why", "data"),
    [
        ("must begin with the mark of CDR", b""),
        ("must be whole, in CDR", pose_stamped(PLACE)[:-1]),
        ("must begin with the mark of CDR", b"\x00\x06" + pose_stamped(PLACE)[2:]),
        ("must be whole, in CDR", pose_stamped(PLACE)[:12] + b"\xff\xff\xff\x7f" + pose_stamped(PLACE)[16:]),
        ("must be finite", pose_stamped(PLACE, x=math.nan)),
        ("must be finite", pose_stamped(PLACE, quaternion=(math.inf, 0, 0, 0))),
        ("must lie within", pose_stamped(PLACE, x=-1e300)),
        ("must have the length 1", pose_stamped(PLACE, quaternion=(0, 0, 0, 0))),
        ("must have the length 1", pose_stamped(PLACE, quaternion=(1e200, 1e200, 0, 0))),
        ("must be in the frame 'world'", pose_stamped(PLACE, frame="odom")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_poses_are_counted_and_logged_once_and_change_nothing(why, data, refused, caplog):
    poses = PoseInput("/pose", STAMPED, "world", refused)
    poses.receive(pose_stamped(PLACE))
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            poses.receive(data)
    assert refused.total == 3
    assert len(caplog.records) == 1 and "/pose: a message" in caplog.text and why in caplog.text
    np.testing.assert_allclose(poses.latest(), PLACE, atol=ROUNDING)


def test_quaternions_are_made_unit_within_what_tf2_allows(refused):
    poses = PoseInput("/pose", STAMPED, "world", refused)
    quaternion = quaternion_from_matrix(PLACE)
    poses.receive(pose_stamped(PLACE, quaternion=1.004 * quaternion))
    np.testing.assert_allclose(poses.latest(), PLACE, atol=ROUNDING)
    poses.receive(pose_stamped(np.eye(4), quaternion=1.006 * quaternion))
    np.testing.assert_allclose(poses.latest(), PLACE, atol=ROUNDING)
    assert refused.total == 1


def test_a_frame_is_found_through_its_parents(refused):
    frames = FrameInput("base_link", "map", refused)
    odom, base = pose(1, 0, 0, yaw=0.5), pose(0, 2, 0, pitch=0.25)
    frames.receive(transforms(("odom", "base_link", base)))
    assert frames.latest() is None  # nothing leads to the world
    frames.receive(transforms(("/map", "/odom", odom), ("base_link", "other", np.eye(4))))
    np.testing.assert_allclose(frames.latest(), odom @ base, atol=ROUNDING)
    frames.receive(transforms(("odom", "base_link", np.eye(4))))
    np.testing.assert_allclose(frames.latest(), odom, atol=ROUNDING)
    assert refused.total == 0


def test_frames_in_a_circle_end(refused):
    frames = FrameInput("base_link", "world", refused)
    frames.receive(transforms(("odom", "base_link", PLACE), ("base_link", "odom", PLACE)))
    assert frames.latest() is None


def test_bodies_are_taken_once_and_a_wrong_one_spoils_no_other(refused, caplog):
    bodies = BodiesInput("/bodies", Scene(bodies_at("ball", "wall")), "world", refused)
    wrong = 2 * np.eye(4)
    bodies.receive(
        transforms(
            ("world", "diver", PLACE),
            ("world", "ball", pose(9)),
            ("odom", "wall", PLACE),
            ("", "ball", PLACE),
            ("world", "wall", wrong, {"quaternion": (0, 0, 0, 0)}),
        )
    )
    moved = bodies.take()
    assert list(moved) == ["ball"] and bodies.take() == {}
    np.testing.assert_allclose(moved["ball"], PLACE, atol=ROUNDING)
    whys = "names of bodies (got 'diver')", "in the frame 'world' (got 'odom'", "the length 1 (got 0)"
    assert refused.total == len(caplog.records) == 3
    assert all(why in one.getMessage() for why, one in zip(whys, caplog.records, strict=True))


def test_shapes_of_a_body_move_with_it_and_other_links_do_not(refused):
    other_link = bodies_at("pylon::arm", placed=pose(1, 0, 0))
    scene = [*bodies_at("pylon", "pylon::column", "pylon_2::column", "pylon_2"), *other_link]
    bodies = BodiesInput("/bodies", Scene(scene), "world", refused)
    bodies.receive(transforms(("world", "pylon", PLACE)))
    assert list(bodies.take()) == ["pylon", "pylon::column"]
    bodies.receive(transforms(("world", "pylon::arm", PLACE)))
    assert list(bodies.take()) == ["pylon::arm"] and refused.total == 0


def test_all_of_a_model_moves_with_it(refused):
    """As a simulator says where a model of several links is; `moved` is what the world has in it."""
    home, bubbles = pose(10, 0, 0, yaw=np.pi / 2), Bubbles("rov::bubbles", pose(10, 0, 1))
    links = [*bodies_at("rov::hull", placed=home), *bodies_at("rov::arm", placed=pose(10, 2, 0))]
    beside = bodies_at("rov_2", "rov_2::arm")
    scene = Scene([*links, *beside, bubbles], models={"rov": home, "away": home})
    bodies = BodiesInput("/bodies", scene.without("rov_2::arm"), "world", refused)
    bodies.receive(transforms(("world", "rov", pose(0, 0, 5)), ("world", "away", PLACE)))
    moved = bodies.take()
    assert list(moved) == ["rov::hull", "rov::arm", "rov::bubbles"]
    np.testing.assert_array_equal(moved["rov::hull"], pose(0, 0, 5))
    np.testing.assert_allclose(moved["rov::arm"], pose(2, 0, 5, yaw=-np.pi / 2), atol=ROUNDING)
    np.testing.assert_allclose(moved["rov::bubbles"], pose(0, 0, 6, yaw=-np.pi / 2), atol=ROUNDING)
    assert refused.total == 1
    bodies.receive(transforms(("world", "rov::arm", PLACE)))
    assert list(bodies.take()) == ["rov::arm"]


@pytest.mark.parametrize("names", [("rov", "rov::arm"), ("rov::arm", "rov")])
def test_a_part_that_a_message_names_beside_its_model_is_where_that_says_in_any_order(refused, names):
    """As where a program places both at once; the model took along the part that came before it."""
    scene = Scene(bodies_at("rov::hull", "rov::arm"), models={"rov": np.eye(4)})
    bodies, places = (
        BodiesInput("/bodies", scene, "world", refused),
        {"rov": pose(0, 0, 5), "rov::arm": pose(3)},
    )
    bodies.receive(transforms(*(("world", name, places[name]) for name in names)))
    moved = bodies.take()
    np.testing.assert_array_equal(moved["rov::hull"], pose(0, 0, 5))
    np.testing.assert_array_equal(moved["rov::arm"], pose(3))


def test_the_clock_gives_each_time_once(refused):
    types, clock = message_types(), ClockInput("/clock", refused)
    assert clock.wait(0.0) is None
    for time_ns in (5, 1_700_000_000_123_456_789):
        clock.receive(types.encode(types.clock(time_ns)))
    assert clock.wait(0.0) == 1_700_000_000_123_456_789
    assert clock.wait(0.0) is None
    stamp = types.make("builtin_interfaces/Time", -1, 0), types.make("builtin_interfaces/Time", 1, 10**9)
    for wrong in stamp:
        clock.receive(types.encode(types.make("rosgraph_msgs/Clock", wrong)))
    assert clock.wait(0.0) is None and refused.total == 2


def mutated(chance, data):
    """Return bytes that a careless or hostile program might send in place of a message."""
    kind = chance.random()
    if kind < 0.2:
        return chance.randbytes(chance.randrange(200))
    data = bytearray(data)
    if kind < 0.5:
        del data[chance.randrange(len(data)) :]
    for _ in range(chance.randrange(4)):
        if data:
            data[chance.randrange(len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)))
    return bytes(data)


@pytest.mark.parametrize("count", [4_000, pytest.param(100_000, marks=pytest.mark.slow)])
@pytest.mark.timeout(600)
def test_wrong_messages_neither_raise_nor_stall(count, refused, caplog):
    types, chance = message_types(), random.Random(1)
    inputs = [
        (PoseInput("/odom", ODOMETRY, "world", refused), odometry(PLACE)),
        (PoseInput("/pose", STAMPED, "world", refused), pose_stamped(PLACE)),
        (FrameInput("base_link", "world", refused), transforms(("world", "base_link", PLACE))),
        (
            BodiesInput("/bodies", Scene(bodies_at("ball")), "world", refused),
            transforms(("world", "ball", PLACE)),
        ),
        (ClockInput("/clock", refused), types.encode(types.clock(10**9))),
    ]
    slowest_s = 0.0
    for number in range(count):
        one, right = inputs[number % len(inputs)]
        data = mutated(chance, right)
        began_s = time.thread_time()  # not the time of other programs on a loaded machine
        one.receive(data)
        slowest_s = max(slowest_s, time.thread_time() - began_s)
    # a length of 2³¹ elements, taken at its word, would take minutes or the memory
    assert slowest_s < 0.5
    assert refused.total > count / 4
    assert len(caplog.records) < 40
    for one, right in inputs[:3]:  # and right ones are read after it
        one.receive(right)
        np.testing.assert_allclose(one.latest(), PLACE, atol=ROUNDING)
