"""Work in two halves, one of them in another thread."""

from __future__ import annotations

from queue import SimpleQueue
from threading import Thread


def _serve(todo: SimpleQueue, done: SimpleQueue):
    """Do the second halves of work, until there is None."""
    while (work := todo.get()) is not None:
        try:
            done.put((work(1), None))
        except BaseException as why:
            done.put((None, why))
        work = None  # it holds its owner, which must be free to go


class Pair:
    """A thread beside the caller's. Two queues hand over in half the time that an executor takes."""

    def __init__(self):
        self._todo, self._done = SimpleQueue(), SimpleQueue()
        Thread(target=_serve, args=(self._todo, self._done), daemon=True).start()

    def run(self, work) -> tuple:
        """What work(0), done here, and work(1), done there, return."""
        self._todo.put(work)
        try:
            mine = work(0)
        finally:
            other, failure = self._done.get()
        if failure is not None:
            raise failure
        return mine, other

    def close(self):
        """End the thread; twice does no harm."""
        self._todo.put(None)

    def __del__(self):
        self.close()
