"""The water's surface in the samples of a view: which rays meet it before any body, and where."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sector import Sector


class WaterSurface(NamedTuple):
    """The water's surface in the sonar's frame.

    up : (3,) unit vector, upright
    height_m : of the surface over the sonar, metres, above 0
    """

    up: np.ndarray
    height_m: float


def water_surface(pose: np.ndarray, surface_z_m: float | None) -> WaterSurface | None:
    """Return the surface over a sonar in the water; None if there is none, or the sonar is above it.

    pose : (4, 4) world_from_sonar
    surface_z_m : height of the surface in the world, metres, or None
    """
    if surface_z_m is None or pose[2, 3] >= surface_z_m:
        return None
    return WaterSurface(pose[2, :3], surface_z_m - pose[2, 3])


class SurfaceOnRays(NamedTuple):
    """The water's surface on the rays of samples.

    depth_inverse : (R, C) float64, 1/x where a ray meets the surface; 0 or less where it does not
    slopes : of it along u and v, the same everywhere
    is_nearest : (R, C) bool, whether the surface is nearer than any body
    ray_length : (R, C) float64, slant range over x
    """

    depth_inverse: np.ndarray
    slopes: tuple[float, float]
    is_nearest: np.ndarray
    ray_length: np.ndarray


def on_rays(samples: SectorSamples, surface: WaterSurface) -> SurfaceOnRays:
    """Return the water's surface on the rays of samples."""
    u, v = samples.sector.sample_coordinates()
    x, y, z = samples.sector.rotation() @ surface.up / surface.height_m
    depth_inverse = x - y * u + z * v
    is_surface = depth_inverse > samples.plane_echo[..., 0]
    return SurfaceOnRays(depth_inverse, (-y, z), is_surface, np.sqrt(1 + u * u + v * v))


def ray_lengths(samples: SectorSamples) -> np.ndarray:
    """Return (R, C) slant range over x, along the sector's axis, of each ray."""
    u, v = samples.sector.sample_coordinates()
    return np.sqrt(1 + u * u + v * v)


def whole_sector(samples: SectorSamples, sector: Sector) -> SectorSamples:
    """Return the samples of a whole sector from those of a window, outside of which there are no bodies."""
    rows, columns = samples.plane_echo.shape[:2]
    apart = samples.sector.u[0] - sector.u[0], samples.sector.v[0] - sector.v[0]
    i, j = np.rint(np.linalg.solve(sector.steps, apart)).astype(int)
    plane_echo = np.zeros((sector.rows, sector.columns, 4), np.float32)
    plane_echo[j : j + rows, i : i + columns] = samples.plane_echo
    return SectorSamples(sector, plane_echo, samples.body_id)
