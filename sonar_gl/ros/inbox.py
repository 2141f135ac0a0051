"""Messages of other programs on their way to a slower reader: the last ones are kept, older ones are dropped."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

logger = logging.getLogger(__name__)

PATIENCE_S = 5.0  # with a function that receives a message while its inbox or transport is closed


class Inbox:
    """Calls a function with each message, in a thread of its own; what comes too quickly is dropped, oldest first.

    Threads of a network library put messages in; they must never wait for the reader, nor may messages pile up.
    An exception of the reader is logged once, and the next message is read all the same.

    Parameters
    ----------
    name : of the topic, for the log
    receive : called with each message
    depth : number of messages that may wait, 1 or more
    """

    def __init__(self, name: str, receive: Callable[[bytes], None], depth: int):
        self.dropped = 0  # messages
        self._name, self._receive = name, receive
        self._waiting, self._changed = deque(maxlen=depth), threading.Condition()
        self._is_open, self._has_failed = True, False
        self._thread = threading.Thread(target=self._run, name=f"inbox {name}", daemon=True)
        self._thread.start()

    def put(self, message: bytes) -> None:
        """Add a message; returns at once. After `close` nothing happens."""
        with self._changed:
            self.dropped += len(self._waiting) == self._waiting.maxlen
            self._waiting.append(message)
            self._changed.notify()

    def close(self) -> None:
        """Drop what waits, and wait until the reader has returned, unless it is the reader that closes.

        A reader that does not return, such as one that waits for room in a queue, is waited for PATIENCE_S seconds.
        """
        with self._changed:
            self._is_open = False
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(PATIENCE_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or not self._is_open)
                if not self._is_open:
                    return
                message = self._waiting.popleft()
            try:
                self._receive(message)
            except Exception:
                if not self._has_failed:
                    logger.exception("messages on %s cannot be read; this is logged once", self._name)
                self._has_failed = True
