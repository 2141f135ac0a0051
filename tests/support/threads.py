"""Functions called in another thread."""

import threading
from contextlib import contextmanager

import sonar_gl as sg
from sonar_gl.core.worker import SecondThread


def in_another_thread(function) -> list[str]:
    """Call a function in another thread. Return the text of the Error that it raises, or [].

    Any other exception is raised again in this thread.
    """
    messages, others = [], []

    def work():
        try:
            function()
        except sg.Error as why:
            messages.append(str(why))
        except BaseException as why:
            others.append(why)

    thread = threading.Thread(target=work, name="other")
    thread.start()
    thread.join()
    for why in others:
        raise why
    return messages


class CountingThread(SecondThread):
    """A second thread that counts the jobs whose halves it was to run."""

    def __init__(self):
        super().__init__()
        self.n_jobs = 0

    def run_halves(self, work):
        """Count the job, and run its halves."""
        self.n_jobs += 1
        return super().run_halves(work)


@contextmanager
def counting_thread():
    """Yield a `CountingThread`; close it at the end of the block."""
    thread = CountingThread()
    try:
        yield thread
    finally:
        thread.close()
