"""Random scenes that mix all kinds of surfaces, and what can be done to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.ping import Ping
from sonar_gl.scene import primitives
from tests.support.worlds import random_rotation

SONARS = {
    "upright": sg.Sonar("upright", 900e3, 24, 48, 70.0, 24.0, 4.0, 0.5, 12.5, transmit_width_deg=60.0),
    "cones": sg.Sonar(
        "cones",
        900e3,
        24,
        48,
        110.0,
        20.0,
        5.0,
        0.5,
        12.5,
        beam_spacing="sine",
        steered="straight",
        tilt_deg=12.0,
    ),
    "all round": sg.Sonar("all round", 900e3, 36, 48, 360.0, 30.0, 10.0, 0.5, 12.5, bandwidth_hz=20e3),
}
RANGE_M = 12.0


@dataclass(frozen=True)
class MixedScene:
    """A scene with a sonar in it.

    samples : `sampling` or `tolerance` of the simulator
    """

    bodies: tuple[sg.Body, ...]
    sonar: sg.Sonar
    acoustics: sg.Acoustics
    pose: np.ndarray
    samples: dict
    engine: str = "cpu"

    def simulator(self, bodies=None) -> sg.Simulator:
        """Return a simulator of it, or of other bodies in it."""
        scene = sg.Scene(self.bodies if bodies is None else bodies)
        return sg.Simulator(scene, self.sonar, self.acoustics, engine=self.engine, **self.samples)

    def ping(self, bodies=None, **more) -> Ping:
        """Return a labelled ping from its pose."""
        with self.simulator(bodies) as simulator:
            return simulator.ping(self.pose, labels=True, **more)

    def moved(self, world_from_world: np.ndarray) -> MixedScene:
        """Return the same scene elsewhere, with its sonar."""
        bodies = tuple(replace(body, pose=world_from_world @ body.pose) for body in self.bodies)
        return replace(self, bodies=bodies, pose=world_from_world @ self.pose)

    def mirrored(self, axis: int) -> MixedScene:
        """Return the scene mirrored along an axis of the sonar's head: 1 swaps port and starboard, 2 up and down."""
        signs = np.ones(4)
        signs[axis] = -1
        head = self.sonar.head_pose(self.pose)
        world_from_mirrored = head @ np.diag(signs) @ np.linalg.inv(head)
        return replace(self, bodies=tuple(_mirrored_body(body, world_from_mirrored) for body in self.bodies))


def with_mesh(body: sg.Body, vertices, faces, reflectivity=None, normals=None, name=None) -> sg.Body:
    """Return a body of other vertices and faces; what is left out is as before."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mu = body.reflectivity if reflectivity is None else reflectivity
    return replace(body, name=name or body.name, mesh=mesh, reflectivity=mu, normals=normals)


def _mirrored_body(body: sg.Body, world_from_mirrored: np.ndarray) -> sg.Body:
    flip = np.diag([1.0, -1.0, 1.0, 1.0])  # of the mesh, so that the pose stays a rotation
    normals = None if body.normals is None else body.normals @ flip[:3, :3].astype(np.float32)
    vertices = np.asarray(body.surface.vertices) @ flip[:3, :3]
    one = with_mesh(body, vertices, np.asarray(body.surface.faces)[:, ::-1], normals=normals)
    return replace(one, pose=world_from_mirrored @ body.pose @ flip)


def _random_mesh(rng, kind: str, size_m: float) -> tuple[trimesh.Trimesh, np.ndarray | None]:
    if kind == "smooth":
        return primitives.cylinder(size_m / 3, size_m)
    if kind == "soup":
        corners = rng.normal(0, size_m / 2, (30, 3))
        return trimesh.Trimesh(corners, np.arange(30).reshape(-1, 3), process=False), None
    if kind == "sheet":
        corners = size_m * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), None
    make = {"box": lambda: trimesh.creation.box(size_m * rng.uniform(0.4, 1.2, 3))}
    make["ball"] = lambda: trimesh.creation.icosphere(2, size_m / 2)
    make["rod"] = lambda: trimesh.creation.cylinder(0.05, 2 * size_m, sections=8)
    return make[kind](), None


def random_body(rng, name: str, sonar: sg.Sonar) -> sg.Body:
    """Return a body in the fan of a head at the origin: with one reflectivity or one per face, some with a lobe."""
    kind = str(rng.choice(["smooth", "soup", "sheet", "box", "ball", "rod"]))
    range_m = RANGE_M * rng.uniform(0.2, 0.95)
    mesh, normals = _random_mesh(rng, kind, range_m * rng.uniform(0.1, 0.3))
    azimuth, elevation = (
        np.radians(fov / 2) * rng.uniform(-0.9, 0.9)
        for fov in (sonar.azimuth_fov_deg, sonar.elevation_fov_deg)
    )
    pose = random_rotation(rng)
    pose[:3, 3] = range_m * np.array([np.cos(azimuth), np.sin(azimuth), np.sin(elevation)])
    mu = rng.uniform(0.1, 0.7, len(mesh.faces)) if rng.random() < 0.3 else rng.uniform(0.1, 0.7)
    lobe = {"specular": 0.3, "roughness_rad": 0.2} if rng.random() < 0.3 else {}
    return sg.Body(name, mesh, pose, mu, normals, **lobe)


def mixed_scene(seed: int, family: str, acoustics: sg.Acoustics | None = None, **samples) -> MixedScene:
    """Return the scene of a seed: some bodies and a floor, before a sonar at a random place.

    family : key of SONARS
    samples : `sampling` or `tolerance`; without any a coarse sampling
    """
    rng, sonar = np.random.default_rng([seed, 90]), SONARS[family]
    bodies = [random_body(rng, f"body {number}", sonar) for number in range(4)]
    floor = trimesh.creation.box((60.0, 60.0, 1.0))
    bodies.append(sg.Body("floor", floor, sg.pose(0, 0, -1.7, *rng.uniform(-0.1, 0.1, 2), 1.0), 0.4))
    samples = samples or {"sampling": sg.Sampling(2, 40)}
    here = MixedScene(tuple(bodies), sonar, acoustics or sg.Acoustics.physical(), np.eye(4), samples)
    here = replace(here, pose=np.linalg.inv(sonar.sonar_from_head))
    turned = random_rotation(rng)
    turned[:3, 3] = rng.uniform(-50, 50, 3)
    return here.moved(turned)


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """Return the share of the echo by which two images differ."""
    one, other = one.astype(np.float64), other.astype(np.float64)
    return float(np.abs(one - other).sum() / max(one.sum(), other.sum()))
