"""Batches in which something goes wrong: nothing is lost or damaged, and nothing is made twice."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path

import numba
import pytest
import trimesh
import xarray as xr

from sonar_gl.batch import pool as pool_module
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import read_job
from sonar_gl.batch.manifest import Manifest
from sonar_gl.batch.pool import IN_PROGRESS, Pool
from sonar_gl.batch.steps import begin
from sonar_gl.engine import sequence
from tests.support.batch_pings import N_SMALL
from tests.support.batches import LABELS, MORE, files_of, make_all, open_batch, write_job, write_plain_job
from tests.support.command_line import run
from tests.support.waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
N, PART = 48, 4
OUTPUTS = "[coco]\nheight = 60\n[ros]\n"


def start(*arguments, before=(), **environment):
    """Start a batch in a process of its own."""
    command = [*before, sys.executable, "-m", "tests.support.batch_faults", "batch", *map(str, arguments)]
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), **environment}
    settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": paths}
    return subprocess.Popen(command, **settings)


def finish(process):
    """Wait for a batch; return its exit status, stdout and stderr."""
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


def workers_of(process) -> list[int]:
    """Return the ids of the processes that make the parts of a batch."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_text()
        except (OSError, ValueError, IndexError):
            continue
        if parent == process.pid and "spawn_main" in command:
            found.append(int(folder.name))
    return found


def wait_for_parts(folder: Path, count: int, process):
    """Wait until so many parts are done."""

    def are_done():
        assert process.poll() is None, finish(process)
        return len(list((folder / "parts").glob("*.json"))) >= count

    wait_until(are_done)


def _serve_the_number_of_threads(*arguments):
    """Serve in a process of a pool, with one more step."""
    pool_module.STEPS["threads"] = lambda batch, report: numba.config.NUMBA_NUM_THREADS
    pool_module.serve(*arguments)


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    return write_job(tmp_path_factory.mktemp("job"), N, LABELS + OUTPUTS)


@pytest.fixture(scope="module")
def expected(job, tmp_path_factory):
    """Every file of the batch, made in one process without a fault."""
    out = tmp_path_factory.mktemp("expected") / "out"
    make_all(job, out)
    return files_of(out)


def assert_same(found: dict, expected: dict):
    assert list(found) == list(expected)
    assert [name for name in found if found[name] != expected[name]] == []


@pytest.mark.slow
def test_a_process_that_hangs_is_replaced(job, expected, tmp_path, monkeypatch):
    out, warnings, parts = tmp_path / "out", [], []
    out.mkdir()
    (out / "batch.json").write_bytes(expected["batch.json"])

    def warn(text):
        warnings.append(text)
        monkeypatch.undo()

    def done(record):
        parts.append(record.part)
        if len(parts) == 1:  # from now on it hangs, and the pool soon gives it up
            os.kill(pool.processes[0].pid, signal.SIGSTOP)
            monkeypatch.setattr(pool_module, "STALL_S", 0.1)

    with Pool(read_job(job).plain, str(out), [None], warn) as pool:
        pool.call("create")
        pool.run_parts(range(3), Manifest.load(Folder(out)).numbers, done)
    assert parts == [0, 1, 2]
    assert warnings == ["a process died at part 1 (SIGKILL); another takes its place"]
    found = files_of(out / "parts")
    assert found == {name: expected[f"parts/{name}"] for name in found} and len(found) == 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_cores", "asked", "n_threads"), [(5, None, 2), (1, None, 1), (4, None, 2), (4, "3", 3)]
)
def test_processes_share_the_cores(job, tmp_path, monkeypatch, n_cores, asked, n_threads):
    """Two of them, each with as many threads as leave a core to each, or as the user says.

    The environment of this process keeps what it says of threads, since another thread may compile meanwhile.
    """
    monkeypatch.setattr(pool_module, "count_cores", lambda: n_cores)
    monkeypatch.setattr(pool_module, "serve", _serve_the_number_of_threads)
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    if asked:
        monkeypatch.setenv("NUMBA_NUM_THREADS", asked)
    found, start_process = [], BaseProcess.start

    def start(process):
        found.append(os.environ.get("NUMBA_NUM_THREADS"))
        start_process(process)

    monkeypatch.setattr(BaseProcess, "start", start)
    with Pool(read_job(job).plain, str(tmp_path), [None, None], print) as pool:
        assert pool.call("threads") == n_threads
    assert found == [asked]


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_signals_that_come_at_once_stop_a_batch_as_one_does(tmp_path, monkeypatch, number):
    """`timeout` sends its signal to the batch and to its group: the second broke off the parts in progress."""
    path, run_parts = write_plain_job(tmp_path, 4, 2), Pool.run_parts

    def run_with_signals(pool, *arguments, **more):
        for _ in range(2):
            signal.raise_signal(number)
        run_parts(pool, *arguments, **more)

    monkeypatch.setattr(Pool, "run_parts", run_with_signals)
    out = tmp_path / "out"
    status, shown, err = run("batch", path, "--out", out, "--workers", "1")
    assert (status, shown) == (
        130,
        f"{out}: 0 of 4 pings; continue with: sonar-gl batch {path} --out {out} --resume\n",
    )
    assert err.count("finishing the parts in progress") == 1


