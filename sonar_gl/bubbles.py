"""Plumes of bubbles, as over a diver's head: where each bubble is at any time, and what it does to sound."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.rigid import check_pose
from sonar_gl.types import Error

MOST = 200_000  # bubbles of a plume at a time
SLOWEST, FASTEST = 0.8, 1.2  # a bubble's own speed over the plume's
DRAWN = 8  # random numbers of a bubble
FIRST = 2**64  # number of the bubble that is born at time 0: those before are counted, too
BOUNDS = (
    ("rate_hz", 1e-3, 1e5, "give bubbles a second"),
    ("radius_m", 5e-4, 0.1, "give metres, 0.005 for 5 mm; smaller ones resonate, which is left out"),
    ("radius_spread", 0, 1, "give the standard deviation of ln(radius)"),
    ("rise_m_s", 0.01, 2, "give metres per second, 0.2 to 0.35 for bubbles of millimetres and more"),
    ("half_angle_deg", 0, 60, "give degrees"),
    ("mouth_m", 0, 100, "give metres"),
    ("height_m", 1e-3, 1000, "give metres"),
    ("breath_s", 0.1, 1000, "give the seconds from one breath to the next"),
    ("exhaling", 0.01, 1, "give the share of the breath that goes out"),
)


def bubble_strength(radius_m):
    """σ_bs of a bubble, m² per steradian: a²/4, the echo of a sphere that sends back all that meets it.

    It holds where ka >> 1, k = 2π/λ: at 900 kHz a bubble of 1 mm has ka = 3.8. The formula of a resonant
    bubble, a² / ((f₀²/f² − 1)² + δ²), would hold it at 1/k² here, for its damping δ tends to ka: it is made
    for bubbles that are small against the wavelength.
    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> (10 * np.log10(bubble_strength(np.array([1e-3, 2.5e-3, 10e-3])))).round(1).tolist()
    [-66.0, -58.1, -46.0]
    """
    return np.asarray(radius_m, np.float64) ** 2 / 4


def bubble_extinction(radius_m):
    """What a bubble takes out of a sound beam, m²: 2πa², twice its own cross-section.

    One half meets the bubble, the other is bent around it by a few λ/(2πa): 3 to 15 degrees for radii of 5
    to 1 mm at 900 kHz. That is wider than a beam: what is bent comes to the sonar as a faint haze, not from
    where the beam looks, and is left out. Further than a²/λ, some centimetres, a bubble's own shadow is
    filled again, and what many together take is even.
    Source: van de Hulst, Light Scattering by Small Particles, 1957

    >>> round(float(bubble_extinction(2.5e-3) / (np.pi * 2.5e-3**2)), 9)
    2.0
    """
    return 2 * math.pi * np.asarray(radius_m, np.float64) ** 2


@dataclass(frozen=True, eq=False)
class Bubbles:
    """A plume of bubbles that rise from one place. As given: a diver's 20 litres of air a minute.

    Parameters
    ----------
    name : unique in its scene
    pose : (4, 4) world_from_plume, the place where the bubbles come from; they rise along the world's z
        whatever its rotation. A plume that is moved takes all of its bubbles along
    rate_hz : bubbles a second, in the mean
    radius_m : their mean radius, metres
    radius_spread : standard deviation of ln(radius), which is normal
    rise_m_s : how fast they rise, metres per second; each has its own speed within 20 % of this. Bubbles of
        1 mm to 1 cm have 0.2 to 0.35 (Clift, Grace, Weber, Bubbles, Drops, and Particles, 1978)
    half_angle_deg : of the cone in which they spread, and which holds 86 % of them, as many as a normal
        distribution of two standard deviations
    mouth_m : radius of the cone where it begins, metres
    height_m : how far up they come, metres; the water's surface ends them in any case
    breath_s, exhaling : seconds from one breath to the next, and the share of it in which bubbles come; None
        = they come evenly
    seed : of what is left to chance: the same seed and time give the same bubbles

    Raises
    ------
    Error
        if a number makes no sense, or more than 200000 bubbles would be there at a time.
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
        where = f"bubbles {self.name!r}"
        for key, low, high, hint in BOUNDS:
            value = getattr(self, key)
            if value is None and key == "breath_s":
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise Error(f"{where}: {key} must be a number (got {value!r})")
            if not low <= value <= high:  # NaN too
                raise Error(f"{where}: {key} must lie in {low:g}..{high:g} (got {value:g}; {hint})")
        if isinstance(self.seed, bool) or not isinstance(self.seed, (int, np.integer)) or self.seed < 0:
            raise Error(f"{where}: seed must be a whole number, 0 or more (got {self.seed!r})")
        many = self.rate_hz * self._oldest_s()
        if many > MOST:
            raise Error(
                f"{where}: there must be no more than {MOST} bubbles at a time (got {many:.0f}: rate_hz "
                "times height_m over rise_m_s; take fewer and larger ones)"
            )
        pose = check_pose(np.eye(4) if self.pose is None else self.pose, f"{where}: pose")
        object.__setattr__(self, "pose", pose)

    def _oldest_s(self) -> float:
        return self.height_m / (SLOWEST * self.rise_m_s)

    def at(self, time_s: float, pose=None) -> tuple[np.ndarray, np.ndarray]:
        """Where the bubbles are.

        Parameters
        ----------
        time_s : seconds, may be negative: the plume was always there
        pose : (4, 4) world_from_plume, None for its own

        Returns
        -------
        (n, 3) float64, world, metres; (n,) float64, radii, metres
        """
        first = math.floor(self._breathed(time_s - self._oldest_s()) * self.rate_hz) - 1
        numbers = np.arange(first, math.floor(self._breathed(time_s) * self.rate_hz) + 1)
        # two of the generator's counts are one bubble: it has the same eight numbers whenever it is asked for
        random = np.random.Philox(key=int(self.seed) % 2**128, counter=FIRST + 2 * first)
        u = (random.random_raw(DRAWN * len(numbers)).reshape(-1, DRAWN) >> np.uint64(11)) * 2.0**-53
        born = (numbers + u[:, 0]) / self.rate_hz
        if self.breath_s is not None:
            breath, share = np.divmod(born / self.breath_s, 1.0)
            born = self.breath_s * (breath + self.exhaling * share)
        rise = (time_s - born) * self.rise_m_s * (SLOWEST + (FASTEST - SLOWEST) * u[:, 1])
        there = (rise >= 0) & (rise <= self.height_m)
        u, rise = u[there], rise[there]
        # pairs of normal numbers, after Box and Muller; of the first pair one
        far, turn = np.sqrt(-2 * np.log1p(-u[:, 2:4])).T, 2 * np.pi * u[:, 4:6].T
        normal = far[0] * np.cos(turn[0])
        radii = self.radius_m * np.exp(self.radius_spread * (normal - self.radius_spread / 2))
        far = far[1] * (self.mouth_m + math.tan(math.radians(self.half_angle_deg)) * rise) / 2
        place = (self.pose if pose is None else pose)[:3, 3]
        return place + np.column_stack([far * np.cos(turn[1]), far * np.sin(turn[1]), rise]), radii

    def _breathed(self, time_s: float) -> float:
        """How long the same air would have flowed evenly."""
        if self.breath_s is None:
            return time_s
        breath, share = divmod(time_s / self.breath_s, 1.0)
        return self.breath_s * (breath + min(share / self.exhaling, 1.0))
