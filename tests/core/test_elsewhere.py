"""The core of the package needs nothing that macOS and Windows lack. Both are emulated: these tests run on Linux."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.batches import write_plain_job

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="the emulation takes away what Linux has"),
    pytest.mark.timeout(300),  # a process each, which compiles what is not kept yet
]
OUTPUTS = """[labels]
layers = ["body"]
[coco]
height = 40
[pictures]
formats = ["png", "npz"]
height = 40
[ros]
"""
LOCK_TWICE = """
from sonar_gl.batch.folder import Folder
from sonar_gl.core.errors import Error
with Folder({0!r}).locked():
    try:
        with Folder({0!r}).locked():
            pass
    except Error as why:
        print(why)
"""
CORES = """
import os
from sonar_gl.batch.run import devices_of
print(len(devices_of(None, ())) == os.cpu_count())
"""
MEMORY = """
from sonar_gl.core.memory import return_free_memory, sparse_table
return_free_memory()
table = sparse_table(3, 1000)
table[2, 999] = 7.0
print(table.sum())
"""
# the signal comes in the middle of an import that takes any exception for the lack of a module
IMPORT = """
import signal, time
try:
    signal.raise_signal(signal.SIGTERM)
    time.sleep(0.01)
except BaseException:
    pass
"""
INTERRUPTED = """
import importlib, sys, time
from pathlib import Path
sys.path.insert(0, str(Path(__file__).parent))
import sonar_gl as sg
from sonar_gl.cli.main import main

def ping(*_, **__):
    importlib.import_module("imports_anything")
    time.sleep(5)

sg.Simulator.ping = ping
sys.argv = ["sonar-gl", "render", "pylon", "--out", str(Path(__file__).parent)]
main()
"""
every_system = pytest.mark.parametrize("system", ["macos", "windows"])


def run_on(system, *command, status=0):
    """Run a command on an emulated system, and return what it printed; text files without encoding are errors."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("SONAR_GL_")}
    home = os.pathsep.join([str(ROOT), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.elsewhere", system, *map(str, command)],
        env={
            **inherited,
            "PYTHONPATH": home,
            "PYTHONWARNDEFAULTENCODING": "1",
            "PYTHONIOENCODING": "cp1252",
        },
        capture_output=True,
        text=True,
        encoding="cp1252",
        timeout=280,
    )
    assert done.returncode == status, done.stderr[-3000:]
    return done.stdout + done.stderr


def run_script(system, folder, text, status=0):
    """Write a script into a folder, and return what it printed on an emulated system."""
    script = folder / "script.py"
    script.write_text(text, encoding="utf-8")
    return run_on(system, script, status=status)


@pytest.mark.slow
@every_system
def test_a_ping_is_drawn_by_the_cpu_and_saved(system, tmp_path):
    run_on(system, "sonar-gl", "render", "pylon", "--format", "png", "--format", "npz", "--out", tmp_path)
    assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".npz"}


@pytest.mark.slow
def test_the_check_of_opengl_says_that_the_cpu_draws(tmp_path):
    check = "from sonar_gl.cli import system_checks\nprint(*system_checks.check_opengl())\n"
    text = run_script("macos", tmp_path, check)
    assert "None OpenGL must be reachable" in text and "pings are drawn by the CPU" in text


@pytest.mark.slow
def test_a_batch_is_made_in_a_folder_that_it_locks(tmp_path):
    job, out = write_plain_job(tmp_path, 2, 1, OUTPUTS), tmp_path / "out"
    run_on("windows", "sonar-gl", "batch", job, "--workers", "1", "--out", out)
    assert json.loads((out / "done.json").read_text(encoding="utf-8"))["parts"] == 2
    text = run_script("windows", tmp_path, LOCK_TWICE.format(str(out)))
    assert "must have one batch at a time (another is running in it)" in text


@pytest.mark.slow
@every_system
def test_a_batch_takes_all_cores_where_the_system_does_not_say_which(system, tmp_path):
    assert run_script(system, tmp_path, CORES).split()[-1] == "True"


@pytest.mark.slow
@every_system
def test_memory_and_allocators_of_other_systems_are_left_alone(system, tmp_path):
    assert run_script(system, tmp_path, MEMORY).split()[-1] == "7.0"


@pytest.mark.slow
def test_a_signal_within_an_import_is_not_lost_without_pthread_kill(tmp_path):
    (tmp_path / "imports_anything.py").write_text(IMPORT, encoding="utf-8")
    assert "error: interrupted" in run_script("windows", tmp_path, INTERRUPTED, status=130)


@pytest.mark.slow
@every_system
def test_asking_for_opengl_says_that_there_is_none(system, tmp_path):
    text = run_on(system, "sonar-gl", "render", "pylon", "--engine", "opengl", "--out", tmp_path, status=2)
    assert "error: OpenGL must be reachable through EGL" in text and "engine 'cpu'" in text
