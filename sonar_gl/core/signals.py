"""Signals that end commands, or interrupt a program."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

REPEAT_S = 0.3  # within it, signals are one: `timeout` sends its own to a command and to the group of it


def exit_interrupted(number: int, frame) -> None:
    """End the process as a command ends by Ctrl-C, at once: a handler for when nothing has begun yet."""
    with suppress(OSError):
        os.write(2, b"error: interrupted\n")
    os._exit(130)


def exit_at_interrupt() -> None:
    """Set `exit_interrupted` as the handler of Ctrl-C, unless the caller has another than Python's own."""
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, exit_interrupted)


@contextmanager
def delayed_interrupt() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block, for work that must not stop half way; a second one stops it at once.

    It has no effect where Ctrl-C does not raise KeyboardInterrupt by Python's own handler: in other threads, and under
    a handler of the program or of a command.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    is_interrupted = False

    def note(number, frame):
        nonlocal is_interrupted
        if is_interrupted:
            raise KeyboardInterrupt
        is_interrupted = True

    try:
        signal.signal(signal.SIGINT, note)
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if is_interrupted:
            raise KeyboardInterrupt
