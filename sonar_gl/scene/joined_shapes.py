"""Shapes with the properties of their surfaces, joined to bodies: of a link of SDF, or a body of MuJoCo."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.scene import primitives
from sonar_gl.scene.primitives import Shape
from sonar_gl.scene.scene import Body


class EchoingShape(NamedTuple):
    """A shape in the frame of its body, with its reflectivity (one value, or (F,)) and material."""

    shape: Shape
    reflectivity: float | np.ndarray
    material: str | None


class SurfaceKind(NamedTuple):
    """What shapes must have alike to be one body: properties of its whole surface, as the fields of `Body`."""

    specular: float = 0.0
    roughness_rad: float | None = None
    speckle_shape: float | None = None


def body_of_shapes(name: str, group: list[EchoingShape], pose, kind: SurfaceKind) -> Body:
    """Return one body from shapes of one kind of surface.

    pose : (4, 4) world_from_body
    """
    shapes, reflectivities, materials = zip(*group, strict=True)
    mesh, normals = shapes[0] if len(shapes) == 1 else primitives.concatenate(shapes)
    reflectivity = reflectivities[0]
    if any(map(np.ndim, reflectivities)) or len(set(reflectivities)) > 1:
        per_face = [np.broadcast_to(one.reflectivity, len(one.shape.mesh.faces)) for one in group]
        reflectivity = np.concatenate(per_face)
    common_material = materials[0] if len(set(materials)) == 1 else None
    return Body(name, mesh, pose, reflectivity, normals, material=common_material, **kind._asdict())
