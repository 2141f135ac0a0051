"""Pings as ROS 2 bags of MCAP files, written without ROS.

A part of a batch is one file; `finish_bag` makes the files of a folder one bag, as ROS splits long ones.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np

from sonar_gl.batch.ros_files import TF_STATIC, BagFile, Contents, information, read_contents, to_yaml
from sonar_gl.batch.ros_messages import BEAMS, nanoseconds
from sonar_gl.batch.ros_records import BagSettings, CameraRecord, PingRecord
from sonar_gl.camera import AHEAD
from sonar_gl.export import eight_bit
from sonar_gl.rigid import check_pose
from sonar_gl.types import Error, check_kind, frozen_array
from sonar_gl.whole import replacing

WORLD, VEHICLE, TF = "world", "base_link", "/tf"  # frames and a topic


def write_part(path, records: Iterable, settings: BagSettings | None = None) -> None:
    """Write pings and camera images as one MCAP file; the same records give the same bytes under any name.

    Parameters
    ----------
    path : ends in .mcap; its folder exists
    records : PingRecord and CameraRecord, at least one, in the order of their times; may be a generator
    settings : None is `BagSettings()`

    Raises
    ------
    Error
        if times fall or ROS cannot hold them, names clash, something of a record is wrong or missing, the
        file cannot be written, or rosbags or mcap is not installed.

    Notes
    -----
    The frames of /tf are world → base_link, the vehicle, where its pose is given → each sonar and camera, at
    the time of each record. /tf_static turns a sensor's own frame to that of its messages; every file has it,
    so that each can be read alone.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise Error(f"{str(path)!r} must end in .mcap (got {path.suffix or 'no suffix'})")
    settings = BagSettings() if settings is None else settings
    check_kind("settings", settings, BagSettings, "such as BagSettings(bits=16)")
    with replacing(path) as beside, beside.open("wb") as file:
        part = _Part(BagFile(file), settings)
        for record in records:
            check_kind("a record", record, PingRecord | CameraRecord, "a bag holds these and CameraRecord")
            part.add(record)
        if part.time_ns < 0:
            raise Error(f"{str(path)!r}: a part must hold at least one record (got none)")
        part.file.finish()


def finish_bag(folder, part_files: Iterable) -> Path:
    """Make a bag of the parts in a folder: write `metadata.yaml`, by which ROS opens the folder.

    Parameters
    ----------
    folder : where the parts are
    part_files : their names, in any order; of a path the last part counts

    Returns
    -------
    path of metadata.yaml

    Raises
    ------
    Error
        if there is no part, one is not there or no whole MCAP file, or two overlap in time.
    """
    folder, parts = Path(folder), []
    for name in (Path(name).name for name in part_files):
        try:
            with (folder / name).open("rb") as file:
                parts.append(read_contents(file, name))
        except OSError as why:
            reason = (why.strerror or str(why)).lower()
            raise Error(f"cannot read the part {str(folder / name)!r} of a bag: {reason}") from None
    text = bag_metadata(parts)
    target = folder / "metadata.yaml"
    with replacing(target) as beside:
        beside.write_text(text, encoding="utf-8")
    return target


def bag_metadata(parts: Iterable[Contents]) -> str:
    """Text of the metadata.yaml of a bag of these files, in any order, as `finish_bag` writes it.

    For folders that are not of this machine: `ros_files.read_contents` reads any open file.
    """
    parts = sorted(parts, key=lambda part: (part.start_ns, part.end_ns, part.name))
    if not parts:
        raise Error("a bag must have at least one part (got none)")
    for former, latter in pairwise(parts):
        if latter.start_ns < former.end_ns:
            raise Error(
                f"parts of a bag must follow one another in time (got {former.name} until "
                f"{former.end_ns / 1e9:g} s and {latter.name} from {latter.start_ns / 1e9:g} s)"
            )
    return to_yaml({"rosbag2_bagfile_information": information(parts)})


