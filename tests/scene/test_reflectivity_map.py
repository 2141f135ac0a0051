"""Reflectivity maps: closed meshes stay closed, the mean is kept, the image is upright, rays agree."""

import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.scene import primitives as meshes
from sonar_gl.scene import reflectivity_map as maps
from sonar_gl.scene.reflectivity_map import read_image, textured, textured_from_above

pytestmark = pytest.mark.usefixtures("few_first_rays")

PLATE = meshes.plane(size=(10, 10))[0]
UV = (PLATE.vertices[:, :2] + 5) / 10
RANDOM = np.random.default_rng(0)


def areas(mesh):
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def middles(mesh):
    return mesh.vertices[mesh.faces].mean(axis=1)


@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (3, 7), (60, 25)])
def test_area_and_mean_reflectivity_are_preserved(shape):
    image = RANDOM.uniform(0, 1, shape)
    (mesh, normals), mu = textured(PLATE, UV, image)
    assert normals is None
    area = areas(mesh)
    assert area.sum() == pytest.approx(100, rel=1e-12)
    # faces cross texels unless both counts are powers of two: up to a sixteenth of a face is a neighbour's
    exact = not any(n & (n - 1) for n in shape)
    assert (mu * area).sum() / 100 == pytest.approx(image.mean(), rel=1e-9 if exact else 0.03)
    assert area.max() <= 100 / image.size * 1.5**2 / 2 + 1e-9 or image.size == 1


@pytest.mark.parametrize("shape", [(3, 7), (5, 5)])
def test_each_face_has_the_mean_of_the_image_over_it(shape):
    """By 576 points of each, against the 16 of the code, which err by less than their share of a step: rms 0.02."""
    image, n = np.random.default_rng(1).uniform(0, 1, shape), 24
    (mesh, _), mu = textured(PLATE, UV, image)
    i, j = np.indices((n, n)).reshape(2, -1)
    b, c = (np.concatenate([(k[i + j < n] + 1 / 3) / n, (k[i + j < n - 1] + 2 / 3) / n]) for k in (i, j))
    assert len(b) == n * n
    spots = np.einsum("kp,fkd->fpd", [1 - b - c, b, c], mesh.vertices[mesh.faces][..., :2])
    column = ((spots[..., 0] + 5) / 10 * shape[1]).astype(int)
    row = ((5 - spots[..., 1]) / 10 * shape[0]).astype(int)
    off = mu - image[row, column].mean(axis=1)
    assert np.sqrt((off**2).mean()) < 0.03 and np.abs(off).max() < 0.1


def test_faces_stay_large_in_constant_regions():
    assert len(textured(PLATE, UV, np.full((1000, 1000), 0.3))[0][0].faces) == 2
    image = np.zeros((512, 512))
    image[128:256, 256:384] = 1
    (mesh, _), mu = textured(PLATE, UV, image)
    assert set(mu) == {0.0, 1.0}  # the edges of the square are edges of faces
    assert len(mesh.faces) < 6000
    assert areas(mesh)[mu > 0].sum() == pytest.approx(100 / 16, rel=1e-12)


def test_the_first_row_is_on_top_and_the_first_column_left():
    image = np.arange(8).reshape(2, 4) / 10
    for (mesh, _), mu in (textured(PLATE, UV, image), textured_from_above((PLATE, None), image)):
        x, y, _ = middles(mesh).T
        column, row = ((x + 5) / 10 * 4).astype(int), ((5 - y) / 10 * 2).astype(int)
        np.testing.assert_allclose(mu, image[row, column], rtol=1e-14)


def test_the_image_repeats_beyond_its_edges():
    image = RANDOM.uniform(0, 1, (4, 4))
    once, mu = textured(PLATE, UV * 2 - 3, image)
    x, y, _ = middles(once[0]).T
    column, row = ((x + 5) / 10 * 8).astype(int) % 4, ((5 - y) / 10 * 8).astype(int) % 4
    np.testing.assert_allclose(mu, image[row, column], rtol=1e-14)


@pytest.mark.parametrize("seam", [pytest.param(False, marks=pytest.mark.slow), True])
def test_no_cracks(seam):
    """A closed mesh stays closed, also with duplicate vertices, as along the seams of an atlas."""
    ball = trimesh.creation.icosphere(1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    normals = vertices.copy()
    uv = vertices[:, :2] * 0.5 + 0.5
    if seam:  # each face has its own part of the image
        vertices, normals, faces = vertices[faces].reshape(-1, 3), normals[faces].reshape(-1, 3), None
        faces = np.arange(len(vertices)).reshape(-1, 3)
        uv = RANDOM.uniform(-0.5, 1, (len(vertices), 2))
    image = np.kron(RANDOM.uniform(0, 1, (8, 8)), np.ones((4, 4)))
    (mesh, smooth), mu = textured(SimpleNamespace(vertices=vertices, faces=faces), uv, image, normals)
    assert len(mesh.faces) == len(mu) > 4 * len(faces)
    joined = trimesh.Trimesh(mesh.vertices, mesh.faces)
    joined.merge_vertices(merge_tex=True, merge_norm=True)
    assert joined.is_watertight and joined.is_winding_consistent
    assert joined.volume == pytest.approx(ball.volume, rel=1e-12)
    np.testing.assert_allclose(np.linalg.norm(smooth, axis=1), 1, rtol=0, atol=2**-23)  # float32
    # interpolated normals are about those of the sphere
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (smooth * outward).sum(axis=1).min() > 0.99


@pytest.mark.slow
def test_raster_against_rays():
    """A textured floor and sphere: the ping agrees with the ray-cast reference."""
    floor = sg.textured_body(
        "floor", PLATE, np.kron(RANDOM.uniform(0.1, 1, (6, 5)), np.ones((4, 4))), UV, sg.pose(5, 0, -1.5)
    )
    ball = trimesh.creation.icosphere(3, 0.5)
    uv = np.asarray(ball.vertices)[:, 1:] + 0.5
    around = np.asarray(ball.vertices) / 0.5
    target = sg.textured_body(
        "ball", ball, RANDOM.uniform(0, 1, (8, 8)), uv, sg.pose(5, 0.4, -0.4), around, 0.3, 0.2
    )
    assert (target.specular, target.roughness_rad) == (0.3, 0.2)
    scene, sonar = sg.Scene([floor, target]), sg.Sonar("t", 900e3, 64, 100, 32.0, 30.0, 0.5, 0.5, 10.0)
    truth = sg.reference_ping(scene, sonar, np.eye(4), sg.Acoustics.ideal(), 0.05)  # errs by 0.5 %
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal()) as simulator:
        ping = simulator.ping(np.eye(4))
    assert ping_error(ping, truth) <= 0.01


