"""What happens to an echo on its way: the settings, the profiles made of them, and the gains that follow."""

from __future__ import annotations

import importlib
import math
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from sonar_gl.beams import Beams
from sonar_gl.pulse import bin_weights
from sonar_gl.settings import check, parse
from sonar_gl.types import Error, check_kind, nearest_names
from sonar_gl.water import ABSORPTION_FORMULAS, SOUND_SPEED_FORMULAS

NEAR_M = 1e-3  # r^-2 is held below this range: no echo comes from there, and r = 0 stays finite
MAX_DECADES = 30.0  # gains are held within 10^±30, so that float32 echoes stay finite
WATER = "temperature_c", "salinity_psu", "depth_m", "ph", "absorption_db_m", "sound_speed_m_s"


@dataclass(frozen=True)
class Acoustics(Beams):
    """What happens to an echo on its way, and how beams hear.

    Parameters
    ----------
    profile : "ideal" (the cosine law alone), "demarco2015" (the founding paper) or "physical"
    range_law : None (the profile's own) or "constant": G = 1; "printed": (r / range_max)², eq. (4) of
        DeMarco, West, Howard 2015 as printed; "inverse": (1 m / r)², at most 1; "sonar_equation":
        r^-2 · 10^(−2αr/10) · 10^(TVG/10) with TVG = k log10 r + 2 α_tvg r dB, r in metres, where r below
        1 mm counts as 1 mm and the whole is held within 10^±30
    beam_pattern : None (the profile's own), "box", "line_array" or "gaussian"
    temperature_c, salinity_psu, depth_m, ph : the water, for α and for the speed of sound
    absorption_db_m : α, dB per metre one way; None = by absorption_formula at the sonar's frequency
    tvg_k : k of the TVG; 20 with the right α makes G = 1, 40 keeps a point target's level
    tvg_absorption_db_m : the α that the TVG believes in; None = the right one
    absorption_formula : "francois_garrison" or "ainslie_mccolm"
    sound_speed_formula : "mackenzie", or "teos10", which needs gsw
    sound_speed_m_s : the speed of sound; None = by sound_speed_formula
    sonar_sound_speed_m_s : what the sonar is set to, None = the right speed; ranges that it shows are the
        true ones times this over the right speed
    taper : of the receiving line array in azimuth: "uniform", "hamming", "taylor" or "chebyshev"
    side_lobe_db : how far down the side lobes of "taylor" and "chebyshev" are, in all arrays
    steered : "alike": every beam has the width of the data sheet; "straight": one straight array, whose
        beams broaden as 1/cos of the angle that they are steered to
    transmit_width_deg, transmit_taper : −3 dB width in azimuth of the projector's beam about the boresight;
        None = it sounds the fan evenly. beam_width_deg stays that of the receiving beams
    elevation_pattern : "box": a beam hears all of elevation_fov_deg alike; "line_array", "gaussian":
        transmitter and receiver alike, and their product is elevation_fov_deg wide at −3 dB
    elevation_taper : of the line array in elevation
    bandwidth_hz, pulse_taper : of the pulse, and of its matched filter, "uniform" or "hamming"; None = an
        echo falls into the bin of its range and no other
    specular : None (the profile's own), or whether smooth faces have lobes
    bubbles : None (the profile's own), or whether the scene's plumes of bubbles are there
    multipath : "none", "incoherent" or "coherent": how the two paths by way of a surface add

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
    absorption_formula: str = "francois_garrison"
    sound_speed_formula: str = "mackenzie"
    sound_speed_m_s: float | None = None
    sonar_sound_speed_m_s: float | None = None
    taper: str = "uniform"
    side_lobe_db: float = 30.0
    steered: str = "alike"
    transmit_width_deg: float | None = None
    transmit_taper: str = "uniform"
    elevation_pattern: str = "box"
    elevation_taper: str = "uniform"
    bandwidth_hz: float | None = None
    pulse_taper: str = "uniform"
    specular: bool | None = None
    bubbles: bool | None = None
    multipath: str = "none"

    def __post_init__(self):
        check(self)

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

    @classmethod
    def needed(cls, scene, sonar, tolerance: float = 0.01, pose=None) -> Acoustics:
        """`physical` with those terms switched on that this scene needs, and no others.

        Without those that are left out the image changes by no more than the tolerance, all together.

        Parameters
        ----------
        scene, sonar : Scene, or a Simulator of it, and Sonar
        tolerance : 0.001..0.5, how much of the echo may differ from that with everything on
        pose : (4, 4) world_from_sonar, or several of a sequence, of which five are tried; None = the scene's

        Raises Error if there is no pose. The same arguments give the same terms: times do not count.
        """
        # it makes pings, and the modules that do so stand on this one
        return importlib.import_module("sonar_gl.terms").needed(scene, sonar, tolerance, pose)

    @classmethod
    def parse(cls, text: str, profile: str = "physical") -> Acoustics:
        """A profile and changes of its fields, from a command line.

        >>> Acoustics.parse("tvg_k=30,elevation_pattern=gaussian").tvg_k
        30.0
        """
        return replace(cls(profile), **parse(text, fields(cls)))

    def in_water(self, water: dict) -> Acoustics:
        """The same in other water.

        Parameters
        ----------
        water : values of any of temperature_c, salinity_psu, depth_m, ph, absorption_db_m, sound_speed_m_s

        Raises Error if a name is another one, a number makes no sense, or echoes would be shown elsewhere.

        >>> Acoustics.physical(ph=7.9).in_water({"temperature_c": 4.0}).sound_speed() < 1470
        True
        """
        check_kind("water", water, dict, 'such as {"temperature_c": 4.0, "salinity_psu": 8.0}')
        for name in water:
            if name not in WATER:
                near = nearest_names(str(name), WATER)
                raise Error(f"water must hold fields of Acoustics that tell the water (got {name!r}; {near})")
        out = replace(self, **water)
        if out.shown_per_true() != self.shown_per_true():
            raise Error(
                "the speed of sound must stay where sonar_sound_speed_m_s is set, as echoes would be shown "
                f"at other ranges (got {out.sound_speed():.2f} for {self.sound_speed():.2f} m/s; leave "
                "sonar_sound_speed_m_s out, or make one Simulator for each water)"
            )
        return out

    def absorption(self, frequency_hz: float) -> float:
        """α at this frequency, dB per metre, one way."""
        if self.absorption_db_m is not None:
            return float(self.absorption_db_m)
        water = (self.temperature_c, self.salinity_psu, self.depth_m, self.ph)
        return float(ABSORPTION_FORMULAS[self.absorption_formula](frequency_hz, *water))

    def sound_speed(self) -> float:
        """How fast sound runs in this water, metres per second."""
        if self.sound_speed_m_s is not None:
            return float(self.sound_speed_m_s)
        water = (self.temperature_c, self.salinity_psu, self.depth_m)
        return float(SOUND_SPEED_FORMULAS[self.sound_speed_formula](*water))

    def shown_per_true(self) -> float:
        """Ranges that the sonar shows over the true ones: the speed that it is set to, over the right one.

        >>> round(10 * Acoustics(sonar_sound_speed_m_s=1500.0, sound_speed_m_s=1450.0).shown_per_true(), 4)
        10.3448
        """
        if self.sonar_sound_speed_m_s is None:
            return 1.0
        return self.sonar_sound_speed_m_s / self.sound_speed()

    def drawn_sonar(self, sonar):
        """The sonar as its echoes lie: bins at true ranges, and as high an aperture as is heard at all."""
        top_deg, scale = self.elevation_reach_deg(sonar), self.shown_per_true()
        if scale == 1.0 and 2 * top_deg == sonar.elevation_fov_deg:
            return sonar
        ranges = {key: getattr(sonar, key) / scale for key in ("range_min_m", "range_max_m")}
        return replace(sonar, elevation_fov_deg=2 * top_deg, **ranges)

    def gain(self, range_m, sonar) -> np.ndarray:
        """G(r), linear power, float64, of the shape of `range_m`, the ranges that the sonar shows, metres.

        The sound weakens over the true range; the TVG and the laws of other profiles know the shown one.
        """
        r = np.asarray(range_m, np.float64)
        if self.range_law == "constant":
            return np.ones_like(r)
        if self.range_law == "printed":
            return (r / sonar.range_max_m) ** 2
        r = np.maximum(r, NEAR_M)
        scale = self.shown_per_true()
        if self.range_law == "inverse":
            return np.minimum(1.0, (r / scale) ** -2)
        absorption, believed = self._absorptions(sonar)
        # one exponent: where TVG and loss cancel they do so exactly, and 10^(-αr) cannot underflow on its own
        decades = (self.tvg_k / 10 - 2) * np.log10(r) + 2 * math.log10(scale)
        decades += 2 * (believed - absorption / scale) * r / 10
        return 10.0 ** np.clip(decades, -MAX_DECADES, MAX_DECADES)

    def tvg(self, range_m, sonar) -> np.ndarray:
        """The TVG alone, linear power, float64, of the shape of `range_m`, the ranges that the sonar shows.

        1 for range laws other than "sonar_equation"; r below 1 mm counts as 1 mm, and the whole is held
        within 10^±30.

        >>> from sonar_gl.sonar import load_sonar
        >>> Acoustics.physical(tvg_k=30.0, absorption_db_m=0.5).tvg([10.0], load_sonar("p900-45")).tolist()
        [10000.0]
        """
        r = np.asarray(range_m, np.float64)
        if self.range_law != "sonar_equation":
            return np.ones_like(r)
        r = np.maximum(r, NEAR_M)
        decades = (self.tvg_k * np.log10(r) + 2 * self._absorptions(sonar)[1] * r) / 10
        return 10.0 ** np.clip(decades, -MAX_DECADES, MAX_DECADES)

    def _absorptions(self, sonar) -> tuple[float, float]:
        """α, and what the TVG takes it for."""
        right = self.absorption(sonar.frequency_hz)
        return right, right if self.tvg_absorption_db_m is None else self.tvg_absorption_db_m

    def pulse_weights(self, sonar) -> np.ndarray | None:
        """(n,) float32 share of an echo that bins about its own get; None where that gets all of it."""
        if self.bandwidth_hz is None:
            return None
        speed_m_s = self.sonar_sound_speed_m_s or self.sound_speed()  # of ranges as they are shown
        return bin_weights(sonar.bin_size_m, self.bandwidth_hz, self.pulse_taper, speed_m_s)

    def meta(self) -> dict:
        """The fields as plain values, for a ping's record."""
        return asdict(self)
