"""Trajectories of the vehicle: the time and pose of each ping, computed from the ping's number alone.

Conventions are SDF's: x forward, y to port, z up; a positive pitch looks down. Only a trajectory that is read
from a file keeps its poses in memory.
"""

from __future__ import annotations

import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field, Strict, ValidationError
from pydantic.dataclasses import dataclass

from sonar_gl.batch.job import METRES, RADIANS, check_keys
from sonar_gl.core.checks import check_choice
from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import check_kind_of_file
from sonar_gl.core.poses import pose, read_poses
from sonar_gl.core.toml_tables import STRICT, key_path, table_error

MAX_COORDINATE_M = 1e8  # also of lengths; northings of UTM reach 1e7
MAX_PINGS = 10**9
RIGHT_ANGLE = 1.5708  # radians, rounded as users round it

# ---- settings: bounds, and descriptions that error messages give as the cure ------------------------


def _bounded(low: float, high: float, cure: str):
    """Return the type of a number in low..high."""
    return Annotated[float, Field(ge=low, le=high, description=cure)]


def _several(number, count: int, cure: str):
    """Return the type of a list of numbers, which becomes a tuple."""
    size = Field(min_length=count, max_length=count, description=cure)
    return Annotated[list[number], Strict(False), size, AfterValidator(tuple)]


def _check_rising(bounds: tuple) -> tuple:
    if bounds[0] > bounds[1]:
        raise ValueError(f"should be [low, high] (got {bounds[0]:g} and {bounds[1]:g}; swap them)")
    return bounds


def _check_not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("should not be 0")
    return value


BOUNDS_M, BOUNDS_RAD = "give [low, high] in metres", "give [low, high] in radians: degrees times π/180"
Coordinate = _bounded(-MAX_COORDINATE_M, MAX_COORDINATE_M, METRES)
Length = _bounded(1e-3, MAX_COORDINATE_M, METRES)
Angle = _bounded(-4 * RIGHT_ANGLE, 4 * RIGHT_ANGLE, RADIANS)
Roll = _bounded(-2 * RIGHT_ANGLE, 2 * RIGHT_ANGLE, RADIANS)
Pitch = _bounded(-RIGHT_ANGLE, RIGHT_ANGLE, RADIANS)
Jitter = _bounded(0.0, 2 * RIGHT_ANGLE, RADIANS)
ElevationJitter = _bounded(0.0, RIGHT_ANGLE, RADIANS)
Speed = _bounded(1e-6, 1e3, "give metres per second")
Rate = _bounded(1e-6, 1e6, "give pings per second")
SweepTime = _bounded(1e-3, 1e9, "give seconds from one end to the other")
Turns = Annotated[_bounded(-1e6, 1e6, "1 is one turn, -1 one clockwise"), AfterValidator(_check_not_zero)]
Count = Annotated[int, Field(ge=1, le=MAX_PINGS, description="give the number of pings")]
Seed = Annotated[int, Field(ge=0, description="give a whole number, 0 or more")]
HorizontalPosition = _several(Coordinate, 2, "give [x, y] in metres")
Position = _several(Coordinate, 3, "give [x, y, z] in metres")
BoxSize = _several(_bounded(0.0, MAX_COORDINATE_M, METRES), 3, "give [x, y, z] in metres")
StartAndEndAngle = _several(Angle, 2, "give [from, to] in radians: degrees times π/180")
AngleBounds = Annotated[_several(Angle, 2, BOUNDS_RAD), AfterValidator(_check_rising)]
ElevationBounds = Annotated[_several(Pitch, 2, BOUNDS_RAD), AfterValidator(_check_rising)]
LengthBounds = Annotated[_several(Length, 2, BOUNDS_M), AfterValidator(_check_rising)]
HeightBounds = Annotated[_several(Coordinate, 2, BOUNDS_M), AfterValidator(_check_rising)]

# ---- trajectories -----------------------------------------------------------------------------------


