"""Measure how even the pings of a live loop are, beside what is aimed at.

python -m tools.bench live                       # pylon, diver, ocean_floor; a minute
python -m tools.bench live --only diver --tolerance 0.01

A sonar swims through each scene in steps of a 10 Hz loop, past bodies and close to some, so that the samples that
keep the tolerance change. Of each ping after the first hundred: its time over the median of the hundred before it, by
the clock and by the time of the processors, which other programs disturb less. The sonar swims the same way three
times, with the same samples, and of each ping the least time counts: other work only adds to it, and not to the same
ping each time. "verified" is the share of pings whose `error_estimate` is within the tolerance.
"""

from __future__ import annotations

import math
import time
import warnings

import numpy as np

import sonar_gl as sg
from sonar_gl.sonar.sampling import ToleranceWarning
from tools.bench import harness
from tools.bench.harness import Aim

ROUNDS, TURNS = (400, 120), 3  # pings; how often the same ones are made
SCENES = "pylon", "diver", "ocean_floor"
PERIOD_S, BEFORE = 0.1, 100  # of the loop; pings whose median counts
LIMIT = 3.0


def path(home, number: int):
    """Return the sonar's pose in a ping: some metres to and fro at up to a metre and a half a second."""
    t = PERIOD_S * number
    x, y, z = 4 * math.sin(0.25 * t), 2 * math.sin(0.31 * t), 0.5 * math.sin(0.2 * t)
    return home @ sg.pose(x, y, z, 0.1 * math.sin(t), 0.1 * math.sin(0.37 * t), 0.6 * math.sin(0.17 * t))


def over_median(times, n: int):
    """Return the time of each ping but the first `n` over the median of the `n` before it."""
    windows = np.lib.stride_tricks.sliding_window_view(times, n)[:-1]
    return times[n:] / np.median(windows, axis=1)


def swim(name: str, tolerance: float, n: int) -> np.ndarray:
    """Return seconds by the clock and of the processors, the error estimate and the rows of each ping: (4, n)."""
    scene, sonar, found = sg.load_scene(name), sg.load_sonar("p900-45"), []
    with sg.Simulator(scene, sonar, tolerance=tolerance) as simulator:
        for number in range(n):
            starts = time.perf_counter(), time.process_time()
            ping = simulator.ping(path(scene.sonar_pose, number))
            took_s = time.perf_counter() - starts[0], time.process_time() - starts[1]
            found.append((*took_s, ping.error_estimate, ping.meta["sampling"]["rows"]))
    return np.array(found).T


def figures_of(name: str, tolerance: float, n: int) -> dict[str, float]:
    """Return the figures of one scene."""
    clock_s, busy_s, estimates, rows = np.min([swim(name, tolerance, n) for _ in range(TURNS)], axis=0)
    before = min(BEFORE, n // 2)
    clock, busy = (over_median(one, before) for one in (clock_s, busy_s))
    return {
        "median, ms": 1e3 * float(np.median(clock_s)),
        "worst, clock": float(clock.max()),
        "worst, busy": float(busy.max()),
        "above 3, busy": float((busy > LIMIT).mean()),
        "verified": float((estimates <= tolerance).mean()),
        "rows, fewest": int(rows.min()),
        "rows, most": int(rows.max()),
    }


def add_options(parser):
    """Add the scene and the tolerance."""
    parser.add_argument("--only", choices=SCENES, help="this scene")
    parser.add_argument("--tolerance", type=float, default=0.02)


def run(options) -> dict:
    """Return the figures of each scene."""
    warnings.simplefilter("ignore", ToleranceWarning)  # some poses are close to a body
    scenes = (options.only,) if options.only else SCENES[:1] if options.quick else SCENES
    found = {name: figures_of(name, options.tolerance, options.rounds) for name in scenes}
    aims = [Aim(f"{name}: worst ping, medians", one["worst, busy"], "", LIMIT) for name, one in found.items()]
    return {"scenes": found, "aims": aims}


def report(found: dict):
    """Print a row for each scene, and the aims."""
    harness.print_scenes(found)