@pytest.mark.slow
def test_a_batch_can_be_resumed_whatever_stopped_it(job, expected, tmp_path):
    """Killed while its store is created; a process killed, then Ctrl-C; killed itself; complete at last."""
    out = tmp_path / "out"
    out.mkdir()
    (out / ".batch.0123.json").write_text("{")  # of a batch that was killed even earlier
    process = start(job, "--out", out, "--workers", "1")
    while not (out / "pings.zarr" / "level" / "zarr.json").exists():
        assert process.poll() is None, finish(process)
    process.kill()
    process.communicate()
    (out / ".batch.0123.json").unlink()
    assert (out / "batch.json").read_bytes() == expected["batch.json"]
    assert not (out / "parts").exists()

    process = start(job, "--out", out, "--workers", "2", "--resume", SLOW_S="0.05")
    wait_for_parts(out, 1, process)
    workers = workers_of(process)
    assert len(workers) == 2
    os.kill(workers[0], signal.SIGKILL)
    wait_for_parts(out, 2, process)
    process.send_signal(signal.SIGINT)
    status, shown, err = finish(process)
    assert status == 130
    command = f"sonar-gl batch {job} --out {out} --resume"
    assert re.fullmatch(f"{out}: \\d+ of {N} pings; continue with: {command}\n", shown)
    assert len(re.findall(r"^a process died at part \d \(SIGKILL\)", err, re.MULTILINE)) == 1
    assert "finishing the parts in progress" in err and "Traceback" not in err
    first = files_of(out / "parts")
    assert 4 <= len(first) < 2 * N / PART

    process = start(job, "--out", out, "--workers", "2", "--resume", SLOW_S="0.05")
    wait_for_parts(out, len(first) // 2 + 1, process)
    workers = workers_of(process)
    process.kill()
    process.communicate()
    assert len(workers) == 2
    # they do not outlive it
    wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers))
    second = files_of(out / "parts")
    assert len(first) < len(second) < 2 * N / PART
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.suffix == ".json"}

    status, shown, err = finish(start(job, "--out", out, "--workers", "1", "--resume"))
    assert (status, shown) == (0, f"{out}: {N} of {N} pings\n"), err
    assert {name: expected[f"parts/{name}"] for name in second} == second
    again = [path for path, at in times.items() if "parts" in path.parts and path.stat().st_mtime_ns != at]
    assert again == []  # no finished part is made again
    assert_same(files_of(out), expected)


@pytest.mark.slow
def test_a_ping_that_kills_two_processes_is_set_aside(job, expected, tmp_path):
    out = tmp_path / "out"
    status, shown, err = finish(start(job, "--out", out, "--workers", "1", DEADLY="1.2"))
    assert status == 3
    assert shown == f"{out}: {N - 1} of {N} pings, 1 set aside\n"
    (line,) = [line for line in err.splitlines() if line.startswith("set aside")]
    assert line == (
        "set aside: ping 6 of seed 5, vehicle at '0 0 0 0 0 0.12' in tank.sdf: "
        "the process that made it died, 2 times"
    ) or re.match(r"set aside: ping 6 of seed 5, vehicle at '0 0 0 0 -?0 \S+' in tank.sdf: the process", line)
    data = xr.open_dataset(out / "pings.zarr", group="level")
    assert data.status.values.tolist() == [1] * 6 + [2] + [1] * (N - 7)
    assert (data.intensity[6] == 0).all()
    found = files_of(out)
    assert {name for name in expected if "/1/0" not in name and found.get(name) != expected[name]} < {
        *(f"parts/0000001.{suffix}" for suffix in ("json", "npy")),
        *(
            name
            for name in expected
            if name.startswith(("bag/", "coco/"))
            or any(
                word in name for word in ("status", "echo", "error_estimate", "columns_per_beam", "/rows/")
            )
        ),
        "done.json",
    }
    record = json.loads(found["parts/0000001.json"])
    assert record["set_aside"] == {"6": "the process that made it died, 2 times"}


