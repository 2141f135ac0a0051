"""The thread of a live session: it pings at a rate while somebody listens, and does jobs between two pings."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from threading import Condition, Event, RLock, Thread, current_thread

from sonar_gl.core.errors import closed_error
from sonar_gl.core.listeners import Listener
from sonar_gl.core.worker import Job

RETRY_S = 0.5  # after a ping that failed


def following_s(due_s: float, now_s: float, period_s: float) -> float:
    """Return when the ping after one is due that was due at a time, and begins now.

    A ping that is late is not made up for, but for what a timer is late by.

    >>> following_s(10.0, 10.25, 0.5), following_s(10.0, 12.0, 0.5)
    (10.5, 12.5)
    """
    return (now_s if now_s - due_s > period_s else due_s) + period_s


class PingThread:
    """Calls a function that pings, again and again while somebody listens, and does jobs of other threads in between.

    All methods may be called from any thread. The errors of a closed one are those of its LiveSession.

    lock : RLock of the session, released while the thread waits, pings and does jobs
    ping : makes a ping; returns whether the next may follow at the rate, else it follows after RETRY_S
    max_rate_hz : returns the pings per second at most
    release : called in the thread at its end
    """

    def __init__(
        self,
        lock: RLock,
        ping: Callable[[], bool],
        max_rate_hz: Callable[[], float],
        release: Callable[[], None],
    ):
        self._ping, self._max_rate_hz, self._release = ping, max_rate_hz, release
        self._changed = Condition(lock)  # guards all that follows
        self._listeners: list[Listener] = []
        self._requests: deque[Job] = deque()
        self._is_closing = False
        self._has_ended = Event()
        self._thread = Thread(target=self._serve, name="sonar_gl live", daemon=True)
        self._thread.start()

    @property
    def listeners(self) -> list[Listener]:
        with self._changed:
            return list(self._listeners)

    def listen(self, call: Callable, waiting: int) -> Listener:
        """Return a new listener, for which the thread pings until it is closed."""
        with self._changed:
            self.check_open()
            listener = Listener(call, "sonar_gl listener", waiting, self._forget)
            self._listeners.append(listener)
            self._changed.notify_all()
            return listener

    def do(self, work: Callable):
        """Have the thread do something between two pings; return its answer, or raise its exception."""
        if current_thread() is self._thread:
            return work()
        job = Job(work)
        with self._changed:
            self.check_open()
            self._requests.append(job)
            self._changed.notify_all()
            while not job.is_over and self._thread.is_alive():
                self._changed.wait(0.5)
        if not job.is_over:
            raise closed_error("LiveSession")
        return job.result()

    def check_open(self) -> None:
        """Raise Error if it is closed, or about to end."""
        if self._is_closing:
            raise closed_error("LiveSession")

    def close(self) -> None:
        """End the thread after its ping or job, and wait for it unless it is the caller; may be called again."""
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if current_thread() is not self._thread:
            self._thread.join()

    def wait_closed(self, timeout_s: float | None) -> bool:
        """Wait until the thread has ended, or so many seconds; return whether it has."""
        # not by `join`: where Ctrl-C interrupts that, Python before 3.13 takes the thread for one that has ended, and
        # `close` would not wait for it
        return self._has_ended.wait(timeout_s)

    def _forget(self, listener: Listener) -> None:
        with self._changed:
            if listener in self._listeners:
                self._listeners.remove(listener)

    def _serve(self) -> None:
        due_s = 0.0
        try:
            while True:
                with self._changed:
                    while not (self._is_closing or self._requests):
                        wait_s = due_s - time.monotonic() if self._listeners else None
                        if wait_s is not None and wait_s <= 0:
                            break
                        self._changed.wait(wait_s)
                    if self._is_closing:
                        return
                    request = self._requests.popleft() if self._requests else None
                if request is None:
                    due_s = following_s(due_s, time.monotonic(), 1 / self._max_rate_hz())
                    if not self._ping():
                        due_s = time.monotonic() + RETRY_S
                    continue
                request.begin()
                with self._changed:
                    self._changed.notify_all()
        finally:
            self._release()
            with self._changed:
                self._is_closing = True
                self._changed.notify_all()
            self._has_ended.set()
