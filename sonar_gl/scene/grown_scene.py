"""A scene to which bodies are added one by one."""

from __future__ import annotations

from collections.abc import Sequence

from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.scene import Body, Scene


class GrownScene:
    """A scene and what was added to it; they are put together when that is asked for, each time all of them.

    Parameters
    ----------
    scene : Scene; None for `before` and what was added to it
    before, things : GrownScene, and the bodies and plumes that were added

    Attributes
    ----------
    made_of : the three parameters
    """

    def __init__(self, scene: Scene | None, before: GrownScene | None = None, things: Sequence = ()):
        # either a scene, or what this one was made of; one attribute, as other threads may replace it
        self.made_of: tuple[Scene | None, GrownScene | None, Sequence] = scene, before, things

    def with_more(self, things: Sequence[Body | Bubbles]) -> GrownScene:
        """Return this scene and more bodies and plumes, whose names it must not have. This object stays as it is."""
        return GrownScene(None, self, things)

    @property
    def scene(self) -> Scene:
        """The scene, with all that was added."""
        parts = []
        scene, before, things = self.made_of
        while scene is None:
            parts.append(things)
            scene, before, things = before.made_of
        if parts:
            scene = scene.with_more([thing for part in reversed(parts) for thing in part])
            self.made_of = scene, None, ()
        return scene