class Trajectory(ABC):
    """A sequence of (time_s, world_from_vehicle) by ping number; nothing is stored.

    Subclasses are frozen dataclasses of settings; pydantic raises ValidationError for one that is out of bounds. A
    table of the job file has the same settings under the same names, which docs/batch.md describes.
    """

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def time_s(self, number):
        """Return the time of a ping in seconds, or an array of them for an array of numbers."""

    @abstractmethod
    def pose(self, number: int) -> np.ndarray:
        """Return the (4, 4) world_from_vehicle of a ping."""

    def __getitem__(self, number) -> tuple[float, np.ndarray]:
        number, size = operator.index(number), len(self)
        if not -size <= number < size:
            raise IndexError(f"a {type(self).__name__} has pings 0..{size - 1} (got {number})")
        number %= size
        return float(self.time_s(number)), self.pose(number)


@dataclass(frozen=True, config=STRICT)
class FileTrajectory(Trajectory):
    """Poses of a CSV file, see `sonar_gl.core.poses.read_poses`.

    Raises Error if the file cannot be read; names file, line and column.

    file : path; columns t,x,y,z,roll,pitch,yaw in seconds, metres and radians, or qx,qy,qz,qw for the angles
    """

    file: str

    def __post_init__(self):
        check_kind_of_file(self.file)  # no pipe: a batch reads the file again when it is resumed
        times_s, poses = read_poses(self.file)
        for array in (times_s, poses):
            array.setflags(write=False)
        object.__setattr__(self, "_table", (times_s, poses))

    def __len__(self):
        return len(self._table[0])

    def time_s(self, number):
        return self._table[0][number]

    def pose(self, number):
        return self._table[1][number]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Lawnmower(Trajectory):
    """Parallel legs over a rectangle, up and down, as in a survey.

    The legs are `line_spacing_m` apart and symmetric about the centre, the first to starboard of the heading.
    There are as many as cover the width, where each covers half a spacing to both sides. The sonar looks
    along its leg. Each leg begins with a ping on the edge of the rectangle. There are no pings between legs,
    while the vehicle drives a half circle; that takes the time of π/2 spacings at its speed.

    Raises ValidationError if a setting is out of bounds, or there are more than 1e9 pings.

    centre_m : x, y of the centre of the rectangle
    yaw_rad : heading of the first leg
    """

    centre_m: HorizontalPosition
    z_m: Coordinate
    length_m: Length
    width_m: Length
    line_spacing_m: Length
    speed_m_s: Speed
    ping_rate_hz: Rate
    yaw_rad: Angle = 0.0
    pitch_rad: Pitch = 0.0
    roll_rad: Roll = 0.0

    def __post_init__(self):
        # the tolerance takes quotients such as 0.3 / 0.1 for whole numbers
        legs = max(1, math.ceil(self.width_m / self.line_spacing_m - 1e-9))
        pings = math.floor(self.length_m * self.ping_rate_hz / self.speed_m_s + 1e-9) + 1
        if legs * pings > MAX_PINGS:
            raise ValueError(
                f"should have at most {MAX_PINGS:g} pings (got {legs} legs of {pings}; give a larger "
                "line_spacing_m, or a smaller ping_rate_hz)"
            )
        object.__setattr__(self, "_n_legs", legs)
        object.__setattr__(self, "_pings_per_leg", pings)

    def __len__(self):
        return self._n_legs * self._pings_per_leg

    def time_s(self, number):
        leg, ping = divmod(number, self._pings_per_leg)
        turn_m = math.pi / 2 * self.line_spacing_m
        return leg * ((self.length_m + turn_m) / self.speed_m_s) + ping / self.ping_rate_hz

    def pose(self, number):
        leg, ping = divmod(number, self._pings_per_leg)
        direction = 1 - 2 * (leg % 2)
        along = direction * (ping * self.speed_m_s / self.ping_rate_hz - self.length_m / 2)
        across = (leg - (self._n_legs - 1) / 2) * self.line_spacing_m
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y = self.centre_m[0] + c * along - s * across, self.centre_m[1] + s * along + c * across
        yaw = math.remainder(self.yaw_rad + (math.pi if direction < 0 else 0.0), 2 * math.pi)
        return pose(x, y, self.z_m, self.roll_rad, self.pitch_rad, yaw)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Orbit(Trajectory):
    """A horizontal circle about a target; the sonar looks at the target.

    centre_m : x, y, z of the target
    n_pings : number of equal steps; the last ping is one step before the end, since after whole turns the end
        is the first position
    turns : number of turns, positive counter-clockwise seen from above, not 0
    start_rad : azimuth of the first position seen from the target, from world x towards y
    speed_m_s : speed on the circle; decides the times only
    """

    centre_m: Position
    radius_m: Length
    z_m: Coordinate
    n_pings: Count
    turns: Turns
    start_rad: Angle = 0.0
    speed_m_s: Speed = 1.0

    def __len__(self):
        return self.n_pings

    def time_s(self, number):
        return number * (2 * math.pi * abs(self.turns) * self.radius_m / self.speed_m_s / self.n_pings)

    def pose(self, number):
        azimuth = self.start_rad + 2 * math.pi * math.remainder(self.turns * number / self.n_pings, 1.0)
        x, y, z = self.centre_m
        pitch = math.atan2(self.z_m - z, self.radius_m)
        yaw = math.remainder(azimuth + math.pi, 2 * math.pi)
        x, y = x + self.radius_m * math.cos(azimuth), y + self.radius_m * math.sin(azimuth)
        return pose(x, y, self.z_m, 0.0, pitch, yaw)


