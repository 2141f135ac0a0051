"""The error of round bodies in open water, which two lattices show too little of."""

import numpy as np
import pytest
import trimesh

from sonar_gl.engine.body_extents import is_round


@pytest.mark.parametrize(
    "mesh, expected",
    [
        (trimesh.creation.icosphere(4, 0.2), True),
        (trimesh.creation.capsule(height=0.3, radius=0.2), True),
        (trimesh.creation.box((1.0, 1.0, 1.0)), False),
        (trimesh.creation.cylinder(0.1, 5.0, sections=64), False),
    ],
)
def test_bodies_that_are_curved_and_face_all_directions_are_round(mesh, expected):
    assert is_round(mesh) is expected


def test_a_wavy_floor_is_not_round():
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    points = np.stack([x, y, np.sin(x) * np.cos(y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(29)[:, None] * 30 + np.arange(29)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 31], corner[:, None] + [0, 31, 30]])
    assert not is_round(trimesh.Trimesh(points, faces, process=False))
