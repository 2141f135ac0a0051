"""The numbers that sliders of the page offer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from sonar_gl.core.checks import check_number
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.outline import round_step
from sonar_gl.sonar.sonar import Sonar

MAX_DECIMALS = 4  # of numbers between the steps
# Greatest range on offer over the sonar's own, where it has no limit: the mean of the presets is 3.2
UNKNOWN_LIMIT_FACTOR = 4.0
STEPS = 200  # of the slider, about


@dataclass(frozen=True)
class NumberScale:
    """A slider, and the field beside it, into which any number may be typed."""

    label: str  # "name, unit", or a name that says its unit
    # low, high, step: ends and step, in the unit of the label
    low: float
    high: float
    step: float
    decimals: int  # of the numbers on show

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


def range_scale(settings: LiveSettings) -> NumberScale:
    """Return the slider of the range: to the limit of the sonar, or as far as it is set if that is more.

    >>> range_scale(LiveSettings("p900-45")).high
    100.0
    """
    sonar, range_m = settings.sonar, settings.device.range_max_m
    limit_m = sonar.range_limit_m or UNKNOWN_LIMIT_FACTOR * sonar.range_max_m
    high_m = float(max(limit_m, range_m))
    step_m = round_step(high_m / STEPS)
    decimals = max(2, math.ceil(-math.log10(step_m)))
    # the least range must exceed the near edge of the first bin; 0.7 / 0.1 is less than 7 in floating point
    low_m = round(step_m * (math.floor(round(sonar.range_min_m / step_m, 6)) + 1), decimals)
    shown_m = round(float(range_m), decimals)
    low_m = min(low_m, shown_m)
    return NumberScale("range, m", low_m, max(high_m, shown_m, low_m + step_m), step_m, decimals)


def shown_range_m(settings: LiveSettings) -> float:
    """Return the range that is set, metres, with no more decimals than its slider shows."""
    return round(float(settings.device.range_max_m), range_scale(settings).decimals)


def allowed_range_m(sonar: Sonar, range_m: float) -> float:
    """Return a range if a sonar allows it, else its limit, or its own range for one that is too near, metres.

    >>> from sonar_gl.sonar.sonar_files import load_sonar
    >>> allowed_range_m(load_sonar("aris-3000"), 30.0), allowed_range_m(load_sonar("p900-45"), 30.0)
    (5.0, 30.0)
    """
    if range_m <= sonar.range_min_m:  # too near for a bin
        return sonar.range_max_m
    return range_m if sonar.range_limit_m is None else min(range_m, sonar.range_limit_m)
