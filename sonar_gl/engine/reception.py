"""From where a sonar receives an echo, and how strongly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.beamformer import Beamformer
from sonar_gl.beamform.kernels.body_counts import ReceivedParts
from sonar_gl.sonar.sonar import Sonar


class Reception(NamedTuple):
    """From where a sonar receives an echo, and how strongly, by its range and its elevation.

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


def reception_of(beamformer: Beamformer, reach_rad: float, gain: np.ndarray) -> Reception:
    """Return how a beamformer receives; reach_rad and gain as of `Reception`."""
    fan = beamformer.fan
    tables = beamformer.elevation_table, beamformer.received_parts
    return Reception(fan.sonar, reach_rad, fan.max_elevation_rad, fan.are_cones, gain, *tables)
