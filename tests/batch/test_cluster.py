"""Parts of a batch on a cluster: of threads in this process, or a real one of two workers, some of which die."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import CancelledError
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from distributed import Client, KilledWorker, LocalCluster, get_client
from distributed.comm import CommClosedError

from sonar_gl import Error
from sonar_gl.batch import cluster
from sonar_gl.batch.cluster import Cluster, run_on_cluster
from sonar_gl.batch.job import read_job
from sonar_gl.batch.steps import STEPS
from sonar_gl.core.errors import MachineError
from tests.support import cluster_parts
from tests.support.batches import files_of, make_all, write_job

with_programs = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]


class Driver:
    """Runs parts on a cluster and counts the results."""

    def __init__(self, when_done=lambda part: None):
        self.done, self.killed, self._when_done = Counter(), {}, when_done

    def run(self, address, make, parts, timeout_s=20):
        def done(part, result):
            assert result["part"] == part
            self._when_done(part)
            self.done[part] += 1

        run_on_cluster(address, make, parts, done, self.killed.__setitem__, timeout_s)


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Address of a scheduler with two workers, each a program of its own as on a real cluster."""
    folder = tmp_path_factory.mktemp("cluster")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]),
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
    """Address of a cluster of threads in this process."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, protocol="tcp", processes=False, dashboard_address=":0"
    ) as here:
        yield here.scheduler_address


def tries(folder):
    """Return part -> processes that tried it."""
    return {int(file.name): file.read_text().split() for file in folder.iterdir()}


@with_programs
def test_the_part_of_a_dead_worker_is_made_by_another(address, tmp_path):
    """Every other part is made once, and the result of each part comes once."""
    victims, begun = [], []

    def parts():
        for part in range(40):
            begun.append(part)
            yield part

    def kill_worker_of_part_5(part):
        assert len(begun) - driver.done.total() <= 3  # this one, one at the other worker, the next
        if not victims and 5 in tries(tmp_path):
            victims.extend(tries(tmp_path)[5])
            os.kill(int(victims[0]), signal.SIGKILL)

    driver = Driver(kill_worker_of_part_5)
    driver.run(address, partial(cluster_parts.wait_to_be_killed, tmp_path), parts())
    assert driver.done == dict.fromkeys(range(40), 1) and not driver.killed
    by_part = tries(tmp_path)
    first, second = by_part.pop(5)
    assert first == victims[0] != second
    # the part that the dead worker had just made may be made again, since its result is lost
    assert sum(len(pids) for pids in by_part.values()) <= len(by_part) + 1


@with_programs
def test_a_part_that_kills_two_workers_is_given_up(address, tmp_path):
    """New workers make all other parts."""
    driver = Driver()
    driver.run(address, partial(cluster_parts.deadly, tmp_path), range(8))
    assert driver.done == dict.fromkeys({*range(8)} - {3}, 1)
    assert set(driver.killed) == {3} and driver.killed[3].startswith("2 workers died of it")
    assert len(set(tries(tmp_path)[3])) == 2


@with_programs
def test_a_batch_has_the_same_bytes_if_workers_die(address, tmp_path):
    """The command line, with workers that write into the folder themselves. They die by themselves, not too late."""
    job, out, begun, made = (
        write_job(tmp_path, 48, more=""),
        *(tmp_path / n for n in ("out", "begun", "made")),
    )
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)  # some have died before
        client.run(cluster_parts.die_at_parts, begun=(3, str(begun)), made=(7, str(made)))
    command = [sys.executable, "-m", "sonar_gl", "batch", job, "--out", out, "--cluster", address]
    batch = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=200)
    assert (batch.returncode, batch.stdout) == (0, f"{out}: 48 of 48 pings\n")
    assert begun.exists()
    make_all(job, tmp_path / "here")
    assert files_of(out) == files_of(tmp_path / "here")


@with_programs
def test_workers_keep_freed_memory(address):
    """With Dask's own setting it would be 50 times the 256 pages of the array."""
    found = []
    run_on_cluster(
        address, cluster_parts.pages, range(4), lambda part, result: found.append(result["pages"]), print
    )
    assert len(found) == 4 and max(found) < 2 * 256


def test_an_interrupt_finishes_the_parts_in_progress_and_begins_no_others(inside, tmp_path):

    def interrupt(part):
        if not interrupts:
            interrupts.append(part)
            signal.raise_signal(signal.SIGINT)

    interrupts, driver = [], Driver(interrupt)
    with pytest.raises(KeyboardInterrupt):
        driver.run(inside, partial(cluster_parts.count, tmp_path), [0, 5, 6, 7])
    assert driver.done == dict.fromkeys(tries(tmp_path), 1) == {0: 1, 5: 1} and interrupts == [0]


