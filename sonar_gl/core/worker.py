"""Threads that do jobs beside their callers, such that an interrupted caller leaves nothing half done behind it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager, nullcontext, suppress
from queue import SimpleQueue
from threading import Lock, RLock, Thread

from sonar_gl.core.errors import Error, closed_error

# Beside a lock in one `with` statement, so that an interrupt at any line of the block releases the lock. A plain
# `with lock` does not if the interrupt comes at the step back to its own line, as from a debugger or a tracer: here
# that step lies before the end of the second manager, inside the first.
STEP_BACK = nullcontext()


class ThreadLock:
    """A lock; a thread that holds it gets an Error in place of waiting for itself."""

    def __init__(self, message: str):
        # the inner lock is only taken under the outer one, whose owner Python knows at any step: a signal handler may
        # come between acquiring a lock and noting by whom
        self._outer, self._inner, self._message = RLock(), Lock(), message

    def check_free(self) -> None:
        """Raise the Error if this thread holds the lock."""
        with self.held_if_free() as is_held:
            pass
        if is_held is None:
            raise Error(self._message)

    @contextmanager
    def held(self):
        """Hold the lock for the time of the block; an interrupt at any line releases it."""
        with self._outer, STEP_BACK:
            if self._inner.locked():  # by this thread
                raise Error(self._message)
            with self._inner, STEP_BACK:
                yield

    @contextmanager
    def held_if_free(self):
        """Hold the lock if it is free; yield True, or False if another thread holds it, or None if this one does."""
        is_acquired = False
        try:  # before the lock is acquired, so that an interrupt at the next line releases it
            is_acquired = self._outer.acquire(blocking=False)
            if not is_acquired:
                yield False
            elif self._inner.locked():
                yield None
            else:
                with self._inner, STEP_BACK:
                    yield True
        finally:
            if is_acquired:
                self._outer.release()


class Job:
    """Work for a thread. Whoever begins it first, the thread or a caller, does it and stores its result.

    A caller that is interrupted in the work leaves it undone: the next one who needs it begins it anew.

    in_use : message of the Error for a thread that does the work and would wait for it, as in a signal handler
    answer, failure : what `work` has returned or raised
    is_over : whether it is done, or cancelled
    """

    def __init__(self, work: Callable[[], object], in_use: str = "a job must not wait for itself"):
        self.answer, self.failure, self.is_over = None, None, False
        self._work, self._doing = work, ThreadLock(in_use)

    def begin(self) -> None:
        """Do the work, unless another thread does it; for threads that serve."""
        with self._doing.held_if_free() as is_held:
            if is_held:
                self._do()

    def check_free(self) -> None:
        """Raise an Error if this thread is in the middle of the work."""
        self._doing.check_free()

    def settle(self) -> None:
        """Have the job done: wait for the thread that does it, or do it here if none has begun."""
        if self._work is not None:  # else it has been done
            with self._doing.held():
                self._do()

    def cancel(self) -> None:
        """Have nobody begin the work from now on; `settle` then waits for a thread that has."""
        self.is_over = True

    def _do(self) -> None:
        if not self.is_over:
            answer = failure = None
            try:
                answer = self._work()
            except Exception as why:
                failure = why
            # the closure of the work holds a reference to its owner
            self.answer, self.failure, self._work, self.is_over = answer, failure, None, True

    def result(self):
        """Settle the job; return its answer, or raise its exception again."""
        self.settle()
        if self.failure is not None:
            raise self.failure
        return self.answer


def _serve(queue: SimpleQueue) -> None:
    """Do jobs from the queue until it yields None."""
    while (job := queue.get()) is not None:
        job.begin()
        job = None
    queue.put(None)  # for the next thread; an interrupted start may leave some more


class JobThreads:
    """Threads that do jobs in turn, started with the first. A queue takes half the time of an executor."""

    def __init__(self, name: str, count: int = 1):
        self._name, self._count, self._queue, self._is_started = name, count, SimpleQueue(), False
        self._starting = Lock()  # held while the threads start: several callers may have a first job

    def submit(self, job: Job) -> None:
        """Hand a job over. If that is interrupted, `Job.settle` still has the job done, once."""
        if not self._is_started:
            with self._starting, STEP_BACK:
                if not self._is_started:
                    for _ in range(self._count):
                        Thread(target=_serve, args=(self._queue,), name=self._name, daemon=True).start()
                    self._is_started = True
        self._queue.put(job)

    def close(self) -> None:
        """End the threads after the jobs that they have; a second call does nothing."""
        self._queue.put(None)

    def __del__(self):
        if hasattr(self, "_queue"):  # its construction was not interrupted
            self._queue.put(None)


class SecondThread:
    """A thread that runs the second half of work. Several callers may share it.

    Each job holds its own result, so an interrupted wait does not affect the next job.
    """

    def __init__(self):
        self._thread, self._is_closed = JobThreads("sonar_gl second half"), False
        self._abandoned: list[Job] = []  # halves of interrupted callers, which the thread may still run

    def run_halves(self, work: Callable[[int], object]) -> tuple:
        """Return (work(0), work(1)); the thread runs the second, or the caller does if the thread is busy.

        Raises Error after `close`. Exceptions of either half are raised again.
        """
        if self._is_closed:
            raise closed_error("SecondThread")
        self.settle()
        half = Job(lambda: work(1))
        try:
            self._thread.submit(half)
            first = work(0)
            return first, half.result()
        except BaseException:
            self._abandoned.append(half)  # first: a second interrupt must not lose a half that runs
            half.cancel()
            raise

    def settle(self) -> None:
        """Wait for halves that the thread still runs for callers that were interrupted: they write to arrays."""
        for half in list(self._abandoned):
            half.settle()
            with suppress(ValueError):  # another caller has removed it
                self._abandoned.remove(half)

    def close(self) -> None:
        """Stop the thread; a second call does nothing."""
        self._is_closed = True
        self._thread.close()


def run_halves(thread: SecondThread | None, work: Callable[[int], object]) -> tuple:
    """Return (work(0), work(1)), the second from the thread if there is one."""
    return (work(0), work(1)) if thread is None else thread.run_halves(work)


def run_rows(thread: SecondThread | None, work: Callable[[slice], object], count: int) -> None:
    """Have work(rows) done for so many rows: for half of them by the thread, if there is one.

    Each row must be a result of its own, so that bits do not depend on the thread.
    """
    if thread is None:
        work(slice(0, count))
        return
    middle = count // 2
    thread.run_halves(lambda half: work(slice(middle, count) if half else slice(0, middle)))
