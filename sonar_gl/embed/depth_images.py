"""Checks of the depth images that other programs hand over, and of their normals, bodies and reflectivity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.core.checks import check_kind, is_iterable, is_whole_number, shown
from sonar_gl.core.errors import Error
from sonar_gl.core.warn import warn_caller
from sonar_gl.embed.camera import Camera
from sonar_gl.scene.scene import DEFAULT_REFLECTIVITY
from sonar_gl.sonar.sonar import Sonar

MAX_BODY_ID = 65534
DEPTH_KINDS = "planar", "range"
# Of z-buffers: what most of their pixels hold at least, of what is further off than ten times their near plane. Sonars
# with shorter ranges may have all surfaces within a metre.
FAR_DEPTH, MOST, MANY_M = 0.9, 0.95, 5.0
# Of normals in other axes than those of the camera: planes are taken from pixels this far to each side, so that noise
# of the depths turns them little, and at up to so many rows and columns. Where pixels between leave them by more than
# this slope, there are several surfaces, as where poles stand before a floor.
OTHER_AXES_RAD, PLANE_PIXELS, LEAST_NORMALS, GRID = math.radians(60.0), 4, 100, 100
MAX_BEND = 0.2
NO_NORMALS, NO_BODIES = np.empty((0, 0, 0), np.float32), np.empty((0, 0), np.uint16)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """The checked depth image of one camera."""

    depth: np.ndarray  # (H, W) float32, metres
    normals: np.ndarray  # (H, W, 3) float32, or an empty array
    body_id: np.ndarray  # (H, W) uint16, or an empty array
    reflectivity: np.ndarray  # μ, a scalar or (H, W) float32


def check_images(camera, depth, normals, body_id, reflectivity) -> tuple[list[Camera], list[DepthImage]]:
    """Return the cameras and their checked images; raise Error if one does not fit its camera.

    The arguments are those of `Sensor.ping_from_depth`.
    """
    several = isinstance(camera, (list, tuple))
    cameras = list(camera) if several else [camera]
    if not cameras:
        raise Error("camera must be a Camera or a list of at least one (got an empty list)")
    for one in cameras:
        check_kind("camera", one, Camera, "such as sonar_gl.Camera.of_fov(640, 480, fov_x_rad=1.5)")
    shared = isinstance(reflectivity, dict) or np.ndim(reflectivity) == 0
    per_camera = [
        _one_per_camera("depth", depth, len(cameras), several),
        _one_per_camera("normals", normals, len(cameras), several),
        _one_per_camera("body_id", body_id, len(cameras), several),
        [reflectivity] * len(cameras)
        if shared and not isinstance(reflectivity, (list, tuple))
        else _one_per_camera("reflectivity", reflectivity, len(cameras), several),
    ]
    return cameras, [_check_image(*one) for one in zip(cameras, *per_camera, strict=True)]


def _one_per_camera(name: str, value, n: int, several: bool) -> list:
    if value is None or not several:
        return [value] * n
    if not isinstance(value, (list, tuple)) or len(value) != n:
        got = f"{len(value)} of them" if isinstance(value, (list, tuple)) else type(value).__name__
        cure = "; or give the camera alone, without a list" if n == 1 else ""
        raise Error(f"{name} must be a list of as many images as there are cameras, {n} (got {got}{cure})")
    return list(value)


def _check_image(camera: Camera, depth, normals, body_id, reflectivity) -> DepthImage:
    shape = camera.height, camera.width
    depth = _check_array("depth", depth, shape)
    if not np.issubdtype(depth.dtype, np.floating):
        raise Error(f"depth must be metres in floating point (got {depth.dtype}; divide millimetres by 1000)")
    if depth.dtype == np.float16:
        # the same words for all images: Python shows them once
        warn_caller("depth in float16 is rounded, by up to 4 mm from 8 m on (hand over float32)")
    if normals is not None:
        normals = _check_array("normals", normals, (*shape, 3))
        if not np.issubdtype(normals.dtype, np.floating):
            raise Error(f"normals must be in floating point (got {normals.dtype}; decode colours to -1..1)")
        normals = normals.astype(np.float32, order="C", copy=False)
    if body_id is not None:
        body_id = _check_array("body_id", body_id, shape)
        if not np.issubdtype(body_id.dtype, np.integer):
            raise Error(f"body_id must hold whole numbers (got {body_id.dtype}; make it an integer type)")
        low, high = body_id.min(), body_id.max()
        if low < 0 or high > MAX_BODY_ID:
            raise Error(f"body_id must lie in 0..{MAX_BODY_ID}, 0 where none is known (got {low} to {high})")
        body_id = body_id.astype(np.uint16, order="C", copy=False)
    with np.errstate(over="ignore"):  # an infinite depth is an empty pixel
        depth = depth.astype(np.float32, order="C", copy=False)
    return DepthImage(
        depth,
        NO_NORMALS if normals is None else normals,
        NO_BODIES if body_id is None else body_id,
        _pixel_reflectivity(reflectivity, body_id, depth),
    )


def _check_array(name: str, value, shape) -> np.ndarray:
    """Return an array of numbers of this shape; masked pixels become 0, which means no echo."""
    try:
        out = np.asarray(value.filled(0) if np.ma.isMaskedArray(value) else value)
    except ValueError:  # ragged
        out = np.empty(0)
    if out.dtype.kind not in "fiu":
        raise Error(f"{name} must be an array of numbers (got {type(value).__name__} of {out.dtype})")
    if out.shape != shape:
        raise Error(f"{name} must have the shape of the camera's image, {shape} (got {out.shape})")
    return out


def _pixel_reflectivity(value, body_id, depth: np.ndarray) -> np.ndarray:
    """Return μ as float32, a scalar or one per pixel; it may be NaN where nothing is."""
    if isinstance(value, dict):
        if body_id is None:
            raise Error("reflectivity by numbers of bodies needs body_id (got none)")
        for number in value:
            if not (is_whole_number(number) and 0 <= number <= MAX_BODY_ID):
                raise Error(f"reflectivity must name numbers of bodies, 0..{MAX_BODY_ID} (got {number!r})")
        table = np.full(1 + max([int(body_id.max()), *value]), DEFAULT_REFLECTIVITY, np.float32)
        table[list(value)] = _check_reflectivity([*value.values()])
        return table[body_id]
    if np.ndim(value) == 0:
        return _check_reflectivity(value)
    value = _check_array("reflectivity", value, depth.shape)
    if (unknown := np.isnan(value)).any():
        count = int((unknown & (depth > 0) & (depth < np.inf)).sum())
        if count:
            raise Error(
                f"reflectivity must lie in 0..1 where depth shows a surface (got NaN in {count} of these pixels)"
            )
        value = np.where(unknown, 0, value)
    return _check_reflectivity(value)


def _check_reflectivity(value) -> np.ndarray:
    try:
        out = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        names = [one for one in np.ravel(np.asarray(value, object)).tolist() if isinstance(one, str)]
        cure = f"; sonar_gl.scene.materials.material({names[0]!r}).reflectivity is that of a material"
        got = f"{names[0]!r}{cure}" if names else shown(value)
        raise Error(f"reflectivity must be a number in 0..1 (got {got})") from None
    if not ((out >= 0) & (out <= 1)).all():  # NaN too
        raise Error(
            f"reflectivity must lie in 0..1 (got {out.min():g} to {out.max():g}; divide 8-bit images by 255)"
        )
    return out


def check_body_names(bodies) -> list[str]:
    if not is_iterable(bodies) or isinstance(bodies, str):
        raise Error(f"bodies must be a list of names, that of number 1 first (got {type(bodies).__name__})")
    bodies = list(bodies)
    for name in bodies:
        check_kind("each of bodies", name, str, "give names, that of number 1 first")
    return bodies


def z_buffer_suspicion(images, sonar: Sonar) -> str | None:
    """Return a warning if the depths look like those of a z-buffer, or None.

    A z-buffer lies in 0..1. Where nothing was drawn it is 1, or 0 if it is reversed. Elsewhere it is about 1 − near/Z,
    or near/Z: with a near plane at 0.1 m, more than 0.9 or less than 0.1 for all that is further off than 1 m.
    """
    depth = np.concatenate([image.depth.ravel() for image in images])
    drawn = depth[(depth > 0) & (depth < np.inf)]
    if not len(drawn) or drawn.max() > 1 or depth.min() < 0:
        return None
    # An image full of metres between 0.9 and 1 shows a wall across the view; one of centimetres is what no camera sees.
    is_ordinary = len(drawn) == len(depth) and np.mean(drawn >= FAR_DEPTH) >= MOST
    is_reversed = np.mean(drawn <= 1 - FAR_DEPTH) >= MOST
    if depth.max() == 1 or (sonar.range_max_m >= MANY_M and (is_ordinary or is_reversed)):
        return "depth lies in 0..1, as a z-buffer does (embed.metres_ahead makes metres of that)"
    return None


def normals_suspicion(cameras, images, planar: bool) -> str | None:
    """Return a warning if half of the normals are far off the surfaces that the depths show, or None."""
    pairs = zip(cameras, images, strict=True)
    cosines = [_cosines(camera, image, planar) for camera, image in pairs if image.normals.size]
    cosines = np.concatenate(cosines) if cosines else np.empty(0)
    if len(cosines) < LEAST_NORMALS or np.median(cosines) > math.cos(OTHER_AXES_RAD):
        return None
    return (
        "normals do not fit the depths: half of them are more than 60° off the surfaces that the depths show (give "
        "them in the camera's optical axes, x right, y down, z ahead, of textures in the view's axes)"
    )


def _cosines(camera: Camera, image: DepthImage, planar: bool) -> np.ndarray:
    """Return |cos| of the angles between normals and the planes of depths, of a grid of pixels where both are known."""
    k, K = PLANE_PIXELS, camera.intrinsics
    rows, columns = (np.arange(k, n - k, 1 + n // GRID) for n in (camera.height, camera.width))
    j, i = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
    K_inverse = np.linalg.inv(K)

    def rays(j, i):
        return np.stack([i, j, np.ones(len(i))], axis=-1) @ K_inverse.T

    def inverse(j, i):
        depth = image.depth[j, i].astype(np.float64)
        return np.where(depth > 0, 1.0 if planar else np.linalg.norm(rays(j, i), axis=-1), np.nan) / depth

    def slope_and_bend(row, column):
        """Return the change of 1/Z per pixel, and how far pixels between both sides leave it."""
        steps = -k, -(k // 2), 0, k // 2, k
        along = np.stack([inverse(j + row * step, i + column * step) for step in steps])
        slope = (along[-1] - along[0]) / (2 * k)
        line = (along[-1] + along[0]) / 2 + slope * np.array(steps)[:, None]
        return slope, np.abs(along - line).max(axis=0)

    with np.errstate(all="ignore"):
        # 1/Z of the plane p . x = 1 is p . K^-1 (i, j, 1)
        (across, bend_across), (down, bend_down) = slope_and_bend(0, 1), slope_and_bend(1, 0)
        x, y = K[:2, :2].T @ np.stack([across, down])
        u, v, _ = rays(j, i).T
        planes = np.stack([x, y, inverse(j, i) - x * u - y * v], axis=-1)
        normals, sizes = image.normals[j, i].astype(np.float64), np.linalg.norm(planes, axis=-1)
        is_one = np.maximum(K[0, 0] * bend_across, K[1, 1] * bend_down) <= MAX_BEND * k * sizes
        cosines = np.abs((planes * normals).sum(axis=-1)) / (sizes * np.linalg.norm(normals, axis=-1))
    return cosines[is_one & np.isfinite(cosines)]


def is_planar(holds: str) -> bool:
    """Return whether images hold depth along the camera's axis; otherwise they hold range along each ray."""
    if not isinstance(holds, str) or holds not in DEPTH_KINDS:
        raise Error(
            f"holds must be 'planar', metres along the camera's axis, or 'range', metres along each pixel's "
            f"ray (got {holds!r}; embed.metres_ahead undoes z-buffers)"
        )
    return holds == "planar"
