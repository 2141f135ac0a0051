"""`sonar_gl.view` and `sonar-gl view`, before a page that stands for the real one."""

import builtins
import copy
import os
import pickle
import sys
import threading
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import sonar_gl as sg
from sonar_gl.cli import main as cli
from sonar_gl.cli import view as command
from sonar_gl.cli.output import echo
from sonar_gl.live import live_sonar, viewer
from sonar_gl.live.session import LiveSession
from sonar_gl.live.view import page
from sonar_gl.ping import Ping

POSES = "t,x,y,z,roll,pitch,yaw\n0,0,0,-5,0,0.2,0\n2,1,0,-5,0,0.2,0\n"


@pytest.fixture(autouse=True)
def pages(monkeypatch, tmp_path):
    """Pages that were opened: (session, host, port, is_closed)."""
    opened = []

    class ViewerPage:
        def __init__(self, session, host, port):
            if port == 1:
                raise OSError(13, "Permission denied")
            self.session, self.host, self.port, self.is_closed = session, host, port, False
            self.url = f"http://{host}:{port}"
            opened.append(self)

        def close(self):
            self.is_closed = True

    monkeypatch.setattr(viewer, "ViewerPage", ViewerPage)
    for module in (viewer, command):
        monkeypatch.setattr(module, "load_viser", lambda: None)
    monkeypatch.chdir(tmp_path)
    return opened


def run(*words):
    return CliRunner().invoke(cli.main, [*words, "--duration", "0.01"])


def test_a_script_gets_pings(pages):
    pings, came = [], threading.Event()

    def on_ping(ping):
        pings.append(ping)
        came.set()

    with sg.view("pylon", "p900-45", on_ping=on_ping, block=False, tolerance=0.2, range_m=12.0) as opened:
        assert opened.url == "http://127.0.0.1:8080"
        assert came.wait(60)
    assert type(pings[0]) is Ping and pings[0].sonar.range_max_m == 12.0
    assert pages[0].is_closed and opened.session.wait_closed(0)


def test_the_kernels_of_read_outs_are_there_before_the_page(pages, monkeypatch):
    # they compile once after an installation, for half a minute, in which the page would stand still
    made, make_ping = [], live_sonar.make_ping

    def noted(run, wanted):
        made.append((wanted.labels, len(pages)))
        return make_ping(run, wanted)

    monkeypatch.setattr(live_sonar, "make_ping", noted)
    with sg.view("pylon", "p900-45", block=False, tolerance=0.2, range_m=12.0):
        assert made == [(False, 0), (True, 0)]


def test_a_view_opens_without_read_outs_where_these_fail(pages, monkeypatch):
    def fail(*_):
        raise sg.Error("labels need more memory than there is")

    monkeypatch.setattr(LiveSession, "reading", fail)
    with sg.view("pylon", "p900-45", block=False, tolerance=0.2, range_m=12.0):
        assert len(pages) == 1


@pytest.mark.slow
def test_a_scene_of_ones_own_and_a_file_of_poses():
    Path("dive.csv").write_text(POSES)
    scene = sg.load_scene("pylon")
    with sg.view(scene, pose="dive.csv", block=False, tolerance=0.2) as opened:
        assert opened.session.scene is scene
        assert opened.session.state().duration_s == 2.0
    with sg.view(scene, pose=sg.pose(1, 2, -4), block=False, tolerance=0.2) as opened:
        assert opened.session.pose.tolist() == sg.pose(1, 2, -4).tolist()


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("file", "cannot write into the folder 'file': 'file' is not a folder"),
        ("file/x/y", "cannot write into the folder 'file/x/y': 'file' is not a folder"),
    ],
)
def test_a_folder_that_cannot_be_is_told_before_the_page_opens(pages, out, message):
    """It was told after the first recording."""
    Path("file").touch()
    ran = run("view", "pylon", "--tolerance", "0.2", "--out", out)
    assert ran.exit_code == 2 and f"error: {message}\n" in ran.output
    assert pages == [] and not Path(out).is_dir()


