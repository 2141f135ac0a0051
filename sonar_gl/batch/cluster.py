"""Parts made by the workers of a Dask cluster. Workers write the files; only the records come back."""

from __future__ import annotations

import asyncio
import ctypes
import json
import logging
import os
import queue
import time
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, lru_cache, partial
from importlib.util import find_spec

from sonar_gl._version import __version__
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.manifest import PartRecord
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.steps import STEPS, make_part
from sonar_gl.core.errors import Error, MachineError
from sonar_gl.core.extras import missing_extra

POLL_S = 1.0  # between checks whether workers came or went
NO_WORKER_S = 1800.0  # a queue may take a while to replace a worker whose time is over
M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -3, -1  # of malloc.h


# ---- a batch on a cluster ---------------------------------------------------------------------------


class Cluster:
    """The workers of a cluster, which run the steps of a batch as the processes of a `Pool` do.

    Raises Error if Dask is not installed.
    """

    def __init__(self, address: str, job: Job, url: str, any_system: bool = False):
        check_installed()
        self._address, self.arguments = address, (json.dumps(job.plain), url, any_system)

    def call(self, name: str, *arguments):
        """Run one of `steps.STEPS` on a worker, and return its result."""
        results, make = [], partial(_run_step, *self.arguments, name, arguments)

        def give_up(_number, why):
            raise MachineError(
                f"workers must live (in the step {name!r} {why}; try again by --resume)"
            ) from None

        run_on_cluster(self._address, make, [0], lambda _number, result: results.append(result), give_up)
        return results[0]

    def run_parts(
        self, parts: list[int], done: Callable[[PartRecord], None], warn: Callable[[str], None]
    ) -> list[int]:
        """Make parts, and return those that workers died of. After Ctrl-C none are returned.

        done : called with the record of each part as it is done
        """
        given_up, finished = [], set()

        def give_up(part, why):
            warn(f"part {part}: {why}; it is made here, ping by ping")
            given_up.append(part)

        def finish(part, record):
            if part not in finished:  # a part may come twice after a death
                finished.add(part)
                done(record)

        try:
            run_on_cluster(self._address, partial(_make_part, *self.arguments), parts, finish, give_up)
        except KeyboardInterrupt:
            return []
        return given_up


@lru_cache(1)
def _batch_of_worker(job: str, url: str, any_system: bool) -> Batch:
    """Return the batch of this worker, the same from part to part. job : plain values as JSON."""
    os.environ.setdefault("LP_NUM_THREADS", "1")  # the software driver would otherwise use all cores
    return Batch(BatchRequests(Job(**json.loads(job))), Folder(url), any_system=any_system)


def _make_part(job: str, url: str, any_system: bool, part: int) -> PartRecord:
    return make_part(_batch_of_worker(job, url, any_system), part)


def _run_step(job: str, url: str, any_system: bool, name: str, arguments: tuple, _number: int):
    return STEPS[name](_batch_of_worker(job, url, any_system), *arguments)


# ---- parts of anything on a cluster -----------------------------------------------------------------


def run_on_cluster(
    address: str,
    make: Callable[[int], object],
    parts: Iterable[int],
    done: Callable[[int, object], None],
    killed: Callable[[int, str], None],
    timeout_s: float = 20.0,
) -> None:
    """Have every part made by a worker of a cluster.

    A worker has one part at a time, and no part waits at the scheduler, so it is known which part a worker
    died of. Such a part is given to other workers until one more has died of it than the scheduler's setting
    `allowed-failures`: the second, if the scheduler was started with
    DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES=1, otherwise the fourth.

    Raises Error if there is no scheduler, no worker, or one with another version of this package or several threads;
    KeyboardInterrupt after the parts in progress are done, the second time at once; and whatever `make` raises, without
    waiting for other parts in progress.

    address : address of the scheduler, such as tcp://login1:8786
    make : function of a part that workers can import, or a functools.partial of one. A worker always runs it
        in the same thread. It may run again for the same part if the worker or the driver dies
    parts : parts to make; taken one by one, as workers become free
    done : called in this thread with each part and the result of `make`, as parts finish
    killed : called likewise with a part that is given up, and why
    timeout_s : how long to wait for the scheduler, and for the first worker
    """
    with _connected(address, timeout_s) as client:
        progress = _Progress(client, address, make, done, killed)
        progress.wait_for_worker(timeout_s)
        try:
            for part in parts:
                progress.start(part)
            progress.finish()
        except KeyboardInterrupt:
            progress.finish()
            raise


