"""Count how often `tolerance` is met in random worlds, and what that costs.

    python -m tools.promise                         # 100 worlds, some twenty minutes
    python -m tools.promise --worlds 20 --first 500
    python -m tools.promise --worlds 20 --alone     # samples chosen from each ping alone, as in batches
    python -m tools.promise --lone 20               # of a sphere, a pile, a capsule or an ellipsoid in open water
    python -m tools.promise --smooth 20             # of a small smooth body with a specular lobe on a floor
    python -m tools.promise --pools 20              # of the sum of direct and multipath echoes

A world (`tests/support/worlds.py`) is a scene, a sonar and a pose by a seed: boxes, cylinders, thin rods,
spheres, tori, floors and hills. Worlds of even seed have profile `ideal`, those of odd seed `physical`. The
promise is kept if the error against `sonar_gl.reference_ping` is within the tolerance, and the error of every
body's own echo within five times it. It is open where the error exceeds that by no more than the truth may be
off, whose rays are limited. The cost is the time of a ping and its samples, over those of the coarsest sampling
level that would have kept the promise, in the same run; of pings alone, over those of a planned ping.

Pools have a calm surface, by which multipath returns up to a hundred times the direct echo. The reference has no
multipath: the truth is a ping of up to nine times as many samples as the finest one that is judged. A pool of which no
finer one fits is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error, worst_body
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.sonar.sampling import WORST_BODY, level_of, sampling_at
from tests.support.worlds import random_lone_body, random_pool, random_smooth_body, random_world
from tools import internals
from tools.bench import harness

TOLERANCES = (0.05, 0.02, 0.01)
POOL_TOLERANCES = (0.05, 0.01)
ROUNDS = 4
TRUTH_ERROR = 0.03
MOST_SAMPLES = 3_500_000  # of the truth of a pool
LEAST_REFLECTED = 0.001  # of the echo: the truth of a pool leaves out no reflector that returns more
MOST_RAYS = 60_000_000  # of a truth; more would change the verdict on the smallest bodies only


class Errors(NamedTuple):
    """Errors of a ping as shares: of its echo, and of the echo of the body that is worst off."""

    echo: float
    worst_body: float

    def are_within(self, tolerance: float) -> bool:
        """Whether the errors are within what the tolerance promises."""
        return self.echo <= tolerance and self.worst_body <= WORST_BODY * tolerance


class Cost(NamedTuple):
    """Sampling level and time of a ping, and those of another one that it is compared with."""

    level: int
    ms: float
    other_level: int
    other_ms: float


@dataclass(frozen=True)
class Outcome:
    """One world at one tolerance.

    Attributes
    ----------
    met : the ping claims that the promise is kept
    error_estimate : that of the ping, or of its plan
    errors : against the truth
    uncertainty : how far off the truth may be
    cost : None if it is not known
    """

    seed: int
    tolerance: float
    met: bool
    error_estimate: float
    errors: Errors
    uncertainty: Errors
    cost: Cost | None = None

    @property
    def kept(self) -> bool:
        """Whether the promise is kept."""
        return self.errors.are_within(self.tolerance)

    @property
    def is_open(self) -> bool:
        """Whether it is not kept by so little that the truth may be what errs."""
        least = Errors(
            *(error - uncertainty for error, uncertainty in zip(self.errors, self.uncertainty, strict=True))
        )
        return not self.kept and least.are_within(self.tolerance)


class World:
    """A random world and the truth about a ping in it.

    Attributes
    ----------
    seed, sonar, pose
    truth : Ping of the reference
    uncertainty : Errors, how far off the truth may be: its halves differ by twice that
    """

    def __init__(self, seed: int, truth_error: float = TRUTH_ERROR, make=random_world):
        self.seed, (self._scene, self.sonar, self.pose) = seed, make(seed)
        self._acoustics = sg.Acoustics.physical() if seed % 2 else sg.Acoustics("ideal", specular=True)
        what = self._scene, self.sonar, self.pose, self._acoustics
        self.truth = sg.reference_ping(*what, truth_error, MOST_RAYS)
        self.uncertainty = Errors(self.truth.meta["difference"] / 2, self.truth.meta["body_difference"] / 2)
        self._errors_at = {}

    def simulator(self, **samples) -> sg.Simulator:
        """Return a simulator of the world; samples : `tolerance` or `sampling` of it."""
        return sg.Simulator(self._scene, self.sonar, self._acoustics, **samples)

    def errors(self, ping: sg.Ping) -> Errors:
        """Return the errors of a ping with labels."""
        return Errors(ping_error(ping, self.truth), worst_body(ping, self.truth)[0])

    def errors_at(self, level: int) -> Errors:
        """Return the errors of a ping at a sampling level."""
        if level not in self._errors_at:
            with self.simulator(sampling=sampling_at(self.sonar, level)) as simulator:
                self._errors_at[level] = self.errors(simulator.ping(self.pose, labels=True))
        return self._errors_at[level]


def median_ms(*makers: Callable[[], sg.Ping]) -> list[float]:
    """Return the time of each of several pings, made in turns."""
    times = harness.take_turns(
        {number: lambda _, make=make: make() for number, make in enumerate(makers)}, ROUNDS, warm_up=1
    )
    return [float(np.median(one)) for one in times.values()]


@contextlib.contextmanager
def planned(world: World, tolerance: float):
    """Yield a simulator whose samples are those of a plan for the world's pose, and the plan."""
    with world.simulator(tolerance=tolerance) as simulator:
        simulator.ping(world.pose)
        yield simulator, simulator.plan([world.pose])


