"""What is said of a job before any ping, since it is unlikely to be meant; no process that makes pings looks for it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from sonar_gl.batch.job import MovedTable
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.trajectories import RandomViews, Trajectory
from sonar_gl.batch.variation import SHIFT_AND_TURN, names_of_wholes
from sonar_gl.core.errors import some_names
from sonar_gl.core.names import matching_names
from sonar_gl.scene.extent import inside_text
from sonar_gl.scene.scene import hull_patterns, hull_text
from sonar_gl.sonar.sonar import too_short_step_s

BLOCK_PINGS = 1 << 18  # of which times are computed at once


def job_warnings(requests: BatchRequests) -> Iterator[str]:
    """Yield all warnings of a job. Each scene is used once, in order, so that many are not read again for this."""
    yield from device_warnings(requests)
    of_hulls, of_models, of_places = [], [], []
    for index in range(len(requests.scenes)):
        of_hulls += hull_warnings(requests, index)
        of_models += model_warnings(requests, index)
        of_places += place_warnings(requests, index)
    yield from (*of_hulls, *of_models, *of_places)


def device_warnings(requests: BatchRequests) -> Iterator[str]:
    """Yield a sentence about each sonar with a longer range than the device allows.

    And about each trajectory whose pings follow each other faster than a sonar makes them; random views do not
    follow each other.
    """
    where = f"warning: {requests.job.where}"
    for sonar in requests.sonars.values():
        if beyond := sonar.beyond_limit_text():
            yield f"{where}: {beyond}"
    speed_m_s = requests.acoustics.assumed_sound_speed_m_s()
    max_rates_hz = {name: sonar.max_ping_rate_hz(speed_m_s) for name, sonar in requests.sonars.items()}
    for k, trajectory in enumerate(requests.trajectories):
        if isinstance(trajectory, RandomViews):
            continue
        shortest_s = _shortest_step_s(trajectory)
        for name, max_rate_hz in max_rates_hz.items():
            if too_short_step_s([0.0, shortest_s], max_rate_hz) is not None:
                yield (
                    f"{where}: poses[{k}]: sonar {name!r} makes {max_rate_hz:.4g} pings a second "
                    f"at most (got {1 / shortest_s:.4g}; its range, its ping_rate_max_hz, or the times)"
                )


def hull_warnings(requests: BatchRequests, index: int) -> list[str]:
    """Return a sentence about a scene in which the sonars leave the hull of their vehicle behind."""
    job, scene = requests.job, requests.scenes[index]
    model, moved = scene.vehicle(), [pattern for table in job.vary.bodies for pattern in table.names]
    if model is None or matching_names(moved, [model, *scene.parts_of(model)]):
        return []
    names = ", ".join(f'"{pattern}"' for pattern in hull_patterns(scene, model))
    return [f"{_place(requests, index)}: {hull_text(model)} (leave it out: without = [{names}])"]


def model_warnings(requests: BatchRequests, index: int) -> list[str]:
    """Return a sentence about each model of a scene of which `vary.bodies` moves the first body, and not others.

    These are bodies and plumes that stay where another table moves the body they are named after. A table that names
    them keeps them there on purpose.
    """
    moving, named = {}, set()
    all_names = [entry.name for entry in requests.scenes[index].bodies_and_plumes]
    for k, table in enumerate(requests.job.vary.bodies):
        names = matching_names(table.names, all_names)
        named.update(names)
        moving |= dict.fromkeys(names, k if _moves(table) else None)  # the last table counts
    left = {}
    for name in all_names:
        for whole in names_of_wholes(name) if name not in named else ():
            if moving.get(whole) is not None:
                left.setdefault(whole, []).append(name)
    return [
        f"{_place(requests, index)}: vary.bodies[{moving[whole]}] moves {whole!r} without {some_names(names)} "
        f'(add "{whole}::*" to its names, or to those of a table that changes nothing)'
        for whole, names in left.items()
    ]


def place_warnings(requests: BatchRequests, index: int) -> list[str]:
    """Return a sentence about each sonar that is inside a body in the first ping of a scene.

    To look at each ping would take as long as to make them.
    """
    bodies, surface_z_m = requests.scenes[index].bodies, requests.scenes[index].surface_z_m
    request = requests[next(run.numbers[0] for run in requests.runs if run.scene == index)]
    poses = [request.bodies.get(body.name, body.pose) for body in bodies]
    present = np.array([pose is not None for pose in poses], bool)
    poses = [np.eye(4) if pose is None else pose for pose in poses]
    place = f"in {requests.job.scenes[index]}: ping {request.number}"
    texts = {
        name: inside_text(bodies, poses, present, (request.vehicle_pose @ mount)[:3, 3], surface_z_m)
        for name, mount in requests.mounts.items()
    }
    return [f"warning: {name} {place}: {text}" for name, text in texts.items() if text]


def _place(requests: BatchRequests, index: int) -> str:
    """Return how warnings about a scene begin."""
    return f"warning: {requests.job.where}: scenes[{index}], {requests.job.scenes[index]!r}"


def _moves(table: MovedTable) -> bool:
    """Return whether a table lets bodies be elsewhere, or absent, in some ping."""
    is_elsewhere = any(np.any(getattr(table, key)) for key in SHIFT_AND_TURN)
    is_elsewhere |= table.scale not in (None, 1)
    return bool(is_elsewhere or table.there < 1 or table.one_of or table.rests_on or table.path)


def _shortest_step_s(trajectory: Trajectory) -> float:
    """Return the shortest time between two pings that are not at the same time; infinite without such.

    Block by block: the times of 1e9 pings would take all memory.
    """
    shortest_s = math.inf
    for first in range(0, len(trajectory), BLOCK_PINGS):
        stop = min(first + BLOCK_PINGS + 1, len(trajectory))  # with the first ping of the next block
        steps_s = np.diff(trajectory.time_s(np.arange(first, stop)))
        shortest_s = float(steps_s[steps_s != 0].min(initial=shortest_s))
    return shortest_s
