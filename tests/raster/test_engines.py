"""Each raster engine judges the other: both give the same samples, except on edges of triangles."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.beamform.beamformer import NO_GAIN
from sonar_gl.beamform.kernels import range_bins
from sonar_gl.engine import world
from sonar_gl.engine.request import PingRequest
from sonar_gl.raster import cull
from sonar_gl.raster import level_of_detail as detail
from sonar_gl.raster.cpu import engine as cpu
from sonar_gl.raster.cpu.kernels import tables
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.raster.views import SectorView
from sonar_gl.scene import primitives
from sonar_gl.sonar.fan import FAR_FACTOR, NEAR_M
from sonar_gl.sonar.sector import SHEAR
from tests.support.worlds import random_world, terrain

SCENES = (
    "pylon",
    "harbour",
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in ("diver", "diver_vertical", "diver_swimming", "ocean_floor")
    ),
)
SAMPLING = sg.Sampling(1, 100)
SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.0, 0.5, 20.0)
# Samples this near an edge may go to either side: the driver snaps corners to 1/256 along columns and rows, which
# moves them by up to 0.0028 along a diagonal.
ON_EDGE = 0.0029


@pytest.fixture(params=["0", "1"], ids=["planes of corners", "planes of the driver"])
def driver(request, monkeypatch):
    """Has OpenGL draw as on a graphics card, by planes from the corners of triangles, and as by a software driver."""
    monkeypatch.setenv("SONAR_GL_SOFTWARE", request.param)


def draw_sectors(scene, sonar, pose, engine, sampling=SAMPLING):
    """Return whole sectors: (sector, plane and echo, bodies) of each."""
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sampling, engine=engine) as simulator:
        run = simulator.run
        with run.drawing():
            renderer = run.sampler.resolution.stage.renderer
            (view,) = renderer.render([pose], with_bodies=True, full=True)
            # OpenGL does not define the body number of an empty sample
            return [(s, p.copy(), np.where(p[..., 0] > 0, b, 0)) for s, p, b, _ in view.sectors]


def project_vertices(scene, pose, sector):
    """Yield the vertices of each body as (V, 3) column times x, row times x, and x, with x ahead of the sector."""
    view = SectorView(sector, 1e3, 1e3).geometry
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


class Difference(NamedTuple):
    """How many samples met a body, how many of them differ in what they met or where, and how many in their echo."""

    hits: int
    others: int
    echoes: int


def compare(scene, sonar, pose, samples, drawn) -> Difference:
    """Compare the images of both engines; what differs must lie on edges, the far plane's apart."""
    far_m = FAR_FACTOR * sonar.range_max_m
    hits, others, echoes = 0, 0, 0
    for (sector, here, body), (_, there, other) in zip(samples, drawn, strict=True):
        hit, met = here[..., 0] > 0, there[..., 0] > 0
        # a few float32 roundings of 6e-8; snapping a corner by 1/256 of a sample changes 1/x by that part of its
        # slope, and by twice as much on slivers
        slope = np.abs(there[..., 1]) * sector.u[1] + np.abs(there[..., 2]) * sector.v[2]
        same = np.abs(here[..., 0] - there[..., 0]) <= 2e-6 * there[..., 0] + slope / 128
        same &= (hit == met) & (body == other)
        # the driver takes slopes as differences of two neighbouring float32 values of 1/x, one of which may lie outside
        # the triangle
        echo = np.abs(here[..., 3] - there[..., 3]) <= 0.01 * there[..., 3] + 1e-6
        odd_ones = ~same & (np.maximum(here[..., 0], there[..., 0]) > 1.01 / far_m)
        for odd, most in ((odd_ones, ON_EDGE), (same & ~echo, 2.0)):
            if odd.any():
                distance = distance_from_edges(np.argwhere(odd), edges_of(scene, pose, sector))
                assert distance.max() <= most
        hits, others = hits + int(met.sum()), others + int(odd_ones.sum())
        echoes += int((same & ~echo).sum())
    return Difference(hits, others, echoes)


def both_engines(scene, sonar, pose):
    """Return the samples of the CPU and of OpenGL."""
    return [draw_sectors(scene, sonar, pose, engine, SAMPLING) for engine in ("cpu", "opengl")]


