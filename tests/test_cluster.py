"""Parts of a batch on a real cluster of two workers, some of which die."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

import cluster_parts
import pytest
from batches import files_of, make_all, write_job
from distributed import Client, LocalCluster

from sonar_gl import Error
from sonar_gl.batch import cluster
from sonar_gl.batch.cluster import run_on_cluster

HERE = Path(__file__).parent


class Told:
    """What the driver was told of parts."""

    def __init__(self, when_done=lambda part: None):
        self.done, self.killed, self._when_done = Counter(), {}, when_done

    def run(self, address, make, parts, timeout_s=20):
        def done(part, told):
            assert told["part"] == part
            self._when_done(part)
            self.done[part] += 1

        run_on_cluster(address, make, parts, done, self.killed.__setitem__, timeout_s)


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Of a scheduler with two workers, all of them programs of their own as on a real cluster."""
    folder = tmp_path_factory.mktemp("cluster")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent), *sys.path]),
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
    }
    meeting = f"--scheduler-file={folder / 'scheduler.json'}"
    commands = (
        ("scheduler", "--host=127.0.0.1", "--port=0", meeting),
        ("worker", "--nworkers=2", "--nthreads=1", meeting),
    )
    with open(folder / "log", "w") as log:
        programs = [
            subprocess.Popen(
                [sys.executable, "-m", "dask", *command, "--no-dashboard"],
                env=environment,
                cwd=folder,
                stdout=log,
                stderr=log,
            )
            for command in commands
        ]
    try:
        while not (folder / "scheduler.json").exists():
            assert programs[0].poll() is None, (folder / "log").read_text()
            time.sleep(0.02)
        address = json.loads((folder / "scheduler.json").read_text())["address"]
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=30)
        yield address
    finally:
        for program in reversed(programs):
            program.terminate()
            program.wait()


@pytest.fixture(scope="module")
def inside():
    """Address of a cluster of threads of this process."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, protocol="tcp", processes=False, dashboard_address=":0"
    ) as here:
        yield here.scheduler_address


def tries(folder):
    """Part -> processes that tried it."""
    return {int(file.name): file.read_text().split() for file in folder.iterdir()}


def test_a_worker_dies(address, tmp_path):
    """Its part is made by another, everything else is made once, and no part is told twice."""
    victims, drawn = [], []

    def parts():
        for part in range(40):
            drawn.append(part)
            yield part

    def kill_who_has_5(part):
        assert len(drawn) - told.done.total() <= 3  # the one told of, one at the other worker, the next
        if not victims and 5 in tries(tmp_path):
            victims.extend(tries(tmp_path)[5])
            os.kill(int(victims[0]), signal.SIGKILL)

    told = Told(kill_who_has_5)
    told.run(address, partial(cluster_parts.count, tmp_path), parts())
    assert told.done == dict.fromkeys(range(40), 1) and not told.killed
    by_part = tries(tmp_path)
    first, second = by_part.pop(5)
    assert first == victims[0] != second
    # what it had made just before may be made again: its result went with it
    assert sum(len(pids) for pids in by_part.values()) <= len(by_part) + 1


def test_a_part_kills_workers(address, tmp_path):
    """It is given up after two of them, and told; all others are made, by workers that came anew."""
    told = Told()
    told.run(address, partial(cluster_parts.deadly, tmp_path), range(8))
    assert told.done == dict.fromkeys({*range(8)} - {3}, 1)
    assert set(told.killed) == {3} and told.killed[3].startswith("2 workers died of it")
    assert len(set(tries(tmp_path)[3])) == 2


def test_a_batch_has_the_same_bytes_where_a_worker_dies(address, tmp_path):
    """By the command line, with workers that write into the folder themselves."""
    job, out = write_job(tmp_path, 48, more=""), tmp_path / "out"
    with Client(address, set_as_default=False) as client:
        workers = list(client.run(os.getpid).values())
    command = "batch", job, "--out", out, "--cluster", address
    batch = subprocess.Popen([sys.executable, "-m", "sonar_gl", *command], stdout=subprocess.PIPE)
    while len(list((out / "parts").glob("*.json"))) < 2:
        assert batch.poll() is None
        time.sleep(0.005)
    os.kill(workers[0], signal.SIGKILL)
    assert len(list((out / "parts").glob("*.json"))) < 12
    told, _ = batch.communicate(timeout=100)
    assert (batch.returncode, told.decode()) == (0, f"{out}: 48 of 48 pings\n")
    make_all(job, tmp_path / "here")
    assert files_of(out) == files_of(tmp_path / "here")


def test_memory_is_kept(address):
    """Dask's own setting makes it 50 times the 256 pages of the array."""
    found = []
    run_on_cluster(
        address, cluster_parts.pages, range(4), lambda part, told: found.append(told["pages"]), print
    )
    assert len(found) == 4 and max(found) < 2 * 256


