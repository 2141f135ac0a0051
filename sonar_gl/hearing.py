"""How a sonar hears its samples, whoever drew them: the fan, the sums, the gain."""

from __future__ import annotations

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.fan import Fan, Sampling, beam_weights, make_fan, up_to
from sonar_gl.lattice import SHEAR
from sonar_gl.reduce import Reducer
from sonar_gl.sonar import Sonar


class Hearing:
    """The sums over the samples of a fan; owns what every ping uses again.

    Attributes
    ----------
    sampling, fan, reducer
    gain : (K,) float32, of each bin
    box : beams are boxes, which end where columns end
    """

    def __init__(
        self, sonar: Sonar, acoustics: Acoustics, sampling: Sampling, shear=SHEAR, widest: float = 0.5
    ):
        reach, pattern = acoustics.beam_reach_rad(sonar), acoustics.beam_pattern_function(sonar)
        drawn, heard = acoustics.drawn_sonar(sonar), acoustics.elevation_function(sonar)
        self.sampling, self.box = sampling, pattern is None
        self.fan: Fan = make_fan(drawn, up_to(sampling, sonar, drawn), reach, self.box, shear, widest)
        weights = beam_weights(self.fan, pattern, reach, acoustics.transmit_function(sonar), heard)
        self.reducer = Reducer(self.fan, *weights, heard)
        self.gain = acoustics.gain(sonar.range_m, sonar).astype(np.float32)

    def intensity(self, views) -> np.ndarray:
        """(B, K) float32 with the gain, of (sector, (R, C, 4) plane and echo, (R, C) body) of each sector."""
        return self.reducer.intensity(views, self.gain)
