"""What a camera beside the sonar sees: colour and depth, drawn by pyrender in an OpenGL context of ours."""

from __future__ import annotations

import numpy as np

from sonar_gl import egl, gl
from sonar_gl.camera import Camera
from sonar_gl.load import import_pyrender
from sonar_gl.rigid import check_pose
from sonar_gl.scene import Scene
from sonar_gl.types import Error, check_kind

# Linear light: a sun overhead, a lamp at the camera, and a little from everywhere
SUN, LAMP, EVERYWHERE = 2.0, 2.0, 0.15
NOTHING = (0.0, 0.02, 0.05)  # colour where no body is


class Optical:
    """Draws a scene as a pinhole camera sees it, in clear water. Use it in a `with` block, or call `close()`.

    Bodies have their meshes' own colours, or else are as gray as their reflectivity; both sides of a face are
    seen. It may live beside simulators in one process: what context is current stays so.

    Parameters
    ----------
    scene : Scene; its bubbles are not drawn
    camera : Camera, such as `Camera.of_fov(640, 480, fov_x_rad=1.2)`
    near_m, far_m : from where to where, along the optical axis, things are seen. Depth has 24 bits: it is
        good to depth² / (near_m · 1.7e7), to a millimetre at 40 m with 0.1 m
    device : as for `Simulator`

    Raises
    ------
    Error
        if there is no usable OpenGL or pyrender, or the image is larger than the driver can draw.
    """

    def __init__(self, scene, camera, near_m: float = 0.1, far_m: float = 100.0, device: int | None = None):
        self._context = None
        check_kind("scene", scene, Scene, "sonar_gl.load_scene makes one from a name or a file")
        check_kind("camera", camera, Camera, "such as sonar_gl.Camera.of_fov(640, 480, fov_x_rad=1.2)")
        projection = camera.projection(near_m, far_m)
        pyrender = import_pyrender()

        class Pinhole(pyrender.camera.Camera):
            """The camera's own projection."""

            def get_projection_matrix(self, width=None, height=None):
                return projection

        self.scene, self.camera = scene, camera
        # all in the frame of the camera, which is OpenGL's: float32 is exact enough only near the origin
        self._drawn = pyrender.Scene(bg_color=NOTHING, ambient_light=[EVERYWHERE] * 3)
        self._drawn.add(Pinhole(near_m, far_m))
        self._drawn.add(pyrender.DirectionalLight(intensity=LAMP))
        self._sun = self._drawn.add(pyrender.DirectionalLight(intensity=SUN))
        self._bodies = {b.name: (b, self._drawn.add(_mesh(pyrender, b))) for b in scene.bodies}
        gl.release_discarded()
        with egl.kept():
            self._context = gl.create_context(device)
        with self._context as context:
            most = context.info["GL_MAX_RENDERBUFFER_SIZE"]
        if max(camera.width, camera.height) > most:
            self.close()
            raise Error(
                f"a camera must have at most {most} pixels a side (got {camera.width} by {camera.height}; "
                "the driver can draw no more)"
            )
        self._renderer = pyrender.Renderer(camera.width, camera.height)
        # its finaliser would delete names in whichever context is current; they go with the context instead
        self._renderer.delete = lambda: None
        self._flags = pyrender.RenderFlags

    def __call__(self, pose, bodies=None) -> tuple[np.ndarray, np.ndarray]:
        """What is seen from a pose.

        Parameters
        ----------
        pose : (4, 4) of the camera's place in the world; as for a sonar x is ahead, y to the left, z up
        bodies : of this image alone, names to (4, 4) world_from_body, or to None for what is not there

        Returns
        -------
        rgb : (H, W, 3) uint8, the first row on top
        depth : (H, W) float32, metres along the optical axis to what is in the middle of a pixel, 0 where
            nothing is

        Raises
        ------
        Error
            if a pose is none, or a name is no body's.
        """
        if self._context is None:
            raise Error("this Optical is closed; make a new one")
        camera_from_world = np.linalg.inv(self.camera.pose_gl(pose))
        places = self._places(bodies)
        for name, (_, node) in self._bodies.items():
            node.mesh.is_visible = places[name] is not None
            if places[name] is not None:
                self._drawn.set_pose(node, camera_from_world @ places[name])
        down = camera_from_world.copy()
        down[:3, 3] = 0
        self._drawn.set_pose(self._sun, down)
        with self._context:
            rgb, _ = self._renderer.render(self._drawn, self._flags.OFFSCREEN)
            # Colours are means of four samples a pixel, and their depth is one's of these, which is not in
            # its middle. Pictures of segments have one sample, there.
            numbers = {node: (0, 0, 0) for _, node in self._bodies.values()}
            _, depth = self._renderer.render(self._drawn, self._flags.OFFSCREEN | self._flags.SEG, numbers)
        return np.ascontiguousarray(rgb), np.ascontiguousarray(depth)

    def _places(self, bodies) -> dict:
        places = {name: body.pose for name, (body, _) in self._bodies.items()}
        if bodies is None:
            return places
        check_kind("bodies", bodies, dict, 'such as {"diver": sonar_gl.pose(x=5)}, or None for "not there"')
        plumes = {plume.name for plume in self.scene.plumes}
        for name, place in bodies.items():
            if name not in places and name not in plumes:
                known = ", ".join(map(repr, places)) or "none"
                raise Error(f"bodies must be bodies of the scene (got {name!r}; there are: {known[:200]})")
            if name in places:
                places[name] = place if place is None else check_pose(place, f"the pose of body {name!r}")
        return places

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self) -> None:
        """Give back all that is in OpenGL; twice does no harm."""
        context, self._context = self._context, None
        if context is not None:
            gl.release(context)

    def __del__(self):
        if getattr(self, "_context", None) is not None:
            gl.discard(self._context)  # later: somebody else may be drawing now


def _mesh(pyrender, body):
    """Of a body, each face twice, once for each side: pyrender lights fronts alone."""
    mesh, mu = body.mesh, body.reflectivity
    faces, colours, texture_at, paint = np.asarray(mesh.faces), None, None, {}
    if mesh.visual.defined:
        (own,) = pyrender.Mesh.from_trimesh(mesh, smooth=False).primitives
        colours, texture_at = own.color_0, own.texcoord_0
        paint["baseColorFactor"] = own.material.baseColorFactor
        if texture_at is not None:
            paint["baseColorTexture"] = own.material.baseColorTexture
    elif np.ndim(mu):
        colours = np.repeat(mu, 3)[:, None] * [1, 1, 1, 0] + [0, 0, 0, 1]
    else:
        paint["baseColorFactor"] = [mu, mu, mu, 1.0]
    # of what a mesh is painted with the colours alone: metal would be dark, with nothing about to mirror
    material = pyrender.MetallicRoughnessMaterial(metallicFactor=0.0, roughnessFactor=0.9, **paint)
    normals = np.repeat(mesh.face_normals, 3, axis=0)
    if body.normals is not None:
        smooth = body.normals[faces].reshape(-1, 3)
        normals = np.where(smooth.any(axis=1)[:, None], smooth, normals)

    def both(corners, sign=1.0):
        if corners is None:
            return None
        three = np.asarray(corners, np.float32).reshape(len(faces), 3, -1)
        return np.concatenate([three, sign * three[:, ::-1]]).reshape(6 * len(faces), -1)

    primitive = pyrender.Primitive(
        both(np.asarray(mesh.vertices)[faces]),
        both(normals, -1.0),
        texcoord_0=both(texture_at),
        color_0=both(colours),
        material=material,
        mode=pyrender.GLTF.TRIANGLES,
    )
    return pyrender.Mesh([primitive])
