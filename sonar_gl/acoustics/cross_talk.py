"""Cross-talk: beams that are received together receive some of each other's echoes."""

from __future__ import annotations

import numpy as np


def leak_between_beams(intensity: np.ndarray, level_db: float, spacing: int) -> np.ndarray:
    """Return the intensity with cross-talk between the beams of each set.

    A sonar with fewer receiver channels than beams takes several transmissions for a frame, and receives in each of
    them a set of beams that are `spacing` apart. A beam receives the share κ of the echo in each other beam
    of its set, at the same range. Powers add: the paths have no common phase. The result is divided by
    1 + (m − 1) κ, where a set has m beams, so that an even echo keeps its level and each bin the sum over its beams.

    Returns (B, K) float32, linear power.

    intensity : (B, K) float32, linear power, mean of the speckle
    level_db : 10 log10 κ, not above 0
    spacing : beams from one beam of a set to the next, 1 or more

    Source: Sound Metrics on DIDSON: 12 channels, 96 beams in 8 transmissions; an echo in one beam shows in every 8th
    (pvazteixeira/sonar-denoising, cpsf.m, 2014); Sound Metrics, ARIS Integration SDK, PingMode: 48, 64, 96 and 128
    beams in 3, 4, 6 and 8 transmissions

    >>> leak_between_beams(np.float32([[3], [0], [0], [0], [0]]), 10 * np.log10(0.25), 2).ravel().tolist()
    [2.0, 0.0, 0.5, 0.0, 0.5]
    """
    share, out = 10 ** (level_db / 10), intensity.copy()
    for first in range(max(len(intensity) - spacing, 0))[:spacing]:  # the sets of more than one beam
        beams = intensity[first::spacing]
        leak = np.float32(share / (1 + (len(beams) - 1) * share))
        own = np.float32((1 - share) / (1 + (len(beams) - 1) * share))
        out[first::spacing] *= own
        out[first::spacing] += leak * beams.sum(axis=0)
    return out
