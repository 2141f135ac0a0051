"""A camera on the vehicle: depth and colour against closed forms, and no effect on simulators."""

import ctypes
import gc
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.batch.optical import OpticalCamera
from sonar_gl.gl import egl, lifetime
from sonar_gl.gl.host import CONFIG_ID

WIDTH, HEIGHT = 160, 120
CAMERA = sg.Camera.of_fov(WIDTH, HEIGHT, fov_x_rad=1.2)
SONAR = sg.Sonar("test", 900e3, 32, 100, 60.0, 20.0, 2.0, 0.5, 20.0)
HERE = np.eye(4)
BALL = trimesh.creation.icosphere(5, 1.0)
QUAD = trimesh.Trimesh(
    [[0, -3, -3], [0, 3, -3], [0, 3, 3], [0, -3, 3]], [[0, 1, 2], [0, 2, 3]], process=False
)
SMALL = trimesh.creation.box((0.5, 0.5, 0.5))


def coloured(**visual):
    mesh = SMALL.copy()
    mesh.visual = trimesh.visual.ColorVisuals(mesh, **visual)
    return mesh


def textured(placed=True):
    """Return a quad whose texture is red above to port, blue above to starboard, green below."""
    from PIL import Image

    picture = np.zeros((32, 32, 3), np.uint8)
    picture[:16, :16, 0] = picture[:16, 16:, 2] = picture[16:, :, 1] = 255
    picture = Image.fromarray(picture)
    uv = [[1, 0], [0, 0], [0, 1], [1, 1]]
    mesh = QUAD.copy()
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, baseColorFactor=None if placed else [0, 255, 0, 255]
    )
    mesh.visual = trimesh.visual.TextureVisuals(uv if placed else None, material=material)
    return mesh


FAR = sg.pose(-500)
SCENE = sg.Scene(
    [
        sg.Body("wall", trimesh.creation.box((1, 40, 40)), sg.pose(5.5), 0.5),
        sg.Body("ball", BALL, FAR, 0.5, np.asarray(BALL.vertices, np.float32)),
        sg.Body("quad", QUAD, FAR, 0.5),
        sg.Body("halves", QUAD, FAR, np.array([0.2, 0.8])),
        sg.Body("tilted", QUAD, FAR, 0.5, [[0.6, 0, -0.8]] * 4),  # its front faces along x
        sg.Body("zero_normals", QUAD, FAR, 0.5, np.zeros((4, 3))),
        sg.Body("small", SMALL, FAR, 0.9),
        sg.Body("red", coloured(face_colors=[[255, 0, 0, 255]] * 12), FAR, 0.9),
        sg.Body("green", coloured(vertex_colors=[[0, 255, 0, 255]] * 8), FAR, 0.9),
        sg.Body("picture", textured(), FAR, 0.9),
        sg.Body("unplaced", textured(placed=False), FAR, 0.9),
        sg.Bubbles("bubbles", sg.pose(4, 0, -1)),
    ]
)


@pytest.fixture(scope="module")
def optical():
    with OpticalCamera(SCENE, CAMERA) as one:
        yield one


def rays():
    """Return y / x and z / x at the centre of each pixel, (H, W) each."""
    half = math.tan(0.6)
    left = (1 - (np.arange(WIDTH) + 0.5) / WIDTH * 2) * half
    up = (1 - (np.arange(HEIGHT) + 0.5) / HEIGHT * 2) * half * HEIGHT / WIDTH
    return np.meshgrid(left, up)


def resolution(depth):
    """Return four steps of 24 bits with the near plane at 0.1 m; more than one because of float32 in between."""
    return 4 * np.asarray(depth) ** 2 / (0.1 * 2**24) + 1e-6


# ---- depth ------------------------------------------------------------------------------------------


