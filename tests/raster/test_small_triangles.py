"""Software rasterization of small triangles gives the driver's samples, except on edges of triangles."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.raster import buffers, scene_meshes, small_triangles
from sonar_gl.raster import level_of_detail as detail
from sonar_gl.raster.cull import SectorGeometry
from sonar_gl.raster.draw_list import SectorView
from sonar_gl.scene import primitives
from sonar_gl.sonar.fan import NEAR_M
from tests.support.worlds import random_world, terrain

SAMPLING = sg.Sampling(1, 100)
SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.0, 0.5, 20.0)
# Samples this near an edge may go to either side: the driver snaps corners to 1/256 along columns and rows, which
# moves them by up to 0.0028 along a diagonal.
ON_EDGE = 0.0029


@pytest.fixture
def draw_sectors(monkeypatch):
    """Return a function that draws whole sectors: (sector, plane and echo, bodies) of each."""

    def draw(scene, sonar, pose, rasterizes, sampling=SAMPLING):
        monkeypatch.setattr(buffers, "is_software", lambda _: rasterizes)
        with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sampling) as simulator:
            run = simulator.run
            with run.drawing():
                renderer = run.sampler.resolution.stage.renderer
                (view,) = renderer.render([pose], with_bodies=True, full=True)
                # OpenGL does not define the body number of an empty sample
                return [(s, p.copy(), np.where(p[..., 0] > 0, b, 0)) for s, p, b in view.sectors]

    return draw


def project_vertices(scene, pose, sector):
    """Yield the vertices of each body as (V, 3) column times x, row times x, and x, with x ahead of the sector."""
    view = SectorGeometry(*SectorView(sector).geometry)
    for body in scene.bodies:
        m = np.linalg.inv(pose)
        m = np.column_stack([m[:3, :3] @ body.pose[:3, :3], m[:3, :3] @ (body.pose[:3, 3] - pose[:3, 3])])
        x, y, z = view.rotation @ (m[:, :3] @ np.asarray(body.mesh.vertices).T + m[:, 3:])
        yield np.column_stack([(view.inverse @ (np.stack([-y, z]) - np.outer(view.corner, x))).T, x])


def edges_of(scene, pose, sector):
    """Return the edges of triangles on the image, (E, 2, 2), clipped at the near plane."""
    out = []
    for body, at in zip(scene.bodies, project_vertices(scene, pose, sector), strict=True):
        faces = np.asarray(body.mesh.faces)
        edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        a, b = at[edges[:, 0]], at[edges[:, 1]]
        in_front = (a[:, 2] >= NEAR_M) | (b[:, 2] >= NEAR_M)
        a, b = a[in_front], b[in_front]
        for one, other in ((a, b), (b, a)):
            behind = one[:, 2] < NEAR_M
            t = (NEAR_M - one[behind, 2]) / (other[behind, 2] - one[behind, 2])
            one[behind] += t[:, None] * (other[behind] - one[behind])
        out.append(np.stack([a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:]], axis=1))
    return np.concatenate(out)


def distance_from_edges(samples, edges):
    """Return the distance of (row, column) samples from the nearest edge."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    square = np.maximum((along * along).sum(axis=1), 1e-30)
    found = []
    for row, column in samples:
        apart = (column, row) - start
        t = np.clip((apart * along).sum(axis=1) / square, 0, 1)
        found.append(np.linalg.norm(apart - t[:, None] * along, axis=1).min())
    return np.array(found)


