"""Messages of other programs on their way to a slower reader: the last ones are kept, older ones are dropped."""

from __future__ import annotations

import logging
from collections.abc import Callable

from sonar_gl.core.listeners import Listener

logger = logging.getLogger(__name__)

PATIENCE_S = 5.0  # with a function that receives a message while its inbox or transport is closed


class Inbox(Listener):
    """A listener of messages that outlives exceptions: they are logged once, and the next message is read all the same.

    Threads of a network library tell it messages; they must never wait for the reader, nor may messages pile up.

    receive : called with each message, of which `depth` may wait, 1 or more
    """

    def __init__(self, name: str, receive: Callable[[bytes], None], depth: int):
        self._name, self._receive, self._has_failed = name, receive, False
        super().__init__(self._read, f"inbox {name}", depth)

    def close(self) -> None:
        """Drop what waits, and wait until the reader has returned, unless it is the reader that closes.

        A reader that does not return, such as one that waits for room in a queue, is waited for PATIENCE_S seconds.
        """
        super().close(PATIENCE_S, drops=True)

    def _read(self, message: bytes) -> None:
        try:
            self._receive(message)
        except Exception:
            if not self._has_failed:
                logger.exception("messages on %s cannot be read; this is logged once", self._name)
            self._has_failed = True
