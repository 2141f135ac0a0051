"""Count how often `tolerance` is met in random worlds, and what that costs.

    python -m tools.promise                         # 100 worlds, some twenty minutes
    python -m tools.promise --worlds 20 --first 500
    python -m tools.promise --worlds 20 --alone     # samples chosen from each ping alone, as in batches
    python -m tools.promise --pools 20              # of the sum of direct and multipath echoes

A world (`tests/support/worlds.py`) is a scene, a sonar and a pose by a seed: boxes, cylinders, thin rods,
spheres, tori, floors and hills. Worlds of even seed have profile `ideal`, those of odd seed `physical`. The
promise is kept if the error against `sonar_gl.reference_ping` is within the tolerance, and the error of every
body's own echo within five times it. It is open where the error exceeds that by no more than the truth may be
off, whose rays are limited. The cost is the time of a ping and its samples, over those of the coarsest sampling
level that would have kept the promise, in the same run; of pings alone, over those of a planned ping.

Pools have a calm surface, by which multipath returns up to a hundred times the direct echo. The reference has no
multipath: the truth is a ping of up to nine times as many samples as the finest one that is judged.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import warnings
from dataclasses import dataclass, replace

import numpy as np

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error, worst_body
from sonar_gl.sonar.sampling import WORST_BODY, level_of, sampling_at
from tests.support.worlds import random_pool, random_world
from tools import internals
from tools.bench import harness

TOLERANCES = (0.05, 0.02, 0.01)
ROUNDS = 4
TRUTH_ERROR = 0.03
MOST_SAMPLES = 3_500_000  # of the truth of a pool
MOST_RAYS = 60_000_000  # of a truth; more would change the verdict on the smallest bodies only


@dataclass(frozen=True)
class Outcome:
    """One world at one tolerance; errors as shares, times in ms, estimates of the plan.

    Of a ping alone, the estimates are its own, and in place of the cheapest level is that of a plan.
    """

    seed: int
    tolerance: float
    met: bool
    error: float
    error_estimate: float
    worst_body: float
    worst_body_estimate: float
    level: int
    cheapest_level: int | None
    ms: float
    cheapest_ms: float
    doubt: float
    body_doubt: float

    @property
    def kept(self) -> bool:
        """Whether the promise is kept."""
        return kept(self.error, self.worst_body, self.tolerance)

    @property
    def is_open(self) -> bool:
        """Whether it is not kept by so little that the truth, `doubt` and `body_doubt` off, may be what errs."""
        return not self.kept and kept(
            self.error - self.doubt, self.worst_body - self.body_doubt, self.tolerance
        )


def kept(error: float, body_error: float, tolerance: float) -> bool:
    """Return whether errors are within what the tolerance promises."""
    return error <= tolerance and body_error <= WORST_BODY * tolerance


def doubts(truth: sg.Ping) -> tuple[float, float]:
    """Return how far off a truth may be, as a share of its echo, and of a body's: its halves differ by twice that."""
    return truth.meta["difference"] / 2, truth.meta["body_difference"] / 2


def profile_of(seed: int) -> sg.Acoustics:
    """Return the acoustics of a world: the two profiles in turn."""
    return sg.Acoustics.physical() if seed % 2 else sg.Acoustics.ideal()


def try_alone(seed: int) -> list[Outcome]:
    """Return the Outcomes of one world whose ping chooses its samples alone; none if it returns no echo."""
    scene, sonar, pose = random_world(seed)
    acoustics, out = profile_of(seed), []
    truth = sg.reference_ping(scene, sonar, pose, acoustics, TRUTH_ERROR, MOST_RAYS)
    for tolerance in TOLERANCES if truth.intensity.any() else ():
        with (
            sg.Simulator(scene, sonar, acoustics, tolerance=tolerance) as alone,
            sg.Simulator(scene, sonar, acoustics, tolerance=tolerance) as planned,
        ):
            plan = planned.plan([pose])
            ping = internals.ping_alone(alone, pose, labels=True)
            pings = {
                "alone": lambda _, simulator=alone: internals.ping_alone(simulator, pose),
                "planned": lambda _, simulator=planned: simulator.ping(pose),
            }
            times = harness.take_turns(pings, ROUNDS, warm_up=1)
            samples = sg.Sampling(**ping.meta["sampling"]).count(sonar)
        out.append(
            Outcome(
                seed,
                tolerance,
                ping.error_estimate <= tolerance,
                ping_error(ping, truth),
                ping.error_estimate,
                worst_body(ping, truth)[0],
                np.nan,
                level_of(sonar, samples),
                plan.level,
                float(np.median(times["alone"])),
                float(np.median(times["planned"])),
                *doubts(truth),
            )
        )
    return out


def try_world(seed: int, tolerances=TOLERANCES, truth_error: float = TRUTH_ERROR, costs: bool = True):
    """Return the Outcomes of one world; none if it returns no echo."""
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
            for level in range(plan.level + 1) if costs else ():
                if level not in judged:
                    with sg.Simulator(scene, sonar, acoustics, sampling_at(sonar, level)) as other:
                        judged[level] = judge(other)
                if kept(*judged[level], tolerance):
                    cheapest = level
                    break
            if cheapest is not None:
                with sg.Simulator(scene, sonar, acoustics, sampling_at(sonar, cheapest)) as other:
                    both = {"own": simulator, "cheapest": other}
                    pings = {name: (lambda _, it=it: it.ping(pose)) for name, it in both.items()}
                    times = harness.take_turns(pings, ROUNDS, warm_up=1)
                ms, cheapest_ms = np.median(times["own"]), np.median(times["cheapest"])
        out.append(
            Outcome(
                seed,
                tolerance,
                plan.met,
                error,
                plan.error_estimate,
                body_error,
                plan.worst_body_estimate,
                plan.level,
                cheapest,
                float(ms),
                float(cheapest_ms),
                *doubts(truth),
            )
        )
    return out


