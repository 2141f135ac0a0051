"""Waits for what another thread or program does."""

import time
from collections.abc import Callable
from typing import TypeVar

WAIT_S = 60.0  # a machine that tests run on may be slow
T = TypeVar("T")


def wait_until(holds: Callable[[], T], often_s: float = 0.005) -> T:
    """Wait until a condition holds, and return what it returned; fails if it does not within a minute."""
    end = time.monotonic() + WAIT_S
    while not (found := holds()):
        assert time.monotonic() < end, "it should have come true"
        time.sleep(often_s)
    return found
