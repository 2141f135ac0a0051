"""What a whole device costs over profile `ideal`: times of pings in turns, at the same tolerance."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

import numpy as np

import sonar_gl as sg
from sonar_gl.analysis.terms import everything_on
from tools.bench import harness
from tools.bench.harness import Aim, Contender
from tools.chart.scenes import make_scene, make_sonar

TOLERANCE = 0.01
MOST = 2.5  # times the time of a ping of profile ideal, aimed at


def make_variants() -> dict[str, tuple[sg.Acoustics, sg.Noise | None]]:
    """Return acoustics and noise by name: ideal; the device, without what the water and its surroundings add; all."""
    acoustics, noise = everything_on(sg.Acoustics.physical(), sg.Noise.physical())
    return {
        "ideal": (sg.Acoustics.ideal(), None),
        "device": (replace(acoustics, multipath="none"), None),
        "all": (acoustics, noise),
    }


def costs_of(name: str, rounds: int) -> dict[str, float]:
    """Return times of pings of a scene, milliseconds, and estimated errors, by variant and figure.

    Pings of all variants take turns; each makes an untimed one first, so that the others do not leave cold caches.
    """
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    pose, contenders, out = scene.sonar_pose, {}, {}
    with ExitStack() as stack:
        for variant, (acoustics, noise) in make_variants().items():
            simulator = stack.enter_context(sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE))
            out[f"{variant}, error"] = simulator.plan([pose]).error_estimate

            def ping(number, simulator=simulator, noise=noise):
                simulator.ping(harness.creep(pose, number), noise=noise)

            contenders[variant] = Contender(ping, before=lambda number, ping=ping: ping(number + 0.5))
        times = harness.take_turns(contenders, rounds)
    out["ideal, ms"] = float(np.median(times["ideal"]))
    for variant in ("device", "all"):
        out[variant] = harness.ratio(times[variant], times["ideal"])
    return out


def table(costs: dict[str, dict[str, float]]) -> str:
    """Return the costs of some scenes as a table of a page."""
    return harness.markdown(
        [
            {
                "scene": f"`{name}`",
                "`ideal`, ms": f"{one['ideal, ms']:.1f}",
                "device / `ideal`": f"{one['device']:.2f}",
                "with multipath and noise / `ideal`": f"{one['all']:.2f}",
                "error, estimated: `ideal`, device": f"{one['ideal, error']:.2%}, {one['device, error']:.2%}",
            }
            for name, one in costs.items()
        ]
    )


def aims(costs: dict[str, dict[str, float]]) -> list[Aim]:
    """Return the aims of some scenes."""
    return [Aim(f"{name}: device / ideal", one["device"], "times", MOST) for name, one in costs.items()]
