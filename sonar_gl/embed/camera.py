"""Pinhole cameras at the sonar's position; other programs render their depth images."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.checks import check_kind, frozen_array, is_number, is_whole_number
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import check_pose
from sonar_gl.sonar.fan import azimuths_of_cones
from sonar_gl.sonar.sonar import Sonar

# Camera axes are those of OpenCV and of ROS's optical frames: x right, y down, z ahead. For an upright camera that
# looks along the boresight they are -y (starboard), -z and x of the sonar.
SONAR_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
OPTICAL_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])  # OpenGL camera axes: x right, y up, z back
MAX_COVERING_FOV_RAD = math.radians(90.0)  # wider images waste pixels on their edges
MARGIN_PIXELS = 2  # around the fan: a plane without normals is estimated from neighbouring pixels
MAX_PIXELS = 16384  # per side; no driver renders larger images


def _check_pixels(name: str, value) -> int:
    """Return a number of pixels, 1 or more."""
    if not is_whole_number(value) or value < 1:
        raise Error(f"{name} of a camera must be a whole number of pixels, 1 or more (got {value!r})")
    return int(value)


def _check_fov(name: str, value) -> float:
    """Return a field of view, radians between 0 and π."""
    if not is_number(value) or not 0 < value < math.pi:
        raise Error(f"{name} must be radians between 0 and π (got {value!r})")
    return float(value)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera at the sonar's position, which gives the direction of each pixel of a depth image.

    Camera axes are optical: x right, y down, z ahead. Pixel (0, 0) is the top left one, and whole coordinates are
    centres of pixels, as in OpenCV and in ROS's camera_info.

    Parameters
    ----------
    width, height : W, H, pixels
    intrinsics : (3, 3) K; a point x y z in camera axes projects to the pixel K [x/z, y/z, 1]. K may shear the
        image, but not mirror it
    rotation : (3, 3) sonar_from_camera; None for an upright camera that looks ahead. The sonar's axes are those of its
        housing, whose head may be tilted: `covering` includes the tilt

    Raises
    ------
    Error
        if the intrinsics are not those of a pinhole camera, or `rotation` is not a rotation matrix.
    """

    width: int
    height: int
    intrinsics: np.ndarray
    rotation: np.ndarray | None = None

    def __post_init__(self):
        for name in ("width", "height"):
            object.__setattr__(self, name, _check_pixels(name, getattr(self, name)))
        K = frozen_array(self.intrinsics, np.float64, (3, 3), "intrinsics of a camera")
        if not np.array_equal(K[2], [0, 0, 1]):
            raise Error(f"intrinsics of a camera must have the last row 0 0 1 (got {K[2].tolist()})")
        if min(K[0, 0], K[1, 1], np.linalg.det(K)) <= 0:
            raise Error(
                f"intrinsics of a camera must have fx and fy above 0, in pixels (got {K[0, 0]:g} and "
                f"{K[1, 1]:g}; rows of the image count downwards)"
            )
        R = SONAR_FROM_OPTICAL if self.rotation is None else self.rotation
        R = frozen_array(R, np.float64, (3, 3), "rotation of a camera")
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-5 or np.linalg.det(R) < 0:
            raise Error("rotation of a camera must be sonar_from_camera (got a matrix that is no rotation)")
        object.__setattr__(self, "intrinsics", K)
        object.__setattr__(self, "rotation", R)

    @classmethod
    def of_fov(
        cls,
        width: int,
        height: int,
        fov_x_rad: float | None = None,
        fov_y_rad: float | None = None,
        rotation: ArrayLike | None = None,
    ) -> Camera:
        """Return a camera of this field of view, from edge to edge; with one angle None pixels are square.

        >>> Camera.of_fov(640, 480, fov_x_rad=math.pi / 2).intrinsics[0].tolist()
        [320.00000000000006, 0.0, 319.5]
        """
        width, height = _check_pixels("width", width), _check_pixels("height", height)
        if fov_x_rad is None and fov_y_rad is None:
            raise Error("a camera must be given its field of view, fov_x_rad, fov_y_rad or both")
        fx = None if fov_x_rad is None else width / 2 / math.tan(_check_fov("fov_x_rad", fov_x_rad) / 2)
        fy = None if fov_y_rad is None else height / 2 / math.tan(_check_fov("fov_y_rad", fov_y_rad) / 2)
        K = [[fx or fy, 0, (width - 1) / 2], [0, fy or fx, (height - 1) / 2], [0, 0, 1]]
        return cls(width, height, K, rotation)

    @classmethod
    def of_projection(
        cls, matrix: ArrayLike, width: int, height: int, rotation: ArrayLike | None = None
    ) -> Camera:
        """Return the camera of an OpenGL projection; the first row of the image is the top one.

        Parameters
        ----------
        matrix : (4, 4) clip_from_camera, a perspective, symmetric or off-centre; its depth mapping is ignored

        Raises
        ------
        Error
            if the matrix is not a perspective projection.
        """
        P = check_projection(matrix)
        if min(P[0, 0], P[1, 1]) <= 0:
            raise Error(
                "projection must have x to the right and y up, [0, 0] and [1, 1] above 0 "
                f"(got {P[0, 0]:g} and {P[1, 1]:g}; give it without the flip, and turn the image's rows round)"
            )
        width, height = _check_pixels("width", width), _check_pixels("height", height)
        K = np.linalg.inv(_ndc_from_pixels(width, height)) @ P[[0, 1, 3], :3] @ OPTICAL_FROM_OPENGL
        K[2] = 0, 0, 1
        return cls(width, height, K, rotation)

    @classmethod
    def covering(
        cls, sonar: Sonar, acoustics: Acoustics | None = None, pixel_deg: float = 0.1
    ) -> list[Camera]:
        """Return cameras, from starboard to port, whose images together cover the fan of the sonar.

        The fan reaches as far aside as the outermost beams receive, and up and down as the main lobe in elevation does.

        Parameters
        ----------
        acoustics : sets how far beam patterns reach beyond the fan; None is `Acoustics.physical()`
        pixel_deg : width of a pixel in the middle of an image; smaller pixels give a smaller error

        Raises
        ------
        Error
            if an image would have more than 16384 columns or rows.
        """
        check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()")
        if not (is_number(pixel_deg) and 0 < pixel_deg <= 10):
            raise Error(f"pixel_deg must be degrees above 0 and no more than 10 (got {pixel_deg!r})")
        pixel = math.radians(pixel_deg)
        acoustics = acoustics if acoustics is not None else Acoustics.physical()
        reach, aperture_deg = (
            acoustics.receive_support_rad(sonar),
            acoustics.true_range_sonar(sonar).elevation_fov_deg,
        )
        start, stop = sonar.azimuth_rad[0] - reach, sonar.azimuth_rad[-1] + reach
        if stop - start > 2 * math.pi:
            start, stop = -math.pi, math.pi
        if acoustics.has_cones(sonar):
            start, stop = azimuths_of_cones(start, stop, math.radians(aperture_deg) / 2)
        n = math.ceil((stop - start) / MAX_COVERING_FOV_RAD - 1e-9)
        half = (stop - start) / n / 2
        across, up = math.tan(half), math.tan(math.radians(aperture_deg) / 2) / math.cos(half)
        width, height = (2 * (math.ceil(extent / pixel) + MARGIN_PIXELS) for extent in (across, up))
        if max(width, height) > MAX_PIXELS:
            raise Error(
                f"cameras that cover this sonar must have at most {MAX_PIXELS} pixels a side (got {width} by "
                f"{height}; give a larger pixel_deg)"
            )
        K = [[1 / pixel, 0, (width - 1) / 2], [0, 1 / pixel, (height - 1) / 2], [0, 0, 1]]
        out = []
        for azimuth in start + half * (2 * np.arange(n) + 1):
            c, s = math.cos(azimuth), math.sin(azimuth)
            turn = sonar.sonar_from_head[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            out.append(cls(width, height, K, turn @ SONAR_FROM_OPTICAL))
        return out

    def seen_from_head(self, sonar: Sonar) -> Camera:
        """Return the camera with its rotation in the axes of the sonar's head in place of the housing's."""
        return replace(self, rotation=sonar.sonar_from_head[:3, :3].T @ self.rotation)

    @property
    def pixel_from_sonar(self) -> np.ndarray:
        """(3, 3) matrix from the sonar's frame to homogeneous pixels; the third number is the distance ahead."""
        return self.intrinsics @ self.rotation.T

    def sees(self, directions: ArrayLike) -> np.ndarray:
        """Return whether directions, (..., 3) in the sonar's frame, lie in the image: (...) bool."""
        i, j, ahead = np.moveaxis(np.asarray(directions) @ self.pixel_from_sonar.T, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            i, j = i / ahead + 0.5, j / ahead + 0.5
        return (ahead > 0) & (i >= 0) & (i <= self.width) & (j >= 0) & (j <= self.height)

    def pixel_rad(self) -> tuple[float, float]:
        """Return the width in azimuth and the height in elevation of the image's middle pixel, radians."""
        A = self.pixel_from_sonar
        d = np.linalg.solve(A, [(self.width - 1) / 2, (self.height - 1) / 2, 1.0])
        d /= np.linalg.norm(d)
        level = math.hypot(d[0], d[1]) or 1e-9
        steps = np.array([[-d[1], d[0], 0], [-d[0] * d[2] / level, -d[1] * d[2] / level, level]])
        moved, at = steps @ A.T, A @ d
        across, up = np.linalg.norm(moved[:, :2] - moved[:, 2:] * at[:2] / at[2], axis=1) / at[2]
        return 1 / max(across, 1e-9), 1 / max(up, 1e-9)

    def projection(
        self, near_m: float, far_m: float, reversed: bool = False, zero_to_one: bool = False
    ) -> np.ndarray:
        """Return the (4, 4) OpenGL clip_from_camera with which a program renders the image.

        Parameters
        ----------
        near_m, far_m : distances of the near and the far plane, metres; the latter may be infinite
        reversed : depth falls from the near plane to the far one, as hosts draw it that clear it to 0 and keep what is
            greater
        zero_to_one : depth lies in 0..1, for glClipControl's GL_ZERO_TO_ONE, and not in -1..1
        """
        if not (is_number(near_m) and is_number(far_m) and 0 < near_m < far_m):
            raise Error(f"near_m must be metres above 0, and far_m above that (got {near_m!r} and {far_m!r})")
        clip = np.zeros((4, 4))
        clip[[0, 1, 3], :3] = (
            _ndc_from_pixels(self.width, self.height) @ self.intrinsics @ OPTICAL_FROM_OPENGL
        )
        near, far = (0.0 if zero_to_one else -1.0), 1.0  # depths of the planes
        if reversed:
            near, far = far, near
        if far_m == math.inf:
            clip[2, 2:] = -far, (near - far) * near_m
        else:
            clip[2, 2:] = np.array([far * far_m - near * near_m, (far - near) * far_m * near_m]) / (
                near_m - far_m
            )
        return clip

    def pose_gl(self, world_from_sonar: ArrayLike) -> np.ndarray:
        """Return (4, 4) world_from_camera in OpenGL's axes (x right, y up, z back), as pyrender expects it."""
        out = check_pose(world_from_sonar).copy()
        out[:3, :3] = out[:3, :3] @ self.rotation @ OPTICAL_FROM_OPENGL
        return out

    def sonar_pose(self, world_from_camera: ArrayLike) -> np.ndarray:
        """Return (4, 4) world_from_sonar for a camera pose in OpenGL's axes: the inverse of `pose_gl`."""
        out = check_pose(world_from_camera, "world_from_camera").copy()
        out[:3, :3] = out[:3, :3] @ (self.rotation @ OPTICAL_FROM_OPENGL).T
        return out


def check_projection(matrix) -> np.ndarray:
    """Return an OpenGL perspective, (4, 4) float64; raise an `Error` for any other matrix."""
    P = frozen_array(matrix, np.float64, (4, 4), "projection")
    if np.abs(P[3] - [0, 0, -1, 0]).max() > 1e-6 or P[0, 3] or P[1, 3]:
        raise Error(
            "projection must be an OpenGL perspective, whose last row is 0 0 -1 0 "
            f"(got {P[3].tolist()}; an orthographic one, or a transposed matrix, has another)"
        )
    return P


def _ndc_from_pixels(width: int, height: int) -> np.ndarray:
    """Return the (3, 3) matrix from pixels to OpenGL's normalized device coordinates, -1..1, y up."""
    return np.array([[2 / width, 0, 1 / width - 1], [0, -2 / height, 1 - 1 / height], [0, 0, 1.0]])


def covered_fraction(sonar: Sonar, cameras, are_cones: bool = False) -> float:
    """Return the fraction of the fan's solid angle that at least one of the cameras sees, in the head's axes.

    are_cones : whether beams are cones, which lie further aside than the azimuths at which they are shown
    """
    low, high = sonar.fan_edges_rad
    azimuth = low + (high - low) * (np.arange(512) + 0.5) / 512
    sine = math.sin(math.radians(sonar.elevation_fov_deg) / 2) * ((np.arange(128) + 0.5) / 64 - 1)[:, None]
    level = np.sqrt(1 - sine * sine)
    up = np.broadcast_to(sine, (128, 512))
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=-1)
    if are_cones:
        beside = np.broadcast_to(np.sin(azimuth), (128, 512))
        ahead = np.sqrt(np.maximum(1 - beside**2 - up**2, 0))
        directions = np.stack([ahead, beside, up], axis=-1)[ahead > 0]
    return float(np.any([camera.sees(directions) for camera in cameras], axis=0).mean())
