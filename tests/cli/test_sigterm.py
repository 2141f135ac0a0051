"""Commands end by SIGTERM, which service managers and containers send, as by Ctrl-C."""

import importlib
import os
import signal
import sys
import time

import pytest

import sonar_gl as sg
from sonar_gl import ros
from tests.support.command_line import run
from tests.support.commands_beside import run_beside
from tests.support.loopback_transport import LoopbackTransport

QUICK = "pylon", "--profile", "ideal", "--noise", "none", "--tolerance", "0.2"
WAIT_S = 180.0  # a machine that tests run on may be slow, and compile kernels first
END = "60"  # seconds: of a command that SIGTERM does not end

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
    printed, begin_s = run_beside([*command, "--duration", END], time.monotonic, WAIT_S, signal.SIGTERM)
    assert time.monotonic() - begin_s < float(END) / 2
    assert not unhandled and closing_line in printed
    assert signal.getsignal(signal.SIGTERM) is handler


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
