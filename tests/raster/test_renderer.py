"""The depth and normal pass against geometry and its NumPy twin."""

import math
from dataclasses import replace
from itertools import product

import moderngl
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.boundary import cos_incidence, plane_of
from sonar_gl.gl import context as gl
from sonar_gl.gl import driver
from sonar_gl.gl import shaders as programs
from sonar_gl.gl.functions import Functions
from sonar_gl.raster.opengl import renderer
from sonar_gl.raster.opengl.renderer import RenderTarget
from sonar_gl.scene.primitives import closedness
from tests.support import glsl

pytestmark = pytest.mark.usefixtures("opengl_engine")

BOX = trimesh.creation.box((1, 1, 1))


def sonar(fov=60.0, elevation=40.0, beams=60, bins=200, **more):
    return sg.Sonar("test", 900e3, beams, bins, fov, elevation, fov / beams, 0.5, 20.0, **more)


def simulate(bodies, it=None, sampling=None):
    return sg.Simulator(sg.Scene(bodies), it or sonar(), sg.Acoustics.ideal(), sampling or sg.Sampling(2, 60))


def ping(bodies, it=None, pose=None, sampling=None, **kw):
    with simulate(bodies, it, sampling) as simulator:
        return simulator.ping(np.eye(4) if pose is None else pose, **kw)


def test_gbuffer_of_a_slanted_plane_is_exact():
    """Range and normal of each sample, computed from 1/x and its slopes, are those of the plane."""
    normal = np.array([1.0, 0.4, -0.3]) / np.linalg.norm([1.0, 0.4, -0.3])
    pose = trimesh.geometry.align_vectors([0, 0, 1], normal)
    pose[:3, 3] = 7.0 * normal
    plate = sg.Body("plate", trimesh.creation.box((60, 60, 1e-3)), pose, 0.6)
    with simulate([plate], sonar(130.0)) as simulator:
        buffers = simulator.gbuffers(np.eye(4))
        sectors = simulator.fan.sectors
    assert len(buffers) == len(sectors) == 3
    for sector, buffer in zip(sectors, buffers, strict=True):
        u, v = sector.sample_coordinates()
        rays = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation()
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        cosine = rays @ normal
        exact = (7.0 - 0.5e-3) / np.where(cosine > 0, cosine, np.inf)
        hit = buffer.range_m > 0
        # excluding the plate's rim and grazing incidence, where the plate ends
        inner = hit & (cosine > 0.35)
        assert inner.sum() > 0.5 * (cosine > 0.35).sum()
        # float32 positions of 40 m give micrometres; the slopes are differences of neighbouring pixels
        np.testing.assert_allclose(buffer.range_m[inner], exact[inner], rtol=5e-6)
        points = buffer.range_m[..., None] * buffer.direction
        np.testing.assert_allclose(points[inner] @ normal, 7.0 - 0.5e-3, rtol=5e-6)
        np.testing.assert_allclose(buffer.direction, rays, atol=1e-7)
        assert np.abs(buffer.normal[inner] + normal).max() < 2e-3
        np.testing.assert_allclose(buffer.echo[inner], 0.6 * cosine[inner], rtol=1e-3)
        assert set(np.unique(buffer.body_id)) <= {0, 1}
        assert (buffer.body_id[hit] == 1).all()


