"""Rectangles, such as infinite planes, drawn no further than a sonar sees.

OpenGL has the corners of triangles in single precision, where they lie before the sonar: to 6e-8 of their distance. The
nearest corners of an infinite plane are up to 1.4 km away and off by 0.1 mm in any direction, and so is the plane: a
ten-thousandth of 1/x at a height of 1 m, and a hundredth at 1 cm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.core.poses import scale_of
from sonar_gl.scene.scene import Body

MAX_SHEET_FACES = 64  # of one patch by far, which is drawn whole
FLATNESS = 1e-9  # of the size of a rectangle: no more than rounding in double precision
MARGIN = 1.01  # times what a sonar sees
# Times the distance of the far plane: views that look up or down steeply reach a hundred times as far, and no echo
# comes back from beyond an eighth of it.
FURTHEST = 2.0


class Sheet(NamedTuple):
    """A body that is a rectangle, without holes, about the middle of its box.

    axes : (2, 3) directions of its sides, of unit length, in the body's frame
    half_sides : (2,) half their lengths, metres
    """

    axes: np.ndarray
    half_sides: np.ndarray


def sheet_of(body: Body) -> Sheet | None:
    """Return what is known of a body that is one even rectangle; None for others."""
    faces = np.asarray(body.surface.faces)
    if len(faces) > MAX_SHEET_FACES or body.normals is not None or np.ndim(body.reflectivity):
        return None
    points = np.asarray(body.surface.vertices, np.float64)
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    outline = edges[counts == 1]
    if len(outline) < 4 or counts.max() > 2:
        return None
    along = points[outline[:, 1]] - points[outline[:, 0]]
    lengths = np.linalg.norm(along, axis=1)
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a) / 2
    areas = np.linalg.norm(normals, axis=1)
    if min(lengths.min(), areas.min()) == 0.0:
        return None
    first, normal = along[0] / lengths[0], normals[0] / areas[0]
    axes = np.array([first, np.cross(normal, first)])
    half_sides = np.abs(points @ axes.T).max(axis=0)
    # neither holes, which would lengthen the outline, nor folds, which would add to the area
    is_flat = np.abs(points @ normal).max() <= FLATNESS * half_sides.max()
    is_whole = np.isclose(areas.sum(), 4.0 * half_sides.prod(), rtol=FLATNESS)
    is_whole &= np.isclose(lengths.sum(), 4.0 * half_sides.sum(), rtol=FLATNESS)
    return Sheet(axes, half_sides) if is_flat and is_whole else None


def draw_near(sheet: Sheet, matrix: np.ndarray, reach_m: float, row: np.ndarray) -> None:
    """Have a rectangle drawn no further than `reach_m` along its sides from the foot of the sonar on it.

    matrix : (3, 4) sonar_from_body, about the middle of the rectangle's box
    row : of `place_bodies`; its first 12 floats, the same matrix, are replaced if the rectangle reaches further
    """
    half_sides, scale = sheet.half_sides.tolist(), scale_of(matrix)
    reach_m /= scale  # in the body's frame
    if max(half_sides) <= reach_m:
        return
    turned, moved = matrix[:, :3], matrix[:, 3]
    along = turned @ sheet.axes.T
    middles, scales, is_whole = [], [], True
    for foot, half in zip((-moved @ along / scale**2).tolist(), half_sides, strict=True):
        low, high = max(foot - reach_m, -half), min(foot + reach_m, half)
        if low >= high:
            return
        is_whole &= high - low == 2.0 * half
        middles.append((low + high) / 2.0)
        scales.append((high - low) / (2.0 * half) - 1.0)
    if is_whole:
        return
    placed = row[:12].reshape(3, 4)
    placed[:, :3] = turned + along * scales @ sheet.axes
    placed[:, 3] = moved + along @ middles
