"""Many pings: some are drawn at once while those before them are summed in another thread."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import numpy as np

from sonar_gl._version import __version__
from sonar_gl.types import Error

BATCH = 4  # poses drawn at once


def several(poses) -> Iterable:
    """The poses, or an Error if something is not several of them."""
    if not isinstance(poses, Iterable) or (isinstance(poses, np.ndarray) and poses.ndim == 2):
        raise Error(f"poses must be several poses (got {type(poses).__name__}; make [pose] of one)")
    return poses


def about(sonar, acoustics, tolerance, scene, gl_renderer: str) -> dict:
    """What pings say of themselves, all those of a run alike."""
    return {
        "sonar": asdict(sonar),
        "acoustics": acoustics.meta(),
        "profile": acoustics.profile,
        "tolerance": tolerance,
        "bin_size_m": sonar.bin_size_m,
        "scene": scene.name,
        "bodies": [body.name for body in scene.bodies],
        "version": __version__,
        "gl_renderer": gl_renderer,
    }


def in_batches(simulator, spots, labels: bool):
    """What `Simulator._finish` makes pings of: pose, where, sampling, views, intensity, labels.

    Parameters
    ----------
    spots : (pose, bodies) of each
    """
    spots, waiting, why, over = iter(spots), None, None, False
    with ThreadPoolExecutor(1) as pool:
        while not over:
            with simulator._drawing(beside=waiting and waiting[-1]):
                batch, due, why, over = _gather(simulator, spots)
                samples = simulator._samples
                upcoming = None
                if batch:
                    now = samples.now
                    views = now.views_of(*zip(*batch, strict=True), labels)
                    future = pool.submit(_add_up, now, views, labels, len(simulator.scene.bodies))
                    upcoming = batch, views, now.sampling, future
                    simulator._underway = future
            if waiting:
                yield from _finished(simulator, *waiting, labels)
            waiting = upcoming
            if due and waiting:
                yield from _finished(simulator, *waiting, labels)
                waiting = None
            if due:
                with simulator._drawing():
                    made = _alone(simulator, *due, labels)
                yield made
        if waiting:
            yield from _finished(simulator, *waiting, labels)
    if why is not None:
        raise why


def _gather(simulator, spots):
    """The next poses that can be drawn at once; the one after them if it is to be looked at; why there are no
    more, and whether there are none."""
    batch = []
    while len(batch) < BATCH:
        try:
            pose, bodies = next(spots)
            spot = pose, simulator._world.moved(bodies)
        except StopIteration:
            return batch, None, None, True
        except Exception as why:  # of the poses: those before come first
            return batch, None, why, True
        if simulator._samples.due(*spot):
            return batch, spot, None, False
        batch.append(spot)
    return batch, None, None, False


def _add_up(now, views, labels, n_bodies):
    """In the other thread; nobody else uses the pass meanwhile, see `Simulator._drawing`."""
    out = []
    for seen in views:
        found = now.reducer.labels(seen, now.gain, n_bodies) if labels else (None,) * 3
        out.append((now.intensity(seen), found))
    return out


def _alone(simulator, pose, where, labels):
    views, intensity = simulator._samples.sense(pose, labels, where, look=True)
    now = simulator._samples.now
    found = now.reducer.labels(views, now.gain, len(simulator.scene.bodies)) if labels else (None,) * 3
    return pose, where, now.sampling, views, intensity, found


def _finished(simulator, batch, views, sampling, future, labels):
    """The pings of a batch that was drawn before."""
    for (pose, where), seen, (intensity, found) in zip(batch, views, future.result(), strict=True):
        simulator._open_world()
        made = pose, where, sampling, seen, intensity, found
        if simulator._samples.changed(intensity) or not intensity.any():
            with simulator._drawing():
                made = _alone(simulator, pose, where, labels)
        yield made
