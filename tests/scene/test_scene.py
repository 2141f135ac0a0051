"""Scenes made from scenes, parts of models, and meshes that are refused."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg


def body(name, *numbers, **angles):
    return sg.Body(name, trimesh.creation.box((1, 1, 1)), sg.pose(*numbers, **angles))


def test_scenes_made_from_a_scene_keep_the_rest():
    scene = sg.Scene(
        [body("a")], sg.pose(1.0), "mine", 2.0, surface_roughness_m=0.3, models={"a": sg.pose(4.0, yaw=1.0)}
    )
    others = (
        scene.with_bodies([body("b")]),
        scene.with_more([body("b")]),
        scene.only("a"),
        scene.with_surface(2.0),
    )
    for other in others:
        assert (other.name, other.surface_z_m, other.surface_roughness_m) == ("mine", 2.0, 0.3)
        np.testing.assert_array_equal(other.sonar_pose, scene.sonar_pose)
        np.testing.assert_array_equal(other.models["a"], scene.models["a"])


def test_names_are_unique_also_of_bodies_that_are_added():
    with pytest.raises(sg.Error, match=r"names of bodies must be unique \(got 'a' more than once\)"):
        sg.Scene([body("a")]).with_more([body("a")])


def test_parts_of_a_model_lie_relative_to_it():
    home, inside = sg.pose(1, 2, 3, 0.1, 0.2, 0.3), sg.pose(4, 5, 6, yaw=-1.0)
    part = sg.Body("m::p", trimesh.creation.box((1, 1, 1)), home @ inside)
    parts = sg.Scene([part, body("other")], models={"m": home}).parts_of("m")
    assert list(parts) == ["m::p"]
    np.testing.assert_allclose(parts["m::p"], inside, rtol=0, atol=4e-15)  # rounding of metres


@pytest.mark.parametrize("wrong", [-1, 3])
def test_faces_name_vertices(wrong):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, wrong]], process=False, validate=False)
    with pytest.raises(sg.Error, match=rf"faces must name vertices 0\.\.2 \(got {wrong}\)"):
        sg.Body("a", mesh)


def test_a_read_only_pose_is_copied_and_read_only_normals_are_shared():
    """The owner may make either writeable again; only of large arrays a copy costs more than that is worth."""
    mesh = trimesh.creation.box((1, 1, 1))
    mine, normals = sg.pose(1, 2, 3), np.full((8, 3), 3**-0.5, np.float32)
    for one in (mine, normals):
        one.setflags(write=False)
    body = sg.Body("box", mesh, mine, normals=normals)
    for one in (mine, normals):
        one.setflags(write=True)
    mine[0, 3] = 9.0
    assert body.pose[0, 3] == 1.0 and body.normals is normals


@pytest.mark.parametrize(
    ("reflectivity", "got"),
    [
        (
            [[0.5], [0.5, 0.5]],
            "must have shape (12) (got a list of parts of 1 and 2 numbers; give one number, or ",
        ),
        (True, "must be a number, or an array of one for each face (got True)"),
        (np.True_, "must be a number, or an array of one for each face (got np.True_)"),
    ],
)
def test_a_reflectivity_that_is_no_number_is_refused(reflectivity, got):
    with pytest.raises(sg.Error) as caught:
        sg.Body("box", trimesh.creation.box(), reflectivity=reflectivity)
    assert str(caught.value).startswith(f"body 'box': reflectivity {got}")


@pytest.mark.parametrize("faces", [[[0, 1, 2], [0, 1]], [], [[0, 1, 2]]])
def test_faces_that_are_no_array_are_refused(faces):
    mesh = SimpleNamespace(vertices=np.eye(3), faces=faces)
    with pytest.raises(
        sg.Error, match=r"^body 'odd': mesh faces must be an array of whole numbers .* \(got list; "
    ):
        sg.Body("odd", mesh)


@pytest.mark.parametrize("bodies", ["pylon", [3], None, 7])
def test_other_contents_of_a_scene_are_refused(bodies):
    with pytest.raises(sg.Error, match="a body of a scene must be a"):
        sg.Scene(bodies)
