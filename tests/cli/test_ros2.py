"""The command `ros2`, with a transport within the process."""

import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from click.testing import CliRunner

import sonar_gl as sg
from sonar_gl import ros
from sonar_gl.cli.main import main
from sonar_gl.cli.ros2_file import read_ros2_file
from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Topic
from tests.support.command_line import BODY, WALL
from tests.support.loopback_transport import LoopbackTransport
from tests.support.pose_messages import odometry

FAST = ("--range", "10", "--bins", "50", "--profile", "ideal", "--noise", "none", "--tolerance", "0.2")


class Transports(dict):
    """The transports that a command makes, by kind, and their arguments."""

    def __init__(self, monkeypatch):
        super().__init__()
        self.arguments = {}
        for name in ("DdsTransport", "ZenohTransport", "FoxgloveTransport"):
            monkeypatch.setitem(vars(ros), name, self._maker(name))  # without loading it

    def _maker(self, name):
        def make(**arguments):
            self.arguments[name] = arguments
            self[name] = LoopbackTransport()
            return self[name]

        return make


@pytest.fixture
def transports(monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    return Transports(monkeypatch)


def run(*words):
    return CliRunner().invoke(main, ["ros2", *words])


def test_a_mistake_of_the_user_is_told_before_a_missing_extra(monkeypatch):
    for name in ("cyclonedds", "zenoh", "foxglove", "rosbags"):
        monkeypatch.setitem(sys.modules, name, None)  # importing it now fails
    for kind in ("dds", "zenoh", "foxglove"):
        for words, message in (
            (["nosuchscene"], "there is no bundled scene 'nosuchscene' (known are "),
            (["pylon", "--sonar", "nosuch"], "unknown sonar (got 'nosuch'; known are "),
            (["pylon", "--rate", "-1"], "rate_hz must lie in 0.001..1000 (got -1; pings per second)\n"),
        ):
            done = run(*words, "--transport", kind)
            assert done.exit_code == 2 and done.output.startswith(f"error: {message}")


def test_a_port_that_is_taken_is_a_mistake_of_the_user(tmp_path):
    pytest.importorskip("foxglove")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        (tmp_path / "taken.toml").write_text(f"[foxglove]\nport = {port}\n")
        found = run("pylon", *FAST, "--transport", "foxglove", "--config", str(tmp_path / "taken.toml"))
    assert found.exit_code == 2  # as of `sonar-gl emulate`
    assert f"must be able to listen at 127.0.0.1:{port} (got address already in use" in found.output


@pytest.mark.slow
def test_it_publishes_in_real_time_until_the_duration_has_passed(transports, caplog):
    with caplog.at_level(logging.INFO):
        found = run("pylon", *FAST, "--duration", "0.6", "--rate", "10")
    assert found.exit_code == 0, found.output
    assert "by dds, 10 pings/s; scene pylon" in found.output
    # once: a terminal shows the log as well
    assert found.output.count("pings published") == 1 and "pings published" not in caplog.text
    transport = transports["DdsTransport"]
    assert transport.is_closed and transports.arguments == {"DdsTransport": {"domain": 0, "node": "sonar"}}
    images = transport.messages("/sonar/projected_image")
    assert 1 <= len(images) <= 6
    stamps = [m.header.stamp.sec + m.header.stamp.nanosec / 1e9 for m in images]
    assert stamps == sorted(stamps) and stamps[0] >= 0 and stamps[-1] < 0.7


def test_several_transports_carry_the_same_bytes(transports, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    found = run(
        "pylon",
        *FAST,
        "--duration",
        "0.2",
        "--transport",
        "zenoh",
        "--transport",
        "foxglove",
        "--name",
        "rov/eye",
    )
    assert found.exit_code == 0, found.output
    zenoh, foxglove = (transports[name].sent for name in ("ZenohTransport", "FoxgloveTransport"))
    assert zenoh == foxglove and {t.name for t, _, _ in zenoh} >= {"/rov/eye/image", "/tf", "/clock"}
    assert transports.arguments == {"ZenohTransport": {"domain": 7, "node": "eye"}, "FoxgloveTransport": {}}


def test_the_file_sets_options_and_topics_and_the_command_line_comes_first(transports, tmp_path):
    (tmp_path / "dive.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,-3,0,0,0\n9,0,0,-3,0,0,0\n")
    (tmp_path / "topics.toml").write_text(
        'poses = "dive.csv"\nrate = 5\nname = "front"\ntransport = ["zenoh"]\nworld_frame = "map"\n'
        'vehicle_frame = "base_link"\nmount = [0.5, 0, 0, 0, 0, 0]\n'
        '[topics]\nimage = "/fan"\nraw_image = false\npoints = false\n'
        '[image]\nheight = 100\ncolormap = "jet"\n[zenoh]\nconnect = "tcp/10.0.0.1:7447"\n'
    )
    found = run(
        "pylon", *FAST, "--config", str(tmp_path / "topics.toml"), "--duration", "0.3", "--rate", "20"
    )
    assert found.exit_code == 0, found.output
    assert "/front/projected_image, /fan, /tf, /clock by zenoh, 20 pings/s" in found.output
    assert transports.arguments["ZenohTransport"]["connect"] == "tcp/10.0.0.1:7447"
    transport = transports["ZenohTransport"]
    image = transport.messages("/fan")[0]
    assert (image.height, image.encoding) == (100, "rgb8")
    link = transport.messages("/tf")[0].transforms[0]
    assert (link.header.frame_id, link.child_frame_id, link.transform.translation.z) == (
        "map",
        "base_link",
        -3,
    )


@pytest.mark.parametrize("words", [pytest.param((), marks=pytest.mark.slow), ("--pose", "1 2 -3 0 0 0.5")])
def test_the_scene_places_the_sonar_and_the_option_the_vehicle_that_carries_it(transports, tmp_path, words):
    mount = [0.5, 0.1, -0.2, 0.1, 0.2, 0.3]
    (tmp_path / "rov.toml").write_text(f'vehicle_frame = "base_link"\nmount = {mount}\n')
    quick = "pylon", *FAST, "--duration", "0.3", "--rate", "20", "--config", str(tmp_path / "rov.toml")
    found = run(*quick, *words)
    assert found.exit_code == 0, found.output
    transport = transports["DdsTransport"]
    (link,) = transport.messages("/tf")[0].transforms
    vehicle = sg.pose(1, 2, -3, yaw=0.5)
    if not words:
        vehicle = sg.load_scene("pylon").sonar_pose @ np.linalg.inv(sg.pose(*mount))
    assert link.child_frame_id == "base_link"
    at = link.transform.translation
    assert (at.x, at.y, at.z) == pytest.approx(tuple(vehicle[:3, 3]))


@pytest.mark.parametrize(
    ("words", "is_warned"),
    [
        (("--pose-from", "pose=/rov/pose"), True),
        (("--pose-from", "pose=/rov/pose", "--bodies-from", "/rov/bodies"), False),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in ((("--pose-from", "pose=/rov/pose", "--without", "rov*"), False), ((), False))
        ),
    ],
)
def test_a_hull_that_stays_behind_is_warned_of(transports, tmp_path, words, is_warned):
    world = f'<sdf version="1.9"><world name="any">{WALL}{BODY.format("rov", "-0.5 0 0", "0.4 0.4 0.2")}</world></sdf>'
    mount = '<link name="mount"><pose>0.5 0 0 0 0 0</pose><sensor name="sonar" type="custom"/></link></model></world>'
    path = tmp_path / "rov.sdf"
    path.write_text(world.replace("</model></world>", mount).replace("</model>\n</world>", mount))
    found = run(str(path), *FAST, "--duration", "0.1", *words)
    assert found.exit_code == 0, found.output
    assert ("model 'rov', which carries it, stays where it is" in found.output) == is_warned


@pytest.mark.slow
def test_counts_are_those_of_the_option_else_of_the_file(transports, tmp_path):
    (tmp_path / "deep.toml").write_text('counts = "bits=16"\n')
    quick = "pylon", *FAST, "--duration", "0.3", "--rate", "20", "--config", str(tmp_path / "deep.toml")
    for words, of_image, of_ping in (((), "mono16", 2), (("--counts", "gain_percentile=97"), "mono8", 0)):
        found = run(*quick, *words)
        assert found.exit_code == 0, found.output
        transport = transports["DdsTransport"]
        assert transport.messages("/sonar/image")[0].encoding == of_image
        assert (
            transport.messages("/sonar/projected_image")[0].image.dtype == of_ping
        )  # DTYPE_UINT8, DTYPE_UINT16
    found = run(*quick, "--counts", "bits=12")
    assert (found.exit_code, "counts: bits must be 8 or 16 (got 12; " in found.output) == (
        2,
        True,
    )


def test_time_and_poses_come_from_other_programs(transports, monkeypatch):
    """With /clock at the times of a bag, a thousand times quicker than real time."""
    types, at = message_types(), sg.load_scene("pylon").sonar_pose
    came = threading.Event()

    def clock(publisher, name="/clock"):
        times = make_clock(publisher, name)
        wait = times.wait
        numbers = iter(range(200))

        def next_time(timeout_s):
            number = next(numbers, None)
            if number is None:
                raise KeyboardInterrupt
            transport = transports["DdsTransport"]
            if number == 50:
                transport.inject("/odom", odometry(at))
                came.set()
            transport.inject("/clock", types.encode(types.clock(10**9 + number * 10**7)))
            return wait(timeout_s)

        times.wait = next_time
        return times

    make_clock = ros.Publisher.clock
    monkeypatch.setattr(ros.Publisher, "clock", clock)
    found = run("pylon", *FAST, "--clock", "ros", "--rate", "10", "--pose-from", "odometry=/odom")
    assert found.exit_code == 0 and came.is_set(), found.output
    transport = transports["DdsTransport"]
    assert "/clock" not in {topic.name for topic, _, _ in transport.sent}
    first = transport.messages("/sonar/projected_image")[0]
    assert (first.header.stamp.sec, first.header.stamp.nanosec) == (1, 5 * 10**8)
    translation = transport.messages("/tf")[0].transforms[0].transform.translation
    np.testing.assert_array_equal([translation.x, translation.y, translation.z], at[:3, 3])


@pytest.mark.slow
def test_it_says_that_no_clock_comes(transports, monkeypatch, caplog):
    monkeypatch.setattr("sonar_gl.cli.ros2.CLOCK_REPORT_S", 0.15)
    found = run("pylon", *FAST, "--clock", "ros", "--duration", "0.4")
    assert found.exit_code == 0 and "0 pings published" in found.output
    # one each 0.15 s, of which two end within 0.4 s; one where the machine is busy
    assert set(caplog.messages) >= {
        "no /clock has come yet; a simulator publishes it, or ros2 bag play --clock"
    }
    assert sum("no /clock" in message for message in caplog.messages) <= 2


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--topics", "image,fan"), "--topics must be some of projected_image,raw_image,image"),
        (("--pose-from", "/odom"), "a source of poses must be odometry=TOPIC, pose=TOPIC or tf=FRAME"),
        (("--pose-from", "tf=a", "--pose", "0 0 0 0 0 0"), "--pose-from excludes --pose and --poses"),
        (("--rate", "0"), "rate_hz must lie in 0.001..1000"),
        (("--name", "a b"), "the name of a sonar must be the full name of a topic"),
        (("--acoustics", "needed"), "--acoustics needed must know the poses beforehand"),
        (("--duration", "-1"), "--duration must lie in"),
        (("--config", "none.toml"), "none.toml: the file of --config must be readable"),
    ],
)
def test_mistakes_are_told_in_a_sentence(words, why, transports):
    found = run("pylon", *words)
    assert found.exit_code == 2 and f"error: {why}" in found.output and "Traceback" not in found.output
    assert not transports


