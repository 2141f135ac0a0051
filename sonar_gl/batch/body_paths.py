"""Paths of bodies: their poses over time, from files."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sonar_gl.batch.job import Job
from sonar_gl.batch.trajectories import Trajectory
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.input_files import check_kind_of_file
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.poses import read_poses


class BodyPath:
    """The poses of a CSV file as a path, which begins and ends with them.

    Raises Error if the file cannot be read, or is of one time alone; names file, line and column.

    begin_s, end_s : its first and last time
    """

    def __init__(self, file: Path):
        check_kind_of_file(file)  # no pipe: each process of a batch reads the file
        times_s, poses = read_poses(file)
        self.begin_s, self.end_s = float(times_s[0]), float(times_s[-1])
        if self.begin_s == self.end_s:
            raise Error(
                f"{file}: must hold poses at two times or more (got one, {self.begin_s:.10g} s; for a body that stays "
                "give its pose at another time, too)"
            )
        self._track = PoseTrack(poses, times_s)

    def at(self, time_s: float) -> np.ndarray | None:
        """Return the (4, 4) pose at a time; None before the path begins and after it has ended."""
        if not self.begin_s <= time_s <= self.end_s:
            return None
        return self._track.at(time_s - self.begin_s)


def load_body_paths(job: Job, trajectories: Sequence[Trajectory]) -> list[list[BodyPath]]:
    """Return the paths of each table `vary.bodies`; none of a table without `path`.

    Raises Error if a file cannot be read, or is of other times than all pings.
    """
    return [
        [
            _load_path(job, name, f"{job.where}: vary.bodies[{k}].path", trajectories)
            for name in table.path or []
        ]
        for k, table in enumerate(job.vary.bodies)
    ]


def _load_path(job: Job, name: str, where: str, trajectories: Sequence[Trajectory]) -> BodyPath:
    with errors_at(where):
        path = BodyPath(job.path(name))
    if not any(_has_ping(trajectory, path) for trajectory in trajectories):
        begin_s, end_s = (trajectories[0].time_s(number) for number in (0, len(trajectories[0]) - 1))
        raise Error(
            f"{where} must hold times of pings, which each table of poses counts by itself (got {name!r} from "
            f"{path.begin_s:.10g} to {path.end_s:.10g} s, and no ping there; poses[0] is from {begin_s:.10g} to "
            f"{end_s:.10g} s)"
        )
    return path


def _has_ping(trajectory: Trajectory, path: BodyPath) -> bool:
    """Return whether a ping of a trajectory, whose times do not fall, is at a time of a path."""
    first = bisect_left(range(len(trajectory)), path.begin_s, key=trajectory.time_s)
    return first < len(trajectory) and trajectory.time_s(first) <= path.end_s
