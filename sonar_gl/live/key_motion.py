"""Motion of the sonar by keys."""

from __future__ import annotations

from collections.abc import Collection

import cv2
import numpy as np

from sonar_gl.core.checks import check_number
from sonar_gl.core.poses import check_pose, pose

SPEED_M_S = 1.0
TURN_RATE_RAD_S = 0.5
# key: forward, port, up; turns to port, turns down
KEYS = {
    "w": (1, 0, 0, 0, 0),
    "s": (-1, 0, 0, 0, 0),
    "a": (0, 1, 0, 0, 0),
    "d": (0, -1, 0, 0, 0),
    "e": (0, 0, 1, 0, 0),
    "q": (0, 0, -1, 0, 0),
    "arrowleft": (0, 0, 0, 1, 0),
    "arrowright": (0, 0, 0, -1, 0),
    "arrowup": (0, 0, 0, 0, -1),
    "arrowdown": (0, 0, 0, 0, 1),
}
STEEPEST_RAD = np.radians(89.0)  # beyond, a turn to port would roll the sonar over


def moved(
    world_from_sonar: np.ndarray,
    keys: Collection[str],
    dt_s: float,
    speed_m_s: float = SPEED_M_S,
    turn_rate_rad_s: float = TURN_RATE_RAD_S,
) -> np.ndarray:
    """Return where a sonar is after some keys were held for a time.

    W and S go forward and backward along the boresight, A and D to port and to starboard, E and Q up and down in the
    world; the arrows turn. A sonar that is turned stays level: it gets no roll that it did not have.

    world_from_sonar : (4, 4), and so what is returned
    keys : names of KEYS, in upper or lower case; others do nothing, and opposite keys cancel
    dt_s : seconds, 0 or more
    speed_m_s, turn_rate_rad_s : metres and radians per second

    >>> moved(np.eye(4), {"w"}, 2.0, speed_m_s=1.5)[:3, 3].tolist()
    [3.0, 0.0, 0.0]
    """
    start = check_pose(world_from_sonar)
    dt_s = check_number("dt_s", dt_s, 0.0, hint="give seconds")
    speed_m_s = check_number("speed_m_s", speed_m_s)
    turn_rate_rad_s = check_number("turn_rate_rad_s", turn_rate_rad_s)
    pressed = {key.casefold() for key in keys}
    forward, port, up, left, down = (
        sum(KEYS[key][axis] for key in pressed if key in KEYS) for axis in range(5)
    )
    out = start.copy()
    step_m, turn_rad = speed_m_s * dt_s, turn_rate_rad_s * dt_s
    out[:3, 3] += step_m * (forward * start[:3, 0] + port * start[:3, 1] + up * np.array([0.0, 0.0, 1.0]))
    if left:
        out[:3, :3] = pose(yaw=np.remainder(left * turn_rad, 2 * np.pi))[:3, :3] @ out[:3, :3]
    if down:
        pitch = float(np.arcsin(np.clip(-out[2, 0], -1, 1)))
        wanted = np.clip(pitch + down * turn_rad, min(pitch, -STEEPEST_RAD), max(pitch, STEEPEST_RAD))
        out[:3, :3] = out[:3, :3] @ _about_level_axis(out, wanted - pitch)
    return out


def _about_level_axis(world_from_sonar: np.ndarray, turn_rad: float) -> np.ndarray:
    """Return the (3, 3) rotation of the sonar, in its frame, about its level axis to port, downwards."""
    boresight = world_from_sonar[:3, 0]
    axis = np.cross([0.0, 0.0, 1.0], boresight)
    if np.linalg.norm(axis) < 1e-9:  # straight up or down
        axis = world_from_sonar[:3, 1]
    axis = world_from_sonar[:3, :3].T @ (axis / np.linalg.norm(axis))
    return cv2.Rodrigues(turn_rad * axis)[0]
