"""Who is in view: how many samples met each body, what it returned, and what it could have."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.compiled import compiled
from sonar_gl.echo import specular_lobe
from sonar_gl.sonar import Sonar

# Larger meshes are taken to show what their boxes would: adding up their faces costs too much.
MAX_FACES = 200_000
VERTICES = 64  # of a body, about, are looked for among the samples
OPEN = 1.01  # 1/x over that of the sample there: a vertex at the foot of a body is as near as the floor


@compiled
def count_samples(
    plane_echo, body_id, u, v, tan_elevation, r_first, per_metre, gain, elevation, hits, echo
):  # fmt: skip
    """Add one sector's samples to (bodies + 1,) counts and sums of μ cos θ ΔΩ G, in aperture and range.

    elevation : of `footprint.accumulate`, taken at the nearest sine
    """
    per_sine = (elevation.shape[0] - 1) / 2 * math.sqrt(1 / tan_elevation**2 + 1)
    K = gain.shape[0]
    area = u[1] * v[2] - u[2] * v[1]
    limit = tan_elevation * tan_elevation
    for j in range(plane_echo.shape[0]):
        for i in range(plane_echo.shape[1]):
            q = plane_echo[j, i, 0]
            if q <= 0.0 or plane_echo[j, i, 3] <= 0.0:
                continue
            uc, vc = u[0] + u[1] * i + u[2] * j, v[0] + v[1] * i + v[2] * j
            if vc * vc > limit * (1.0 + uc * uc):
                continue
            L = math.sqrt(1.0 + uc * uc + vc * vc)
            k = (L / q - r_first) * per_metre
            if 0.0 <= k < K:
                place = int((elevation.shape[0] - 1) / 2 + vc / L * per_sine + 0.5)
                heard = elevation[place] if elevation.shape[0] else 1.0
                hits[body_id[j, i]] += 1.0
                echo[body_id[j, i]] += plane_echo[j, i, 3] * q * area / (L * L * L * L) * gain[int(k)] * heard


def census(views, n_bodies: int, sonar: Sonar, gain, elevation) -> tuple[np.ndarray, np.ndarray]:
    """(bodies + 1,) samples that met each body, and about the echo of each; `sonar` as drawn."""
    hits, echo = np.zeros(n_bodies + 1), np.zeros(n_bodies + 1)
    for sector, plane_echo, body_id in views:
        count_samples(
            plane_echo,
            body_id,
            sector.u,
            sector.v,
            sector.tan_elevation,
            sonar.range_min_m,
            1.0 / sonar.bin_size_m,
            gain,
            elevation,
            hits,
            echo,
        )
    return hits, echo


def in_plain_sight(views, body, body_pose, pose, sonar: Sonar) -> bool:
    """Whether some vertex of a body that no sample met lies in the open, as the samples about it tell."""
    vertices = np.asarray(body.surface.vertices, np.float64)
    vertices = vertices[:: max(1, len(vertices) // VERTICES)]
    world = vertices @ body_pose[:3, :3].T + body_pose[:3, 3]
    points = (world - pose[:3, 3]) @ pose[:3, :3]
    range_m = np.linalg.norm(points, axis=1)
    points = points[(range_m > sonar.range_min_m) & (range_m < sonar.range_max_m)]
    for sector, plane_echo, _ in views:
        x, y, z = (points @ sector.rotation().T).T
        ahead = x > 1e-3
        u, v, q = -y[ahead] / x[ahead], z[ahead] / x[ahead], 1 / x[ahead]
        near = (np.abs(v) < sector.tan_elevation * np.sqrt(1 + u * u)) & (
            np.abs(np.arctan(u)) < sector.half_width_rad
        )
        lattice = np.linalg.inv([[sector.u[1], sector.u[2]], [sector.v[1], sector.v[2]]])
        i, j = np.rint(lattice @ np.stack([u - sector.u[0], v - sector.v[0]])).astype(int)
        inside = near & (i >= 0) & (i < sector.columns) & (j >= 0) & (j < sector.rows)
        if (q[inside] > plane_echo[j[inside], i[inside], 0] * OPEN).any():
            return True
    return False


def _bounds(surface) -> np.ndarray:
    """(2, 3) least and largest coordinates of the vertices that faces use."""
    used = np.zeros(len(surface.vertices), bool)
    used[np.asarray(surface.faces)] = True
    vertices = np.asarray(surface.vertices, np.float64)[used]
    return np.array([vertices.min(axis=0), vertices.max(axis=0)])


def _area_m2(surface) -> float:
    """Area of a mesh."""
    a, b, c = np.asarray(surface.vertices, np.float64)[np.asarray(surface.faces).T]
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


class Extent:
    """What each body of a scene could show at most, if nothing stood before it; `specular`: with its lobe."""

    def __init__(self, bodies, specular: bool = False):
        surfaces = [body.surface for body in bodies]
        bounds = np.array([_bounds(surface) for surface in surfaces]).reshape(-1, 2, 3)
        self.centres, self.radii = bounds.mean(axis=1), np.linalg.norm(np.ptp(bounds, axis=1), axis=1) / 2
        lobes = [specular_lobe(1.0, body.specular * specular, body.roughness_rad) for body in bodies]
        self.reflectivity = np.array([0.0] + [np.max(body.reflectivity) for body in bodies])
        self.reflectivity[1:] += lobes
        # the shadow of a surface is half of it at most, and inside that of its sphere
        self.area_m2 = np.minimum(
            np.pi * self.radii**2,
            [_area_m2(s) / 2 if len(s.faces) <= MAX_FACES else np.inf for s in surfaces],
        )

    def solid_angle(self, where, pose, sonar: Sonar, reach_rad: float) -> np.ndarray:
        """(bodies + 1,) steradians that each body may fill; 0 where its sphere lies outside the fan.

        where : Whereabouts of the bodies
        """
        out = np.zeros(len(self.radii) + 1)
        if not len(self.radii):
            return out
        centres = np.einsum("nij,nj->ni", where.poses[:, :3, :3], self.centres) + where.poses[:, :3, 3]
        x, y, z = ((centres - pose[:3, 3]) @ pose[:3, :3]).T
        distance = np.maximum(np.sqrt(x * x + y * y + z * z), 1e-9)
        wide = np.arcsin(np.minimum(self.radii / distance, 1.0))
        elevation = np.arcsin(z / distance)
        half_azimuth = math.radians(sonar.azimuth_fov_deg) / 2 + reach_rad
        beside = wide / np.maximum(np.cos(elevation), 1e-9)
        inside = (
            where.shown
            & (distance - self.radii < sonar.range_max_m)
            & (distance + self.radii > sonar.range_min_m)
            & (np.abs(elevation) - wide < math.radians(sonar.elevation_fov_deg) / 2)
            & (np.abs(np.arctan2(y, x)) - beside < half_azimuth)
        )
        nearest = np.maximum(distance - self.radii, distance / 2)
        out[1:] = np.where(inside, np.minimum(self.area_m2 / nearest**2, 4 * np.pi), 0.0)
        return out
