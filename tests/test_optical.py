"""A camera beside the sonar: depth and colour against closed forms, and simulators that do not notice."""

import ctypes
import gc
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl import egl, gl
from sonar_gl.batch.optical import Optical
from sonar_gl.foreign import CONFIG_ID

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
    """A quad whose picture is red above to port, blue above to starboard, green below; metal, so its file."""
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
        sg.Body("tilted", QUAD, FAR, 0.5, [[0.6, 0, -0.8]] * 4),  # its front looks along x
        sg.Body("untold", QUAD, FAR, 0.5, np.zeros((4, 3))),
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
    with Optical(SCENE, CAMERA) as one:
        yield one


def rays():
    """(H, W) y and z over x of each pixel's middle."""
    half = math.tan(0.6)
    left = (1 - (np.arange(WIDTH) + 0.5) / WIDTH * 2) * half
    up = (1 - (np.arange(HEIGHT) + 0.5) / HEIGHT * 2) * half * HEIGHT / WIDTH
    return np.meshgrid(left, up)


def fine(depth):
    """What 24 bits resolve at near_m = 0.1: four steps, for float32 on the way there."""
    return 4 * np.asarray(depth) ** 2 / (0.1 * 2**24) + 1e-6


# ---- depth ------------------------------------------------------------------------------------------


