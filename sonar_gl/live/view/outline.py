"""Lines and planes that show a sonar in 3D: the outline of its fan, and where the fan's picture lies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from sonar_gl.core.poses import pose
from sonar_gl.imaging.fan_image import FanGeometry
from sonar_gl.sonar.sonar import Sonar

SELECTED_COLOR = (80, 255, 130)  # RGB, of a selected body: no colour map of sonars has green
SECTOR_RAD = math.radians(45.0)  # of a picture in one plane: its sides are 8 % lower than its middle
ARC_STEP_RAD = math.radians(3.0)  # of the arcs' chords


def fan_outline(sonar: Sonar) -> np.ndarray:
    """Return the edges of the volume that a sonar sees, in the frame of its housing: with the tilt of the head.

    The volume is between the outer beams, the −3 dB edges in elevation, and the ranges of the sonar. A dashed
    middle is not among its edges: `fan_arcs` draws it.

    Returns (N, 2, 3) float32, ends of line segments, metres.

    >>> from sonar_gl.sonar.sonar_files import load_sonar
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
    low, high = sonar.fan_edges_rad
    azimuths = np.linspace(low, high, 1 + math.ceil((high - low) / ARC_STEP_RAD))
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


@dataclass(frozen=True, eq=False)
class PictureSector:
    """A part of the fan image of a ping, and where it lies in the frame of the head: in a plane through the sonar.

    The upper face of the fan, where a floor that the fan meets does not hide a picture, is a cone. One plane that
    touches it ahead would lie far below it at the sides of a wide fan; several planes, each for some of the beams, stay
    near it. A point of the cone is shown straight below, in the plane, so that neighbouring parts meet.

    geometry : FanGeometry of the whole picture
    azimuths_rad : edges of the part, starboard first
    elevation_rad : of the cone
    rows_per_m : pixels of the part per metre, in both directions
    """

    geometry: FanGeometry
    azimuths_rad: tuple[float, float]
    elevation_rad: float
    rows_per_m: float

    @classmethod
    def all_of(cls, geometry: FanGeometry, elevation_rad: float, rows: int) -> list[PictureSector]:
        """Return the parts of a picture, starboard first.

        elevation_rad : of the cone
        rows : of pixels up to the last range
        """
        low, high = geometry.azimuth_edges_rad
        edges = np.linspace(low, high, 1 + max(1, math.ceil((high - low) / SECTOR_RAD - 1e-6))).tolist()
        rows_per_m = rows / geometry.range_edges_m[1]
        return [cls(geometry, sides, elevation_rad, rows_per_m) for sides in pairwise(edges)]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of pixels."""
        (near_m, far_m), half_rad = self.geometry.range_edges_m, self._half_rad
        size_m = (
            far_m - near_m * math.cos(half_rad),
            2 * far_m * math.cos(self.elevation_rad) * math.sin(half_rad),
        )
        return tuple(max(1, math.ceil(one * self.rows_per_m - 1e-6)) for one in size_m)

    @property
    def height_m(self) -> float:
        return self.shape[0] / self.rows_per_m

    @property
    def width_m(self) -> float:
        return self.shape[1] / self.rows_per_m

    @property
    def head_from_picture(self) -> np.ndarray:
        """Pose of the part, (4, 4): origin in its middle, x to its right, y down, z into it."""
        ahead_m = self.geometry.range_edges_m[1] - self.height_m / 2
        flat = np.array([[0, -1, 0, ahead_m], [-1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]], np.float64)
        return pose(yaw=self._middle_rad) @ pose(pitch=-self.elevation_rad) @ flat

    def pixels(self) -> PicturePixels:
        """Return which pixels of the whole picture the part shows."""
        height, width = self.shape
        right, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        right_m = right / self.rows_per_m - self.width_m / 2
        down_m = down / self.rows_per_m - self.height_m / 2
        azimuth, range_m = self._bearing(right_m, down_m)
        near_m, far_m = self.geometry.range_edges_m
        from_side_m = range_m * np.sin(self._half_rad - abs(azimuth - self._middle_rad))
        cover = np.ones(azimuth.shape, np.float32)
        for from_edge_m in (from_side_m, range_m - near_m, far_m - range_m):
            cover *= np.clip(0.5 + from_edge_m * self.rows_per_m, 0, 1)
        column, row = self.geometry.pixel(azimuth, range_m)
        return PicturePixels(column.astype(np.float32), row.astype(np.float32), cover)

    @property
    def _half_rad(self) -> float:
        return (self.azimuths_rad[1] - self.azimuths_rad[0]) / 2

    @property
    def _middle_rad(self) -> float:
        return sum(self.azimuths_rad) / 2

    def _bearing(self, right_m, down_m) -> tuple[np.ndarray, np.ndarray]:
        """Return azimuth and range of the point of the cone that is straight above or below a point of the plane."""
        ahead_m = self.geometry.range_edges_m[1] - self.height_m / 2 - down_m
        level = math.cos(self.elevation_rad)
        azimuth = self._middle_rad + np.arctan2(-right_m, ahead_m * level)
        return azimuth, np.hypot(ahead_m * level, right_m) / level


class PicturePixels(NamedTuple):
    """Where the pixels of a part lie in the whole picture, (h, w) each."""

    # column, row: float32, as `FanGeometry.pixel` counts them
    column: np.ndarray
    row: np.ndarray
    # float32, share of a pixel that lies in the part, so that neighbouring parts meet without a line
    cover: np.ndarray

    def of(self, picture: np.ndarray) -> np.ndarray:
        """Return these pixels of a picture, (h, w, 3) uint8."""
        return cv2.remap(picture, self.column, self.row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
