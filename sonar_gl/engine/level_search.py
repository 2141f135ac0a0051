"""The sampling level that one ping needs, or some pings, by what they see alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sonar_gl.core.errors import SampleLimitError
from sonar_gl.engine.error_model import ErrorModel, TriedView
from sonar_gl.engine.flow import PingSetup, Plan
from sonar_gl.engine.stage import Coverage, StageCache
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.sampling import FINEST_LEVEL, level_of, typical_level

MAX_POSES = 24  # of a sequence are tried
# A ping alone is first tried with as many samples, or what most pings need for the tolerance if that is more: so many
# take less time than the rest of a ping, which another try would repeat.
FIRST_SAMPLES = 1 << 14
# Finer by at most so many levels at once, four times the samples: estimates from few samples are rough. What is tried
# on the way costs a third of the last try.
MOST_STEPS_ALONE = 4
# times the samples of the try before, which are too much alike otherwise: columns are whole fractions of a beam, so
# that a level may have the very samples of the one below
LEAST_FINER = 1.3


class ChosenView(NamedTuple):
    """A view whose samples were chosen from it alone.

    tried : TriedView, the last one that was tried
    plan : Plan
    """

    tried: TriedView
    plan: Plan


class FoundLevel(NamedTuple):
    """The coarsest sampling level that keeps the tolerance in a ping.

    plan : Plan of that level
    total : the sum of the ping's echo
    coverage : Coverage
    finest : the finest level that is known to fit there
    """

    plan: Plan
    total: float
    coverage: Coverage
    finest: int


def evenly_picked(things: Sequence, most: int) -> list:
    """Return at most so many of some things, evenly apart, the first and the last among them.

    >>> evenly_picked(range(10), 4)
    [0, 3, 6, 9]
    """
    return [things[k] for k in np.unique(np.linspace(0, len(things) - 1, most).round().astype(int))]


class LevelSearch:
    """Tries sampling levels in a ping. What it finds depends on no other ping.

    stages : StageCache
    tolerance : as for `Simulator`
    gain : (K,) of the sonar's bins

    model : ErrorModel, which judges what was tried
    usual : the level that most pings need
    finest : the finest level that there is. Fewer may fit, by how much of the fan bodies fill
    """

    def __init__(self, stages: StageCache, tolerance: float, gain: np.ndarray):
        self.model, self._stages = ErrorModel(stages, tolerance, gain), stages
        self.finest = FINEST_LEVEL
        self.usual = min(typical_level(self.model.tolerance), self.finest)
        self._first_alone = max(self.usual, level_of(stages.sonar, FIRST_SAMPLES))

    def choose(self, setup: PingSetup, further: Sequence[SceneState] = ()) -> ChosenView:
        """Try finer samples until they keep the tolerance; the last that were tried are those of the ping.

        So that level is not always the coarsest one that does.

        Raises SampleLimitError if the coarsest samples do not fit.

        further : states of which views are drawn along
        """
        chosen = self._try_finer(setup, further)
        self._stages.settle(chosen.plan.n_samples)
        return chosen

    def _try_finer(self, setup: PingSetup, further: Sequence[SceneState]) -> ChosenView:
        """Return the first view whose samples keep the tolerance, or that with the most samples that fit."""
        level, finest, before = self._first_alone, self.finest, None
        while True:
            level = min(level, finest)
            try:
                tried = self.model.draw(setup, level, further=further, for_labels=setup.request.labels)
                judged = self.model.judge(setup, level, tried, before)
            except SampleLimitError:
                if level == 0:
                    raise
                finest, before = level - 1, None
                continue
            if judged.steps <= 0 or level == finest:
                return ChosenView(tried, judged.plan)
            fewest = LEAST_FINER * self._count(level)
            level = min(level + min(judged.steps, MOST_STEPS_ALONE), finest)
            while level < finest and self._count(level) < fewest:
                level += 1
            before = tried if self._count(level) >= fewest else None

    def _count(self, level: int) -> float:
        return self.model.sampling_at(level).count(self._stages.sonar)

    def find_coarsest(self, setup: PingSetup, first: int, finest: int | None = None) -> FoundLevel:
        """Find the coarsest level that keeps the tolerance in a ping, or the finest that fits.

        Raises SampleLimitError if the coarsest samples do not fit.

        first : level to begin with
        finest : the finest level to try; None for all
        """
        finest = self.finest if finest is None else finest
        level = min(first, finest)
        # the level lies above the one that failed; the other limit has kept the tolerance, or does not fit
        failed, kept = -1, finest + 1
        found = {}
        while level not in found:
            try:
                tried = self.model.draw(setup, level)
                coverage = tried.coverage  # while the samples are valid
                judged = self.model.judge(setup, level, tried)
            except SampleLimitError:
                if level == 0:
                    raise
                finest = level - 1
                kept = min(kept, level)
                level -= 1
                continue
            # not of the last level that is tried, which may be coarser
            found[level], steps = (judged.plan, tried.echo.total, coverage), judged.steps
            if steps > 0:
                failed = max(failed, level)
            else:
                kept = min(kept, level)
            if steps == 0:
                break
            level = min(max(level + steps, failed + 1), kept - 1)
            if level <= failed:
                level = min(kept, finest)
        self._stages.drop_large()
        return FoundLevel(*found[level], finest)

    def find_for_all(self, setups: Sequence[PingSetup]) -> Plan:
        """Find the coarsest level that keeps the tolerance in all of some pings, of many in MAX_POSES.

        Their order does not count.
        """
        picked = evenly_picked(setups, MAX_POSES)
        plans = [self.find_coarsest(setup, self.usual).plan for setup in picked]
        while not self._fit(picked, plans, level := max(plan.level for plan in plans)):
            plans = [
                self.find_coarsest(setup, level - 1, level - 1).plan if plan.level == level else plan
                for setup, plan in zip(picked, plans, strict=True)
            ]
        finest = [plan for plan in plans if plan.level == level]
        return replace(
            max(finest, key=lambda plan: plan.worst_body_estimate),
            error_estimate=max(plan.error_estimate for plan in finest),
            met=all(plan.met for plan in plans),
        )

    def _fit(self, setups: Sequence[PingSetup], plans: Sequence[Plan], level: int) -> bool:
        """Return whether the samples of a level fit in pings whose plans may have coarser ones.

        As bodies fill more of the fan, fewer fit.
        """
        stage = self.model.stage_at(level)
        sectors = stage.fan.sectors
        if (
            sum(one.columns for one in sectors) * max(one.rows for one in sectors)
            <= self._stages.most_samples
        ):
            return True
        try:
            for setup, plan in zip(setups, plans, strict=True):
                if plan.level < level:
                    stage.draw([setup.head_pose], [setup.state], with_bodies=True)
        except SampleLimitError:
            return False
        return True
