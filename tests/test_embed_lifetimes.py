"""A sonar beside a host: threads, the order in which things go, and what is left of them.

What is tried stands in `embed_lifetimes.py`; of each host a process.
"""

import json

import pytest


@pytest.mark.parametrize("kind", ["egl", "glx"])
def test_lifetimes(kind, run_beside):
    failed = json.loads(run_beside("embed_lifetimes.py", kind))
    assert failed == {}, "\n".join(failed.values())


def test_hosts_that_are_too_old(run_beside):
    printed = run_beside("embed_lifetimes.py", "egl", "too_old", MESA_GL_VERSION_OVERRIDE="3.2")
    assert json.loads(printed) == {}


def test_pyrender_closes_the_display(run_beside):
    assert (
        json.loads(run_beside("embed_lifetimes.py", "egl", "closed_by_pyrender", PYOPENGL_PLATFORM="egl"))
        == {}
    )
