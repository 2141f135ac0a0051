"""The promise of a tolerance: the cheapest samples that keep it, here and as the sonar moves.

A ping is compared with one of half the samples. The difference of the two falls as the error does, and ERROR
times it is more than the error, nearly always. A small body's own echo is known as well as it has samples,
LUCK / samples^0.75, the law of stratified sampling in two dimensions, worse where they are few, and no better
than the two agree on it.
These constants, and the rates at which errors fall, are those of random worlds (`tools/promise.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sonar_gl.census import Extent, census, in_plain_sight
from sonar_gl.fan import Sampling, half_of
from sonar_gl.ladder import ERROR_RATE, FINEST_RUNG, STEPS_PER_HALF, check_tolerance, guess_of, sampling_of
from sonar_gl.lattice import SHEAR
from sonar_gl.passes import Passes
from sonar_gl.types import Error
from sonar_gl.watch import Watch

ERROR = 1.0
LUCK, LUCK_RATE = 1.8, 0.75
WORST_BODY = 5.0  # times the tolerance, of a body's own echo
COUNTS = 5e-4  # of the echo: bodies that return less are let go; half of what is promised
FEW = 8  # samples on a body, below which its echo is held to be unknown
APART = 0.7  # of the difference that two lattices make to a body's own echo
SOME = 300  # samples on a body: of more, whole ones at the ends of range and aperture spoil the difference
MOST_STEPS = 8  # at a time: estimates from very few samples are rough
POSES = 24  # of a sequence are tried


@dataclass(frozen=True)
class Plan:
    """What was chosen for a tolerance.

    Attributes
    ----------
    sampling : Sampling
    rung : on the ladder of samplings
    error_estimate : the error stays below, in 95 of 100 cases
    worst_body_estimate : the relative error of any body's own echo likewise
    worst_body : number of that body, 0 for none
    met : whether the tolerance is met
    """

    sampling: Sampling
    rung: int
    error_estimate: float
    worst_body_estimate: float
    worst_body: int
    met: bool


def _luck(hits):
    """Of a body's own echo by its samples: few may all lie along a thin thing, or beside it."""
    return LUCK * (1 + FEW / hits) / hits**LUCK_RATE


