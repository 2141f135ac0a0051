"""Primitive shapes, height maps and mesh files: vertices, normals, orientation, errors."""

import warnings

import cv2
import numpy as np
import pytest
import trimesh

from sonar_gl.scene import mesh_files
from sonar_gl.scene import primitives as meshes
from tests.support.errors import error_of

FLOAT32 = 2**-23  # normals are float32: each of three numbers is rounded
UPWARD = np.array([0.0, 0.0, 0.3])  # tilts normals, so that they differ from computed ones
SOLIDS = {
    "box": (meshes.box((1.0, 2.0, 3.0)), 6.0, (1, 2, 3)),
    "cylinder": (meshes.cylinder(1.0, 2.0), 2 * np.pi, (2, 2, 2)),
    "sphere": (meshes.sphere(2.0), 32 / 3 * np.pi, (4, 4, 4)),
    "cone": (meshes.cone(1.0, 2.0), 2 / 3 * np.pi, (2, 2, 2)),
    "capsule": (meshes.capsule(1.0, 2.0), 2 * np.pi + 4 / 3 * np.pi, (2, 2, 4)),
    "ellipsoid": (meshes.ellipsoid((1.0, 2.0, 3.0)), 8 * np.pi, (2, 4, 6)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_oriented_outward_with_the_right_size(name):
    (mesh, normals), volume, extents = SOLIDS[name]
    mesh = mesh.to_trimesh()
    merged = mesh.copy()
    merged.merge_vertices()
    assert merged.is_watertight and merged.is_winding_consistent
    # chords lie half a millimetre within arcs of radius 0.4 m and more
    assert 0.996 * volume <= mesh.volume <= volume * (1 + 1e-12)
    np.testing.assert_array_equal(mesh.bounds, np.array([[-0.5], [0.5]]) * extents)
    assert mesh.area_faces.min() > 0
    if normals is not None:
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=0, atol=FLOAT32)
        cosines = np.einsum("fkc,fc->fk", normals[mesh.faces], mesh.face_normals)
        assert cosines.min() > np.cos(np.radians(6))  # half of 3.75 degrees; more where ellipsoids bend


def test_a_tiny_solid_far_from_the_origin_of_its_mesh_is_closed():
    """Whole numbers that tell its vertices apart overflowed: it was taken for an open surface, with a warning."""
    pebble = trimesh.creation.icosphere(2, 1e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert meshes.closedness(np.add(pebble.vertices, [5e5, 5e6, 0]), pebble.faces) == 1


def test_an_edge_of_four_faces_closes_no_mesh_and_keeps_its_ends():
    """Two tetrahedra that touch along the edge from vertex 0 to 1."""
    points = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
    one, other = ([(a, b, c), (b, a, d), (c, b, d), (a, c, d)] for a, b, c, d in ((1, 0, 2, 3), (1, 0, 4, 5)))
    assert [meshes.closedness(points, np.array(faces)) for faces in (one, other, one + other)] == [1, 1, 0]
    fixed = meshes.fixed_vertices(np.array(one + other), len(points))
    np.testing.assert_array_equal(fixed, [True, True, False, False, False, False])


def test_a_trimesh_that_is_changed_in_place_leaves_the_triangles_it_was_made_of():
    mesh = meshes.box((1, 1, 1)).mesh
    before = mesh.vertices.copy(), mesh.faces.copy()
    changed = mesh.to_trimesh()
    changed.vertices += 1.0
    changed.faces[:] = 0
    np.testing.assert_array_equal(mesh.vertices, before[0])
    np.testing.assert_array_equal(mesh.faces, before[1])


@pytest.mark.parametrize("radius", [0.02, 0.11, 0.5, 1.2, 5.0])
def test_chords_stay_near_their_arcs(radius):
    n = meshes.facets_around(radius)
    assert n % 4 == 0
    assert radius * (1 - np.cos(np.pi / n)) <= meshes.SAGITTA_M * (1 + 1e-9)
    assert n == 24 or radius * (1 - np.cos(np.pi / (n - 4))) > meshes.SAGITTA_M  # and no more than needed


def test_sphere_vertices_and_normals():
    mesh, normals = meshes.sphere(2.0)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 2.0, rtol=1e-12)
    np.testing.assert_allclose(normals, mesh.vertices / 2.0, rtol=0, atol=FLOAT32)
    n = meshes.facets_around(2.0)
    assert len(mesh.faces) == n * (2 * (n // 2) - 2)


def test_cylinder_has_a_smooth_side_flat_ends_and_sharp_edges():
    mesh, normals = meshes.cylinder(0.5, 3.0)
    side = normals[:, 2] == 0
    radial = mesh.vertices[side] / 0.5
    np.testing.assert_allclose(normals[side], radial * [1, 1, 0], rtol=0, atol=FLOAT32)
    np.testing.assert_array_equal(normals[~side], np.sign(mesh.vertices[~side]) * [0, 0, 1])
    rim = mesh.vertices[:, 2] == 1.5
    assert {0.0, 1.0} == set(normals[rim, 2].tolist())  # two vertices where side and end meet


def test_capsule_vertices_keep_their_distance_from_the_axis_segment():
    mesh, normals = meshes.capsule(0.5, 2.0)
    nearest = np.clip(mesh.vertices * [0, 0, 1], -1, 1)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - nearest, axis=1), 0.5, rtol=1e-12)
    np.testing.assert_allclose(normals, (mesh.vertices - nearest) / 0.5, rtol=0, atol=FLOAT32)


def test_ellipsoid_normals_are_gradients():
    radii = np.array([1.0, 2.0, 3.0])
    mesh, normals = meshes.ellipsoid(radii)
    np.testing.assert_allclose((mesh.vertices**2 / radii**2).sum(axis=1), 1, rtol=1e-12)
    gradient = mesh.vertices / radii**2
    np.testing.assert_allclose(
        normals, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), rtol=0, atol=FLOAT32
    )


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -2, 0), (1, 2, 3), (0, 1e-9, -1)])
def test_plane_turns_to_its_normal(normal):
    mesh, normals = meshes.plane(normal, (2.0, 4.0))
    mesh = mesh.to_trimesh()
    assert normals is None and len(mesh.faces) == 2
    unit = np.array(normal) / np.linalg.norm(normal)
    np.testing.assert_allclose(mesh.face_normals, [unit, unit], rtol=0, atol=1e-8)
    np.testing.assert_allclose(mesh.area, 8.0, rtol=1e-14)
    np.testing.assert_allclose(mesh.vertices @ unit, 0, rtol=0, atol=1e-8)


