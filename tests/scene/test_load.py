"""Scenes from bundled names, files, and objects of trimesh and pyrender."""

import copy
import importlib.metadata
import json
import os
import pickle
import subprocess
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.data_files import data_folder
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import pose
from sonar_gl.scene import load
from sonar_gl.scene.load import bundled_scenes, load_scene, scene_description
from sonar_gl.scene.placed_shapes import PlacedShapes
from sonar_gl.scene.primitives import box
from sonar_gl.scene.pyrender_scene import import_pyrender
from sonar_gl.scene.scene import Scene
from tests.support.errors import error_of
from tests.support.processes import python

ENDINGS = ".sdf .world .urdf .xacro .xml .mjcf .glb .gltf .obj .stl .ply .dae"
SDF = (
    "<sdf version='1.9'>{}<model name='m'><link name='l'><collision name='c'><geometry><box>"
    "<size>1 2 3</size></box></geometry><laser_retro>51</laser_retro></collision></link></model></sdf>"
)


@pytest.fixture
def pyrender():
    try:
        return import_pyrender()
    except Error as why:
        pytest.skip(str(why))


def error_message(*args, **kwargs):
    with pytest.raises(Error) as caught:
        load_scene(*args, **kwargs)
    return str(caught.value)


# ---- names and files ---------------------------------------------------------------------------------


def test_data_folders_are_found():
    assert (data_folder("shaders")).is_dir() and (data_folder("scenes")).is_dir()
    with pytest.raises(Error, match="the folder 'nonsense' is neither in"):
        data_folder("nonsense")


def test_bundled_scenes_are_those_of_the_folder():
    """So that tests of each bundled scene are tests of some."""
    folder = Path(__file__).resolve().parents[2] / "scenes"
    names = {name.removesuffix(".sdf") for name in os.listdir(folder) if name.endswith(".sdf")}
    assert names == bundled_scenes().keys() >= {"harbour", "pylon", "diver"}


def test_every_bundled_scene_loads_without_a_warning():
    for name, path in bundled_scenes().items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            scene = load_scene(name)
        assert scene.name == name == path.stem
        assert scene.surface_z_m is None or scene.sonar_pose[2, 3] < scene.surface_z_m, name
        assert scene.n_triangles > 0 and scene_description(path)


def test_bundled_scenes_name_materials_and_return_no_more_than_arrives():
    names = set()
    for name in bundled_scenes():
        for body in load_scene(name).bodies:
            assert np.max(body.reflectivity) + body.specular <= 1, (name, body.name)
            names.add(body.material)
    # None: shapes of several materials that are one body, the suit and the fins of the swimming diver
    assert names == {
        *("medium_sand", "medium_silt", "rock", "concrete", "smooth_concrete", "steel", "corroded_steel"),
        *("brass", "foam_neoprene", "rubber", "wet_wood", None),
    }


@pytest.fixture
def two_scenes(tmp_path, monkeypatch):
    for name in ("pylon", "harbour"):
        (tmp_path / f"{name}.sdf").write_text(SDF.format(""))
    monkeypatch.setattr(load, "data_folder", lambda name: tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("names", "hint"),
    [
        ([], ""),
        (["notes.txt"], ""),
        (["a.stl"], "; give one of its files: a.stl"),
        (
            ["b.OBJ", "a.stl", "notes.txt"],
            "; give one of its files: a.stl, b.OBJ; or an SDF file with a model for each mesh",
        ),
        (["b.obj", "a.stl", "tank.sdf"], "; give one of its files: a.stl, b.obj, tank.sdf"),
    ],
)
def test_a_folder_of_meshes_is_told_what_to_give(tmp_path, names, hint):
    for name in names:
        (tmp_path / name).touch()
    assert error_message(tmp_path) == (
        f"{tmp_path}: a folder must be that of a model (it has neither model.config nor model.sdf{hint})"
    )


def test_bundled_names_and_unknown_ones(two_scenes):
    assert list(bundled_scenes()) == ["harbour", "pylon"]
    assert load_scene("pylon").name == "pylon"
    hint = f"a file must end in one of {ENDINGS}"
    assert error_message("pilon") == (f"there is no bundled scene 'pilon' (did you mean 'pylon'?; {hint})")
    assert error_message("xyz") == f"there is no bundled scene 'xyz' (known are harbour, pylon; {hint})"


