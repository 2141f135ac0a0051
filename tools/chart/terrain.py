"""Remesh the bundled ocean floor: more triangles, or fewer, over the same ground."""

from __future__ import annotations

import math

import cv2
import numpy as np
import trimesh

import sonar_gl as sg


def finer_floor(triangles: int):
    """Make the scene `ocean_floor` with about so many triangles, its heights by cubic interpolation.

    Returns
    -------
    Scene with flat faces; `scene.n_triangles` is how many there are
    """
    scene = sg.load_scene("ocean_floor")
    floor, *others = scene.bodies
    points = np.asarray(floor.mesh.vertices)
    xs, column = np.unique(points[:, 0].round(6), return_inverse=True)
    ys, row = np.unique(points[:, 1].round(6), return_inverse=True)
    heights = np.empty((len(ys), len(xs)), np.float32)
    heights[row, column] = points[:, 2]
    n = math.isqrt(triangles // 2) + 1  # vertices along a side
    heights = cv2.resize(heights, (n, n), interpolation=cv2.INTER_CUBIC)

    def along(old):
        """Return the places of OpenCV's new values: both grids' cells fill the same square."""
        at = (np.arange(n) + 0.5) * len(old) / n - 0.5
        return old[0] + at * (old[-1] - old[0]) / (len(old) - 1)

    x, y = np.meshgrid(along(xs), along(ys))
    vertices = np.stack([x.ravel(), y.ravel(), heights.ravel().astype(float)], axis=1)
    corner = np.arange(n * (n - 1), dtype=np.int32).reshape(n - 1, n)[:, :-1].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + a, corner + b], axis=1) for a, b in ((1, n + 1), (n + 1, n))]
    )
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    bodies = [sg.Body(floor.name, mesh, floor.pose, floor.reflectivity)]
    bodies += [sg.Body(one.name, one.mesh, one.pose, one.reflectivity) for one in others]
    return sg.Scene(bodies, scene.sonar_pose, scene.name)