def test_plane_without_a_size_is_twenty_two_kilometres_wide():
    np.testing.assert_array_equal(meshes.plane()[0].to_trimesh().bounds, [[-11e3, -11e3, 0], [11e3, 11e3, 0]])


def test_transform_moves_normals_by_the_inverse_transpose():
    mesh, normals = meshes.transform(meshes.sphere(3.0), np.diag([1 / 3, 2 / 3, 1.0, 1.0]))
    other, expected = meshes.ellipsoid((1.0, 2.0, 3.0))
    np.testing.assert_allclose(mesh.vertices, other.vertices, rtol=1e-14)
    np.testing.assert_allclose(normals, expected, rtol=0, atol=FLOAT32)


def test_mirroring_keeps_the_orientation_outward():
    mesh, normals = meshes.transform(meshes.sphere(1.0), np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert mesh.to_trimesh().volume > 0
    np.testing.assert_allclose(normals, mesh.vertices, rtol=0, atol=FLOAT32)


def test_concatenate_gives_zero_normals_to_flat_shapes_and_merges_nothing():
    box, ball = meshes.box((1, 1, 1)), meshes.sphere(1.0)
    mesh, normals = meshes.concatenate([box, ball, box])
    assert len(mesh.vertices) == 8 + len(ball[0].vertices) + 8
    assert not normals[:8].any() and not normals[-8:].any()
    np.testing.assert_array_equal(normals[8:-8], ball[1])
    np.testing.assert_array_equal(mesh.vertices[mesh.faces[-12:]], box[0].vertices[box[0].faces])
    assert meshes.concatenate([box, box])[1] is None


# ---- height maps -------------------------------------------------------------------------------------


def test_heightmap_top_row_is_north_and_left_column_west(tmp_path):
    image = np.zeros((3, 4), np.uint8)
    image[0, 1] = 255  # top row: +y; second column: -x side
    image[2, 3] = 51
    cv2.imwrite(str(tmp_path / "h.png"), image)
    mesh, normals = mesh_files.heightmap(tmp_path / "h.png", (6.0, 4.0, 10.0), (100.0, 200.0, -5.0))
    assert normals is None and len(mesh.vertices) == 12 and len(mesh.faces) == 2 * 3 * 2
    heights = {tuple(v[:2]): v[2] for v in mesh.vertices.tolist()}
    assert heights.pop((99.0, 202.0)) == 5.0
    assert heights.pop((103.0, 198.0)) == pytest.approx(-3.0, abs=1e-12)
    assert set(heights.values()) == {-5.0}
    mesh = mesh.to_trimesh()
    np.testing.assert_array_equal(mesh.bounds[:, :2], [[97, 198], [103, 202]])
    assert (mesh.face_normals[:, 2] > 0).all()


COLOURS = np.array([[[30, 60, 90, 255], [0, 0, 0, 7]], [[90, 30, 0, 255], [0, 0, 60, 0]]], np.uint8)


@pytest.mark.parametrize(
    ("suffix", "image", "expected"),
    [
        ("png", np.array([[128, 64], [0, 32]], np.uint8), [3.0, 1.5, 0.0, 0.75]),
        ("png", np.array([[40000, 10000], [0, 20000]], np.uint16), [3.0, 0.75, 0.0, 1.5]),
        ("png", np.full((2, 2, 3), 51, np.uint8), [3.0] * 4),
        ("png", np.zeros((2, 2), np.uint8), [0.0] * 4),
        (
            "png",
            COLOURS,
            [3.0, 0.0, 2.0, 1.0],
        ),  # of their means, 60, 0, 40 and 20; how opaque they are does not count
        ("png", COLOURS[..., :3], [3.0, 0.0, 2.0, 1.0]),
        ("tiff", np.full((2, 2), -1.25, np.float32), [-1.25] * 4),
    ],
)
def test_heightmap_scales_by_the_largest_value_as_gazebo_does(tmp_path, suffix, image, expected):
    """HeightmapShape::Init of Gazebo Classic, and Ogre2Heightmap::Init of gz-rendering."""
    cv2.imwrite(str(tmp_path / f"h.{suffix}"), image)
    mesh, _ = mesh_files.heightmap(tmp_path / f"h.{suffix}", (1.0, 1.0, 3.0))
    np.testing.assert_allclose(mesh.vertices[:, 2], expected, rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.int16, np.uint16])