def test_texture_coordinates_of_the_mesh(tmp_path):
    mesh = trimesh.Trimesh(PLATE.vertices, PLATE.faces, process=False)
    with pytest.raises(sg.Error, match="body 'plate': a mesh with an image needs texture coordinates"):
        sg.textured_body("plate", mesh, np.ones((2, 2)))
    mesh.visual = trimesh.visual.TextureVisuals(uv=UV)
    image = np.array([[0, 255], [128, 64]], np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    for file_or_array in (tmp_path / "a.png", str(tmp_path / "a.png"), image, image / 255):
        body = sg.textured_body("plate", mesh, file_or_array)
        assert sorted(set(body.reflectivity.round(6))) == [0, 0.25098, 0.501961, 1]


def test_images_of_8_and_16_bits_and_of_colour(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.array([[0, 65535, 13107]], np.uint16))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), [[0, 1, 0.2]])
    colour = np.zeros((1, 1, 3), np.uint8)
    colour[..., 1] = 153
    np.testing.assert_allclose(read_image(colour), [[0.2]], rtol=1e-14)
    for opacity in (0, 255):  # is no colour
        with_opacity = np.dstack([colour, np.full((1, 1), opacity, np.uint8)])
        np.testing.assert_allclose(read_image(with_opacity), [[0.2]], rtol=1e-14)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.full((2, 2), 200.0), "an image: reflectivity must lie in 0..1 (got 200 to 200;"),
        (None, "an image must be an array of numbers, or the path of a file (got None)"),
        (np.array([["a", "b"]]), "an image must be an array of numbers, or the path of a file"),
        (np.ones((3, 8, 8)), "an image must have shape (H, W), or (H, W, 1, 3 or 4) of colours (got"),
        (np.full((2, 2), np.nan), "an image: its values must be finite"),
        (np.zeros((0, 2)), "an image: must have a texel at least"),
        (np.zeros(4), "an image: its values must have shape"),
        ("nowhere.png", "nowhere.png: there is no such file"),
        (__file__, "must be an image that OpenCV reads"),
    ],
)
def test_invalid_images(image, words):
    with pytest.raises(sg.Error, match=re.escape(words)):
        sg.textured_body("plate", PLATE, image, UV)


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (
            trimesh.Scene([trimesh.creation.box()]),
            "mesh must be a trimesh.Trimesh (got Scene; sonar_gl.load_scene",
        ),
        ("plate.obj", "mesh must be a trimesh.Trimesh (got str; "),
        (trimesh.Trimesh(), "mesh must have at least one face"),
    ],
)
@pytest.mark.parametrize("uv", [None, UV])
def test_invalid_meshes(mesh, words, uv):
    with pytest.raises(sg.Error, match=re.escape(f"body 'plate': {words}")):
        sg.textured_body("plate", mesh, np.ones((2, 2)), uv)


def test_a_mesh_in_another_unit_gives_a_warning():
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.units = "mm"
    with pytest.warns(UserWarning, match="a mesh states the unit 'mm'"):
        sg.textured_body("plate", mesh, np.ones((2, 2)), mesh.vertices[:, :2])


def test_too_many_faces_are_refused(monkeypatch):
    monkeypatch.setattr(maps, "MAX_FACES", 1000)
    with pytest.raises(sg.Error, match=r"at most 1000 faces .* image of 64 x 32; make it smaller"):
        textured(PLATE, UV, RANDOM.uniform(0, 1, (32, 64)))
    with pytest.raises(sg.Error, match="texture coordinates must have shape"):
        textured(PLATE, UV[:3], np.ones((2, 2)))
    upright = (SimpleNamespace(vertices=PLATE.vertices[:, [0, 2, 1]], faces=PLATE.faces), None)
    with pytest.raises(sg.Error, match="laid from above needs a shape with some width"):
        textured_from_above(upright, np.ones((2, 2)))


def test_faces_on_the_far_edges_of_an_image_take_the_last_texels():
    image = np.zeros((8, 8))
    image[0, :] = 1.0  # the highest y
    (mesh, _), mu = textured_from_above((trimesh.creation.box((4, 4, 0.2)), None), image)
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    assert not mu[middle[:, 1] < -1.999].any() and (mu[middle[:, 1] > 1.999] == 1).all()
    (mesh, _), mu = textured_from_above((trimesh.creation.box((4, 4, 0.2)), None), image.T)  # the lowest x
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    assert not mu[middle[:, 0] > 1.999].any() and (mu[middle[:, 0] < -1.999] == 1).all()
