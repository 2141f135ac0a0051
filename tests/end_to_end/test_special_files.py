"""What is no plain file, or holds nothing, is called so wherever a file is read; nothing waits for it for ever."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

import sonar_gl as sg
from tests.support.command_line import SONAR
from tests.support.file_readers import POSES, READERS, SUFFIXES

GIT_LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"
KINDS = {  # kind -> (function that makes one at a path, what messages say)
    "folder": (os.mkdir, "must be a file (got a folder"),
    "pipe": (os.mkfifo, "must be a file (got a named pipe; write its content to a file first)"),
    "device": (lambda path: os.symlink("/dev/null", path), "must be a file (got a device"),
    "endless device": (lambda path: os.symlink("/dev/zero", path), "must be a file (got a device"),
    "Git LFS": (
        lambda path: path.write_text(GIT_LFS),
        "got a pointer of Git LFS; fetch the file by 'git lfs pull'",
    ),
}
WAIT_S = 60  # a machine that tests run on may be slow


@contextmanager
def at_once():
    """Fail if the block waits: opening a pipe to which nobody writes does so for ever."""

    def fail(*_):
        raise AssertionError(f"it waits for more than {WAIT_S} s")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(WAIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def message(folder, reader) -> str:
    with at_once(), pytest.raises(sg.Error) as caught:
        READERS[reader](folder, "odd")
    return str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_called_so(tmp_path, reader, kind):
    make, words = KINDS[kind]
    for suffix in SUFFIXES:
        make(tmp_path / f"odd{suffix}")
    if kind.endswith("device") and reader.endswith("of a scene"):  # scenes may not name files elsewhere
        words = "it leads to /dev/"
    if kind == "folder" and reader in ("scene", "mesh", "scene of a job"):  # it may be that of a model
        words = "must be a file, or the folder of a model (it has no model.sdf)"
    text = message(tmp_path, reader)
    assert words in text and "odd." in text


@pytest.mark.parametrize("reader", [name for name in READERS if "job" not in name and "sonar" not in name])
def test_an_empty_file_is_called_so(tmp_path, reader):
    for suffix in SUFFIXES:
        (tmp_path / f"odd{suffix}").touch()
    words = (
        "must hold at least one pose" if reader == "poses" else "must not be empty (got a file of 0 bytes)"
    )
    assert words in message(tmp_path, reader)


def test_poses_may_come_through_a_pipe_that_is_open():
    """As by `--poses /dev/stdin`, or `--poses <(...)` of a shell."""
    program = (
        "import sys; from sonar_gl.core.poses import read_poses; print(len(read_poses('/dev/stdin')[1]))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], input=POSES, capture_output=True, text=True, timeout=60
    )
    assert (ran.stdout, ran.stderr) == ("1\n", "")


@pytest.mark.slow
def test_a_sonar_may_come_through_a_pipe_that_is_open():
    """As by `--sonar /dev/stdin`, or `--sonar <(sonar-gl sonars p900-45)` of a shell; a change of it may follow."""
    program = "import sys; from sonar_gl.sonar.sonar_files import load_sonar; print(load_sonar(sys.argv[1]).n_beams)"
    for what, printed in (("/dev/stdin", "24\n"), ("/dev/stdin,n_beams=12", "12\n")):
        ran = subprocess.run(
            [sys.executable, "-c", program, what], input=SONAR, capture_output=True, text=True, timeout=60
        )
        assert (ran.stdout, ran.stderr) == (printed, "")


def test_what_is_no_file_and_no_folder_is_not_called_a_missing_sonar(tmp_path):
    os.mkfifo(tmp_path / "sonar")
    with at_once(), pytest.raises(sg.Error) as caught:
        sg.load_sonar(tmp_path / "sonar")
    told = "must be a file (got a named pipe; write its content to a file first)"
    assert str(caught.value) == f"{tmp_path}/sonar: {told}"
