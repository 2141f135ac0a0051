"""The request for each ping of a job, computed from the ping's number alone: any worker can make any ping."""

from __future__ import annotations

import math
import os
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics, check_moved
from sonar_gl.acoustics.water import Water
from sonar_gl.batch.job import Job, MovedTable, SonarTable, build, check_keys, check_patterns
from sonar_gl.batch.trajectories import FileTrajectory, RandomViews, Trajectory, build_trajectory
from sonar_gl.core.checks import check_choice, shown
from sonar_gl.core.errors import Error, errors_at, nearest_of_many, some_names
from sonar_gl.core.input_files import check_no_link_loop, noted_files
from sonar_gl.core.names import matching_names, names_of
from sonar_gl.core.poses import MAX_TIME_S
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.engine.request import PingRequest
from sonar_gl.noise.receiver import receiver_levels_db
from sonar_gl.noise.settings import PRESETS, Noise, check_moved_amounts
from sonar_gl.ros.messages import MAX_TIME_S as MAX_ROS_TIME_S
from sonar_gl.scene.extent import body_bounds, gap_m, inside_text
from sonar_gl.scene.load import load_scene
from sonar_gl.scene.scene import Body, Scene, hull_patterns, hull_text
from sonar_gl.scene.sdf.resources import GIVE_FOLDERS, SKIP_MISSING
from sonar_gl.scene.sdf.xacro import split_arguments
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sonar import Sonar, too_short_step_s
from sonar_gl.sonar.sonar_files import load_sonar, split_sonar

# of random numbers; never renumber: the bytes of data sets would change
VARY_STREAM, NOISE_STREAM, VIEWS_STREAM, CLEARANCE_STREAM = 101, 102, 103, 104
CLEARANCE_TRIES = 100  # places that are drawn for a body; it is absent if none is clear
BLOCK_PINGS = 1 << 18  # of which times are computed at once
GAP_S = 1.0  # between the last ping of a run and the first of the next
SHIFT_AND_TURN = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
WHOLE_NOISE = "looks"  # the field of the noise that is a whole number, and may vary
VARIED_WATER = tuple(field.name for field in fields(Water) if not field.name.endswith("_formula"))


@dataclass(frozen=True, eq=False)
class BatchRequest:
    """The request for one ping of a batch, common to all sonars of the job.

    Attributes
    ----------
    number : number of the ping in the job, from 0 on
    scene : index into the job's scenes
    time_s : time of transmission
    vehicle_pose : (4, 4) world_from_vehicle
    bodies, reflectivity : changes in this ping, as in `PingRequest`
    water : Water of this ping, or None for that of the job
    noise : noise of this ping
    """

    number: int
    scene: int
    time_s: float
    vehicle_pose: np.ndarray
    bodies: dict
    reflectivity: dict
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

        Parameters
        ----------
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


@dataclass(frozen=True, eq=False)
class TrajectoryRun:
    """Consecutive pings along one trajectory in one scene.

    Attributes
    ----------
    scene : index into the job's scenes
    numbers : numbers of the pings in the job
    delay_s : added to the times of the trajectory
    """

    scene: int
    trajectory: Trajectory
    numbers: range
    delay_s: float


class _Vehicle(NamedTuple):
    """What carries the sonar in a scene: the model, the names of what is in it, and patterns that match these alone."""

    model: str
    parts: list[str]
    patterns: list[str]


