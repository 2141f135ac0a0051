"""When to estimate the error of the samples again: after sonar or bodies have moved, or bodies changed."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sonar_gl.core.poses import scales_of
from sonar_gl.engine.flow import PingSetup
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.sonar import Sonar

CHECK_EVERY = 24  # pings: a check costs nearly another one
CHECK_MOVE = 0.05  # of range_max_m
CHECK_BRIGHTER = 2.0  # times the reflectivity of a body, or its area
CHECK_TURN_DEG = 30.0  # or a quarter of the field of view, or half the aperture in elevation


class ReplanTrigger:
    """Decides when to estimate the error again: since the last check sonar or bodies have moved, or bodies changed.

    backscatter : function of a state to the most that each body returns in it
    """

    def __init__(self, sonar: Sonar, backscatter: Callable[[SceneState], np.ndarray]):
        self._backscatter = backscatter
        self._far_m = CHECK_MOVE * sonar.range_max_m
        turn_deg = min(CHECK_TURN_DEG, sonar.azimuth_fov_deg / 4, sonar.elevation_fov_deg / 2)
        self._far_rad = math.radians(turn_deg)

    def is_due(self, before: PingSetup, after: PingSetup, n_pings: int) -> bool:
        """Return whether sonar or bodies have changed much since the last check, or a little, and that is long ago.

        before, after : of the ping that was checked and of the one to come
        n_pings : from the one to the other
        """
        if have_come_or_gone(before.state, after.state):
            return True
        moved, turned, brighter = self._change(before, after)
        if moved <= 0.0 and turned < 1e-6 and brighter == 1.0:
            return False
        return self._is_much(moved, turned, brighter) or n_pings >= CHECK_EVERY

    def is_far(self, before: PingSetup, after: PingSetup) -> bool:
        """Return whether sonar or bodies have changed much between two pings.

        Not if bodies came or went: where the sonar has hardly moved, the samples of before are a good start.
        """
        return self._is_much(*self._change(before, after))

    def _is_much(self, moved: float, turned: float, brighter: float) -> bool:
        return moved > self._far_m or turned > self._far_rad or brighter > CHECK_BRIGHTER

    def _brighter(self, before: SceneState, after: SceneState, in_both: np.ndarray) -> float:
        """Return by how many times at most a body that is present in two states returns more, or less, in the other."""
        own, other = (scales_of(state.poses[in_both]) ** 2 for state in (before, after))
        if after.reflectivity is not before.reflectivity:
            own, other = own * self._backscatter(before)[in_both], other * self._backscatter(after)[in_both]
        high, low = np.maximum(own, other), np.minimum(own, other)
        return float(np.where(high > low, high / np.maximum(low, 1e-12), 1.0).max(initial=1.0))

    def _change(self, before: PingSetup, after: PingSetup) -> tuple[float, float, float]:
        """Return by how much sonar or bodies move, metres, and turn, radians, and how many times brighter or darker.

        The bodies are those that both pings have.
        """
        moved, turned = _motion_of_one(before.head_pose, after.head_pose)
        old, new = before.state, after.state
        if new is old:
            return moved, turned, 1.0
        if n_added := len(new.present) - len(old.present):
            old = old.with_absent(n_added)
        in_both = old.present & new.present
        bodies_moved, bodies_turned = _motion(old.poses[in_both], new.poses[in_both])
        return max(moved, bodies_moved), max(turned, bodies_turned), self._brighter(old, new, in_both)


def have_come_or_gone(before: SceneState, after: SceneState) -> bool:
    """Return whether other bodies are present in one state than in another."""
    if after is before:
        return False
    return len(after.present) != len(before.present) or bool((after.present != before.present).any())


def _motion(before, after) -> tuple[float, float]:
    """Return by how much at most some (n, 4, 4) poses have moved, metres, and turned, radians."""
    if not len(before):
        return 0.0, 0.0
    apart = after[:, :3, 3] - before[:, :3, 3]
    moved = math.sqrt(float((apart * apart).sum(axis=1).max()))
    traces = (before[:, :3, :3] * after[:, :3, :3]).sum(axis=(1, 2)) / (scales_of(before) * scales_of(after))
    return moved, _angle_of(traces.min())


def _motion_of_one(before, after) -> tuple[float, float]:
    """Return the same of one (4, 4) pose, without NumPy, whose calls take longer: each ping does this a few times."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = before.tolist()
    (p, q, r, u), (j, k, m, v), (n, o, s, w), _ = after.tolist()
    trace = a * p + b * q + c * r + d * j + e * k + f * m + g * n + h * o + i * s
    return math.dist((x, y, z), (u, v, w)), _angle_of(trace)


def _angle_of(trace: float) -> float:
    """Return the angle of the rotation that leads from one matrix to another; `trace` : the sum of their products."""
    return math.acos(min(1.0, max(-1.0, (float(trace) - 1) / 2)))
