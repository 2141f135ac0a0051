"""Measures of odd meshes, poses and numbers: what the naive way makes of each, and what ours does."""

import math
import warnings
from dataclasses import replace

import naive
import numpy as np
import trimesh
from regimes import BOX, HERE, SONAR, difference, ping, plate, quad, simulate

import sonar_gl as sg

BALL = trimesh.creation.icosphere(3, 1.0)


def shading_normals(change):
    """(naive, ours): echo of a ball with changed shading normals, over that with unit ones outwards.

    change : function of (V, 3) unit normals. Naive takes the cosine of the normals as they come.
    """
    normals = np.asarray(BALL.vertex_normals)
    ball = sg.Body("ball", BALL, sg.pose(5), 0.5, normals)
    changed = replace(ball, normals=change(normals))
    toward = BALL.vertices + np.array([5, 0, 0])
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    lit = naive.lambert(normals, toward) > 0
    plain = [naive.lambert(n, toward)[lit].sum() for n in (normals, change(normals))]
    return float(plain[1] / plain[0]), float(ping([changed]).intensity.sum() / ping([ball]).intensity.sum())


def broken_triangles():
    """(naive, ours): a box with triangles twice, inside out, and without area, against the sound box.

    Naive: faces whose normal is not a number. Ours: echo in wrong bins.
    """
    v, f = BOX.vertices, np.asarray(BOX.faces)
    points = np.repeat(f[:, :1], 3, axis=1)  # three corners in one place
    middle = (v[f[:, 0]] + v[f[:, 1]]) / 2  # three corners in one line
    lines = np.column_stack([f[:, 0], f[:, 1], len(v) + np.arange(len(f))])
    broken = trimesh.Trimesh(
        np.vstack([v, middle]), np.vstack([f, f, f[:, ::-1], points, lines]), process=False
    )
    pose = sg.pose(5, 0.3, 0.2, 0.3, 0.4, 0.5)
    sound, ours = (ping([sg.Body("box", mesh, pose)]).intensity for mesh in (BOX, broken))
    nan = np.isnan(naive.face_normals(broken)).any(axis=1).sum()
    return int(nan), difference(ours, sound)


