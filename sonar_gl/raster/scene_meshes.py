"""The bodies of a scene on the CPU: the patches of their meshes, where they are, and what a sector draws of
them.
"""

from __future__ import annotations

from dataclasses import fields
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sonar_gl.core.memory import DynamicArrays
from sonar_gl.core.warn import warn_caller
from sonar_gl.raster.cull import (
    LOBE,
    PER_BODY,
    REFLECTIVITY,
    BodyBoxes,
    PatchTree,
    body_spans,
    choose_in_sectors,
    place_bodies,
)
from sonar_gl.raster.level_of_detail import EXTREMES, Levels, mesh_with_levels
from sonar_gl.raster.views import BodiesInView, SectorViews, distance_before_plane
from sonar_gl.scene.scene import Body
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.fan import NEAR_M, SURFACE_MARGIN_M

LEVEL_FIELDS = tuple(field.name for field in fields(Levels))
MANY_FACES = 5_000_000  # whose levels of detail take ten seconds or more


class _KnownMesh(NamedTuple):
    """What is kept of a mesh for more bodies that have it.

    key : by which it is found
    made_of : held, so that no other object has the id of one of these: a body may take another surface later
    box : a row of each array of `BodyBoxes` but `order`
    n_leaves : how many of its patches a sector may choose
    """

    key: tuple
    made_of: tuple
    box: tuple
    n_leaves: int


