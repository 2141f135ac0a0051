"""Poses in SDF: numbers, and frames relative to other frames."""

import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.core.poses import pose
from sonar_gl.scene.sdf import frames
from tests.support.sdf_texts import BOX, RETRO, ROUNDING, SHAPE, link, model, read_warned


def test_chain_of_relative_frames_against_hand_computed_values(read_text):
    scene = read_text(
        model(
            "<pose>10 0 0 0 0 1.5707963267948966</pose>"
            "<link name='base'><pose>1 0 0 0 0 0</pose></link>"
            "<frame name='f' attached_to='base'><pose>0 2 0 0 0 0</pose></frame>"
            "<frame name='g'><pose relative_to='f'>0 0 3 1.5707963267948966 0 0</pose></frame>"
            "<link name='tip'><pose relative_to='g'>0 1 0 0 0 0</pose>"
            f"<collision name='c'><pose>0 0 5 0 0 0</pose>{BOX}{RETRO}</collision></link>"
        )
    )
    # in the model: base (1 0 0), f (1 2 0), g (1 2 3) rolled by 90 degrees, whose y is up: tip (1 2 4),
    # and the shape's centre, 5 along its z, (1 -3 4)
    # the model, turned by 90 degrees about z at (10 0 0), takes (x y z) to (10 - y, x, z)
    (body,) = scene.bodies
    expected = [[0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(body.pose, expected, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(body.mesh.bounds, [[0, -6, 2], [2, 0, 6]], rtol=0, atol=ROUNDING)
    assert body.name == "m" and body.reflectivity == 1.0 and body.normals is None


def test_shape_relative_to_a_frame_of_its_model(read_text):
    shape = f"<collision name='c'><pose relative_to='mark'>1 0 0 0 0 0</pose>{BOX}{RETRO}</collision>"
    scene = read_text(
        model(
            "<frame name='mark'><pose>0 0 9 0 0 3.141592653589793</pose></frame>"
            + link("<pose>5 0 0 0 0 0</pose>", shape=shape)
        )
    )
    # mark points backwards: the shape is at (-1 0 9) in the model, wherever its link is
    np.testing.assert_allclose(scene.bodies[0].mesh.bounds, [[-2, -2, 6], [0, 2, 12]], rtol=0, atol=ROUNDING)


def test_quaternion_degrees_and_old_frame_attribute(read_text):
    half = np.sqrt(0.5)
    scene = read_text(
        "<frame name='there'><pose>0 0 7 0 0 0</pose></frame>"
        + model(
            f"<pose rotation_format='quat_xyzw'>1 2 3 0 0 {2 * half} {2 * half}</pose>" + link(), "quaternion"
        )
        + model("<pose degrees='true'>1 2 3 0 0 450</pose>" + link(), "degrees")
        + model("<pose>1 2 3 0 0 1.5707963267948966</pose>" + link(), "radians")
        + model("<pose frame='there'>1 0 0 0 0 0</pose>" + link(), "old")
        + model("<pose frame=''/>" + link(), "empty")
    )
    turned = pose(1, 2, 3, yaw=np.pi / 2)
    for body in scene.bodies[:3]:
        np.testing.assert_allclose(body.pose, turned, rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(scene.bodies[3].pose, pose(1, 0, 7))
    np.testing.assert_array_equal(scene.bodies[4].pose, np.eye(4))


def test_nested_models_scoped_frames_joints_and_placement(read_text):
    inner = model("<pose>1 0 0 0 0 0</pose>" + link("<pose>0 1 0 0 0 0</pose>"), "inner")
    scene = read_text(
        model("<pose>0 0 5 0 0 0</pose>" + inner + link("<pose relative_to='inner::link'/>"), "outer")
        + model("<pose relative_to='outer::inner'>0 0 1 0 0 0</pose>" + link(), "beside")
        + model(
            "<joint name='j'><pose>0 0 2 0 0 0</pose><child>a</child></joint>"
            "<link name='a'><pose>0 0 1 0 0 0</pose></link>" + link("<pose relative_to='j'/>"),
            "jointed",
        )
        + "<model name='placed' placement_frame='foot'><pose>0 0 0 0 0 0</pose>"
        "<frame name='foot'><pose>0 0 -3 0 0 0</pose></frame>" + link() + "</model>"
    )
    assert {body.name: body.pose[:3, 3].tolist() for body in scene.bodies} == {
        "outer::inner": [1, 0, 5],
        "outer": [0, 0, 5],
        "beside": [1, 0, 6],
        "jointed": [0, 0, 0],
        "placed": [0, 0, 3],
    }
    boxes = {
        body.name: (body.pose @ [*body.mesh.bounds.mean(axis=0), 1])[:3].tolist() for body in scene.bodies
    }
    assert boxes == {
        "outer::inner": [1, 1, 5],
        "outer": [1, 1, 5],
        "beside": [1, 0, 6],
        "jointed": [0, 0, 3],
        "placed": [0, 0, 3],
    }


def test_poses_keep_float64_far_from_the_origin(read_text):
    scene = read_text(model("<pose>500000.000001 5000000.000001 0 0 0 0</pose>" + link()))
    np.testing.assert_array_equal(scene.bodies[0].pose[:2, 3], [500000.000001, 5000000.000001])


def test_large_angles_are_radians_and_warn_once(tmp_path):
    """As in Gazebo: any number is an angle, though these are nearly always degrees."""
    turned = SHAPE.replace("<geometry>", "<pose>0 0 0 45 0 0</pose><geometry>")
    world = model("<pose>1 0 0 0 0 -105</pose>" + link(), "a") + model(link(shape=turned), "b")
    world += model("<pose degrees='true'>0 0 0 0 0 720</pose>" + link(), "c")
    scene, (text,) = read_warned(tmp_path, world)
    a, b, _ = scene.bodies
    np.testing.assert_allclose(a.pose, pose(1, 0, 0, 0, 0, -105 + 34 * np.pi), rtol=0, atol=ROUNDING)
    corner = pose(0, 0, 0, 45 - 14 * np.pi) @ (1, 2, 3, 1)
    assert np.abs(b.mesh.vertices - corner[:3]).max(axis=1).min() < 1e-9
    assert text == (
        "2 poses have angles of more than 2.5π, read as radians, as by Gazebo; if they are degrees, write "
        '<pose degrees="true"> (world/model[a]/pose, world/model[b]/link[link]/collision[c]/pose)'
    )


def test_an_angle_a_little_over_a_turn(read_text):
    (body,) = read_text(model("<pose>0 0 0 0 0 6.597345</pose>" + link())).bodies
    np.testing.assert_allclose(body.pose, pose(yaw=6.597345 - 2 * np.pi), rtol=0, atol=ROUNDING)


def test_a_long_chain_of_frames_is_an_error():
    scope = frames.Scope("a.sdf: world", None, is_world=True)
    for i in range(5000):
        scope.add(f"f{i}", frames.Frame(None, f"a.sdf: world/frame[f{i}]", f"f{i + 1}"))
    with pytest.raises(Error, match=r"frames must lead to the model or world \(got f0 -> f1 "):
        scope.find("f0", "a.sdf: world")
