"""A camera on the vehicle: colour and depth, rendered by pyrender in an OpenGL context of its own."""

from __future__ import annotations

import numpy as np

from sonar_gl.core.checks import check_kind, unknown_body_error
from sonar_gl.core.closing import Closable
from sonar_gl.core.errors import Error, closed_error
from sonar_gl.core.poses import check_pose
from sonar_gl.embed.camera import Camera
from sonar_gl.gl import context as gl
from sonar_gl.gl import egl, lifetime
from sonar_gl.scene.pyrender_scene import import_pyrender
from sonar_gl.scene.scene import Scene

# Linear light: a sun overhead, a lamp at the camera, and ambient light
SUN, LAMP, AMBIENT = 2.0, 2.0, 0.15
BACKGROUND_RGB = (0.0, 0.02, 0.05)  # where no body is
# Range of depths along the optical axis that are rendered, metres. Depth has 24 bits, so that its error is
# depth² / (NEAR_M · 1.7e7): a millimetre at 40 m.
NEAR_M, FAR_M = 0.1, 100.0


class OpticalCamera(Closable):
    """Renders a scene by a pinhole camera in clear water. Use it in a `with` block, or call `close()`.

    Bodies have the colours of their meshes; a mesh without colours is gray by its reflectivity. Both sides of
    a face are visible. Simulators may exist in the same process: the current context stays current.

    Raises Error if there is no usable OpenGL or pyrender, or the image is larger than the driver supports.

    scene : Scene; its bubbles are not rendered
    camera : Camera, such as `Camera.of_fov(640, 480, fov_x_rad=1.2)`
    device : as for `Simulator`
    context : its OpenGL context; None once it is closed
    """

    def __init__(self, scene, camera, device: int | None = None):
        self.context = None
        check_kind("scene", scene, Scene, "sonar_gl.load_scene makes one from a name or a file")
        check_kind("camera", camera, Camera, "such as sonar_gl.Camera.of_fov(640, 480, fov_x_rad=1.2)")
        projection = camera.projection(NEAR_M, FAR_M)
        pyrender = import_pyrender()

        class Pinhole(pyrender.camera.Camera):
            """The camera's own projection."""

            def get_projection_matrix(self, width=None, height=None):
                return projection

        self.scene, self.camera = scene, camera
        # everything is in the camera's frame, since float32 is precise only near the origin
        self._graph = pyrender.Scene(bg_color=BACKGROUND_RGB, ambient_light=[AMBIENT] * 3)
        self._graph.add(Pinhole(NEAR_M, FAR_M))
        self._graph.add(pyrender.DirectionalLight(intensity=LAMP))
        self._sun = self._graph.add(pyrender.DirectionalLight(intensity=SUN))
        self._bodies = {b.name: (b, self._graph.add(_mesh(pyrender, b))) for b in scene.bodies}
        lifetime.release_waiting()
        with egl.preserve_current():
            self.context = gl.create_context(device)
        with self.context as context:
            max_size = context.info["GL_MAX_RENDERBUFFER_SIZE"]
        if max(camera.width, camera.height) > max_size:
            self.close()
            raise Error(
                f"a camera must have at most {max_size} pixels a side, as the driver supports no more (got "
                f"{camera.width} by {camera.height})"
            )
        self._renderer = pyrender.Renderer(camera.width, camera.height)
        # its finaliser would delete objects of whichever context is current; they are freed with the context
        self._renderer.delete = lambda: None
        self._flags = pyrender.RenderFlags

    def __call__(self, pose, bodies=None) -> tuple[np.ndarray, np.ndarray]:
        """Render one image: (H, W, 3) uint8 RGB, the first row on top, and (H, W) float32 depth.

        Depth is in metres along the optical axis, at the centre of each pixel, 0 where no body is. Raises Error if a
        pose is invalid, or a name is unknown.

        pose : (4, 4) world_from_camera; as for a sonar x is forward, y to port, z up
        bodies : for this image only, name -> (4, 4) world_from_body, or None for a body that is not present
        """
        if self.context is None:
            raise closed_error("OpticalCamera")
        camera_from_world = np.linalg.inv(self.camera.pose_gl(pose))
        poses = self._poses(bodies)
        for name, (_, node) in self._bodies.items():
            node.mesh.is_visible = poses[name] is not None
            if poses[name] is not None:
                self._graph.set_pose(node, camera_from_world @ poses[name])
        down = camera_from_world.copy()
        down[:3, 3] = 0
        self._graph.set_pose(self._sun, down)
        with self.context:
            rgb, _ = self._renderer.render(self._graph, self._flags.OFFSCREEN)
            # Colours are means of four samples per pixel, and the depth with them is that of one sample, off
            # the centre. Segmentation renders one sample per pixel, at the centre.
            numbers = {node: (0, 0, 0) for _, node in self._bodies.values()}
            _, depth = self._renderer.render(self._graph, self._flags.OFFSCREEN | self._flags.SEG, numbers)
        return np.ascontiguousarray(rgb), np.ascontiguousarray(depth)

    def _poses(self, bodies) -> dict:
        """Return the pose of every body in an image, None for those that are not present."""
        poses = {name: body.pose for name, (body, _) in self._bodies.items()}
        if bodies is None:
            return poses
        check_kind("bodies", bodies, dict, 'such as {"diver": sonar_gl.pose(x=5)}, or None for "not there"')
        plumes = {plume.name for plume in self.scene.plumes}
        for name, pose in bodies.items():
            if name not in poses and name not in plumes:
                raise unknown_body_error(name, {*poses, *plumes})
            if name in poses:
                what = f"the pose of body {name!r}"
                poses[name] = pose if pose is None else check_pose(pose, what, may_scale=True)
        return poses

    def close(self) -> None:
        """Release all OpenGL objects; a second call does nothing."""
        context, self.context = self.context, None
        if context is not None:
            lifetime.release(context)

    def __del__(self):
        if getattr(self, "context", None) is not None:
            lifetime.discard(self.context)  # released later, since another context may be current now


