"""The runs of a job: which pings go along which trajectory, in which scene, and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.batch.job import Job
from sonar_gl.batch.random_streams import VIEWS_STREAM, seed_of
from sonar_gl.batch.trajectories import Trajectory, build_trajectory
from sonar_gl.core.checks import check_choice, shown
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import MAX_TIME_S
from sonar_gl.ros.messages import MAX_TIME_S as MAX_ROS_TIME_S

GAP_S = 1.0  # between the last ping of a run and the first of the next


@dataclass(frozen=True, eq=False)
class TrajectoryRun:
    """Consecutive pings along one trajectory in one scene.

    scene : index into the job's scenes
    delay_s : added to the times of the trajectory
    """

    scene: int
    trajectory: Trajectory
    numbers: range
    delay_s: float

    def at(self, number: int) -> tuple[float, np.ndarray]:
        """Return the time of a ping, and its (4, 4) world_from_vehicle."""
        time_s, pose = self.trajectory[number - self.numbers.start]
        return time_s + self.delay_s, pose

    def time_on_trajectory_s(self, number: int) -> float:
        """Return the time of a ping as its trajectory counts it."""
        return float(self.trajectory.time_s(number - self.numbers.start))


def load_trajectories(job: Job) -> list[Trajectory]:
    """Return the trajectory of each table of poses; an Error names file, table and key of what is wrong in one."""
    out, n_views = [], 0
    for index, table in enumerate(map(dict, job.poses)):
        if isinstance(table.get("file"), str):  # of others the trajectory says what is wrong
            table["file"] = str(job.path(table["file"]))
        if table.get("kind") == "random_views":
            seed = seed_of(np.uint64, job.seed, VIEWS_STREAM, n_views) if n_views else job.seed
            table.setdefault("seed", seed)
            n_views += 1
        out.append(build_trajectory(table, job.where, index))
    return out


def runs_of(job: Job, trajectories: list[Trajectory]) -> list[TrajectoryRun]:
    """Return the runs of a job in order: along each trajectory, one for each of its scenes.

    Each begins GAP_S after the one before has ended.

    Raises Error if a table of poses names no scene of the job, if a scene has no poses, or if a time cannot be stored.
    """
    # a bag holds no negative times; only a file has such, and later runs begin after it
    if job.ros is not None and (first_s := trajectories[0].time_s(0)) < 0:
        raise Error(
            f"{job.where}: poses[0].file must hold times from 0 on, for a bag (got {first_s:g} s; shift them)"
        )
    runs, first, delay_s, last_s = [], 0, 0.0, None
    for trajectory, in_scenes in zip(trajectories, _scenes_of_poses(job), strict=True):
        for scene in in_scenes:
            if last_s is not None:
                delay_s = last_s + GAP_S - trajectory[0][0]
            runs.append(TrajectoryRun(scene, trajectory, range(first, first + len(trajectory)), delay_s))
            first += len(trajectory)
            last_s = trajectory[len(trajectory) - 1][0] + delay_s
    _check_last_time(job, last_s)
    return runs


def _scenes_of_poses(job: Job) -> list[list[int]]:
    """Return the scenes of each table of poses, by rising number: those that it names, by default all.

    Raises Error for a name that is no scene of the job, and for a scene that no table names.
    """
    found = []
    for k, table in enumerate(job.poses):
        names, where = table.get("scenes", job.scenes), f"{job.where}: poses[{k}].scenes"
        if not isinstance(names, list) or not names:
            raise Error(
                f"{where} must be a list of scenes (got {shown(names)}; leave it out for all scenes of the job)"
            )
        for name in names:
            check_choice("scene", name, job.scenes, where)
        found.append([scene for scene, name in enumerate(job.scenes) if name in names])
    for scene in sorted(set(range(len(job.scenes))).difference(*found)):
        raise Error(
            f"{job.where}: scenes[{scene}] must have poses (got {job.scenes[scene]!r}, which no table of poses has in "
            "its scenes; name it in one, or leave it out)"
        )
    return found


def _check_last_time(job: Job, time_s: float) -> None:
    """Check that pings, and a bag, can have the time of the last ping; those before are not later."""
    limit_s, what = (
        (MAX_ROS_TIME_S, "for a bag") if job.ros is not None else (MAX_TIME_S, "as all pings must")
    )
    if time_s >= limit_s:
        raise Error(
            f"{job.where}: poses must end before {limit_s:.10g} s, {what} (got {time_s:.10g} s; give times in seconds, "
            "fewer pings, or a larger ping_rate_hz or speed_m_s)"
        )
