"""Many pings: some are drawn at once while those before them are summed in another thread."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import islice

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
    world, samples = simulator._world, simulator._samples

    def add_up(now, batch, views):
        """In the other thread, with a pass that nobody else uses meanwhile."""
        out = []
        for seen in views:
            found = now.reducer.labels(seen, now.gain, len(world.scene.bodies)) if labels else (None,) * 3
            out.append((now.intensity(seen), found))
        return out

    def alone(pose, where, look):
        views, intensity = samples.sense(pose, labels, where, look)
        now = samples.now
        found = now.reducer.labels(views, now.gain, len(world.scene.bodies)) if labels else (None,) * 3
        return pose, where, now.sampling, views, intensity, found

    def finish(waiting):
        """The pings of a batch that was drawn before."""
        now, batch, views, future = waiting
        for (pose, where), seen, (intensity, found) in zip(batch, views, future.result(), strict=True):
            if samples.changed(intensity):
                with simulator._drawing():
                    yield alone(pose, where, look=True)
            else:
                yield pose, where, now.sampling, seen, intensity, found

    spots, waiting = iter(spots), None
    with ThreadPoolExecutor(1) as pool:
        while taken := list(islice(spots, BATCH)):
            with simulator._drawing():
                batch = [(pose, world.moved(bodies)) for pose, bodies in taken]
                first = batch[0] if samples.due(*batch[0]) else None
                if first is None:
                    now = samples.now
                    views = now.views_of(*zip(*batch, strict=True), labels)
                    upcoming = now, batch, views, pool.submit(add_up, now, batch, views)
            if waiting:
                yield from finish(waiting)
                waiting = None
            if first is None:
                waiting = upcoming
                continue
            for spot in batch:
                with simulator._drawing():
                    made = alone(*spot, look=spot is first)
                yield made
        if waiting:
            yield from finish(waiting)
