"""The scenes of a job: read from their files, and changed as the job wants."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_gl.batch.job import Job, check_patterns
from sonar_gl.batch.job_settings import can_only_be_file
from sonar_gl.batch.variation import BodyPath, MovedBodies, check_floors
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.input_files import check_no_link_loop, noted_files
from sonar_gl.core.names import matching_names, names_of
from sonar_gl.scene.load import load_scene
from sonar_gl.scene.scene import Scene
from sonar_gl.scene.sdf.resources import GIVE_FOLDERS, SKIP_MISSING
from sonar_gl.scene.sdf.xacro import split_arguments

KEPT = 2  # scenes in memory


class SceneContents(NamedTuple):
    """The names of what is in a scene, and its surface; known also when the scene is no longer in memory."""

    bodies: list[str]
    plumes: list[str]
    surface_z_m: float | None

    @property
    def names(self) -> list[str]:
        """The names of bodies and plumes: all that patterns match."""
        return [*self.bodies, *self.plumes]


class _Kept(NamedTuple):
    """A scene in memory, and what moves in it."""

    scene: Scene
    moved: MovedBodies


class JobScenes(Sequence):
    """The scenes of a job, each a `Scene` with the bodies and the surface that the job wants.

    Only the last KEPT ones are in memory: a further use of another one reads it again. The first time, they are read
    and checked in the order of the job.

    Raises Error at the first use, if a scene cannot be loaded, or lacks a floor on which bodies rest; and once all have
    been read, if the job names what no scene has, or leaves nothing of a scene.
    """

    def __init__(self, job: Job, paths: list[list[BodyPath]]):
        self._job, self._paths = job, paths
        self._contents: list[SceneContents] = []  # of the scenes that have been read
        self._names_in_files, self._files = {}, {}  # ordered sets
        self._hash = hashlib.sha256()
        self._kept: dict[int, _Kept] = {}

    def __len__(self) -> int:
        return len(self._job.scenes)

    def __getitem__(self, index: int) -> Scene:
        return self._keep(range(len(self))[index]).scene

    def moved_bodies(self, index: int) -> MovedBodies:
        """Return what the tables `vary.bodies` change in a scene."""
        return self._keep(index).moved

    @property
    def contents(self) -> list[SceneContents]:
        """What is in each scene."""
        self._read_to(len(self))
        return self._contents

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the job and of its scenes, whose meshes and models may come from files of their own."""
        self._read_to(len(self))
        return self._hash.hexdigest()

    @cached_property
    def files(self) -> dict[str, str]:
        """SHA-256 of each file that decides the pings: of the job, and of its scenes, such as meshes.

        Names are relative to the folder of the job, of files in it.
        """
        self._read_to(len(self))
        folder, found = Path(self._job.folder).absolute(), {}
        for path in map(Path, dict.fromkeys([*map(os.path.abspath, self._job.files()), *self._files])):
            name = path.relative_to(folder) if path.is_relative_to(folder) else path
            found[name.as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
        return found

    def _keep(self, index: int) -> _Kept:
        """Return a scene that is kept in memory from now on."""
        self._read_to(index + 1)
        if index not in self._kept:
            self._add(index, self._changed(self._load(index)))
        return self._kept[index]

    def _add(self, index: int, scene: Scene) -> None:
        while len(self._kept) >= KEPT:
            self._kept.pop(next(iter(self._kept)))
        self._kept[index] = _Kept(scene, MovedBodies(scene, self._job, self._paths))

    def _read_to(self, stop: int) -> None:
        """Read and check the scenes before this one that have not been read yet."""
        for index in range(len(self._contents), stop):
            with noted_files() as files:
                in_file = self._load(index)
            scene = self._changed(in_file)
            bodies, plumes = ([entry.name for entry in kind] for kind in (scene.bodies, scene.plumes))
            contents = SceneContents(bodies, plumes, scene.surface_z_m)
            check_floors(self._job, index, bodies, plumes)
            self._names_in_files |= dict.fromkeys(_names(in_file))
            if index == len(self) - 1:
                self._check_names([*self._contents, contents])
            self._files |= dict.fromkeys(files)
            if index == 0:  # now, since a scene that cannot be read is named better by the one that loads it
                self._hash.update(self._job.digest.encode())
            _add_scene(self._hash, scene)
            self._contents.append(contents)
            self._add(index, scene)

    def _load(self, index: int) -> Scene:
        """Return a scene as it is in its file."""
        job, name = self._job, self._job.scenes[index]
        path, file = job.path(name), job.path(split_arguments(name)[0])
        is_file = any(one.is_file() for one in (file, file / "model.sdf", file / "model.config"))
        folders = [job.path(folder) for folder in job.resource_paths]
        with errors_at(f"{job.where}: scenes[{index}]"):
            check_no_link_loop(path)
            found = str(path) if is_file or can_only_be_file(split_arguments(name)[0]) else name
            return _load_for_job(found, folders, job.skip_missing)

    def _changed(self, scene: Scene) -> Scene:
        """Return a scene as the job wants it. A pattern need not match a body of every scene."""
        job = self._job
        if job.only is not None:
            scene = scene.only(*_matched(job.only, scene))
        if job.without is not None:
            scene = scene.without(*_matched(job.without, scene))
        return scene if job.surface_z_m is None else scene.with_surface(job.surface_z_m)

    def _check_names(self, contents: list[SceneContents]) -> None:
        """Raise an Error if the job names what no scene has, or leaves nothing of a scene."""
        job = self._job
        for key in ("only", "without"):
            check_patterns(getattr(job, key) or [], self._names_in_files, f"{job.where}: {key}")
        for index, one in enumerate(contents) if job.only or job.without else ():
            if not one.names:
                raise Error(
                    f"{job.where}: only and without must leave a body of each scene (got none of scenes[{index}], "
                    f"{job.scenes[index]!r})"
                )
        known = dict.fromkeys(name for one in contents for name in one.names)
        bodies = list(dict.fromkeys(name for one in contents for name in one.bodies))
        for k, table in enumerate(job.vary.bodies):
            where = f"{job.where}: vary.bodies[{k}]"
            check_patterns(table.names, known, f"{where}.names")
            for key in ("scale", "reflectivity"):
                if getattr(table, key) is not None and not matching_names(table.names, bodies):
                    raise Error(f"{where}.{key} must be that of bodies (got bubbles alone, which have none)")


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


def _add_scene(digest, scene: Scene) -> None:
    """Add to a digest all that decides a scene's echo, of which files of meshes and included models have a part."""
    digest.update(repr((scene.surface_z_m, scene.surface_roughness_m)).encode())
    for body in scene.bodies:
        digest.update(
            repr((body.name, body.material, body.specular, body.roughness_rad, body.speckle_shape)).encode()
        )
        arrays = (body.pose, body.surface.vertices, body.surface.faces, body.reflectivity)
        for array in (*arrays, np.empty(0) if body.normals is None else body.normals):
            digest.update(np.ascontiguousarray(array).tobytes())
    for plume in scene.plumes:
        settings = [getattr(plume, field.name) for field in fields(plume) if field.name != "pose"]
        digest.update(repr(settings).encode() + plume.pose.tobytes())