@pytest.mark.slow
def test_each_worker_has_one_part_at_a_time_and_none_waits(inside, tmp_path):
    """Part 5 is slow: the other worker makes part 0 meanwhile."""
    begun, made = [], []

    def parts():
        for part in (5, 0, 1, 2, 3):
            begun.append(part)
            yield part

    def look(part):
        made.append(part)
        assert len(begun) - len(made) <= 2  # the other one, and the next

    driver = Driver(look)
    driver.run(inside, partial(cluster_parts.count, tmp_path), parts())
    assert made[0] == 0 and driver.done == dict.fromkeys([0, 1, 2, 3, 5], 1)


@pytest.mark.slow
@pytest.mark.parametrize("failures", [1, 3])
def test_a_part_that_the_scheduler_gives_up_is_reported_with_the_last_worker(inside, failures):
    error = KilledWorker("part", SimpleNamespace(address="tcp://last"), failures)
    driver = Driver()
    driver.run(inside, partial(cluster_parts.raising, error, 1), range(3))
    assert driver.done == {0: 1, 2: 1}
    assert driver.killed == {1: f"{failures + 1} workers died of it, last tcp://last"}


@pytest.mark.parametrize("kind", [CommClosedError, CancelledError])
def test_a_result_that_is_lost_with_the_scheduler_is_an_error_of_the_machine(inside, kind):
    with pytest.raises(MachineError, match=f"the scheduler at {inside} must stay .it has gone; .*--resume"):
        Driver().run(inside, partial(cluster_parts.raising, kind(), 1), [1])


@pytest.mark.parametrize("kind", [CommClosedError, OSError, asyncio.TimeoutError])
def test_a_scheduler_that_does_not_answer_has_gone(inside, monkeypatch, kind):
    def fail(_):
        raise kind

    monkeypatch.setattr(Client, "nthreads", fail)
    with pytest.raises(MachineError, match=f"the scheduler at {inside} must stay"):
        Driver().run(inside, cluster_parts.failing, [1])


def count_every_1000_s(monkeypatch, *n_workers):
    """Have workers counted a thousand seconds apart, in these numbers; then there are two."""
    clock, counts = SimpleNamespace(now=1e6), [*n_workers]

    def count(_):
        clock.now += 1000.0
        return dict.fromkeys(range(counts.pop(0) if counts else 2), 1)

    monkeypatch.setattr(Client, "nthreads", count)
    monkeypatch.setattr(cluster, "time", SimpleNamespace(monotonic=lambda: clock.now, sleep=time.sleep))
    return counts


@pytest.mark.slow
def test_workers_may_be_away_for_less_than_half_an_hour(inside, tmp_path, monkeypatch):
    counts, driver = count_every_1000_s(monkeypatch, 2, 2, 2, 0, 2, 0), Driver()
    driver.run(inside, partial(cluster_parts.count, tmp_path), range(6))
    assert driver.done == dict.fromkeys(range(6), 1) and not counts


@pytest.mark.parametrize("parts", [range(6), [5]], ids=["while parts begin", "while the last one is made"])
def test_workers_that_are_away_for_longer_are_missed(inside, tmp_path, monkeypatch, parts):
    count_every_1000_s(monkeypatch, 2, 2, 0, 0)
    monkeypatch.setattr(cluster, "POLL_S", 0.01)  # part 5 takes half a second
    missed = r"the cluster must have a worker \(got none for 1800 s; start some: dask worker tcp:"
    with pytest.raises(Error, match=missed):
        Driver().run(inside, partial(cluster_parts.count, tmp_path), parts)


@pytest.mark.slow
def test_a_notebook_may_use_a_cluster(inside, tmp_path):
    """Its cells run in an event loop. The client is not the one of the notebook's own tasks."""

    async def cell():
        driver.run(inside, partial(cluster_parts.count, tmp_path), range(2))

    def look_for_default_client(_part):
        with pytest.raises(ValueError):
            get_client(timeout=0)

    driver = Driver(look_for_default_client)
    asyncio.run(cell())
    assert driver.done == {0: 1, 1: 1}


def test_steps_and_parts_have_the_batch_of_the_worker(inside, tmp_path, monkeypatch):
    """It is made once: it loads scenes."""
    job, url, batches = read_job(write_job(tmp_path)), str(tmp_path / "out"), []

    def batch(requests, folder, any_system):
        batches.append((requests.job.digest, folder.url, any_system, os.environ["LP_NUM_THREADS"]))
        return batches[-1]

    monkeypatch.setattr(cluster, "Batch", batch)
    monkeypatch.setattr(cluster, "make_part", lambda *given: given)
    monkeypatch.setitem(STEPS, "look", lambda *given: given)
    monkeypatch.setenv("LP_NUM_THREADS", "9")  # to restore it
    monkeypatch.delenv("LP_NUM_THREADS")
    remote, records = Cluster(inside, job, url, any_system=True), []
    expected = job.digest, url, True, "1"
    assert remote.call("look", 7, "all") == (expected, 7, "all")
    assert remote.run_parts([3, 1, 2], records.append, pytest.fail) == []
    assert sorted(records) == [(expected, 1), (expected, 2), (expected, 3)] and len(batches) == 1


