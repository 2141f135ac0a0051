"""Pings of depth images against closed forms and against pings of a Simulator of the same scene."""

import copy
import gc
import math
import pickle
import threading
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl import embed
from sonar_gl.core.worker import SecondThread
from sonar_gl.embed import camera_rig
from sonar_gl.embed.resample import UNSEEN, PixelPlanes
from sonar_gl.engine.motion import shown_in_motion
from sonar_gl.noise.noise import add_noise
from sonar_gl.raster import scene_meshes
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.samples import NO_SPANS, SectorSamples
from tests.support import soak
from tests.support.casting import Cast, box, cylinder, plane, sphere
from tests.support.closed_forms import box_beams, cylinder_echo, plane_echo
from tests.support.forks import in_fork
from tests.support.main_lobe import main_lobe_alone
from tests.support.waiting import wait_until

IDEAL = sg.Acoustics.ideal()
AHEAD = sg.Camera.of_fov(2, 2, fov_x_rad=1.0).rotation
pytestmark = pytest.mark.usefixtures("main_lobe_alone")
__all__ = ["main_lobe_alone"]  # the fixture


def sonar_of(fov_deg=40.0, n_beams=80, elevation_deg=16.0, range_m=20.0, n_bins=400, **more):
    width = fov_deg / n_beams
    return sg.Sonar("test", 900e3, n_beams, n_bins, fov_deg, elevation_deg, width, 0.0, range_m, **more)


def camera_of(sonar, columns=480):
    """Return a camera that looks ahead and sees a little more than the fan."""
    fov = math.radians(sonar.azimuth_fov_deg) * 1.05
    top = math.tan(math.radians(sonar.elevation_fov_deg) / 2) / math.cos(fov / 2) * 1.05
    rows = math.ceil(columns * top / math.tan(fov / 2))
    return sg.Camera.of_fov(columns, rows, fov_x_rad=fov)


SONAR = sonar_of()
CAMERA = camera_of(SONAR)
SHAPE = CAMERA.height, CAMERA.width


def ping_of(depth, camera=CAMERA, **more):
    """Return a ping of SONAR by ideal acoustics."""
    return sg.ping_from_depth(depth, SONAR, camera, IDEAL, **more)


def wrong(ping, truth):
    """Return the share of the echo that lies in wrong bins."""
    e, t = (np.asarray(getattr(p, "intensity", p), np.float64) for p in (ping, truth))
    return np.abs(e - t).sum() / t.sum()


def block(low, high):
    mesh = trimesh.creation.box(np.subtract(high, low))
    mesh.apply_translation(np.add(low, high) / 2)
    return mesh


# A room with flat faces, for the Simulator and for ray casting; the sonar is at the origin.
ROOM = {
    "floor": ([-90, -90, -4], [90, 90, -2.5]),
    "box": ([9, 1, -2.5], [11, 3, 0.6]),
    "slab": ([6, -4, -1.5], [6.5, -2, 0.4]),
    "far wall": ([16, -90, -2.5], [17, 90, 5]),
}
ROOM_CAST = Cast(*(box(low, high) for low, high in ROOM.values()))


def room():
    return sg.Scene([sg.Body(name, block(*ends), reflectivity=0.5) for name, ends in ROOM.items()])


@pytest.fixture(scope="module")
def truth():
    """Return a fine ping of the room, with labels."""
    with sg.Simulator(room(), SONAR, IDEAL, tolerance=0.002) as simulator:
        return simulator.ping(np.eye(4), labels=True)


def test_a_wall_as_planar_depth_and_as_range():
    sonar = sonar_of(100.0, 100, 4.0)
    camera = camera_of(sonar, 1000)
    range_m, depth, normals, _ = Cast(plane([1, 0, 0], 8)).images(camera)
    top = math.radians(2.0)
    exact = 0.5 * box_beams(
        sonar, lambda psi: plane_echo((1, 0, 0), 8.0, psi, (-top, top), sonar.bin_edges_m)
    )
    assert np.allclose(depth, 8.0)
    with embed.Sensor(sonar, IDEAL) as sensor:
        for face_normals in (normals, None):
            planar = sensor.ping_from_depth(depth, camera, normals=face_normals)
            radial = sensor.ping_from_depth(range_m, camera, normals=face_normals, holds="range")
            for ping in (planar, radial):
                # a sample covers a tenth of a degree, a bin at 12 m and 49 degrees a fifth of a degree
                assert wrong(ping, exact) < 0.004
                shown = (ping.intensity @ ping.range_m) / ping.intensity.sum(1)
                # a bin, and a beam's width
                assert np.abs(shown - 8 / np.cos(ping.azimuth_rad)).max() < 0.05 + 0.01
        short = sensor.ping_from_depth(depth, camera, holds="range")
        long = sensor.ping_from_depth(range_m, camera)
    # a wrong kind of depth changes all beams except those near the boresight
    assert wrong(short, exact) > 1.5 and wrong(long, exact) > 1.5
    aside = np.abs(np.degrees(sonar.azimuth_rad)) > 30
    peaks = short.range_m[short.intensity.argmax(1)], long.range_m[long.intensity.argmax(1)]
    assert (8 / np.cos(sonar.azimuth_rad) - peaks[0])[aside].min() > 1.1
    assert (peaks[1] - 8 / np.cos(sonar.azimuth_rad))[aside].min() > 1.1


def sector_camera(sector):
    """Return the camera whose pixels are the samples of a sector, with its shear; the top row is the last one."""
    last = sector.rows - 1
    step = np.array([[sector.u[1], -sector.u[2]], [-sector.v[1], sector.v[2]]])
    start = np.array([sector.u[0] + sector.u[2] * last, -(sector.v[0] + sector.v[2] * last)])
    K = np.eye(3)
    K[:2, :2] = np.linalg.inv(step)
    K[:2, 2] = -K[:2, :2] @ start
    return sg.Camera(sector.columns, sector.rows, K, sector.rotation().T @ AHEAD)


