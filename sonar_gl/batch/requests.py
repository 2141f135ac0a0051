"""The request for each ping of a job, computed from the ping's number alone: any worker can make any ping."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sonar_gl.acoustics.water import Water
from sonar_gl.batch.body_paths import load_body_paths
from sonar_gl.batch.job import Job
from sonar_gl.batch.job_scenes import JobScenes
from sonar_gl.batch.job_settings import build_acoustics, build_noise, check_settings, load_sonars
from sonar_gl.batch.random_streams import NOISE_STREAM, VARY_STREAM, generator, seed_of
from sonar_gl.batch.trajectory_runs import load_trajectories, runs_of
from sonar_gl.batch.variation import check_varied_fields, draw_fields
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine.request import PingRequest
from sonar_gl.noise.settings import Noise


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
