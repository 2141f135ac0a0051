"""Where the bodies and plumes of a live session's scene are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sonar_gl.core.checks import unknown_body_error
from sonar_gl.core.poses import check_pose
from sonar_gl.scene.scene import Scene


def scene_poses(scene: Scene) -> dict[str, np.ndarray]:
    """Return where a scene has its bodies and plumes, by name: (4, 4) world_from_body."""
    return {thing.name: thing.pose for thing in scene.bodies_and_plumes}


class BodyPoses:
    """Poses of bodies and plumes, some of which were moved. To be used by one thread at a time.

    Parameters
    ----------
    scene : Scene, which stays as it is

    Attributes
    ----------
    moved : names of those that were moved to (4, 4) world_from_body, None for one that was taken away. A change makes
        another mapping, so that a ping may hold this one
    """

    def __init__(self, scene: Scene):
        self._home = scene_poses(scene)
        self.moved: Mapping[str, np.ndarray | None] = {}

    def all(self) -> dict[str, np.ndarray | None]:
        """Return where all are now."""
        return {**self._home, **self.moved}

    def move(self, name: str, pose: np.ndarray | None) -> None:
        """Put one elsewhere, or None to take it away; raise Error if there is none of this name."""
        if not isinstance(name, str) or name not in self._home:
            raise unknown_body_error(name, self._home, "a body that is moved must be one of the scene")
        pose = None if pose is None else check_pose(pose, f"the pose of body {name!r}")
        self.moved = {**self.moved, name: pose}

    def reset(self) -> None:
        """Put all back to where the scene has them."""
        self.moved = {}