def test_the_rasteriser_reads_the_columns_that_scenes_write():
    box = sg.Body("box", trimesh.creation.box(), reflectivity=0.25, specular=0.5, roughness_rad=0.125)
    meshes = SceneMeshes()
    meshes.add([box])
    columns = [tables.ROW_REFLECTIVITY, tables.ROW_STRENGTH, tables.ROW_SLOPE]
    assert meshes.table[0, columns].tolist() == [0.25, 0.5, 0.125]
    assert columns[:2] == [cull.REFLECTIVITY, cull.LOBE]


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
def test_random_worlds():
    """Every second world is rolled."""
    found = []
    for seed in range(100, 124):
        scene, sonar, pose = random_world(seed)
        pose = pose @ sg.pose(roll=0.7) if seed % 2 else pose
        found.append(compare(scene, sonar, pose, *both_engines(scene, sonar, pose)))
    hits, others, echoes = np.sum(found, axis=0)
    assert hits > 200_000
    assert others <= 1e-5 * hits
    assert echoes <= 1e-5 * hits


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("name", SCENES)
def test_bundled_scenes(name):
    """Scenes with shading normals and reflectivity maps."""
    scene, sonar = sg.load_scene(name), sg.load_sonar("p900-45")
    samples, drawn = both_engines(scene, sonar, scene.sonar_pose)
    hits, others, echoes = compare(scene, sonar, scene.sonar_pose, samples, drawn)
    assert hits > 20_000
    # the outline of a bright pile in the harbour passes a sample by less than rounding of its corners to float32
    on_edges = 1e-4 if name == "harbour" else 0
    assert others <= (name == "harbour")
    assert echoes <= 2
    sums = [sum(float(plane_echo[..., 3].sum()) for _, plane_echo, *_ in views) for views in (samples, drawn)]
    assert sums[0] == pytest.approx(sums[1], rel=1e-4 + on_edges)


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("name", SCENES)
def test_images_of_bundled_scenes(name, monkeypatch):
    """The same sums of both engines' samples: images differ by less than 1.5e-4 of the echo.

    The faces that join rows are known of one engine alone; tests/beamform/test_joined_rows.py has what they change.
    """
    monkeypatch.setattr(range_bins, "piece_limits", lambda *_: (0.0, 0.0))
    scene, sonar, images = sg.load_scene(name), sg.load_sonar("p900-45"), []
    for engine in ("cpu", "opengl"):
        with sg.Simulator(scene, sonar, sampling=sg.Sampling(1, 100), engine=engine) as simulator:
            images.append(simulator.ping(scene.sonar_pose).intensity.astype(np.float64))
    assert np.abs(images[0] - images[1]).sum() < 1.5e-4 * images[0].sum()


def ball(name, at, reflectivity=0.5, radius=1.0, smooth=False):
    mesh = trimesh.creation.icosphere(3, radius)
    normals = np.asarray(mesh.vertices, np.float32) / np.float32(radius) if smooth else None
    return sg.Body(name, mesh, at, reflectivity, normals)


def floor(width=400.0, at=-2.0):
    return sg.Body("floor", primitives.plane(size=(width, width))[0], sg.pose(z=at, roll=0.02, yaw=0.3), 0.4)


NARROW = replace(SONAR, azimuth_fov_deg=50.0)  # one sector


def uneven_sheet(rng, spacing, border, off_grid):
    """Return a body whose vertices lie before a sector of `NARROW`: (name, mesh).

    Parameters
    ----------
    spacing : of vertices, in samples
    border : how many samples the sheet ends beyond the sector's first and last, in samples
    off_grid : how far vertices lie beside samples at most, in samples
    """
    ((sector, *_),) = draw_sectors(sg.Scene([ball("ball", sg.pose(5))]), NARROW, np.eye(4), "cpu")
    ends = [
        np.arange(-border, n + border + spacing, spacing, dtype=float) for n in (sector.columns, sector.rows)
    ]
    columns, rows = (one.ravel() for one in np.meshgrid(*ends, indexing="ij"))
    n_columns, n_rows = map(len, ends)
    columns, rows = (one + rng.uniform(-off_grid, off_grid, one.shape) for one in (columns, rows))
    u, v = (w[0] + w[1] * columns + w[2] * rows for w in (sector.u, sector.v))
    rays = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation()
    points = rays * rng.uniform(6.0, 9.0, len(u))[:, None]
    first = np.arange(n_columns * n_rows).reshape(n_columns, n_rows)[:-1, :-1].ravel()
    a, b, c, d = first, first + n_rows, first + n_rows + 1, first + 1
    turn = rng.random(len(first)) < 0.5  # which of its diagonals divides a cell
    faces = [
        np.where(turn, one, other) for one, other in zip((a, b, c, a, c, d), (a, b, d, b, c, d), strict=True)
    ]
    faces = np.stack(faces, axis=-1).reshape(-1, 3)
    return sg.Body("sheet", trimesh.Trimesh(points, faces, process=False), reflectivity=0.4)


