"""Rigid poses: from six numbers, and what is none refused."""

from __future__ import annotations

import numpy as np

from sonar_gl.types import Error, frozen_array


def check_pose(matrix, what: str = "pose") -> np.ndarray:
    """A rigid (4, 4) float64 `world_from_x`, or an `Error`."""
    out = frozen_array(matrix, np.float64, (4, 4), what)
    # in plain numbers: a sixth of the time that NumPy takes for nine of them, at every ping
    (a, b, c), (d, e, f), (g, h, i) = out[:3, :3].tolist()
    lengths = a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1
    angles = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    turn = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if max(map(abs, lengths + angles)) > 1e-5 or turn < 0:
        raise Error(
            f"{what} must be a rotation and a translation (its 3x3 part scales, shears or mirrors; "
            "scale the mesh instead)"
        )
    if not np.array_equal(out[3], [0, 0, 0, 1]):
        raise Error(f"{what} must have the last row 0 0 0 1 (got {out[3].tolist()})")
    return out


def numbers_of(matrix: np.ndarray) -> tuple[float, ...]:
    """x y z roll pitch yaw of a (4, 4) pose, metres and radians, as `pose` takes them.

    >>> [round(x, 9) for x in numbers_of(pose(1, 2, 3, 0.1, -0.2, 0.3))]
    [1.0, 2.0, 3.0, 0.1, -0.2, 0.3]
    """
    (a, b, _), (d, e, _), (g, h, i) = matrix[:3, :3].tolist()
    pitch = np.arctan2(-g, np.hypot(a, d))
    if np.hypot(a, d) < 1e-9:  # straight up or down, where roll and yaw are one
        roll, yaw = 0.0, np.arctan2(-b, e)
    else:
        roll, yaw = np.arctan2(h, i), np.arctan2(d, a)
    return (*matrix[:3, 3].tolist(), float(roll), float(pitch), float(yaw))


def pose(x=0.0, y=0.0, z=0.0, roll=0.0, pitch=0.0, yaw=0.0) -> np.ndarray:
    """`world_from_sonar` from SDF's six numbers: metres, and fixed-axis x-y-z angles in radians.

    Convention: R = Rz(yaw) Ry(pitch) Rx(roll), x forward, y left (port), z up.

    Returns
    -------
    (4, 4) float64

    Raises
    ------
    Error
        if a number is not finite, or an angle is beyond 2π, as degrees would be.

    >>> (pose(1, 2, 3, yaw=np.pi / 2) @ [1, 0, 0, 1]).round(6).tolist()
    [1.0, 3.0, 3.0, 1.0]
    """
    numbers = frozen_array([x, y, z, roll, pitch, yaw], np.float64, (6,), "pose x y z roll pitch yaw")
    if np.abs(numbers[3:]).max() > 2 * np.pi + 1e-6:
        raise Error(
            f"pose angles must be radians, within ±2π (got roll pitch yaw = {roll:g} {pitch:g} {yaw:g}; "
            "if these are degrees, multiply by π/180; if they are unwrapped radians, wrap them)"
        )
    (sr, sp, sy), (cr, cp, cy) = np.sin(numbers[3:]), np.cos(numbers[3:])
    out = np.eye(4)
    out[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    out[:3, 3] = numbers[:3]
    return out
