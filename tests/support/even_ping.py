"""Pings of a constant echo, to measure the statistics of noise on."""

import numpy as np

from sonar_gl import Ping, Sonar, Water
from tests.support.settings import described

FREQUENCY_HZ, SOUND_SPEED_M_S, BIN_M, RANGE_MIN_M = 900e3, 1500.0, 0.0125, 1.0
BEAM_WIDTH_RAD = np.radians(1.0)
UNIFORM_WIDTH = 0.885892941379  # −3 dB width of a uniform line array in λ/L: twice the x of sinc²(x) = 1/2
HAMMING_SERIES = (0.23 / 0.54,)
WATER = Water(sound_speed_m_s=SOUND_SPEED_M_S)
SIGMAS = 5.0  # a tolerance of 5 standard errors fails by chance once in 1.7 million


def even_ping(n_beams=64, n_bins=256, spacing_deg=0.25, level=1.0, pose=None, **settings) -> Ping:
    """Return a ping whose intensity is `level` in each bin.

    Beams are 1 degree wide, `spacing_deg` apart, or evenly spread over the circle if that is too small for
    them. `settings` are fields of `Sonar`, and of `Acoustics` that differ from those of profile ideal in water of
    1500 m/s.
    """
    range_max_m = RANGE_MIN_M + BIN_M * n_bins
    fan_deg = min(360.0, n_beams * spacing_deg)
    sonar = Sonar("even", FREQUENCY_HZ, n_beams, n_bins, fan_deg, 20.0, 1.0, RANGE_MIN_M, range_max_m)
    sonar, acoustics = described(sonar, **{"profile": "ideal", "water": WATER} | settings)
    intensity = np.full((n_beams, n_bins), level, np.float32)
    return Ping(intensity, sonar.azimuth_rad, sonar.range_m, pose=pose, sonar=sonar, acoustics=acoustics)


def correlation(a, b) -> float:
    """Return the correlation coefficient of two arrays of one shape."""
    return float(np.corrcoef(np.ravel(a), np.ravel(b))[0, 1])


def hamming_correlation(x):
    """Return the Fourier transform of a squared Hamming taper, 1 at x = 0."""
    (f,) = HAMMING_SERIES
    near, far = (np.sinc(x - m) + np.sinc(x + m) for m in (1, 2))
    return ((1 + 2 * f * f) * np.sinc(x) + 2 * f * near + f * f * far) / (1 + 2 * f * f)