def try_plan(world: World, tolerance: float) -> Outcome:
    """Return the outcome of a planned ping, without its cost."""
    with planned(world, tolerance) as (simulator, plan):
        errors = world.errors(simulator.ping(world.pose, labels=True))
    return Outcome(world.seed, tolerance, plan.met, plan.error_estimate, errors, world.uncertainty)


def try_plan_and_cost(world: World, tolerance: float) -> Outcome:
    """Return what `try_plan` does, with the cost beside that of the coarsest level that would keep the promise."""
    outcome = try_plan(world, tolerance)
    with planned(world, tolerance) as (simulator, plan):
        enough = (level for level in range(plan.level + 1) if world.errors_at(level).are_within(tolerance))
        if (cheapest := next(enough, None)) is None:
            return outcome
        with world.simulator(sampling=sampling_at(world.sonar, cheapest)) as other:
            own_ms, other_ms = median_ms(lambda: simulator.ping(world.pose), lambda: other.ping(world.pose))
    return replace(outcome, cost=Cost(plan.level, own_ms, cheapest, other_ms))


def try_alone(world: World, tolerance: float) -> Outcome:
    """Return the outcome of a ping that chooses its samples alone, whose cost is beside that of a planned one."""
    with world.simulator(tolerance=tolerance) as alone, world.simulator(tolerance=tolerance) as planned:
        plan = planned.plan([world.pose])
        ping = internals.ping_alone(alone, world.pose, labels=True)
        own_ms, other_ms = median_ms(
            lambda: internals.ping_alone(alone, world.pose), lambda: planned.ping(world.pose)
        )
    level = level_of(world.sonar, sg.Sampling(**ping.meta["sampling"]).count(world.sonar))
    cost = Cost(level, own_ms, plan.level, other_ms)
    estimate = ping.error_estimate
    return Outcome(
        world.seed, tolerance, estimate <= tolerance, estimate, world.errors(ping), world.uncertainty, cost
    )


def try_tolerances(
    world: World, try_ping: Callable[[World, float], Outcome], tolerances=TOLERANCES
) -> list[Outcome]:
    """Return the outcomes of one world; none if it returns no echo."""
    return [try_ping(world, tolerance) for tolerance in tolerances] if world.truth.intensity.any() else []


@dataclass(frozen=True)
class PoolOutcome:
    """One pool at one tolerance: shares of the whole echo, and multipath relative to the direct echo."""

    seed: int
    tolerance: float
    multipath: float
    error: float
    error_estimate: float


