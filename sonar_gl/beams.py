"""How the arrays of a sonar hear and sound: the patterns that the settings of `Acoustics` ask for."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from sonar_gl.patterns import Lobe, gaussian_pattern, line_array_pattern
from sonar_gl.types import Error

# Of smooth patterns: the main lobe counts up and down as far as the echo there, both ways, is above this; and
# so much of a Gaussian beam counts in azimuth, one way.
ELEVATION_LEVEL, GAUSSIAN_LEVEL = 1e-3, 1e-4
MAX_ELEVATION_DEG = 85.0  # above the boresight: further up a perspective view cannot look
MAX_STEER_DEG = 80.0  # of a straight array: nearer to its line a beam has no −3 dB edge on the far side


class Beams:
    """The part of `Acoustics` that knows of directions; it reads the settings there."""

    def beam_pattern_function(self, sonar):
        """Function (azimuth_rad, steer_azimuth_rad) -> linear power, 1 on the axis; None for a box.

        Raises
        ------
        Error
            if a straight array is to be steered along its own line.
        """
        if self.beam_pattern == "box":
            return None
        settings = {"beam_width_rad": math.radians(sonar.beam_width_deg), "steered": self.steered}
        steer_deg = float(np.degrees(np.abs(sonar.azimuth_rad).max()))
        if self.steered == "straight" and steer_deg > MAX_STEER_DEG:
            raise Error(
                f'acoustics: steered "straight" needs beams within ±{MAX_STEER_DEG:g}° of the boresight '
                f'(got {steer_deg:.4g}°: one array cannot hear along its own line; take "alike")'
            )
        if self.beam_pattern == "gaussian":
            return partial(gaussian_pattern, **settings)
        return partial(line_array_pattern, taper=self.taper, side_lobe_db=self.side_lobe_db, **settings)

    def beam_reach_rad(self, sonar) -> float:
        """How far from its axis a beam hears, radians: half a box, a line array to its 4th null or so."""
        half = math.radians(sonar.beam_width_deg) / 2
        if self.beam_pattern == "box":
            return half
        lobe = Lobe(self.beam_pattern, 2 * half, self.taper, self.side_lobe_db)
        gaussian = self.beam_pattern == "gaussian"
        sine = lobe.sine_at(GAUSSIAN_LEVEL) if gaussian else lobe.last_null()
        reach = math.asin(min(1.0, sine))
        if self.steered == "straight":  # furthest of the outermost beam, away from the boresight
            steer = float(np.abs(sonar.azimuth_rad).max())
            reach = max(reach, math.asin(min(1.0, math.sin(steer) + sine)) - steer)
        return reach

    def transmit_function(self, sonar):
        """Function (azimuth_rad) -> linear power of the projector, 1 on the boresight; None if even."""
        if self.transmit_width_deg is None:
            return None
        width = math.radians(self.transmit_width_deg)
        settings = {"taper": self.transmit_taper, "side_lobe_db": self.side_lobe_db}
        return partial(line_array_pattern, steer_azimuth_rad=0.0, beam_width_rad=width, **settings)

    def _elevation_lobe(self, sonar) -> Lobe:
        width = math.radians(sonar.elevation_fov_deg)
        return Lobe(self.elevation_pattern, width, self.elevation_taper, self.side_lobe_db, both_ways=True)

    def elevation_function(self, sonar):
        """Function (sine of elevation) -> linear power both ways, 1 on the boresight; None for a box.

        Transmitter and receiver are alike, upright, and not steered.
        """
        if self.elevation_pattern == "box":
            return None
        lobe = self._elevation_lobe(sonar)
        return lambda sine: lobe.power(sine) ** 2

    def elevation_reach_deg(self, sonar) -> float:
        """How far above and below the boresight anything is heard, degrees."""
        half = sonar.elevation_fov_deg / 2
        if self.elevation_pattern == "box":
            return half
        sine = self._elevation_lobe(sonar).sine_at(math.sqrt(ELEVATION_LEVEL))
        return max(half, min(math.degrees(math.asin(min(sine, 1.0))), MAX_ELEVATION_DEG))
