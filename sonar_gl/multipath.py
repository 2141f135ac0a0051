"""Ghosts: what mirrors add to a ping, drawn from behind them and summed beside the straight echoes.

The sonar's image in a plane sees through it what the sonar sees in it. So an echo that meets the plane twice
is a ping of the image, and one that meets it once goes straight one way and by the image's ray the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sonar_gl.draws import Whereabouts
from sonar_gl.fan import half_of
from sonar_gl.ghosts import accumulate_ghosts
from sonar_gl.lookup import Lookup, light, lookup
from sonar_gl.passes import Pass, Passes
from sonar_gl.reflectors import Mirror, find_mirrors

BIAS_M = 1e-3  # a mirror's own surface is not drawn from behind
FACES = np.diag([1.0, -1.0, 1.0, 1.0])  # the image's port is the sonar's starboard
# Ghosts err by their share of the echo. Samples are halved twice for those of less than SHARES[0] of the
# straight echoes, once for those of less than SHARES[1], and not at all for stronger ones.
SHARES = 0.1, 0.3
WIDEST = 1.0  # columns, in spacings of beams
BOTH_WAYS = 3.0  # an echo may meet the mirror on its way out, on its way back, or on both


def behind(plane) -> tuple[np.ndarray, np.ndarray]:
    """Where the sonar's image is, (4, 4) sonar_from_image, and the plane in its frame, of `draws.Placed`."""
    turned = np.eye(4)
    turned[:3, :3] -= 2 * np.outer(plane[:3], plane[:3])
    turned[:3, 3] = 2 * plane[3] * plane[:3]
    out = turned @ FACES
    offset = plane[3] - BIAS_M - plane[:3] @ out[:3, 3]
    return out, np.append(-out[:3, :3].T @ plane[:3], offset)


@dataclass(frozen=True, eq=False)
class Ghost:
    """A mirror that returns something in one ping.

    Attributes
    ----------
    mirror : Mirror
    plane : (4,) normal and offset of it, in the sonar's frame
    ceiling : (4,) likewise of the water's surface, normal up; all zeros if there is none
    sonar_from_image : (4, 4)
    own_views, seen : what the sonar sees, and to look it up
    views, lookup : what its image sees
    """

    mirror: Mirror
    plane: np.ndarray
    ceiling: np.ndarray
    sonar_from_image: np.ndarray
    own_views: list
    seen: Lookup
    views: list
    lookup: Lookup


@dataclass(frozen=True, eq=False)
class Ghosts:
    """Those of one ping, how often samples were halved for them, the passes of the sonar and its image."""

    halved: int
    own: Pass
    image: Pass
    mirrored: list[Ghost]