class BatchRequests(Sequence):
    """The requests of a job, a sequence by ping number.

    Attributes
    ----------
    job : Job
    sonars : name -> Sonar, in the order of the job
    mounts : name -> (4, 4) vehicle_from_sonar
    acoustics, noise : those of the job, before variation
    runs : the runs of the job, in order: along each trajectory, one for each of its scenes

    Raises
    ------
    Error
        if the job names something unknown or invalid; the message names file and table.
    """

    def __init__(self, job: Job):
        self.job = job
        self.sonars, self.mounts = _load_sonars(job)
        self.noise = _load_noise(job)
        self.acoustics = _load_acoustics(job)
        self._trajectories = trajectories = [self._load_trajectory(k) for k in range(len(job.poses))]
        _check_varied_fields(job, self.acoustics, self.noise)
        with errors_at(f"{job.where}: noise"):
            for sonar in self.sonars.values():  # those of which the noise needs more than they have
                receiver_levels_db(self.noise, sonar, self.acoustics)
        for output, table in job:
            if hasattr(table, "counts"):
                self.counts(output)  # raises an Error if they do not go with the law of a sonar
        if job.ros is not None:
            _check_times_for_bag(job, trajectories)
        self.runs = _runs(trajectories, _scenes_of_poses(job))
        _check_last_time(job, self.runs[-1])
        self._starts = [run.numbers.start for run in self.runs]
        self._scenes, self._moved_names, self._apart_groups, self._files = {}, {}, {}, {}
        self._vehicles: dict[int, _Vehicle | None] = {}  # of each scene; None without a hull
        self._left_behind: dict[int, list[str]] = {}  # of each scene, what `model_warnings` yields
        self._places: dict[int, list[str]] = {}  # of each scene, where its first ping has a sonar in a body
        self._check_names_of_bodies()

    def _load_trajectory(self, index: int) -> Trajectory:
        table = dict(self.job.poses[index])
        if isinstance(table.get("file"), str):  # of others the trajectory says what is wrong
            table["file"] = str(self.job.path(table["file"]))
        if table.get("kind") == "random_views":
            table.setdefault("seed", self._views_seed(index))
        return build_trajectory(table, self.job.where, index)

    def _views_seed(self, index: int) -> int:
        """Return the seed of a table of random views that states none: of the first one it is that of the job."""
        before = sum(table.get("kind") == "random_views" for table in self.job.poses[:index])
        if before == 0:
            return self.job.seed
        key = np.random.SeedSequence(self.job.seed, spawn_key=(VIEWS_STREAM, before))
        return int(key.generate_state(1, np.uint64)[0])

    def device_warnings(self) -> Iterator[str]:
        """Yield a sentence about each sonar with a longer range than the device allows.

        And about each trajectory whose pings follow each other faster than a sonar makes them; random views do not
        follow each other.
        """
        for sonar in self.sonars.values():
            if beyond := sonar.beyond_limit_text():
                yield f"warning: {self.job.where}: {beyond}"
        speed_m_s = self.acoustics.assumed_sound_speed_m_s()
        max_rates_hz = {name: sonar.max_ping_rate_hz(speed_m_s) for name, sonar in self.sonars.items()}
        for k, trajectory in enumerate(self._trajectories):
            if isinstance(trajectory, RandomViews):
                continue
            shortest_s = _shortest_step_s(trajectory)
            for name, max_rate_hz in max_rates_hz.items():
                if too_short_step_s([0.0, shortest_s], max_rate_hz) is not None:
                    yield (
                        f"warning: {self.job.where}: poses[{k}]: sonar {name!r} makes {max_rate_hz:.4g} pings a second "
                        f"at most (got {1 / shortest_s:.4g}; its range, its ping_rate_max_hz, or the times)"
                    )

    def warnings(self) -> Iterator[str]:
        """Yield what is said of the job before any ping, whatever makes the pings."""
        yield from self.device_warnings()
        yield from self.hull_warnings()
        yield from self.model_warnings()
        yield from self.place_warnings()

    def place_warnings(self) -> Iterator[str]:
        """Yield a sentence about each sonar that is inside a body in the first ping of a scene.

        To look at each ping would take as long as to make them.
        """
        for index in range(len(self.job.scenes)):
            if index not in self._places:
                self.scene(index)
            yield from self._places[index]

    def _find_places(self, index: int) -> list[str]:
        """Return the warnings of the sonars that are inside a body in the first ping of a scene."""
        bodies = self.scene(index).bodies
        request = self[next(run.numbers[0] for run in self.runs if run.scene == index)]
        poses = [request.bodies.get(body.name, body.pose) for body in bodies]
        present = np.array([pose is not None for pose in poses], bool)
        poses = [np.eye(4) if pose is None else pose for pose in poses]
        place = f"in {self.job.scenes[index]}: ping {request.number}"
        texts = {
            name: inside_text(bodies, poses, present, (request.vehicle_pose @ mount)[:3, 3])
            for name, mount in self.mounts.items()
        }
        return [f"warning: {name} {place}: {text}" for name, text in texts.items() if text]

    def model_warnings(self) -> Iterator[str]:
        """Yield a sentence about each model of which `vary.bodies` moves the first body, and leaves others behind."""
        for index in range(len(self.job.scenes)):
            if index not in self._left_behind:
                self.scene(index)
            yield from self._left_behind[index]

    def _find_left_behind(self, index: int) -> list[str]:
        """Return the warnings of bodies and plumes that stay where another table moves the body they are named after.

        A table that names them keeps them there on purpose.
        """
        moving, named = {}, set()
        for k, table in enumerate(self.job.vary.bodies):
            names = self.moved_names(index, k)
            named.update(names)
            moving |= dict.fromkeys(names, k if _moves(table) else None)  # the last table counts
        left = {}
        for name in self.bodies_and_plumes(index):
            parts = name.split("::")
            for whole in ("::".join(parts[:n]) for n in range(1, len(parts)) if name not in named):
                if moving.get(whole) is not None:
                    left.setdefault(whole, []).append(name)
        where = f"warning: {self.job.where}: scenes[{index}], {self.job.scenes[index]!r}"
        return [
            f"{where}: vary.bodies[{moving[whole]}] moves {whole!r} without {some_names(names)} "
            f'(add "{whole}::*" to its names, or to those of a table that changes nothing)'
            for whole, names in left.items()
        ]

    def hull_warnings(self) -> Iterator[str]:
        """Yield a sentence about each scene in which the sonars leave the hull of their vehicle behind."""
        moved = [pattern for table in self.job.vary.bodies for pattern in table.names]
        for index, name in enumerate(self.job.scenes):
            if index not in self._vehicles:
                self.scene(index)
            vehicle = self._vehicles[index]
            if vehicle is not None and not matching_names(moved, [vehicle.model, *vehicle.parts]):
                place = f"{self.job.where}: scenes[{index}], {name!r}"
                names = ", ".join(f'"{pattern}"' for pattern in vehicle.patterns)
                yield f"warning: {place}: {hull_text(vehicle.model)} (leave it out: without = [{names}])"

    def __len__(self) -> int:
        return self.runs[-1].numbers.stop

    def __getitem__(self, number: int) -> BatchRequest:
        if not 0 <= number < len(self):
            raise IndexError(f"a job has pings 0..{len(self) - 1} (got {number})")
        run = self.runs[bisect_right(self._starts, number) - 1]
        time_s, vehicle_pose = run.trajectory[number - run.numbers.start]
        vary = self.job.vary
        drawn = number - (number - run.numbers.start) % (
            vary.hold_pings or 1
        )  # the ping whose draws this one has
        random = self._random(
            VARY_STREAM, drawn
        )  # the order of the draws below decides the bytes of data sets
        water = {key: _draw(random, value) for key, value in sorted(vary.water.items())}
        noise = {
            key: (_draw_whole if key == WHOLE_NOISE else _draw)(random, value)
            for key, value in sorted(vary.noise.items())
        }
        bodies, reflectivity = self._draw_bodies(run.scene, drawn, random) if vary.bodies else ({}, {})
        return BatchRequest(
            number,
            run.scene,
            time_s + run.delay_s,
            vehicle_pose,
            bodies,
            reflectivity,
            replace(self.acoustics.water, **water) if water else None,
            replace(self.noise, **noise),
        )

    def _random(self, *stream: int) -> np.random.Generator:
        key = np.random.SeedSequence(self.job.seed, spawn_key=stream)
        return np.random.Generator(np.random.SFC64(key))

    def _draw_bodies(self, scene: int, number: int, random) -> tuple[dict, dict]:
        """Draw the poses of bodies that move in a ping, and their reflectivities."""
        bodies, reflectivity, taken = {}, {}, {}  # taken: what keeps clear of each other
        known = self.bodies_and_plumes(scene)
        for k, table in enumerate(self.job.vary.bodies):
            groups = self._moved_groups(scene, k)
            chosen = _draw_whole(random, [0, len(groups) - 1]) if table.one_of and groups else None
            for n, group in enumerate(groups):
                draws = _draw_move(random, table)
                is_present = random.random() < table.there and chosen in (None, n)
                mu = None if table.reflectivity is None else _draw(random, table.reflectivity)
                for name in group:  # of two tables the later one counts, also where it changes nothing
                    for found in (bodies, reflectivity, taken):
                        found.pop(name, None)
                if not group:
                    continue
                if is_present and table.clearance_m is not None:
                    # a stream of its own: no other draw depends on how many these are
                    more = self._random(CLEARANCE_STREAM, number, k, n)
                    draws = _clear_draws(known, group, table, draws, more, taken)
                    is_present = draws is not None
                poses = (
                    _moved_poses(known, group, table, draws, bodies) if is_present else dict.fromkeys(group)
                )
                if is_present and not draws.any() and mu is None and table.rests_on is None:
                    continue
                bodies |= poses
                if mu is not None and is_present:
                    reflectivity |= {name: mu for name in group if hasattr(known[name], "reflectivity")}
        return bodies, reflectivity

    def scene(self, index: int) -> Scene:
        """Return a scene of the job, with the bodies and the surface that the job wants. The last two are cached."""
        if index not in self._scenes:
            self._keep_scene(index, self._load_scene(index))
        return self._scenes[index]

    def _load_scene(self, index: int) -> Scene:
        """Return a scene of the job as it is in its file."""
        name = self.job.scenes[index]
        path, file = self.job.path(name), self.job.path(split_arguments(name)[0])
        is_file = any(one.is_file() for one in (file, file / "model.sdf", file / "model.config"))
        folders = [self.job.path(folder) for folder in self.job.resource_paths]
        with errors_at(f"{self.job.where}: scenes[{index}]"):
            check_no_link_loop(path)
            found = str(path) if is_file or _names_file(split_arguments(name)[0]) else name
            with noted_files() as files:
                scene = _load_for_job(found, folders, self.job.skip_missing)
        self._files[index] = files
        return scene

    def files(self) -> list[str]:
        """Return the absolute paths of all files that decide the pings: those of the job, and those of its scenes."""
        found = dict.fromkeys(os.path.abspath(path) for path in self.job.files())
        for index in range(len(self.job.scenes)):
            if index not in self._files:
                self.scene(index)
            found |= dict.fromkeys(self._files[index])
        return list(found)

    def _keep_scene(self, index: int, scene: Scene) -> None:
        """Cache a scene without what the job leaves out. A pattern need not match a body of every scene."""
        job = self.job
        if job.only is not None:
            scene = scene.only(*_matched(job.only, scene))
        if job.without is not None:
            scene = scene.without(*_matched(job.without, scene))
        if job.surface_z_m is not None:
            scene = scene.with_surface(job.surface_z_m)
        while len(self._scenes) > 1:
            self._scenes.pop(next(iter(self._scenes)))
        model = scene.vehicle()
        hull = (
            None if model is None else _Vehicle(model, [*scene.parts_of(model)], hull_patterns(scene, model))
        )
        self._vehicles[index] = hull
        self._scenes[index] = scene
        if index not in self._places:  # now, since many scenes are not loaded again for it
            self._check_rests(index)
            self._left_behind[index] = self._find_left_behind(index)
            self._places[index] = self._find_places(index)

    def _check_names_of_bodies(self) -> None:
        """Raise an Error if `only` or `without` names what no scene has, or leaves nothing of a scene."""
        job, known, empty = self.job, {}, []
        for index, name in enumerate(job.scenes) if job.only or job.without else ():
            scene = self._load_scene(index)
            known |= dict.fromkeys(_names(scene))
            self._keep_scene(index, scene)
            empty += [] if _names(self.scene(index)) else [f"scenes[{index}], {name!r}"]
        for key in ("only", "without") if known else ():
            check_patterns(getattr(job, key) or [], known, f"{job.where}: {key}")
        if empty:
            raise Error(
                f"{job.where}: only and without must leave a body of each scene (got none of {empty[0]})"
            )

    def bodies_and_plumes(self, scene: int) -> dict:
        """Return the bodies and plumes of a scene by name."""
        return {entry.name: entry for entry in self.scene(scene).bodies_and_plumes}

    def moved_names(self, scene: int, table: int) -> list[str]:
        """Return the bodies of a scene that a table of moved bodies matches; it may be none of this scene."""
        if (scene, table) not in self._moved_names:
            patterns = self.job.vary.bodies[table].names
            self._moved_names[scene, table] = matching_names(patterns, self.bodies_and_plumes(scene))
        return self._moved_names[scene, table]

    def _check_rests(self, scene: int) -> None:
        """Raise an Error if a scene lacks the floor on which a table rests bodies, or it moves with them or later."""
        known, n_tables = [body.name for body in self.scene(scene).bodies], len(self.job.vary.bodies)
        for k, table in enumerate(self.job.vary.bodies):
            names, floor = self.moved_names(scene, k), table.rests_on
            if floor is None or not names:
                continue
            where = f"{self.job.where}: vary.bodies[{k}].rests_on must name a body"
            if floor in names:
                raise Error(f"{where} that does not move with the others (got {floor!r})")
            later = next((n for n in range(k + 1, n_tables) if floor in self.moved_names(scene, n)), None)
            if later is not None:
                raise Error(
                    f"{where} that no later table names (got {floor!r}, which vary.bodies[{later}] names; give that "
                    "table first)"
                )
            if floor not in known:
                hint = nearest_of_many(floor, known)
                raise Error(
                    f"{where} of each scene of {names[0]!r} (got {floor!r}, which scenes[{scene}] lacks; {hint})"
                )

    def _moved_groups(self, scene: int, table: int) -> list[list[str]]:
        """Return the bodies of a scene that a table moves or chooses from, those that move together in one list.

        A model whose name a pattern matches moves as a whole, the outermost of several: a fish with its tail.
        """
        names, moved = self.moved_names(scene, table), self.job.vary.bodies[table]
        if not (moved.apart or moved.one_of):
            return [names]
        if (scene, table) not in self._apart_groups:
            # a body of MuJoCo is a model, too, whose parts are named after it
            models = set(matching_names(moved.names, [*self.scene(scene).models, *names]))
            groups = {}
            for name in names:
                parts = name.split("::")
                wholes = ("::".join(parts[:n]) for n in range(1, len(parts)))
                groups.setdefault(next((whole for whole in wholes if whole in models), name), []).append(name)
            self._apart_groups[scene, table] = list(groups.values())
        return self._apart_groups[scene, table]

    def counts(self, output: str) -> dict[str, Counts]:
        """Return the law of each sonar's counts in an output such as "pictures", whose table may change the sonar's."""
        table = getattr(self.job, output)
        with errors_at(f"{self.job.where}: {output}"):
            changes = {} if table is None else table.counts
            return {name: sonar.counts.changed(changes) for name, sonar in self.sonars.items()}

    def noise_seed(self, sonar: str) -> int:
        """Return the seed of a sonar's noise; each sonar has its own."""
        index = list(self.sonars).index(sonar)
        key = np.random.SeedSequence(self.job.seed, spawn_key=(NOISE_STREAM, index))
        return int(key.generate_state(1, np.uint32)[0])


