"""The sampling error model, and the choice of the cheapest samples that keep a tolerance as the sonar moves.

A ping is compared with one of half the samples. The difference of the two decreases as the error does, and
ERROR_FACTOR times the difference nearly always exceeds the error. The relative error of a small body's echo is
modelled as BODY_ERROR_FACTOR / n^0.75 for n samples, the law of stratified sampling in two dimensions. It is larger
where samples are few, and at least the difference of that body's echo between the two pings.
These constants, and the rates at which errors decrease, were fitted to random worlds (`tools/promise.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.warn import warn_caller
from sonar_gl.engine.flow import PingSetup, ReceivedPing, Resolution
from sonar_gl.engine.stage import StageCache
from sonar_gl.engine.visibility import BodyExtents, count_bodies, is_unobstructed
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.sampling import (
    ERROR_RATE,
    FINEST_LEVEL,
    LEVELS_PER_HALF,
    WORST_BODY,
    Sampling,
    ToleranceWarning,
    check_tolerance,
    half_of,
    sampling_at,
    typical_level,
)
from sonar_gl.sonar.sector import SHEAR
from sonar_gl.sonar.sonar import Sonar

ERROR_FACTOR = 1.0  # of the difference between a ping and one of half the samples
BODY_ERROR_FACTOR, BODY_ERROR_RATE = 1.8, 0.75
MIN_ECHO_SHARE = 5e-4  # of the total: bodies that return less are neglected; half of what is promised
MIN_BODY_SAMPLES = 8  # with fewer, the echo of a body is taken as unknown
DIFFERENCE_FACTOR = 0.7  # of the difference between two lattices in a body's own echo
# With more samples on a body, whole samples at the ends of range and aperture dominate that difference.
MAX_COMPARED_SAMPLES = 300
MAX_STEPS = 8  # at a time: estimates from very few samples are rough
MAX_POSES = 24  # of a sequence are tried

CHECK_EVERY = 24  # pings: a check costs about one and a half
CHECK_MOVE, CHECK_CHANGE = 0.05, 0.2  # of range_max_m; of the whole echo
CHECK_TURN_DEG = 30.0  # or a quarter of the field of view, or half the aperture in elevation


@dataclass(frozen=True)
class Plan:
    """The samples that were chosen for a tolerance.

    Attributes
    ----------
    sampling : Sampling
    level : sampling level
    error_estimate : the error stays below, in 95 of 100 cases
    worst_body_estimate : the relative error of any body's own echo likewise
    worst_body : number of that body, 0 for none
    met : whether the tolerance is met
    """

    sampling: Sampling
    level: int
    error_estimate: float
    worst_body_estimate: float
    worst_body: int
    met: bool


class LastCheck(NamedTuple):
    """When the error was estimated last, and of what.

    Attributes
    ----------
    pose, state : of that ping
    total : the sum of its echo
    number : how many pings had been noticed by then
    """

    pose: np.ndarray
    state: SceneState
    total: float
    number: int


class Judgement(NamedTuple):
    """A sampling level in a ping.

    Attributes
    ----------
    plan : Plan of this level
    steps : by how many levels finer (or coarser, if negative) would do
    check : LastCheck, if the plan is followed
    """

    plan: Plan
    steps: int
    check: LastCheck


@dataclass(frozen=True, eq=False)
class Choice:
    """The samples that are followed, and why. It is replaced as a whole: an interrupt leaves the old or the new one.

    Attributes
    ----------
    resolution : of the last ping, or of the first to come
    level : its sampling level
    plan : the Plan behind it; None before the first ping
    check : the LastCheck; None before the first ping
    planned_poses : bytes of the poses for which the samples are fixed; None while they are chosen ping by ping
    """

    resolution: Resolution
    level: int
    plan: Plan | None = None
    check: LastCheck | None = None
    planned_poses: frozenset[bytes] | None = None


class Sampler(Protocol):
    """What chooses the samples of pings.

    Attributes
    ----------
    choice : all that changes from ping to ping, to be put back where a plan is broken off
    resolution : of the last ping, or of the first to come
    tolerance : that it keeps, or None
    """

    choice: object
    resolution: Resolution
    tolerance: float | None

    def resolution_for(self, setup: PingSetup, check: bool = False) -> Resolution:
        """Return the samples of a ping; `check` has their error estimated even if that is not due."""

    def review(self, received: ReceivedPing) -> Resolution | None:
        """Return the samples to draw the ping with once more, or None if it is good."""

    def notice(self, setup: PingSetup) -> bool:
        """Take note of a ping to come; return whether its error is to be estimated."""

    def has_changed(self, total: float) -> bool:
        """Return whether something came into view, or left, by the sum of the echo."""

    def fix(self, setups: Sequence[PingSetup]) -> Plan | None:
        """Choose samples for all of some pings, and stay with them."""

    def error_estimate(self, pose) -> float | None:
        """Return the estimated error of a ping from `pose`."""


class FixedSampling:
    """Samples that were given: nothing to choose, nothing promised. A `Sampler`."""

    tolerance = choice = None

    def __init__(self, stages: StageCache, sampling: Sampling):
        self.resolution = Resolution(stages.stage(sampling))

    def resolution_for(self, setup: PingSetup, check: bool = False) -> Resolution:
        """Return the samples."""
        return self.resolution

    def review(self, received: ReceivedPing) -> None:
        """Return None: there are no others."""

    def notice(self, setup: PingSetup) -> bool:
        """Return False."""
        return False

    def has_changed(self, total: float) -> bool:
        """Return False."""
        return False

    def fix(self, setups: Sequence[PingSetup]) -> None:
        """Return None: the samples are fixed."""

    def error_estimate(self, pose) -> None:
        """Return None: there is no estimate."""


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
    """

    def __init__(self, stages: StageCache, tolerance: float, gain: np.ndarray):
        self.tolerance = check_tolerance(tolerance)
        self._stages, self._sonar = stages, stages.sonar
        self._gain, self._specular = gain, stages.acoustics.specular
        self._true_range_sonar = stages.acoustics.true_range_sonar(self._sonar)
        self._extents = BodyExtents(self._bodies, self._specular)
        self._reach_rad = stages.acoustics.receive_support_rad(self._sonar)
        self._finest = FINEST_LEVEL
        self._guess = min(typical_level(self.tolerance), self._finest)
        self._trigger, self._n_noticed, self._has_warned = ReplanTrigger(self._sonar), 0, False
        self.choice = Choice(self._resolution_at(self._guess), self._guess)

    @property
    def resolution(self) -> Resolution:
        """The resolution of the last ping, or of the first to come."""
        return self.choice.resolution

    @property
    def plan(self) -> Plan | None:
        """The Plan that it follows, None before the first ping."""
        return self.choice.plan

    @property
    def _bodies(self) -> list:
        return self._stages.buffers.meshes.bodies

    def _resolution_at(self, level: int) -> Resolution:
        return Resolution(self._stages.stage(sampling_at(self._sonar, level)))

    def resolution_for(self, setup: PingSetup, check: bool = False) -> Resolution:
        """Return samples that keep the tolerance."""
        check = self.notice(setup) or check
        if check and self.plan is None:
            self.choice = self._search(setup, self.choice.level)
            self._warn_if_unmet()
            return self.resolution
        return replace(self.resolution, check=check)

    def review(self, received: ReceivedPing) -> Resolution | None:
        """Return finer or coarser samples, if these were found to be wrong."""
        drawn = received.drawn
        resolution, level = drawn.resolution, self.choice.level
        if resolution.is_final:
            return None
        if not resolution.check:  # a check needs samples that know their bodies
            return replace(resolution, check=True) if self.has_changed(received.direct.total) else None
        judged = self._judge(drawn.setup, level, received)
        choice, again = replace(self.choice, plan=judged.plan, check=judged.check), None
        if (judged.steps > 0 and level < self._finest) or judged.steps <= -LEVELS_PER_HALF:
            choice = self._search(drawn.setup, level)
            again = replace(choice.resolution, is_final=True)
        self.choice = choice
        self._warn_if_unmet()
        return again

    def has_changed(self, total: float) -> bool:
        """Return whether something came into view, or left, since the last check, by the sum of the echo."""
        if self.choice.planned_poses is not None:
            return False
        before = 0.0 if self.choice.check is None else self.choice.check.total
        return abs(total - before) > CHECK_CHANGE * before

    def fix(self, setups: Sequence[PingSetup]) -> Plan:
        """Choose for all of some pings, for MAX_POSES of many, and stay with it."""
        picked = np.unique(np.linspace(0, len(setups) - 1, MAX_POSES).round().astype(int))
        # each as if it came first: the order does not count
        plans = [self._search(setups[k], self._guess).plan for k in picked]
        level = max(plan.level for plan in plans)
        finest = [plan for plan in plans if plan.level == level]
        plan = replace(
            max(finest, key=lambda plan: plan.worst_body_estimate),
            error_estimate=max(plan.error_estimate for plan in finest),
            met=all(plan.met for plan in plans),
        )
        poses = frozenset(setup.request.pose.tobytes() for setup in setups)
        self.choice = Choice(self._resolution_at(level), level, plan, planned_poses=poses)
        self._warn_if_unmet()
        return plan

    def error_estimate(self, pose) -> float | None:
        """Return the estimated error of a ping from `pose`; None where samples were fixed for other poses."""
        planned = self.choice.planned_poses
        return None if planned is not None and pose.tobytes() not in planned else self.plan.error_estimate

    def notice(self, setup: PingSetup) -> bool:
        """Take note of a ping to come; return whether its error is to be estimated."""
        if self.choice.planned_poses is not None:
            return False
        self._n_noticed += 1
        check = self.choice.check
        return check is None or self._trigger.is_due(
            check, setup.request.pose, setup.state, self._n_noticed - check.number
        )

    def _search(self, setup: PingSetup, level: int) -> Choice:
        """Find the coarsest level that keeps the tolerance in this ping; begin with `level`."""
        failed, kept, found = -1, self._finest + 1, {}
        while level not in found:
            try:
                found[level] = judged = self._judge(setup, level)
            except SampleLimitError:
                if level == 0:
                    raise
                self._finest = level - 1
                kept = min(kept, level)
                level = max(level - 1, failed)
                continue
            steps = judged.steps
            if steps > 0:
                failed = max(failed, level)
            else:
                kept = min(kept, level)
            if -2 < steps <= 0:  # another try would gain nothing
                break
            level = min(max(level + steps, failed + 1), kept - 1)
            if level <= failed:
                level = min(kept, self._finest)
        chosen = Choice(self._resolution_at(level), level, found[level].plan, judged.check)
        self._stages.drop_large()
        return chosen

    def _judge(self, setup: PingSetup, level: int, received: ReceivedPing | None = None) -> Judgement:
        """Estimate the error of a level in a ping.

        received : the ping with samples of that level and the numbers of bodies, if it is there already
        """
        sampling, state, pose = sampling_at(self._sonar, level), setup.state, setup.request.pose
        # in the mirror image of the lattice a rod that runs along its rows does not
        fine, coarse = self._stages.stage(sampling), self._stages.stage(half_of(sampling), -SHEAR)
        bodies = self._bodies
        if self._extents.n_bodies < len(bodies):  # some were added
            self._extents = BodyExtents(bodies, self._specular)
        if received is None:
            (view,) = fine.draw([pose], [state], with_bodies=True)
            intensity = fine.beamformer.sum_view(view, setup.gain).intensity
        else:
            view, intensity = received.drawn.view, received.direct.intensity
        counted = len(bodies), self._true_range_sonar, self._gain, fine.beamformer.elevation_table
        hits, echo = count_bodies(view.sectors, *counted)
        (other_view,) = coarse.draw([pose], [state], with_bodies=True)
        other_intensity = coarse.beamformer.sum_view(other_view, setup.gain).intensity
        difference = np.abs(intensity - other_intensity).sum(dtype=np.float64)
        _, other_echo = count_bodies(other_view.sectors, *counted)
        whole, total = float(intensity.sum(dtype=np.float64)), echo.sum()
        error = ERROR_FACTOR * float(difference / whole) if whole > 0 else 0.0
        steps = math.log2(max(error, 1e-9) / self.tolerance) * LEVELS_PER_HALF / ERROR_RATE
        if whole <= 0:
            steps = 0.0  # nothing to judge by, and coarser samples would tell no more
        # A body's own echo: by the samples that met it, and by how the two lattices differ. The echo of a body that
        # few met is not known: it counts if it could be strong, unless it is hidden.
        angle = self._extents.solid_angle(state, pose, self._true_range_sonar, self._reach_rad)
        strength = angle * self._extents.reflectivity
        counts = echo > MIN_ECHO_SHARE * total
        for body in np.flatnonzero(
            ~counts & (hits < MIN_BODY_SAMPLES) & (strength * self._gain.max() > MIN_ECHO_SHARE * total)
        ):
            one = bodies[body - 1], state.poses[body - 1]
            counts[body] = is_unobstructed(view.sectors, *one, pose, self._true_range_sonar)
        apart = np.where(
            hits < MAX_COMPARED_SAMPLES,
            DIFFERENCE_FACTOR * np.abs(echo - other_echo) / np.maximum(echo, 1e-30),
            0.0,
        )
        errors = np.maximum(_body_error(np.maximum(hits, 1.0)), np.minimum(apart, 1.0)) * counts
        worst = int(errors.argmax())
        if counts.any():
            finer = (errors[worst] / (WORST_BODY * self.tolerance)) ** (1 / BODY_ERROR_RATE)
            steps = max(steps, LEVELS_PER_HALF / 2 * math.log2(finer))
        steps = min(math.ceil(steps), MAX_STEPS)
        worst_error = float(errors[worst])
        plan = Plan(sampling, level, error, worst_error, worst if counts.any() else 0, steps <= 0)
        return Judgement(plan, steps, LastCheck(pose, state, whole, self._n_noticed))

    def _warn_if_unmet(self) -> None:
        """Warn of a tolerance that cannot be kept, once until it can."""
        plan, has_warned = self.plan, self._has_warned
        self._has_warned = not plan.met
        if plan.met or has_warned:
            return
        columns = plan.sampling.columns_per_beam * self._sonar.n_beams
        name = f" ({self._bodies[plan.worst_body - 1].name!r})" if plan.worst_body else ""
        warn_caller(
            f"tolerance {self.tolerance:g} cannot be met here: with the most samples that fit, "
            f"{columns:.0f} x {plan.sampling.rows}, the estimate is {plan.error_estimate:.2g}, and "
            f"{plan.worst_body_estimate:.2g} for the worst body{name}; go nearer, narrow the fan, or ask "
            "for a larger tolerance",
            ToleranceWarning,
        )


