"""The settings of a live session: sonar, acoustics, noise, samples, and how pings are shown."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import Water
from sonar_gl.analysis.terms import TERMS, Term
from sonar_gl.core.checks import (
    check_choice,
    check_kind,
    check_number,
    check_whole_number,
    make_numbers_plain,
)
from sonar_gl.core.errors import Error
from sonar_gl.imaging.colormaps import DEFAULT_COLORMAP
from sonar_gl.imaging.fan_image import MAX_HEIGHT
from sonar_gl.imaging.styles import FanStyle
from sonar_gl.noise.settings import Noise
from sonar_gl.raster.engine_names import ENGINES
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sampling import check_tolerance
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

FORMS = "fan", "polar"
DEFAULT_RATE_HZ = 25.0
DEFAULT_TOLERANCE = 0.05
DEFAULT_HEIGHT = 640


@dataclass(frozen=True)
class LiveSettings:
    """Everything about the pings of a live session but where the sonar and the bodies are; Error if a part is invalid.

    Parameters
    ----------
    sonar : Sonar, or a text of `load_sonar`
    range_m : maximum range in place of the sonar's, metres; bins as by `Sonar.with_range`; None for the sonar's own
    n_bins : number of range bins in place of the sonar's; None for its own
    acoustics : Acoustics, with the water
    noise : Noise, or a text of `Noise.parse`
    tolerance : as for `Simulator`
    engine : "auto", "opengl" or "cpu", as for `Simulator`; None as for `Simulator`, too
    seed : of the noise
    counts : Counts in place of the sonar's: law and gain; None for the sonar's own
    colormap : of `colorize`
    form : "fan", seen from above, or "polar", a column for each beam, port on the left, far ranges at the top
    height : of the picture, pixels
    max_rate_hz : pings per second at most

    >>> LiveSettings("p900-45").changed(range_m=20.0).device.range_max_m
    20.0
    """

    sonar: Sonar
    range_m: float | None = None
    n_bins: int | None = None
    acoustics: Acoustics = field(default_factory=Acoustics.physical)
    noise: Noise = field(default_factory=Noise.physical)
    tolerance: float = DEFAULT_TOLERANCE
    engine: str | None = None
    seed: int = 0
    counts: Counts | None = None
    colormap: str = DEFAULT_COLORMAP
    form: str = "fan"
    height: int = DEFAULT_HEIGHT
    max_rate_hz: float = DEFAULT_RATE_HZ

    def __post_init__(self):
        make_numbers_plain(self)
        if isinstance(self.sonar, str):
            object.__setattr__(self, "sonar", load_sonar(self.sonar))
        if isinstance(self.noise, str):
            object.__setattr__(self, "noise", Noise.parse(self.noise))
        check_kind("sonar", self.sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", self.acoustics, Acoustics, "such as sonar_gl.Acoustics.physical()")
        check_kind("noise", self.noise, Noise, "such as sonar_gl.Noise.physical()")
        check_kind("counts", self.counts, Counts | None, 'such as Counts("power", exponent=0.26)')
        check_tolerance(self.tolerance)
        check_whole_number("seed", self.seed)
        if self.engine is not None:
            check_choice("engine", self.engine, ENGINES)
        lacking = self.style.setting_of_8_bits  # raises Error for an unknown colour map
        if self.counts is not None and self.counts.bits > self.sonar.counts.bits and lacking is not None:
            raise Error(
                "counts of 16 bits need the colour map gray, since others have 8 bits "
                f"(got {self.colormap}; give gray, or bits = 8)"
            )
        check_choice("form", self.form, FORMS)
        check_whole_number("height", self.height, 1, MAX_HEIGHT, "give pixels")
        check_number("max_rate_hz", self.max_rate_hz, 0.01, 1000.0, "give pings per second")
        self.device  # noqa: B018 - raises Error for a range that the sonar cannot have

    @property
    def device(self) -> Sonar:
        """The sonar with these ranges, bins and law of counts."""
        sonar = self.sonar if self.n_bins is None else replace(self.sonar, n_bins=self.n_bins)
        sonar = sonar if self.range_m is None else self.sonar.with_range(self.range_m, self.n_bins)
        return sonar if self.counts is None else replace(sonar, counts=self.counts)

    @property
    def law(self) -> Counts:
        """The law of counts by which pings are shown."""
        return self.sonar.counts if self.counts is None else self.counts

    @property
    def style(self) -> FanStyle:
        """The style of pictures of the form "fan", of which those of the form "polar" have the colours."""
        return FanStyle(self.height, self.colormap)

    @property
    def water(self) -> Water:
        """The water of the acoustics."""
        return self.acoustics.water

    def changed(self, **values) -> LiveSettings:
        """Return these settings with other values of some fields; raise Error if a name is unknown or a value invalid.

        Beside the fields there are `water`, a Water, and `gain_db`, a fixed gain of the law of counts. Another sonar
        comes with its own range, bins and counts, unless they are given, too.
        """
        known = [one.name for one in fields(self)] + ["water", "gain_db"]
        for name in values:
            check_choice("setting", name, known)
        if "water" in values:
            water = values.pop("water")
            check_kind("water", water, Water, "such as sonar_gl.Water(temperature_c=4.0)")
            acoustics = values.get("acoustics", self.acoustics)
            check_kind("acoustics", acoustics, Acoustics, "such as Acoustics.physical()")
            values["acoustics"] = replace(acoustics, water=water)
        gain_db = values.pop("gain_db", None)
        if "sonar" in values:
            values = {"range_m": None, "n_bins": None, "counts": None} | values
        out = replace(self, **values)
        return out if gain_db is None else replace(out, counts=out.law.changed({"gain_db": gain_db}))

    def is_on(self, term: str) -> bool:
        """Return whether a term of acoustics or noise is on, by its name in `analysis.terms.TERMS`."""
        return _term(term).is_on(self.acoustics, self.noise)

    def switched(self, term: str, on: bool) -> LiveSettings:
        """Return these settings with a term of acoustics or noise on or off.

        >>> LiveSettings("p900-45").switched("multipath", True).acoustics.multipath
        'incoherent'
        """
        if on and self.is_on(term):
            return self
        found = _term(term)
        acoustics, noise = found.changed(self.acoustics, self.noise, found.on if on else found.off)
        return replace(self, acoustics=acoustics, noise=noise)


def term_names() -> list[str]:
    """Return the names of the terms of acoustics and noise, as `sonar-gl plan` prices them."""
    return [term.name for term in TERMS]


def _term(name: str) -> Term:
    check_choice("term", name, term_names())
    return next(term for term in TERMS if term.name == name)


class SettingsTrial:
    """The settings of the next ping, which are taken back if no ping can be made with them.

    To be used by one thread at a time. There are none to go back to from those of the first ping.
    """

    def __init__(self, settings: LiveSettings):
        self.settings = self._proven = settings  # of the next ping, and the last ones that one was made with
        self._settings_problem = self._ping_problem = ""

    @property
    def problem(self) -> str:
        """A sentence about why the last settings were not taken, or the last ping failed; "" if all is well."""
        return self._settings_problem or self._ping_problem

    def change(self, settings: LiveSettings) -> None:
        """Take other settings for the next ping."""
        self.settings, self._settings_problem = settings, ""

    def succeed(self, settings: LiveSettings) -> None:
        """Note that a ping was made with some settings."""
        self._proven, self._ping_problem = settings, ""

    def fail(self, settings: LiveSettings, problem: str) -> bool:
        """Note why a ping failed with some settings, and take them back unless others have come since.

        Returns whether other settings may be tried at once: the failure is not that of settings that worked before.
        """
        if settings == self._proven:
            self._ping_problem = problem
            return False
        if settings == self.settings:
            self.settings, self._settings_problem = self._proven, problem
        return True
