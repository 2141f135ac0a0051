"""The command `batch` without a terminal: its progress is lines of a log."""

import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from tqdm import tqdm

from sonar_gl.batch import run as runs
from sonar_gl.cli.batch import Lines
from tests.support.command_line import BOX, SENSOR, SONAR, WALL, run

ROOT = Path(__file__).resolve().parents[2]
POSES = '[[poses]]\nkind = "trajectory"\nfile = "dive.csv"\n'


def write_job(bodies, rows="0,0,0,0,0,0,0\n", scene="", sonar="", more=""):
    """Write a job of a trajectory in a tank with these bodies; scene, sonar and more are keys and tables of it."""
    Path("tank.sdf").write_text(f'<sdf version="1.9"><world name="any">{bodies}</world></sdf>')
    Path("small.toml").write_text(SONAR)
    Path("dive.csv").write_text(f"t,x,y,z,roll,pitch,yaw\n{rows}")
    job = f'scenes = ["tank.sdf"]\n{scene}[[sonars]]\nsonar = "small.toml"\n{sonar}'
    Path("job.toml").write_text(job + POSES + more)


def dry_run():
    """(stdout, stderr) of a dry run of the job."""
    status, out, err = run("batch", "job.toml", "--dry-run", "--workers", "1")
    assert status == 0
    return out, err


def test_a_bar_without_a_terminal_writes_lines():
    stream = io.StringIO()
    with tqdm(total=4, mininterval=0, miniters=1, ascii=True, ncols=60, file=Lines(stream)) as bar:
        for _ in range(4):
            bar.update()
            tqdm.write("a report", file=stream)
    lines = stream.getvalue().splitlines()
    assert "\r" not in stream.getvalue() and stream.getvalue().endswith("\n")
    assert lines.count("a report") == 4
    bars = [line for line in lines if line != "a report"]
    assert all("%|" in line and line == line.strip() for line in bars)
    assert bars[0].startswith("0%|") and bars[-1].startswith("100%")


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (("--check", "file"), "file"),
        (("job.toml", "--out", "file"), "file"),
        (("job.toml", "--out", "file", "--resume"), "file"),
        (("job.toml", "--out", "pipe"), "pipe"),
    ],
)
def test_a_file_in_the_place_of_the_folder_of_a_batch_is_called_so(tmp_path, monkeypatch, words, where):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("mine")
    os.mkfifo("pipe")
    write_job(WALL + BOX + SENSOR)
    status, out, err = run("batch", *words)
    got = {"file": "a file", "pipe": "a named pipe"}[where]
    assert (status, out) == (2, "")
    assert err == f"error: {tmp_path}/{where}: the place of a batch must be a folder (got {got})\n"
    assert Path("file").read_text() == "mine"


@pytest.mark.parametrize("name", ["batch.json", ".batch.0123.json"])
def test_an_interrupted_batch_tells_of_its_files_if_there_are_any(name, tmp_path, monkeypatch):
    """Unfinished files, which begin with a dot, are none."""
    monkeypatch.chdir(tmp_path)
    Path("dive.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n")
    Path("job.toml").write_text('scenes = ["pylon"]\n[[sonars]]\nsonar = "p900-45"\n' + POSES)

    def interrupted(*_, **__):
        Path("made").mkdir()
        Path("made", name).write_text("{}")
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "run", interrupted)
    files = "; the files written so far are complete" if name == "batch.json" else ""
    assert run("batch", "job.toml", "--out", "made") == (130, "", f"error: interrupted{files}\n")


TWO_SONARS = """scenes = ["pylon"]
[[sonars]]
name = "level"
sonar = "p900-45"
[[sonars]]
name = "upright"
sonar = "p900-45"
mount = [0, 0, 0, 1.57, 0, 0]
"""


@pytest.mark.slow
def test_several_sonars_are_refused_without_assertions_at_once(tmp_path):
    """Zarr opens no group within another then: the first part ended with its traceback, after minutes."""
    (tmp_path / "dive.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n")
    (tmp_path / "job.toml").write_text(TWO_SONARS + POSES)
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    command = [sys.executable, "-O", "-m", "sonar_gl", "batch", "job.toml", "--out", "made"]
    done = subprocess.run(command, cwd=tmp_path, env=paths, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "error: a batch of several sonars must run with Python's assertions, without which Zarr opens no group of a "
        "sonar (got python -O; leave that out, or unset PYTHONOPTIMIZE)\n"
    )
    assert not (tmp_path / "made").exists()


