"""Reprint Table I of the founding paper, the rates of complete images, with ours beside it.

    python -m tools.bench paper                  # half a minute
    python -m tools.bench paper --rounds 500

A complete image is one from the pose to the colours, noise included:

- the paper's own picture (`demarco_image`): 19 600 rays, 280 x 70 to 45 x 20 degrees, its noise on the
  cloud, a circle a point, median, salt and pepper, Jet, 600 pixels high
- a ping of profile `physical` at 1 % by `p900-45` with `Noise.physical()`, as a fan image 800 pixels high
  in Jet

A rate is that of one image, 1 over its time; mean and standard deviation are printed, as in the paper. No
PNGs are written; the paper's code wrote one a frame.

This is not a race. The paper cast its rays one by one through the physics engine of Gazebo, which simulated
the world at the same time, on a CPU of 2015. Of its table only the rate of 3.1 Hz is known here, not the
rates of single scenes, their deviations or its computer; its scenes are like ours, not ours.
"""

from __future__ import annotations

import numpy as np

import sonar_gl as sg
from tools.bench import harness

ROUNDS = 200, 2
PAPER_HZ = 3.1
RANGE_M = {"pylon": 30.0, "diver": 10.0, "ocean_floor": 30.0}  # as in docs/gallery.md
STYLES = ("the paper's picture", "physical, 1 %")


def rates_hz(name: str, rounds: int) -> dict[str, np.ndarray]:
    """Return the (rounds,) rates of complete images of a bundled scene, by style."""
    scene = sg.load_scene(name)
    rays, fan = (sg.load_sonar(sonar).with_range(RANGE_M[name]) for sonar in ("demarco-2015", "p900-45"))
    speckle = sg.Noise.physical()
    with sg.Simulator(scene, rays) as paper, sg.Simulator(scene, fan) as physical:
        physical.plan([scene.sonar_pose])

        def draw_theirs(number):
            pose = harness.creep(scene.sonar_pose, number)
            sg.demarco_image(paper, pose, seed=number, range_law="constant")

        def draw_ours(number):
            pose = harness.creep(scene.sonar_pose, number)
            ping = physical.ping(pose, speckle, seed=0, ping_number=number)
            sg.colorize(sg.fan_image(ping, 800), "jet")

        times = harness.take_turns(dict(zip(STYLES, (draw_theirs, draw_ours), strict=True)), rounds)
    return {style: 1e3 / ms for style, ms in times.items()}


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument("--scene", action="append", choices=RANGE_M, help="may be repeated; default: all")


def run(options) -> dict:
    """Return mean and standard deviation of the rates, Hz, of each scene and style."""
    scenes = {}
    for name in options.scene or RANGE_M:
        found = rates_hz(name, options.rounds)
        scenes[name] = {style: (float(hz.mean()), float(hz.std())) for style, hz in found.items()}
    return {"paper_hz": PAPER_HZ, "rates_hz": scenes}


def report(found: dict):
    """Print the rates beside the paper's, and the caveat."""
    print("\nComplete images a second, mean (standard deviation)")
    print(
        f"  theirs: a CPU of 2015, 19 600 rays through Gazebo's physics engine; {PAPER_HZ} Hz for all scenes"
    )
    harness.print_table(
        [
            {
                "scene": name,
                "paper, 2015": PAPER_HZ,
                **{style: f"{mean:.1f} ({deviation:.1f})" for style, (mean, deviation) in styles.items()},
                "times theirs": ", ".join(f"{mean / PAPER_HZ:.0f}" for mean, _ in styles.values()),
            }
            for name, styles in found["rates_hz"].items()
        ]
    )
    print("  no race: other hardware, other scenes of the same kind, and Gazebo simulated a world besides")
