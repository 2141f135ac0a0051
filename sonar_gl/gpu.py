"""A scene's meshes and tables in the driver's memory."""

from __future__ import annotations

import moderngl
import numpy as np

from sonar_gl.gl import compile_program
from sonar_gl.meshes import closedness
from sonar_gl.scene import Scene
from sonar_gl.types import Error

TABLE_WIDTH = 4096  # texels; whole bodies to a row of the table
# Nearer than this the sonar looks through things: its own face is not an echo.
NEAR_M = 1e-3


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

    def place(self, pose: np.ndarray):
        """Upload the bodies' matrices relative to the sonar, taken in float64 before they are rounded.

        Returns
        -------
        rotations, offsets : (n, 3, 3) and (n, 3) sonar_from_body
        outside : whether back faces may be left out: the sonar is in the box of no closed body
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
        return rotations, offsets, not (inside & (self.closed != 0)).any()
