"""Depth images to samples: the plane that each pixel sees, and for each ray of a sector that of its pixel.

With Z how far ahead of the camera a surface lies, 1/Z is linear on the image where the surface is plane. A
pixel (i, j) so holds 1/Z and its steps to the next pixel across and down. By H = K camera_from_sector a ray
d = (1, -u, v) meets the pixel H d / (H d)_z, and 1/x on it is (H d)_z / Z; both are exact for planes.
"""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.camera import Camera
from sonar_gl.compiled import compiled
from sonar_gl.lattice import Sector
from sonar_gl.pair import Pair

# Centre differences err least on curved surfaces: they are taken unless they fit so many times worse than
# those of one side, which end at an edge.
WORSE = 4.0
NOISE = 1e-6  # of 1/Z: fits as good as that are alike
# Where 1/Z fits no neighbour to this part of itself, the surface is no wider than the pixel, and is taken to
# face the camera.
ALONE = 0.1
EDGE_ON = 1e-6  # of a normal: nearer to that its plane is not told, and hardly echoes
HAIR = 1e-6  # of a pixel: cameras side by side meet without a gap
UNSEEN = -1.0  # 1/x of a ray that no camera has looked at; 0 of one that met nothing


@compiled
def _invert(start, stop, depth, K_inverse, planar, inverse):
    """1/Z of each pixel of some rows, 0 where there is none."""
    for j in range(start, stop):
        for i in range(depth.shape[1]):
            x = K_inverse[0, 0] * i + K_inverse[0, 1] * j + K_inverse[0, 2]
            y = K_inverse[1, 0] * i + K_inverse[1, 1] * j + K_inverse[1, 2]
            d = np.float64(depth[j, i])
            q = (1.0 if planar else math.sqrt(x * x + y * y + 1.0)) / d
            inverse[j, i] = q if d > 0.0 and q < 1e30 else 0.0  # NaN and infinity, too


@compiled
def _step(q, before, two_before, after, two_after):
    """The step of 1/Z to the next pixel, of five in a row; 0 are those that there are not."""
    back, ahead = q - before, after - q
    fit_back, fit_ahead, fit = q, q, q
    if before > 0.0:
        fit_back = min(abs(back), abs(back - (before - two_before)) if two_before > 0.0 else q)
    if after > 0.0:
        fit_ahead = min(abs(ahead), abs((two_after - after) - ahead) if two_after > 0.0 else q)
    if before > 0.0 and after > 0.0:
        fit = abs(ahead - back)
    best = min(fit_back, fit_ahead)
    if fit <= max(WORSE * best, NOISE * q) and fit < ALONE * q:
        return (back + ahead) / 2
    if best >= ALONE * q:
        return 0.0
    # where the last pixels bend, this one does: limbs of round things are steeper than the step to them
    if fit_back <= fit_ahead:
        bend = back - (before - two_before) if two_before > 0.0 else 0.0
        return back + bend / 2 if abs(bend) == fit_back else back
    bend = (two_after - after) - ahead if two_after > 0.0 else 0.0
    return ahead - bend / 2 if abs(bend) == fit_ahead else ahead


@compiled
def _find_planes(start, stop, inverse, normals, K, K_inverse, planes):
    """Fill some rows of (H, W, 4): 1/Z, its steps across and down, cosine of incidence times slant range.

    normals : (H, W, 3), camera axes, or of no size
    """
    n_rows, n_columns = inverse.shape
    for j in range(start, stop):
        for i in range(n_columns):
            q = np.float64(inverse[j, i])
            planes[j, i, 0] = q
            if q <= 0.0:
                planes[j, i, 1] = planes[j, i, 2] = planes[j, i, 3] = 0.0
                continue
            x = K_inverse[0, 0] * i + K_inverse[0, 1] * j + K_inverse[0, 2]
            y = K_inverse[1, 0] * i + K_inverse[1, 1] * j + K_inverse[1, 2]
            nx = ny = nz = length = 0.0
            if normals.shape[0] > 0:
                nx, ny, nz = normals[j, i, 0], normals[j, i, 1], normals[j, i, 2]
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if 0.0 < length < 1e30:  # not NaN either
                towards = nx * x + ny * y + nz
                echo = abs(towards) / (q * length)
                # the plane's 1/Z is q n . (x, y, 1) / towards
                tilt = q / math.copysign(max(abs(towards), EDGE_ON * length), towards)
                across = tilt * (nx * K_inverse[0, 0] + ny * K_inverse[1, 0])
                down = tilt * (nx * K_inverse[0, 1] + ny * K_inverse[1, 1])
            else:
                left = inverse[j, i - 1] if i > 0 else 0.0
                lefter = inverse[j, i - 2] if i > 1 else 0.0
                right = inverse[j, i + 1] if i + 1 < n_columns else 0.0
                righter = inverse[j, i + 2] if i + 2 < n_columns else 0.0
                across = _step(q, left, lefter, right, righter)
                above = inverse[j - 1, i] if j > 0 else 0.0
                higher = inverse[j - 2, i] if j > 1 else 0.0
                below = inverse[j + 1, i] if j + 1 < n_rows else 0.0
                lower = inverse[j + 2, i] if j + 2 < n_rows else 0.0
                down = _step(q, above, higher, below, lower)
                # the plane p . x = 1 lies 1/|p| away, which is the cosine times the slant range
                px, py = K[0, 0] * across + K[1, 0] * down, K[0, 1] * across + K[1, 1] * down
                pz = q - px * x - py * y
                echo = 1.0 / math.sqrt(px * px + py * py + pz * pz)
            planes[j, i, 1], planes[j, i, 2], planes[j, i, 3] = across, down, echo


