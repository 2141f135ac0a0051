"""A scene for the compiled rasteriser, and what draws it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from dataclasses import dataclass, field

import numba
import numpy as np

from sonar_gl.core.memory import DynamicArrays, ReusedArray, prepare_in_turn
from sonar_gl.core.worker import SecondThread
from sonar_gl.raster.cpu.kernels.shading import write_lobes
from sonar_gl.raster.cpu.kernels.tables import NOTHING, PatchFaces, PlacedBodies, Triangles, Vertices
from sonar_gl.raster.cpu.kernels.windows import draw_windows
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.raster.views import (
    MAX_SAMPLES,
    NO_PLANE,
    NO_SAMPLES,
    BodiesInView,
    PatchRoom,
    RenderWorkspace,
    SectorLayout,
    SectorView,
    Window,
    stacked,
)
from sonar_gl.scene.scene import Scene
from sonar_gl.sonar.fan import FAR_FACTOR, NEAR_M, Fan
from sonar_gl.sonar.samples import NO_BODIES, SectorSamples, ViewSamples, with_neighbours

# About what a face and a sample cost, ns. A ping that costs less is drawn in one thread: handing half of it to the
# other one takes 10 to 20 us.
FACE_NS, SAMPLE_NS, FEW_NS = 20, 4, 60_000
NO_LOBES = np.empty((0, 0), np.float32)


@dataclass(frozen=True, eq=False)
class LoadedMeshes:
    """The meshes of a scene's bodies in arrays.

    meshes : SceneMeshes, the bodies and their poses
    vertices : Vertices of all patches
    patches : tuple of PatchFaces; empty without bodies
    arrays : DynamicArrays of the vertices
    """

    meshes: SceneMeshes
    vertices: Vertices
    patches: tuple[np.ndarray, ...] = ()
    arrays: DynamicArrays = field(default_factory=DynamicArrays)

    def with_more(self, bodies) -> LoadedMeshes:
        """Return these and more bodies. This object stays as it is."""
        meshes = copy(self.meshes)
        made = meshes.add(bodies)
        if not made:
            return LoadedMeshes(meshes, self.vertices, self.patches, self.arrays)
        points = self.arrays.append("points", self.vertices.points, [one.points for one in made])
        normals = self._appended("normals", made, np.zeros(3, np.float32))
        reflectivity = self._appended("reflectivity", made, np.float32(1.0))
        patches = tuple(meshes.levels[name] for name in PatchFaces._fields)
        return LoadedMeshes(meshes, Vertices(points, normals, reflectivity), patches, self.arrays)

    def _appended(self, name: str, made, default):
        """Return an attribute of all vertices, as soon as any mesh has it."""
        old, n = getattr(self.vertices, name), len(self.vertices.points)
        if not len(old) and all(getattr(one, name) is None for one in made):
            return old
        if not len(old):
            old = np.broadcast_to(default, (n, *default.shape))
        parts = [getattr(one, name) for one in made]
        fill = [np.broadcast_to(default, (len(one.points), *default.shape)) for one in made]
        return self.arrays.append(
            name, old, [f if p is None else p for p, f in zip(parts, fill, strict=True)]
        )


class _Image:
    """Samples of one view, side by side."""

    def __init__(self):
        self._arrays = ReusedArray(np.float32, 4), ReusedArray(np.uint16), ReusedArray(np.int32)
        self._lobes = ReusedArray(np.float32)

    def take(self, width: int, height: int, with_bodies: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return plane_echo, body_id and face_id of `SectorSamples`; body_id of no size if it is not wanted."""
        size, shape, (plane_echo, body_id, face_id) = width * height, (height, width), self._arrays
        numbers = body_id.take(size).reshape(shape) if with_bodies else NO_BODIES
        return plane_echo.take(size).reshape(*shape, 4), numbers, face_id.take(size).reshape(shape)

    def take_lobes(self, width: int, height: int) -> np.ndarray:
        """Return room for the specular lobes of the samples of a view, (height, width)."""
        return self._lobes.take(width * height).reshape(height, width)

    @property
    def n_last(self) -> int:
        """Samples of the last view."""
        return self._arrays[0].n_last

    def arrays_of(self, growth: float) -> list[tuple[ReusedArray, int]]:
        """Return the arrays that are in use, with the rows of a view of `growth` times the samples."""
        used = [one for one in (*self._arrays, self._lobes) if one.n_last]
        return [(one, math.ceil(growth * one.n_last)) for one in used]

    def drop_large(self) -> None:
        for one in (*self._arrays, self._lobes):
            one.drop_large()