def test_a_wrong_domain_of_the_environment_is_told(transports, monkeypatch):
    for text in ("one", "233", "-1"):
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
        found = run("pylon", *FAST)
        assert (
            found.exit_code == 2 and "error: ROS_DOMAIN_ID must be a whole number in 0..232" in found.output
        )


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("rates = 5", "the file: unknown key (got 'rates'; did you mean 'rate' or "),
        ("[topics]\nfan = '/a'", "topics: unknown key (got 'fan'"),
        ("rate = '5'", "rate: should be a valid number (got '5')"),
        ("transport = ['mqtt']", "transport[0]: should be 'dds', 'zenoh' or 'foxglove' (got 'mqtt')"),
        ("without = 'pylon'", "without: should be a valid list (got 'pylon'; write [\"pylon\"])"),
        ("[topics]\nimage = true", "topics.image: should be the name of a topic, or false for none"),
        ("water = {temperature_c = 4}", "water: should be a valid string (got a table of temperature_c;"),
        ("mount = [1, 2]", "mount: should have a length of at least 6 (got [1"),
        ("[foxglove]\nport = 70000", "foxglove.port: should be less than or equal to 65535 (got 70000"),
        ("rate = ", "the file of --config must be TOML"),
        ("world_frame = '/a'", "world_frame must be the name of a frame"),
        ("[topics]\nimage = 'fan'", "the topic 'image' must be the full name of a topic"),
    ],
)
def test_mistakes_in_the_file_are_told_with_its_name_and_key(text, why, transports, tmp_path):
    path = tmp_path / "topics.toml"
    path.write_text(text + "\n")
    found = run("pylon", "--config", str(path))
    assert found.exit_code == 2 and f"error: {path}: {why}" in found.output
    assert not transports


