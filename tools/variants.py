#!/usr/bin/env python
"""Other ways to lay samples and to sum them, against the way that is used: error and time as ratios.

    python tools/variants.py            # some three minutes
    python tools/variants.py --worlds 4

Each way is tried on pylon, diver and some random worlds (`tests/worlds.py`), with samples 0.3 degrees wide
and high and a half and a quarter of that, profile `ideal`. Told are medians over scenes and samplings: the
error against `sonar_gl.reference_ping` over ours, the largest relative error of a body's own echo over ours,
and the time of a ping over ours in the same run. Then rods 1 cm thick: how much their echo spreads while the
sonar creeps.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import math
import sys
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from time import perf_counter
from unittest import mock

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl import fan, footprint, lattice
from sonar_gl.fan import rung_sampling
from sonar_gl.passes import Pass
from sonar_gl.verify import ping_error, worst_body

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from worlds import random_world

WIDTHS_DEG = (0.3, 0.15, 0.075)
REPEATS = 9
SONAR = sg.Sonar("variants", 900e3, 256, 512, 45.0, 20.0, 1.0, 0.5, 30.0)


def kernel(old: str, new: str):
    """Have `accumulate` with a line of its source changed."""
    return mock.patch("sonar_gl.reduce.accumulate", changed_kernel(old, new))


@cache
def changed_kernel(old: str, new: str):
    """Compile it."""
    source = inspect.getsource(footprint)
    assert old in source, old
    space = {}
    exec(source.replace(old, new).replace("from __future__ import annotations", ""), space)
    return space["accumulate"]


def sheared(shear_of_rows, tilt):
    """Lattices of another shear: samples a row, as a function of rows, and the rise from side to side."""

    def make(azimuth, half_width, n_samples, rows, tan_elevation, _):
        return lattice.make_sector(azimuth, half_width, n_samples, rows, tan_elevation, shear_of_rows(rows))

    stack = contextlib.ExitStack()
    stack.enter_context(mock.patch.object(fan, "make_sector", make))
    stack.enter_context(mock.patch.object(lattice, "SHEAR_ROWS", tilt))
    return stack


def neighbours():
    """Slopes of the surface from the samples beside, not from the face that the ray met."""
    views = Pass.views

    def changed(self, *arguments, **more):
        out = []
        for sector, plane_echo, body_id in views(self, *arguments, **more):
            plane_echo = plane_echo.copy()
            if min(plane_echo.shape[:2]) > 1:
                up, along = np.gradient(plane_echo[..., 0])
                to_uv = np.linalg.inv([[sector.u[1], sector.v[1]], [sector.u[2], sector.v[2]]])
                for k in range(2):
                    plane_echo[..., 1 + k] = to_uv[k, 0] * along + to_uv[k, 1] * up
            out.append((sector, plane_echo, body_id))
        return out

    return mock.patch.object(Pass, "views", changed)


def scaled(columns: float, rows: float, reducer: str = "footprint"):
    """Another number of samples across and up."""
    return lambda s: sg.Sampling(s.columns_per_beam * columns, max(4, round(s.rows * rows)), reducer)


def same(sampling):
    """The sampling as it is."""
    return sampling


ROOT2 = math.sqrt(2)
EDGES = "meet if is_edge else border_here"
HORIZON = "min(max(-plane / along, low), high) if is_lost else border_here"
TRAPEZOID = "if 8 * thin * per_metre >= s * s:"
VARIANTS = {  # what a row is called: (what to patch, what to make of a sampling)
    "ours": (contextlib.nullcontext, same),
    "no shear": (lambda: sheared(lambda _: 0.0, 0.0), same),
    "shear 16 over the picture, rise 0.25": (lambda: sheared(lambda rows: 16 / rows, 0.25), same),
    "shear 0.382 a row": (lambda: sheared(lambda _: 0.382, lattice.SHEAR_ROWS), same),
    "rise 0.36 of the rows": (lambda: sheared(lambda _: lattice.SHEAR, 0.36), same),
    "rise 0.09 of the rows": (lambda: sheared(lambda _: lattice.SHEAR, 0.09), same),
    "sectors of 30 degrees": (lambda: mock.patch.object(fan, "MAX_SECTOR_RAD", math.radians(30)), same),
    "samples twice as high as wide": (contextlib.nullcontext, scaled(ROOT2, 1 / ROOT2)),
    "samples twice as wide as high": (contextlib.nullcontext, scaled(1 / ROOT2, ROOT2)),
    "edges half way between rays": (lambda: kernel(EDGES, "border_here"), same),
    "horizons half way between rays": (lambda: kernel(HORIZON, "border_here"), same),
    "boxes only, no trapezoids": (lambda: kernel(TRAPEZOID, "if False:"), same),
    "slopes from neighbours": (neighbours, same),
    "point bins": (contextlib.nullcontext, scaled(1, 1, "point")),
}


def cases(n_worlds: int):
    """(scene, sonar, pose, truth) of each."""
    found = []
    for name in ("pylon", "diver"):
        scene = sg.load_scene(name)
        bodies = [replace(body, normals=None) for body in scene.bodies]
        found.append((sg.Scene(bodies, name=name), SONAR, scene.sonar_pose))
    found += [random_world(seed) for seed in range(50, 50 + n_worlds)]
    ideal = sg.Acoustics.ideal()
    return [(*case, sg.reference_ping(*case, ideal, error=0.02)) for case in found]


def measure(case, sampling):
    """(error, worst body, ms) of each variant, in turns."""
    scene, sonar, pose, truth = case
    with contextlib.ExitStack() as stack:
        simulators, out, times = {}, {}, {name: [] for name in VARIANTS}
        for name, (patch, change) in VARIANTS.items():
            with patch():
                simulator = sg.Simulator(scene, sonar, sg.Acoustics.ideal(), change(sampling))
                simulators[name] = stack.enter_context(simulator)
                ping = simulator.ping(pose, labels=True)
            out[name] = [ping_error(ping, truth), worst_body(ping, truth)[0]]
        for _ in range(REPEATS):
            for name, simulator in simulators.items():
                with VARIANTS[name][0]():
                    start = perf_counter()
                    simulator.ping(pose)
                    times[name].append(perf_counter() - start)
    ours = np.array(times["ours"])
    return {name: (*out[name], float(np.median(np.array(t) / ours))) for name, t in times.items()}


def rods():
    """Spread of the echo of rods at 6 and 15 m, rms about the truth, median and worst, for each variant."""
    rng = np.random.default_rng(5)
    scenes = []
    for range_m, length_m in ((6, 1.0), (15, 2.0)):
        for angle in (0, 90, 45, -45, 10, 80, *rng.uniform(0, 180, 2)):
            turn = trimesh.transformations.rotation_matrix(math.radians(angle), [1, 0, 0])
            place = sg.pose(range_m, *(range_m * rng.uniform(-0.08, 0.08, 2)))
            mesh = trimesh.creation.cylinder(0.005, length_m, sections=24)
            scenes.append(sg.Scene([sg.Body("rod", mesh, place @ turn, reflectivity=1.0)]))
    poses = [sg.pose(y=0.007 * k, z=0.003 * k) for k in range(16)]

    def energies(scene, sampling):
        with sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), sampling) as simulator:
            return np.array([simulator.ping(pose).intensity.sum(dtype=float) for pose in poses])

    truths = [energies(scene, sg.Sampling(16, 1600)) for scene in scenes]
    out = {}
    for name, (patch, change) in VARIANTS.items():
        with patch():
            spread = [
                np.sqrt(np.mean((energies(scene, change(sg.Sampling(1.5, 60))) / truth - 1) ** 2))
                for scene, truth in zip(scenes, truths, strict=True)
            ]
        out[name] = float(np.median(spread)), float(np.max(spread))
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--worlds", type=int, default=10, help="random worlds")
    options = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = []
        for case in cases(options.worlds):
            found += [measure(case, rung_sampling(case[1], width)) for width in WIDTHS_DEG]
        spreads = rods()
    print(f"{'way':37}  error  worst body   time  rods: median  worst")
    for name in VARIANTS:
        ratios = [[one[name][k] / max(one["ours"][k], 1e-9) for one in found] for k in (0, 1)]
        time = np.median([one[name][2] for one in found])
        told = "".join(f"  {np.median(r):{wide}.2f}" for r, wide in zip(ratios, (5, 10), strict=True))
        print(f"{name:37}{told}  {time:5.2f}  {spreads[name][0]:12.2f}  {spreads[name][1]:5.2f}")


if __name__ == "__main__":
    main()
