"""The ranges that the page offers for a sonar."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.outline import round_step
from sonar_gl.sonar.sonar import Sonar

# Greatest range on offer over the sonar's own, where it has no limit: the mean of the presets is 3.2
UNKNOWN_LIMIT_FACTOR = 4.0
STEPS = 200  # of the slider, about


@dataclass(frozen=True)
class RangeScale:
    """The slider of the range.

    Attributes
    ----------
    low_m, high_m, step_m : bounds and step, metres
    shown_m : the range that is set, metres, with no more decimals than the slider shows
    decimals : that the slider shows
    """

    low_m: float
    high_m: float
    step_m: float
    shown_m: float
    decimals: int

    @classmethod
    def of(cls, settings: LiveSettings) -> RangeScale:
        """Return the slider of some settings: to the limit of the sonar, or as far as it is set if that is more.

        >>> RangeScale.of(LiveSettings("p900-45")).high_m
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
        return cls(low_m, max(high_m, shown_m, low_m + step_m), step_m, shown_m, decimals)


def allowed_range_m(sonar: Sonar, range_m: float) -> float:
    """Return a range if a sonar allows it, else its limit, or its own range for one that is too near, metres.

    >>> from sonar_gl.sonar.sonar import load_sonar
    >>> allowed_range_m(load_sonar("aris-3000"), 30.0), allowed_range_m(load_sonar("p900-45"), 30.0)
    (5.0, 30.0)
    """
    if range_m <= sonar.range_min_m:  # too near for a bin
        return sonar.range_max_m
    return range_m if sonar.range_limit_m is None else min(range_m, sonar.range_limit_m)
