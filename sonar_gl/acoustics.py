"""How sound weakens with range and how a beam hears: formulas, and the profiles made of them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from sonar_gl.types import Error, nearest_names

HALF_POWER = 0.442946470689  # x of sinc²(x) = 1/2: half the −3 dB width of a uniform line array, in λ/L
LOBES = 4  # of the line array's pattern, to each side of the axis, that count: the rest is below −23 dB
NEAR_M = 1e-3  # r^-2 is held below this range: no echo comes from there, and r = 0 stays finite
MAX_DECADES = 30.0  # gains are held within 10^±30, so that float32 echoes stay finite


def absorption_francois_garrison(frequency_hz, temperature_c, salinity_psu, depth_m, ph):
    """Absorption of sound in sea water, dB per metre one way: boric acid, magnesium sulphate, pure water.

    Parameters
    ----------
    frequency_hz : hertz; fitted from 200 Hz to 1 MHz, above which pure water (f²) rules and is kept
    temperature_c, salinity_psu, depth_m, ph : °C, practical salinity, metres, 1

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
    """Absorption of sound in sea water, dB per metre one way: a short form within 10 % of the long one.

    Parameters
    ----------
    frequency_hz : hertz, 100 Hz to 1 MHz
    temperature_c, salinity_psu, depth_m, ph : °C, practical salinity, metres, 1

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
    """Speed of sound in sea water, metres per second.

    Parameters
    ----------
    temperature_c, salinity_psu, depth_m : −2..30 °C, 25..40, 0..8000 m

    Source: Mackenzie, "Nine-term equation for sound speed in the oceans", J. Acoust. Soc. Am. 70,
    807-812, 1981

    >>> round(float(sound_speed_mackenzie(25.0, 35.0, 1000.0)), 3)
    1550.744
    """
    t, s, d = (np.asarray(x, np.float64) for x in (temperature_c, salinity_psu, depth_m))
    warmth = 1448.96 + 4.591 * t - 5.304e-2 * t**2 + 2.374e-4 * t**3
    salt = 1.340 * (s - 35) - 1.025e-2 * t * (s - 35)
    return warmth + salt + 1.630e-2 * d + 1.675e-7 * d**2 - 7.139e-13 * t * d**3


def line_array_pattern(azimuth_rad, steer_azimuth_rad, beam_width_rad):
    """What a beam of a uniform line array hears from each direction, linear power, 1 on its axis.

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad : radians, shapes that broadcast: the direction, the beam's axis
    beam_width_rad : −3 dB full width, radians, 0..π

    sinc²(u L/λ) with u = sin(ψ − ψ0) and L/λ = 0.44295 / sin(width / 2), so the −3 dB width is exact.
    Every beam is alike: a data sheet gives one width, and curved or many-faced arrays keep it over the
    fan. (One straight array would have u = sin ψ − sin ψ0 and broaden by 1/cos ψ0 where it is steered.)
    The array hears nothing from behind, more than 90° from the beam's axis.
    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> round(float(line_array_pattern(np.radians(0.5), 0.0, np.radians(1.0))), 9)
    0.5
    """
    offset = np.asarray(azimuth_rad, np.float64) - np.asarray(steer_azimuth_rad, np.float64)
    apertures = HALF_POWER / np.sin(np.asarray(beam_width_rad, np.float64) / 2)
    return np.where(np.cos(offset) > 0, np.sinc(np.sin(offset) * apertures) ** 2, 0.0)


def box_pattern(azimuth_rad, steer_azimuth_rad, beam_width_rad):
    """A beam that hears all within half its width of its axis alike, and nothing else: 1 or 0.

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad : radians, of any shapes that broadcast: the direction, the beam's axis
    beam_width_rad : full width, radians; its starboard edge is in the beam, its port edge is not

    >>> box_pattern(np.radians([-0.6, -0.4, 0.4, 0.6]), 0.0, np.radians(1.0)).tolist()
    [0.0, 1.0, 1.0, 0.0]
    """
    offset = np.asarray(azimuth_rad, np.float64) - np.asarray(steer_azimuth_rad, np.float64)
    offset = (offset + np.pi) % (2 * np.pi) - np.pi
    share = offset / np.asarray(beam_width_rad, np.float64)
    return ((share >= -0.5) & (share < 0.5)).astype(np.float64)


BEAM_PATTERNS = {"box": box_pattern, "line_array": line_array_pattern}
RANGE_LAWS = ("constant", "printed", "inverse", "sonar_equation")
PROFILES = {  # name: its range law and its beam pattern
    "ideal": ("constant", "box"),
    "demarco2015": ("printed", "box"),
    "physical": ("sonar_equation", "line_array"),
}
BOUNDS = (
    ("temperature_c", -2, 40, "give °C"),
    ("salinity_psu", 0, 45, "give grams of salt per kilogram of water"),
    ("depth_m", 0, 12000, "give metres below the surface, positive down"),
    ("ph", 7, 9, "sea water has about 8"),
    ("absorption_db_m", 0, 1e5, "give dB per metre one way, a thousandth of dB per km"),
    ("tvg_k", 0, 60, "usual are 20, 30 and 40"),
    ("tvg_absorption_db_m", 0, 1e5, "give dB per metre one way, a thousandth of dB per km"),
)


@dataclass(frozen=True)
class Acoustics:
    """What happens to an echo on its way, as one gain G(r), and the shape of the beams.

    Parameters
    ----------
    profile : "ideal" (the cosine law alone), "demarco2015" (the founding paper) or "physical"
    range_law : None (the profile's own) or "constant": G = 1; "printed": (r / range_max)², eq. (4) of
        DeMarco, West, Howard 2015 as printed; "inverse": (1 m / r)², at most 1; "sonar_equation":
        r^-2 · 10^(−2αr/10) · 10^(TVG/10) with TVG = k log10 r + 2 α_tvg r dB, r in metres, where r below
        1 mm counts as 1 mm and the whole is held within 10^±30
    beam_pattern : None (the profile's own), "box" or "line_array"
    temperature_c, salinity_psu, depth_m, ph : the water, for α
    absorption_db_m : α, dB per metre one way; None = Francois-Garrison at the sonar's frequency
    tvg_k : k of the TVG; 20 with the right α makes G = 1, 40 keeps a point target's level
    tvg_absorption_db_m : the α that the TVG believes in; None = the right one

    Raises Error if a name is unknown or a number makes no sense.

    >>> from sonar_gl.sonar import load_sonar
    >>> Acoustics.physical(tvg_k=40.0).gain(np.array([1.0, 10.0]), load_sonar("p900-45")).round(9).tolist()
    [1.0, 100.0]
    """

    profile: str = "physical"
    range_law: str | None = None
    beam_pattern: str | None = None
    temperature_c: float = 10.0
    salinity_psu: float = 35.0
    depth_m: float = 10.0
    ph: float = 8.0
    absorption_db_m: float | None = None
    tvg_k: float = 20.0
    tvg_absorption_db_m: float | None = None

    def __post_init__(self):
        names = {"profile": PROFILES, "range_law": RANGE_LAWS, "beam_pattern": BEAM_PATTERNS}
        for place, (key, known) in enumerate(names.items()):
            value = getattr(self, key)
            if value is None and place > 0:
                object.__setattr__(self, key, PROFILES[self.profile][place - 1])
            elif str(value) not in known:
                raise Error(f"acoustics: unknown {key} (got {value!r}; {nearest_names(str(value), known)})")
        for key, low, high, hint in BOUNDS:
            value = getattr(self, key)
            if value is None and "absorption" in key:
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise Error(f"acoustics: {key} must be a number (got {value!r})")
            if not low <= value <= high:  # NaN too
                raise Error(f"acoustics: {key} must lie in {low:g}..{high:g} (got {value:g}; {hint})")

    @classmethod
    def ideal(cls) -> Acoustics:
        """The cosine law alone, box beams: what closed forms are checked against."""
        return cls("ideal")

    @classmethod
    def demarco2015(cls, range_law: str = "printed") -> Acoustics:
        """The founding paper: eq. (4) "printed", "constant" (as its published code reads) or "inverse"."""
        return cls("demarco2015", range_law=range_law)

    @classmethod
    def physical(cls, **settings) -> Acoustics:
        """Spreading, absorption and TVG, beams of a line array; settings are the fields, by name."""
        return cls("physical", **settings)

    def absorption(self, frequency_hz: float) -> float:
        """α at this frequency, dB per metre, one way."""
        if self.absorption_db_m is not None:
            return float(self.absorption_db_m)
        water = (self.temperature_c, self.salinity_psu, self.depth_m, self.ph)
        return float(absorption_francois_garrison(frequency_hz, *water))

    def gain(self, range_m, sonar) -> np.ndarray:
        """G(r), linear power, float64, of the shape of `range_m` (metres), for this sonar."""
        r = np.asarray(range_m, np.float64)
        if self.range_law == "constant":
            return np.ones_like(r)
        if self.range_law == "printed":
            return (r / sonar.range_max_m) ** 2
        r = np.maximum(r, NEAR_M)
        if self.range_law == "inverse":
            return np.minimum(1.0, r**-2)
        absorption = self.absorption(sonar.frequency_hz)
        believed = absorption if self.tvg_absorption_db_m is None else self.tvg_absorption_db_m
        # one exponent: where TVG and loss cancel they do so exactly, and 10^(-αr) cannot underflow on its own
        decades = (self.tvg_k / 10 - 2) * np.log10(r) + 2 * (believed - absorption) * r / 10
        return 10.0 ** np.clip(decades, -MAX_DECADES, MAX_DECADES)

    def beam_pattern_function(self, sonar):
        """Function (azimuth_rad, steer_azimuth_rad) -> linear power, 1 on the axis; None for a box."""
        if self.beam_pattern == "box":
            return None
        return partial(BEAM_PATTERNS[self.beam_pattern], beam_width_rad=np.radians(sonar.beam_width_deg))

    def beam_reach_rad(self, sonar) -> float:
        """How far from its axis a beam hears, radians: half a box, or a line array to its 4th null."""
        half = math.radians(sonar.beam_width_deg) / 2
        if self.beam_pattern == "box":
            return half
        return math.asin(min(1.0, LOBES * math.sin(half) / HALF_POWER))

    def meta(self) -> dict:
        """The fields as plain values, for a ping's record."""
        return asdict(self)
