"""Pings in ROS 2 bags, read back by two independent readers."""

import math
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.beam_pattern import line_array_pattern
from sonar_gl.acoustics.water import Water
from sonar_gl.core.extras import install_command
from sonar_gl.core.poses import pose
from sonar_gl.ping import Ping
from sonar_gl.ros.bag import (
    BagSettings,
    CameraRecord,
    PingRecord,
    bag_metadata,
    read_contents,
    write_part,
)
from sonar_gl.ros.messages import by_range, message_types, nanoseconds
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sonar import Sonar
from tests.support.errors import error_of

AZIMUTH = np.array([-0.6, -0.25, 0.1, 0.5])  # rising, uneven, more to starboard than to port
RANGE_M = np.array([1.0, 1.5, 2.0])
PORT = 3  # number of the beam farthest to port
VEHICLE = pose(3, -2, -5, 0.1, -0.2, 2.0)
SONAR = VEHICLE @ pose(0.4, 0.1, -0.3, pitch=0.3)
IMAGING_SONAR = Sonar("four beams", 900e3, 4, 3, 80.0, 20.0, 1.5, 0.75, 2.25)
ACOUSTICS = Acoustics.ideal().in_water(Water(sound_speed_m_s=1481.5))
SETTINGS = BagSettings()


def make_ping(intensity=None, **changes):
    if intensity is None:  # a different value in every bin, in dB that 8 bits represent exactly
        intensity = 10 ** ((np.arange(12).reshape(4, 3) * 20 / 255 * 60 - 60) / 10)
    fields = {
        "azimuth_rad": AZIMUTH,
        "range_m": RANGE_M,
        "pose": SONAR,
        "sonar": IMAGING_SONAR,
        "acoustics": ACOUSTICS,
    }
    return Ping(intensity.astype(np.float32), **{**fields, **changes})


def record(time_s=1.25, sonar="p900-45", ping=None, **more):
    return PingRecord(time_s, sonar, ping or make_ping(), vehicle_pose=VEHICLE, **more)