class _HalfWorkspace:
    """What one thread draws into: a visibility buffer, its triangles, and room for chosen patches."""

    def __init__(self):
        self._buffer = ReusedArray(np.float32), ReusedArray(np.int32)
        self._triangles = ReusedArray(np.float32, 4), ReusedArray(np.int32, 3), ReusedArray(float, 9)
        self.chosen = PatchRoom()

    def buffer(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return room for a visibility buffer of so many samples: depth and triangle, flat."""
        depth, triangle = self._buffer
        return depth.take(count), triangle.take(count)

    def triangles(self, count: int, has_normals: bool) -> Triangles:
        """Return room for so many triangles."""
        planes, bodies, normals = self._triangles
        return Triangles(planes.take(count), bodies.take(count), normals.take(count * has_normals))

    def arrays_of(self, count: int) -> list[tuple[ReusedArray, int]]:
        """Return the arrays of a visibility buffer, with the rows of one of so many samples."""
        return [(one, count) for one in self._buffer]

    def drop_large(self) -> None:
        for one in (*self._buffer, *self._triangles):
            one.drop_large()


class CpuWorkspace(RenderWorkspace):
    """Images, and what each thread draws into.

    beside : as of `RasterEngine.make_workspace`

    halves : _HalfWorkspace of each thread, of which a view needs nothing once it is drawn
    room : samples of an image, and of what a half draws at a time, for each sample of the last view
    """

    def __init__(self, most_samples: int, beside: CpuWorkspace | None):
        super().__init__(most_samples, _Image)
        self.halves = (_HalfWorkspace(), _HalfWorkspace()) if beside is None else beside.halves
        self.room = 0.0, 0.0

    def prepare(self, n_samples: int, share: float) -> None:
        """Have memory ready for a view of so many samples, or a share of what is missing."""
        of_image, of_half = (math.ceil(n_samples * room) for room in self.room)
        n_last = self._images[0].n_last if self._images else 0
        images = self._images if n_last else []
        arrays = [pair for image in images for pair in image.arrays_of(of_image / n_last)]
        prepare_in_turn(arrays + [pair for half in self.halves for pair in half.arrays_of(of_half)], share)

    def drop_large(self) -> None:
        """Drop large arrays; samples that were drawn stay valid."""
        super().drop_large()
        for half in self.halves:
            half.drop_large()


class CpuRenderer:
    """Draws a fan's sectors side by side, an image for each pose. A `Renderer`.

    Of each sector only the window that holds bodies is drawn, in two halves if that pays.

    specular : add the specular lobes of smooth bodies
    workspace : CpuWorkspace, which renderers may share
    thread : for the second half; None does both halves in the caller's thread
    """

    def __init__(
        self,
        engine: CpuEngine,
        fan: Fan,
        specular: bool,
        workspace: CpuWorkspace,
        thread: SecondThread | None,
    ):
        self._engine, self._specular = engine, specular
        self._workspace, self._thread = workspace, thread
        range_max_m = fan.sonar.range_max_m
        self._limits = np.array([NEAR_M, FAR_FACTOR * range_max_m])
        self._sectors = [SectorView(sector, FAR_FACTOR * range_max_m, range_max_m) for sector in fan.sectors]
        self._layout, self._stacked = SectorLayout(self._sectors), stacked(self._sectors)
        empty = [view.sector.within(0, 0, 0, 0) for view in self._sectors]
        self._dark = [SectorSamples(one, NO_SAMPLES, NO_BODIES) for one in empty]

    def render(
        self,
        poses: Sequence[np.ndarray],
        states: Sequence = (None,),
        with_bodies: bool = False,
        full: bool = False,
        planes: Sequence | None = None,
        keep_last: bool = False,
    ) -> list[ViewSamples]:
        """Draw all sectors as seen from some poses; see `Renderer.render`."""
        planes = planes or [None] * len(poses)
        n = len(poses)
        images, out = self._workspace.images(n, keep_last), [None] * n
        views = list(zip(poses, states, planes, strict=True))
        groups = _with_lobes(views)

        def draw(group: list[int], half: int | None = None):
            bodies = self._engine.meshes.view_from(*views[group[0]], self._specular)
            drawn = self._draw([images[k] for k in group], bodies, with_bodies, full, half)
            for k, view in zip(group, drawn, strict=True):
                out[k] = view

        # a thread draws a whole view in less time than two halves: each half has to place all bodies
        pairs = 0 if self._thread is None else len(groups) // 2
        for k in range(pairs):
            self._thread.run_halves(lambda half, k=k: draw(groups[2 * k + half], half))
        for group in groups[2 * pairs :]:
            draw(group)
        return out

    def prepare(self, n_samples: int, share: float) -> None:
        """Have memory ready before a view is drawn; see `Renderer.prepare`."""
        self._workspace.prepare(n_samples, share)

    def _draw(
        self, images: Sequence[_Image], bodies: BodiesInView, with_bodies: bool, full: bool, half: int | None
    ) -> list[ViewSamples]:
        """Draw a view, and into a second image its specular lobes alone, in the memory of one half if that is given.

        Of the lobes, the samples have the window that `SectorSamples.with_echo` finds.
        """
        meshes, workspace = self._engine.meshes, self._workspace
        chosen = workspace.halves[half or 0].chosen.take(len(self._sectors), meshes.most_patches)
        found = meshes.choose(self._stacked, bodies, chosen)
        if full:
            found[:, 2:] = [view.whole for view in self._sectors]
        windows = [Window(*row[2:]) for row in found.tolist()]
        _, faces, _, _, columns, rows = found.T.tolist()
        width, height = sum(columns), max(rows)
        workspace.check_samples(width, height)
        samples = images[0].take(width, height, with_bodies)
        if not self._engine.contents.patches:
            plane_echo, body_id, face_id = samples
            plane_echo[:], body_id[:], face_id[:] = 0.0, 0, NOTHING
            return [self._layout.samples(windows, *samples, bodies.spans)] * len(images)
        plane = NO_PLANE if bodies.plane is None else bodies.plane
        closed = meshes.boxes.closed
        placed = PlacedBodies(bodies.matrices, bodies.table, bodies.is_cut, closed, bodies.outside, plane)
        work_ns = FACE_NS * sum(faces) + SAMPLE_NS * width * height * len(images)
        lobes = images[1].take_lobes(width, height) if len(images) > 1 else NO_LOBES
        is_whole = half is not None or self._thread is None or work_ns < FEW_NS
        n_parts = 1 if is_whole else 2
        most = max(faces), max(w.rows * math.ceil(w.columns / n_parts) for w in windows)
        if n_samples := sum(w.rows * w.columns for w in windows):
            workspace.room = width * height / n_samples, most[1] / n_samples
        drawn = tuple(placed), bodies.has_lobes, chosen, found, most, samples, lobes
        if is_whole:
            parts = [self._draw_part(workspace.halves[half or 0], 0, 1, *drawn)]
        else:
            parts = self._thread.run_halves(
                lambda part: self._draw_part(workspace.halves[part], part, 2, *drawn)
            )
        met_by_parts = zip(*(is_met.tolist() for is_met, _ in parts), strict=True)
        is_dark = tuple(not any(is_met) for is_met in met_by_parts)
        whole = self._layout.samples(windows, *samples, bodies.spans, is_dark, sum(faces))
        if len(images) == 1:
            return [whole]
        lit = np.stack([lit for _, lit in parts])
        first, past = lit.min(axis=0), lit.max(axis=0)
        limits = np.stack([first[:, 0], past[:, 1], first[:, 2], past[:, 3]], axis=1)
        return [whole, _lobes_alone(whole, samples, lobes, limits, images[1], self._dark)]

    def _draw_part(
        self,
        half: _HalfWorkspace,
        part: int,
        n_parts: int,
        placed: tuple,
        has_lobes: bool,
        chosen: np.ndarray,
        found: np.ndarray,
        most: tuple[int, int],
        samples,
        lobes: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw some columns of each sector's window; return `is_met` and `lit` of `draw_windows`.

        placed : tuple of PlacedBodies
        chosen, found : of `SceneMeshes.choose`
        most : faces of a sector, and samples of a part of one
        samples, lobes : as for `shade`
        """
        contents = self._engine.contents
        vertices, has_normals = tuple(contents.vertices), len(contents.vertices.normals) > 0
        triangles = tuple(half.triangles(most[0], has_normals))
        is_met, lit = np.empty(len(found), bool), np.empty((len(found), 4), np.int64)
        draw_windows(
            chosen,
            found,
            contents.patches,
            vertices,
            placed,
            self._stacked.geometry,
            (part, n_parts),
            self._limits,
            (*half.buffer(most[1]), triangles),
            (placed[1], has_lobes),
            samples,
            lobes,
            is_met,
            lit,
        )
        return is_met, lit


def _lobes_alone(
    whole: ViewSamples, image: tuple, lobes: np.ndarray, limits: np.ndarray, room: _Image, dark: Sequence
) -> ViewSamples:
    """Return the samples of specular lobes alone, and of those beside them, which few of a view are.

    whole : the view with all echoes
    image, lobes : as for `shade`
    limits : (S, 4) columns and rows of the lobes of each sector, as for `with_neighbours`
    room : for the samples
    dark : SectorSamples of each sector without any samples
    """
    lit = np.flatnonzero(limits[:, 0] < limits[:, 1]).tolist()
    windows = np.zeros((len(lit), 5), np.int64)
    out, places, width = list(dark), [0] * len(dark), 0
    for n, s in enumerate(lit):
        sector = whole.sectors[s].sector
        low, past, bottom, top = with_neighbours(limits[s].tolist(), sector.columns, sector.rows)
        out[s] = sector.within(low, bottom, past - low, top - bottom)
        windows[n] = whole.left[s] + low, width, bottom, past - low, top - bottom
        places[s], width = width, width + past - low
    alone = room.take(width, int(windows[:, 4].max(initial=0)), image[1].size > 0)
    write_lobes(image, lobes, windows, alone)
    plane_echo, body_id, face_id = alone
    for s in lit:
        here = slice(0, out[s].rows), slice(places[s], places[s] + out[s].columns)
        bodies = body_id[here] if body_id.size else NO_BODIES
        out[s] = SectorSamples(out[s], plane_echo[here], bodies, face_id[here])
    (of_image, u, v, limits), arrays = whole.table, (plane_echo, tuple(places), face_id, body_id)
    of_image, u, v = np.zeros_like(of_image), u.copy(), v.copy()
    for n, s in enumerate(lit):
        of_image[s], u[s], v[s] = windows[n, [1, 3, 4]], out[s].sector.u, out[s].sector.v
    return ViewSamples(tuple(out), *arrays, (of_image, u, v, limits), whole.body_spans, is_lit=True)


def _with_lobes(views: Sequence[tuple]) -> list[list[int]]:
    """Return the number of each view, followed by that of its specular lobes alone where they are drawn, too.

    views : pose, SceneState or None, and clip plane of each
    """
    groups = []
    for number, (pose, state, plane) in enumerate(views):
        for group in groups:
            its_pose, its_state, its_plane = views[group[0]]
            is_same = len(group) == 1 and pose is its_pose and plane is its_plane
            if is_same and None not in (state, its_state) and state.is_without_diffuse_echo_of(its_state):
                group.append(number)
                break
        else:
            groups.append([number])
    return groups


class CpuEngine:
    """Draws the bodies of a scene by compiled code. A `RasterEngine`.

    contents : LoadedMeshes
    driver : what stands in for the driver's names
    """

    name, draws_in_threads = "cpu", True

    def __init__(self, scene: Scene):
        empty = Vertices(np.empty((0, 3), np.float32), np.empty((0, 3), np.float32), np.empty(0, np.float32))
        self.contents = LoadedMeshes(SceneMeshes(scene.surface_z_m), empty).with_more(scene.bodies)
        self.driver = {
            "engine": self.name,
            "renderer": "CPU",
            "vendor": "sonar_gl",
            "version": f"Numba {numba.__version__}",
            "max_samples": MAX_SAMPLES,
        }

    @property
    def meshes(self) -> SceneMeshes:
        """The bodies and their poses."""
        return self.contents.meshes

    def with_more(self, bodies) -> LoadedMeshes:
        return self.contents.with_more(bodies)

    def make_workspace(
        self, most_samples: int = MAX_SAMPLES, beside: CpuWorkspace | None = None
    ) -> CpuWorkspace:
        return CpuWorkspace(most_samples, beside)

    def make_renderer(
        self, fan: Fan, specular: bool, workspace: CpuWorkspace, thread: SecondThread | None = None
    ) -> CpuRenderer:
        return CpuRenderer(self, fan, specular, workspace, thread)

    def check_thread(self) -> None:
        """Do nothing: any thread may draw."""

    def drawing(self) -> AbstractContextManager:
        """Do nothing: there is no context."""
        return nullcontext()

    def collect(self) -> None:
        """Do nothing: arrays go with their last name."""

    def discard(self) -> None:
        """Do nothing."""

    @staticmethod
    def release_waiting() -> None:
        """Do nothing."""
