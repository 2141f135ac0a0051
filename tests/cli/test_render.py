"""Pictures that show almost nothing; files of a sequence, complete though other threads write them."""

import errno
import itertools
import os
import re
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import sonar_gl as sg
from sonar_gl.cli import render as command
from sonar_gl.cli.render import WRITERS, BackgroundCalls
from sonar_gl.core import atomic_file
from tests.support.command_line import BODY, BOX, SENSOR, SONAR, WALL, run
from tests.support.waiting import WAIT_S, wait_until

FRAMES = 8
POSES = "t,x,y,z,roll,pitch,yaw\n" + "".join(f"{n},{n / 10},0,0,0,0,0\n" for n in range(FRAMES))
SEQUENCE = ("tank.sdf", "--sonar", "small.toml", "--poses", "dive.csv", "--tolerance", 0.05, "--height", 60)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder with a small scene, a small sonar and a sequence of poses, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    Path("tank.sdf").write_text(f'<sdf version="1.9"><world name="any">{WALL}{BOX}{SENSOR}</world></sdf>')
    Path("small.toml").write_text(SONAR)
    Path("dive.csv").write_text(POSES)
    return tmp_path


def complete_files() -> set[str]:
    """Names of what was written, all of it readable; nothing else may lie beside it."""
    names = {path.name for path in Path("out").iterdir()}
    for name in names:
        if name.endswith(".png"):
            assert cv2.imread(f"out/{name}").shape[0] == 60
        elif name.endswith(".gif"):
            assert Image.open(f"out/{name}").n_frames >= 1
        else:
            assert sg.load_npz(f"out/{name}").intensity.shape == (24, 80)
    return names


def test_calls_do_not_wait_and_the_block_waits_for_all():
    go, done = threading.Event(), []

    def slow(number):
        assert go.wait(WAIT_S)
        done.append(number)

    with BackgroundCalls() as calls:
        for number in range(WRITERS + 1):
            calls.start(slow, number)
        assert not done
        go.set()
    assert sorted(done) == list(range(WRITERS + 1))


def test_no_more_wait_than_said():
    lock, under_way, most = threading.Lock(), 0, 0

    def slow():
        nonlocal under_way
        time.sleep(0.002)
        with lock:
            under_way -= 1

    with BackgroundCalls() as calls:
        for _ in range(20):
            with lock:
                under_way += 1
                most = max(most, under_way)
            calls.start(slow)
    assert under_way == 0 and most <= WRITERS + 2  # that of the caller, and those that were handed over


def test_an_error_comes_out_at_once_and_once():
    begun = []

    def broken(number):
        begun.append(number)
        raise sg.Error(f"number {number}")

    with pytest.raises(sg.Error, match="number 0"), BackgroundCalls() as calls:
        for number in range(100):
            calls.start(broken, number)
    assert len(begun) < 10  # those that were under way
    with pytest.raises(sg.Error, match="number 7"), BackgroundCalls() as calls:
        calls.start(broken, 7)  # told at the end


def test_leaving_early_ends_what_has_begun_and_begins_no_more(monkeypatch):
    begun, ended, may_end = [], [], threading.Event()

    class Pool(ThreadPoolExecutor):
        """Lets calls end once it is told to begin no more."""

        def shutdown(self, wait=True, **options):
            super().shutdown(wait=False, **options)
            may_end.set()
            super().shutdown(wait=wait)

    def slow(number):
        begun.append(number)
        assert may_end.wait(WAIT_S)
        ended.append(number)

    monkeypatch.setattr(command, "ThreadPoolExecutor", Pool)
    with pytest.raises(KeyboardInterrupt), BackgroundCalls() as calls:
        for number in range(WRITERS + 1):
            calls.start(slow, number)
        wait_until(lambda: len(begun) == WRITERS)
        raise KeyboardInterrupt
    assert sorted(begun) == sorted(ended) == list(range(WRITERS))
    assert not [t.name for t in threading.enumerate() if t.name.startswith("writer")]


