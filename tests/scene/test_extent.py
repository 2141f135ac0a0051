"""What bodies a place lies in, or below; how far bodies are above a floor."""

import warnings

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.scene import extent
from sonar_gl.scene.extent import air_text, bodies_beyond, body_around, bounds_of, gap_m, other_unit_text
from sonar_gl.scene.primitives import INFINITE_PLANE_M, plane
from tests.support.worlds import terrain

BALL = sg.Body("ball", trimesh.creation.icosphere(2, 1.0), sg.pose(5, 0, 0))


def around(bodies, place, poses=None, present=None, surface_z_m=None):
    """The name of the body about a place, in bodies where they are."""
    poses = [body.pose for body in bodies] if poses is None else poses
    present = [True] * len(bodies) if present is None else present
    of_bodies = bodies, np.asarray(poses), np.asarray(present)
    return body_around(*of_bodies, np.asarray(place, float), surface_z_m)


@pytest.mark.parametrize(
    ("place", "found"),
    [((5, 0, 0), "ball"), ((5.5, 0, 0.5), "ball"), ((5, 0, 1.5), ""), ((5, 0, -1.5), ""), ((0, 0, 0), "")],
)
def test_a_place_in_a_closed_body(place, found):
    """In its middle, where the line straight up meets a corner of the mesh; beside the middle; above; below; aside."""
    assert around([BALL], place) == found


def test_a_body_moved_and_a_body_absent():
    moved = [sg.pose(0, 0, 0, roll=1.0)]
    assert around([BALL], (0, 0, 0.3), moved) == "ball"
    assert around([BALL], (5, 0, 0.3), moved) == ""
    assert around([BALL], (0, 0, 0.3), moved, [False]) == ""


def test_a_place_between_a_body_and_its_upright_half_open_shell():
    """An open cup with normals outwards: its inside is water, and so is the place below it."""
    cup = trimesh.creation.box((2, 2, 2))
    cup.update_faces(cup.face_normals[:, 2] < 0.5)
    cup = sg.Body("cup", cup)
    assert not cup.mesh.is_watertight
    assert [around([cup], (0, 0, z)) for z in (2.0, 0.0, -2.0)] == ["", "", ""]


def test_a_place_below_a_floor():
    """Planes and terrains look up; a place beside a terrain is not below it."""
    flat = sg.Body("flat", plane().mesh.to_trimesh(), sg.pose(z=-3))
    assert [around([flat], (7, -4, z)) for z in (-2.9, -3.1)] == ["", "flat"]
    hills = sg.Body("hills", terrain(np.random.default_rng(1), 10.0, 1.0, 21), sg.pose(z=-8))
    low, high = hills.mesh.bounds[:, 2] - 8
    assert around([hills], (0.3, 0.2, low - 0.1)) == "hills"
    assert around([hills], (0.3, 0.2, high + 0.1)) == around([hills], (30, 0, low - 0.1)) == ""


def test_a_place_in_the_water_lies_in_no_body_that_is_in_its_surface_or_above():
    """A sheet that shows the surface looks up, as terrain does. What reaches into the water still counts."""
    sheet = sg.Body("sheet", terrain(np.random.default_rng(1), 40.0, 0.0, 2), sg.pose(z=-3))
    assert around([sheet], (0.3, 0.2, -5)) == around([sheet], (0.3, 0.2, -5), surface_z_m=0.0) == "sheet"
    assert around([sheet], (0.3, 0.2, -5), surface_z_m=-3.0) == ""
    assert around([sheet], (0.3, 0.2, -5), surface_z_m=-4.0) == ""
    assert around([sheet], (0.3, 0.2, -5), surface_z_m=-6.0) == "sheet"  # the sonar is in the air
    assert around([BALL], (5, 0, -0.5), surface_z_m=-0.2) == "ball"
    assert around([BALL, sheet], (5, 0, -0.5), [BALL.pose, sg.pose()], surface_z_m=0.0) == "ball"


def test_the_first_of_several_bodies_is_named():
    other = sg.Body("other", trimesh.creation.box((4, 4, 4)), sg.pose(5, 0, 0))
    assert around([BALL, other], (5, 0, 0)) == "ball" and around([BALL, other], (5, 0, 1.5)) == "other"


def test_far_from_the_origin_as_in_utm():
    utm = sg.pose(500_000, 5_600_000, 0)
    assert around([BALL], utm[:3, 3] + [0, 0, 0.9], [utm]) == "ball"
    assert around([BALL], utm[:3, 3] + [0, 0, 1.1], [utm]) == ""


@pytest.mark.parametrize(
    ("size_m", "is_warned"),
    [((500, 100, 100), True), ((499, 200, 200), False), ((3000, 3000, 99), False), ((3000, 99, 3000), False)],
)
def test_a_scene_that_is_long_and_high_may_be_in_millimetres(size_m, is_warned):
    text = other_unit_text(sg.Scene([sg.Body("block", trimesh.creation.box(size_m))]))
    assert ("if it was made in centimetres or millimetres" in text) == is_warned


