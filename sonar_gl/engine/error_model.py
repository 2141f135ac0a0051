"""The sampling error model: what error the samples of a ping leave, and how many more or fewer would do.

A ping is compared with one of COARSER times fewer samples. The difference of the two decreases as the error does, and
ERROR_FACTOR times the error that it shows exceeds 19 of 20 errors. The relative error of a small body's echo is
modelled by its samples (`body_error`), and is at least what the difference of that body's echo between the two pings
shows. What the fan's strips take of a body beyond the echo of its samples may err alike in both pings: it is added. The
constants, and the rates at which errors decrease, were fitted to random worlds (`tools/promise.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.beamformer import BeamEcho
from sonar_gl.beamform.labels import BodySums
from sonar_gl.engine.body_counts import (
    BODY_ERROR_RATE,
    MIN_BODY_SAMPLES,
    BodyCounts,
    body_error,
    count_bodies,
)
from sonar_gl.engine.body_extents import BodyExtents
from sonar_gl.engine.difference import share_of_difference, wrong_share
from sonar_gl.engine.flow import PingSetup, Plan
from sonar_gl.engine.obstruction import is_unobstructed
from sonar_gl.engine.reception import Reception, reception_of
from sonar_gl.engine.stage import Coverage, Stage, StageCache
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.samples import ViewSamples
from sonar_gl.sonar.sampling import (
    ERROR_RATE,
    LEVELS_PER_HALF,
    WORST_BODY,
    Sampling,
    check_tolerance,
    part_of,
    sampling_at,
)
from sonar_gl.sonar.sector import SHEAR

COARSER = 2  # times fewer samples: with 3 or 4 both lattices miss some rods before a floor
DIFFERENCE_FACTOR = 1.37  # of the error that the difference shows of a body's own echo
SMOOTH_FACTOR = 2.0  # times as much of a body with a specular lobe: most of its echo is that of few samples
GLINT_SAMPLES = 32  # in what may be a glint: with so many it is met, and they show how uneven the echo is
MEAN_FACTOR = 0.6  # of such unevenness of a lobe that is a mean about each sample: of 20 errors 19 are less
MIN_ECHO_SHARE = 5e-4  # of the total: bodies that return less are neglected; half of what is promised
# Near the outline of a round body the footprints of both lattices reach too far alike. Such errors count from where
# these bodies return more than this share of the echo, towards all of it.
MOSTLY_ROUND = 0.8
UNEVEN_FACTOR = 1.5  # of the standard deviation of an echo whose faces return unlike shares
# With more samples on a body, whole samples at the ends of range and aperture dominate that difference.
MAX_COMPARED_SAMPLES = 1000
MAX_STEPS = 8  # at a time: estimates from very few samples are rough


class Judgement(NamedTuple):
    """A sampling level in a ping.

    plan : Plan of this level
    steps : by how many levels finer (or coarser, if negative) would do
    """

    plan: Plan
    steps: int


class ErrorEstimate(NamedTuple):
    """An error of a sampling level, and what would keep the tolerance.

    error : estimated error, relative
    steps : by how many levels finer (or coarser, if negative) would do
    number : of the body whose own echo it is of; 0 for none
    """

    error: float
    steps: float
    number: int = 0


class TriedView(NamedTuple):
    """A view that was drawn and summed with some sampling level.

    stage : Stage of that level
    view : ViewSamples with the numbers of bodies, valid until something else is drawn
    bodies : BodySums for the labels of the ping; None where they are not summed
    further : ViewSamples that were drawn along
    """

    stage: Stage
    view: ViewSamples
    echo: BeamEcho
    counts: BodyCounts
    bodies: BodySums | None = None
    further: Sequence[ViewSamples] = ()

    @property
    def coverage(self) -> Coverage:
        """As of `Stage.coverage`; first asked for while the samples are valid."""
        return self.stage.coverage(self.view)

    @property
    def only_reaches(self) -> bool:
        """Whether all echo is that of samples beyond the last bin that reach into it: none in range met a body."""
        return self.view.bubbles is None and not self.counts.samples.any()


class BegunJudgement(NamedTuple):
    """A judgement of which the view to compare with has been drawn, and is still to be summed.

    shares : (bodies + 1,) of `BodyExtents.glint_shares`
    is_counted, is_compared : (bodies + 1,) of `_counting_bodies`, and which of these are compared between the views
    stage, view : of the view to compare with; None where the ping is compared with itself
    number : of that view, of all that were drawn to compare with
    """

    setup: PingSetup
    level: int
    tried: TriedView
    shares: np.ndarray
    is_counted: np.ndarray
    is_compared: np.ndarray
    stage: Stage | None
    view: ViewSamples | None
    number: int

    @property
    def n_bodies(self) -> int:
        """Of the scene by then."""
        return len(self.is_counted) - 1


class ErrorModel:
    """Judges sampling levels by what they see. It keeps nothing of a ping: what it says depends on that ping alone.

    tolerance : as for `Simulator`
    gain : (K,) of the sonar's bins
    """

    def __init__(self, stages: StageCache, tolerance: float, gain: np.ndarray):
        self.tolerance = check_tolerance(tolerance)
        self._stages, self._sonar = stages, stages.sonar
        self._gain, self._extents = gain, BodyExtents(self.bodies, stages.acoustics.specular)
        self._reach_rad = stages.acoustics.receive_support_rad(self._sonar)
        self._n_drawn = 0  # views to compare with, each of which overwrites the one before

    @property
    def bodies(self) -> list:
        """The bodies of the scene."""
        return self._stages.engine.meshes.bodies

    def sampling_at(self, level: int) -> Sampling:
        """Return the samples of a sampling level, fitted to the columns of the fan."""
        return self._stages.fitted(sampling_at(self._sonar, level))

    def stage_at(self, level: int) -> Stage:
        """Return the stage of a sampling level."""
        return self._stages.stage(self.sampling_at(level))

    def coarser_stage(self, stage: Stage) -> Stage:
        """Return the stage whose view one with the samples of `stage` is compared with."""
        # in the mirror image of the lattice a rod that runs along its rows does not
        return self._stages.stage(self._stages.fitted(part_of(stage.sampling, 1 / COARSER), -SHEAR), -SHEAR)

    def draw(
        self, setup: PingSetup, level: int, further: Sequence[SceneState] = (), for_labels: bool = False
    ) -> TriedView:
        """Draw and sum the view of a ping with a sampling level.

        further : states of which views are drawn along
        for_labels : each body is summed by itself, too
        """
        stage, states = self.stage_at(level), [setup.state, *further]
        view, *along = stage.draw([setup.head_pose] * len(states), states, with_bodies=True)
        beamformer, bodies = stage.beamformer, None
        if for_labels:
            echo, bodies = beamformer.sum_bodies(view, setup.gain)
        else:
            echo = beamformer.sum_view(view, setup.gain)
        return self.tried(stage, view, echo)._replace(bodies=bodies, further=along)

    def _draw_coarser(self, setup: PingSetup, stage: Stage) -> ViewSamples:
        """Draw the view that one of another stage is compared with; stage : its own, of `coarser_stage`."""
        self._n_drawn += 1
        (view,) = stage.draw([setup.head_pose], [setup.state], with_bodies=True)
        return view

    def tried(
        self, stage: Stage, view: ViewSamples, echo: BeamEcho, is_counted: np.ndarray | None = None
    ) -> TriedView:
        """Return a view that was drawn and summed already, with what was met of each body.

        is_counted : of `count_bodies`
        """
        extents = self._current_extents()
        found = count_bodies(view, len(self.bodies), self._reception(stage), is_counted)
        # others err along their outlines alone, which the number of samples tells of
        is_uneven = extents.by_face | extents.are_smooth
        counts = found._replace(unevenness=found.unevenness * is_uneven)
        return TriedView(stage, view, echo, counts)

    def judge(
        self, setup: PingSetup, level: int, tried: TriedView, before: TriedView | None = None
    ) -> Judgement:
        """Estimate the error of a level in a ping.

        tried : with samples of that level
        before : of the same ping with fewer samples, to compare with; None to draw one
        """
        return self.concluded(self.begun(setup, level, tried, draws=before is None), before)

    def begun(self, setup: PingSetup, level: int, tried: TriedView, draws: bool = True) -> BegunJudgement:
        """Return what `concluded` takes, with a view to compare with if that is to be drawn.

        What it takes of the samples that were tried is read here; it holds their echo, of which no array may change.
        """
        greatest = self._current_extents().greatest_echo(
            setup.state, setup.head_pose, self._reception(tried.stage)
        )
        # most of the echo of a round smooth body is that of few samples, and none of them may have met the glint
        shares = self._extents.glint_shares(tried.counts.echo, greatest, setup.state)
        in_glint = tried.counts.samples * shares
        is_counted = self._counting_bodies(setup, tried, greatest, in_glint)
        is_compared = is_counted & (in_glint < MAX_COMPARED_SAMPLES)
        is_empty = tried.echo.total <= 0 and not tried.counts.samples.any()
        # fewer samples tell nothing then: a body that might be seen asks for more whatever they show of it
        stage = self.coarser_stage(tried.stage) if draws and not is_empty else None
        view = None if stage is None else self._draw_coarser(setup, stage)
        return BegunJudgement(
            setup, level, tried, shares, is_counted, is_compared, stage, view, self._n_drawn
        )

    def concluded(self, begun: BegunJudgement, before: TriedView | None = None) -> Judgement:
        """Return a judgement that was begun; its view is drawn again if others were drawn over it.

        before : as of `judge`, where none was drawn
        """
        setup, level, tried, shares, is_counted, is_compared, stage, view, number = begun
        if before is None and stage is None:
            before = tried
        elif before is None:
            if number != self._n_drawn:
                view = self._draw_coarser(setup, stage)
            before = self.tried(stage, view, stage.beamformer.sum_view(view, setup.gain), is_compared)
        coarser = tried.stage.sampling.count(self._sonar) / before.stage.sampling.count(self._sonar)
        whole = self._whole_error(tried, before, coarser)
        worst = self._worst_body(tried, before, coarser, shares, is_counted, is_compared)
        steps = min(math.ceil(max(whole.steps, worst.steps)), MAX_STEPS)
        stage = tried.stage
        estimates = whole.error, worst.error, worst.number
        # of what only reaches into the last bin no tolerance can be kept; finer samples may find that it is nothing
        met = steps <= 0 or (tried.only_reaches and worst.number == 0)
        return Judgement(Plan(stage.sampling, level, *estimates, met, stage.fan.n_samples), steps)

    def _whole_error(self, tried: TriedView, before: TriedView, coarser: float) -> ErrorEstimate:
        """Estimate the share of the echo in wrong bins: by how the two lattices differ, and by what strips add to both.

        coarser : how many times as many samples `tried` has as `before`
        """
        if tried.echo.total <= 0:
            return ErrorEstimate(0.0, 0.0)  # nothing to judge by, and coarser samples would tell no more
        counts = tried.counts
        total = max(counts.echo.sum(), 1e-30)
        of_strips = float(np.abs(counts.of_strips - counts.echo).sum() / total)
        of_round = float(counts.echo[self._current_extents().are_round].sum() / total)
        alike = max(of_round - MOSTLY_ROUND, 0.0) / (1 - MOSTLY_ROUND)
        error = wrong_share(tried.echo, before.echo, coarser, alike) + of_strips
        steps = math.log2(max(error, 1e-9) / self.tolerance) * LEVELS_PER_HALF / ERROR_RATE
        return ErrorEstimate(0.0 if tried.only_reaches else error, steps)

    def _worst_body(
        self,
        tried: TriedView,
        before: TriedView,
        coarser: float,
        shares: np.ndarray,
        counts: np.ndarray,
        is_compared: np.ndarray,
    ) -> ErrorEstimate:
        """Estimate the error of each body's own echo, and return the largest; `coarser` as of `_whole_error`.

        By the samples that met it, by how the two lattices differ, and by what strips take beyond the samples.

        shares : of `BodyExtents.glint_shares`
        counts : of `_counting_bodies`
        is_compared : likewise, which bodies are to be compared with `before`
        """
        hits, echo, of_strips, unevenness, strands, runs = tried.counts
        # Rows that run along a thin rod meet it in few runs, and all alike; those of the coarser samples cross it. Then
        # the error is all of the difference.
        runs_along = 2 * runs < before.counts.runs
        factor = DIFFERENCE_FACTOR * np.where(runs_along, 1.0, share_of_difference(coarser, BODY_ERROR_RATE))
        # Of the less of both: samples along a thin rod take too much of it, and would understate by how much.
        less = np.minimum(echo, before.counts.echo)
        apart = factor * np.abs(echo - before.counts.echo) / np.maximum(less, 1e-30)
        apart = np.where(is_compared, apart, 0.0)
        uneven = unevenness / np.maximum(echo, 1e-30)
        is_textured = self._extents.by_face | ~self._extents.are_smooth
        shown = np.maximum(apart, UNEVEN_FACTOR * uneven * is_textured)
        errors = np.maximum(body_error(np.maximum(hits, 1.0), strands), np.minimum(shown, 1.0))
        of_smooth = self._errors_of_smooth(tried.counts, shares, apart, uneven)
        errors = np.where(self._extents.are_smooth, np.maximum(errors, of_smooth), errors)
        errors = np.hypot(errors, np.abs(of_strips - echo) / np.maximum(echo, 1e-30)) * counts
        if not counts.any():
            return ErrorEstimate(0.0, -math.inf)
        worst = int(errors.argmax())
        finer = (errors[worst] / (WORST_BODY * self.tolerance)) ** (1 / BODY_ERROR_RATE)
        return ErrorEstimate(float(errors[worst]), LEVELS_PER_HALF / 2 * math.log2(finer), worst)

    def _errors_of_smooth(
        self, found: BodyCounts, shares: np.ndarray, apart: np.ndarray, uneven: np.ndarray
    ) -> np.ndarray:
        """Return the errors of bodies by their glints, which return most of the echo of a smooth one.

        `_worst_body` takes the larger of these and of the errors of any body, which count the difference of lattices.

        Where so few samples may lie in a glint that it may be missed, as if these were all; the difference, which may
        be small by chance, counts more. Where it cannot be missed, the echo errs inside the outline, too, as far as it
        differs from sample to sample. Where a lobe is a mean about each sample, the smaller of both is enough.

        found : without `shares`, which are of `BodyExtents.glint_shares`
        apart, uneven : the errors that differences of lattices show, and of neighbouring samples
        """
        in_glint = found.samples * shares
        by_glint = body_error(np.maximum(in_glint, 1.0), found.strands * shares)
        by_glint = np.maximum(by_glint, np.minimum(SMOOTH_FACTOR * apart, 1.0))
        by_all = body_error(np.maximum(found.samples, 1.0), found.strands)
        of_uneven = np.where(self._extents.are_means, MEAN_FACTOR, 1.0) * uneven
        by_all = np.hypot(by_all, np.minimum(of_uneven, 1.0))
        by_all = np.where(self._extents.are_means, np.minimum(by_glint, by_all), by_all)
        return np.where(in_glint < GLINT_SAMPLES, by_glint, by_all)

    def _counting_bodies(
        self, setup: PingSetup, tried: TriedView, greatest: np.ndarray, in_glint: np.ndarray
    ) -> np.ndarray:
        """Return (bodies + 1,) bool by number: which have so strong an echo that their own error counts.

        The echo of a body that few samples met is not known: it counts if it could be strong where it lies, unless it
        is hidden.

        greatest : of `BodyExtents.greatest_echo`
        in_glint : how many samples on each body may lie in its glint; all where it has none
        """
        bodies, state, pose = self.bodies, setup.state, setup.head_pose
        sectors, echo = tried.view.sectors, tried.counts.echo
        total, reception = echo.sum(), self._reception(tried.stage)
        counts = echo > MIN_ECHO_SHARE * total
        least = MIN_ECHO_SHARE * total
        for body in np.flatnonzero(~counts & (in_glint < MIN_BODY_SAMPLES) & (greatest > least)):
            one = bodies[body - 1]
            # samples on a mirror whose glint lies beside the fan have no echo, and are not among those that met it
            if greatest[body] * self._extents.share_in_view(body, one, state, pose, reception) > least:
                sphere, body_pose = self._extents.sphere_about(body), state.poses[body - 1]
                of_one = one, sphere, body_pose, pose, reception, setup.surface_z_m
                counts[body] = is_unobstructed(sectors, body, *of_one)
        return counts

    def greatest_backscatter(self, state: SceneState) -> np.ndarray:
        """Return (bodies,) the most that each body may return per steradian in a state."""
        return self._current_extents().greatest_backscatter(state)

    def _current_extents(self) -> BodyExtents:
        if self._extents.n_bodies < len(self.bodies):  # some were added
            self._extents.add(self.bodies[self._extents.n_bodies :])
        return self._extents

    def _reception(self, stage: Stage) -> Reception:
        return reception_of(stage.beamformer, self._reach_rad, self._gain)
