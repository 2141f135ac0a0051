#!/usr/bin/env python
"""Reprints Table I of the founding paper, the rates of complete images, with ours beside it.

    python tools/bench_paper.py                  # half a minute
    python tools/bench_paper.py --repeats 500

A complete image is one from the pose to the colours, noise and all:

- the paper's own picture (`demarco_image`): 19 600 rays, 280 x 70 to 45 x 20 degrees, its noise on the
  cloud, a circle a point, median, salt and pepper, Jet, 600 pixels high
- a ping of profile `physical` at 1 % by `p900-45` with `Noise.physical()`, as a fan image 800 pixels high
  in Jet

The sonar creeps ahead, so that no two images are alike. A rate is that of one image, 1 over its time; told
are mean and standard deviation, as in the paper. No PNGs are written; the paper's code wrote one a frame.

The caveat: this is no race. The paper cast its rays one by one through the physics engine of Gazebo, which
simulated the world at the same time, on a CPU of 2015. Of its table the rate of 3.1 Hz is known here; the
rates of its scenes apart, their deviations and its computer are not, and its scenes are like ours, not ours.
"""

from __future__ import annotations

import argparse
import os
import platform
from time import perf_counter

import numpy as np

import sonar_gl as sg

PAPER_HZ = 3.1
RANGE_M = {"pylon": 30.0, "diver": 10.0, "ocean_floor": 30.0}  # as in docs/gallery.md
STYLES = ("the paper's picture", "physical, 1 %")
CREEP_M = 0.001
WARM_UP = 3


def rates_hz(name: str, repeats: int) -> dict[str, np.ndarray]:
    """(repeats,) rate of each complete image of a bundled scene, by style; the styles take turns."""
    scene, times = sg.load_scene(name), {style: [] for style in STYLES}
    rays, fan = (sg.load_sonar(sonar).with_range(RANGE_M[name]) for sonar in ("demarco-2015", "p900-45"))
    speckle = sg.Noise.physical()
    with sg.Simulator(scene, rays) as paper, sg.Simulator(scene, fan) as physical:
        physical.plan([scene.sonar_pose])
        for number in range(WARM_UP + repeats):
            pose = scene.sonar_pose @ sg.pose(x=CREEP_M * number)
            start = perf_counter()
            sg.demarco_image(paper, pose, seed=number, range_law="constant")
            drawn = perf_counter()
            ping = physical.ping(pose, speckle, seed=0, ping_number=number)
            sg.colorize(sg.fan_image(ping, 800), "jet")
            for style, took_s in zip(STYLES, (drawn - start, perf_counter() - drawn), strict=True):
                times[style].append(took_s)
    return {style: 1 / np.array(took_s[WARM_UP:]) for style, took_s in times.items()}


def processor() -> str:
    """What the CPU calls itself."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    name = names[0] if names else platform.processor() or "a CPU without a name"
    return f"{os.cpu_count()} cores of {name}"


def paper_table(repeats: int, names=()) -> dict:
    """Hardware, and for each scene, or some, and style mean and standard deviation of the rate, Hz."""
    with sg.Simulator(sg.Scene([]), sg.load_sonar("p900-45")) as simulator:
        renderer = simulator.gl_info["renderer"]
    scenes = {}
    for name in names or RANGE_M:
        found = rates_hz(name, repeats)
        scenes[name] = {style: (float(hz.mean()), float(hz.std())) for style, hz in found.items()}
    return {"renderer": renderer, "processor": processor(), "images": repeats, "scenes": scenes}


def tell(found: dict):
    """Print what `paper_table` found, the paper's rate beside it, and the caveat."""
    print("Complete images a second, mean (standard deviation)")
    print(f"  theirs: a CPU of 2015, 19 600 rays through Gazebo's physics engine; {PAPER_HZ} Hz told for all")
    print(f"  ours:   {found['renderer']}, {found['processor']}; {found['images']} images each")
    print(f"{'':12}  {'paper, 2015':>14}" + "".join(f"  {style:>20}" for style in STYLES) + "  times theirs")
    for name, styles in found["scenes"].items():
        line = f"{name:12}  {PAPER_HZ:14.1f}"
        line += "".join(f"  {f'{mean:.1f} ({std:.1f})':>20}" for mean, std in styles.values())
        print(line + "  " + ", ".join(f"{mean / PAPER_HZ:.0f}" for mean, _ in styles.values()))
    print("  no race: other hardware, other scenes of the same kind, and Gazebo simulated a world besides")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=200, help="images of each scene and style")
    parser.add_argument("--scene", action="append", choices=RANGE_M, help="may be repeated; all if left out")
    options = parser.parse_args()
    tell(paper_table(options.repeats, options.scene))


if __name__ == "__main__":
    main()