@pytest.mark.parametrize(
    ("size_z", "expected"), [(1.0, [1200, 1300, 1400, 1600]), (400.0, [1200, 1300, 1400, 1600]), (40.0, None)]
)
def test_a_tiff_is_an_elevation_model_whose_size_is_its_own_extent(tmp_path, dtype, size_z, expected):
    """Dem::FillHeightMap of gz-common; gz-sim's tutorial sets the z of `<size>` to maximum - minimum."""
    path = tmp_path / "dem.tif"
    cv2.imwrite(str(path), np.array([[1200, 1300], [1400, 1600]]).astype(dtype))
    mesh, _ = mesh_files.heightmap(path, (9.0, 9.0, size_z), (0.0, 0.0, -1600.0))
    expected = expected or [1200, 1210, 1220, 1240]
    np.testing.assert_allclose(mesh.vertices[:, 2], np.array(expected) - 1600.0, rtol=1e-12)


@pytest.mark.parametrize("size_z", [1.0, 7.0])
def test_a_level_elevation_model_keeps_its_height(tmp_path, size_z):
    path = tmp_path / "dem.tif"
    cv2.imwrite(str(path), np.full((2, 3), 12.5, np.float32))
    mesh, _ = mesh_files.heightmap(path, (9.0, 9.0, size_z))
    assert mesh.vertices[:, 2].tolist() == [12.5] * 6


