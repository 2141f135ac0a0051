"""The meshes of a scene in GL buffers, and the calls that draw them."""

from __future__ import annotations

import moderngl
import numpy as np

from sonar_gl.core.worker import SecondThread
from sonar_gl.gl.context import is_software
from sonar_gl.gl.memory import check_driver
from sonar_gl.gl.shaders import compile_program
from sonar_gl.raster.draw_list import DrawList
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.scene.scene import Scene

MIN_INDIRECT_VERSION = 430  # OpenGL version with indirect draws; before it, each draw is a separate call


class GrowingBuffer:
    """A GL buffer to append to; when it is full, a buffer of twice the size replaces it."""

    def __init__(self, context: moderngl.Context):
        self.context, self.used = context, 0
        self.buffer = context.buffer(reserve=4)

    def fit(self, size: int) -> bool:
        """Make room for `size` bytes; return whether another buffer replaced this one."""
        if size <= self.buffer.size:
            return False
        larger = self.context.buffer(reserve=max(2 * self.used, size))
        if self.used:
            self.context.copy_buffer(larger, self.buffer, self.used)
        self.buffer = larger
        return True

    def append(self, data) -> None:
        """Write an array at the end."""
        self.fit(self.used + data.nbytes)
        self.buffer.write(np.ascontiguousarray(data), offset=self.used)
        self.used += data.nbytes

    def overwrite(self, data) -> bool:
        """Replace the contents; return whether another buffer replaced this one."""
        self.used = 0
        moved = self.fit(2 * data.nbytes) if data.nbytes > self.buffer.size else False
        if data.nbytes:
            self.buffer.write(np.ascontiguousarray(data))
        return moved


class SceneBuffers:
    """A scene's meshes in GL buffers.

    Attributes
    ----------
    meshes : SceneMeshes, the bodies and their poses
    """

    def __init__(
        self, context: moderngl.Context, scene: Scene, shader_folder, thread: SecondThread | None = None
    ):
        self.context, self.shader_folder = context, shader_folder
        self.indirect = context.version_code >= MIN_INDIRECT_VERSION
        # Software OpenGL is slow per triangle, so triangles that cover no sample are culled on the CPU first.
        self.rasterizes = is_software(context.info["GL_RENDERER"])
        self.features = {"SHADING_NORMALS": 0, "FACE_REFLECTIVITY": 0, "INDIRECT": int(self.indirect)}
        self.points, self.normals, self.reflectivity = (
            GrowingBuffer(context),
            GrowingBuffer(context),
            GrowingBuffer(context),
        )
        self.indices, self.rows, self.draws = (
            GrowingBuffer(context),
            GrowingBuffer(context),
            GrowingBuffer(context),
        )
        self.n_points, self.programs, self.arrays = 0, {}, {}
        self.meshes = SceneMeshes(self.rasterizes, thread, scene.surface_z_m)
        self.add(scene.bodies)

    def add(self, bodies) -> None:
        """Append bodies; only their meshes are uploaded."""
        for one in self.meshes.add(bodies):
            levels = one.levels
            self.points.append(one.points)
            if not self.rasterizes:
                first = np.repeat(levels.first_vertex + self.n_points, levels.n_faces)
                self.indices.append((levels.faces + first[:, None]).astype(np.uint32))
            for name, buffer, data, default in (
                ("SHADING_NORMALS", self.normals, one.normals, np.zeros(3, np.float32)),
                ("FACE_REFLECTIVITY", self.reflectivity, one.reflectivity, np.ones(1, np.float32)),
            ):
                if data is not None and not self.features[name]:  # the first mesh with this attribute
                    self.features[name] = 1
                    buffer.append(np.tile(default, self.n_points))
                if self.features[name]:
                    buffer.append(np.tile(default, len(one.points)) if data is None else data)
            self.n_points += len(one.points)
        self.arrays = {}
        check_driver(self.context)

    def array(self, labels: bool, lobes: bool) -> moderngl.VertexArray:
        """Return the vertex array of the program with or without body numbers and specular lobes."""
        if (labels, lobes) not in self.arrays:
            defines = {**self.features, "LABELS": int(labels), "SPECULAR": int(lobes)}
            if (key := tuple(defines.values())) not in self.programs:
                files = "gbuffer.vert", "gbuffer.frag"
                self.programs[key] = compile_program(self.context, self.shader_folder, *files, defines)
            program = self.programs[key]
            layout = [(self.points.buffer, "3f", "in_position")]
            if self.features["SHADING_NORMALS"]:
                layout.append((self.normals.buffer, "3f", "in_normal"))
            if self.features["FACE_REFLECTIVITY"]:
                layout.append((self.reflectivity.buffer, "1f", "in_reflectivity"))
            if self.indirect:
                names = "body_x", "body_y", "body_z", "body_echo"
                layout.append((self.rows.buffer, "4f 4f 4f 4f/i", *names))
            array = self.context.vertex_array(program, layout, index_buffer=self.indices.buffer)
            self.arrays[labels, lobes] = array
        return self.arrays[labels, lobes]

    def upload(self, rows, out: DrawList) -> None:
        """Upload the bodies' rows and the draw list."""
        moved = self.rows.overwrite(rows) | self.draws.overwrite(*out.draws.filled())
        if self.rasterizes:
            moved |= self.indices.overwrite(*out.indices.filled())
        if moved:
            self.arrays = {}

    def draw(self, array, flags: int, rows, out: DrawList, first: int, n: int) -> None:
        """Draw `n` entries of the list from `first` on, in one call where the driver has indirect draws."""
        if n == 0:
            return
        self.context.enable_only(flags)
        if self.indirect:
            array.render_indirect(self.draws.buffer, count=n, first=first)
            return
        for count, _, index, _, row in out.draws.arrays[0][first : first + n].tolist():
            values = rows[row]
            for k, name in enumerate(("body_x", "body_y", "body_z")):
                array.program[name].write(values[4 * k : 4 * k + 4])
            array.program["body_echo"].write(values[12:])
            array.render(vertices=count, first=index)
