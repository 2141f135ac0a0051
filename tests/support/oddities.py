"""Measures of odd meshes, poses and numbers, for the naive methods and for ours."""

import math
import warnings
from dataclasses import replace

import numpy as np
import trimesh

import sonar_gl as sg
from tests.support import naive
from tests.support.regimes import BOX, HERE, SONAR, difference, ping, plate, quad, simulate

BALL = trimesh.creation.icosphere(3, 1.0)


def shading_normals(change):
    """Return (naive, ours): echo of a ball with changed shading normals, relative to unit normals outwards.

    change : function of (V, 3) unit normals. The naive method does not normalize them.
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
    """Return (naive, ours) of a box with duplicate, reversed and degenerate triangles, against the intact box.

    Naive: the number of faces with a NaN normal. Ours: the share of echo in wrong bins.
    """
    v, f = BOX.vertices, np.asarray(BOX.faces)
    points = np.repeat(f[:, :1], 3, axis=1)  # three equal corners
    middle = (v[f[:, 0]] + v[f[:, 1]]) / 2  # three collinear corners
    lines = np.column_stack([f[:, 0], f[:, 1], len(v) + np.arange(len(f))])
    broken = trimesh.Trimesh(
        np.vstack([v, middle]), np.vstack([f, f, f[:, ::-1], points, lines]), process=False
    )
    pose = sg.pose(5, 0.3, 0.2, 0.3, 0.4, 0.5)
    sound, ours = (ping([sg.Body("box", mesh, pose)]).intensity for mesh in (BOX, broken))
    nan = np.isnan(naive.face_normals(broken)).any(axis=1).sum()
    return int(nan), difference(ours, sound)


def coplanar(reflectivities):
    """Return (naive, ours): echo of two coplanar plates over that of a single plate of reflectivity 1.

    The naive method adds the echoes of all faces.
    """
    first, second = (plate(name, 6.0, 2.0, mu) for name, mu in zip("ab", reflectivities, strict=True))
    # other triangles, so that depths are not identical
    fan = trimesh.Trimesh(
        np.vstack([second.mesh.vertices, [[0.3, 0.1, 0]]]),
        [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
        process=False,
    )
    single = ping([replace(first, reflectivity=1.0)]).intensity.sum()
    ours = ping([first, replace(second, mesh=fan)]).intensity.sum()
    return sum(reflectivities), float(ours / single)


def on_a_body(x, y, z):
    """Return (naive, ours) of a sonar on a slab's face, edge or corner that looks at a wall.

    Naive: share of Embree's rays from the sonar that hit the slab. Ours: share of echo in wrong bins, against a
    scene without the slab.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    slab = sg.Body("slab", trimesh.creation.box((4, 4, 1)), sg.pose(0, 0, -0.5))
    wall = sg.Body("wall", trimesh.creation.box((0.5, 40, 40)), sg.pose(8, 0, 0))
    # the lower edge of the aperture is 2 degrees above horizontal
    pose = sg.pose(x, y, z, 0, -math.radians(12), 0)
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
    """Return (naive, ours) of an attitude of the sonar.

    Naive: degrees by which the conversion to Euler angles and back rotates a pose of 9 digits. Ours: share of echo in
    wrong bins when sonar and scene are rotated together.
    """
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
    """Return (naive, ours) of normal incidence.

    Naive: share of surfaces whose incidence by arccos is NaN. Ours: the largest μ cos θ of a ball around the sonar,
    as float32 steps above 1.
    """
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
    """Return (naive, ours): bins of a wall 0.1 mm before and behind range_min and range_max; -1 for none.

    The naive method truncates the quotient. There are 12 bins of 0.5 m, from 2 m to 8 m.
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
    """Return (naive, ours): relative error of the sum of many equal echoes in one bin.

    The naive method adds 40 million float32 values one by one; ours sums a million samples of a ball in one bin.
    """
    count = 40_000_000
    sonar = sg.Sonar("sum", 900e3, 1, 1, 20.0, 20.0, 20.0, 0.5, 20.0)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(6.0, count=[180, 360]), reflectivity=1.0)
    echo = ping([ball], sonar, sampling=sg.Sampling(1000, 1000)).intensity.sum(dtype=np.float64)
    coarse = ping([ball], sonar, sampling=sg.Sampling(100, 100)).intensity.sum(dtype=np.float64)
    return abs(naive.sum_in_sequence(1.0, count) / count - 1), float(abs(echo / coarse - 1))


def order_of_sums():
    """Return (naive, ours): the share of results that are not identical in a second run.

    The naive method adds float32 values in another order, like atomics on a GPU; ours repeats a ping after others.
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
    """Return (naive, ours): the worst beam's relative error inside a ball, whose echo is its reflectivity.

    Many beams have half a sample each, few beams have 20; the naive method adds each column to a single beam.
    """
    sonar = replace(SONAR, n_beams=n_beams, n_bins=n_bins, beam_width_deg=60.0 / n_beams)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=1.0)
    sampling = sg.Sampling(0.5 if n_beams > 100 else 20, 24)
    ours = ping([ball], sonar, sampling=sampling).intensity.sum(axis=1, dtype=np.float64)
    plain = naive.single_view_beams(sonar, sampling.columns_per_beam)
    return float(np.abs(plain - 1).max()), float(np.abs(ours - 1).max())