def _load_for_job(what: str, folders: list[Path], skip_missing: bool) -> Scene:
    """Load a scene; errors about missing files name the keys of a job, and not the options of other commands."""
    try:
        return load_scene(what, folders, skip_missing)
    except Error as why:
        text = str(why)
        for option, key in (
            (GIVE_FOLDERS, "the key resource_paths"),
            (f"{SKIP_MISSING}True", "skip_missing = true"),
            (f"{SKIP_MISSING} are", "skip_missing is"),
        ):
            text = text.replace(option, key)
        raise type(why)(text) from None


def _names(scene: Scene) -> list[str]:
    """Return the names of bodies and plumes."""
    return [entry.name for entry in scene.bodies_and_plumes]


def _matched(patterns: list[str], scene: Scene) -> list[str]:
    """Return those patterns that match something in a scene."""
    names = set(_names(scene))
    return [pattern for pattern in patterns if names_of(pattern, names)]


def _moved_poses(known: dict, group: list[str], table: MovedTable, draws: np.ndarray, placed: dict) -> dict:
    """Return the poses of bodies that move together, given their draws and the poses of tables before."""
    poses = _drawn_poses(known, group, draws)
    if table.rests_on is not None:
        floor, place = known[table.rests_on], placed.get(table.rests_on)
        of_bodies = [(known[name], pose) for name, pose in poses.items() if isinstance(known[name], Body)]
        gap = gap_m(of_bodies, floor, floor.pose if place is None else place)
        if math.isfinite(gap):  # else beside the floor: as drawn
            for pose in poses.values():
                pose[2, 3] += draws[SHIFT_AND_TURN.index("z_m")] - gap
    return poses


