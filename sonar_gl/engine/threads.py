"""How many threads compute."""

from __future__ import annotations

import os

import numba

from sonar_gl.core.cores import count_cores

MAX_THREADS = 8  # beyond this Python's own share of a ping, about a tenth of a millisecond, is the limit


def n_threads() -> int:
    """Return how many threads compute: one for each core that this process may use, or NUMBA_NUM_THREADS."""
    count = numba.config.NUMBA_NUM_THREADS
    if count == numba.config.NUMBA_DEFAULT_NUM_THREADS:  # it knows of no share of time, as of containers
        count = count_cores()
    return min(count, MAX_THREADS)


def limit_threads(count: int) -> None:
    """Have this process compute with so many threads, unless the user says how many by NUMBA_NUM_THREADS."""
    if "NUMBA_NUM_THREADS" not in os.environ:
        numba.config.NUMBA_NUM_THREADS = count
