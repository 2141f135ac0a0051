"""The settings of the acoustic model, and the gains, patterns and kernels that follow from them for a sonar."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.acoustics.beam_pattern import ArrayPattern, FarPattern, gaussian_pattern, line_array_pattern
from sonar_gl.acoustics.pulse import PulseResponse, bin_weights, resolution_cell_m
from sonar_gl.acoustics.range_gain import inverse_square_gain, sonar_equation_gain, time_varied_gain
from sonar_gl.acoustics.sea_surface import surface_backscattering
from sonar_gl.acoustics.water import DEFAULT_WATER, GREATEST_ABSORPTION_DB_M, Water
from sonar_gl.core.checks import check_choice, check_fields, check_kind, make_numbers_plain, shown
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.key_values import parse_fields
from sonar_gl.core.signatures import shown_by_fields
from sonar_gl.core.warn import collected_warnings, warn_caller
from sonar_gl.sonar.sonar import Sonar

TVG_FIELDS = ("tvg_k", "tvg_absorption_db_m")
SWITCHES = (  # fields that are on in the profile "physical", and off in the others
    "conical_beams",
    "far_side_lobes",
    "transmit_beam",
    "pulse",
    "specular",
    "bubbles",
    "cross_talk",
    "volume_reverberation",
    "surface_reverberation",
)
BARE = {"beam_pattern": "box", "elevation_pattern": "box"} | dict.fromkeys(SWITCHES, False)
PROFILES = {  # name: values of the fields that are None
    "ideal": BARE | {"range_law": "constant"},
    "demarco2015": BARE | {"range_law": "printed"},
    "physical": {
        "range_law": "sonar_equation",
        "beam_pattern": "line_array",
        "elevation_pattern": "line_array",
        **dict.fromkeys(SWITCHES, True),
    },
}
CHOICES = {  # field: allowed names
    "range_law": ("constant", "printed", "inverse", "sonar_equation"),
    "beam_pattern": ("box", "line_array", "gaussian"),
    "elevation_pattern": ("box", "line_array", "gaussian"),
    "multipath": ("none", "incoherent", "coherent"),
}
BOUNDS = (  # field, least and greatest value, hint for messages
    ("tvg_k", 0, 60, "usual are 20, 30 and 40"),
    ("tvg_absorption_db_m", 0, 1e5, "give dB per metre one way, a thousandth of dB per km"),
    ("sonar_sound_speed_m_s", 1000, 2000, "give metres per second, about 1500 in water"),
)
MOVED_TO_SONAR = {  # fields that describe the device: their names in `Sonar`
    "taper": "receive_taper",
    "side_lobe_db": "side_lobe_db",
    "steered": "steered",
    "transmit_width_deg": "transmit_width_deg",
    "transmit_taper": "transmit_taper",
    "elevation_taper": "elevation_taper",
    "bandwidth_hz": "bandwidth_hz",
    "pulse_taper": "pulse_taper",
}
MOVED_TO_WATER = tuple(field.name for field in fields(Water))

MAX_STEER_DEG = 80.0  # of a straight array: nearer to its own line a beam has no −3 dB edge on the far side
GAUSSIAN_SUPPORT_LEVEL = 1e-4  # one-way power in azimuth at which a Gaussian beam is cut
# Entries of the table of `receive_correlation`, which is interpolated: off by 2e-4 for a line array without taper.
CORRELATIONS = 2049
SKIRTS_LEVEL = 0.1  # two-way power in elevation below which samples are coarse, also in the main lobe
ELEVATION_SUPPORT_LEVEL = 1e-3  # two-way power in elevation at which the main lobe is taken to end
MAX_ELEVATION_DEG = 85.0  # above the boresight: a perspective view cannot cover much more
# Two-way power in elevation below which nothing is received: the first bottom return comes from so near that a level
# sonar shows it 20 dB above its side lobe, and images show 60 dB.
SIDE_LOBE_LEVEL = 1e-8
MAX_SIDE_LOBE_DEG = 89.5  # above the boresight: a ten-thousandth of the hemisphere lies beyond


@shown_by_fields
@dataclass(frozen=True)
class Acoustics:
    """The acoustic model of a ping: water, range gain, beam patterns, pulse and the terms of the echo.

    docs/acoustics.md has the formula of each term, and its source.

    Parameters
    ----------
    profile : "ideal", "demarco2015" or "physical"
        Determines the fields that are None by default and in this table "by profile". "ideal": the cosine law
        alone. "demarco2015": the model of DeMarco, West, Howard 2015. "physical": the sonar equation and the whole
        device, whose beams in azimuth and elevation are those of line arrays and whose pulse has a bandwidth,
        with specular backscatter and bubbles.
    range_law : "constant", "printed", "inverse", "sonar_equation" or None
        Range gain G(r). "constant": 1. "printed": (r / range_max)², eq. (4) of DeMarco, West, Howard 2015 as
        printed. "inverse": (1 m / r)², at most 1. "sonar_equation": two-way transmission loss and TVG,
        r^-2 · 10^(−2αr/10) · 10^(TVG/10) with TVG = k log10 r + 2 α_tvg r dB, r in metres, where r below 1 mm
        counts as 1 mm and the product stays within 10^±30; r^-2 is the spreading r^-4 times the r² of the area in a
        solid angle. None: by profile.
    beam_pattern : "box", "line_array", "gaussian" or None
        Receive beam pattern in azimuth. None: by profile.
    conical_beams : bool or None
        Whether one straight array receives along cones about its axis, as far as the sonar has one and its beams are
        no boxes (see `has_cones`); False: beams are upright. None: by profile.
    far_side_lobes : bool or None
        Whether beams of a line array receive beyond their 4th null: all side lobes in azimuth over the whole fan, and
        the floor of the sonar's `element_error_db`. None: by profile.
    water : Water, or a table of its fields
        The water, which has the absorption α and the speed of sound.
    tvg_k : float
        k of the TVG. 20 with the right α makes G = 1; 40 keeps the level of a point target.
    tvg_absorption_db_m : float or None
        α_tvg, the absorption that the TVG assumes, dB per metre one way. None: the right one, α.
    sonar_sound_speed_m_s : float or None
        Speed of sound that the sonar assumes, metres per second. The ranges that it shows are the true ones times
        this over the right speed. None: the right speed.
    transmit_beam : bool or None
        Whether the sonar's `transmit_width_deg` counts; False: the fan is insonified evenly. None: by profile.
    elevation_pattern : "box", "line_array", "gaussian" or None
        Pattern in elevation. "box": 1 within elevation_fov_deg of the sonar, 0 outside. Otherwise transmitter and
        receiver have the same pattern, and the two-way pattern is elevation_fov_deg wide at −3 dB. None: by profile.
    pulse : bool or None
        Whether the pulse has the sonar's bandwidth. False: no matched filter; an echo falls only into the bin of its
        range. None: by profile.
    specular : bool or None
        Whether smooth faces have a specular (Kirchhoff) backscatter lobe. None: by profile.
    bubbles : bool or None
        Whether the scene's plumes of bubbles scatter and attenuate. None: by profile.
    volume_reverberation : bool or None
        Whether the water scatters, if it has a `volume_backscatter_db`. None: by profile.
    surface_reverberation : bool or None
        Whether the water's surface scatters, if the scene has one and the water a `wind_speed_m_s`. None: by profile.
    cross_talk : bool or None
        Whether the sonar's `cross_talk_db` counts: beams of one set receive some of each other's echoes. None: by
        profile.
    multipath : "none", "incoherent" or "coherent"
        Whether echoes by way of planar reflectors are added, and how the two single-bounce paths add up:
        "incoherent" in power, "coherent" in phase where one beam receives both. They belong to a scene more than to a
        device, so that no profile has them.

    Raises
    ------
    Error
        if a name is unknown, has moved to `Sonar` or `Water`, or a number is out of bounds.

    >>> from sonar_gl.sonar.sonar_files import load_sonar
    >>> Acoustics.physical(tvg_k=40.0).range_gain(np.array([1.0, 10.0]), load_sonar("p900-45")).round(9).tolist()
    [1.0, 100.0]
    """

    profile: str = "physical"
    range_law: str | None = None
    beam_pattern: str | None = None
    conical_beams: bool | None = None
    far_side_lobes: bool | None = None
    water: Water = DEFAULT_WATER
    tvg_k: float = 20.0
    tvg_absorption_db_m: float | None = None
    sonar_sound_speed_m_s: float | None = None
    transmit_beam: bool | None = None
    elevation_pattern: str | None = None
    pulse: bool | None = None
    specular: bool | None = None
    bubbles: bool | None = None
    volume_reverberation: bool | None = None
    surface_reverberation: bool | None = None
    cross_talk: bool | None = None
    multipath: str = "none"

    def __post_init__(self):
        make_numbers_plain(self)
        check_choice("profile", self.profile, PROFILES, "acoustics")
        for key, value in PROFILES[self.profile].items():
            if getattr(self, key) is None:
                object.__setattr__(self, key, value)
        if not isinstance(self.water, Water):  # a table of a file
            with errors_at("acoustics"):
                object.__setattr__(self, "water", DEFAULT_WATER.changed(self.water))
        for key, names in CHOICES.items():
            check_choice(key, getattr(self, key), names, "acoustics")
        for key in SWITCHES:
            if not isinstance(getattr(self, key), bool):
                raise Error(f"acoustics: {key} must be True or False (got {shown(getattr(self, key))})")
        check_fields("acoustics", self, BOUNDS)
        alpha_db_m = self.tvg_absorption_db_m
        if alpha_db_m is not None and alpha_db_m > GREATEST_ABSORPTION_DB_M:
            warn_caller(
                f"acoustics: tvg_absorption_db_m = {alpha_db_m:g} amplifies an echo at 1 m by {2 * alpha_db_m:g} dB; "
                f"if it is in dB per km, give {alpha_db_m / 1e3:g}"
            )

    def __new__(cls, *arguments, **fields):
        """Refuse fields that describe the device or the water."""
        check_moved("acoustics", fields)
        return super().__new__(cls)

    @classmethod
    def ideal(cls, **settings) -> Acoustics:
        """Return the profile "ideal": the cosine law alone with box beams, the model that closed forms describe.

        Settings are the fields, by name, and change it.

        >>> Acoustics.ideal(water=Water(temperature_c=4.0)) == Acoustics("ideal", water=Water(temperature_c=4.0))
        True
        """
        return cls("ideal", **settings)

    @classmethod
    def demarco2015(cls, range_law: str = "printed", **settings) -> Acoustics:
        """Return the profile "demarco2015": the model of DeMarco, West, Howard 2015.

        Parameters
        ----------
        range_law : "printed", eq. (4); "constant", as the published code reads; or "inverse"
        settings : the other fields, by name
        """
        return cls("demarco2015", range_law=range_law, **settings)

    @classmethod
    def physical(cls, **settings) -> Acoustics:
        """Return the profile "physical": the sonar equation and the whole device; settings are the fields, by name."""
        return cls("physical", **settings)

    @classmethod
    def needed(cls, *_arguments, **_settings) -> Acoustics:
        """Moved to `sonar_gl.needed_acoustics`, since choosing the terms simulates pings."""
        raise Error("Acoustics.needed has moved (call sonar_gl.needed_acoustics with the same arguments)")

    @classmethod
    def parse(cls, text: str, profile: str = "physical") -> Acoustics:
        """Return a profile with some fields changed, from the text "key=value,..." of a command line.

        >>> Acoustics.parse("tvg_k=30,elevation_pattern=gaussian").tvg_k
        30.0
        """
        check_kind("acoustics", text, str, "such as 'tvg_k=30,multipath=coherent'")
        keys = [item.partition("=")[0].strip() for item in text.split(",")]
        check_moved(f"acoustics {text!r}", keys)
        if "needed" in keys:
            raise Error(f"acoustics {text!r}: needed takes no other settings: it chooses the terms itself")
        if "water" in keys:
            raise Error(
                f'acoustics {text!r}: water has an option of its own (give --water "temperature_c=4")'
            )
        if "" in keys:
            got = "a comma or nothing where a key must be"
            raise Error(f"acoustics {text!r}: must be key=value, ... (got {got})")
        _, settings = parse_fields("acoustics", text, cls, without=("profile", "water"))
        acoustics = replace(cls(profile), **settings)
        for key in TVG_FIELDS:
            if settings.get(key) is not None and acoustics.range_law != "sonar_equation":
                warn_caller(
                    f"acoustics {text!r}: {key} has no effect by the range law {acoustics.range_law!r} of the profile "
                    f"{profile!r} (give range_law=sonar_equation, too)"
                )
        return acoustics

    def meta(self) -> dict:
        """Return the fields as plain values, the water as a table, for the record of a ping."""
        return asdict(self)

    # ---- water --------------------------------------------------------------------------------------------

    def in_water(self, water: Water) -> Acoustics:
        """Return the same model in other water.

        Raises
        ------
        Error
            if it is no Water, or the ranges that the sonar shows or, with multipath, the waves would change.

        >>> Acoustics.physical(tvg_k=30.0).in_water(Water(temperature_c=4.0)).water.temperature_c
        4.0
        """
        check_kind("water", water, Water, "such as dataclasses.replace(acoustics.water, temperature_c=4.0)")
        out = replace(self, water=water)
        if out.shown_per_true() != self.shown_per_true():
            raise Error(
                "the speed of sound must not change where sonar_sound_speed_m_s is set, since echoes would be "
                f"shown at other ranges (got {water.sound_speed():.2f} for {self.water.sound_speed():.2f} m/s; leave "
                "sonar_sound_speed_m_s out, or make one Simulator for each water)"
            )
        if self.multipath != "none" and water.wave_height_m() != self.water.wave_height_m():
            raise Error(
                "the wind must not change where there is multipath, since waves decide whether the surface reflects "
                f'(got wind_speed_m_s = {water.wind_speed_m_s} for {self.water.wind_speed_m_s}; give multipath="none", '
                "or make one Simulator for each wind)"
            )
        return out

    def assumed_sound_speed_m_s(self) -> float:
        """Return the speed of sound by which the sonar shows ranges: the one that it is set to, or the water's.

        >>> water = Water(sound_speed_m_s=1450.0)
        >>> Acoustics(water=water).assumed_sound_speed_m_s()
        1450.0
        >>> Acoustics(water=water, sonar_sound_speed_m_s=1500.0).assumed_sound_speed_m_s()
        1500.0
        """
        return float(self.sonar_sound_speed_m_s or self.water.sound_speed())

    def shown_per_true(self) -> float:
        """Return the ratio of shown to true ranges: the speed of sound that the sonar assumes, over the right one.

        >>> round(10 * Acoustics(water=Water(sound_speed_m_s=1450.0), sonar_sound_speed_m_s=1500.0).shown_per_true(), 4)
        10.3448
        """
        if self.sonar_sound_speed_m_s is None:
            return 1.0
        return self.sonar_sound_speed_m_s / self.water.sound_speed()

    def true_range_sonar(self, sonar: Sonar) -> Sonar:
        """Return the sonar whose bins lie at true ranges, and whose aperture is the main lobe in elevation.

        Parameters
        ----------
        sonar : Sonar, whose bins lie at the ranges that it shows, and whose aperture is the −3 dB width
        """
        top_deg, scale = self.elevation_support_deg(sonar), self.shown_per_true()
        if scale == 1.0 and 2 * top_deg == sonar.elevation_fov_deg:
            return sonar
        ranges = {key: getattr(sonar, key) / scale for key in ("range_min_m", "range_max_m")}
        # no warnings: they would name numbers that no user has written, and the given sonar has had its own
        with collected_warnings():
            return replace(sonar, elevation_fov_deg=2 * top_deg, **ranges)

    # ---- range gain ---------------------------------------------------------------------------------------

    def range_gain(self, range_m: ArrayLike, sonar: Sonar) -> np.ndarray:
        """Return the range gain G(r): two-way transmission loss and TVG, or the law of another profile.

        The transmission loss depends on the true range; the TVG and the laws "constant" and "printed" depend on the
        range that the sonar shows.

        Parameters
        ----------
        range_m : ranges that the sonar shows, metres, any shape

        Returns
        -------
        linear power, float64, of the shape of `range_m`
        """
        r = np.asarray(range_m, np.float64)
        if self.range_law == "constant":
            return np.ones_like(r)
        if self.range_law == "printed":
            return (r / sonar.range_max_m) ** 2
        if self.range_law == "inverse":
            return inverse_square_gain(r, self.shown_per_true())
        absorption = self._true_and_assumed_absorption(sonar)
        return sonar_equation_gain(r, self.tvg_k, *absorption, self.shown_per_true())

    def tvg(self, range_m: ArrayLike, sonar: Sonar) -> np.ndarray:
        """Return the TVG without the transmission loss; 1 for range laws other than "sonar_equation".

        Ranges below 1 mm count as 1 mm, and the gain stays within 10^±30.

        Parameters
        ----------
        range_m : ranges that the sonar shows, metres, any shape

        Returns
        -------
        linear power, float64, of the shape of `range_m`

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> Acoustics.physical(tvg_k=30.0, tvg_absorption_db_m=0.5).tvg([10.0], load_sonar("p900-45")).tolist()
        [10000.0]
        """
        r = np.asarray(range_m, np.float64)
        if self.range_law != "sonar_equation":
            return np.ones_like(r)
        _, assumed = self._true_and_assumed_absorption(sonar)
        return time_varied_gain(r, self.tvg_k, assumed)

    def _true_and_assumed_absorption(self, sonar) -> tuple[float, float]:
        """Return α of the water and α of the TVG, dB per metre, one way."""
        true = self.water.absorption(sonar.frequency_hz)
        return true, true if self.tvg_absorption_db_m is None else self.tvg_absorption_db_m

    @property
    def volume_backscatter_db(self) -> float | None:
        """S_v of the water, dB re 1/m, as far as the model includes it; None for no volume reverberation."""
        return self.water.volume_backscatter_db if self.volume_reverberation else None

    @property
    def scatterer_density_m3(self) -> float | None:
        """Number of scatterers per cubic metre of the water, as far as the model includes them; None for many."""
        return self.water.scatterer_density_m3 if self.volume_reverberation else None

    def surface_backscatter(self, sonar: Sonar) -> Callable | None:
        """Return the backscatter of the water's surface; None if the model does not include it.

        Parameters
        ----------
        sonar : Sonar, of which the frequency counts

        Returns
        -------
        function (grazing_rad) -> cross section per area and steradian, linear

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> windy = Acoustics.physical(water=Water(wind_speed_m_s=7.0))
        >>> round(float(10 * np.log10(windy.surface_backscatter(load_sonar("p900-45"))(np.radians(20.0)))), 1)
        -27.6
        """
        wind_speed_m_s = self.water.wind_speed_m_s
        if not self.surface_reverberation or wind_speed_m_s is None:
            return None
        return partial(surface_backscattering, frequency_hz=sonar.frequency_hz, wind_speed_m_s=wind_speed_m_s)

    # ---- beam patterns ------------------------------------------------------------------------------------

    def receive_pattern(self, sonar: Sonar) -> Callable | None:
        """Return the receive beam pattern in azimuth; None for a box.

        Returns
        -------
        function (azimuth_rad, steer_azimuth_rad) -> linear one-way power, 1 on the beam's axis

        Raises
        ------
        Error
            if a straight array has to form beams along its own line.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> pattern = Acoustics.physical(far_side_lobes=False).receive_pattern(load_sonar("p900-45"))
        >>> round(float(pattern(np.radians(10.5), np.radians(10.0))), 9)  # half of its width off the axis
        0.5
        """
        if self.beam_pattern == "box":
            return None
        settings = {"beam_width_rad": math.radians(sonar.beam_width_deg), "steered": sonar.steered}
        steer_deg = float(np.degrees(np.abs(sonar.azimuth_rad).max()))
        if sonar.steered == "straight" and steer_deg > MAX_STEER_DEG:
            raise Error(
                f'sonar {sonar.name!r}: steered "straight" needs beams within ±{MAX_STEER_DEG:g}° of the boresight '
                f'(got {steer_deg:.4g}°: one array cannot receive along its own line; take "alike")'
            )
        if self.beam_pattern == "gaussian":
            return partial(gaussian_pattern, **settings)
        return partial(
            line_array_pattern,
            taper=sonar.receive_taper,
            side_lobe_db=sonar.side_lobe_db,
            floor=self._floor(sonar),
            **settings,
        )

    def has_cones(self, sonar: Sonar) -> bool:
        """Return whether beams are cones: those of one straight array, unless they are boxes.

        Lenses, curved arrays and arrays of several faces have upright beams; so have fans that look further aside than
        MAX_STEER_DEG, along their own array.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> [Acoustics.physical().has_cones(load_sonar(name)) for name in ("oculus-m750d-lf", "didson-hf")]
        [True, False]
        """
        if not self.conical_beams or self.beam_pattern == "box":
            return False
        widest_deg = float(np.degrees(np.abs(sonar.azimuth_rad).max()))
        return sonar.is_straight_array and widest_deg <= MAX_STEER_DEG

    def far_pattern(self, sonar: Sonar) -> FarPattern | None:
        """Return what beams receive beyond `receive_support_rad`; None if nothing."""
        if not (self.far_side_lobes and self.beam_pattern == "line_array"):
            return None
        return FarPattern(self._receive_array(sonar), sonar.steered, self._floor(sonar))

    def _receive_array(self, sonar) -> ArrayPattern:
        """Return the receive pattern in azimuth of a beam that is not steered, unless it is a box."""
        width = math.radians(sonar.beam_width_deg)
        return ArrayPattern(self.beam_pattern, width, sonar.receive_taper, sonar.side_lobe_db)

    def _floor(self, sonar) -> float:
        """Return the mean power that errors of the elements add to the receive pattern."""
        level_db = sonar.element_error_db
        return 10 ** (level_db / 10) if self.far_side_lobes and level_db is not None else 0.0

    def receive_support_rad(self, sonar: Sonar) -> float:
        """Return the half-width of the receive pattern's support, radians; beyond it are the far side lobes alone.

        A box ends at half its width, a line array at its 4th null (see `ArrayPattern.support_sine`), and a Gaussian
        beam where its power is 1e-4. With `steered="straight"` it is that of the beam where it is widest.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> round(math.degrees(Acoustics.physical().receive_support_rad(load_sonar("p900-45"))), 2)  # 4 / 0.886 widths
        4.52
        """
        if self.beam_pattern == "box":
            return math.radians(sonar.beam_width_deg) / 2
        pattern, gaussian = self._receive_array(sonar), self.beam_pattern == "gaussian"
        sine = pattern.main_lobe_sine(GAUSSIAN_SUPPORT_LEVEL) if gaussian else pattern.support_sine()
        support = math.asin(min(1.0, sine))
        if sonar.steered == "straight":
            # on either side; a beam further aside than its 4th null has none there
            steer = np.abs(sonar.azimuth_rad)
            away = np.arcsin(np.minimum(1.0, np.sin(steer) + sine)) - steer
            inward = steer - np.arcsin(np.maximum(-1.0, np.sin(steer) - sine))
            support = max(support, float(away.max()), float(inward.max()))
        return support

    def receive_widths_rad(self, sonar: Sonar, azimuth_rad: ArrayLike) -> np.ndarray:
        """Return the −3 dB widths of receive beams at these azimuths, radians, in the plane of the fan.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> sonar = load_sonar("p900-45,steered=straight")
        >>> np.degrees(Acoustics.physical().receive_widths_rad(sonar, np.radians([0.0, 60.0]))).round(2).tolist()
        [1.0, 2.0]
        """
        width = math.radians(sonar.beam_width_deg)
        if self.beam_pattern == "box" or sonar.steered != "straight":
            return np.full(np.shape(azimuth_rad), width)
        edges = np.sin(azimuth_rad) + math.sin(width / 2) * np.array([[-1.0], [1.0]])
        return np.diff(np.arcsin(np.clip(edges, -1.0, 1.0)), axis=0)[0]

    def receive_correlation(self, sonar: Sonar) -> tuple[np.ndarray, float]:
        """Return how the amplitudes that beams receive of two directions correlate over beams.

        Returns
        -------
        correlation : (CORRELATIONS,) float64, ∫a(v) a(v − u) dv / ∫a² dv of a beam's amplitude a at even squares of u,
            the difference of the directions' sines: 1 at 0, 0 at the end
        reach : u at the end, the whole width of the receive pattern's support

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> correlation, reach = Acoustics.physical().receive_correlation(load_sonar("p900-45"))
        >>> correlation[[0, -1]].tolist(), round(math.degrees(reach), 2)
        ([1.0, 0.0], 9.03)
        """
        share = np.sqrt(np.linspace(0, 1, CORRELATIONS))
        if self.beam_pattern == "box":
            width = math.radians(sonar.beam_width_deg)
            reach = math.sin(min(width, math.pi / 2))
            correlation = 1 - np.arcsin(share * reach) / width
        else:
            array = self._receive_array(sonar)
            gaussian = self.beam_pattern == "gaussian"
            reach = 2 * (array.main_lobe_sine(GAUSSIAN_SUPPORT_LEVEL) if gaussian else array.support_sine())
            correlation = array.correlation(share * reach)
        correlation[-1] = 0.0
        return correlation, reach

    def null_rad(self, sonar: Sonar) -> float:
        """Return the shortest period over azimuth of receive and transmit pattern together, radians; 0 for a box.

        Without a transmit beam, it is the distance of two nulls of the receive pattern.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> sonar = load_sonar("p900-45,transmit_width_deg=none")
        >>> round(math.degrees(Acoustics.physical().null_rad(sonar)), 2)  # 1 / 0.886 widths
        1.13
        """
        if self.beam_pattern == "box":
            return 0.0
        per_rad = 1 / self._receive_array(sonar).null_sine()
        if self.transmit_beam and sonar.transmit_width_deg is not None:
            width = math.radians(sonar.transmit_width_deg)
            pattern = ArrayPattern("line_array", width, sonar.transmit_taper, sonar.side_lobe_db)
            per_rad += 1 / pattern.null_sine()  # the periods of a product
        return 1 / per_rad

    def transmit_pattern(self, sonar: Sonar) -> Callable | None:
        """Return the transmit beam pattern in azimuth; None if the fan is insonified evenly.

        Returns
        -------
        function (azimuth_rad) -> linear one-way power, 1 on the boresight

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> pattern = Acoustics.physical().transmit_pattern(load_sonar("p900-45,transmit_width_deg=60"))
        >>> round(float(pattern(np.radians(30.0))), 9)
        0.5
        """
        if not self.transmit_beam or sonar.transmit_width_deg is None:
            return None
        width = math.radians(sonar.transmit_width_deg)
        settings = {"taper": sonar.transmit_taper, "side_lobe_db": sonar.side_lobe_db}
        return partial(line_array_pattern, steer_azimuth_rad=0.0, beam_width_rad=width, **settings)

    def two_way_elevation_pattern(self, sonar: Sonar) -> Callable | None:
        """Return the two-way beam pattern in elevation; None for a box.

        Transmitter and receiver have the same pattern, upright and not steered.

        Returns
        -------
        function (sine of elevation) -> linear two-way power, 1 on the boresight

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> pattern = Acoustics.physical().two_way_elevation_pattern(load_sonar("p900-45"))  # 20 degrees high
        >>> round(float(pattern(np.sin(np.radians(10.0)))), 9)
        0.5
        """
        one_way = self.one_way_elevation_pattern(sonar)
        return None if one_way is None else lambda sine: one_way.power(sine) ** 2

    def one_way_elevation_pattern(self, sonar: Sonar) -> ArrayPattern | None:
        """Return the beam pattern in elevation of the transmitter or the receiver alone; None for a box.

        Noise of the water is received by it, echoes by the two-way pattern.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> pattern = Acoustics.physical().one_way_elevation_pattern(load_sonar("p900-45"))  # 20 degrees high
        >>> round(float(pattern.power(np.sin(np.radians(10.0)))), 9)  # its square is 0.5
        0.707106781
        """
        if self.elevation_pattern == "box":
            return None
        width = math.radians(sonar.elevation_fov_deg)
        return ArrayPattern(
            self.elevation_pattern, width, sonar.elevation_taper, sonar.side_lobe_db, two_way_width=True
        )

    def elevation_support_deg(self, sonar: Sonar) -> float:
        """Return the half-width of the elevation pattern's main lobe, degrees above and below the boresight.

        The main lobe ends where the two-way power is ELEVATION_SUPPORT_LEVEL; a box ends at half its aperture.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> sonar = load_sonar("p900-45")
        >>> Acoustics.ideal().elevation_support_deg(sonar), round(Acoustics.physical().elevation_support_deg(sonar), 2)
        (10.0, 27.35)
        """
        half_width = sonar.elevation_fov_deg / 2
        if self.elevation_pattern == "box":
            return half_width
        sine = self.one_way_elevation_pattern(sonar).main_lobe_sine(math.sqrt(ELEVATION_SUPPORT_LEVEL))
        return max(half_width, min(math.degrees(math.asin(min(sine, 1.0))), MAX_ELEVATION_DEG))

    def dense_elevation_deg(self, sonar: Sonar) -> float:
        """Return the elevation, degrees, beyond which the two-way pattern is so weak that coarse samples suffice.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> round(Acoustics.physical().dense_elevation_deg(load_sonar("p900-45")), 2)
        17.65
        """
        if self.elevation_pattern == "box":
            return self.elevation_support_deg(sonar)
        sine = self.one_way_elevation_pattern(sonar).main_lobe_sine(math.sqrt(SKIRTS_LEVEL))
        return min(math.degrees(math.asin(min(sine, 1.0))), MAX_ELEVATION_DEG)

    def max_elevation_deg(self, sonar: Sonar) -> float:
        """Return the elevation beyond which nothing is received: the end of the aperture, or of the side lobes.

        >>> from sonar_gl import load_sonar
        >>> Acoustics(elevation_pattern="line_array").max_elevation_deg(load_sonar("p900-45"))
        89.5
        """
        support_deg = self.elevation_support_deg(sonar)
        if self.elevation_pattern == "box":
            return support_deg
        sines = np.linspace(0, 1, 8193)
        received = sines[self.two_way_elevation_pattern(sonar)(sines) > SIDE_LOBE_LEVEL]
        return max(support_deg, min(math.degrees(math.asin(received[-1])), MAX_SIDE_LOBE_DEG))

    # ---- pulse --------------------------------------------------------------------------------------------

    def pulse_weights(self, sonar: Sonar) -> np.ndarray | None:
        """Return the kernel of the matched filter over bins, by `sonar_gl.acoustics.pulse.bin_weights`; None without.

        Returns
        -------
        (n,) float32, the share of an echo that falls into each of the bins around its own
        """
        return bin_weights(sonar.bin_size_m, *self.pulse_response(sonar)) if self.pulse else None

    def pulse_level(self, sonar: Sonar) -> float:
        """Return the factor of the matched filter on the sum of an echo: resolution cell over bin, 1 at least.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> round(Acoustics().pulse_level(load_sonar("p900-45,bandwidth_hz=20e3")), 2)  # 50.8 mm over 25.4 mm
        2.0
        """
        cells = resolution_cell_m(*self.pulse_response(sonar)) / sonar.bin_size_m if self.pulse else 1.0
        return cells if cells > 1 + 1e-9 else 1.0  # rounding may make a cell as long as a bin a little longer

    def pulse_response(self, sonar: Sonar) -> PulseResponse:
        """Return bandwidth and taper of the pulse, and the speed of sound.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> pulse = Acoustics(water=Water(sound_speed_m_s=1500.0)).pulse_response(load_sonar("p900-45"))
        >>> round(pulse.bandwidth_hz)  # 1.3628 c / 2 / 25.4 mm
        40241
        """
        speed_m_s = self.assumed_sound_speed_m_s()  # bins lie at shown ranges
        # the resolution cell is inversely proportional to the bandwidth
        as_a_bin_hz = resolution_cell_m(1.0, sonar.pulse_taper, speed_m_s) / sonar.bin_size_m
        bandwidth_hz = sonar.bandwidth_hz or min(as_a_bin_hz, sonar.frequency_hz)  # no pulse has a wider band
        return PulseResponse(float(bandwidth_hz), sonar.pulse_taper, speed_m_s)


def check_moved(what: str, names) -> None:
    """Raise an Error for the first name that is a field of `Sonar` or `Water` now."""
    for name in names:
        if name in MOVED_TO_WATER:
            raise Error(
                f"{what}: {name} describes the water, and is a field of Water now (write it there: "
                f"water=sonar_gl.Water({name}=...) in Python, --water {name}=... on a command line, "
                f"water = {{ {name} = ... }} in a job)"
            )
        if name in MOVED_TO_SONAR:
            new = MOVED_TO_SONAR[name]
            raise Error(
                f"{what}: {name} describes the device, and is a field of Sonar now (write it as {new} there: in a "
                f"sonar's TOML file, by --sonar p900-45,{new}=..., or by dataclasses.replace)"
            )