def _drawn_poses(known: dict, group: list[str], draws: np.ndarray) -> dict:
    """Return the poses of bodies that move together, wherever the floor is."""
    shift, turn = np.split(draws, 2)
    pivot = known[group[0]].pose
    move = pivot @ make_pose(0, 0, 0, *turn) @ np.linalg.inv(pivot)
    move[:3, 3] += shift
    return {name: move @ known[name].pose for name in group}


def _clear_draws(
    known: dict, group: list[str], table: MovedTable, draws: np.ndarray, random, taken: dict
) -> np.ndarray | None:
    """Return draws that keep bodies clear of those that are taken: further ones until they do, None if none does.

    The floor has no part in it, which moves bodies up and down alone.

    taken : name of a body -> the (2, 2) least and greatest x and y of the rectangle about it, and its least distance;
        the bodies are taken, too, from then on
    """
    for _ in range(CLEARANCE_TRIES):
        sides = {
            name: body_bounds(known[name], pose)[:, :2]
            for name, pose in _drawn_poses(known, group, draws).items()
            if isinstance(known[name], Body)
        }
        if all(
            np.maximum(a[0] - b[1], b[0] - a[1]).max() >= max(table.clearance_m, least_m)
            for a in sides.values()
            for b, least_m in taken.values()
        ):
            taken |= {name: (rectangle, table.clearance_m) for name, rectangle in sides.items()}
            return draws
        draws = _draw_move(random, table)
    return None


