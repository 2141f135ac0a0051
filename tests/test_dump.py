"""Files of a sequence are written while the next frames are made, and are as whole as if they were not."""

import errno
import os
import threading
import time
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import BOX, SENSOR, SONAR, WALL, run

import sonar_gl as sg
from sonar_gl import dump, whole
from sonar_gl.dump import WRITERS, Behind

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


def whole_files() -> set[str]:
    """Names of what was written, all of it readable; nothing else may lie beside it."""
    names = {path.name for path in Path("out").iterdir()}
    for name in names:
        if name.endswith(".png"):
            assert cv2.imread(f"out/{name}").shape[0] == 60
        else:
            assert sg.load_npz(f"out/{name}").intensity.shape == (24, 80)
    return names


def test_calls_do_not_wait_and_the_block_waits_for_all():
    go, done = threading.Event(), []

    def slow(number):
        go.wait(10)
        done.append(number)

    with Behind() as behind:
        for number in range(WRITERS + 1):
            behind(slow, number)
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

    with Behind() as behind:
        for _ in range(20):
            with lock:
                under_way += 1
                most = max(most, under_way)
            behind(slow)
    assert under_way == 0 and most <= WRITERS + 2  # that of the caller, and those that were handed over


def test_an_error_comes_out_at_once_and_once():
    begun = []

    def broken(number):
        begun.append(number)
        raise sg.Error(f"number {number}")

    with pytest.raises(sg.Error, match="number 0"), Behind() as behind:
        for number in range(100):
            behind(broken, number)
    assert len(begun) < 10  # those that were under way
    with pytest.raises(sg.Error, match="number 7"), Behind() as behind:
        behind(broken, 7)  # told at the end


def test_leaving_early_ends_what_has_begun_and_begins_no_more():
    begun, ended, started = [], [], threading.Event()

    def slow(number):
        begun.append(number)
        started.set()
        time.sleep(0.05)
        ended.append(number)

    with pytest.raises(KeyboardInterrupt), Behind() as behind:
        for number in range(WRITERS + 1):
            behind(slow, number)
        started.wait(10)
        raise KeyboardInterrupt
    assert sorted(begun) == sorted(ended) and 1 <= len(ended) <= WRITERS + 1
    assert not [t.name for t in threading.enumerate() if t.name.startswith("writer")]


@pytest.mark.parametrize("slow_s", [0, 0.05])
def test_disk_that_fills_in_a_sequence(monkeypatch, slow_s):
    replace = os.replace

    def fills(source, target):
        time.sleep(slow_s)
        if str(target).endswith("_0002.png"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(whole.os, "replace", fills)
    status, out, err = run("render", *SEQUENCE, "--out", "out")
    assert (status, out) == (2, "")
    assert err == "error: cannot write 'out/tank_0002.png': no space left on device\n"
    names = whole_files()
    assert {"tank_0000.png", "tank_0000.npz", "tank_0001.png", "tank_0001.npz"} <= names
    assert "tank_0002.png" not in names and f"tank_{FRAMES - 1:04d}.npz" not in names


def test_interrupt_of_a_sequence(monkeypatch):
    ping, save = sg.Simulator.ping, dump.save_png

    def interrupted(self, *arguments, **more):
        if arguments[4] == 5:
            raise KeyboardInterrupt
        return ping(self, *arguments, **more)

    def slow(*arguments):
        time.sleep(0.05)
        save(*arguments)

    monkeypatch.setattr(sg.Simulator, "ping", interrupted)
    monkeypatch.setattr(dump, "save_png", slow)
    status, out, err = run("render", *SEQUENCE, "--out", "out")
    assert (status, out, err) == (130, "", "error: interrupted; the files written so far are whole\n")
    names = whole_files()
    assert "tank_0000.png" in names and not [name for name in names if name >= "tank_0005"]


def test_film_that_cannot_be_written_leaves_whole_stills(monkeypatch):
    def broken(frames):
        next(frames)
        raise sg.Error("no film today")

    monkeypatch.setattr(dump, "save_animation", lambda _path, frames, _fps: broken(frames))
    status, _, err = run("render", *SEQUENCE, "--out", "out", "--format", "gif", "--format", "png")
    assert (status, err) == (2, "error: no film today\n")
    assert whole_files() <= {"tank_0000.png", "tank_0001.png"}


def test_poses_that_follow_too_quickly(tmp_path):
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("p900-45").with_range(15.0)
    with sg.Simulator(scene, sonar, sampling=sg.Sampling(0.5, 24)) as simulator:
        assert sonar.max_ping_rate_hz(1500.0) == 50.0
        least_s = 2 * 15.0 / simulator.acoustics.sound_speed()
        out = dump.Dump(simulator, None, tmp_path, ("npz",), sg.Noise())
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
