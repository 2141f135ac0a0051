"""ROS 2 messages of pings, pictures, cameras and places, and their bytes.

Frames: `sonar` is the sonar's own, x ahead, y to port, z up, and `sonar_beams` that of its messages, see
`BEAMS`; so with `camera`, and `camera_optical`, x right, y down, z ahead.
"""

from __future__ import annotations

import math
from functools import lru_cache
from importlib import import_module

import cv2
import numpy as np
from trimesh.transformations import quaternion_from_matrix

from sonar_gl.types import Error, Ping

# Fields of apl-ocean-engineering/marine_msgs 2.0.2, in their order.
DTYPES = ("UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "UINT64", "INT64", "FLOAT32", "FLOAT64")
DEFINITIONS = {
    "marine_acoustic_msgs/msg/PingInfo": """
        float32 frequency
        float32 sound_speed
        float32[] tx_beamwidths
        float32[] rx_beamwidths
    """,
    "marine_acoustic_msgs/msg/SonarImageData": "\n".join(
        [
            "bool is_bigendian",
            *(f"uint32 DTYPE_{name}={number}" for number, name in enumerate(DTYPES)),
            "uint32 dtype",
            "uint32 beam_count",
            "uint8[] data",
        ]
    ),
    "marine_acoustic_msgs/msg/ProjectedSonarImage": """
        std_msgs/Header header
        PingInfo ping_info
        geometry_msgs/Vector3[] beam_directions
        float32[] ranges
        SonarImageData image
    """,
}
# sonar_from_beams by where y points: x down, y to port, z ahead, or x up, y to starboard, z ahead
BEAMS = {
    "port": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "starboard": np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
}
LATEST_S = 2**31  # ROS holds whole seconds in 32 bits with a sign


def library(name: str):
    """A module that the extra `ros` brings, or an Error."""
    try:
        return import_module(name)
    except ImportError:
        raise Error(
            f"ROS 2 bags need rosbags and mcap (got no module {name}; install them with "
            "\"pip install 'sonar_gl[ros]'\")"
        ) from None


def nanoseconds(time_s: float) -> int:
    """A time of the simulation in nanoseconds, the nearest to it; 0 or more and below 2³¹ s, or an Error."""
    if isinstance(time_s, bool) or not isinstance(time_s, (int, float, np.number)):
        raise Error(f"a time in a ROS bag must be a number of seconds (got {time_s!r})")
    if not 0 <= time_s < LATEST_S:  # NaN too
        raise Error(
            f"a time in a ROS bag must lie in 0..{LATEST_S} s (got {time_s:g}; bags know none before 0: "
            "count from the first ping)"
        )
    whole = math.floor(time_s)
    return whole * 10**9 + round(float(time_s - whole) * 1e9)  # the difference is exact


def levels(intensity: np.ndarray, bits: int, scale: str, db_range) -> np.ndarray:
    """Intensity (B, K) as integers of 8, 16 or 32 bits, little endian: (K, B), range by range, port first.

    "db": from db_range[0], which is 0, to db_range[1], the largest integer; "linear": intensity 0..1 so.
    What lies beyond is cut.
    """
    if scale == "db":
        low, high = db_range
        share = np.maximum(intensity, np.float32(10 ** (low / 10)), dtype=np.float32, order="C")
        cv2.log(share, dst=share)
        share *= 10 / math.log(10) / (high - low)
        share -= low / (high - low)
    else:
        share = np.array(intensity, np.float32)
    if bits == 32:  # more than float32 can tell apart
        share = share.astype(np.float64)
    np.clip(share, 0.0, 1.0, out=share)
    share *= 2**bits - 1
    share += 0.5
    return np.ascontiguousarray(share.astype(f"<u{bits // 8}")[::-1].T)


class Messages:
    """The types of messages that a bag of pings needs."""

    def __init__(self):
        typesys = library("rosbags.typesys")
        self.store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for name, text in DEFINITIONS.items():
            text = "\n".join(line.strip() for line in text.split("\n"))
            self.store.register(typesys.get_types_from_msg(text, name))
        self.directions = lru_cache(maxsize=16)(self._directions)
        self.schema = lru_cache(maxsize=None)(self._schema)

    def make(self, name: str, *fields):
        """A message of the type "package/Name", from its fields in their order."""
        package, kind = name.split("/")
        return self.store.types[f"{package}/msg/{kind}"](*fields)

    def encode(self, message) -> bytes:
        """The message's bytes in CDR, little endian."""
        return bytes(self.store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def _schema(self, msgtype: str) -> tuple[str, str]:
        """Definition of a type with all that it is made of, and the hash of both."""
        return self.store.generate_msgdef(msgtype, ros_version=2)[0], self.store.hash_rihs01(msgtype)

    def header(self, time_ns: int, frame: str):
        """std_msgs/Header"""
        return self.make(
            "std_msgs/Header", self.make("builtin_interfaces/Time", *divmod(time_ns, 10**9)), frame
        )

    def _directions(self, table: bytes, y_sign: str) -> list:
        azimuth = np.frombuffer(table)[::-1]
        ahead = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))], axis=1)
        return [self.make("geometry_msgs/Vector3", *xyz) for xyz in (ahead @ BEAMS[y_sign]).tolist()]

    def ping(self, header, ping: Ping, y_sign: str, bits: int, scale: str, db_range):
        """marine_acoustic_msgs/ProjectedSonarImage, beams port first.

        Its readers take beams for sorted by rising atan2(−y, z): where y is to port, by azimuth to starboard.
        """
        try:
            sonar, sound_speed = ping.meta["sonar"], ping.meta["sound_speed_m_s"]
            frequency, width, height = (
                sonar[key] for key in ("frequency_hz", "beam_width_deg", "elevation_fov_deg")
            )
        except (KeyError, TypeError) as why:
            raise Error(
                "meta of a ping in a ROS bag must hold sound_speed_m_s and sonar, with its frequency_hz, "
                f"beam_width_deg and elevation_fov_deg (missing: {why})"
            ) from None
        n_beams = len(ping.azimuth_rad)
        vertical, across = (np.full(n_beams, math.radians(deg), np.float32) for deg in (height, width))
        info = self.make("marine_acoustic_msgs/PingInfo", frequency, sound_speed, vertical, across)
        data = levels(ping.intensity, bits, scale, db_range).reshape(-1).view(np.uint8)
        image = "marine_acoustic_msgs/SonarImageData", False, DTYPES.index(f"UINT{bits}"), n_beams, data
        table = np.ascontiguousarray(ping.azimuth_rad, np.float64).tobytes()
        return self.make(
            "marine_acoustic_msgs/ProjectedSonarImage",
            header,
            info,
            self.directions(table, y_sign),
            np.asarray(ping.range_m, np.float32),
            self.make(*image),
        )

    def image(self, header, pixels: np.ndarray):
        """sensor_msgs/Image of (H, W) or (H, W, 3) RGB uint8, or of (H, W) float32 metres."""
        encoding = "rgb8" if pixels.ndim == 3 else "mono8" if pixels.dtype == np.uint8 else "32FC1"
        pixels = np.ascontiguousarray(pixels, "<f4" if encoding == "32FC1" else np.uint8)
        height, width = pixels.shape[:2]
        data = pixels.reshape(-1).view(np.uint8)
        return self.make("sensor_msgs/Image", header, height, width, encoding, 0, data.size // height, data)

    def camera_info(self, header, height: int, width: int, K: np.ndarray):
        """sensor_msgs/CameraInfo of a pinhole camera without distortion."""
        roi = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        P = np.hstack([K, np.zeros((3, 1))])
        matrices = (m.reshape(-1) for m in (np.zeros(5), K, np.eye(3), P))
        return self.make("sensor_msgs/CameraInfo", header, height, width, "plumb_bob", *matrices, 0, 0, roi)

    def transform(self, time_ns: int, parent: str, child: str, matrix: np.ndarray):
        """geometry_msgs/TransformStamped of (4, 4) parent_from_child."""
        w, x, y, z = quaternion_from_matrix(matrix).tolist()
        place = self.make("geometry_msgs/Vector3", *matrix[:3, 3].tolist())
        turn = self.make("geometry_msgs/Quaternion", x, y, z, w)
        whole = self.make("geometry_msgs/Transform", place, turn)
        return self.make("geometry_msgs/TransformStamped", self.header(time_ns, parent), child, whole)


@lru_cache(maxsize=1)
def messages() -> Messages:
    """The one set of types of this process: reading them takes a tenth of a second."""
    return Messages()
