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
BOTH_WAYS = 3.0  # an echo may meet the mirror on its way out, on its way back, or on both


@dataclass(frozen=True, eq=False)
class Ghost:
    """A mirror that returns something in one ping.

    Attributes
    ----------
    mirror : Mirror
    plane : (4,) normal and offset of it, in the sonar's frame
    ceiling : (4,) likewise of the water's surface, normal up; all zeros if there is none
    sonar_from_image : (4, 4)
    seen : Lookup of what the sonar sees
    image : Pass of the image; views, lookup : what it sees
    """

    mirror: Mirror
    plane: np.ndarray
    ceiling: np.ndarray
    sonar_from_image: np.ndarray
    seen: Lookup
    image: Pass
    views: list
    lookup: Lookup


class Multipath:
    """The mirrors of a run.

    Parameters
    ----------
    passes : Passes of the sonar
    tolerance : mirrors that can return no more than this share of the echo are left out
    """

    def __init__(self, passes: Passes, scene, tolerance: float):
        sonar, acoustics = passes.sonar, passes.acoustics
        self.acoustics, self.tolerance, self.gpu = acoustics, tolerance, passes.gpu
        if sonar.beam_azimuths_deg is not None:
            turned = tuple(-azimuth for azimuth in reversed(sonar.beam_azimuths_deg))
            sonar = replace(sonar, beam_azimuths_deg=turned)
        self.images = Passes(passes.gpu, sonar, acoustics)
        self.wavenumber_rad_m = 2 * math.pi * sonar.frequency_hz / acoustics.sound_speed()
        self.scene, self.mirrors = None, []
        self.look(scene)

    def look(self, scene) -> None:
        """Find the mirrors of a scene, once."""
        if scene is not self.scene:
            self.scene, self.mirrors = scene, find_mirrors(scene, self.wavenumber_rad_m)
            self.brightest = max([float(np.max(body.reflectivity)) for body in scene.bodies], default=0.0)

    def draw(self, now: Pass, poses, wheres) -> list[list[Ghost]]:
        """The ghosts of each of the pings that `now` drew last, from these poses."""
        seen = [lookup(picture) for picture in now.renderer.drawn]
        # half of the samples will do: ghosts are a fraction of the echo, and err by as much of it
        image, found, spots = self.images.of(half_of(now.sampling)), [], []
        for number, (pose, where) in enumerate(zip(poses, wheres, strict=True)):
            where = where or self.gpu.stock.where
            for mirror in self.mirrors:
                plane = self._plane(mirror, pose, where)
                if plane is None or not self._counts(mirror, plane, seen[number], now):
                    continue
                turned = np.eye(4)
                turned[:3, :3] -= 2 * np.outer(plane[:3], plane[:3])
                turned[:3, 3] = 2 * plane[3] * plane[:3]
                sonar_from_image = turned @ FACES
                normal = -sonar_from_image[:3, :3].T @ plane[:3]
                offset = plane[3] - BIAS_M - plane[:3] @ sonar_from_image[:3, 3]
                found.append((number, mirror, plane, self._ceiling(pose), sonar_from_image))
                spots.append((pose @ sonar_from_image, where, np.append(normal, offset)))
        out = [[] for _ in poses]
        if spots:
            image.renderer.turn()
            of_image, wheres, planes = zip(*spots, strict=True)
            image.renderer.render(of_image, wheres, planes=planes)
            n, views = len(image.fan.sectors), list(image.renderer.views())
            for k, (number, *what) in enumerate(found):
                ghost = Ghost(
                    *what, seen[number], image, views[k * n : k * n + n], lookup(image.renderer.drawn[k])
                )
                out[number].append(ghost)
        return out

    def add(self, now: Pass, views, ghosts: list[Ghost], intensity) -> float:
        """Add to a ping's (B, K) intensity; the sum of what was added."""
        whole = 0.0
        for ghost in ghosts:
            reducer = ghost.image.reducer
            intensity += reducer.sum_with(self._adder(ghost, True), ghost.views, now.gain)[::-1]
            intensity += now.reducer.sum_with(self._adder(ghost, False), views, now.gain)
            whole += reducer.total + now.reducer.total
        return whole

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

        def add(view, parts, tables, sums, spans):
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
        self.images.close()
