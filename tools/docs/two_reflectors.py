"""Echoes over one or two planar reflectors by brute force, with box beams in azimuth: rays and images of the sonar."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from sonar_gl.scene.reflectors import N_SINES, planar_reflectors
from tests.support.two_bounces import LIFT_M, SURFACE, RayCaster

ON_PLANE_M = 2e-3  # from a reflector's plane, its own surface
THERE_M = 10 * ON_PLANE_M  # from where a ray should meet a reflector
MAX_SINE = np.sin(np.radians(80.0))  # of elevations: far into the side lobes
EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])
LEAST_REFLECTION = 0.01  # of the intensity at 45 degrees: reflectors that are left out return less


class Reflector(NamedTuple):
    """A planar reflector in the frame of the sonar.

    normal, offset_m : of its plane, normal . x = offset
    body : number of its body, or SURFACE
    reflected : (N_SINES,) intensity by the sine of the grazing angle
    box : (2, 3) lowest and highest coordinates of its body
    """

    normal: np.ndarray
    offset_m: float
    body: int
    reflected: np.ndarray
    box: np.ndarray


class TwoReflectors:
    """The reflectors and bodies of a scene, seen from its sonar.

    Parameters
    ----------
    scene : Scene
    sonar : Sonar
    acoustics : of which the elevation pattern and the water count
    """

    def __init__(self, scene, sonar, acoustics):
        pose = sonar.head_pose(scene.sonar_pose)
        self.sonar, self.pattern = sonar, acoustics.two_way_elevation_pattern(sonar)
        n_faces = [len(body.surface.faces) for body in scene.bodies]
        self.first_face = np.cumsum([0, *n_faces])
        self.mu = np.concatenate(
            [np.broadcast_to(body.reflectivity, n) for body, n in zip(scene.bodies, n_faces, strict=True)]
        )
        k = 2 * np.pi * sonar.frequency_hz / acoustics.water.sound_speed()
        reflectors = planar_reflectors(scene, k, acoustics.water.wave_height_m())
        poses = np.stack([body.pose for body in scene.bodies])
        self.reflectors = []
        for one in reflectors:
            if np.interp(np.sin(np.pi / 4), np.linspace(0, 1, N_SINES), one.reflection_coefficient) < (
                LEAST_REFLECTION
            ):
                continue
            normal, offset = one.in_world(poses)
            plane = normal @ pose[:3, :3], offset - normal @ pose[:3, 3]
            body, box = SURFACE, EVERYWHERE
            if one.body is not None:
                body, box = one.body, _box_of(scene.bodies[one.body], pose)
            self.reflectors.append(Reflector(*plane, body, one.reflection_coefficient, box))
        surface = next((one[:2] for one in self.reflectors if one.body == SURFACE), None)
        self.caster = RayCaster(scene, pose, surface)

    def hits(self, origins, directions):
        """Return distance (inf for none), normal towards the ray, body and face of the first thing on each ray."""
        distance, normal, body, face = self.caster.hits(origins, directions)
        face += self.first_face[np.maximum(body, 0)]
        return distance, normal, body, np.minimum(face, len(self.mu) - 1)

    def is_on(self, reflector: int, body, place):
        """Return whether places on bodies lie on a reflector."""
        one = self.reflectors[reflector]
        return (body == one.body) & (np.abs(place @ one.normal - one.offset_m) < ON_PLANE_M)

    def reflection(self, reflector: int, direction):
        """Return the intensity reflection coefficient for directions of rays."""
        one = self.reflectors[reflector]
        return np.interp(np.abs(direction @ one.normal), np.linspace(0, 1, N_SINES), one.reflected)

    def joined(self, place, face_normal, leg: tuple[int, ...], within_m):
        """Join places to the sonar by reflectors; the leg names them from the sonar on.

        Rays are cast only for places whose way may still be open, since they take most of the time.

        within_m : how long the way from each place may be

        Returns
        -------
        numbers of the places whose way is open; of each of these length, reflection, cos θ at the place, and (n, 3)
        direction at the sonar
        """
        images = [np.zeros(3)]
        for reflector in leg:
            normal, offset, *_ = self.reflectors[reflector]
            images.append(images[-1] + 2 * (offset - images[-1] @ normal) * normal)
        length = np.linalg.norm(place - images[-1], axis=1)
        cosine = (((images[-1] - place) / length[:, None]) * face_normal).sum(axis=1)
        which = np.flatnonzero((cosine > 0) & (length < within_m))
        at, lift, loss = place[which], face_normal[which], np.ones(len(which))
        for reflector, image in zip(leg[::-1], images[::-1], strict=False):
            toward = (image - at) / np.linalg.norm(image - at, axis=1)[:, None]
            normal, offset, *_, (low, high) = self.reflectors[reflector]
            with np.errstate(divide="ignore", invalid="ignore"):
                there = (offset - at @ normal) / (toward @ normal)
                spot = at + there[:, None] * toward
                may_meet = (there > 0) & ((spot > low - THERE_M) & (spot < high + THERE_M)).all(axis=1)
            which, at, lift, loss, toward, there, spot = (
                one[may_meet] for one in (which, at, lift, loss, toward, there, spot)
            )
            distance, turned, body, _ = self.hits(at + LIFT_M * lift, toward)
            is_open = (np.abs(distance - there) < THERE_M) & self.is_on(reflector, body, spot)
            loss *= self.reflection(reflector, toward)
            which, at, lift, loss = (one[is_open] for one in (which, spot, turned, loss))
        to_sonar = np.linalg.norm(at, axis=1)
        toward = -at / np.maximum(to_sonar, 1e-9)[:, None]
        distance, *_ = self.hits(at + LIFT_M * lift, toward)
        is_open = distance > to_sonar - 20 * LIFT_M
        which, loss, direction = which[is_open], loss[is_open], -toward[is_open]
        return which, length[which], loss, cosine[which], direction

    def ping(self, n_rays: int, seed: int = 0, batch: int = 500_000):
        """Return (B, K) multipath over one reflector, and over two, for a range gain of 1."""
        sonar, random = self.sonar, np.random.default_rng(seed)
        half = self.half = np.radians(sonar.azimuth_fov_deg + sonar.beam_width_deg) / 2
        self.spacing = np.diff(sonar.azimuth_rad).mean()
        self.around = int(np.ceil((half - sonar.azimuth_rad[-1]) / self.spacing)) + 2
        n = len(self.reflectors)
        legs = [(), *((a,) for a in range(n))]
        twice = [(a, b) for a, b in product(range(n), repeat=2) if a != b]
        out = np.zeros((2, sonar.n_beams + 2 * self.around, sonar.n_bins))
        for _ in range(-(-n_rays // batch)):
            azimuth, sine = half * random.uniform(-1, 1, batch), MAX_SINE * random.uniform(-1, 1, batch)
            cosine = np.sqrt(1 - sine**2)
            launched = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine], axis=1)
            start = np.zeros((batch, 3))
            distance, normal, body, face = self.hits(start, launched)
            place = launched * np.where(np.isfinite(distance), distance, 0.0)[:, None]
            for leg in legs:
                direction, weight, length = launched, np.sqrt(self.pattern(sine)), distance
                there, facing, met, on = place, normal, body, face
                if leg:
                    (a,) = leg
                    turns = self.is_on(a, body, place)
                    sent, inward = launched[turns], normal[turns]
                    direction = sent - 2 * (sent * inward).sum(axis=1)[:, None] * inward
                    weight = weight[turns] * self.reflection(a, sent)
                    beyond, facing, met, on = self.hits(place[turns] + LIFT_M * inward, direction)
                    length = distance[turns] + beyond
                    there = place[turns] + direction * np.where(np.isfinite(beyond), beyond, 0.0)[:, None]
                else:
                    sent = launched
                ends = (met >= 0) & (length < 2 * sonar.range_max_m)
                outward = sent[ends], weight[ends], length[ends]
                scattering = there[ends], facing[ends], self.mu[on[ends]], direction[ends]
                others = [*([(b,) for b in range(n)] if leg else []), *(twice if not leg else [])]
                if not leg:
                    others += [(a,) for a in range(n)]
                for other in others:
                    order = len(set(leg + other))
                    if not leg or other == leg or order == 2:
                        self._add(out[order - 1], outward, scattering, leg, other)
        height = 2 * MAX_SINE * self.pattern(np.linspace(-MAX_SINE, MAX_SINE, 20001)).mean()
        rays = batch * -(-n_rays // batch)
        width = np.radians(sonar.beam_width_deg)
        out *= 2 * half * 2 * MAX_SINE / rays / (width * height)
        return [self._beams(one, width) for one in out]

    def _add(self, out, outward, scattering, leg, other) -> None:
        """Add paths that go out by one leg and back by another; those that go out straight the other way round, too."""
        (sent, weight, length), (place, facing, mu, direction) = outward, scattering
        within_m = 2 * self.sonar.range_max_m - length
        which, back, loss, cosine, arriving = self.joined(place, facing, other, within_m)
        sent, weight, length, mu = (one[which] for one in (sent, weight, length, mu))
        if other == leg:  # reflected twice by one plane: the way back is that out
            cosine = np.abs((direction[which] * facing[which]).sum(axis=1))
        mean = (length + back) / 2
        energy = mu * cosine * weight * loss * (mean / back) ** 2
        energy *= np.sqrt(self.pattern(np.clip(arriving[:, 2], -1, 1)))
        # the fan is insonified evenly, and nothing beside it, as in the simulator
        energy *= (np.abs(arriving[:, 2]) < MAX_SINE) & (self._azimuth(arriving) < self.half)
        self._put(out, arriving, mean, energy)
        if not leg:
            self._put(out, sent, mean, energy)

    def _azimuth(self, directions):
        return np.abs(np.arctan2(directions[:, 1], directions[:, 0]))

    def _put(self, out, arriving, range_m, energy) -> None:
        azimuth = np.arctan2(arriving[:, 1], arriving[:, 0])
        beam = np.rint((azimuth - self.sonar.azimuth_rad[0]) / self.spacing).astype(int) + self.around
        k = np.floor((range_m - self.sonar.range_min_m) / self.sonar.bin_size_m)
        ok = (beam >= 0) & (beam < len(out)) & (k >= 0) & (k < self.sonar.n_bins) & (energy > 0)
        np.add.at(out, (beam[ok], k[ok].astype(int)), energy[ok])

    def _beams(self, image, width_rad):
        """Return sums over the widths of box beams."""
        steps = width_rad / self.spacing
        reach = int(np.ceil((steps - 1) / 2))
        kernel = np.ones(2 * reach + 1)
        kernel[[0, -1]] *= (steps - (2 * reach - 1)) / 2
        padded = np.apply_along_axis(np.convolve, 0, image, kernel, "same")
        return padded[self.around : -self.around]


def _box_of(body, pose) -> np.ndarray:
    """Return (2, 3) lowest and highest coordinates of a body in the frame of a sonar at a pose."""
    m = np.linalg.inv(pose) @ body.pose
    vertices = np.asarray(body.surface.vertices) @ m[:3, :3].T + m[:3, 3]
    return np.array([vertices.min(axis=0), vertices.max(axis=0)])