def test_only_the_plane_of_a_collision_has_no_bounds():
    """A visual's plane of the same length may be narrower."""
    endless, long = sg.Body("endless", plane()[0]), sg.Body("long", plane(size=(INFINITE_PLANE_M, 3000.0))[0])
    np.testing.assert_array_equal(bounds_of([endless, long]), [[-11e3, -1500, 0], [11e3, 1500, 0]])


def test_a_sonar_at_the_surface_is_in_the_water():
    scene = sg.Scene([BALL], surface_z_m=-2.0)
    assert [bool(air_text(scene, sg.pose(z=z))) for z in (-2.001, -2.0, -1.999)] == [False, False, True]


PYRAMID = sg.Body(  # 1 - max(|x|, |y|) high
    "pyramid",
    trimesh.Trimesh(
        [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 1]],
        [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
    ),
)
CRATE = sg.Body("crate", trimesh.creation.box((0.4, 0.4, 0.4)))


@pytest.mark.parametrize("origin", [(0, 0, 0), (500_000, 5_600_000, 0)])
def test_a_turned_box_is_as_far_above_a_plane_as_its_lowest_corner(origin):
    box, flat = (
        sg.Body("box", trimesh.creation.box((0.6, 0.4, 0.3))),
        sg.Body("flat", plane().mesh.to_trimesh()),
    )
    at = np.eye(4)
    at[:3, 3] = origin
    for roll, pitch in ((0, 0), (0.3, -0.8), (3.1, 1.2)):
        turned = sg.pose(0.2, -0.7, -2.5, roll, pitch, 2.0)
        lowest_m = -2.5 - np.abs(turned[2, :3]) @ [0.3, 0.2, 0.15]
        found = gap_m([(box, at @ turned)], flat, at @ sg.pose(z=-3))
        assert found == pytest.approx(lowest_m + 3, abs=1e-9)  # rounding of eastings and northings


@pytest.mark.parametrize(
    ("x", "y", "gap"),
    [
        (0, 0, 1.8),  # the peak touches the middle of the crate's face
        (0.5, 0, 2.1),  # its edge at x = 0.3 touches the slope
        (-0.4, 0.6, 2.2),
        (1.1, 0, 2.7),  # its middle lies beside the pyramid, which has no height there
        (1.3, 0, np.inf),
    ],
)
def test_a_box_touches_a_hill_by_its_edge_or_by_the_peak(x, y, gap):
    assert gap_m([(CRATE, sg.pose(x, y, 3))], PYRAMID, np.eye(4)) == pytest.approx(gap, abs=1e-12)
    far = (CRATE, sg.pose(0, 0, 9))
    assert gap_m([far, (CRATE, sg.pose(x, y, 3))], PYRAMID, np.eye(4)) == pytest.approx(min(gap, 7.8))


def test_bodies_touch_alike_whatever_is_compared_at_once(monkeypatch):
    """A floor of more triangles than that is compared with one corner at a time."""
    placed = [(CRATE, sg.pose(0.5, 0, 3, 0.3, 0.2))]
    expected = gap_m(placed, PYRAMID, np.eye(4))
    for pairs in (1, 5, 9):
        monkeypatch.setattr(extent, "PAIRS", pairs)
        assert gap_m(placed, PYRAMID, np.eye(4)) == expected


def test_a_box_on_one_with_the_same_sides_touches_its_top():
    """Its lower corners lie on the upright faces of the other, which have no area from above."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert gap_m([(CRATE, sg.pose(z=3))], CRATE, np.eye(4)) == pytest.approx(2.6, abs=1e-12)


def test_vertices_of_no_face_do_not_touch_a_floor():
    corners = [[-1, -1, 0], [1, -1, 0], [0, 1, 0], [0, 0, -1]]
    sheet = sg.Body("sheet", trimesh.Trimesh(corners, [[0, 1, 2]], process=False))
    assert len(sheet.surface.vertices) == 4
    assert gap_m([(sheet, sg.pose(z=3))], CRATE, np.eye(4)) == pytest.approx(2.8, abs=1e-12)


def test_bodies_beyond_a_range():
    """By their nearest point, as far as boxes with sides along the axes tell, from the nearest of several places."""
    wall = sg.Body("wall", trimesh.creation.box((2.0, 40.0, 2.0)), sg.pose(12, 0, 0))
    assert bodies_beyond([BALL, wall], np.array([[0.0, 0, 0]]), 3.9) == ["ball", "wall"]
    assert bodies_beyond([BALL, wall], np.array([[0.0, 0, 0]]), 4.1) == ["wall"]
    assert bodies_beyond([BALL, wall], np.array([[0.0, 15, 0], [0, 19, 0]]), 11.1) == ["ball"]
    assert bodies_beyond([BALL, wall], np.array([[0.0, 15, 0], [0, 0, 0]]), 11.1) == []
    assert bodies_beyond([BALL], np.array([[5.0, 0, 4]]), 2.9) == ["ball"]
    assert bodies_beyond([BALL], np.array([[5.0, 0, 4]]), 3.1) == []
