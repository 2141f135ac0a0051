"""Shading normals that round the edges of flat faces, which then echo as curved ones."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sonar_gl.core.errors import some_names
from sonar_gl.scene.scene import Body

# A normal that is shared by two faces at right angles, such as those of a box, lies 45 degrees off either; one of a
# smooth surface of eight facets around lies 22.5 degrees off.
MOST_TURNED_DEG = 40.0
MOST_FACES = 50_000  # of finer meshes few faces lie at edges


def turned_share(body: Body) -> float:
    """Return the share of a body's area in faces of which a shading normal lies more than MOST_TURNED_DEG off.

    >>> import trimesh
    >>> box = trimesh.creation.box((4, 2, 1))
    >>> turned_share(Body("box", box)), turned_share(Body("box", box, normals=box.vertex_normals))
    (0.0, 1.0)
    """
    if body.normals is None or len(body.surface.faces) > MOST_FACES:
        return 0.0
    faces = np.asarray(body.surface.faces)
    a, b, c = np.asarray(body.surface.vertices, np.float64)[faces].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)  # vectors of twice the area
    lengths = np.linalg.norm(areas, axis=1)
    normals = np.asarray(body.normals, np.float64)[faces]
    # of either side: faces may be listed the other way round than their normals point
    along = np.abs(np.einsum("fki,fi->fk", normals, areas))
    least = np.cos(np.radians(MOST_TURNED_DEG)) * np.linalg.norm(normals, axis=2) * lengths[:, None]
    is_shaded = normals.any(axis=2).all(axis=1)  # a normal of zeros is that of the flat face
    is_turned = is_shaded & (along < least).any(axis=1)
    return float(lengths[is_turned].sum() / max(lengths.sum(), 1e-300))


def rounded_text(bodies: Iterable[Body]) -> str:
    """Return a sentence about the bodies most of whose area has normals that round its edges; empty if none has."""
    bodies, shares = list(bodies), {}
    for body in bodies:
        if _shape_of(body) not in shares:
            shares[_shape_of(body)] = turned_share(body)
    names = [body.name for body in bodies if shares[_shape_of(body)] > 0.5]
    if not names:
        return ""
    return (
        f"shading normals of {some_names(names)} lie more than {MOST_TURNED_DEG:g} degrees off the faces: edges are "
        "rounded, and flat faces echo as curved ones; write the mesh with flat shading or sharp edges "
        "(mesh.unmerge_vertices() of trimesh, Mesh.from_trimesh(mesh, smooth=False) of pyrender)"
    )


def _shape_of(body: Body) -> tuple[int, int]:
    """Return what bodies of one mesh with the same normals have in common, while they are held."""
    return id(body.surface), id(body.normals)
