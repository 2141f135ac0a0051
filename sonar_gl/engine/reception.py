"""From where a sonar receives an echo, and how strongly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.beamformer import Beamformer
from sonar_gl.beamform.kernels.body_counts import ReceivedParts
from sonar_gl.sonar.sonar import Sonar


class Reception(NamedTuple):
    """From where a sonar receives an echo, and how strongly, by its range and its elevation.

    Attributes
    ----------
    sonar : with true ranges
    reach_rad : how far beyond their axes the outermost beams receive
    max_elevation_rad : beyond which nothing is received, side lobes included
    are_cones : of `Fan`
    gain : (K,) of the bins
    elevation_table, parts : of `Beamformer`, whose `received_parts` the parts are
    """

    sonar: Sonar
    reach_rad: float
    max_elevation_rad: float
    are_cones: bool
    gain: np.ndarray
    elevation_table: np.ndarray
    parts: ReceivedParts

    def greatest_gain(self, nearest_m, farthest_m) -> np.ndarray:
        """Return the greatest gain between ranges, (n,) metres, of which a part lies in the bins."""
        bins = (np.stack([nearest_m, farthest_m]) - self.sonar.range_min_m) / self.sonar.bin_size_m
        return _greatest(self.gain, *np.floor(bins))

    def greatest_pattern(self, low_sine, high_sine) -> np.ndarray:
        """Return the greatest two-way elevation pattern between sines of elevation, (n,)."""
        if not len(self.elevation_table):
            return np.ones(len(low_sine))
        per_sine = (len(self.elevation_table) - 1) / 2
        low, high = per_sine + per_sine * low_sine, per_sine + per_sine * high_sine
        return _greatest(self.elevation_table, np.floor(low), np.ceil(high))


def reception_of(beamformer: Beamformer, reach_rad: float, gain: np.ndarray) -> Reception:
    """Return how a beamformer receives; reach_rad and gain as of `Reception`."""
    fan = beamformer.fan
    tables = beamformer.elevation_table, beamformer.received_parts
    return Reception(fan.sonar, reach_rad, fan.max_elevation_rad, fan.are_cones, gain, *tables)


def _greatest(values, first, last) -> np.ndarray:
    """Return the greatest of some values within each span of places, (n,), both ends included."""
    first, last = (np.clip(places, 0, len(values) - 1).astype(np.int64) for places in (first, last))
    ends = np.stack([first, last + 1], axis=1).ravel()
    # a span may end with the last value: `reduceat` takes no end beyond it
    return np.maximum.reduceat(np.append(values, values[-1]), ends)[::2]