def apart(disk: Path) -> tuple[str, ...]:
    """Return the command that runs a script where it may mount a file system at a folder."""
    found = "unshare", "--user", "--map-root-user", "--mount", "sh", "-c"
    if shutil.which("unshare") is None or subprocess.run([*found, f"mount -t tmpfs tmpfs {disk}"]).returncode:
        why = "a full disk is a file system mounted in a namespace of its own, which must be allowed"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    return found


@pytest.mark.slow
def test_a_batch_can_be_resumed_after_a_full_disk(job, expected, tmp_path):
    """On a file system of its own, which is too small at first."""
    disk = tmp_path / "disk"
    disk.mkdir()
    script = f"""
        mount -t tmpfs -o size=500k tmpfs {disk}
        "$@" --out {disk}/out; echo "status $?"
        mount -o remount,size=50m {disk}
        "$@" --out {disk}/out --resume; echo "status $?"
        cp -r {disk}/out {tmp_path}/out
    """
    _, shown, err = finish(start(job, "--workers", "1", before=(*apart(disk), script, "sh")))
    first, _, then = shown.partition("status 2\n")
    assert first == "" and then == f"{disk}/out: {N} of {N} pings\nstatus 0\n", (shown, err)
    assert "No space left on device" in err and "--resume" in err and "Traceback" not in err
    assert_same(files_of(tmp_path / "out"), expected)


