"""A process that makes parts, as its pool tells it; it lives no longer than the pool."""

from __future__ import annotations

import os
import signal
import threading
import traceback
from multiprocessing import parent_process

from sonar_gl.commands import load_numba
from sonar_gl.types import Error


def _die_with_parent():
    """Nobody takes what is made after the pool is gone, and the next one may be at the same part."""
    parent = parent_process()

    def wait():
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def serve(pipe, job: dict, url: str, device: int | None) -> None:
    """Do what comes through a pipe until there is None or it ends.

    In: the name of a method of `Work`, and what it takes. Out: what `Maker.make` tells, and at the end
    ("done", result), or ("refused", sentence) for a user's mistake, full disks, and all else.
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # the pool says when to end; queues tell all processes
        signal.signal(number, signal.SIG_IGN)
    _die_with_parent()
    made = None

    def tell(word, value):
        pipe.send((word, value))

    while (command := _next(pipe)) is not None:
        try:
            if made is None:
                load_numba()
                from sonar_gl.batch.work import Work

                made = Work(job, url, device)
            result = "done", getattr(made, command[0])(*command[1:], tell=tell)
        except Error as why:
            result = "refused", str(why)
        except OSError as why:
            result = "refused", f"{why.filename or url}: {why.strerror or why}; go on with --resume"
        except BaseException:
            result = "refused", f"a part could not be made:\n{traceback.format_exc()}"
        try:
            pipe.send(result)
        except OSError:  # the pool is gone
            return


def _next(pipe):
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return None
