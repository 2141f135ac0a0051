"""Pinhole cameras at the sonar's place, whose depth images other programs draw."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.rigid import check_pose
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, check_kind, frozen_array

# Camera axes are those of OpenCV and of ROS's optical frames. Upright along the boresight, x to the right is
# starboard (−y of the sonar), y down is −z, z ahead is x.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
OPENGL = np.diag([1.0, -1.0, -1.0])  # of the same camera, x right, y up, z back
WIDEST_RAD = math.radians(90.0)  # of those that cover a fan: wider ones waste pixels on their edges
MARGIN = 2  # pixels about what is needed, so that a plane can be told there without normals
MAX_PIXELS = 16384  # of a side: more no driver draws


def _count(name: str, value) -> int:
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < 1:
        raise Error(f"{name} of a camera must be a whole number of pixels, 1 or more (got {value!r})")
    return int(value)


def _angle(name: str, value) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not 0 < value < math.pi:
        raise Error(f"{name} must be radians between 0 and π (got {value!r})")
    return float(value)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera at the sonar's place: what each pixel of a depth image looks at.

    Camera axes are optical, x right, y down, z ahead. Pixels count from (0, 0), the middle of the image's
    first one, top left, as in OpenCV and in ROS's camera_info.

    Parameters
    ----------
    width, height : W, H, pixels
    intrinsics : (3, 3) K; a point x y z, camera axes, lies at the pixel K [x/z, y/z, 1]. The image may be
        sheared, not mirrored
    rotation : (3, 3) sonar_from_camera; None looks along the boresight, upright

    Raises
    ------
    Error
        if the intrinsics are no pinhole camera's, or the rotation is none.
    """

    width: int
    height: int
    intrinsics: np.ndarray
    rotation: np.ndarray | None = None

    def __post_init__(self):
        for name in ("width", "height"):
            object.__setattr__(self, name, _count(name, getattr(self, name)))
        K = frozen_array(self.intrinsics, np.float64, (3, 3), "intrinsics of a camera")
        if not np.array_equal(K[2], [0, 0, 1]):
            raise Error(f"intrinsics of a camera must have the last row 0 0 1 (got {K[2].tolist()})")
        if min(K[0, 0], K[1, 1], np.linalg.det(K)) <= 0:
            raise Error(
                f"intrinsics of a camera must have fx and fy above 0, in pixels (got {K[0, 0]:g} and "
                f"{K[1, 1]:g}; rows of the image count downwards)"
            )
        R = AHEAD if self.rotation is None else self.rotation
        R = frozen_array(R, np.float64, (3, 3), "rotation of a camera")
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-5 or np.linalg.det(R) < 0:
            raise Error("rotation of a camera must be sonar_from_camera (got a matrix that is no rotation)")
        object.__setattr__(self, "intrinsics", K)
        object.__setattr__(self, "rotation", R)

    @classmethod
    def of_fov(cls, width: int, height: int, fov_x_rad=None, fov_y_rad=None, rotation=None) -> Camera:
        """A camera of this field of view, from edge to edge; pixels are square where one of them is None.

        >>> Camera.of_fov(640, 480, fov_x_rad=math.pi / 2).intrinsics[0].tolist()
        [320.00000000000006, 0.0, 319.5]
        """
        width, height = _count("width", width), _count("height", height)
        if fov_x_rad is None and fov_y_rad is None:
            raise Error("a camera must be given its field of view, fov_x_rad, fov_y_rad or both")
        fx = None if fov_x_rad is None else width / 2 / math.tan(_angle("fov_x_rad", fov_x_rad) / 2)
        fy = None if fov_y_rad is None else height / 2 / math.tan(_angle("fov_y_rad", fov_y_rad) / 2)
        K = [[fx or fy, 0, (width - 1) / 2], [0, fy or fx, (height - 1) / 2], [0, 0, 1]]
        return cls(width, height, K, rotation)

    @classmethod
    def of_projection(cls, matrix, width: int, height: int, rotation=None) -> Camera:
        """The camera of an OpenGL projection, of an image whose first row is the top one.

        Parameters
        ----------
        matrix : (4, 4) clip_from_camera, a perspective, aside or not; how it lays depth does not matter

        Raises
        ------
        Error
            if it is no perspective.
        """
        P = check_projection(matrix)
        width, height = _count("width", width), _count("height", height)
        K = np.linalg.inv(_ndc_from_pixels(width, height)) @ P[[0, 1, 3], :3] @ OPENGL
        K[2] = 0, 0, 1
        return cls(width, height, K, rotation)

    @classmethod
    def covering(
        cls, sonar: Sonar, acoustics: Acoustics | None = None, pixel_deg: float = 0.1
    ) -> list[Camera]:
        """Cameras side by side, from starboard to port, that together see all that the sonar hears.

        Parameters
        ----------
        acoustics : whose beams hear beyond the fan; None is `Acoustics.physical()`
        pixel_deg : how wide a pixel is in the middle of an image; error falls with it

        Raises
        ------
        Error
            if an image would have more than 16384 columns or rows.
        """
        check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()")
        if not (isinstance(pixel_deg, (int, float, np.number)) and 0 < pixel_deg <= 10):
            raise Error(f"pixel_deg must be degrees above 0 and no more than 10 (got {pixel_deg!r})")
        pixel = math.radians(pixel_deg)
        acoustics = acoustics if acoustics is not None else Acoustics.physical()
        reach, aperture_deg = acoustics.beam_reach_rad(sonar), acoustics.drawn_sonar(sonar).elevation_fov_deg
        start, stop = sonar.azimuth_rad[0] - reach, sonar.azimuth_rad[-1] + reach
        if stop - start > 2 * math.pi:
            start, stop = -math.pi, math.pi
        n = math.ceil((stop - start) / WIDEST_RAD - 1e-9)
        half = (stop - start) / n / 2
        across, up = math.tan(half), math.tan(math.radians(aperture_deg) / 2) / math.cos(half)
        width, height = (2 * (math.ceil(extent / pixel) + MARGIN) for extent in (across, up))
        if max(width, height) > MAX_PIXELS:
            raise Error(
                f"cameras that cover this sonar must have at most {MAX_PIXELS} pixels a side (got {width} by "
                f"{height}; give a larger pixel_deg)"
            )
        K = [[1 / pixel, 0, (width - 1) / 2], [0, 1 / pixel, (height - 1) / 2], [0, 0, 1]]
        out = []
        for azimuth in start + half * (2 * np.arange(n) + 1):
            c, s = math.cos(azimuth), math.sin(azimuth)
            out.append(cls(width, height, K, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ AHEAD))
        return out

    @property
    def pixel_from_sonar(self) -> np.ndarray:
        """(3, 3) of directions in the sonar's frame; the third number is how far ahead they lie."""
        return self.intrinsics @ self.rotation.T

    def sees(self, directions) -> np.ndarray:
        """Whether directions, (..., 3) in the sonar's frame, lie in the image: (...) bool."""
        i, j, ahead = np.moveaxis(np.asarray(directions) @ self.pixel_from_sonar.T, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            i, j = i / ahead + 0.5, j / ahead + 0.5
        return (ahead > 0) & (i >= 0) & (i <= self.width) & (j >= 0) & (j <= self.height)

    def pixel_rad(self) -> tuple[float, float]:
        """How wide and how high, in azimuth and elevation, a pixel is in the middle of the image."""
        A = self.pixel_from_sonar
        d = np.linalg.solve(A, [(self.width - 1) / 2, (self.height - 1) / 2, 1.0])
        d /= np.linalg.norm(d)
        level = math.hypot(d[0], d[1]) or 1e-9
        steps = np.array([[-d[1], d[0], 0], [-d[0] * d[2] / level, -d[1] * d[2] / level, level]])
        moved, at = steps @ A.T, A @ d
        across, up = np.linalg.norm(moved[:, :2] - moved[:, 2:] * at[:2] / at[2], axis=1) / at[2]
        return 1 / max(across, 1e-9), 1 / max(up, 1e-9)

    def projection(self, near_m: float, far_m: float) -> np.ndarray:
        """(4, 4) OpenGL clip_from_camera, for the program that draws the image."""
        if not all(isinstance(one, (int, float, np.number)) for one in (near_m, far_m)) or not (
            0 < near_m < far_m < math.inf
        ):
            got = f"got {near_m!r} and {far_m!r}"
            raise Error(f"near_m and far_m must be finite metres, the former above 0 and the smaller ({got})")
        clip = np.zeros((4, 4))
        clip[[0, 1, 3], :3] = _ndc_from_pixels(self.width, self.height) @ self.intrinsics @ OPENGL
        clip[2, 2:] = np.array([far_m + near_m, 2 * far_m * near_m]) / (near_m - far_m)
        return clip

    def pose_gl(self, world_from_sonar) -> np.ndarray:
        """(4, 4) world_from_camera in OpenGL's axes: x right, y up, z back, as pyrender takes it."""
        out = check_pose(world_from_sonar).copy()
        out[:3, :3] = out[:3, :3] @ self.rotation @ OPENGL
        return out

    def sonar_pose(self, world_from_camera) -> np.ndarray:
        """(4, 4) world_from_sonar, where the camera stands so, in OpenGL's axes: undoes `pose_gl`."""
        out = check_pose(world_from_camera, "world_from_camera").copy()
        out[:3, :3] = out[:3, :3] @ (self.rotation @ OPENGL).T
        return out


def check_projection(matrix) -> np.ndarray:
    """(4, 4) float64, an OpenGL perspective, or an Error."""
    P = frozen_array(matrix, np.float64, (4, 4), "projection")
    if np.abs(P[3] - [0, 0, -1, 0]).max() > 1e-6 or P[0, 3] or P[1, 3]:
        raise Error(
            "projection must be an OpenGL perspective, whose last row is 0 0 -1 0 "
            f"(got {P[3].tolist()}; an orthographic one, or a transposed matrix, has another)"
        )
    return P


def _ndc_from_pixels(width: int, height: int) -> np.ndarray:
    """(3, 3) from pixels to OpenGL's -1..1, upwards."""
    return np.array([[2 / width, 0, 1 / width - 1], [0, -2 / height, 1 - 1 / height], [0, 0, 1.0]])


def covered(sonar: Sonar, cameras) -> float:
    """The share of the fan's solid angle that at least one of the cameras sees."""
    azimuth = np.radians(sonar.azimuth_fov_deg) * ((np.arange(512) + 0.5) / 512 - 0.5)
    sine = math.sin(math.radians(sonar.elevation_fov_deg) / 2) * ((np.arange(128) + 0.5) / 64 - 1)[:, None]
    level = np.sqrt(1 - sine * sine)
    up = np.broadcast_to(sine, (128, 512))
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=-1)
    return float(np.any([camera.sees(directions) for camera in cameras], axis=0).mean())
