"""What a forked process does with an object of its parent."""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable

import sonar_gl as sg

LONGEST_S = 30  # then the forked process hangs


def in_fork(*calls: Callable[[], object]) -> list[str]:
    """Return for each call in a forked process "done", or the Error that it has raised; fewer if the process hangs."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        # since Python 3.12 a fork of a process with threads warns
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LONGEST_S)
        try:
            for call in calls:
                try:
                    call()
                    reply = "done"
                except sg.Error as why:
                    reply = str(why)
                os.write(writing, f"{reply}\n".encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        replies = pipe.read().splitlines()
    os.waitpid(child, 0)
    return replies
