#!/usr/bin/env python
"""Times pings of bundled scenes and judges them against the ray-cast reference, for a ladder of samplings.

    python tools/bench.py                              # all scenes, some minutes
    python tools/bench.py --quick                      # fewer repeats and rays, less than a minute
    python tools/bench.py --scene pylon --json out.json
    python tools/bench.py --paper                      # Table I of the founding paper, ours beside theirs
    python tools/bench.py --start                      # time and memory of fresh processes
    python tools/bench.py --scaling --out docs         # how the time grows; see tools/bench_scaling.py

The setting is one for all: 256 beams of 1 degree boxes over 45 x 20 degrees, 512 bins to 30 m, profile
`ideal`. What is compared is interleaved, round by round, and told as medians; ratios are medians of the
rounds' ratios.

The error is the sum of |E - T| over the sum of T, over beams and bins, T of `sonar_gl.reference_ping`
(Embree; the extra `reference`), flat faces, at the scene's own pose. Beside it stands how far T's two halves
differ, of which T itself is wrong by about half.

A tolerance is looked after while the sonar moves: what that costs is the summed time of pings of a moving
sonar over that of pings with the same samples, fixed beforehand.

The picture is a ping of profile `physical` with `Noise.physical()`, as a colour fan image 800 pixels high.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import platform
import warnings
from contextlib import ExitStack
from dataclasses import asdict, replace
from time import perf_counter

import bench_paper
import bench_scaling
import bench_start
import numpy as np

import sonar_gl as sg
from sonar_gl.verify import ping_error
from sonar_gl.watch import CHECK_EVERY

SCENES = ("pylon", "diver", "ocean_floor")
SONAR = sg.Sonar(
    name="bench",
    frequency_hz=900e3,
    n_beams=256,
    n_bins=512,
    azimuth_fov_deg=45.0,
    elevation_fov_deg=20.0,
    beam_width_deg=1.0,
    range_min_m=0.5,
    range_max_m=30.0,
)
LADDER = {  # what a row is called: what `Simulator` is given
    "tolerance 0.05": {"tolerance": 0.05},
    "tolerance 0.02": {"tolerance": 0.02},
    "tolerance 0.01": {"tolerance": 0.01},
    "1.5 x 48": {"sampling": sg.Sampling(1.5, 48)},
    "2 x 64": {"sampling": sg.Sampling(2, 64)},
    "2 x 64, point": {"sampling": sg.Sampling(2, 64, "point")},
}
BASE = "tolerance 0.01"  # the default; times are told as multiples of its time too
STAGES = ("render", "reduce", "beams")  # draw and read back; samples to columns; columns to beams
CREEP_M = 0.001  # the sonar creeps ahead by so much a round: no two pings alike
WARM_UP = 3


class Stopwatch:
    """Adds up the seconds that some methods of a simulator take, in STAGES' order."""

    def __init__(self, simulator):
        renderer, reducer = simulator._samples.now.renderer, simulator._samples.now.reducer
        self.seconds = [0.0] * len(STAGES)
        for stage, (owner, name) in enumerate(
            ((renderer, "render"), (reducer, "_accumulate"), (reducer, "_beams"))
        ):
            setattr(owner, name, self._timed(stage, getattr(owner, name)))

    def _timed(self, stage, method):
        def timed(*arguments):
            start = perf_counter()
            out = method(*arguments)
            self.seconds[stage] += perf_counter() - start
            return out

        return timed

    def time(self, simulator, pose) -> list[float]:
        """Seconds of a whole ping, then of its stages."""
        self.seconds[:] = [0.0] * len(STAGES)
        start = perf_counter()
        simulator.ping(pose)
        return [perf_counter() - start, *self.seconds]


def picture(simulator, pose, number: int) -> list[float]:
    """Seconds of a finished picture: the ping with its noise, the fan image, its colours."""
    start = perf_counter()
    ping = simulator.ping(pose, sg.Noise.physical(), seed=0, ping_number=number)
    heard = perf_counter()
    image = sg.fan_image(ping, 800)
    formed = perf_counter()
    sg.colorize(image, "jet")
    return [heard - start, formed - heard, perf_counter() - formed]