@pytest.mark.parametrize("roll, pitch, yaw", [(0, 0, 0), (0.3, -0.5, 2.0), (math.pi / 2, 0, 0), (0, -1.5, 1)])
def test_the_fan_follows_the_sonar_s_pose(roll, pitch, yaw):
    """A ball at range 8 m, azimuth +20°, elevation -5° of the sonar appears there for every pose of the sonar."""
    pose = sg.pose(1, 2, 3, roll, pitch, yaw)
    azimuth, elevation = math.radians(20), math.radians(-5)
    direction = [
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    centre = (pose @ [*(8 * np.array(direction)), 1])[:3]
    result = ping(
        [sg.Body("box", trimesh.creation.icosphere(3, 0.2), sg.pose(*centre))], pose=pose, labels=True
    )
    beam, k = np.unravel_index(result.intensity.argmax(), result.intensity.shape)
    assert abs(math.degrees(result.azimuth_rad[beam]) - 20) < 1.5
    assert abs(result.range_m[k] - 7.8) < 0.15
    assert result.elevation_rad[beam, k] == pytest.approx(elevation, abs=math.radians(0.7))


@pytest.mark.parametrize("inverted", [False, True])
def test_back_face_culling_does_not_change_the_image(inverted, monkeypatch):
    """Back-face culling does not change the image, since nearer faces hide further ones."""
    torus = trimesh.creation.torus(1.0, 0.3)
    if inverted:
        torus.invert()
    assert closedness(torus.vertices, torus.faces) == (-1 if inverted else 1)
    body = sg.Body("torus", torus, sg.pose(6, 0, 0, 1.0, 0.3, 0))
    culled = ping([body]).intensity
    monkeypatch.setattr("sonar_gl.scene.primitives.MAX_CLOSED_FACES", 0)
    whole = ping([body]).intensity
    assert whole.any()
    # identical, except where faces were reversed, which changes the order of their corners
    difference = np.abs(culled - whole).sum() / whole.sum()
    assert difference < (1e-4 if inverted else 1e-12)


def test_closedness():
    assert closedness(BOX.vertices, BOX.faces) == 1
    split = BOX.copy()
    split.unmerge_vertices()  # as at creases and seams, where vertices are duplicated
    assert closedness(split.vertices, split.faces) == 1
    assert closedness(BOX.vertices, BOX.faces[:-1]) == 0
    assert closedness(BOX.vertices, BOX.faces[[0, 0, *range(1, 12)]]) == 0
    one_turned = np.vstack([BOX.faces[:1, ::-1], BOX.faces[1:]])
    assert closedness(BOX.vertices, one_turned) == 0
    flat = np.zeros((3, 3))
    assert closedness(flat, np.array([[0, 1, 2]])) == 0


def test_reflectivity_of_bodies_and_of_faces():
    box = sg.Body("box", BOX, sg.pose(5, 0, 0), 1.0)
    full = ping([box]).intensity
    assert full.any()
    np.testing.assert_allclose(ping([replace(box, reflectivity=0.25)]).intensity, 0.25 * full, rtol=1e-6)
    nearest = np.isclose(BOX.face_normals[:, 0], -1)
    only = replace(box, reflectivity=np.where(nearest, 0.5, 0.0))
    np.testing.assert_allclose(ping([only]).intensity, 0.5 * full, rtol=1e-5)
    # open bodies are drawn after closed ones; each face must still have its own reflectivity
    sheet = trimesh.Trimesh(BOX.vertices, BOX.faces[:-1], process=False)
    values = np.linspace(0.1, 1, len(sheet.faces))
    pair = [
        sg.Body("sheet", sheet, sg.pose(6, 2, 0), values),
        sg.Body("closed", BOX, sg.pose(6, -2, 0), np.linspace(0.1, 1, 12)),
    ]
    both = ping(pair).intensity
    apart = ping(pair[:1]).intensity + ping(pair[1:]).intensity
    # the window's size changes the rounding of slopes
    np.testing.assert_allclose(both, apart, rtol=1e-3, atol=1e-6)


def test_shading_normals_change_the_cosine_only():
    """A coarse cylinder with true normals has the echo of a fine one, at the ranges of its coarse faces."""
    coarse = trimesh.creation.cylinder(1.0, 20.0, sections=24)
    normals = coarse.vertices * [1, 1, 0]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    fine = ping([sg.Body("fine", trimesh.creation.cylinder(1.0, 20.0, sections=720), sg.pose(6, 0, 0))])
    flat = ping([sg.Body("flat", coarse, sg.pose(6, 0, 0))])
    smooth = ping([sg.Body("smooth", coarse, sg.pose(6, 0, 0), normals=normals)])
    per_beam = [p.intensity.sum(axis=1) for p in (fine, flat, smooth)]
    error = [np.abs(per_beam[k] - per_beam[0]).sum() / per_beam[0].sum() for k in (1, 2)]
    # the remaining difference is the polygon's silhouette, narrower by 1 - cos(180°/24)
    assert error[1] < 0.01 < error[0]
    np.testing.assert_array_equal(smooth.intensity > 0, flat.intensity > 0)


def test_slivers_show_nothing(monkeypatch):
    """Rounding moves corners off a line on which all three lie: 166 of 219 000 samples were at wrong ranges."""
    monkeypatch.setenv("SONAR_GL_SOFTWARE", "0")  # as on a graphics card, by planes from corners
    rng = np.random.default_rng(0)
    n, wall, buffers = 3000, trimesh.creation.box((0.2, 12, 12)), []
    ends = rng.uniform(-6, 6, (n, 2, 3))
    ends[:, :, 0] = -0.1  # on the face that the sonar sees
    middle = ends[:, 0] + (ends[:, 1] - ends[:, 0]) * rng.uniform(0.2, 0.8, (n, 1))
    corners = np.concatenate([ends, middle[:, None]], axis=1).reshape(-1, 3)
    faces = len(wall.vertices) + np.arange(3 * n).reshape(-1, 3)
    with_slivers = trimesh.Trimesh(
        np.vstack([wall.vertices, corners]), np.vstack([wall.faces, faces]), process=False
    )
    for mesh in (wall, with_slivers):
        body = sg.Body("wall", mesh, sg.pose(9.3, 0.2, 0.1, 0.2, 0.3, 0.4))
        with simulate([body], sonar(40.0, 30.0), sg.Sampling(8, 300)) as simulator:
            (buffer,) = simulator.gbuffers(np.eye(4))
            buffers.append(buffer)
    assert (buffers[0].range_m > 0).sum() > 10_000
    np.testing.assert_array_equal(buffers[1].range_m, buffers[0].range_m)
    np.testing.assert_array_equal(buffers[1].echo, buffers[0].echo)


def test_glsl_functions_equal_their_numpy_twins():
    rng = np.random.default_rng(0)
    normal, direction = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 4096, 3)))
    direction[:64] = -normal[:64]  # aligned: the dot product may be a hair above 1
    normal, direction = np.float32(normal), np.float32(direction)
    got = glsl.call("echo.glsl", {"n": normal, "d": direction}, "cos_incidence(n, d)")[:, 0]
    np.testing.assert_allclose(got, cos_incidence(normal.astype(float), direction), atol=2e-7)  # float32
    assert got.max() <= 1
    assert got.min() >= 0


