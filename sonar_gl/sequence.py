"""Pings from what was summed; and many of them: some are drawn while those before are summed."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import repeat

import numpy as np

from sonar_gl.multipath import SHARES
from sonar_gl.nothing import why_nothing
from sonar_gl.rigid import check_pose
from sonar_gl.shadows import Background
from sonar_gl.types import Error, Ping

BATCH = 4  # poses drawn at once
GHOST_POSES = 5  # of a planned sequence, that decide how finely ghosts are drawn


def several(poses) -> Iterable:
    """The poses, or an Error if something is not several of them."""
    if not isinstance(poses, Iterable) or (isinstance(poses, np.ndarray) and poses.ndim == 2):
        raise Error(f"poses must be several poses (got {type(poses).__name__}; make [pose] of one)")
    return poses


def each(values, name: str, poses=None) -> Iterable:
    """One for each ping, or None for each; an Error if it is one value alone, or of another number."""
    if not isinstance(values, Iterable | None) or isinstance(values, (dict, str)):
        raise Error(f"{name} must be several, one a pose (got {values!r})")
    counted = values is not None and hasattr(values, "__len__") and hasattr(poses, "__len__")
    if counted and len(values) != len(poses):
        raise Error(f"{name} must be as many as poses (got {len(values)} for {len(poses)} poses)")
    return repeat(None) if values is None else values


def spots_of(poses, **changes):
    """(pose, *what `whereabouts` takes) of each ping, for `in_batches`."""
    more = [each(values, name, poses) for name, values in changes.items()]
    for pose, *changed in zip(several(poses), *more, strict=False):
        yield check_pose(pose), *changed


def whereabouts(simulator, bodies=None, time_s=None, reflectivity=None, water=None):
    """Whereabouts of a ping, by what `Simulator.ping` takes."""
    where = simulator._world.moved(bodies, time_s, simulator.acoustics.bubbles, reflectivity)
    if water is None:
        return where
    sonar, acoustics = simulator.sonar, simulator.acoustics.in_water(water)
    return replace(where, acoustics=acoustics, gain=acoustics.gain(sonar.range_m, sonar).astype(np.float32))


def finish(simulator, pose, where, sampling, views, intensity, whole, found, seed, velocity=None) -> Ping:
    """A ping from what was summed, `whole` in all; `found` : of `Reducer.labels`, or empty.

    velocity : of `in_motion`
    """
    scene, samples, record = simulator.scene, simulator._samples, simulator._record
    if whole <= 0:
        sonars = simulator.sonar, simulator._passes.drawn
        warnings.warn(why_nothing(scene, where, *sonars, pose, views), stacklevel=3)
    if record.described is not scene:  # at first, and when bodies were added
        names = [body.name for body in scene.bodies], [plume.name for plume in scene.plumes]
        record.describe(scene, scene.name, *names, samples.tolerance, simulator.gl_info["renderer"])
    more = {} if where.time_s is None else {"time_s": where.time_s}
    estimate = samples.estimate(pose)
    made = pose, intensity, found, sampling, seed, whole > 0, estimate
    return record.ping(*made, velocity, where.acoustics, **more)


def in_batches(simulator, spots, labels):
    """What `finish` makes pings of: pose, where, sampling, views, intensity and its sum, labels.

    Parameters
    ----------
    spots : of `spots_of`
    labels : of `labels_of`
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
                    views = _views(now, *zip(*batch, strict=True), labels)
                    ghosts = _ghosts(simulator, now, *zip(*batch, strict=True))
                    future = pool.submit(_add_up, simulator, now, views, ghosts, labels)
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
                    made = alone(simulator, *due, labels, look=True)
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
            pose, *changed = next(spots)
            spot = pose, whereabouts(simulator, *changed)
        except StopIteration:
            return batch, None, None, True
        except Exception as why:  # of the poses: those before come first
            return batch, None, why, True
        if simulator._samples.due(*spot):
            return batch, spot, None, False
        batch.append(spot)
    return batch, None, None, False


