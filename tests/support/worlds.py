"""Random worlds on which the tolerance is tested."""

from __future__ import annotations

import dataclasses

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.scene import primitives


def random_rotation(rng) -> np.ndarray:
    """Return a uniformly distributed rotation, (4, 4)."""
    return trimesh.transformations.random_rotation_matrix(rng.random(3))


def terrain(rng, size_m: float, relief_m: float, n: int = 96) -> trimesh.Trimesh:
    """Return a square of hills, a sum of waves with random directions and amplitudes proportional to their lengths."""
    x = np.linspace(-size_m / 2, size_m / 2, n)
    x, y = np.meshgrid(x, x, indexing="ij")
    z = np.zeros_like(x)
    for octave in range(5):
        for _ in range(4):
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            k = 2 * np.pi * 2**octave / size_m
            z += 0.5**octave * np.sin(k * (x * np.cos(angle) + y * np.sin(angle)) + phase)
    z *= relief_m / np.ptp(z)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return trimesh.Trimesh(np.stack([x, y, z], -1).reshape(-1, 3), faces, process=False)


def random_body(rng, number: int, range_m: float, sonar: sg.Sonar) -> sg.Body:
    """Return a box, cylinder, rod, sphere or torus in the fan, with a size of up to a third of its range."""
    r = range_m * rng.uniform(0.08, 0.95)
    half = np.radians(sonar.azimuth_fov_deg) / 2, np.radians(sonar.elevation_fov_deg) / 2
    psi, phi = rng.uniform(-half[0], half[0]), rng.uniform(-half[1], half[1])
    place = r * np.array([np.cos(phi) * np.cos(psi), np.cos(phi) * np.sin(psi), np.sin(phi)])
    size = r * 10 ** rng.uniform(-1.7, -0.5)
    kind = rng.choice(["box", "cylinder", "rod", "sphere", "torus"])
    if kind == "box":
        mesh = trimesh.creation.box(size * rng.uniform(0.2, 1.5, 3))
    elif kind == "cylinder":
        mesh = trimesh.creation.cylinder(
            size * rng.uniform(0.1, 0.6), size * rng.uniform(0.5, 2), sections=64
        )
    elif kind == "rod":
        mesh = trimesh.creation.cylinder(10 ** rng.uniform(-2, -1), size * rng.uniform(1, 5), sections=24)
    elif kind == "sphere":
        mesh = trimesh.creation.icosphere(4, size / 2)
    else:
        mesh = trimesh.creation.torus(size / 2, size * rng.uniform(0.05, 0.2), 64, 24)
    pose = random_rotation(rng)
    if rng.random() < 0.3:  # upright and level bodies are common, and hard
        pose = (
            np.eye(4) if rng.random() < 0.5 else trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
        )
    pose[:3, 3] = place
    return sg.Body(f"{kind} {number}", mesh, pose, reflectivity=rng.uniform(0.1, 1.0))


def random_world(seed: int):
    """Return (scene, sonar, pose) of a seed; nearly all of these worlds return an echo."""
    rng = np.random.default_rng(seed)
    range_m = 10 ** rng.uniform(1, 2)
    fov = rng.uniform(30, 130)
    n_beams = int(rng.choice([64, 128, 256, 512]))
    sonar = sg.Sonar(
        name=f"random {seed}",
        frequency_hz=900e3,
        n_beams=n_beams,
        n_bins=int(rng.choice([200, 400, 512, 800])),
        azimuth_fov_deg=fov,
        elevation_fov_deg=rng.uniform(10, 30),
        beam_width_deg=max(fov / n_beams, float(rng.choice([0.2, 0.5, 1.0, 1.5]))),
        range_min_m=0.5,
        range_max_m=range_m,
    )
    bodies = [random_body(rng, number, range_m, sonar) for number in range(rng.integers(1, 9))]
    ground = rng.choice(["none", "floor", "terrain"])
    if ground != "none":
        depth = range_m * rng.uniform(0.05, 0.3)
        mesh = (
            trimesh.creation.box((6 * range_m, 6 * range_m, 1))
            if ground == "floor"
            else terrain(rng, 3 * range_m, depth * rng.uniform(0.2, 1.0))
        )
        tilt = sg.pose(0, 0, -depth - 0.5, rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(-3, 3))
        bodies.append(sg.Body(str(ground), mesh, tilt, reflectivity=rng.uniform(0.1, 1.0)))
    # bodies were placed for a level fan; now the world is rotated and moved, and the sonar turned a little more
    world = random_rotation(rng)
    world[:3, 3] = rng.uniform(-100, 100, 3)
    bodies = [sg.Body(b.name, b.mesh, world @ b.pose, b.reflectivity) for b in bodies]
    turn = sg.pose(0, 0, 0, rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.15), rng.uniform(-0.3, 0.3))
    return sg.Scene(bodies, name=f"world {seed}"), sonar, world @ turn


