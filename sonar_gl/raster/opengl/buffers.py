"""The meshes of a scene in GL buffers, and the calls that draw them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import moderngl
import numpy as np

from sonar_gl.core.data_files import data_folder
from sonar_gl.gl.context import is_software
from sonar_gl.gl.driver import check_driver
from sonar_gl.gl.shaders import compile_program
from sonar_gl.raster.opengl.sheets import Sheet, sheet_of
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.scene.scene import Scene

INDIRECT_VERSION = 430  # the OpenGL version that has indirect draws with instances of any number
INDIRECT_EXTENSIONS = {"GL_ARB_multi_draw_indirect", "GL_ARB_base_instance"}
# How far corners on a line may lie beside it, over the largest coordinate: 2^-24 of it in each of three directions, of
# the corner in the middle and of the line.
ROUNDING = 2.0**-22
FACES_AT_ONCE = 1 << 18


def has_indirect_draws(context: moderngl.Context) -> bool:
    """Return whether one call can draw a list; without, each entry of the list is a call.

    A driver may give the version that was asked for and no later one, as NVIDIA's does, with extensions for the rest.
    """
    return context.version_code >= INDIRECT_VERSION or context.extensions >= INDIRECT_EXTENSIONS


class GrowingBuffer:
    """A GL buffer to append to; when it is full, a buffer of twice the size replaces it."""

    def __init__(self, context: moderngl.Context):
        self.context, self.used = context, 0
        self.buffer = context.buffer(reserve=4)

    def fit(self, size: int) -> None:
        """Make room for `size` bytes."""
        if size > self.buffer.size:
            larger = self.context.buffer(reserve=max(2 * self.used, size))
            if self.used:
                self.context.copy_buffer(larger, self.buffer, self.used)
            self.buffer = larger

    def append(self, data) -> None:
        """Write an array at the end."""
        self.fit(self.used + data.nbytes)
        self.buffer.write(np.ascontiguousarray(data), offset=self.used)
        self.used += data.nbytes

    def overwrite(self, data) -> None:
        """Replace the contents."""
        self.used = 0
        if data.nbytes > self.buffer.size:
            self.fit(2 * data.nbytes)
        if data.nbytes:
            self.buffer.write(np.ascontiguousarray(data))


def collapse_lines(faces: np.ndarray, first: int, points: np.ndarray) -> None:
    """Make a point, which is not drawn, of each face whose corners lie on a line but for their rounding, in place.

    A driver that rounds corners to its own grid may find a sample in such a face, and has no plane for it. The geometry
    shader leaves out such faces, and others that are far away; software drivers draw without it.

    faces : (I, 3) indices, counted from `first`
    points : (W, 3) float32
    """
    lowest = ROUNDING * np.abs(points).max(initial=0.0)
    for start in range(0, len(faces), FACES_AT_ONCE):
        part = faces[start : start + FACES_AT_ONCE]
        a, b, c = (points[part[:, k] - first].astype(np.float64) for k in range(3))
        edges = np.stack([b - a, c - b, a - c])
        longest = np.sqrt((edges**2).sum(axis=2).max(axis=0))
        double_area = np.linalg.norm(np.cross(edges[0], edges[2]), axis=1)
        is_line = double_area <= lowest * longest
        part[is_line] = part[is_line, :1]


def draws_of(patches: np.ndarray, meshes: SceneMeshes, row: int) -> np.ndarray:
    """Return patches as draws: (n, 5) uint32 of indices, instances, first index, first vertex, body's row.

    patches : (n, 2) patch and body
    row : of the first body
    """
    patch, body = patches.T
    draws = np.zeros((len(patches), 5), np.uint32)
    draws[:, 0], draws[:, 1] = 3 * meshes.levels["n_faces"][patch], 1
    draws[:, 2], draws[:, 4] = 3 * meshes.levels["first_face"][patch], row + body
    return draws


@dataclass(frozen=True, eq=False)
class UploadedMeshes:
    """The meshes of a scene's bodies, on the CPU and in GL buffers.

    meshes : SceneMeshes, the bodies and their poses
    points, normals, reflectivity : GrowingBuffer of each vertex; unused as long as no mesh has the attribute
    indices : GrowingBuffer of all faces
    n_points : how many vertices there are
    sheets : by the number of each body that is a rectangle
    """

    meshes: SceneMeshes
    points: GrowingBuffer
    normals: GrowingBuffer
    reflectivity: GrowingBuffer
    indices: GrowingBuffer
    n_points: int = 0
    sheets: dict[int, Sheet] = field(default_factory=dict)

    def with_more(self, bodies) -> UploadedMeshes:
        """Return these and more bodies; only their meshes are uploaded.

        This object stays as it is, also after an interrupt: what is new lies behind what its buffers use.
        """
        meshes, n_points, bodies = copy(self.meshes), self.n_points, list(bodies)
        found = {number: sheet_of(body) for number, body in enumerate(bodies, len(meshes.bodies))}
        found = {number: sheet for number, sheet in found.items() if sheet is not None}
        sheets = self.sheets | found if found else self.sheets
        points, normals, reflectivity, indices = map(
            copy, (self.points, self.normals, self.reflectivity, self.indices)
        )
        for one in meshes.add(bodies):
            levels = one.levels
            points.append(one.points)
            first = np.repeat(levels.first_vertex + n_points, levels.n_faces)
            faces = (levels.faces + first[:, None]).astype(np.uint32)
            collapse_lines(faces, n_points, one.points)
            indices.append(faces)
            for buffer, data, default in (
                (normals, one.normals, np.zeros(3, np.float32)),
                (reflectivity, one.reflectivity, np.ones(1, np.float32)),
            ):
                if data is not None and not buffer.used:  # the first mesh with this attribute
                    buffer.append(np.tile(default, n_points))
                if data is not None or buffer.used:
                    buffer.append(np.tile(default, len(one.points)) if data is None else data)
            n_points += len(one.points)
        check_driver(points.context)
        return UploadedMeshes(meshes, points, normals, reflectivity, indices, n_points, sheets)


class SceneBuffers:
    """A scene's meshes in GL buffers, and what draws them.

    uploaded : UploadedMeshes
    """

    def __init__(self, context: moderngl.Context, scene: Scene):
        self.context, self._shader_folder = context, data_folder("shaders")
        self.indirect = has_indirect_draws(context)
        # exact on a card; a software driver interpolates well, and a geometry shader nearly doubles its time
        self._corner_planes = not is_software(context.info["GL_RENDERER"])
        empty = UploadedMeshes(SceneMeshes(scene.surface_z_m), *(GrowingBuffer(context) for _ in range(4)))
        self.uploaded = empty.with_more(scene.bodies)
        self._rows, self._draws = GrowingBuffer(context), GrowingBuffer(context)
        self._programs, self._arrays, self._bound = {}, {}, ()

    @property
    def meshes(self) -> SceneMeshes:
        """The bodies and their poses."""
        return self.uploaded.meshes

    def array(self, with_bodies: bool, lobes: bool) -> moderngl.VertexArray:
        """Return the vertex array of the program with or without body numbers and specular lobes."""
        uploaded = self.uploaded
        bound = uploaded, self._rows.buffer
        if self._bound != bound:  # bodies were added, or a buffer was replaced by a larger one
            self._arrays = {}
            self._bound = bound
        if (with_bodies, lobes) not in self._arrays:
            features = {
                "SHADING_NORMALS": int(uploaded.normals.used > 0),
                "FACE_REFLECTIVITY": int(uploaded.reflectivity.used > 0),
                "INDIRECT": int(self.indirect),
                "CORNER_PLANES": int(self._corner_planes),
            }
            defines = {**features, "BODY_NUMBERS": int(with_bodies), "SPECULAR": int(lobes)}
            if (key := tuple(defines.values())) not in self._programs:
                planes = ("gbuffer.geom",) if self._corner_planes else ()
                files = "gbuffer.vert", *planes, "gbuffer.frag"
                self._programs[key] = compile_program(self.context, self._shader_folder, files, defines)
            program = self._programs[key]
            layout = [(uploaded.points.buffer, "3f", "in_position")]
            if features["SHADING_NORMALS"]:
                layout.append((uploaded.normals.buffer, "3f", "in_normal"))
            if features["FACE_REFLECTIVITY"]:
                layout.append((uploaded.reflectivity.buffer, "1f", "in_reflectivity"))
            if self.indirect:
                names = "body_x", "body_y", "body_z", "body_echo"
                layout.append((self._rows.buffer, "4f 4f 4f 4f/i", *names))
            array = self.context.vertex_array(program, layout, index_buffer=uploaded.indices.buffer)
            self._arrays[with_bodies, lobes] = array
        return self._arrays[with_bodies, lobes]

    def upload(self, rows, draws: np.ndarray) -> None:
        """Upload the bodies' rows, and draws of `draws_of`."""
        self._rows.overwrite(rows)
        self._draws.overwrite(draws)

    def draw(self, array, flags: int, rows, draws: np.ndarray, first: int, n: int) -> None:
        """Draw `n` of these draws from `first` on, in one call where the driver has indirect draws."""
        if n == 0:
            return
        self.context.enable_only(flags)
        if self.indirect:
            array.render_indirect(self._draws.buffer, count=n, first=first)
            return
        for count, _, index, _, row in draws[first : first + n].tolist():
            values = rows[row]
            for k, name in enumerate(("body_x", "body_y", "body_z")):
                array.program[name].write(values[4 * k : 4 * k + 4])
            array.program["body_echo"].write(values[12:])
            array.render(vertices=count, first=index)
