"""Resample depth images: fit a plane to each pixel, then intersect each ray of a sector with its pixel's plane.

Let Z be the distance of a surface along the camera's axis. Where the surface is plane, 1/Z is linear on the image, so
a pixel (i, j) holds 1/Z and its steps to the next pixel across and down. With H = K camera_from_sector, a ray
d = (1, -u, v) meets the pixel H d / (H d)_z, and 1/x on it is (H d)_z / Z; both are exact for planes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.core.compiled import compiled
from sonar_gl.core.worker import SecondThread
from sonar_gl.embed.camera import Camera
from sonar_gl.sonar.samples import SectorSamples

# Central differences have the smallest error on curved surfaces. One-sided ones, which do not cross an edge, replace
# them where they fit this many times better.
EDGE_RATIO = 4.0
FIT_NOISE = 1e-6  # of 1/Z: fits with smaller residuals are equally good
# Where the steps of 1/Z to all neighbours exceed this fraction of it, the surface is no wider than the pixel, and is
# assumed to face the camera.
MAX_RELATIVE_STEP = 0.1
MIN_COSINE = 1e-6  # of incidence: below it the plane is undefined, and its echo is negligible
OVERLAP = 1e-6  # of a pixel, so that cameras side by side leave no gap
UNSEEN = -1.0  # 1/x of a ray that no camera sees; a ray that meets nothing has 0


@compiled
def _invert(start, stop, depth, K_inverse, planar, inverse):
    """Fill 1/Z for the pixels of some rows; 0 where a pixel is empty."""
    for j in range(start, stop):
        for i in range(depth.shape[1]):
            x = K_inverse[0, 0] * i + K_inverse[0, 1] * j + K_inverse[0, 2]
            y = K_inverse[1, 0] * i + K_inverse[1, 1] * j + K_inverse[1, 2]
            d = np.float64(depth[j, i])
            q = (1.0 if planar else math.sqrt(x * x + y * y + 1.0)) / d
            inverse[j, i] = q if d > 0.0 and q < 1e30 else 0.0  # NaN and infinity, too


@compiled
def _step(q, before, two_before, after, two_after):
    """Estimate the step of 1/Z to the next pixel from five pixels in a row; a missing pixel is 0."""
    back, ahead = q - before, after - q
    fit_back, fit_ahead, fit = q, q, q
    if before > 0.0:
        fit_back = min(abs(back), abs(back - (before - two_before)) if two_before > 0.0 else q)
    if after > 0.0:
        fit_ahead = min(abs(ahead), abs((two_after - after) - ahead) if two_after > 0.0 else q)
    if before > 0.0 and after > 0.0:
        fit = abs(ahead - back)
    best = min(fit_back, fit_ahead)
    if fit <= max(EDGE_RATIO * best, FIT_NOISE * q) and fit < MAX_RELATIVE_STEP * q:
        return (back + ahead) / 2
    if best >= MAX_RELATIVE_STEP * q:
        return 0.0
    # A one-sided step is extrapolated by its curvature: the limb of a round body is steeper than the step to it.
    if fit_back <= fit_ahead:
        bend = back - (before - two_before) if two_before > 0.0 else 0.0
        return back + bend / 2 if abs(bend) == fit_back else back
    bend = (two_after - after) - ahead if two_after > 0.0 else 0.0
    return ahead - bend / 2 if abs(bend) == fit_ahead else ahead


@compiled
def _find_planes(start, stop, inverse, normals, K, K_inverse, planes):
    """Fill some rows of planes, (H, W, 4): 1/Z, its steps across and down, cosine of incidence times slant range.

    normals : (H, W, 3), camera axes, or an empty array
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
                nx, ny = np.float64(normals[j, i, 0]), np.float64(normals[j, i, 1])
                nz = np.float64(normals[j, i, 2])
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if 0.0 < length < math.inf:  # not NaN either
                towards = nx * x + ny * y + nz
                echo = abs(towards) / (q * length)
                # the plane's 1/Z is q n . (x, y, 1) / towards
                tilt = q / math.copysign(max(abs(towards), MIN_COSINE * length), towards)
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