def _moves(table: MovedTable) -> bool:
    """Return whether a table lets bodies be elsewhere, or absent, in some ping."""
    is_elsewhere = any(np.any(getattr(table, key)) for key in SHIFT_AND_TURN)
    return bool(is_elsewhere or table.there < 1 or table.one_of or table.rests_on)


def _draw_move(random, table: MovedTable) -> np.ndarray:
    """Return the (6,) shift and turn of a table."""
    return np.array([_draw(random, getattr(table, key)) for key in SHIFT_AND_TURN])


def _draw(random, value) -> float:
    """Return a varied value. A constant takes a draw, too, so that later draws do not depend on it."""
    share = random.random()
    return float(value) if isinstance(value, (int, float)) else value[0] + (value[1] - value[0]) * share


def _draw_whole(random, value) -> int:
    """Return a varied whole number: each one from the lower to the upper bound is equally probable."""
    low, high = (int(bound) for bound in np.ravel(value)[[0, -1]])
    return min(int(_draw(random, [low, high + 1])), high)  # rounding may give the upper bound of the draw


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


def _runs(trajectories: list[Trajectory], scenes: list[list[int]]) -> list[TrajectoryRun]:
    """Return the runs of a job, of each trajectory in its scenes. Each begins GAP_S after the one before has ended."""
    runs, first, delay_s, last_s = [], 0, 0.0, None
    for trajectory, in_scenes in zip(trajectories, scenes, strict=True):
        for scene in in_scenes:
            if last_s is not None:
                delay_s = last_s + GAP_S - trajectory[0][0]
            runs.append(TrajectoryRun(scene, trajectory, range(first, first + len(trajectory)), delay_s))
            first += len(trajectory)
            last_s = trajectory[len(trajectory) - 1][0] + delay_s
    return runs


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


