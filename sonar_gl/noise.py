"""What noise does to a ping: speckle, receiver noise, salt and pepper, median blur."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from sonar_gl.types import Error, Ping, nearest_names

STREAMS = {
    "speckle": 1,
    "gaussian": 2,
    "salt_and_pepper": 3,
    "cloud": 4,
}  # never renumber: bytes would change


@dataclass(frozen=True)
class Noise:
    """Amounts of noise. The order is speckle, Gaussian, median, salt and pepper.

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

    Raises
    ------
    Error
        if an amount makes no sense.
    """

    speckle: bool = False
    gaussian: float = 0.0
    salt_and_pepper: float = 0.0
    median: int = 0
    cloud_gaussian_m: float = 0.0

    def __post_init__(self):
        if not isinstance(self.speckle, (bool, np.bool_)):
            raise Error(f"noise: speckle must be True or False (got {self.speckle!r})")
        for key, high, hint in (
            ("gaussian", 1, "a fraction of full scale"),
            ("salt_and_pepper", 1, "a fraction of the bins"),
            ("cloud_gaussian_m", 10, "give metres"),
        ):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise Error(f"noise: {key} must be a number (got {value!r})")
            if not 0 <= value <= high:  # NaN too
                raise Error(f"noise: {key} must lie in 0..{high} (got {value:g}; {hint})")
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
        """Speckle, and a receiver 50 dB below full scale."""
        return cls(speckle=True, gaussian=1e-5)

    @classmethod
    def parse(cls, text: str) -> Noise:
        """Noise from a command line: "none", "demarco2015", "physical", amounts, or one and then the other.

        >>> Noise.parse("gaussian=0.01,median=3") == Noise(gaussian=0.01, median=3)
        True
        >>> Noise.parse("physical,speckle=no")
        Noise(speckle=False, gaussian=1e-05, salt_and_pepper=0.0, median=0, cloud_gaussian_m=0.0)
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
    """The value of one `key=value` of a command line; a bare `speckle` switches it on."""
    if key == "speckle":
        words = {None: True, "1": True, "yes": True, "true": True, "on": True}
        words |= {"0": False, "no": False, "false": False, "off": False}
        if value not in words:
            raise Error(f"noise {text!r}: speckle must be yes or no (got {value!r})")
        return words[value]
    try:
        number = float(value)
    except (TypeError, ValueError):
        got = "no number" if not value else repr(value)
        raise Error(f"noise {text!r}: {key} must be a number, as in {key}=0 (got {got})") from None
    return int(number) if key == "median" and number.is_integer() else number


def check_seed(number, what: str = "seed") -> int:
    """A whole number, 0 or more, or an `Error`."""
    if isinstance(number, (bool, np.bool_)) or not isinstance(number, (int, np.integer)) or number < 0:
        raise Error(f"{what} must be a whole number, 0 or more (got {number!r})")
    return int(number)


def stream(seed: int, ping_number: int, term: str) -> np.random.Generator:
    """Random numbers for one term of one ping: no term, switched on or off, moves those of another.

    >>> bool(stream(7, 0, "speckle").random() == stream(7, 0, "speckle").random())
    True
    """
    key = (check_seed(ping_number, "ping_number"), STREAMS[term])
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(check_seed(seed), spawn_key=key)))


def add_noise(ping: Ping, noise: Noise | None, seed: int, ping_number: int = 0) -> Ping:
    """The ping with noise, and a record of it in `meta`; the ping itself where no term acts on it.

    Parameters
    ----------
    ping : its `meta["sonar"]["beam_width_deg"]`, if there, correlates the speckle of overlapping beams
    noise : amounts; None = none
    seed, ping_number : whole numbers, 0 or more; the same two give the same bytes

    Returns
    -------
    Ping with (B, K) float32 intensity, all 0 or more
    """
    check_seed(seed), check_seed(ping_number, "ping_number")
    if noise is None or not (noise.speckle or noise.gaussian or noise.median or noise.salt_and_pepper):
        return ping
    # compiled, so slow to import, and not asked for by who only names amounts
    from sonar_gl.normals import add_normal
    from sonar_gl.speckle import multiply_by_speckle

    out = np.array(ping.intensity, dtype=np.float32, order="C")
    if noise.speckle:
        width = ping.meta.get("sonar", {}).get("beam_width_deg")
        width = None if width is None else float(np.radians(width))
        multiply_by_speckle(out, ping.azimuth_rad, width, stream(seed, ping_number, "speckle"))
    if noise.gaussian:
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