POSE_ROWS = "0,0,0,0,0,0,0\n1,0,0,50,0,0,0\n2,0,0,0,0,0,3\n"


@pytest.mark.slow
def test_a_dry_run_tells_of_pings_without_an_echo(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_job(WALL, POSE_ROWS, sonar="mount = [0, 0, 0.5, 0, 0, 0]\n")
    (line,) = [line for line in dry_run()[0].splitlines() if "no echo" in line]
    assert line == (
        "  2 of these 3 pings have no echo, such as ping 1, sonar at '0 0 50.5 0 0 0' "
        "('sonar-gl render --pose' says why)"
    )
    write_job(WALL)
    assert "no echo" not in dry_run()[0]


@pytest.mark.slow
def test_a_dry_run_tells_of_a_sonar_in_a_body(tmp_path, monkeypatch):
    """The mount lifts the second ping out of the box, which the job has moved away from the third."""
    monkeypatch.chdir(tmp_path)
    rows = "0,-2,0.5,-0.2,0,0,0\n1,-2,0.5,0,0,0,0\n2,3,0.5,-0.2,0,0,0\n"
    moved = '[[vary.bodies]]\nnames = ["box"]\nx_m = -5\n'
    write_job(WALL + BOX, rows, sonar="mount = [0, 0, 0.2, 0, 0, 0]\n", more=moved)
    (line,) = [line for line in dry_run()[0].splitlines() if "in a body" in line]
    assert line == (
        "  1 of these 3 pings has the sonar in a body or below a floor, such as ping 0, sonar at "
        "'-2 0.5 0 0 0 0', in or below 'box'"
    )


@pytest.mark.slow
def test_a_dry_run_says_once_and_of_which_sonar_what_a_survey_warns_of(tmp_path, monkeypatch):
    """The survey's process showed the text once more, without the sonar and the scene."""
    monkeypatch.chdir(tmp_path)
    write_job(WALL, POSE_ROWS, scene="surface_z_m = -1\n", sonar='name = "head"\n')
    (line,) = [line for line in dry_run()[1].splitlines() if "above the water's surface" in line]
    assert line.startswith("warning: head in tank.sdf: the sonar is above the water's surface in some pings")


@pytest.mark.slow
def test_a_dry_run_tells_of_a_scene_in_millimetres_as_doctor_does(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wall = WALL.replace("1 20 20", "1000 200 500")
    assert wall != WALL
    write_job(wall, POSE_ROWS)
    (line,) = [line for line in dry_run()[1].splitlines() if "millimetres" in line]
    assert line.startswith(
        "warning: tank.sdf: the scene measures 1000 x 200 x 500 m: if it was made in centimetres or millimetres"
    )
    assert line.removeprefix("warning: tank.sdf: ") in run("doctor", "--scene", "tank.sdf")[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "batch must be given either a job file, or --check and a folder (got neither)"),
        ("job.toml --check .", "batch must be given either a job file, or --check and a folder (got both)"),
        *(
            (
                f"--check . {more}",
                f"--check and {more.split()[0]} exclude each other (a check makes no pings; leave one out)",
            )
            for more in (
                "--resume",
                "--dry-run",
                "--out made",
                "--workers 2",
                "--device 0",
                "--cluster tcp://a:1",
            )
        ),
        ("job.toml --dry-run --resume", "--dry-run and --resume exclude each other"),
    ],
)
def test_options_that_would_have_no_effect_are_refused(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    status, out, err = run("batch", *words.split())
    assert (status, out) == (2, "") and err.startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("words", [("--dry-run",), ("--out", "made")])
def test_processes_leave_warnings_of_scenes_to_the_command_which_shows_them_once(
    tmp_path, monkeypatch, capfd, words
):
    monkeypatch.chdir(tmp_path)
    wall = re.sub("<laser_retro>.*?</laser_retro>", "", WALL)
    write_job(wall + SENSOR, "0,0,0,0,0,0,0\n1,0,0,0,0,0,0\n")
    status, _, err = run("batch", "job.toml", *words, "--workers", "2")
    assert status == 0
    shown = [line for line in (err + capfd.readouterr().err).splitlines() if "laser_retro" in line]
    assert len(shown) == 1 and shown[0].startswith(f"warning: {tmp_path}/tank.sdf: no <laser_retro>")
