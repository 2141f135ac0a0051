"""The `<state>` of a world that Gazebo Classic has saved: where its models stood at that moment.

Gazebo Classic moves its models there when it opens the world. Their own `<pose>` is where they were put first.
"""

from __future__ import annotations

import re

import numpy as np

from sonar_gl.core.errors import some_names
from sonar_gl.scene.sdf.frames import Scope, read_pose

MOVED = 0.01  # metres, or of a rotation's matrix: less is a model that has settled on the ground


def apply_state(scope: Scope, world) -> str:
    """Move the models and links of a world to the poses of its first `<state>`; return in words what moved.

    Raises Error with file and element, if a pose is invalid.

    scope : of the world, filled, before poses of models are asked for
    """
    state = world.find("state")
    if state is None:
        return ""
    moved = _apply(scope, np.eye(4), state, scope.location_of("state"))
    said = [f"models stand where <state> says, as in Gazebo Classic ({some_names(moved)})"] if moved else []
    scaled = [
        model.get("name")
        for model in state.iter("model")
        if not all(re.fullmatch(r"1(\.0*)?", word) for word in (model.findtext("scale") or "").split())
    ]
    said += [f"<scale> of <state> is left out ({some_names(scaled)})"] if scaled else []
    return "; ".join(said)


def _apply(scope: Scope, world_from_scope: np.ndarray, state, location: str) -> list[str]:
    """Move what the state of a world or model names; its poses are in the world."""
    moved = []
    for model in state.findall("model"):
        name = (model.get("name") or "").strip()
        frame = scope.frames.get(name)
        if frame is None or frame.scope is None:  # deleted since
            continue
        where = f"{location}/model[{name}]"
        parts = [_place(scope, world_from_scope, name, model, where)]
        world_from_model = world_from_scope @ scope.find(name, where)
        for link in model.findall("link"):
            link_name = (link.get("name") or "").strip()
            parts.append(_place(frame.scope, world_from_model, link_name, link, f"{where}/link[{link_name}]"))
        inner = _apply(frame.scope, world_from_model, model, where)
        moved += [name] if any(parts) or inner else []
    return moved


def _place(scope: Scope, world_from_scope: np.ndarray, name: str, element, location: str) -> bool:
    """Put a frame, or "model::frame", at the pose of an element in the world; return whether it moved."""
    head, _, rest = name.partition("::")
    if name not in scope.frames:
        inner = scope.frames.get(head)
        if not rest or inner is None or inner.scope is None:
            return False
        return _place(inner.scope, world_from_scope @ scope.find(head, location), rest, element, location)
    pose = element.find("pose")
    if pose is None:
        return False
    before = scope.find(name, location)
    world_from_frame = read_pose(pose, f"{location}/pose", scope.large_angles)
    scope.frames[name].matrix = np.linalg.inv(world_from_scope) @ world_from_frame
    return bool(np.abs(scope.frames[name].matrix - before).max() > MOVED)
