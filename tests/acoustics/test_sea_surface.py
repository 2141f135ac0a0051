"""The height of waves under wind, and the backscatter of the sea surface."""

import math

import numpy as np
import pytest

from sonar_gl.acoustics.sea_surface import rms_wave_height_m, surface_backscattering


@pytest.mark.parametrize(("wind_m_s", "drag"), [(5.0, 1.2e-3), (10.0, 1.2e-3), (20.0, 1.79e-3)])
def test_waves_have_the_height_of_the_spectrum_of_pierson_and_moskowitz(wind_m_s, drag):
    """Their wind is that at 19.5 m, ours at 10 m: a logarithmic profile, with drag coefficients of Large and Pond."""
    wind_19_5_m_s = wind_m_s * (1 + math.sqrt(drag) / 0.4 * math.log(19.5 / 10))
    w = np.geomspace(0.2, 50, 20_001) * 9.81 / wind_19_5_m_s
    spectrum = 8.1e-3 * 9.81**2 / w**5 * np.exp(-0.74 * (9.81 / wind_19_5_m_s / w) ** 4)
    variance = ((spectrum[1:] + spectrum[:-1]) / 2 * np.diff(w)).sum()
    # 0.21 for 0.2093, and 1.06 for 1.058 to 1.071, squared
    assert rms_wave_height_m(wind_m_s) == pytest.approx(math.sqrt(variance), rel=0.021)


def handbook_strength(grazing_deg, frequency_khz, wind_m_s):
    """Return the cross section by the formulas of APL-UW TR 9407, ch. II.C, one after the other."""
    g, u, f = math.radians(grazing_deg), wind_m_s, frequency_khz
    s2 = 4.6e-3 * math.log(2.1 * u * u)

    def facets(off_vertical):
        return (
            math.exp(-(math.tan(off_vertical) ** 2) / s2) / math.cos(off_vertical) ** 4 / (4 * math.pi * s2)
        )

    # the angle from the vertical at which facets return 15 dB less: they fall evenly to beyond it
    low, high = 0.0, math.radians(45)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if facets(middle) > facets(0.0) / 10**1.5 else (low, middle)
    composite = 1.3e-5 * u * math.tan(g) ** 4 if grazing_deg <= 85 else 0.0
    share = 1 / (1 + math.exp(0.524 * (90 - math.degrees(low) - grazing_deg)))
    calm = u**1.57 if u >= 6 else 6**1.57 * math.exp(1.2 * (u - 6))
    loss_db = 1.26e-3 / math.sin(g) * calm * f**0.85
    waves = (share * facets(math.pi / 2 - g) + (1 - share) * composite) * 10 ** (-loss_db / 10)
    depth = 10 ** (-5.2577 + 0.4701 * u) if u <= 11 else 10 ** (-5.2577 + 0.4701 * 11) * (u / 11) ** 3.5
    depth *= (f / 25) ** 0.85
    b = depth / math.sin(g)
    damping = 2.55e-2 * f ** (1 / 3)
    bubbles = depth * 0.0136 / (4 * math.pi * damping)
    return waves + bubbles * (1 + 8 * b * math.exp(-2 * b) - math.exp(-4 * b)) / (2 * b)


@pytest.mark.parametrize("wind_m_s", [1.0, 4.0, 7.0, 11.0, 13.0, 25.0])
@pytest.mark.parametrize("frequency_khz", [20.0, 100.0, 900.0])
def test_the_backscatter_is_that_of_the_handbook(wind_m_s, frequency_khz):
    """Calm and rough seas; grazing angles of bubbles, of composite roughness and of facets, and between these."""
    grazing_deg = np.array([0.5, 2, 5, 10, 30, 50, 60, 65, 70, 75, 80, 83, 85, 86, 90])
    found = surface_backscattering(np.radians(grazing_deg), 1e3 * frequency_khz, wind_m_s)
    wanted = [handbook_strength(one, frequency_khz, wind_m_s) for one in grazing_deg]
    # eight steps to the angle of the blend leave 1e-10 of the echo
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