def _mesh(pyrender, body):
    """Return a body as a mesh of pyrender, each face twice, once for each side: only fronts are lit."""
    mesh, mu = body.mesh, body.reflectivity
    faces, colours, uv, material = np.asarray(mesh.faces), None, None, {}
    if mesh.visual.defined:
        (own,) = pyrender.Mesh.from_trimesh(mesh, smooth=False).primitives
        colours, uv = own.color_0, own.texcoord_0
        material["baseColorFactor"] = own.material.baseColorFactor
        if uv is not None:
            material["baseColorTexture"] = own.material.baseColorTexture
    elif np.ndim(mu):
        colours = np.repeat(mu, 3)[:, None] * [1, 1, 1, 0] + [0, 0, 0, 1]
    else:
        material["baseColorFactor"] = [mu, mu, mu, 1.0]
    # only the colours of the mesh's material are used: metal would be dark, with nothing around to reflect
    painted = pyrender.MetallicRoughnessMaterial(metallicFactor=0.0, roughnessFactor=0.9, **material)
    normals = np.repeat(mesh.face_normals, 3, axis=0)
    if body.normals is not None:
        smooth = body.normals[faces].reshape(-1, 3)
        normals = np.where(smooth.any(axis=1)[:, None], smooth, normals)

    def both_sides(corners, sign=1.0):
        """Repeat values at corners for the back, with the corners in reverse order."""
        if corners is None:
            return None
        front = np.asarray(corners, np.float32).reshape(len(faces), 3, -1)
        return np.concatenate([front, sign * front[:, ::-1]]).reshape(6 * len(faces), -1)

    primitive = pyrender.Primitive(
        both_sides(np.asarray(mesh.vertices)[faces]),
        both_sides(normals, -1.0),
        texcoord_0=both_sides(uv),
        color_0=both_sides(colours),
        material=painted,
        mode=pyrender.GLTF.TRIANGLES,
    )
    return pyrender.Mesh([primitive])
