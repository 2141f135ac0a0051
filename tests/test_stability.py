"""Many pings: no growth of memory or of GL objects, and the same bytes wherever they are made."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import oddities
import pytest
import soak

import sonar_gl as sg

pytestmark = pytest.mark.filterwarnings("ignore:no echo came back")  # what is measured

PINGS, WARM_UP = 800, 200
PROGRAM = """
import hashlib, sys
sys.path.insert(0, sys.argv[1])
import numpy as np, sonar_gl as sg
from soak import make_simulator, pose_of
with make_simulator() as simulator:
    for k in range(3):
        ping = simulator.ping(pose_of(k), sg.Noise.physical(), seed=5, labels=True)
        print(*(hashlib.sha256(a.tobytes()).hexdigest() for a in (ping.intensity, ping.body_id)))
"""


def test_pings_without_end():
    """Of changing poses, with labels and noise every so often."""
    with soak.make_simulator() as simulator:
        soak.run(simulator, WARM_UP)
        objects, resident, used = soak.gl_objects(simulator), soak.resident_bytes(), soak.in_use()
        soak.run(simulator, PINGS)
        soak.check_growth(used, resident, PINGS)
        assert soak.gl_objects(simulator) == objects


def test_simulators_without_end():
    """Made and closed: 40 of them, some 2 MB of GL buffers each."""
    for _ in range(10):
        soak.make_simulator().close()
    before = soak.resident_bytes()
    for _ in range(40):
        with soak.make_simulator() as simulator:
            simulator.ping(soak.pose_of(1))
    assert soak.resident_bytes() - before < 40e6


def test_the_same_seed_gives_the_same_bytes_in_another_process():
    naive, ours = oddities.order_of_sums()
    assert naive > 0.5  # float32 sums in another order
    assert ours == 0
    here = []
    with soak.make_simulator() as simulator:
        for k in range(3):
            ping = simulator.ping(soak.pose_of(k), sg.Noise.physical(), seed=5, labels=True)
            here.append([hashlib.sha256(a.tobytes()).hexdigest() for a in (ping.intensity, ping.body_id)])
    for threads in ("1", "2"):
        environment = os.environ | {
            "PYTHONHASHSEED": threads,
            "NUMBA_NUM_THREADS": threads,
            "LP_NUM_THREADS": threads,
        }
        run = subprocess.run(
            [sys.executable, "-c", PROGRAM, os.path.dirname(soak.__file__)],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        assert [line.split() for line in run.stdout.splitlines()] == here
    assert len(np.unique(np.array(here))) == 6
