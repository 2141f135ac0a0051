"""Memory that the process holds without need."""

from __future__ import annotations

import ctypes
from functools import cache


@cache
def _malloc_trim():
    """Return glibc's malloc_trim, or None where there is another C library."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None


def return_free_memory() -> None:
    """Give freed memory back to the operating system; takes milliseconds.

    By itself glibc keeps what lies below memory in use: after large arrays were freed, hundreds of megabytes.
    """
    trim = _malloc_trim()
    if trim is not None:
        trim(0)
