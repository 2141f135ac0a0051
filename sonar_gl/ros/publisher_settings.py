"""What a publisher of ROS 2 topics sends and follows: names of topics and frames, rates, sizes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sonar_gl.core.checks import (
    check_choice,
    check_kind,
    check_number,
    check_whole_number,
    make_numbers_plain,
    shown,
)
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.poses import pose
from sonar_gl.imaging.fan_image import colours
from sonar_gl.ros.messages import BEAMS, TF
from sonar_gl.ros.transport import check_topic
from sonar_gl.sonar.sampling import check_tolerance

# what is published: type
TOPICS = {
    "projected_image": "marine_acoustic_msgs/msg/ProjectedSonarImage",
    "raw_image": "marine_acoustic_msgs/msg/RawSonarImage",
    "image": "sensor_msgs/msg/Image",
    "points": "sensor_msgs/msg/PointCloud2",
    "tf": "tf2_msgs/msg/TFMessage",
    "clock": "rosgraph_msgs/msg/Clock",
}
GLOBAL_TOPICS = {"tf": TF, "clock": "/clock"}  # the same for all sonars
# what poses come from: type
POSE_SOURCES = {
    "odometry": "nav_msgs/msg/Odometry",
    "pose": "geometry_msgs/msg/PoseStamped",
    "tf": "tf2_msgs/msg/TFMessage",
}
FRAME = re.compile(r"[A-Za-z0-9_][\w/.:-]*")
MAX_RATE_HZ = 1000.0


def check_frame(what: str, name) -> str:
    """Return the name of a frame; an Error if tf2 does not allow it."""
    if isinstance(name, str) and FRAME.fullmatch(name) and len(name) < 200:
        return name
    raise Error(f"{what} must be the name of a frame, without a / before it (got {shown(name)})")


@dataclass(frozen=True)
class PoseSource:
    """Where poses of the sonar or its vehicle come from.

    Attributes
    ----------
    kind : one of POSE_SOURCES
    name : of the topic; with "tf", of the frame that /tf tells the pose of

    >>> PoseSource.parse("odometry=/rov/odometry")
    PoseSource(kind='odometry', name='/rov/odometry')
    """

    kind: str
    name: str

    def __post_init__(self):
        check_choice("source of poses", self.kind, POSE_SOURCES)
        (check_frame if self.kind == "tf" else check_topic)(f"the source of poses {self.kind!r}", self.name)

    @classmethod
    def parse(cls, text: str) -> PoseSource:
        """Return the source of a text: odometry=TOPIC, pose=TOPIC or tf=FRAME; an Error if it is none."""
        kind, separator, name = text.partition("=")
        if not separator:
            raise Error(
                "a source of poses must be odometry=TOPIC, pose=TOPIC or tf=FRAME "
                f"(got {shown(text)}; such as odometry=/rov/odometry)"
            )
        return cls(kind.strip(), name.strip())


@dataclass(frozen=True)
class PublisherSettings:
    """What a publisher sends and follows; raise Error if a setting is invalid.

    Parameters
    ----------
    name : of the sonar: its topics are /NAME/image and so on, its frames NAME and NAME_beams
    rate_hz : pings per second of simulation time; None for as many as sound and the device allow
    topics : for some of TOPICS other names, or None for those that are not published
    world_frame : frame of the scene, in which poses come
    vehicle_frame : frame of the vehicle that carries the sonar, whose poses come then; None for poses of the sonar.
        With poses from /tf it is the frame that they are of
    mount : x y z roll pitch yaw of the sonar on the vehicle, metres and radians
    pose_from : PoseSource of messages that move the sonar, or None
    bodies_from : topic of tf2_msgs/TFMessage whose child frames are names of bodies, or None
    y_sign : direction of y of beam_directions, as for `BagSettings`
    image_height : of the fan image, pixels
    colormap : of the fan image, as an RGB image; None for the counts themselves, as a gray one
    points_columns, points_rows : of the point cloud, about: as of `Simulator.point_cloud` there are some rows more, 36
        for 32, and beyond one perspective view a multiple of the views as columns; `height` and `width` of the message
        state how many
    tolerance, seed : as for `Simulator` and `Simulator.ping`
    """

    name: str = "sonar"
    rate_hz: float | None = None
    topics: Mapping[str, str | None] = field(default_factory=dict)
    world_frame: str = "world"
    vehicle_frame: str | None = None
    mount: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    pose_from: PoseSource | None = None
    bodies_from: str | None = None
    y_sign: str = "port"
    image_height: int = 600
    colormap: str | None = None
    points_columns: int = 128
    points_rows: int = 32
    tolerance: float = 0.05
    seed: int = 0

    def __post_init__(self):
        make_numbers_plain(self)
        check_topic("the name of a sonar", f"/{self.name}")
        if self.rate_hz is not None:
            check_number("rate_hz", self.rate_hz, 1e-3, MAX_RATE_HZ, "pings per second")
        check_kind("topics", self.topics, Mapping, 'such as {"image": "/fan", "raw_image": None}')
        for kind, name in self.topics.items():
            check_choice("topic", kind, TOPICS)
            if name is not None:
                check_topic(f"the topic {kind!r}", name)
        check_frame("world_frame", self.world_frame)
        check_kind("pose_from", self.pose_from, PoseSource | None, 'such as PoseSource("odometry", "/odom")')
        if self.vehicle_frame is not None:
            check_frame("vehicle_frame", self.vehicle_frame)
        if self.bodies_from is not None:
            check_topic("bodies_from", self.bodies_from)
        check_choice("y_sign", self.y_sign, BEAMS)
        check_whole_number("image_height", self.image_height, 16, 8192, "pixels")
        if self.colormap is not None:
            colours(self.colormap)
        check_whole_number("points_columns", self.points_columns, 1, 4096)
        check_whole_number("points_rows", self.points_rows, 1, 4096)
        check_whole_number("seed", self.seed)
        check_tolerance(self.tolerance)
        check_kind("mount", self.mount, tuple | list, "give six numbers: x y z roll pitch yaw")
        if len(self.mount) != 6:
            raise Error(f"mount must be six numbers, x y z roll pitch yaw (got {len(self.mount)})")
        with errors_at("mount"):
            pose(*self.mount)
        self._check_frames()
        names = list(self.topic_names.values())
        if len(set(names)) < len(names):
            raise Error(f"topics must have different names (got {', '.join(sorted(names))})")

    def _check_frames(self) -> None:
        if self.reads_tf and self.vehicle_frame not in (None, self.pose_from.name):
            raise Error(
                f"vehicle_frame must be the frame that poses from /tf are of, {self.pose_from.name!r}, or left out "
                f"(got {self.vehicle_frame!r})"
            )
        frames = [self.world_frame, self.vehicle, self.frame, self.beams_frame]
        named = [frame for frame in frames if frame is not None]
        if len(set(named)) < len(named):
            raise Error(
                f"the frames of world, vehicle and sonar must differ (got {', '.join(named)}; another name of the "
                "sonar gives its frames another one)"
            )
        if self.vehicle is None and any(self.mount):
            raise Error("a mount needs vehicle_frame (it is the pose of the sonar in that frame)")

    @property
    def reads_tf(self) -> bool:
        return self.pose_from is not None and self.pose_from.kind == "tf"

    @property
    def vehicle(self) -> str | None:
        """The frame whose pose is known, where it is not the sonar's own."""
        return self.pose_from.name if self.reads_tf else self.vehicle_frame

    @property
    def frame(self) -> str:
        """The frame of the sonar: x forward, y to port, z up."""
        return self.name

    @property
    def beams_frame(self) -> str:
        """The frame of messages about beams: z forward, see `BEAMS`."""
        return f"{self.name}_beams"

    @cached_property
    def topic_names(self) -> dict[str, str]:
        """Names of the topics that are published, by what they hold."""
        defaults = {kind: GLOBAL_TOPICS.get(kind, f"/{self.name}/{kind}") for kind in TOPICS}
        names = {**defaults, **self.topics}
        return {kind: names[kind] for kind in TOPICS if names[kind] is not None}

    @cached_property
    def vehicle_from_sonar(self) -> np.ndarray:
        """(4, 4) pose of the sonar on its vehicle."""
        return pose(*self.mount)
