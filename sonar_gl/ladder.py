"""The ladder of samplings that a tolerance is sought on."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.fan import Sampling, rung_sampling
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error

COARSEST_DEG, STEPS_PER_HALF = 1.0, 4  # of the ladder: so many rungs halve a sample's width
FINEST_RUNG = 40  # or where the driver's limits are
ERROR_RATE = 1.3  # the error falls as the width of samples to this power


def check_tolerance(tolerance) -> float:
    """The tolerance.

    Raises
    ------
    Error
        if it lies outside 0.001..0.5.
    """
    number = isinstance(tolerance, (int, float, np.number)) and not isinstance(tolerance, bool)
    if not (number and 0.001 <= tolerance <= 0.5):
        raise Error(f"tolerance must be a number in 0.001..0.5 (got {tolerance!r}; 0.01 is one per cent)")
    return float(tolerance)


def sampling_of(sonar: Sonar, rung: int) -> Sampling:
    """The ladder's rung."""
    return rung_sampling(sonar, COARSEST_DEG * 2 ** (-rung / STEPS_PER_HALF))


def guess_of(tolerance: float) -> int:
    """The rung that most scenes need."""
    finer = COARSEST_DEG / 0.2 * (0.02 / tolerance) ** (1 / ERROR_RATE)
    return min(max(0, round(STEPS_PER_HALF * math.log2(finer))), FINEST_RUNG)
