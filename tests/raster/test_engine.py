"""Which engine draws, by arguments, environment and graphics card."""

import re
import subprocess
import sys

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.gl import context as gl
from sonar_gl.raster import engine

EMPTY = sg.Scene([])


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    for variable in ("SONAR_GL_ENGINE", "SONAR_GL_DEVICE", "SONAR_GL_SOFTWARE"):
        monkeypatch.delenv(variable, raising=False)


@pytest.fixture
def card(monkeypatch):
    """A machine that has the file of a graphics driver."""
    monkeypatch.setattr(engine, "CARDS", ("null",))


@pytest.fixture
def no_card(monkeypatch):
    monkeypatch.setattr(engine, "CARDS", ("no such file",))


def name_of(**arguments):
    made = engine.make_engine(EMPTY, **arguments)
    made.discard()
    made.release_waiting()
    return made.name


def test_without_a_card_the_cpu_draws(no_card):
    assert name_of() == name_of(engine="auto") == "cpu"
    assert name_of(engine="opengl") == name_of(device=0) == "opengl"


def test_with_a_card_its_driver_draws(card, monkeypatch):
    monkeypatch.setenv("SONAR_GL_SOFTWARE", "0")
    assert name_of() == name_of(engine="opengl") == "opengl"
    assert name_of(engine="cpu") == "cpu"


def test_a_software_driver_does_not_draw_by_itself(card, monkeypatch):
    monkeypatch.setenv("SONAR_GL_SOFTWARE", "1")
    assert name_of() == "cpu"
    monkeypatch.setenv("SONAR_GL_DEVICE", "0")  # chosen on purpose
    assert name_of() == "opengl"


def test_a_card_without_opengl_leaves_the_cpu(card, monkeypatch):
    def none(_device=None):
        raise sg.Error("no EGL")

    monkeypatch.setattr(gl, "create_context", none)
    assert name_of() == "cpu"
    with pytest.raises(sg.Error, match="no EGL"):
        name_of(engine="opengl")


def test_the_variable_chooses_and_an_argument_overrides_it(no_card, monkeypatch):
    monkeypatch.setenv("SONAR_GL_ENGINE", "opengl")
    assert (name_of(), name_of(engine="cpu")) == ("opengl", "cpu")
    monkeypatch.setenv("SONAR_GL_ENGINE", "cpu")
    assert (name_of(), name_of(engine="opengl"), name_of(device=0)) == ("cpu", "opengl", "opengl")


@pytest.mark.parametrize(
    ("arguments", "variable", "message"),
    [
        ({"engine": "gpu"}, "", "the engine must be one of auto, opengl, cpu (got 'gpu')"),
        (
            {},
            "vulkan",
            "the engine must be one of auto, opengl, cpu (got 'vulkan', by the variable SONAR_GL_ENGINE)",
        ),
        ({"engine": "cpu", "device": 0}, "", "the cpu engine needs no OpenGL (got device 0; leave it out"),
        (
            {"engine": "cpu", "context": "current"},
            "",
            "the cpu engine needs no OpenGL (got context 'current'",
        ),
        (
            {"context": np.zeros(3)},
            "",
            "context must be 'current' without a device, or None (got array([0., 0., 0.]); make a host's context "
            "current, and give 'current')",
        ),
        (
            {"engine": np.zeros(3)},
            "",
            "the engine must be one of auto, opengl, cpu (got array([0., 0., 0.]))",
        ),
        ({"context": "mine"}, "", "context must be 'current' without a device, or None (got 'mine')"),
    ],
)
def test_contradictions_are_errors(monkeypatch, arguments, variable, message):
    monkeypatch.setenv("SONAR_GL_ENGINE", variable)
    with pytest.raises(sg.Error, match=re.escape(message)):
        name_of(**arguments)


@pytest.mark.parametrize("other", [{"engine": "cpu"}, {"device": 0}, {"context": "current"}])
def test_a_second_sonar_takes_the_engine_of_the_first(other):
    with sg.Simulator(sg.load_scene("pylon"), sg.load_sonar("p900-45"), engine="cpu") as first:
        ((name, value),) = other.items()
        told = f"{name} must be left out beside a Simulator, whose engine draws (got {value!r})"
        with pytest.raises(sg.Error, match=f"^{re.escape(told)}$"):
            sg.Simulator(first, sg.load_sonar("p900-45"), **other)


@pytest.mark.parametrize("name", ["cpu", "opengl"])
def test_pings_name_their_engine(name):
    scene = sg.load_scene("pylon")
    with sg.Simulator(scene, sg.load_sonar("p900-45"), sampling=sg.Sampling(0.5, 40), engine=name) as it:
        ping = it.ping(scene.sonar_pose)
        assert it.gl_info["engine"] == ping.meta["engine"] == name
        assert ping.meta["gl_renderer"] == it.gl_info["renderer"]


WITHOUT_OPENGL = """
import ctypes, sys
real = ctypes.CDLL
def library(name, *rest, **more):
    if name and any(part in str(name) for part in ("EGL", "libGL", "OpenGL")):
        raise OSError(f"{name}: cannot open shared object file")
    return real(name, *rest, **more)
ctypes.CDLL = library
sys.modules["moderngl"] = sys.modules["glcontext"] = None  # importing them fails
import sonar_gl as sg
scene = sg.load_scene("pylon")
with sg.Simulator(scene, sg.load_sonar("p900-45"), tolerance=0.05) as it:
    assert it.ping(scene.sonar_pose, labels=True).intensity.any()
    assert len(list(it.pings([scene.sonar_pose] * 3))) == 3
    assert it.point_cloud(scene.sonar_pose, 16, 8)[0].any() and it.gbuffers(scene.sonar_pose)
"""


@pytest.mark.slow
def test_pings_need_no_opengl(monkeypatch):
    """Neither a library of the system nor a package."""
    monkeypatch.setenv("SONAR_GL_ENGINE", "cpu")
    done = subprocess.run([sys.executable, "-c", WITHOUT_OPENGL], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


def test_several_threads_may_draw_at_once():
    """A simulator of each sonar in one scene, as its workers do: the CPU's workspaces are separate."""
    scene, sonar = sg.load_scene("pylon"), sg.load_sonar("p900-45")
    poses = [scene.sonar_pose @ sg.pose(x=0.1 * k, yaw=0.05 * k) for k in range(12)]
    with sg.Simulator(scene, sonar, sampling=sg.Sampling(1, 80), engine="cpu") as it:
        alone = [it.ping(pose).intensity.copy() for pose in poses]
        for one, ping in zip(alone, it.pings(poses), strict=True):
            np.testing.assert_array_equal(ping.intensity, one)