class EvenTrajectory(Trajectory):
    """A trajectory with the settings `n_pings` and `ping_rate_hz`."""

    def __len__(self):
        return self.n_pings

    def time_s(self, number):
        return number / self.ping_rate_hz


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SectorScan(EvenTrajectory):
    """A sonar at a fixed position that pans to and fro at a constant rate, as on a pan and tilt unit.

    pan_rad : yaw at the start and at the end of a sweep
    sweep_s : time from one end to the other
    tilt_rad : pitch, positive looks down
    """

    position_m: Position
    pan_rad: StartAndEndAngle
    n_pings: Count
    ping_rate_hz: Rate
    sweep_s: SweepTime
    tilt_rad: Pitch = 0.0

    def pose(self, number):
        share = 1 - abs(number / (self.ping_rate_hz * self.sweep_s) % 2 - 1)
        start, stop = self.pan_rad
        yaw = math.remainder(start + (stop - start) * share, 2 * math.pi)
        return pose(*self.position_m, 0.0, self.tilt_rad, yaw)


def _ranges_below(slope: float, height: float) -> tuple[float, float]:
    """Return the interval of ranges r >= 0 with r · slope <= height; empty if its start exceeds its end."""
    if slope == 0:
        return (0.0, math.inf) if height >= 0 else (math.inf, 0.0)
    return (0.0, height / slope) if slope > 0 else (max(0.0, height / slope), math.inf)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RandomViews(EvenTrajectory):
    """Random views of a target, by default from all azimuths.

    Each ping aims at a point, uniform in the box of the target. The azimuth of the sonar is uniform. Its
    range is uniform over those of `range_m` at which some elevation of `elevation_rad` keeps the sonar within
    `z_m`. The sine of its elevation is uniform over those elevations, so that equal solid angles are equally
    likely. No draw is rejected. The sonar is then turned so that the point appears at a uniform azimuth and
    elevation within the jitters, and rolled about the line to the point.

    Raises ValidationError if a setting is out of bounds, or no position within `z_m` satisfies the others.

    target_m, target_size_m : centre of the box that is aimed at, and its size along world x, y, z
    range_m : [low, high], from the point to the sonar
    azimuth_rad : [low, high], azimuth of the sonar seen from the point, from world x towards y
    elevation_rad : [low, high], elevation of the sonar seen from the point, positive above
    z_m : [low, high], height of the sonar, such as from the floor to the surface
    azimuth_jitter_rad, elevation_jitter_rad : largest angle between the point and the boresight
    ping_rate_hz : decides the times only
    """

    target_m: Position
    range_m: LengthBounds
    n_pings: Count
    target_size_m: BoxSize = (0.0, 0.0, 0.0)
    azimuth_rad: AngleBounds = (-math.pi, math.pi)
    elevation_rad: ElevationBounds = (0.0, 0.0)
    z_m: HeightBounds = (-MAX_COORDINATE_M, MAX_COORDINATE_M)
    azimuth_jitter_rad: Jitter = 0.0
    elevation_jitter_rad: ElevationJitter = 0.0
    roll_jitter_rad: Jitter = 0.0
    ping_rate_hz: Rate = 1.0
    seed: Seed = 0

    def __post_init__(self):
        # The possible pairs of a point's height and a range form a convex set: checking its ends is enough.
        for end in (-0.5, 0.5):
            z = self.target_m[2] + end * self.target_size_m[2]
            low, high = self._ranges(z)
            if low > high:
                raise ValueError(
                    f"range_m and elevation_rad should leave a position within z_m = {list(self.z_m)} from "
                    f"which to look at z = {z:g} (got {list(self.range_m)} and {list(self.elevation_rad)}; "
                    "widen one of the three, or make target_size_m smaller)"
                )

    def _ranges(self, z: float) -> tuple[float, float]:
        """Return the interval of ranges at which some elevation keeps the sonar within z_m."""
        lowest, highest = (math.sin(elevation) for elevation in self.elevation_rad)
        below, above = _ranges_below(lowest, self.z_m[1] - z), _ranges_below(-highest, z - self.z_m[0])
        return max(self.range_m[0], below[0], above[0]), min(self.range_m[1], below[1], above[1])

    def pose(self, number):
        # every ping makes the same nine draws, so that no setting changes the draws of another
        key = np.random.SeedSequence(self.seed, spawn_key=(number,))
        u = np.random.Generator(np.random.PCG64(key)).random(9).tolist()
        x, y, z = (
            centre + (share - 0.5) * size
            for centre, share, size in zip(self.target_m, u[:3], self.target_size_m, strict=True)
        )
        low, high = self._ranges(z)
        range_m = low + (high - low) * u[3]
        low = max(math.sin(self.elevation_rad[0]), (self.z_m[0] - z) / range_m)
        high = min(math.sin(self.elevation_rad[1]), (self.z_m[1] - z) / range_m)
        sine, (start, stop) = low + (high - low) * u[4], self.azimuth_rad
        azimuth = start + (stop - start) * u[5]
        horizontal_m = range_m * math.sqrt(1 - sine * sine)
        x, y = x + horizontal_m * math.cos(azimuth), y + horizontal_m * math.sin(azimuth)
        z += range_m * sine
        out = pose(x, y, z, 0.0, math.asin(sine), math.remainder(azimuth + math.pi, 2 * math.pi))
        limits = self.azimuth_jitter_rad, self.elevation_jitter_rad, self.roll_jitter_rad
        left, up, roll = ((2 * share - 1) * limit for share, limit in zip(u[6:], limits, strict=True))
        # the sonar turns by the inverse of the angles at which the point shall appear
        out[:3, :3] = out[:3, :3] @ (pose(roll=roll) @ pose(pitch=up) @ pose(yaw=-left))[:3, :3]
        return out


KINDS = {
    "trajectory": FileTrajectory,
    "lawnmower": Lawnmower,
    "orbit": Orbit,
    "sector": SectorScan,
    "random_views": RandomViews,
}


def build_trajectory(table: Mapping, file: str, index: int = 0) -> Trajectory:
    """Return the trajectory of a table of poses.

    Raises Error if the kind is unknown or a setting is wrong; names file, table and key.

    table : `kind`, a key of KINDS, and the settings of that kind; `scenes`, which decides no pose, is ignored
    file, index : name of the job file and index of the table, for messages
    """
    settings, place = dict(table), ("poses", index)
    where = f"{file}: {key_path(place)}"
    if "kind" not in table:
        known = {field.name for kind in KINDS.values() for field in fields(kind)}
        for key in table:
            check_choice("key", key, {"kind", "scenes", *known}, where)
    kind = settings.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise Error(
            f"{where}: kind must be one of {', '.join(KINDS)} (got {'none' if kind is None else repr(kind)})"
        )
    settings.pop("scenes", None)
    check_keys(KINDS[kind], settings, where, also=("scenes",))
    try:
        return KINDS[kind](**settings)
    except ValidationError as why:
        raise table_error(why, KINDS[kind], file, place) from None
