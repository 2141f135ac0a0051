"""Random places round a target, each of its number alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sonar_gl.batch.numbered import (
    FARTHEST_M,
    RIGHT_ANGLE,
    Numbered,
    angle,
    count,
    length,
    metres,
    rate,
    setting,
)
from sonar_gl.noise import check_seed
from sonar_gl.rigid import pose
from sonar_gl.types import Error


def _spread(most: float):
    """A field of how far something is off at most, either way."""
    return setting(0.0, most, "give radians: degrees times π/180", 0.0)


def _reach(slope: float, most: float) -> tuple[float, float]:
    """The ranges r, 0 or more, at which r · slope is `most` or less; none if the first is the larger."""
    if slope == 0:
        return (0.0, math.inf) if most >= 0 else (math.inf, 0.0)
    return (0.0, most / slope) if slope > 0 else (max(0.0, most / slope), math.inf)


@dataclass(frozen=True, kw_only=True)
class RandomViews(Numbered):
    """A target seen at random, from all round unless `azimuth_rad` says less.

    Each ping aims at a point that is uniform in the target's box. Its azimuth is uniform. Its range
    is uniform over those of `range_m` from which some elevation of `elevation_rad` keeps the sonar within
    `z_m`; the sine of its elevation is uniform over those that do, so that equal solid angles are equally
    likely. Nothing is drawn and thrown away. Then the sonar is turned so that the point appears at a uniform
    azimuth and elevation within the jitters, and rolled about the line to it.

    Parameters
    ----------
    target_m, target_size_m : middle, and lengths along world x, y, z, of the box that is aimed at
    range_m : [low, high], from the point to the sonar
    n_pings : how many
    azimuth_rad : [low, high], of the sonar as seen from the point, from world x towards y
    elevation_rad : [low, high], likewise, positive above
    z_m : [low, high], height of the sonar: give what lies between floor and surface
    azimuth_jitter_rad, elevation_jitter_rad : at most so far from the boresight the point appears
    roll_jitter_rad : at most so far the sonar is rolled
    ping_rate_hz : for the times alone
    seed : whole number, 0 or more; another makes others

    Raises
    ------
    Error
        if a number makes no sense, or no place within `z_m` fits the others.
    """

    target_m: tuple[float, float, float] = metres(size=3)
    range_m: tuple[float, float] = length(size=2, rises=True)
    n_pings: int = count()
    target_size_m: tuple[float, float, float] = length((0.0, 0.0, 0.0), least=0.0, size=3)
    azimuth_rad: tuple[float, float] = angle((-math.pi, math.pi), size=2, rises=True)
    elevation_rad: tuple[float, float] = angle((0.0, 0.0), most=RIGHT_ANGLE, size=2, rises=True)
    z_m: tuple[float, float] = metres((-FARTHEST_M, FARTHEST_M), size=2, rises=True)
    azimuth_jitter_rad: float = _spread(2 * RIGHT_ANGLE)
    elevation_jitter_rad: float = _spread(RIGHT_ANGLE)
    roll_jitter_rad: float = _spread(2 * RIGHT_ANGLE)
    ping_rate_hz: float = rate(1.0)
    seed: int = field(default=0)

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "seed", check_seed(self.seed, "random_views: seed"))
        # what is possible of a point's height and a range is convex: its ends stand for all between
        for end in (-0.5, 0.5):
            z = self.target_m[2] + end * self.target_size_m[2]
            low, high = self._ranges(z)
            if low > high:
                raise Error(
                    "random_views: range_m and elevation_rad must leave a place within z_m = "
                    f"{list(self.z_m)} from which to look at z = {z:g} (got {list(self.range_m)} and "
                    f"{list(self.elevation_rad)}; widen one of the three, or make target_size_m smaller)"
                )

    def _ranges(self, z: float) -> tuple[float, float]:
        """The ranges at which some elevation keeps the sonar within z_m, aiming at this height."""
        steepest = [math.sin(elevation) for elevation in self.elevation_rad]
        below, above = _reach(steepest[0], self.z_m[1] - z), _reach(-steepest[1], z - self.z_m[0])
        return max(self.range_m[0], below[0], above[0]), min(self.range_m[1], below[1], above[1])

    def _length(self):
        return self.n_pings

    def _time_s(self, n):
        return n / self.ping_rate_hz

    def _pose(self, n):
        # all that there may be is drawn, so that no setting moves what others decide
        numbers = np.random.SeedSequence(self.seed, spawn_key=(n,))
        u = np.random.Generator(np.random.PCG64(numbers)).random(9).tolist()
        x, y, z = (
            at + (share - 0.5) * size
            for at, share, size in zip(self.target_m, u[:3], self.target_size_m, strict=True)
        )
        low, high = self._ranges(z)
        range_m = low + (high - low) * u[3]
        low = max(math.sin(self.elevation_rad[0]), (self.z_m[0] - z) / range_m)
        high = min(math.sin(self.elevation_rad[1]), (self.z_m[1] - z) / range_m)
        sine, (start, stop) = low + (high - low) * u[4], self.azimuth_rad
        azimuth = start + (stop - start) * u[5]
        level = range_m * math.sqrt(1 - sine * sine)
        x, y, z = x + level * math.cos(azimuth), y + level * math.sin(azimuth), z + range_m * sine
        out = pose(x, y, z, 0.0, math.asin(sine), math.remainder(azimuth + math.pi, 2 * math.pi))
        limits = self.azimuth_jitter_rad, self.elevation_jitter_rad, self.roll_jitter_rad
        aside, up, roll = ((2 * share - 1) * limit for share, limit in zip(u[6:], limits, strict=True))
        # turned back from where the point is to appear, it does appear there
        out[:3, :3] = out[:3, :3] @ (pose(roll=roll) @ pose(pitch=up) @ pose(yaw=-aside))[:3, :3]
        return out