class PixelImage(NamedTuple):
    """What each pixel of a camera shows."""

    planes: np.ndarray  # (H, W, 4) float32, filled by `_find_planes`
    body_id: np.ndarray  # (H, W) uint16, or an empty array


class Rays(NamedTuple):
    """The rays of a sector, and how they project onto an image."""

    homography: np.ndarray  # (3, 3) K camera_from_sector
    # u, v: (3,) lattice of the sector
    u: np.ndarray
    v: np.ndarray


@compiled
def _sample(start, stop, image, rays, overwrite, include_border, plane_echo, body_id):
    """Fill the samples of some rows from one image; without `overwrite` only the samples that are `UNSEEN`.

    Returns the number of rays that hit the image.
    """
    planes, pixel_body, H, u, v = image.planes, image.body_id, rays.homography, rays.u, rays.v
    n_rows, n_columns, n_rays = planes.shape[0], planes.shape[1], 0
    labels, reach = pixel_body.shape[0] > 0, OVERLAP
    du, dv = abs(u[1]) / 2, abs(v[2]) / 2
    for j in range(start, stop):
        for i in range(plane_echo.shape[1]):
            if overwrite:
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
            if include_border:
                reach = (
                    OVERLAP
                    + (abs(H[0, 1] - column * H[2, 1]) * du + abs(H[0, 2] - column * H[2, 2]) * dv) / ahead
                )
            if not over <= reach:
                continue
            over = abs(row - (n_rows - 1) / 2) - n_rows / 2
            if include_border:
                reach = (
                    OVERLAP + (abs(H[1, 1] - row * H[2, 1]) * du + abs(H[1, 2] - row * H[2, 2]) * dv) / ahead
                )
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
                body_id[j, i] = pixel_body[m, n] if met else 0
            n_rays += 1
    return n_rays


class PixelPlanes:
    """The planes seen by a camera's pixels, in arrays that the next image reuses."""

    def __init__(self, camera: Camera, thread: SecondThread):
        self._camera, self._thread = camera, thread
        self._inverse = np.zeros((camera.height, camera.width), np.float32)
        # filled by `_find_planes`, the last component times reflectivity
        self.planes = np.zeros((camera.height, camera.width, 4), np.float32)

    def find(self, depth, planar: bool, normals, reflectivity) -> None:
        """Fill `planes` from one image.

        depth : (H, W) float32, metres; a pixel is empty where it is not a number above 0
        planar : whether depth is measured along the camera's axis; otherwise along the pixel's ray
        normals : (H, W, 3) float32, normals of the faces, on either side, camera axes, or an empty array. Without
            normals, and where they are 0 or NaN, planes are estimated from neighbouring pixels
        reflectivity : μ, a scalar or (H, W)
        """
        K = self._camera.intrinsics
        K_inverse = np.linalg.inv(K)
        self._by_rows(_invert, len(depth), depth, K_inverse, planar, self._inverse)
        self._by_rows(_find_planes, len(depth), self._inverse, normals, K, K_inverse, self.planes)
        self.planes[..., 3] *= reflectivity

    def sample(self, samples: SectorSamples, pixel_body, overwrite: bool, include_border: bool) -> int:
        """Fill the samples of a sector from this image; return how many of its rays hit the image.

        samples : SectorSamples, whose arrays are written to
        pixel_body : (H, W) uint16, the body of each pixel, or an empty array
        overwrite : fill all samples; otherwise only those that are `UNSEEN`
        include_border : rays up to half a sample outside of the image take the plane of its border
        """
        sector = samples.sector
        homography = np.ascontiguousarray(self._camera.pixel_from_sonar @ sector.rotation().T)
        image, rays = PixelImage(self.planes, pixel_body), Rays(homography, sector.u, sector.v)
        arguments = image, rays, overwrite, include_border, samples.plane_echo, samples.body_id
        return sum(self._by_rows(_sample, sector.rows, *arguments))

    def _by_rows(self, work, n: int, *arguments):
        """Call `work` for both halves of the rows, one of them in the second thread."""
        bounds = (0, n // 2, n)
        return self._thread.run_halves(lambda half: work(bounds[half], bounds[half + 1], *arguments))
