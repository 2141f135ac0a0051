"""The sea surface under wind: its backscatter by waves and by bubbles below them, and the height of its waves.

Source of the backscatter: APL-UW, High-Frequency Ocean Environmental Acoustic Models Handbook, TR 9407, 1994, ch. II.
The handbook is for 10 to 100 kHz; above, its formulas are extrapolated. Their bubbles resonate. If at 1 MHz bubbles
that are large against the wavelength prevailed, which scatter 1 / 8π of what they extinguish, a dense layer of them
would return −17 dB + 10 log sin g, 10 dB more than here.
"""

from __future__ import annotations

import math

import numpy as np

STEEPEST_COMPOSITE_RAD = math.radians(85.0)  # beyond, facets alone scatter
FACETS_END_DB = 15.0  # below the level at vertical incidence, where composite roughness takes over
BLEND_PER_DEG = 0.524  # rate of the change from one to the other
AT_19_5_M = 1.06  # the wind 19.5 m above the sea over that at 10 m


def rms_wave_height_m(wind_speed_m_s: float) -> float:
    """Return the rms height of the waves of a fully developed sea, metres.

    A quarter of the significant wave height 0.21 V² / g, where V is the wind 19.5 m above the sea.

    Parameters
    ----------
    wind_speed_m_s : U, 10 m above the sea

    Notes
    -----
    V = 1.06 U, by the logarithmic profile of neutral air, V / U = 1 + √C ln(19.5 / 10) / 0.4, with the drag coefficient
    C = 1.2e-3 of 4 to 11 m/s; it is 1.07 at 20 m/s. The often quoted 1.026 results with the decimal logarithm.

    Source: Pierson, Moskowitz, "A proposed spectral form for fully developed wind seas", J. Geophys. Res. 69,
    5181-5190, 1964; Large, Pond, "Open ocean momentum flux measurements in moderate to strong winds", J. Phys.
    Oceanogr. 11, 324-336, 1981 (drag coefficient)

    >>> round(rms_wave_height_m(10.0), 2)  # a significant height of 2.4 m
    0.6
    """
    return 0.21 * (AT_19_5_M * wind_speed_m_s) ** 2 / 9.81 / 4


def facet_slope_variance(wind_speed_m_s: float) -> float:
    """Return s² = 0.0046 ln(2.1 U²), twice the variance of the facets' slopes along one direction; U at least 1 m/s.

    >>> round(facet_slope_variance(10.0), 4)
    0.0246
    """
    return 4.6e-3 * math.log(2.1 * max(wind_speed_m_s, 1.0) ** 2)


def facet_backscattering(grazing_rad, wind_speed_m_s: float):
    """Return the cross section of waves without bubbles per area and steradian: facets, and composite roughness.

    grazing_rad : g, radians, 0..π/2; an array of any shape
    wind_speed_m_s : U, 10 m above the sea

    Facets: sec⁴γ / 4πs² · exp(−tan² γ / s²), γ = 90° − g. Composite roughness: 1.3e-5 U tan⁴ g, up to g = 85°. They are
    blended about the angle at which facets return 15 dB less than at γ = 0.

    >>> round(float(10 * np.log10(facet_backscattering(np.pi / 2, 10.0))), 1)
    5.1
    """
    g = np.asarray(grazing_rad, np.float64)
    s2 = facet_slope_variance(wind_speed_m_s)
    with np.errstate(divide="ignore", over="ignore"):
        tan2 = np.tan(math.pi / 2 - g) ** 2
        facets = (1 + tan2) ** 2 / (4 * math.pi * s2) * np.exp(-tan2 / s2)
    facets = np.where(tan2 > 700 * s2, 0.0, facets)  # at the horizon: infinity times 0
    composite = 1.3e-5 * wind_speed_m_s * np.tan(np.minimum(g, STEEPEST_COMPOSITE_RAD)) ** 4
    composite = np.where(g <= STEEPEST_COMPOSITE_RAD, composite, 0.0)
    end = s2
    for _ in range(8):  # (1 + end)² exp(−end / s²) = −15 dB; a step leaves less than a tenth of the error
        end = s2 * (FACETS_END_DB / 10 * math.log(10) + 2 * math.log1p(end))
    beyond_deg = np.degrees(math.pi / 2 - math.atan(math.sqrt(end)) - g)
    share = 1 / (1 + np.exp(BLEND_PER_DEG * beyond_deg))
    return share * facets + (1 - share) * composite


