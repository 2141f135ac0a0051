"""Shading normals that round the edges of flat faces."""

import warnings

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.scene import shading_normals
from sonar_gl.scene.pyrender_scene import import_pyrender
from sonar_gl.scene.shading_normals import rounded_text, turned_share


@pytest.mark.parametrize(
    ("mesh", "share"),
    [
        (trimesh.creation.box((40, 40, 0.1)), 1.0),
        (
            trimesh.creation.cylinder(0.15, 6.0, sections=24),
            1.0,
        ),  # its ends share their normals with its side
        (trimesh.creation.icosphere(1, 0.5), 0.0),
        (trimesh.creation.torus(0.5, 0.15, major_sections=16, minor_sections=8), 0.0),
    ],
)
def test_normals_of_edges_lie_off_the_faces(mesh, share):
    assert turned_share(sg.Body("part", mesh, normals=mesh.vertex_normals)) == share
    turned = mesh.copy()
    turned.invert()
    assert turned_share(sg.Body("part", turned, normals=mesh.vertex_normals)) == share
    assert turned_share(sg.Body("part", mesh)) == 0.0
    assert turned_share(sg.Body("part", mesh, normals=0.5 * mesh.vertex_normals)) == share  # of any length


def two_triangles(name: str, share: float, normals) -> sg.Body:
    """Return a body of two level triangles; normals : (3, 3) of the first, which has this share of the area."""
    second = [0, 0, 1], [1 - share, 0, 1], [0, 1, 1]
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [share, 0, 0], [0, 1, 0], *second], [[0, 1, 2], [3, 4, 5]], process=False
    )
    return sg.Body(name, mesh, normals=np.vstack([normals, np.tile([0.0, 0, 1], (3, 1))]))


UP, NONE = [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]


def tilted(degrees: float) -> list[float]:
    """Return a normal so many degrees off the vertical."""
    return [np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))]


@pytest.mark.parametrize(
    ("normals", "is_turned"),
    [
        ([UP, UP, tilted(41)], True),
        ([UP, tilted(39), tilted(-39)], False),
        ([NONE, tilted(41), tilted(41)], False),  # a face of which one corner has no normal is shaded as flat
        ([UP, UP, tilted(180 - 41)], True),
    ],
)
def test_a_face_counts_by_its_area_where_one_of_its_normals_lies_off(normals, is_turned):
    assert turned_share(two_triangles("part", 0.2, normals)) == pytest.approx(0.2 * is_turned)


def test_bodies_are_named_most_of_whose_area_has_such_normals():
    bodies = [two_triangles(f"part {share:g}", share, [UP, UP, tilted(60)]) for share in (0.49, 0.51)]
    assert rounded_text(bodies[:1]) == ""
    assert rounded_text(bodies).startswith("shading normals of part 0.51 lie more than 40 degrees off")


def test_a_scene_of_rounded_boxes_is_warned_of(tmp_path):
    floor, ball = trimesh.creation.box((30, 30, 0.1)), trimesh.creation.icosphere(3, 0.5)
    pyrender = import_pyrender()
    shown = pyrender.Scene()
    shown.add(pyrender.Mesh.from_trimesh(floor), name="floor", pose=sg.pose(z=-3))  # smooth by default
    shown.add(pyrender.Mesh.from_trimesh(ball), name="ball", pose=sg.pose(6, z=-2))
    with pytest.warns(UserWarning, match="^shading normals of floor lie more than 40 degrees off") as found:
        sg.load_scene(shown)
    assert len(found) == 1
    assert floor.vertex_normals.shape == (8, 3)  # reading them has trimesh write them
    path = tmp_path / "bay.glb"
    trimesh.Scene({"floor": floor}).export(path)
    with pytest.warns(UserWarning, match=f"^{path}: shading normals of bay lie"):
        sg.load_scene(path)


def test_flat_and_smooth_bodies_are_not_warned_of():
    pyrender = import_pyrender()
    shown = pyrender.Scene()
    shown.add(pyrender.Mesh.from_trimesh(trimesh.creation.box((30, 30, 0.1)), smooth=False))
    shown.add(pyrender.Mesh.from_trimesh(trimesh.creation.icosphere(3, 0.5)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sg.load_scene(shown)
        for name in ("pylon", "harbour", "diver", "diver_swimming", "ocean_floor"):
            sg.load_scene(name)


def test_rounded_edges_change_the_echo_of_a_floor():
    """Why it is warned of: half of a floor that is seen from above its middle faces away by such normals."""
    floor, sonar = trimesh.creation.box((30, 30, 0.1)), sg.load_sonar("p900-45").with_range(12.0)
    sums = []
    for normals in (None, floor.vertex_normals):
        body = sg.Body("floor", floor, sg.pose(z=-3), reflectivity=0.5, normals=normals)
        with sg.Simulator(sg.Scene([body]), sonar, sg.Acoustics.ideal()) as simulator:
            sums.append(float(np.sum(simulator.ping(sg.pose(pitch=0.3)).intensity)))
    assert sums[1] < 0.1 * sums[0]


def test_bodies_of_one_mesh_share_what_is_found_of_it(monkeypatch):
    """Of a scene of 40 balls of 20 480 faces each, it was all but a twentieth of the time of loading."""
    seen = []

    def count(body):
        seen.append(body.name)
        return turned_share(body)

    monkeypatch.setattr(shading_normals, "turned_share", count)
    box = trimesh.creation.box((4, 2, 1))
    normals = np.array(box.vertex_normals, np.float32)
    normals.setflags(write=False)
    bodies = [sg.Body(f"rounded {k}", box, sg.pose(k), normals=normals) for k in range(3)]
    text = rounded_text([*bodies, sg.Body("flat", box)])
    assert seen == ["rounded 0", "flat"]
    assert text.startswith("shading normals of rounded 0, rounded 1, rounded 2 lie")