def check_same(scene, pose, rasterised, drawn, on_edge=ON_EDGE, rounding=2e-6):
    """Check that images agree except on edges; return the numbers of hits and of samples that differ."""
    hits, others = 0, 0
    for (sector, here, body), (_, there, other) in zip(rasterised, drawn, strict=True):
        hit, met = here[..., 0] > 0, there[..., 0] > 0
        # a few float32 roundings of 6e-8; snapping a corner by 1/256 of a sample changes 1/x by that part of its
        # slope, and by twice as much on slivers
        slope = np.abs(there[..., 1]) * sector.u[1] + np.abs(there[..., 2]) * sector.v[2]
        same = np.abs(here[..., 0] - there[..., 0]) <= rounding * there[..., 0] + slope / 128
        # slopes are differences of two neighbouring float32 values of 1/x
        same &= np.abs(here[..., 3] - there[..., 3]) <= 0.01 * there[..., 3] + 1e-6
        same &= body == other
        same |= ~hit & ~met
        odd = np.argwhere(~same)
        if len(odd):
            assert distance_from_edges(odd, edges_of(scene, pose, sector)).max() <= on_edge
        hits, others = hits + int(met.sum()), others + len(odd)
    return hits, others


@pytest.mark.parametrize("seed", range(100, 112))
def test_random_worlds(draw_sectors, seed):
    """Every second world is rolled."""
    scene, sonar, pose = random_world(seed)
    pose = pose @ sg.pose(roll=0.7) if seed % 2 else pose
    hits, others = check_same(
        scene, pose, *(draw_sectors(scene, sonar, pose, here) for here in (True, False))
    )
    # Strips of 0.006 samples around edges hold up to 1 % of the samples where triangles are one or two samples wide,
    # and up to 4 of the few hundred samples of a rod.
    assert others <= 4 + 0.01 * hits


@pytest.mark.parametrize("name", ["pylon", "diver", "diver_vertical"])
def test_bundled_scenes(draw_sectors, name):
    """Scenes with shading normals; the samples that differ do not change the sum of the echo."""
    scene, sonar = sg.load_scene(name), sg.load_sonar("p900-45")
    rasterised, drawn = (draw_sectors(scene, sonar, scene.sonar_pose, here) for here in (True, False))
    hits, others = check_same(scene, scene.sonar_pose, rasterised, drawn)
    assert hits > 200
    assert others <= 4 + 0.01 * hits
    sums = [
        sum(float(plane_echo[..., 3].sum()) for _, plane_echo, _ in views) for views in (rasterised, drawn)
    ]
    # samples on edges fall to both sides equally often
    assert sums[0] == pytest.approx(sums[1], rel=2e-3)


def ball(name, at, reflectivity=0.5, radius=1.0, smooth=False):
    mesh = trimesh.creation.icosphere(3, radius)
    normals = np.asarray(mesh.vertices, np.float32) / np.float32(radius) if smooth else None
    return sg.Body(name, mesh, at, reflectivity, normals)


def floor(width=400.0, at=-2.0):
    return sg.Body("floor", primitives.plane(size=(width, width))[0], sg.pose(z=at, roll=0.02, yaw=0.3), 0.4)


def worlds():
    """Yield hard cases for the rasterization: (name, bodies, sonar, pose)."""
    wide = sg.Sonar("wide", 900e3, 128, 200, 250.0, 30.0, 2.0, 0.5, 20.0)
    n = len(trimesh.creation.icosphere(3).faces)
    patchy = np.random.default_rng(0).uniform(0.1, 1.0, n)
    far = np.array([500_000.0, 4_500_000.0, -30.0])
    ring = [ball(str(k), sg.pose(6 * np.cos(k), 6 * np.sin(k), 0.1 * k)) for k in range(-2, 3)]
    tube = trimesh.creation.cylinder(0.4, 2000.0, sections=48)
    across = sg.pose(8, 3, -0.5, roll=np.pi / 2)
    hull = trimesh.creation.icosphere(4, 9.0)
    fence = trimesh.creation.box((30, 0.2, 0.2)).subdivide_to_size(0.5)
    yield "wide", [*ring, floor()], wide, np.eye(4)
    yield "rolled", [*ring, floor()], wide, sg.pose(roll=2.0, pitch=0.3)
    yield "inside", [sg.Body("hull", hull, sg.pose(1, 1, 0)), ball("ball", sg.pose(5))], SONAR, np.eye(4)
    yield "near", [sg.Body("fence", fence, sg.pose(3, 0.11, -0.15, yaw=0.01)), floor()], SONAR, np.eye(4)
    away = [sg.Body(b.name, b.mesh, sg.pose(*far) @ b.pose, b.reflectivity) for b in [*ring, floor()]]
    yield "away", away, SONAR, sg.pose(*far, yaw=0.1)
    yield "long", [sg.Body("tube", tube, across), floor(2000.0)], SONAR, sg.pose(yaw=0.2)
    yield "smooth", [ball("a", sg.pose(5), 0.9, smooth=True), ball("b", sg.pose(7, 2))], SONAR, np.eye(4)
    yield "patchy", [ball("a", sg.pose(5), patchy), ball("b", sg.pose(7, 2))], SONAR, np.eye(4)
    hills = terrain(np.random.default_rng(0), 80, 4, 230)  # 100 triangles a sample in the distance
    yield "hills", [sg.Body("hills", hills, sg.pose(z=-5)), *ring], SONAR, sg.pose(pitch=0.1)
    both = ball("a", sg.pose(5, yaw=1, roll=2), patchy, smooth=True)
    yield "both", [both, ball("b", sg.pose(7, 2)), floor()], SONAR, np.eye(4)


