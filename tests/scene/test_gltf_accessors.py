"""Geometry of glTF files that trimesh reads wrongly, or names at random."""

import base64
import json
import warnings

import numpy as np
import pytest

from sonar_gl.scene import gltf_accessors, mesh_files
from sonar_gl.scene.load import load_scene
from tests.support.errors import error_of

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
PLAIN = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
TRIANGLE = {"attributes": {"POSITION": 0}}
DRACO = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
SPARSE = {"count": 1, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 0}}


@pytest.fixture
def write(tmp_path):
    """Return the path of a glTF with this accessor, these primitives of its mesh, and other things at its top."""

    def gltf(accessor=PLAIN, primitives=(TRIANGLE,), **others):
        data = base64.b64encode(CORNERS.tobytes()).decode()
        header = {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": 48, "uri": f"data:application/octet-stream;base64,{data}"}],
            "bufferViews": [{"buffer": 0, "byteLength": 48}],
            "accessors": [accessor],
            "meshes": [{"name": "hull", "primitives": list(primitives)}],
            "nodes": [{"mesh": 0, "name": "ship"}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        }
        path = tmp_path / "a.gltf"
        path.write_text(json.dumps(header | others))
        return path

    return gltf


def test_parts_of_a_node_have_the_same_names_whenever_they_are_read(write):
    """trimesh names each by six random letters."""
    nodes = [
        {"name": "fleet", "children": [1, 2, 3]},
        {"mesh": 0, "name": "ship"},
        {"mesh": 0, "name": "tug"},
        {"mesh": 1, "name": "ship_1"},
    ]
    meshes = [{"name": "hull", "primitives": [TRIANGLE] * 3}, {"name": "mast", "primitives": [TRIANGLE]}]
    path = write(nodes=nodes, meshes=meshes)
    names = [body.name for body in load_scene(path).bodies]
    assert sorted(names) == ["ship", "ship_1", "ship_2", "ship_3", "tug", "tug_1", "tug_2"]
    assert [body.name for body in load_scene(path).bodies] == names
    mesh, _ = mesh_files.read_mesh(path, "tug")
    assert len(mesh.faces) == 3  # of all its parts


@pytest.mark.parametrize(
    "accessor, primitive, others, got",
    [
        (PLAIN | {"sparse": SPARSE}, TRIANGLE, {}, "a sparse accessor"),
        (PLAIN | {"componentType": 5122, "normalized": True}, TRIANGLE, {}, "normalized integers"),
        ({"componentType": 5126, "count": 3, "type": "VEC3"}, TRIANGLE, {}, "none"),
        (
            {"componentType": 5126, "count": 3, "type": "VEC3"},
            TRIANGLE | {"extensions": DRACO},
            {},
            "compression by Draco, which the package DracoPy would read",
        ),
        (
            PLAIN,
            TRIANGLE,
            {"bufferViews": [{"buffer": 0, "byteLength": 48, "extensions": {"EXT_meshopt_compression": {}}}]},
            "compression by meshopt",
        ),
    ],
)
def test_positions_that_would_be_read_wrongly_are_refused(
    write, monkeypatch, accessor, primitive, others, got
):
    monkeypatch.setattr(gltf_accessors, "find_spec", lambda name: None)
    path = write(accessor, [primitive], **others)
    assert error_of(load_scene, path) == (
        f"{path}: the positions of mesh 'hull' must be plain numbers (got {got}; import the file into Blender, and "
        "export it without compression)"
    )


def test_a_view_beyond_its_buffer_is_refused_without_an_empty_text(write):
    """trimesh asserts it, and gives no text."""
    path = write(bufferViews=[{"buffer": 0, "byteLength": 64}])
    assert error_of(load_scene, path) == f"{path}: trimesh cannot read this mesh (AssertionError)"


def test_draco_with_its_library_or_with_plain_positions_beside_it(write, monkeypatch):
    compressed = TRIANGLE | {"extensions": DRACO}
    monkeypatch.setattr(gltf_accessors, "find_spec", lambda name: None)
    gltf_accessors.check_geometry(write(PLAIN, [compressed]))
    monkeypatch.setattr(gltf_accessors, "find_spec", lambda name: name)
    gltf_accessors.check_geometry(write({"componentType": 5126, "count": 3, "type": "VEC3"}, [compressed]))


@pytest.mark.parametrize(
    "others, left_out",
    [
        ({"primitives": [TRIANGLE, TRIANGLE | {"mode": 6}]}, "triangle fans (hull)"),
        (
            {"nodes": [{"mesh": 0, "name": "ship", "skin": 0}], "skins": [{"joints": [0]}]},
            "the pose of bones (ship)",
        ),
        ({"nodes": [{"mesh": 0, "name": "ship", "weights": [0.5]}]}, "morph targets (ship)"),
        ({"meshes": [{"weights": [1.0], "primitives": [TRIANGLE]}]}, "morph targets (ship)"),
        (
            {"nodes": [{"mesh": 0, "name": "ship", "extensions": {"EXT_mesh_gpu_instancing": {}}}]},
            "copies by EXT_mesh_gpu_instancing (ship)",
        ),
    ],
)
def test_what_is_left_out_is_told(write, others, left_out):
    path = write(**others)
    with pytest.warns(UserWarning) as caught:
        load_scene(path)
    first, _ = [str(one.message) for one in caught]  # the other one is of its reflectivity
    assert first.startswith(f"{path}: read without {left_out}")


def test_morph_targets_at_rest_are_no_loss(write):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*: a mesh file states no reflectivity")
        load_scene(write(meshes=[{"weights": [0.0], "primitives": [TRIANGLE]}]))
