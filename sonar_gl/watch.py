"""When to look again at what the samples are worth: sonar, bodies or the echo have changed."""

from __future__ import annotations

import math

CHECK_EVERY = 24  # pings: a look costs about one and a half
CHECK_MOVE, CHECK_CHANGE = 0.05, 0.2  # of range_max_m; of the whole echo
CHECK_TURN_DEG = 30.0  # or a quarter of the field of view, or half the aperture in elevation


def _motion(before, after) -> tuple[float, float]:
    """How far at most some (n, 4, 4) poses lie from others, metres, and how far turned, radians."""
    if not len(before):
        return 0.0, 0.0
    apart = after[:, :3, 3] - before[:, :3, 3]
    moved = math.sqrt(float((apart * apart).sum(axis=1).max()))
    turned = float((before[:, :3, :3] * after[:, :3, :3]).sum(axis=(1, 2)).min())
    return moved, math.acos(min(1.0, max(-1.0, (turned - 1) / 2)))


class Watch:
    """What was there at the last look."""

    def __init__(self, sonar):
        self.pose, self.where, self.whole, self.since = None, None, 0.0, 0
        self.far_m = CHECK_MOVE * sonar.range_max_m
        turn_deg = min(CHECK_TURN_DEG, sonar.azimuth_fov_deg / 4, sonar.elevation_fov_deg / 2)
        self.far_rad = math.radians(turn_deg)

    def looked(self, pose, where, whole: float) -> None:
        """At a ping from `pose` of bodies that are `where`, and of so much echo in all."""
        self.pose, self.where, self.whole, self.since = pose, where, whole, 0

    def changed(self, whole: float) -> bool:
        """Whether something came into view, or left."""
        return abs(whole - self.whole) > CHECK_CHANGE * self.whole

    def due(self, pose, where) -> bool:
        """Whether sonar or bodies have moved far, or a little for long."""
        self.since += 1
        if self.pose is None:
            return True
        moved, turned = _motion(self.pose[None], pose[None])
        if where is not self.where:
            if len(where.shown) != len(self.where.shown) or (where.shown != self.where.shown).any():
                return True
            bodies_moved, bodies_turned = _motion(self.where.poses, where.poses)
            moved, turned = max(moved, bodies_moved), max(turned, bodies_turned)
        if moved <= 0.0 and turned < 1e-6:
            return False
        return self.since >= CHECK_EVERY or moved > self.far_m or turned > self.far_rad
