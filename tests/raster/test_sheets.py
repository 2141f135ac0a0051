"""Rectangles are drawn by OpenGL no further than a sonar sees, and are where they are."""

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.beamform.kernels import range_bins
from sonar_gl.raster.opengl.sheets import draw_near, sheet_of
from sonar_gl.scene import primitives
from sonar_gl.sonar.fan import FAR_FACTOR, NEAR_M
from tests.support.worlds import random_rotation

SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.0, 0.1, 10.0)
AROUND = sg.Sonar("around", 900e3, 128, 200, 360.0, 30.0, 3.0, 0.1, 8.0)
TURN = random_rotation(np.random.default_rng(3))
SHEET = trimesh.Trimesh(*primitives.plane(size=(30.0, 3000.0)).mesh, process=False)


@pytest.fixture(params=["0", "1"], ids=["planes of corners", "planes of the driver"])
def driver(request, monkeypatch):
    """Has OpenGL draw as on a graphics card, and as by a software driver."""
    monkeypatch.setenv("SONAR_GL_SOFTWARE", request.param)


def views_of(simulator, pose):
    """Return whole sectors: (sector, plane and echo) of each."""
    run = simulator.run
    with run.drawing():
        (view,) = run.sampler.resolution.stage.renderer.render([pose], with_bodies=True, full=True)
        return [(one.sector, one.plane_echo.copy()) for one in view.sectors]


def poses_above(rng, count):
    """Yield poses of sonars 0.1 to 2 m above z = 0, rolled by any angle, up to 9 km from the origin."""
    for _ in range(count):
        x, y = rng.uniform(-1, 1, 2) * rng.choice([10.0, 900.0, 9000.0])
        roll, pitch, yaw = rng.uniform(-3, 3), rng.uniform(-0.4, 0.4), rng.uniform(-3, 3)
        yield sg.pose(x, y, 10 ** rng.uniform(-1, 0.3), roll, pitch, yaw)


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("sonar", [SONAR, AROUND], ids=["ahead", "around"])
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_an_infinite_plane_is_where_it_is(engine, sonar):
    """By OpenGL a plane 10 cm below the sonar was off by up to a thousandth of 1/x: its corners are float32."""
    scene, n = sg.Scene([sg.Body("ground", primitives.plane()[0], reflectivity=0.4)]), 0
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sg.Sampling(1, 60), engine=engine) as simulator:
        for pose in poses_above(np.random.default_rng(1), 12):
            for sector, found in views_of(simulator, pose):
                u, v = sector.sample_coordinates()
                rays = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation()
                true = rays @ pose[2, :3] / -pose[2, 3]
                # the far plane and the near one cut at 1/x, which has its own rounding
                is_sure = (np.abs(true * FAR_FACTOR * sonar.range_max_m - 1) > 1e-2) & (true < 0.99 / NEAR_M)
                is_seen = true * FAR_FACTOR * sonar.range_max_m > 1
                np.testing.assert_array_equal((found[..., 0] > 0)[is_sure], is_seen[is_sure])
                both = is_sure & is_seen
                of_plane = 2e-7 if engine == "cpu" else 8e-6
                np.testing.assert_allclose(found[both, 0], true[both], rtol=2e-7, atol=of_plane / pose[2, 3])
                n += both.sum()
    assert n > 10_000


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("profile", [pytest.param("ideal", marks=pytest.mark.slow), "physical"])
@pytest.mark.parametrize(
    "sonar", [SONAR, pytest.param(AROUND, marks=pytest.mark.slow)], ids=["ahead", "around"]
)
def test_images_of_infinite_planes(sonar, profile, monkeypatch):
    """They differed by up to 1.5e-3 of the echo."""
    monkeypatch.setattr(range_bins, "piece_limits", lambda *_: (0.0, 0.0))  # the engine cpu alone knows faces
    upright = sg.pose(7.0, pitch=np.pi / 2)
    planes = primitives.plane()[0], primitives.plane(normal=(1.0, 2.0, 3.0))[0]
    bodies = [
        sg.Body("ground", planes[0], reflectivity=0.4),
        sg.Body("slope", planes[1], sg.pose(z=-4.0), 0.5),
        sg.Body("wall", planes[0], upright, 0.6),
    ]
    poses, images = list(poses_above(np.random.default_rng(2), 6)), []
    # near the origin, where all three are
    poses = [sg.pose(*pose[:3, 3] * [1e-3, 1e-3, 1.0]) @ pose_of(pose[:3, :3]) for pose in poses]
    for engine in ("cpu", "opengl"):
        made_of = sg.Scene(bodies), sonar, getattr(sg.Acoustics, profile)(), sg.Sampling(1, 100)
        with sg.Simulator(*made_of, engine=engine) as simulator:
            images.append(np.array([simulator.ping(pose).intensity for pose in poses], np.float64))
    apart = np.abs(images[0] - images[1]).sum(axis=(1, 2)) / images[0].sum(axis=(1, 2))
    assert apart.max() < 1.5e-4