def test_a_wall_at_5_m(optical):
    rgb, depth = optical(HERE)
    assert (rgb.shape, rgb.dtype) == ((HEIGHT, WIDTH, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((HEIGHT, WIDTH), np.float32)
    assert np.abs(depth - 5).max() < fine(5)
    assert rgb.flags.c_contiguous and depth.flags.c_contiguous


def test_a_slanted_wall_in_the_middle_of_pixels(optical):
    """The plane through 5 m ahead, turned by 0.6 and tilted by 0.3."""
    turned = sg.pose(5, 0, 0, 0, 0.3, 0.6)
    _, depth = optical(HERE, {"wall": turned @ sg.pose(0.5)})
    left, up = rays()
    normal = turned[:3, 0]
    wanted = normal[0] * 5 / (normal[0] + normal[1] * left + normal[2] * up)
    # a shift by an eighth of a pixel would be seen
    assert np.abs(np.gradient(wanted, axis=1)).min() / 8 > 1e-3
    assert (np.abs(depth - wanted) < fine(wanted)).all()
    assert fine(wanted).max() < 1e-3


def test_a_ball(optical):
    """Between that of the sphere about its vertices and of that within its faces."""
    _, depth = optical(HERE, {"wall": None, "ball": sg.pose(4, 0.3, -0.2)})
    left, up = rays()
    square, along = 1 + left * left + up * up, 4 + 0.3 * left - 0.2 * up

    def sphere(radius):
        beneath = along**2 - square * (16 + 0.13 - radius**2)
        return np.where(beneath > 0, (along - np.sqrt(np.maximum(beneath, 0))) / square, np.inf)

    inner = np.einsum("ij,ij->i", BALL.triangles_center, BALL.face_normals).min()
    outside, inside = sphere(1.0), sphere(inner)
    np.testing.assert_array_equal(depth[outside == np.inf], 0)
    seen = inside < np.inf
    assert seen.sum() > 1500
    assert (depth[seen] >= outside[seen] - fine(4)).all()
    assert (depth[seen] <= inside[seen] + fine(4)).all()


def test_near_and_far():
    wall = sg.Scene(SCENE.bodies[:1])
    for near, far, seen in ((4.9, 5.1, True), (5.01, 5.4, False), (1.0, 4.99, False)):
        with Optical(wall, CAMERA, near_m=near, far_m=far) as one:
            rgb, depth = one(HERE)
        assert (depth > 0).all() == seen == (rgb.max() > 100)
        assert seen or not depth.any()


# ---- which way is which -----------------------------------------------------------------------------


@pytest.mark.parametrize("away", [(0, 0, 0), (500_000, 4_500_000, -30)])
@pytest.mark.parametrize("turn", [(0, 0, 0), (0.4, 0.3, 2.5)])
def test_port_is_left_and_up_is_up(optical, away, turn):
    """Wherever the camera is and however it is turned; far from the origin as near it."""
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


def test_bodies_of_one_image_alone(optical):
    before = optical(HERE)
    place = {"small": sg.pose(3, 0.5, 0), "wall": None, "bubbles": None}
    moved = optical(HERE, place)
    after = optical(HERE)
    for one, two in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, two)
    with Optical(sg.Scene([sg.Body("small", SMALL, place["small"], 0.9)]), CAMERA) as other:
        for one, two in zip(moved, other(HERE), strict=True):
            np.testing.assert_array_equal(one, two)
    assert 100 < (moved[1] > 0).sum() < 3000


def test_without_bodies_nothing_is_seen():
    with Optical(sg.Scene([]), CAMERA) as one:
        rgb, depth = one(HERE)
    assert not depth.any()
    assert (rgb == rgb[0, 0]).all()
    assert rgb.max() < 80


# ---- colours ----------------------------------------------------------------------------------------


def colour(optical, **bodies):
    """Of the middle of the image, from in front."""
    rgb, depth = optical(HERE, {"wall": None, **bodies})
    assert depth[HEIGHT // 2, WIDTH // 2] > 0
    return rgb[HEIGHT // 2, WIDTH // 2].astype(int)


def test_gray_by_reflectivity_or_colours_of_its_own(optical):
    wall, small = (colour(optical, **{name: sg.pose(3)}) for name in ("quad", "small"))
    assert wall[0] == wall[1] == wall[2]
    # linear light, seen as its 2.2nd root
    assert small[0] / wall[0] == pytest.approx((0.9 / 0.5) ** (1 / 2.2), rel=0.03)
    # matt: by Lambert 0.96 of the lamp's 2 / π, and 0.15 from everywhere; Fresnel's terms are two grays
    lit = (0.9 * (0.96 * 2 / math.pi + 0.15)) ** (1 / 2.2) * 255
    assert abs(small[0] - lit) < 4
    red, green = (colour(optical, **{name: sg.pose(3)}) for name in ("red", "green"))
    assert red[0] > 150 and red[1:].max() < 20
    assert green[1] > 150 and green[[0, 2]].max() < 20


def test_a_picture_on_a_mesh(optical):
    rgb, _ = optical(HERE, {"wall": None, "picture": sg.pose(5)})
    middle = np.array([HEIGHT // 2, WIDTH // 2])
    for offset, channel in (((-20, -20), 0), ((-20, 20), 2), ((20, -20), 1), ((20, 20), 1)):
        found = rgb[tuple(middle + offset)].tolist()
        assert found.pop(channel) > 150
        assert max(found) < 40  # a white sheen
    unplaced = colour(optical, unplaced=sg.pose(5))  # that says nowhere what of its picture is where
    assert unplaced[1] > 150 and unplaced[[0, 2]].max() < 40


def test_a_reflectivity_for_each_face(optical):
    rgb, _ = optical(HERE, {"wall": None, "halves": sg.pose(5)})
    low, high = rgb[HEIGHT // 2 + 20, WIDTH // 2 + 30, 0], rgb[HEIGHT // 2 - 20, WIDTH // 2 - 30, 0]
    assert sorted((high / low, low / high))[1] == pytest.approx(4 ** (1 / 2.2), rel=0.03)


def test_both_sides_of_a_face_are_seen(optical):
    """An upright one, which the light from above does not tell apart."""
    front = optical(HERE, {"wall": None, "quad": sg.pose(5)})
    back = optical(HERE, {"wall": None, "quad": sg.pose(5, yaw=math.pi)})
    np.testing.assert_array_equal(front[0], back[0])
    np.testing.assert_allclose(front[1], back[1], atol=fine(5))
    assert front[0][HEIGHT // 2, WIDTH // 2].min() > 100


def test_shading_normals_where_there_are_some(optical):
    """Turned up at its back, a face has more of the light from above; where a normal is 0 it is flat."""
    flat, tilted, untold = (colour(optical, **{name: sg.pose(5)}) for name in ("quad", "tilted", "untold"))
    assert tilted[0] > flat[0] + 10
    np.testing.assert_array_equal(untold, flat)


# ---- beside simulators ------------------------------------------------------------------------------


def test_pings_are_the_same_to_the_byte():
    """Before, between and after images, and after what drew them was closed or forgotten."""
    scene = sg.Scene(SCENE.bodies[:1])
    with sg.Simulator(scene, SONAR, sampling=sg.Sampling(2, 20)) as simulator:

        def ping():
            return simulator.ping(HERE, sg.Noise.physical(), labels=True).intensity.tobytes()

        wanted, current = ping(), egl.current()
        with Optical(scene, CAMERA) as one:
            image = one(HERE)
            assert egl.current() == current
            assert ping() == wanted
            again = one(HERE)
            assert ping() == wanted
        assert ping() == wanted
        assert [a.tobytes() for a in again] == [a.tobytes() for a in image]
        forgotten, last = Optical(scene, CAMERA), Optical(scene, CAMERA)
        forgotten(HERE), last(HERE)
        with (
            last._context
        ):  # in the midst of drawing, with names like its own, the garbage collector comes by
            del forgotten
            gc.collect()
        assert ping() == wanted
        assert egl.current() == current
    assert [a.tobytes() for a in last(HERE)] == [a.tobytes() for a in image]  # the simulator is closed
    last.close()
    last.close()
    with pytest.raises(sg.Error, match="this Optical is closed; make a new one"):
        last(HERE)
    with sg.Simulator(scene, SONAR, sampling=sg.Sampling(2, 20)) as simulator:
        assert simulator.ping(HERE, sg.Noise.physical()).intensity.tobytes() == wanted


def is_there(place) -> bool:
    """Whether EGL knows a context."""
    display, *_, handle = place
    found = ctypes.c_int()
    return bool(egl.library().eglQueryContext(display, handle, CONFIG_ID, ctypes.byref(found)))


def test_contexts_are_given_back():
    scene = sg.Scene([])
    closed, forgotten = Optical(scene, CAMERA), Optical(scene, CAMERA)
    places = [one._context.extra._ours for one in (closed, forgotten)]
    assert [is_there(place) for place in places] == [True, True]
    closed.close()
    assert [is_there(place) for place in places] == [False, True]
    del forgotten
    gc.collect()
    gl.release_discarded()  # as the next simulator or ping does
    assert [is_there(place) for place in places] == [False, False]


def resident():
    """Bytes of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_memory_stays_flat(optical):
    """An image and its depth are 134 kB: fifty of them would be seen."""
    for _ in range(5):
        optical(HERE)
    gc.collect()
    before, held = resident(), sys.getallocatedblocks()
    for n in range(50):
        optical(sg.pose(0.01 * n), {"wall": None, "small": sg.pose(3, 0.01 * n)})
    gc.collect()
    assert sys.getallocatedblocks() - held < 250  # half a block an image was measured
    assert resident() - before < 3_000_000


# ---- messages ---------------------------------------------------------------------------------------


def test_messages(optical):
    camera = sg.Camera.of_fov(20_000_000, 1, fov_x_rad=1.0)
    for call, message in (
        (lambda: Optical("pylon", CAMERA), "scene must be a Scene (got str; sonar_gl.load_scene makes one"),
        (lambda: Optical(SCENE, 640), "camera must be a Camera (got int; such as sonar_gl.Camera.of_fov("),
        (
            lambda: Optical(SCENE, CAMERA, near_m=0),
            "near_m and far_m must be finite metres, the former above 0",
        ),
        (
            lambda: Optical(sg.Scene([]), camera),
            "pixels a side (got 20000000 by 1; the driver can draw no more)",
        ),
        (lambda: optical(np.zeros((3, 3))), "pose must have shape (4, 4) (got (3, 3))"),
        (lambda: optical(HERE, ["ball"]), "bodies must be a dict (got list; such as"),
        (
            lambda: optical(HERE, {"wal": None}),
            "bodies must be bodies of the scene (got 'wal'; there are: 'wall'",
        ),
        (
            lambda: optical(HERE, {"wall": 2 * HERE}),
            "the pose of body 'wall' must be a rotation and a translation",
        ),
    ):
        with pytest.raises(sg.Error) as caught:
            call()
        assert message in str(caught.value)
