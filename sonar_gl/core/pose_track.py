"""The pose of a sonar or a body at any time, from poses at some times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from trimesh.transformations import quaternion_from_matrix, quaternion_matrix, quaternion_slerp


class PoseTrack:
    """Poses over time: between two of them position and attitude change evenly; before and after all, they stay.

    poses : (4, 4) world_from_x, at least one
    times_s : (N,) seconds, which do not fall; None for what stands at the first pose

    >>> from sonar_gl.core.poses import pose
    >>> float(PoseTrack([pose(0), pose(2, yaw=1.0)], [0.0, 4.0]).at(1.0)[0, 3])
    0.5
    """

    def __init__(self, poses: Sequence[np.ndarray], times_s: Sequence[float] | None = None):
        self._poses = [np.asarray(one, np.float64) for one in poses]
        times_s = np.zeros(1) if times_s is None else np.asarray(times_s, np.float64)
        self._times_s = times_s - times_s[0]  # since the first pose

    @property
    def duration_s(self) -> float:
        """Seconds from the first pose to the last."""
        return float(self._times_s[-1])

    def at(self, time_s: float) -> np.ndarray:
        """Return world_from_x, (4, 4) float64, at a time in seconds since the first pose."""
        times_s = self._times_s
        after = int(np.searchsorted(times_s, time_s, side="right"))
        if after == 0 or after == len(times_s):
            return self._poses[min(after, len(times_s) - 1)].copy()
        first, second = self._poses[after - 1], self._poses[after]
        share = (time_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1])
        out = quaternion_matrix(
            quaternion_slerp(quaternion_from_matrix(first), quaternion_from_matrix(second), share)
        )
        out[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
        return out