def find_truth(what: tuple, pose: np.ndarray, finest: sg.Sampling) -> tuple[sg.Ping, sg.Ping] | None:
    """Return a ping of more samples than the finest one that is judged, and its direct echo; None if no such one fits.

    what : scene, sonar and acoustics
    """
    scene, sonar, acoustics = what
    finer = min(3.0, (MOST_SAMPLES / finest.count(sonar)) ** 0.5)
    while finer > 1:
        many = sg.Sampling(finer * finest.columns_per_beam, round(finer * finest.rows))
        finer /= 2**0.5
        truthful = scene, sonar, acoustics, many, LEAST_REFLECTED
        with contextlib.suppress(SampleLimitError), sg.Simulator(*truthful) as simulator:
            truth = internals.ping_with_all_samples(simulator, pose)
            without = replace(acoustics, multipath="none")
            with sg.Simulator(simulator, sonar, without, many) as direct:
                return truth, direct.ping(pose)
    return None


def try_pool(seed: int) -> list[PoolOutcome] | None:
    """Return the outcomes of the first ping in one pool; none if there is no multipath; None without a truth."""
    scene, sonar, pose, acoustics = random_pool(seed)
    pings = []
    for tolerance in POOL_TOLERANCES:
        with sg.Simulator(scene, sonar, acoustics, tolerance=tolerance) as simulator:
            pings.append(simulator.ping(pose))
    finest = max((sg.Sampling(**ping.meta["sampling"]) for ping in pings), key=lambda one: one.count(sonar))
    if (found := find_truth((scene, sonar, acoustics), pose, finest)) is None:
        return None
    truth, direct = found
    whole, part = (float(ping.intensity.sum(dtype=float)) for ping in (truth, direct))
    multipath = whole / max(part, 1e-30) - 1
    return [
        PoolOutcome(seed, tolerance, multipath, ping_error(ping, truth), ping.error_estimate)
        for tolerance, ping in zip(POOL_TOLERANCES, pings if multipath > 1e-3 else (), strict=False)
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
        costs = [o.cost for o in mine if o.cost is not None]
        time = np.median([cost.ms / cost.other_ms for cost in costs])
        samples = np.median([2.0 ** ((cost.level - cost.other_level) / 2) for cost in costs])
        estimate = np.median([o.error_estimate / o.errors.echo for o in mine])
        broken = [
            (o.seed, round(max(o.errors.echo / tolerance, o.errors.worst_body / tolerance / WORST_BODY), 2))
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
    parser.add_argument("--lone", type=int, help="how many with a single round body, in place of worlds")
    parser.add_argument("--smooth", type=int, help="how many with a small smooth body, in place of worlds")
    parser.add_argument("--pools", type=int, help="how many with multipath, in place of worlds")
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    parser.add_argument("--alone", action="store_true", help="have each ping choose its samples alone")
    options = parser.parse_args()
    if options.pools and (options.alone or options.lone or options.smooth):
        parser.error("--alone, --lone and --smooth are of worlds, not of --pools")
    make = random_lone_body if options.lone else random_smooth_body if options.smooth else random_world
    try_ping = try_alone if options.alone else try_plan_and_cost
    outcomes, left_out, seed, first = [], [], options.first, options.first
    with warnings.catch_warnings(), contextlib.suppress(KeyboardInterrupt):  # Ctrl-C prints the table so far
        warnings.simplefilter("ignore", UserWarning)
        while len({o.seed for o in outcomes}) < (
            options.pools or options.lone or options.smooth or options.worlds
        ):
            tried = try_pool(seed) if options.pools else try_tolerances(World(seed, make=make), try_ping)
            outcomes += tried or []
            left_out += [seed] if tried is None else []
            seed += 1
            if sys.stderr.isatty():
                print(f"\r{seed - first} worlds", end="", file=sys.stderr)
    with sg.Simulator(sg.Scene([]), random_world(0)[1]) as simulator:
        print(f"seeds {first} to {seed - 1}, on {simulator.gl_info['renderer']}")
    report_pools(outcomes) if options.pools else report(outcomes)
    if left_out:
        print(
            f"left out, as no truth fits that is finer than what it judges: {len(left_out)}, seeds {left_out}"
        )
    if options.alone:
        total, of_plans = (sum(getattr(o.cost, name) for o in outcomes) for name in ("ms", "other_ms"))
        print(f"all pings alone over all planned pings: {total / of_plans:.2f} times the time")


if __name__ == "__main__":
    main()
