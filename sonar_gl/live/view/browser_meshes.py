"""Meshes of a scene for a browser, with fewer triangles where it has too many."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.scene.scene import Body, Scene

MAX_TRIANGLES = 200_000
FEWEST = 12  # triangles of a body, those of a box; bodies that cannot have as many are left out
COARSER = 1.25  # from one try of a cell's size to the next


@dataclass(frozen=True, eq=False)
class BrowserMesh:
    """A body's mesh for a browser."""

    name: str  # of the body
    # (V, 3) float32, metres, relative to `middle`: browsers have no float64, and vertices may be in UTM
    vertices: np.ndarray
    middle: np.ndarray  # (3,) float64, of the mesh's box in the body's frame
    faces: np.ndarray  # (F, 3) uint32
    pose: np.ndarray  # (4, 4) world_from_body, as the scene has it


def browser_meshes(scene: Scene, max_triangles: int = MAX_TRIANGLES) -> list[BrowserMesh]:
    """Return the meshes of all bodies, with at most `max_triangles` in all; the scene stays as it is.

    Bodies with many triangles lose most. Where there are more bodies than `max_triangles` / 12, the smallest are left
    out.
    """
    bodies = list(scene.bodies)
    if len(bodies) > max_triangles // FEWEST:
        largest = sorted(
            range(len(bodies)), key=lambda index: -np.ptp(bodies[index].surface.vertices, axis=0).max()
        )
        bodies = [bodies[index] for index in sorted(largest[: max_triangles // FEWEST])]
    most = _most_triangles([len(body.surface.faces) for body in bodies], max_triangles)
    return [_browser_mesh(body, most) for body in bodies]


def _most_triangles(counts: list[int], total: int) -> int:
    """Return the most triangles that each body may have so that all have no more than `total`."""
    left, most = total, total
    for number, count in enumerate(sorted(counts)):
        most = left // (len(counts) - number)
        if count > most:
            return most
        left -= count
    return total


def _browser_mesh(body: Body, most: int) -> BrowserMesh:
    vertices = np.asarray(body.surface.vertices, np.float64)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices = (vertices - middle).astype(np.float32)
    faces = np.asarray(body.surface.faces, np.int64)
    if len(faces) > most:
        vertices, faces = decimated(vertices, faces, most)
    return BrowserMesh(body.name, vertices, middle, faces.astype(np.uint32), body.pose)


def decimated(vertices: np.ndarray, faces: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh with at most `most` triangles: the vertices in each cell of a grid become one, their mean.

    vertices, faces : (V, 3) float32, metres, and (F, 3) int64, as in what is returned
    """
    corners = vertices[faces].astype(np.float64)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ).sum()
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    # two triangles a cell on a plane; `area` counts it twice
    cell_m = max(math.sqrt(area / most), extent / 2**20)
    while True:
        out = _clustered(vertices, faces, cell_m)
        if len(out[1]) <= most:
            return out
        cell_m *= COARSER


def _clustered(vertices: np.ndarray, faces: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Join the vertices of each cell; return the vertices and the faces that still have three of them."""
    cells = ((vertices - vertices.min(axis=0)) / cell_m).astype(np.int64)  # below 2^21 along each axis
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    _, joined, counts = np.unique(keys, return_inverse=True, return_counts=True)
    joined = joined.ravel()
    middles = np.stack([np.bincount(joined, axis) for axis in vertices.T.astype(np.float64)], axis=-1)
    faces = joined[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)  # faces that lie in one another
    return (middles / counts[:, None]).astype(np.float32), faces[np.sort(first)]
