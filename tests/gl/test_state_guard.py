"""A sonar leaves the OpenGL state of a host's context as it found it, whatever that state is.

Each host is a process of tests/support/embed_state.py; tests/support/host_state.py reads and sets its state.
"""

import json

import pytest

from tests.support.host_state import ERRORS

STATES = "pristine", "working", "hostile"
# Beginnings of names of the state that the guard leaves alone, since neither the sonar nor moderngl change it
NOT_RESTORED = (
    "ATOMIC_COUNTER_BUFFER",
    "BLEND_COLOR",
    "DEBUG_GROUP_STACK_DEPTH",
    "DEBUG_OUTPUT_SYNCHRONOUS",
    "DISPATCH_INDIRECT_BUFFER",
    "FRAGMENT_SHADER_DERIVATIVE_HINT",
    "IMAGE_BINDING",
    "LINE_SMOOTH_HINT",
    "LOGIC_OP_MODE",
    "MIN_SAMPLE_SHADING_VALUE",
    "PATCH_VERTICES",
    "POINT_",
    "POLYGON_OFFSET_FACTOR",
    "POLYGON_OFFSET_UNITS",
    "POLYGON_SMOOTH_HINT",
    "PROGRAM_PIPELINE",
    "QUERY_BUFFER",
    "SAMPLER_BINDING",
    "SAMPLE_COVERAGE_",
    "SAMPLE_MASK_VALUE",
    "SHADER_STORAGE_BUFFER",
    "STENCIL_",
    "TEXTURE_BINDING",
    "TEXTURE_COMPRESSION_HINT",
    "TRANSFORM_FEEDBACK_BUFFER",
    "UNIFORM_BUFFER",
    # of the compatibility profile
    "ALPHA_TEST_",
    "FOG",
    "INDEX_OFFSET",
    "LIGHTING",
    "LINE_STIPPLE",
    "LINE_WIDTH",
    "SHADE_MODEL",
    "VERTEX_PROGRAM_TWO_SIDE",
    "ZOOM_",
)


def check_run(state, got):
    """State and errors stay, pings are those of a simulator alone, and the host's frames stay the same."""
    assert got["values"] > 2500  # of OpenGL 3.3; newer ones have more
    assert {name: changed for name, changed in got["changed"].items() if changed} == {}
    assert {name: n for name, n in got["wrong"].items() if n} == {}
    assert len(got["changed"]) == len(got["wrong"]) == 13  # steps
    assert got["left"] == {}
    if state == "working":
        assert got["colours"] > 5  # the frame is not empty
        assert list(got["frames"].values()) == [0] * 13


def check_guard(got):
    """Its blocks draw as in a new context, and restore what they change."""
    # before it is entered, with drawing, left by an exception, nested, and with each kind of error pending
    blocks = "made", "block", "raises", "nested", "around nested", *ERRORS
    assert {name: got[name] for name in blocks if got[name]} == {}
    assert got["errors inside"] == []
    assert got["on inside"] == ["MULTISAMPLE", "DITHER"]  # OpenGL's defaults; all other switches are off
    assert got["drawn wrongly"] == [0] * 6
    assert [name for name in got["not restored"] if not name.startswith(NOT_RESTORED)] == []


def check_deleting(got):
    """Deleted objects are not bound again, which would be an error; the host's own error is still pending."""
    assert all(got["before"].values())
    assert got["errors"] == ["INVALID_VALUE"]
    assert got["after"] == dict.fromkeys(got["before"], 0)


def check_debug_callback(got):
    """A debug callback gets no error raised inside the guard, except those of the host while it draws."""
    for name in ERRORS:
        assert got[name] == [0, [name]]
    assert got["while the host draws"] == [1, ["INVALID_VALUE"]]
    assert got["in a sector"] == [1, ["INVALID_VALUE"]]
    assert got["after"] == [1, ["INVALID_ENUM"]]
    assert got["switched off"] == [0, ["INVALID_VALUE"]]


def check_naive(pristine, working, hostile):
    """Without a guard, moderngl changes the host's state, and draws wrongly, or its reads write elsewhere."""
    assert pristine["wrong"] == 0
    assert len(pristine["changed"]) > 100
    assert working.get("error") or working["wrong"] > 10_000
    assert working["frame"] > 1000
    assert hostile.get("error") or hostile["wrong"] > 10_000
    assert len(hostile["changed"]) > 20  # until the driver reported an error


@pytest.mark.slow  # .ci/run runs it
@pytest.mark.parametrize(  # each version, and each window system
    "kind", ["egl 4.5", "egl 3.3", "glx 4.1", "glx 4.5", "glx compatible"]
)
def test_beside_a_host(kind, run_beside):
    kind, version = kind.split()
    # Mesa then has no newer functions; other drivers give what they have
    override = {} if version == "compatible" else {"MESA_GL_VERSION_OVERRIDE": version}
    got = json.loads(run_beside("embed_state", kind, version, **override))
    requested = 330 if version == "compatible" else 10 * int(version.replace(".", ""))
    assert got["version"] >= requested
    if "Mesa" in got["name"] and override:
        assert got["version"] == requested
    assert got["compatible"] == (version == "compatible")
    for state in STATES:
        check_run(state, got["runs"][state])
        check_guard(got["guard"][state])
    for modes in got["modes"].values():
        assert {name: changed for name, changed in modes["changed"].items() if changed} == {}
        assert len(modes["changed"]) == 9  # steps
        assert modes["left"] == {} and modes["wrong"] == 0
    assert list(got["modes"]["working"]["frames"].values()) == [0] * 9
    check_deleting(got["deleting"])
    check_debug_callback(got["debug callback"])
    check_naive(*(got["naive"][state] for state in STATES))
    assert got["moderngl"] == {"same": True, "wrong": 0, "buffer": "mine"}