class _Progress:
    """The parts that workers are making."""

    def __init__(self, client, address: str, make, done, killed):
        self._client, self._address, self._make = client, address, make
        self._done, self._killed = done, killed
        self._parts = {}  # future -> part
        self._ended = queue.SimpleQueue()
        self._n_workers, self._counted_s, self._last_worker_s = 0, 0.0, time.monotonic()

    def wait_for_worker(self, timeout_s: float) -> None:
        """Wait for the first worker."""
        while not self._has_free_worker(timeout_s):
            time.sleep(0.1)

    def start(self, part: int) -> None:
        """Wait for a free worker and give it a part."""
        while not self._has_free_worker():
            self._settle()
        future = self._client.submit(run_part, self._make, part, __version__, pure=False)
        self._parts[future] = part
        future.add_done_callback(self._ended.put)

    def finish(self) -> None:
        """Wait for all parts in progress."""
        for future in self._parts:
            if future.done():  # it was being settled when the user interrupted
                self._ended.put(future)
        while self._parts:
            self._has_free_worker()
            self._settle()

    def _has_free_worker(self, timeout_s: float = NO_WORKER_S) -> bool:
        """Return whether a worker has no part; an Error if there has been no worker for that long."""
        now = time.monotonic()
        if now - self._counted_s > POLL_S or not self._n_workers:
            with self._scheduler_loss_as_error(OSError, asyncio.TimeoutError):
                self._n_workers, self._counted_s = len(self._client.nthreads()), now
            if self._n_workers:
                self._last_worker_s = now
            elif now - self._last_worker_s > timeout_s:
                raise Error(
                    f"the cluster must have a worker (got none for {timeout_s:g} s; start some: "
                    f"dask worker {self._address} --nthreads 1)"
                )
        return len(self._parts) < self._n_workers

    def _settle(self) -> None:
        """Pass on the result of a part, if one ends within POLL_S."""
        from distributed import KilledWorker

        try:
            future = self._ended.get(timeout=POLL_S)
        except queue.Empty:
            return
        if future not in self._parts:
            return
        try:
            with self._scheduler_loss_as_error():
                result = future.result()
        except KilledWorker as why:
            last = why.last_worker.address
            self._killed(self._parts[future], f"{why.allowed_failures + 1} workers died of it, last {last}")
        else:
            self._done(self._parts[future], result)
        del self._parts[future]

    @contextmanager
    def _scheduler_loss_as_error(self, *kinds):
        from distributed.comm import CommClosedError

        try:
            yield
        except (asyncio.CancelledError, CancelledError, CommClosedError, *kinds):
            raise MachineError(
                f"the scheduler at {self._address} must stay (it has gone; start the cluster again, then the "
                "batch with --resume)"
            ) from None


def check_installed() -> None:
    """Raise an Error if Dask is not installed."""
    if find_spec("distributed") is None:
        raise missing_extra("cluster", "a cluster needs Dask (got no module distributed)")


@contextmanager
def _connected(address: str, timeout_s: float):
    """Give a client of the scheduler."""
    for name in "distributed.client", "distributed.utils":  # their messages repeat our errors
        logging.getLogger(name).setLevel(logging.CRITICAL)
    check_installed()
    from distributed import Client

    try:
        with ThreadPoolExecutor(1) as thread:  # in a thread, since notebooks have a running event loop here
            thread.submit(asyncio.run, _try_connection(address, timeout_s)).result()
        client = Client(address, timeout=timeout_s, set_as_default=False)
    except (OSError, asyncio.TimeoutError, ValueError) as why:
        raise Error(
            f"a Dask scheduler must answer at {address or 'an address'} (got: {str(why) or 'silence'}; start "
            "one: dask scheduler, which prints its address)"
        ) from None
    with client:
        yield client


async def _try_connection(address: str, timeout_s: float) -> None:
    """Connect within the timeout, which Dask's client exceeds where something else listens."""
    from distributed import Security
    from distributed.comm import connect

    secrets = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=timeout_s, **secrets), timeout_s)
    await comm.close()


def run_part(make: Callable[[int], object], part: int, version: str):
    """Make a part on a worker, which must have this version and one thread."""
    from distributed import get_worker

    worker = get_worker()
    if version != __version__:
        raise Error(
            f"workers must have sonar_gl {version}, as here (got {__version__} at {worker.address}; "
            "install the same there)"
        )
    if worker.state.nthreads != 1:
        raise Error(
            f"a worker must have one thread, as OpenGL has (got {worker.state.nthreads} at {worker.address}; "
            "start it with --nthreads 1, several times if the machine has the cores)"
        )
    _keep_freed_memory()
    return make(part)


@cache
def _keep_freed_memory() -> None:
    """Let a worker's malloc keep freed memory, as glibc does by default.

    Dask starts workers with MALLOC_TRIM_THRESHOLD_. With any value of it glibc takes the pages of every large
    array from the kernel anew, which halves the pings per second.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library; TypeError: of Windows
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, 32 << 20)
        mallopt(M_TRIM_THRESHOLD, 64 << 20)