def random_lone_body(seed: int):
    """Return (scene, sonar, pose) of a seed: a sphere, a pile, a capsule or an ellipsoid alone in open water."""
    rng = np.random.default_rng([seed, 78])
    sonar = sg.Sonar("small", 900e3, 64, 200, 45.0, 20.0, 1.0, 0.5, 12.0)
    kind, is_turned, radius_m, length_m = (
        rng.integers(4),
        rng.random() < 0.5,
        rng.uniform(0.03, 0.3),
        rng.uniform(0.5, 6),
    )
    mesh = (
        trimesh.creation.icosphere(5, radius_m),
        trimesh.creation.cylinder(radius_m, length_m, sections=96),
        trimesh.creation.capsule(length_m / 3, radius_m),
        trimesh.creation.icosphere(5).apply_scale(rng.uniform(0.05, 0.5, 3)),
    )[kind]
    pose = sg.pose(yaw=rng.uniform(-0.3, 0.3)) @ sg.pose(rng.uniform(1.5, 9), 0.0, rng.uniform(-0.3, 0.3))
    pose = pose @ sg.pose(0, 0, 0, *is_turned * rng.uniform(-0.8, 0.8, 2))
    return sg.Scene([sg.Body("body", mesh, pose)], name=f"lone body {seed}"), sonar, np.eye(4)


