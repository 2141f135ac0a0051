"""The links of a scene's tree, and the one that carries the sonar."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sonar_gl.scene.sdf.frames import Scope, read_pose

SONAR_WORDS = ("sonar", "fls", "multibeam")
OTHER_SONARS = ("dvl", "altimeter")  # which make no images
# Types of sensor that Gazebo's users simulate sonars with. In a model that is named after a sonar only these
# are taken for one: the model may hold an IMU as well.
IMAGING_SENSORS = {"camera", "depth", "depth_camera", "rgbd_camera", "ray", "gpu_ray", "lidar", "gpu_lidar"}


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

    def world_pose(self) -> np.ndarray:
        """Return (4, 4) world_from_link."""
        return self.world_from_model @ self.scope.find(self.name, self.location)

    def pose_in_link(self, element, location: str) -> np.ndarray:
        """Return (4, 4) link_from_element of a shape, sensor or plume in the link."""
        pose_element, location = element.find("pose"), f"{location}/pose"
        if pose_element is None or not (pose_element.get("relative_to") or pose_element.get("frame")):
            return read_pose(pose_element, location)
        in_model = self.scope.resolve_pose(pose_element, location, self.name)
        return np.linalg.inv(self.scope.find(self.name, self.location)) @ in_model


def links_of(scope: Scope, world_from_scope: np.ndarray, model: str = "") -> Iterator[Link]:
    """Yield every link of a scope and the models in it, in the order of the file."""
    for name, frame in scope.frames.items():
        if frame.scope is not None:
            world_from_model = world_from_scope @ scope.find(name, frame.location)
            yield from links_of(frame.scope, world_from_model, f"{model}::{name}" if model else name)
        elif name in scope.links:
            yield Link(scope, name, scope.links[name], model, world_from_scope)


def find_sonar(links) -> tuple[Link | None, np.ndarray | None]:
    """Return the link that carries the sonar and the sonar's (4, 4) world pose, or (None, None).

    The sonar is the first `<sensor type="custom">`; else the first sensor whose own name or plugin contains
    one of SONAR_WORDS; else the first of IMAGING_SENSORS in a model whose name contains one, or in a link of
    a URDF file. By their names, DVLs and altimeters are none.
    """
    found = []
    for link in links:
        for sensor in link.element.findall("sensor"):
            names = [sensor.get("name") or ""]
            names += [p.get(key) or "" for p in sensor.findall("plugin") for key in ("name", "filename")]
            kind = (sensor.get("type") or "").strip()
            owner = link.model or link.name
            by_sensor, by_model = (
                any(word in text.lower() for word in SONAR_WORDS) for text in (" ".join(names), owner)
            )
            if any(word in f"{names[0]} {owner}".lower() for word in OTHER_SONARS):
                by_sensor = by_model = False
            if kind == "custom" or by_sensor or (by_model and kind in IMAGING_SENSORS):
                rank = 0 if kind == "custom" else 1 if by_sensor else 2
                found.append((rank, len(found), link, sensor))
    if not found:
        return None, None
    _, _, link, sensor = min(found, key=lambda candidate: candidate[:2])
    location = f"{link.location}/sensor[{sensor.get('name') or ''}]"
    return link, link.world_pose() @ link.pose_in_link(sensor, location)
