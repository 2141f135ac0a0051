"""Functions of a part, imported by the workers of tests/batch/test_cluster.py."""

import os
import resource
import signal
import time
from contextlib import suppress

from sonar_gl.batch import cluster


def count(folder, part):
    """Write down every try; part 5 is slow."""
    with open(f"{folder}/{part}", "a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(0.5 if part == 5 else 0.01)
    return {"part": part, "worker": os.getpid()}


def wait_to_be_killed(folder, part):
    """Write down every try; the first of part 5 lasts until its worker is killed."""
    found = count(folder, part)
    with open(f"{folder}/{part}") as file:
        if part == 5 and len(file.readlines()) == 1:
            time.sleep(30.0)
    return found


def deadly(folder, part):
    """Write down every try; part 3 kills its worker."""
    found = count(folder, part)
    if part == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return found


def die_at_parts(begun, made):
    """Have this worker kill itself as it begins a part of a batch, or has made one, unless another worker has.

    Parameters
    ----------
    begun, made : number of the part, and the file that the worker leaves
    """
    make = cluster.make_part

    def die_once(part, at, file):
        if part == at:
            with suppress(FileExistsError), open(file, "x"):
                os.kill(os.getpid(), signal.SIGKILL)

    def make_part(batch, part):
        die_once(part, *begun)
        record = make(batch, part)
        die_once(part, *made)
        return record

    cluster.make_part = make_part


def raising(error, at, part):
    """Raise an error for one part."""
    if part == at:
        raise error
    return {"part": part}


def failing(part):
    raise OSError(28, f"no space left for part {part}")


def pages(part):
    """Return how many pages the kernel gives for arrays that are made and freed."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(50):
        bytearray(1 << 20)
    return {"part": part, "pages": resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before}