class Multipath:
    """The mirrors of a run.

    Parameters
    ----------
    passes : Passes of the sonar
    scene : Scene
    tolerance : mirrors that can return no more than this share of the echo are left out

    Attributes
    ----------
    halved : how often samples are, by the strength of the last ping's ghosts; `fixed` holds it as it is
    """

    def __init__(self, passes: Passes, scene, tolerance: float):
        sonar = passes.sonar
        # lobes are those of echoes straight back; the projector's weight would go by the wrong way of the two
        acoustics = replace(passes.acoustics, specular=False, transmit_width_deg=None)
        self.acoustics, self.tolerance, self.gpu = acoustics, tolerance, passes.gpu
        self.own = Passes(passes.gpu, sonar, acoustics, WIDEST)
        if sonar.beam_azimuths_deg is not None:
            turned = tuple(-azimuth for azimuth in reversed(sonar.beam_azimuths_deg))
            sonar = replace(sonar, beam_azimuths_deg=turned)
        self.images = Passes(passes.gpu, sonar, acoustics, WIDEST)
        self.wavenumber_rad_m = 2 * math.pi * sonar.frequency_hz / acoustics.sound_speed()
        self.scene, self.mirrors, self.halved, self.fixed = None, [], len(SHARES), False
        self.look(scene)

    def look(self, scene) -> None:
        """Find the mirrors of a scene, once."""
        if scene is not self.scene:
            self.scene, self.mirrors = scene, find_mirrors(scene, self.wavenumber_rad_m)
            self.shines = any(body.specular > 0 for body in scene.bodies)
            self.brightest = max([float(np.max(body.reflectivity)) for body in scene.bodies], default=0.0)

    def too_coarse(self, halved: int, ghosts: float, straight: float) -> bool:
        """Whether ghosts should have been drawn finer, by their sum and that of the straight echoes."""
        if not self.fixed:
            # coarser only where they would stay so: else they flicker
            wanted, kept = (sum(f * ghosts <= share * straight for share in SHARES) for f in (1, 2))
            self.halved = min(max(self.halved, kept), wanted)
        return halved > self.halved

    def draw(self, now: Pass, poses, wheres) -> list[Ghosts | None]:
        """The ghosts of each of the pings that `now` drew last, from these poses; None without any."""
        found, spots = [], []
        for number, (pose, where) in enumerate(zip(poses, wheres, strict=True)):
            # bubbles would have to weaken each leg by itself
            seen, where = (
                lookup(now.renderer.drawn[number]),
                replace(where or self.gpu.stock.where, bubbles=None),
            )
            for mirror in self.mirrors:
                plane = self._plane(mirror, pose, where)
                if plane is not None and self._counts(mirror, plane, seen, now):
                    sonar_from_image, clip = behind(plane)
                    found.append((number, (mirror, plane, self._ceiling(pose), sonar_from_image)))
                    spots.append((pose @ sonar_from_image, where, clip))
        out = [None] * len(poses)
        if not found:
            return out
        numbers = sorted({number for number, _ in found})
        sampling = now.sampling
        for _ in range(self.halved):
            sampling = half_of(sampling)
        own, image = self.own.of(sampling), self.images.of(sampling)
        if (
            self.halved
            or self.shines
            or any(where is not None and where.bubbles is not None for where in wheres)
        ):
            clear = [where and replace(where, bubbles=None) for where in wheres]
            views = own.views_of([poses[n] for n in numbers], [clear[n] for n in numbers])
            pictures = own.renderer.drawn
        else:  # what was drawn will do
            views, pictures = now.last_views(), now.renderer.drawn
            views, pictures = [views[n] for n in numbers], [pictures[n] for n in numbers]
        own_of = dict(zip(numbers, zip(views, map(lookup, pictures), strict=True), strict=True))
        image_poses, image_wheres, clips = zip(*spots, strict=True)
        views = image.views_of(image_poses, image_wheres, planes=clips)
        for (number, about), *seen in zip(found, views, map(lookup, image.renderer.drawn), strict=True):
            out[number] = out[number] or Ghosts(self.halved, own, image, [])
            out[number].mirrored.append(Ghost(*about, *own_of[number], *seen))
        return out

    def sum(self, ghosts: Ghosts, gain) -> tuple[np.ndarray, float]:
        """(B, K) of a ping's ghosts, and its sum."""
        own = [(ghost.own_views, self._adder(ghost, False)) for ghost in ghosts.mirrored]
        image = [(ghost.views, self._adder(ghost, True)) for ghost in ghosts.mirrored]
        out = ghosts.own.reducer.sum_with(own, gain)
        out += ghosts.image.reducer.sum_with(image, gain)[::-1]
        return out, ghosts.own.reducer.total + ghosts.image.reducer.total

    def _plane(self, mirror: Mirror, pose, where: Whereabouts):
        """(4,) the mirror in the sonar's frame, its offset positive; None if it is not there."""
        if mirror.body is not None and not where.shown[mirror.body]:
            return None
        normal, offset = mirror.in_world(where.poses)
        plane = np.append(normal @ pose[:3, :3], offset - normal @ pose[:3, 3])
        if abs(plane[3]) <= BIAS_M:
            return None
        return plane if plane[3] > 0 else -plane

    def _ceiling(self, pose) -> np.ndarray:
        """(4,) the water's surface in the sonar's frame, normal up; zeros if there is none."""
        z = self.scene.surface_z_m
        return np.zeros(4) if z is None else np.append(pose[2, :3], z - pose[2, 3])

    def _counts(self, mirror: Mirror, plane, seen: Lookup, now: Pass) -> bool:
        """Whether a mirror may return more than the tolerance."""
        sonar = now.fan.sonar
        mirrored, echo = light(
            seen.picture, seen.sectors, plane, mirror.body is not None, mirror.loss, sonar.range_max_m
        )
        return BOTH_WAYS * self.brightest * mirrored > self.tolerance * echo

    def _adder(self, ghost: Ghost, from_image: bool):
        """What `Reducer.sum_with` takes."""
        to_other = ghost.sonar_from_image if from_image else np.linalg.inv(ghost.sonar_from_image)
        other = ghost.seen if from_image else ghost.lookup
        once = 2.0 if self.acoustics.multipath == "coherent" else 1.0

        def add(view, parts, tables, fresh, sums, spans):
            sector, plane_echo, bodies = view
            own = np.eye(4)
            own[:3, :3] = sector.rotation().T
            into = own if not from_image else ghost.sonar_from_image @ own
            up = ghost.ceiling[:3]
            ceiling = np.append(up @ into[:3, :3], ghost.ceiling[3] - up @ into[:3, 3])
            accumulate_ghosts(
                plane_echo,
                bodies,
                sector.u,
                sector.v,
                sector.tan_elevation,
                *parts,
                *tables,
                fresh,
                own[:3],
                (to_other @ own)[:3],
                ceiling,
                from_image,
                once,
                ghost.seen.picture,
                ghost.seen.sectors,
                other.picture,
                other.sectors,
                ghost.plane,
                ghost.mirror.body is not None,
                ghost.mirror.loss,
                sums,
                spans,
            )

        return add

    def close(self):
        """End the reducers' threads."""
        self.own.close()
        self.images.close()