@pytest.mark.parametrize("slow_s", [pytest.param(0, marks=pytest.mark.slow), 0.05])
def test_disk_that_fills_in_a_sequence(monkeypatch, slow_s):
    replace = os.replace

    def fills(source, target):
        time.sleep(slow_s)
        if str(target).endswith("_0002.png"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(atomic_file.os, "replace", fills)
    status, out, err = run("render", *SEQUENCE, "--out", "out")
    assert (status, out) == (2, "")
    assert err == "error: cannot write 'out/tank_0002.png': no space left on device\n"
    names = complete_files()
    assert {"tank_0000.png", "tank_0000.npz", "tank_0001.png", "tank_0001.npz"} <= names
    assert "tank_0002.png" not in names and f"tank_{FRAMES - 1:04d}.npz" not in names


def test_interrupt_of_a_sequence(monkeypatch):
    ping, save = sg.Simulator.ping, command.save_png

    def interrupted(self, *arguments, **more):
        if arguments[4] == 5:
            raise KeyboardInterrupt
        return ping(self, *arguments, **more)

    def slow(*arguments):
        time.sleep(0.05)
        save(*arguments)

    monkeypatch.setattr(sg.Simulator, "ping", interrupted)
    monkeypatch.setattr(command, "save_png", slow)
    status, out, err = run("render", *SEQUENCE, "--out", "out")
    assert (status, out, err) == (130, "", "error: interrupted; the files written so far are complete\n")
    names = complete_files()
    assert "tank_0000.png" in names and not [name for name in names if name >= "tank_0005"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("formats", "interrupted_at", "has_files"),
    [pytest.param("gif", 3, False, marks=pytest.mark.slow), ("gif mp4", FRAMES + 2, True)],
)
def test_interrupt_of_a_film(formats, interrupted_at, has_files, monkeypatch):
    """The second film renders the pings of the first again."""
    ping, pings = sg.Simulator.ping, itertools.count(1)

    def interrupted(self, *arguments, **more):
        if next(pings) == interrupted_at:
            raise KeyboardInterrupt
        return ping(self, *arguments, **more)

    monkeypatch.setattr(sg.Simulator, "ping", interrupted)
    options = [word for name in formats.split() for word in ("--format", name)]
    status, out, err = run("render", *SEQUENCE, "--out", "out", *options)
    files = "; the files written so far are complete" if has_files else ""
    assert (status, out, err) == (130, "", f"error: interrupted{files}\n")
    assert complete_files() == ({"tank.gif"} if has_files else set())


def test_film_that_cannot_be_written_leaves_complete_stills(monkeypatch):
    def broken(frames):
        next(frames)
        raise sg.Error("no film today")

    monkeypatch.setattr(command, "save_animation", lambda _path, frames, _fps: broken(frames))
    status, _, err = run("render", *SEQUENCE, "--out", "out", "--format", "gif", "--format", "png")
    assert (status, err) == (2, "error: no film today\n")
    assert complete_files() <= {"tank_0000.png", "tank_0001.png"}


BOX_ONLY = f'<sdf version="1.9"><world name="any">{BOX}{SENSOR}</world></sdf>'
QUICK = ("--sonar", "small.toml", "--tolerance", 0.05, "--height", 60)


def test_a_picture_that_shows_almost_nothing_says_what_to_change():
    Path("box.sdf").write_text(BOX_ONLY)
    view = ("--profile", "ideal", "--pose", "-4 0 0 0 0 0")
    status, out, err = run("render", "box.sdf", *QUICK, *view)
    assert status == 0 and "strongest echo " in out
    match = re.fullmatch(
        r"warning: the picture is nearly empty: (0\.\d+) % of its cells are bright enough to be seen; "
        r"change --range \(0\.5 to 8\.5 m\) or the sonar's pose\n",
        err,
    )
    percent = 100 * (sg.load_npz("box.npz").intensity > 10**-5.7).mean()  # 5 % from -60 to 0 dB
    assert percent < 1 and float(match[1]) == pytest.approx(percent, rel=0.05)
    assert run("render", "box.sdf", *QUICK, *view, "--format", "npz")[2] == ""
    err = run("render", "box.sdf", *QUICK, *view[2:], "--style", "demarco2015")[2]
    assert re.fullmatch(
        r"warning: the picture is nearly empty: 0\.\d+ % of its pixels show an echo; "
        r"change --range \(0\.5 to 8\.5 m\) or the sonar's pose\n",
        err,
    )


def test_noise_is_not_the_strongest_echo():
    """It rises with range, by the TVG, above any echo."""
    loud = "small.toml,self_noise_db=-30"
    view = ("--noise", "self_noise=yes", "--tolerance", 0.05, "--format", "npz")
    status, out, _ = run("render", "tank.sdf", "--sonar", loud, "--range", 60, *view)
    found = re.search(r"strongest echo .* at (\d+\.\d+) m", out)
    assert status == 0 and sg.load_npz("tank.npz").intensity[:, -10:].max() > 1  # the noise
    assert float(found[1]) < 8
    out = run("render", "tank.sdf", "--sonar", "small.toml,self_noise_db=20", *view)[1]
    assert ", no echo above the noise; " in out


def test_noise_does_not_fill_an_empty_picture():
    """It is as bright as an echo, but not the picture of one."""
    Path("box.sdf").write_text(BOX_ONLY)
    noisy = *QUICK, "--profile", "ideal", "--noise", "speckle=yes,ambient_db=-50"
    err = run("render", "box.sdf", *noisy, "--pose", "-4 0 0 0 0 0")[2]
    assert (sg.load_npz("box.npz").intensity > 10**-5.7).mean() > 0.5
    match = re.match(
        r"warning: the picture is nearly empty: (0\.\d+) % of its cells show an echo above the noise", err
    )
    assert 0 < float(match[1]) < 1
    assert run("render", "tank.sdf", *noisy)[2] == ""


def test_a_dark_picture_says_which_gain_shows_it():
    dark = ("--counts", "law=db,low_db=20,high_db=40")
    status, _, err = run("render", "tank.sdf", *QUICK, *dark)
    assert status == 0 and err == (
        "warning: the picture is nearly empty: 0 % of its cells are bright enough to be seen; "
        "give --counts gain_percentile=99, or more gain by --acoustics tvg_k=40\n"
    )
    assert run("render", "tank.sdf", *QUICK, "--counts", "low_db=20,high_db=40,gain_percentile=99")[2] == ""
    err = run("render", "tank.sdf", *QUICK, *dark, "--profile", "ideal")[2]  # which has no TVG
    assert err.endswith("bright enough to be seen; give --counts gain_percentile=99\n")


def test_a_sequence_is_nearly_empty_if_all_its_pictures_are():
    header = "t,x,y,z,roll,pitch,yaw\n"
    sequence = "render", "tank.sdf", *QUICK, "--profile", "ideal", "--poses", "away.csv", "--format", "png"
    Path("away.csv").write_text(header + "0,0,0,0,0,0,0\n1,-3.6,0,0,0,0,0\n")
    assert run(*sequence)[2] == ""
    Path("away.csv").write_text(header + "0,-3.7,0,0,0,0,0\n1,-3.6,0,0,0,0,0\n")  # the box alone is in range
    note, warning = run(*sequence)[2].splitlines()
    assert note.endswith(" m; beyond it: wall") and warning.startswith(
        "warning: all pictures are nearly empty: "
    )


@pytest.mark.slow
def test_a_hull_that_stays_behind_is_warned_of():
    hull = BODY.format("rov", "-0.5 0 0", "0.4 0.4 0.2")
    mount = '<link name="mount"><pose>0.5 0 0 0 0 0</pose><sensor name="sonar" type="custom"/></link></model>'
    vehicle = hull.replace("</model>", mount)
    Path("rov.sdf").write_text(f'<sdf version="1.9"><world name="any">{WALL}{vehicle}</world></sdf>')
    sequence = "rov.sdf", *SEQUENCE[1:], "--format", "npz"
    assert run("render", *sequence)[2] == (
        "warning: poses move the sonar alone: model 'rov', which carries it, stays where it is, and returns echo "
        "(leave it out: --without 'rov*')\n"
    )
    assert run("render", *sequence, "--without", "rov*")[2] == ""
    dock = BODY.format("rov_dock", "8 3 0", "0.4 0.4 0.2")  # which that pattern would leave out, too
    Path("rov.sdf").write_text(f'<sdf version="1.9"><world name="any">{WALL}{vehicle}{dock}</world></sdf>')
    assert run("render", *sequence)[2].endswith(" (leave it out: --without 'rov')\n")
    assert run("render", *sequence, "--without", "rov")[2] == ""
    assert run("render", *SEQUENCE, "--format", "npz")[2] == ""  # the sensor is alone in its model
    assert run("render", *sequence[:3], "--tolerance", 0.05, "--format", "npz")[2] == ""  # does not move


@pytest.mark.slow
@pytest.mark.parametrize("words", [("aris-1800", "--range", 16), ("aris-1800,range_max_m=16",)])
def test_a_range_beyond_what_the_device_allows_is_warned_of(words):
    fast = "render", "tank.sdf", "--bins", 40, "--tolerance", 0.5, "--noise", "none", "--format", "npz"
    code, _, err = run(*fast, "--sonar", *words)
    assert code == 0
    assert err == "warning: sonar 'aris-1800' allows ranges of 15 m at most, its range_limit_m (got 16 m)\n"
    assert run(*fast, "--sonar", "aris-1800", "--range", 15)[2] == ""


def test_poses_that_follow_too_quickly(tmp_path):
    scene, preset = sg.load_scene("tank.sdf"), sg.load_sonar("p900-45").with_range(15.0)
    with sg.Simulator(scene, preset, sampling=sg.Sampling(0.5, 24)) as simulator:
        out = command.FrameWriter(simulator, None, tmp_path, ("npz",), sg.Noise())
        why = r"must be 0\.06667 s apart or more, since sonar 'p900-45' makes 15 pings a second at most \(got 0\.05 s;"
        with pytest.warns(UserWarning, match=why):
            out.write(np.stack([scene.sonar_pose] * 2), np.array([0.0, 0.05]))
    sonar = replace(preset, ping_rate_max_hz=None)
    with sg.Simulator(scene, sonar, sampling=sg.Sampling(0.5, 24)) as simulator:
        assert sonar.max_ping_rate_hz(1500.0) == 50.0
        least_s = 2 * 15.0 / simulator.acoustics.water.sound_speed()
        out = command.FrameWriter(simulator, None, tmp_path, ("npz",), sg.Noise())
        poses = np.stack([scene.sonar_pose] * 3)
        with pytest.warns(UserWarning, match=r"must be 0\.02\d+ s apart or more") as told:
            out.write(poses, np.array([0.0, least_s, 1.9 * least_s]))
        assert len(told) == 1
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            out.write(poses, np.zeros(3))
            out.write(poses, np.arange(3) * least_s)
            out.write(poses[:1])
        assert sg.load_npz(tmp_path / "tank_0002.npz").meta["time_s"] == 2 * least_s


def test_bodies_beyond_the_range_are_named():
    """With a preset of a short range a scene may look empty though its floor, or a nearer body, echoes."""
    assert (
        run("render", "tank.sdf", "--sonar", "small.toml", "--range", 4)[2] == "range: 4 m; beyond it: wall\n"
    )
    assert run("render", "tank.sdf", "--sonar", "small.toml")[2] == ""


def test_all_bodies_beyond_the_range_are_left_to_the_warning_of_no_echo():
    err = run("render", "tank.sdf", "--sonar", "small.toml", "--range", 2)[2]
    assert err.startswith("warning: no echo came back: ") and "beyond it" not in err
