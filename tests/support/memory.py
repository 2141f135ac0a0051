"""Memory of this process (Linux)."""

import os


def resident_bytes() -> int:
    """Return the resident memory of this process, bytes."""
    with open("/proc/self/statm") as numbers:
        return int(numbers.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
