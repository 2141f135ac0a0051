"""Models where the state that Gazebo Classic has saved says."""

import numpy as np

from sonar_gl.core.poses import pose
from sonar_gl.scene.sdf.reader import read_sdf
from tests.support.errors import error_of
from tests.support.sdf_texts import RETRO, ROUNDING, link, model, read_warned, shape, write

STATE = """<state world_name='w'><model name='gone'><pose>9 9 9 0 0 0</pose></model>
<model name='gate'><pose frame=''>1 2 3 0 0 1.5707963267948966</pose><scale>10 1 1.0</scale>
<link name='a'><pose>1 2 3 0 0 1.5707963267948966</pose><velocity>0 0 0 0 0 0</velocity></link>
<link name='b'><pose>1 7 3 0 0 0</pose></link>
<model name='inner'><pose>4 4 4 0 0 0</pose><link name='c'><pose>4 4 5 0 0 0</pose></link></model>
</model>
<model name='flat'><pose>5 0 0 0 0 0</pose><link name='part::d'><pose>5 0 2 0 0 0</pose></link></model>
<model name='rock'><pose>0.001 0 0 0 0 0</pose><scale>1 1 1</scale></model></state>"""


def test_models_stand_where_the_state_of_gazebo_classic_says(tmp_path):
    """It moves them there when it opens the world; a deleted model is still in the state."""
    inner = model(link(name="c", shape=shape(RETRO)), name="inner")
    parts = link(name="a", shape=shape(RETRO)) + link(name="b", shape=shape(RETRO))
    flat = model(model(link(name="d", shape=shape(RETRO)), name="part"), name="flat")
    rock = model(link(shape=shape(RETRO)), name="rock")
    scene, texts = read_warned(tmp_path, model(parts + inner, name="gate") + flat + rock + STATE)
    assert texts == [
        "models stand where <state> says, as in Gazebo Classic (gate, flat); <scale> of <state> is left out "
        "(gate)"
    ]
    middles = {body.name: (body.pose @ [*body.surface.vertices.mean(axis=0), 1])[:3] for body in scene.bodies}
    expected = {
        "gate::a": [1, 2, 3],
        "gate::b": [1, 7, 3],
        "gate::inner": [4, 4, 5],
        "flat::part": [5, 0, 2],
        "rock": [0.001, 0, 0],
    }
    assert list(middles) == list(expected)
    np.testing.assert_allclose(list(middles.values()), list(expected.values()), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(scene.models["gate"], pose(1, 2, 3, yaw=np.pi / 2), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(scene.models["gate::inner"][:3, 3], 4, rtol=0, atol=ROUNDING)


def test_a_state_without_poses_or_with_bad_ones(tmp_path, read_text):
    shaped = model(link(shape=shape(RETRO)), name="m")
    (body,) = read_text(
        shaped + "<state><model name='m'><link name='nobody'/></model><light name='m'/></state>"
    ).bodies
    assert np.array_equal(body.pose, np.eye(4))
    path = write(tmp_path / "a.world", shaped + "<state><model name='m'><pose>1 2</pose></model></state>")
    assert (
        error_of(read_sdf, path) == f"{path}: world/state/model[m]/pose: must be 6 finite numbers (got '1 2')"
    )
