"""The water, and formulas of its absorption and speed of sound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from sonar_gl.acoustics.sea_surface import rms_wave_height_m
from sonar_gl.core.checks import check_choice, check_fields, check_number, make_numbers_plain, shown
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_extra
from sonar_gl.core.key_values import parse_fields
from sonar_gl.core.warn import warn_caller

# For pressure from depth; at 1 km the speed at the poles or the equator differs by 0.05 m/s.
LATITUDE_DEG = 45.0
GREATEST_ABSORPTION_DB_M = 20.0  # that is no likely mistake: of sea water at 9 MHz


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

    It is simpler than `absorption_francois_garrison`, and within 10 % of it from 100 kHz to 3 MHz in water of −2 to
    30 °C, fresh to 40, down to 1 km. All arguments broadcast.

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
CHOICES = {  # field: allowed names
    "absorption_formula": tuple(ABSORPTION_FORMULAS),
    "sound_speed_formula": tuple(SOUND_SPEED_FORMULAS),
}
BOUNDS = (  # field, least and greatest value, hint for messages
    ("temperature_c", -2, 40, "give °C"),
    ("salinity_psu", 0, 45, "give grams of salt per kilogram of water"),
    ("depth_m", 0, 12000, "give metres below the surface, positive down"),
    ("ph", 7, 9, "sea water has about 8"),
    ("absorption_db_m", 0, 1e5, "give dB per metre one way, a thousandth of dB per km"),
    ("sound_speed_m_s", 1000, 2000, "give metres per second, about 1500 in water"),
    ("volume_backscatter_db", -200, 0, "give dB re 1/m, usual are -90 to -50"),
    ("scatterer_density_m3", 1e-6, 1e12, "give a number per cubic metre"),
    (
        "wind_speed_m_s",
        1,
        30,
        "give metres per second, 7 is a moderate breeze; leave it out for a calm surface",
    ),
)


@dataclass(frozen=True)
class Water:
    """The water between sonar and bodies: absorption α, speed of sound c, scatterers and waves, the same everywhere.

    Parameters
    ----------
    temperature_c, salinity_psu, depth_m, ph : float
        The properties from which α and c follow: °C, practical salinity, metres below the surface, 1.
    absorption_db_m : float or None
        α, dB per metre one way. None: by `absorption_formula` at the sonar's frequency.
    absorption_formula : "francois_garrison" or "ainslie_mccolm"
        Formula of α: Francois, Garrison 1982, or Ainslie, McColm 1998.
    sound_speed_formula : "mackenzie" or "teos10"
        Formula of c: Mackenzie 1981, or TEOS-10, which requires gsw.
    sound_speed_m_s : float or None
        c, metres per second. None: by `sound_speed_formula`.
    volume_backscatter_db : float or None
        Volume backscattering strength S_v of plankton, fish, silt and small bubbles at the sonar's frequency, dB re
        1/m: 10 log10 of the backscattering cross section per cubic metre. None: clear water.
    scatterer_density_m3 : float or None
        Mean number of these scatterers per cubic metre. Where few lie in a resolution cell, speckle shows each by
        itself, at new places in each ping. None: so many that their echo is fully developed speckle.
    wind_speed_m_s : float or None
        Wind over a fully developed sea, metres per second at a height of 10 m. Where a scene has a surface, its waves
        and bubbles scatter, and it is as rough as the waves. None: the surface scatters nothing, and is as rough as the
        scene says.

    Raises
    ------
    Error
        if a name is unknown, a number is out of bounds, or there is a density of scatterers without their strength.

    >>> round(Water(temperature_c=25.0, depth_m=1000.0).sound_speed(), 3)
    1550.744
    """

    temperature_c: float = 10.0
    salinity_psu: float = 35.0
    depth_m: float = 10.0
    ph: float = 8.0
    absorption_db_m: float | None = None
    absorption_formula: str = "francois_garrison"
    sound_speed_formula: str = "mackenzie"
    sound_speed_m_s: float | None = None
    volume_backscatter_db: float | None = None
    scatterer_density_m3: float | None = None
    wind_speed_m_s: float | None = None

    def __post_init__(self):
        make_numbers_plain(self)
        for key, names in CHOICES.items():
            check_choice(key, getattr(self, key), names, "water")
        check_fields("water", self, BOUNDS)
        if self.scatterer_density_m3 is not None and self.volume_backscatter_db is None:
            raise Error(
                f"water: scatterer_density_m3 needs volume_backscatter_db (got {self.scatterer_density_m3:g} without "
                "it; give the strength of all scatterers in a cubic metre)"
            )
        for text in self._likely_mistakes():
            warn_caller(f"water: {text}")

    def _likely_mistakes(self) -> Iterator[str]:
        """Yield a sentence about each number that looks like one of another unit: unlikely but possible."""
        alpha_db_m = self.absorption_db_m
        if alpha_db_m is not None and alpha_db_m > GREATEST_ABSORPTION_DB_M:
            yield (
                f"absorption_db_m = {alpha_db_m:g} takes {2 * alpha_db_m:g} dB from an echo at 1 m; if it is in dB per "
                f"km, give {alpha_db_m / 1e3:g}"
            )
        if 0.025 < self.salinity_psu < 0.045:  # a lake may be as fresh as this
            yield (
                f"salinity_psu = {self.salinity_psu:g} is fresh water; if it is in kilograms per kilogram, give "
                f"{1e3 * self.salinity_psu:g}"
            )

    @classmethod
    def parse(cls, text: str) -> Water:
        """Return the water that the text "key=value,..." of a command line states.

        >>> Water.parse("temperature_c=4,salinity_psu=8").salinity_psu
        8.0
        """
        return cls(**parse_fields("water", text, cls)[1])

    def changed(self, values: Mapping) -> Water:
        """Return this water with other values of some fields, as a file gives them.

        Raises
        ------
        Error
            if the values are no table, or a field is unknown or out of bounds.

        >>> Water(ph=7.9).changed({"temperature_c": 4.0}).ph
        7.9
        """
        known = [field.name for field in fields(self)]
        if not isinstance(values, Mapping):
            raise Error(
                f"water must be a Water, or a table such as {{ temperature_c = 4 }} (got {shown(values)})"
            )
        for key in values:
            check_choice("key", key, known, "water")
        return replace(self, **values)

    def absorption(self, frequency_hz: float) -> float:
        """Return the absorption α at a frequency, hertz, 1..1e9: dB per metre, one way.

        >>> round(Water(temperature_c=4.0, salinity_psu=8.0, ph=7.9).absorption(900e3), 3)
        0.334
        """
        frequency_hz = check_number("frequency_hz", frequency_hz, 1.0, 1e9, "give hertz, 900e3 for 900 kHz")
        if self.absorption_db_m is not None:
            return float(self.absorption_db_m)
        properties = (self.temperature_c, self.salinity_psu, self.depth_m, self.ph)
        return float(ABSORPTION_FORMULAS[self.absorption_formula](frequency_hz, *properties))

    def sound_speed(self) -> float:
        """Return the speed of sound c, metres per second.

        >>> round(Water().sound_speed(), 2), Water(sound_speed_m_s=1450.0).sound_speed()
        (1489.97, 1450.0)
        """
        if self.sound_speed_m_s is not None:
            return float(self.sound_speed_m_s)
        properties = (self.temperature_c, self.salinity_psu, self.depth_m)
        return float(SOUND_SPEED_FORMULAS[self.sound_speed_formula](*properties))

    def wave_height_m(self) -> float:
        """Return the rms height of the waves, metres; 0 if the wind is not given.

        >>> round(Water(wind_speed_m_s=7.0).wave_height_m(), 2)
        0.29
        """
        return 0.0 if self.wind_speed_m_s is None else rms_wave_height_m(self.wind_speed_m_s)


DEFAULT_WATER = Water()
