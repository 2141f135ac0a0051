"""What error the difference of two echoes shows that were summed from more and from fewer samples."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.beamform.beamformer import BeamEcho
from sonar_gl.core.compiled import added_in_any_order
from sonar_gl.sonar.sampling import ERROR_RATE

ERROR_FACTOR = 1.4  # of the error that the difference shows: 19 of 20 lie below
# Errors in few bins, as of the outlines before a single beam, do not average out: their difference may be small by
# chance. With FEW_FACTOR half as many of them exceed the estimate, in random worlds one of 10 to 30 (docs/trials.md).
FEW_BINS, FEW_FACTOR = 16.0, 1.35


def wrong_share(echo: BeamEcho, before: BeamEcho, coarser: float, alike: float = 0.0) -> float:
    """Return a bound of the share of an echo in wrong bins, which 19 of 20 keep, by the difference from another one.

    before : of the same view, summed from fewer samples
    coarser : how many times fewer
    alike : share of the error, 0 to 1, that both have alike but for its size, rather than each its own
    """
    difference, squares = _sums_of_differences(echo.intensity, before.intensity)
    factor = (1 - alike) * ERROR_FACTOR * share_of_difference(coarser, ERROR_RATE / 2)
    if difference * difference < FEW_BINS * squares:  # as many bins of even differences would have as much
        factor *= FEW_FACTOR
    if alike:
        factor += alike / (coarser ** (ERROR_RATE / 2) - 1)
    return factor * float(difference / echo.total)


def share_of_difference(coarser: float, rate: float) -> float:
    """Return the error of n samples over their difference from n / coarser samples.

    The two err independently, and errors decrease as n^-rate.
    """
    return 1 / math.sqrt(1 + coarser ** (2 * rate))


@added_in_any_order
def _sums_of_differences(a, b):
    """Return Σ|a − b| and Σ(a − b)² of two float32 arrays of one shape, (B, K); NumPy would fill two more of them."""
    total, squares = 0.0, 0.0
    for j in range(a.shape[0]):
        for i in range(a.shape[1]):
            difference = np.float64(abs(a[j, i] - b[j, i]))
            total += difference
            squares += difference * difference
    return total, squares