def by_mcap(path):
    """Return (topic, time, message) as read by mcap, with the definitions in the file."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        return [(c.topic, m.log_time, message) for _, c, m, message in reader.iter_decoded_messages()]


def by_rosbags(path):
    """Return (topic, time, message) as read by rosbags from a file or a folder."""
    with AnyReader([path]) as reader:
        return [(c.topic, t, reader.deserialize(data, c.msgtype)) for c, t, data in reader.messages()]


READERS = pytest.mark.parametrize("read", [by_mcap, by_rosbags])


def write(folder, *records, settings=SETTINGS, name="part.mcap"):
    write_part(folder / name, records, settings)
    return folder / name


def metadata_of(*parts):
    """Return the text of the metadata.yaml of a bag of these files."""
    contents = []
    for path in parts:
        with path.open("rb") as file:
            contents.append(read_contents(file, path.name))
    return bag_metadata(contents)


def only(messages, topic):
    (found,) = [message for name, _, message in messages if name == topic]
    return found


def matrix(transform):
    x, y, z, w = (getattr(transform.rotation, name) for name in "xyzw")
    out = np.eye(4)
    half_turn = 2 * math.atan2(math.hypot(x, y, z), w)
    axis = np.array([x, y, z]) / max(math.hypot(x, y, z), 1e-12)
    out[:3, :3] = cv2.Rodrigues(axis * half_turn)[0]
    out[:3, 3] = [getattr(transform.translation, name) for name in "xyz"]
    return out


def placed(messages, frame):
    """Return (4, 4) world_from_frame, by the last messages of /tf and /tf_static."""
    links = {
        link.child_frame_id: link
        for t, _, m in messages
        if t in ("/tf", "/tf_static")
        for link in m.transforms
    }
    out = np.eye(4)
    while frame != "world":
        out, frame = matrix(links[frame].transform) @ out, links[frame].header.frame_id
    return out


def test_a_path_may_be_text(tmp_path):
    for path in (tmp_path / "path.mcap", str(tmp_path / "text.mcap")):
        write_part(path, [PingRecord(0.0, "a", make_ping())], SETTINGS)
    assert (tmp_path / "text.mcap").read_bytes() == (tmp_path / "path.mcap").read_bytes()


@READERS
def test_the_sound_speed_is_the_one_that_ranges_are_calculated_with(tmp_path, read):
    """Of a sonar set to another speed than its water has, which shows echoes at other ranges than their own."""
    acoustics = Acoustics(water=Water(sound_speed_m_s=1450.0), sonar_sound_speed_m_s=1500.0)
    ping, types = make_ping(acoustics=acoustics), message_types()
    projected = only(read(write(tmp_path, record(ping=ping))), "/p900_45/projected_image")
    raw = types.raw_ping(types.header(0, "beams"), ping, "port")
    assert (projected.ping_info.sound_speed, raw.ping_info.sound_speed) == (1500.0, 1500.0)
    assert raw.sample_rate == 1500.0 / (2 * ping.bin_size_m)


@READERS
def test_every_field_of_a_ping(tmp_path, read):
    messages = read(write(tmp_path, record()))
    assert {t for _, t, _ in messages} == {1_250_000_000}
    message = only(messages, "/p900_45/projected_image")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 250_000_000)
    assert message.header.frame_id == "p900_45_beams"
    info, image = message.ping_info, message.image
    assert (info.frequency, info.sound_speed) == (900e3, 1481.5)
    np.testing.assert_array_equal(info.tx_beamwidths, np.full(4, np.radians(20), np.float32))
    np.testing.assert_array_equal(info.rx_beamwidths, np.full(4, np.radians(1.5), np.float32))
    directions = np.array([[d.x, d.y, d.z] for d in message.beam_directions])
    port_first = AZIMUTH[::-1]
    expected = np.stack([0 * port_first, np.sin(port_first), np.cos(port_first)], axis=1)
    np.testing.assert_allclose(directions, expected, atol=1e-15)
    np.testing.assert_array_equal(message.ranges, RANGE_M.astype(np.float32))
    assert (image.is_bigendian, image.dtype, image.beam_count) == (False, 0, 4)
    # range by range, port first, 20 levels from bin to bin of a beam
    expected = [20 * (3 * beam + k) for k in range(3) for beam in (3, 2, 1, 0)]
    assert list(bytes(image.data)) == expected


@READERS
def test_beams_of_one_straight_array_are_as_wide_as_they_are_aside(tmp_path, read):
    """Where the power of the pattern is half of that on the axis."""
    ping = make_ping(sonar=replace(IMAGING_SONAR, steered="straight"), acoustics=Acoustics.physical())
    widths = only(
        read(write(tmp_path, record(ping=ping))), "/p900_45/projected_image"
    ).ping_info.rx_beamwidths
    for width, steer in zip(widths, AZIMUTH[::-1], strict=True):
        azimuth = np.linspace(steer - 0.1, steer + 0.1, 20001)
        above = azimuth[line_array_pattern(azimuth, steer, math.radians(1.5), steered="straight") > 0.5]
        assert width == pytest.approx(above[-1] - above[0], abs=1e-4)


@READERS
@pytest.mark.parametrize("y_sign", ["port", "starboard"])
def test_a_target_to_port_is_to_port(tmp_path, read, y_sign):
    intensity = np.zeros((4, 3))
    intensity[PORT, 1] = 0.5
    messages = read(write(tmp_path, record(ping=make_ping(intensity)), settings=BagSettings(y_sign)))
    message = only(messages, "/p900_45/projected_image")
    k, beam = divmod(int(np.argmax(np.frombuffer(bytes(message.image.data), np.uint8))), 4)
    d = message.beam_directions[beam]
    assert (d.y > 0) == (y_sign == "port") and abs(d.y) == pytest.approx(math.sin(0.5), abs=1e-15)
    # the frames put it at its position in the world
    found = placed(messages, message.header.frame_id) @ [*(message.ranges[k] * v for v in (d.x, d.y, d.z)), 1]
    true = SONAR @ [1.5 * math.cos(0.5), 1.5 * math.sin(0.5), 0, 1]
    np.testing.assert_allclose(found, true, atol=1e-7)  # quaternions by an eigenvalue problem
    # shown by beam number from the smallest bearing on, with bearings to the right, it is on the left
    assert beam == 0
    if y_sign == "port":
        bearings = [math.atan2(-v.y, v.z) for v in message.beam_directions]
        assert bearings == sorted(bearings) and bearings[beam] < 0


@pytest.mark.parametrize("y_sign", ["port", "starboard"])
def test_beams_are_those_of_the_tilted_head(tmp_path, y_sign):
    tilted = replace(IMAGING_SONAR, tilt_deg=10.0)
    one = record(ping=make_ping(sonar=tilted))
    messages = by_rosbags(write(tmp_path, one, settings=BagSettings(y_sign)))
    np.testing.assert_allclose(placed(messages, "p900_45"), SONAR, atol=1e-7)
    ahead = placed(messages, "p900_45_beams")[:3, 2]
    np.testing.assert_allclose(ahead, (SONAR @ pose(pitch=math.radians(10)))[:3, 0], atol=1e-7)


def test_the_frames_have_the_documented_directions(tmp_path):
    for y_sign, down in (("port", 1), ("starboard", -1)):
        messages = by_rosbags(write(tmp_path, record(), settings=BagSettings(y_sign)))
        np.testing.assert_allclose(placed(messages, "base_link"), VEHICLE, atol=1e-7)
        np.testing.assert_allclose(placed(messages, "p900_45"), SONAR, atol=1e-7)
        turn = np.linalg.inv(SONAR) @ placed(messages, "p900_45_beams")
        np.testing.assert_allclose(turn @ [1, 0, 0, 0], [0, 0, -down, 0], atol=1e-7)
        np.testing.assert_allclose(turn @ [0, 1, 0, 0], [0, down, 0, 0], atol=1e-7)
        np.testing.assert_allclose(turn @ [0, 0, 1, 0], [1, 0, 0, 0], atol=1e-7)
    alone = by_rosbags(write(tmp_path, PingRecord(0.0, "a", make_ping())))
    np.testing.assert_allclose(placed(alone, "a"), SONAR, atol=1e-7)
    assert "base_link" not in {
        link.child_frame_id for t, _, m in alone if t == "/tf" for link in m.transforms
    }


@pytest.mark.parametrize("shape", [(1, 1), (4, 1), (1, 4), (5, 2)])
def test_counts_go_range_by_range_from_port(shape):
    counts = np.arange(math.prod(shape), dtype=np.uint16).reshape(shape)
    found = by_range(counts)
    assert found.flags.c_contiguous and found.dtype == np.dtype("<u2")
    np.testing.assert_array_equal(found, counts[::-1].T)


@pytest.mark.parametrize(("bits", "dtype"), [(8, 0), (16, 2)])
def test_a_bag_has_the_counts_of_the_sonar(tmp_path, bits, dtype):
    law = Counts("power", exponent=0.5, bits=bits)
    ping = make_ping(sonar=replace(IMAGING_SONAR, counts=law))
    image = only(by_mcap(write(tmp_path, record(ping=ping))), "/p900_45/projected_image").image
    assert (image.dtype, image.is_bigendian) == (dtype, False)
    data = np.frombuffer(bytes(image.data), f"<u{bits // 8}").reshape(3, 4)
    np.testing.assert_array_equal(data, by_range(law.apply(ping.intensity)))


def test_times_are_the_nearest_nanosecond():
    assert nanoseconds(0) == 0
    assert nanoseconds(0.1 + 0.2) == 300_000_000
    assert nanoseconds(1.9999999999) == 2_000_000_000
    # a product of the whole time would exceed 2 ** 53 and lose the last digits
    assert nanoseconds(2147483647.25) == 2147483647_250_000_000
    assert nanoseconds(np.float32(0.5)) == 500_000_000
    assert nanoseconds(12_345_678.000000001) == 12_345_678_000_000_000 + round(
        (12_345_678.000000001 - 12_345_678) * 1e9
    )
    for wrong in (-1e-9, 2.0**31, math.nan, math.inf):
        assert "must lie in 0..2147483648 s" in error_of(nanoseconds, wrong)
    for wrong in ("1", None, True):
        assert "must be a number of seconds" in error_of(nanoseconds, wrong)


@READERS
def test_pictures_gray_and_coloured(tmp_path, read):
    rng = np.random.default_rng(1)
    gray, colour = rng.random((3, 5)).astype(np.float32), rng.integers(0, 256, (3, 5, 3), np.uint8)
    deep = rng.integers(0, 65536, (3, 5), np.uint16)
    for picture, encoding, step in ((gray, "mono8", 5), (deep, "mono16", 10), (colour, "rgb8", 15)):
        image = only(read(write(tmp_path, record(picture=picture))), "/p900_45/image")
        assert (image.height, image.width, image.encoding, image.step) == (3, 5, encoding, step)
        assert image.is_bigendian == 0 and image.header.frame_id == "p900_45_beams"
        expected = picture if encoding != "mono8" else np.rint(picture * 255).astype(np.uint8)
        assert bytes(image.data) == expected.tobytes()


@READERS
def test_a_camera(tmp_path, read):
    rng = np.random.default_rng(2)
    colour, depth = rng.integers(0, 256, (3, 5, 3), np.uint8), rng.random((3, 5)).astype(np.float32)
    depth[0, 0] = np.nan
    K = np.array([[400.0, 0.0, 2.0], [0.0, 410.0, 1.0], [0.0, 0.0, 1.0]])
    camera = CameraRecord(2.0, SONAR, K, colour, depth, VEHICLE)
    messages = read(write(tmp_path, camera))
    image, distance, info = (only(messages, f"/camera/{name}") for name in ("image", "depth", "camera_info"))
    assert {m.header.frame_id for m in (image, distance, info)} == {"camera_optical"}
    assert {m.header.stamp.sec for m in (image, distance, info)} == {2}
    assert (image.encoding, image.step) == ("rgb8", 15) and bytes(image.data) == colour.tobytes()
    assert (distance.encoding, distance.step) == ("32FC1", 20) and bytes(distance.data) == depth.tobytes()
    assert (info.height, info.width, info.distortion_model) == (3, 5, "plumb_bob")
    assert list(info.d) == [0] * 5 and list(info.k) == K.ravel().tolist()
    assert list(info.r) == np.eye(3).ravel().tolist()
    assert list(info.p) == np.hstack([K, np.zeros((3, 1))]).ravel().tolist()
    assert (info.binning_x, info.roi.do_rectify) == (0, False)
    turn = np.linalg.inv(SONAR) @ placed(messages, "camera_optical")
    expected = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(turn, expected, atol=1e-7)


def split_bag(folder):
    """Make a bag of two parts with two sonars, one part with a camera that comes late."""
    folder.mkdir(exist_ok=True)
    eye = CameraRecord(
        1.0, SONAR, np.eye(3), np.zeros((2, 2), np.uint8), np.ones((2, 2), np.float32), VEHICLE
    )
    times = 0.1 + 0.5 * np.arange(5)
    pings = [[record(t, name) for name in ("left", "right")] for t in times]
    first = write(folder, *pings[0], *pings[1], eye, name="b.mcap")
    second = write(folder, *pings[2], *pings[3], *pings[4], name="a.mcap")
    (folder / "metadata.yaml").write_text(metadata_of(second, first), encoding="utf-8")
    return folder, first, second


def test_a_bag_of_two_parts(tmp_path):
    folder, first, second = split_bag(tmp_path / "bag")
    messages = by_rosbags(folder)
    assert [t for _, t, _ in messages] == sorted(t for _, t, _ in messages)
    assert [(name, t) for name, t, _ in messages] == [
        (name, t) for path in (first, second) for name, t, _ in by_mcap(path)
    ]
    with Reader(folder) as reader:
        # rosbags' end is after the last message
        assert reader.start_time == 100_000_000 and reader.duration == 2_000_000_001
        assert reader.message_count == len(messages)
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        assert counts["/left/projected_image"] == counts["/right/projected_image"] == 5
        assert counts["/camera/image"] == counts["/camera/camera_info"] == 1
        assert counts["/tf_static"] == 5  # each part repeats them, as frames come
        files = {file["path"]: file for file in reader.storage.files}
        assert list(files) == ["b.mcap", "a.mcap"]
        assert [file["starting_time"]["nanoseconds_since_epoch"] for file in files.values()] == [
            100_000_000,
            1_100_000_000,
        ]
        assert [file["duration"]["nanoseconds"] for file in files.values()] == [900_000_000, 1_000_000_000]
        assert sum(file["message_count"] for file in files.values()) == len(messages)
        hashes = {connection.msgtype: connection.digest for connection in reader.connections}
        latched = {
            c.topic
            for c in reader.connections
            for qos in c.ext.offered_qos_profiles
            if qos.durability is QosDurability.TRANSIENT_LOCAL
        }
    assert latched == {"/tf_static"}
    # as published by ROS 2
    assert hashes["sensor_msgs/msg/Image"].startswith("RIHS01_d31d41a9a4c4bc8e")
    assert hashes["tf2_msgs/msg/TFMessage"].startswith("RIHS01_e369d0f05a23ae52")
    assert hashes["marine_acoustic_msgs/msg/ProjectedSonarImage"].startswith("RIHS01_")


def test_the_last_message_of_tf_static_has_all_frames(tmp_path):
    _, first, second = split_bag(tmp_path / "bag")
    for path, frames in (
        (first, ["left_beams", "right_beams", "camera_optical"]),
        (second, ["left_beams", "right_beams"]),
    ):
        *_, last = [m for topic, _, m in by_mcap(path) if topic == "/tf_static"]
        assert [link.child_frame_id for link in last.transforms] == frames


def test_each_time_has_one_transform_of_the_vehicle(tmp_path):
    path = write(tmp_path, record(1.0, "left"), record(1.0, "right"), record(1.5, "left"))
    frames = [
        (t, link.child_frame_id) for topic, t, m in by_mcap(path) if topic == "/tf" for link in m.transforms
    ]
    assert len(set(frames)) == len(frames) == 5


def test_definitions_include_their_constants(tmp_path):
    with AnyReader([write(tmp_path, record())]) as reader:
        image = reader.typestore.types["marine_acoustic_msgs/msg/SonarImageData"]
        found = {name[6:]: getattr(image, name) for name in vars(image) if name.startswith("DTYPE_")}
    numbers = {
        "UINT8": 0,
        "INT8": 1,
        "UINT16": 2,
        "INT16": 3,
        "UINT32": 4,
        "INT32": 5,
        "UINT64": 6,
        "INT64": 7,
    }
    assert found == numbers | {"FLOAT32": 8, "FLOAT64": 9}


def test_a_part_includes_the_metadata_of_a_bag(tmp_path):
    """Without their version, newer ROS misreads /tf_static of a file that is opened without its folder."""
    path = write(tmp_path, record(1.0), record(3.0))
    with path.open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    beside = metadata_of(path).splitlines()
    assert beside[0] == "rosbag2_bagfile_information:" and beside[1] == "  version: 8"
    assert metadata.name == "rosbag2"
    inside = metadata.metadata["serialized_metadata"].splitlines()
    names = beside.index("  relative_file_paths:")
    assert inside[: names - 1] == [line[2:] for line in beside[1:names]]
    # only the folder has them
    assert inside[names - 1 : names + 1] == ["relative_file_paths: []", "files: []"]


def test_the_same_records_give_the_same_bytes(tmp_path):
    folder, *_ = split_bag(tmp_path / "one")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    message_types.cache_clear()
    folder, *_ = split_bag(tmp_path / "two")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert sorted(before) == ["a.mcap", "b.mcap", "metadata.yaml"]
    assert write(tmp_path, record()).read_bytes() == write(tmp_path, record(), name="b.mcap").read_bytes()


def test_invalid_records_are_refused(tmp_path):
    def error(*records):
        return error_of(write_part, tmp_path / "part.mcap", records, SETTINGS)

    assert "must be in the order of their times (got 1 s after 2 s)" in error(record(2.0), record(1.0))
    assert "0..2147483648 s (got -1" in error(record(-1.0))
    assert "begin with a letter from A to Z (got '3d')" in error(record(sonar="3d"))
    clash = error(record(sonar="a-b"), record(sonar="a b"))
    assert "sonar 'a b' and that of sonar 'a-b', both 'a_b'" in clash
    assert "of sonar 'base-link' and that of a frame" in error(record(sonar="base-link"))
    needed = "a ping in a ROS message must have sonar and acoustics"
    assert f"{needed} (missing: acoustics)" in error(record(ping=make_ping(acoustics=None)))
    without = make_ping(sonar=None, acoustics=None)
    assert f"{needed} (missing: sonar and acoustics)" in error(record(ping=without))
    assert "the picture of 'p900_45' in a ROS bag must have shape" in error(record(picture=np.zeros(3)))
    assert "vehicle_pose must be a rotation" in error(
        PingRecord(1.0, "a", make_ping(), vehicle_pose=2 * np.eye(4))
    )
    assert list(tmp_path.iterdir()) == []  # not even an unfinished file


def test_invalid_parts_are_refused(tmp_path):
    first = write(tmp_path, record(1.0), record(2.0), name="a.mcap")
    second = write(tmp_path, record(1.5), name="b.mcap")
    assert "(got a.mcap until 2 s and b.mcap from 1.5 s)" in error_of(metadata_of, second, first)
    assert "b.mcap" in metadata_of(write(tmp_path, record(2.0), name="b.mcap"), first)
    complete = second.read_bytes()
    for broken in (complete[:-100], b"", b"\x89MCAP0\r\n" + bytes(200), b"text"):
        second.write_bytes(broken)
        assert "'b.mcap' must be a complete part" in error_of(metadata_of, second)


def test_the_error_without_the_extra_says_how_to_add_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap.writer", None)  # as if it were not installed
    why = error_of(write, tmp_path, record())
    assert why == (
        "ROS 2 bags need rosbags, mcap and ruamel.yaml (got no module mcap.writer); to add it: "
        + install_command("ros")
    )
    assert list(tmp_path.iterdir()) == []
