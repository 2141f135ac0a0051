"""Samples that keep a tolerance as the sonar moves, while no ping takes much longer than those before it.

A check of the error costs nearly another ping, and what it finds changes the samples of later pings, in steps. Until
finer samples have been checked, pings carry the error that the coarser ones had. A ping far from the one before tells
nothing of the samples that it needs: they are chosen from it alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.beamform.beamformer import BeamEcho
from sonar_gl.core.checks import text_beside
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.warn import warn_caller
from sonar_gl.engine.error_model import BegunJudgement, Judgement
from sonar_gl.engine.flow import DrawnPing, PingSetup, Plan, ReceivedPing, Resolution
from sonar_gl.engine.level_search import LevelSearch
from sonar_gl.engine.replan_trigger import ReplanTrigger, have_come_or_gone
from sonar_gl.engine.stage import WHOLE, Coverage, StageCache
from sonar_gl.sonar.sampling import ERROR_RATE, LEVELS_PER_HALF, WORST_BODY, ToleranceWarning
from sonar_gl.sonar.sonar import Sonar

CHECK_CHANGE = 0.2  # of the whole echo
# A ping takes the time of the share of its samples that its Coverage states, of FACE for each face, of PIECE for each
# piece in which faces are summed, about the geometric mean of faces and samples, of FILTERED_BIN for each bin of each
# beam (BARE_BIN without a matched filter), more by COVERED_BIN of that where the share is whole, and of FIXED_SAMPLES.
# By views of the scenes and loops of `tools/bench live` at many levels, BARE_BIN with profile `ideal`.
FIXED_SAMPLES, FACE, PIECE = 10_000, 0.5, 2.0
FILTERED_BIN, BARE_BIN, COVERED_BIN = 0.23, 0.046, 4.3
# With a check of its error a ping takes CHECK_COST times as long. In a loop two pings may share a check: the first one
# draws the view to compare with, the second one sums it. Each takes about PART_COST times as long.
CHECK_COST, PART_COST = 2.1, 1.6
# No ping may cost more than MOST_COST times the usual one of the RECENT ones up to it, because of a check or since its
# view has filled. From MOST_FULL_COST times on, those after it have fewer samples. Finer ones are as many as can be
# checked at once. Nor may a ping have more than MOST_MORE times as many samples as the one before, two levels, unless
# it has fewer than FEW_SAMPLES: where few of many meet a body, they cost little, but their memory does not.
MOST_COST, MOST_FULL_COST, RECENT = 2.3, 1.8, 100
MOST_FINER_COST = MOST_COST / PART_COST
MOST_MORE, FEW_SAMPLES = 2.1, 50_000
DRAWN = 0.6  # of what the samples and faces of a ping cost, before they are summed
# Before finer samples are drawn their memory is used for the first time, of no more samples at a time than this times
# the usual cost. That of a sample, with its share of the view that it is compared with, takes about as long as two to
# seven samples that met a body: pages that the host of a virtual machine has to provide, too, take the longest. So much
# of FEW_SAMPLES takes next to no time.
MOST_NEW = 0.1
LIKE_COST = 0.1  # share by which a ping may cost more or less than was expected
# So many pings with echo, each near the one before, are a loop that must not stall. Fewer are those of a program that
# looks at bodies now and then, or has others in each ping; or of a loop that has just begun.
LOOP_PINGS = 10


class LastCheck(NamedTuple):
    """When the error was estimated last, and of what.

    setup : PingSetup of that ping
    total : the sum of its echo
    n_pings : of the history by then
    """

    setup: PingSetup
    total: float
    n_pings: int


@dataclass(frozen=True, eq=False)
class Choice:
    """The samples that are followed, and why. It is replaced as a whole: an interrupt leaves the old or the new one.

    level : sampling level of the last ping, or of the first to come
    finest : the finest level that is known to fit, where the sonar is
    coverage : of the last ping that was checked, or cost other than expected
    plan : the Plan behind it, by the last check; None before the first ping
    last_check : LastCheck; None before the first ping
    planned : `_view_of` each ping for which the samples are fixed; None while they are chosen ping by ping
    is_due : the error is to be estimated as soon as that costs no more than a ping may
    next_level : level that pings change to once the stages of its samples have been made, and have memory; None for the
        same one
    n_made : how many of these two stages have been made
    share : of their new memory that is ready
    begun : BegunJudgement of the last check, which the next ping concludes; None without one
    """

    level: int
    finest: int
    coverage: Coverage = WHOLE
    plan: Plan | None = None
    last_check: LastCheck | None = None
    planned: frozenset[int] | None = None
    is_due: bool = False
    next_level: int | None = None
    n_made: int = 0
    share: float = 0.0
    begun: BegunJudgement | None = None

    @property
    def is_planned(self) -> bool:
        """Whether the samples are fixed."""
        return self.planned is not None


class PingHistory(NamedTuple):
    """The pings so far, as the sampler knows them.

    n_pings : how many
    last : PingSetup of the last one; None before the first
    costs : of the last RECENT of them with echo, in samples; empty where the last one is still to choose its samples,
        alone
    """

    n_pings: int = 0
    last: PingSetup | None = None
    costs: tuple[float, ...] = ()


class AdaptiveSampling:
    """Chooses among sampling levels by what they see, and checks again as the sonar moves. A `Sampler`.

    stages : StageCache
    tolerance : as for `Simulator`
    gain : (K,) of the sonar's bins

    search : LevelSearch, for a ping by itself
    choice : Choice; whoever takes a step of several that may be broken off keeps it, and puts it back
    history : PingHistory
    """

    def __init__(self, stages: StageCache, tolerance: float, gain: np.ndarray):
        self.search = LevelSearch(stages, tolerance, gain)
        self._model, self._stages, self._sonar = self.search.model, stages, stages.sonar
        self.tolerance = self._model.tolerance
        self._trigger, self._has_warned = ReplanTrigger(self._sonar, self._model.greatest_backscatter), False
        self.choice, self.history = Choice(self.search.usual, self.search.finest), PingHistory()
        self._resolution = None, None  # the last level, and its Resolution

    @property
    def resolution(self) -> Resolution:
        """The resolution of the last ping, or of the first to come."""
        level = self.choice.level
        # not made with each choice: others may follow before a ping has these samples
        if self._resolution[0] != level:
            self._resolution = level, Resolution(self._model.stage_at(level))
        return self._resolution[1]

    @property
    def is_live(self) -> bool:
        """Whether the samples of pings follow those of the pings before: unless they were planned."""
        return not self.choice.is_planned

    @property
    def plan(self) -> Plan | None:
        """The Plan that it follows, None before the first ping."""
        return self.choice.plan

    def resolution_for(self, setup: PingSetup) -> Resolution:
        """Add a ping to the history, and return its samples; those of the first ping keep the tolerance."""
        self.history = self.history_with(setup)
        check = self.is_check_due(self.history)
        if check and self.plan is None:
            return self._search(setup)
        resolution = self.resolution
        if self._is_of_finer():
            finer = replace(self.choice, level=self.plan.level)
            self.choice = replace(self.choice, plan=self._unverified(finer, self.choice.level))
        # memory is given back by a ping that takes no longer for another reason
        is_busy = check or self.choice.begun is not None
        self._stages.settle(resolution.stage.fan.n_samples, may_drop=not is_busy)
        if self.choice.is_due and not is_busy:  # before the check, which would have to make it
            self._model.coarser_stage(resolution.stage)
        return replace(resolution, check=True) if check else resolution

    def review(self, received: ReceivedPing) -> Resolution | None:
        """Estimate the error of a ping if that is due; return other samples if it is to be sampled again.

        It is if its echo is the first one, but for a loop that had others before. Otherwise finer or coarser samples
        are those of the next pings, so that none takes much longer than those before.
        """
        drawn, total, choice = received.drawn, received.direct.total, self.choice
        setup, resolution = drawn.setup, drawn.resolution
        has_changed = self.has_changed(received)
        if resolution.is_final:
            return None
        if choice.begun is not None:
            choice = self._concluded(choice)
            if has_changed:  # since the ping that was checked
                plan = self._unverified(choice, choice.level) if choice.plan.met else choice.plan
                choice = replace(choice, plan=plan, is_due=True)
            self.choice = choice
            return None
        if not (resolution.check or has_changed or choice.next_level is not None):
            return None
        if has_changed and choice.plan.met:
            choice = replace(choice, plan=self._unverified(choice, choice.level))
        costs = self.history.costs
        is_loop = len(costs) >= LOOP_PINGS
        is_first_echo = choice.last_check.total <= 0 < total and not is_loop
        if choice.next_level is not None and not is_first_echo:
            self.choice = self._prepared(choice, drawn)
            return None
        if not (resolution.check or is_first_echo or self._can_check(choice.level, received.coverage, costs)):
            self.choice = choice if choice.is_due else replace(choice, is_due=True)
            return None
        tried = self._model.tried(resolution.stage, drawn.view, received.direct)
        check = LastCheck(setup, total, self.history.n_pings)
        checked = replace(choice, coverage=received.coverage, last_check=check, is_due=False, next_level=None)
        is_costly = CHECK_COST * self._cost(choice.level, received.coverage) > MOST_COST * _usual(costs)
        if is_loop and (is_costly or choice.plan.met):
            # the arrays of the ping change as it is finished
            echo = BeamEcho(received.direct.intensity.copy(), total)
            begun = self._model.begun(setup, choice.level, tried._replace(echo=echo))
            self.choice = replace(checked, begun=begun)
            return None
        judged = self._model.judge(setup, choice.level, tried)
        if is_first_echo and not self._is_kept(choice, judged):
            return self._search(setup)
        self.choice = self._judged(checked, judged)
        return None

    def _concluded(self, choice: Choice) -> Choice:
        """Return a choice after the check that the ping before has begun."""
        begun, choice = choice.begun, replace(choice, begun=None)
        if begun.n_bodies < len(self._model.bodies):  # some were added since
            return replace(choice, is_due=True)
        return self._judged(choice, self._model.concluded(begun))

    def _judged(self, choice: Choice, judged: Judgement) -> Choice:
        """Return a choice after a check; warn if the tolerance cannot be kept."""
        checked = replace(choice, plan=judged.plan)
        if not self._is_kept(choice, judged):
            return self._moved(checked, choice.level + judged.steps)
        self._warn_if_unmet(checked.plan)
        return checked

    def _prepared(self, choice: Choice, drawn: DrawnPing) -> Choice:
        """Return a choice that is a step nearer to its next level.

        A step is one of its two stages, since those of fine samples take as long as a ping, or part of their memory.
        """
        stage = self._model.stage_at(choice.next_level)
        if choice.n_made == 0:
            return replace(choice, n_made=1)
        coarser = self._model.coarser_stage(stage)
        # by samples alone: how fine pings are must not depend on what memory was kept of finer ones
        n_now, n_of_fan = drawn.view.n_samples, drawn.resolution.stage.fan.n_samples
        n_new = n_now * (stage.fan.n_samples / n_of_fan - 1)
        most = MOST_NEW * max(_usual(self.history.costs), FEW_SAMPLES)
        share = choice.share if choice.n_made < 2 else choice.share + most / max(n_new, most)
        is_ready = n_new <= most or share >= 1.0
        for one in (stage, coarser):
            n_samples = math.ceil(n_now * one.fan.n_samples / n_of_fan)
            one.renderer.prepare(n_samples, 1.0 if is_ready else share)
        if is_ready:
            return replace(choice, level=choice.next_level, next_level=None)
        return replace(choice, n_made=2, share=share)

    def _is_kept(self, choice: Choice, judged: Judgement) -> bool:
        """Return whether pings keep their level: finer samples are not needed, or do not fit, or half would not do."""
        if judged.steps > 0:
            return choice.level >= choice.finest
        return choice.level == 0 or judged.steps > -LEVELS_PER_HALF

    def _search(self, setup: PingSetup) -> Resolution:
        """Choose the coarsest level that keeps the tolerance in a ping, and return its samples to draw the ping with.

        Also if the level is that of before: the search has drawn other samples over those of the ping, of which image
        sources may still be in need.
        """
        found = self.search.find_coarsest(setup, self.choice.level)
        check = LastCheck(setup, found.total, self.history.n_pings)
        self._warn_if_unmet(found.plan)
        self.choice = Choice(found.plan.level, found.finest, found.coverage, found.plan, check)
        self.history = self.history._replace(costs=(self._cost(found.plan.level, found.coverage),))
        return replace(self.resolution, is_final=True)

    def _moved(self, choice: Choice, level: int) -> Choice:
        """Return a choice of finer or coarser samples for the next pings, which are to be checked.

        As fine as a ping may cost, also where it may not cost the check for now. The estimate remains that of the last
        check: above the tolerance, if it asked for finer samples.
        """
        wanted, most = max(0, min(level, choice.finest)), MOST_FINER_COST * _usual(self.history.costs)
        room = max(FEW_SAMPLES, MOST_MORE * self._model.sampling_at(choice.level).count(self._sonar))
        finer = [
            n
            for n in range(choice.level + 1, wanted + 1)
            if self._cost(n, choice.coverage) <= most
            and self._model.sampling_at(n).count(self._sonar) <= room
        ]
        # at least the next level, or else a check would ask for the same one again
        level = (finer or [min(choice.level + 1, wanted)])[-1]
        finest = self.search.finest if level < choice.level else choice.finest
        return self._on_its_way(choice, level, finest)

    def _on_its_way(self, choice: Choice, level: int, finest: int) -> Choice:
        """Return a choice whose samples are those of another level as soon as that has been prepared."""
        return replace(choice, next_level=level, n_made=0, share=0.0, finest=finest, is_due=True, begun=None)

    def _cost(self, level: int, coverage: Coverage) -> float:
        """Return about what a ping costs without a check of its error, in samples that met a body."""
        stage = self.resolution.stage
        n_samples = stage.fan.n_samples
        # each ping asks for that of its own level, whose samples the fan has counted
        if level != self.choice.level:
            others = self._model.sampling_at(level)
            n_samples *= others.count(self._sonar) / stage.sampling.count(self._sonar)
        return self._cost_of(n_samples, coverage)

    def _cost_of(self, n_samples: float, coverage: Coverage) -> float:
        return cost_of(self._sonar, self._stages.acoustics, n_samples, coverage)

    def _can_check(self, level: int, coverage: Coverage, costs: Sequence[float]) -> bool:
        """Return whether a ping of a level, whose cost is the last of these, may cost a check of its error, too."""
        return PART_COST * self._cost(level, coverage) <= MOST_COST * _usual(costs)

    def costs_as_expected(self, coverage: Coverage) -> bool:
        """Return whether a ping costs about what was expected: it draws as many faces, and its samples meet as much."""
        choice = self.choice
        if choice.is_planned:
            return True
        expected = self._cost(choice.level, choice.coverage)
        return abs(self._cost(choice.level, coverage) - expected) <= LIKE_COST * expected

    def affordable(self, drawn: DrawnPing) -> Resolution:
        """Return the resolution with which a ping that was drawn is to be received, so that it does not stall a loop.

        Fewer samples, or the same ones without a check, if many more of them met bodies than in the pings before: where
        a sonar sees little, it has fine samples, which cost little until a body comes into view.
        """
        resolution, choice, coverage = drawn.resolution, self.choice, drawn.coverage
        if resolution.is_final or self.costs_as_expected(coverage):
            return resolution
        costs, level = self.history.costs, choice.level
        is_loop, usual, cost = len(costs) >= LOOP_PINGS, _usual(costs), self._cost(level, coverage)
        if is_loop and cost > MOST_COST * usual:
            level = self._coarser_level(coverage, usual)
        later, is_coarser = level, level < choice.level
        if is_loop and not is_coarser and cost > MOST_FULL_COST * usual:
            while later > 0 and self._cost(later, coverage) > MOST_FINER_COST * usual:
                later -= 1
        drops_check = resolution.check and is_loop and not self._can_check(level, coverage, costs)
        self.history = self.history._replace(costs=(*costs[:-1], self._cost(level, coverage)))
        self.choice = changed = replace(choice, level=level, coverage=coverage)
        if is_coarser:
            changed = replace(changed, is_due=True, next_level=None, begun=None)
        elif later < (level if choice.next_level is None else min(level, choice.next_level)):
            changed, drops_check = self._on_its_way(changed, later, choice.finest), resolution.check
        elif drops_check:
            changed = replace(changed, is_due=True)
        if is_coarser or changed.next_level != choice.next_level or (drops_check and choice.plan.met):
            changed = replace(changed, plan=self._unverified(choice, min(level, later)))
        self.choice = changed
        if is_coarser or drops_check:
            return replace(self.resolution, halvings=resolution.halvings, is_final=True)
        return resolution

    def _coarser_level(self, coverage: Coverage, usual: float) -> int:
        """Return the level with which a ping that was drawn is to be drawn once more, or its own if that saves nothing.

        What it took to draw it is spent.
        """
        level = self.choice.level
        whole = self._cost(level, coverage)
        spent = DRAWN * (whole - self._cost_of(0, Coverage(coverage.share, 0)))
        coarser = level
        while coarser > 0 and spent + self._cost(coarser, coverage) > MOST_COST * usual:
            coarser -= 1
        return coarser if spent + self._cost(coarser, coverage) < whole else level

    def _unverified(self, before: Choice, level: int) -> Plan:
        """Return the Plan of the samples that are followed now, after the view has changed, or as they become coarser.

        It is not met until a check says so: as if those of before, or of the next finer level, just kept the tolerance.

        level : that is followed, or will be as soon as it is prepared
        """
        plan, stage = before.plan, self.resolution.stage
        is_checked = plan.raised_for is None
        n_coarser = max(before.level - level, 1) if is_checked else max(plan.raised_for - level, 0)
        coarser = 2.0 ** (ERROR_RATE * n_coarser / LEVELS_PER_HALF)
        return replace(
            plan,
            sampling=stage.sampling,
            level=self.choice.level,
            error_estimate=coarser * max(plan.error_estimate, self.tolerance),
            met=False,
            n_samples=stage.fan.n_samples,
            raised_for=level if is_checked else min(plan.raised_for, level),
        )

    def fewer_samples(self, error: SampleLimitError) -> Resolution:
        """Return samples of the next coarser level: those of a ping were more than fit."""
        level = self.choice.level - 1
        if self.choice.is_planned:
            raise SampleLimitError(
                f"planned samples must fit at each pose, and do not at this one, which the plan did not try: {error}; "
                "or plan for this pose, too, and for no more than twenty poses at a time"
            ) from error
        if level < 0:
            raise error
        before = self.choice
        self.choice = replace(before, level=level, finest=level, is_due=True, next_level=None, begun=None)
        if before.plan is not None:
            self.choice = replace(self.choice, plan=self._unverified(before, level))
        return replace(self.resolution, check=True)

    def has_changed(self, received: ReceivedPing) -> bool:
        """Return whether bodies came or went since the last check, or the view changed, by the sum of the echo."""
        checked, total = self.choice.last_check, received.direct.total
        if self.choice.is_planned:
            return False
        if checked is None:
            return total > 0
        if have_come_or_gone(checked.setup.state, received.drawn.setup.state):
            return True
        return abs(total - checked.total) > CHECK_CHANGE * checked.total

    def fix(self, setups: Sequence[PingSetup]) -> Plan:
        """Choose for all of some pings, as `LevelSearch.find_for_all`, and stay with it."""
        plan, planned = self.search.find_for_all(setups), frozenset(map(_view_of, setups))
        self.choice = Choice(plan.level, self.search.finest, plan=plan, planned=planned)
        self._warn_if_unmet(plan)
        return plan

    def error_estimate(self, setup: PingSetup) -> float | None:
        """Return the estimated error of a ping; None where samples were fixed for other poses, bodies or water."""
        choice = self.choice
        return None if choice.is_planned and _view_of(setup) not in choice.planned else choice.plan.bound

    def history_with(self, setup: PingSetup) -> PingHistory:
        """Return the history with a ping to come, which has the samples of those before; planned ones are not in it."""
        before = self.history
        if self.choice.is_planned:
            return before
        choice = self.choice
        return PingHistory(before.n_pings + 1, setup, self._costs_with(choice.level, choice.coverage))

    def _costs_with(self, level: int, coverage: Coverage) -> tuple[float, ...]:
        """Return the costs of the last pings with echo and of one to come, with the samples of a level.

        While there is no echo, a ping takes a small part of the time of one with as many samples on bodies.
        """
        costs, checked = self.history.costs, self.choice.last_check
        if len(costs) > 1 and checked is not None and checked.total <= 0:
            return costs
        return *costs[1 - RECENT :], self._cost(level, coverage)

    def is_deciding(self, history: PingHistory) -> bool:
        """Return whether the last ping of a history may change the samples of those after it, whatever it sees."""
        choice = self.choice
        is_under_way = choice.next_level is not None or choice.begun is not None
        return is_under_way or self._is_of_finer() or self.is_check_due(history)

    def _is_of_finer(self) -> bool:
        """Return whether the last check was one of finer samples than those that are followed."""
        return self.plan is not None and self.plan.level > self.choice.level

    def is_check_due(self, history: PingHistory) -> bool:
        """Return whether the error of the last ping of a history is to be estimated."""
        choice, checked = self.choice, self.choice.last_check
        if choice.is_planned or choice.next_level is not None or choice.begun is not None:
            return False
        # the first one, or one that follows a ping that is still to choose
        if checked is None or len(history.costs) == 1:
            return True
        n_pings = history.n_pings - checked.n_pings
        is_due = choice.is_due or self._trigger.is_due(checked.setup, history.last, n_pings)
        return is_due and self._can_check(choice.level, choice.coverage, history.costs)

    def is_apart(self, setup: PingSetup) -> bool:
        """Return whether a ping asks to be sampled by itself, or has little in common with the last one.

        It lies far from it, or bodies came or went, but for a loop that they would stall.
        """
        if setup.request.alone:
            return True
        if self.choice.last_check is None:  # as of the first ping, and of planned samples
            return False
        history = self.history
        if len(history.costs) < LOOP_PINGS and have_come_or_gone(history.last.state, setup.state):
            return True
        return self._trigger.is_far(history.last, setup)

    def history_with_apart(self, setup: PingSetup) -> PingHistory:
        """Return the history with a ping to come whose samples are being chosen from it alone."""
        return PingHistory(self.history.n_pings + 1, setup)

    def follow(self, setup: PingSetup, plan: Plan, total: float, coverage: Coverage, n_pings: int) -> None:
        """Warn if samples that were chosen from a ping alone do not suffice; then have later pings follow them.

        total : the sum of its echo
        n_pings : of the history that ends with it
        """
        self._warn_if_unmet(plan)
        if setup.request.alone:
            return
        finest = self.search.finest if plan.met else plan.level
        choice = Choice(plan.level, finest, coverage, plan, LastCheck(setup, total, n_pings))
        history = self.history
        if n_pings >= history.n_pings:  # else later ones were added meanwhile
            # another place has other costs
            costs = (self._cost_of(plan.n_samples, coverage),)
            history = PingHistory(n_pings, setup, costs)
        # in one step: a ping near the one before this, after an interrupt between, would follow this choice
        self.choice, self.history = choice, history

    def _warn_if_unmet(self, plan: Plan) -> None:
        """Warn of a tolerance that cannot be kept, once until it can.

        Before samples are chosen for good: where warnings are errors, each such ping raises one, also when it is tried
        again.
        """
        if plan.met or self._has_warned:
            self._has_warned = not plan.met
            return
        columns = plan.sampling.columns_per_beam * self._sonar.n_beams
        name, more, body_bound = "", "", WORST_BODY * self.tolerance
        if plan.worst_body:
            body = self._model.bodies[plan.worst_body - 1]
            name = f" ({body.name!r})"
            if body.specular and self._stages.acoustics.specular and plan.worst_body_estimate > body_bound:
                more = ", or give that body a rough material"  # its glint needs most of the samples
        warn_caller(
            f"tolerance {self.tolerance:g} cannot be met here: with the most samples that fit, "
            f"{columns:.0f} x {plan.sampling.rows}, the estimate is "
            f"{text_beside(plan.error_estimate, self.tolerance)}, and "
            f"{text_beside(plan.worst_body_estimate, body_bound)} for the worst body{name}; go nearer, narrow the "
            f"fan, or ask for a larger tolerance{more}",
            ToleranceWarning,
        )
        self._has_warned = True


def cost_of(sonar: Sonar, acoustics: Acoustics, n_samples: float, coverage: Coverage) -> float:
    """Return about what a ping costs, in samples that met a body."""
    of_bins = (FILTERED_BIN if acoustics.pulse else BARE_BIN) * sonar.n_beams * sonar.n_bins
    n_counted, n_faces = n_samples * coverage.share, coverage.n_faces
    of_view = n_counted + FACE * n_faces + PIECE * math.sqrt(n_counted * n_faces)
    return FIXED_SAMPLES + of_bins * (1 + COVERED_BIN * coverage.share) + of_view


def _usual(costs: Sequence[float]) -> float:
    """Return what pings usually cost: a little less than the median, which lags where half of them cost more."""
    return sorted(costs)[9 * len(costs) // 20]


def _view_of(setup: PingSetup) -> int:
    """Return a hash of what determines the echo of a ping: where all is, and how much it and the water return."""
    # plus 0, since -0.0 has other bytes
    return hash(((setup.head_pose + 0).tobytes(), setup.state.echo_hash, setup.gain.tobytes()))