def test_a_wall_at_5_m(optical):
    rgb, depth = optical(HERE)
    assert (rgb.shape, rgb.dtype) == ((HEIGHT, WIDTH, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((HEIGHT, WIDTH), np.float32)
    assert np.abs(depth - 5).max() < resolution(5)
    assert rgb.flags.c_contiguous and depth.flags.c_contiguous


def test_depth_of_a_slanted_wall_is_that_at_pixel_centres(optical):
    """A plane through 5 m ahead, with yaw 0.6 and pitch 0.3."""
    plane = sg.pose(5, 0, 0, 0, 0.3, 0.6)
    _, depth = optical(HERE, {"wall": plane @ sg.pose(0.5)})
    left, up = rays()
    normal = plane[:3, 0]
    wanted = normal[0] * 5 / (normal[0] + normal[1] * left + normal[2] * up)
    # a shift by an eighth of a pixel would show
    assert np.abs(np.gradient(wanted, axis=1)).min() / 8 > 1e-3
    assert (np.abs(depth - wanted) < resolution(wanted)).all()
    assert resolution(wanted).max() < 1e-3


def test_a_ball(optical):
    """Its depth is between those of the spheres around its vertices and inside its faces."""
    _, depth = optical(HERE, {"wall": None, "ball": sg.pose(4, 0.3, -0.2)})
    left, up = rays()
    square, along = 1 + left * left + up * up, 4 + 0.3 * left - 0.2 * up

    def sphere(radius):
        beneath = along**2 - square * (16 + 0.13 - radius**2)
        return np.where(beneath > 0, (along - np.sqrt(np.maximum(beneath, 0))) / square, np.inf)

    inner = np.einsum("ij,ij->i", BALL.triangles_center, BALL.face_normals).min()
    outside, inside = sphere(1.0), sphere(inner)
    np.testing.assert_array_equal(depth[outside == np.inf], 0)
    hit = inside < np.inf
    assert hit.sum() > 1500
    assert (depth[hit] >= outside[hit] - resolution(4)).all()
    assert (depth[hit] <= inside[hit] + resolution(4)).all()


# ---- directions -------------------------------------------------------------------------------------


@pytest.mark.parametrize("away", [pytest.param((0, 0, 0), marks=pytest.mark.slow), (500_000, 4_500_000, -30)])
@pytest.mark.parametrize("turn", [(0, 0, 0), (0.4, 0.3, 2.5)])
def test_port_is_left_and_up_is_up(optical, away, turn):
    """For any pose of the camera, also far from the origin."""
    camera = sg.pose(*away, *turn)
    focal = WIDTH / 2 / math.tan(0.6)
    for at in ((0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
        rgb, depth = optical(camera, {"wall": None, "small": camera @ sg.pose(3.25, *at[1:])})
        middle = np.argwhere(np.abs(depth - 3) < 1e-4).mean(axis=0)
        wanted = (HEIGHT - 1) / 2 - at[2] / 3 * focal, (WIDTH - 1) / 2 - at[1] / 3 * focal
        np.testing.assert_allclose(middle, wanted, atol=0.5)
        assert rgb[tuple(middle.round().astype(int))].min() > 100
        assert (rgb[depth == 0] == rgb[0, 0]).all(axis=-1).mean() > 0.99  # edges blend


def test_light_comes_from_above(optical):
    rgb, _ = optical(sg.pose(roll=math.pi), {"wall": None, "ball": sg.pose(4)})
    column = rgb[:, WIDTH // 2, 0].astype(int)
    assert column[HEIGHT // 2 + 15] > column[HEIGHT // 2 - 15] + 15  # upside down


# ---- bodies -----------------------------------------------------------------------------------------


def test_poses_of_bodies_hold_for_one_image(optical):
    before = optical(HERE)
    place = {"small": sg.pose(3, 0.5, 0), "wall": None, "bubbles": None}
    moved = optical(HERE, place)
    after = optical(HERE)
    for one, two in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, two)
    with OpticalCamera(sg.Scene([sg.Body("small", SMALL, place["small"], 0.9)]), CAMERA) as other:
        for one, two in zip(moved, other(HERE), strict=True):
            np.testing.assert_array_equal(one, two)
    assert 100 < (moved[1] > 0).sum() < 3000


def test_a_body_may_be_larger_than_its_mesh(optical):
    """Light does not depend on the size."""
    place = sg.pose(5, 0.5, 0, 0.2, 0.3, 0.4)
    got = optical(HERE, {"small": place @ np.diag([2, 2, 2, 1]), "wall": None})
    larger = sg.Body("small", SMALL.copy().apply_scale(2), place, 0.9)
    with OpticalCamera(sg.Scene([larger]), CAMERA) as other:
        for one, two in zip(got, other(HERE), strict=True):
            np.testing.assert_array_equal(one, two)


def test_an_empty_scene_has_the_background_colour():
    with OpticalCamera(sg.Scene([]), CAMERA) as one:
        rgb, depth = one(HERE)
    assert not depth.any()
    assert (rgb == rgb[0, 0]).all()
    assert rgb.max() < 80


# ---- colours ----------------------------------------------------------------------------------------


def colour(optical, **bodies):
    """Return the colour at the centre of the image."""
    rgb, depth = optical(HERE, {"wall": None, **bodies})
    assert depth[HEIGHT // 2, WIDTH // 2] > 0
    return rgb[HEIGHT // 2, WIDTH // 2].astype(int)


def test_bodies_are_gray_by_reflectivity_or_have_the_colours_of_their_mesh(optical):
    wall, small = (colour(optical, **{name: sg.pose(3)}) for name in ("quad", "small"))
    assert wall[0] == wall[1] == wall[2]
    # linear light, displayed as its 2.2nd root
    assert small[0] / wall[0] == pytest.approx((0.9 / 0.5) ** (1 / 2.2), rel=0.03)
    # Lambert: 0.96 of the lamp's 2 / π, and 0.15 ambient; the Fresnel terms are two gray levels
    lit = (0.9 * (0.96 * 2 / math.pi + 0.15)) ** (1 / 2.2) * 255
    assert abs(small[0] - lit) < 4
    red, green = (colour(optical, **{name: sg.pose(3)}) for name in ("red", "green"))
    assert red[0] > 150 and red[1:].max() < 20
    assert green[1] > 150 and green[[0, 2]].max() < 20


def test_a_texture_on_a_mesh(optical):
    rgb, _ = optical(HERE, {"wall": None, "picture": sg.pose(5)})
    middle = np.array([HEIGHT // 2, WIDTH // 2])
    for offset, channel in (((-20, -20), 0), ((-20, 20), 2), ((20, -20), 1), ((20, 20), 1)):
        found = rgb[tuple(middle + offset)].tolist()
        assert found.pop(channel) > 150
        assert max(found) < 40  # a white sheen
    unplaced = colour(optical, unplaced=sg.pose(5))  # a texture without coordinates
    assert unplaced[1] > 150 and unplaced[[0, 2]].max() < 40


def test_a_reflectivity_for_each_face(optical):
    rgb, _ = optical(HERE, {"wall": None, "halves": sg.pose(5)})
    low, high = rgb[HEIGHT // 2 + 20, WIDTH // 2 + 30, 0], rgb[HEIGHT // 2 - 20, WIDTH // 2 - 30, 0]
    assert sorted((high / low, low / high))[1] == pytest.approx(4 ** (1 / 2.2), rel=0.03)


def test_both_sides_of_a_face_are_visible(optical):
    """An upright face, whose sides get the same light from above."""
    front = optical(HERE, {"wall": None, "quad": sg.pose(5)})
    back = optical(HERE, {"wall": None, "quad": sg.pose(5, yaw=math.pi)})
    np.testing.assert_array_equal(front[0], back[0])
    np.testing.assert_allclose(front[1], back[1], atol=resolution(5))
    assert front[0][HEIGHT // 2, WIDTH // 2].min() > 100


def test_shading_follows_the_normals_of_vertices(optical):
    """A face whose normal points up at its back gets more light from above; normals of 0 count as none."""
    names = "quad", "tilted", "zero_normals"
    flat, tilted, zero = (colour(optical, **{name: sg.pose(5)}) for name in names)
    assert tilted[0] > flat[0] + 10
    np.testing.assert_array_equal(zero, flat)


# ---- beside simulators ------------------------------------------------------------------------------


def test_images_do_not_change_the_bytes_of_pings():
    """Before, between and after images, and after cameras were closed or deleted."""
    scene = sg.Scene(SCENE.bodies[:1])
    with sg.Simulator(scene, SONAR, sampling=sg.Sampling(2, 20)) as simulator:

        def ping():
            return simulator.ping(HERE, sg.Noise.physical(), labels=True).intensity.tobytes()

        wanted, current = ping(), egl.current()
        with OpticalCamera(scene, CAMERA) as one:
            image = one(HERE)
            assert egl.current() == current
            assert ping() == wanted
            again = one(HERE)
            assert ping() == wanted
        assert ping() == wanted
        assert [a.tobytes() for a in again] == [a.tobytes() for a in image]
        deleted, last = OpticalCamera(scene, CAMERA), OpticalCamera(scene, CAMERA)
        deleted(HERE), last(HERE)
        with last.context:  # the garbage collector runs while another context with the same names is current
            del deleted
            gc.collect()
        assert ping() == wanted
        assert egl.current() == current
    assert [a.tobytes() for a in last(HERE)] == [a.tobytes() for a in image]  # the simulator is closed
    last.close()
    last.close()
    with pytest.raises(sg.Error, match="this OpticalCamera is closed; make a new one"):
        last(HERE)
    with sg.Simulator(scene, SONAR, sampling=sg.Sampling(2, 20)) as simulator:
        assert simulator.ping(HERE, sg.Noise.physical()).intensity.tobytes() == wanted


def exists(ours) -> bool:
    """Return whether EGL knows a context."""
    display, *_, handle = ours
    found = ctypes.c_int()
    return bool(egl.library().eglQueryContext(display, handle, CONFIG_ID, ctypes.byref(found)))


def test_contexts_are_released():
    scene = sg.Scene([])
    closed, deleted = OpticalCamera(scene, CAMERA), OpticalCamera(scene, CAMERA)
    contexts = [one.context.extra.binding for one in (closed, deleted)]
    assert [exists(context) for context in contexts] == [True, True]
    closed.close()
    assert [exists(context) for context in contexts] == [False, True]
    del deleted
    gc.collect()
    lifetime.release_waiting()  # as the next simulator or ping does
    assert [exists(context) for context in contexts] == [False, False]


def resident():
    """Return the bytes of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.slow
def test_images_leave_no_memory_behind(optical):
    """An image and its depth have 134 kB, so fifty of them would show."""
    for _ in range(5):
        optical(HERE)
    gc.collect()
    before, blocks = resident(), sys.getallocatedblocks()
    for n in range(50):
        optical(sg.pose(0.01 * n), {"wall": None, "small": sg.pose(3, 0.01 * n)})
    gc.collect()
    assert sys.getallocatedblocks() - blocks < 250  # half a block an image was measured
    assert resident() - before < 3_000_000


# ---- messages ---------------------------------------------------------------------------------------


def test_messages(optical):
    camera = sg.Camera.of_fov(20_000_000, 1, fov_x_rad=1.0)
    for call, message in (
        (
            lambda: OpticalCamera("pylon", CAMERA),
            "scene must be a Scene (got str; sonar_gl.load_scene makes one",
        ),
        (
            lambda: OpticalCamera(SCENE, 640),
            "camera must be a Camera (got int; such as sonar_gl.Camera.of_fov(",
        ),
        (
            lambda: OpticalCamera(sg.Scene([]), camera),
            "pixels a side, as the driver supports no more (got 20000000 by 1)",
        ),
        (
            lambda: optical(np.zeros((3, 3))),
            "pose must have shape (4, 4) (got (3, 3); sonar_gl.pose makes one from x y z roll pitch yaw)",
        ),
        (lambda: optical(HERE, ["ball"]), "bodies must be a dict (got list; such as"),
        (
            lambda: optical(HERE, {"wal": None}),
            "bodies must be bodies of the scene (got 'wal'; did you mean 'wall'?)",
        ),
        (
            lambda: optical(HERE, {"wall": np.diag([1.0, 2.0, 1.0, 1.0])}),
            "the pose of body 'wall' must be a rotation, a translation and one scale",
        ),
    ):
        with pytest.raises(sg.Error) as caught:
            call()
        assert message in str(caught.value)
