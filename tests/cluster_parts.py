"""Functions of a part that the workers of tests/test_cluster.py import."""

import os
import resource
import signal
import time


def count(folder, part):
    """Leave a mark of every try; part 5 takes its time."""
    with open(f"{folder}/{part}", "a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(0.5 if part == 5 else 0.01)
    return {"part": part, "worker": os.getpid()}


def deadly(folder, part):
    """Likewise, but part 3 kills every worker that tries it."""
    found = count(folder, part)
    if part == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return found


def failing(part):
    raise OSError(28, f"no space left for part {part}")


def pages(part):
    """How many pages the kernel gives for arrays that come and go."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(50):
        bytearray(1 << 20)
    return {"part": part, "pages": resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before}
