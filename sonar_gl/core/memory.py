"""Memory that the process would hold without need."""

from __future__ import annotations

import ctypes
import mmap
from contextlib import suppress

import numpy as np


def sparse_table(n_rows: int, n_columns: int) -> np.ndarray:
    """Return a table of float64 zeros, of which only what is written becomes resident memory, page by page.

    NumPy asks Linux for pages of 2 MB for arrays of 4 MB and more: one number a row would make all of it resident.
    """
    private = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
    try:
        memory = mmap.mmap(-1, 8 * n_rows * n_columns, **private)
    except OSError as why:
        raise MemoryError(f"no room for {8 * n_rows * n_columns} bytes: {why}") from None
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        with suppress(OSError):  # a kernel without such pages
            memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory).reshape(n_rows, n_columns)


def return_free_memory() -> None:
    """Give freed memory back to the operating system; takes milliseconds.

    By itself glibc keeps what lies below memory in use: after large arrays were freed, hundreds of megabytes.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library; TypeError: of Windows
        ctypes.CDLL(None).malloc_trim(0)