def coplanar(reflectivities):
    """(naive, ours): echo of two plates in one place over that of the first one alone, were it to read 1.

    Naive adds what every face returns.
    """
    first, second = (plate(name, 6.0, 2.0, mu) for name, mu in zip("ab", reflectivities, strict=True))
    # another cut into triangles, so that depths are not the same to the bit
    fan = trimesh.Trimesh(
        np.vstack([second.mesh.vertices, [[0.3, 0.1, 0]]]),
        [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
        process=False,
    )
    whole = ping([replace(first, reflectivity=1.0)]).intensity.sum()
    ours = ping([first, replace(second, mesh=fan)]).intensity.sum()
    return sum(reflectivities), float(ours / whole)


def on_a_body(x, y, z):
    """(naive, ours): a sonar on a slab's face, edge or corner, looking away from it, at a wall.

    Naive: share of Embree's rays, begun at the sonar itself, that meet the slab they stand on. Ours: echo in
    wrong bins against the same without the slab.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    slab = sg.Body("slab", trimesh.creation.box((4, 4, 1)), sg.pose(0, 0, -0.5))
    wall = sg.Body("wall", trimesh.creation.box((0.5, 40, 40)), sg.pose(8, 0, 0))
    pose = sg.pose(x, y, z, 0, -math.radians(12), 0)  # the aperture's lower edge is 2 degrees above level
    ours = difference(ping([slab, wall], pose=pose).intensity, ping([wall], pose=pose).intensity)
    scene = EmbreeScene()
    triangles = (slab.mesh.vertices + np.array([0, 0, -0.5]))[slab.mesh.faces]
    keep = TriangleMesh(scene, np.ascontiguousarray(triangles, np.float32))
    azimuth, elevation = np.meshgrid(np.radians(np.linspace(-30, 30, 64)), np.radians(np.linspace(2, 22, 32)))
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    rays = np.ascontiguousarray(rays.reshape(3, -1).T, np.float32)
    hit = scene.run(np.broadcast_to(np.float32([x, y, z]), rays.shape).copy(), rays)
    del keep
    return float((hit >= 0).mean()), ours


def attitude(roll, pitch, yaw):
    """(naive, ours): naive, degrees by which a pose turns when it goes through Euler angles and back, its
    matrix written with 9 digits; ours, echo in wrong bins when sonar and scene are turned together."""
    pose = sg.pose(1, 2, 3, roll, pitch, yaw)
    again = sg.pose(1, 2, 3, *naive.euler(pose.round(9) + 0.0))
    cosine = (np.trace(pose[:3, :3].T @ again[:3, :3]) - 1) / 2
    bodies = [
        sg.Body("floor", trimesh.creation.box((40, 40, 1)), sg.pose(0, 0, -2.5), 0.3),
        sg.Body("box", BOX, sg.pose(6, 1, -1.5, 0.1, 0.2, 0.3), 0.8),
    ]
    turned = [replace(body, pose=pose @ body.pose) for body in bodies]
    ours = difference(ping(turned, pose=pose).intensity, ping(bodies).intensity)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), ours


def cosine_above_one():
    """(naive, ours): share of surfaces met head on whose incidence is not a number by arccos; and the
    largest μ cos θ less 1 of a ball about the sonar, in float32's steps above 1."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(10_000, 3)).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        nan = np.isnan(np.arccos(naive.lambert(-d, d))).mean()
    ball = sg.Body("ball", trimesh.creation.icosphere(4, 5.0), reflectivity=1.0)
    normals = -np.asarray(ball.mesh.vertices) / 5
    with simulate([replace(ball, normals=normals)], replace(SONAR, elevation_fov_deg=90.0)) as simulator:
        top = max(buffer.echo.max() for buffer in simulator.gbuffers(HERE))
    return float(nan), float((top - 1) / np.finfo(np.float32).eps)


def bin_ends():
    """(naive, ours): bins of a wall 0.1 mm before and behind range_min, and likewise range_max; -1 is none.

    Naive truncates the quotient. Bins are of 0.5 m, 2 m to 8 m: K = 12.
    """
    sonar = sg.Sonar("ends", 900e3, 1, 12, 0.1, 0.1, 0.1, 2.0, 8.0)
    ranges = (1.9999, 2.0001, 7.9999, 8.0001)
    ours = []
    for range_m in ranges:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            echo = ping([plate("wall", range_m, 5.0)], sonar).intensity[0]
        ours.append(int(echo.argmax()) if echo.any() else -1)
    return [naive.bin_of(range_m, sonar) for range_m in ranges], ours


def long_sums():
    """(naive, ours): relative error of very many equal echoes in one bin.

    Naive adds 40 million in float32, one by one; ours a million samples of a ball's wall in one bin.
    """
    count = 40_000_000
    sonar = sg.Sonar("sum", 900e3, 1, 1, 20.0, 20.0, 20.0, 0.5, 20.0)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(6.0, count=[180, 360]), reflectivity=1.0)
    echo = ping([ball], sonar, sampling=sg.Sampling(1000, 1000)).intensity.sum(dtype=np.float64)
    coarse = ping([ball], sonar, sampling=sg.Sampling(100, 100)).intensity.sum(dtype=np.float64)
    return abs(naive.sum_in_sequence(1.0, count) / count - 1), float(abs(echo / coarse - 1))


def order_of_sums():
    """(naive, ours): results that differ to the bit when the same is done again.

    Naive adds the same float32 in another order, as atomics on a GPU do; ours makes the same ping again,
    other pings between.
    """
    rng = np.random.default_rng(0)
    echoes = rng.random((64, 4096), np.float32)
    shuffled = rng.permuted(echoes, axis=1)
    differ = np.cumsum(echoes, axis=1)[:, -1] != np.cumsum(shuffled, axis=1)[:, -1]
    floor = sg.Body("floor", quad(100), sg.pose(0, 0, -3))
    with simulate([floor]) as simulator:
        a = simulator.ping(HERE).intensity
        simulator.ping(sg.pose(0, 0, 1))
        b = simulator.ping(HERE).intensity
    return float(differ.mean()), float((a != b).mean())


def many_beams_and_bins(n_beams, n_bins):
    """(naive, ours): worst beam's relative error inside a ball, which reads its reflectivity in all beams.

    Half a sample a beam where beams are many, two where they are not; naive drops each column whole into one
    beam.
    """
    sonar = replace(SONAR, n_beams=n_beams, n_bins=n_bins, beam_width_deg=60.0 / n_beams)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=1.0)
    sampling = sg.Sampling(0.5 if n_beams > 100 else 20, 24)
    ours = ping([ball], sonar, sampling=sampling).intensity.sum(axis=1, dtype=np.float64)
    seen = naive.single_view_beams(sonar, sampling.columns_per_beam)
    return float(np.abs(seen - 1).max()), float(np.abs(ours - 1).max())
