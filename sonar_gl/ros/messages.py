"""Messages of ROS 2 and their bytes, in bags and live topics alike; nothing of ROS is needed.

rosbags encodes and decodes them, since it is quick with arrays.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from sonar_gl.core.checks import is_number, shown
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_extra
from sonar_gl.ping import Ping

TF, TF_STATIC = "/tf", "/tf_static"  # topics
# sonar_from_beams by the direction of y: x down, y to port, z forward; or x up, y to starboard, z forward
BEAMS = {
    "port": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "starboard": np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
}
MAX_TIME_S = 2**31  # ROS stores whole seconds in 32 signed bits
# Definitions of apl-ocean-engineering/marine_msgs 2.0.2, fields in their order.
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
    "marine_acoustic_msgs/msg/RawSonarImage": """
        std_msgs/Header header
        PingInfo ping_info
        float32 sample_rate
        uint32 samples_per_beam
        uint32 sample0
        float32[] tx_delays
        float32[] tx_angles
        float32[] rx_angles
        SonarImageData image
    """,
}


def nanoseconds(time_s: float) -> int:
    """Return the nearest nanosecond to a time of the simulation in seconds; an Error outside 0..2³¹ s."""
    if not is_number(time_s):
        raise Error(f"a time of ROS must be a number of seconds (got {time_s!r})")
    if not 0 <= time_s < MAX_TIME_S:  # NaN too
        raise Error(
            f"a time of ROS must lie in 0..{MAX_TIME_S} s (got {time_s:g}; ROS has no times below 0: "
            "count from the first ping)"
        )
    seconds = math.floor(time_s)
    return seconds * 10**9 + round(float(time_s - seconds) * 1e9)  # the difference is exact


def by_range(counts: np.ndarray) -> np.ndarray:
    """Return counts (B, K) as little-endian integers (K, B), range by range, port first."""
    return np.ascontiguousarray(counts[::-1].T, counts.dtype.newbyteorder("<"))


def _typesys():
    """Return the module of rosbags that knows the types, loaded on first use, or raise an Error."""
    try:
        import rosbags.typesys
    except ImportError as why:
        raise missing_extra("ros", f"ROS 2 messages need rosbags (got no module {why.name})") from None
    return rosbags.typesys


class MessageTypes:
    """The types of ROS 2 messages about pings and poses, those of Humble and of DEFINITIONS.

    schema : function of a type's name such as "sensor_msgs/msg/Image" to its definition, which includes those of its
        fields, and the hash of both; an Error if the type is another
    """

    def __init__(self):
        from trimesh.transformations import quaternion_from_matrix  # trimesh takes a second to load

        typesys = _typesys()
        self._quaternion = quaternion_from_matrix
        self._store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        self._unknown_type = typesys.TypesysError
        for name, text in DEFINITIONS.items():
            text = "\n".join(line.strip() for line in text.split("\n"))
            self._store.register(typesys.get_types_from_msg(text, name))
        self._directions = lru_cache(maxsize=16)(self._make_directions)
        self.schema = lru_cache(maxsize=None)(self._make_schema)

    def make(self, name: str, *fields):
        """Return a message of the type "package/Name" with fields in their order."""
        package, kind = name.split("/")
        return self._store.types[f"{package}/msg/{kind}"](*fields)

    def encode(self, message) -> bytes:
        """Return a message in CDR, little endian."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def decode(self, data: bytes, msgtype: str):
        """Return the message in CDR bytes of the type "package/msg/Name".

        Raises Error if the bytes are no such message. They may be anything: lengths are checked before memory is taken.
        """
        # 0 0 is big endian, 0 1 little; other marks are encodings that ROS does not use
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise Error(
                f"{msgtype} must begin with the mark of CDR (got {bytes(data[:4]).hex() or 'no bytes'})"
            )
        try:
            return self._store.deserialize_cdr(data, msgtype)
        except Exception as why:  # wrong bytes raise anything
            raise Error(
                f"{msgtype} must be whole, in CDR (got {len(data)} bytes, {type(why).__name__})"
            ) from None

    def _make_schema(self, msgtype: str) -> tuple[str, str]:
        """Return the definition of a type, including those of its fields, and the hash of both."""
        try:
            return self._store.generate_msgdef(msgtype, ros_version=2)[0], self._store.hash_rihs01(msgtype)
        except self._unknown_type:
            raise Error(
                "the type of a message must be one of ROS 2 Humble or of a ping, such as 'sensor_msgs/msg/Image' "
                f"(got {shown(msgtype)})"
            ) from None

    def header(self, time_ns: int, frame: str):
        """Return a std_msgs/Header."""
        return self.make(
            "std_msgs/Header", self.make("builtin_interfaces/Time", *divmod(time_ns, 10**9)), frame
        )

    def _make_directions(self, table: bytes, y_sign: str) -> list:
        """Return the unit vectors of beams, port first, from the bytes of their azimuths."""
        azimuth = np.frombuffer(table)[::-1]
        forward = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))], axis=1)
        return [self.make("geometry_msgs/Vector3", *xyz) for xyz in (forward @ BEAMS[y_sign]).tolist()]

    def _ping_parts(self, ping: Ping) -> tuple:
        """Return the PingInfo and the SonarImageData of a ping, beams port first."""
        missing = [name for name in ("sonar", "acoustics") if getattr(ping, name) is None]
        if missing:
            raise Error(
                f"a ping in a ROS message must have sonar and acoustics (missing: {' and '.join(missing)})"
            )
        sonar, n_beams, data = ping.sonar, len(ping.azimuth_rad), by_range(ping.counts())
        acoustics = ping.acoustics
        info = self.make(
            "marine_acoustic_msgs/PingInfo",
            sonar.frequency_hz,
            # "speed of sound used to calculate ranges": the one that the sonar assumes
            acoustics.assumed_sound_speed_m_s(),
            np.full(n_beams, math.radians(sonar.elevation_fov_deg), np.float32),
            acoustics.receive_widths_rad(sonar, ping.azimuth_rad[::-1]).astype(np.float32),
        )
        dtype = DTYPES.index(f"UINT{8 * data.itemsize}")
        data = data.reshape(-1).view(np.uint8)
        return info, self.make("marine_acoustic_msgs/SonarImageData", False, dtype, n_beams, data)

    def ping(self, header, ping: Ping, y_sign: str):
        """Return a marine_acoustic_msgs/ProjectedSonarImage, beams port first.

        Readers expect beams sorted by rising atan2(−y, z): with y to port, by azimuth to starboard.

        y_sign : a key of BEAMS
        """
        info, image = self._ping_parts(ping)
        table = np.ascontiguousarray(ping.azimuth_rad, np.float64).tobytes()
        directions = self._directions(table, y_sign)
        ranges = np.asarray(ping.range_m, np.float32)
        return self.make("marine_acoustic_msgs/ProjectedSonarImage", header, info, directions, ranges, image)

    def raw_ping(self, header, ping: Ping, y_sign: str):
        """Return a marine_acoustic_msgs/RawSonarImage, beams port first, a sample for each bin.

        Sample n, counted from the transmission, has its middle at range (n + 1/2) c / (2 sample_rate), where c is the
        sound speed of the message. sample0 is the first one's number; where range_min_m is no multiple of a bin, it is
        rounded. The angle of a received beam is its turn about x, atan2(−y, z), in the frame that `y_sign` selects.
        """
        info, image = self._ping_parts(ping)
        n_beams, bin_size_m = len(ping.azimuth_rad), ping.bin_size_m
        to_port = ping.azimuth_rad[::-1].astype(np.float32)
        return self.make(
            "marine_acoustic_msgs/RawSonarImage",
            header,
            info,
            info.sound_speed / (2 * bin_size_m),
            len(ping.range_m),
            max(0, round(float(ping.range_m[0]) / bin_size_m - 0.5)),
            np.zeros(n_beams, np.float32),
            np.zeros(n_beams, np.float32),
            -to_port if y_sign == "port" else to_port,
            image,
        )

    def points(self, header, points: np.ndarray, intensity: np.ndarray):
        """Return a sensor_msgs/PointCloud2 of (H, W, 3) points, metres, NaN where there is none, and (H, W) intensity.

        Fields are x, y, z and intensity, float32.
        """
        height, width = intensity.shape
        numbers = np.concatenate([points, intensity[..., None]], axis=-1).astype("<f4")
        is_dense = bool(np.isfinite(numbers).all())
        fields = [
            self.make("sensor_msgs/PointField", name, 4 * number, 7, 1)  # 7 is FLOAT32
            for number, name in enumerate(("x", "y", "z", "intensity"))
        ]
        data = numbers.reshape(-1).view(np.uint8)
        return self.make(
            "sensor_msgs/PointCloud2", header, height, width, fields, False, 16, 16 * width, data, is_dense
        )

    def clock(self, time_ns: int):
        """Return a rosgraph_msgs/Clock."""
        return self.make("rosgraph_msgs/Clock", self.make("builtin_interfaces/Time", *divmod(time_ns, 10**9)))

    def transforms(self, links: list):
        """Return a tf2_msgs/TFMessage of what `transform` returns."""
        return self.make("tf2_msgs/TFMessage", links)

    def image(self, header, pixels: np.ndarray):
        """Return a sensor_msgs/Image of (H, W) uint8 or uint16, (H, W, 3) RGB uint8, or (H, W) float32 metres."""
        encodings = {np.uint8: "mono8", np.uint16: "mono16", np.float32: "32FC1"}
        encoding = "rgb8" if pixels.ndim == 3 else encodings[pixels.dtype.type]
        pixels = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
        height, width = pixels.shape[:2]
        data = pixels.reshape(-1).view(np.uint8)
        return self.make("sensor_msgs/Image", header, height, width, encoding, 0, data.size // height, data)

    def camera_info(self, header, height: int, width: int, K: np.ndarray):
        """Return the sensor_msgs/CameraInfo of a pinhole camera without distortion."""
        roi = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        P = np.hstack([K, np.zeros((3, 1))])
        matrices = (m.reshape(-1) for m in (np.zeros(5), K, np.eye(3), P))
        return self.make("sensor_msgs/CameraInfo", header, height, width, "plumb_bob", *matrices, 0, 0, roi)

    def transform(self, time_ns: int, parent: str, child: str, matrix: np.ndarray):
        """Return the geometry_msgs/TransformStamped of (4, 4) parent_from_child."""
        w, x, y, z = self._quaternion(matrix).tolist()
        translation = self.make("geometry_msgs/Vector3", *matrix[:3, 3].tolist())
        rotation = self.make("geometry_msgs/Quaternion", x, y, z, w)
        transform = self.make("geometry_msgs/Transform", translation, rotation)
        return self.make("geometry_msgs/TransformStamped", self.header(time_ns, parent), child, transform)


@lru_cache(maxsize=1)
def message_types() -> MessageTypes:
    """Return the message types of this process; reading them takes a tenth of a second."""
    return MessageTypes()
