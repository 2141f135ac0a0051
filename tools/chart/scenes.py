"""Scenes and sonars of the chart, and the truth that judges its methods."""

from __future__ import annotations

import hashlib
import os
import pathlib
import tempfile
import warnings
from dataclasses import replace

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.analysis import rays, reference
from sonar_gl.core.atomic_file import atomic_write
from tools.chart.rivals.slices import Slices
from tools.chart.terrain import finer_floor

BEAMS = {"wide": 1.0, "narrow": 45.0 / 256}  # degrees; narrow ones just touch each other
SCENES = ("pylon", "diver", "ocean_floor", "ocean_floor_1m", "grazing", "tank")
CACHE = pathlib.Path(tempfile.gettempdir()) / f"sonar_gl_chart_{os.getuid()}"


def make_sonar(scene_name: str, beams: str) -> sg.Sonar:
    """Make the chart's sonar: 256 beams over 45 x 20 degrees, 512 bins to 30 m (`grazing`: 60 m)."""
    range_max_m = 60.0 if scene_name == "grazing" else 30.0
    return sg.Sonar("chart", 900e3, 256, 512, 45.0, 20.0, BEAMS[beams], 0.5, range_max_m)


def grazing() -> sg.Scene:
    """Make a flat floor 1 m below, seen at 1 to 3 degrees."""
    mesh = trimesh.Trimesh(
        [(-200, -200, 0), (200, -200, 0), (200, 200, 0), (-200, 200, 0)], [(0, 1, 2), (0, 2, 3)]
    )
    return sg.Scene([sg.Body("floor", mesh, reflectivity=1.0)], sg.pose(0, 0, 1, 0.05, -0.12, 0.3), "grazing")


def tank() -> sg.Scene:
    """Make the inside of a tank, 12 x 8 x 4 m, with a sphere, a box and three pipes 3 cm thick in it."""
    walls = trimesh.creation.box((12, 8, 4))
    walls.invert()

    def pipe(length):
        return trimesh.creation.cylinder(0.015, length, sections=24)

    bodies = [
        sg.Body("walls", walls, sg.pose(0, 0, -2), 0.3),
        sg.Body("sphere", trimesh.creation.icosphere(3, 0.5), sg.pose(1.0, 1.3, -2.6), 0.8),
        sg.Body("box", trimesh.creation.box((0.8, 0.8, 0.8)), sg.pose(3, -0.2, -3.58, yaw=0.5), 0.8),
        sg.Body("upright", pipe(3.9), sg.pose(2.0, -1.2, -2.0), 0.9),
        sg.Body("leaning", pipe(3.0), sg.pose(0.0, 0.3, -2.2, 0.2, 0.1), 0.9),
        sg.Body("level", pipe(5.0), sg.pose(3.9, 0.0, -2.9, np.pi / 2), 0.9),
    ]
    return sg.Scene(bodies, sg.pose(-5.6, 0.2, -1.5, 0, 0.15, 0.02), "tank")


def ocean_floor_1m() -> sg.Scene:
    """Make the ocean floor with a million triangles over the same ground."""
    scene = finer_floor(1_000_000)
    return sg.Scene(scene.bodies, scene.sonar_pose, "ocean_floor_1m")


def make_scene(name: str) -> sg.Scene:
    """Make a scene of the chart, with flat faces: the truth knows no shading normals."""
    made = {"grazing": grazing, "tank": tank, "ocean_floor_1m": ocean_floor_1m}
    scene = made[name]() if name in made else sg.load_scene(name)
    return sg.Scene([replace(body, normals=None) for body in scene.bodies], scene.sonar_pose, scene.name)


def make_truth(scene, sonar, quick: bool = False) -> sg.Ping:
    """Return `sonar_gl.reference_ping` of profile ideal at the scene's own pose, from the folder CACHE.

    meta["difference"] is the difference of its two seeds. Rays do not converge on `grazing`, whose floor has
    a closed form: its truth is 64 slices a beam spacing, judged by half as many.
    """
    if scene.name == "grazing":
        return _from_slices(scene, sonar)
    error, max_rays = (0.01, 20_000_000) if quick else (0.002, 100_000_000)
    mark = hashlib.sha256(f"{sg.__version__} {sonar} {error} {max_rays}".encode())
    for module in (reference, rays):
        mark.update(pathlib.Path(module.__file__).read_bytes())
    for body in scene.bodies:
        for array in (body.mesh.vertices, body.mesh.faces, body.pose, body.reflectivity):
            mark.update(np.ascontiguousarray(array).tobytes())
    mark.update(scene.sonar_pose.tobytes())
    path = CACHE / f"truth_{scene.name}_{mark.hexdigest()[:16]}.npz"
    if not path.exists():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the chart shows the uncertainty that is left
            ping = sg.reference_ping(scene, sonar, scene.sonar_pose, sg.Acoustics.ideal(), error, max_rays)
        path.parent.mkdir(parents=True, exist_ok=True)
        known = {"difference": ping.meta["difference"], "body_echo": ping.body_echo}
        with atomic_write(path) as name:
            np.savez(name, intensity=ping.intensity, **known)
    with np.load(path) as cached:
        return _truth(scene, sonar, cached["intensity"], cached["difference"], cached["body_echo"])


def _truth(scene, sonar, intensity, difference, body_echo) -> sg.Ping:
    made = {"pose": scene.sonar_pose, "meta": {"difference": float(difference)}, "sonar": sonar}
    ping = sg.Ping(intensity, sonar.azimuth_rad, sonar.range_m, **made)
    return replace(ping, body_echo=body_echo)


def _from_slices(scene, sonar) -> sg.Ping:
    fine, coarse = (
        Slices(scene, sonar, sg.Acoustics.ideal(), None, (n, 0)).ping(scene.sonar_pose) for n in (64, 32)
    )
    difference = 2 * np.abs(fine - coarse).sum() / fine.sum()
    return _truth(scene, sonar, fine, difference, np.array([0.0, fine.sum()]))
