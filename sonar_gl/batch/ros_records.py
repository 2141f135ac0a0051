"""What goes into a ROS 2 bag, and how."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.batch.ros_messages import BEAMS
from sonar_gl.types import Error, Ping, frozen_array, nearest_names


@dataclass(frozen=True)
class BagSettings:
    """How pings are written.

    Parameters
    ----------
    y_sign : where y of beam_directions points: "port", as sonar_image_proc reads it, in a frame whose x is
        down; or "starboard", as the message's own text has it, in one whose x is up. z is ahead
    bits : of a bin, 8, 16 or 32, unsigned
    scale : "db" or "linear", as of a fan image
    db_range : (0, the largest integer) in dB; 0 dB = intensity 1, where "linear" has its largest integer

    Raises
    ------
    Error
        if one makes no sense.
    """

    y_sign: str = "port"
    bits: int = 8
    scale: str = "db"
    db_range: tuple[float, float] = (-60.0, 0.0)

    def __post_init__(self):
        for name, known in (("y_sign", tuple(BEAMS)), ("scale", ("db", "linear"))):
            value = getattr(self, name)
            if value not in known:
                raise Error(
                    f"unknown {name} of a ROS bag (got {value!r}; {nearest_names(str(value), known)})"
                )
        if isinstance(self.bits, bool) or self.bits not in (8, 16, 32):
            raise Error(f"bits of a bin in a ROS bag must be 8, 16 or 32 (got {self.bits!r})")
        low, high = frozen_array(self.db_range, np.float64, (2,), "db_range of a ROS bag").tolist()
        if not low < high:
            raise Error(f"db_range of a ROS bag must rise (got {low:g} and {high:g})")
        object.__setattr__(self, "db_range", (low, high))


@dataclass(frozen=True, eq=False)
class PingRecord:
    """One ping, on its way into a bag: topics /sonar/projected_image and /sonar/image, and its place in /tf.

    Attributes
    ----------
    time_s : when it was transmitted, seconds of the simulation, 0 or more
    sonar : its name; ROS gets it with "_" for what is no letter and no digit
    ping : with its pose, and meta as `Simulator.ping` gives it
    picture : None, or its fan image: (H, W) or (H, W, 3) RGB, uint8 or float 0..1
    vehicle_pose : None, or (4, 4) world_from_vehicle, which the sonar's pose is then told from
    """

    time_s: float
    sonar: str
    ping: Ping
    picture: np.ndarray | None = None
    vehicle_pose: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class CameraRecord:
    """What a camera sees: topics /camera/image, /camera/depth and /camera/camera_info, and its place in /tf.

    Attributes
    ----------
    time_s, vehicle_pose : as of a PingRecord
    camera : its name
    pose : (4, 4) world_from_camera, x ahead, y to port, z up, as of a sonar
    intrinsics : (3, 3), as of `Camera`; pixels count from the middle of the first
    picture : None, or (H, W) or (H, W, 3) RGB, uint8 or float 0..1
    depth_m : None, or (H, W) float32 of that size, along the optical axis; NaN or infinity where it is open
    """

    time_s: float
    camera: str
    pose: np.ndarray
    intrinsics: np.ndarray
    picture: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    vehicle_pose: np.ndarray | None = None
