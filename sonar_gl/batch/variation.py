"""What changes from ping to ping: bodies of a scene, by random draws and along paths, and fields of water and noise."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import Water
from sonar_gl.batch.job import Job, MovedTable, build
from sonar_gl.batch.random_streams import CLEARANCE_STREAM, PATH_STREAM, generator
from sonar_gl.batch.trajectories import Trajectory
from sonar_gl.core.checks import check_choice
from sonar_gl.core.errors import Error, errors_at, nearest_of_many
from sonar_gl.core.input_files import check_kind_of_file
from sonar_gl.core.names import matching_names
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.core.poses import read_poses
from sonar_gl.core.warn import collected_warnings
from sonar_gl.noise.settings import Noise, check_moved_amounts
from sonar_gl.scene.extent import body_bounds, gap_m
from sonar_gl.scene.scene import Body, Scene

CLEARANCE_TRIES = 100  # places that are drawn for a body; it is absent if none is clear
SHIFT_AND_TURN = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
WHOLE_NOISE = "looks"  # the field of the noise that is a whole number, and may vary
VARIED_WATER = tuple(field.name for field in fields(Water) if not field.name.endswith("_formula"))

# ---- checks -----------------------------------------------------------------------------------------


def check_varied_fields(job: Job, acoustics: Acoustics, noise: Noise) -> None:
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
            # a level that is too high is so at the upper end, and need not be warned of twice
            with collected_warnings() if (name, end) == ("noise", 0) else nullcontext():
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


def check_floors(job: Job, index: int, bodies: Iterable[str], plumes: Iterable[str]) -> None:
    """Raise an Error if a scene lacks the floor on which a table rests bodies, or it moves with them or later."""
    tables, known = job.vary.bodies, [*bodies]
    named = [matching_names(table.names, [*known, *plumes]) for table in tables]
    for k, (table, names) in enumerate(zip(tables, named, strict=True)):
        floor = table.rests_on
        if floor is None or not names:
            continue
        where = f"{job.where}: vary.bodies[{k}].rests_on must name a body"
        if floor in names:
            raise Error(f"{where} that does not move with the others (got {floor!r})")
        later = next((n for n in range(k + 1, len(tables)) if floor in named[n]), None)
        if later is not None:
            raise Error(
                f"{where} that no later table names (got {floor!r}, which vary.bodies[{later}] names; give that "
                "table first)"
            )
        if floor not in known:
            hint = nearest_of_many(floor, known)
            raise Error(
                f"{where} of each scene of {names[0]!r} (got {floor!r}, which scenes[{index}] lacks; {hint})"
            )


# ---- paths of bodies ----------------------------------------------------------------------------------


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


# ---- bodies -----------------------------------------------------------------------------------------


class MovedBodies:
    """The bodies and plumes of a scene that the tables `vary.bodies` change, and their random draws.

    known : name -> body or plume of the scene, also those that no table names
    """

    def __init__(self, scene: Scene, job: Job, paths: list[list[BodyPath]]):
        self.known = {entry.name: entry for entry in scene.bodies_and_plumes}
        self._seed, self._models = job.seed, scene.models
        self._tables = [
            (table, of_table, _groups(table, [*self.known], scene.models))
            for table, of_table in zip(job.vary.bodies, paths, strict=True)
        ]

    def draw(
        self, number: int, random: np.random.Generator, run_start: int, time_s: float
    ) -> tuple[dict, dict, list[str]]:
        """Draw the changes of a ping: `bodies` and `reflectivity` of its request, and names without a clear place.

        run_start : number of the first ping of its run, for which tables with a path draw
        time_s : its time on the trajectory, and on paths; later than that of `number` where draws hold
        """
        # taken: what keeps clear of each other; gone: what is absent though it follows a path
        bodies, reflectivity, taken, gone, unplaced = {}, {}, {}, {}, {}
        for k, (table, paths, groups) in enumerate(self._tables):
            source = generator(self._seed, PATH_STREAM, run_start, k) if paths else random
            chosen = draw_whole(source, [0, len(groups) - 1]) if table.one_of and groups else None
            for n, group in enumerate(groups):
                draws = _draw_move(source, table)
                is_present = source.random() < table.there and chosen in (None, n)
                mu = None if table.reflectivity is None else draw_value(source, table.reflectivity)
                scale = 1.0 if table.scale is None else draw_value(source, table.scale)
                path = paths[draw_whole(source, [0, len(paths) - 1])] if paths else None
                for name in group:  # of two tables the later one counts, also where it changes nothing
                    for found in (bodies, reflectivity, taken, gone, unplaced):
                        found.pop(name, None)
                if not group:
                    continue
                home = self.known[group[0]].pose if path is None else self._home(table, group)
                place = home if path is None else path.at(time_s)
                is_present = is_present and place is not None and table.rests_on not in gone
                move = _Move(group, home, place, scale)
                if is_present and table.clearance_m is not None:
                    # a stream of its own: no other draw depends on how many these are
                    more = generator(self._seed, CLEARANCE_STREAM, number, k, n)
                    draws = _clear_draws(self.known, move, table, draws, more, taken)
                    is_present = draws is not None
                    if not is_present:
                        unplaced |= dict.fromkeys(group)
                if not is_present:
                    bodies |= dict.fromkeys(group)
                    if path is not None:
                        gone |= dict.fromkeys(group)
                    continue
                is_moved = draws.any() or scale != 1.0 or table.rests_on is not None or path is not None
                if is_moved or mu is not None:
                    bodies |= _moved_poses(self.known, move, table, draws, bodies)
                if mu is not None:
                    reflectivity |= {name: mu for name in group if hasattr(self.known[name], "reflectivity")}
        return bodies, reflectivity, list(unplaced)

    def _home(self, table: MovedTable, group: list[str]) -> np.ndarray:
        """Return the pose in the scene of what follows a path: of the model if several parts of one do, else of a body.

        It is that of the innermost model that has them all, or of the first body if none has. Of a model whose parts
        are named as a whole, one may be left in the scene.
        """
        first, *others = group
        together = not (table.apart or table.one_of)
        for whole in reversed(names_of_wholes(first)):
            is_whole = others or (together and f"{whole}::*" in table.names)
            if is_whole and whole in self._models and all(name.startswith(f"{whole}::") for name in others):
                return self._models[whole]
        return self.known[first].pose


class _Move(NamedTuple):
    """A move of bodies that keeps them as they are to each other.

    names : of the bodies
    home, place : (4, 4) pose of what they are in or about, in the scene and in this ping before shift and turn; the
        same if they follow no path
    scale : times their size, about the origin of that pose
    """

    names: list[str]
    home: np.ndarray
    place: np.ndarray
    scale: float


def _groups(table: MovedTable, known: list[str], models: Iterable[str]) -> list[list[str]]:
    """Return the bodies of a scene that a table moves or chooses from, those that move together in one list.

    A model whose name a pattern matches moves as a whole, the outermost of several: a fish with its tail.

    known, models : names of all bodies and plumes of the scene, and of its models
    """
    names = matching_names(table.names, known)
    if not (table.apart or table.one_of):
        return [names]
    # a body of MuJoCo is a model, too, whose parts are named after it
    moved_models, groups = set(matching_names(table.names, [*models, *names])), {}
    for name in names:
        whole = next((whole for whole in names_of_wholes(name) if whole in moved_models), name)
        groups.setdefault(whole, []).append(name)
    return list(groups.values())


def names_of_wholes(name: str) -> list[str]:
    """Return the names of the models and bodies of which something is a part, the outermost first.

    >>> names_of_wholes("school::fish::tail")
    ['school', 'school::fish']
    """
    parts = name.split("::")
    return ["::".join(parts[:n]) for n in range(1, len(parts))]


def _moved_poses(known: dict, move: _Move, table: MovedTable, draws: np.ndarray, placed: dict) -> dict:
    """Return the poses of bodies that move together, given their draws and the poses of tables before."""
    poses = _drawn_poses(known, move, draws)
    if table.rests_on is not None:
        floor, place = known[table.rests_on], placed.get(table.rests_on)
        of_bodies = [(known[name], pose) for name, pose in poses.items() if isinstance(known[name], Body)]
        gap = gap_m(of_bodies, floor, floor.pose if place is None else place)
        if math.isfinite(gap):  # else beside the floor: as drawn
            for pose in poses.values():
                pose[2, 3] += draws[SHIFT_AND_TURN.index("z_m")] - gap
    return poses


def _drawn_poses(known: dict, move: _Move, draws: np.ndarray) -> dict:
    """Return the poses of bodies that move together, wherever the floor is."""
    shift, turn = np.split(draws, 2)
    turned = make_pose(0, 0, 0, *turn)
    turned[:3, :3] *= move.scale
    moved = move.place @ turned @ np.linalg.inv(move.home)
    moved[:3, 3] += shift
    return {name: moved @ known[name].pose for name in move.names}


def _clear_draws(
    known: dict, move: _Move, table: MovedTable, draws: np.ndarray, random, taken: dict
) -> np.ndarray | None:
    """Return draws that keep bodies clear of those that are taken: further ones until they do, None if none does.

    The floor has no part in it, which moves bodies up and down alone.

    taken : name of a body -> the (2, 2) least and greatest x and y of the rectangle about it, and its least distance;
        the bodies are taken, too, from then on
    """
    for _ in range(CLEARANCE_TRIES):
        sides = {
            name: body_bounds(known[name], pose)[:, :2]
            for name, pose in _drawn_poses(known, move, draws).items()
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


# ---- draws ------------------------------------------------------------------------------------------


def _draw_move(random: np.random.Generator, table: MovedTable) -> np.ndarray:
    """Return the (6,) shift and turn of a table."""
    return np.array([draw_value(random, getattr(table, key)) for key in SHIFT_AND_TURN])


def draw_value(random: np.random.Generator, value) -> float:
    """Return a varied value. A constant takes a draw, too, so that later draws do not depend on it."""
    share = random.random()
    return float(value) if isinstance(value, (int, float)) else value[0] + (value[1] - value[0]) * share


def draw_whole(random: np.random.Generator, value) -> int:
    """Return a varied whole number: each one from the lower to the upper bound is equally probable."""
    low, high = (int(bound) for bound in np.ravel(value)[[0, -1]])
    return min(
        int(draw_value(random, [low, high + 1])), high
    )  # rounding may give the upper bound of the draw


def draw_fields(random: np.random.Generator, table: dict) -> dict:
    """Return the varied fields of the water or the noise."""
    draw_as = {WHOLE_NOISE: draw_whole}
    return {key: draw_as.get(key, draw_value)(random, value) for key, value in sorted(table.items())}