@pytest.mark.parametrize("bodies, sonar, pose", [pytest.param(*w[1:], id=w[0]) for w in worlds()])
def test_hard_cases(draw_sectors, monkeypatch, bodies, sonar, pose):
    # no coarser levels, whose edges are not those of the mesh
    monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 10**9)
    scene = sg.Scene(bodies)
    rasterised, drawn = (draw_sectors(scene, sonar, pose, here) for here in (True, False))
    hits, others = check_same(scene, pose, rasterised, drawn)
    assert hits > 1000
    assert others <= 4 + 0.01 * hits


def pictures(views):
    """Return plane and echo, and bodies, of all sectors in one array each."""
    return [np.concatenate([view[k].ravel() for view in views]) for k in (1, 2)]


def test_rasterized_samples_are_those_of_rays(draw_sectors, monkeypatch):
    """Each sample is compared with its ray's intersection of all triangles, in float64."""
    monkeypatch.setattr(scene_meshes, "LAYERS", 50)
    n = len(trimesh.creation.icosphere(3).faces)
    patchy = np.random.default_rng(1).uniform(0.1, 1.0, n)
    ball = trimesh.creation.icosphere(3, 0.9)
    torus = trimesh.creation.torus(1.0, 0.3, 48, 24)
    bodies = [
        sg.Body("ball", ball, sg.pose(6, 1, 0.2, 0.3), patchy),
        sg.Body("torus", torus, sg.pose(7, -1, -0.3, yaw=1.2), 0.7),
    ]
    pose = sg.pose(-0.5, 0.1, 0, 0.1, -0.05, 0.2)
    calls = []

    def counting(*args):
        calls.append(small_triangles.rasterize_small_triangles(*args))
        return calls[-1]

    monkeypatch.setattr(scene_meshes, "rasterize_small_triangles", counting)
    narrow = replace(SONAR, azimuth_fov_deg=50.0)
    ((sector, found, body),) = draw_sectors(sg.Scene(bodies), narrow, pose, True, sg.Sampling(0.7, 35))
    assert calls[-1][2] == 0, "all triangles are small here"
    u, v = (w.ravel() for w in sector.sample_coordinates())
    rays = np.stack([np.ones_like(u), -u, v], axis=-1)
    best, echo, slopes, which = np.zeros(len(u)), np.zeros(len(u)), np.zeros((len(u), 2)), np.zeros(len(u))
    inner = np.full(len(u), np.inf)  # distance from an edge, in barycentric coordinates
    for number, one in enumerate(bodies, 1):
        m = np.linalg.inv(pose) @ one.pose
        corners = (np.asarray(one.mesh.vertices) @ m[:3, :3].T + m[:3, 3]) @ sector.rotation().T
        mu = np.broadcast_to(one.reflectivity, len(one.mesh.faces))
        for face, strength in zip(corners[one.mesh.faces], mu, strict=True):
            # barycentric weights where the ray meets the triangle's plane
            weights = rays @ np.linalg.inv(face)
            plane = np.linalg.solve(face, np.ones(3))  # p . x = 1
            q = rays @ plane  # 1/x
            least = (weights / q[:, None]).min(axis=1) * np.where(q > 0, 1, -1)
            on = (np.abs(least) < np.abs(inner)) & (q > best * 0.999) & (q > 0)
            inner[on] = least[on]
            met = (weights.min(axis=1) >= 0) & (q > best)
            best[met], which[met], echo[met] = q[met], number, strength / np.linalg.norm(plane)
            slopes[met] = -plane[1], plane[2]
    hit = best > 0
    assert hit.sum() > 350
    # corners snap to 1/256 of a sample, by up to 0.003: a few thousandths of a triangle
    sure = np.abs(inner) > 0.01
    assert sure[hit].mean() > 0.9
    np.testing.assert_array_equal((found[..., 0].ravel() > 0)[sure], hit[sure])
    np.testing.assert_array_equal(body.ravel()[sure], which[sure])
    sure &= hit
    found = found.reshape(-1, 4)[sure]
    # vertices and results are float32, 6e-8; slopes are differences over triangles along which 1/x changes by a
    # hundredth
    np.testing.assert_allclose(found[:, 0], best[sure], rtol=1e-6)
    np.testing.assert_allclose(found[:, 3], echo[sure], rtol=2e-5)
    np.testing.assert_allclose(found[:, 1:3], slopes[sure], rtol=2e-5, atol=1e-6)