def _body_error(hits):
    """Return the relative error of a body's echo by its samples: few may all lie along a thin body, or beside it."""
    return BODY_ERROR_FACTOR * (1 + MIN_BODY_SAMPLES / hits) / hits**BODY_ERROR_RATE


class ReplanTrigger:
    """Decides when to estimate the error again: sonar or bodies have moved since the last check."""

    def __init__(self, sonar: Sonar):
        self._far_m = CHECK_MOVE * sonar.range_max_m
        turn_deg = min(CHECK_TURN_DEG, sonar.azimuth_fov_deg / 4, sonar.elevation_fov_deg / 2)
        self._far_rad = math.radians(turn_deg)

    def is_due(self, last: LastCheck, pose, state: SceneState, n_pings: int) -> bool:
        """Return whether sonar or bodies have moved far since the last check, or a little for `n_pings`, long."""
        moved, turned = _motion(last.pose[None], pose[None])
        if state is not last.state:
            before = last.state
            if len(state.present) != len(before.present) or (state.present != before.present).any():
                return True
            bodies_moved, bodies_turned = _motion(before.poses, state.poses)
            moved, turned = max(moved, bodies_moved), max(turned, bodies_turned)
        if moved <= 0.0 and turned < 1e-6:
            return False
        return n_pings >= CHECK_EVERY or moved > self._far_m or turned > self._far_rad


def _motion(before, after) -> tuple[float, float]:
    """Return by how much at most some (n, 4, 4) poses have moved, metres, and turned, radians."""
    if not len(before):
        return 0.0, 0.0
    apart = after[:, :3, 3] - before[:, :3, 3]
    moved = math.sqrt(float((apart * apart).sum(axis=1).max()))
    turned = float((before[:, :3, :3] * after[:, :3, :3]).sum(axis=(1, 2)).min())
    return moved, math.acos(min(1.0, max(-1.0, (turned - 1) / 2)))
