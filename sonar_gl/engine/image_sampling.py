"""How finely image sources are sampled: for one ping, for planned poses, or as the sonar moves.

Weak multipath needs few samples. A ping begins with the coarsest, or with those of the ping before; where its multipath
is too strong for them, its image sources are drawn once more, and the difference tells the error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.beamformer import BeamEcho
from sonar_gl.core.checks import text_beside
from sonar_gl.core.warn import warn_caller
from sonar_gl.engine.body_counts import body_error
from sonar_gl.engine.difference import wrong_share
from sonar_gl.engine.multipath import (
    COARSEST,
    FINEST,
    MULTIPATH_GAIN,
    THINNINGS,
    BodySamples,
    ImageSourceSamples,
)
from sonar_gl.raster.views import MAX_CHOSEN_SAMPLES
from sonar_gl.sonar.sampling import WORST_BODY, ToleranceWarning

# These were fitted to random pools (`tools/promise.py`). Multipath from the coarsest samples, which are compared with
# nothing, nearly always errs by less than the first, relative to itself; from as many samples as of the direct echo, by
# about as many tolerances as the second says.
FIRST_ERROR, USUAL_ERROR = 0.5, 0.8
HALVING_RATE = 0.85  # each halving of the rows multiplies the error by two to this power, about
# Of the error that a comparison shows: the estimate of the direct echo's error has room, and the two are added. Where
# there are more samples than of the direct echo, multipath is nearly all echo, and its whole error counts.
BESIDE_DIRECT = 0.7
# Estimated of the direct echo, in tolerances. That of a ping is not known where samples were given, and a ping of a
# data set, whose samples were chosen, is to be made again by giving these.
USUAL_DIRECT_ERROR = 0.8
MIN_SHARE = 0.015  # bodies whose multipath may be more of the direct echo count by themselves
# A body whose multipath may count keeps about so many samples, in the direct view and where its image should be: if a
# small one were missed, its multipath would seem to be weak, and the samples to suffice.
LEAST_ON_BODY = 16
# As a sonar moves, samples get finer by one halving at a time, so that no ping takes much longer than those before.
# They get finer again after so many pings, more than half of those that count for what a ping usually takes.
PINGS_BEFORE_FINER = 55


class MultipathEcho(NamedTuple):
    """The multipath of a ping beside its direct echo.

    images : ImageSourceSamples that it was summed from
    direct_error : the estimated error of the direct echo; None without one
    """

    images: ImageSourceSamples
    multipath: BeamEcho
    direct: BeamEcho
    direct_error: float | None

    @property
    def share(self) -> float:
        """The echo relative to the direct echo."""
        return self.multipath.total / max(self.direct.total, 1e-30)

    def error_against(self, coarser: MultipathEcho) -> MultipathError | None:
        """Return the error as the difference from the same multipath with fewer rows shows it; None without echo."""
        if self.multipath.total <= 0:
            return None
        times = self.images.rows / coarser.images.rows
        wrong = wrong_share(self.multipath, coarser.multipath, times)
        of_it = BESIDE_DIRECT if self.images.halvings >= 0 else 1.0
        return MultipathError(of_it * wrong, self.images.rows)


class MultipathError(NamedTuple):
    """The relative error of multipath, estimated by a comparison.

    error : relative to multipath
    rows : `ImageSourceSamples.rows` that it was summed from
    """

    error: float
    rows: float

    def at(self, rows: float) -> float:
        """Return the error with so many rows, about."""
        return self.error * (self.rows / rows) ** HALVING_RATE


class HalvingChoice(NamedTuple):
    """How finely image sources are sampled.

    halvings : how often rows are halved
    is_fixed : whether that stays
    error : MultipathError of a ping with about such samples; None where none was compared
    is_new : it follows no ping before: that from which it is chosen is drawn until it keeps the tolerance. Others leave
        what a comparison shows to the next ping, so that none takes much longer than those before
    is_due : the next ping is to be compared with one of the coarsest samples
    finest : the least halvings whose samples are known to fit, in the last ping
    before : halvings of the ping before; FINEST where there is none to follow
    n_waiting : pings to come until samples may get finer than that
    n_samples : of the fan of the last ping, which the halvings refer to; 0 where there is none to follow
    """

    halvings: int
    is_fixed: bool = False
    error: MultipathError | None = None
    is_new: bool = False
    is_due: bool = False
    finest: int = FINEST
    before: int = FINEST
    n_waiting: int = 0
    n_samples: int = 0


class ImageSampling:
    """Chooses how finely image sources are sampled, by the multipath of each ping.

    tolerance : of the whole echo
    each_alone : each ping begins with the coarsest samples, so that it does not depend on those before
    choice : HalvingChoice; whoever takes a step of several that may be broken off keeps it, and puts it back
    """

    def __init__(self, tolerance: float, each_alone: bool):
        self._tolerance, self._each_alone, self._has_warned = tolerance, each_alone, False
        self.choice = HalvingChoice(COARSEST)

    def begin_alone(self) -> int:
        """Return the halvings of the next ping: the most, as if none had been made before, unless they are fixed."""
        if not self.choice.is_fixed:
            self.choice = HalvingChoice(COARSEST, is_new=True)
        return self.choice.halvings

    def begin(self, check: bool, n_samples: int) -> int:
        """Return the halvings of the next ping: those of the last, or the most, to compare with others after it.

        More where the direct echo has many times the samples of before, or image sources would have as many more.

        check : the error of this ping's direct echo is estimated. That of its multipath would take as long again: it is
            due in the next ping
        n_samples : of the ping's fan
        """
        if self._begins_anew:
            return self.begin_alone()
        if not self.choice.is_fixed:
            last = self.choice
            more = int(math.log2(max(n_samples / (last.n_samples or n_samples), 1)))
            before = min(last.halvings + more, COARSEST)
            n_waiting = max(last.n_waiting - 1, 0) if last.halvings == last.before else 0
            if more or last.halvings < last.before:
                n_waiting = PINGS_BEFORE_FINER
            self.choice = HalvingChoice(
                COARSEST if last.is_due else before,
                False,
                last.error,
                is_due=check,
                before=before,
                n_waiting=n_waiting,
                n_samples=n_samples,
            )
        return self.choice.halvings

    @property
    def halvings_ahead(self) -> int:
        """The halvings of a ping that is made while those before are awaited: theirs, as far as is known."""
        return self.halvings_alone if self._begins_anew else self.choice.halvings

    @property
    def _begins_anew(self) -> bool:
        """Whether the next ping begins as if none had been made before."""
        return self._each_alone or self.choice.error is None

    @property
    def halvings_alone(self) -> int:
        """The halvings with which `begin_alone` begins."""
        return self.choice.halvings if self.choice.is_fixed else COARSEST

    def fix(self, halvings: int, error: MultipathError | None = None) -> None:
        """Halve rows so often from now on; `error` as of `HalvingChoice`."""
        self.choice = HalvingChoice(halvings, True, error)

    def release(self) -> None:
        """Choose samples ping by ping again."""
        self.choice = self.choice._replace(is_fixed=False)

    @contextmanager
    def without_plan(self) -> Iterator[None]:
        """Choose samples as if nothing had been planned, inside a `with` block."""
        planned = self.choice
        try:
            self.release()
            yield
        finally:
            if planned.is_fixed:
                self.choice = planned

    def review(self, echo: MultipathEcho, coarser: MultipathEcho | None = None) -> bool:
        """Adapt the samples to a ping's multipath; return whether this ping is to be drawn once more with them.

        coarser : of the same ping with fewer samples, to compare with; None for none
        """
        choice, own = self.choice, echo.images.halvings
        if not choice.is_fixed:
            error = choice.error if coarser is None else echo.error_against(coarser)
            wanted = self._halvings_for(echo, error)
            # coarser only where they would stay so: otherwise they flicker
            kept = self._halvings_for(echo, error, margin=2)
            if error is None:  # only a comparison asks for more samples than those of the direct echo
                wanted = max(wanted, 0)
            elif coarser is not None and wanted < own:  # estimates from few samples are rough
                # Beyond those of the direct echo the comparison is with four times fewer: half as many err alike where
                # a small body echoes by way of a reflector alone, and the difference may show half of the error.
                step = 1 if own > 0 else 2
                wanted = max(own - step, _finest_for(echo.images))
            if not choice.is_new:
                wanted = max(wanted, choice.before - (choice.n_waiting == 0))
            self.choice = choice = choice._replace(
                halvings=min(max(choice.halvings, kept), wanted), error=error
            )
        return own > choice.halvings and (coarser is None or choice.is_new)

    def keep_to(self, halvings: int) -> None:
        """Halve rows no less often in the next ping, since finer samples do not fit."""
        self.choice = self.choice._replace(halvings=max(self.choice.halvings, halvings), finest=halvings)

    def warn_if_unmet(self, echo: MultipathEcho | None) -> None:
        """Warn of multipath that breaks the tolerance with the most samples that fit, once until it does not.

        Not where the direct echo alone breaks it: the warning of that has been given. As the sonar moves, finer samples
        than those of a ping may be left to the next.

        echo : of a ping whose direct echo has an estimated error; None without multipath
        """
        error, is_unmet = 0.0, False
        if echo is not None:
            error = self.error_of(echo)
            is_finest = echo.images.halvings <= max(_finest_for(echo.images), self.choice.finest)
            is_unmet = is_finest and echo.direct_error <= self._tolerance < error
        if is_unmet and not self._has_warned:
            warn_caller(
                f"tolerance {self._tolerance:g} cannot be met here: with the most samples that fit of what comes by "
                f"way of planar reflectors, the estimate is {text_beside(error, self._tolerance)}; go nearer, narrow "
                "the fan, ask for a larger tolerance, or leave multipath out",
                ToleranceWarning,
            )
        self._has_warned = is_unmet

    def error_of(self, echo: MultipathEcho) -> float:
        """Return the estimated error of the multipath in a ping, as a share of the whole echo, with the direct echo's.

        It is that of the bins; at the least, comparable with `Plan.bound`, that of the bodies that the images see: a
        body's own echo may err by WORST_BODY times the tolerance.
        """
        if echo.multipath.total <= 0:
            return 0.0
        share, images, known = echo.share / (1 + echo.share), echo.images, self.choice.error
        own = FIRST_ERROR if known is None else known.at(images.rows)
        direct = echo.direct_error or 0.0
        if direct <= self._tolerance:  # so much is left to it where samples are chosen: its estimate has room
            direct = min(direct, USUAL_DIRECT_ERROR * self._tolerance)
        of_bins = share * own + (1 - share) * direct
        fewer = THINNINGS[images.halvings].times_fewer
        return max(of_bins, _error_by_samples(share, images.imaged, fewer) / WORST_BODY)

    def _halvings_for(self, echo: MultipathEcho, known: MultipathError | None, margin: int = 1) -> int:
        """Return how often rows may be halved.

        known : of `_expected_error`
        margin : that would do for so many times the multipath, and so many times fewer samples, too
        """
        share, images = margin * echo.share, echo.images
        direct, fewest = images.direct, _fewest_samples(images)
        # what the direct echo leaves of the tolerance is multipath's
        most = self._tolerance * (1 + (1 - USUAL_DIRECT_ERROR) / max(share, 1e-30))
        finest = _finest_for(images)
        for halvings in range(COARSEST, finest, -1):
            fewer = margin * THINNINGS[halvings].times_fewer
            of_direct, of_imaged = (_error_by_samples(share, one, fewer) for one in (direct, images.imaged))
            allowed = self._tolerance * (1 + share)
            if halvings > 0:
                is_enough = fewest >= LEAST_ON_BODY * fewer and max(of_direct, of_imaged) <= allowed
            else:  # more samples help bodies that the images see alone; `error_of` tells of these
                is_enough = of_imaged <= WORST_BODY * allowed
            if is_enough and self._expected_error(images, halvings, known) * margin**HALVING_RATE <= most:
                return halvings
        return finest

    def _expected_error(
        self, images: ImageSourceSamples, halvings: int, known: MultipathError | None
    ) -> float:
        """Return about what the relative error of a ping's multipath is, were rows halved so often.

        known : the error that a comparison has shown, with the samples that were compared; None without one
        """
        if known is not None:
            return known.at(images.rows * 2.0 ** (images.halvings - halvings))
        if halvings == COARSEST:
            return FIRST_ERROR
        return USUAL_ERROR * self._tolerance * 2.0 ** (HALVING_RATE * halvings)


def _fewest_samples(images: ImageSourceSamples) -> float:
    """Return the fewest samples on any body whose multipath may count, where the sonar sees it or an image should."""
    direct, fewest = images.direct, images.direct.samples.sum()
    for of_view in (direct, images.expected):
        counts = MULTIPATH_GAIN * of_view.echo > MIN_SHARE * direct.echo.sum()
        fewest = min(of_view.samples[counts].min(initial=math.inf), fewest)
    return fewest


def _finest_for(images: ImageSourceSamples) -> int:
    """Return the least number of halvings whose samples fit for certain."""
    columns, rows, _ = THINNINGS[images.halvings]
    n_samples = images.own.fan.n_samples * columns * rows
    return max(FINEST, min(math.ceil(math.log2(n_samples / MAX_CHOSEN_SAMPLES)), 0))


def _error_by_samples(share: float, counts: BodySamples, fewer: float) -> float:
    """Return the error of multipath by the samples on the bodies that return it, relative to what `share` is.

    At the worst it is that of the bodies with the fewest samples.

    share : of multipath
    counts : of the direct view or of the images'
    fewer : times fewer samples than there
    """
    errors = np.minimum(body_error(np.maximum(counts.samples / fewer, 1.0)), 1.0)
    order = np.argsort(-errors)
    most = MULTIPATH_GAIN * share * counts.echo[order] / max(counts.echo.sum(), 1e-30)
    return float(errors[order] @ np.diff(np.minimum(np.cumsum(most), share), prepend=0.0))
