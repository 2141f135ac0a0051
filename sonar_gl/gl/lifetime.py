"""The release of OpenGL objects: at once, or, if their context cannot be used now, by a later call.

OpenGL objects can be released only while their context is current, in a thread that may use it, and while
nobody draws. The garbage collector calls finalisers at any time and in any thread, and a program may close a
sonar while another context is current. So objects that cannot be released wait in one queue, which all modules share:

- `discard` only queues. It is for finalisers.
- `release` releases at once, or queues what is out of reach. It is for `close()`.
- `release_waiting` releases what has come into reach. Simulators and sensors call it before they draw.
"""

from __future__ import annotations

import os
from collections import deque
from contextlib import ExitStack
from typing import Protocol

import moderngl

from sonar_gl.core.worker import ThreadLock

# A context that has ended cannot always be told from one that is not current. Each group is tried again at
# every ping, so that beyond this number the oldest are given up.
MAX_UNREACHABLE = 1000

IN_USE = "objects must not wait for their own release"


class Releasable(Protocol):
    """OpenGL objects that are released together."""

    is_gone: bool  # whether their context is known to have ended, and the objects with it

    def is_in_reach(self) -> bool:
        """Return whether they can be released in this thread now."""

    def release(self) -> None:
        """Release them, which are in reach; of those that are gone, forget the names."""


class _ContextObjects:
    """A moderngl context and all objects in it that nobody holds."""

    def __init__(self, context: moderngl.Context):
        self._context = context

    @property
    def is_gone(self) -> bool:
        return self._context.extra.is_gone

    def is_in_reach(self) -> bool:
        return self._context.extra.is_in_reach()

    def release(self) -> None:
        if not self.is_gone:
            with self._context as context:
                context.fbo = None  # the framebuffer used last, which the context would keep alive
                context.gc()  # in a share group the objects would outlive the context
        self._context.release()


class ReleaseQueue:
    """OpenGL objects that wait to be released, in groups: the objects of one context that belong together."""

    def __init__(self):
        self._discarded: deque[tuple[Releasable, ...]] = deque()
        self._unreachable: deque[tuple[Releasable, ...]] = deque(maxlen=MAX_UNREACHABLE)
        self._releasing = ThreadLock(IN_USE)

    def discard(self, *objects: moderngl.Context | Releasable) -> None:
        """Have objects of one context released by a later `release_waiting`, in this order.

        Finalisers may call this: it neither draws nor takes a lock.
        """
        self._discarded.append(_group(objects))

    def release(self, *objects: moderngl.Context | Releasable) -> None:
        """Release objects of one context, in this order; all of them later, if one is out of reach.

        Not to be called inside a `with context` block, nor while a host draws a sector.
        """
        self._release(_group(objects))

    def release_waiting(self) -> None:
        """Release all waiting objects that are in reach.

        Not to be called inside a `with context` block. A framebuffer that a host draws into is out of reach. A signal
        handler that comes while its thread releases leaves all to that release, or to a later one.
        """
        with self._releasing.held_if_free() as is_held:
            if is_held:
                self._release_all()
        if is_held is False:  # another thread held it
            with self._releasing.held():
                self._release_all()

    def waiting(self) -> int:
        """Return how many groups wait, for tests: it must not rise without end."""
        return len(self._discarded) + len(self._unreachable)

    def forget(self) -> None:
        """Empty the queue in a forked process: the objects are the parent's."""
        self._releasing = ThreadLock(IN_USE)  # another thread of the parent may hold the old one
        self._discarded.clear()
        self._unreachable.clear()

    def _release_all(self) -> None:
        for queue in (self._unreachable, self._discarded):
            for _ in range(len(queue)):
                group = queue.popleft()
                try:
                    self._release(group)
                except KeyboardInterrupt:
                    self._discarded.append(group)
                    raise

    def _release(self, group: tuple[Releasable, ...]) -> None:
        # Whether a context is gone shows when it is tried.
        if all(one.is_in_reach() or one.is_gone for one in group):
            with ExitStack() as stack:  # the others are released, too, if one raises an error
                for one in reversed(group):
                    stack.callback(one.release)
        else:
            self._unreachable.append(group)


def _group(objects) -> tuple[Releasable, ...]:
    return tuple(_ContextObjects(one) if isinstance(one, moderngl.Context) else one for one in objects)


_queue = ReleaseQueue()
discard, release, release_waiting, waiting = (
    _queue.discard,
    _queue.release,
    _queue.release_waiting,
    _queue.waiting,
)
if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_queue.forget)
