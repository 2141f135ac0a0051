"""Lines and planes that show a sonar in 3D: the outline of its fan, and where the fan's picture lies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.core.poses import pose
from sonar_gl.imaging.fan_image import FanGeometry
from sonar_gl.sonar.sonar import Sonar

SELECTED_COLOR = (80, 255, 130)  # RGB, of a selected body: no colour map of sonars has green
ARC_STEP_RAD = math.radians(3.0)  # of the arcs' chords


def fan_outline(sonar: Sonar) -> np.ndarray:
    """Return the edges of the volume that a sonar sees, in the frame of its housing: with the tilt of the head.

    The volume is between the outer beams, the −3 dB edges in elevation, and the ranges of the sonar. A dashed
    middle is not among its edges: `fan_arcs` draws it.

    Returns
    -------
    (N, 2, 3) float32, ends of line segments, metres

    >>> from sonar_gl.sonar.sonar import load_sonar
    >>> float(np.linalg.norm(fan_outline(load_sonar("p900-45").with_range(20.0)), axis=2).max().round(3))
    20.0
    """
    azimuths, elevations, ranges = _edges(sonar)
    lines = []
    for elevation in elevations:
        lines += [_arc(azimuths, elevation, range_m) for range_m in ranges]
    if azimuths[-1] - azimuths[0] < 2 * math.pi - 1e-3:
        for azimuth in azimuths[[0, -1]]:
            lines += [_line([azimuth] * 2, [elevation] * 2, ranges) for elevation in elevations]
            lines += [_line([azimuth] * 2, elevations, [range_m] * 2) for range_m in ranges]
    return (np.concatenate(lines) @ sonar.sonar_from_head[:3, :3].T).astype(np.float32)


def fan_arcs(sonar: Sonar, step_m: float) -> np.ndarray:
    """Return arcs of equal range in the middle of the fan, in the frame of its housing: (N, 2, 3) float32, metres."""
    azimuths, _, (_, far_m) = _edges(sonar)
    ranges = np.arange(step_m, far_m * 0.999, step_m)
    lines = [_arc(azimuths, 0.0, range_m) for range_m in [*ranges, far_m]]
    return (np.concatenate(lines) @ sonar.sonar_from_head[:3, :3].T).astype(np.float32)


def round_step(about: float) -> float:
    """Return 1, 2 or 5 times a power of ten near a positive number.

    >>> round_step(6.0), round_step(0.021)
    (5.0, 0.02)
    """
    power = 10.0 ** np.floor(np.log10(about))
    return float(power * min((1, 2, 5, 10), key=lambda digit: abs(digit * power - about)))


def _edges(sonar: Sonar) -> tuple[np.ndarray, list[float], tuple[float, float]]:
    """Return azimuths along an arc, both elevations and both ranges."""
    half = math.radians(sonar.azimuth_fov_deg) / 2
    azimuths = np.linspace(-half, half, 1 + math.ceil(2 * half / ARC_STEP_RAD))
    up = math.radians(sonar.elevation_fov_deg) / 2
    return azimuths, [-up, up], (sonar.range_min_m, sonar.range_max_m)


def _arc(azimuths, elevation, range_m) -> np.ndarray:
    count = len(azimuths)
    points = _points(azimuths, [elevation] * count, [range_m] * count)
    return np.stack([points[:-1], points[1:]], 1)


def _line(azimuths, elevations, ranges) -> np.ndarray:
    return _points(azimuths, elevations, ranges)[None]


def _points(azimuths, elevations, ranges) -> np.ndarray:
    """Return (N, 3) points of N azimuths, elevations and ranges."""
    azimuths, elevations, ranges = (np.asarray(each, float) for each in (azimuths, elevations, ranges))
    flat = ranges * np.cos(elevations)
    return np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), ranges * np.sin(elevations)], -1)


@dataclass(frozen=True)
class PicturePlane:
    """Where the fan image of a ping lies in the frame of the head: in a plane through the sonar, tilted up.

    On the upper face of the fan, a floor that the fan meets does not hide it.

    Attributes
    ----------
    width_m, height_m : size of the whole picture
    head_from_picture : (4, 4), origin in the picture's middle, x to its right, y down, z into it
    """

    width_m: float
    height_m: float
    head_from_picture: np.ndarray

    @classmethod
    def of(cls, geometry: FanGeometry, elevation_rad: float) -> PicturePlane:
        """Return the plane of a picture of this geometry, at an elevation ahead of the sonar."""
        ahead = (geometry.sonar_row - (geometry.height - 1) / 2) / geometry.pixels_per_m
        port = (geometry.sonar_column - (geometry.width - 1) / 2) / geometry.pixels_per_m
        out = np.array([[0, -1, 0, ahead], [-1, 0, 0, port], [0, 0, -1, 0], [0, 0, 0, 1]], np.float64)
        out = pose(pitch=-elevation_rad) @ out
        return cls(geometry.width / geometry.pixels_per_m, geometry.height / geometry.pixels_per_m, out)

    def place_of_ray(self, head_from_world, origin, direction) -> tuple[float, float] | None:
        """Return (right, down), 0..1 of the picture, where a ray of the world meets it; None if it does not."""
        picture_from_world = np.linalg.inv(self.head_from_picture) @ head_from_world
        start = picture_from_world[:3, :3] @ origin + picture_from_world[:3, 3]
        along = picture_from_world[:3, :3] @ direction
        if abs(along[2]) < 1e-9 or -start[2] / along[2] <= 0:
            return None
        x, y, _ = start - along * (start[2] / along[2])
        right, down = x / self.width_m + 0.5, y / self.height_m + 0.5
        return (float(right), float(down)) if 0 <= right <= 1 and 0 <= down <= 1 else None