def test_a_bundled_name_as_a_path(two_scenes):
    assert error_message(Path("pylon")) == (
        "there is no bundled scene 'pylon' (a Path is that of a file: name a bundled scene by text; a file must end in "
        f"one of {ENDINGS})"
    )


def test_invalid_paths(two_scenes):
    assert error_message("") == "a scene must be a bundled name or a path (got an empty text)"
    assert error_message("no.sdf") == (
        "no.sdf: there is no such file (bundled scenes are named without an ending)"
    )
    assert error_message(two_scenes / "a.fbx") == (
        f"{two_scenes / 'a.fbx'}: a scene file must end in one of {ENDINGS} (got '.fbx')"
    )
    assert (
        error_message(str(two_scenes))
        == f"{two_scenes}: a folder must be that of a model (it has neither model.config nor model.sdf; give one of "
        "its files: harbour.sdf, pylon.sdf)"
    )
    for address in (
        "https://fuel.gazebosim.org/1.0/a/models/Boat",
        "model://boat",
        "file:///models/a.sdf",
        "HTTPS://FUEL.GAZEBOSIM.ORG/1.0/a/models/Boat",
        "Http://example.org/a.sdf",
        "FUEL://boat",
        "git+ssh://example.org/a.glb",
        "s3://bucket/a.sdf",
    ):
        assert error_message(address) == (
            f"a scene must be a bundled name or a path (got the address {address!r}; give the path of its file or "
            "folder on this machine)"
        )
    assert error_message("a.usdz") == "a.usdz: USD is not read; convert it to .glb, for instance by Blender"
    assert error_message(3) == (
        "a scene must be a bundled name, a path, or a scene or mesh of trimesh, pyrender or MuJoCo (got int)"
    )


@pytest.mark.parametrize("suffix", [".sdf", ".world", ".SDF"])
def test_sdf_files(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text(SDF.format(""))
    for what in (path, str(path)):
        scene = load_scene(what)
        assert (scene.name, scene.bodies[0].name, scene.bodies[0].reflectivity) == ("a", "m", 0.2)


def test_resource_paths_and_skip_missing_reach_the_reader(tmp_path):
    path = tmp_path / "a.world"
    path.write_text("<sdf><world name='w'><include><uri>model://rock</uri></include></world></sdf>")
    (tmp_path / "models" / "rock").mkdir(parents=True)
    (tmp_path / "models" / "rock" / "model.sdf").write_text(SDF.format(""))
    assert len(load_scene(path, [tmp_path / "models"]).bodies) == 1
    with pytest.warns(UserWarning, match="model://rock"):
        assert load_scene(path, skip_missing=True).bodies == ()


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        ("<!-- A pylon\n   and a &amp; sign. --><description>no</description>", "A pylon and a & sign."),
        ("<model><description>Words\n of it.</description></model>", "Words of it."),
        ("", ""),
    ],
)
def test_scene_description(tmp_path, inside, expected):
    (tmp_path / "a.sdf").write_text(f"<sdf>{inside}</sdf>")
    assert scene_description(tmp_path / "a.sdf") == expected


@pytest.mark.parametrize(("suffix", "extents"), [("glb", (1, 3, 2)), ("gltf", (1, 3, 2)), ("stl", (1, 2, 3))])
def test_only_gltf_is_turned_to_z_up(tmp_path, suffix, extents):
    box = trimesh.creation.box((1, 2, 3))
    box.apply_translation((0, 0, 10))
    if suffix == "gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(box)).items():
            (tmp_path / name.replace("model.gltf", "a.gltf")).write_bytes(data)
    else:
        box.export(tmp_path / f"a.{suffix}")
    scene = load_scene(tmp_path / f"a.{suffix}")
    (body,) = scene.bodies
    assert (scene.name, body.name, body.reflectivity) == ("a", "a", 0.5)
    np.testing.assert_array_equal(body.mesh.extents, extents)
    centre = (0, 0, 10) if suffix == "stl" else (0, -10, 0)
    np.testing.assert_array_equal(body.mesh.bounds.mean(axis=0), centre)
    assert body.mesh.volume == pytest.approx(6, rel=1e-12)


def test_a_missing_file_of_another_case_or_with_a_slip_is_suggested(tmp_path):
    for name in ("Harbour wall.OBJ", "b.sdf", "notes.txt"):
        (tmp_path / name).touch()
    for name, hint in (
        ("harbour wall.obj", "did you mean 'Harbour wall.OBJ'?"),
        ("notes.sdf", "bundled scenes are named without an ending"),
    ):
        assert error_of(load_scene, tmp_path / name) == f"{tmp_path / name}: there is no such file ({hint})"


