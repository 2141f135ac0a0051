"""The height of waves under wind."""

import math

import numpy as np
import pytest

from sonar_gl.acoustics.sea_surface import rms_wave_height_m


@pytest.mark.parametrize(("wind_m_s", "drag"), [(5.0, 1.2e-3), (10.0, 1.2e-3), (20.0, 1.79e-3)])
def test_waves_have_the_height_of_the_spectrum_of_pierson_and_moskowitz(wind_m_s, drag):
    """Their wind is that at 19.5 m, ours at 10 m: a logarithmic profile, with drag coefficients of Large and Pond."""
    wind_19_5_m_s = wind_m_s * (1 + math.sqrt(drag) / 0.4 * math.log(19.5 / 10))
    w = np.geomspace(0.2, 50, 20_001) * 9.81 / wind_19_5_m_s
    spectrum = 8.1e-3 * 9.81**2 / w**5 * np.exp(-0.74 * (9.81 / wind_19_5_m_s / w) ** 4)
    variance = ((spectrum[1:] + spectrum[:-1]) / 2 * np.diff(w)).sum()
    # 0.21 for 0.2093, and 1.06 for 1.058 to 1.071, squared
    assert rms_wave_height_m(wind_m_s) == pytest.approx(math.sqrt(variance), rel=0.021)
