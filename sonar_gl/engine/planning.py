"""Samples that are chosen for planned pings before any of them is made."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sonar_gl.engine.flow import PingSetup, Plan
from sonar_gl.engine.level_search import evenly_picked
from sonar_gl.engine.multipath import COARSEST
from sonar_gl.engine.pipeline import sample
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.run import Run

IMAGE_POSES = 5  # of a planned sequence, that decide how finely image sources are sampled


def plan(run: Run, requests: Iterable[PingRequest]) -> Plan | None:
    """Choose the samples for all of these pings, and stay with them; if that is broken off, with those before."""
    setups = [run.set_up(request) for request in requests]
    with run.drawing(), run.choices_kept():
        setups = [run.with_later_bodies(setup) for setup in setups]
        chosen = run.sampler.fix(setups)
        if run.image_sources is not None:
            _fix_images(run, setups)
    return chosen


def _fix_images(run: Run, setups: Sequence[PingSetup]) -> None:
    """Choose the samples of image sources for all of some pings, for IMAGE_POSES of many, and stay with them."""
    images, least, errors = run.image_sampling, COARSEST, []
    images.release()
    for setup in evenly_picked(setups, IMAGE_POSES):
        images.begin_alone()
        received, _ = sample(run, setup)
        if (found := received.drawn.images) is not None:
            least = min(least, found.halvings)
        if images.choice.error is not None:
            errors.append(images.choice.error)
    images.fix(least, max(errors, key=lambda error: error.at(1), default=None))
