"""The example clients, run as their readers do: beside the real commands, on loopback.

Clients are processes of their own, but for those that end at once. Commands run in this process, where kernels are
loaded; a slow test of tests/cli/test_ros2.py has a process of its own.

All look at a ball to port, whose nearest point has a range and a bearing of closed form.
"""

import contextlib
import math
import os
import re
import runpy
import select
import signal
import subprocess
import sys
import time
from array import array
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sonar_gl.ros.messages import message_types
from sonar_gl.ros.publisher_settings import TOPICS, PublisherSettings
from tests.support import commands_beside
from tests.support.live_messages import free_port, ping_message

ROOT = Path(__file__).resolve().parents[2]
WAIT_S = 200.0  # a machine that tests run on may be slow, and compile kernels first
BALL, RADIUS_M = (6.0, 2.0), 0.3  # where its middle is, x and y in metres
NEAREST_M, BEARING_DEG = math.hypot(*BALL) - RADIUS_M, math.degrees(math.atan2(BALL[1], BALL[0]))
RANGE_ERROR_M = 0.13  # of the middle of a patch of 0.25 m that holds the nearest point
# automatic gain brings beams about the middle of the ball, half of its 5.4°, to full scale
BEARING_ERROR_DEG = 1.5
FAST = "--profile", "ideal", "--noise", "none", "--tolerance", "0.1"
SCENE = f"""<sdf version="1.9"><world name="ball">
  <model name="sonar"><pose>0 0 -3 0 0 0</pose>
    <link name="link"><sensor name="imaging_sonar" type="custom"/></link></model>
  <model name="ball"><pose>{BALL[0]} {BALL[1]} -3 0 0 0</pose>
    <link name="link"><collision name="ball"><geometry><sphere><radius>{RADIUS_M}</radius></sphere></geometry>
      <laser_retro>200</laser_retro></collision></link></model>
</world></sdf>"""
BRIGHTEST = (
    r"brightest patch \d+% of full scale, at (?P<range>[\d.]+) m and (?P<bearing>[\d.]+)° to (?P<side>\w+)"
)

pytestmark = pytest.mark.timeout(WAIT_S + 60)


@pytest.fixture
def scene(tmp_path):
    """The path of the ball's scene."""
    path = tmp_path / "ball.sdf"
    path.write_text(SCENE)
    return str(path)


@contextlib.contextmanager
def running(program, until):
    """Run a program beside a block, once it has printed a text; it ends as by Ctrl-C."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    child = subprocess.Popen(
        [sys.executable, *program],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, cwd=ROOT,
    )  # fmt: skip
    end_s = time.monotonic() + WAIT_S
    try:
        text = b""
        while until not in text.decode(errors="replace"):
            assert time.monotonic() < end_s and child.poll() is None, text.decode()
            if select.select([child.stdout], [], [], 0.1)[0]:
                text += os.read(child.stdout.fileno(), 65536)
        yield
        child.send_signal(signal.SIGINT)
        rest = child.communicate(timeout=WAIT_S)[0]
        assert child.returncode == 0, (text + rest).decode()
    finally:
        child.kill()
        child.communicate()


def run_beside(command, *program):
    """Run a command here until a program has ended beside it; return what both printed."""
    return commands_beside.run_beside(command, lambda: run(*program), WAIT_S)


def run(*program):
    """Run a program to its end; return what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *program], capture_output=True, text=True, timeout=WAIT_S, env=environment, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def run_here(monkeypatch, capsys, *program):
    """Run a program in this process until it exits; return its status, and what it printed to stdout and stderr."""
    monkeypatch.setattr(sys, "argv", list(map(str, program)))
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(ROOT / program[0]), run_name="__main__")
    return caught.value.code, *capsys.readouterr()


def check_ball(line):
    """A line states range and bearing of the ball."""
    found = re.search(BRIGHTEST, line)
    assert found, line
    assert float(found["range"]) == pytest.approx(NEAREST_M, abs=RANGE_ERROR_M)
    assert float(found["bearing"]) == pytest.approx(BEARING_DEG, abs=BEARING_ERROR_DEG)
    assert found["side"] == "port"


