"""A body's mesh as the driver wants it: about its middle, vertices welded, in levels of detail."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.detail import MANY, Levels, make_levels
from sonar_gl.meshes import closedness


@dataclass(frozen=True, eq=False)
class Prepared:
    """What does not change while a body moves.

    Attributes
    ----------
    centre : (3,) float64 of its box, in the body's frame; all else counts from there
    bounds : (2, 3) low and high corner of the box
    closed : +1 if its every edge joins two faces of one orientation, else 0; its normals point outwards
    levels : Levels
    points : (W, 3) float32, of the levels' vertices; normals : (W, 3) float32 or None
    reflectivity : (W,) float32, alike about each face, or None where the whole body has one
    """

    centre: np.ndarray
    bounds: np.ndarray
    closed: int
    levels: Levels
    points: np.ndarray
    normals: np.ndarray | None
    reflectivity: np.ndarray | None


def _weld(rows, faces):
    """Vertices alike in all their columns made one: which of them stay, and the faces' new numbers."""
    bits = (rows + 0.0).view(np.uint64)  # −0 is 0
    marks = np.zeros(len(rows), np.uint64)
    for column in bits.T:
        marks = (marks ^ column) * np.uint64(0x9E3779B97F4A7C15)
        marks ^= marks >> np.uint64(29)
    _, kept, same = np.unique(marks, return_index=True, return_inverse=True)
    same = same.ravel()
    if not (bits == bits[kept][same]).all():  # two marks alike by chance
        _, kept, same = np.unique(bits, axis=0, return_index=True, return_inverse=True)
    faces = same.ravel()[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return kept, faces[whole] if whole.any() else faces


def prepare(body) -> Prepared:
    """The mesh of a body."""
    points, faces = np.asarray(body.surface.vertices, np.float64), np.asarray(body.surface.faces)
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    centre = bounds.mean(axis=0)
    closed = closedness(points, faces)
    points, normals, reflectivity = points - centre, body.normals, None
    if closed < 0:
        faces = faces[:, ::-1]
    if np.ndim(body.reflectivity):  # a vertex for each reflectivity of the faces about it
        reflectivity = np.repeat(np.asarray(body.reflectivity, np.float64), 3)
        corners = np.ascontiguousarray(faces).ravel()
        points, faces = points[corners], np.arange(len(corners)).reshape(-1, 3)
        normals = None if normals is None else normals[corners]
    if len(faces) > MANY or reflectivity is not None:
        columns = [points]
        columns += [] if normals is None else [normals.astype(np.float64)]
        columns += [] if reflectivity is None else [reflectivity[:, None]]
        kept, faces = _weld(np.column_stack(columns), faces)
        points = points[kept]
        normals = None if normals is None else normals[kept]
        reflectivity = None if reflectivity is None else reflectivity[kept].astype(np.float32)
    levels = make_levels(points, faces)
    own = levels.vertices
    return Prepared(
        centre=centre,
        bounds=bounds - centre,
        closed=abs(closed),
        points=points[own].astype(np.float32),
        normals=None if normals is None else normals[own],
        reflectivity=None if reflectivity is None else reflectivity[own],
        levels=levels,
    )
