#!/usr/bin/env python
"""Counts how often `tolerance` keeps its promise in random worlds, and what that costs.

    python tools/promise.py                         # 100 worlds, some twenty minutes
    python tools/promise.py --worlds 20 --first 500

A world (`tests/worlds.py`) is a scene, a sonar and a pose by a seed: boxes, cylinders, thin rods, spheres,
tori, floors and hills; worlds of even seed are heard with profile `ideal`, of odd seed with `physical`. The
promise is kept if the error against `sonar_gl.reference_ping` is within the tolerance, and that of every
body's own echo within five times it. What it costs is the time of a ping and its samples, over those of the
coarsest rung of the ladder of samplings that would have kept it, in the same run.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

import sonar_gl as sg
from sonar_gl.plan import WORST_BODY, sampling_of
from sonar_gl.verify import ping_error, worst_body

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from worlds import random_world

TOLERANCES = (0.05, 0.02, 0.01)
REPEATS = 5
MOST_RAYS = 60_000_000  # of a truth: minutes of them change no verdict but of the smallest bodies


@dataclass(frozen=True)
class Outcome:
    """One world at one tolerance; errors as shares, times in ms, estimates as the plan gave them."""

    seed: int
    tolerance: float
    met: bool
    error: float
    error_estimate: float
    worst_body: float
    worst_body_estimate: float
    rung: int
    cheapest_rung: int | None
    ms: float
    cheapest_ms: float

    @property
    def kept(self) -> bool:
        """Whether the promise was kept."""
        return kept(self.error, self.worst_body, self.tolerance)


def kept(error: float, body_error: float, tolerance: float) -> bool:
    """Whether errors are as promised."""
    return error <= tolerance and body_error <= WORST_BODY * tolerance


def profile_of(seed: int) -> sg.Acoustics:
    """Each of the two in turn."""
    return sg.Acoustics.physical() if seed % 2 else sg.Acoustics.ideal()


def try_world(seed: int, tolerances=TOLERANCES, truth_error: float = 0.03, costs: bool = True):
    """Outcomes of one world, or none if nothing in it returns an echo."""
    scene, sonar, pose = random_world(seed)
    acoustics = profile_of(seed)
    truth = sg.reference_ping(scene, sonar, pose, acoustics, truth_error, MOST_RAYS)
    if not truth.intensity.any():
        return []
    judged = {}

    def judge(simulator):
        ping = simulator.ping(pose, labels=True)
        return ping_error(ping, truth), worst_body(ping, truth)[0]

    out = []
    for tolerance in tolerances:
        with sg.Simulator(scene, sonar, acoustics, tolerance=tolerance) as simulator:
            simulator.ping(pose)
            plan = simulator.plan([pose])
            error, body_error = judge(simulator)
            cheapest, ms, cheapest_ms = None, np.nan, np.nan
            for rung in range(plan.rung + 1) if costs else ():
                if rung not in judged:
                    with sg.Simulator(scene, sonar, acoustics, sampling_of(sonar, rung)) as other:
                        judged[rung] = judge(other)
                if kept(*judged[rung], tolerance):
                    cheapest = rung
                    break
            if cheapest is not None:
                with sg.Simulator(scene, sonar, acoustics, sampling_of(sonar, cheapest)) as other:
                    times = np.array(
                        [[_time(one, pose) for one in (simulator, other)] for _ in range(REPEATS)]
                    )
                ms, cheapest_ms = np.median(times[1:], axis=0)
        out.append(
            Outcome(
                seed,
                tolerance,
                plan.met,
                error,
                plan.error_estimate,
                body_error,
                plan.worst_body_estimate,
                plan.rung,
                cheapest,
                float(ms),
                float(cheapest_ms),
            )
        )
    return out


def _time(simulator, pose) -> float:
    start = perf_counter()
    simulator.ping(pose)
    return 1e3 * (perf_counter() - start)


def tell(outcomes):
    """Print the table."""
    print(
        "tolerance  worlds  kept  met  of those kept  cost: time  samples  estimate/error, median  broken by"
    )
    for tolerance in sorted({o.tolerance for o in outcomes}, reverse=True):
        mine = [o for o in outcomes if o.tolerance == tolerance]
        met = [o for o in mine if o.met]
        known = [o for o in mine if o.cheapest_rung is not None]
        time = np.median([o.ms / o.cheapest_ms for o in known])
        samples = np.median([2.0 ** ((o.rung - o.cheapest_rung) / 2) for o in known])
        estimate = np.median([o.error_estimate / o.error for o in mine])
        broken = [
            (o.seed, round(max(o.error / tolerance, o.worst_body / tolerance / 5), 2))
            for o in mine
            if not o.kept
        ]
        print(
            f"{tolerance:9g}  {len(mine):6}  {sum(o.kept for o in mine):4}  {len(met):3}"
            f"  {sum(o.kept for o in met):13}  {time:10.2f}  {samples:7.2f}  {estimate:22.2f}  {broken}"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--worlds", type=int, default=100, help="how many with an echo")
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    options = parser.parse_args()
    outcomes, seed, first = [], options.first, options.first
    with warnings.catch_warnings(), contextlib.suppress(KeyboardInterrupt):  # which tells of those so far
        warnings.simplefilter("ignore", UserWarning)
        while len({o.seed for o in outcomes}) < options.worlds:
            outcomes += try_world(seed)
            seed += 1
            if sys.stderr.isatty():
                print(f"\r{seed - first} worlds", end="", file=sys.stderr)
    with sg.Simulator(sg.Scene([]), random_world(0)[1]) as simulator:
        print(f"seeds {first} to {seed - 1}, on {simulator.gl_info['renderer']}")
    tell(outcomes)


if __name__ == "__main__":
    main()