def check_picture(path):
    """A picture has the ball, the only echo, to port, which is on the left."""
    picture = cv2.imread(str(path))
    assert picture is not None
    blue, _, red = np.moveaxis(picture.astype(int), 2, 0)
    echo = red - blue > 40  # of the map copper; axes and letters are gray
    left, right = np.array_split(echo, 2, axis=1)
    assert left.sum() > 100 and not right.any()


# ---- topics of ROS 2 ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_subscriber_prints_pings_and_paints_one(scene, tmp_path):
    pytest.importorskip("cyclonedds")
    domain = "--domain", str(100 + os.getpid() % 100)  # programs that run beside tests may use domain 0
    command = ["ros2", scene, "--sonar", "p900-45", "--range", "12", "--rate", "10", *FAST, *domain]
    read = "examples/ros2_subscriber.py", *domain, "--pings", "3", "--out", tmp_path
    printed, lines = run_beside(command, *read)
    assert re.search(r"^[1-9]\d* pings published", printed, re.MULTILINE)
    lines = lines.splitlines()
    assert len(lines) == 3
    stamps_s = []
    for line in lines:
        found = re.match(
            r"sonar_beams at ([\d.]+) s: 256 beams, \d+ ranges from 0.5\d to 1[12].\d\d m; ", line
        )
        assert found, line
        stamps_s.append(float(found[1]))
        check_ball(line)
    assert stamps_s == sorted(set(stamps_s))
    check_picture(tmp_path / "ros2_subscriber.png")


@pytest.mark.slow
def test_poses_of_the_example_move_the_sonar_over_zenoh(scene, tmp_path):
    """The sonar sways across its boresight: the ball stays 6 m ahead, at range 6 m / cos(bearing) less its radius."""
    pytest.importorskip("zenoh")
    port, domain = free_port(), ("--domain", "7")
    router, config = f"tcp/127.0.0.1:{port}", tmp_path / "zenoh.toml"
    config.write_text(f'[zenoh]\nconnect = "{router}"\n')
    over_zenoh = "--transport", "zenoh", *domain
    command = ["ros2", scene, "--sonar", "p900-90", "--range", "12", "--rate", "2", *FAST, *over_zenoh]
    command += ["--pose-from", "pose=/rov/pose", "--config", str(config)]
    poses = ["examples/ros2_poses.py", "--scene", scene, *over_zenoh, "--router", router]

    def read():
        subscriber = "examples/ros2_subscriber.py", "--pings", "6", "--out", tmp_path
        with running(poses, "sends poses"):
            return run(*subscriber, *over_zenoh, "--router", router)

    with running(["examples/zenoh_router.py", "--port", str(port)], "Ctrl-C ends it"):
        printed, lines = commands_beside.run_beside(command, read, WAIT_S)
    assert "ignored" not in printed
    lines, bearings_deg = lines.splitlines(), []
    for line in lines:
        found = re.search(BRIGHTEST, line)
        assert found, line
        sign = 1 if found["side"] == "port" else -1
        bearings_deg.append(sign * float(found["bearing"]))
        range_m = BALL[0] / math.cos(math.radians(bearings_deg[-1])) - RADIUS_M
        # beams about the middle of the ball are at full scale, the first of them up to 1.5 degrees beside it: at 34
        # degrees to port that changes the range of the line by 0.12 m
        assert float(found["range"]) == pytest.approx(range_m, abs=0.15), line
    # in two seconds and a half of a period of 20 s it moves by 0.15 m at least, 1.4 degrees in the worst case
    assert len(lines) == 6 and max(bearings_deg) - min(bearings_deg) > 1.0


def test_a_scene_without_a_place_for_the_sonar_is_told(tmp_path, monkeypatch, capsys):
    pytest.importorskip("cyclonedds")
    path = tmp_path / "none.sdf"
    path.write_text(re.sub(r"<model name=\"sonar\">.*?</model>", "", SCENE, flags=re.DOTALL))
    status, out, err = run_here(monkeypatch, capsys, "examples/ros2_poses.py", "--scene", path)
    assert (status, out) == (2, "")
    assert err.startswith("error: the scene must have a place for the sonar")


