"""The request for each ping of a job, computed from the ping's number alone: any worker can make any ping."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sonar_gl.acoustics.water import Water
from sonar_gl.batch.job import Job
from sonar_gl.batch.job_scenes import JobScenes
from sonar_gl.batch.job_settings import build_acoustics, build_noise, check_settings, load_sonars
from sonar_gl.batch.random_streams import NOISE_STREAM, VARY_STREAM, VIEWS_STREAM, generator, seed_of
from sonar_gl.batch.trajectories import Trajectory, build_trajectory
from sonar_gl.batch.variation import check_varied_fields, draw_fields, load_body_paths
from sonar_gl.core.checks import check_choice, shown
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import MAX_TIME_S
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine.request import PingRequest
from sonar_gl.noise.settings import Noise
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


@dataclass(frozen=True, eq=False)
class BatchRequest:
    """The request for one ping of a batch, common to all sonars of the job.

    scene : index into the job's scenes
    vehicle_pose : (4, 4) world_from_vehicle
    bodies, reflectivity : changes in this ping, as in `PingRequest`
    unplaced : names of bodies that are absent since no place was clear
    water : Water of this ping, or None for that of the job
    """

    number: int
    scene: int
    time_s: float
    vehicle_pose: np.ndarray
    bodies: dict
    reflectivity: dict
    unplaced: list[str]
    water: Water | None
    noise: Noise

    def for_sonar(
        self,
        mount: np.ndarray,
        labels: bool = False,
        background: list[str] | None = None,
        label_level_db: float | None = None,
    ) -> PingRequest:
        """Return the request for one sonar, without noise.

        mount : (4, 4) vehicle_from_sonar
        labels, background, label_level_db : as in `PingRequest`
        """
        return PingRequest(
            pose=self.vehicle_pose @ mount,
            labels=labels,
            background=background,
            label_level_db=label_level_db,
            bodies=self.bodies,
            time_s=self.time_s,
            reflectivity=self.reflectivity,
            water=self.water,
            noise_parts=self.noise.speckle,
            alone=True,  # whatever other pings its process makes
        )


class BatchRequests(Sequence):
    """The requests of a job, a sequence by ping number.

    Raises Error if the job names something unknown or invalid; the message names file and table. See also `JobScenes`.

    sonars : name -> Sonar, in the order of the job
    mounts : name -> (4, 4) vehicle_from_sonar
    acoustics, noise : of the job, before variation
    scenes : JobScenes, which are read when they are first used
    trajectories : Trajectory of each table of poses
    runs : the runs of the job, in order: along each trajectory, one for each of its scenes
    """

    def __init__(self, job: Job):
        self.job, (self.sonars, self.mounts) = job, load_sonars(job)
        self.noise, self.acoustics = build_noise(job), build_acoustics(job)
        check_settings(job, self.sonars, self.acoustics, self.noise)
        self.trajectories = load_trajectories(job)
        check_varied_fields(job, self.acoustics, self.noise)
        self.runs = runs_of(job, self.trajectories)
        self._starts = [run.numbers.start for run in self.runs]
        self.scenes = JobScenes(job, load_body_paths(job, self.trajectories))

    def __len__(self) -> int:
        return self.runs[-1].numbers.stop

    def __getitem__(self, number: int) -> BatchRequest:
        if not 0 <= number < len(self):
            raise IndexError(f"a job has pings 0..{len(self) - 1} (got {number})")
        run, vary = self.runs[bisect_right(self._starts, number) - 1], self.job.vary
        time_s, vehicle_pose = run.at(number)
        # the ping whose draws this one has
        drawn = number - (number - run.numbers.start) % (vary.hold_pings or 1)
        random = generator(self.job.seed, VARY_STREAM, drawn)
        # the order of these draws decides the bytes of data sets
        water, noise = draw_fields(random, vary.water), draw_fields(random, vary.noise)
        with collected_warnings():  # the ends of these ranges were warned of
            water = replace(self.acoustics.water, **water) if water else None
            noise = replace(self.noise, **noise)
        bodies, reflectivity, unplaced = {}, {}, []
        if vary.bodies:
            moved, on_path_s = self.scenes.moved_bodies(run.scene), run.time_on_trajectory_s(number)
            bodies, reflectivity, unplaced = moved.draw(drawn, random, run.numbers.start, on_path_s)
        return BatchRequest(
            number, run.scene, time_s, vehicle_pose, bodies, reflectivity, unplaced, water, noise
        )

    def noise_seed(self, sonar: str) -> int:
        """Return the seed of a sonar's noise; each sonar has its own."""
        return seed_of(np.uint32, self.job.seed, NOISE_STREAM, list(self.sonars).index(sonar))


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
