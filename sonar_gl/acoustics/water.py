"""Absorption and speed of sound in sea water."""

from __future__ import annotations

import numpy as np

from sonar_gl.core.extras import missing_extra

LATITUDE_DEG = (
    45.0  # for pressure from depth; at 1 km the speed at the poles or the equator differs by 0.05 m/s
)


def absorption_francois_garrison(frequency_hz, temperature_c, salinity_psu, depth_m, ph):
    """Return the absorption of sound in sea water by Francois and Garrison, dB per metre, one way, float64.

    It is the sum of three terms: boric acid, magnesium sulphate and pure water. All arguments broadcast.

    Parameters
    ----------
    frequency_hz : hertz; the fit covers 200 Hz to 1 MHz, above which pure water (f²) dominates
    temperature_c : °C
    salinity_psu : practical salinity
    depth_m : metres below the surface
    ph : pH

    Source: Francois, Garrison, "Sound absorption based on ocean measurements. Part II: Boric acid
    contribution and equation for total absorption", J. Acoust. Soc. Am. 72, 1879-1890, 1982

    >>> round(float(absorption_francois_garrison(900e3, 10.0, 35.0, 0.0, 8.0)), 6)
    0.299463
    """
    f, t, s, d = (np.asarray(x, np.float64) for x in (frequency_hz, temperature_c, salinity_psu, depth_m))
    f = f / 1e3  # the paper's kHz
    c, kelvin = 1412 + 3.21 * t + 1.19 * s + 0.0167 * d, 273 + t
    a1 = 8.86 / c * 10 ** (0.78 * np.asarray(ph, np.float64) - 5)
    f1 = 2.8 * np.sqrt(s / 35) * 10 ** (4 - 1245 / kelvin)
    a2, p2 = 21.44 * s / c * (1 + 0.025 * t), 1 - 1.37e-4 * d + 6.2e-9 * d**2
    f2 = 8.17 * 10 ** (8 - 1990 / kelvin) / (1 + 0.0018 * (s - 35))
    cold = 4.937e-4 - 2.59e-5 * t + 9.11e-7 * t**2 - 1.50e-8 * t**3
    warm = 3.964e-4 - 1.146e-5 * t + 1.45e-7 * t**2 - 6.5e-10 * t**3
    a3, p3 = np.where(t <= 20, cold, warm), 1 - 3.83e-5 * d + 4.9e-10 * d**2
    db_km = a1 * f1 * f**2 / (f1**2 + f**2) + a2 * p2 * f2 * f**2 / (f2**2 + f**2) + a3 * p3 * f**2
    return db_km / 1e3


def absorption_ainslie_mccolm(frequency_hz, temperature_c, salinity_psu, depth_m, ph):
    """Return the absorption of sound in sea water by Ainslie and McColm, dB per metre, one way, float64.

    It is simpler than `absorption_francois_garrison` and within 10 % of it. All arguments broadcast.

    Parameters
    ----------
    frequency_hz : hertz, 100 Hz to 1 MHz
    temperature_c : °C
    salinity_psu : practical salinity
    depth_m : metres below the surface
    ph : pH

    Source: Ainslie, McColm, "A simplified formula for viscous and chemical absorption in sea water",
    J. Acoust. Soc. Am. 103, 1671-1672, 1998

    >>> round(float(absorption_ainslie_mccolm(900e3, 10.0, 35.0, 0.0, 8.0)), 6)
    0.322309
    """
    f, t, s, z = (np.asarray(x, np.float64) for x in (frequency_hz, temperature_c, salinity_psu, depth_m))
    f, z = f / 1e3, z / 1e3  # the paper's kHz and km
    f1, f2 = 0.78 * np.sqrt(s / 35) * np.exp(t / 26), 42 * np.exp(t / 17)
    boric = 0.106 * f1 * f**2 / (f1**2 + f**2) * np.exp((np.asarray(ph, np.float64) - 8) / 0.56)
    magnesium = 0.52 * (1 + t / 43) * (s / 35) * f2 * f**2 / (f2**2 + f**2) * np.exp(-z / 6)
    return (boric + magnesium + 0.00049 * f**2 * np.exp(-(t / 27 + z / 17))) / 1e3


def sound_speed_mackenzie(temperature_c, salinity_psu, depth_m):
    """Return the speed of sound in sea water by Mackenzie, metres per second, float64. All arguments broadcast.

    Parameters
    ----------
    temperature_c : °C, −2..30
    salinity_psu : practical salinity, 25..40
    depth_m : metres below the surface, 0..8000

    Source: Mackenzie, "Nine-term equation for sound speed in the oceans", J. Acoust. Soc. Am. 70,
    807-812, 1981

    >>> round(float(sound_speed_mackenzie(25.0, 35.0, 1000.0)), 3)
    1550.744
    """
    t, s, d = (np.asarray(x, np.float64) for x in (temperature_c, salinity_psu, depth_m))
    warmth = 1448.96 + 4.591 * t - 5.304e-2 * t**2 + 2.374e-4 * t**3
    salt = 1.340 * (s - 35) - 1.025e-2 * t * (s - 35)
    return warmth + salt + 1.630e-2 * d + 1.675e-7 * d**2 - 7.139e-13 * t * d**3


def sound_speed_teos10(temperature_c, salinity_psu, depth_m):
    """Return the speed of sound in sea water by the equation of state TEOS-10, metres per second, float64.

    The water has the composition of the reference ocean and lies at 45° of latitude. All arguments broadcast.

    Parameters
    ----------
    temperature_c : in-situ temperature, °C
    salinity_psu : practical salinity, 0..42
    depth_m : metres below the surface

    Raises
    ------
    Error
        if gsw is not installed.

    Source: IOC, SCOR, IAPSO, "The international thermodynamic equation of seawater - 2010", 2010; computed by
    the Gibbs SeaWater toolbox

    >>> round(float(sound_speed_teos10(10.0, 35.0, 10.0)), 2)
    1489.98
    """
    try:
        import gsw
    except ImportError:
        why = 'sound_speed_formula "teos10" needs gsw, "mackenzie" does not (got no module gsw)'
        raise missing_extra("teos10", why) from None
    t, s, d = (np.asarray(x, np.float64) for x in (temperature_c, salinity_psu, depth_m))
    pressure, salinity = gsw.p_from_z(-d, LATITUDE_DEG), gsw.SR_from_SP(s)
    return gsw.sound_speed(salinity, gsw.CT_from_t(salinity, t, pressure), pressure)


ABSORPTION_FORMULAS = {
    "francois_garrison": absorption_francois_garrison,
    "ainslie_mccolm": absorption_ainslie_mccolm,
}
SOUND_SPEED_FORMULAS = {"mackenzie": sound_speed_mackenzie, "teos10": sound_speed_teos10}