def _bottle(radius_m: float, length_m: float) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return a bottle about the z axis, and its shading normals."""
    z = np.linspace(0, 1, 60)
    radii = np.interp(z, [0.0, 0.03, 0.55, 0.75, 1.0], [0.92, 1.0, 1.0, 0.4, 0.35])
    radii = np.convolve(np.pad(radii, 3, mode="edge"), np.ones(7) / 7, mode="valid")  # without edges
    side = np.column_stack([radii * radius_m, z * length_m])
    mesh = trimesh.creation.revolve(np.vstack([[0, 0], side, [0, length_m]]), sections=48)
    return mesh, mesh.vertex_normals


def random_smooth_body(seed: int):
    """Return (scene, sonar, pose) of a seed: a smooth sphere, pipe, capsule, ellipsoid or bottle on a floor of sand."""
    rng = np.random.default_rng([seed, 79])
    sonar = sg.Sonar("small", 900e3, 128, 400, 60.0, 20.0, 1.0, 0.5, 15.0)
    radius_m, length_m = 10 ** rng.uniform(-1.5, -0.7), rng.uniform(0.2, 1.2)
    mesh, normals = (
        primitives.sphere(radius_m),
        primitives.cylinder(radius_m, length_m),
        primitives.capsule(radius_m, length_m),
        primitives.ellipsoid(radius_m * rng.uniform(0.5, 2.0, 3)),
        _bottle(radius_m, 6 * radius_m),
    )[rng.integers(5)]
    turn = (  # upright, lying, or any other way
        sg.pose(0, 0, 0, *rng.normal(0, 0.1, 2)),
        sg.pose(yaw=rng.uniform(-np.pi, np.pi)) @ sg.pose(pitch=np.pi / 2),
        random_rotation(rng),
    )[rng.integers(3)]
    distance_m, azimuth_rad = rng.uniform(2.0, 12.0), rng.uniform(-0.4, 0.4)
    height_m = distance_m * rng.uniform(0.03, 0.15)
    lowest_m = (mesh.vertices @ turn[:3, :3].T)[:, 2].min()
    place = distance_m * np.cos(azimuth_rad), distance_m * np.sin(azimuth_rad), -height_m - lowest_m
    material = str(rng.choice(["glass", "steel", "aluminium"]))
    floor = sg.Body("floor", trimesh.creation.box((100, 100, 1)), sg.pose(0, 0, -height_m - 0.5), "sand")
    body = sg.Body("body", mesh, sg.pose(*place) @ turn, material, normals)
    return sg.Scene([floor, body], name=f"smooth body {seed}"), sonar, sg.pose(pitch=0.1)


POOL_SONARS = (
    "p900-45",
    "p900-130",
    "m450",
    "oculus-m750d-lf",
    "gemini-720is",
    "gemini-720im",
    "aris-1800-lf",
    "didson-lf",
    "sonoptix-echo",
    "kongsberg-m3",
)


def random_pool(seed: int):
    """Return (scene, sonar, pose, acoustics) of a seed: a calm surface above some of a floor, a wall and small bodies.

    Multipath returns between nothing and a hundred times the direct echo.
    """
    rng = np.random.default_rng([seed, 77])
    sonar = sg.load_sonar(str(rng.choice(POOL_SONARS)))
    range_m = min(sonar.range_max_m, 10 ** rng.uniform(0.7, 1.3))
    depth, bodies, half_fov = range_m * rng.uniform(0.05, 0.4), [], np.radians(sonar.azimuth_fov_deg) / 2
    if rng.random() < 0.7:
        mesh = trimesh.creation.box((6 * range_m, 6 * range_m, 1))
        bodies.append(sg.Body("floor", mesh, sg.pose(0, 0, -depth - 0.5), rng.uniform(0.05, 1)))
    if rng.random() < 0.7:
        r, azimuth = range_m * rng.uniform(0.3, 0.9), rng.uniform(-0.8, 0.8)
        place = r * np.cos(azimuth), r * np.sin(azimuth), -depth
        mesh, turn = trimesh.creation.box((0.3, 4 * range_m, 2 * depth)), azimuth + rng.uniform(-0.5, 0.5)
        bodies.append(sg.Body("wall", mesh, sg.pose(*place, yaw=turn), rng.uniform(0.05, 1)))
    for number in range(rng.integers(0 if bodies else 1, 5)):
        r, azimuth = range_m * rng.uniform(0.1, 0.9), rng.uniform(-half_fov, half_fov)
        size = r * 10 ** rng.uniform(-1.7, -0.5)
        mesh = (
            trimesh.creation.icosphere(3, size / 2),
            trimesh.creation.box((size, size / 2, 1.4 * size)),
            trimesh.creation.cylinder(0.2 * size, 2 * size, sections=24),
        )[rng.integers(3)]
        place = r * np.cos(azimuth), r * np.sin(azimuth), -depth * rng.uniform(0.1, 1)
        pose = sg.pose(*place, *rng.uniform(-0.5, 0.5, 3))
        bodies.append(sg.Body(f"body {number}", mesh, pose, rng.uniform(0.1, 1)))
    roughness_m = float(rng.choice([0.0, 1e-4]))
    scene = sg.Scene(bodies, surface_z_m=0.0, surface_roughness_m=roughness_m, name=f"pool {seed}")
    turn = rng.uniform(-0.1, 0.1), rng.uniform(-0.3, 0.25), rng.uniform(-0.2, 0.2)
    acoustics = sg.Acoustics.physical() if rng.random() < 0.5 else sg.Acoustics.ideal()
    acoustics = dataclasses.replace(acoustics, multipath=str(rng.choice(["incoherent", "coherent"])))
    head = sg.pose(0, 0, -depth * rng.uniform(0.15, 0.85), *turn)
    return scene, sonar.with_range(float(range_m)), head, acoustics


def rods_before_a_wall(seed: int) -> tuple[sg.Scene, float]:
    """Return thin rods and small balls, with or without a wall behind them, and a tolerance to try.

    Half of the rods are near the slope of the lattice's rows, or of their mirror image, which is 10 degrees for
    `ROD_SONAR`: samples meet such a rod all along, or not at all.
    """
    rng = np.random.default_rng([seed, 5])
    tolerance, side, bodies = float(rng.choice([0.1, 0.05, 0.02])), rng.choice([-1, 1]), []
    for number in range(3):
        x = rng.uniform(4, 14)
        y, z = (0.1 * number - 0.1) * x, rng.uniform(-0.12, 0.12) * x
        roll = (
            rng.uniform(0, np.pi) if rng.random() < 0.5 else np.pi / 2 + np.radians(side * rng.uniform(0, 15))
        )
        if rng.random() < 0.3:
            mesh = trimesh.creation.icosphere(3, 10 ** rng.uniform(-2, -0.8))
        else:
            radius = 10 ** rng.uniform(-2.7, -1.5)
            mesh = trimesh.creation.cylinder(radius, rng.uniform(0.02, 0.3) * x, sections=12)
        bodies.append(sg.Body(f"body {number}", mesh, sg.pose(x, y, z, roll=roll), rng.uniform(0.3, 1)))
    if rng.random() < 0.7:
        wall = trimesh.creation.box((1, 30, 30))
        bodies.append(sg.Body("wall", wall, sg.pose(15.5), 10 ** rng.uniform(-2, -1)))
    return sg.Scene(bodies), tolerance


def wires_before_a_wall(seed: int) -> tuple[sg.Scene, float]:
    """Return a grating or a net of thin bars, one body, before a bright wall, and a tolerance to try."""
    rng = np.random.default_rng([seed, 6])
    tolerance, kind = float(rng.choice([0.05, 0.02, 0.01])), rng.choice(["upright", "level", "both"])
    x, radius = rng.uniform(3, 13), 10 ** rng.uniform(-3, -2)
    spacing = max(10 ** rng.uniform(-1.5, -0.7), 4 * radius)
    width, height = rng.uniform(0.05, 0.25, 2) * x
    bars = []
    for length, across, turn in ((height, width, 0.0), (width, height, np.pi / 2)):
        if kind == ("level" if turn == 0 else "upright"):
            continue
        for place in np.arange(-across / 2, across / 2, spacing):
            bar = trimesh.creation.box((2 * radius, 2 * radius, length))
            bar.apply_transform(sg.pose(0, place, 0))
            bars.append(bar.apply_transform(sg.pose(roll=turn)))
    turned = rng.choice([0.0, 0.05, 0.5]) * rng.uniform(-1, 1, 3)
    net = sg.Body("net", trimesh.util.concatenate(bars), sg.pose(x, *rng.uniform(-0.3, 0.3, 2), *turned))
    wall = sg.Body("wall", trimesh.creation.box((1, 30, 30)), sg.pose(15.5), 10 ** rng.uniform(-1, 0))
    return sg.Scene([net, wall]), tolerance


ROD_SONAR = sg.Sonar("narrow", 900e3, 24, 160, 18.0, 18.0, 2.0, 0.5, 16.5)
