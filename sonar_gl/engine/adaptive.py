"""The choice of the cheapest samples that keep a tolerance: for one ping, for planned poses, or as the sonar moves.

As the sonar moves, no ping may take much longer than those before it: a check of the error costs nearly another ping,
and what it finds changes the samples of later pings, in steps. Until finer samples have been checked, pings carry the
error that the coarser ones had. A ping far from the one before tells nothing of the samples that it needs: they are
chosen from it alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import NamedTuple, Protocol

import numpy as np

from sonar_gl.core.checks import text_beside
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.warn import warn_caller
from sonar_gl.engine.error_model import COARSER, ErrorModel, Plan, TriedView
from sonar_gl.engine.flow import PingSetup, ReceivedPing, Resolution
from sonar_gl.engine.stage import StageCache
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.sampling import (
    LEVELS_PER_HALF,
    WORST_BODY,
    Sampling,
    ToleranceWarning,
    level_of,
    sampling_at,
    typical_level,
)
from sonar_gl.sonar.sonar import Sonar

MAX_POSES = 24  # of a sequence are tried
# A ping alone is first tried with as many samples, or what most pings need for the tolerance if that is more: so many
# take less time than the rest of a ping, which another try would repeat.
FIRST_SAMPLES = 1 << 14
# Finer by at most so many levels at once, four times the samples: estimates from few samples are rough. What is tried
# on the way costs a third of the last try.
MOST_STEPS_ALONE = 4
# A ping by itself that needs so many times fewer samples than those before gives back their memory. Each one could, but
# a ping that needs as much again would take the time to get it anew.
MUCH_FEWER = 4

CHECK_EVERY = 24  # pings: a check costs nearly another one
CHECK_MOVE, CHECK_CHANGE = 0.05, 0.2  # of range_max_m; of the whole echo
CHECK_BRIGHTER = 2.0  # times the reflectivity of a body
CHECK_TURN_DEG = 30.0  # or a quarter of the field of view, or half the aperture in elevation
# A ping may cost so many times the median of so many before it; what takes the time of a ping beside its samples costs
# as much as so many more, also in a check. By the pings of `tools/bench live`.
MOST_COST, RECENT, FIXED_SAMPLES = 2.4, 100, 45_000


class LastCheck(NamedTuple):
    """When the error was estimated last, and of what.

    Attributes
    ----------
    pose, state : of that ping
    total : the sum of its echo
    number : how many pings had been registered by then
    """

    pose: np.ndarray
    state: SceneState
    total: float
    number: int


@dataclass(frozen=True, eq=False)
class Choice:
    """The samples that are followed, and why. It is replaced as a whole: an interrupt leaves the old or the new one.

    Attributes
    ----------
    level : sampling level of the last ping, or of the first to come
    plan : the Plan behind it; None before the first ping
    check : the LastCheck; None before the first ping
    planned : `_view_of` each ping for which the samples are fixed; None while they are chosen ping by ping
    is_due : the error is to be estimated as soon as that costs no more than a ping may
    """

    level: int
    plan: Plan | None = None
    check: LastCheck | None = None
    planned: frozenset[int] | None = None
    is_due: bool = False


class PingHistory(NamedTuple):
    """The pings so far, as the sampler knows them.

    Attributes
    ----------
    number : how many
    pose, state : of the last one; None before the first
    costs : of the last RECENT of them, in samples; empty where the last one is still to choose its samples, alone
    """

    number: int = 0
    pose: np.ndarray | None = None
    state: SceneState | None = None
    costs: tuple[float, ...] = ()


class ChosenView(NamedTuple):
    """A view whose samples were chosen from it alone.

    Attributes
    ----------
    tried : TriedView, the last one that was tried
    plan : Plan
    """

    tried: TriedView
    plan: Plan


class Sampler(Protocol):
    """What chooses the samples of pings.

    Attributes
    ----------
    choice : all that checks and plans change, to be put back where a plan is broken off
    history : all that each ping changes, to be put back where a ping is to be made again
    resolution : of the last ping, or of the first to come
    tolerance : that it keeps, or None
    """

    choice: object
    history: object
    resolution: Resolution
    tolerance: float | None

    def resolution_for(self, setup: PingSetup) -> Resolution:
        """Register a ping, and return its samples."""

    def review(self, received: ReceivedPing) -> Resolution | None:
        """Return the samples to draw the ping with once more, or None if it is good."""

    def coarser(self, error: SampleLimitError) -> Resolution:
        """Return fewer samples for a ping whose samples are more than fit, or raise the error again."""

    def register(self, setup: PingSetup) -> bool:
        """Add a ping to come to the history; return whether its error is to be estimated."""

    def has_changed(self, total: float) -> bool:
        """Return whether something came into view, or left, by the sum of the echo."""

    def fix(self, setups: Sequence[PingSetup]) -> Plan | None:
        """Choose samples for all of some pings, and stay with them."""

    def is_apart(self, setup: PingSetup) -> bool:
        """Return whether the samples of a ping to come are chosen from it alone."""

    def register_apart(self, setup: PingSetup) -> None:
        """Add a ping to the history whose samples are being chosen from it alone, by this sampler or another one."""

    def follow(self, setup: PingSetup, plan: Plan, total: float, number: int) -> None:
        """Have later pings follow samples that were chosen from a ping alone.

        total : the sum of its echo
        number : of the ping in the history, to which it is added if it was not registered
        """

    def error_estimate(self, setup: PingSetup) -> float | None:
        """Return the estimated error of a ping."""


class FixedSampling:
    """Samples that were given: nothing to choose, nothing promised. A `Sampler`."""

    tolerance = choice = history = None

    def __init__(self, stages: StageCache, sampling: Sampling):
        self.resolution = Resolution(stages.stage(sampling))

    def resolution_for(self, setup: PingSetup) -> Resolution:
        """Return the samples."""
        return self.resolution

    def review(self, received: ReceivedPing) -> None:
        """Return None: there are no others."""

    def coarser(self, error: SampleLimitError) -> Resolution:
        """Raise the error."""
        raise error

    def register(self, setup: PingSetup) -> bool:
        """Return False."""
        return False

    def has_changed(self, total: float) -> bool:
        """Return False."""
        return False

    def fix(self, setups: Sequence[PingSetup]) -> None:
        """Return None: the samples are fixed."""

    def is_apart(self, setup: PingSetup) -> bool:
        """Return False."""
        return False

    def error_estimate(self, setup: PingSetup) -> None:
        """Return None: there is no estimate."""


def evenly_picked(things: Sequence, most: int) -> list:
    """Return at most so many of some things, evenly apart, the first and the last among them.

    >>> evenly_picked(range(10), 4)
    [0, 3, 6, 9]
    """
    return [things[k] for k in np.unique(np.linspace(0, len(things) - 1, most).round().astype(int))]


class AdaptiveSampling:
    """Chooses among sampling levels by what they see, and checks again as the sonar moves. A `Sampler`.

    Parameters
    ----------
    stages : StageCache
    tolerance : as for `Simulator`
    gain : (K,) of the sonar's bins

    Attributes
    ----------
    choice : Choice; whoever takes a step of several that may be broken off keeps it, and puts it back
    history : PingHistory
    """

    def __init__(self, stages: StageCache, tolerance: float, gain: np.ndarray):
        self._model, self._stages, self._sonar = ErrorModel(stages, tolerance, gain), stages, stages.sonar
        self.tolerance = self._model.tolerance
        self._guess = min(typical_level(self.tolerance), self._model.finest)
        self._first = max(self._guess, level_of(self._sonar, FIRST_SAMPLES))
        self._trigger, self._has_warned = ReplanTrigger(self._sonar, self._model.greatest_backscatter), False
        self.choice, self.history = Choice(self._guess), PingHistory()
        self._resolution = None, None  # the last level, and its Resolution
        self._room = 0  # samples of the largest recent ping by itself, whose memory is kept

    @property
    def resolution(self) -> Resolution:
        """The resolution of the last ping, or of the first to come."""
        level = self.choice.level
        # not made with each choice: others may follow before a ping has these samples
        if self._resolution[0] != level:
            self._resolution = level, Resolution(self._model.stage_at(level))
        return self._resolution[1]

    @property
    def plan(self) -> Plan | None:
        """The Plan that it follows, None before the first ping."""
        return self.choice.plan

    def resolution_for(self, setup: PingSetup) -> Resolution:
        """Register a ping, and return its samples; those of the first ping keep the tolerance."""
        check = self.register(setup)
        if check and self.plan is None:
            choice = self._search(setup, self.choice.level)
            self._warn_if_unmet(choice.plan)
            self.choice = choice
            return replace(self.resolution, is_final=True)
        return replace(self.resolution, check=check)

    def review(self, received: ReceivedPing) -> Resolution | None:
        """Estimate the error of a ping if that is due; return other samples if it is to be sampled again."""
        drawn, total = received.drawn, received.direct.total
        resolution, level = drawn.resolution, self.choice.level
        if resolution.is_final or not (resolution.check or self.has_changed(total)):
            return None
        is_first = self.choice.check.total <= 0 < total
        if not (resolution.check or is_first or self._can_check()):
            self.choice = self.choice if self.choice.is_due else replace(self.choice, is_due=True)
            return None
        tried = self._model.tried(resolution.stage, drawn.view, received.direct)
        judged = self._model.judge(drawn.setup, level, tried)
        choice = replace(
            self.choice, plan=judged.plan, check=self._check_of(drawn.setup, total), is_due=False
        )
        is_wrong = (
            level < self._model.finest if judged.steps > 0 else level > 0 and judged.steps <= -LEVELS_PER_HALF
        )
        is_searched = is_wrong and is_first
        if is_searched:
            choice = self._search(drawn.setup, level)
        elif is_wrong:
            choice = self._followed(choice, level + judged.steps)
        self.choice = choice
        if not (is_wrong and choice.is_due):
            self._warn_if_unmet(choice.plan)
        # a search has drawn other samples over those of this ping, of which image sources may still be in need
        if choice.is_due or (choice.level == level and not is_searched):
            return None
        return replace(self.resolution, is_final=True)

    def _followed(self, choice: Choice, level: int) -> Choice:
        """Return a choice of finer or coarser samples for the next pings, which are to be checked.

        Finer by steps that can be checked at once; where a ping may not cost as much, without a check for now. The
        estimate remains that of the last check: above the tolerance, if it asked for finer samples.
        """
        wanted, most = max(0, min(level, self._model.finest)), self._most_cost()
        finer = [n for n in range(choice.level + 1, wanted + 1) if self._cost(n) <= most]
        checkable = [n for n in finer if self._cost(n, check=True) <= most]
        level = (checkable or finer or [min(wanted, choice.level)])[-1]
        if level < choice.level:
            self._model.forget_limit()
            self._stages.drop_large()
        # made by this ping: the next one, if it is checked, has to make the coarser stage
        self._model.stage_at(level)
        return replace(choice, level=level, is_due=True)

    def _cost(self, level: int, check: bool = False) -> float:
        """Return about what a ping costs, with a check of its error or without, in samples of the whole fan."""
        stage = self.resolution.stage
        per_count = stage.fan.n_samples / stage.sampling.count(self._sonar)
        n_samples = per_count * sampling_at(self._sonar, level).count(self._sonar)
        cost = n_samples + FIXED_SAMPLES
        return cost + n_samples / COARSER + FIXED_SAMPLES if check else cost

    def _most_cost(self) -> float:
        return MOST_COST * median(self.history.costs)

    def _can_check(self) -> bool:
        """Return whether a ping with a check costs no more than a ping may."""
        return self._cost(self.choice.level, check=True) <= self._most_cost()

    def coarser(self, error: SampleLimitError) -> Resolution:
        """Return samples of the next coarser level: those of a ping were more than fit."""
        level = self.choice.level - 1
        if level < 0 or self.choice.planned is not None:
            raise error
        self._model.finest = level
        self.choice = replace(self.choice, level=level, is_due=True)
        return replace(self.resolution, check=True)

    def has_changed(self, total: float) -> bool:
        """Return whether something came into view, or left, since the last check, by the sum of the echo."""
        if self.choice.planned is not None:
            return False
        before = 0.0 if self.choice.check is None else self.choice.check.total
        return abs(total - before) > CHECK_CHANGE * before

    def fix(self, setups: Sequence[PingSetup]) -> Plan:
        """Choose for all of some pings, for MAX_POSES of many, and stay with it."""
        # each as if it came first: the order does not count
        plans = [self._search(setup, self._guess).plan for setup in evenly_picked(setups, MAX_POSES)]
        level = max(plan.level for plan in plans)
        finest = [plan for plan in plans if plan.level == level]
        plan = replace(
            max(finest, key=lambda plan: plan.worst_body_estimate),
            error_estimate=max(plan.error_estimate for plan in finest),
            met=all(plan.met for plan in plans),
        )
        planned = frozenset(map(_view_of, setups))
        self.choice = Choice(level, plan, planned=planned)
        self._warn_if_unmet(plan)
        return plan

    def error_estimate(self, setup: PingSetup) -> float | None:
        """Return the estimated error of a ping; None where samples were fixed for other poses, bodies or water."""
        planned = self.choice.planned
        return None if planned is not None and _view_of(setup) not in planned else self.plan.bound

    def register(self, setup: PingSetup) -> bool:
        """Add a ping to come to the history; return whether its error is to be estimated."""
        if self.choice.planned is not None:
            return False
        pose, state, before, check = setup.head_pose, setup.state, self.history, self.choice.check
        cost, number = self._cost(self.choice.level), before.number + 1
        self.history = PingHistory(number, pose, state, (*before.costs[1 - RECENT :], cost))
        # the first one, or one that follows a ping that is still to choose
        if check is None or not before.costs:
            return True
        is_due = self.choice.is_due or self._trigger.is_due(check, pose, state, number - check.number)
        return is_due and self._can_check()

    def is_apart(self, setup: PingSetup) -> bool:
        """Return whether a ping asks to be sampled by itself, or lies far from the last one."""
        if setup.request.alone:
            return True
        is_first, is_planned = self.choice.check is None, self.choice.planned is not None
        if is_first or is_planned:
            return False
        return self._trigger.is_far(self.history, setup.head_pose, setup.state)

    def choose(self, setup: PingSetup, further: Sequence[SceneState] = ()) -> ChosenView:
        """Try finer samples until they keep the tolerance; the last that were tried are those of the ping.

        The choice depends on this ping alone.

        Parameters
        ----------
        further : states of which views are drawn along
        """
        tried, plan = self._try_alone(setup, further)
        if MUCH_FEWER * plan.n_samples < self._room:
            self._stages.drop_large()
            self._room = 0
        self._room = max(self._room, plan.n_samples)
        return ChosenView(tried, plan)

    def _try_alone(self, setup: PingSetup, further: Sequence[SceneState]) -> ChosenView:
        """Return the first view whose samples keep the tolerance, or that with the most samples that fit."""
        level, model, before = self._first, self._model, None
        limit = model.finest
        try:
            model.forget_limit()
            while True:
                level = min(level, model.finest)
                try:
                    tried = model.draw(setup, level, further=further, for_labels=setup.request.labels)
                    judged = model.judge(setup, level, tried, before)
                except SampleLimitError:
                    if level == 0:
                        raise
                    model.finest, before = level - 1, None
                    continue
                if judged.steps <= 0 or level == model.finest:
                    return ChosenView(tried, judged.plan)
                level, before = level + min(judged.steps, MOST_STEPS_ALONE), tried
        except BaseException:
            model.finest = limit  # of where the pings before were made
            raise

    def register_apart(self, setup: PingSetup) -> None:
        """Add a ping to the history whose samples are being chosen from it alone."""
        self.history = PingHistory(self.history.number + 1, setup.head_pose, setup.state)

    def follow(self, setup: PingSetup, plan: Plan, total: float, number: int) -> None:
        """Warn if samples that were chosen from a ping alone do not suffice; then have later pings follow them."""
        self._warn_if_unmet(plan)
        if setup.request.alone:
            return
        pose, state, model = setup.head_pose, setup.state, self._model
        choice, history = Choice(plan.level, plan, LastCheck(pose, state, total, number)), self.history
        if number >= history.number:  # else later ones were registered meanwhile
            costs = (float(plan.n_samples + FIXED_SAMPLES),)  # another place has other costs
            history = PingHistory(number, pose, state, costs)
        model.forget_limit()
        if not plan.met:
            model.finest = plan.level
        # in one step: a ping near the one before this, after an interrupt between, would follow this choice
        self.choice, self.history = choice, history

    def _check_of(self, setup: PingSetup, total: float) -> LastCheck:
        return LastCheck(setup.head_pose, setup.state, total, self.history.number)

    def _search(self, setup: PingSetup, level: int) -> Choice:
        """Find the coarsest level that keeps the tolerance in this ping; begin with `level`."""
        model = self._model
        model.forget_limit()
        failed, kept, found, total = -1, model.finest + 1, {}, 0.0
        level = min(level, model.finest)
        while level not in found:
            try:
                tried = model.draw(setup, level)
                found[level] = judged = model.judge(setup, level, tried)
            except SampleLimitError:
                if level == 0:
                    raise
                model.finest = level - 1
                kept = min(kept, level)
                level = max(level - 1, failed)
                continue
            total, steps = tried.echo.total, judged.steps
            if steps > 0:
                failed = max(failed, level)
            else:
                kept = min(kept, level)
            if -2 < steps <= 0:  # another try would gain nothing
                break
            level = min(max(level + steps, failed + 1), kept - 1)
            if level <= failed:
                level = min(kept, model.finest)
        chosen = Choice(level, found[level].plan, self._check_of(setup, total))
        self._stages.drop_large()
        return chosen

    def _warn_if_unmet(self, plan: Plan) -> None:
        """Warn of a tolerance that cannot be kept, once until it can.

        Before samples are chosen for good: where warnings are errors, each such ping raises one, also when it is tried
        again.
        """
        if plan.met or self._has_warned:
            self._has_warned = not plan.met
            return
        columns = plan.sampling.columns_per_beam * self._sonar.n_beams
        name = f" ({self._model.bodies[plan.worst_body - 1].name!r})" if plan.worst_body else ""
        body_bound = WORST_BODY * self.tolerance
        warn_caller(
            f"tolerance {self.tolerance:g} cannot be met here: with the most samples that fit, "
            f"{columns:.0f} x {plan.sampling.rows}, the estimate is "
            f"{text_beside(plan.error_estimate, self.tolerance)}, and "
            f"{text_beside(plan.worst_body_estimate, body_bound)} for the worst body{name}; go nearer, narrow the "
            "fan, or ask for a larger tolerance",
            ToleranceWarning,
        )
        self._has_warned = True


class ReplanTrigger:
    """Decides when to estimate the error again: sonar or bodies have moved, or bodies changed, since the last check.

    Parameters
    ----------
    sonar : Sonar
    backscatter : function of a state to the most that each body returns in it
    """

    def __init__(self, sonar: Sonar, backscatter: Callable[[SceneState], np.ndarray]):
        self._backscatter = backscatter
        self._far_m = CHECK_MOVE * sonar.range_max_m
        turn_deg = min(CHECK_TURN_DEG, sonar.azimuth_fov_deg / 4, sonar.elevation_fov_deg / 2)
        self._far_rad = math.radians(turn_deg)

    def is_due(self, last: LastCheck, pose, state: SceneState, n_pings: int) -> bool:
        """Return whether sonar or bodies have changed much since the last check, or a little for `n_pings`, long."""
        moved, turned, brighter = self._change_since(last, pose, state)
        if moved <= 0.0 and turned < 1e-6 and brighter == 1.0:
            return False
        return self._is_much(moved, turned, brighter) or n_pings >= CHECK_EVERY

    def is_far(self, last: LastCheck | PingHistory, pose, state: SceneState) -> bool:
        """Return whether sonar or bodies have changed much since some ping, or bodies came or went."""
        return self._is_much(*self._change_since(last, pose, state))

    def _is_much(self, moved: float, turned: float, brighter: float) -> bool:
        return moved > self._far_m or turned > self._far_rad or brighter > CHECK_BRIGHTER

    def _brighter(self, before: SceneState, after: SceneState) -> float:
        """Return by how many times at most a body returns more, or less, than in another state with the same bodies."""
        if after.reflectivity is before.reflectivity:
            return 1.0
        own, other = (self._backscatter(state)[after.present] for state in (before, after))
        high, low = np.maximum(own, other), np.minimum(own, other)
        return float(np.where(high > low, high / np.maximum(low, 1e-12), 1.0).max(initial=1.0))

    def _change_since(self, last: LastCheck | PingHistory, pose, state: SceneState) -> tuple[float, ...]:
        """Return by how much sonar or bodies have moved and turned since some ping, and become brighter or darker.

        Infinite if bodies came or went.
        """
        moved, turned = _motion_of_one(last.pose, pose)
        before = last.state
        if state is not before:
            if len(state.present) != len(before.present) or (state.present != before.present).any():
                return math.inf, math.inf, math.inf
            bodies_moved, bodies_turned = _motion(before.poses, state.poses)
            moved, turned = max(moved, bodies_moved), max(turned, bodies_turned)
        return moved, turned, self._brighter(before, state)


def _view_of(setup: PingSetup) -> int:
    """Return a hash of what determines the echo of a ping: where all is, and how much it and the water return."""
    state = setup.state
    arrays = setup.head_pose, state.present, state.poses, state.reflectivity, state.bubbles, setup.gain
    # plus 0, since -0.0 has other bytes
    return hash(tuple(None if one is None else (one + 0).tobytes() for one in arrays))


def _motion(before, after) -> tuple[float, float]:
    """Return by how much at most some (n, 4, 4) poses have moved, metres, and turned, radians."""
    if not len(before):
        return 0.0, 0.0
    apart = after[:, :3, 3] - before[:, :3, 3]
    moved = math.sqrt(float((apart * apart).sum(axis=1).max()))
    return moved, _angle_of((before[:, :3, :3] * after[:, :3, :3]).sum(axis=(1, 2)).min())


def _motion_of_one(before, after) -> tuple[float, float]:
    """Return the same of one (4, 4) pose, without NumPy, whose calls take longer: each ping does this a few times."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = before.tolist()
    (p, q, r, u), (j, k, m, v), (n, o, s, w), _ = after.tolist()
    trace = a * p + b * q + c * r + d * j + e * k + f * m + g * n + h * o + i * s
    return math.dist((x, y, z), (u, v, w)), _angle_of(trace)


def _angle_of(trace: float) -> float:
    """Return the angle of the rotation that leads from one matrix to another; `trace` : the sum of their products."""
    return math.acos(min(1.0, max(-1.0, (float(trace) - 1) / 2)))
