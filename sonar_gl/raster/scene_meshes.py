"""The bodies of a scene on the CPU: the patches of their meshes, where they are, and what a sector draws of
them.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from sonar_gl.core.worker import SecondThread
from sonar_gl.raster.cull import (
    BodyBoxes,
    BodyPlaces,
    DetailLimits,
    PatchTree,
    choose_patches,
    draw_patches,
    place_bodies,
)
from sonar_gl.raster.draw_list import (
    LOBE,
    PER_BODY,
    REFLECTIVITY,
    BodiesInView,
    DrawList,
    SectorDraws,
    SectorView,
    distance_before_plane,
    window_about,
)
from sonar_gl.raster.level_of_detail import Levels, mesh_with_levels
from sonar_gl.raster.small_triangles import (
    DrawnTriangles,
    PatchFaces,
    PlacedBodies,
    Vertices,
    rasterize_small_triangles,
)
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.fan import NEAR_M

# A patch replaces its mesh where its geometric error is at most so many samples, and where its echo changes
# by at most so much per radian of a sample's width; not at all where its normals make a specular lobe.
ERROR_SAMPLES, ECHO_PER_RAD = 0.01, 2.0
TWO_THREADS = 4000  # faces, below which one thread is as fast
LAYERS = 2  # samples rasterised in software, per sample of a sector; what exceeds this is drawn
LEVEL_FIELDS = tuple(field.name for field in fields(Levels))


class SceneMeshes:
    """The bodies of a scene. Poses are float64 until they have been taken relative to the sonar.

    Parameters
    ----------
    rasterizes : leave out triangles that meet no sample, and rasterise small ones in software
    thread : for the second half of that
    surface_z_m : of the water, which ends there for a sonar in it; or None

    Attributes
    ----------
    bodies : list of Body, in the order of their numbers
    state : SceneState, unless a ping has its own
    rows : (n, PER_BODY) float32, positions not filled in
    boxes : BodyBoxes
    levels : the patches of all meshes, one after the other: fields of `Levels` by name
    """

    def __init__(
        self,
        rasterizes: bool = False,
        thread: SecondThread | None = None,
        surface_z_m: float | None = None,
    ):
        self.rasterizes, self._surface_z_m, self._thread = rasterizes, surface_z_m, thread
        self.bodies, self.state = [], SceneState(np.empty((0, 4, 4)), np.empty(0, bool))
        self.rows = np.empty((0, PER_BODY), np.float32)
        self.boxes = BodyBoxes(
            centres=np.empty((0, 3)),
            bounds=np.empty((0, 2, 3)),
            closed=np.empty(0, np.int64),
            roots=np.empty((0, 2), np.int64),
            order=np.empty(0, np.int64),
        )
        self.levels: dict[str, np.ndarray] = {}
        self._vertices = Vertices(
            np.empty((0, 3), np.float32), np.empty((0, 3), np.float32), np.empty(0, np.float32)
        )
        self._tree = self._faces = ()
        self._meshes = {}
        self._chosen = np.empty((0, 2), np.int32)

    @property
    def reflectivity(self) -> np.ndarray:
        """(n,) float32 of bodies, 1 where each face has its own."""
        return self.rows[:, REFLECTIVITY]

    def add(self, bodies) -> list:
        """Append bodies. Those that share a mesh share all that is made of it. A copy made before stays as it is.

        Returns
        -------
        the new meshes, `MeshWithLevels`, in the order of their vertices
        """
        made, added, rows, meshes = [], [], [], dict(self._meshes)  # copies of this object have the old one
        n_patches = len(self.levels.get("skip", ()))
        for number, body in enumerate(bodies, len(self.bodies)):
            by_face = np.ndim(body.reflectivity) > 0
            key = id(body.surface), id(body.normals), id(body.reflectivity) if by_face else None
            if key not in meshes:
                one = mesh_with_levels(body)
                end = n_patches + len(one.levels.skip)
                meshes[key] = one.centre, one.bounds, one.closed, (n_patches, end)
                n_patches = end
                made.append(one)
            added.append(meshes[key])
            mu = 1.0 if by_face else body.reflectivity
            rows.append([0.0] * 12 + [mu, number, body.specular, body.roughness_rad])
        self._meshes = meshes
        self._append_levels(made)
        if bodies:
            self.rows = np.concatenate([self.rows, np.asarray(rows, self.rows.dtype)])
            columns = (
                np.concatenate([old, np.asarray(column, old.dtype)])
                for old, column in zip(self.boxes, zip(*added, strict=True), strict=False)
            )
            boxes = BodyBoxes(*columns, order=self.boxes.order)
            self.boxes = boxes._replace(order=np.argsort(boxes.closed == 0, kind="stable"))
            poses = np.concatenate([self.state.poses, [body.pose for body in bodies]])
            self.state = SceneState(poses, np.append(self.state.present, np.ones(len(bodies), bool)))
            self.bodies = [*self.bodies, *bodies]
            most = [self.levels["leaf"][first:end].sum() for first, end in boxes.roots]
            self._chosen = np.empty((int(sum(most)), 2), np.int32)
        return made

    def _append_levels(self, made) -> None:
        """Append the patches of meshes."""
        parts = {name: [column] for name, column in self.levels.items()}
        parts = parts or {name: [] for name in LEVEL_FIELDS}
        n_patches, n_faces = len(self.levels.get("skip", ())), len(self.levels.get("faces", ()))
        n_vertices = len(self._vertices.points)
        for one in made:
            shifts = {"skip": n_patches, "first_vertex": n_vertices, "first_face": n_faces}
            for name in LEVEL_FIELDS:
                parts[name].append(getattr(one.levels, name) + shifts.get(name, 0))
            n_patches += len(one.levels.skip)
            n_vertices += len(one.points)
            n_faces += len(one.levels.faces)
        if made:
            self.levels = {name: np.concatenate(columns) for name, columns in parts.items()}
            self._tree = tuple(self.levels[name] for name in PatchTree._fields)
            self._faces = tuple(self.levels[name] for name in PatchFaces._fields)
            points = np.concatenate([self._vertices.points, *(one.points for one in made)])
            self._vertices = Vertices(
                points if self.rasterizes else points[:0],  # otherwise the driver has them
                self._appended("normals", made, np.zeros(3, np.float32)),
                self._appended("reflectivity", made, np.float32(1.0)),
            )

    def _appended(self, name, made, default):
        """Return an attribute of all vertices, as soon as any mesh has it."""
        old = getattr(self._vertices, name)
        if not self.rasterizes or (not len(old) and all(getattr(one, name) is None for one in made)):
            return old
        if not len(old):
            n = len(self._vertices.points)
            old = np.tile(default, (n,) + (1,) * default.ndim).reshape(-1, *default.shape)
        parts = [getattr(one, name) for one in made]
        fill = [np.broadcast_to(default, (len(one.points), *default.shape)) for one in made]
        return np.concatenate([old, *(f if p is None else p for p, f in zip(parts, fill, strict=True))])

    def view_from(
        self, pose, state: SceneState | None = None, plane=None, specular: bool = False
    ) -> BodiesInView:
        """Return the bodies as seen from `pose`, world_from_sonar.

        Parameters
        ----------
        plane : of `BodiesInView`; None is the water's surface, if there is one
        specular : with the lobes of smooth bodies
        """
        state = state or self.state
        matrices, rows = np.zeros((len(state.poses), 3, 4)), self.rows.copy()
        if state.reflectivity is not None:
            rows[:, REFLECTIVITY] = state.reflectivity
        if not specular:
            rows[:, LOBE] = 0.0
        outside = place_bodies(state.poses, state.present, tuple(self.boxes), pose, NEAR_M, matrices, rows)
        present, is_cut = state.present, np.zeros(len(state.present), bool)
        if plane is None and self._surface_z_m is not None and pose[2, 3] < self._surface_z_m:
            plane = np.append(-pose[2, :3], self._surface_z_m - pose[2, 3])
        if plane is not None:
            nearest, furthest = distance_before_plane(plane, matrices, self.boxes.bounds)
            present, is_cut = present & (furthest > 0), nearest < 0
        return BodiesInView(matrices, rows, present, outside, plane, is_cut)

    def draw_sector(
        self, view: SectorView, bodies: BodiesInView, far_m, range_max_m, row: int, out: DrawList
    ) -> SectorDraws:
        """Add what a sector draws to `out`; `row` is where the rows of `bodies` begin."""
        extent = np.array([np.inf, -np.inf, np.inf, -np.inf])
        first, first_sample = out.draws.used, out.samples.used
        lobes = bodies.rows[:, LOBE] > 0
        limits = DetailLimits(
            near_m=NEAR_M,
            far_m=float(far_m),  # a whole number would have the kernel compiled a second time
            range_max_m=float(range_max_m),
            error_per_m=ERROR_SAMPLES * view.sample_rad,
            echo_errors=np.where(lobes, 0.0, ECHO_PER_RAD * view.sample_rad),
        )
        n = choose_patches(
            self._tree,
            tuple(self.boxes),
            tuple(BodyPlaces(bodies.present, bodies.matrices, bodies.outside)),
            view.geometry,
            tuple(limits),
            self._chosen,
            extent,
        )
        chosen = self._chosen[:n]
        if self.rasterizes:
            n_closed = self._rasterize(view, bodies, row, chosen, out)
        else:
            (draws,) = out.draws.reserve(n)
            first_face, n_faces = self.levels["first_face"], self.levels["n_faces"]
            n_closed = draw_patches(chosen, first_face, n_faces, self.boxes.closed, row, draws)
            out.draws.used += n
        window = window_about(extent, view.sector.columns, view.sector.rows)
        samples = slice(first_sample, out.samples.used)
        return SectorDraws(first, n_closed, out.draws.used - first, samples, window)

    def _rasterize(self, view, bodies, row, chosen, out) -> int:
        """Add the triangles of patches that meet a sample; return how many draws are of closed bodies."""
        counts = self.levels["n_faces"][chosen[:, 0]]
        ends, sector = counts.cumsum(), view.sector
        total = int(ends[-1]) if len(ends) else 0
        half = int(ends.searchsorted(total // 2)) if total > TWO_THREADS else len(chosen)
        n_samples = LAYERS * sector.columns * sector.rows
        starts = (0, int(ends[half - 1]) if half else 0)
        (draws,), (indices,) = out.draws.reserve(len(chosen)), out.indices.reserve(3 * total)
        samples = out.samples.reserve(2 * n_samples)
        placed = PlacedBodies(bodies.matrices, bodies.rows, bodies.is_cut, self.boxes.closed, bodies.outside)

        def work(which):
            part = slice(half, None) if which else slice(0, half)
            drawn = DrawnTriangles(
                draws=draws[part],
                indices=indices[3 * starts[which] :],
                first_index=out.indices.used,
                first_row=row,
            )
            return rasterize_small_triangles(
                chosen[part],
                self._faces,
                tuple(self._vertices),
                tuple(placed),
                view.geometry,
                NEAR_M,
                tuple(drawn),
                tuple(array[which * n_samples :][:n_samples] for array in samples),
            )

        if half == len(chosen):
            n_closed, n, used, filled = work(0)
        else:
            first, second = self._thread.run_halves(work) if self._thread else (work(0), work(1))
            (n_closed, n, used, filled), (more_closed, more, more_used, more_filled) = first, second
            draws[n : n + more] = draws[half : half + more]
            draws[n : n + more, 2] += used
            begin = 3 * starts[1]
            indices[used : used + more_used] = indices[begin : begin + more_used]
            for array in samples:
                array[filled : filled + more_filled] = array[n_samples : n_samples + more_filled]
            n_closed, n = n_closed + more_closed, n + more
            used, filled = used + more_used, filled + more_filled
        out.draws.used += n
        out.indices.used += used
        out.samples.used += filled
        return n_closed
