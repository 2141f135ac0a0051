"""Ring-down: the transducer rings on after the pulse, while the receiver listens already."""

from __future__ import annotations

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.noise.reception import MAX_POWER
from sonar_gl.sonar.sonar import Sonar


def ring_down_power(range_m, sonar: Sonar | None, acoustics: Acoustics | None) -> np.ndarray | None:
    """Return the power of the ring-down in each bin after the TVG; None of a sonar that does not state one.

    An oscillation that is damped evenly decays exponentially in time, by so many dB per metre of range. All elements
    ring alike, and so do all beams. The power is added to that of the echo.

    Returns (K,) float64, linear power, at most MAX_POWER.

    range_m : (K,) ranges that the sonar shows, metres
    sonar : None if unknown
    acoustics : None if unknown; then there is no TVG

    >>> from sonar_gl.sonar.sonar_files import load_sonar
    >>> sonar = load_sonar("p900-45,ring_down_db=20,ring_down_decay_db_m=100")
    >>> ring_down_power(np.array([0.2, 0.5]), sonar, Acoustics.ideal()).round(12).tolist()
    [1.0, 0.001]
    """
    if sonar is None or sonar.ring_down_db is None:
        return None
    r = np.asarray(range_m, np.float64)
    power = 10 ** (np.clip(sonar.ring_down_db - sonar.ring_down_decay_db_m * r, -300, 300) / 10)
    if acoustics is not None:
        power *= acoustics.tvg(r, sonar)
    return np.minimum(power, MAX_POWER)