@pytest.mark.parametrize("acoustics", [IDEAL, sg.Acoustics.physical(pulse=True)])
def test_a_camera_with_the_samples_of_a_sector_gives_the_simulator_s_ping(acoustics, monkeypatch):
    # no host tells where its bodies are, beyond which they have no labels
    monkeypatch.setattr(scene_meshes, "body_spans", lambda *_: NO_SPANS)
    sampling, pose = sg.Sampling(3, 100), sg.pose(0.3, 0.1, 0.2, 0.05, 0.1, 0.1)
    mus = {n: 0.2 * n for n in range(1, 5)}
    scene = sg.Scene([sg.Body(b.name, b.mesh, reflectivity=mus[n]) for n, b in enumerate(room().bodies, 1)])
    with sg.Simulator(scene, SONAR, acoustics, sampling) as simulator:
        expected, (buffer,) = simulator.ping(pose, labels=True), simulator.gbuffers(pose)
        camera = sector_camera(simulator.fan.sectors[0])
    images = {
        "normals": buffer.normal[::-1] @ camera.rotation,
        "body_id": buffer.body_id[::-1],
        "holds": "range",
    }
    with embed.Sensor(SONAR, acoustics, sampling) as sensor:
        ping = sensor.ping_from_depth(
            buffer.range_m[::-1], camera, pose, reflectivity=mus, labels=True, bodies=list(ROOM), **images
        )
    # float32 rounds ranges and normals: an error of 1e-5 of a bin at most, where planes are steep
    assert wrong(ping, expected) < 1e-5
    assert np.abs(ping.intensity - expected.intensity).max() < 1e-4 * expected.intensity.max()
    assert (ping.body_id == expected.body_id).all()
    assert np.allclose(ping.elevation_rad, expected.elevation_rad, atol=1e-4, equal_nan=True)
    assert np.allclose(ping.body_echo, expected.body_echo, rtol=1e-5)
    same = set(expected.meta) - {"engine", "gl_renderer", "scene"}
    assert {key: ping.meta[key] for key in same} == {key: expected.meta[key] for key in same}
    assert ping.meta["gl_renderer"] == "none: depth image"
    assert (ping.pose == pose).all()


@pytest.mark.slow
@pytest.mark.parametrize("with_normals", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_error_falls_with_the_resolution(truth, with_normals):
    errors = []
    for columns in (120, 240, 480, 960):
        camera = camera_of(SONAR, columns)
        _, depth, normals, _ = ROOM_CAST.images(camera)
        ping = ping_of(depth, camera, normals=normals if with_normals else None)
        errors.append(wrong(ping, truth))
    # silhouettes fall on whole pixels, so the error falls with their width, from a third of a degree on
    assert errors[0] > errors[1] > errors[2] > errors[3]
    assert errors[0] < 0.02 and errors[3] < 0.003


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.5, 2.0])
def test_a_floor_at_grazing_incidence_has_no_rings(height):
    sonar = sonar_of(range_m=30.0, n_bins=1200)
    camera = camera_of(sonar, 320)
    _, depth, normals, _ = Cast(plane([0, 0, -1], height)).images(camera)
    top = math.radians(8.0)
    exact = 0.5 * box_beams(
        sonar, lambda psi: plane_echo((0, 0, -1), height, psi, (-top, top), sonar.bin_edges_m), 20
    )
    inside = slice(*np.searchsorted(sonar.bin_edges_m, [height / math.sin(top) + 0.1, 29.9]))
    pings = [sg.ping_from_depth(depth, sonar, camera, IDEAL, normals=n) for n in (normals, None)]
    for ping in pings:
        # at 30 m and one degree of depression a row of pixels covers 3 m, 120 bins, without gaps
        assert np.abs(ping.intensity[:, inside] / exact[:, inside] - 1).max() < 0.01
    dropped = sg.Sampling(4, 150, "point")
    rings = sg.ping_from_depth(depth, sonar, camera, IDEAL, sampling=dropped, normals=normals)
    assert (rings.intensity[:, inside] == 0).mean() > 0.3


@pytest.mark.parametrize(
    "turn",
    [
        pytest.param("roll 90", marks=pytest.mark.slow),
        pytest.param("aside 20", marks=pytest.mark.slow),
        "down 5, roll -30",
    ],
)
def test_a_rotated_camera_gives_the_same_ping(truth, turn):
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    if turn == "roll 90":
        like = camera_of(SONAR, 640)
        K = [[like.intrinsics[0, 0], 0, (like.height - 1) / 2], [0, like.intrinsics[0, 0], 319.5], [0, 0, 1]]
        camera = sg.Camera(like.height, 640, K, AHEAD @ quarter)
    elif turn == "aside 20":
        camera = sg.Camera.of_fov(
            1100, 320, math.radians(88), rotation=sg.pose(yaw=math.radians(20))[:3, :3] @ AHEAD
        )
    else:
        rotation = sg.pose(roll=math.radians(-30), pitch=math.radians(5))[:3, :3] @ AHEAD
        camera = sg.Camera.of_fov(480, 480, math.radians(48), rotation=rotation)
    _, depth, normals, body = ROOM_CAST.images(camera)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no warning: the cameras cover the fan
        for face_normals in (normals, None):
            ping = ping_of(depth, camera, normals=face_normals, body_id=body, labels=True)
            assert wrong(ping, truth) < 0.02  # the error of an upright camera with such pixels
            # the strongest body differs only in bins that two bodies share
            assert (ping.body_id != truth.body_id).mean() < 0.01


@pytest.mark.parametrize(("fov_deg", "n_cameras"), [(130.0, 2), (130.0, 3), (360.0, 4), (360.0, 3)])
def test_several_cameras_see_a_wide_fan_without_seams(fov_deg, n_cameras):
    n_beams = int(fov_deg)
    sonar = sonar_of(fov_deg, n_beams, 10.0)
    if (fov_deg, n_cameras) in ((130.0, 2), (360.0, 4)):
        cameras = sg.Camera.covering(sonar, IDEAL, pixel_deg=0.2)
    else:  # images that meet without overlap
        share = math.radians(fov_deg) / n_cameras
        yaws = [share * (k - (n_cameras - 1) / 2) for k in range(n_cameras)]
        cameras = [
            sg.Camera.of_fov(
                int(share / math.radians(0.2)), 140, share, rotation=sg.pose(yaw=yaw)[:3, :3] @ AHEAD
            )
            for yaw in yaws
        ]
    assert len(cameras) == n_cameras
    # an upright pipe around the sonar, seen from inside
    depth = [8.01 / np.hypot(*np.moveaxis(rays_of(camera), -1, 0)[:2]) for camera in cameras]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pings = [
            sg.ping_from_depth(depth, sonar, cameras, IDEAL, holds="range", normals=normals)
            for normals in ([inward(camera) for camera in cameras], None)
        ]
    top = math.radians(5.0)
    exact = 0.5 * plane_echo((1, 0, 0), 8.01, np.zeros((1, 1)), (-top, top), sonar.bin_edges_m)[0]
    exact /= 2 * math.sin(top)
    for ping in pings:
        # all beams are equal, also at the seams, apart from the wall's curvature within a pixel
        assert np.abs(ping.intensity - exact).sum(1).max() / exact.sum() < 2e-3