def block_of(page, beginning):
    """The code of a page's Python block that begins with a line."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.search(rf"^```python\n({beginning}\n.*?)^```", text, re.DOTALL | re.MULTILINE)[1]


def test_the_node_of_the_page_reads_a_message_by_names_that_it_has(monkeypatch, capsys):
    """With a stand-in for rclpy, as no ROS is here, and a message of a publisher whose arrays are as rclpy has them."""
    pytest.importorskip("rosbags")
    ping, data = ping_message(3, 5)
    message = message_types().decode(data, TOPICS["projected_image"])
    message = replace(message, image=replace(message.image, data=array("B", message.image.data.tobytes())))
    kind, received = object(), []

    def create_subscription(msg_type, topic, callback, qos_profile):
        assert msg_type is kind and topic == PublisherSettings().topic_names["projected_image"]
        assert 0 < qos_profile < 100  # a depth
        received.append(callback)

    node = SimpleNamespace(create_subscription=create_subscription)
    rclpy = SimpleNamespace(
        init=lambda: None, create_node=lambda name: node, spin=lambda node: received[0](message)
    )
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    package, name = TOPICS["projected_image"].split("/msg/")
    monkeypatch.setitem(sys.modules, package, SimpleNamespace())
    monkeypatch.setitem(sys.modules, f"{package}.msg", SimpleNamespace(**{name: kind}))
    exec(compile(block_of("ros2.md", "import rclpy"), "ros2.md", "exec"), {"__name__": "__main__"})
    counts = ping.counts()[::-1]  # port first
    k = counts.max(axis=0).argmax()
    strongest, beam = counts[:, k].max(), counts[:, k].argmax()
    assert capsys.readouterr().out == (
        f"0.000000000 s, sonar_beams, 3 beams: {strongest} of 255 at {ping.range_m[k]:.2f} m in beam {beam}\n"
    )


# ---- emulated devices ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_client_of_an_oculus_prints_results_and_paints_one(scene, tmp_path):
    port = str(free_port())
    read = "examples/oculus_client.py", "--port", port, "--range", "12", "--pings", "3", "--out", tmp_path
    printed, lines = run_beside(["emulate", "oculus", scene, *FAST, "--port", port], *read)
    assert re.search(r"^[1-9]\d* results sent, 0 missed", printed, re.MULTILINE)
    lines = lines.splitlines()
    assert len(lines) == 3
    for number, line in enumerate(lines):
        assert re.match(rf"ping {number}: 256 beams, \d+ ranges from 0.0\d to 1[12].\d\d m; ", line), line
        check_ball(line)
        later = re.search(r"; (\d+) ms after the last$", line)
        # ten pings a second at most, but one that begins late is nearer to the next
        assert (later is None) == (number == 0) and (later is None or int(later[1]) >= 50)
    check_picture(tmp_path / "oculus_client.png")


def test_an_oculus_that_is_not_there_is_told(tmp_path, monkeypatch, capsys):
    port = str(free_port())
    program = "examples/oculus_client.py", "--port", port, "--out", tmp_path
    status, _, err = run_here(monkeypatch, capsys, *program)
    assert status == 2
    assert err == (f"error: an Oculus must answer at 127.0.0.1:{port} (got [Errno 111] Connection refused)\n")


@pytest.mark.slow
def test_the_lines_of_the_page_turn_the_head_of_a_ping360(scene):
    pytest.importorskip("brping")
    port = str(free_port())
    code = block_of("live.md", "import brping").replace("9092", port)
    printed, lines = run_beside(["emulate", "ping360", scene, *FAST, "--port", port], "-c", code)
    assert re.search(r"^20 pings sent", printed, re.MULTILINE)
    # the client itself says first where it connects to
    found = [re.fullmatch(r"(\d+)°: (\d+) of 255 at ([\d.]+) m", line) for line in lines.splitlines()[1:]]
    assert all(found) and [int(one[1]) for one in found] == list(range(0, 360, 18))
    counts = [int(one[2]) for one in found]
    # 342 degrees clockwise are 18 to port, where the ball is; beams of 2 degrees elsewhere see nothing
    assert [18 * k for k, count in enumerate(counts) if count] == [342]
    assert float(found[342 // 18][3]) == pytest.approx(NEAREST_M, abs=RANGE_ERROR_M)
