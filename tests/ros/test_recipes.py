"""The recipes of docs/ros2.md for other simulators and for bags, with stand-ins for their programs over DDS.

A stand-in sends what the page says that the other program sends: the same topics, types, frames, qualities of service.
The commands are those of the page, but for the scene, what makes it quick, and a domain of its own.

All look at a ball, whose nearest point has a range and a bearing of closed form.
"""

import math
import os
import re
import shlex
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.ros.messages import message_types
from sonar_gl.ros.publisher_settings import TOPICS
from sonar_gl.ros.transport import Topic
from tests.support.commands_beside import run_beside
from tests.support.pose_messages import odometry, transforms

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "ros2.md").read_text(encoding="utf-8")
WAIT_S = 100.0  # a machine that tests run on may be slow
PERIOD_S, DEPTH = 0.02, 10  # of messages; of ros_gz_bridge's publishers
FAST = ["--sonar", "p900-90", "--range", "12", "--profile", "ideal", "--noise", "none", "--tolerance", "0.1"]
BALL, RADIUS_M, DEPTH_M = (6.0, 2.0), 0.3, 3.0
# bins of 5 cm; automatic gain brings beams about the middle of the ball, half of its width, to full scale
RANGE_ERROR_M, BEARING_ERROR_DEG = 0.06, 1.5
BEGAN_NS = 100 * 10**9  # of the simulation's time
WORLD = f"""<sdf version="1.9"><world name="harbour">
  <model name="rov"><pose>0 0 {-DEPTH_M} 0 0 0</pose>
    <link name="base_link"><collision name="hull"><geometry><box><size>1 1 1</size></box></geometry></collision>
    </link></model>
  <model name="box"><pose>{BALL[0]} {BALL[1]} {-DEPTH_M} 0 0 0</pose>
    <link name="link"><collision name="ball"><geometry><sphere><radius>{RADIUS_M}</radius></sphere></geometry>
      <laser_retro>200</laser_retro></collision></link></model>
</world></sdf>"""

pytest.importorskip("cyclonedds")
pytestmark = pytest.mark.timeout(WAIT_S + 60)


class Sighting(NamedTuple):
    """Where a ping shows the ball."""

    stamp_ns: int
    range_m: float
    bearing_deg: float


def command_of(heading, tmp_path, monkeypatch):
    """The words of the `sonar-gl` command below a heading of the page, beside the files of the section."""
    monkeypatch.chdir(tmp_path)
    section = PAGE.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    for name, text in re.findall(r"`(\w+\.(?:toml|yaml))`.*?\n\n```\w+\n(.*?)```", section, re.DOTALL):
        Path(name).write_text(text)
    Path("harbour.sdf").write_text(WORLD)
    (line,) = re.findall(r"^sonar-gl (.*)$", section, re.MULTILINE)
    words = shlex.split(line)
    words[words.index("pylon")] = "harbour.sdf"
    return words


def watch(command, play):
    """Run a command; call `play` with a function that sends a message, until the ball was seen. Return what was seen.

    play : function (send, sightings) that returns when it has seen enough
    """
    domain, types = 100 + os.getpid() % 100, message_types()
    sightings, topics = [], {}

    def see(data):
        message = types.decode(data, TOPICS["projected_image"])
        counts = np.frombuffer(bytes(message.image.data), np.uint8).reshape(len(message.ranges), -1)
        if counts.any():
            is_brightest = counts == counts.max()
            nearest = is_brightest.any(axis=1).argmax()
            beams = [message.beam_directions[k] for k in np.flatnonzero(is_brightest.any(axis=0))]
            bearing_deg = np.degrees(np.mean([math.atan2(one.y, one.z) for one in beams]))
            stamp = message.header.stamp
            stamp_ns = stamp.sec * 10**9 + stamp.nanosec
            sightings.append(Sighting(stamp_ns, float(message.ranges[nearest]), float(bearing_deg)))

    def work():
        from sonar_gl.ros import DdsTransport

        transport = DdsTransport(domain=domain, node="stand_in")
        try:
            transport.subscribe(Topic.of_type("/sonar/projected_image", TOPICS["projected_image"]), see)

            def send(name, msgtype, data, time_ns, **quality):
                key = Topic.of_type(name, msgtype, **{"depth": DEPTH, **quality})
                transport.publish(topics.setdefault(name, key), data, time_ns)

            play(send, sightings)
        finally:
            transport.close()

    printed, _ = run_beside([*command, *FAST, "--rate", "10", "--domain", str(domain)], work, WAIT_S)
    return printed, sightings


def check(sighting, x, y):
    """The ball is so far ahead, and to port."""
    assert sighting.range_m == pytest.approx(math.hypot(x, y) - RADIUS_M, abs=RANGE_ERROR_M)
    assert sighting.bearing_deg == pytest.approx(math.degrees(math.atan2(y, x)), abs=BEARING_ERROR_DEG)


def send_clock(send, time_ns):
    """Send the time of a simulation."""
    types = message_types()
    send("/clock", "rosgraph_msgs/msg/Clock", types.encode(types.clock(time_ns)), time_ns)


