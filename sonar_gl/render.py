"""Scene to G-buffer: the only stage that draws."""

from __future__ import annotations

import moderngl
import numpy as np

from sonar_gl.fan import Fan
from sonar_gl.gl import compile_program
from sonar_gl.scene import Scene
from sonar_gl.types import Error, GBuffer

TABLE_WIDTH = 3 * 1024  # texels; whole bodies to a row of the table
# Nearer than this the sonar looks through things: its own face is not an echo.
NEAR_M = 1e-3
# Surfaces are drawn this much beyond the last bin, since near grazing a sample whose middle lies beyond it
# still reaches into it.
FAR_FACTOR = 8.0


class SceneOnGpu:
    """A scene's meshes in GL buffers; poses stay on the CPU, in float64, until a ping needs them."""

    def __init__(self, context: moderngl.Context, scene: Scene, shader_folder):
        self.context, self.scene = context, scene
        self.centres = np.zeros((len(scene.bodies), 3))
        positions, normals, numbers, indices, faces = [], [], [], [], []
        first = 0
        for index, body in enumerate(scene.bodies):
            vertices = np.asarray(body.mesh.vertices, np.float64)
            triangles = np.asarray(body.mesh.faces, np.int64)
            centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
            self.centres[index] = centre
            positions.append((vertices - centre).astype(np.float32))
            numbers.append(np.full(len(vertices), index, np.uint32))
            indices.append((triangles + first).astype(np.uint32))
            faces.append(face_table(vertices, triangles, body.reflectivity))
            normals.append(np.zeros_like(positions[-1]) if body.normals is None else body.normals)
            first += len(vertices)
        smooth = any(body.normals is not None for body in scene.bodies)
        self.program = compile_program(
            context,
            shader_folder,
            "gbuffer.vert",
            "gbuffer.frag",
            {"SHADING_NORMALS": int(smooth), "TABLE_WIDTH": TABLE_WIDTH},
        )
        self.vertex_array = None
        if not scene.bodies:
            return
        layout = [(self._buffer(positions), "3f", "in_position"), (self._buffer(numbers), "1u", "in_body")]
        if smooth:
            layout.append((self._buffer(normals), "3f", "in_normal"))
        self.vertex_array = context.vertex_array(self.program, layout, index_buffer=self._buffer(indices))
        self.face_texture = self._table(np.concatenate(faces))
        self.body_texture = self._table(np.zeros((3 * len(scene.bodies), 4), np.float32))
        self.program["face_table"] = 0
        self.program["body_table"] = 1

    def _buffer(self, arrays):
        return self.context.buffer(np.concatenate(arrays).tobytes())

    def _table(self, texels):
        """(N, 4) float32 in a texture of TABLE_WIDTH texels a row."""
        height = -(-len(texels) // TABLE_WIDTH)
        limit = self.context.info["GL_MAX_TEXTURE_SIZE"]
        if height > limit:
            raise Error(
                f"a scene may have at most {limit * TABLE_WIDTH} triangles on this OpenGL driver "
                f"(got {len(texels)}; decimate its meshes)"
            )
        padded = np.zeros((height * TABLE_WIDTH, 4), np.float32)
        padded[: len(texels)] = texels
        texture = self.context.texture((TABLE_WIDTH, height), 4, padded.tobytes(), dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def place(self, pose: np.ndarray):
        """Upload the bodies' matrices relative to the sonar, taken in float64 before they are rounded."""
        if self.vertex_array is None:
            return
        rows = np.empty((len(self.scene.bodies), 3, 4), np.float32)
        sonar_from_world = pose[:3, :3].T
        for index, body in enumerate(self.scene.bodies):
            rotation = sonar_from_world @ body.pose[:3, :3]
            rows[index, :, :3] = rotation
            offset = sonar_from_world @ (body.pose[:3, 3] - pose[:3, 3])
            rows[index, :, 3] = offset + rotation @ self.centres[index]
        padded = np.zeros((self.body_texture.height * TABLE_WIDTH, 4), np.float32)
        padded[: 3 * len(rows)] = rows.reshape(-1, 4)
        self.body_texture.write(padded.tobytes())


def face_table(vertices, triangles, reflectivity) -> np.ndarray:
    """(F, 4) float32: each face's unit normal in the body's frame and its reflectivity."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    out = np.zeros((len(triangles), 4), np.float32)
    # a triangle without area covers no pixel centre; its normal is never read
    out[:, :3] = normals / np.where(lengths > 0, lengths, 1.0)[:, None]
    out[:, 3] = reflectivity
    return out


class Renderer:
    """Draws a fan's sectors side by side into one framebuffer and reads them back."""

    def __init__(self, context: moderngl.Context, scene: Scene, fan: Fan, shader_folder):
        self.context, self.fan = context, fan
        self.far_m = FAR_FACTOR * fan.sonar.range_max_m
        width = sum(s.columns for s in fan.sectors)
        height = max(s.rows for s in fan.sectors)
        limit = min(context.info["GL_MAX_TEXTURE_SIZE"], *context.info["GL_MAX_VIEWPORT_DIMS"])
        if max(width, height) > limit:
            raise Error(
                f"samples must fit the driver's limit of {limit} by {limit} pixels (got {width} columns by "
                f"{height} rows; ask for a larger tolerance or fewer columns_per_beam or rows)"
            )
        self.size = (width, height)
        self.gpu = SceneOnGpu(context, scene, shader_folder)
        self.attachments = [context.renderbuffer(self.size, n, dtype="f4") for n in (4, 2)]
        self.framebuffer = context.framebuffer(self.attachments, context.depth_renderbuffer(self.size))
        self.pixels = [np.zeros((height, width, n), np.float32) for n in (4, 2)]

    def draw(self, pose: np.ndarray):
        """Draw all sectors as seen from `pose`, world_from_sonar."""
        gpu = self.gpu
        gpu.place(pose)
        self.framebuffer.use()
        self.framebuffer.clear(depth=1.0)
        if gpu.vertex_array is None:
            return
        self.context.enable_only(moderngl.DEPTH_TEST)
        gpu.face_texture.use(0)
        gpu.body_texture.use(1)
        gpu.program["far_m"].value = self.far_m
        left = 0
        for sector in self.fan.sectors:
            self.framebuffer.viewport = (left, 0, sector.columns, sector.rows)
            matrix = sector.projection(NEAR_M, self.far_m)
            gpu.program["clip_from_sonar"].write(np.ascontiguousarray(matrix.T, np.float32))
            gpu.vertex_array.render()
            left += sector.columns
        self.framebuffer.viewport = (0, 0, *self.size)

    def read(self):
        """Copy the G-buffer back; the arrays are reused by the next ping."""
        for index, (pixels, components) in enumerate(zip(self.pixels, (4, 2), strict=True)):
            self.framebuffer.read_into(pixels, components=components, attachment=index, dtype="f4")

    def sector_pixels(self):
        """(sector, (R, C, 4) normal and range, (R, C, 2) echo and body) of each sector."""
        left = 0
        for sector in self.fan.sectors:
            here = (slice(0, sector.rows), slice(left, left + sector.columns))
            yield sector, self.pixels[0][here], self.pixels[1][here]
            left += sector.columns

    def gbuffers(self) -> list[GBuffer]:
        """What was read, one `GBuffer` a sector, copied."""
        out = []
        for _, normal_range, echo_body in self.sector_pixels():
            out.append(
                GBuffer(
                    range_m=normal_range[..., 3].copy(),
                    normal=normal_range[..., :3].copy(),
                    echo=echo_body[..., 0].copy(),
                    body_id=echo_body[..., 1].astype(np.uint16),
                )
            )
        return out
