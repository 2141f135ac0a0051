"""glTF buffers: which files a mesh may name."""

import json
import os
import re
import struct
import threading

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.scene import mesh_files
from sonar_gl.scene.mesh_buffers import MAX_BUFFER_BYTES
from tests.support.errors import error_of

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
SCENE = """<sdf version='1.9'><model name='m'><link name='l'><collision name='c'><geometry><mesh>
<uri>{}</uri></mesh></geometry><laser_retro>255</laser_retro></collision></link></model></sdf>"""


def write_gltf(path, uri):
    """Write a glTF of one triangle, whose vertices are the first bytes of its buffer."""
    view = {"buffer": 0, "byteOffset": 0, "byteLength": TRIANGLE.nbytes}
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [view],
        "buffers": [{"uri": uri, "byteLength": TRIANGLE.nbytes}],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def with_accessors(path, *accessors, **view):
    """Change the accessors of a glTF file, and its one view; write it as .glb if that is its name."""
    content = json.loads(write_gltf(path.with_suffix(".gltf"), "a.bin").read_text())
    path.with_name("a.bin").write_bytes(TRIANGLE.tobytes())
    content["accessors"] = [{"componentType": 5126, "type": "VEC3", **one} for one in accessors]
    content["bufferViews"][0].update(view)
    text = json.dumps(content).encode()
    if path.suffix == ".glb":
        text += b" " * (-len(text) % 4)
        text = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text
    path.write_bytes(text)
    return path


@pytest.fixture
def secret(tmp_path):
    """A file outside of the mesh's folder that would be a valid buffer."""
    path = tmp_path / "out" / "secret.bin"
    path.parent.mkdir()
    path.write_bytes(TRIANGLE.tobytes())
    return path


def outside(tmp_path, secret, kind):
    """Return the URI by which a mesh in tmp_path/in leads to the secret."""
    folder = tmp_path / "in"
    folder.mkdir(exist_ok=True)
    if kind == "link":
        (folder / "link.bin").symlink_to(secret)
    if kind == "linked folder":
        (folder / "linked").symlink_to(secret.parent)
    return {
        "absolute": str(secret),
        "parent": "../out/secret.bin",
        "quoted": "%2e%2e/out/secret.bin",
        "link": "link.bin",
        "linked folder": "linked/secret.bin",
    }[kind]


@pytest.mark.parametrize("suffix", ["bin", "bytes of a mesh.bin"])
@pytest.mark.parametrize("quoted", [False, True])
def test_a_buffer_in_the_folder_is_read(tmp_path, suffix, quoted):
    name = f"a {suffix}"
    (tmp_path / "in" / "parts").mkdir(parents=True)
    (tmp_path / "in" / "parts" / name).write_bytes(TRIANGLE.tobytes())
    uri = f"parts/{name}".replace(" ", "%20") if quoted else f"parts/{name}"
    mesh, _ = mesh_files.read_mesh(write_gltf(tmp_path / "in" / "a.gltf", uri))
    np.testing.assert_array_equal(mesh.vertices, TRIANGLE)


@pytest.mark.parametrize("kind", ["absolute", "parent", "quoted", "link", "linked folder"])
def test_a_buffer_outside_of_the_folder_is_refused(tmp_path, secret, kind):
    uri = outside(tmp_path, secret, kind)
    path = write_gltf(tmp_path / "in" / "a.gltf", uri)
    assert error_of(sg.load_scene, path) == (
        f"{path}: the URI {uri!r} must name a file in the mesh's folder (it leads to {secret}; put it there)"
    )


@pytest.mark.parametrize("kind", ["absolute", "parent", "quoted", "link", "linked folder"])
def test_a_mesh_of_an_sdf_scene_reads_only_the_resource_paths(tmp_path, secret, kind):
    uri = outside(tmp_path, secret, kind)
    write_gltf(tmp_path / "in" / "a.gltf", uri)
    scene = tmp_path / "in" / "a.sdf"
    scene.write_text(SCENE.format("a.gltf"))
    with pytest.raises(Error, match=re.escape(f"the URI {uri!r} must name a file in the mesh's folder")):
        sg.load_scene(scene)
    (body,) = sg.load_scene(scene, resource_paths=[tmp_path / "out"]).bodies
    np.testing.assert_array_equal(body.surface.vertices, TRIANGLE)


