"""Waits for what another thread or program does."""

import time
from collections.abc import Callable

WAIT_S = 60.0  # a machine that tests run on may be slow


def wait_until(holds: Callable[[], bool], often_s: float = 0.005) -> None:
    """Wait until a condition holds; fails if it does not within a minute."""
    end = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < end, "it should have come true"
        time.sleep(often_s)
