"""The links of a scene's tree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sonar_gl.scene.sdf.frames import Scope, read_pose

IDENTITY = np.eye(4)


@dataclass(frozen=True)
class Link:
    """A link of the tree.

    scope : the model that holds it, or a model that is merged into that one
    name : in that scope
    element : its `<link>`
    model : name of the model, "outer::inner" if nested; "" in a URDF file
    world_from_model, model_from_scope : (4, 4)
    """

    scope: Scope
    name: str
    element: object
    model: str
    world_from_model: np.ndarray
    model_from_scope: np.ndarray

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
        return self.model_from_scope @ self.scope.find(self.name, self.location)

    def world_pose(self) -> np.ndarray:
        """Return (4, 4) world_from_link."""
        return self.world_from_model @ self.pose_in_model()

    def pose_in_link(self, element, location: str) -> np.ndarray:
        """Return (4, 4) link_from_element of a shape, sensor or plume in the link."""
        pose_element, location = element.find("pose"), f"{location}/pose"
        if pose_element is None or not (pose_element.get("relative_to") or pose_element.get("frame")):
            return read_pose(pose_element, location, self.scope.large_angles)
        in_scope = self.scope.resolve_pose(pose_element, location, self.name)
        return np.linalg.inv(self.scope.find(self.name, self.location)) @ in_scope


def models_of(
    scope: Scope, world_from_scope: np.ndarray, model: str = ""
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and (4, 4) world_from_model of every model in a scope; parameters as for `links_of`."""
    for name, frame in scope.frames.items():
        if frame.scope is None:
            continue
        world_from_inner, inner = world_from_scope @ scope.find(name, frame.location), model
        if name not in scope.merged:
            inner = f"{model}::{name}" if model else name
            yield inner, world_from_inner
        yield from models_of(frame.scope, world_from_inner, inner)


def links_of(
    scope: Scope, world_from_model: np.ndarray, model: str = "", model_from_scope: np.ndarray = IDENTITY
) -> Iterator[Link]:
    """Yield every link of a scope and the models in it, in the order of the file.

    scope : of a world, of a model, or of what is merged into one of them
    world_from_model, model_from_scope : (4, 4)
    """
    for name, frame in scope.frames.items():
        if frame.scope is not None:
            model_from_inner = model_from_scope @ scope.find(name, frame.location)
            if name in scope.merged:
                yield from links_of(frame.scope, world_from_model, model, model_from_inner)
            else:
                inner = f"{model}::{name}" if model else name
                yield from links_of(frame.scope, world_from_model @ model_from_inner, inner)
        elif name in scope.links:
            yield Link(scope, name, scope.links[name], model, world_from_model, model_from_scope)
