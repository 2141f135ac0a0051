"""Commands end by SIGTERM, which service managers and containers send, as by Ctrl-C."""

import ctypes
import importlib
import os
import signal
import sys
import time

import pytest

import sonar_gl as sg
from sonar_gl import ros
from sonar_gl.cli.command_group import PAUSE_S
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


EARLY = """
import os, signal, sys
def interrupt(*_):
    os.kill(os.getpid(), signal.SIGINT)
class Finder:
    def find_spec(self, name, *_):
        if name == "{module}":
            interrupt()
sys.meta_path.insert(0, Finder())
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv = ["sonar-gl", "scenes"]
from sonar_gl.__main__ import main
import click
click.Group.parse_args = interrupt
main()
"""


@pytest.mark.parametrize("module", ["click", "sonar_gl.cli.main", "sonar_gl.imaging.formats", "none"])
def test_ctrl_c_while_the_command_loads_ends_it_by_one_line(module):
    """It printed a traceback; "none" has it come while the arguments are read, which printed "Aborted!"."""
    done = python("-c", EARLY.format(module=module))
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "error: interrupted\n")


@pytest.mark.slow
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_that_the_caller_ignores_or_handles_ends_no_command(number, monkeypatch):
    """As shells have Ctrl-C ignored in the background, and nohup has SIGHUP."""
    handled = []

    def plan(*_):
        os.kill(os.getpid(), number)
        raise sg.Error("the command went on")

    monkeypatch.setattr(sg.Simulator, "plan", plan)
    for handler in (signal.SIG_IGN, lambda *_: handled.append(number)):
        before = signal.signal(number, handler)
        try:
            status, _, errors = run("render", "pylon")
        finally:
            signal.signal(number, before)
        assert status == 2 and errors.endswith("\nerror: the command went on\n")
    assert handled == [number]


def test_a_command_that_renders_says_that_it_was_interrupted(unhandled, monkeypatch):
    monkeypatch.setattr(sg.Simulator, "ping", lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM))
    status, _, errors = run("render", "pylon")
    assert status == 130 and errors.endswith("\nerror: interrupted\n")
    assert not unhandled


@pytest.fixture
def imports_anything(request, monkeypatch, tmp_path):
    """A module that sends a signal, the parameter, while it is imported, and takes whatever is raised there."""
    (tmp_path / "imports_anything.py").write_text(
        f"import os\ntry:\n    os.kill(os.getpid(), {int(request.param)})\nexcept BaseException:\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "imports_anything", raising=False)  # of the other signal


@pytest.mark.parametrize("imports_anything", [signal.SIGTERM, signal.SIGINT], indirect=True)
@pytest.mark.usefixtures("imports_anything")
def test_a_signal_within_an_import_is_not_lost(unhandled, monkeypatch):
    """trimesh takes any exception within its imports for the lack of a module."""

    def ping(*_, **__):
        importlib.import_module("imports_anything")
        time.sleep(float(END))
        pytest.fail("the command went on")

    monkeypatch.setattr(sg.Simulator, "ping", ping)
    status, _, errors = run("render", "pylon")
    assert status == 130 and errors.endswith("\nerror: interrupted\n")
    assert not unhandled


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_that_python_must_ignore_comes_again(number, unhandled, monkeypatch):
    """LLVM calls Python while Numba compiles or reads a function: a KeyboardInterrupt there went lost."""

    def ping(*_, **__):
        ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), number))()
        time.sleep(float(END))
        pytest.fail("the command went on")

    monkeypatch.setattr(sg.Simulator, "ping", ping)
    status, _, errors = run("render", "pylon")
    assert status == 130 and errors.endswith("\nerror: interrupted\n")
    assert not unhandled and "Traceback" not in errors


@pytest.mark.parametrize("imports_anything", [signal.SIGTERM], indirect=True)
@pytest.mark.usefixtures("imports_anything")
def test_a_signal_within_the_last_import_of_a_command_does_not_reach_its_caller(unhandled, monkeypatch):
    def plan(*_):
        importlib.import_module("imports_anything")
        raise sg.Error("the command ends")

    monkeypatch.setattr(sg.Simulator, "plan", plan)
    assert run("render", "pylon")[0] == 2
    time.sleep(2 * PAUSE_S)
    assert not unhandled


@pytest.mark.slow
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