def pose_of(rotation):
    """Return a (4, 4) pose of a rotation."""
    out = np.eye(4)
    out[:3, :3] = rotation
    return out


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
def test_a_long_sheet_ends_where_it_does():
    """3 km long and 30 m wide, turned about: its sides are in view, and one of its ends."""
    body = sg.Body("sheet", SHEET, TURN, 0.4)
    for x, y in ((0.0, 0.0), (12.0, 700.0), (-14.0, -1495.0), (18.0, 1504.0)):
        pose = TURN @ sg.pose(x, y, 1.5, pitch=0.3, yaw=0.8)
        views = []
        for engine in ("cpu", "opengl"):
            made_of = sg.Scene([body]), SONAR, sg.Acoustics.ideal(), sg.Sampling(1, 100)
            with sg.Simulator(*made_of, engine=engine) as simulator:
                views.append(views_of(simulator, pose))
        for (_, here), (_, there) in zip(*views, strict=True):
            both = (here[..., 0] > 0) & (there[..., 0] > 0)
            assert ((here[..., 0] > 0) != (there[..., 0] > 0)).sum() <= 2  # on edges
            np.testing.assert_allclose(there[both, 0], here[both, 0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, -0.5, -0.8)])
@pytest.mark.parametrize("size", [(22_000.0, 22_000.0), (30.0, 3000.0), (2.0, 3.0)])
def test_sheets_are_found(normal, size):
    body = sg.Body("sheet", primitives.plane(normal, size)[0])
    sheet = sheet_of(body)
    np.testing.assert_allclose(np.sort(sheet.half_sides), np.sort(size) / 2)
    np.testing.assert_allclose(sheet.axes @ sheet.axes.T, np.eye(2), atol=1e-12)
    unit = np.array(normal) / np.linalg.norm(normal)
    np.testing.assert_allclose(sheet.axes @ unit, 0.0, atol=1e-12)


def test_what_is_no_rectangle_is_no_sheet():
    x, y = np.meshgrid(np.arange(4.0), np.arange(4.0))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(16)])
    first = np.array([k for k in range(12) if k % 4 < 3])
    quads = np.column_stack([first, first + 1, first + 5, first + 4])
    whole = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    assert sheet_of(sg.Body("grid", trimesh.Trimesh(points, whole, process=False))) is not None
    bent = points + [0.0, 0.0, 1e-3] * (x.ravel() > 2)[:, None]
    skew = points + [0.0, 0.3, 0.0] * x.ravel()[:, None]
    for name, vertices, faces in (
        ("hole", points, np.delete(whole, [4, 13], axis=0)),
        ("notch", points, np.delete(whole, [2, 11], axis=0)),
        ("bent", bent, whole),
        ("skew", skew, whole),
        ("triangle", points[[0, 3, 12]], np.array([[0, 1, 2]])),
        ("twice", points, np.concatenate([whole, whole[:1]])),
    ):
        assert sheet_of(sg.Body(name, trimesh.Trimesh(vertices, faces, process=False))) is None, name
    assert sheet_of(sg.Body("box", trimesh.creation.box((400.0, 400.0, 1.0)))) is None
    mesh = trimesh.Trimesh(points, whole, process=False)
    assert sheet_of(sg.Body("patchy", mesh, reflectivity=np.linspace(0.1, 1.0, len(whole)))) is None
    assert sheet_of(sg.Body("smooth", mesh, normals=np.tile(np.float32([0, 0.1, 1]), (16, 1)))) is None


def test_small_sheets_and_those_out_of_sight_stay_as_they_are():
    sheet, row = sheet_of(sg.Body("sheet", SHEET)), np.full(16, 7.0, np.float32)
    draw_near(sheet, sg.pose(5, 3, -1)[:3], 1600.0, row)
    draw_near(sheet, sg.pose(5, 3000, -1)[:3], 100.0, row)
    np.testing.assert_array_equal(row, 7.0)
    draw_near(sheet, sg.pose(5, 3, -1)[:3], 100.0, row)
    np.testing.assert_allclose(row[:12].reshape(3, 4), [[1, 0, 0, 5], [0, 1 / 15, 0, 0], [0, 0, 1, -1]])
    np.testing.assert_array_equal(row[12:], 7.0)
