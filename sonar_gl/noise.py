"""What noise does to a ping: speckle, receiver noise, other sonars, salt and pepper, median blur."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from sonar_gl.types import Error, Ping, nearest_names

STREAMS = {
    "speckle": 1,
    "gaussian": 2,
    "salt_and_pepper": 3,
    "cloud": 4,
    "texture": 5,
    "receiver": 6,
    "interference": 7,
}  # never renumber: bytes would change


BOUNDS = (
    ("gaussian", 0, 1, "a fraction of full scale"),
    ("salt_and_pepper", 0, 1, "a fraction of the bins"),
    ("cloud_gaussian_m", 0, 10, "give metres"),
    ("speckle_shape", 0.05, 1e4, "below 1 is spiky, None is fully developed"),
    ("electronic_db", -300, 100, "dB over the echo of an all-round surface at 1 m"),
    ("ambient_db", -300, 100, "dB over the echo of an all-round surface at 1 m"),
    ("interference_lines", 0, 1000, "a mean number in a ping"),
    ("interference_db", -300, 100, "dB over the echo of an all-round surface at 1 m"),
)
MAY_BE_NONE = ("speckle_shape", "electronic_db", "ambient_db")
SWITCHES = ("speckle", "follow_motion")


@dataclass(frozen=True)
class Noise:
    """Amounts of noise. The order is speckle, receiver, interference, Gaussian, median, salt and pepper.

    Parameters
    ----------
    speckle : fully developed speckle, the echo times an exponential of mean 1, correlated over
        overlapping beams as a line array dictates
    gaussian : standard deviation of what the receiver adds to each bin, relative to full scale 1;
        sums below 0 become 0
    salt_and_pepper : fraction of bins set to 0 or to full scale 1, half each
    median : 0 (none), 3 or 5: size of a median filter over beams and bins
    cloud_gaussian_m : metres, standard deviation of the noise that the founding paper's picture puts
        on its point cloud; pings know no cloud, they leave it alone
    speckle_shape : None (fully developed), or ν of the K distribution: the echo is in addition multiplied by
        a texture, a Gamma(ν, 1/ν); contrast √(1 + 2/ν)
    looks : independent speckle patterns, and receiver noises with them, that are averaged; contrast 1/√looks
    follow_motion : False: each ping number has its own speckle; True: the sonar's pose decides, so it stands
        still with the sonar and moves with it (`frozen.frozen_field` tells what counts as motion)
    electronic_db, ambient_db : None, or mean power of the receiver's own and of the sea's noise, before the
        TVG, dB over the echo of an all-round surface of reflectivity 1 at 1 m; it rises with the TVG of range
        law "sonar_equation", others have none. The field adds to the echo's: |√E g + √N n|²
    interference_lines : mean number of pulses of another sonar in a ping
    interference_db : of one in the beam that points at it, as `electronic_db`

    Raises Error if an amount makes no sense.
    """

    speckle: bool = False
    gaussian: float = 0.0
    salt_and_pepper: float = 0.0
    median: int = 0
    cloud_gaussian_m: float = 0.0
    speckle_shape: float | None = None
    looks: int = 1
    follow_motion: bool = False
    electronic_db: float | None = None
    ambient_db: float | None = None
    interference_lines: float = 0.0
    interference_db: float = -40.0

    def __post_init__(self):
        for key in SWITCHES:
            if not isinstance(getattr(self, key), (bool, np.bool_)):
                raise Error(f"noise: {key} must be True or False (got {getattr(self, key)!r})")
        for key, low, high, hint in BOUNDS:
            value = getattr(self, key)
            if value is None and key in MAY_BE_NONE:
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise Error(f"noise: {key} must be a number (got {value!r})")
            if not low <= value <= high:  # NaN too
                raise Error(f"noise: {key} must lie in {low:g}..{high:g} (got {value:g}; {hint})")
        looks = self.looks
        if isinstance(looks, bool) or not isinstance(looks, (int, np.integer)) or not 1 <= looks <= 1000:
            raise Error(f"noise: looks must be a whole number in 1..1000 (got {looks!r})")
        for key in ("speckle_shape", "looks", "follow_motion"):
            if not self.speckle and getattr(self, key) != type(self).__dataclass_fields__[key].default:
                raise Error(f"noise: {key} says how speckle is, and there is none (switch speckle on)")
        if isinstance(self.median, bool) or self.median not in (0, 3, 5):
            raise Error(f"noise: median must be 0, 3 or 5 (got {self.median!r}; 0 is none)")

    @classmethod
    def none(cls) -> Noise:
        """No noise."""
        return cls()

    @classmethod
    def demarco2015(cls) -> Noise:
        """The founding paper: 1 cm on the point cloud, median 3, then salt and pepper on 0.5 %.

        The first two are those of its published code; the paper gives no amount for the third.
        """
        return cls(median=3, salt_and_pepper=0.005, cloud_gaussian_m=0.01)

    @classmethod
    def physical(cls) -> Noise:
        """Speckle, and a receiver whose noise one sees in far shadows.

        −90 dB becomes −43 dB of full scale at 30 m, where a TVG of 20 log r + 2αr at 900 kHz in sea water has
        added 47 dB, and −64 dB at 10 m. It is 32 dB above the water's thermal noise of
        `receiver.ambient_noise_db`: chosen by the look of such sonars' pictures, not measured.
        """
        return cls(speckle=True, electronic_db=-90.0)

    @classmethod
    def parse(cls, text: str) -> Noise:
        """Noise from a command line: "none", "demarco2015", "physical", amounts, or one and then the other.

        >>> Noise.parse("gaussian=0.01,median=3") == Noise(gaussian=0.01, median=3)
        True
        >>> Noise.parse("physical,electronic_db=none") == Noise(speckle=True)
        True
        """
        profiles = {"none": cls.none, "demarco2015": cls.demarco2015, "physical": cls.physical}
        keys = [f.name for f in fields(cls)]
        start, amounts = cls(), {}
        for place, item in enumerate(item.strip() for item in text.split(",")):
            key, equals, value = (part.strip() for part in item.partition("="))
            if place == 0 and not equals and key in profiles:
                start = profiles[key]()
            elif key not in keys:
                known = keys if equals or place else [*profiles, *keys]
                raise Error(f"noise {text!r}: unknown name (got {key!r}; {nearest_names(key, known)})")
            elif key in amounts:
                raise Error(f"noise {text!r}: {key} must be given once")
            else:
                amounts[key] = _amount(text, key, value if equals else None)
        return replace(start, **amounts)


def _amount(text: str, key: str, value: str | None):
    """The value of one `key=value` of a command line; a bare switch, such as `speckle`, is on."""
    if key in MAY_BE_NONE and value == "none":
        return None
    if key in SWITCHES:
        words = {None: True, "1": True, "yes": True, "true": True, "on": True}
        words |= {"0": False, "no": False, "false": False, "off": False}
        if value not in words:
            raise Error(f"noise {text!r}: {key} must be yes or no (got {value!r})")
        return words[value]
    try:
        number = float(value)
    except (TypeError, ValueError):
        got = "no number" if not value else repr(value)
        raise Error(f"noise {text!r}: {key} must be a number, as in {key}=0 (got {got})") from None
    return int(number) if key in ("median", "looks") and number.is_integer() else number


def check_seed(number, what: str = "seed") -> int:
    """A whole number, 0 or more, or an `Error`."""
    if isinstance(number, (bool, np.bool_)) or not isinstance(number, (int, np.integer)) or number < 0:
        raise Error(f"{what} must be a whole number, 0 or more (got {number!r})")
    return int(number)


def stream(seed: int, ping_number: int, term: str, *more: int) -> np.random.Generator:
    """Random numbers for one term of one ping: no term, switched on or off, moves those of another.

    more : whole numbers, 0 or more, of streams within the term

    >>> bool(stream(7, 0, "speckle").random() == stream(7, 0, "speckle").random())
    True
    """
    key = (check_seed(ping_number, "ping_number"), STREAMS[term], *more)
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(check_seed(seed), spawn_key=key)))


def add_noise(ping: Ping, noise: Noise | None, seed: int, ping_number: int = 0) -> Ping:
    """The ping with noise, and a record of it in `meta`; the ping itself where no term acts on it.

    Parameters
    ----------
    ping : its `meta["sonar"]["beam_width_deg"]`, if there, correlates the fields of overlapping beams, and
        `bandwidth_hz` and `pulse_taper` of `meta["acoustics"]` those of bins, where it names a bandwidth
    noise : amounts; None = none
    seed, ping_number : whole numbers, 0 or more; the same two give the same bytes

    Returns
    -------
    Ping with (B, K) float32 intensity, all 0 or more
    """
    check_seed(seed), check_seed(ping_number, "ping_number")
    if noise is None:
        return ping
    fields_act = noise.speckle or noise.interference_lines
    fields_act = fields_act or (noise.electronic_db, noise.ambient_db) != (None, None)
    if not (fields_act or noise.gaussian or noise.median or noise.salt_and_pepper):
        return ping
    out = np.array(ping.intensity, dtype=np.float32, order="C")
    # compiled, so slow to import, and not asked for by who only names amounts
    if fields_act:
        from sonar_gl.grain import Grain

        def random(term, *more):  # what belongs to the pose has `more`
            return stream(seed, 0 if more else ping_number, term, *more)

        Grain(ping, noise, random).add(out)
    if noise.gaussian:
        from sonar_gl.normals import add_normal

        add_normal(stream(seed, ping_number, "gaussian"), noise.gaussian, out)
    if noise.median:
        import cv2  # slow to import, and seldom asked for

        out = cv2.medianBlur(out, int(noise.median))
    if noise.salt_and_pepper:  # after the median, as in the founding paper: it would undo this
        draw = stream(seed, ping_number, "salt_and_pepper").random(out.shape, dtype=np.float32)
        out[draw < noise.salt_and_pepper / 2] = 0.0
        out[draw >= 1 - noise.salt_and_pepper / 2] = 1.0
    out.setflags(write=False)
    record = {"noise": asdict(noise), "seed": int(seed), "ping_number": int(ping_number)}
    return replace(ping, intensity=out, meta={**ping.meta, **record})
