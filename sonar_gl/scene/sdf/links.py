"""The links of a scene's tree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sonar_gl.scene.sdf.frames import Scope, read_pose


@dataclass(frozen=True)
class Link:
    """A link of the tree.

    Attributes
    ----------
    scope : the model that holds it
    name : in that model
    element : its `<link>`
    model : name of the model, "outer::inner" if nested; "" in a URDF file
    world_from_model : (4, 4)
    """

    scope: Scope
    name: str
    element: object
    model: str
    world_from_model: np.ndarray

    @property
    def path(self) -> str:
        """`model::link`."""
        return f"{self.model}::{self.name}" if self.model else self.name

    @property
    def location(self) -> str:
        """File and element, for messages."""
        return self.scope.frames[self.name].location

    def pose_in_model(self) -> np.ndarray:
        """Return (4, 4) model_from_link."""
        return self.scope.find(self.name, self.location)

    def world_pose(self) -> np.ndarray:
        """Return (4, 4) world_from_link."""
        return self.world_from_model @ self.pose_in_model()

    def pose_in_link(self, element, location: str) -> np.ndarray:
        """Return (4, 4) link_from_element of a shape, sensor or plume in the link."""
        pose_element, location = element.find("pose"), f"{location}/pose"
        if pose_element is None or not (pose_element.get("relative_to") or pose_element.get("frame")):
            return read_pose(pose_element, location, self.scope.large_angles)
        in_model = self.scope.resolve_pose(pose_element, location, self.name)
        return np.linalg.inv(self.pose_in_model()) @ in_model


def links_of(scope: Scope, world_from_scope: np.ndarray, model: str = "") -> Iterator[Link]:
    """Yield every link of a scope and the models in it, in the order of the file."""
    for name, frame in scope.frames.items():
        if frame.scope is not None:
            world_from_model = world_from_scope @ scope.find(name, frame.location)
            yield from links_of(frame.scope, world_from_model, f"{model}::{name}" if model else name)
        elif name in scope.links:
            yield Link(scope, name, scope.links[name], model, world_from_scope)