def test_a_folder_without_permission_is_told_before_the_page_opens(pages, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # tests may run as root, who may write anywhere
    ran = run("view", "pylon", "--tolerance", "0.2", "--out", "new/deep")
    assert ran.exit_code == 2 and pages == []
    assert "error: cannot write into the folder 'new/deep': permission denied\n" in ran.output


def test_a_view_and_its_session_refuse_to_be_copied():
    with sg.view("pylon", block=False, tolerance=0.2) as opened:
        for take, it in product((copy.copy, copy.deepcopy, pickle.dumps), (opened, opened.session)):
            with pytest.raises(sg.Error, match=f"a {type(it).__name__} cannot be copied or pickled"):
                take(it)


@pytest.mark.slow
def test_an_exception_of_the_callback_ends_a_blocking_view(pages):
    def on_ping(ping):
        raise KeyError("a mistake of the script")

    with pytest.raises(KeyError, match="a mistake of the script"):
        sg.view("pylon", on_ping=on_ping, tolerance=0.2)
    assert pages[0].is_closed


def test_a_view_waits_no_longer_once_its_session_is_closed():
    with sg.view("pylon", block=False, tolerance=0.2) as opened:
        waiting = threading.Thread(target=opened.wait, daemon=True)
        waiting.start()
        opened.session.close()
        waiting.join(60)
        assert not waiting.is_alive()


async def note_later(ping):
    """Of a notebook, whose event loop runs: never awaited, and so without effect."""


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"scene": "pylom"}, "did you mean 'pylon'"),
        ({"sonar": "p900-46"}, "did you mean 'p900-45'"),
        ({"pose": np.zeros((4, 4))}, "pose"),
        ({"pose": "no.csv"}, "no.csv"),
        ({"tolerance": 7}, "tolerance"),
        ({"on_ping": 7}, r"on_ping must be a function of a Ping \(got 7\)"),
        (
            {"on_ping": note_later},
            r"on_ping must be a plain function of a Ping \(got an async one; .*threadsafe\)",
        ),
        ({"no_setting": 7}, "unknown setting"),
        ({"port": 80800}, r"port must be a whole number in 0..65535 \(got 80800\)"),
        ({"port": "8080"}, r"port must be a whole number in 0..65535 \(got '8080'\)"),
        ({"host": None}, r"host must be a str \(got NoneType; such as 127.0.0.1"),
    ],
)
def test_wrong_arguments_are_errors(pages, arguments, message):
    with pytest.raises(sg.Error, match=message):
        sg.view(**{"scene": "pylon", "block": False, **arguments})
    assert pages == []


@pytest.mark.slow
def test_the_repr_of_a_view_names_its_address():
    """What a notebook shows of it, which opens no browser by itself."""
    with sg.view("pylon", "p900-45", block=False, tolerance=0.2, port=8123) as opened:
        assert repr(opened) == "<LiveView at http://127.0.0.1:8123>"
    assert repr(opened) == "<LiveView at http://127.0.0.1:8123, closed>"


def test_a_port_that_cannot_be_had_is_an_error():
    before = set(threading.enumerate())
    with pytest.raises(sg.Error, match=r"the page must be able to listen at 127.0.0.1:1 .*Permission denied"):
        sg.view("pylon", port=1, block=False, tolerance=0.2)
    assert not [one for one in set(threading.enumerate()) - before if one.name == "sonar_gl live"]


def test_without_its_extra_view_says_how_to_add_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)  # importing it now fails
    for module in (viewer, command):
        monkeypatch.setattr(module, "load_viser", page.load_viser)
        monkeypatch.setattr(module, "LiveSession", None)  # no ping before
    monkeypatch.setattr(command, "needed_acoustics", None)
    with pytest.raises(sg.Error, match=r"the page needs viser .* to add it: "):
        sg.view("pylon")
    for words in ([], ["--acoustics", "needed"]):
        done = run("view", "pylon", *words)
        assert done.exit_code == 2 and "error: the page needs viser" in done.output
    # a mistake of the user comes first: that can be mended without installing anything
    for words in (["nosuchscene"], ["pylon", "--sonar", "nosuch"], ["pylon", "--tolerance", "7"]):
        done = run("view", *words)
        assert done.exit_code == 2 and "viser" not in done.output and done.output.count("error: ") == 1
    with pytest.raises(sg.Error, match="no bundled scene"):
        sg.view("nosuchscene")
    with pytest.raises(sg.Error, match="unknown setting"):
        sg.view("pylon", no_setting=7)