def until_seen(sightings, condition, turn, first_ns=BEGAN_NS):
    """Call `turn` with the time, in nanoseconds, until a ping shows the ball as wanted; return the time after it."""
    end_s, time_ns = time.monotonic() + WAIT_S, first_ns
    while not (sightings and condition(sightings[-1])):
        assert time.monotonic() < end_s, sightings[-3:]
        turn(time_ns)
        time.sleep(PERIOD_S)
        time_ns += round(PERIOD_S * 1e9)
    return time_ns


def test_gazebo(tmp_path, monkeypatch):
    """ros_gz_bridge sends time, odometry and the pose of a model, as bridge.yaml has them; the vehicle is not seen."""
    command = command_of("With Gazebo", tmp_path, monkeypatch)
    command = [*command, "--without", "rov"]
    bridged = dict(
        re.findall(r"ros_topic_name: (\S+)\n.*\n\s+ros_type_name: (\S+)\n", Path("bridge.yaml").read_text())
    )
    assert bridged == {
        "/clock": "rosgraph_msgs/msg/Clock",
        "/rov/odometry": "nav_msgs/msg/Odometry",
        "/rov/bodies": "tf2_msgs/msg/TFMessage",
    }

    def play(send, sightings):
        def turn(vehicle, ball):
            def at(time_ns):
                send_clock(send, time_ns)
                data = odometry(vehicle, "harbour", time_ns)
                send("/rov/odometry", bridged["/rov/odometry"], data, time_ns)
                if ball is not None:
                    # the plugin names both frames of a pose
                    send("/rov/bodies", bridged["/rov/bodies"], transforms(("harbour", "box", ball)), time_ns)

            return at

        ahead = sg.pose(z=-DEPTH_M)
        after_ns = until_seen(sightings, lambda one: True, turn(ahead, None))
        check(sightings[-1], *BALL)
        moved = sg.pose(BALL[0], -BALL[1], -DEPTH_M)
        after_ns = until_seen(sightings, lambda one: one.bearing_deg < 0, turn(ahead, moved), after_ns)
        check(sightings[-1], BALL[0], -BALL[1])
        nearer = sg.pose(1.0, -BALL[1], -DEPTH_M)
        until_seen(sightings, lambda one: one.range_m < 5.0, turn(nearer, moved), after_ns)
        check(sightings[-1], BALL[0] - 1.0, 0.0)

    _, sightings = watch(command, play)
    stamps_ns = [one.stamp_ns for one in sightings]
    assert stamps_ns == sorted(set(stamps_ns)) and stamps_ns[0] >= BEGAN_NS  # the simulation's time


def test_stonefish(tmp_path, monkeypatch):
    """Stonefish has z down and the vehicle's y to starboard; a static transform leads to the scene's frame."""
    command = command_of("With Stonefish", tmp_path, monkeypatch)
    assert "static_transform_publisher --roll 3.14159265 --frame-id world --child-frame-id world_ned" in PAGE
    turned = transforms(("world", "world_ned", sg.pose(roll=math.pi)))

    def play(send, sightings):
        send("/tf_static", "tf2_msgs/msg/TFMessage", turned, 0, latched=True, depth=1)
        vehicle = transforms(("world_ned", "rov/base_link", sg.pose(z=DEPTH_M - 0.1)))
        until_seen(
            sightings,
            lambda one: True,
            lambda time_ns: send("/tf", "tf2_msgs/msg/TFMessage", vehicle, time_ns, depth=100),
        )

    began_ns = time.time_ns()
    _, sightings = watch([*command, "--without", "rov"], play)
    # the sonar is mounted 0.4 m ahead and 0.1 m below, at the depth of the ball
    check(sightings[-1], BALL[0] - 0.4, BALL[1])
    assert began_ns < sightings[-1].stamp_ns < time.time_ns()  # the system's time


@pytest.mark.slow
def test_a_bag(tmp_path, monkeypatch):
    """`ros2 bag play --clock` sends recorded odometry and its time; a bag that begins again is followed again."""
    command = command_of("With a bag", tmp_path, monkeypatch)

    def play(send, sightings):
        def turn(y):
            def at(time_ns):
                send_clock(send, time_ns)
                send(
                    "/rov/odometry",
                    "nav_msgs/msg/Odometry",
                    odometry(sg.pose(0, y, -DEPTH_M), "world", time_ns),
                    time_ns,
                )

            return at

        until_seen(sightings, lambda one: True, turn(0.0))
        check(sightings[-1], *BALL)
        # as long as a second at least, so that its beginning lies in the past
        end_ns = until_seen(sightings, lambda one: one.stamp_ns > BEGAN_NS + 3 * 10**9, turn(0.0))
        assert end_ns > BEGAN_NS + 2 * 10**9
        # the first ping after the jump may still be at the pose before it
        until_seen(
            sightings, lambda one: one.stamp_ns < BEGAN_NS + 2 * 10**9 and one.bearing_deg < 14, turn(1.0)
        )
        check(sightings[-1], BALL[0], BALL[1] - 1.0)

    printed, _ = watch([*command, "--without", "rov"], play)
    assert "1 jumps of time" in printed
