"""What noise does to a ping: speckle, receiver noise, salt and pepper, median blur."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache

import numpy as np

from sonar_gl.types import Error, Ping, nearest_names

STREAMS = {
    "speckle": 1,
    "gaussian": 2,
    "salt_and_pepper": 3,
    "cloud": 4,
}  # never renumber: bytes would change
APERTURE = 0.885892941379  # −3 dB width of a uniform line array in λ/L, twice the x of sinc²(x) = 1/2
BLOCK = 16  # bins of speckle drawn at a time; another number would change the bytes


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


@lru_cache(maxsize=8)
def _beams_from_elements(azimuths_rad: tuple[float, ...], beam_width_rad: float) -> np.ndarray | None:
    """(B, M) float32 that turns M independent normals into B beams correlated as sinc(0.8859 D / width).

    The rows are what a line array does: each of M elements adds a wave over azimuth, cos and sin of one
    frequency, and the frequencies fill evenly the band that the aperture passes. Rows have unit power.
    The sum repeats itself after a period, which must be longer than the fan by some widths; the whole
    circle is its own period. None where no two beams overlap: independent draws do then, beams a width
    apart share 2 % of their intensity's variance.
    """
    azimuth = np.asarray(azimuths_rad)
    if len(azimuth) < 2 or np.diff(azimuth).min() >= 0.95 * beam_width_rad:
        return None
    period = min(2 * np.pi, 1.2 * (azimuth[-1] - azimuth[0]) + 12 * beam_width_rad)
    elements = max(1, round(APERTURE * period / beam_width_rad))
    if period < 2 * np.pi:
        period = elements * beam_width_rad / APERTURE  # the width exact, the period nearly as asked
    waves = (np.arange(elements) - (elements - 1) / 2) * (2 * np.pi / period)
    phase = azimuth[:, None] * waves
    # waves come in pairs ±f: cos for one of a pair, sin for the other, √2 each; the wave 0 stands alone
    out = np.where(waves > 0, np.sqrt(2) * np.cos(phase), np.sqrt(2) * np.sin(phase))
    out[:, waves == 0] = 1.0
    out = (out / np.sqrt(elements)).astype(np.float32)
    out.setflags(write=False)
    return out


def speckle_field(azimuth_rad, n_bins: int, beam_width_rad: float | None, random) -> np.ndarray:
    """|g|² of a circular complex Gaussian g of unit variance: fully developed speckle.

    Parameters
    ----------
    azimuth_rad : (B,) beam centres, radians, rising
    n_bins : K; bins are independent of one another
    beam_width_rad : −3 dB width of a beam, radians; None = beams are independent
    random : numpy.random.Generator

    Returns
    -------
    (B, K) float32, exponential, mean 1, contrast 1, standard deviation 5.57 dB

    Notes
    -----
    Beams D apart hear through one aperture: their fields correlate as sinc(0.8859 D / width), the
    Fourier transform of a uniform line array, their intensities as its square [1]_.

    References
    ----------
    .. [1] Goodman, Speckle Phenomena in Optics, 2007 (van Cittert-Zernike theorem)
    """
    factor = None
    if beam_width_rad:
        factor = _beams_from_elements(tuple(np.asarray(azimuth_rad, np.float64).tolist()), beam_width_rad)
    B = len(azimuth_rad)
    out = np.empty((B, n_bins), np.float32)
    for k in range(0, n_bins, BLOCK):  # small products: BLAS threads stall on busy cores
        block = out[:, k : k + BLOCK]
        n = block.shape[1]
        rows = B if factor is None else factor.shape[1]
        parts = random.standard_normal((rows, 2 * n), dtype=np.float32)  # real parts, imaginary parts
        if factor is not None:
            parts = factor @ parts
        np.square(parts, out=parts)
        np.add(parts[:, :n], parts[:, n:], out=block)
    out *= np.float32(0.5)
    return out


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
    streams = {term: stream(seed, ping_number, term) for term in ("speckle", "gaussian", "salt_and_pepper")}
    if noise is None or not (noise.speckle or noise.gaussian or noise.median or noise.salt_and_pepper):
        return ping
    out = np.array(ping.intensity, dtype=np.float32, order="C")
    if noise.speckle:
        width = ping.meta.get("sonar", {}).get("beam_width_deg")
        width = None if width is None else float(np.radians(width))
        out *= speckle_field(ping.azimuth_rad, out.shape[1], width, streams["speckle"])
    if noise.gaussian:
        added = streams["gaussian"].standard_normal(out.shape, dtype=np.float32)
        added *= np.float32(noise.gaussian)
        out += added
        np.maximum(out, 0, out=out)
    if noise.median:
        import cv2  # slow to import, and seldom asked for

        out = cv2.medianBlur(out, int(noise.median))
    if noise.salt_and_pepper:  # after the median, as in the founding paper: it would undo this
        draw = streams["salt_and_pepper"].random(out.shape, dtype=np.float32)
        out[draw < noise.salt_and_pepper / 2] = 0.0
        out[draw >= 1 - noise.salt_and_pepper / 2] = 1.0
    out.setflags(write=False)
    record = {"noise": asdict(noise), "seed": int(seed), "ping_number": int(ping_number)}
    return replace(ping, intensity=out, meta={**ping.meta, **record})
