"""Depth images of planes, spheres, boxes and cylinders by ray casting, independent of the package."""

import numpy as np


class Cast:
    """Numbered shapes in the sonar's frame, and depth images of them.

    The ray of pixel (i, j), from the top left, has the direction K⁻¹ (i, j, 1) in camera axes.
    """

    def __init__(self, *shapes):
        self.shapes = shapes

    def images(self, camera):
        """Return range (inf where a ray hits nothing), planar depth, normals (H, W, 3) in camera axes, and body."""
        K, R = np.asarray(camera.intrinsics), np.asarray(camera.rotation)
        j, i = np.mgrid[0 : camera.height, 0 : camera.width]
        rays = np.stack([i, j, np.ones_like(i)], -1) @ np.linalg.inv(K).T
        length = np.linalg.norm(rays, axis=-1)
        d = rays / length[..., None] @ R.T
        range_m, normals, body = np.full(i.shape, np.inf), np.zeros(d.shape), np.zeros(i.shape, np.int64)
        for number, shape in enumerate(self.shapes, 1):
            r, n = shape(d)
            nearer = r < range_m
            range_m[nearer], body[nearer] = r[nearer], number
            normals[nearer] = (np.broadcast_to(n, d.shape) @ R)[nearer]
        return range_m, range_m / length, normals, body


def plane(normal, distance):
    """Return the ray intersection of the plane normal . x = distance."""

    def hit(d):
        with np.errstate(divide="ignore"):
            r = distance / (d @ np.asarray(normal, float))
        return np.where(r > 0, r, np.inf), np.asarray(normal, float)

    return hit


def sphere(centre, radius):
    """Return the ray intersection of a sphere."""

    def hit(d):
        b = d @ np.asarray(centre, float)
        inside = b * b - np.dot(centre, centre) + radius**2
        r = np.where(inside > 0, b - np.sqrt(np.maximum(inside, 0)), np.inf)
        r = np.where(r > 0, r, np.inf)
        return r, np.where(
            np.isfinite(r)[..., None], np.where(np.isfinite(r), r, 0)[..., None] * d - centre, 0
        )

    return hit


def box(low, high):
    """Return the ray intersection of an axis-aligned box between two corners."""
    low, high = np.asarray(low, float), np.asarray(high, float)

    def hit(d):
        with np.errstate(divide="ignore"):
            near, far = np.sort(np.stack([low / d, high / d]), axis=0)
        enter, leave = near.max(-1), far.min(-1)
        r = np.where((enter <= leave) & (enter > 0), enter, np.inf)
        return r, np.eye(3)[near.argmax(-1)]

    return hit


def cylinder(x, y, radius, low, high):
    """Return the ray intersection of an upright cylinder without its ends."""

    def hit(d):
        a = d[..., 0] ** 2 + d[..., 1] ** 2
        b = d[..., 0] * x + d[..., 1] * y
        inside = b * b - a * (x * x + y * y - radius**2)
        r = np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
        z = np.where(np.isfinite(r), r, 0) * d[..., 2]
        r = np.where((r > 0) & (low < z) & (z < high), r, np.inf)
        at = np.where(np.isfinite(r), r, 0)[..., None] * d - [x, y, 0]
        return r, at * [1, 1, 0]

    return hit
