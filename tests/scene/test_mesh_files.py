"""Mesh files of which a part would be left out, or that are refused though they could be read."""

import numpy as np
import pytest
import trimesh

from tests.support.loaded_scenes import error_message, load

VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY_STRIP = """ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z
element tristrips 1\nproperty list int int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n4 0 1 2 3\n"""


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("a.ply", PLY_STRIP, "must be polygons of an element 'face' (got strips of triangles, tristrips; "),
        ("a.obj", VERTICES.upper() + "F 1 2 3\n", "begin with 'f' (got 'F 1 2 3'; "),
        ("a.obj", VERTICES + "f 1 2 3\n  fo 1 2 3\n", "begin with 'f' (got 'fo 1 2 3'; "),
    ],
)
def test_faces_that_would_be_left_out_are_refused(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    assert (found := error_message(path)).startswith(f"{path}: faces of ") and message in found


@pytest.mark.parametrize("more", [b"a colour map", bytes(50)], ids=["text", "facet"])
@pytest.mark.parametrize("head", [b"made by a program", b"solid made by a program"], ids=["plain", "solid"])
def test_what_follows_the_triangles_of_a_binary_stl_is_left_out(tmp_path, head, more):
    path = tmp_path / "a.stl"
    data = trimesh.creation.box((1, 2, 3)).export(file_type="stl")
    path.write_bytes(head.ljust(80, b"\0") + data[80:] + more)
    scene, (said, *_) = load(path)
    assert len(scene.bodies[0].surface.faces) == 12
    assert said == f"{path}: {len(more)} bytes after the 12 triangles that the file states are left out"


def test_a_byte_order_mark_takes_no_vertex(tmp_path):
    """Editors of Windows write one; a vertex may be the first line."""
    text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1 2 3\n"  # without the first, the fourth would be taken
    (tmp_path / "a.obj").write_bytes(b"\xef\xbb\xbf" + text)
    scene, _ = load(tmp_path / "a.obj")
    vertices = scene.bodies[0].surface.vertices
    assert np.ptp(vertices, axis=0).tolist() == [1, 1, 0]