def test_a_buffer_that_is_a_pipe_is_refused_at_once(tmp_path):
    path = write_gltf(tmp_path / "a.gltf", "pipe.bin")
    os.mkfifo(tmp_path / "pipe.bin")
    # whoever opens the pipe gets an end of file after some seconds, and fails
    ends = [os.open(tmp_path / "pipe.bin", os.O_RDWR | os.O_NONBLOCK)]
    timer = threading.Timer(3.0, lambda: os.close(ends.pop()))
    timer.start()
    with pytest.raises(Error) as caught:
        sg.load_scene(path)
    timer.cancel()
    timer.join()
    os.close(ends.pop())
    assert str(caught.value) == (
        f"{path}: the URI 'pipe.bin' must name a regular file (got a folder or device at {tmp_path}/pipe.bin)"
    )


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("none.bin", "the URI 'none.bin' must name a file (there is none at "),
        ("folder", "the URI 'folder' must name a regular file (got a folder or device at "),
        ("loop.bin", "the URI 'loop.bin' must name a file (got a loop of symbolic links)"),
        ("a\0b", r"the URI 'a\x00b' must name a file that can be read ("),
        ("x" * 5000, "' must name a file that can be read ("),
        ("large.bin", "the URI 'large.bin' must name a file of 1000 MB or less (got 1000 MB)"),
    ],
)
def test_other_buffers_that_cannot_be_read(tmp_path, uri, words):
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop.bin").symlink_to(tmp_path / "loop.bin")
    with open(tmp_path / "large.bin", "wb") as file:
        file.truncate(MAX_BUFFER_BYTES + 1)  # takes no room on the disk
    path = write_gltf(tmp_path / "a.gltf", uri)
    with pytest.raises(Error) as caught:
        sg.load_scene(path)
    assert str(caught.value).startswith(f"{path}: ") and words in str(caught.value)
    assert len(str(caught.value)) < 600


def test_materials_are_not_opened(tmp_path):
    """Materials of COLLADA would be read and decoded, and have no acoustic meaning."""
    os.mkfifo(tmp_path / "pipe")
    text = "mtllib pipe\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(text)
    assert len(sg.load_scene(tmp_path / "a.obj").bodies[0].surface.faces) == 1


# ---- sizes


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_accessors_that_state_more_than_there_is_are_refused_at_once(tmp_path, suffix):
    """A few bytes could state any number, which trimesh would make arrays of."""
    path = tmp_path / f"a{suffix}"
    for accessor, view in (
        ({"bufferView": 0, "count": 10**9}, {}),
        ({"bufferView": 0, "count": 4}, {}),
        ({"bufferView": 0, "count": 3, "byteOffset": 4}, {}),
        ({"bufferView": 0, "count": 3}, {"byteStride": 16}),
        ({"bufferView": 0, "count": 10**9}, {"byteStride": 1}),
        ({"bufferView": 0, "count": 10**400}, {}),
    ):
        message = error_of(sg.load_scene, with_accessors(path, accessor, **view))
        assert message.startswith(f"{path}: trimesh cannot read this mesh (")
    zeros = {"count": 3_000_000}
    assert error_of(sg.load_scene, with_accessors(path, zeros, zeros)) == (
        f"{path}: accessors without a bufferView must have at most 5000000 elements together (got 6000000; they "
        "are zeros)"
    )


def test_accessors_that_fit_are_read(tmp_path):
    fits = {"bufferView": 0, "count": 3}
    for accessors, view in (([fits], {}), ([fits, {"count": 3}], {}), ([fits], {"byteStride": 12})):
        (body,) = sg.load_scene(with_accessors(tmp_path / "a.gltf", *accessors, **view)).bodies
        assert body.mesh.area == 0.5


@pytest.mark.parametrize(
    "accessor",
    [
        {"bufferView": 0, "count": 1e9},
        {"bufferView": 0, "count": "3"},
        {"bufferView": 7, "count": 3},
        {"bufferView": "0", "count": 3},
        {"bufferView": 0, "count": 3, "type": ["VEC3"]},
        {"bufferView": 0, "count": 3, "componentType": [5126]},
        {"bufferView": 0, "count": 3, "byteOffset": "4"},
        {},
    ],
)
def test_other_mistakes_of_accessors_are_told_as_well(tmp_path, accessor):
    path = with_accessors(tmp_path / "a.gltf", accessor)
    with pytest.raises(Error, match=re.escape(f"{path}: trimesh cannot read this mesh (")):
        sg.load_scene(path)
