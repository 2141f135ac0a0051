"""Actions that browsers ask for, done one by one in one thread."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue

from sonar_gl.core.errors import Error

logger = logging.getLogger(__name__)

PROBLEM_S = 12.0  # for which a browser shows why an action failed
REPEAT_S = 3.0  # within which the same is not said again


class Actions:
    """A queue of actions. viser calls back in many threads; what it calls only asks here.

    Parameters
    ----------
    on_done : called after each action, whether it failed or not
    """

    def __init__(self, on_done: Callable[[], None]):
        self._queue, self._on_done = SimpleQueue(), on_done
        self._told, self._told_s = "", 0.0

    def ask(self, client, action: Callable[[], None] | None) -> None:
        """Have an action done for a browser (a viser.ClientHandle, or None); an action None only wakes the thread."""
        self._queue.put((client, action))

    def connect(self, handle, action: Callable) -> None:
        """Have an action of a control's value done when somebody changes it in a browser."""

        @handle.on_update
        async def _(event):
            if event.client is not None:  # else the page has set it
                value = handle.value
                self.ask(event.client, lambda: action(value))

    def connect_button(self, handle, action: Callable) -> None:
        """Have an action of the browser (a viser.ClientHandle) done when a button is clicked there."""

        @handle.on_click
        async def _(event):
            if event.client is not None:
                self.ask(event.client, lambda: action(event.client))

    def do(self, timeout_s: float) -> None:
        """Do all actions that were asked for; wait for the first of them, at most so long."""
        try:
            item = self._queue.get(timeout=timeout_s)
            while True:
                self._do(*item)
                item = self._queue.get_nowait()
        except Empty:
            return

    def _do(self, client, action) -> None:
        if action is None:
            return
        try:
            action()
        except Error as why:
            self._complain(client, str(why))
        except Exception as why:
            text = f"{type(why).__name__}: {why}"
            if self._complain(client, text):
                logger.exception("an action of the page failed")
        finally:
            self._on_done()

    def _complain(self, client, text: str) -> bool:
        """Say in a browser why an action failed, and return True; not twice, as at each move of a pointer."""
        now_s = time.monotonic()
        if text == self._told and now_s - self._told_s < REPEAT_S:
            return False
        self._told, self._told_s = text, now_s
        tell(client, "That did not work", text, is_problem=True)
        return True


def tell(client, title: str, text: str, is_problem: bool = False) -> None:
    """Show a note in a browser; None for no browser."""
    if client is not None:
        client.add_notification(
            title, text, auto_close_seconds=PROBLEM_S, color="red" if is_problem else "teal"
        )
