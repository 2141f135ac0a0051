import gc
import os
import select
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import moderngl
import pytest

from sonar_gl.core.compiled import announce_compilation
from tests.support.kernels import compile_kernels

ROOT = Path(__file__).resolve().parents[1]

# a shell has what it runs in the background ignore Ctrl-C, which some tests send to commands, in this process or others
signal.signal(signal.SIGINT, signal.default_int_handler)
# commands run in this process, too, and which test compiles a kernel first depends on those that were chosen
announce_compilation(False)


def pytest_sessionstart(session):
    """Compile kernels before all tests, once for all their processes; who names tests compiles what those need."""
    config = session.config
    is_complete = config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.option.keyword
    is_kept = hasattr(config, "cache")  # not with `-p no:cacheprovider`
    options = config.option
    runs_none = (
        options.collectonly or options.showfixtures or options.show_fixtures_per_test or options.setupplan
    )
    if is_complete and is_kept and not hasattr(config, "workerinput") and not runs_none:
        compile_kernels(config.cache, config.get_terminal_writer().line)


def pytest_collection_finish():
    """Have the garbage collector pass over modules and thousands of tests; a full collection takes 0.2 s with them."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def display():
    """Name of an X display that nobody sees."""
    if shutil.which("Xvfb") is None:
        why = "hosts that come by GLX need a display: apt-get install xvfb"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    command = "Xvfb", "-displayfd", "1", "-screen", "0", "1280x1024x24", "-nolisten", "tcp"
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    try:
        ready, _, _ = select.select([server.stdout], [], [], 30)
        number = server.stdout.readline().decode().strip() if ready else ""
        assert number, "Xvfb must say which display it has"
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


@pytest.fixture(scope="session")
def run_beside(request):
    """Function (module of tests.support, *arguments) -> what it printed; those with "glx" have a display."""

    def run(name: str, *arguments: str, **environment: str) -> str:
        inherited = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "MESA_GL_VERSION_OVERRIDE")}
        if "glx" in arguments:
            environment["DISPLAY"] = request.getfixturevalue("display")
        home = os.pathsep.join([str(ROOT), *sys.path])
        done = subprocess.run(
            [sys.executable, "-m", f"tests.support.{name}", *arguments],
            env={**inherited, "PYTHONPATH": home, **environment},
            capture_output=True,
            text=True,
            timeout=100,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    return run


@pytest.fixture(scope="module")
def few_first_rays():
    """Has references compare their halves early, as a million rays are more than small scenes need; `error` holds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sonar_gl.analysis.reference.FIRST_RAYS", 2**17)
        yield


@pytest.fixture
def timed_once(monkeypatch):
    """Has prices of terms, and `sonar-gl plan`, time one ping each, for tests that ask for no times."""
    monkeypatch.setattr("sonar_gl.analysis.terms.TURNS", 1)
    monkeypatch.setattr("sonar_gl.cli.plan.TURNS", 1)


@pytest.fixture
def opengl_engine(monkeypatch):
    """Has simulators draw by OpenGL, also on a software driver."""
    monkeypatch.setenv("SONAR_GL_ENGINE", "opengl")


@pytest.fixture
def opengl_for_pyrender():
    """Skips where the driver lacks the OpenGL 4.1 that pyrender asks for; sonar_gl itself needs 3.3."""
    try:
        moderngl.create_context(standalone=True, require=410, backend="egl").release()
    except Exception as why:  # moderngl and glcontext raise plain Exception
        pytest.skip(f"pyrender needs OpenGL 4.1 ({why})")
