"""Commands end by SIGTERM, which service managers and containers send, as by Ctrl-C."""

import importlib
import os
import signal
import sys
import time

import pytest

import sonar_gl as sg
from sonar_gl import ros
from sonar_gl.core.signals import REPEAT_S
from tests.support.command_line import run
from tests.support.commands_beside import run_beside
from tests.support.loopback_transport import LoopbackTransport
from tests.support.processes import python

QUICK = "pylon", "--profile", "ideal", "--noise", "none", "--tolerance", "0.2"
WAIT_S = 180.0  # a machine that tests run on may be slow, and compile kernels first
END = "600"  # seconds: of a command that SIGTERM does not end, beyond the time limit of a test

pytestmark = pytest.mark.timeout(WAIT_S + 60)


@pytest.fixture
def unhandled():
    """A list of the signals SIGTERM that no command has handled; one would end the tests otherwise."""
    found = []
    before = signal.signal(signal.SIGTERM, lambda number, _frame: found.append(number))
    yield found
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize(
    ("command", "closing_line"),
    [
        (["ros2", *QUICK, "--transport", "dds"], "pings published"),
        (["emulate", "oculus", *QUICK, "--port", "0"], "results sent"),
        (["emulate", "ping360", *QUICK, "--port", "0"], "pings sent"),
    ],
)
def test_a_live_command_prints_its_closing_line(command, closing_line, unhandled, monkeypatch):
    monkeypatch.setitem(vars(ros), "DdsTransport", lambda **_: LoopbackTransport())
    handler = signal.getsignal(signal.SIGTERM)
    printed, _ = run_beside([*command, "--duration", END], lambda: None, WAIT_S, signal.SIGTERM)
    assert not unhandled and closing_line in printed
    assert signal.getsignal(signal.SIGTERM) is handler


def test_a_signal_that_is_sent_twice_at_once_ends_a_command_as_one_does(unhandled, monkeypatch):
    """`timeout` sends its signal to the command and to its group: the second cut the end of the first short."""
    close = ros.Publisher.close

    def close_under_a_signal(publisher):
        os.kill(os.getpid(), signal.SIGTERM)
        close(publisher)

    monkeypatch.setitem(vars(ros), "DdsTransport", lambda **_: LoopbackTransport())
    monkeypatch.setattr(ros.Publisher, "close", close_under_a_signal)
    command = ["ros2", *QUICK, "--transport", "dds", "--duration", END]
    printed, _ = run_beside(command, lambda: None, WAIT_S, signal.SIGTERM)
    assert not unhandled and "pings published" in printed


def test_a_later_signal_ends_what_the_first_has_not(unhandled, monkeypatch):
    def ping(*_, **__):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt:  # which some library takes for its own
            time.sleep(1.5 * REPEAT_S)
            os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("the command went on")

    monkeypatch.setattr(sg.Simulator, "ping", ping)
    assert run("render", "pylon")[0] == 130
    assert not unhandled


def test_a_command_that_renders_says_that_it_was_interrupted(unhandled, monkeypatch):
    monkeypatch.setattr(sg.Simulator, "ping", lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM))
    status, _, errors = run("render", "pylon")
    assert status == 130 and errors.endswith("\nerror: interrupted\n")
    assert not unhandled


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_within_an_import_is_not_lost(number, unhandled, monkeypatch, tmp_path):
    """trimesh takes any exception within its imports for the lack of a module."""
    (tmp_path / "imports_anything.py").write_text(
        f"import os\ntry:\n    os.kill(os.getpid(), {int(number)})\nexcept BaseException:\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "imports_anything", raising=False)  # of the other signal

    def ping(*_, **__):
        importlib.import_module("imports_anything")
        time.sleep(float(END))
        pytest.fail("the command went on")

    monkeypatch.setattr(sg.Simulator, "ping", ping)
    status, _, errors = run("render", "pylon")
    assert status == 130 and errors.endswith("\nerror: interrupted\n")
    assert not unhandled


@pytest.mark.parametrize(
    ("ignored", "expected"),
    [(False, (130, [])), pytest.param(True, (0, ["pylon.mp4"]), marks=pytest.mark.slow)],
)
def test_a_closed_terminal_leaves_no_half_written_film(ignored, expected, tmp_path):
    """SIGHUP killed the command, which left the film under a hidden name; nohup has the signal ignored."""
    code = """
import os, signal, sys
import sonar_gl as sg
from sonar_gl.cli.main import main
signal.signal(signal.SIGHUP, signal.SIG_IGN if sys.argv.pop(1) == "True" else signal.SIG_DFL)
ping = sg.Simulator.ping
def hang_up(*arguments, **more):
    if arguments[5] == 1:
        os.kill(os.getpid(), signal.SIGHUP)
    return ping(*arguments, **more)
sg.Simulator.ping = hang_up
main()
"""
    poses = "t,x,y,z,roll,pitch,yaw\n" + "".join(f"{t},0,0,-5,0,0.2,0\n" for t in range(3))
    (tmp_path / "poses.csv").write_text(poses)
    options = ["--poses", tmp_path / "poses.csv", "--profile", "ideal", "--bins", "20", "--height", "40"]
    options += ["--format", "mp4", "--out", tmp_path / "out", "--engine", "cpu"]
    done = python("-c", code, str(ignored), "render", "pylon", *map(str, options), timeout=WAIT_S)
    assert (done.returncode, os.listdir(tmp_path / "out")) == expected
