"""The numbers that a slider of the page offers."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sonar_gl.core.checks import check_number

MAX_DECIMALS = 4  # of numbers between the steps


@dataclass(frozen=True)
class NumberScale:
    """A slider, and the field beside it, into which any number may be typed.

    Attributes
    ----------
    label : "name, unit", or a name that says its unit
    low, high, step : ends and step, in the unit of the label
    decimals : of the numbers on show
    """

    label: str
    low: float
    high: float
    step: float
    decimals: int

    def holding(self, value: float) -> NumberScale:
        """Return a scale that shows a number in force as it is: a command line or a script may set any.

        >>> scale = NumberScale("tolerance, %", 0.5, 20.0, 0.5, 1)
        >>> scale.holding(5.0) == scale, scale.holding(50.0).high, scale.holding(0.25).decimals
        (True, 50.0, 2)
        """
        decimals = self.decimals
        while decimals < MAX_DECIMALS and round(value, decimals) != value:
            decimals += 1
        return replace(self, low=min(self.low, value), high=max(self.high, value), decimals=decimals)

    def check(self, value) -> float:
        """Return a number that a browser has sent; Error beyond the ends.

        >>> NumberScale("tolerance, %", 0.5, 20.0, 0.5, 1).check(50)
        Traceback (most recent call last):
            ...
        sonar_gl.core.errors.Error: tolerance must lie in 0.5..20 (got 50; give %)
        """
        name, _, unit = self.label.partition(", ")
        return check_number(name, value, self.low, self.high, f"give {unit}" if unit else "")
