"""Pauses of Python's cyclic garbage collector, while code runs that finalisers of other programs must not interrupt."""

from __future__ import annotations

import gc
import os
from threading import RLock


class _Collector:
    """Counts the pauses of all threads; the first turns the collector off, the last turns it on if it was on."""

    def __init__(self):
        self.reset()

    def reset(self) -> None:
        """Forget all pauses: in a forked process no thread is left that would end them."""
        # A finaliser may end a pause while this thread holds the lock.
        self._lock, self._pauses, self._was_on = RLock(), set(), False

    def pause(self, number: int) -> None:
        with self._lock:
            self._pauses.add(number)
            if gc.isenabled():
                self._was_on = True
                gc.disable()

    def resume(self, number: int) -> None:
        with self._lock:
            self._pauses.discard(number)
            if self._was_on and not self._pauses:
                self._was_on = False
                gc.enable()

    def forget(self) -> None:
        """End all pauses, in a forked process."""
        was_on = self._was_on
        self.reset()
        if was_on:
            gc.enable()


class EndedPause:
    """A pause that has ended. It has no finaliser: Python drops an interrupt that comes in one."""

    def end(self) -> None:
        """Do nothing."""


class CollectorPause(EndedPause):
    """A pause of the garbage collector, from its construction to `end`. Several may overlap, in any thread.

    The collector runs finalisers in whichever thread allocates memory. A finaliser of another program may make
    another OpenGL context current, or delete OpenGL objects by names that are ours in the context that is current.
    Objects without reference cycles are finalised by the thread that drops them, and what is current in that thread
    does not concern this one.
    """

    def __init__(self):
        _collector.pause(id(self))

    def end(self) -> None:
        """End the pause; a second call does nothing."""
        _collector.resume(id(self))
        self.__class__ = EndedPause

    def __del__(self):
        """End a pause that an interrupt has cut off from its `end`."""
        _collector.resume(id(self))


_collector = _Collector()
if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_collector.forget)