def _add_up(simulator, now, views, ghosts, labels):
    """In the other thread; nobody else uses the pass meanwhile, see `Simulator._drawing`."""
    out = []
    for seen, mirrored in zip(views, ghosts, strict=True):
        intensity = now.intensity(seen)
        straight = now.reducer.total
        made, more = _sum_ghosts(simulator, mirrored, now.gain_of(seen))
        if more:
            intensity += made
        ghosts = mirrored is not None and (mirrored.halved, more)
        out.append((intensity, straight + more, _labels(simulator, now, seen, labels), straight, ghosts))
    return out


def _ghosts(simulator, now, poses, wheres, first=True):
    """Of each pose what mirrors show of it, drawn now."""
    if simulator._multipath is None:
        return [None] * len(poses)
    multipath = simulator._multipath
    multipath.look(simulator.scene)
    if first and simulator._samples.tolerance is None:  # samples were given: no ping depends on those before
        multipath.halved = len(SHARES)
    return multipath.draw(now, poses, wheres)


def fix_ghosts(simulator, spots) -> None:
    """Decide by some (pose, Whereabouts) how finely ghosts are drawn, and stay with it."""
    if (multipath := simulator._multipath) is None:
        return
    multipath.fixed, least = False, len(SHARES)
    for at in np.unique(np.linspace(0, len(spots) - 1, GHOST_POSES).round().astype(int)):
        multipath.halved = len(SHARES)
        alone(simulator, *spots[at], labels=False)
        least = min(least, multipath.halved)
    multipath.halved, multipath.fixed = least, True


def _sum_ghosts(simulator, ghosts, gain):
    """What they add to the straight echoes, and its sum."""
    return (0.0, 0.0) if ghosts is None else simulator._multipath.sum(ghosts, gain)


def _views(now, poses, wheres, labels):
    """Of each pose, drawn at once; with the `background` alone where shadows are asked for."""
    if not isinstance(labels, Background):
        return now.views_of(poses, wheres, labels)
    views = now.views_of((*poses, *poses), (*wheres, *map(labels.alone, wheres)), True)
    for seen, behind in zip(views, views[len(poses) :], strict=False):
        seen.background = behind
    return views[: len(poses)]


def _labels(simulator, now, views, labels):
    if not labels:
        return {}
    asked, n_bodies = (), len(simulator.scene.bodies)
    if isinstance(labels, Background):
        asked = labels.mask(n_bodies), now.reducer.intensity(views.background)
    return now.reducer.labels(views, now.gain_of(views), n_bodies, *asked)


def alone(simulator, pose, where, labels, look: bool = False):
    """What `finish` makes a ping of."""
    views, intensity = simulator._samples.sense(pose, bool(labels), where, look)
    now = simulator._samples.now
    straight = now.reducer.total
    (ghosts,) = _ghosts(simulator, now, [pose], [where])
    made, more = _sum_ghosts(simulator, ghosts, now.gain_of(views))
    while ghosts is not None and simulator._multipath.too_coarse(ghosts.halved, more, straight):
        (ghosts,) = _ghosts(simulator, now, [pose], [where], first=False)
        made, more = _sum_ghosts(simulator, ghosts, now.gain_of(views))
    if more:
        intensity += made
    if isinstance(labels, Background):
        (views.background,) = now.views_of([pose], [labels.alone(where)])
    return (
        pose,
        where,
        now.sampling,
        views,
        intensity,
        straight + more,
        _labels(simulator, now, views, labels),
    )


def _finished(simulator, batch, views, sampling, future, labels):
    """The pings of a batch that was drawn before."""
    for (pose, where), seen, (*sums, straight, ghosts) in zip(batch, views, future.result(), strict=True):
        simulator._open_world()
        made = pose, where, sampling, seen, *sums
        again = simulator._samples.changed(straight) or straight <= 0
        if again or (ghosts and simulator._multipath.too_coarse(*ghosts, straight)):
            with simulator._drawing():
                made = alone(simulator, pose, where, labels, look=True)
        yield made
