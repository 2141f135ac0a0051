"""Meshes on their way to the buffers of OpenGL."""

import numpy as np
import pytest

from sonar_gl.raster.opengl import buffers
from sonar_gl.raster.opengl.buffers import collapse_lines


@pytest.mark.parametrize("at_once", [1, buffers.FACES_AT_ONCE])
def test_faces_whose_corners_lie_on_a_line_are_not_drawn(monkeypatch, at_once):
    """Their rounded corners span a sliver, in which a software driver found samples, with a plane of their own."""
    monkeypatch.setattr(buffers, "FACES_AT_ONCE", at_once)
    rng = np.random.default_rng(5)
    a, b = rng.uniform(-10, 10, (2, 500, 3))
    aside = np.cross(b - a, rng.normal(size=(500, 3)))
    aside /= np.linalg.norm(aside, axis=1)[:, None]
    middle = a + rng.uniform(0, 1, (500, 1)) * (b - a)
    # a hundredth of a millimetre high is more than float32 rounds at 10 m
    points = np.concatenate([a, b, middle, middle + 1e-5 * aside]).astype(np.float32)
    numbers = np.arange(500)
    lines = np.column_stack([numbers, 500 + numbers, 1000 + numbers])
    thin = np.column_stack([500 + numbers, 1500 + numbers, numbers])
    faces = 7 + np.concatenate([lines, thin, lines[:, [0, 0, 1]]]).astype(np.uint32)
    found = faces.copy()
    collapse_lines(found, 7, points)
    assert (np.ptp(found[:500], axis=1) == 0).all() and (np.ptp(found[1000:], axis=1) == 0).all()
    np.testing.assert_array_equal(found[500:1000], faces[500:1000])