@pytest.mark.parametrize("suffix", ["glb", "obj", "stl"])
def test_the_reflectivity_that_a_mesh_file_lacks_is_told_of(tmp_path, suffix):
    parts = {"hull": trimesh.creation.box((1, 2, 3)), "mast": trimesh.creation.box((1, 1, 9))}
    path = tmp_path / f"a.{suffix}"
    trimesh.Scene(parts).export(path)
    with pytest.warns(UserWarning) as caught:
        scene = load_scene(path)
    assert [str(w.message) for w in caught] == [
        f"{path}: a mesh file states no reflectivity; it is taken as 0.5 (give another in Python, or by an SDF file "
        "that includes the mesh)"
    ]
    assert {body.reflectivity for body in scene.bodies} == {0.5}


@pytest.mark.parametrize(
    ("suffix", "away_m", "step_m"),
    [
        *((suffix, 4_500_000.37, 0.5) for suffix in ("dae", "glb", "ply", "stl")),
        *((suffix, 10_000.37, None) for suffix in ("dae", "glb", "ply", "stl")),
        ("obj", 4_500_000.37, None),
    ],
)
def test_vertices_that_single_precision_rounds_are_told_of(tmp_path, suffix, away_m, step_m):
    """A quay wall in UTM was read with steps of half a metre, without a word."""
    path = tmp_path / f"a.{suffix}"
    wall = trimesh.creation.box((1.1, 2.2, 3.3)).apply_translation((0, away_m, 0))
    wall.unmerge_vertices()  # trimesh writes normals into COLLADA: those of faces
    wall.export(path)
    with pytest.warns(UserWarning) as caught:
        load_scene(path)
    *said, _ = [str(w.message) for w in caught if w.category is UserWarning]
    assert said == (
        []
        if step_m is None
        else [
            f"{path}: positions of vertices are rounded to steps of {step_m} m, since they are far from the file's "
            "origin and in single precision (move the mesh to the origin before it is written, and place it by a "
            "pose; or write an OBJ or a PLY of doubles)"
        ]
    )


@pytest.mark.filterwarnings("ignore:.*reflectivity", "error:.*rounded")
def test_whole_metres_of_a_file_of_decimals_are_not_taken_as_rounded(tmp_path):
    """Single precision holds them, too, even in UTM."""
    path = tmp_path / "a.obj"
    trimesh.creation.box((2, 2, 2)).apply_translation((500_000, 4_500_000, -10)).export(path)
    assert load_scene(path).bodies[0].mesh.bounds[1].tolist() == [500_001, 4_500_001, -9]


@pytest.mark.filterwarnings("ignore:.*reflectivity", "error:.*rounded")
@pytest.mark.parametrize("kind", ["double", "float64"])
def test_a_ply_of_doubles_is_not_taken_as_rounded(tmp_path, kind):
    """Cells of a raster in UTM are whole multiples of half a metre, and heights of a GeoTIFF have single precision."""
    heights = np.float32([-40.1, -40.2, -40.3]).astype(np.float64)
    corners = np.column_stack([[500_000, 500_000.5, 500_000], [4_500_000, 4_500_000, 4_500_000.5], heights])
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n" + "".join(
        f"property {kind} {axis}\n" for axis in "xyz"
    )
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path = tmp_path / "a.ply"
    path.write_bytes(
        header.encode() + corners.astype("<f8").tobytes() + b"\3" + np.arange(3, dtype="<i4").tobytes()
    )
    np.testing.assert_array_equal(load_scene(path).bodies[0].mesh.vertices, corners)


@pytest.mark.filterwarnings("ignore:.*reflectivity")
@pytest.mark.parametrize("end", ["# last", "#2 4 3"])
def test_comments_after_the_numbers_of_an_obj(tmp_path, end):
    (tmp_path / "a.obj").write_text(
        f"v 0 0 0 {end}\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3 {end}\nf 2 4 3 {end}\n"
    )
    assert load_scene(tmp_path / "a.obj").bodies[0].mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2]]


def test_normals_of_a_glb_turn_with_it(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "a.glb", include_normals=True)
    (body,) = load_scene(tmp_path / "a.glb").bodies
    # glTF has float32 of both
    np.testing.assert_allclose(body.normals, body.mesh.vertices, rtol=0, atol=2**-23)