class _Part:
    """Records on their way into a file."""

    def __init__(self, file: BagFile, settings: BagSettings):
        self.file, self.settings, self.make = file, settings, file.messages
        self.time_ns = -1  # of the last record
        self._placed, self._fixed = set(), {}  # frames placed at that time; transforms that stay, by frame
        self._names = {WORLD: "of a frame", VEHICLE: "of a frame"}

    def add(self, record) -> None:
        """Write the messages of a record."""
        time_ns = nanoseconds(record.time_s)
        if time_ns < self.time_ns:
            got = f"got {record.time_s:g} s after {self.time_ns / 1e9:g} s"
            raise Error(f"records of a part must come in the order of their times ({got})")
        if time_ns > self.time_ns:
            self.time_ns, self._placed = time_ns, set()
        (self._add_ping if isinstance(record, PingRecord) else self._add_camera)(record)

    def _add_ping(self, record: PingRecord) -> None:
        name, ping, settings = self._name(record.sonar, "sonar"), record.ping, self.settings
        if ping.pose is None:
            raise Error(f"a ping of sonar {record.sonar!r} in a ROS bag must have its pose (got None)")
        header = self._place(name, ping.pose, "_beams", BEAMS[settings.y_sign], record.vehicle_pose)
        message = self.make.ping(
            header, ping, settings.y_sign, settings.bits, settings.scale, settings.db_range
        )
        self._put(f"/{name}/projected_image", message)
        self._put_picture(name, header, record)

    def _add_camera(self, record: CameraRecord) -> None:
        name, what = self._name(record.camera, "camera"), f"of camera {record.camera!r}"
        K = frozen_array(record.intrinsics, np.float64, (3, 3), f"intrinsics {what}")
        images = [image for image in (record.picture, record.depth_m) if image is not None]
        sizes = {np.shape(image)[:2] for image in images}
        if len(sizes) != 1:
            got = "neither" if not sizes else " and ".join(map(str, sorted(sizes)))
            raise Error(f"a record {what} must have a picture, a depth image, or both of a size (got {got})")
        header = self._place(name, record.pose, "_optical", AHEAD, record.vehicle_pose)
        self._put_picture(name, header, record)
        if record.depth_m is not None:
            depth = np.asarray(record.depth_m)
            if depth.ndim != 2 or depth.dtype.kind != "f" or not depth.size:
                raise Error(f"depth_m {what} must be (H, W) floats (got {depth.shape}, {depth.dtype})")
            self._put(f"/{name}/depth", self.make.image(header, depth.astype(np.float32, copy=False)))
        self._put(f"/{name}/camera_info", self.make.camera_info(header, *sizes.pop(), K))

    def _put_picture(self, name: str, header, record) -> None:
        if record.picture is not None:
            picture = eight_bit(np.asarray(record.picture), f"the picture of {name!r} in a ROS bag")
            self._put(f"/{name}/image", self.make.image(header, picture))

    def _put(self, topic: str, message) -> None:
        self.file.put(self.time_ns, topic, message)

    def _name(self, name: str, kind: str) -> str:
        """A name as ROS takes it, which no other has."""
        check_kind(f"the name of a {kind}", name, str, "ROS calls its topics and frames by it")
        short = re.sub("[^A-Za-z0-9]+", "_", name).strip("_")
        if not short[:1].isalpha():
            raise Error(
                f"the name of a {kind} in a ROS bag must begin with a letter from A to Z (got {name!r})"
            )
        if self._names.setdefault(short, f"of {kind} {name!r}") != f"of {kind} {name!r}":
            raise Error(
                f"names in a ROS bag must differ in letters and digits (got that of {kind} {name!r} and that "
                f"{self._names[short]}, both {short!r})"
            )
        return short

    def _place(self, name: str, pose, suffix: str, turn: np.ndarray, vehicle_pose):
        """Say where a sensor is; the header of what it says in the frame `turn` of it."""
        parent, chain, time_ns, make = WORLD, [], self.time_ns, self.make
        parent_from_sensor = check_pose(pose, f"pose of {name!r}")
        if vehicle_pose is not None:
            vehicle = check_pose(vehicle_pose, "vehicle_pose")
            chain.append((WORLD, VEHICLE, vehicle))
            parent, parent_from_sensor = VEHICLE, np.linalg.inv(vehicle) @ parent_from_sensor
        chain.append((parent, name, parent_from_sensor))
        frame = name + suffix
        if frame not in self._fixed:
            fixed = np.eye(4)
            fixed[:3, :3] = turn
            self._fixed[frame] = make.transform(time_ns, name, frame, fixed)
            # all of them each time, for only the last message is kept
            self._put(TF_STATIC, make.make("tf2_msgs/TFMessage", list(self._fixed.values())))
        chain = [link for link in chain if link[1] not in self._placed]
        self._placed.update(link[1] for link in chain)
        if chain:
            self._put(TF, make.make("tf2_msgs/TFMessage", [make.transform(time_ns, *link) for link in chain]))
        return make.header(time_ns, frame)
