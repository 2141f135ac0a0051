"""A scene to which bodies are added one by one."""

from __future__ import annotations

from collections.abc import Sequence

from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.scene import Body, Scene


class GrownScene:
    """A scene and what was added to it; they are put together when that is asked for, each time all of them.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene | None):
        # either a scene, or what this one was made of; one attribute, as other threads may replace it
        self._made_of: tuple[Scene | None, GrownScene | None, Sequence] = scene, None, ()

    def with_more(self, things: Sequence[Body | Bubbles]) -> GrownScene:
        """Return this scene and more bodies and plumes, whose names it must not have. This object stays as it is."""
        out = GrownScene(None)
        out._made_of = None, self, things
        return out

    @property
    def scene(self) -> Scene:
        """The scene, with all that was added."""
        parts = []
        scene, before, things = self._made_of
        while scene is None:
            parts.append(things)
            scene, before, things = before._made_of
        if parts:
            scene = scene.with_more([thing for part in reversed(parts) for thing in part])
            self._made_of = scene, None, ()
        return scene