def test_glsl_functions_of_planes_equal_their_numpy_twins():
    rng = np.random.default_rng(1)
    q = np.float32(1 / rng.uniform(0.5, 60, 4096))
    at, slopes = np.float32(rng.uniform(-0.5, 0.5, (4096, 2))), np.float32(rng.normal(size=(4096, 2)) * 0.3)
    normal = rng.normal(size=(4096, 3))
    lengths = 10.0 ** rng.uniform(-32, 38, (4096, 1))  # drivers take components below 1.2e-38 for 0
    normal = np.float32(normal / np.linalg.norm(normal, axis=1, keepdims=True) * lengths)
    normal[::5] = 0.0  # flat
    inputs = {"q": q, "slopes": slopes, "at": at}
    planes = plane_of(*(value.astype(float) for value in (q, slopes, at)))
    got = glsl.call("plane.glsl", inputs, "plane_of(q, slopes, at)", 3)
    np.testing.assert_allclose(got, planes, atol=3e-7)  # float32, numbers up to 2
    got = glsl.call(
        "plane.glsl", inputs | {"n": normal}, "cos_times_range(plane_of(q, slopes, at), q, at, n)"
    )[:, 0]
    normal, ray = normal.astype(float), np.stack([np.ones(len(at)), -at[:, 0], at[:, 1]], axis=-1)
    length = np.linalg.norm(ray, axis=1, keepdims=True)
    sides = np.sign(
        -(normal * planes).sum(axis=1, keepdims=True)
    )  # p . x = 1, so that -p points to the sonar
    turned = sides * normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-40)
    flat = 1 / np.linalg.norm(planes, axis=1)  # the distance of the plane
    want = np.where(normal.any(axis=1), cos_incidence(turned, ray / length) * length[:, 0] / q, flat)
    # near grazing incidence rounding decides on which side of the plane the normal is
    clear = np.abs((planes * normal).sum(axis=1)) > 1e-5 * np.linalg.norm(normal, axis=1)
    clear |= ~normal.any(axis=1)
    assert clear.mean() > 0.99
    np.testing.assert_allclose(got[clear], want[clear], rtol=1e-4, atol=1e-4)  # of metres up to 70


