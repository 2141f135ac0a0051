import pytest


@pytest.fixture(autouse=True, scope="module")
def by_opengl():
    """Simulators of these tests draw by OpenGL, also on a software driver and in fixtures of a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SONAR_GL_ENGINE", "opengl")
        yield
