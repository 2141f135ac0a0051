"""What tests of readers ask of a scene that was loaded."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.scene.load import load_scene
from sonar_gl.scene.scene import Scene

# of reflectivity, which few of these scenes state
UNSTATED = ("no <laser_retro>", "no material of a known name")


def load(what, *arguments, **settings) -> tuple[Scene, list[str]]:
    """Return the scene, and the texts of warnings but those of reflectivities that are not stated."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load_scene(what, *arguments, **settings)
    texts = [str(one.message) for one in caught]
    return scene, [text for text in texts if not any(words in text for words in UNSTATED)]


def error_message(what, *arguments, **settings) -> str:
    """Return the text of the Error that loading raises."""
    with pytest.raises(Error) as caught:
        load(what, *arguments, **settings)
    return str(caught.value)


def boxes_of(scene: Scene) -> dict[str, np.ndarray]:
    """Return name -> (2, 3) bounds of a body in the world."""
    out = {}
    for body in scene.bodies:
        points = body.mesh.vertices @ body.pose[:3, :3].T + body.pose[:3, 3]
        out[body.name] = np.array([points.min(axis=0), points.max(axis=0)])
    return out
