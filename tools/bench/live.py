"""Measure how even the pings of a live loop are, beside what is aimed at.

python -m tools.bench live                       # pylon, diver, ocean_floor; some minutes
python -m tools.bench live --only diver --tolerance 0.01

Loops of 10 Hz, in which the samples that keep the tolerance change: a sonar swims through each scene, past bodies and
close to some; drives straight ahead, into what is there and through it; turns away from all bodies and back; and a body
vanishes and comes back. Of each ping after the first hundred: its time over the median of the hundred with echo before
it, by the clock and by the time of the processors, which other programs disturb less. Pings without echo, which take a
fraction of the time of others whatever their samples, would lower that median. Each loop is made three times, with the
same samples, and of each ping the least time counts: other work only adds to it, and not to the same ping each time.
"verified" is the share of pings whose `error_estimate` is within the tolerance. Finer samples, and the finer meshes
that they draw, take memory that is new in each loop; the last line says how long the system needs to provide it.
"""

from __future__ import annotations

import math
import mmap
import time
import warnings

import numpy as np

import sonar_gl as sg
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.sonar.sampling import ToleranceWarning
from tools.bench import harness
from tools.bench.harness import Aim

ROUNDS, TURNS = (400, 120), 3  # pings; how often the same ones are made
FRESH_MB, PAGE = 16, 4096  # as much as the samples of a fine ping take; bytes
SCENES = "pylon", "diver", "ocean_floor"
PERIOD_S, BEFORE = 0.1, 100  # of the loop; pings whose median counts
LIMIT = 3.0


def path(home, number: int):
    """Return the sonar's pose in a ping: some metres to and fro at up to a metre and a half a second."""
    t = PERIOD_S * number
    x, y, z = 4 * math.sin(0.25 * t), 2 * math.sin(0.31 * t), 0.5 * math.sin(0.2 * t)
    return home @ sg.pose(x, y, z, 0.1 * math.sin(t), 0.1 * math.sin(0.37 * t), 0.6 * math.sin(0.17 * t))


def swims(scene, n: int):
    """Yield the pose and the bodies of each ping of a sonar that swims along `path`."""
    for number in range(n):
        yield path(scene.sonar_pose, number), None


def drives(scene, n: int):
    """Yield the same of one that drives straight ahead, a metre a second, through what is there."""
    for number in range(n):
        yield scene.sonar_pose @ sg.pose(0.1 * max(0, number - 60)), None


def turns(scene, n: int):
    """Yield the same of one that turns round, by 3 degrees a ping, stays, and turns back."""
    for number in range(n):
        turned = min(max(number - n // 3, 0), 60) - min(max(number - 2 * n // 3, 0), 60)
        yield scene.sonar_pose @ sg.pose(0.02 * math.sin(number / 5), yaw=math.radians(3 * turned)), None


def hides(scene, n: int):
    """Yield the same of one that creeps ahead, as the first body vanishes and comes back, each for three seconds."""
    gone = {scene.bodies[0].name: None}
    for number in range(n):
        yield scene.sonar_pose @ sg.pose(0.01 * number), gone if number % 60 >= 30 else None


LOOPS = {"swims": swims, "drives": drives, "turns": turns, "hides": hides}


def over_median(times, has_echo, n: int):
    """Return the time of each ping but the first `n` over the median of up to `n` with echo before it."""
    before = [times[:k][has_echo[:k]][-n:] for k in range(n, len(times))]
    return times[n:] / [np.median(one) for one in before]


def measure(name: str, loop: str, tolerance: float, n: int) -> np.ndarray:
    """Return seconds by the clock and of the processors, the estimate, the rows and the echo of each ping: (5, n)."""
    scene, sonar, found = sg.load_scene(name), sg.load_sonar("p900-45"), []
    with sg.Simulator(scene, sonar, tolerance=tolerance) as simulator:
        for pose, bodies in LOOPS[loop](scene, n):
            starts = time.perf_counter(), time.process_time()
            ping = simulator.ping(pose, bodies=bodies)
            took_s = time.perf_counter() - starts[0], time.process_time() - starts[1]
            found.append((*took_s, ping.error_estimate, ping.meta["sampling"]["rows"], ping.meta["has_echo"]))
    return np.array(found).T


def figures_of(name: str, loop: str, tolerance: float, n: int) -> dict[str, float]:
    """Return the figures of one loop in one scene."""
    turns_of = [measure(name, loop, tolerance, n) for _ in range(TURNS)]
    clock_s, busy_s, estimates, rows, has_echo = np.min(turns_of, axis=0)
    before = min(BEFORE, n // 2)
    clock, busy = (over_median(one, has_echo > 0, before) for one in (clock_s, busy_s))
    return {
        "median, ms": 1e3 * float(np.median(clock_s)),
        "worst, clock": float(clock.max()),
        "worst, busy": float(busy.max()),
        "above 3, busy": float((busy > LIMIT).mean()),
        "verified": float((estimates <= tolerance).mean()),
        "rows, fewest": int(rows.min()),
        "rows, most": int(rows.max()),
    }


def fresh_memory_ms() -> float:
    """Return how long the first use of a MB of memory takes, ms: the median of several times."""
    times_s = []
    for _ in range(9):
        with mmap.mmap(-1, FRESH_MB * 10**6) as memory:
            start = time.perf_counter()
            for byte in range(0, len(memory), PAGE):
                memory[byte] = 1
            times_s.append(time.perf_counter() - start)
            start = time.perf_counter()
            for byte in range(0, len(memory), PAGE):
                memory[byte] = 1
            times_s[-1] -= time.perf_counter() - start  # of the loop itself
    return 1e3 * float(np.median(times_s)) / FRESH_MB


def add_options(parser):
    """Add the scene and the tolerance."""
    parser.add_argument("--only", choices=SCENES, help="this scene")
    parser.add_argument("--tolerance", type=float, default=0.02)


def run(options) -> dict:
    """Return the figures of each scene."""
    warnings.simplefilter("ignore", ToleranceWarning)  # some poses are close to a body
    warnings.simplefilter("ignore", NoEchoWarning)  # others see none
    scenes = (options.only,) if options.only else SCENES[:1] if options.quick else SCENES
    found = {
        f"{name} {loop}": figures_of(name, loop, options.tolerance, options.rounds)
        for name in scenes
        for loop in LOOPS
    }
    aims = [Aim(f"{name}: worst ping, medians", one["worst, busy"], "", LIMIT) for name, one in found.items()]
    return {"scenes": found, "aims": aims, "fresh_memory_ms": fresh_memory_ms()}


def report(found: dict):
    """Print a row for each scene, and what fresh memory takes."""
    harness.print_scenes(found)
    print(f"  the first use of a MB of memory takes {found['fresh_memory_ms']:.2f} ms")
