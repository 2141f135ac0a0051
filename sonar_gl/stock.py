"""The bodies of a run on the CPU: their meshes' patches, where they are, and what of them a sector sees."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from sonar_gl.cull import draw_patches, place, see
from sonar_gl.detail import Levels
from sonar_gl.draws import LOBE, PER_BODY, Draws, Placed, SectorView, Whereabouts, before_plane, window_of
from sonar_gl.pair import Pair
from sonar_gl.prepared import prepare
from sonar_gl.sift import sift_patches

# Nearer than this the sonar looks through things: its own face is not an echo.
NEAR_M = 1e-3
# A patch stands in for its mesh where it strays by no more than so many samples, and where its echo changes
# by no more than so much per radian of a sample's width; not at all where its normals make a lobe.
STRAY_SAMPLES, ECHO_PER_RAD = 0.01, 2.0
TWO_THREADS = 4000  # faces, below which one sifts as quickly
LAYERS = 2  # samples that are filled in, for each of a sector; of more triangles are drawn
PATCHES = tuple(field.name for field in fields(Levels))


class Stock:
    """The bodies of a run. Poses are float64 until they have been taken relative to the sonar.

    Attributes
    ----------
    bodies : list of Body, in the order of their numbers
    where : Whereabouts, unless a ping is told otherwise
    rows : (n, PER_BODY) float32, places not filled in
    surface_z_m : of the water, which ends there for a sonar in it; or None
    sifts : whether triangles that meet no sample are left out beforehand, and small ones filled in
    """

    def __init__(self, sifts: bool = False):
        self.sifts, self.surface_z_m = sifts, None
        self.bodies, self.where = [], Whereabouts(np.empty((0, 4, 4)), np.empty(0, bool))
        self.rows = np.empty((0, PER_BODY), np.float32)
        self.roots, self.closed = np.empty((0, 2), np.int64), np.empty(0, np.int64)
        self.centres, self.bounds = np.empty((0, 3)), np.empty((0, 2, 3))
        self.patches: dict[str, np.ndarray] = {}
        self.points, self.normals = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
        self.reflectivity = np.empty(0, np.float32)
        self._known, self._pair = {}, None
        self._chosen = np.empty((0, 2), np.int32)

    def add(self, bodies) -> list:
        """More bodies, after those that are there. Those that share a mesh share all that is made of it.

        Returns
        -------
        what is new to the stock, `Prepared`, in the order of its vertices
        """
        made, columns = [], {"roots": [], "closed": [], "centres": [], "bounds": [], "rows": []}
        n_patches = len(self.patches.get("skip", ()))
        for number, body in enumerate(bodies, len(self.bodies)):
            split = np.ndim(body.reflectivity) > 0
            key = id(body.surface), id(body.normals), id(body.reflectivity) if split else None
            if key not in self._known:
                one = prepare(body)
                end = n_patches + len(one.levels.skip)
                self._known[key] = (n_patches, end), one.closed, one.centre, one.bounds
                n_patches = end
                made.append(one)
            mu = 1.0 if split else body.reflectivity
            row = [0.0] * 12 + [mu, number, body.specular, body.roughness_rad]
            for name, value in zip(columns, (*self._known[key], row), strict=True):
                columns[name].append(value)
        self._take(made)
        if bodies:
            for name, column in columns.items():
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.asarray(column, old.dtype)]))
            poses = np.concatenate([self.where.poses, [body.pose for body in bodies]])
            self.where = Whereabouts(poses, np.append(self.where.shown, np.ones(len(bodies), bool)))
            self.order = np.argsort(self.closed == 0, kind="stable")
            self.bodies = [*self.bodies, *bodies]
            most = [self.patches["leaf"][first:end].sum() for first, end in self.roots]
            self._chosen = np.empty((int(sum(most)), 2), np.int32)
        return made

    def _take(self, made) -> None:
        """Put meshes' patches after those that are there."""
        parts = {name: [column] for name, column in self.patches.items()} or {name: [] for name in PATCHES}
        n_patches = len(self.patches.get("skip", ()))
        n_vertices, n_faces = len(self.points), len(self.patches.get("faces", ()))
        for one in made:
            shifts = {"skip": n_patches, "first_vertex": n_vertices, "first_face": n_faces}
            for name in PATCHES:
                parts[name].append(getattr(one.levels, name) + shifts.get(name, 0))
            n_patches += len(one.levels.skip)
            n_vertices += len(one.points)
            n_faces += len(one.levels.faces)
        if made:
            self.patches = {name: np.concatenate(columns) for name, columns in parts.items()}
            self.normals = self._spread("normals", made, np.zeros(3, np.float32))
            self.reflectivity = self._spread("reflectivity", made, np.float32(1.0))
            self.points = np.concatenate([self.points, *(one.points for one in made)])
            if not self.sifts:  # the driver has them
                self.points = self.points[:0]

    def _spread(self, name, made, none):
        """Of each vertex, once there are any that have it."""
        old = getattr(self, name)
        if not self.sifts or (not len(old) and all(getattr(one, name) is None for one in made)):
            return old
        if not len(old):
            old = np.tile(none, (len(self.points),) + (1,) * none.ndim).reshape(-1, *none.shape)
        parts = [getattr(one, name) for one in made]
        fill = [np.broadcast_to(none, (len(one.points), *none.shape)) for one in made]
        return np.concatenate([old, *(f if p is None else p for p, f in zip(parts, fill, strict=True))])

    def place(self, pose, where: Whereabouts | None = None, plane=None, specular: bool = False) -> Placed:
        """The bodies as seen from `pose`, world_from_sonar.

        Parameters
        ----------
        plane : of `Placed`; None is the water's surface, if there is one
        specular : with their lobes
        """
        where = where or self.where
        matrices, rows = np.zeros((len(where.poses), 3, 4)), where.rows(self.rows)
        if not specular:
            rows[:, LOBE] = 0.0
        about = where.poses, where.shown, self.centres, self.bounds, self.closed
        outside = place(*about, pose, NEAR_M, matrices, rows)
        shown, cut = where.shown, np.zeros(len(where.shown), bool)
        if plane is None and self.surface_z_m is not None and pose[2, 3] < self.surface_z_m:
            plane = np.append(-pose[2, :3], self.surface_z_m - pose[2, 3])
        if plane is not None:
            nearest, furthest = before_plane(plane, matrices, self.bounds)
            shown, cut = shown & (furthest > 0), nearest < 0
        return Placed(matrices, rows, shown, outside, plane, cut)

    def see(self, view: SectorView, placed: Placed, far_m, range_max_m, row: int, out: Draws):
        """Add what a sector draws to `out`.

        Parameters
        ----------
        row : where the rows of `placed` begin

        Returns
        -------
        first, n_closed, n : draws in `out`; the first of them are of closed bodies
        window : first column, first row, columns and rows of the samples whose rays may meet a body
        """
        found = np.array([np.inf, -np.inf, np.inf, -np.inf])
        patches, first = self.patches, out.counts["draws"]
        n = see(
            *(
                patches[name]
                for name in ("skip", "leaf", "error_m", "box", "cone", "moment", "whole", "n_faces")
            ),
            self.roots,
            self.order,
            placed.shown,
            self.closed,
            self.bounds,
            placed.matrices,
            view.rotation,
            view.limits,
            view.inverse,
            view.corner,
            NEAR_M,
            far_m,
            range_max_m,
            STRAY_SAMPLES * view.sample_rad,
            np.where(placed.rows[:, LOBE] > 0, 0.0, ECHO_PER_RAD * view.sample_rad),
            placed.outside,
            self._chosen,
            found,
        )
        chosen = self._chosen[:n]
        if self.sifts:
            n_closed = self._sift(view, placed, row, chosen, out)
        else:
            (draws,) = out.room("draws", n)
            n_closed = draw_patches(
                chosen, patches["first_face"], patches["n_faces"], self.closed, row, draws
            )
            out.counts["draws"] += n
        n = out.counts["draws"] - first
        return first, n_closed, n, window_of(found, view.sector.columns, view.sector.rows)

    def _sift(self, view, placed, row, chosen, out) -> int:
        """Add the triangles of patches that meet a sample; how many draws are of closed bodies."""
        patches, counts = self.patches, self.patches["n_faces"][chosen[:, 0]]
        ends, sector = counts.cumsum(), view.sector
        total = int(ends[-1]) if len(ends) else 0
        half = int(ends.searchsorted(total // 2)) if total > TWO_THREADS else len(chosen)
        n_samples = LAYERS * sector.columns * sector.rows
        starts = (0, int(ends[half - 1]) if half else 0)
        (draws,), (indices,) = out.room("draws", len(chosen)), out.room("indices", 3 * total)
        samples = out.room("samples", 2 * n_samples, "places", "values", "bodies")

        def work(which):
            part = slice(half, None) if which else slice(0, half)
            return sift_patches(
                chosen[part],
                *(patches[name] for name in ("first_vertex", "n_vertices", "first_face", "n_faces")),
                self.points,
                self.normals,
                self.reflectivity,
                patches["faces"],
                placed.matrices,
                placed.rows,
                placed.cut,
                self.closed,
                view.rotation,
                view.inverse,
                view.corner,
                view.size,
                NEAR_M,
                placed.outside,
                row,
                out.counts["indices"],
                indices[3 * starts[which] :],
                draws[part],
                sector.u,
                sector.v,
                *(array[which * n_samples :][:n_samples] for array in samples),
            )

        if half == len(chosen):
            n_closed, n, used, filled = work(0)
        else:
            self._pair = self._pair or Pair()
            (n_closed, n, used, filled), (more_closed, more, more_used, more_filled) = self._pair.run(work)
            draws[n : n + more] = draws[half : half + more]
            draws[n : n + more, 2] += used
            begin = 3 * starts[1]
            indices[used : used + more_used] = indices[begin : begin + more_used]
            for array in samples:
                array[filled : filled + more_filled] = array[n_samples : n_samples + more_filled]
            n_closed, n, used, filled = (
                n_closed + more_closed,
                n + more,
                used + more_used,
                filled + more_filled,
            )
        for kind, more in (("draws", n), ("indices", used), ("samples", filled)):
            out.counts[kind] += more
        return n_closed
