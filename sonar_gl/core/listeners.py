"""Listeners: each has a thread of its own, and misses what comes while it is busy."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from threading import Condition, Thread, current_thread

from sonar_gl.core.closing import Closable
from sonar_gl.core.errors import Error

logger = logging.getLogger(__name__)


class Listener(Closable):
    """Calls a function with what it is told, in a thread of its own.

    While the function is busy, new items take the place of the ones that wait: a slow listener misses items, and holds
    up nobody. An exception of the function ends the listening.

    call : function of one item
    waiting : how many items may wait
    on_close : function of this listener, called once it is closed
    missed : number of items that others replaced
    failure : exception that ended the listening, or None
    """

    def __init__(self, call: Callable, name: str, waiting: int, on_close: Callable = lambda _: None):
        self.missed, self.failure = 0, None
        self._call, self._on_close = call, on_close
        self._items, self._changed, self._is_closed = deque(maxlen=waiting), Condition(), False
        self._thread = Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    @property
    def is_closed(self) -> bool:
        """Whether it takes no more items."""
        return self._is_closed

    def tell(self, item) -> None:
        """Hand over an item; never waits. After `close` nothing happens."""
        with self._changed:
            if self._is_closed:
                return
            self.missed += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._changed.notify()

    def close(self, timeout_s: float | None = 10.0, drops: bool = False) -> None:
        """Take no more items, and wait until those that were taken are done; a second call does nothing.

        drops : whether the items that wait are dropped
        """
        with self._changed:
            self._is_closed = True
            if drops:
                self._items.clear()
            self._changed.notify()
        if current_thread() is not self._thread:
            self._thread.join(timeout_s)

    def _serve(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._items or self._is_closed)
                    if not self._items:
                        return
                    item = self._items.popleft()
                self._call(item)
        except Exception as why:
            # whose fault an Error is it says by itself
            logger.warning(
                "a listener failed, and gets no more pings: %s", why, exc_info=not isinstance(why, Error)
            )
            self.failure = why
        finally:
            self._is_closed = True
            self._on_close(self)
