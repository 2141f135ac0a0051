"""Actions that browsers ask for, done one by one in one thread."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Hashable
from threading import Condition

from sonar_gl.core.errors import Error

logger = logging.getLogger(__name__)

PROBLEM_S = 12.0  # for which a browser shows why an action failed
REPEAT_S = 3.0  # within which the same is not said again


class Actions:
    """A queue of actions. viser calls back in many threads; what it calls only asks here.

    on_done : called after each batch of actions, whether they failed or not
    """

    def __init__(self, on_done: Callable[[], None]):
        self._on_done = on_done
        self._changed = Condition()  # guards the two that follow
        self._waiting: dict[Hashable, tuple] = {}
        self._is_woken = False
        self._told, self._told_s = "", 0.0

    def ask(self, client, action: Callable[[], None] | None, key: Hashable = None) -> None:
        """Have an action done for a browser (a viser.ClientHandle, or None); an action None only wakes the thread.

        Of the actions of one key that wait, as of a slider that is dragged, the newest alone is done; None is no key.
        The key of a control is its `id`, since viser's handles have no hash.
        """
        with self._changed:
            if action is None:
                self._is_woken = True
            else:
                key = object() if key is None else key
                self._waiting.pop(key, None)  # the newest goes to the end
                self._waiting[key] = client, action
            self._changed.notify()

    def waits(self, key: Hashable) -> bool:
        """Return whether an action of a key waits: what a control shows is then newer than what the session has."""
        with self._changed:
            return key in self._waiting

    def show(self, handle, value) -> None:
        """Have a control show a value, unless a newer one waits."""
        if handle.value != value and not self.waits(id(handle)):
            handle.value = value

    def connect(self, handle, action: Callable) -> None:
        """Have an action of a control's value done when somebody changes it in a browser."""
        self.connect_from(handle, lambda _client, value: action(value))

    def connect_from(self, handle, action: Callable) -> None:
        """As `connect`, but for an action of the browser (a viser.ClientHandle) and the value."""

        @handle.on_update
        async def _(event):
            if event.client is not None:  # else the page has set it
                value = handle.value
                self.ask(event.client, lambda: action(event.client, value), id(handle))

    def connect_button(self, handle, action: Callable) -> None:
        """Have an action of the browser (a viser.ClientHandle) done when a button is clicked there."""

        @handle.on_click
        async def _(event):
            if event.client is not None:
                self.ask(event.client, lambda: action(event.client))

    def do(self, timeout_s: float) -> None:
        """Do the actions that wait now; wait for the first of them, at most so long."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_woken, timeout_s)
            batch, self._waiting, self._is_woken = self._waiting, {}, False
        for client, action in batch.values():
            self._do(client, action)
        if batch:
            self._on_done()

    def _do(self, client, action) -> None:
        try:
            action()
        except Error as why:
            self._report_failure(client, str(why))
        except Exception as why:
            text = f"{type(why).__name__}: {why}"
            if self._report_failure(client, text):
                logger.exception("an action of the page failed")

    def _report_failure(self, client, text: str) -> bool:
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
