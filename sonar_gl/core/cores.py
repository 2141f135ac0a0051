"""How many cores of the machine this process may use, and how many threads compute on them."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

import numba

MAX_THREADS = 8  # beyond this Python's own share of a ping, about a tenth of a millisecond, is the limit
OWN_GROUPS, GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def count_cores() -> int:
    """Return how many cores this process may use: those that it may run on, no more than its share of time fills.

    Containers have all cores of their machine, and a share of time that Python does not know, as Docker and Kubernetes
    limit it.
    """
    has_affinity = hasattr(os, "sched_getaffinity")
    n_cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    return max(1, math.ceil(min(n_cores, _cores_by_time())))


def _cores_by_time() -> float:
    """Return how many cores the share of time of this process's control groups fills; infinite without a limit.

    A group is limited by those that hold it, too. Source: the Linux kernel's "Control Group v2", cpu.max, and "CFS
    Bandwidth Control" for version 1.
    """
    least = math.inf
    for line in _text(OWN_GROUPS).splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers:  # version 2
            top, files = GROUPS, ("cpu.max",)
        elif "cpu" in controllers.split(","):
            top, files = GROUPS / "cpu", ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        else:
            continue
        own = top / path.lstrip("/")
        # in a container the path may be that of the host, and the container's own group is the top one
        inside = [] if ".." in own.parts else [group for group in (own, *own.parents) if top in group.parents]
        for group in (*inside, top):
            least = min(least, _share_of_time(" ".join(_text(group / file) for file in files)))
    return least


def _share_of_time(limit: str) -> float:
    """Return processor time over real time of "quota period", microseconds; infinite where there is no limit."""
    with suppress(ValueError):  # "max 100000", or a file that does not exist
        quota_us, period_us = map(int, limit.split())
        if quota_us > 0 and period_us > 0:
            return quota_us / period_us
    return math.inf


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeError):
        return ""


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
