"""A command that runs until Ctrl-C, in this process, and what runs beside it."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

from sonar_gl.cli import main as cli


class Printed(io.StringIO):
    """What a command prints, and an event that is set once it says how it is stopped."""

    def __init__(self):
        super().__init__()
        self.runs = threading.Event()

    def write(self, text):
        written = super().write(text)
        if "Ctrl-C stops it" in self.getvalue():
            self.runs.set()
        return written


def run_beside(command, work, wait_s, by=signal.SIGINT):
    """Run a command here until a function has returned in another thread; it ends by a signal, that of Ctrl-C.

    Returns what the command printed, and what the function returned.
    """
    assert threading.current_thread() is threading.main_thread()  # which receives signals
    printed, lock, has_ended = Printed(), threading.Lock(), False

    def run_work():
        try:
            assert printed.runs.wait(wait_s)
            return None if has_ended else work()
        finally:
            with lock:
                if not has_ended:
                    os.kill(os.getpid(), by)

    with ThreadPoolExecutor(1) as beside:
        found = beside.submit(run_work)
        try:
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                status = cli.main(command, standalone_mode=False)
        finally:
            with lock:
                has_ended = True
            printed.runs.set()
        result = None if status else found.result()
    assert not status, printed.getvalue()  # an exit is returned, as is the lack of one
    return printed.getvalue(), result
