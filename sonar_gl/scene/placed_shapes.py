"""Bodies of shapes that nodes of a scene place by affine transforms."""

from __future__ import annotations

import numpy as np

from sonar_gl.scene.primitives import Shape, rotation_and_stretch, transform
from sonar_gl.scene.scene import Body, warn_of_unit

SAME_SIZE_M = 1e-6  # copies of a shape that differ in no vertex by more share one
RIGID = 1e-12  # most of R Rᵀ − 1 that products of rotations in float64 leave


class PlacedShapes:
    """Makes the bodies of a scene. Those of one shape and size share a mesh, of which pings then keep one in memory."""

    def __init__(self):
        # by the id of a mesh: the mesh, held so that no other has its id, and how far it reaches from its origin
        self._reaches_m: dict[int, tuple[object, float]] = {}
        self._stretched: dict[tuple, Shape] = {}

    def body(self, name: str, shape: Shape, world_from_node) -> Body:
        """Return a body with the pose of its node; scale, shear and mirroring go into the vertices.

        shape : its mesh is known by its identity, so it must not be changed meanwhile
        world_from_node : (4, 4), affine
        """
        pose = np.array(world_from_node, np.float64)
        linear = pose[:3, :3]
        is_rigid = np.allclose(linear @ linear.T, np.eye(3), rtol=0, atol=RIGID) and np.linalg.det(linear) > 0
        if not is_rigid and np.isfinite(linear).all():  # of others `Body` says what is wrong
            pose[:3, :3], stretch = rotation_and_stretch(linear)
            shape = self._stretch(shape, stretch)
        return Body(name, shape.mesh, pose, normals=shape.normals)

    def _stretch(self, shape: Shape, stretch: np.ndarray) -> Shape:
        """Return a shape under a linear (3, 3) transform, or the one of this size that was made before."""
        key = id(shape.mesh)
        if key not in self._reaches_m:
            self._reaches_m[key] = shape.mesh, float(np.abs(shape.mesh.vertices).max(initial=0.0))
        _, reach_m = self._reaches_m[key]
        changes = tuple(np.round((stretch - np.eye(3)) * (reach_m / SAME_SIZE_M)).flat)
        if not any(changes):
            return shape
        if (key, changes) not in self._stretched:
            warn_of_unit(shape.mesh)  # which the transformed one does not state
            matrix = np.eye(4)
            matrix[:3, :3] = stretch
            self._stretched[key, changes] = transform(shape, matrix)
        return self._stretched[key, changes]
