"""Parts of a batch made by the workers of a Dask cluster; they write what they make, and tell the result."""

from __future__ import annotations

import asyncio
import ctypes
import logging
import queue
import time
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec

from sonar_gl._version import __version__
from sonar_gl.types import Error

POLL_S = 1.0  # how often is looked whether workers came or went
NO_WORKER_S = 1800.0  # a worker whose time is over is replaced from a cluster's queue, which takes a while
M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -3, -1  # of malloc.h


def run_on_cluster(
    address: str,
    make: Callable[[int], dict],
    parts: Iterable[int],
    done: Callable[[int, dict], None],
    killed: Callable[[int, str], None],
    timeout_s: float = 20.0,
) -> None:
    """Have every part made by a worker of a cluster.

    A worker has one part in hand at a time, and no part waits at the scheduler: so it is known which part a
    worker died of. Such a part is given to other workers, until one more has died of it than the scheduler's
    setting `allowed-failures` says: the second, where the scheduler was started with
    DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES=1, the fourth otherwise.

    Parameters
    ----------
    address : of the scheduler, such as tcp://login1:8786
    make : function of a part that workers can import, or a functools.partial of one; a worker runs it in one
        and the same thread. Where a worker or the driver dies, it may run again for the same part
    parts : what is to be made; taken one by one, as workers become free
    done : called here, in this thread, with each part and what `make` gave back, as parts finish
    killed : called likewise with a part that is given up, and why
    timeout_s : how long to wait for the scheduler, and for the first worker

    Raises
    ------
    Error
        if there is no scheduler, no worker, or one with another version of this package or several threads.
    KeyboardInterrupt
        after the parts in hand are done; at once the second time.
    Exception
        whatever `make` raises; nobody waits then for the other parts in hand.
    """
    with _connected(address, timeout_s) as client:
        hands = _Hands(client, address, make, done, killed)
        hands.wait_for_worker(timeout_s)
        try:
            for part in parts:
                hands.take(part)
            hands.finish()
        except KeyboardInterrupt:
            hands.finish()
            raise


class _Hands:
    """The parts that workers have in hand."""

    def __init__(self, client, address: str, make, done, killed):
        self._client, self._address, self._make = client, address, make
        self._done, self._killed = done, killed
        self._parts = {}  # future: part
        self._ended = queue.SimpleQueue()
        self._n_workers, self._looked_s, self._seen_s = 0, 0.0, time.monotonic()

    def wait_for_worker(self, timeout_s: float):
        while not self._free(timeout_s):
            time.sleep(0.1)

    def take(self, part: int):
        """Give a part to a worker; waits for one that has none."""
        while not self._free():
            self._settle()
        future = self._client.submit(_made, self._make, part, __version__, pure=False)
        self._parts[future] = part
        future.add_done_callback(self._ended.put)

    def finish(self):
        """Wait for all parts in hand."""
        for future in self._parts:
            if future.done():  # it was being settled when the user interrupted
                self._ended.put(future)
        while self._parts:
            self._free()
            self._settle()

    def _free(self, timeout_s: float = NO_WORKER_S) -> bool:
        """Whether a worker has no part; an Error if there was no worker for so long."""
        now = time.monotonic()
        if now - self._looked_s > POLL_S or not self._n_workers:
            with self._scheduler_lost(OSError, asyncio.TimeoutError):
                self._n_workers, self._looked_s = len(self._client.nthreads()), now
            if self._n_workers:
                self._seen_s = now
            elif now - self._seen_s > timeout_s:
                raise Error(
                    f"the cluster must have a worker (got none for {timeout_s:g} s; start some: "
                    f"dask worker {self._address} --nthreads 1)"
                )
        return len(self._parts) < self._n_workers

    def _settle(self):
        """Hand over a part that has ended, if one does soon."""
        from distributed import KilledWorker

        try:
            future = self._ended.get(timeout=POLL_S)
        except queue.Empty:
            return
        if future not in self._parts:
            return
        try:
            with self._scheduler_lost():
                result = future.result()
        except KilledWorker as why:
            place = why.last_worker.address
            self._killed(self._parts[future], f"{why.allowed_failures + 1} workers died of it, last {place}")
        else:
            self._done(self._parts[future], result)
        del self._parts[future]

    @contextmanager
    def _scheduler_lost(self, *kinds):
        from distributed.comm import CommClosedError

        try:
            yield
        except (asyncio.CancelledError, CancelledError, CommClosedError, *kinds):
            raise Error(
                f"the scheduler at {self._address} must stay (it went away; start the cluster again, then "
                "the batch, which goes on where it was)"
            ) from None


def check_installed() -> None:
    """An Error where Dask is not."""
    if find_spec("distributed") is None:
        raise Error("a cluster needs Dask (got none; pip install distributed)")


@contextmanager
def _connected(address: str, timeout_s: float):
    """A client of the scheduler."""
    for name in "distributed.client", "distributed.utils":  # what they would tell is told by errors
        logging.getLogger(name).setLevel(logging.CRITICAL)
    check_installed()
    from distributed import Client

    try:
        with ThreadPoolExecutor(1) as thread:  # not here: notebooks have a loop of their own
            thread.submit(asyncio.run, _greet(address, timeout_s)).result()
        client = Client(address, timeout=timeout_s, set_as_default=False)
    except (OSError, asyncio.TimeoutError, ValueError) as why:
        raise Error(
            f"a Dask scheduler must answer at {address or 'an address'} (got: {str(why) or 'silence'}; start "
            "one: dask scheduler, which prints its address)"
        ) from None
    with client:
        yield client


async def _greet(address: str, timeout_s: float):
    """Wait no longer than so for what listens there: Dask's client would, where it is no scheduler."""
    from distributed import Security
    from distributed.comm import connect

    secrets = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=timeout_s, **secrets), timeout_s)
    await comm.close()


def _made(make, part, version):
    """What a worker runs."""
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
    _keep_memory()
    return make(part)


@cache
def _keep_memory():
    """Let a worker's malloc keep what is freed, as glibc's does of itself.

    Dask starts workers with MALLOC_TRIM_THRESHOLD_, and any value of it has glibc take every large array's
    pages anew from the kernel: that makes half as many pings a second.
    """
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(M_MMAP_THRESHOLD, 32 << 20)
        mallopt(M_TRIM_THRESHOLD, 64 << 20)
