"""Poses, bodies and times that come as messages of ROS 2, from programs that may send anything.

Each input has a method `receive`, which a transport calls with bytes in a thread of its own. It takes what is right,
and counts what is not; it never raises.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import rotation_rows
from sonar_gl.ros.messages import MAX_TIME_S, message_types
from sonar_gl.scene.scene import Scene

logger = logging.getLogger(__name__)

MAX_PARENTS = 100  # between a frame and the world
MAX_DISTANCE_M = 1e8  # as far as scenes reach
NORM_TOLERANCE = 0.01  # of a quaternion's square, as in tf2


class RefusedError(Exception):
    """What is wrong with a message or a part of it, and of which few kinds that is, each of which is logged once."""

    def __init__(self, kind: str, why: str):
        super().__init__(why)
        self.kind = kind


class RefusedMessages:
    """Counts what was refused, and logs the first of each kind."""

    def __init__(self):
        self._total, self._seen, self._lock = 0, set(), threading.Lock()

    @contextmanager
    def counting(self, name: str) -> Iterator[None]:
        """Count what the block raises as refused; `name` says where it came from."""
        try:
            yield
        except RefusedError as why:
            self._add(name, why.kind, str(why))
        except Error as why:
            self._add(name, "no such message", str(why))

    def _add(self, name: str, kind: str, why: str) -> None:
        with self._lock:
            self._total += 1
            is_first = (name, kind) not in self._seen
            self._seen.add((name, kind))
        if is_first:
            logger.warning(
                "%s: a message or a part of it is ignored: %s (others like it are only counted)", name, why
            )

    @property
    def total(self) -> int:
        return self._total


def _matrix(position, orientation) -> np.ndarray:
    place = position.x, position.y, position.z
    w, x, y, z = orientation.w, orientation.x, orientation.y, orientation.z
    if not all(map(math.isfinite, (*place, w, x, y, z))):
        raise RefusedError("not finite", "numbers of a pose must be finite (got NaN or infinity)")
    if max(map(abs, place)) > MAX_DISTANCE_M:
        raise RefusedError(
            "too far", f"poses must lie within {MAX_DISTANCE_M:g} m (got {max(map(abs, place)):g} m)"
        )
    square = w * w + x * x + y * y + z * z
    if not abs(square - 1) <= NORM_TOLERANCE:
        raise RefusedError(
            "no rotation", f"the quaternion of a pose must have the length 1 (got {math.sqrt(square):g})"
        )
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_rows(*(number / math.sqrt(square) for number in (x, y, z, w))), place
    return out


def _check_world(frame: str, world: str) -> None:
    """Raise RefusedError unless a pose is in the frame of the world, or names none."""
    if frame.lstrip("/") not in ("", world):
        raise RefusedError(
            "other frame",
            f"poses must be in the frame {world!r} (got {shown(frame)}; the setting world_frame names it)",
        )


class PoseInput:
    """The last pose that came by nav_msgs/Odometry or geometry_msgs/PoseStamped.

    The order in which messages come counts, not their stamps, so that a bag or a simulation may begin again.

    world : frame that poses must be in
    """

    def __init__(self, topic: str, msgtype: str, world: str, refused: RefusedMessages):
        self._topic, self._msgtype, self._world, self._refused = topic, msgtype, world, refused
        self._latest = None

    def receive(self, data: bytes) -> None:
        with self._refused.counting(self._topic):
            message = message_types().decode(bytes(data), self._msgtype)
            _check_world(message.header.frame_id, self._world)
            at = message.pose
            at = at.pose if hasattr(at, "pose") else at  # Odometry's has a covariance
            self._latest = _matrix(at.position, at.orientation)

    def latest(self) -> np.ndarray | None:
        """Return the last pose, (4, 4); None if none came."""
        return self._latest


class FrameInput:
    """The pose of a frame by tf2_msgs/TFMessage of /tf and /tf_static: the last transform of each frame counts.

    frame, world : the one whose pose is asked for, and the one that it is in
    """

    def __init__(self, frame: str, world: str, refused: RefusedMessages):
        self._frame, self._world, self._refused = frame, world, refused
        self._links: dict[str, tuple[str, np.ndarray]] = {}  # frame: its parent, and parent_from_frame
        self._lock = threading.Lock()

    def receive(self, data: bytes) -> None:
        """Take a message; what is wrong with one transform leaves the others in force."""
        for child, link in _transforms(data, "/tf", self._refused):
            with self._refused.counting("/tf"):
                parent = link.header.frame_id.lstrip("/")
                if not child or not parent:
                    raise RefusedError("no frame", "transforms must name both frames (got an empty name)")
                matrix = _matrix(link.transform.translation, link.transform.rotation)
                with self._lock:
                    self._links[child] = parent, matrix

    def latest(self) -> np.ndarray | None:
        """Return world_from_frame, (4, 4); None as long as no transforms lead from the frame to the world."""
        frame, out = self._frame, np.eye(4)
        with self._lock:
            for _ in range(MAX_PARENTS):
                if frame not in self._links:
                    return None
                frame, matrix = self._links[frame]
                out = matrix @ out
                if frame == self._world:
                    return out
        return None


class BodiesInput:
    """The poses of bodies by tf2_msgs/TFMessage: the child frame is the name of a body, or of a model of the scene.

    Bodies such as `pylon::column`, which readers of scenes make of shapes of `pylon` that are smoother, move with it;
    and so does with a model all that is in it.

    topic : of the messages
    world : frame that poses must be in
    """

    def __init__(self, topic: str, scene: Scene, world: str, refused: RefusedMessages):
        self._topic, self._world, self._refused = topic, world, refused
        # what moves with a frame: names, and (4, 4) frame_from_body
        self._followers: dict[str, dict[str, np.ndarray]] = {
            body.name: {
                other.name: np.eye(4)
                for other in scene.bodies
                if other is body
                or (other.name.startswith(f"{body.name}::") and np.array_equal(other.pose, body.pose))
            }
            for body in scene.bodies
        }
        self._followers |= {model: parts for model in scene.models if (parts := scene.parts_of(model))}
        self._moved: dict[str, np.ndarray] = {}
        self._lock = threading.Lock()

    def receive(self, data: bytes) -> None:
        """Take a message; what is wrong with one transform leaves the others in force."""
        came = []
        for child, link in _transforms(data, self._topic, self._refused):
            with self._refused.counting(self._topic):
                if child not in self._followers:
                    raise RefusedError(
                        "no body", f"child frames must be names of bodies (got {shown(child)})"
                    )
                _check_world(link.header.frame_id, self._world)
                came.append((child, _matrix(link.transform.translation, link.transform.rotation)))
        # models first: a part that is named itself is where that says
        came.sort(key=lambda one: one[0].count("::"))
        with self._lock:
            for child, matrix in came:
                self._moved |= {name: matrix @ at for name, at in self._followers[child].items()}

    def take(self) -> dict[str, np.ndarray]:
        """Return the poses that came since the last call, (4, 4) world_from_body by name."""
        with self._lock:
            moved, self._moved = self._moved, {}
        return moved


def _transforms(data: bytes, topic: str, refused: RefusedMessages) -> Iterator[tuple[str, object]]:
    """Yield the child frame and the transform of each that a message holds."""
    with refused.counting(topic):
        message = message_types().decode(bytes(data), "tf2_msgs/msg/TFMessage")
        yield from ((link.child_frame_id.lstrip("/"), link) for link in message.transforms)


class ClockInput:
    """The last time that came by rosgraph_msgs/Clock."""

    def __init__(self, topic: str, refused: RefusedMessages):
        self._topic, self._refused = topic, refused
        self._time_ns, self._news = None, threading.Condition()

    def receive(self, data: bytes) -> None:
        with self._refused.counting(self._topic):
            clock = message_types().decode(bytes(data), "rosgraph_msgs/msg/Clock").clock
            if not (0 <= clock.sec < MAX_TIME_S and 0 <= clock.nanosec < 10**9):
                raise RefusedError(
                    "no time",
                    f"times must have 0 seconds or more and less than 10⁹ nanoseconds (got {clock.sec} and "
                    f"{clock.nanosec})",
                )
            with self._news:
                self._time_ns = clock.sec * 10**9 + clock.nanosec
                self._news.notify_all()

    def wait(self, timeout_s: float) -> int | None:
        """Return the time that came last since the last call, nanoseconds; None if none comes within the timeout."""
        with self._news:
            self._news.wait_for(lambda: self._time_ns is not None, timeout_s)
            time_ns, self._time_ns = self._time_ns, None
        return time_ns