def measure(scene, repeats: int):
    """Times in ms, (repeats, 1 + stages) for each row of the ladder and (repeats, 3) for the picture."""
    ideal, physical = sg.Acoustics.ideal(), sg.Acoustics.physical()
    with ExitStack() as stack:
        ladder = {
            name: stack.enter_context(sg.Simulator(scene, SONAR, ideal, **how))
            for name, how in LADDER.items()
        }
        finished = stack.enter_context(sg.Simulator(scene, SONAR, physical))
        for simulator in (*ladder.values(), finished):
            simulator.plan([scene.sonar_pose])
        watches = {name: Stopwatch(simulator) for name, simulator in ladder.items()}
        times = {name: [] for name in ladder}
        pictures = []
        for number in range(-WARM_UP, repeats):
            pose = scene.sonar_pose @ sg.pose(x=CREEP_M * (number + WARM_UP))
            for name, simulator in ladder.items():
                times[name].append(watches[name].time(simulator, pose))
            pictures.append(picture(finished, pose, number + WARM_UP))
        about = {
            name: {
                "columns": sum(window[2] for window in simulator._samples.now.renderer.windows),
                "rows": max(window[3] for window in simulator._samples.now.renderer.windows),
                "sampling": asdict(simulator.sampling),
            }
            for name, simulator in ladder.items()
        }
    times = {name: 1e3 * np.array(rows[WARM_UP:]) for name, rows in times.items()}
    return times, 1e3 * np.array(pictures[WARM_UP:]), about