@pytest.mark.parametrize("gap", [-9999.0, -32768.0])
def test_gaps_of_an_elevation_model_are_at_its_lowest_height(tmp_path, gap):
    path = tmp_path / "dem.tif"
    cv2.imwrite(str(path), np.array([[-30, gap], [-20, -10]], np.float32))
    with pytest.warns(UserWarning, match=r"heights of -9999 m or less \(1 of 4\) stand for gaps"):
        mesh, _ = mesh_files.heightmap(path, (9.0, 9.0, 20.0))
    np.testing.assert_allclose(mesh.vertices[:, 2], [-30, -30, -20, -10], rtol=1e-12)
    cv2.imwrite(str(path), np.full((2, 2), gap, np.float32))
    assert error_of(mesh_files.heightmap, path) == (
        f"{path}: heights must be more than -9999 m (got none; fill the gaps first)"
    )


def test_heightmap_errors(tmp_path):
    missing, text, dot, gap = (tmp_path / n for n in ("no.png", "text.png", "dot.png", "gap.tiff"))
    text.write_text("not an image")
    cv2.imwrite(str(dot), np.zeros((1, 5), np.uint8))
    cv2.imwrite(str(gap), np.array([[0, np.nan], [0, 0]], np.float32))
    assert error_of(mesh_files.heightmap, missing) == f"{missing}: there is no such file"
    assert error_of(mesh_files.heightmap, text) == (
        f"{text}: a height map must be an image that OpenCV reads (8 or 16 bit PNG, float TIFF)"
    )
    assert error_of(mesh_files.heightmap, dot) == (
        f"{dot}: a height map must have 2 x 2 pixels or more (got 5 x 1)"
    )
    assert error_of(mesh_files.heightmap, gap) == (
        f"{gap}: heights must be finite (got NaN or infinity; fill the gaps first)"
    )


# ---- mesh files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "ply", "dae"])
def test_normals_of_the_file_are_used(tmp_path, suffix):
    ball = trimesh.creation.icosphere(1)
    tilted = ball.vertices + UPWARD
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    ball = trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=tilted, process=False)
    if suffix == "gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(
            trimesh.Scene(ball), include_normals=True
        ).items():
            (tmp_path / name.replace("model.gltf", "a.gltf")).write_bytes(data)
    else:
        options = {"ply": {"vertex_normal": True}, "dae": {}}.get(suffix, {"include_normals": True})
        ball.export(tmp_path / f"a.{suffix}", **options)
    mesh, normals = mesh_files.read_mesh(tmp_path / f"a.{suffix}")
    expected = mesh.vertices + UPWARD
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert len(mesh.faces) == 80
    # text formats have 8 digits of normals, and of the vertices that these are compared with
    np.testing.assert_allclose(normals, expected, rtol=0, atol=2e-7)


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply", "stl"])
def test_files_without_normals_are_flat(tmp_path, suffix):
    ball = trimesh.creation.icosphere(1)
    options = {"ply": {"vertex_normal": False}, "stl": {}}.get(suffix, {"include_normals": False})
    ball.export(tmp_path / f"a.{suffix}", **options)
    mesh, normals = mesh_files.read_mesh(tmp_path / f"a.{suffix}")
    assert normals is None and len(mesh.faces) == 80
    # float32, or 8 digits, of vertices whose errors are unlike
    assert mesh.to_trimesh().volume == pytest.approx(ball.volume, rel=5e-8)


def test_bad_normals_in_a_file_become_flat(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property float nx\nproperty float ny\nproperty float nz\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
        "0 0 0 0 0 2\n1 0 0 nan 0 1\n0 1 0 0 0 0\n1 1 0 0 inf 0\n3 0 1 2\n"
    )
    _, normals = mesh_files.read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(normals, [[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]])


def test_degenerate_and_inverted_faces_load_unchanged(tmp_path):
    (tmp_path / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
        "f 1 2 3\nf 1 2 3\nf 3 2 1\nf 1 1 2\nf 1 2 4\n"  # duplicate, inverted, degenerate, open
    )
    mesh, normals = mesh_files.read_mesh(tmp_path / "a.obj")
    assert normals is None and len(mesh.faces) == 5