@pytest.mark.parametrize(
    ("text", "words", "why"),
    [
        ('without = ["*"]', (), "--without and --only must leave a body (they leave out all "),
        ('only = ["wreck"]', (), "got 'wreck'"),
        (
            'without = ["wreck"]',
            ("--without", "*"),
            "--without and --only must leave a body (they leave out all ",
        ),
    ],
)
def test_the_file_leaves_out_bodies_unless_the_command_line_does(text, words, why, transports, tmp_path):
    path = tmp_path / "topics.toml"
    path.write_text(text)
    found = run("pylon", "--config", str(path), *words)
    assert found.exit_code == 2 and why in found.output
    assert not transports


@pytest.mark.parametrize("name", ["mine.toml", "a,b.toml"])
@pytest.mark.parametrize("rest", ["", "#front", ",bandwidth_hz=30e3", "#front, bandwidth_hz = 30e3"])
def test_the_files_of_a_file_lie_beside_it(tmp_path, monkeypatch, name, rest):
    (tmp_path / "there").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    path, sonar, poses = (tmp_path / "there" / file for file in ("topics.toml", name, "dive,1.csv"))
    path.write_text(f'sonar = "{name}{rest}"\nposes = "dive,1.csv"\n')
    sonar.write_text("")
    poses.write_text("")
    found = read_ros2_file(path)
    assert (found.sonar, found.poses) == (f"{sonar}{rest}", str(poses))


