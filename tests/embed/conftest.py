import pytest

from sonar_gl.gl import egl
from tests.support import gl_host


@pytest.fixture(autouse=True, scope="module")
def by_opengl():
    """Simulators of these tests draw by OpenGL, also on a software driver and in fixtures of a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SONAR_GL_ENGINE", "opengl")
        yield


@pytest.fixture
def context():
    """The context of a bare host, current until the end of the test."""
    made = gl_host.make_context()
    yield made
    egl.library().eglMakeCurrent(egl.library().eglGetCurrentDisplay(), None, None, None)
    made.release()
