"""Frames of SDF: poses, and what they are relative to."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sonar_gl.scene import pose
from sonar_gl.types import Error, nearest_names


def numbers(element, where: str, count: int, positive: bool = False) -> np.ndarray:
    """(count,) float64 that the text of `element` must hold, or an `Error` that begins with `where`."""
    wanted = f"must be {count} finite {'positive ' if positive else ''}number{'s' if count > 1 else ''}"
    if element is None:
        raise Error(f"{where}: {wanted} (the tag is absent)")
    text = (element.text or "").strip()
    try:
        out = np.array([float(word) for word in text.split()])
    except ValueError:
        raise Error(f"{where}: {wanted} (got {text!r})") from None
    if len(out) != count or not np.isfinite(out).all() or (positive and out.min() <= 0):
        raise Error(f"{where}: {wanted} (got {text!r})")
    return out


def matrix_of(element, where: str) -> np.ndarray:
    """(4, 4) of a `<pose>` element; identity where it is absent or empty."""
    if element is None or not (element.text or "").strip():
        return np.eye(4)
    if element.get("rotation_format", "euler_rpy") == "quat_xyzw":
        values = numbers(element, where, 7)
        length = np.linalg.norm(values[3:])
        if length < 1e-6:
            raise Error(f"{where}: a quaternion must not be zero (got {element.text.strip()!r})")
        x, y, z, w = values[3:] / length
        out = np.eye(4)
        out[:3, 3] = values[:3]
        out[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        return out
    values = numbers(element, where, 6)
    if element.get("degrees", "false").strip() in ("true", "1"):
        return pose(*values[:3], *np.radians(np.fmod(values[3:], 360.0)))
    if np.abs(values[3:]).max() > 2 * np.pi + 1e-6:
        raise Error(
            f"{where}: angles must be radians, within ±2π (got {element.text.strip()!r}; "
            'if they are degrees, write <pose degrees="true">)'
        )
    return pose(*values)


@dataclass
class Frame:
    """Something with a pose that others may be relative to; `scope` if it is a model."""

    pose_element: object
    where: str
    base: str = ""  # what an absent relative_to means
    scope: Scope | None = None
    placement: str = ""  # the frame of the model that its pose is about
    matrix: np.ndarray | None = None


@dataclass
class Scope:
    """A world or a model: its frames by name, its links, and the file that it was read from."""

    where: str
    folder: Path
    is_world: bool = False
    frames: dict = field(default_factory=dict)
    links: dict = field(default_factory=dict)

    def at(self, part: str) -> str:
        """File and path of an element in this scope, for messages."""
        return f"{self.where}{'' if self.where.endswith(': ') else '/'}{part}"

    def add(self, name: str, frame: Frame, where: str | None = None):
        """Give a frame its name; `where` it is asked for, if that is not where it stands."""
        if not name:
            raise Error(f"{where or frame.where}: must have a name")
        if name in self.frames:
            raise Error(f"{where or frame.where}: names must be unique (got {name!r} twice)")
        self.frames[name] = frame

    def find(self, name: str, where: str, seen=()) -> np.ndarray:
        """(4, 4) scope_from_frame."""
        if name in ("", "__model__") or (self.is_world and name in ("world", "__root__")):
            return np.eye(4)
        head, _, rest = name.partition("::")
        if name in self.frames:
            head, rest = name, ""
        frame = self.frames.get(head)
        if frame is None or (rest and frame.scope is None):
            known = [*self.frames, "world" if self.is_world else "__model__"]
            raise Error(f"{where}: unknown frame {name!r} ({nearest_names(name, known)})")
        if frame.matrix is None:
            if head in seen or len(seen) > 200:
                chain = " -> ".join([*seen, head][:10])
                raise Error(f"{where}: frames must lead to the model or world (got {chain} ...)")
            where = f"{frame.where}/pose"
            matrix = self.relative(frame.pose_element, where, frame.base, (*seen, head))
            if frame.placement:
                matrix = matrix @ np.linalg.inv(frame.scope.find(frame.placement, frame.where))
            frame.matrix = matrix
        return frame.matrix @ frame.scope.find(rest, where) if rest else frame.matrix

    def relative(self, pose_element, where, base, seen=()):
        """(4, 4) of a pose in this scope; SDF 1.5 and 1.6 wrote `frame` for `relative_to`."""
        if pose_element is not None:
            base = pose_element.get("relative_to") or pose_element.get("frame") or base
        return self.find(base, where, seen) @ matrix_of(pose_element, where)