class SceneMeshes:
    """The bodies of a scene. Poses are float64 until they have been taken relative to the sonar.

    surface_z_m : of the water, which ends there for a sonar in it; or None
    bodies : (n,) array of Body, in the order of their numbers
    state : SceneState, unless a ping has its own
    table : (n, PER_BODY) float32, as of `BodiesInView`; positions not filled in
    boxes : BodyBoxes
    levels : the patches of all meshes, one after the other: fields of `Levels` by name
    most_patches : that a sector may choose
    """

    def __init__(self, surface_z_m: float | None = None):
        self._surface_z_m, self.most_patches = surface_z_m, 0
        self.bodies = np.empty(0, object)
        self.state = SceneState(np.empty((0, 4, 4)), np.empty(0, bool))
        self.table = np.empty((0, PER_BODY), np.float32)
        self._columns = {
            "centres": np.empty((0, 3)),
            "bounds": np.empty((0, 2, 3)),
            "extremes": np.empty((0, EXTREMES, 3)),
            "spheres": np.empty((0, 2)),
            "closed": np.empty(0, np.int64),
            "roots": np.empty((0, 2), np.int64),
        }
        self.levels: dict[str, np.ndarray] = {}
        self._tree, self._has_lobes = (), False
        # Copies of this object share both. The place of a key counts if the mesh there has that key: it may be of a
        # copy that nobody kept.
        self._arrays, self._places = DynamicArrays(), {}
        self._meshes = np.empty(0, object)  # _KnownMesh of each mesh

    @property
    def reflectivity(self) -> np.ndarray:
        """(n,) float32 of bodies, 1 where each face has its own."""
        return self.table[:, REFLECTIVITY]

    @cached_property
    def boxes(self) -> BodyBoxes:
        """BodyBoxes; found when they are asked for, as the order of bodies is another one after each `add`."""
        order = np.argsort(self._columns["closed"] == 0, kind="stable")
        return BodyBoxes(**self._columns, order=order)

    def add(self, bodies) -> list:
        """Append bodies. Those that share a mesh share all that is made of it, unless it was changed meanwhile. A copy
        made before stays as it is. Takes no more time where there are many bodies.

        Returns the new meshes, `MeshWithLevels`, in the order of their vertices.
        """
        made, boxes, rows, new = [], [], [], {}
        n_patches = len(self.levels.get("skip", ()))
        for number, body in enumerate(bodies, len(self.bodies)):
            by_face = np.ndim(body.reflectivity) > 0
            made_of = body.surface, body.normals, body.reflectivity if by_face else None
            key = tuple(map(id, made_of))
            known = self._known_mesh(key) or new.get(key)
            if known is None:
                _warn_of_many_faces(body)
                one = mesh_with_levels(body)
                end = n_patches + len(one.levels.skip)
                box = one.centre, one.bounds, one.extremes, one.radii, one.closed, (n_patches, end)
                known = new[key] = _KnownMesh(key, made_of, box, int(one.levels.leaf.sum()))
                n_patches = end
                made.append(one)
            boxes.append(known.box)
            self.most_patches += known.n_leaves
            mu = 1.0 if by_face else body.reflectivity
            rows.append([0.0] * 12 + [mu, number, body.specular, body.roughness_rad])
        self._append_levels(made)
        if not rows:
            return made
        self._places.update(zip(new, range(len(self._meshes), len(self._meshes) + len(new)), strict=True))
        self._meshes = self._append("meshes", self._meshes, new.values())
        rows = np.asarray(rows, self.table.dtype)
        self.table = self._arrays.append("table", self.table, [rows])
        self._has_lobes |= bool((rows[:, LOBE] > 0).any())
        self._columns = {
            name: self._arrays.append(name, old, [np.asarray(column, old.dtype)])
            for (name, old), column in zip(self._columns.items(), zip(*boxes, strict=True), strict=True)
        }
        vars(self).pop("boxes", None)
        state = self.state
        poses = self._arrays.append("poses", state.poses, [[body.pose for body in bodies]])
        present = self._arrays.append("present", state.present, [np.ones(len(bodies), bool)])
        self.state = SceneState(poses, present)
        self.bodies = self._append("bodies", self.bodies, bodies)
        return made

    def _known_mesh(self, key: tuple) -> _KnownMesh | None:
        """Return the mesh of a key; None for a new one."""
        place = self._places.get(key, len(self._meshes))
        known = self._meshes[place] if place < len(self._meshes) else None
        return None if known is None or known.key != key else known

    def _append(self, name: str, old: np.ndarray, things) -> np.ndarray:
        """Return an array of objects and more of them."""
        return self._arrays.append(name, old, [np.fromiter(things, object, len(things))])

    def _append_levels(self, made) -> None:
        """Append the patches of meshes."""
        n_patches, n_faces = len(self.levels.get("skip", ())), len(self.levels.get("faces", ()))
        n_vertices, parts = len(self.levels.get("vertices", ())), {name: [] for name in LEVEL_FIELDS}
        for one in made:
            shifts = {"skip": n_patches, "first_vertex": n_vertices, "first_face": n_faces}
            for name in LEVEL_FIELDS:
                parts[name].append(getattr(one.levels, name) + shifts.get(name, 0))
            n_patches += len(one.levels.skip)
            n_vertices += len(one.points)
            n_faces += len(one.levels.faces)
        if made:
            old = self.levels or {name: columns[0][:0] for name, columns in parts.items()}
            self.levels = {name: self._arrays.append(name, old[name], parts[name]) for name in LEVEL_FIELDS}
            self._tree = tuple(self.levels[name] for name in PatchTree._fields)

    def view_from(
        self, pose, state: SceneState | None = None, plane=None, specular: bool = False
    ) -> BodiesInView:
        """Return the bodies as seen from `pose`, world_from_sonar.

        plane : of `BodiesInView`; None is the water's surface, if there is one
        specular : with the lobes of smooth bodies
        """
        state = state or self.state
        matrices, table = np.zeros((len(state.poses), 3, 4)), self.table.copy()
        if state.reflectivity is not None:
            table[:, REFLECTIVITY] = state.reflectivity
        if not specular:
            table[:, LOBE] = 0.0
        outside = place_bodies(state.poses, state.present, tuple(self.boxes), pose, NEAR_M, matrices, table)
        present, is_cut = state.present, np.zeros(len(state.present), bool)
        if plane is None and self._surface_z_m is not None and pose[2, 3] < self._surface_z_m:
            plane = np.append(-pose[2, :3], self._surface_z_m - SURFACE_MARGIN_M - pose[2, 3])
        if plane is not None:
            nearest, furthest = distance_before_plane(plane, matrices, self.boxes.bounds)
            present, is_cut = present & (furthest > 0), nearest < 0
        spheres = np.where(is_cut[:, None], 0.0, self.boxes.spheres)
        spans = body_spans(matrices, self.boxes.bounds, self.boxes.extremes, spheres, NEAR_M)
        has_lobes = specular and self._has_lobes
        return BodiesInView(present, matrices, table, outside, has_lobes, plane, is_cut, spans)

    def choose(self, views: SectorViews, bodies: BodiesInView, out: np.ndarray) -> np.ndarray:
        """Choose what each of S sectors draws of bodies.

        Returns (S, 6) int64: how many patches of a sector are chosen, how many faces these have, and its Window.

        out : (S, most_patches or more, 2) int32, overwritten with patches and bodies
        """
        found = np.zeros((len(out), 6), np.int64)
        if len(self.bodies):
            boxes, (geometry, limits) = tuple(self.boxes), views
            choose_in_sectors(self._tree, boxes, bodies.placed, geometry, limits, out, found)
        return found


def _warn_of_many_faces(body: Body) -> None:
    """Warn of a mesh before a preparation that looks like a hang."""
    n_faces = len(body.surface.faces)
    if n_faces > MANY_FACES:
        warn_caller(
            f"body {body.name!r} has {n_faces} triangles, whose levels of detail take ten seconds to some minutes, "
            "and a gigabyte or more, in each process; fewer triangles serve where these are smaller than a bin"
        )