def _load_sonars(job: Job) -> tuple[dict[str, Sonar], dict[str, np.ndarray]]:
    """Return the sonars of a job by name, and their mounts."""
    sonars, mounts = {}, {}
    for k, table in enumerate(job.sonars):
        where = f"{job.where}: sonars[{k}]"
        sonar = _load_sonar(job, table, where)
        plain = "".join(c if c.isalnum() else "_" for c in sonar.name)
        name = table.name or (plain if plain[:1].isalpha() else f"sonar_{plain}")
        if name in sonars:
            raise Error(f"{where}.name must differ from those before (got {name!r})")
        sonars[name], mounts[name] = sonar, make_pose(*table.mount)
    return sonars, mounts


def _names_file(name: str) -> bool:
    """Return whether a name can only be that of a file beside the job: presets and bundled scenes have no such name."""
    return Path(name).suffix != "" or len(Path(name).parts) > 1


def _load_sonar(job: Job, table: SonarTable, where: str) -> Sonar:
    name, more = split_sonar(table.sonar)
    path = job.path(name)
    with errors_at(where):
        check_no_link_loop(path)
        sonar = load_sonar(f"{path}{more}" if path.is_file() or _names_file(name) else table.sonar)
        if table.range_m is None:
            return sonar if table.bins is None else replace(sonar, n_bins=table.bins)
    with errors_at(f"{where}.range_m"):
        return sonar.with_range(table.range_m, table.bins)


