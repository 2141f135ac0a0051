"""Sequences whose members are made from their number alone, and settings that say what they may be."""

from __future__ import annotations

import dataclasses
import operator

import numpy as np

from sonar_gl.types import Error

FARTHEST_M = 1e8  # of coordinates, and of lengths: UTM's northings reach 1e7
MOST_PINGS = 10**9
RIGHT_ANGLE = 1.5708  # radians, as people round it


@dataclasses.dataclass(frozen=True)
class Allowed:
    """What a setting may be: one number, or `size` of them, in low..high.

    Attributes
    ----------
    size : how many numbers, 0 for a bare one
    rises : of two numbers the second must not be the smaller
    whole : no fractions
    """

    low: float
    high: float
    hint: str
    size: int = 0
    rises: bool = False
    whole: bool = False

    def check(self, what: str, value):
        """The value, as float, int or a tuple of floats, or an Error."""
        if not self.size:
            return self._number(what, value)
        if not isinstance(value, (list, tuple, np.ndarray)) or np.shape(value) != (self.size,):
            raise Error(f"{what} must be {self.size} numbers (got {value!r}; {self.hint})")
        out = tuple(self._number(what, number) for number in value)
        if self.rises and out[0] > out[1]:
            raise Error(f"{what} must be [low, high] (got {out[0]:g} and {out[1]:g}; swap them)")
        return out

    def _number(self, what: str, value):
        kinds, name = (
            ((int, np.integer), "a whole number") if self.whole else ((int, float, np.number), "a number")
        )
        if isinstance(value, (bool, np.bool_)) or not isinstance(value, kinds):
            raise Error(f"{what} must be {name} (got {value!r}; {self.hint})")
        if not self.low <= value <= self.high:  # NaN too
            raise Error(f"{what} must lie in {self.low:g}..{self.high:g} (got {value:g}; {self.hint})")
        return int(value) if self.whole else float(value)


def setting(low: float, high: float, hint: str, default=dataclasses.MISSING, **more):
    """A dataclass's field that `Allowed(low, high, hint, **more)` checks."""
    return dataclasses.field(default=default, metadata={"allowed": Allowed(low, high, hint, **more)})


def metres(default=dataclasses.MISSING, **more):
    """A field of coordinates."""
    return setting(-FARTHEST_M, FARTHEST_M, "give metres", default, **more)


def length(default=dataclasses.MISSING, least=1e-3, **more):
    """A field of a length, or of several."""
    return setting(least, FARTHEST_M, "give metres", default, **more)


def angle(default=dataclasses.MISSING, most=4 * RIGHT_ANGLE, **more):
    """A field of an angle, or of several."""
    return setting(-most, most, "give radians: degrees times π/180", default, **more)


def rate(default=dataclasses.MISSING):
    """A field of pings a second."""
    return setting(1e-6, 1e6, "give pings a second", default)


def count():
    """A field of how many pings."""
    return setting(1, MOST_PINGS, "give how many pings", whole=True)


class Numbered:
    """A sequence of (time_s, pose), made when they are asked for: pose n of n alone, and nothing is held.

    A subclass is a frozen dataclass that has `_length`, `_time_s` and `_pose`.
    """

    def __post_init__(self):
        for field in dataclasses.fields(self):
            allowed = field.metadata.get("allowed")
            if allowed is not None:
                value = allowed.check(f"{self.name()}: {field.name}", getattr(self, field.name))
                object.__setattr__(self, field.name, value)

    @classmethod
    def name(cls) -> str:
        """What it is called in a job and in messages: its class in lower case.

        >>> Numbered.name()
        'numbered'
        """
        return "".join("_" * (i > 0) + c.lower() if c.isupper() else c for i, c in enumerate(cls.__name__))

    def __len__(self):
        return self._length()

    def __getitem__(self, n) -> tuple[float, np.ndarray]:
        n, size = operator.index(n), len(self)
        if not -size <= n < size:
            raise IndexError(f"{self.name()} has pings 0..{size - 1} (got {n})")
        n %= size
        return float(self._time_s(n)), self._pose(n)

    @property
    def times_s(self) -> np.ndarray:
        """(N,) float64, when each ping leaves, seconds; made anew each time."""
        return np.asarray(self._time_s(np.arange(len(self))), np.float64)

    def _length(self) -> int:
        raise NotImplementedError

    def _time_s(self, n):
        """Seconds of a number or of an array of them."""
        raise NotImplementedError

    def _pose(self, n: int) -> np.ndarray:
        raise NotImplementedError
