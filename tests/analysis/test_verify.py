"""The error of a ping against the reference: the measures, the picture, the command."""

import itertools
import json
import math
import os
import pty
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis import verify as judge
from sonar_gl.cli import verify as command
from sonar_gl.core.extras import install_command
from sonar_gl.ping import Ping
from tests.support import command_line
from tests.support.command_line import BOX, SENSOR, SONAR, WALL
from tests.support.processes import python

pytestmark = pytest.mark.usefixtures("few_first_rays")

CASTING = "casting rays, 400 million at most in each of up to 3 rounds; Ctrl-C stops"
SCENE = f'<sdf version="1.9"><world name="any">{WALL}{BOX}{{more}}</world></sdf>'


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Make the working directory a folder with a small scene and a small sonar."""
    monkeypatch.chdir(tmp_path)
    Path("tank.sdf").write_text(SCENE.format(more=SENSOR))
    Path("mute.sdf").write_text(SCENE.format(more=""))
    Path("small.toml").write_text(SONAR)


@pytest.fixture(scope="module")
def tank():
    """Return a verification of a wall and a box in front of it, with few samples on purpose."""
    bodies = [
        sg.Body("wall", trimesh.creation.box((1, 20, 20)), sg.pose(5.5), 1.0),
        sg.Body("box", trimesh.creation.box((0.2, 0.2, 0.2)), sg.pose(3, 0.5), 1.0),
        sg.Body("behind", trimesh.creation.box((0.2, 0.2, 0.2)), sg.pose(8), 1.0),
    ]
    sonar = sg.Sonar("small", 900e3, 24, 80, 40.0, 10.0, 2.0, 0.5, 8.5)
    # a clock that shows 1, 2, 4, 8 ms: each time that is measured, 1, 4, 16 ms, has another one as its mean and median
    clock = SimpleNamespace(perf_counter=(2.0**k / 1000 for k in itertools.count()).__next__)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judge, "time", clock)
        return judge.verify(sg.Scene(bodies), sonar, np.eye(4), tolerance=0.05, sampling=sg.Sampling(1, 12))


def run(*arguments):
    """Return (exit status, stdout, stderr) of `sonar-gl verify`."""
    return command_line.run("verify", *arguments)


def ping(intensity, body_echo=None):
    intensity = np.array(intensity, np.float32)
    beams, bins = intensity.shape
    body_echo = None if body_echo is None else np.array(body_echo, float)
    return Ping(intensity, np.arange(beams) / 10, np.arange(bins) + 1.0, body_echo=body_echo)


# --- measures


@pytest.mark.parametrize(
    "measured, true, error",
    [
        ([[1, 2], [0, 1]], [[1, 2], [0, 1]], 0.0),
        ([[0, 2], [1, 1]], [[1, 2], [0, 1]], 0.5),  # one of four units in a wrong bin counts twice
        ([[2, 4], [0, 2]], [[1, 2], [0, 1]], 1.0),
        ([[0, 0]], [[3, 0]], 1.0),
        ([[0, 0]], [[0, 0]], 0.0),
        ([[1, 0]], [[0, 0]], math.inf),
    ],
)
def test_ping_error(measured, true, error):
    assert judge.ping_error(ping(measured), ping(true)) == error


def test_ping_error_sums_in_float64():
    """In float32 a bin of 2^-24 would vanish beside one of 1."""
    true = np.full((1, 1 + 2**12), 2.0**-24)
    true[0, 0] = 1
    wrong = true.copy()
    wrong[0, 1:] = 0
    part = 2.0**-12
    assert judge.ping_error(ping(wrong), ping(true)) == part / (1 + part)


@pytest.mark.parametrize(
    "measured, true, worst",
    [
        ([0, 10, 2], [0, 10, 1], (1.0, 2)),
        ([0, 11, 1], [0, 10, 1], (0.1, 1)),
        ([0, 1000, 0], [0, 1000, 0.5], (0.0, 1)),  # too weak to be judged by itself
        ([0, 1000, 0], [0, 1000, 1.5], (1.0, 2)),
        ([0, 0, 5], [0, 0, 0], (0.0, 0)),
        ([0], [0], (0.0, 0)),
    ],
)
def test_worst_body(measured, true, worst):
    assert judge.worst_body(ping([[1]], measured), ping([[1]], true)) == pytest.approx(worst)


# --- verify


def test_verify_agrees_with_its_parts(tank):
    assert tank.error == judge.ping_error(tank.ping, tank.truth) > 0
    error, number = judge.worst_body(tank.ping, tank.truth)
    assert (tank.worst_body_error, tank.worst_body) == (error, tank.ping.meta["bodies"][number - 1])
    assert tank.ping.meta["sampling"]["rows"] == 12
    # the fifth of nine pings, then the reference
    assert (tank.time_ms, tank.reference_s) == pytest.approx((4.0**4, 4.0**9 / 1000), rel=1e-12)
    # the reference is ten times as exact as the error found
    assert tank.certain and tank.difference <= tank.error / 10


@pytest.mark.parametrize("tolerance, kept", [(0.2, True), (0.002, False)])
def test_kept(tank, tolerance, kept):
    assert replace(tank, tolerance=tolerance).kept is kept
    # the worst body may err by five times the tolerance
    assert replace(tank, tolerance=tolerance, worst_body_error=5.01 * tolerance).kept is False


# --- picture


def test_the_picture_shows_ping_truth_and_difference(tank):
    picture = judge.error_picture(tank, 300)
    assert picture.dtype == np.uint8 and picture.shape[2] == 3 and picture.shape[1] % 3 == 0
    fast, true, difference = np.split(picture.astype(int), 3, axis=1)
    top = len(picture) - 300 - 2 * 42  # below the titles and the axes' labels
    assert np.abs(fast[top:] - true[top:]).mean() < 20
    assert difference[top:].max() == 255
    # too much echo is red, too little blue
    shift = np.zeros_like(tank.truth.intensity)
    shift[:12, 40:60], shift[12:, 40:60] = 1, -1
    shifted = replace(tank, ping=replace(tank.ping, intensity=tank.truth.intensity + shift))
    difference = np.split(judge.error_picture(shifted, 300).astype(int), 3, axis=1)[2]
    red = (difference[..., 0] > 200) & (difference[..., 1] < 60) & (difference[..., 2] < 60)
    blue = (difference[..., 2] > 200) & (difference[..., 1] < 60) & (difference[..., 0] < 60)
    assert red.sum() > 1000 and blue.sum() > 1000
    # starboard, where beams begin, is on the right
    assert np.flatnonzero(red.any(axis=0)).mean() > np.flatnonzero(blue.any(axis=0)).mean() + 20


def test_a_ping_equal_to_the_truth_leaves_the_difference_white(tank):
    same = replace(tank, ping=replace(tank.ping, intensity=tank.truth.intensity))
    difference = np.split(judge.error_picture(same, 200).astype(int), 3, axis=1)[2]
    assert (np.ptp(difference, axis=2) <= 1).all()  # no colour
    # white but for lines and letters
    assert (difference.min(axis=2) == 255).mean() > 0.1


@pytest.mark.parametrize("height", [20, 60])
def test_titles_of_narrow_fans_can_be_read(monkeypatch, tank, height):
    """Letters were fitted to the fan alone: those above a single beam were two pixels high."""
    written = []
    draw = judge.cv2.putText

    def note(image, text, place, font, size, *more):
        (across, up), _ = judge.cv2.getTextSize(text, font, size, 1)
        written.append((text, place[0], place[0] + across, up))
        return draw(image, text, place, font, size, *more)

    monkeypatch.setattr(judge.cv2, "putText", note)
    picture = judge.error_picture(tank, height)
    width = picture.shape[1] / 3
    titles = [one for one in written if one[0].startswith(("fast", "from", "reference", "difference", "red"))]
    assert len(titles) == 6
    for number, (_text, left, right, up) in enumerate(titles):
        assert number // 2 * width <= left and right <= (number // 2 + 1) * width
        assert up >= 7
    fans = [part.astype(int) for part in np.split(picture, 3, axis=1)]
    bright = [np.flatnonzero(part[40:].max(axis=2).any(axis=0)).mean() for part in fans]
    assert np.ptp(bright) < 3  # all at the same place


# --- command


@pytest.mark.slow
def test_the_command_reports_and_draws_the_error():
    status, out, err = run("tank.sdf", "--sonar", "small.toml", "--tolerance", 0.2, "--height", 120)
    assert (status, err) == (0, f"{CASTING}\n")
    found = dict(re.findall(r"^(\w[\w ]*?)  +(.*)$", out, re.MULTILINE))
    assert found["scene"] == "tank" and found["sonar"] == "small, 24 beams x 80 bins"
    assert found["profile"] == "physical" and found["sampling"].startswith("columns_per_beam ")
    assert re.fullmatch(r"[\d.]+ % of the echo; the tolerance of 20 % is kept", found["error"])
    share = r"'(box|wall)', [\d.]+ % of the echo; its own is off by [\d.]+ %"
    assert re.fullmatch(share, found["worst body"])
    assert re.fullmatch(r"[\d.]+ million rays, [\d.]+ s; its halves differ by [\d.]+ %", found["reference"])
    assert re.fullmatch(r"\d+\.\d\d ms on .+", found["ping"])
    assert found["picture"] == "tank_error.png"
    assert re.search(r"^body  share of echo +error\nwall  .* %\nbox   .* %$", out, re.MULTILINE)
    picture = cv2.imread("tank_error.png")
    assert picture.shape[0] > 120 and picture.shape[1] > 3 * 80
    assert sorted(os.listdir()) == ["mute.sdf", "small.toml", "tank.sdf", "tank_error.png"]


def test_json_holds_the_same_and_more():
    changes = ["--profile", "ideal", "--tolerance", 0.05, "--bins", 40, "--height", 90]
    place = ["--sonar", "small.toml", "--pose", "0 0 0 0 0 0", "--out", "new/deep"]
    status, out, err = run("mute.sdf", *place, *changes, "--json")
    assert (status, err) == (0, f"{CASTING}\n")
    found = json.loads(out)
    assert (found["scene"], found["sonar"], found["profile"]) == ("mute", "small", "ideal")
    assert (found["beams"], found["bins"]) == (24, 40)
    assert found["kept"] is True and 0 < found["error"] <= found["tolerance"] == 0.05
    assert found["certain"] is True and found["reference_difference"] <= found["error"] / 10
    assert found["picture"] == "new/deep/mute_error.png" and Path(found["picture"]).is_file()
    assert [body["name"] for body in found["bodies"]] == ["wall", "box"]
    assert sum(body["echo"] for body in found["bodies"]) == pytest.approx(1)
    worst = max(found["bodies"], key=lambda body: body["error"])
    assert (found["worst_body"], found["worst_body_error"]) == (worst["name"], pytest.approx(worst["error"]))


@pytest.mark.slow
def test_a_tolerance_that_is_not_kept_has_status_1(monkeypatch):
    monkeypatch.setattr(judge.Verification, "kept", property(lambda self: False))
    status, out, _ = run("tank.sdf", "--sonar", "small.toml", "--tolerance", 0.2, "--height", 60)
    assert status == 1 and "the tolerance of 20 % is NOT kept" in out
    status, out, _ = run("tank.sdf", "--sonar", "small.toml", "--tolerance", 0.2, "--height", 60, "--json")
    assert status == 1 and json.loads(out)["kept"] is False
    assert "0 the tolerance was kept, 1 it was not, 2 a mistake" in run("--help")[1]


def test_a_ping_without_echo_is_reported():
    down = "tank.sdf", "--sonar", "small.toml", "--pose", "0 0 0 0 1.5 0", "--profile", "ideal"
    status, out, err = run(*down, "--height", 60)
    assert status == 0
    assert "error       none: no echo comes back from this pose\n" in out
    assert "worst body" not in out
    assert re.fullmatch(rf"warning: no echo came back: .*\n{CASTING}\n", err)
    status, out, _ = run(*down, "--json")
    assert json.loads(out)["has_echo"] is False


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nowhere.sdf"], "nowhere.sdf: there is no such file (bundled scenes are named without an ending)"),
        (["tank.sdf", "--pose", "1 2 3"], "--pose must be 6 numbers, 'x y z roll pitch yaw'"),
        (["tank.sdf", "--bins", 0], "sonar 'small': n_bins must be a whole number in 1..65536 (got 0)"),
        (["tank.sdf", "--height", 0], "height of a fan image must be a whole number in 1..16000 (got 0;"),
        (["tank.sdf", "--out", "small.toml"], "cannot write into the folder 'small.toml':"),
    ],
)
def test_mistakes_are_reported_in_one_sentence(arguments, message):
    status, out, err = run("--sonar", "small.toml", *arguments)
    assert (status, out) == (2, "")
    assert err.startswith(f"error: {message}") and err.count("\n") == 1
    assert not list(Path().glob("*.png"))


def test_without_embree_the_error_says_what_to_install_before_a_ping_is_made(monkeypatch):
    """In a new installation the first ping compiles for minutes."""
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    monkeypatch.setattr(judge, "Simulator", lambda *_: pytest.fail("a ping is made first"))
    status, out, err = run("tank.sdf", "--sonar", "small.toml", "--tolerance", 0.1)
    assert (status, out) == (2, "")
    assert err == (
        "error: the reference needs Embree (got no module embreex); to add it: "
        f"{install_command('reference')}\n"
    )


@pytest.mark.slow
def test_without_a_terminal_lines_show_that_rays_are_being_cast(monkeypatch):
    monkeypatch.setattr(command, "LINE_EVERY_S", 0.0)
    status, _, err = run("tank.sdf", "--sonar", "small.toml", "--tolerance", 0.1, "--height", 60)
    first, *others = err.splitlines()
    assert (status, first) == (0, CASTING)
    pattern = r"round ([123]): ([\d.]+) of about ([\d.]+) million rays, (\d+) s so far"
    found = [tuple(map(float, re.fullmatch(pattern, line).groups())) for line in others]
    # the number of rays cast has one digit after the point, that of rays expected three digits
    assert len(found) > 5 and all(cast <= expected * 1.005 + 0.05 for _, cast, expected, _ in found)
    for column in (0, 3):  # rounds and seconds
        numbers = [line[column] for line in found]
        assert numbers == sorted(numbers)
    for number in {line[0] for line in found}:
        casts = [line[1] for line in found if line[0] == number]
        assert casts == sorted(casts)


@pytest.mark.slow
def test_a_terminal_shows_that_rays_are_being_cast():
    ours, theirs = pty.openpty()
    how = "tank.sdf", "--sonar", "small.toml", "--tolerance", "0.1", "--height", "60"
    streams = {"capture_output": False, "stdout": subprocess.PIPE, "stderr": theirs}
    done = python("-m", "sonar_gl", "verify", *how, **streams)
    os.close(theirs)
    shown = os.read(ours, 100_000).decode()
    os.close(ours)
    assert done.returncode == 0
    first, *others = shown.split("\r\n")
    assert first == CASTING
    counts = re.findall(r"([\d.]+) of about ([\d.]+) million rays", "".join(others))
    assert len(counts) > 5 and all(float(cast) <= float(expected) * 1.01 for cast, expected in counts)
    assert "casting" not in done.stdout and "million rays" in done.stdout
