"""A second thread for the second half of a job."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from threading import Lock, Thread

from sonar_gl.core.errors import closed_error

CALLER, THREAD = "caller", "thread"


class _Half:
    """The second half of a job; who claims it first, the caller or the thread, runs it and stores its result."""

    def __init__(self, work: Callable):
        self.work, self.answer, self.failure = work, None, None
        self._claims, self._undone = [], Lock()
        self._undone.acquire()

    def claim(self, who: str) -> bool:
        """Return whether CALLER or THREAD has claimed it first.

        An interrupt at any point leaves that decided, as appending to a list is atomic.
        """
        self._claims.append(who)
        return self._claims[0] is who

    def do(self) -> None:
        """Run the work and store its result or exception; call it after `claim`."""
        try:
            self.answer = self.work(1)
        except BaseException as why:
            self.failure = why
        self.work = None  # the closure holds a reference to its owner
        self._undone.release()

    def wait(self) -> None:
        """Wait until the work is done."""
        with self._undone:
            pass


def _serve(queue: SimpleQueue) -> None:
    """Run halves of jobs from the queue until it yields None."""
    while (half := queue.get()) is not None:
        if half.claim(THREAD):
            half.do()
        half = None


class SecondThread:
    """A thread that runs the second half of jobs, started with the first job. Several callers may share it.

    Each job holds its own result, so an interrupted wait does not affect the next job. A queue takes half the time of
    an executor of the standard library.
    """

    def __init__(self):
        self._queue, self._started, self._is_closed, self._abandoned = SimpleQueue(), Lock(), False, []

    def run_halves(self, work: Callable[[int], object]) -> tuple:
        """Return (work(0), work(1)); the thread runs the second, or the caller does if the thread is busy.

        Raises
        ------
        Error
            after `close`. Exceptions of either half are raised again.
        """
        if self._is_closed:
            raise closed_error("SecondThread")
        if self._started.acquire(blocking=False):
            try:
                Thread(target=_serve, args=(self._queue,), name="sonar_gl second half", daemon=True).start()
            except BaseException:
                self._started.release()
                raise
        for half in list(self._abandoned):  # they may still write to arrays of this job
            half.wait()
            with suppress(ValueError):  # another caller has removed it
                self._abandoned.remove(half)
        half = _Half(work)
        try:
            self._queue.put(half)
            first = work(0)
            if half.claim(CALLER):
                half.do()
            else:
                half.wait()
        except BaseException:
            if not half.claim(CALLER):  # the thread is running it, or has
                self._abandoned.append(half)
            raise
        if half.failure is not None:
            raise half.failure
        return first, half.answer

    def close(self) -> None:
        """Stop the thread; a second call does nothing."""
        self._is_closed = True
        self._queue.put(None)

    def __del__(self):
        self._queue.put(None)