def _load_acoustics(job: Job) -> Acoustics:
    where = f"{job.where}: acoustics"
    check_moved(where, job.acoustics)
    if "water" in job.acoustics:
        raise Error(f"{where}: water is a table of its own (give a line [water], or water = {{ ... }})")
    return build(Acoustics, {**job.acoustics, "water": build(Water, job.water, f"{job.where}: water")}, where)


def _load_noise(job: Job) -> Noise:
    settings, where = dict(job.noise), f"{job.where}: noise"
    preset = settings.pop("preset", "none")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise Error(f"{where}.preset must be one of {', '.join(PRESETS)} (got {shown(preset)})")
    check_moved_amounts(where, settings)
    settings = asdict(PRESETS[preset]) | settings
    check_keys(Noise, settings, where, also=("preset",))
    return build(Noise, settings, where)


def _check_varied_fields(job: Job, acoustics: Acoustics, noise: Noise) -> None:
    """Check the tables vary.water and vary.noise, and that both ends of their ranges are allowed."""
    where, vary = job.where, job.vary
    for key in vary.water:
        check_choice("key", key, VARIED_WATER, f"{where}: vary.water")
    check_moved_amounts(f"{where}: vary.noise", vary.noise)
    if "median" in vary.noise:
        raise Error(f"{where}: vary.noise: median cannot vary; set it in the table noise (got it here)")
    for end in (0, -1):
        for base, table, name in ((acoustics.water, vary.water, "water"), (noise, vary.noise, "noise")):
            values = {key: np.ravel(value)[end].item() for key, value in table.items()}
            if name == "noise" and (value := values.get(WHOLE_NOISE)) is not None:
                if value != int(value):
                    raise Error(f"{where}: vary.noise.{WHOLE_NOISE} must be whole numbers (got {value:g})")
                values[WHOLE_NOISE] = int(value)
            build(type(base), asdict(base) | values, f"{where}: vary.{name}")
    if vary.water and acoustics.sonar_sound_speed_m_s is not None:
        raise Error(
            f"{where}: vary.water and acoustics.sonar_sound_speed_m_s exclude each other (got both; ranges "
            "would differ from ping to ping; leave one out)"
        )
    if "wind_speed_m_s" in vary.water and acoustics.multipath != "none":
        raise Error(
            f"{where}: vary.water.wind_speed_m_s and acoustics.multipath exclude each other (got both; waves decide "
            "whether the surface reflects; leave one out)"
        )


def _check_times_for_bag(job: Job, trajectories: list[Trajectory]) -> None:
    """Check that the first time of the first run is not negative, which a bag cannot hold; later ones never fall."""
    first = trajectories[0]
    if isinstance(first, FileTrajectory) and (time_s := first.times_s[0]) < 0:
        raise Error(
            f"{job.where}: poses[0].file must hold times from 0 on, for a bag (got {time_s:g} s; shift them)"
        )


def _check_last_time(job: Job, last: TrajectoryRun) -> None:
    """Check that pings, and a bag, can have the time of the last ping; those before are not later."""
    time_s = last.trajectory[-1][0] + last.delay_s
    limit_s, what = (
        (MAX_ROS_TIME_S, "for a bag") if job.ros is not None else (MAX_TIME_S, "as all pings must")
    )
    if time_s >= limit_s:
        raise Error(
            f"{job.where}: poses must end before {limit_s:.10g} s, {what} (got {time_s:.10g} s; give times in seconds, "
            "fewer pings, or a larger ping_rate_hz or speed_m_s)"
        )