def differing(scene):
    """Return how many samples are of another face in one engine than in the other, and how many there are."""
    ((_, here, _),), ((_, there, _),) = both_engines(scene, NARROW, np.eye(4))
    inverse, echo = (
        np.abs(here - there)[..., k] / np.maximum(here, there)[..., k].clip(1e-9) for k in (0, 3)
    )
    return int(((inverse > 1e-3) | (echo > 0.05)).sum()), inverse.size


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("spacing, off_grid", [(2, 0), (3, 1 / 256)])
def test_a_sample_on_an_edge_is_of_one_face_alone(spacing, off_grid):
    """Both engines give it to the same one. The engine `cpu` gave it to the one that is nearer by rounding."""
    rng = np.random.default_rng(0)
    found, n = differing(sg.Scene([uneven_sheet(rng, spacing, -4, off_grid)]))
    assert n > 10_000
    assert found <= 2


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
def test_the_driver_does_not_move_edges_that_leave_the_sector():
    """It rounded where they met the sides of the viewport, which were those of the sector."""
    rng = np.random.default_rng(1)
    assert sum(differing(sg.Scene([uneven_sheet(rng, 9, 20, 4.0)]))[0] for _ in range(12)) <= 1


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
    around = [ball(str(k), sg.pose(6 * np.cos(k), 6 * np.sin(k), 0.1 * k)) for k in range(7)]
    full = replace(wide, azimuth_fov_deg=360.0)
    yield "full circle", [*around, floor()], full, np.eye(4)
    yield "full circle rolled", [*around, floor()], full, sg.pose(roll=0.7, pitch=0.2, yaw=0.5)
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


SLOW_WORLDS = "rolled", "full circle", "away", "hills", "wide", "smooth", "patchy"


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize(
    "bodies, sonar, pose",
    [pytest.param(*w[1:], id=w[0], marks=pytest.mark.slow if w[0] in SLOW_WORLDS else ()) for w in worlds()],
)
def test_hard_cases(monkeypatch, bodies, sonar, pose):
    # no coarser levels, whose edges are not those of the mesh
    monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 10**9)
    scene = sg.Scene(bodies)
    hits, others, echoes = compare(scene, sonar, pose, *both_engines(scene, sonar, pose))
    assert hits > 1000
    assert others <= 2
    assert echoes <= 5


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
@pytest.mark.parametrize(
    "exponent",
    [
        -100,
        pytest.param(66, marks=pytest.mark.slow),
        *(pytest.param(e, marks=pytest.mark.slow) for e in (-40, -10, 20)),
    ],
)
def test_the_length_of_normals_changes_nothing(engine, exponent):
    """Powers of two round nothing. Normals shorter than 1e-3 counted as none, and long ones returned no echo."""
    unit = [ball("a", sg.pose(5), 0.9, smooth=True), ball("b", sg.pose(7, 2)), floor()]
    scaled = replace(unit[0], normals=np.ldexp(unit[0].normals, exponent))
    flat = replace(unit[0], normals=np.zeros_like(unit[0].normals))
    want, got, other = (
        pictures(draw_sectors(sg.Scene([one, *unit[1:]]), SONAR, np.eye(4), engine))
        for one in (unit[0], scaled, flat)
    )
    np.testing.assert_array_equal(got[0], want[0])
    assert (other[0] != want[0]).sum() > 1000


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("sonar_z_m", [-0.5, 0.5])
def test_the_surface_of_the_water_cuts_bodies(sonar_z_m):
    """A pier from the floor into the air is seen below the surface only, or, from the air, whole."""
    pier = sg.Body("pier", trimesh.creation.box((1, 1, 8)), sg.pose(6, 0.5, -1, yaw=0.4), 0.5)
    scene = sg.Scene([pier, ball("buoy", sg.pose(5, -1.5, 0.1)), floor()], surface_z_m=0.0)
    pose = sg.pose(z=sonar_z_m, pitch=-0.1)
    samples, drawn = both_engines(scene, SONAR, pose)
    for (sector, here, body), (_, there, other) in zip(samples, drawn, strict=True):
        differs = (body != other) | (np.abs(here[..., 0] - there[..., 0]) > 1e-4 * there[..., 0])
        assert differs.sum() <= 1e-3 * differs.size  # where the surface meets a sample to rounding
        u, v = sector.sample_coordinates()
        hit = here[..., 0] > 0
        rays = np.stack([np.ones_like(u), -u, v], axis=-1)[hit] / here[hit, :1]
        height_m = sonar_z_m + (rays @ sector.rotation()) @ pose[2, :3]
        assert hit.sum() > 1000
        assert (height_m.max() > 0.5) == (sonar_z_m > 0)


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_a_face_in_the_surface_of_the_water_is_not_seen(engine):
    """A tank that is filled to the brim is one without its lid; rounding decided on each sample of it."""
    box = trimesh.creation.box((24, 24, 4))
    open_box = trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.5], process=False)
    sonar, pose = replace(SONAR, elevation_fov_deg=60.0), sg.pose(0.3, 0.2, -0.4, 0.1, -0.2, 0.3)
    full, lidless = (
        sg.Scene([sg.Body("tank", mesh, sg.pose(yaw=0.3), 0.4)], surface_z_m=2.0) for mesh in (box, open_box)
    )
    got, want = (pictures(draw_sectors(one, sonar, pose, engine)) for one in (full, lidless))
    assert 0.3 < (want[1] > 0).mean() < 0.9
    assert (got[1] != want[1]).mean() < 1e-3