def test_interrupted(inside, tmp_path):
    """Parts in hand are made and told, no others are begun."""

    def interrupt(part):
        if not interrupts:
            interrupts.append(part)
            signal.raise_signal(signal.SIGINT)

    interrupts, told = [], Told(interrupt)
    with pytest.raises(KeyboardInterrupt):
        told.run(inside, partial(cluster_parts.count, tmp_path), [0, 5, 6, 7])
    assert told.done == dict.fromkeys(tries(tmp_path), 1) == {0: 1, 5: 1} and interrupts == [0]


def test_what_make_raises(inside):
    with pytest.raises(OSError, match="no space left for part 2"):
        Told().run(inside, cluster_parts.failing, [2])


def test_other_version(inside, monkeypatch):
    calls = []
    make = partial(calls.append)
    monkeypatch.setattr(cluster, "__version__", "0.0.1")
    theirs = partial(cluster._made, version="0.0.2")
    monkeypatch.setattr(cluster, "_made", lambda make, part, _: theirs(make, part))
    with pytest.raises(Error, match=r"must have sonar_gl 0.0.2, as here \(got 0.0.1 at tcp:.*same there"):
        Told().run(inside, make, [1])
    assert not calls


def test_several_threads():
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=2, protocol="tcp", processes=False, dashboard_address=":0"
        ) as here,
        pytest.raises(Error, match=r"must have one thread.*\(got 2 at tcp:.*--nthreads 1"),
    ):
        Told().run(here.scheduler_address, cluster_parts.failing, [1])


def test_no_worker():
    with (
        LocalCluster(n_workers=0, protocol="tcp", processes=False, dashboard_address=":0") as here,
        pytest.raises(Error, match=r"must have a worker \(got none for 0.1 s; start some: dask worker tcp:"),
    ):
        Told().run(here.scheduler_address, cluster_parts.failing, [1], timeout_s=0.1)


def test_something_else_listens():
    """And says nothing: a web server waits for its line, too."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = "tcp://{}:{}".format(*other.getsockname())
        with pytest.raises(
            Error, match=f"a Dask scheduler must answer at {address} .got: silence; start one"
        ):
            Told().run(address, cluster_parts.failing, [1], timeout_s=0.2)


@pytest.mark.parametrize("wrong", ["tcp://127.0.0.1:9", "nothing://there", "tcp://no.such.host.invalid:80"])
def test_no_scheduler(wrong):
    with pytest.raises(Error, match=f"a Dask scheduler must answer at {wrong} .got: .*start one"):
        Told().run(wrong, cluster_parts.failing, [1], timeout_s=0.3)


def test_scheduler_dies(address, tmp_path):
    """The last test here, for it leaves no cluster."""
    with Client(address, set_as_default=False) as client:
        pid = client.run_on_scheduler(os.getpid)
    told = Told(lambda part: os.kill(pid, signal.SIGKILL))
    with pytest.raises(Error, match=f"the scheduler at {address} must stay"):
        told.run(address, partial(cluster_parts.count, tmp_path), range(1000), timeout_s=2)
