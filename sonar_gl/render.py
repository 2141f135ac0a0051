"""Scene to G-buffer: the only stage that draws."""

from __future__ import annotations

import moderngl
import numpy as np

from sonar_gl.fan import Fan, Sector
from sonar_gl.gl import compile_program
from sonar_gl.scene import Scene
from sonar_gl.types import Error, GBuffer

TABLE_WIDTH = 4096  # texels; whole bodies to a row of the table
# Nearer than this the sonar looks through things: its own face is not an echo.
NEAR_M = 1e-3
# Surfaces are drawn this much beyond the last bin, since near grazing a sample whose middle lies beyond it
# still reaches into it.
FAR_FACTOR = 8.0
# Back faces of closed bodies are not drawn. Finding out whether a larger mesh is closed costs too much.
MAX_CLOSED_FACES = 50_000


class SceneOnGpu:
    """A scene's meshes in GL buffers; poses stay on the CPU, in float64, until a ping needs them."""

    def __init__(self, context: moderngl.Context, scene: Scene, shader_folder):
        self.context, self.scene, self.shader_folder = context, scene, shader_folder
        self.programs, self.arrays = {}, {}
        bodies = scene.bodies
        if not bodies:
            return
        limit = context.info["GL_MAX_TEXTURE_SIZE"] * TABLE_WIDTH
        if scene.n_triangles > limit:
            raise Error(
                f"a scene may have at most {limit} triangles on this OpenGL driver "
                f"(got {scene.n_triangles}; decimate its meshes)"
            )
        vertices = [np.asarray(body.mesh.vertices, np.float64) for body in bodies]
        faces = [np.asarray(body.mesh.faces, np.int64) for body in bodies]
        self.bounds = np.array([[v.min(axis=0), v.max(axis=0)] for v in vertices])
        self.centres = self.bounds.mean(axis=1)
        self.poses = np.array([body.pose for body in bodies])
        # +1: closed, normals outwards; −1: closed, normals inwards; 0: open
        self.closed = np.array([closedness(v, f) for v, f in zip(vertices, faces, strict=True)])
        first = np.concatenate([[0], np.cumsum([len(v) for v in vertices])])
        order = np.argsort(self.closed == 0, kind="stable")  # closed bodies first
        indices = [(faces[b][:, :: -1 if self.closed[b] < 0 else 1] + first[b]) for b in order]
        self.n_faces = sum(len(faces[b]) for b in order)
        self.n_closed_faces = sum(len(faces[b]) for b in order if self.closed[b])
        self.features = {
            "SHADING_NORMALS": int(any(body.normals is not None for body in bodies)),
            "FACE_REFLECTIVITY": int(any(np.ndim(body.reflectivity) for body in bodies)),
            "TABLE_WIDTH": TABLE_WIDTH,
        }
        numbers = np.repeat(np.arange(len(bodies), dtype=np.uint32), np.diff(first))
        positions = np.concatenate(vertices) - self.centres[numbers]
        self.layout = [
            (context.buffer(positions.astype(np.float32).tobytes()), "3f", "in_position"),
            (context.buffer(numbers.tobytes()), "1u", "in_body"),
        ]
        if self.features["SHADING_NORMALS"]:
            normals = [
                np.zeros(v.shape, np.float32) if body.normals is None else body.normals
                for v, body in zip(vertices, bodies, strict=True)
            ]
            self.layout.append((context.buffer(np.concatenate(normals).tobytes()), "3f", "in_normal"))
        self.indices = context.buffer(np.concatenate(indices).astype(np.uint32).tobytes())
        self.body_texels = np.zeros((-(-len(bodies) * 4 // TABLE_WIDTH) * TABLE_WIDTH, 4), np.float32)
        self.body_texels[3 : 4 * len(bodies) : 4, 0] = [np.mean(body.reflectivity) for body in bodies]
        self.body_table = self._table(self.body_texels)
        self.face_table = self.body_table
        if self.features["FACE_REFLECTIVITY"]:
            texels = np.zeros((-(-self.n_faces // TABLE_WIDTH) * TABLE_WIDTH, 1), np.float32)
            reflectivity = [np.broadcast_to(bodies[b].reflectivity, len(faces[b])) for b in order]
            texels[: self.n_faces, 0] = np.concatenate(reflectivity)
            self.face_table = self._table(texels)

    def _table(self, texels):
        size = (TABLE_WIDTH, len(texels) // TABLE_WIDTH)
        texture = self.context.texture(size, texels.shape[1], texels.tobytes(), dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def array(self, labels: bool) -> moderngl.VertexArray:
        """The vertex array whose program writes bodies' numbers too, or does not."""
        if labels not in self.arrays:
            defines = {**self.features, "LABELS": int(labels)}
            program = compile_program(
                self.context, self.shader_folder, "gbuffer.vert", "gbuffer.frag", defines
            )
            for name, unit in (("body_table", 0), ("face_table", 1)):
                if name in program:
                    program[name] = unit
            self.arrays[labels] = self.context.vertex_array(program, self.layout, index_buffer=self.indices)
        return self.arrays[labels]

    def place(self, pose: np.ndarray) -> bool:
        """Upload the bodies' matrices relative to the sonar, taken in float64 before they are rounded.

        Returns
        -------
        bool
            whether back faces may be left out: the sonar is in the box of no closed body.
        """
        sonar_from_world = pose[:3, :3].T
        rotations = sonar_from_world @ self.poses[:, :3, :3]
        offsets = (self.poses[:, :3, 3] - pose[:3, 3]) @ sonar_from_world.T
        texels = self.body_texels[: 4 * len(rotations)].reshape(-1, 4, 4)
        texels[:, :3, :3] = rotations
        texels[:, :3, 3] = offsets + np.einsum("nij,nj->ni", rotations, self.centres)
        self.body_table.write(self.body_texels)
        sonar = -np.einsum("nji,nj->ni", rotations, offsets)
        low, high = self.bounds[:, 0] - 2 * NEAR_M, self.bounds[:, 1] + 2 * NEAR_M
        inside = ((sonar > low) & (sonar < high)).all(axis=1)
        return not (inside & (self.closed != 0)).any()


def closedness(vertices, faces) -> int:
    """+1 or −1 for a mesh whose every edge joins two faces of one orientation, by the sign of its volume."""
    if len(faces) > MAX_CLOSED_FACES:
        return 0
    extent = np.ptp(vertices, axis=0).max()
    # vertices that coincide count as one, for creases and seams duplicate them
    keys = np.ascontiguousarray(np.round(vertices / (extent or 1.0) * 1e9).astype(np.int64))
    _, same = np.unique(keys.view([("", np.int64)] * 3).ravel(), return_inverse=True)
    triangles = same.ravel()[faces]
    triangles = triangles[
        (triangles[:, 0] != triangles[:, 1])
        & (triangles[:, 1] != triangles[:, 2])
        & (triangles[:, 2] != triangles[:, 0])
    ]
    a, b = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    n = len(vertices)
    forward, backward = np.sort(a * n + b), np.sort(b * n + a)
    if len(forward) == 0 or (np.diff(forward) == 0).any() or not np.array_equal(forward, backward):
        return 0
    middle = vertices - vertices.mean(axis=0)
    x, y, z = (middle[faces[:, k]] for k in range(3))
    return int(np.sign(np.einsum("ij,ij->", x, np.cross(y, z))))


class Renderer:
    """Draws a fan's sectors side by side into one framebuffer and reads them back."""

    def __init__(self, context: moderngl.Context, gpu: SceneOnGpu, fan: Fan):
        self.context, self.gpu, self.fan = context, gpu, fan
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
        plane_echo = context.renderbuffer(self.size, 4, dtype="f4")
        body_id = context.renderbuffer(self.size, 1, dtype="u2")
        depth = context.depth_renderbuffer(self.size)
        self.framebuffers = {
            False: context.framebuffer([plane_echo], depth),
            True: context.framebuffer([plane_echo, body_id], depth),
        }
        self.uniforms = {}
        self.plane_echo = np.zeros((height, width, 4), np.float32)
        self.body_id = np.zeros((height, width), np.uint16)
        self.lefts = np.cumsum([0] + [s.columns for s in fan.sectors])[:-1]

    def render(self, pose: np.ndarray, labels: bool = False):
        """Draw all sectors as seen from `pose`, world_from_sonar, and read them back.

        The arrays `plane_echo` and, with labels, `body_id` are used again by the next call.
        """
        gpu, framebuffer = self.gpu, self.framebuffers[labels]
        framebuffer.use()
        framebuffer.clear(depth=1.0)
        if self.gpu.scene.bodies:
            outside = gpu.place(pose)
            array = gpu.array(labels)
            gpu.body_table.use(0)
            gpu.face_table.use(1)
            for sector, left in zip(self.fan.sectors, self.lefts, strict=True):
                framebuffer.viewport = (left, 0, sector.columns, sector.rows)
                for name, value in self._uniforms(array.program, sector, int(left)):
                    array.program[name].write(value)
                split = gpu.n_closed_faces if outside else 0
                if split:
                    self._draw(array, moderngl.DEPTH_TEST | moderngl.CULL_FACE, 0, split)
                if split < gpu.n_faces:
                    self._draw(array, moderngl.DEPTH_TEST, split, gpu.n_faces - split)
            framebuffer.viewport = (0, 0, *self.size)
        framebuffer.read_into(self.plane_echo, components=4, dtype="f4")
        if labels:
            framebuffer.read_into(self.body_id, components=1, dtype="u2", attachment=1)

    def _uniforms(self, program, sector: Sector, left: int) -> list[tuple[str, bytes]]:
        """What a program needs to know of a sector; the same for every ping."""
        key = (program.glo, left)
        if key not in self.uniforms:
            pixel_from_uv = np.linalg.inv([[sector.u[1], sector.u[2]], [sector.v[1], sector.v[2]]])
            values = {
                "clip_from_sonar": sector.projection(NEAR_M, self.far_m).T,
                "sector_from_sonar": sector.rotation().T,
                "pixel_from_uv": pixel_from_uv.T,
                "far_m": self.far_m,
                # pixels count from the left of the whole framebuffer
                "u": sector.u - [sector.u[1] * left, 0, 0],
                "v": sector.v - [sector.v[1] * left, 0, 0],
            }
            self.uniforms[key] = [
                (name, np.ascontiguousarray(value, np.float32).tobytes())
                for name, value in values.items()
                if name in program
            ]
        return self.uniforms[key]

    def _draw(self, array, flags: int, first_face: int, n_faces: int):
        self.context.enable_only(flags)
        if "first_face" in array.program:
            array.program["first_face"].value = first_face
        array.render(vertices=3 * n_faces, first=3 * first_face)

    def views(self):
        """(sector, (R, C, 4) plane and echo, (R, C) body) of each sector, of the last render."""
        for sector, left in zip(self.fan.sectors, self.lefts, strict=True):
            here = (slice(0, sector.rows), slice(left, left + sector.columns))
            yield sector, self.plane_echo[here], self.body_id[here]

    def gbuffers(self) -> list[GBuffer]:
        """What was read, one `GBuffer` a sector."""
        out = []
        for sector, plane_echo, body_id in self.views():
            u, v = sector.rays()
            q, along_u, along_v = (plane_echo[..., k].astype(np.float64) for k in range(3))
            plane = np.stack([q - along_u * u - along_v * v, -along_u, along_v], axis=-1)
            hit = q > 0
            length = np.where(hit, np.linalg.norm(plane, axis=-1), 1.0)
            normal = -(plane / length[..., None]) @ sector.rotation()
            range_m = np.where(hit, np.sqrt(1 + u * u + v * v) / np.where(hit, q, 1.0), 0.0)
            out.append(
                GBuffer(
                    range_m=range_m.astype(np.float32),
                    normal=np.where(hit[..., None], normal, 0).astype(np.float32),
                    echo=np.where(hit, plane_echo[..., 3] / np.where(hit, range_m, 1), 0).astype(np.float32),
                    body_id=np.where(hit, body_id, 0),  # cleared or not is left open for integers
                )
            )
        return out