@pytest.mark.slow
@pytest.mark.usefixtures("timed_once")
def test_the_command_takes_the_needed_terms():
    done = run(
        "view", "pylon", "--acoustics", "needed", "--tolerance", "0.2", "--range", "12", "--bins", "60"
    )
    assert done.exit_code == 0, done.output


def test_the_command_opens_a_page_with_what_its_options_say(pages):
    Path("job.toml").write_text("")
    done = run("view", "pylon", "--sonar", "p900-90", "--range", "12", "--bins", "99", "--noise", "none", "--polar",
               "--water", "temperature_c=4", "--acoustics", "pulse=no", "--counts", "gain_db=3", "--tolerance", "0.2",
               "--height", "111", "--colormap", "ice", "--seed", "5", "--port", "0", "--pose", "0 0 -5 0 0.1 0",
               "--without", "box", "--job", "job.toml", "--out", "pictures")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "the page is at http://127.0.0.1:0; Ctrl-C ends it" in done.output
    (opened,) = pages
    session, settings = opened.session, opened.session.settings
    assert opened.is_closed and opened.port == 0 and session.output.folder == Path("pictures")
    assert settings.device.range_max_m == 12.0 and settings.device.n_bins == 99
    assert settings.sonar == sg.load_sonar("p900-90")
    assert settings.acoustics == sg.Acoustics.physical(pulse=False, water=sg.Water(temperature_c=4.0))
    assert settings.law == sg.load_sonar("p900-90").counts.changed({"gain_db": 3.0})
    assert (settings.form, settings.height, settings.colormap) == ("polar", 111, "ice")
    assert (settings.tolerance, settings.seed, settings.noise) == (0.2, 5, sg.Noise())
    assert "box" not in session.bodies() and session.pose.tolist() == sg.pose(0, 0, -5, 0, 0.1, 0).tolist()
    assert not Path("pictures").exists()


@pytest.mark.slow
def test_the_command_follows_a_file_of_poses(pages):
    Path("dive.csv").write_text(POSES)
    done = run("view", "pylon", "--poses", "dive.csv", "--tolerance", "0.2")
    assert done.exit_code == 0, done.output
    assert pages[0].session.state().duration_s == 2.0


def test_ctrl_c_right_after_the_address_ends_the_command_as_later(pages, monkeypatch):
    def interrupted_echo(text, **more):
        echo(text, **more)
        if text.startswith("the page is at"):
            raise KeyboardInterrupt

    monkeypatch.setattr(command, "echo", interrupted_echo)
    done = run("view", "pylon", "--tolerance", "0.2")
    assert (done.exit_code, "error" in done.output) == (0, False), done.output
    assert "Ctrl-C ends it" in done.output and pages[0].is_closed


def test_ctrl_c_right_after_the_address_ends_a_blocking_view(pages, monkeypatch):
    def interrupted_print(text):
        raise KeyboardInterrupt

    monkeypatch.setattr(builtins, "print", interrupted_print)
    sg.view("pylon", tolerance=0.2)
    assert pages[0].is_closed


def test_its_command_line_has_the_engine_that_the_user_chose(pages):
    done = run("view", "pylon", "--tolerance", "0.2", "--engine", "cpu", "--skip-missing")
    assert done.exit_code == 0, done.output
    line = pages[0].session.output.command_line()
    assert " --skip-missing " in line and " --engine cpu " in line and " --sonar p900-45 " in line


def test_other_machines_are_warned_of(pages):
    done = run("view", "pylon", "--tolerance", "0.2", "--host", "0.0.0.0")
    assert done.exit_code == 0 and pages[0].host == "0.0.0.0"
    assert "warning: any machine that reaches 0.0.0.0 can see this page, and move its sonar" in done.output


@pytest.mark.parametrize(
    "words, message",
    [
        (["--tolerance", "7"], "tolerance"),
        (["--range", "0.1"], "range_min_m"),
        (["--counts", "low_db=5"], "counts"),
        (["--colormap", "no"], "colour map"),
        (["--job", "no.toml"], "the job file must be readable"),
        (["--pose", "1 2 3"], "--pose must be 6 numbers"),
        (["--height", "0"], "height"),
        (["--only", "no*"], "names must be those of bodies"),
    ],
)
def test_mistakes_in_options_are_one_sentence(pages, words, message):
    done = run("view", "pylon", *words)
    assert done.exit_code == 2 and message in done.output
    assert done.output.count("\n") <= 2 and "Traceback" not in done.output
    assert pages == []
