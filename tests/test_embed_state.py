"""A host's OpenGL context is as it was after all that a sonar does beside it, whatever state that was.

What is done, and read of the host, stands in `embed_state.py` and `host_state.py`: of each host a process.
"""

import json

import pytest

STATES = "pristine", "working", "hostile"
# That the guard leaves alone, since neither the sonar nor moderngl touch it: by its first words.
NOT_HELD = (
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
    # of old profiles
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


KINDS_OF_ERROR = "INVALID_ENUM", "INVALID_VALUE", "INVALID_OPERATION", "INVALID_FRAMEBUFFER_OPERATION"


def check_run(state, got):
    """State and errors are left, pings are those of a simulator alone, frames of the host the same."""
    assert got["values"] > 2500  # of 3.3; more of newer ones
    assert {name: changed for name, changed in got["changed"].items() if changed} == {}
    assert {name: n for name, n in got["wrong"].items() if n} == {}
    assert len(got["changed"]) == len(got["wrong"]) == 13  # things that were done
    assert got["left"] == {}
    if state == "working":
        assert got["colours"] > 5  # something is seen
        assert list(got["frames"].values()) == [0] * 13


def check_guard(got):
    """Its blocks draw as in a new context, and put back what they change."""
    # not yet entered, drawn in, left by an exception, one within another, and with each kind of error pending
    kept = "made", "block", "raises", "nested", "nests", *KINDS_OF_ERROR
    assert {name: got[name] for name in kept if got[name]} == {}
    assert got["errors inside"] == []
    assert got["drawn wrongly"] == [0] * 6
    assert [name for name in got["not held"] if not name.startswith(NOT_HELD)] == []


def check_deleting(got):
    """What is gone is not bound, which makes no error, and what was pending is so."""
    assert all(got["was"].values())
    assert got["errors"] == ["INVALID_VALUE"]
    assert got["is"] == dict.fromkeys(got["was"], 0)


def check_listening(got):
    """A debug callback hears of none of the guard's errors, but of those of the host in its own turn."""
    for name in KINDS_OF_ERROR:
        assert got[name] == [0, [name]]
    assert got["of its own"] == [1, ["INVALID_VALUE"]]
    assert got["in a sector"] == [1, ["INVALID_VALUE"]]
    assert got["after"] == [1, ["INVALID_ENUM"]]
    assert got["deaf"] == [0, ["INVALID_VALUE"]]


def check_naive(pristine, working, hostile):
    """moderngl in the host's context as it stands: what it changes, and what it draws."""
    assert pristine["wrong"] == 0
    assert len(pristine["changed"]) > 100
    assert working["wrong"] > 10_000
    assert working["frame"] > 1000
    assert hostile.get("error") or hostile["wrong"] > 10_000
    assert "CURRENT_PROGRAM" in hostile["changed"]


@pytest.mark.parametrize(
    "kind",
    ["egl 3.3", "egl 4.5", "glx 4.1", "glx 4.5", "glx compatible"],  # each version, each way in
)
def test_beside_a_host(kind, run_beside):
    kind, version = kind.split()
    # so that newer functions are refused; other drivers than Mesa give what they have
    override = {} if version == "compatible" else {"MESA_GL_VERSION_OVERRIDE": version}
    got = json.loads(run_beside("embed_state.py", kind, version, **override))
    asked = 330 if version == "compatible" else 10 * int(version.replace(".", ""))
    assert got["version"] >= asked
    if "Mesa" in got["name"] and override:
        assert got["version"] == asked
    assert got["compatible"] == (version == "compatible")
    for state in STATES:
        check_run(state, got["runs"][state])
        check_guard(got["guard"][state])
    for doors in got["doors"].values():
        assert {name: changed for name, changed in doors["changed"].items() if changed} == {}
        assert len(doors["changed"]) == 9
        assert doors["left"] == {} and doors["wrong"] == 0
    assert list(got["doors"]["working"]["frames"].values()) == [0] * 9
    check_deleting(got["deleting"])
    check_listening(got["listening"])
    check_naive(*(got["naive"][state] for state in STATES))
    assert got["moderngl"] == {"same": True, "wrong": 0, "buffer": "mine"}
