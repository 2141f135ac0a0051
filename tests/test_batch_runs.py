"""Batches in which something goes wrong: nothing is lost, nothing is torn, nothing is made twice."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr
from batches import LABELS, files_of, make_all, write_job

from sonar_gl.batch import pool as pools
from sonar_gl.batch.files import Folder
from sonar_gl.batch.job import read_job
from sonar_gl.batch.planned import Planned
from sonar_gl.batch.pool import Pool

HERE = Path(__file__).parent
N, PART = 48, 4
MORE = "[coco]\nheight = 60\n[ros]\n"


def start(*arguments, before=(), **environment):
    """A batch under way in a process of its own."""
    command = [*before, sys.executable, HERE / "batch_faults.py", "batch", *map(str, arguments)]
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), *sys.path]), **environment}
    settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": paths}
    return subprocess.Popen(command, **settings)


def finish(process):
    """(exit status, stdout, stderr)."""
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


def workers_of(process) -> list[int]:
    """Processes that make its parts."""
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
    """Until so many parts are done."""
    deadline = time.monotonic() + 60
    while len(list((folder / "parts").glob("*.json"))) < count:
        assert process.poll() is None, finish(process)
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    return write_job(tmp_path_factory.mktemp("job"), N, LABELS + MORE)


@pytest.fixture(scope="module")
def whole(job, tmp_path_factory):
    """Every file of the batch, made in one process without a fault."""
    out = tmp_path_factory.mktemp("whole") / "out"
    make_all(job, out)
    return files_of(out)


def assert_same(found: dict, expected: dict):
    assert list(found) == list(expected)
    assert [name for name in found if found[name] != expected[name]] == []


def test_a_worker_that_hangs_is_replaced(job, whole, tmp_path, monkeypatch):
    out, told, records = tmp_path / "out", [], []
    out.mkdir()
    (out / "planned.json").write_bytes(whole["planned.json"])

    def tell(text):
        told.append(text)
        monkeypatch.undo()

    def done(record):
        records.append(record["part"])
        if len(records) == 1:  # it stops, and is waited for no longer
            os.kill(pool._processes[0].process.pid, signal.SIGSTOP)
            monkeypatch.setattr(pools, "STALL_S", 0.1)

    with Pool(read_job(job).plain, str(out), [None], tell) as pool:
        pool.ask("create")
        pool.run(range(3), Planned.load(Folder(out)).numbers, done)
    assert records == [0, 1, 2]
    assert told == ["a process died at part 1 (exit code -9); another takes its place"]
    parts = files_of(out / "parts")
    assert parts == {name: whole[f"parts/{name}"] for name in parts} and len(parts) == 6


def test_a_batch_goes_on_whatever_stopped_it(job, whole, tmp_path):
    """Killed with its store half made; a worker killed, and then Ctrl-C; killed itself; whole at last."""
    out = tmp_path / "out"
    out.mkdir()
    (out / ".planned.0123.json").write_text("{")  # of one that was killed still earlier
    process = start(job, "--out", out, "--workers", "1")
    while not (out / "pings.zarr" / "level" / "zarr.json").exists():
        assert process.poll() is None, finish(process)
    process.kill()
    process.communicate()
    (out / ".planned.0123.json").unlink()
    assert (out / "planned.json").read_bytes() == whole["planned.json"]
    assert not (out / "parts").exists()

    process = start(job, "--out", out, "--workers", "2", "--resume", SLOW_S="0.05")
    wait_for_parts(out, 1, process)
    workers = workers_of(process)
    assert len(workers) == 2
    os.kill(workers[0], signal.SIGKILL)
    wait_for_parts(out, 2, process)
    process.send_signal(signal.SIGINT)
    status, told, err = finish(process)
    assert status == 130
    again = f"sonar-gl batch {job} --out {out} --resume"
    assert re.fullmatch(f"{out}: \\d+ of {N} pings; go on with: {again}\n", told)
    assert len(re.findall(r"^a process died at part \d \(exit code -9\)", err, re.MULTILINE)) == 1
    assert "finishing the pings in hand" in err and "Traceback" not in err
    first = files_of(out / "parts")
    assert 4 <= len(first) < 2 * N / PART

    process = start(job, "--out", out, "--workers", "2", "--resume", SLOW_S="0.05")
    wait_for_parts(out, len(first) // 2 + 1, process)
    workers = workers_of(process)
    process.kill()
    process.communicate()
    assert len(workers) == 2
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{worker}").exists() for worker in workers):  # they do not outlive it
        assert time.monotonic() < deadline
        time.sleep(0.01)
    second = files_of(out / "parts")
    assert len(first) < len(second) < 2 * N / PART
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.suffix == ".json"}

    status, told, err = finish(start(job, "--out", out, "--workers", "1", "--resume"))
    assert (status, told) == (0, f"{out}: {N} of {N} pings\n"), err
    assert {name: whole[f"parts/{name}"] for name in second} == second
    again = [path for path, at in times.items() if "parts" in path.parts and path.stat().st_mtime_ns != at]
    assert again == []  # nothing that was done is done again
    assert_same(files_of(out), whole)


def test_a_ping_that_kills_twice_is_set_aside(job, whole, tmp_path):
    out = tmp_path / "out"
    status, told, err = finish(start(job, "--out", out, "--workers", "1", DEADLY="1.2"))
    assert status == 3
    assert told == f"{out}: {N - 1} of {N} pings, 1 set aside\n"
    (line,) = [line for line in err.splitlines() if line.startswith("set aside")]
    assert line == (
        "set aside: ping 6 of seed 5, vehicle at '0 0 0 0 0 0.12' in tank.sdf: "
        "the process that made it died, 2 times"
    ) or re.match(r"set aside: ping 6 of seed 5, vehicle at '0 0 0 0 -?0 \S+' in tank.sdf: the process", line)
    data = xr.open_dataset(out / "pings.zarr", group="level")
    assert data.status.values.tolist() == [1] * 6 + [2] + [1] * (N - 7)
    assert (data.intensity[6] == 0).all()
    found = files_of(out)
    assert {name for name in whole if "/1/0" not in name and found.get(name) != whole[name]} < {
        *(f"parts/0000001.{suffix}" for suffix in ("json", "npy")),
        *(name for name in whole if name.startswith(("bag/", "coco/")) or "status" in name or "echo" in name),
        "done.json",
    }
    record = json.loads(found["parts/0000001.json"])
    assert record["set_aside"] == {"6": "the process that made it died, 2 times"}


def test_a_full_disk_stops_a_batch_that_then_goes_on(job, whole, tmp_path):
    """On a file system of its own, too small at first."""
    disk = tmp_path / "disk"
    disk.mkdir()
    script = f"""
        mount -t tmpfs -o size=500k tmpfs {disk}
        "$@" --out {disk}/out; echo "status $?"
        mount -o remount,size=50m {disk}
        "$@" --out {disk}/out --resume; echo "status $?"
        cp -r {disk}/out {tmp_path}/out
    """
    apart = "unshare", "--user", "--map-root-user", "--mount", "sh", "-c"
    if shutil.which("unshare") is None or subprocess.run([*apart, f"mount -t tmpfs tmpfs {disk}"]).returncode:
        why = (
            "a full disk is a file system that is mounted in a namespace of one's own, which must be allowed"
        )
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    _, told, err = finish(start(job, "--workers", "1", before=(*apart, script, "sh")))
    first, _, then = told.partition("status 2\n")
    assert first == "" and then == f"{disk}/out: {N} of {N} pings\nstatus 0\n", (told, err)
    assert "No space left on device" in err and "--resume" in err and "Traceback" not in err
    assert_same(files_of(tmp_path / "out"), whole)
