"""Messages to the page that are none of a browser's: a sentence for the first of each kind, in place of tracebacks."""

from __future__ import annotations

import logging
from asyncio import AbstractEventLoop
from collections import Counter
from collections.abc import Iterator
from threading import Lock
from types import TracebackType

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import escape_controls

logger = logging.getLogger(__name__)

OWN = "sonar_gl."  # modules whose failures are faults of this program
FAILED, NO_REQUEST = "connection handler failed", "opening handshake failed"  # texts of websockets
SERVER_LOGGER = "websockets.server"


class WrongMessages:
    """Counts messages that viser cannot read, and logs the first of each kind.

    viser reads them in tasks of its event loop and in handlers of connections, and catches nothing: asyncio and
    websockets print tracebacks then. What fails in this program's own code keeps its traceback.

    Attributes
    ----------
    server_logger : for the servers of the page, in place of that of websockets, to which it passes on
    total : number of messages that were ignored
    """

    def __init__(self):
        self._counts, self._lock = Counter(), Lock()
        # one for each page, since servers of others keep theirs as it is
        self.server_logger = logging.Logger(SERVER_LOGGER)
        self.server_logger.parent = logging.getLogger(SERVER_LOGGER)
        self.server_logger.addFilter(self._is_shown)

    @property
    def total(self) -> int:
        """Number of messages that were ignored."""
        with self._lock:
            return sum(self._counts.values())

    def watch(self, loop: AbstractEventLoop) -> None:
        """Have an event loop report here what fails in its tasks."""
        loop.set_exception_handler(self._handle)

    def close(self) -> None:
        """Log how many there were, if more than were told one by one."""
        with self._lock:
            total, n_kinds = sum(self._counts.values()), len(self._counts)
        if total > n_kinds:
            logger.warning("%d messages to the page were ignored, as no browser sends such", total)

    def _handle(self, loop: AbstractEventLoop, context: dict) -> None:
        """Take what failed in a task; the signature is asyncio's."""
        why = context.get("exception")
        if not isinstance(why, Exception) or _is_own(why):
            loop.default_exception_handler(context)
        else:
            self._add(why)

    def _is_shown(self, record: logging.LogRecord) -> bool:
        """Return whether a record of websockets is logged as it is."""
        text, why = record.getMessage(), record.exc_info[1] if record.exc_info else None
        # as of browsers that connect beforehand; viser leaves these out, too, after its first page
        if text == NO_REQUEST:
            return False
        if text != FAILED or not isinstance(why, Exception) or _is_own(why):
            return True
        self._add(why)
        return False

    def _add(self, why: Exception) -> None:
        kind = type(why).__name__
        with self._lock:
            self._counts[kind] += 1
            is_first = self._counts[kind] == 1
        if is_first:
            logger.warning(
                "a message to the page is ignored, as no browser sends such (%s; others like it are only counted)",
                escape_controls(f"{kind}: {shown(str(why))}" if str(why) else kind),
            )


def _is_own(why: Exception) -> bool:
    """Return whether an exception came through this program's code."""
    return any(name.startswith(OWN) for name in _modules(why.__traceback__))


def _modules(traceback: TracebackType | None) -> Iterator[str]:
    """Yield the modules of the frames of a traceback."""
    while traceback is not None:
        yield traceback.tb_frame.f_globals.get("__name__", "")
        traceback = traceback.tb_next
