"""Meshes of a scene for a browser, with fewer triangles where it has too many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.scene.scene import Scene

MAX_TRIANGLES = 200_000


@dataclass(frozen=True, eq=False)
class BrowserMesh:
    """A body's mesh for a browser.

    Attributes
    ----------
    name : of the body
    vertices : (V, 3) float32, metres, in the body's frame
    faces : (F, 3) uint32
    pose : (4, 4) world_from_body, as the scene has it
    reflectivity : mean of the body's, 0..1
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    pose: np.ndarray
    reflectivity: float


def browser_meshes(scene: Scene, max_triangles: int = MAX_TRIANGLES) -> list[BrowserMesh]:
    """Return the meshes of all bodies, with at most `max_triangles` in all; the scene stays as it is."""
    return [
        BrowserMesh(
            body.name,
            np.asarray(body.surface.vertices, np.float32),
            np.asarray(body.surface.faces, np.uint32),
            body.pose,
            float(np.mean(body.reflectivity)),
        )
        for body in scene.bodies
    ]
