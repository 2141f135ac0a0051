"""Measure two sonars, and bodies that come, go and move, beside what is aimed at.

python -m tools.bench changes
python -m tools.bench changes --quick
"""

from __future__ import annotations

from collections import defaultdict
from contextlib import ExitStack

import numpy as np
import trimesh

import sonar_gl as sg
from tools.bench import harness
from tools.bench.harness import Aim
from tools.chart.scenes import make_scene, make_sonar

ROUNDS = 40, 2
IDEAL = sg.Acoustics.ideal()
SCENE, PINGS = "ocean_floor", 24
QUICK_SCENE, QUICK_PINGS = "pylon", 8
MOST_CHANGES = 20  # each adds bodies


def two_sonars(name: str, n: int, rounds: int) -> float:
    """Return the time of two sonars, one level and one upright, in one world over that of two runs.

    Each begins with the scene loaded and makes n pings a sonar.
    """
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    turns = np.eye(4), sg.pose(roll=np.pi / 2)

    def ping_all(simulators):
        for simulator, turn in simulators:
            simulator.plan([scene.sonar_pose @ turn])
        for k in range(n):
            for simulator, turn in simulators:
                simulator.ping(harness.creep(scene.sonar_pose, k) @ turn)

    def two_runs(_number):
        for turn in turns:
            with sg.Simulator(scene, sonar, IDEAL) as simulator:
                ping_all([(simulator, turn)])

    def one_world(_number):
        with sg.Simulator(scene, sonar, IDEAL) as first, sg.Simulator(first, sonar, IDEAL) as second:
            ping_all(list(zip((first, second), turns, strict=True)))

    times = harness.take_turns({"runs": two_runs, "world": one_world}, rounds, warm_up=1)
    return harness.ratio(times["world"], times["runs"])


def body_changes(name: str, changes: int) -> dict[str, float]:
    """Return medians in ms of changes of a scene's bodies, and of the pings after them."""
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    here, ball = scene.sonar_pose, trimesh.creation.icosphere(3, 0.3)
    times = defaultdict(list)

    with ExitStack() as stack:
        simulator = stack.enter_context(sg.Simulator(scene, sonar, IDEAL))
        simulator.plan([here])
        simulator.add(sg.Body("known", ball, here @ sg.pose(9)))
        for k in range(-1, changes):
            if k == 0:  # the first change is the warm-up
                times.clear()
            before, after = here @ sg.pose(8, 0.1 * k), here @ sg.pose(9, 0.1 * k)
            for what, function, *arguments in (
                ("add a body", simulator.add, sg.Body(f"new {k}", ball.copy(), before)),
                ("first ping after that", simulator.ping, here),
                ("add another of its mesh", simulator.add, sg.Body(f"again {k}", ball, before)),
                ("first ping after this", simulator.ping, here),
                ("ping", simulator.ping, here),  # with the same bodies
                ("move a body", simulator.place, {f"new {k}": after}),
                ("first ping after moving", simulator.ping, here),
                (
                    "ping with a body elsewhere",
                    lambda pose: simulator.ping(here, bodies={"known": pose}),
                    after,
                ),
                ("hide a body", simulator.place, {f"new {k}": None}),
            ):
                times[what].append(harness.timed(function, *arguments)[0])
            simulator.place({f"again {k}": None})
    return {what: float(np.median(ms)) for what, ms in times.items()}


def add_options(parser):
    """Add no options."""


def run(options) -> dict:
    """Return the figures beside their aims."""
    scene, n = (QUICK_SCENE, QUICK_PINGS) if options.quick else (SCENE, PINGS)
    time = two_sonars(scene, n, max(1, options.rounds // 10))
    aims = [Aim("two sonars in one world / in two runs", time, "times", 1.0)]
    ms = body_changes(scene, min(options.rounds, MOST_CHANGES))
    for change, after, limit in (
        ("add a body", "first ping after that", 10.0),
        ("add another of its mesh", "first ping after this", 10.0),
        ("move a body", "first ping after moving", 1.0),
    ):
        aims.append(Aim(change, ms[change], "ms", limit))
        aims.append(Aim(f"  {after}, more than a ping", ms[after] - ms["ping"], "ms", limit))
    aims.append(Aim("hide a body", ms["hide a body"], "ms", 1.0))
    more = ms["ping with a body elsewhere"] - ms["ping"]
    aims.append(Aim("ping(bodies=), more than a ping", more, "ms", 1.0))
    return {"aims": aims}


def report(found: dict):
    """Print the figures beside their aims."""
    harness.print_aims(found["aims"])