def looking_after(scene, repeats: int) -> float:
    """What keeping a tolerance while the sonar moves costs, as a share of the time of pings."""
    ideal, turns = sg.Acoustics.ideal(), max(2, repeats // 20)
    spent = np.zeros(2)
    with sg.Simulator(scene, SONAR, ideal) as live, sg.Simulator(scene, SONAR, ideal) as fixed:
        fixed.plan([scene.sonar_pose])
        live.ping(scene.sonar_pose)
        for number in range(1, 1 + CHECK_EVERY * turns):  # whole rounds of looking and not
            pose = scene.sonar_pose @ sg.pose(x=CREEP_M * number)
            for which, simulator in enumerate((live, fixed)):
                start = perf_counter()
                simulator.ping(pose)
                spent[which] += perf_counter() - start
    return float(spent[0] / spent[1] - 1)


def errors(scene, n_rays: int):
    """Error of each row of the ladder, and how far the two halves of the reference differ."""
    flat = sg.Scene([replace(body, normals=None) for body in scene.bodies], scene.sonar_pose, scene.name)
    ideal = sg.Acoustics.ideal()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the halves' difference is told
        truth = sg.reference_ping(flat, SONAR, flat.sonar_pose, ideal, 0.005, n_rays)
    out = {}
    for name, how in LADDER.items():
        with sg.Simulator(flat, SONAR, ideal, **how) as simulator:
            out[name] = ping_error(simulator.ping(flat.sonar_pose), truth)
    return out, truth.meta["difference"]


def bench(name: str, repeats: int, n_rays: int) -> dict:
    """All figures of one scene; times in ms."""
    scene = sg.load_scene(name)
    times, pictures, rows = measure(scene, repeats)
    error, difference = errors(scene, n_rays) if n_rays else ({}, None)
    for row, ms in times.items():
        whole, stages = ms[:, 0], ms[:, 1:]
        rows[row] |= {
            "ping_ms": {"median": float(np.median(whole)), "p95": float(np.quantile(whole, 0.95))},
            "stages_ms": dict(zip(STAGES, np.median(stages, axis=0).tolist(), strict=True)),
            "rest_ms": float(np.median(whole - stages.sum(axis=1))),
            "times_base": float(np.median(whole / times[BASE][:, 0])),
            "error": error.get(row),
        }
    whole = pictures.sum(axis=1)
    return {
        "scene": name,
        "triangles": scene.n_triangles,
        "bodies": len(scene.bodies),
        "reference_rays": n_rays,
        "reference_seeds_differ": difference,
        "ladder": rows,
        "looking_after": looking_after(scene, repeats),
        "picture_ms": {
            "median": float(np.median(whole)),
            "p95": float(np.quantile(whole, 0.95)),
            **dict(zip(("ping", "fan_image", "colorize"), np.median(pictures, axis=0).tolist(), strict=True)),
        },
    }


def tell(found: dict):
    """Print the table of one scene."""
    wide = max(map(len, found["ladder"]))
    print(f"\n{found['scene']}: {found['triangles']} triangles, {found['bodies']} bodies")
    head = f"  {'sampling':{wide}}  {'columns x rows':>14}  {'ping, ms':>8}  {'p95':>6}  {'ratio':>5}"
    print(head + "".join(f"  {stage:>6}" for stage in (*STAGES, "rest")) + "   error")
    for name, row in found["ladder"].items():
        samples = f"{row['columns']} x {row['rows']}"
        line = (
            f"  {name:{wide}}  {samples:>14}  {row['ping_ms']['median']:8.2f}  {row['ping_ms']['p95']:6.2f}"
        )
        line += f"  {row['times_base']:5.2f}"
        line += "".join(f"  {ms:6.2f}" for ms in (*row["stages_ms"].values(), row["rest_ms"]))
        print(line + ("       -" if row["error"] is None else f"  {row['error']:6.2%}"))
    if found["reference_rays"]:
        rays, differ = found["reference_rays"] / 1e6, found["reference_seeds_differ"]
        print(f"  the reference's halves, {rays:g} million rays at most, differ by {differ:.2%}")
    print(f"  looking after tolerance 0.01 of a moving sonar costs {found['looking_after']:+.0%} of the time")
    p = found["picture_ms"]
    print(
        f"  colour image with noise: {p['median']:.2f} ms, p95 {p['p95']:.2f} "
        f"(ping {p['ping']:.2f}, fan image {p['fan_image']:.2f}, colours {p['colorize']:.2f})"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scene", action="append", choices=SCENES, help="may be repeated; all if left out")
    parser.add_argument("--quick", action="store_true", help="fewer repeats and rays")
    parser.add_argument("--repeats", type=int, help="rounds; 100, or 12 if quick")
    parser.add_argument(
        "--rays", type=int, help="of a reference at most; 80 million, or 4 if quick; 0 for no errors"
    )
    parser.add_argument("--json", metavar="FILE", help="write all figures there too")
    parser.add_argument("--paper", action="store_true", help="only what tools/bench_paper.py prints")
    parser.add_argument("--start", action="store_true", help="only what tools/bench_start.py prints")
    parser.add_argument("--scaling", action="store_true", help="only what tools/bench_scaling.py prints")
    parser.add_argument("--large", action="store_true", help="with --scaling: also 10 million triangles")
    parser.add_argument("--out", type=pathlib.Path, help="with --scaling: where its table and picture go")
    options = parser.parse_args()
    if options.paper:
        bench_paper.tell(bench_paper.paper_table(options.repeats or 200))
    if options.start:
        bench_start.tell(bench_start.start_costs(options.repeats or 5))
    if options.scaling:
        bench_scaling.scaling(options.quick, options.large, options.out)
    if options.paper or options.start or options.scaling:
        return
    repeats = options.repeats or (12 if options.quick else 100)
    n_rays = options.rays if options.rays is not None else (4_000_000 if options.quick else 80_000_000)
    with sg.Simulator(sg.Scene([]), SONAR) as simulator:
        renderer = simulator.gl_info["renderer"]
    load = os.getloadavg()[0]
    print(
        f"sonar_gl {sg.__version__} on {renderer}; Python {platform.python_version()}, {os.cpu_count()} cores"
    )
    print(f"{repeats} rounds, times are medians; the load at the start is {load:.1f} (quiet is below 0.3)")
    found = []
    for name in options.scene or SCENES:
        try:
            found.append(bench(name, repeats, n_rays))
        except sg.Error as why:
            raise SystemExit(f"{why}; or leave the errors out with --rays 0") from None
        tell(found[-1])
    if options.json:
        about = {
            "version": sg.__version__,
            "gl_renderer": renderer,
            "python": platform.python_version(),
            "machine": platform.machine(),
            "cores": os.cpu_count(),
            "load": load,
            "rounds": repeats,
            "sonar": asdict(SONAR),
        }
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump({**about, "scenes": found}, file, indent=2)


if __name__ == "__main__":
    main()
