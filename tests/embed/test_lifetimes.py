"""Lifetimes of a sonar and its host: threads, order of closing, and objects that remain.

Each host is a process of tests/support/embed_lifetimes.py, which holds the cases.
"""

import json

import pytest

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("kind", ["egl", "glx"])
def test_lifetimes(kind, run_beside):
    failed = json.loads(run_beside("embed_lifetimes", kind))
    assert failed == {}, "\n".join(failed.values())


def test_hosts_with_an_old_opengl_version(run_beside):
    printed = run_beside("embed_lifetimes", "egl", "too_old", MESA_GL_VERSION_OVERRIDE="3.2")
    assert json.loads(printed) == {}


def test_pyrender_may_close_the_display(run_beside):
    assert (
        json.loads(run_beside("embed_lifetimes", "egl", "closed_by_pyrender", PYOPENGL_PLATFORM="egl")) == {}
    )