def test_scene_graph_is_flattened_and_submeshes_are_found(tmp_path):
    scene, move = trimesh.Scene(), np.eye(4)
    move[:3, 3] = 5, 0, 0
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), node_name="near", geom_name="one")
    scene.add_geometry(trimesh.creation.box((2, 2, 2)), node_name="far", geom_name="two", transform=move)
    scene.export(tmp_path / "a.glb")
    all_parts, _ = mesh_files.read_mesh(tmp_path / "a.glb")
    np.testing.assert_array_equal(all_parts.to_trimesh().bounds, [[-0.5, -1, -1], [6, 1, 1]])
    far, _ = mesh_files.read_mesh(tmp_path / "a.glb", "far")
    np.testing.assert_array_equal(far.to_trimesh().bounds, [[4, -1, -1], [6, 1, 1]])
    centred, _ = mesh_files.read_mesh(tmp_path / "a.glb", "far", center=True)
    np.testing.assert_array_equal(centred.to_trimesh().bounds, [[-1, -1, -1], [1, 1, 1]])
    assert error_of(mesh_files.read_mesh, tmp_path / "a.glb", "nose") == (
        f"{tmp_path / 'a.glb'}: there is no submesh 'nose' (it has far, near)"
    )


def test_a_centred_mesh_has_the_middle_of_its_box_at_the_origin_whatever_vertices_no_face_uses(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "1 1 1\n3 1 1\n1 5 1\n1 4 1\n50 60 70\n3 0 1 2\n3 0 1 3\n"
    )
    mesh, _ = mesh_files.read_mesh(tmp_path / "a.ply", center=True)
    assert len(mesh.vertices) == 5
    used = mesh.vertices[np.unique(mesh.faces)]
    np.testing.assert_allclose([used.min(axis=0), used.max(axis=0)], [[-1, -2, 0], [1, 2, 0]], atol=1e-12)


def test_collada_unit_is_applied_and_up_axis_is_not(tmp_path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "a.dae")
    text = (tmp_path / "a.dae").read_text()
    assert "<asset>" in text
    start, end = text.index("<asset>"), text.index("</asset>")
    asset = (
        "<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>"
        '<unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis>'
    )
    (tmp_path / "b.dae").write_text(text[:start] + asset + text[end:])
    mesh, _ = mesh_files.read_mesh(tmp_path / "b.dae")
    np.testing.assert_allclose(mesh.to_trimesh().extents, [0.01, 0.02, 0.03], rtol=1e-14)


POINTS = (
    "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    "end_header\n1 2 3\n"
)
NO_FACE = "a mesh must have at least one face (got none: the file is cut short, or a point cloud)"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("empty.stl", "", "must not be empty (got a file of 0 bytes)"),
        ("cut_short.stl", "\0" * 80 + "\x0c\0\0\0" + "\0" * 300, NO_FACE),
        ("points.ply", POINTS, NO_FACE),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", NO_FACE),
        (
            "nan.obj",
            "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
            "vertices must be finite (got NaN or infinity in 1 of 3 of geometry 'nan.obj'; fill the gaps, or leave out "
            "these vertices and their faces)",
        ),
    ],
)
def test_meshes_without_faces_or_with_nan(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    assert error_of(mesh_files.read_mesh, tmp_path / name) == f"{tmp_path / name}: {message}"


@pytest.mark.parametrize("name", ["bad.glb", "bad.gltf", "bad.ply", "bad.dae"])
def test_unreadable_meshes_name_the_file(tmp_path, name):
    (tmp_path / name).write_text("garbage")
    start = f"{tmp_path / name}: trimesh cannot read this mesh ("  # what follows is trimesh's own
    assert error_of(mesh_files.read_mesh, tmp_path / name).startswith(start)


def test_missing_mesh(tmp_path):
    path = tmp_path / "no.stl"
    assert error_of(mesh_files.read_mesh, path) == f"{path}: there is no such file"


def test_collada_with_entities_is_refused(tmp_path):
    path = tmp_path / "bomb.dae"
    path.write_text('<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><COLLADA>&b;</COLLADA>')
    assert error_of(mesh_files.read_mesh, path) == (
        f"{path}: trimesh cannot read this mesh (ValueError: a document type declaration is refused)"
    )


def test_text_meshes_need_not_be_utf8(tmp_path):
    """CAD programs write comments in Latin-1."""
    text = "# mod\xe8le\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_bytes(text.encode("latin-1"))
    mesh, _ = mesh_files.read_mesh(tmp_path / "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2]]


TWO_TRIANGLES = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]]


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n",
        "vn 0 0 1\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf -3//-1 -2//-1 -1//-1\nv 0 0 5\nv 1 0 5\nv 0 1 5\nvn 0 0 1\n"
        "f -3//-1 -2//-1 -1//-1\n",
        "\tv 0 0 0\n  v 1 0 0\nv\t0\t1 0\nv 0 0 5\nv 1 0 5\nv 0 1 5\n  f 1 2 3\nf\t4 5 6",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf 1 2\\\n3\nf 4 5\\\r\n6\n",
        "v 0 0 0\rv 1 0 0\rv 0 1 0\rf 1 2 3\rv 0 0 5\rv 1 0 5\rv 0 1 5\rf 4 5 6\r",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_obj_files_as_other_programs_write_them(tmp_path, text, encoding):
    path = tmp_path / "a.obj"
    path.write_bytes(("# mod\xe8le\n" + text).encode(encoding))
    mesh, _ = mesh_files.read_mesh(path)
    assert mesh.vertices[mesh.faces].reshape(-1, 3).tolist() == TWO_TRIANGLES


