"""The command line, for tests of batches in which something goes wrong: pings are slow, and some kill.

SLOW_S : seconds that each ping takes longer; DEADLY : times of pings whose process dies of them; STALL_S : of
`pool`. Processes that make parts load this file as they start, as they do with any program that begins a
batch.
"""

import os
import signal
import time

from sonar_gl.batch import pool
from sonar_gl.cli import main as cli
from sonar_gl.engine.run import Run

real = Run.set_up
slow_s = float(os.environ.get("SLOW_S", "0"))
deadly = [float(word) for word in os.environ.get("DEADLY", "").split()]


def set_up(run, request):
    if run.sampler.tolerance is None:  # the samples are planned
        if any(abs(request.time_s - at) < 1e-6 for at in deadly):
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(slow_s)
    return real(run, request)


Run.set_up = set_up

pool.STALL_S = float(os.environ.get("STALL_S", pool.STALL_S))

if __name__ == "__main__":
    cli.main()