@pytest.mark.parametrize("sonar", ["p900-45", "p900-45,bandwidth_hz=30e3", "other.toml#front"])
def test_what_does_not_lie_beside_the_file_stays(tmp_path, sonar):
    path = tmp_path / "topics.toml"
    path.write_text(f'sonar = "{sonar}"\nposes = "none,1.csv"\n')
    assert (read_ros2_file(path).sonar, read_ros2_file(path).poses) == (sonar, "none,1.csv")


def test_an_empty_file_changes_nothing(tmp_path):
    path = tmp_path / "empty.toml"
    path.write_text("")
    assert not read_ros2_file(path).model_dump(exclude_defaults=True)


WAIT_S = 120.0  # a machine that tests run on may be slow, and compile kernels first


@pytest.mark.slow
def test_poses_and_time_go_in_and_pings_come_out_over_dds(tmp_path):
    """As with a simulator beside it: this process sends /clock and odometry, the command publishes pings."""
    pytest.importorskip("cyclonedds")
    types, at, domain = message_types(), sg.load_scene("pylon").sonar_pose, 100 + os.getpid() % 100
    images, links, image = [], [], "marine_acoustic_msgs/msg/ProjectedSonarImage"

    transport = ros.DdsTransport(domain=domain)
    log = (tmp_path / "log").open("w+")
    words = [
        "--transport",
        "dds",
        "--domain",
        str(domain),
        "--duration",
        str(WAIT_S),
        "--clock",
        "ros",
        "--rate",
        "10",
    ]
    words += ["--pose-from", "odometry=/rov/odometry"]
    command = subprocess.Popen(
        [sys.executable, "-m", "sonar_gl", "ros2", "pylon", *FAST, *words],
        stdout=log,
        stderr=subprocess.STDOUT,
    )
    try:
        clock = Topic.of_type("/clock", "rosgraph_msgs/msg/Clock", depth=1)
        poses = Topic.of_type("/rov/odometry", "nav_msgs/msg/Odometry")
        transport.subscribe(
            Topic.of_type("/sonar/projected_image", image),
            lambda data: images.append(types.decode(data, image)),
        )
        transport.subscribe(
            Topic.of_type("/tf", "tf2_msgs/msg/TFMessage"),
            lambda data: links.extend(types.decode(data, "tf2_msgs/msg/TFMessage").transforms),
        )
        end_s, number = time.monotonic() + WAIT_S, 0
        while len(images) < 3 and time.monotonic() < end_s and command.poll() is None:
            number += 1
            time_ns = 10**10 + number * 10**7
            transport.publish(clock, types.encode(types.clock(time_ns)), time_ns)
            transport.publish(poses, odometry(at, time_ns=time_ns), time_ns)
            time.sleep(0.01)
        command.send_signal(signal.SIGTERM)  # SIGINT is ignored by what a shell starts in the background
        status = command.wait(WAIT_S)
        log.seek(0)
        assert status == 0, log.read()
        log.seek(0)
        assert re.search(r"^[1-9]\d* pings published", log.read(), re.MULTILINE)
    finally:
        command.kill()
        command.wait()
        transport.close()
        log.close()
    stamps_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in images]
    assert len(stamps_ns) >= 3 and all(ns % 10**7 == 0 for ns in stamps_ns)  # those of the clock
    assert stamps_ns == sorted(set(stamps_ns))
    assert (
        len(images[0].beam_directions) == sg.load_sonar("p900-45").n_beams and max(images[0].image.data) > 0
    )
    place = links[0].transform.translation
    np.testing.assert_array_equal([place.x, place.y, place.z], at[:3, 3])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--seed", "-1"), "seed must be a whole number, 0 or more (got -1)"),
        (("--tolerance", "nan"), "tolerance must be a number in 0.001..0.5 (got nan; 0.01 is one per cent)"),
        (
            ("--topics", ""),
            "--topics must name one or more of projected_image,raw_image,image,points,tf,clock (got none)",
        ),
        (
            ("--topics", "clock", "--clock", "ros"),
            "some topic must be published (got none; /clock is sent with --clock own alone)",
        ),
    ],
)
def test_what_makes_no_ping_is_told_before_a_transport_opens(transports, words, message):
    """A wrong seed was told by the first ping, after the topics were announced."""
    found = run("pylon", *FAST, *words, "--duration", "0.1")
    assert (found.exit_code, found.output.splitlines()[-1]) == (2, f"error: {message}")
    assert not transports
