"""Moves the sonar of `sonar-gl ros2` by messages, without ROS: it sways to port and starboard.

sonar-gl ros2 pylon --pose-from pose=/rov/pose
python examples/ros2_poses.py                        # in another terminal; Ctrl-C ends it
"""

import argparse
import math
import os
import time
from contextlib import closing, suppress

from trimesh.transformations import quaternion_from_matrix

import sonar_gl as sg
from sonar_gl.ros import DdsTransport, ZenohTransport
from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Topic

RATE_HZ = 20.0
SWAY_M, PERIOD_S = 2.0, 20.0


def make_transport(options):
    """What carries the messages."""
    if options.transport == "zenoh":
        return ZenohTransport(options.router, options.domain, node="rov")
    return DdsTransport(options.domain, node="rov")


def pose_message(world_from_sonar, time_ns):
    """The bytes of a geometry_msgs/PoseStamped in the frame of the scene."""
    types = message_types()
    x, y, z = world_from_sonar[:3, 3].tolist()
    w, i, j, k = quaternion_from_matrix(world_from_sonar).tolist()
    position = types.make("geometry_msgs/Point", x, y, z)
    orientation = types.make("geometry_msgs/Quaternion", i, j, k, w)
    pose = types.make("geometry_msgs/Pose", position, orientation)
    return types.encode(types.make("geometry_msgs/PoseStamped", types.header(time_ns, "world"), pose))


def main(options):
    """Send poses about the one that the scene has for the sonar."""
    start = sg.load_scene(options.scene).sonar_pose
    if start is None:
        raise sg.Error(f"the scene must have a place for the sonar (got {options.scene}, which has none)")
    topic = Topic.of_type(options.topic, "geometry_msgs/msg/PoseStamped")
    with closing(make_transport(options)) as transport:
        print(f"sends poses on {options.topic}; Ctrl-C ends it", flush=True)
        began_s = time.monotonic()
        while (time_s := time.monotonic() - began_s) < options.duration:
            sway = sg.pose(y=SWAY_M * math.sin(2 * math.pi * time_s / PERIOD_S))
            time_ns = time.time_ns()
            transport.publish(topic, pose_message(start @ sway, time_ns), time_ns)
            time.sleep(1 / RATE_HZ)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="pylon", help="name or file, as for sonar-gl ros2")
    parser.add_argument("--duration", type=float, default=math.inf, help="seconds after which it ends")
    parser.add_argument("--topic", default="/rov/pose")
    parser.add_argument("--transport", choices=("dds", "zenoh"), default="dds")
    parser.add_argument("--router", default="tcp/127.0.0.1:7447", help="of zenoh")
    parser.add_argument("--domain", type=int, default=os.environ.get("ROS_DOMAIN_ID", "").strip() or "0")
    try:
        with suppress(KeyboardInterrupt):
            main(parser.parse_args())
    except sg.Error as why:
        parser.exit(2, f"error: {why}\n")
