"""PLY files whose faces have different numbers of corners, or lists beside them."""

import struct

import numpy as np
import pytest

from sonar_gl.scene.mesh_files import read_mesh
from sonar_gl.scene.ply_faces import tidy_ply

POINTS = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 3, 0], [0, 2, 0.0]])
HEADER = "ply\nformat binary_{}_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
QUAD, TRIANGLE, PENTAGON = (0, 1, 2, 4), (2, 3, 4), (0, 1, 2, 3, 4)


def ply_of(
    faces, order="little", before=b"", after=b"", properties="{}property list uchar int vertex_indices\n"
):
    """Return a file of faces with a byte `before` or `after` the corners of each."""
    properties = properties.format("property uchar flag\n" if before else "")
    properties += "property uchar flag\n" if after else ""
    header = f"{HEADER.format(order)}element face {len(faces)}\n{properties}end_header\n"
    mark = "<" if order == "little" else ">"
    rows = [struct.pack(f"{mark}B{len(face)}i", len(face), *face) for face in faces]
    points = POINTS.astype(f"{mark}f4").tobytes()
    return header.encode() + points + b"".join(before + row + after for row in rows)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("flags", [{}, {"before": b"7"}, {"after": b"7"}])
# the sizes of the last one add up to those of three quadrilaterals
@pytest.mark.parametrize("faces", [[TRIANGLE, QUAD], [QUAD, TRIANGLE], [QUAD, TRIANGLE, PENTAGON]])
def test_each_polygon_is_a_fan(tmp_path, order, flags, faces):
    path = tmp_path / "a.ply"
    path.write_bytes(ply_of(faces, order, **flags))
    mesh = read_mesh(path).mesh
    triangles = [(face[0], *face[k : k + 2]) for face in faces for k in range(1, len(face) - 1)]
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], POINTS[np.array(triangles)])


def test_other_lists_of_faces_may_differ_in_length(tmp_path):
    """As texture coordinates, which some faces have; they were refused."""
    faces = [(0, 1, 2), (0, 2, 4), TRIANGLE]
    lists = "property list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    header = f"{HEADER.format('little')}element face 3\n{lists}end_header\n"
    rows = [
        struct.pack("<B3iB", 3, *face, n) + bytes(4 * n) for face, n in zip(faces, (6, 0, 6), strict=True)
    ]
    path = tmp_path / "a.ply"
    path.write_bytes(header.encode() + POINTS.astype("<f4").tobytes() + b"".join(rows))
    mesh = read_mesh(path).mesh
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], POINTS[np.array(faces)])


@pytest.mark.parametrize(
    "data",
    [
        ply_of([QUAD, QUAD]),
        ply_of([TRIANGLE, TRIANGLE], before=b"7"),
        ply_of([QUAD, TRIANGLE])[:-5],
        ply_of([QUAD, TRIANGLE], properties="property uchar flag\n").replace(b"face 2", b"face 99999999999"),
        ply_of([QUAD, TRIANGLE]).replace(b"face 2", b"face 99999999999"),
        ply_of([QUAD], properties="property list char uchar vertex_indices\n").replace(b"\x04\0", b"\xff\0"),
        ply_of([QUAD, TRIANGLE], properties="property list uchar uint vertex_indices\n")[:-1] + b"\xff",
        ply_of([QUAD, TRIANGLE], properties="property list uchar float vertex_indices\n"),
        b"ply\nformat binary_little_endian 1.0\nend_header\n",
        b"",
    ],
    ids=[
        "quads",
        "triangles",
        "short",
        "no corners",
        "many",
        "negative",
        "no vertex",
        "floats",
        "no faces",
        "empty",
    ],
)
def test_other_files_and_broken_ones_stay_as_they_are(data):
    assert tidy_ply(data) == data


@pytest.mark.parametrize("flag", ["", "property uchar flag\n"])
@pytest.mark.parametrize("faces", [[QUAD], [TRIANGLE, QUAD], [QUAD, TRIANGLE]])
def test_faces_of_text_may_have_a_second_list(tmp_path, faces, flag):
    """Such as texture coordinates, which are no part of a shape."""
    header = HEADER.replace("binary_{}_endian", "ascii") + f"element face {len(faces)}\n{flag}"
    header += "property list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    rows = [(*([7] if flag else []), len(f), *f, 2 * len(f), *[0.5] * 2 * len(f)) for f in faces]
    path = tmp_path / "a.ply"
    path.write_text(header + "".join(" ".join(map(str, row)) + "\n" for row in [*POINTS, *rows]))
    mesh = read_mesh(path).mesh
    triangles = {frozenset((face[0], *face[k : k + 2])) for face in faces for k in range(1, len(face) - 1)}
    assert {frozenset(face) for face in mesh.faces.tolist()} == triangles
    np.testing.assert_array_equal(mesh.vertices, POINTS)
