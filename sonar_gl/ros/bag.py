"""Pings as ROS 2 bags of MCAP files, written without ROS.

A part of a batch is one file. `bag_metadata` makes the files of a folder one bag, in the form in which ROS
splits long recordings.

Frames: `sonar` is the sonar's own, x forward, y to port, z up, and `sonar_beams` that of its messages, see
`messages.BEAMS`. Likewise `camera`, and `camera_optical` with x right, y down, z forward.

`messages` makes the messages. mcap writes the files: its writer adds no time or version, guards chunks by
CRC, and compresses by LZ4. For a ping of 256 x 1161 bins that takes 0.4 ms and
leaves 0.73 of the size; Zstandard takes 2.4 ms and leaves 0.58.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from sonar_gl.core.atomic_file import atomic_write
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_extra
from sonar_gl.core.poses import check_pose
from sonar_gl.embed.camera import SONAR_FROM_OPTICAL
from sonar_gl.imaging.files import whole_numbers
from sonar_gl.ping import Ping
from sonar_gl.ros.messages import BEAMS, TF, TF_STATIC, message_types, nanoseconds

WORLD, VEHICLE, CAMERA = "world", "base_link", "camera"  # frames
CHUNK_BYTES = 1 << 20
METADATA_VERSION = 8  # read by ROS 2 Iron and later
FOREVER = {"sec": 9223372036, "nsec": 854775807}  # 2⁶³ − 1 ns, as ROS writes it
# Quality of service of /tf_static: reliable, transient local, depth 1, so that late subscribers get the last
# message. Three copies of FOREVER, since YAML would write the same object as an anchor.
LATCHED = [
    {
        "history": 1,
        "depth": 1,
        "reliability": 1,
        "durability": 1,
        "deadline": dict(FOREVER),
        "lifespan": dict(FOREVER),
        "liveliness": 1,
        "liveliness_lease_duration": dict(FOREVER),
        "avoid_ros_namespace_conventions": False,
    }
]


def _libraries() -> SimpleNamespace:
    """Return the modules of the extra `ros`, loaded on first use, or raise an Error."""
    try:
        import mcap.reader
        import mcap.writer
        import rosbags.typesys  # noqa: F401 (`messages` uses it)
        import ruamel.yaml
    except ImportError as why:
        needs = "ROS 2 bags need rosbags, mcap and ruamel.yaml"
        raise missing_extra("ros", f"{needs} (got no module {why.name})") from None
    return SimpleNamespace(reader=mcap.reader, writer=mcap.writer, yaml=ruamel.yaml)


# ---- records: what goes into a bag ------------------------------------------------------------------


@dataclass(frozen=True)
class BagSettings:
    """How pings are written.

    y_sign : direction of y of beam_directions: "port", as sonar_image_proc reads them, in a frame with x
        down; or "starboard", as the message's documentation says, in a frame with x up. z is forward
    """

    y_sign: str = "port"


@dataclass(frozen=True, eq=False)
class PingRecord:
    """One ping for a bag: topics /sonar/projected_image and /sonar/image, and its frames in /tf.

    time_s : time of transmission, seconds of the simulation, 0 or more
    sonar : name of the sonar; characters that are no letters or digits become "_"
    ping : with its pose, sonar and acoustics, as `Simulator.ping` gives it; the sonar's counts are written
    picture : None, or the fan image: (H, W) or (H, W, 3) RGB, uint8 or float 0..1, or (H, W) uint16
    vehicle_pose : None, or (4, 4) world_from_vehicle; the sonar's frame is then a child of the vehicle's
    """

    time_s: float
    sonar: str
    ping: Ping
    picture: np.ndarray | None = None
    vehicle_pose: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class CameraRecord:
    """One camera image for a bag: /camera/image, /camera/depth, /camera/camera_info, and its frames in /tf.

    time_s, vehicle_pose : as for a PingRecord
    pose : (4, 4) world_from_camera, x forward, y to port, z up, as for a sonar
    intrinsics : (3, 3), as for `Camera`; pixels count from the centre of the first
    picture : (H, W) or (H, W, 3) RGB, uint8 or float 0..1
    depth_m : (H, W) float32 of the same size, along the optical axis; NaN or infinity where no body is
    """

    time_s: float
    pose: np.ndarray
    intrinsics: np.ndarray
    picture: np.ndarray
    depth_m: np.ndarray
    vehicle_pose: np.ndarray | None = None


# ---- a part and a bag -------------------------------------------------------------------------------


def write_part(path, records: Iterable, settings: BagSettings) -> None:
    """Write pings and camera images as one MCAP file; the same records give the same bytes under any name.

    Parameters
    ----------
    path : ends in .mcap; its folder exists
    records : PingRecord and CameraRecord, at least one, by time; may be a generator
    settings : BagSettings

    Raises
    ------
    Error
        if times fall or ROS cannot store them, names clash, something in a record is wrong, the file cannot be
        written, or the extra `ros` is not installed.

    Notes
    -----
    The frames of /tf are world → base_link, the vehicle, where its pose is given → each sonar and camera, at
    the time of each record. /tf_static rotates a sensor's own frame to that of its messages. Every file has
    it, so that each can be read alone.
    """
    with atomic_write(Path(path)) as temporary, temporary.open("wb") as file:
        part = _PartWriter(BagFile(file), settings)
        for record in records:
            part.add(record)
        part.file.finish()


class _PartWriter:
    def __init__(self, file: BagFile, settings: BagSettings):
        self.file, self.settings, self.types = file, settings, file.types
        self.time_ns = -1  # of the last record
        self._placed, self._fixed = set(), {}  # frames placed at that time; static transforms by frame
        self._names = dict.fromkeys((WORLD, VEHICLE, CAMERA), "of a frame")

    def add(self, record) -> None:
        time_ns = nanoseconds(record.time_s)
        if time_ns < self.time_ns:
            got = f"got {record.time_s:g} s after {self.time_ns / 1e9:g} s"
            raise Error(f"records of a part must be in the order of their times ({got})")
        if time_ns > self.time_ns:
            self.time_ns, self._placed = time_ns, set()
        (self._add_ping if isinstance(record, PingRecord) else self._add_camera)(record)

    def _add_ping(self, record: PingRecord) -> None:
        name, ping = self._name(record.sonar), record.ping
        turn = BEAMS[self.settings.y_sign]
        if ping.sonar is not None:
            turn = ping.sonar.sonar_from_head[:3, :3] @ turn
        header = self._place(name, ping.pose, "_beams", turn, record.vehicle_pose)
        self._put(f"/{name}/projected_image", self.types.ping(header, ping, self.settings.y_sign))
        self._put_picture(name, header, record)

    def _add_camera(self, record: CameraRecord) -> None:
        header = self._place(CAMERA, record.pose, "_optical", SONAR_FROM_OPTICAL, record.vehicle_pose)
        self._put_picture(CAMERA, header, record)
        self._put(f"/{CAMERA}/depth", self.types.image(header, record.depth_m))
        info = self.types.camera_info(header, *record.depth_m.shape, record.intrinsics)
        self._put(f"/{CAMERA}/camera_info", info)

    def _put_picture(self, name: str, header, record) -> None:
        if record.picture is not None:
            picture = whole_numbers(record.picture, f"the picture of {name!r} in a ROS bag")
            self._put(f"/{name}/image", self.types.image(header, picture))

    def _put(self, topic: str, message) -> None:
        self.file.put(self.time_ns, topic, message)

    def _name(self, name: str) -> str:
        """Return the name of a sonar in a form that ROS allows; an Error if another name has the same form."""
        short = re.sub("[^A-Za-z0-9]+", "_", name).strip("_")
        if not short[:1].isalpha():
            raise Error(
                f"the name of a sonar in a ROS bag must begin with a letter from A to Z (got {name!r})"
            )
        owner = f"of sonar {name!r}"
        if self._names.setdefault(short, owner) != owner:
            raise Error(
                f"names in a ROS bag must differ in letters and digits (got that {owner} and that "
                f"{self._names[short]}, both {short!r})"
            )
        return short

    def _place(self, name: str, pose, suffix: str, turn: np.ndarray, vehicle_pose):
        """Write the transforms of a sensor, and return the header of messages in the frame name + suffix.

        turn : (3, 3) sensor_from_frame
        """
        parent, links, time_ns, types = WORLD, [], self.time_ns, self.types
        parent_from_sensor = check_pose(pose, f"pose of {name!r}")
        if vehicle_pose is not None:
            vehicle = check_pose(vehicle_pose, "vehicle_pose")
            links.append((WORLD, VEHICLE, vehicle))
            parent, parent_from_sensor = VEHICLE, np.linalg.inv(vehicle) @ parent_from_sensor
        links.append((parent, name, parent_from_sensor))
        frame = name + suffix
        if frame not in self._fixed:
            fixed = np.eye(4)
            fixed[:3, :3] = turn
            self._fixed[frame] = types.transform(time_ns, name, frame, fixed)
            # all static transforms each time, since late subscribers get the last message only
            self._put(TF_STATIC, types.transforms(list(self._fixed.values())))
        links = [link for link in links if link[1] not in self._placed]
        self._placed.update(child for _, child, _ in links)
        if links:
            self._put(TF, types.transforms([types.transform(time_ns, *link) for link in links]))
        return types.header(time_ns, frame)


# ---- files ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BagContents:
    """The contents of an MCAP file."""

    name: str  # name of the file in its folder
    # start_ns, end_ns: times of the first and the last message
    start_ns: int
    end_ns: int
    topics: dict[str, tuple[str, int]]  # topic -> type and number of its messages

    @property
    def count(self) -> int:
        return sum(count for _, count in self.topics.values())


class BagFile:
    """Writes an MCAP file to an open binary file; messages come in the order of their times."""

    def __init__(self, file):
        mcap = _libraries().writer
        self.types = message_types()
        self._writer = mcap.Writer(file, CHUNK_BYTES, mcap.CompressionType.LZ4)
        self._writer.start("ros2", "sonar_gl")
        self._start_ns = self._end_ns = None
        self._topics, self._channels, self._schemas = {}, {}, {}

    def put(self, time_ns: int, topic: str, message) -> None:
        msgtype = message.__msgtype__
        if topic not in self._channels:
            text, digest = self.types.schema(msgtype)
            if msgtype not in self._schemas:
                self._schemas[msgtype] = self._writer.register_schema(msgtype, "ros2msg", text.encode())
            meta = {"offered_qos_profiles": _qos(topic), "topic_type_hash": digest}
            schema = self._schemas[msgtype]
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, meta)
        data = self.types.encode(message)
        self._writer.add_message(self._channels[topic], time_ns, data, time_ns)
        self._start_ns, self._end_ns = time_ns if self._start_ns is None else self._start_ns, time_ns
        self._topics[topic] = (msgtype, self._topics.get(topic, ("", 0))[1] + 1)

    def finish(self) -> None:
        """End the file, with the metadata that ROS reads from a file without its folder."""
        metadata = _bag_information([BagContents("", self._start_ns, self._end_ns, self._topics)])
        metadata |= {"relative_file_paths": [], "files": []}
        self._writer.add_metadata("rosbag2", {"serialized_metadata": _to_yaml(metadata)})
        self._writer.finish()


def read_contents(file, name: str) -> BagContents:
    """Read the summary of an open MCAP file; an Error if it is no complete file of `write_part`."""
    reader = _libraries().reader
    try:
        summary = reader.make_reader(file).get_summary()
        statistics, channels, schemas = summary.statistics, summary.channels, summary.schemas
        topics = {
            channel.topic: (schemas[channel.schema_id].name, statistics.channel_message_counts[number])
            for number, channel in channels.items()
        }
        return BagContents(name, statistics.message_start_time, statistics.message_end_time, topics)
    except Exception:  # bytes of another kind raise anything
        raise Error(f"{name!r} must be a complete part of a bag, an MCAP file (make it again)") from None


def bag_metadata(parts: Iterable[BagContents]) -> str:
    """Return the text of metadata.yaml, by which ROS opens the folder of these files as a bag.

    parts : of `read_contents`, at least one, in any order; Error if two of them overlap in time
    """
    parts = sorted(parts, key=lambda part: (part.start_ns, part.end_ns, part.name))
    for former, latter in pairwise(parts):
        if latter.start_ns < former.end_ns:
            raise Error(
                f"parts of a bag must follow one another in time (got {former.name} until "
                f"{former.end_ns / 1e9:g} s and {latter.name} from {latter.start_ns / 1e9:g} s)"
            )
    return _to_yaml({"rosbag2_bagfile_information": _bag_information(parts)})


def _bag_information(files: list[BagContents]) -> dict:
    """Return ROS's metadata of a bag of these files, which are in the order of their times."""
    topics = {}
    for file in files:
        for topic, (msgtype, count) in file.topics.items():
            topics[topic] = msgtype, count + topics.get(topic, ("", 0))[1]
    start, end = files[0].start_ns, files[-1].end_ns
    return {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        **_span(start, end, sum(file.count for file in files)),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": msgtype,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": _qos(topic),
                    "type_description_hash": message_types().schema(msgtype)[1],
                },
                "message_count": count,
            }
            for topic, (msgtype, count) in sorted(topics.items())
        ],
        "compression_format": "",  # of whole files or messages; MCAP compresses its chunks
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [{"path": f.name, **_span(f.start_ns, f.end_ns, f.count)} for f in files],
        "custom_data": {},
        "ros_distro": "",
    }


def _span(start_ns: int, end_ns: int, count: int) -> dict:
    return {
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "duration": {"nanoseconds": end_ns - start_ns},
        "message_count": count,
    }


def _qos(topic: str) -> str:
    """Return the quality of service of a topic as YAML; empty for ROS's default."""
    return _to_yaml(LATCHED) if topic == TF_STATIC else ""


def _to_yaml(value) -> str:
    yaml = _libraries().yaml.YAML(typ="safe", pure=True)
    yaml.default_flow_style, yaml.sort_base_mapping_type_on_output, yaml.width = False, False, 1000
    text = io.StringIO()
    yaml.dump(value, text)
    return text.getvalue()