def test_parts_that_workers_died_of_are_left_to_the_caller(tmp_path, monkeypatch):
    job, interrupts, records, warnings = read_job(write_job(tmp_path)), [], [], []

    def run(_address, _make, parts, done, killed):
        assert parts == [1, 2, 3]
        done(1, "first")
        done(1, "again")  # its worker died after it had made it
        killed(2, "2 workers died of it, last tcp://last")
        done(3, "third")
        if interrupts:
            raise KeyboardInterrupt

    monkeypatch.setattr(cluster, "run_on_cluster", run)
    remote = Cluster("tcp://nowhere", job, "out")
    assert remote.run_parts([1, 2, 3], records.append, warnings.append) == [2]
    assert records == ["first", "third"]
    assert warnings == ["part 2: 2 workers died of it, last tcp://last; it is made here, ping by ping"]
    interrupts.append(True)
    assert remote.run_parts([1, 2, 3], records.append, warnings.append) == []


def test_a_step_that_workers_died_of_is_an_error_of_the_machine(tmp_path, monkeypatch):
    def run(_address, _make, parts, _done, killed):
        (part,) = parts
        killed(part, "2 workers died of it")

    monkeypatch.setattr(cluster, "run_on_cluster", run)
    why = r"workers must live \(in the step 'begin' 2 workers died of it; try again by --resume\)"
    with pytest.raises(MachineError, match=why):
        Cluster("tcp://nowhere", read_job(write_job(tmp_path)), "out").call("begin")


def test_exceptions_of_a_part_are_raised_here(inside):
    with pytest.raises(OSError, match="no space left for part 2"):
        Driver().run(inside, cluster_parts.failing, [2])


def test_a_worker_with_another_version_is_refused(inside, monkeypatch):
    calls = []
    make = partial(calls.append)
    monkeypatch.setattr(cluster, "__version__", "0.0.1")
    theirs = partial(cluster.run_part, version="0.0.2")
    monkeypatch.setattr(cluster, "run_part", lambda make, part, _: theirs(make, part))
    with pytest.raises(Error, match=r"must have sonar_gl 0.0.2, as here \(got 0.0.1 at tcp:.*same there"):
        Driver().run(inside, make, [1])
    assert not calls


def test_a_worker_with_several_threads_is_refused():
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=2, protocol="tcp", processes=False, dashboard_address=":0"
        ) as here,
        pytest.raises(Error, match=r"must have one thread.*\(got 2 at tcp:.*--nthreads 1"),
    ):
        Driver().run(here.scheduler_address, cluster_parts.failing, [1])


def test_a_cluster_without_workers_is_refused():
    with (
        LocalCluster(n_workers=0, protocol="tcp", processes=False, dashboard_address=":0") as here,
        pytest.raises(Error, match=r"must have a worker \(got none for 0.1 s; start some: dask worker tcp:"),
    ):
        Driver().run(here.scheduler_address, cluster_parts.failing, [1], timeout_s=0.1)


@pytest.mark.slow
def test_another_server_at_the_address_is_refused():
    """It stays silent, as a web server does until it gets a request."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = "tcp://{}:{}".format(*other.getsockname())
        with pytest.raises(
            Error, match=f"a Dask scheduler must answer at {address} .got: silence; start one"
        ):
            Driver().run(address, cluster_parts.failing, [1], timeout_s=0.5)


@pytest.mark.parametrize(
    "wrong",
    [
        "tcp://127.0.0.1:9",
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in ("nothing://there", "tcp://no.such.host.invalid:80")
        ),
    ],
)
def test_an_address_without_a_scheduler_is_refused(wrong):
    with pytest.raises(Error, match=f"a Dask scheduler must answer at {wrong} .got: .*start one"):
        Driver().run(wrong, cluster_parts.failing, [1], timeout_s=0.3)


def test_a_cluster_needs_an_address():
    with pytest.raises(Error, match=r"a Dask scheduler must answer at an address \(got: .*start one"):
        Driver().run("", cluster_parts.failing, [1], timeout_s=0.3)


@with_programs
def test_the_error_for_a_dead_scheduler(address, tmp_path):
    """The last test here, since it leaves no cluster."""
    with Client(address, set_as_default=False) as client:
        pid = client.run_on_scheduler(os.getpid)
    driver = Driver(lambda part: os.kill(pid, signal.SIGKILL))
    with pytest.raises(Error, match=f"the scheduler at {address} must stay"):
        driver.run(address, partial(cluster_parts.count, tmp_path), range(1000))