class Planner:
    """Chooses among samplings by what they see, and looks again as the sonar moves.

    Parameters
    ----------
    passes : Passes
    tolerance : as for `Simulator`

    Attributes
    ----------
    now : the Pass that made the last ping, or will make the next
    plan : the Plan that it follows, None before the first ping
    warning : None, or a sentence that the user has not been told yet
    """

    def __init__(self, passes: Passes, tolerance: float):
        self.tolerance = check_tolerance(tolerance)
        self.passes, self.sonar, self.stock = passes, passes.sonar, passes.gpu.stock
        self.drawn, self.specular = passes.drawn, passes.acoustics.specular
        self.extent = Extent(self.stock.bodies, self.specular)
        self.reach_rad = passes.acoustics.beam_reach_rad(self.sonar)
        self.finest = FINEST_RUNG
        self._guess = min(guess_of(self.tolerance), self.finest)
        self.rung = self._guess
        self.now = passes.of(sampling_of(self.sonar, self.rung))
        self.plan = self.warning = None
        self._fixed, self._told, self._planned = False, False, set()
        self._watch = Watch(self.sonar)

    def sense(self, pose, labels: bool, where=None, look: bool = False):
        """(views, intensity) of a ping, with samples that keep the tolerance.

        Parameters
        ----------
        where : Whereabouts of the bodies, None for where they are by themselves
        look : at what the samples are worth, due or not
        """
        look = self.due(pose, where) or look
        if look and self.plan is None:
            self._choose(pose, where)
            look = False
        views = self.now.views(pose, labels or look, where=where)
        intensity = self.now.intensity(views)
        if not look and self.changed(self.now.reducer.total):
            look, views = True, self.now.views(pose, labels=True, where=where)
        if look:
            self.plan, steps = self._judge(pose, where, self.rung, (views, intensity))
            if (steps > 0 and self.rung < self.finest) or steps <= -STEPS_PER_HALF:
                self._choose(pose, where)
                views = self.now.views(pose, labels, where=where)
                intensity = self.now.intensity(views)
        self._tell()
        return views, intensity

    def changed(self, whole: float) -> bool:
        """Whether something came into view, or left, since the last look, by the whole echo."""
        return not self._fixed and self._watch.changed(whole)

    def fix(self, spots) -> Plan:
        """Choose for all of some (pose, Whereabouts), for POSES of many, and stay with it."""
        picked = np.unique(np.linspace(0, len(spots) - 1, POSES).round().astype(int))
        plans, guess = [], self._guess
        for k in picked:
            self.rung = guess  # each as if it came first: the order does not count
            plans.append(self._choose(*spots[k]))
        self.rung, self._fixed = max(plan.rung for plan in plans), True
        finest = [plan for plan in plans if plan.rung == self.rung]
        self.plan = replace(
            max(finest, key=lambda plan: plan.worst_body_estimate),
            error_estimate=max(plan.error_estimate for plan in finest),
            met=all(plan.met for plan in plans),
        )
        self.now, self._planned = self.passes.of(self.plan.sampling), {pose.tobytes() for pose, _ in spots}
        self._tell()
        return self.plan

    def estimate(self, pose) -> float | None:
        """Of the error of a ping from `pose`; None where the samples were fixed for other poses."""
        return None if self._fixed and pose.tobytes() not in self._planned else self.plan.error_estimate

    def due(self, pose, where=None) -> bool:
        """Whether to look at a ping from `pose`."""
        return not self._fixed and (self._watch.due(pose, where or self.stock.where) or self.plan is None)

    def _choose(self, pose, where) -> Plan:
        """The coarsest rung that keeps the tolerance at `pose`, or the finest there is."""
        failed, kept, rung, found = -1, self.finest + 1, self.rung, {}
        while rung not in found:
            try:
                found[rung], steps = self._judge(pose, where, rung)
            except Error:  # beyond the driver's limits
                if rung == 0:
                    raise
                self.finest = rung - 1
                kept = min(kept, rung)
                rung = max(rung - 1, failed)
                continue
            if steps > 0:
                failed = max(failed, rung)
            else:
                kept = min(kept, rung)
            if -2 < steps <= 0:  # nothing to be gained by another look
                break
            rung = min(max(rung + steps, failed + 1), kept - 1)
            if rung <= failed:
                rung = min(kept, self.finest)
        self.plan, self.rung = found[rung], rung
        self.now = self.passes.of(self.plan.sampling)
        return self.plan

    def _judge(self, pose, where, rung: int, made=None) -> tuple[Plan, int]:
        """What a rung is worth at `pose`, and how many steps finer (or coarser, if negative) would do.

        made : (views, intensity) with labels, if they are there already
        """
        sampling, where = sampling_of(self.sonar, rung), where or self.stock.where
        # in the mirror image of the lattice a rod that runs along its rows does not
        fine, coarse = self.passes.of(sampling), self.passes.of(half_of(sampling), -SHEAR)
        if len(self.extent.radii) < len(self.stock.bodies):  # some were added
            self.extent = Extent(self.stock.bodies, self.specular)
        if made is None:
            views = fine.views(pose, labels=True, where=where)
            made = views, fine.intensity(views)
        views, intensity = made
        counted = len(self.stock.bodies), self.drawn, fine.gain, fine.reducer.elevation
        hits, echo = census(views, *counted)
        views = coarse.views(pose, labels=True, where=where)
        difference = np.abs(intensity - coarse.intensity(views)).sum(dtype=np.float64)
        _, other = census(views, *counted)
        whole, total = float(intensity.sum(dtype=np.float64)), echo.sum()
        self._watch.looked(pose, where, whole)
        error = ERROR * float(difference / whole) if whole > 0 else 0.0
        steps = math.log2(max(error, 1e-9) / self.tolerance) * STEPS_PER_HALF / ERROR_RATE

        if whole <= 0:
            steps = 0.0  # nothing to judge by, and none the wiser for coarser samples
        # A body's own echo: by the samples that met it, and by what the two lattices make of it. Of one that
        # few met the echo is not known: it counts if it could be strong, unless it is hidden.
        strength = self.extent.solid_angle(where, pose, self.drawn, self.reach_rad) * self.extent.reflectivity
        heard = echo > COUNTS * total
        for body in np.flatnonzero(~heard & (hits < FEW) & (strength * fine.gain.max() > COUNTS * total)):
            one = self.stock.bodies[body - 1], where.poses[body - 1]
            heard[body] = in_plain_sight(made[0], *one, pose, self.drawn)
        apart = np.where(hits < SOME, APART * np.abs(echo - other) / np.maximum(echo, 1e-30), 0.0)
        luck = np.maximum(_luck(np.maximum(hits, 1.0)), np.minimum(apart, 1.0)) * heard
        worst = int(luck.argmax())
        if heard.any():
            finer = (luck[worst] / (WORST_BODY * self.tolerance)) ** (1 / LUCK_RATE)
            steps = max(steps, STEPS_PER_HALF / 2 * math.log2(finer))
        steps = min(math.ceil(steps), MOST_STEPS)
        return Plan(sampling, rung, error, float(luck[worst]), worst if heard.any() else 0, steps <= 0), steps

    def _tell(self):
        """Have the user warned of a tolerance that cannot be kept, once until it can."""
        plan = self.plan
        if not plan.met and not self._told:
            columns = plan.sampling.columns_per_beam * self.sonar.n_beams
            name = f" ({self.stock.bodies[plan.worst_body - 1].name!r})" if plan.worst_body else ""
            self.warning = (
                f"tolerance {self.tolerance:g} cannot be met here: with the most samples that fit, "
                f"{columns:.0f} x {plan.sampling.rows}, the estimate is {plan.error_estimate:.2g}, and "
                f"{plan.worst_body_estimate:.2g} for the worst body{name}; go nearer, narrow the fan, or ask "
                "for a larger tolerance"
            )
        self._told = not plan.met