@compiled
def _lay(start, stop, planes, bodies, H, u, v, fresh, beyond, plane_echo, body_id):
    """What the rays of some rows see of this image; unless they are fresh, those that saw none before. How
    many look at it."""
    n_rows, n_columns, n_rays = planes.shape[0], planes.shape[1], 0
    labels, reach = bodies.shape[0] > 0, HAIR
    du, dv = abs(u[1]) / 2, abs(v[2]) / 2
    for j in range(start, stop):
        for i in range(plane_echo.shape[1]):
            if fresh:
                plane_echo[j, i, 0], plane_echo[j, i, 3], body_id[j, i] = UNSEEN, 0.0, 0
            elif plane_echo[j, i, 0] != UNSEEN:
                continue
            u_ray, v_ray = u[0] + u[1] * i + u[2] * j, v[0] + v[1] * i + v[2] * j
            ahead = H[2, 0] - H[2, 1] * u_ray + H[2, 2] * v_ray
            if ahead <= 0.0:
                continue
            column = (H[0, 0] - H[0, 1] * u_ray + H[0, 2] * v_ray) / ahead
            row = (H[1, 0] - H[1, 1] * u_ray + H[1, 2] * v_ray) / ahead
            over = abs(column - (n_columns - 1) / 2) - n_columns / 2
            if beyond:
                reach = (
                    HAIR
                    + (abs(H[0, 1] - column * H[2, 1]) * du + abs(H[0, 2] - column * H[2, 2]) * dv) / ahead
                )
            if not over <= reach:
                continue
            over = abs(row - (n_rows - 1) / 2) - n_rows / 2
            if beyond:
                reach = HAIR + (abs(H[1, 1] - row * H[2, 1]) * du + abs(H[1, 2] - row * H[2, 2]) * dv) / ahead
            if not over <= reach:
                continue
            m = min(max(int(row + 0.5), 0), n_rows - 1)
            n = min(max(int(column + 0.5), 0), n_columns - 1)
            across, down = np.float64(planes[m, n, 1]), np.float64(planes[m, n, 2])
            q = planes[m, n, 0] + across * (column - n) + down * (row - m)
            met = planes[m, n, 0] > 0.0 and q > 0.0
            rest = q - across * column - down * row
            plane_echo[j, i, 0] = q * ahead if met else 0.0
            plane_echo[j, i, 1] = -(H[0, 1] * across + H[1, 1] * down + H[2, 1] * rest) if met else 0.0
            plane_echo[j, i, 2] = H[0, 2] * across + H[1, 2] * down + H[2, 2] * rest if met else 0.0
            plane_echo[j, i, 3] = planes[m, n, 3] if met else 0.0
            if labels:
                body_id[j, i] = bodies[m, n] if met else 0
            n_rays += 1
    return n_rays


class Planes:
    """The planes that a camera's pixels see, and the arrays to find them in again.

    Attributes
    ----------
    planes : (H, W, 4) float32, of `_find_planes`; the last times reflectivity
    """

    def __init__(self, camera: Camera, pair: Pair):
        self.camera, self.pair = camera, pair
        self.inverse = np.zeros((camera.height, camera.width), np.float32)
        self.planes = np.zeros((camera.height, camera.width, 4), np.float32)

    def find(self, depth, planar: bool, normals, reflectivity) -> None:
        """Of one image.

        Parameters
        ----------
        depth : (H, W) float32, metres; what is no number above 0 is nothing
        planar : it is that along the camera's axis, or else along the pixel's ray
        normals : (H, W, 3) float32 of the faces, either side, camera axes, or of no size: then, and where
            they are 0 or NaN, planes are told by what neighbours see
        reflectivity : μ, one or (H, W)
        """
        K = self.camera.intrinsics
        K_inverse = np.linalg.inv(K)
        self._by_rows(_invert, len(depth), depth, K_inverse, planar, self.inverse)
        self._by_rows(_find_planes, len(depth), self.inverse, normals, K, K_inverse, self.planes)
        self.planes[..., 3] *= reflectivity

    def lay(self, sector: Sector, bodies, fresh: bool, beyond: bool, plane_echo, body_id) -> int:
        """Give rays of a sector what they see; how many look at this image.

        Parameters
        ----------
        bodies : (H, W) uint16, or of no size
        fresh : nothing was laid before; else those rays alone that are `UNSEEN`
        beyond : rays half a sample beside the image take its border: what they stand for begins there
        plane_echo, body_id : (R, C, 4) float32 and (R, C) uint16, written to
        """
        H = np.ascontiguousarray(self.camera.pixel_from_sonar @ sector.rotation().T)
        rays = H, sector.u, sector.v
        return sum(
            self._by_rows(_lay, sector.rows, self.planes, bodies, *rays, fresh, beyond, plane_echo, body_id)
        )

    def _by_rows(self, work, n: int, *arguments):
        """Have half of the rows done in the other thread."""
        bounds = (0, n // 2, n)
        return self.pair.run(lambda half: work(bounds[half], bounds[half + 1], *arguments))