def rays_of(camera):
    """Return unit rays, (H, W, 3), sonar frame."""
    j, i = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([i, j, np.ones_like(i)], -1) @ np.linalg.inv(camera.intrinsics).T @ camera.rotation.T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def inward(camera):
    """Return the normals of an upright pipe around the sonar, (H, W, 3), camera axes."""
    return (rays_of(camera) * [1, 1, 0]) @ camera.rotation


def test_body_numbers_of_pixels_become_labels(truth):
    camera = camera_of(SONAR, 960)
    _, depth, normals, body = ROOM_CAST.images(camera)
    with embed.Sensor(SONAR, IDEAL) as sensor:
        ping = sensor.ping_from_depth(
            depth, camera, normals=normals, body_id=body.astype(np.int32), bodies=tuple(ROOM), labels=True
        )
        unknown = np.where(body == 2, 0, body)
        partly = sensor.ping_from_depth(depth, camera, normals=normals, body_id=unknown, labels=True)
        bare = sensor.ping_from_depth(depth, camera, normals=normals, labels=True)
        unlabelled = sensor.ping_from_depth(depth, camera, normals=normals)
    assert ping.meta["bodies"] == list(ROOM)
    assert (ping.body_id != truth.body_id).mean() < 0.005
    assert np.allclose(ping.body_echo, truth.body_echo, rtol=0.01)
    both = (ping.body_id == truth.body_id) & (truth.intensity > 1e-3)
    assert np.median(np.abs(ping.elevation_rad - truth.elevation_rad)[both]) < math.radians(0.05)
    # pixels with number 0 still echo, and stay distinct from the numbered bodies
    assert (partly.intensity == ping.intensity).all()
    assert (partly.body_id == np.where(ping.body_id == 2, 0, ping.body_id)).all()
    assert np.array_equal(partly.elevation_rad, ping.elevation_rad, equal_nan=True)
    assert partly.body_echo[0] == ping.body_echo[2] and partly.body_echo[2] == 0
    assert (partly.body_echo[[1, 3, 4]] == ping.body_echo[[1, 3, 4]]).all()
    assert not bare.body_id.any() and len(bare.body_echo) == 1
    assert bare.body_echo[0] == pytest.approx(ping.body_echo.sum(), rel=1e-6)
    assert unlabelled.body_id is None and (unlabelled.intensity == ping.intensity).all()


def test_reflectivity_by_pixel_and_by_body():
    _, depth, normals, body = ROOM_CAST.images(CAMERA)
    mus = np.array([0.5, 0.1, 0.9, 0.5, 0.5])
    with embed.Sensor(SONAR, IDEAL) as sensor:

        def ping(mu, **more):
            return sensor.ping_from_depth(depth, CAMERA, normals=normals, reflectivity=mu, **more)

        by_pixel = ping(mus[body], body_id=body)
        by_body = ping({1: 0.1, 2: 0.9, 77: 1.0}, body_id=body, labels=True)
        labelled = ping(0.5, body_id=body, labels=True)
        assert (by_pixel.intensity == by_body.intensity).all()
        assert np.allclose(by_body.body_echo[1:5], labelled.body_echo[1:5] * mus[1:] / 0.5, rtol=1e-5)
        assert np.allclose(ping(1).intensity, 2 * labelled.intensity, rtol=1e-6)