def test_a_shader_error_names_its_file_and_line(tmp_path):
    (tmp_path / "a.vert").write_text("#version 330 core\nvoid main() { gl_Position = vec4(0); }\n")
    (tmp_path / "b.glsl").write_text("float one() { return 1.0; }\nfloat two() { return nonsense; }\n")
    (tmp_path / "c.frag").write_text(
        '#version 330 core\n#include "b.glsl"\nout vec4 o;\nvoid main() { o = vec4(one()); }\n'
    )
    context = gl.create_context()
    with context, pytest.raises(RuntimeError, match=r"b\.glsl:2"):
        programs.compile_program(context, tmp_path, ("a.vert", "c.frag"), {"X": 1})
    context.release()


def test_too_many_samples_for_the_driver():
    it = sonar(beams=100)
    with pytest.raises(sg.Error) as caught:
        simulate([sg.Body("box", BOX)], it, sg.Sampling(1000, 10))
    context = gl.create_context()
    limit = driver.side_limit(context)
    context.release()
    assert str(caught.value).startswith(
        f"samples must fit the driver's limit of {limit} by {limit} pixels (got "
    )
    assert str(caught.value).endswith("ask for a larger tolerance or fewer samples)")


@pytest.mark.slow
@pytest.mark.parametrize("part", ["depth_renderbuffer", "framebuffer"])
@pytest.mark.parametrize("is_first", [True, False])
def test_an_interrupt_while_a_larger_target_is_made_leaves_later_pings_right(monkeypatch, part, is_first):
    """The size was noted first: later pings drew into the old, smaller target, and 77 % of their echo was lost."""
    bodies = [sg.Body("wall", trimesh.creation.box((0.2, 6, 6)), sg.pose(6))]
    with simulate(bodies) as simulator:
        expected = simulator.ping(sg.pose()).intensity

    def interrupted(*_args, **_more):
        raise KeyboardInterrupt

    with simulate(bodies) as simulator:
        if not is_first:
            simulator.ping(sg.pose(-12))
        with monkeypatch.context() as patch:
            patch.setattr(moderngl.Context, part, interrupted)
            with pytest.raises(KeyboardInterrupt):
                simulator.ping(sg.pose())
        np.testing.assert_array_equal(simulator.ping(sg.pose()).intensity, expected)


def out_of_memory(patch, _simulator):
    patch.setattr(Functions, "take_errors", lambda _: [0x0505])


def reset(patch, simulator):
    with simulator.run.drawing() as context:
        patch.setattr(context.extra.gl, "glGetGraphicsResetStatus", lambda: 0x8253)


def read_nothing(patch, _simulator):
    patch.setattr(moderngl.Framebuffer, "read_into", lambda *_args, **_more: None)


def make_none(patch, _simulator):
    def incomplete(*_args):
        raise moderngl.Error("the framebuffer is not complete (GL_FRAMEBUFFER_UNSUPPORTED)")

    patch.setattr(moderngl.Context, "framebuffer", incomplete)


def no_room(patch, _simulator):
    patch.setattr(driver, "free_bytes", lambda _: 100_000)


@pytest.mark.parametrize(
    "failure, message",
    [
        (out_of_memory, "got GL_OUT_OF_MEMORY"),
        (reset, "must keep the sonar's OpenGL context"),
        (read_nothing, "must keep the sonar's OpenGL context"),
        (
            make_none,
            r"must make a framebuffer of 192 columns by 128 rows \(got: the framebuffer is not complete",
        ),
        (
            no_room,
            r"samples must fit the memory of the graphics card \(got [0-9.]+ MB, where 0.1 MB are free",
        ),
    ],
)
def test_a_failure_of_the_driver_is_an_error_and_no_black_ping(monkeypatch, failure, message):
    """Later pings, once the driver works, are right."""
    bodies = [sg.Body("wall", trimesh.creation.box((0.2, 60, 60)), sg.pose(6))]
    with simulate(bodies) as simulator:
        expected = simulator.ping(sg.pose()).intensity
    with simulate(bodies) as simulator:
        with monkeypatch.context() as patch:
            failure(patch, simulator)
            with pytest.raises(sg.Error, match=message):
                simulator.ping(sg.pose())
        np.testing.assert_array_equal(simulator.ping(sg.pose()).intensity, expected)


