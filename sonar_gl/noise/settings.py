"""The amounts of noise: speckle, receiver noise, interference, Gaussian noise, median, salt and pepper."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from sonar_gl.core.checks import (
    check_fields,
    check_kind,
    check_whole_number,
    is_number,
    make_numbers_plain,
    shown,
)
from sonar_gl.core.errors import Error
from sonar_gl.core.key_values import parse_fields
from sonar_gl.core.signatures import shown_by_fields
from sonar_gl.core.warn import warn_caller
from sonar_gl.sonar.sonar import ABSOLUTE_LEVEL, LEVEL

BOUNDS = (  # field, least, most, hint
    ("gaussian", 0, 1, "a fraction of full scale"),
    ("salt_and_pepper", 0, 1, "a fraction of the bins"),
    ("cloud_gaussian_m", 0, 10, "give metres"),
    ("ambient_db", -300, 100, LEVEL),
    ("interference_lines", 0, 1000, "a mean number in a ping"),
    ("interference_db", -300, 100, LEVEL),
    ("dropped_beams", 0, 1, "a fraction of the beams"),
)
SWITCHES = ("speckle", "follow_motion", "self_noise", "thermal_noise")
MOVED = {
    "electronic_db": ("self_noise", "self_noise_db")
}  # field: the switch in its place, its name in `Sonar`


@shown_by_fields
@dataclass(frozen=True)
class Noise:
    """The noise of a ping: which terms it has, and how much of each.

    The terms apply in this order: speckle, receiver noise, interference, ring-down, Gaussian, median, salt and
    pepper, dropped beams.

    Parameters
    ----------
    speckle : whether the diffuse echo is multiplied by an exponential variate of mean 1, correlated between overlapping
        beams as by a line array: fully developed speckle, as [11] of docs/acoustics.md derives it. Bodies with a
        `speckle_shape` also have a texture. Specular lobes are steady echoes, which speckle spares
    gaussian : standard deviation of Gaussian noise in each bin, relative to full scale 1; negative sums
        become 0
    salt_and_pepper : fraction of bins set to 0 or to full scale 1, half each
    median : 0 (none), 3 or 5: size of a median filter over beams and bins
    cloud_gaussian_m : metres, standard deviation of the noise on the point cloud of the founding paper's
        picture; it does not act on pings
    looks : number of independent speckle patterns, each with its receiver noise, that are averaged; the
        contrast becomes 1/√looks
    follow_motion : False: every ping number has its own speckle. True: place-locked speckle, which depends on
        seed and pose of the sonar. A place keeps it while the sonar turns or moves along the line of sight, and loses
        it as its aspect changes; docs/acoustics.md has the rates
    self_noise : whether there is the receiver's own noise, whose level is the sonar's `self_noise_db`, and the
        ring-down of a sonar that states one. The TVG of range law "sonar_equation" amplifies the noise; other laws have
        no TVG. Fields add: echo E and noise N become |√E g + √N n|², with g of the speckle and n independent of it
    ambient_db : mean power of ambient noise before the TVG, dB relative to the echo of a sphere of
        reflectivity 1 about the sonar, at 1 m; None for none
    interference_lines : mean number of pulses of another sonar in a ping
    interference_db : power of such a pulse on the axis of a beam, as `ambient_db`
    thermal_noise : whether there is the thermal noise of the water, which adds as `self_noise`. Its level follows from
        the sonar's `source_level_db`, by `sonar_gl.noise.receiver.absolute_levels`
    dropped_beams : fraction of beams whose data is lost in a ping: they are 0 in all bins

    Raises
    ------
    Error
        if an amount is out of bounds, or has moved to `Sonar` or `Body`.
    """

    speckle: bool = False
    gaussian: float = 0.0
    salt_and_pepper: float = 0.0
    median: int = 0
    cloud_gaussian_m: float = 0.0
    looks: int = 1
    follow_motion: bool = False
    self_noise: bool = False
    ambient_db: float | None = None
    interference_lines: float = 0.0
    interference_db: float = -40.0
    thermal_noise: bool = False
    dropped_beams: float = 0.0

    def __post_init__(self):
        make_numbers_plain(self)
        for key in SWITCHES:
            if not isinstance(getattr(self, key), bool):
                raise Error(f"noise: {key} must be True or False (got {shown(getattr(self, key))})")
        check_fields("noise", self, BOUNDS)
        check_whole_number("noise: looks", self.looks, 1, 1000)
        # follow_motion does nothing without it: "physical,speckle=no" is plain
        if not self.speckle and self.looks != 1:
            raise Error(f"noise: looks needs speckle (got {self.looks!r} without it; switch speckle on)")
        if not is_number(self.median) or self.median not in (0, 3, 5):
            raise Error(f"noise: median must be 0, 3 or 5 (got {shown(self.median)}; 0 is none)")
        if self.ambient_db is not None and self.ambient_db > 0:  # above all that comes back
            warn_caller(f"noise: ambient_db = {self.ambient_db:g} {ABSOLUTE_LEVEL}")

    def __new__(cls, *arguments, **fields):
        """Refuse fields that describe the device."""
        check_moved_amounts("noise", fields)
        return super().__new__(cls)

    @property
    def has_receiver_noise(self) -> bool:
        """Whether the receiver adds noise, its own or the water's."""
        return bool(self.self_noise or self.thermal_noise or self.ambient_db is not None)

    @property
    def acts_on_field(self) -> bool:
        """Whether a term acts on the complex echo field of a ping (`sonar_gl.noise.field.FieldNoise`)."""
        return bool(self.speckle or self.has_receiver_noise or self.interference_lines)

    @property
    def acts_on_bins(self) -> bool:
        """Whether a term acts on the intensities of the bins, after those of the field."""
        return bool(self.gaussian or self.median or self.salt_and_pepper or self.dropped_beams)

    @classmethod
    def none(cls) -> Noise:
        """Return the noise with all terms off."""
        return cls()

    @classmethod
    def demarco2015(cls) -> Noise:
        """Return the founding paper's noise: 1 cm on the point cloud, median 3, salt and pepper on 0.5 %.

        The first two amounts are those of its published code. The paper gives none for the third.
        """
        return cls(median=3, salt_and_pepper=0.005, cloud_gaussian_m=0.01)

    @classmethod
    def physical(cls, **settings) -> Noise:
        """Return place-locked speckle, and self-noise that shows in distant shadows; settings are the fields, by name.

        A sonar that stands still sees the same speckle again, as real ones do (docs/realism.md), and new noise.

        At 30 m a TVG of 20 log r + 2αr has added 47 dB at 900 kHz in sea water, so that −90 dB, the default of
        `Sonar.self_noise_db`, becomes −43 dB of full scale; at 10 m it becomes −64 dB. That level is 31 dB above the
        thermal noise in a band of 30 kHz at a source level of 205 dB (`sonar_gl.noise.receiver.absolute_levels`). It is
        chosen for its likeness to pictures of such sonars, not measured.

        >>> Noise.physical(speckle=False) == Noise(follow_motion=True, self_noise=True)
        True
        """
        return cls(**{"speckle": True, "follow_motion": True, "self_noise": True} | settings)

    @classmethod
    def parse(cls, text: str) -> Noise:
        """Return the noise that a command line states: a preset, amounts, or a preset and amounts.

        Presets are those of `PRESETS`.

        >>> Noise.parse("gaussian=0.01,median=3") == Noise(gaussian=0.01, median=3)
        True
        >>> Noise.parse("physical,self_noise=off") == Noise(speckle=True, follow_motion=True)
        True
        """
        check_kind("noise", text, str, "such as 'physical,follow_motion=no'")
        check_moved_amounts(f"noise {text!r}", [item.partition("=")[0].strip() for item in text.split(",")])
        preset, amounts = parse_fields("noise", text, cls, presets=PRESETS)
        return replace(PRESETS[preset or "none"], **amounts)


def check_moved_amounts(what: str, names: Iterable[str]) -> None:
    """Raise an Error for the first name that is a field of `Sonar` or `Body` now."""
    for name in names:
        if name == "speckle_shape":
            raise Error(
                f"{what}: speckle_shape describes a surface, and is a field of Body now (write it there: "
                "sonar_gl.Body(..., speckle_shape=...) or dataclasses.replace in Python, <sonar_gl:speckle_shape> in a "
                "scene file)"
            )
        if name in MOVED:
            switch, new = MOVED[name]
            raise Error(
                f"{what}: {name} describes the device, and is {new} of Sonar now (switch it on by {switch} here, and "
                f"write the level as {new} in a sonar's TOML file, by --sonar p900-45,{new}=..., or by "
                "dataclasses.replace; ambient_db is a level of the noise alone)"
            )


PRESETS = {"none": Noise.none(), "physical": Noise.physical(), "demarco2015": Noise.demarco2015()}
