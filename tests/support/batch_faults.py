"""The command line, for tests of batches in which something goes wrong: pings are slow, and some kill.

SLOW_S : seconds that each ping takes longer; DEADLY : times of pings whose process dies of them; DEADLY_BEGINS :
file with the number of processes that shall die as they begin a batch; SIGNAL : by which they die, SIGKILL by default;
MEMORY_MB : memory that processes may take beyond what they have, from their first ping on; STALL_S : of `pool`.
Processes that make parts load this file as they start, as they do with any program that begins a batch.
"""

import os
import resource
import signal
import time
from pathlib import Path

from sonar_gl.batch import pool, steps
from sonar_gl.batch.parts import no_report
from sonar_gl.cli import main as cli
from sonar_gl.engine.run import Run

real = Run.resolve
end_signal = getattr(signal, os.environ.get("SIGNAL", "SIGKILL"))
deadly_begins = os.environ.get("DEADLY_BEGINS")
memory_mb = os.environ.get("MEMORY_MB")
slow_s = float(os.environ.get("SLOW_S", "0"))
deadly = [float(word) for word in os.environ.get("DEADLY", "").split()]


def die():
    """End this process at once."""
    os.kill(os.getpid(), end_signal)


def limit_memory():
    """Give this process no more than MEMORY_MB beyond what it has."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limit = size + int(float(memory_mb) * 1e6)
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))


def resolve(run, request):
    if memory_mb:
        limit_memory()
    if any(abs(request.time_s - at) < 1e-6 for at in deadly):
        die()
    time.sleep(slow_s)
    return real(run, request)


def begin(batch, report=no_report):
    if deadly_begins:
        left = int(Path(deadly_begins).read_text())
        Path(deadly_begins).write_text(str(left - 1))
        if left > 0:
            die()
    return steps.begin(batch, report)


Run.resolve = resolve
steps.STEPS["begin"] = begin

pool.STALL_S = float(os.environ.get("STALL_S", pool.STALL_S))

if __name__ == "__main__":
    cli.main()