def pictures(views):
    """Return plane and echo, and bodies, of all sectors in one array each."""
    return [np.concatenate([view[k].ravel() for view in views]) for k in (1, 2)]


def test_samples_of_the_cpu_are_those_of_rays():
    """Each sample is compared with its ray's intersection of all triangles, in float64."""
    n = len(trimesh.creation.icosphere(2).faces)
    patchy = np.random.default_rng(1).uniform(0.1, 1.0, n)
    ball = trimesh.creation.icosphere(2, 0.9)
    torus = trimesh.creation.torus(1.0, 0.3, 16, 12)
    bodies = [
        sg.Body("ball", ball, sg.pose(6, 1, 0.2, 0.3), patchy),
        sg.Body("torus", torus, sg.pose(7, -1, -0.3, yaw=1.2), 0.7),
    ]
    pose = sg.pose(-0.5, 0.1, 0, 0.1, -0.05, 0.2)
    narrow = replace(SONAR, azimuth_fov_deg=50.0)
    ((sector, found, body),) = draw_sectors(sg.Scene(bodies), narrow, pose, "cpu", sg.Sampling(0.7, 35))
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


def test_two_threads_draw_the_same_samples_as_one(monkeypatch):
    monkeypatch.setattr(world, "n_threads", lambda: 2)  # also on one core
    scene = sg.Scene([*small_world().bodies, ball("patchy", sg.pose(9, 2), np.linspace(0.1, 1, 1280))])
    draw_sectors(scene, SONAR, np.eye(4), "cpu")  # the first simulator of a process draws once by itself
    got, parts = [], []
    draw_windows = cpu.draw_windows
    monkeypatch.setattr(cpu, "draw_windows", lambda *a: parts.append(1) or draw_windows(*a))
    for threshold in (0, 10**9):
        monkeypatch.setattr(cpu, "FEW_NS", threshold)
        parts.clear()
        got.append(pictures(draw_sectors(scene, SONAR, np.eye(4), "cpu")))
        assert len(parts) == (1 if threshold else 2)
    two, one = got
    assert (one[0] > 0).sum() > 10_000
    np.testing.assert_array_equal(two[0], one[0])
    np.testing.assert_array_equal(two[1], one[1])


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_memory_that_is_made_ready_leaves_the_samples_that_were_drawn(engine):
    """And finer ones are those that are drawn without that."""
    fine, views = sg.Sampling(4, 400), []
    with sg.Simulator(small_world(), SONAR, sg.Acoustics.ideal(), SAMPLING, engine=engine) as simulator:
        run = simulator.run
        with run.drawing():
            coarse, finer = (run.stages.stage(one).renderer for one in (SAMPLING, fine))
            finer.prepare(1000, 0.5)  # before anything was drawn
            (view,) = coarse.render([np.eye(4)], with_bodies=True)
            before = [one.plane_echo.copy() for one in view.sectors]
            for share in (0.4, 1.0):
                finer.prepare(fine.columns_per_beam * SONAR.n_beams * fine.rows, share)
            for one, same in zip(view.sectors, before, strict=True):
                np.testing.assert_array_equal(one.plane_echo, same)
            (view,) = finer.render([np.eye(4)], with_bodies=True, full=True)
            views = [one.plane_echo.copy() for one in view.sectors]
    alone = draw_sectors(small_world(), SONAR, np.eye(4), engine, fine)
    for one, (_, same, _) in zip(views, alone, strict=True):
        np.testing.assert_array_equal(one, same)


