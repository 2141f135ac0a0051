"""Multipath by brute force: rays are reflected where they hit a planar reflector, and return from their end."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

LIFT_M = 1e-4  # rays start this far off a surface, so as not to hit it again
NO_BODY, SURFACE = -2, -1  # in the place of a body's number


class RayCaster:
    """Casts rays at the bodies of a scene and the water's surface, in the sonar's frame.

    Parameters
    ----------
    pose : (4, 4) world_from_sonar
    surface : unit normal and offset of the surface, normal . x = offset, in the sonar's frame; None for none
    """

    def __init__(self, scene, pose, surface):
        self.surface, self._embree, self._keep = surface, EmbreeScene(robust=True), []
        sonar_from_world = np.linalg.inv(pose)
        for body in scene.bodies:
            m = sonar_from_world @ body.pose
            vertices = np.asarray(body.surface.vertices) @ m[:3, :3].T + m[:3, 3]
            corners = vertices[np.asarray(body.surface.faces)].astype(np.float32)
            self._keep.append(TriangleMesh(self._embree, corners))

    def hits(self, origins, directions):
        """Return distance (inf for none), unit normal towards the ray, body and its face; see SURFACE and NO_BODY."""
        found = self._embree.run(origins.astype(np.float32), directions.astype(np.float32), output=True)
        body = np.where(found["geomID"].astype(int) >= 0, found["geomID"].astype(int), NO_BODY)
        distance = np.where(body >= 0, found["tfar"].astype(float), np.inf)
        normal = found["Ng"].astype(float)
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
        if self.surface is not None:
            up, offset = self.surface
            with np.errstate(divide="ignore", invalid="ignore"):
                there = (offset - origins @ up) / (directions @ up)
            first = (there > 1e-6) & (there < distance)
            distance, body = np.where(first, there, distance), np.where(first, SURFACE, body)
            normal[first] = up
        normal *= -np.sign((normal * directions).sum(axis=1))[:, None]
        return distance, normal, body, np.where(body >= 0, found["primID"].astype(int), 0)


class TwoBounces:
    """Single-bounce and double-bounce echoes of a sonar with box beams, for bodies with one reflectivity each.

    Reflectors return all energy at all angles, and both ways of a single bounce add up incoherently.

    Parameters
    ----------
    scene : faces of the bodies in `reflectors`, and a surface at `surface_z_m`, reflect
    reflectors : names of bodies
    pattern : two-way elevation pattern, a function of the sine of the elevation; None for a constant
    """

    def __init__(self, scene, sonar, pose, reflectors, pattern=None):
        self.sonar, self.pattern = sonar, pattern or np.ones_like
        self.mu = np.array([float(body.reflectivity) for body in scene.bodies])
        self.is_reflector = np.array([body.name in reflectors for body in scene.bodies])
        self.surface = None if scene.surface_z_m is None else (pose[2, :3], scene.surface_z_m - pose[2, 3])
        self.hits = RayCaster(scene, pose, self.surface).hits

    def ping(self, n_rays: int, seed: int = 0):
        """Return the multipath part of a ping, (B, K), for G = 1, from jittered rays over the fan."""
        sonar, random = self.sonar, np.random.default_rng(seed)
        half, top = np.radians(sonar.azimuth_fov_deg) / 2, np.sin(np.radians(sonar.elevation_fov_deg) / 2)
        across = int(np.sqrt(n_rays * 2))
        up = n_rays // across
        i, j = np.meshgrid(np.arange(across), np.arange(up), indexing="ij")
        azimuth = half * (2 * (i + random.random(i.shape)) / across - 1).ravel()
        sine = top * (2 * (j + random.random(i.shape)) / up - 1).ravel()
        cosine = np.sqrt(1 - sine**2)
        rays = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine], axis=1)
        to_reflector, normal, body, _ = self.hits(np.zeros_like(rays), rays)
        reflects = (body == SURFACE) | ((body >= 0) & np.append(self.is_reflector, False)[body])
        rays, azimuth, to_reflector, normal = (x[reflects] for x in (rays, azimuth, to_reflector, normal))
        turned = rays - 2 * (rays * normal).sum(axis=1)[:, None] * normal
        start = rays * to_reflector[:, None]
        beyond, face, met, _ = self.hits(start + LIFT_M * normal, turned)
        ok = met >= 0
        rays, azimuth, to_reflector, start, turned, beyond, face, met = (
            x[ok] for x in (rays, azimuth, to_reflector, start, turned, beyond, face, met)
        )
        place, bounced = start + turned * beyond[:, None], to_reflector + beyond
        mu = self.mu[met]
        out = np.zeros((sonar.n_beams, sonar.n_bins))
        # double bounce: both ways by the reflector
        incidence = -(turned * face).sum(axis=1)
        self._put(out, azimuth, bounced, mu * incidence * self.pattern(rays[:, 2]))
        # single bounce: the point must be visible directly, from the same side, and within the fan
        straight = np.linalg.norm(place, axis=1)
        back = -place / straight[:, None]
        other = (back * face).sum(axis=1)
        distance, _, body, _ = self.hits(place + LIFT_M * face, back)
        there = np.arctan2(place[:, 1], place[:, 0])
        visible = (other > 0) & (distance > straight - 2 * LIFT_M)
        visible &= (np.abs(place[:, 2] / straight) < top) & (np.abs(there) < half)
        if self.surface is not None:
            visible &= place @ self.surface[0] < self.surface[1]
        mean = (straight + bounced) / 2
        energy = mu * other * (mean / straight) ** 2 * visible
        energy *= np.sqrt(self.pattern(rays[:, 2]) * self.pattern(np.clip(place[:, 2] / straight, -top, top)))
        self._put(out, azimuth, mean, energy)
        self._put(out, there, mean, energy)
        beam = 2 * half / sonar.n_beams
        return out * (2 * half * 2 * top / (across * up)) / (beam * 2 * top)

    def _put(self, out, azimuth, range_m, energy):
        sonar = self.sonar
        half = np.radians(sonar.azimuth_fov_deg) / 2
        beam = np.floor((azimuth + half) / (2 * half) * sonar.n_beams).astype(int)
        k = np.floor((range_m - sonar.range_min_m) / sonar.bin_size_m).astype(int)
        ok = (beam >= 0) & (beam < sonar.n_beams) & (k >= 0) & (k < sonar.n_bins)
        np.add.at(out, (beam[ok], k[ok]), energy[ok])