@pytest.mark.slow
def test_a_dry_run_without_space_names_the_variable(job, tmp_path):
    """It cannot be resumed."""
    disk = tmp_path / "disk"
    disk.mkdir()
    script = f'mount -t tmpfs -o size=16k tmpfs {disk}; TMPDIR={disk} "$@"'
    status, shown, err = finish(
        start(job, "--dry-run", "--workers", "1", before=(*apart(disk), script, "sh"))
    )
    assert (status, shown) == (2, "")
    assert re.fullmatch(
        rf"error: {disk}/\S+: No space left on device; set TMPDIR to another folder for temporary files\n",
        err,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGKILL", "SIGSEGV"])
def test_a_process_that_dies_while_it_begins_is_replaced(job, expected, tmp_path, name):
    out, left = tmp_path / "out", tmp_path / "left"
    left.write_text("2")
    process = start(job, "--out", out, "--workers", "1", DEADLY_BEGINS=str(left), SIGNAL=name)
    status, shown, err = finish(process)
    assert (status, shown) == (0, f"{out}: {N} of {N} pings\n"), err
    assert err.count(f"a process died in the step 'begin' ({name}); another takes its place\n") == 2
    assert_same(files_of(out), expected)


@pytest.mark.slow
@pytest.mark.parametrize(("option", "again"), [("--any-system", " by --resume"), ("--dry-run", "")])
def test_processes_that_die_again_and_again_are_no_mistake_of_the_user(job, tmp_path, option, again):
    """Status 2 would tell a queue not to try again."""
    out, left = tmp_path / "out", tmp_path / "left"
    left.write_text("1000")
    status, shown, err = finish(start(job, "--out", out, "--workers", "1", option, DEADLY_BEGINS=str(left)))
    assert (status, shown) == (4, "")
    assert err.splitlines()[-1] == (
        "error: processes must live (the step 'begin' ended 3 of them, the last by SIGKILL; is memory short? "
        f"'sonar-gl doctor' may say why; try again{again})"
    )
    assert "Traceback" not in err


@pytest.mark.slow
def test_a_ping_by_which_processes_segfault_is_set_aside(job, tmp_path):
    out = tmp_path / "out"
    status, shown, err = finish(start(job, "--out", out, "--workers", "1", DEADLY="1.2", SIGNAL="SIGSEGV"))
    assert (status, shown) == (3, f"{out}: {N - 1} of {N} pings, 1 set aside\n")
    assert err.count("a process died at part 1 (SIGSEGV); another takes its place\n") == 2


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--dry-run", "--workers=2"])
def test_a_warning_of_a_scene_is_shown_once_whichever_processes_load_it(tmp_path, option):
    job = write_plain_job(tmp_path, 8, 4, LABELS)
    world = tmp_path / "tank.sdf"
    world.write_text(re.sub("<laser_retro>.*?</laser_retro>", "", world.read_text()))
    status, _, err = finish(start(job, "--out", tmp_path / "out", option))
    assert status == 0, err
    assert err.count("no <laser_retro> in 3 of 3 bodies") == 1 and err.startswith(
        f"warning: {world}: no <las"
    )
    assert "UserWarning" not in err


@pytest.mark.slow
def test_the_error_of_a_process_without_memory_is_one_sentence(tmp_path):
    """Its pings take more than it is allowed: of 1024 beams and 8192 bins, 34 MB for each array."""
    job = write_plain_job(tmp_path, 4, 4, LABELS)
    sonar = tmp_path / "small.toml"
    sonar.write_text(sonar.read_text().replace("n_beams = 24", "n_beams = 1024").replace("= 80", "= 8192"))
    status, shown, err = finish(start(job, "--out", tmp_path / "out", "--workers", "1", MEMORY_MB="20"))
    assert (status, shown) == (2, "")
    *_, line = err.splitlines()
    assert re.fullmatch(
        r"error: memory ran out \(.+\); have fewer --workers, or ask for fewer beams, bins or pixels, and "
        "continue with --resume",
        line,
    )
    assert "Traceback" not in err


def test_existing_files_are_not_overwritten(small, tmp_path):
    job, out = small / "job.toml", small / "out"
    before = files_of(out)
    status, _, err = run("batch", job, "--out", out)
    assert status == 2 and "must hold no batch yet (continue it by --resume" in err
    changed = tmp_path / "job.toml"
    write_job(tmp_path, N_SMALL, LABELS + MORE)
    changed.write_text(changed.read_text().replace("seed = 5", "seed = 6"))
    status, _, err = run("batch", changed, "--out", out, "--resume")
    assert status == 2 and "(changed: seed;" in err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("years")
    status, _, err = run("batch", job, "--out", tmp_path / "full", "--resume")
    assert status == 2 and "must be an empty folder, or one with a batch to --resume" in err
    assert files_of(out) == before
    status, shown, _ = run("batch", job, "--out", out, "--resume")  # nothing is left to do
    assert (status, shown) == (0, f"{out}: {N_SMALL} of {N_SMALL} pings\n")
    assert files_of(out) == before


def test_resuming_names_the_files_that_have_changed(tmp_path):
    """Files of the job, meshes, included models and what these name; in and beside the folder of the job."""
    folder, meshes = tmp_path / "job", tmp_path / "meshes"
    (meshes / "rock").mkdir(parents=True)
    folder.mkdir()
    job = write_job(folder, 2, "")
    job.write_text('resource_paths = ["../meshes"]\n' + job.read_text())
    trimesh.creation.box((1, 20, 20)).export(folder / "wall.obj")
    for name, data in _gltf(1.0).items():
        (meshes / "rock" / name).write_bytes(data)
    (meshes / "rock" / "model.sdf").write_text(
        "<sdf version='1.9'><model name='rock'><link name='l'><collision name='c'><geometry><mesh><uri>model.gltf</uri>"
        "</mesh></geometry><laser_retro>9</laser_retro></collision></link></model></sdf>"
    )
    rock = "<include><uri>model://rock</uri><pose>4 1 0 0 0 0</pose></include></world>"
    text = (folder / "tank.sdf").read_text().replace("</world>", rock)
    wall = "<box><size>1 20 20</size></box>"
    (folder / "tank.sdf").write_text(text.replace(wall, "<mesh><uri>wall.obj</uri></mesh>", 1))
    batch = open_batch(job, tmp_path / "out")
    begin(batch).save(batch.folder)

    def changed():
        status, out, err = run("batch", job, "--out", tmp_path / "out", "--resume", "--workers", "1")
        assert (status, out) == (2, "")
        return re.search(r"resumed with the job that began it \(changed: (.*); restore that, or", err)[1]

    buffer = "gltf_buffer_1.bin"  # the vertices
    changes = {
        folder / "wall.obj": ("wall.obj", lambda data: data.replace(b"v 0.5", b"v 0.6")),
        folder / "tank.sdf": ("tank.sdf", lambda data: data + b"<!-- another one -->"),
        folder / "small.toml": ("small.toml", lambda data: data + b"# another one"),
        meshes / "rock" / "model.sdf": (
            None,
            lambda data: data.replace(b"</uri>", b"</uri><scale>1 1 2</scale>"),
        ),
        meshes / "rock" / buffer: (None, lambda _: _gltf(1.5)[buffer]),
    }
    for path, (name, change) in changes.items():
        before = path.read_bytes()
        path.write_bytes(change(before))
        assert changed() == (name or str(path))
        path.write_bytes(before)
    for path in (folder / "wall.obj", folder / "small.toml"):
        path.write_bytes(changes[path][1](path.read_bytes()))
    job.write_text(job.read_text().replace("seed = 5", "seed = 6"))
    assert changed() == "seed, small.toml, wall.obj"


def _gltf(height_m):
    """Return the files of a box, by name."""
    return trimesh.creation.box((1, 1, height_m)).scene().export(file_type="gltf")


def test_the_pings_in_progress_are_those_that_a_sequence_may_have_begun():
    assert IN_PROGRESS == 2 * sequence.BATCH + 1
