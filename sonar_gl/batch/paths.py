"""Where a sonar goes: read from a table, along lines, round a target, turning on the spot, or at random.

Each is a sequence of (time_s, world_from_sonar): `len(path)`, `path[n]`, `path.times_s`. Settings can stand
in a table as they are, under the same names. Conventions are SDF's: x ahead, y to port, z up; a positive
pitch looks down. Nothing but a file's table is held in memory: ping n is made from n alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.batch.numbered import (
    MOST_PINGS,
    RIGHT_ANGLE,
    Numbered,
    angle,
    count,
    length,
    metres,
    rate,
    setting,
)
from sonar_gl.batch.views import RandomViews
from sonar_gl.poses import read_poses
from sonar_gl.rigid import check_pose, pose
from sonar_gl.types import Error

# vehicle_from_sonar of two sonars that look ahead: world_from_sonar = world_from_vehicle @ ORTHOGONAL[name].
# One fan lies level; the other is turned by 90° about its boresight, and its port side is up.
ORTHOGONAL = {
    "horizontal": check_pose(np.eye(4)),
    "vertical": check_pose(pose(roll=math.pi / 2)),
}


@dataclass(frozen=True)
class Trajectory(Numbered):
    """Poses of a CSV file, as `sonar_gl.poses.read_poses` reads it when this is made.

    Parameters
    ----------
    file : path; columns t,x,y,z,roll,pitch,yaw in seconds, metres and radians

    Raises
    ------
    Error
        with file, line and column, if it cannot be read so.
    """

    file: str

    def __post_init__(self):
        times_s, poses = read_poses(self.file)
        for array in (times_s, poses):
            array.setflags(write=False)
        object.__setattr__(self, "_table", (times_s, poses))

    def _length(self):
        return len(self._table[0])

    def _time_s(self, n):
        return self._table[0][n]

    def _pose(self, n):
        return self._table[1][n]


@dataclass(frozen=True, kw_only=True)
class Lawnmower(Numbered):
    """Parallel legs over a rectangle, there and back, as in a survey.

    Legs are `line_spacing_m` apart and as many as cover the width, each half a spacing to both sides; they
    lie evenly about the centre, the first to starboard of the heading. The sonar looks along its leg. Each
    leg begins with a ping on the rectangle's edge. No ping is made between legs, where the vehicle drives a
    half circle: that takes π/2 spacings at its speed.

    Parameters
    ----------
    centre_m : x, y of the rectangle's middle
    z_m : height at which the sonar travels
    length_m, width_m : along and across the legs
    line_spacing_m, speed_m_s, ping_rate_hz : pings on a leg are speed / rate apart
    yaw_rad : heading of the first leg
    pitch_rad, roll_rad : of the sonar, on every leg

    Raises
    ------
    Error
        if a number makes no sense, or pings are more than 1e9.
    """

    centre_m: tuple[float, float] = metres(size=2)
    z_m: float = metres()
    length_m: float = length()
    width_m: float = length()
    line_spacing_m: float = length()
    speed_m_s: float = setting(1e-6, 1e3, "give metres per second")
    ping_rate_hz: float = rate()
    yaw_rad: float = angle(0.0)
    pitch_rad: float = angle(0.0, most=RIGHT_ANGLE)
    roll_rad: float = angle(0.0, most=2 * RIGHT_ANGLE)

    def __post_init__(self):
        super().__post_init__()
        # a hair less or more than a whole number, as 0.3 / 0.1 is, counts as that
        legs = max(1, math.ceil(self.width_m / self.line_spacing_m - 1e-9))
        pings = math.floor(self.length_m * self.ping_rate_hz / self.speed_m_s + 1e-9) + 1
        if legs * pings > MOST_PINGS:
            raise Error(
                f"lawnmower: must have at most {MOST_PINGS:g} pings (got {legs} legs of {pings}; give "
                "a larger line_spacing_m, or a smaller ping_rate_hz)"
            )
        object.__setattr__(self, "_legs", (legs, pings))

    def _length(self):
        return math.prod(self._legs)

    def _time_s(self, n):
        leg, ping = divmod(n, self._legs[1])
        turned_m = math.pi / 2 * self.line_spacing_m
        return leg * ((self.length_m + turned_m) / self.speed_m_s) + ping / self.ping_rate_hz

    def _pose(self, n):
        leg, ping = divmod(n, self._legs[1])
        way = 1 - 2 * (leg % 2)
        ahead = way * (ping * self.speed_m_s / self.ping_rate_hz - self.length_m / 2)
        aside = (leg - (self._legs[0] - 1) / 2) * self.line_spacing_m
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y = self.centre_m[0] + c * ahead - s * aside, self.centre_m[1] + s * ahead + c * aside
        yaw = math.remainder(self.yaw_rad + (math.pi if way < 0 else 0.0), 2 * math.pi)
        return pose(x, y, self.z_m, self.roll_rad, self.pitch_rad, yaw)


@dataclass(frozen=True, kw_only=True)
class Orbit(Numbered):
    """A level circle about a target, at which the sonar looks.

    Parameters
    ----------
    centre_m : x, y, z of the target
    radius_m : horizontal distance from it
    z_m : height at which the sonar travels
    n_pings : even steps; the last is one step before the end, which after whole turns is the first place
    turns : of the whole, positive counter-clockwise seen from above, not 0
    start_rad : where it begins, from world x towards y as seen from the target
    speed_m_s : on the circle; it sets the times alone

    Raises
    ------
    Error
        if a number makes no sense.
    """

    centre_m: tuple[float, float, float] = metres(size=3)
    radius_m: float = length()
    z_m: float = metres()
    n_pings: int = count()
    turns: float = setting(-1e6, 1e6, "1 is once round, -1 the other way")
    start_rad: float = angle(0.0)
    speed_m_s: float = setting(1e-6, 1e3, "give metres per second", 1.0)

    def __post_init__(self):
        super().__post_init__()
        if self.turns == 0:
            raise Error("orbit: turns must not be 0 (got 0; 1 is once round, -1 the other way)")

    def _length(self):
        return self.n_pings

    def _time_s(self, n):
        return n * (2 * math.pi * abs(self.turns) * self.radius_m / self.speed_m_s / self.n_pings)

    def _pose(self, n):
        azimuth = self.start_rad + 2 * math.pi * math.remainder(self.turns * n / self.n_pings, 1.0)
        x, y, z = self.centre_m
        pitch = math.atan2(self.z_m - z, self.radius_m)
        yaw = math.remainder(azimuth + math.pi, 2 * math.pi)
        x, y = x + self.radius_m * math.cos(azimuth), y + self.radius_m * math.sin(azimuth)
        return pose(x, y, self.z_m, 0.0, pitch, yaw)


@dataclass(frozen=True, kw_only=True)
class Sector(Numbered):
    """A sonar that stays and turns evenly to and fro, as on a pan and tilt unit.

    Parameters
    ----------
    position_m : x, y, z
    pan_rad : yaw from which it turns, and to which, by way of the angles between
    n_pings, ping_rate_hz : how many, and how many a second
    sweep_s : time from one end to the other
    tilt_rad : how far it looks down

    Raises
    ------
    Error
        if a number makes no sense.
    """

    position_m: tuple[float, float, float] = metres(size=3)
    pan_rad: tuple[float, float] = angle(size=2)
    n_pings: int = count()
    ping_rate_hz: float = rate()
    sweep_s: float = setting(1e-3, 1e9, "give seconds from one end to the other")
    tilt_rad: float = angle(0.0, most=RIGHT_ANGLE)

    def _length(self):
        return self.n_pings

    def _time_s(self, n):
        return n / self.ping_rate_hz

    def _pose(self, n):
        share = 1 - abs(n / (self.ping_rate_hz * self.sweep_s) % 2 - 1)
        start, stop = self.pan_rad
        yaw = math.remainder(start + (stop - start) * share, 2 * math.pi)
        return pose(*self.position_m, 0.0, self.tilt_rad, yaw)


KINDS = {kind.name(): kind for kind in (Trajectory, Lawnmower, Orbit, Sector, RandomViews)}