# each error at the first call, and one at the last
@pytest.mark.parametrize(
    "at, failure",
    [
        pytest.param(at, failure, marks=pytest.mark.slow if at and (at, failure) != (3, 0x0505) else ())
        for at, failure in product(range(4), (0x0502, 0x0505, 0x0507))
    ],
)
def test_a_failure_in_the_choice_of_samples_is_an_error_and_changes_no_later_choice(monkeypatch, at, failure):
    """The search for the coarsest samples took each error for the driver's limit: other samples, without a word."""
    bodies = [sg.Body("ball", trimesh.creation.icosphere(3, 0.4), sg.pose(6))]
    with sg.Simulator(sg.Scene(bodies), sonar(), sg.Acoustics.ideal(), tolerance=0.05) as simulator:
        expected = simulator.ping(sg.pose()).intensity
    errors = iter([[]] * at + [[failure]])
    with sg.Simulator(sg.Scene(bodies), sonar(), sg.Acoustics.ideal(), tolerance=0.05) as simulator:
        with monkeypatch.context() as patch:
            patch.setattr(Functions, "take_errors", lambda _: next(errors, []))
            with pytest.raises(sg.Error):
                simulator.ping(sg.pose())
        np.testing.assert_array_equal(simulator.ping(sg.pose()).intensity, expected)


def test_samples_that_are_read_later_are_the_same(monkeypatch):
    """As from a graphics card: by buffers of the driver, when all pictures of a batch are drawn."""
    bodies = [
        sg.Body("wall", trimesh.creation.box((0.2, 60, 3)), sg.pose(9)),
        sg.Body("box", BOX, sg.pose(5, 1, 0.3, yaw=0.4)),
    ]
    # of windows that grow and shrink
    poses = [sg.pose(x, yaw=0.05 * x) for x in (-8.0, 0.0, 1.0, -3.0, 2.0, 3.0)]
    found = []
    for asynchronous in (False, True):
        with monkeypatch.context() as patch, simulate(bodies) as simulator:
            patch.setattr(renderer, "RenderTarget", lambda _, late=asynchronous: RenderTarget(late))
            alone = [simulator.ping(pose, labels=k % 2 == 0) for k, pose in enumerate(poses)]
            found.append([*alone, *simulator.pings(poses, labels=True)])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one.intensity, other.intensity)
        for name in ("body_id", "incidence_rad", "share"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_windows_that_take_turns_share_a_render_target_which_becomes_smaller_after_many_small_ones(
    monkeypatch,
):
    """Early versions made it anew for each small window, and for each large one after it."""
    n_bytes, check_room = [], renderer.check_room
    monkeypatch.setattr(
        renderer, "check_room", lambda context, n: n_bytes.append(n) or check_room(context, n)
    )
    monkeypatch.setattr(renderer, "MIN_PIXELS", 1)
    monkeypatch.setattr(renderer, "USES_BEFORE_SMALLER", 3)
    near, far = sg.pose(3.5, 1), sg.pose(-12)
    with simulate([sg.Body("box", BOX, sg.pose(5, 1, 0.3, yaw=0.4))]) as simulator:
        expected = {id(pose): simulator.ping(pose).intensity for pose in (far, near)}
        del n_bytes[:-1]
        for pose in (far, near, far, far, near, near, far):
            np.testing.assert_array_equal(simulator.ping(pose).intensity, expected[id(pose)])
        assert len(n_bytes) == 1
        for _ in range(4):
            np.testing.assert_array_equal(simulator.ping(far).intensity, expected[id(far)])
        assert len(n_bytes) == 2 and n_bytes[1] < n_bytes[0]
