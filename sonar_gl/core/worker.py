"""A thread that does jobs beside its callers, such that an interrupted caller leaves nothing half done behind it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from threading import Lock, Thread, get_ident

from sonar_gl.core.errors import Error, closed_error


class ThreadLock:
    """A lock; a thread that holds it gets an Error in place of waiting for itself.

    Parameters
    ----------
    message : of the Error
    """

    def __init__(self, message: str):
        self._lock, self._owner, self._message = Lock(), None, message

    def check_free(self) -> None:
        """Raise the Error if this thread holds the lock."""
        if self._owner == get_ident():
            raise Error(self._message)

    @contextmanager
    def held(self):
        """Hold the lock for the time of the block; an interrupt at any point releases it."""
        self.check_free()
        with self._lock:
            try:
                self._owner = get_ident()
                yield
            finally:
                self._owner = None


class Job:
    """Work for a thread. Whoever claims it first, the thread or a caller, does it and stores its result.

    Attributes
    ----------
    answer, failure : what `work` has returned or raised
    is_done : whether it has
    """

    def __init__(self, work: Callable[[], object]):
        self.answer, self.failure, self.is_done = None, None, False
        self._work, self._claims, self._undone = work, [], Lock()
        self._undone.acquire()

    def claim(self) -> bool:
        """Return whether this thread has claimed the job first.

        An interrupt at any point leaves that decided, as appending to a list is atomic.
        """
        self._claims.append(get_ident())
        return self._claims[0] == get_ident()

    def do(self) -> None:
        """Do the work, if it is not done, and store its result or exception; call it after `claim`."""
        if self.is_done:
            return
        try:
            self.answer = self._work()
        except BaseException as why:
            self.failure = why
        self._work = None  # the closure holds a reference to its owner
        self.is_done = True
        self._undone.release()

    def settle(self) -> None:
        """Have the job done: wait for the thread that does it, or do it here if none has begun."""
        if not self.claim():
            with self._undone:
                pass
            return
        self.do()
        if self.failure is not None and not isinstance(self.failure, Exception):
            raise self.failure  # an interrupt of this thread

    def result(self):
        """Settle the job; return its answer, or raise its exception again."""
        self.settle()
        if self.failure is not None:
            raise self.failure
        return self.answer


def _serve(queue: SimpleQueue) -> None:
    """Do jobs from the queue until it yields None."""
    while (job := queue.get()) is not None:
        if job.claim():
            job.do()
        job = None


class JobThread:
    """A thread that does jobs in turn, started with the first. A queue takes half the time of an executor.

    Parameters
    ----------
    name : of the thread
    """

    def __init__(self, name: str):
        self._name, self._queue, self._started = name, SimpleQueue(), Lock()

    def submit(self, job: Job) -> None:
        """Hand a job over. If that is interrupted, `Job.settle` still has the job done, once."""
        if self._started.acquire(blocking=False):
            try:
                Thread(target=_serve, args=(self._queue,), name=self._name, daemon=True).start()
            except BaseException:
                self._started.release()
                raise
        self._queue.put(job)

    def close(self) -> None:
        """End the thread after the jobs that it has; a second call does nothing."""
        self._queue.put(None)

    def __del__(self):
        self._queue.put(None)


class SecondThread:
    """A thread that runs the second half of work. Several callers may share it.

    Each job holds its own result, so an interrupted wait does not affect the next job.
    """

    def __init__(self):
        self._thread, self._is_closed, self._abandoned = JobThread("sonar_gl second half"), False, []

    def run_halves(self, work: Callable[[int], object]) -> tuple:
        """Return (work(0), work(1)); the thread runs the second, or the caller does if the thread is busy.

        Raises
        ------
        Error
            after `close`. Exceptions of either half are raised again.
        """
        if self._is_closed:
            raise closed_error("SecondThread")
        for half in list(self._abandoned):  # they may still write to arrays of this job
            half.settle()
            with suppress(ValueError):  # another caller has removed it
                self._abandoned.remove(half)
        half = Job(lambda: work(1))
        try:
            self._thread.submit(half)
            first = work(0)
            return first, half.result()
        except BaseException:
            if not half.claim():  # the thread is running it, or has
                self._abandoned.append(half)
            raise

    def close(self) -> None:
        """Stop the thread; a second call does nothing."""
        self._is_closed = True
        self._thread.close()
