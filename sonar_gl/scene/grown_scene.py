"""A scene to which bodies are added one by one."""

from __future__ import annotations

from collections.abc import Iterable

from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.scene import Body, Scene


class GrownScene:
    """A scene and the bodies and plumes that were added to it, put together when the scene is asked for."""

    def __init__(self, scene: Scene, things: Iterable[Body | Bubbles] = ()):
        self._parts = scene, tuple(things)  # one attribute, as other threads may replace it

    def with_more(self, things: Iterable[Body | Bubbles]) -> GrownScene:
        """Return this scene and more bodies and plumes, whose names it must not have. This object stays as it is."""
        scene, before = self._parts
        return GrownScene(scene, (*before, *things))

    @property
    def scene(self) -> Scene:
        """The scene, with all that was added."""
        scene, things = self._parts
        if things:
            scene = scene.with_more(things)
            self._parts = scene, ()
        return scene