def small_world():
    balls = [ball(str(k), sg.pose(4 + 2 * k, k - 1, 0.2 * k), smooth=k == 1) for k in range(3)]
    return sg.Scene([*balls, floor()])


def test_without_room_for_samples_the_image_is_identical(draw_sectors, monkeypatch):
    """With no room for samples the driver draws all triangles, except those that cover no sample."""
    drawn = pictures(draw_sectors(small_world(), SONAR, np.eye(4), False))
    monkeypatch.setattr(scene_meshes, "LAYERS", 0)
    rasterised = pictures(draw_sectors(small_world(), SONAR, np.eye(4), True))
    assert (drawn[0] > 0).sum() > 10_000
    np.testing.assert_array_equal(rasterised[0], drawn[0])
    np.testing.assert_array_equal(rasterised[1], drawn[1])


def test_triangles_beyond_the_room_for_samples_are_drawn(draw_sectors, monkeypatch):
    scene, pose, filled = small_world(), sg.pose(yaw=0.1), []
    drawn = draw_sectors(scene, SONAR, pose, False)
    for room in (1000, 300, 100):

        def few(*args, room=room):
            out = small_triangles.rasterize_small_triangles(
                *args[:-1], tuple(array[:room] for array in args[-1])
            )
            filled.append(out[3])
            return out

        monkeypatch.setattr(scene_meshes, "rasterize_small_triangles", few)
        hits, others = check_same(scene, pose, draw_sectors(scene, SONAR, pose, True), drawn)
        assert hits > 5000
        assert others <= 4 + 0.01 * hits
        assert room - small_triangles.MAX_SAMPLES < filled[-1] <= room  # the buffer was full


def test_two_threads_rasterize_the_same_samples_as_one(draw_sectors, monkeypatch):
    scene = sg.Scene([*small_world().bodies, ball("patchy", sg.pose(9, 2), np.linspace(0.1, 1, 1280))])
    got, calls = [], []

    def counting(*args):
        calls.append(1)
        return small_triangles.rasterize_small_triangles(*args)

    monkeypatch.setattr(scene_meshes, "rasterize_small_triangles", counting)
    for threshold in (0, 10**9):
        monkeypatch.setattr(scene_meshes, "TWO_THREADS", threshold)
        calls.clear()
        got.append((pictures(draw_sectors(scene, SONAR, np.eye(4), True)), len(calls)))
    (two, n_two), (one, n_one) = got
    assert n_two > n_one
    np.testing.assert_array_equal(two[0], one[0])
    np.testing.assert_array_equal(two[1], one[1])
