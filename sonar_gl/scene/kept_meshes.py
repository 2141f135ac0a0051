"""Copies of the meshes that a world was given: a trimesh may be changed in place, by its owner, at any time.

The raster engine copies vertices when it takes a body. Estimates of errors, reflectors, and the warning of a ping
without echo read the mesh later; by these copies they read the shape that is drawn.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy

import numpy as np

from sonar_gl.scene.primitives import Triangles
from sonar_gl.scene.scene import Body, Scene


class KeptMeshes:
    """Copies of meshes, one for all bodies of a mesh as long as it is not changed."""

    def __init__(self):
        # by the id of the mesh, which is held here, too, so that no other object has its id
        self._copies: dict[int, tuple[object, Triangles]] = {}

    def scene(self, scene: Scene) -> Scene:
        """Return the same scene with bodies whose meshes nobody else can change."""
        return scene.with_bodies(self.bodies(scene.bodies))

    def bodies(self, bodies: Iterable) -> list:
        """Return bodies whose meshes nobody else can change; plumes stay as they are."""
        return [self._body(body) if isinstance(body, Body) else body for body in bodies]

    def _body(self, body: Body) -> Body:
        # also where the surface is `Triangles`: reading `mesh` of the given body puts a trimesh in their place
        kept = copy(body)
        if not isinstance(body.surface, Triangles):
            object.__setattr__(kept, "surface", self._copy(body.surface))
        return kept

    def _copy(self, mesh) -> Triangles:
        """Return a copy of a mesh: the one made before, if the mesh is still the same."""
        _, before = self._copies.get(id(mesh), (None, None))
        is_same = before is not None and np.array_equal(mesh.vertices, before.vertices)
        if is_same and np.array_equal(mesh.faces, before.faces):
            return before
        made = Triangles(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))
        self._copies[id(mesh)] = mesh, made
        return made
