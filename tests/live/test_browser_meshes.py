"""Meshes for browsers."""

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.live.view.browser_meshes import browser_meshes


def test_a_small_scene_stays_as_it_is():
    scene = sg.load_scene("pylon")
    for mesh, body in zip(browser_meshes(scene), scene.bodies, strict=True):
        assert mesh.name == body.name and mesh.pose.tolist() == body.pose.tolist()
        np.testing.assert_allclose(mesh.vertices + mesh.middle, body.surface.vertices, rtol=0, atol=1e-6)
        assert mesh.faces.tolist() == np.asarray(body.surface.faces).tolist()


@pytest.mark.parametrize(
    "most", [200, *(pytest.param(one, marks=pytest.mark.slow) for one in (20_000, 2_000))]
)
def test_a_ball_keeps_its_shape(most):
    ball = trimesh.creation.icosphere(6, 2.0)  # 81 920 triangles
    box = trimesh.creation.box((1, 1, 1))
    scene = sg.Scene([sg.Body("ball", ball), sg.Body("box", box, sg.pose(5))])
    before = ball.vertices.copy()
    found = browser_meshes(scene, most)
    assert [len(mesh.faces) for mesh in found][1] == 12
    n_faces = len(found[0].faces)
    assert most / 4 < n_faces <= most - 12
    # In a cell of side c, the mean of points on a sphere lies within (c√3/2)² / 2r of it. A cell of a plane has two
    # triangles; here, where cells are cut and their sizes tried in steps, at least one on c².
    cell_squared = 4 * np.pi * 2.0**2 / (n_faces / 2)
    inside_m = 2.0 - np.linalg.norm(found[0].vertices + found[0].middle, axis=1)
    assert inside_m.min() > -1e-6  # of float32
    assert inside_m.max() < 3 / 4 * cell_squared / (2 * 2.0)
    assert scene.bodies[0].mesh.vertices.tolist() == before.tolist()


@pytest.mark.parametrize("most", [20_000, 200])
def test_a_mesh_in_utm_is_that_at_the_origin(most):
    """Its vertices were rounded to float32, to half a metre."""
    away = np.array([500_000.0, 4_500_000.0, -30.0])
    ball = trimesh.creation.icosphere(4, 2.0)
    there = ball.copy().apply_translation(away)
    (expected,), (found,) = (browser_meshes(sg.Scene([sg.Body("b", one)]), most) for one in (ball, there))
    np.testing.assert_allclose(found.middle, away, rtol=0, atol=1e-8)
    if most > len(ball.faces):
        np.testing.assert_allclose(found.vertices, expected.vertices, rtol=0, atol=1e-6)
    assert np.linalg.norm(found.vertices, axis=1).max() < 2.0 + 1e-5
    assert len(found.faces) == pytest.approx(len(expected.faces), rel=0.1)


def test_many_bodies_share_the_triangles_and_the_smallest_are_left_out():
    mesh = trimesh.creation.icosphere(2, 1.0)  # 320 triangles
    bodies = [
        sg.Body(f"ball {n}", trimesh.Trimesh(mesh.vertices * (n + 1), mesh.faces, process=False))
        for n in range(50)
    ]
    found = browser_meshes(sg.Scene(bodies), 5000)
    assert len(found) == 50 and sum(len(one.faces) for one in found) <= 5000
    found = browser_meshes(sg.Scene(bodies), 120)
    assert [one.name for one in found] == [f"ball {n}" for n in range(40, 50)]
    assert sum(len(one.faces) for one in found) <= 120


def test_a_flat_mesh_and_one_of_no_extent_end():
    side = np.arange(200.0)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    first = (np.arange(199)[:, None] * 200 + np.arange(199)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 201], 1), np.stack([first, first + 201, first + 200], 1)]
    )
    (plane,) = browser_meshes(
        sg.Scene([sg.Body("plane", trimesh.Trimesh(vertices, faces, process=False))]), 1000
    )
    assert 250 < len(plane.faces) <= 1000
    area = trimesh.Trimesh(plane.vertices, plane.faces, process=False).area
    assert area == pytest.approx(199.0**2, rel=0.15)  # the margin of half a cell all round is lost
    point = trimesh.Trimesh(np.zeros((3, 3)), np.tile([[0, 1, 2]], (50, 1)), process=False)
    (mesh,) = browser_meshes(sg.Scene([sg.Body("point", point)]), 12)
    assert len(mesh.faces) == 0