@pytest.mark.parametrize("missing", [0.0, np.nan, -np.inf])
def test_pixels_without_depth_are_empty(missing):
    shapes = box([9, 1, -2], [11, 3, 1]), sphere([12, -3, 0], 1.0), plane([0, 0, -1], 0.6)
    _, depth, normals, _ = Cast(*shapes).images(CAMERA)
    holes = ~np.isfinite(depth) | (depth > 160)
    assert 0.3 < holes.mean() < 0.7
    pings = []
    for face_normals in (normals, None):
        with embed.Sensor(SONAR, IDEAL) as sensor:
            with_inf = sensor.ping_from_depth(np.where(holes, np.inf, depth), CAMERA, normals=face_normals)
            pings.append(
                sensor.ping_from_depth(np.where(holes, missing, depth), CAMERA, normals=face_normals)
            )
        # Pixels of a far plane are empty, too, and do not bend the estimated planes of pixels before it.
        assert (pings[-1].intensity == with_inf.intensity).all()
    # they are those of the faces, but for some pixels at edges and of the sphere, whose errors cancel to 2e-5
    assert pings[1].intensity.sum() == pytest.approx(pings[0].intensity.sum(), rel=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("columns", [400, *(pytest.param(n, marks=pytest.mark.slow) for n in (800, 1600))])
def test_a_thin_rod_has_the_echo_of_its_closed_form(columns):
    """The rod is 3 cm thick at 8 m, 0.21 degrees: two, four and eight pixels wide."""
    sonar = sonar_of(n_beams=20)
    camera = camera_of(sonar, columns)
    shapes = cylinder(8.0, 0.37, 0.015, -5, 5), plane([1, 0, 0], 15)
    _, depth, normals, _ = Cast(*shapes).images(camera)
    top, distance, azimuth = math.radians(8.0), math.hypot(8, 0.37), math.atan2(0.37, 8)

    def rod(psi):
        return cylinder_echo(0.015, distance, psi - azimuth, -5, 5, top, sonar.bin_edges_m)

    exact = 0.5 * box_beams(sonar, rod, 500).sum()  # 50 nodes on the rod: to 2 %
    near = sonar.range_m < 10
    for face_normals in (normals, None):
        ping = sg.ping_from_depth(depth, sonar, camera, IDEAL, normals=face_normals)
        got = ping.intensity[:, near].sum()
        # each pixel shows either the rod or the wall
        assert got == pytest.approx(exact, rel=0.7 * 400 / columns / 2)
        # the rod echoes at its own range only, with no spurious surface between it and the wall
        lit = sonar.range_m[near & (ping.intensity.max(0) > 1e-2 * ping.intensity[:, near].max())]
        assert lit.min() > 7.9 and lit.max() < 8.2
        between = (sonar.range_m > 8.5) & (sonar.range_m < 14.9)
        assert ping.intensity[:, between].sum() < 1e-3 * got


def test_surfaces_one_pixel_wide_are_taken_to_face_the_camera():
    camera = camera_of(SONAR, 200)
    depth = np.full((camera.height, 200), 15.0)
    depth[:, 60] = depth[20, 120:160] = 8.0
    facing = np.broadcast_to([0, 0, 1.0], (*depth.shape, 3))
    known, found = (ping_of(depth, camera, normals=n) for n in (facing, None))
    near = SONAR.range_m < 14
    assert known.intensity[:, near].sum() > 0
    # the vertical and the horizontal line agree, except at their ends
    assert wrong(found.intensity[:, near], known.intensity[:, near]) < 1e-3


@pytest.mark.slow
def test_a_sphere_and_its_limb():
    camera = camera_of(SONAR, 960)
    _, depth, normals, _ = Cast(sphere([8, 0.5, 0.0], 1.0)).images(camera)
    body = sg.Body("ball", trimesh.creation.icosphere(6, 1.0), sg.pose(8, 0.5, 0))
    with sg.Simulator(sg.Scene([body]), SONAR, IDEAL, tolerance=0.002) as simulator:
        exact = simulator.ping(np.eye(4))
    for face_normals in (normals, None):
        ping = ping_of(depth, camera, normals=face_normals)
        assert wrong(ping, exact) < 0.005


def hints(depth, camera=CAMERA, n=1, **more) -> list[str]:
    """Return the warnings of some pings of a new sensor."""
    with warnings.catch_warnings(record=True) as caught, embed.Sensor(SONAR, IDEAL) as sensor:
        warnings.simplefilter("always")
        for _ in range(n):
            sensor.ping_from_depth(depth, camera, **more)
    return [str(one.message) for one in caught]


PITCHED = sg.pose(pitch=0.3, yaw=0.5)[:3, :3]


@pytest.mark.parametrize(
    "change",
    [
        lambda n: n @ (PITCHED @ CAMERA.rotation).T,  # those of the world
        lambda n: n @ CAMERA.rotation.T,  # those of the sonar
    ],
)
def test_normals_in_other_axes_give_a_hint_once(change):
    """They moved most of the echo into other bins without a word."""
    _, depth, normals, _ = ROOM_CAST.images(CAMERA)
    found = hints(depth, n=2, normals=change(normals))
    assert found == [
        "normals do not fit the depths: half of them are more than 60° off the surfaces that the depths show "
        "(give them in the camera's optical axes, x right, y down, z ahead, of textures in the view's axes)"
    ]


@pytest.mark.parametrize("noise_m", [pytest.param(0.0, marks=pytest.mark.slow), 0.02])
def test_normals_that_fit_the_depths_give_no_hint(noise_m):
    random = np.random.default_rng(0)
    distances, depth, normals, _ = ROOM_CAST.images(CAMERA)
    noise = random.normal(0, noise_m, depth.shape)
    assert not hints(depth + noise, normals=normals)
    assert not hints(distances + noise, normals=-3 * normals, holds="range")
    some = normals.copy()
    some[: CAMERA.height // 2] = 0  # estimated there
    some[CAMERA.height // 2 :, ::3] = np.nan
    assert not hints(depth + noise, normals=some)
    assert not hints([depth, depth], [CAMERA, CAMERA], normals=[normals, 0 * normals])
    assert not hints(np.where(random.random(depth.shape) < 0.7, depth, 0), normals=normals)
    tiny = sg.Camera.of_fov(3, 2, fov_x_rad=1.0)
    assert not [one for one in hints(np.ones((2, 3)), tiny, normals=np.ones((2, 3, 3))) if "normals" in one]


def test_normals_of_walls_far_aside_of_a_wide_camera_fit_the_depths():
    camera = sg.Camera.of_fov(400, 100, math.radians(150), math.radians(60))
    distances, depth, normals, _ = Cast(plane([0, 1, 0], 2.0), plane([0, -1, 0], 2.0)).images(camera)
    assert not hints(depth, camera, normals=normals)
    assert not hints(distances, camera, normals=normals, holds="range")
    assert hints(depth, camera, normals=normals[..., ::-1])


def test_normals_of_poles_before_a_wall_fit_the_depths():
    """Most pixels have others of another surface four pixels aside, and planes through both are those of none."""
    random = np.random.default_rng(0)
    poles = [
        cylinder(distance, distance * sine, 0.03, -5, 5)
        for distance, sine in zip(random.uniform(4, 12, 150), random.uniform(-0.5, 0.5, 150), strict=True)
    ]
    for columns in (100, 200):
        camera = sg.Camera.of_fov(columns, columns // 2, math.radians(60), math.radians(30))
        _, depth, normals, _ = Cast(*poles, plane([1, 0, 0], 15)).images(camera)
        assert not hints(depth, camera, normals=normals)
    assert hints(depth, camera, normals=normals[..., ::-1])  # of the wall, between


@pytest.mark.parametrize(("entry", "normal"), [((0, 1), [0, 1, 0]), ((1, 0), [0, 0, 1])])
def test_normals_fit_the_depths_of_a_camera_that_shears_its_image(entry, normal):
    K = np.array(sg.Camera.of_fov(200, 100, math.radians(90), math.radians(60)).intrinsics)
    K[entry] = 1.2 * K[0, 0]
    camera = sg.Camera(200, 100, K)
    _, depth, normals, _ = Cast(plane(normal, 2.0), plane(np.negative(normal), 2.0)).images(camera)
    assert not [hint for hint in hints(depth, camera, normals=normals) if "normals" in hint]
    assert hints(depth, camera, normals=np.roll(normals, 1, axis=-1))[-1].startswith("normals do not fit")


def test_depth_in_float16_gives_a_hint():
    _, depth, _, _ = ROOM_CAST.images(CAMERA)
    rounded = depth.astype(np.float16)
    assert hints(rounded) == ["depth in float16 is rounded, by up to 4 mm from 8 m on (hand over float32)"]
    assert not hints(rounded.astype(np.float32))


def test_normals_may_have_any_length():
    """Longer than 1e19 counted as none, since the square of a float32 overflows."""
    sonar = sg.load_sonar("p900-45")
    (camera,) = sg.Camera.covering(sonar)
    depth = np.full((camera.height, camera.width), 6.0)
    normals = np.broadcast_to(np.float32([0.75, 0, -0.5]), (*depth.shape, 3))
    pings = [
        sg.ping_from_depth(depth, sonar, camera, IDEAL, normals=normals * np.float32(2.0**power)).intensity
        for power in (0, -100, 66, 120)
    ]
    assert pings[0].sum() < 0.7 * sg.ping_from_depth(depth, sonar, camera, IDEAL).intensity.sum()
    for other in pings[1:]:
        np.testing.assert_array_equal(other, pings[0])


def test_edge_on_faces_and_invalid_normals_stay_finite():
    _, depth, normals, _ = ROOM_CAST.images(CAMERA)
    found = ping_of(depth)
    for none in (0.0, np.nan, np.inf):
        assert (ping_of(depth, normals=0 * normals + none).intensity == found.intensity).all()
    other = ping_of(depth, normals=-3.0 * normals)
    assert np.allclose(other.intensity, ping_of(depth, normals=normals).intensity, rtol=1e-4, atol=1e-7)
    rays = rays_of(CAMERA) @ CAMERA.rotation
    across = np.cross(rays, [0.0, 1.0, 0.0])
    for tilt in (0.0, 1e-9, 1e-4):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ping = ping_of(depth, normals=across + tilt * rays)
        assert np.isfinite(ping.intensity).all() and (ping.intensity >= 0).all()
        assert ping.intensity.sum() < 1e-3 * found.intensity.sum()
    rng = np.random.default_rng(1)  # random depths, which form no surface
    noise = np.exp(rng.normal(1, 3, depth.shape))
    assert np.isfinite(ping_of(noise).intensity).all()


def test_samples_are_finite_and_empty_ones_are_zero():
    """Samples of planes through the sonar, and of rays past a floor's horizon, are finite."""
    (sector,) = make_fan(SONAR, sg.Sampling(4, 200), BeamShape(0.004)).sectors
    camera, thread = camera_of(SONAR, 64), SecondThread()
    planes, none = PixelPlanes(camera, thread), np.empty((0, 0), np.uint16)
    shape = sector.rows, sector.columns
    _, depth, normals, _ = Cast(plane([0, 0, -1], 0.1)).images(camera)
    across = np.cross(rays_of(camera) @ camera.rotation, [0.0, 1.0, 0.0])  # edge-on within rounding
    depth_up = np.full(depth.shape, 5.0)
    for image, face_normals in ((depth, normals), (depth_up, across)):
        plane_echo = np.zeros((*shape, 4), np.float32)
        samples = SectorSamples(sector, plane_echo, np.zeros(shape, np.uint16))
        planes.find(image.astype(np.float32), True, face_normals.astype(np.float32), 0.5)
        planes.sample(samples, none, True, True)
        assert np.isfinite(plane_echo).all()
        unseen, met = plane_echo[..., 0] == UNSEEN, plane_echo[..., 0] > 0
        assert met.any() and not plane_echo[~met & ~unseen].any()
    thread.close()
    # its first pixel looks straight ahead; the plane passes through the camera
    middle = sg.Camera(3, 3, np.diag([1.0, 1, 1]))
    planes = PixelPlanes(middle, SecondThread())
    planes.find(np.ones((3, 3), np.float32), True, np.full((3, 3, 3), [1, 0, 0], np.float32), 0.5)
    assert np.isfinite(planes.planes).all() and planes.planes[0, 0, 3] == 0


def test_memory_layout_and_type_of_images_do_not_matter():
    _, depth, normals, body = ROOM_CAST.images(CAMERA)
    kwargs = {"normals": normals, "body_id": body, "labels": True}
    one = ping_of(depth, **kwargs)
    turned = {
        "normals": normals.astype("f4")[:, ::-1][:, ::-1],
        "body_id": np.asfortranarray(body, np.uint16),
    }
    other = ping_of(np.asfortranarray(depth, np.float32), labels=True, **turned)
    assert (one.intensity == other.intensity).all() and (one.body_id == other.body_id).all()
    listed = sg.ping_from_depth(
        [depth], SONAR, [CAMERA], IDEAL, normals=[normals], body_id=[body], labels=True
    )
    assert (one.intensity == listed.intensity).all()
    before = one.intensity.copy()
    ping_of(depth / 2)
    assert (one.intensity == before).all() and not one.intensity.flags.writeable


def test_noise_velocity_and_pose_act_as_in_other_pings():
    _, depth, _, _ = ROOM_CAST.images(CAMERA)
    noise, pose, velocity = sg.Noise.physical(), sg.pose(1, 2, 3), [1.0, 0, 0, 0, 0, 0.3]
    with embed.Sensor(SONAR) as sensor:

        def ping(**more):
            return sensor.ping_from_depth(depth, CAMERA, pose, **more)

        quiet = ping(seed=7)
        noisy = ping(noise=noise, seed=7, ping_number=3)
        assert (noisy.intensity == ping(noise=noise, seed=7, ping_number=3).intensity).all()
        assert (noisy.intensity == add_noise(quiet, noise, 7, 3).intensity).all()
        assert (noisy.intensity != ping(noise=noise, seed=8, ping_number=3).intensity).any()
        assert (noisy.intensity != ping(noise=noise, seed=7, ping_number=4).intensity).any()
        assert noisy.meta["ping_number"] == 3 and (noisy.pose == pose).all()
        moving = ping(velocity=velocity)
        assert (moving.intensity == shown_in_motion(quiet, velocity).intensity).all()
        assert (moving.intensity != quiet.intensity).any() and moving.meta["velocity"] == velocity
        # place-locked speckle depends on the pose
        locked = sg.Noise(speckle=True, follow_motion=True)
        there = sensor.ping_from_depth(depth, CAMERA, sg.pose(2, 2, 3), noise=locked, seed=7)
        assert (ping(noise=locked, seed=7).intensity != there.intensity).any()
        assert (sensor.ping_from_depth(depth, CAMERA).pose == np.eye(4)).all()
        # and without one each ping has its own
        numbered = [
            sensor.ping_from_depth(depth, CAMERA, noise=locked, ping_number=n).intensity for n in (0, 1)
        ]
        assert (numbered[0] != numbered[1]).any()


def test_a_warning_names_what_the_cameras_do_not_see_once():
    narrow = sg.Camera.of_fov(300, 300, math.radians(20))
    depth = np.full((300, 300), 5.0)
    with embed.Sensor(SONAR, IDEAL) as sensor:
        with pytest.warns(
            UserWarning, match=r"see (49|50)\.\d % of the sonar's fan.*±20° and elevations within ±8°"
        ) as caught:
            sensor.ping_from_depth(depth, narrow)
        assert len(caught) == 1 and caught[0].filename == __file__
        again = sg.Camera(300, 300, narrow.intrinsics)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ping = sensor.ping_from_depth(depth, again)
            assert (ping.intensity[:18] == 0).all() and (ping.intensity[22:58].sum(1) > 0).all()
            cameras = sg.Camera.covering(SONAR, IDEAL)
            sensor.ping_from_depth([np.full((c.height, c.width), 5.0) for c in cameras], cameras)
        backwards = sg.Camera(300, 300, narrow.intrinsics, np.diag([-1.0, -1, 1]) @ AHEAD)
        with pytest.raises(sg.Error, match="must look into the sonar's fan"):
            sensor.ping_from_depth(depth, backwards)
    with pytest.warns(UserWarning, match="% of the sonar's fan") as caught:
        ping_of(depth, narrow, sampling=sg.Sampling(1, 20))
    assert caught[0].filename == __file__


def test_half_a_per_cent_of_the_fan_that_no_camera_sees_is_warned_of():
    """39.8 of 40 degrees."""
    camera, depth = sg.Camera.of_fov(30, 30, math.radians(39.8)), np.full((30, 30), 5.0)
    with pytest.warns(UserWarning, match=r"^the cameras see 99\.[456] % of the sonar's fan, and the rest"):
        ping_of(depth, camera, sampling=sg.Sampling(1, 20))


@pytest.mark.parametrize(
    ("distance", "more", "why"),
    [
        (30.0, {}, "lies at 30.0. m, beyond range_max_m = 20"),
        (0.5, {}, "lies at 0.50 m, nearer than range_min_m = 1"),
        (5.0, {"reflectivity": 0}, "lies at 5.00 m; its reflectivity is 0"),
        (np.inf, {}, "what was drawn shows no surface in the fan"),
    ],
)
def test_a_warning_says_why_a_ping_has_no_echo(distance, more, why):
    sonar = replace(SONAR, range_min_m=1.0)
    camera = camera_of(sonar, 400)
    with pytest.warns(UserWarning, match=f"^no echo came back: .*{why}") as caught:
        ping = sg.ping_from_depth(np.full((camera.height, 400), distance), sonar, camera, IDEAL, **more)
    assert len(caught) == 1 and caught[0].filename == __file__
    assert not ping.intensity.any() and not ping.meta["has_echo"]


def test_later_pings_reuse_the_beamformer_of_the_first(monkeypatch):
    depth = np.full(SHAPE, 5.0)
    first = ping_of(depth)

    def forbidden(*_, **_more):
        raise AssertionError("made again")

    monkeypatch.setattr("sonar_gl.embed.sensor.make_beamformer", forbidden)
    equal = replace(SONAR), sg.Camera(CAMERA.width, CAMERA.height, CAMERA.intrinsics), sg.Acoustics.ideal()
    assert (sg.ping_from_depth(depth, *equal).intensity == first.intensity).all()
    with pytest.raises(AssertionError, match="made again"):
        sg.ping_from_depth(depth, replace(SONAR, n_beams=81), CAMERA, IDEAL)


def test_the_rigs_of_the_cameras_that_were_used_last_are_kept(monkeypatch):
    """Those of cameras that differ by their intrinsics alone."""
    cameras, made = [sg.Camera.of_fov(64, 48, fov_rad) for fov_rad in (0.9, 1.0, 1.1)], []

    class CountedRig(camera_rig.CameraRig):
        def __init__(self, sonar, rig, *more):
            made.append(cameras.index(rig[0]))
            super().__init__(sonar, rig, *more)

    monkeypatch.setattr("sonar_gl.embed.sensor.CameraRig", CountedRig)
    monkeypatch.setattr("sonar_gl.embed.sensor.MAX_RIGS", 2)
    with embed.Sensor(SONAR, IDEAL, sg.Sampling(1, 16)) as sensor:
        for number in (0, 1, 0, 2, 0, 1):
            sensor.ping_from_depth(np.full((48, 64), 5.0), cameras[number])
    assert made == [0, 1, 2, 1]


def test_labels_may_have_the_highest_number_of_a_body():
    camera = camera_of(SONAR, 64)
    depth = np.full((camera.height, camera.width), 5.0)
    with embed.Sensor(SONAR, IDEAL, sg.Sampling(1, 16)) as sensor:
        ping = sensor.ping_from_depth(depth, camera, body_id=np.full(depth.shape, 65534), labels=True)
        assert ping.body_id.max() == 65534 and ping.meta["bodies"][-1] == "body 65534"
        with pytest.raises(sg.Error, match=r"numbers of bodies must lie in 1\.\.65534"):
            sensor.ping_from_depth(depth, camera, bodies=["a"] * 65535)


def test_samples_are_as_fine_as_pixels():
    sonar = sonar_of(90.0, 64, 20.0)
    for pixel_deg in (0.1, 0.3):
        cameras = sg.Camera.covering(sonar, IDEAL, pixel_deg)
        sampling = camera_rig.finest_sampling(sonar, cameras)
        assert sampling.columns_per_beam * 64 == pytest.approx(90 / pixel_deg, rel=1e-3)
        assert sampling.rows == pytest.approx(2 * math.tan(math.radians(10)) / math.radians(pixel_deg), abs=1)
    wide = sg.Camera.of_fov(
        400, 100, math.radians(90), math.radians(40)
    )  # pixels of 2 tan 45° / 400 by 2 tan 20° / 100
    sampling = camera_rig.finest_sampling(sonar, [wide])
    assert sampling.columns_per_beam * 64 == pytest.approx(math.radians(90) / (2 / 400), rel=1e-9)
    assert sampling.rows == math.ceil(100 * math.tan(math.radians(10)) / math.tan(math.radians(20)))
    large = camera_rig.finest_sampling(sonar, [sg.Camera.of_fov(8000, 8000, fov_x_rad=math.pi / 2)])
    assert large.columns_per_beam * 64 * large.rows == pytest.approx(camera_rig.MAX_SAMPLES, rel=1e-3)


GOOD = np.full((30, 40), 5.0)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            {"depth": np.zeros(3)},
            r"depth must have the shape of the camera's image, \(30, 40\) \(got \(3,\)\)",
        ),
        ({"depth": GOOD.T}, r"depth must have the shape .* \(got \(40, 30\)\)"),
        ({"depth": GOOD[..., None]}, r"depth must have the shape"),
        ({"depth": (1000 * GOOD).astype(np.uint16)}, "depth must be metres in floating point .*uint16"),
        ({"depth": GOOD.astype(complex)}, "depth must be an array of numbers"),
        ({"depth": [[1.0], [1.0, 2.0]]}, "depth must have the shape"),
        ({"normals": GOOD}, r"normals must have the shape of the camera's image, \(30, 40, 3\)"),
        ({"body_id": GOOD}, "body_id must hold whole numbers"),
        ({"body_id": np.full((30, 40), -1)}, "body_id must lie in 0..65534.*got -1"),
        ({"body_id": np.full((30, 40), 65535)}, "body_id must lie in 0..65534.*65535"),
        ({"reflectivity": 1.5}, "reflectivity must lie in 0..1"),
        (
            {"reflectivity": "sand"},
            r"reflectivity must be a number in 0..1 \(got 'sand'; "
            r"sonar_gl.scene.materials.material\('sand'\).reflectivity is that of a material\)",
        ),
        (
            {"reflectivity": {1: "sand"}, "body_id": np.ones((30, 40), int)},
            r"reflectivity must be a number in 0..1 \(got 'sand'; .*material\('sand'\).reflectivity",
        ),
        (
            {"reflectivity": np.full((30, 40), np.nan)},
            "reflectivity must lie in 0..1 where depth shows a surface .got NaN in 1200 of these pixels",
        ),
        ({"reflectivity": np.zeros((3, 4))}, "reflectivity must have the shape"),
        ({"reflectivity": {1: 0.2}}, "reflectivity by numbers of bodies needs body_id"),
        ({"reflectivity": {"rock": 0.2}, "body_id": np.ones((30, 40), int)}, "must name numbers of bodies"),
        ({"reflectivity": {1: 2.0}, "body_id": np.ones((30, 40), int)}, "reflectivity must lie in 0..1"),
        ({"camera": "wide"}, "camera must be a Camera"),
        ({"camera": []}, "list of at least one"),
        ({"camera": [None]}, "camera must be a Camera"),
        ({"several": 2, "depth": GOOD}, "depth must be a list of .* cameras, 2 .got ndarray"),
        (
            {"several": 1},
            "depth must be a list of .* cameras, 1 .got ndarray; or give the camera alone, without a list",
        ),
        ({"several": 2, "depth": [GOOD]}, "depth must be a list .*cameras, 2 .got 1 of them"),
        ({"several": 1, "depth": [GOOD], "normals": np.zeros((30, 40, 3))}, "normals must be a list"),
        ({"bodies": "rock"}, "bodies must be a list of names, that of number 1 first .got str"),
        ({"bodies": None}, "bodies must be a list of names, that of number 1 first .got NoneType"),
        ({"bodies": [3]}, "each of bodies must be a str .got int"),
        ({"holds": "z-buffer"}, "holds must be 'planar', .* .got 'z-buffer'; embed.metres_ahead undoes"),
        ({"holds": True}, "holds must be 'planar', .* .got True"),
        ({"depth": "near.png"}, "depth must be an array of numbers .got str"),
        ({"depth": None}, "depth must be an array of numbers .got NoneType"),
        ({"normals": np.full((30, 40, 3), 128, np.uint8)}, "normals must be in floating point .got uint8"),
        ({"pose": np.eye(3)}, "pose must have shape"),
        ({"seed": -1}, "seed must be a whole number"),
        ({"noise": "physical"}, "noise must be a Noise"),
        ({"velocity": [1.0]}, "velocity"),
        ({"sonar": "p900-45"}, "sonar must be a Sonar"),
        ({"sonar": {}}, "sonar must be a Sonar"),
        ({"acoustics": "ideal"}, "acoustics must be an Acoustics"),
        ({"sampling": 3}, "sampling must be a Sampling"),
        ({"acoustics": sg.Acoustics(multipath="coherent")}, 'must have multipath "none".*use a Simulator'),
    ],
)
def test_invalid_arguments_raise_errors(more, message):
    camera = sg.Camera.of_fov(40, 30, math.radians(50))
    kwargs = {"depth": GOOD, "sonar": SONAR, "camera": camera, "acoustics": IDEAL} | more
    if several := kwargs.pop("several", 0):
        kwargs["camera"] = [camera] * several
    with pytest.raises(sg.Error, match=message) as caught:
        sg.ping_from_depth(**kwargs)
    assert "\n" not in str(caught.value)


def test_masked_pixels_are_empty():
    depth, mask = np.full(SHAPE, 5.0), np.zeros(SHAPE, bool)
    mask[:, CAMERA.width // 2 :] = True  # the starboard half
    masked = ping_of(np.ma.array(depth, mask=mask))
    holes = ping_of(np.where(mask, np.nan, depth))
    assert np.array_equal(masked.intensity, holes.intensity) and masked.intensity.any()
    assert masked.intensity[: SONAR.n_beams // 4].sum() == 0


def test_reflectivity_may_be_unknown_where_a_pixel_is_empty():
    depth, mu = np.full(SHAPE, 6.0), np.full(SHAPE, 0.4)
    for row, empty in enumerate((0.0, -1.0, np.nan, np.inf)):
        depth[row] = empty
    mu[:4] = np.nan
    unknown = ping_of(depth, reflectivity=mu)
    known = ping_of(depth, reflectivity=np.nan_to_num(mu))
    assert np.array_equal(unknown.intensity, known.intensity) and known.intensity.any()
    mu[4, :3] = np.nan
    with pytest.raises(sg.Error, match="got NaN in 3 of these pixels"):
        ping_of(depth, reflectivity=mu)


def z_buffer_hints(depth, sonar=SONAR) -> int:
    """Return how many warnings say that depth looks like a z-buffer."""
    with warnings.catch_warnings(record=True) as caught, embed.Sensor(sonar, IDEAL) as sensor:
        warnings.simplefilter("always")
        sensor.ping_from_depth(depth, CAMERA)
    return sum("as a z-buffer does" in str(one.message) for one in caught)


@pytest.mark.parametrize("near_m", [0.01, 0.1])
@pytest.mark.parametrize("some_cleared", [False, True])
@pytest.mark.parametrize("is_reversed", [False, True])
def test_every_z_buffer_in_place_of_depth_gives_a_hint(is_reversed, some_cleared, near_m):
    """Early versions gave it only if the largest value was exactly 1."""
    tilted = np.linspace(1.5, 18, CAMERA.width)
    for metres in (np.full(SHAPE, 6.0), np.tile(tilted, (CAMERA.height, 1))):
        if some_cleared:
            metres[:, :9] = np.inf
        depth = near_m / metres if is_reversed else 1 - near_m / metres
        assert z_buffer_hints(depth) == 1


def test_metres_give_no_hint_of_a_z_buffer():
    shape = CAMERA.height, CAMERA.width
    small = np.zeros(shape)
    small[3:9, 3:9] = 0.95  # something before the camera, and nothing else
    metres = {
        "wall": np.full(shape, 0.8),
        "walls": np.tile(np.linspace(0.6, 0.99, CAMERA.width), (CAMERA.height, 1)),
        "corner of a tank": np.tile(np.linspace(0.05, 0.9, CAMERA.width), (CAMERA.height, 1)),
        "small": small,
        "far": np.tile(np.linspace(0.95, 1.05, CAMERA.width), (CAMERA.height, 1)),
        "nothing": np.zeros(shape),
    }
    hints = {name: z_buffer_hints(depth) for name, depth in metres.items()}
    assert hints == dict.fromkeys(metres, 0)
    short = replace(SONAR, range_min_m=0.1, range_max_m=2.0)
    assert z_buffer_hints(np.full(shape, 0.95), short) == 0


def test_a_z_buffer_in_place_of_depth_warns_once():
    projection, metres = CAMERA.projection(0.1, 50.0), np.full(SHAPE, 6.0)
    metres[: CAMERA.height // 4] = 50.0
    ndc = (-projection[2, 2] * metres + projection[2, 3]) / metres
    z_buffer = (ndc + 1) / 2
    z_buffer[: CAMERA.height // 4] = 1.0
    with (
        embed.Sensor(SONAR, IDEAL) as sensor,
        pytest.warns(UserWarning, match="as a z-buffer does") as caught,
    ):
        for _ in range(2):
            sensor.ping_from_depth(z_buffer, CAMERA)
    assert len([one for one in caught if "z-buffer" in str(one.message)]) == 1
    undone = embed.metres_ahead(z_buffer, projection)
    assert (undone[: CAMERA.height // 4] == 0).all()
    np.testing.assert_allclose(undone[CAMERA.height // 4 :], 6.0, rtol=1e-4)  # float32 near 1
    for wrong, message in (
        ((np.zeros(3), projection), "z_buffer must have shape"),
        ((z_buffer, projection.T), "projection must be an OpenGL perspective"),
        (
            (np.full((2, 2), 4_000_000_000, np.uint32), projection),
            r"z_buffer must lie in 0..1 \(got 4e\+09 to 4e\+09; divide whole numbers by the largest of their type\)",
        ),
        (
            (np.full((2, 2), 5.0), projection),
            r"z_buffer must lie in 0..1 \(got 5 to 5; what holds metres already needs no conversion\)",
        ),
        (
            (z_buffer.astype(np.float16), projection),
            r"z_buffer must be in float32 \(got float16, whose steps",
        ),
        (
            ([[-0.5, 0.9]], projection),
            r"z_buffer must lie in 0..1 \(got -0.5 to 0.9; make 0..1 of -1..1 by d / 2 \+ 0.5\)",
        ),
    ):
        with pytest.raises(sg.Error, match=message):
            embed.metres_ahead(*wrong)


def test_every_body_number_of_the_labels_has_a_name():
    depth = np.full(SHAPE, 5.0)
    kwargs = {"body_id": np.full(depth.shape, 3), "labels": True}
    ping = ping_of(depth, bodies=["wall"], **kwargs)
    assert ping.meta["bodies"] == ["wall", "body 2", "body 3"]
    assert len(ping.body_echo) == 4 and ping.body_echo[3] > 0


def test_a_forked_process_may_ping():
    """Workers that load data are often forked: cached sensors have threads that the fork lacks."""
    depth = np.full(SHAPE, 5.0)
    parent_intensity = ping_of(depth).intensity

    def pings_alike():
        ping = ping_of(depth)
        assert np.array_equal(ping.intensity, parent_intensity)

    with embed.Sensor(SONAR, IDEAL) as sensor:
        sensor.ping_from_depth(depth, CAMERA)
        replies = in_fork(pings_alike, lambda: sensor.ping_from_depth(depth, CAMERA))
    refused = "a Sensor must be used in the process that made it; make one in each process"
    assert replies == ["done", refused]


def test_a_sensor_refuses_to_be_copied():
    with embed.Sensor(SONAR, IDEAL) as sensor:
        for take in (copy.copy, copy.deepcopy, pickle.dumps):
            with pytest.raises(sg.Error, match="a Sensor cannot be copied"):
                take(sensor)


@pytest.mark.slow
def test_many_camera_rigs_do_not_leak_threads():
    """A sensor caches the last few rigs: their number bounds the threads, and closing ends all threads."""
    gc.collect()  # threads of earlier tests may end meanwhile; none starts
    before = threading.active_count()
    with embed.Sensor(SONAR, IDEAL) as sensor:
        for k in range(12):
            camera = sg.Camera.of_fov(60 + 2 * k, 40, fov_x_rad=1.6, fov_y_rad=0.9)
            sensor.ping_from_depth(np.full((40, 60 + 2 * k), 5.0), camera)
            if k == 3:
                most = threading.active_count()
        wait_until(lambda: threading.active_count() <= most)  # threads end with a delay
    wait_until(lambda: threading.active_count() <= before)


@pytest.mark.slow
def test_many_depth_images_do_not_leak_memory():
    sonar = sonar_of(45.0, 64, 20.0)
    camera = sg.Camera.of_fov(160, 80, fov_x_rad=1.0)
    depth = np.full((80, 160), 5.0, np.float32)
    numbers = np.ones((80, 160), int)
    with embed.Sensor(sonar, IDEAL) as sensor:

        def run(n):
            for k in range(n):
                sensor.ping_from_depth(depth, camera, body_id=numbers, labels=k % 50 == 0)

        run(200)
        resident, used = soak.settled_bytes(), soak.allocated()
        run(800)
        soak.check_growth(used, resident, 800)
