"""The bodies of a run in the driver's memory, and how they are drawn."""

from __future__ import annotations

import re

import moderngl
import numpy as np

from sonar_gl.draws import Draws
from sonar_gl.programs import compile_program
from sonar_gl.scene import Scene
from sonar_gl.stock import Stock

INDIRECT_GL = 430  # has draws from a buffer; before, each is a call of its own
# Where the CPU does the drawing anyway, triangles that meet no sample are left out beforehand.
SOFTWARE = re.compile("llvmpipe|softpipe|swrast|swiftshader", re.IGNORECASE)


class Growing:
    """A GL buffer that is written at its end, and moves to one of twice the size when it is full."""

    def __init__(self, context: moderngl.Context):
        self.context, self.used = context, 0
        self.buffer = context.buffer(reserve=4)

    def fit(self, size: int) -> bool:
        """Have room for so many bytes; whether the buffer is another one now."""
        if size <= self.buffer.size:
            return False
        larger = self.context.buffer(reserve=max(2 * self.used, size))
        if self.used:
            self.context.copy_buffer(larger, self.buffer, self.used)
        self.buffer = larger
        return True

    def append(self, data) -> None:
        self.fit(self.used + data.nbytes)
        self.buffer.write(np.ascontiguousarray(data), offset=self.used)
        self.used += data.nbytes

    def overwrite(self, data) -> bool:
        """Put this in place of all that was there; whether the buffer is another one now."""
        self.used = 0
        moved = self.fit(2 * data.nbytes) if data.nbytes > self.buffer.size else False
        if data.nbytes:
            self.buffer.write(np.ascontiguousarray(data))
        return moved


class SceneOnGpu:
    """A scene's meshes in GL buffers.

    Attributes
    ----------
    stock : Stock, the bodies and where they are
    """

    def __init__(self, context: moderngl.Context, scene: Scene, shader_folder):
        self.context, self.shader_folder = context, shader_folder
        self.indirect = context.version_code >= INDIRECT_GL
        self.sifts = bool(SOFTWARE.search(context.info["GL_RENDERER"]))
        self.features = {"SHADING_NORMALS": 0, "FACE_REFLECTIVITY": 0, "INDIRECT": int(self.indirect)}
        self.points, self.normals, self.reflectivity = Growing(context), Growing(context), Growing(context)
        self.indices, self.rows, self.draws = Growing(context), Growing(context), Growing(context)
        self.n_points, self.programs, self.arrays = 0, {}, {}
        self.stock = Stock(self.sifts)
        self.stock.surface_z_m = scene.surface_z_m
        self.add(scene.bodies)

    def add(self, bodies) -> None:
        """More bodies, after those that are there; only their own meshes go to the driver."""
        for one in self.stock.add(bodies):
            levels = one.levels
            self.points.append(one.points)
            if not self.sifts:
                first = np.repeat(levels.first_vertex + self.n_points, levels.n_faces)
                self.indices.append((levels.faces + first[:, None]).astype(np.uint32))
            for name, growing, data, none in (
                ("SHADING_NORMALS", self.normals, one.normals, np.zeros(3, np.float32)),
                ("FACE_REFLECTIVITY", self.reflectivity, one.reflectivity, np.ones(1, np.float32)),
            ):
                if data is not None and not self.features[name]:  # the first that has any
                    self.features[name] = 1
                    growing.append(np.tile(none, self.n_points))
                if self.features[name]:
                    growing.append(np.tile(none, len(one.points)) if data is None else data)
            self.n_points += len(one.points)
        self.arrays = {}

    def array(self, labels: bool, lobes: bool) -> moderngl.VertexArray:
        """The vertex array whose program writes bodies' numbers, and adds lobes, or does not."""
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

    def upload(self, rows, out: Draws) -> None:
        """Bodies' rows and what is drawn of them to the driver."""
        moved = self.rows.overwrite(rows) | self.draws.overwrite(out.draws[: out.counts["draws"]])
        if self.sifts:
            moved |= self.indices.overwrite(out.indices[: out.counts["indices"]])
        if moved:
            self.arrays = {}

    def draw(self, array, flags: int, rows, out: Draws, first: int, n: int) -> None:
        """Some of the draws, at once where the driver can."""
        if n == 0:
            return
        self.context.enable_only(flags)
        if self.indirect:
            array.render_indirect(self.draws.buffer, count=n, first=first)
            return
        for count, _, index, _, row in out.draws[first : first + n].tolist():
            values = rows[row]
            for k, name in enumerate(("body_x", "body_y", "body_z")):
                array.program[name].write(values[4 * k : 4 * k + 4])
            array.program["body_echo"].write(values[12:])
            array.render(vertices=count, first=index)
