"""Poses in SDF: the numbers of an element, and frames that refer to other frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error, nearest_names
from sonar_gl.core.poses import pose, rotation_rows

USUAL_ANGLE_RAD = 2.5 * np.pi  # more is nearly always degrees; a little over a turn occurs
OF_ORIGIN = "of_origin"  # attribute of a `<pose>` that stands for an `<origin>` of URDF: the location of that


def read_numbers(element, location: str, count: int, positive: bool = False) -> np.ndarray:
    """Return the (count,) float64 numbers in the text of `element`.

    Raises Error, which begins with `location`, if the element is None or has other text.
    """
    wanted = f"must be {count} finite {'positive ' if positive else ''}number{'s' if count > 1 else ''}"
    if element is None:
        raise Error(f"{location}: {wanted} (the tag is absent)")
    text = (element.text or "").strip()
    try:
        out = np.array([float(word) for word in text.split()])
    except ValueError:
        raise Error(f"{location}: {wanted} (got {shown(text)})") from None
    if len(out) != count or not np.isfinite(out).all() or (positive and out.min() <= 0):
        raise Error(f"{location}: {wanted} (got {shown(text)})")
    return out


def read_pose(element, location: str, large_angles: dict) -> np.ndarray:
    """Return the (4, 4) matrix of a `<pose>` element; the identity if it is None or empty.

    The location is added to `large_angles` if its radians were probably meant as degrees.
    """
    if element is None or not (element.text or "").strip():
        return np.eye(4)
    rotation_format = element.get("rotation_format") or "euler_rpy"
    if rotation_format not in ("euler_rpy", "quat_xyzw"):
        raise Error(
            f"{location}: rotation_format must be 'euler_rpy' or 'quat_xyzw' (got {shown(rotation_format)})"
        )
    if rotation_format == "quat_xyzw":
        values = read_numbers(element, location, 7)
        length = np.linalg.norm(values[3:])
        if length < 1e-6:
            raise Error(f"{location}: a quaternion must not be zero (got {shown(element.text.strip())})")
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = rotation_rows(*values[3:] / length), values[:3]
        return out
    values = read_numbers(element, location, 6)
    if element.get("degrees", "false").strip() in ("true", "1"):
        return pose(*values[:3], *np.radians(np.fmod(values[3:], 360.0)))
    if np.abs(values[3:]).max() > USUAL_ANGLE_RAD:
        large_angles[element.get(OF_ORIGIN, location)] = OF_ORIGIN in element.attrib
    return pose(*values[:3], *np.fmod(values[3:], 2 * np.pi))


@dataclass
class Frame:
    """A frame, link, joint or model, to which poses may be relative.

    pose_element : its `<pose>`, or None
    base : name of the frame that its pose is relative to if the pose names none
    scope : the Scope of a model; None for others
    placement : name of the frame of the model that its pose places; "" is the model itself
    matrix : (4, 4) scope_from_frame, once it is computed
    """

    pose_element: object
    location: str
    base: str = ""
    scope: Scope | None = None
    placement: str = ""
    matrix: np.ndarray | None = None


@dataclass
class Scope:
    """A world or a model: its frames and links by name.

    frames : name -> Frame
    links : name -> `<link>` element
    merged : name of the frame -> Scope, of each model whose names count as names in this scope, too
    large_angles : location of a pose whose radians were probably meant as degrees -> whether it is an `<origin>` of
        URDF; of this and all inner scopes
    """

    location: str
    folder: Path
    is_world: bool = False
    frames: dict = field(default_factory=dict)
    links: dict = field(default_factory=dict)
    merged: dict = field(default_factory=dict)
    large_angles: dict = field(default_factory=dict)

    def inner(self, location: str, folder: Path) -> Scope:
        """Return an empty scope for a model in this one."""
        return Scope(location, folder, large_angles=self.large_angles)

    def location_of(self, part: str) -> str:
        """Return file and path of an element in this scope, for messages."""
        return f"{self.location}{'' if self.location.endswith(': ') else '/'}{part}"

    def add(self, name: str, frame: Frame, location: str | None = None):
        """Add a frame; messages begin with `location`, by default that of the frame."""
        location = location or frame.location
        if not name:
            raise Error(f"{location}: must have a name")
        self._check_new(name, location)
        self.frames[name] = frame

    def merge(self, name: str, location: str):
        """Let the names in the model of a frame count as names in this scope, too."""
        inner = self.frames[name].scope
        for new in inner.names():
            self._check_new(new, location)
        self.merged[name] = inner

    def names(self) -> list[str]:
        """Return the names of all frames, with those of merged models."""
        return [*self.frames, *(name for scope in self.merged.values() for name in scope.names())]

    def link_names(self) -> list[str]:
        """Return the names of all links, with those of merged models."""
        return [*self.links, *(name for scope in self.merged.values() for name in scope.link_names())]

    def holds(self, name: str) -> bool:
        """Return whether a frame has this name, here or in a merged model."""
        return name in self.frames or any(scope.holds(name) for scope in self.merged.values())

    def _check_new(self, name: str, location: str):
        if self.holds(name):
            raise Error(f"{location}: names must be unique (got {name!r} twice)")

    def find(self, name: str, location: str, visited=()) -> np.ndarray:
        """Return the (4, 4) matrix scope_from_frame of a frame.

        name : of a frame, or "model::frame"; "" is the scope itself
        location : of the element that names the frame, for messages
        visited : names of the frames whose poses led to this one, to detect cycles
        """
        if name in ("", "__model__") or (self.is_world and name in ("world", "__root__")):
            return np.eye(4)
        head, _, rest = name.partition("::")
        if name in self.frames:
            head, rest = name, ""
        frame = self.frames.get(head)
        if frame is None:
            for merged, scope in self.merged.items():
                if scope.holds(head):
                    return self.find(merged, location, visited) @ scope.find(name, location)
        if frame is None or (rest and frame.scope is None):
            known = [*self.names(), "world" if self.is_world else "__model__"]
            raise Error(f"{location}: unknown frame {name!r} ({nearest_names(name, known)})")
        if frame.matrix is None:
            if head in visited or len(visited) > 200:
                chain = " -> ".join([*visited, head][:10])
                raise Error(f"{location}: frames must lead to the model or world (got {chain} ...)")
            location = f"{frame.location}/pose"
            matrix = self.resolve_pose(frame.pose_element, location, frame.base, (*visited, head))
            if frame.placement:
                matrix = matrix @ np.linalg.inv(frame.scope.find(frame.placement, frame.location))
            frame.matrix = matrix
        return frame.matrix @ frame.scope.find(rest, location) if rest else frame.matrix

    def resolve_pose(self, pose_element, location: str, base: str, visited=()) -> np.ndarray:
        """Return the (4, 4) matrix of a pose in this scope.

        The pose is relative to the frame that its attribute `relative_to` names (`frame` in SDF 1.5 and 1.6),
        by default to the frame `base`.
        """
        if pose_element is not None:
            base = pose_element.get("relative_to") or pose_element.get("frame") or base
        return self.find(base, location, visited) @ read_pose(pose_element, location, self.large_angles)
