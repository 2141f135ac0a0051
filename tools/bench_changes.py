"""Many frames, two sonars, and bodies that come, go and move: what they cost, beside what is aimed at."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter

import numpy as np
import trimesh
from bench_cases import rung_of
from bench_terrain import finer_floor
from chart_scenes import make_scene, make_sonar

import sonar_gl as sg
from sonar_gl.plan import sampling_of

IDEAL = sg.Acoustics.ideal()
CREEP_M = 0.001
LARGE_PINGS = 9
CHANGES = 20  # at most: each adds bodies


def in_sequence(name: str, n: int, rounds: int) -> float:
    """How many times the pings of `pings` one gets in the time of ping by ping, of a scene."""
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    poses = [scene.sonar_pose @ sg.pose(x=CREEP_M * k) for k in range(n)]
    with sg.Simulator(scene, sonar, IDEAL) as simulator:
        simulator.plan([scene.sonar_pose])
        ratios = []
        for number in range(-1, rounds):
            start = perf_counter()
            for pose in poses:
                simulator.ping(pose)
            one_by_one = perf_counter()
            for _ in simulator.pings(poses):
                pass
            if number >= 0:
                ratios.append((one_by_one - start) / (perf_counter() - one_by_one))
    return float(np.median(ratios))


def two_sonars(name: str, n: int, rounds: int) -> float:
    """The time of a pair of sonars, one level and one upright, in one world, over that of two runs.

    Each begins with the scene loaded and makes n pings a sonar.
    """
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    turns = np.eye(4), sg.pose(roll=np.pi / 2)

    def look(simulators):
        for simulator, turn in simulators:
            simulator.plan([scene.sonar_pose @ turn])
        for k in range(n):
            for simulator, turn in simulators:
                simulator.ping(scene.sonar_pose @ sg.pose(x=CREEP_M * k) @ turn)

    ratios = []
    for number in range(-1, rounds):
        start = perf_counter()
        for turn in turns:
            with sg.Simulator(scene, sonar, IDEAL) as simulator:
                look([(simulator, turn)])
        apart = perf_counter()
        with sg.Simulator(scene, sonar, IDEAL) as first, sg.Simulator(first, sonar, IDEAL) as second:
            look(list(zip((first, second), turns, strict=True)))
        if number >= 0:
            ratios.append((perf_counter() - apart) / (apart - start))
    return float(np.median(ratios))


def of_a_body(name: str, rounds: int) -> dict[str, float]:
    """Medians in microseconds of what is done to a body of a scene, and of pings after that."""
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    here, ball = scene.sonar_pose, trimesh.creation.icosphere(3, 0.3)
    times = {}

    def timed(what, function, *arguments, **named):
        start = perf_counter()
        function(*arguments, **named)
        times.setdefault(what, []).append(1e6 * (perf_counter() - start))

    with ExitStack() as stack:
        simulator = stack.enter_context(sg.Simulator(scene, sonar, IDEAL))
        simulator.plan([here])
        simulator.add(sg.Body("known", ball, here @ sg.pose(9)))
        for k in range(-1, min(rounds, CHANGES)):
            if k == 0:
                times.clear()
            before, after = here @ sg.pose(8, 0.1 * k), here @ sg.pose(9, 0.1 * k)
            timed("add a body", simulator.add, sg.Body(f"new {k}", ball.copy(), before))
            timed("first ping after that", simulator.ping, here)
            timed("add another of its mesh", simulator.add, sg.Body(f"again {k}", ball, before))
            timed("first ping after this", simulator.ping, here)
            timed("ping", simulator.ping, here)  # with the same bodies
            timed("move a body", simulator.place, {f"new {k}": after})
            timed("first ping after moving", simulator.ping, here)
            timed("ping with a body elsewhere", simulator.ping, here, bodies={"known": after})
            timed("hide a body", simulator.place, {f"new {k}": None})
            simulator.place({f"again {k}": None})
    return {what: float(np.median(us)) for what, us in times.items()}


def large(triangles: int) -> dict[str, float]:
    """A floor from a file in a process of its own: seconds to load it and to make a simulator, a ping, MB."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "floor.ply"
        finer_floor(triangles).bodies[0].mesh.export(path)
        command = [sys.executable, __file__, str(path)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} ended with exit status {done.returncode}")
    return json.loads(done.stdout)


def load_large(path: str) -> dict[str, float]:
    """What `large` tells; in the process that it starts."""
    bundled, sonar = make_scene("ocean_floor"), make_sonar("ocean_floor", "wide")
    sampling = sampling_of(sonar, rung_of(bundled, sonar))
    start = perf_counter()
    (floor,) = sg.load_scene(path).bodies
    loaded = perf_counter()
    scene = sg.Scene([floor, *bundled.bodies[1:]], bundled.sonar_pose)
    with sg.Simulator(scene, sonar, IDEAL, sampling) as simulator:
        made, times = perf_counter(), []
        for k in range(LARGE_PINGS):
            began = perf_counter()
            simulator.ping(scene.sonar_pose @ sg.pose(x=CREEP_M * k))
            times.append(1e3 * (perf_counter() - began))
    return {
        "triangles": scene.n_triangles,
        "load_s": loaded - start,
        "make_s": made - loaded,
        "ping_ms": float(np.median(times)),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
    }


def measure(sizes) -> list[tuple]:
    """(what, measured, unit, aim, whether at least) of each; sizes : `bench_cases.Sizes`."""
    aims = []
    for name in sizes.scenes:
        gain = in_sequence(name, sizes.pings, max(2, sizes.rounds // 4))
        aims.append((f"pings() over ping by ping, {name}", gain, "times", 1.5, True))
    pair = two_sonars(sizes.scene, sizes.pings, max(1, sizes.rounds // 10))
    aims.append(("two sonars in one world / in two runs", pair, "times", 1.0, False))
    us = of_a_body(sizes.scene, sizes.rounds)
    for change, after, limit in (
        ("add a body", "first ping after that", 10.0),
        ("add another of its mesh", "first ping after this", 10.0),
        ("move a body", "first ping after moving", 1.0),
    ):
        aims.append((change, us[change] / 1e3, "ms", limit, False))
        aims.append((f"  {after}, more than a ping", (us[after] - us["ping"]) / 1e3, "ms", limit, False))
    aims.append(("hide a body", us["hide a body"] / 1e3, "ms", 1.0, False))
    more = (us["ping with a body elsewhere"] - us["ping"]) / 1e3
    aims.append(("ping(bodies=), more than a ping", more, "ms", 1.0, False))
    return aims


if __name__ == "__main__":
    print(json.dumps(load_large(sys.argv[1])))
