import pytest

from sonar_gl.raster import scene_meshes
from sonar_gl.sonar.samples import NO_SPANS


@pytest.fixture(autouse=True, scope="module")
def by_opengl():
    """Simulators of these tests draw by OpenGL, also on a software driver and in fixtures of a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SONAR_GL_ENGINE", "opengl")
        yield


@pytest.fixture
def no_boxes(monkeypatch):
    """Has a Simulator know as little of its bodies as of a host's: not the ranges within which footprints are kept."""
    monkeypatch.setattr(scene_meshes, "body_spans", lambda *_: NO_SPANS)
