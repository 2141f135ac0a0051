"""The state of a scene in one ping: what bodies reflect at most."""

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.scene.state import GreatestReflectivity, SceneState

BOX = trimesh.creation.box((1, 1, 1))


def test_the_reflectivity_of_a_ping_replaces_that_of_a_body_and_multiplies_that_of_faces():
    plain, patchy = (
        sg.Body("plain", BOX, reflectivity=0.75),
        sg.Body("patchy", BOX, reflectivity=np.linspace(0.1, 0.5, 12)),
    )
    greatest = GreatestReflectivity.of([plain, patchy])
    state = SceneState(np.tile(np.eye(4), (2, 1, 1)), np.ones(2, bool))
    assert greatest.in_state(state).tolist() == [0.75, 0.5]
    assert greatest.in_state(state.with_reflectivity([0.25, 0.25])).tolist() == [0.25, 0.125]
    assert greatest.in_state(state.without_diffuse_echo()).tolist() == [0.0, 0.0]