TURNS = np.eye(3), -np.eye(3), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]
NOTCHED = "v -2 -2 0\nv 2 -2 0\nv 2 2 0\nv 0 -1.5 0\nv -2 2 0\n"


@pytest.mark.parametrize("matrix", TURNS)
@pytest.mark.parametrize("face", ["1 2 3 4 5", "5 4 3 2 1", "-4/1 -3/1 -2/1 -1/1 -5/1"])
def test_concave_polygons_of_obj_files_have_their_own_area(tmp_path, matrix, face):
    """A fan from the first corner would cover the notch, as an opening in a wall."""
    points = np.array(NOTCHED.replace("v", "").split(), float).reshape(5, 3) @ np.transpose(matrix)
    lines = "".join("v {} {} {}\n".format(*point) for point in points)
    (tmp_path / "a.obj").write_text(f"{lines}vt 0 0\nf {face}\n")
    mesh, _ = mesh_files.read_mesh(tmp_path / "a.obj")
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    areas = np.cross(b - a, c - a) / 2
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(9, rel=1e-14)  # 16 - 7 of the notch
    sense = -1 if face.startswith("5") else 1
    wanted = sense * np.linalg.det(matrix) * np.asarray(matrix) @ (0, 0, 9)
    np.testing.assert_allclose(areas.sum(axis=0), wanted, rtol=0, atol=1e-14)


def test_convex_polygons_of_obj_files_stay_fans(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 2 0 0\nv 3 1 0\nv 2 2 0\nv 0 2 0\nf 1 2 3 4 5\n")
    mesh, _ = mesh_files.read_mesh(tmp_path / "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


@pytest.mark.parametrize("face", ["0 1 2", "1 2 0", "1/1 0/1 2/1", "-1 -2 -4"])
def test_obj_files_that_count_from_0_are_refused(tmp_path, face):
    path = tmp_path / "a.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1 2 3\nf {face}")
    assert error_of(mesh_files.read_mesh, path) == (
        f"{path}: faces of an OBJ file must name vertices that exist, the first of which is 1 (got 'f {face}'; add 1 "
        "to the numbers of a file that counts from 0)"
    )


def test_groups_of_obj_files_without_objects_are_parts(tmp_path):
    path, points = tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    path.write_text(
        f"g default\n{points}g hull\nusemtl a\nf 1 2 3\ng mast top\nusemtl b\nf 3 2 1\ng hull\nusemtl a\nf 1 3 2\n"
    )
    parts = {part.node: len(part.shape.mesh.faces) for part in mesh_files.read_mesh_parts(path)}
    assert parts == {"hull": 2, "mast top": 1}
    assert len(mesh_files.read_mesh(path, "Hull").mesh.faces) == 2
    path.write_text(f"o boat\n{points}g hull\nf 1 2 3\ng mast\nf 3 2 1\n")
    assert [part.node for part in mesh_files.read_mesh_parts(path)] == ["boat"]