def _gltf_of_copies(path, mesh, matrices: dict):
    scene = trimesh.Scene()
    scene.geometry["rock"] = mesh
    for name, matrix in matrices.items():
        scene.graph.update(name, geometry="rock", matrix=matrix)
    scene.export(path, include_normals=True)


def _scaled(matrix, *factors):
    return matrix @ np.diag([*factors, 1.0])


def test_copies_in_a_mesh_file_of_one_size_share_their_mesh(tmp_path):
    """A level of a game has hundreds of copies of a rock: pings keep one mesh of those of one size and handedness."""
    rock = trimesh.creation.icosphere(1)
    rock.apply_transform(np.diag([1, 0.5, 0.8, 1]) + np.diag([0.2, 0.1, 0], 1))
    turned = pose(7, 8, 9, roll=0.3, pitch=-0.4, yaw=2)
    matrices = {
        "plain": pose(1, 2, 3),
        "turned": turned,
        "large": _scaled(turned, 2, 2, 2),
        "large_too": _scaled(pose(-5, yaw=1), 2, 2, 2),
        "mirrored": _scaled(turned, 1, 1, -1),
        "inverted": _scaled(pose(4), -1, -1, -1),
        "stretched": _scaled(turned, 1, 2, 3),
        "flattened": _scaled(turned, 1, 1, 0),
    }
    _gltf_of_copies(tmp_path / "a.glb", rock, matrices)
    bodies = {body.name: body for body in load_scene(tmp_path / "a.glb").bodies}
    assert set(bodies) == set(matrices)
    one = {name: (id(body.surface), id(body.normals)) for name, body in bodies.items()}
    assert one["plain"] == one["turned"] and one["large"] == one["large_too"]
    assert one["mirrored"] == one["inverted"] and len(set(one.values())) == 5
    y_up_to_z_up = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    for name, body in bodies.items():
        expected = y_up_to_z_up @ matrices[name] @ np.c_[rock.vertices, np.ones(len(rock.vertices))].T
        got = body.pose @ np.c_[body.mesh.vertices, np.ones(len(body.mesh.vertices))].T
        # positions of glTF are float32, and about 1; its matrices have 64 bits
        np.testing.assert_allclose(got, expected, rtol=0, atol=4e-7)
        assert np.allclose(body.pose[:3, :3] @ body.pose[:3, :3].T, np.eye(3), rtol=0, atol=1e-12)
        if name != "flattened":  # outside stays outside, for faces and for normals
            assert body.mesh.volume == pytest.approx(
                rock.volume * abs(np.linalg.det(matrices[name][:3, :3])), 1e-5
            )
            facing = np.einsum("ij,ij->i", body.normals, body.mesh.vertices - body.mesh.vertices.mean(axis=0))
            assert (facing > 0).all()


def test_the_mesh_of_many_copies_is_turned_once(tmp_path, monkeypatch):
    _gltf_of_copies(
        tmp_path / "a.glb", trimesh.creation.icosphere(1), {f"rock_{k}": pose(k) for k in range(9)}
    )
    turned, transform = [], load.transform
    monkeypatch.setattr(load, "transform", lambda *given: turned.append(given) or transform(*given))
    assert len(load_scene(tmp_path / "a.glb").bodies) == 9 and len(turned) == 1


def test_the_body_of_a_mesh_file_has_the_pose_of_its_node(tmp_path):
    """So `place` and `bodies=` mean the same of all nodes, whether or not others share their geometry."""
    _gltf_of_copies(tmp_path / "a.glb", trimesh.creation.box((1, 2, 3)), {"quay": pose(4, 5, 6)})
    (body,) = load_scene(tmp_path / "a.glb").bodies
    np.testing.assert_array_equal(body.pose, pose(4, -6, 5))
    np.testing.assert_array_equal(body.mesh.bounds, [[-0.5, -1.5, -1], [0.5, 1.5, 1]])