@dataclass(frozen=True)
class PoolOutcome:
    """One pool at one tolerance: shares of the whole echo, and multipath relative to the direct echo."""

    seed: int
    tolerance: float
    multipath: float
    error: float
    error_estimate: float


def try_pool(seed: int, tolerances=(0.05, 0.01)) -> list[PoolOutcome]:
    """Return the outcomes of the first ping in one pool; none if there is no multipath."""
    scene, sonar, pose, acoustics = random_pool(seed)
    pings = []
    for tolerance in tolerances:
        with sg.Simulator(scene, sonar, acoustics, tolerance=tolerance) as simulator:
            pings.append(simulator.ping(pose))
    finest = max((sg.Sampling(**ping.meta["sampling"]) for ping in pings), key=lambda one: one.count(sonar))
    finer = min(3.0, (MOST_SAMPLES / finest.count(sonar)) ** 0.5)
    many = sg.Sampling(finer * finest.columns_per_beam, round(finer * finest.rows))
    with sg.Simulator(scene, sonar, acoustics, many) as simulator:
        truth = internals.ping_with_all_samples(simulator, pose)
    with sg.Simulator(scene, sonar, replace(acoustics, multipath="none"), many) as simulator:
        direct = float(simulator.ping(pose).intensity.sum(dtype=float))
    multipath = float(truth.intensity.sum(dtype=float)) / max(direct, 1e-30) - 1
    return [
        PoolOutcome(seed, tolerance, multipath, ping_error(ping, truth), ping.error_estimate)
        for tolerance, ping in zip(tolerances, pings if multipath > 1e-3 else (), strict=False)
    ]


def report_pools(outcomes: list[PoolOutcome]):
    """Print the table of pools."""
    rows = []
    for tolerance in sorted({o.tolerance for o in outcomes}, reverse=True):
        mine = [o for o in outcomes if o.tolerance == tolerance]
        met = [o for o in mine if o.error_estimate <= tolerance]
        rows.append(
            {
                "tolerance": f"{tolerance:g}",
                "pools": len(mine),
                "multipath/direct, median": f"{np.median([o.multipath for o in mine]):.2f}",
                "kept": sum(o.error <= tolerance for o in mine),
                "met": len(met),
                "of those kept": sum(o.error <= tolerance for o in met),
                "estimate/error, median": f"{np.median([o.error_estimate / o.error for o in mine]):.2f}",
                "broken by": [(o.seed, round(o.error / tolerance, 2)) for o in met if o.error > tolerance],
            }
        )
    harness.print_table(rows, indent=0)


def report(outcomes):
    """Print the table."""
    rows = []
    for tolerance in sorted({o.tolerance for o in outcomes}, reverse=True):
        mine = [o for o in outcomes if o.tolerance == tolerance]
        met = [o for o in mine if o.met]
        known = [o for o in mine if o.cheapest_level is not None]
        time = np.median([o.ms / o.cheapest_ms for o in known])
        samples = np.median([2.0 ** ((o.level - o.cheapest_level) / 2) for o in known])
        estimate = np.median([o.error_estimate / o.error for o in mine])
        broken = [
            (o.seed, round(max(o.error / tolerance, o.worst_body / tolerance / 5), 2))
            for o in mine
            if not (o.kept or o.is_open)
        ]
        rows.append(
            {
                "tolerance": f"{tolerance:g}",
                "worlds": len(mine),
                "kept": sum(o.kept for o in mine),
                "met": len(met),
                "of those kept": sum(o.kept for o in met),
                "open": sum(o.is_open for o in mine),
                "cost: time": f"{time:.2f}",
                "samples": f"{samples:.2f}",
                "estimate/error, median": f"{estimate:.2f}",
                "broken by": broken,
            }
        )
    harness.print_table(rows, indent=0)


def main():
    """Try worlds from the first seed on."""
    parser = argparse.ArgumentParser(prog="python -m tools.promise", description=__doc__.partition("\n")[0])
    parser.add_argument("--worlds", type=int, default=100, help="how many with an echo")
    parser.add_argument("--pools", type=int, help="how many with multipath, in place of worlds")
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    parser.add_argument("--alone", action="store_true", help="have each ping choose its samples alone")
    options = parser.parse_args()
    if options.pools and options.alone:
        parser.error("--alone is of worlds, not of --pools")
    try_one = try_pool if options.pools else try_alone if options.alone else try_world
    outcomes, seed, first = [], options.first, options.first
    with warnings.catch_warnings(), contextlib.suppress(KeyboardInterrupt):  # Ctrl-C prints the table so far
        warnings.simplefilter("ignore", UserWarning)
        while len({o.seed for o in outcomes}) < (options.pools or options.worlds):
            outcomes += try_one(seed)
            seed += 1
            if sys.stderr.isatty():
                print(f"\r{seed - first} worlds", end="", file=sys.stderr)
    with sg.Simulator(sg.Scene([]), random_world(0)[1]) as simulator:
        print(f"seeds {first} to {seed - 1}, on {simulator.gl_info['renderer']}")
    report_pools(outcomes) if options.pools else report(outcomes)
    if options.alone:
        total, of_plans = (sum(getattr(o, name) for o in outcomes) for name in ("ms", "cheapest_ms"))
        print(f"all pings alone over all planned pings: {total / of_plans:.2f} times the time")


if __name__ == "__main__":
    main()
