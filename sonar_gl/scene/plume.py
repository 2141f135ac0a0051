"""Bubble plumes, such as a diver's exhaust: the place and radius of each bubble at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.core.checks import (
    ArraysStayReadOnly,
    check_fields,
    check_kind,
    check_number,
    check_whole_number,
    make_numbers_plain,
)
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import MAX_TIME_S, check_pose

MAX_BUBBLES = 200_000  # of a plume at one time
MIN_SPEED_RATIO, MAX_SPEED_RATIO = 0.8, 1.2  # a bubble's own speed of rise over the plume's
NUMBERS_PER_BUBBLE = 8  # random numbers: two steps of Philox's counter
# counter of the bubble released at time 0; bubbles released earlier have smaller counters
COUNTER_AT_0_S = 2**64
BOUNDS = (
    ("rate_hz", 1e-3, 1e5, "give bubbles a second"),
    ("radius_m", 5e-4, 0.1, "give metres, 0.005 for 5 mm; smaller ones resonate, which is not modelled"),
    ("radius_spread", 0, 1, "give the standard deviation of ln(radius)"),
    ("rise_m_s", 0.01, 2, "give metres per second, 0.2 to 0.35 for bubbles of millimetres and more"),
    ("half_angle_deg", 0, 60, "give degrees"),
    ("mouth_m", 0, 100, "give metres"),
    ("height_m", 1e-3, 1000, "give metres"),
    ("breath_s", 0.1, 1000, "give the seconds from one breath to the next"),
    ("exhaling", 0.01, 1, "give the fraction of a breath during which bubbles are released"),
)


@dataclass(frozen=True, eq=False)
class Bubbles(ArraysStayReadOnly):
    """A plume of bubbles that rise from one place. The defaults are a diver who exhales 20 litres a minute.

    Parameters
    ----------
    name : unique in its scene
    pose : (4, 4) world_from_plume, the source of the bubbles; None is the identity. Bubbles rise along the
        world's z whatever the rotation. Moving the plume moves all of its bubbles
    rate_hz : mean number of bubbles released per second
    radius_m : mean radius, metres
    radius_spread : standard deviation of ln(radius), which is normally distributed
    rise_m_s : mean speed of rise, metres per second; each bubble has its own speed within 20 % of it. Bubbles
        of 1 mm to 1 cm rise at 0.2 to 0.35 m/s (Clift, Grace, Weber, Bubbles, Drops, and Particles, 1978)
    half_angle_deg : half angle of the cone in which they spread. The cone holds 86 % of them, as two standard
        deviations of a normal distribution in two dimensions do
    mouth_m : radius of the cone at its lower end, metres
    height_m : height to which they rise, metres; the water's surface always ends them
    breath_s, exhaling : period of breathing, seconds, and the fraction of it during which bubbles are
        released; breath_s None releases them evenly
    seed : seed of all random numbers: the same seed and time give the same bubbles

    Raises
    ------
    Error
        if a number is out of bounds, or the plume would hold more than 200000 bubbles at a time.
    """

    name: str
    pose: np.ndarray = None
    rate_hz: float = 300.0
    radius_m: float = 5e-3
    radius_spread: float = 0.5
    rise_m_s: float = 0.25
    half_angle_deg: float = 6.0
    mouth_m: float = 0.05
    height_m: float = 5.0
    breath_s: float | None = None
    exhaling: float = 0.4
    seed: int = 0

    def __post_init__(self):
        check_kind("the name of bubbles", self.name, str, 'such as "diver::bubbles"')
        location = f"bubbles {self.name!r}"
        make_numbers_plain(self)
        check_fields(location, self, BOUNDS)
        check_whole_number(f"{location}: seed", self.seed)
        number = self.rate_hz * self._max_age_s()
        if number > MAX_BUBBLES:
            raise Error(
                f"{location}: there must be no more than {MAX_BUBBLES} bubbles at a time (got {number:.0f}: "
                "rate_hz times height_m over rise_m_s; take fewer and larger ones)"
            )
        pose = check_pose(np.eye(4) if self.pose is None else self.pose, f"{location}: pose")
        object.__setattr__(self, "pose", pose)

    def _max_age_s(self) -> float:
        """Return the time that the slowest bubble needs to rise to the top."""
        return self.height_m / (MIN_SPEED_RATIO * self.rise_m_s)

    def at(self, time_s: float, pose: ArrayLike | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the places and radii of the bubbles at a time.

        Parameters
        ----------
        time_s : seconds, may be negative: the plume has no beginning
        pose : (4, 4) world_from_plume; None is the plume's own

        Returns
        -------
        places : (n, 3) float64, world, metres
        radii : (n,) float64, metres

        Raises
        ------
        Error
            if the time is not a number of seconds that a ping may have, or the pose is not one.
        """
        time_s = check_number("time_s", time_s, -MAX_TIME_S, MAX_TIME_S, "give seconds")
        source = (self.pose if pose is None else check_pose(pose, f"the pose of bubbles {self.name!r}"))[
            :3, 3
        ]
        first = math.floor(self._exhaled_s(time_s - self._max_age_s()) * self.rate_hz) - 1
        numbers = np.arange(first, math.floor(self._exhaled_s(time_s) * self.rate_hz) + 1)
        # the counter depends on the bubble's number alone, so each bubble has the same random numbers at any
        # time
        random = np.random.Philox(key=int(self.seed) % 2**128, counter=COUNTER_AT_0_S + 2 * first)
        u = random.random_raw(NUMBERS_PER_BUBBLE * len(numbers)).reshape(-1, NUMBERS_PER_BUBBLE)
        u = (u >> np.uint64(11)) * 2.0**-53  # uniform in [0, 1)
        released_s = (numbers + u[:, 0]) / self.rate_hz
        if self.breath_s is not None:
            breath, fraction = np.divmod(released_s / self.breath_s, 1.0)
            released_s = self.breath_s * (breath + self.exhaling * fraction)
        speed_ratio = MIN_SPEED_RATIO + (MAX_SPEED_RATIO - MIN_SPEED_RATIO) * u[:, 1]
        height = (time_s - released_s) * self.rise_m_s * speed_ratio
        present = (height >= 0) & (height <= self.height_m)
        u, height = u[present], height[present]
        # two pairs of normal numbers by Box and Muller; only one number of the first pair is used
        magnitude, angle = np.sqrt(-2 * np.log1p(-u[:, 2:4])).T, 2 * np.pi * u[:, 4:6].T
        normal = magnitude[0] * np.cos(angle[0])
        radii = self.radius_m * np.exp(self.radius_spread * (normal - self.radius_spread / 2))
        # the cone's radius is two standard deviations
        cone_m = self.mouth_m + math.tan(math.radians(self.half_angle_deg)) * height
        from_axis = magnitude[1] * cone_m / 2
        offsets = np.column_stack([from_axis * np.cos(angle[1]), from_axis * np.sin(angle[1]), height])
        return source + offsets, radii

    def _exhaled_s(self, time_s: float) -> float:
        """Return the time in which a steady flow would have released as many bubbles."""
        if self.breath_s is None:
            return time_s
        breath, fraction = divmod(time_s / self.breath_s, 1.0)
        return self.breath_s * (breath + min(fraction / self.exhaling, 1.0))