@pytest.mark.filterwarnings("ignore:.*reflectivity")
def test_nodes_of_a_mesh_file_that_are_not_finite_are_named(tmp_path):
    """Scales of nested nodes are multiplied, and may overflow."""
    _gltf_of_copies(tmp_path / "a.gltf", trimesh.creation.box((1, 2, 3)), {"quay": np.eye(4)})
    content = json.loads((tmp_path / "a.gltf").read_text())
    scale = {"scale": [1e200, 1, 1]}
    content |= {
        "nodes": [{"children": [1]} | scale, {"name": "quay", "mesh": 0} | scale],
        "scenes": [{"nodes": [0]}],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.raises(Error, match=r"a.gltf: nodes must have finite transforms \(got .* in node 'quay'"):
        load_scene(tmp_path / "a.gltf")
    (tmp_path / "a.sdf").write_text(
        "<sdf><model name='m'><link name='l'><collision name='c'><geometry><mesh><uri>a.gltf</uri></mesh></geometry>"
        "</collision></link></model></sdf>"
    )
    with pytest.raises(Error, match=r"nodes must have finite transforms"):
        load_scene(tmp_path / "a.sdf")


# ---- trimesh -----------------------------------------------------------------------------------------


def test_a_trimesh_is_a_flat_body():
    ball = trimesh.creation.icosphere(1)
    assert len(ball.vertex_normals)  # computed by trimesh, not those of the mesh
    scene = load_scene(ball)
    (body,) = scene.bodies
    assert (scene.name, body.name, body.reflectivity, body.normals) == ("scene", "mesh", 0.5, None)
    np.testing.assert_array_equal(body.mesh.vertices, ball.vertices)


@pytest.mark.parametrize("unit", ["mm", "inches", "0.0254 * meters", "furlongz"])
def test_a_mesh_of_another_unit_than_metres_gives_a_warning(unit):
    """It is not converted, since trimesh keeps the unit when the mesh is scaled by hand."""
    mesh = trimesh.creation.box((100, 100, 100))
    mesh.units = unit
    rigid, scaled = trimesh.Scene([mesh]), trimesh.Scene()
    scaled.add_geometry(mesh, transform=np.diag([2.0, 2.0, 2.0, 1.0]))
    for make in (lambda: sg.Body("box", mesh), *(partial(load_scene, one) for one in (mesh, rigid, scaled))):
        with pytest.warns(UserWarning, match="coordinates are taken as metres") as found:
            make()
        assert len(found) == 1 and f"'{unit}'" in str(found[0].message)


@pytest.mark.parametrize("unit", [None, "none", "", "m", "meters", "metres", "1.0 * meters"])
def test_a_mesh_in_metres_gives_no_warning(unit):
    mesh = trimesh.creation.box()
    if unit is not None:
        mesh.units = unit
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(trimesh.Scene([mesh]))


def test_a_trimesh_scene_keeps_coordinates_and_applies_scale_to_vertices():
    scene, scaled = trimesh.Scene(), pose(1, 2, 3, yaw=np.pi / 2)
    scaled[:3, :3] *= 2
    scene.add_geometry(trimesh.creation.box((1, 2, 3)), node_name="rigid", transform=pose(4, 5, 6, roll=1))
    scene.add_geometry(trimesh.creation.box((1, 2, 3)), node_name="scaled", transform=scaled)
    mirrored = np.diag([-1.0, 1, 1, 1])
    scene.add_geometry(trimesh.creation.box((1, 2, 3)), node_name="mirrored", transform=pose(0, 9) @ mirrored)
    scene.add_geometry(trimesh.PointCloud(np.zeros((3, 3))), node_name="points")
    bodies = {body.name: body for body in load_scene(scene).bodies}
    assert set(bodies) == {"rigid", "scaled", "mirrored"}
    np.testing.assert_array_equal(bodies["rigid"].pose, pose(4, 5, 6, roll=1))
    # of a node that is scaled, too, the pose is that of the node: as in mesh files
    np.testing.assert_allclose(bodies["scaled"].pose, pose(1, 2, 3, yaw=np.pi / 2), rtol=0, atol=1e-15)
    np.testing.assert_allclose(bodies["scaled"].mesh.extents, [2, 4, 6], rtol=1e-14)
    assert bodies["mirrored"].mesh.volume > 0  # its faces still look outwards


def test_copies_in_a_trimesh_scene_of_one_size_share_their_mesh_as_in_mesh_files():
    scene, rock = trimesh.Scene(), trimesh.creation.icosphere(1)
    turned = pose(7, 8, 9, roll=0.3, pitch=-0.4, yaw=2)
    scene.add_geometry(rock, geom_name="rock", node_name="plain", transform=turned)
    for name, place in (("large", turned), ("large_too", pose(-5, yaw=1))):
        scene.graph.update(frame_to=name, matrix=_scaled(place, 2, 2, 2), geometry="rock")
    bodies = {body.name: body for body in load_scene(scene).bodies}
    assert bodies["plain"].surface is rock
    assert bodies["large"].surface is bodies["large_too"].surface


def test_a_node_whose_rotation_is_rounded_has_one_as_pose_and_the_shape_as_it_is():
    """As of matrices in single precision, from a program of graphics."""
    shape, place = box((1, 2, 3)), np.array(pose(7, 8, 9, roll=0.3, pitch=-0.4, yaw=2))
    place[:3, :3] = place[:3, :3].astype(np.float32)
    body = PlacedShapes().body("a", shape, place)
    assert body.surface is shape.mesh
    assert np.allclose(body.pose[:3, :3] @ body.pose[:3, :3].T, np.eye(3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(body.pose, place, rtol=0, atol=1e-7)  # half a step of float32 is 6e-8


# ---- pyrender ----------------------------------------------------------------------------------------


def test_import_pyrender_leaves_numpy_alone(pyrender):
    before = hasattr(np, "infty")
    mesh = pyrender.Mesh.from_trimesh(trimesh.creation.box())
    scene = pyrender.Scene()
    scene.add(mesh)
    np.testing.assert_array_equal(scene.bounds, [[-0.5] * 3, [0.5] * 3])  # numpy 2 broke this
    assert hasattr(np, "infty") is before


def test_a_pyopengl_too_old_for_python_3_14_is_told(pyrender, monkeypatch):
    """The one that pyrender asks for raises an ArgumentError of ctypes at the first texture."""
    monkeypatch.setattr(sys, "version_info", (3, 14, 0))
    version = importlib.metadata.version
    for installed in "3.1.0", "3.1.6", "3.1.10", "3.2.0rc1":
        monkeypatch.setattr(
            importlib.metadata,
            "version",
            lambda name, installed=installed: installed if name == "PyOpenGL" else version(name),
        )
        if installed != "3.1.0":
            assert import_pyrender() is pyrender
            continue
        assert error_of(import_pyrender) == (
            "pyrender must have PyOpenGL>=3.1.6 to draw in Python 3.14 (got 3.1.0, which pyrender itself asks for; to "
            f"add it: {sys.executable} -m pip install 'PyOpenGL>=3.1.6', and do not mind that pip then says so)"
        )


def test_pyrender_scene_round_trip(pyrender):
    box, ball = trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere(2)
    scene = pyrender.Scene(name="host")
    parent = scene.add_node(pyrender.Node(name="parent", matrix=pose(10, 0, 0, yaw=np.pi / 2))) or next(
        iter(scene.get_nodes(name="parent"))
    )
    scene.add(
        pyrender.Mesh.from_trimesh(box, smooth=False), name="box", pose=pose(1, 2, 3), parent_node=parent
    )
    scene.add(pyrender.Mesh.from_trimesh(ball, smooth=True), name="ball", pose=pose(0, 0, 7))
    scene.add(pyrender.Mesh.from_trimesh(ball, smooth=True), name="ball")
    scene.add(pyrender.Mesh.from_points(np.zeros((5, 3))), name="points")
    scene.add(pyrender.PerspectiveCamera(1.0), name="camera")
    loaded = load_scene(scene)
    assert loaded.name == "host" and [b.name for b in loaded.bodies] == ["box", "ball", "ball_2"]
    placed, round_, _ = loaded.bodies
    np.testing.assert_allclose(placed.pose, pose(8, 1, 3, yaw=np.pi / 2), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(placed.mesh.triangles, box.triangles)
    cosines = np.einsum("fkc,fc->fk", placed.normals[placed.mesh.faces], placed.mesh.face_normals)
    np.testing.assert_array_equal(cosines, 1)
    np.testing.assert_array_equal(round_.pose, pose(0, 0, 7))
    # pyrender keeps float32
    np.testing.assert_allclose(round_.mesh.vertices, ball.vertices, rtol=0, atol=2**-24)
    np.testing.assert_allclose(round_.normals, ball.vertex_normals, rtol=0, atol=2**-24)
    assert round_.reflectivity == 0.5


def test_pyrender_instances_are_joined(pyrender):
    poses = np.stack([pose(x, 0, 0) for x in (-5.0, 5.0)])
    mesh = pyrender.Mesh.from_trimesh(trimesh.creation.box(), poses=poses)
    scene = pyrender.Scene()
    scene.add(mesh, pose=pose(0, 0, 1))
    (body,) = load_scene(scene).bodies
    assert len(body.mesh.faces) == 24
    np.testing.assert_array_equal(body.mesh.bounds, [[-5.5, -0.5, -0.5], [5.5, 0.5, 0.5]])
    np.testing.assert_array_equal(body.pose, pose(0, 0, 1))


@pytest.mark.parametrize("indices", [None, [3, 2, 1, 0, 4]])
@pytest.mark.parametrize(
    "mode, corners", [(5, [0, 1, 2, 2, 1, 3, 2, 3, 4]), (6, [0, 1, 2, 0, 2, 3, 0, 3, 4])]
)
def test_strips_and_fans_of_pyrender(pyrender, mode, corners, indices):
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 3, 0], [0, 2, 0]], np.float32)
    drawn = points if indices is None else points[indices]
    given = None if indices is None else np.array(indices)
    scene = pyrender.Scene()
    scene.add(pyrender.Mesh([pyrender.Primitive(points, indices=given, mode=mode)]))
    (body,) = load_scene(scene).bodies
    np.testing.assert_array_equal(body.mesh.triangles.reshape(-1, 3), drawn[corners])


def test_objects_with_the_interface_of_a_pyrender_scene():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
    primitive = SimpleNamespace(positions=corners, indices=None, normals=None, poses=None, mode=4)
    lines = SimpleNamespace(positions=corners, indices=None, normals=None, poses=None, mode=1)
    nodes = {
        SimpleNamespaceNode(name=name, mesh=SimpleNamespace(name=None, primitives=[primitive, lines]))
        for name in ("c", "a", "b", None)
    }
    scene = SimpleNamespace(mesh_nodes=nodes, get_pose=lambda node: pose(0, 0, 2))
    loaded = load_scene(scene)
    assert isinstance(loaded, Scene) and {b.name for b in loaded.bodies} == {"a", "b", "c", "mesh"}
    np.testing.assert_array_equal(loaded.bodies[0].mesh.triangles.reshape(-1, 3), corners)
    assert loaded.bodies[0].normals is None


class SimpleNamespaceNode(SimpleNamespace):
    """A namespace that sets can hold, as pyrender's nodes are held."""

    __hash__ = object.__hash__


# ---- imports -----------------------------------------------------------------------------------------


def test_importing_the_loader_imports_no_slow_package():
    code = (
        "import sys; import sonar_gl.scene.load; "
        "print([m for m in ('trimesh', 'cv2', 'pyrender', 'OpenGL', 'scipy') if m in sys.modules])"
    )
    out = python("-c", code, check=True)
    assert out.stdout.strip() == "[]"


# ---- lazy meshes -------------------------------------------------------------------------------------


def test_bodies_of_files_make_a_trimesh_when_mesh_is_first_read():
    body = load_scene("pylon").bodies[0]
    vertices, faces = body.surface
    assert not isinstance(body.surface, trimesh.Trimesh)
    mesh = body.mesh
    assert isinstance(mesh, trimesh.Trimesh) and body.mesh is mesh is body.surface
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    again = replace(body, reflectivity=0.1)
    assert again.mesh is mesh and again.reflectivity == 0.1
    mesh.apply_translation((1, 0, 0))  # takes effect, since surface is the same object
    np.testing.assert_array_equal(body.surface.vertices, vertices + np.array([1.0, 0.0, 0.0]))


@pytest.mark.slow
def test_a_command_loads_neither_trimesh_nor_scipys_algebra(tmp_path):
    """They would add half a second and 60 MB to `sonar-gl render pylon`."""
    code = f"""
import sys
from sonar_gl.cli.main import main
words = "render pylon --sonar p900-45 --range 20 --labels --axes --out".split()
main([*words, {str(tmp_path)!r}], standalone_mode=False)
print(*[name for name in ("trimesh", "scipy.linalg", "PIL") if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (tmp_path / "pylon.png").is_file() and done.stderr.split() == []


def test_bodies_are_left_out_by_name():
    wall, near, far = (
        sg.Body(name, trimesh.creation.box((1, 1, 1))) for name in ("wall", "boat_1", "boat_2")
    )
    plume = sg.Bubbles("bubbles", pose())
    scene = Scene([wall, near, far, plume], pose(x=1), "harbour", 3.0, 0.01)

    def names(one):
        np.testing.assert_array_equal(one.sonar_pose, pose(x=1))
        assert (one.name, one.surface_z_m, one.surface_roughness_m) == ("harbour", 3.0, 0.01)
        return [thing.name for thing in one.bodies_and_plumes]

    assert names(scene.without("boat*")) == ["wall", "bubbles"]
    assert names(scene.without("wall", "bubbles", "boat_?")) == []
    assert names(scene.without()) == names(scene)
    assert names(scene.only("boat_2", "b*s")) == ["boat_2", "bubbles"]
    other = scene.with_bodies(iter([far]))
    assert other.bodies == (far,) and other.plumes == (plume,) and other.surface_z_m == 3.0
    with pytest.raises(Error, match=r"as in scene.with_bodies\(\[body\]\)"):
        scene.with_bodies(far)
    with pytest.raises(Error, match=r"each of the bodies must be a Body .*; the plumes of the scene stay"):
        scene.with_bodies([far, plume])
    assert scene.with_surface(-1.0).surface_z_m == -1.0 and scene.with_surface(None).surface_z_m is None
    for leave in (scene.without, scene.only):
        assert error_of(leave, "boat_1", "bat_1") == (
            "names must be those of bodies of the scene (got 'bat_1'; did you mean 'boat_1' or 'boat_2'?)"
        )
        with pytest.raises(Error, match="a name of bodies must be a str"):
            leave(1)
    with pytest.raises(Error, match="surface_z_m of a scene"):
        scene.with_surface(float("nan"))


def test_an_unknown_name_of_many_is_told_with_a_few_known_ones():
    box = trimesh.creation.box((1, 1, 1))
    scene = Scene([sg.Body(f"pile_{k:04d}", box) for k in range(1000)])
    with pytest.raises(Error, match=r"'wreck'; known are pile_0000, .*pile_0009 and 990 more"):
        scene.without("wreck")


DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset><unit meter="1"/></asset>
<library_images><image id="i"><init_from>no.png</init_from></image></library_images>
<library_effects><effect id="e"><profile_COMMON>
<newparam sid="s"><surface type="2D"><init_from>i</init_from></surface></newparam>
<newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam>
<technique sid="c"><phong><emission><texture texture="t" texcoord="UV"/></emission></phong></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="9">0 0 0 1 0 0 0 1 0</float_array>
<technique_common><accessor source="#a" count="3" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1" material="mm"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="mm" target="#m"/></technique_common></bind_material></instance_geometry></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#w"/></scene></COLLADA>"""


def test_textures_that_are_missing_give_no_log(tmp_path, caplog):
    """trimesh logs a traceback of each, though it is told to skip materials."""
    (tmp_path / "a.dae").write_text(DAE)
    trimesh.load(tmp_path / "a.dae", skip_materials=True)
    assert "Traceback" in caplog.text
    caplog.clear()
    (body,) = load_scene(tmp_path / "a.dae").bodies
    assert len(body.surface.faces) == 1 and caplog.text == ""


def test_arrays_of_copies_are_read_only_as_those_of_scenes_are():
    """A simulator would not notice what is written into them."""
    box, plume = trimesh.creation.box((1, 1, 1)), sg.Bubbles("plume")
    scene = Scene(
        [sg.Body("wall", box, reflectivity=np.full(12, 0.5)), plume], pose(), models={"wall": pose(x=1)}
    )
    for again in (scene, copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        (body,), (bubbles,) = again.bodies, again.plumes
        for array in (body.pose, body.reflectivity, bubbles.pose, again.sonar_pose, again.models["wall"]):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0


@pytest.mark.parametrize("name", ["surface_z_m", "sonar_pose", "bodies", "plumes", "models", "bodys"])
def test_a_scene_is_not_changed(name):
    """Values that are set later would pass without the checks of the constructor, and simulators would not notice."""
    scene = Scene([sg.Body("wall", trimesh.creation.box((1, 1, 1)))], pose(x=1), surface_z_m=0.0)
    before = dict(vars(scene))
    with pytest.raises(
        Error, match=rf"a Scene must not be changed \(got a new value of '{name}'; with_bodies, "
    ):
        setattr(scene, name, None)
    assert vars(scene) == before
    for again in (copy.copy(scene), copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        assert (again.name, again.surface_z_m, again.bodies[0].name) == ("scene", 0.0, "wall")


@pytest.mark.parametrize("skip", ["no", 1, None, np.array([True])])
def test_whether_to_skip_what_is_missing_is_true_or_false(skip):
    """A text such as "no" would be taken for True."""
    assert (
        error_of(load_scene, "pylon", skip_missing=skip)
        == f"skip_missing must be True or False (got {skip!r})"
    )