def test_both_lattices_share_what_a_view_needs_while_it_is_drawn():
    """Not the samples: they are compared."""
    with sg.Simulator(small_world(), SONAR, sg.Acoustics.ideal(), SAMPLING, engine="cpu") as simulator:
        stages = simulator.run.stages
        with simulator.run.drawing():
            one, other = (stages.stage(SAMPLING, shear) for shear in (SHEAR, -SHEAR))
            (view,) = one.draw([np.eye(4)], [None])
            before = [sector.plane_echo.copy() for sector in view.sectors]
            other.draw([np.eye(4)], [None])
        for sector, same in zip(view.sectors, before, strict=True):
            np.testing.assert_array_equal(sector.plane_echo, same)
        made = simulator.run.world.engine.make_workspace(1000)
        assert simulator.run.world.engine.make_workspace(1000, made).halves is made.halves


def seen_bodies(samples):
    """Return the number of the body of each sample; 0, which is not written, where it met nothing."""
    return np.where(samples.plane_echo[..., 0] > 0, samples.body_id, 0)


@pytest.mark.parametrize("is_threaded", [False, True])
@pytest.mark.parametrize(
    "name", ["diver", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pylon", "ocean_floor"))]
)
def test_views_of_lobes_alone_are_shaded_with_the_whole_view(name, is_threaded, monkeypatch):
    """They are those that are drawn by themselves, to the bit, and so are their sums; no triangle is drawn for them."""
    scene, drawn = sg.load_scene(name), []
    draw_windows = cpu.draw_windows
    monkeypatch.setattr(cpu, "draw_windows", lambda *a: drawn.append(1) or draw_windows(*a))
    monkeypatch.setattr(cpu, "FEW_NS", 0 if is_threaded else 10**12)
    monkeypatch.setattr(world, "n_threads", lambda: 2)
    poses = [scene.sonar_pose, scene.sonar_pose @ sg.pose(0.1, yaw=0.1), scene.sonar_pose @ sg.pose(0.2)]
    with sg.Simulator(scene, SONAR, sg.Acoustics.physical(), SAMPLING, engine="cpu") as simulator:
        run, stage = simulator.run, simulator.run.sampler.resolution.stage
        renderer, state = stage.renderer, run.world.state_of(None, None, False, None)
        lobes = state.without_diffuse_echo()

        def draw(poses, states):
            drawn.clear()
            with run.drawing():
                views = renderer.render(poses, states, with_bodies=True)
            views = [
                view.with_echo() if its_state is lobes else view
                for view, its_state in zip(views, states, strict=True)
            ]
            sums = [stage.beamformer.sum_view(view, NO_GAIN).intensity for view in views]
            samples = [one for view in views for one in view.sectors]
            arrays = [
                (one.plane_echo, one.face_id, seen_bodies(one), one.sector.u, one.sector.v) for one in samples
            ]
            return [*([a.copy() for a in one] for one in arrays), *([one] for one in sums)], len(drawn)

        whole, n_whole = draw(poses, [state] * 3)
        alone, _ = draw(poses, [lobes] * 3)
        both, n_both = draw([*poses, *poses], [state] * 3 + [lobes] * 3)
    assert n_both == n_whole
    assert sum((plane_echo[..., 3] > 0).sum() for plane_echo, *_ in alone[:-3]) > 100
    assert all(intensity.any() for (intensity,) in alone[-3:])
    samples = [*whole[:-3], *alone[:-3]]
    for got, expected in zip(both, [*samples, *whole[-3:], *alone[-3:]], strict=True):
        for found, true in zip(got, expected, strict=True):
            np.testing.assert_array_equal(found, true)


def test_room_for_triangles_follows_what_is_drawn():
    """Pings share their memory: of no triangles, of many, of few and of many again."""
    ball = sg.Body("ball", trimesh.creation.icosphere(5, 1.0), sg.pose(6), 0.5)  # 20 480 triangles
    made_of = sg.Scene([ball]), SONAR, sg.Acoustics.ideal(), sg.Sampling(1, 40)
    with sg.Simulator(*made_of, engine="cpu") as simulator:
        expected = simulator.ping(np.eye(4)).intensity
    with sg.Simulator(*made_of, engine="cpu") as simulator:
        places = sg.pose(-9), None, sg.pose(19), None
        images = [
            simulator.ping(np.eye(4), bodies=None if at is None else {"ball": at}).intensity for at in places
        ]
    np.testing.assert_array_equal(images[1], expected)
    np.testing.assert_array_equal(images[3], expected)


@pytest.mark.slow
def test_a_row_that_a_level_edge_leaves_out_stays_empty_however_far_another_edge_lies():
    """Here the diver's scene has a face with a corner behind the sonar, one edge along the rows and one nearly so.

    The latter meets a row at 8e16 columns, where float64 has no steps of one.
    """
    scene, sonar = sg.load_scene("diver"), sg.load_sonar("demarco-2015").with_range(10.0)
    pose, clouds = scene.sonar_pose @ sg.pose(x=0.016), []
    for engine in ("cpu", "opengl"):
        with sg.Simulator(scene, sonar, engine=engine) as simulator:
            clouds.append(simulator.point_cloud(pose, 140, 140))
    for one, other in zip(*clouds, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)  # float32


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_an_infinite_plane_is_the_same_ten_kilometres_away(engine):
    """It was 2 km wide: vehicles that went further had no floor. tests/raster/test_sheets.py has where it lies."""
    ground = sg.Body("ground", primitives.plane()[0], reflectivity=0.4)
    with sg.Simulator(sg.Scene([ground]), SONAR, sg.Acoustics.ideal(), SAMPLING, engine=engine) as simulator:
        near, far = (simulator.ping(sg.pose(x, -x, 2.0, 0.0, 0.3, 0.2)).intensity for x in (300.0, 9_900.0))
    assert near.any()
    assert np.abs(far - near).sum() < (1e-5 if engine == "cpu" else 5e-5) * near.sum()


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
@pytest.mark.parametrize("names", ["abc", "bca", "cba"])
def test_of_bodies_whose_faces_coincide_the_first_one_is_seen(engine, names):
    mesh = trimesh.creation.box((1, 8, 8))
    mus = {"a": 0.1, "b": 0.5, "c": 0.9}
    scene = sg.Scene([sg.Body(name, mesh, sg.pose(5.5), mus[name]) for name in names])
    alone = sg.Scene([sg.Body("wall", mesh, sg.pose(5.5), mus[names[0]])])
    found, expected = (
        draw_sectors(one, SONAR, sg.pose(0, 0, 0, 0.01, 0.02, 0.05), engine) for one in (scene, alone)
    )
    for (_, planes, bodies), (_, planes_alone, bodies_alone) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(planes, planes_alone)
        np.testing.assert_array_equal(bodies, bodies_alone)
        assert (bodies <= 1).all() and (bodies == 1).any()


@pytest.mark.usefixtures("driver")
def test_both_engines_count_the_faces_that_they_draw():
    """By what a ping costs a live loop chooses its samples, the same ones with both."""
    scene, n_faces = sg.load_scene("diver"), []
    for engine in ("cpu", "opengl"):
        with sg.Simulator(scene, NARROW, sampling=SAMPLING, engine=engine) as simulator:
            run = simulator.run
            setup = run.set_up(PingRequest(scene.sonar_pose))
            with run.drawing():
                (view,) = run.sampler.resolution.stage.draw([setup.head_pose], [setup.state])
            n_faces.append(view.n_faces)
    assert n_faces[0] == n_faces[1] > 100
