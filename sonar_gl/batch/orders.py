"""What each ping of a job is: by the job and the ping's number alone, so that any worker can make it."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, fields, replace

import numpy as np

from sonar_gl.acoustics import WATER, Acoustics
from sonar_gl.batch.job import Job
from sonar_gl.batch.paths import KINDS, Trajectory
from sonar_gl.batch.tables import made, meant
from sonar_gl.load import load_scene
from sonar_gl.noise import Noise
from sonar_gl.rigid import pose as make_pose
from sonar_gl.sonar import load_sonar
from sonar_gl.types import Error, nearest_names

VARY, NOISE = 101, 102  # streams of random numbers; never renumber: bytes would change
BETWEEN_S = 1.0
TURNS = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")


@dataclass(frozen=True, eq=False)
class Order:
    """What is asked of one ping.

    Attributes
    ----------
    number : of all pings of the job
    scene : index into the job's scenes
    time_s, pose : (4, 4) world_from_vehicle
    bodies, reflectivity, water : as `Simulator.ping` takes them
    noise : Noise
    """

    number: int
    scene: int
    time_s: float
    pose: np.ndarray
    bodies: dict
    reflectivity: dict
    water: dict
    noise: Noise


def _drawn(random, value) -> float:
    """A value of a table: a number, or one drawn evenly between two. Either takes one draw."""
    share = random.random()
    return float(value) if isinstance(value, (int, float)) else value[0] + (value[1] - value[0]) * share


class Orders:
    """All pings of a job, by number.

    Attributes
    ----------
    sonars : Sonar of each of the job's tables, by name
    mounts : (4, 4) vehicle_from_sonar of each
    acoustics, noise
    paths : of the job's tables of poses

    Raises
    ------
    Error
        naming file and table of what makes no sense.
    """

    def __init__(self, job: Job):
        self.job, where = job, job.where
        self.sonars, self.mounts = {}, {}
        for k, table in enumerate(job.sonars):
            name, sonar = self._sonar(table, f"{where}: sonars[{k}]")
            if name in self.sonars:
                raise Error(f"{where}: sonars[{k}].name must be another than those before (got {name!r})")
            self.sonars[name], self.mounts[name] = sonar, make_pose(*table.mount)
        noise = dict(job.noise)
        known = {"none": Noise.none, "demarco2015": Noise.demarco2015, "physical": Noise.physical}
        if (preset := noise.pop("preset", "none")) not in known:
            raise Error(f"{where}: noise.preset must be one of {', '.join(known)} (got {preset!r})")
        base = {f.name: getattr(known[preset](), f.name) for f in fields(Noise)}
        made(Noise, noise, f"{where}: noise")
        self.noise = made(Noise, base | noise, f"{where}: noise")
        self.acoustics = made(Acoustics, job.acoustics, f"{where}: acoustics")
        self.paths = [self._path(table, f"{where}: poses[{k}]") for k, table in enumerate(job.poses)]
        self._check_ranges()
        # one run of consecutive pings for each scene along each path
        self._runs = [(scene, path) for path in self.paths for scene in range(len(job.scenes))]
        self._starts = np.cumsum([0, *(len(path) for _, path in self._runs)]).tolist()
        self._later_s = [0.0]  # each run begins a second after the one before has ended
        for (_, path), (_, following) in zip(self._runs, self._runs[1:], strict=False):
            ended_s = path[len(path) - 1][0] + self._later_s[-1]
            self._later_s.append(ended_s + BETWEEN_S - following[0][0])
        if job.ros is not None:
            self._check_times()
        self._scenes, self._names = {}, {}

    def _sonar(self, table, where):
        path = self.job.path(table.sonar.partition("#")[0])
        what = str(self.job.path(table.sonar)) if path.is_file() else table.sonar
        try:
            sonar = load_sonar(what)
            sonar = sonar if table.range_m is None else sonar.with_range(table.range_m)
            sonar = sonar if table.bins is None else replace(sonar, n_bins=table.bins)
        except Error as why:
            raise Error(f"{where}: {why}") from None
        plain = "".join(c if c.isalnum() else "_" for c in sonar.name)
        return table.name or (plain if plain[:1].isalpha() else f"sonar_{plain}"), sonar

    def _path(self, table, where):
        table = dict(table)
        kind = table.pop("kind", None)
        if not isinstance(kind, str) or kind not in KINDS:
            raise Error(f"{where}: kind must be one of {', '.join(KINDS)} (got {kind!r})")
        if "file" in table:
            table["file"] = str(self.job.path(str(table["file"])))
        if kind == "random_views":
            table.setdefault("seed", self.job.seed)
        return made(KINDS[kind], table, where)

    def _check_ranges(self):
        """That both ends of what is drawn make sense."""
        where, vary = self.job.where, self.job.vary
        for key in vary.water:
            if key not in WATER:
                raise Error(f"{where}: vary.water: unknown key (got {key!r}; {nearest_names(key, WATER)})")
        if "median" in vary.noise:
            raise Error(f"{where}: vary.noise: median must stay, in the table noise (got it here)")
        for end in (0, -1):
            water = {key: np.ravel(value)[end].item() for key, value in vary.water.items()}
            noise = {key: np.ravel(value)[end].item() for key, value in vary.noise.items()}
            noise |= {key: int(noise[key]) for key in noise if key == "looks"}
            for kind, base, table, name in (
                (Acoustics, self.acoustics, water, "water"),
                (Noise, self.noise, noise, "noise"),
            ):
                base = {f.name: getattr(base, f.name) for f in fields(kind)}
                for key in table:
                    if key not in base:
                        raise Error(
                            f"{where}: vary.{name}: unknown key (got {key!r}; {nearest_names(key, base)})"
                        )
                made(kind, base | table, f"{where}: vary.{name}")
        if vary.water and self.acoustics.sonar_sound_speed_m_s is not None:
            raise Error(
                f"{where}: vary.water must stand without acoustics.sonar_sound_speed_m_s "
                "(got both; ranges would be other ones in each ping)"
            )

    def _check_times(self):
        """That a bag can hold them: those of a file may be anything."""
        for k, path in enumerate(self.paths):
            if isinstance(path, Trajectory):
                times_s = path.times_s if k else np.append(0.0, path.times_s)  # paths follow one another
                if (falls := np.flatnonzero(np.diff(times_s) < 0)).size:
                    former, latter = times_s[falls[0] : falls[0] + 2]
                    where, got = f"{self.job.where}: poses[{k}].file", f"{latter:g} s after {former:g} s"
                    raise Error(f"{where} must hold times from 0 on that never fall, for a bag (got {got})")

    def __len__(self) -> int:
        return self._starts[-1]

    def runs(self):
        """(scene, numbers) of consecutive pings along one path in one scene."""
        for (scene, _), first, past in zip(self._runs, self._starts, self._starts[1:], strict=False):
            yield scene, range(first, past)

    def scene(self, index: int):
        """A scene of the job; the last two are kept."""
        if index not in self._scenes:
            name = self.job.scenes[index]
            path = self.job.path(name)
            paths = [self.job.path(p) for p in self.job.resource_paths]
            try:
                scene = load_scene(str(path) if path.is_file() else name, paths, self.job.skip_missing)
            except Error as why:
                raise Error(f"{self.job.where}: scenes[{index}]: {why}") from None
            while len(self._scenes) > 1:
                self._scenes.pop(next(iter(self._scenes)))
            self._scenes[index] = scene
        return self._scenes[index]

    def __getitem__(self, number: int) -> Order:
        if not 0 <= number < len(self):
            raise IndexError(number)
        run = bisect_right(self._starts, number) - 1
        scene, path = self._runs[run]
        time_s, pose = path[number - self._starts[run]]
        time_s = float(time_s) + self._later_s[run]
        key = np.random.SeedSequence(self.job.seed, spawn_key=(VARY, number))
        random = np.random.Generator(np.random.SFC64(key))
        vary = self.job.vary
        water = {key: _drawn(random, value) for key, value in sorted(vary.water.items())}
        noise = {key: _drawn(random, value) for key, value in sorted(vary.noise.items())}
        if "looks" in noise:
            noise["looks"] = int(noise["looks"])
        bodies, reflectivity = self._moved(scene, random) if vary.bodies else ({}, {})
        return Order(number, scene, time_s, pose, bodies, reflectivity, water, replace(self.noise, **noise))

    def _moved(self, scene: int, random):
        """Bodies of a ping that lie elsewhere, and those of another reflectivity."""
        bodies, reflectivity = {}, {}
        things = self.things(scene)
        for k, table in enumerate(self.job.vary.bodies):
            names = self.names(scene, k)
            for group in [[name] for name in names] if table.apart else [names]:
                shift, turn = np.split(np.array([_drawn(random, getattr(table, key)) for key in TURNS]), 2)
                is_there = random.random() < table.there
                mu = None if table.reflectivity is None else _drawn(random, table.reflectivity)
                if not group:
                    continue
                if is_there and not shift.any() and not turn.any() and mu is None:
                    continue
                pivot = things[group[0]].pose
                turned = pivot @ make_pose(0, 0, 0, *turn) @ np.linalg.inv(pivot)
                turned[:3, 3] += shift
                for name in group:
                    bodies[name] = turned @ things[name].pose if is_there else None
                    if mu is not None and is_there and hasattr(things[name], "reflectivity"):
                        reflectivity[name] = mu
        return bodies, reflectivity

    def things(self, scene: int) -> dict:
        """Bodies and plumes of a scene by name."""
        loaded = self.scene(scene)
        return {thing.name: thing for thing in (*loaded.bodies, *loaded.plumes)}

    def names(self, scene: int, k: int) -> list[str]:
        """What the job's k-th table of moved bodies means in a scene, where it may mean none."""
        if (scene, k) not in self._names:
            self._names[scene, k] = meant(self.job.vary.bodies[k].names, self.things(scene))
        return self._names[scene, k]

    def noise_seed(self, sonar: str) -> int:
        """Of the noise of a sonar, other than those of others."""
        index = list(self.sonars).index(sonar)
        key = np.random.SeedSequence(self.job.seed, spawn_key=(NOISE, index))
        return int(key.generate_state(1, np.uint32)[0])