def bubble_loss_db(grazing_rad, frequency_hz: float, wind_speed_m_s: float):
    """Return what bubbles absorb of sound on its way to the surface and back from it, dB.

    1.26e-3 / sin g · U^1.57 f^0.85, f in kHz; below 6 m/s the value there, less by the factor exp(1.2 (U − 6))
    (eqs. 28a and 28b, page II-21).

    grazing_rad : g, radians, above 0..π/2; an array of any shape
    frequency_hz : f, hertz
    wind_speed_m_s : U

    >>> round(float(bubble_loss_db(np.pi / 2, 25e3, 10.0)), 2)
    0.72
    """
    fall = math.exp(1.2 * min(wind_speed_m_s - 6.0, 0.0))
    wind = max(wind_speed_m_s, 6.0) ** 1.57 * fall
    return 1.26e-3 / np.sin(grazing_rad) * wind * (frequency_hz / 1e3) ** 0.85


def bubble_layer_backscattering(grazing_rad, frequency_hz: float, wind_speed_m_s: float):
    """Return the cross section of the bubbles below the surface per area and steradian.

    grazing_rad : g, radians, above 0..π/2; an array of any shape
    frequency_hz : f, hertz
    wind_speed_m_s : U

    δ_r sin g / 8πδ · (1 + 8β exp(−2β) − exp(−4β)), β = β_v / sin g: direct and by way of the surface, in a layer
    that attenuates. β_v = 10^(0.4701 U − 5.2577) (f / 25 kHz)^0.85 is its depth-integrated extinction, up to
    11 m/s, and rises as U^3.5 from there. δ_r = 0.0136 and δ = 0.0255 f^(1/3), f in kHz, are the damping of
    resonant bubbles by radiation and in all. A dense layer returns δ_r sin g / 8πδ whatever the wind.

    >>> dense = bubble_layer_backscattering(np.pi / 6, 1e6, 15.0)
    >>> round(float(dense / (0.0136 * 0.5 / (8 * np.pi * 0.255))), 9)
    1.0
    >>> grazing = np.radians(10.0)  # at 900 kHz the layer is dense from a wind of 8 m/s on
    >>> [round(float(10 * np.log10(bubble_layer_backscattering(grazing, 900e3, u))), 1) for u in (4, 5, 8, 15)]
    [-36.8, -32.9, -34.1, -34.2]
    """
    sine, f = np.sin(grazing_rad), frequency_hz / 1e3
    extinction = 10 ** (0.4701 * min(wind_speed_m_s, 11.0) - 5.2577) * (f / 25) ** 0.85
    extinction *= max(wind_speed_m_s / 11.0, 1.0) ** 3.5
    beta = extinction / sine
    paths = 1 + 8 * beta * np.exp(-2 * beta) - np.exp(-4 * beta)
    return 0.0136 / (2.55e-2 * f ** (1 / 3)) * sine / (8 * math.pi) * paths


def surface_backscattering(grazing_rad, frequency_hz: float, wind_speed_m_s: float):
    """Return the backscattering cross section of the sea surface per area and steradian, seen from below.

    Returns linear, of the shape of `grazing_rad`; 10 log of it is S_s, the surface backscattering strength.

    grazing_rad : g, radians, above 0..π/2; an array of any shape
    frequency_hz : f, hertz; fitted at 10 to 100 kHz
    wind_speed_m_s : U, 10 m above the sea

    >>> grazing = np.radians([10.0, 30.0, 90.0])
    >>> (10 * np.log10(surface_backscattering(grazing, 100e3, 7.0))).round(1).tolist()
    [-28.9, -27.7, 4.4]
    """
    passed = 10 ** (-bubble_loss_db(grazing_rad, frequency_hz, wind_speed_m_s) / 10)
    waves = facet_backscattering(grazing_rad, wind_speed_m_s) * passed
    return waves + bubble_layer_backscattering(grazing_rad, frequency_hz, wind_speed_m_s)
