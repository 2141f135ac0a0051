"""The counts that a sonar delivers: how its receiver turns intensity into the whole numbers of an image.

A device sends no intensities but whole numbers of 8 or 16 bits, after a gain and a law that brings an echo of many
decades into them. The law decides what an image looks like: the same ping has other tones and another histogram with
another law.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.core.checks import (
    check_choice,
    check_number,
    holds_numbers,
    is_whole_number,
    make_numbers_plain,
    shown,
)
from sonar_gl.core.errors import Error
from sonar_gl.core.key_values import parse_fields

# fields that one law alone uses
LAWS = {"power": ("exponent",), "db": ("low_db", "high_db")}
LEAST_EXPONENT, GREATEST_EXPONENT = 0.01, 2.0
LEVEL_BOUND_DB = 180.0  # two such levels multiply to 1e±36, which float32 holds
# Share of full scale below which a display is black: 8 counts of 255, which on an sRGB screen have 0.24 % of the
# luminance of white. The lowest count alone would be no measure: by I^0.26 it lies 104 dB below full scale.
BLACK = 1 / 32
# bins that tell which ones a percentile needs; alone they would miss it by 0.5 dB where bright bodies fill one bin in a
# hundred, and frames of a film would flicker
PERCENTILE_BINS = 1 << 14
LEAST_FLOAT32 = float(np.finfo(np.float32).tiny)
SURE_DEVIATIONS = 4.0  # standard deviations of the rank of a bin in such a sample


@dataclass(frozen=True)
class Counts:
    """The law by which a sonar turns intensity I, linear, into counts 0..2^bits − 1; larger values are clipped.

    Parameters
    ----------
    law : "power": counts = full scale · (g I)^exponent; or "db": counts rise evenly with 10 log10(g I), from 0 at
        `low_db` to full scale at `high_db`
    exponent : of the law "power", 0.01..2: 1 is linear in power, 0.5 is amplitude, 0.25 its square root
    low_db, high_db : window of the law "db"
    gain_db : fixed gain 10 log10(g)
    gain_percentile : automatic gain, in place of a fixed one: in each ping, g brings the level at this percentile of
        the bins that have an echo to full scale, 0..100; None for the fixed gain
    bits : 8 or 16

    Raises
    ------
    Error
        if a field is invalid.

    Notes
    -----
    Full scale is g I = 1 by the law "power" and `high_db` by the law "db". Without gain, I = 1 is the echo of a sphere
    about the sonar that returns all of it (`Ping.intensity`).

    >>> law = Counts("power", exponent=0.5)
    >>> law.apply(np.array([0.0, 0.25, 1.0, 7.0], np.float32)).tolist()
    [0, 128, 255, 255]
    >>> Counts(low_db=-40).intensity_of([0, 255]).tolist()
    [9.999999747378752e-05, 1.0]
    """

    law: str = "db"
    exponent: float = 0.26
    low_db: float = -60.0
    high_db: float = 0.0
    gain_db: float = 0.0
    gain_percentile: float | None = None
    bits: int = 8

    def __post_init__(self):
        make_numbers_plain(self)
        check_choice("law", self.law, LAWS, "counts")
        check_number("counts: exponent", self.exponent, LEAST_EXPONENT, GREATEST_EXPONENT)
        for key in ("low_db", "high_db", "gain_db"):
            check_number(f"counts: {key}", getattr(self, key), -LEVEL_BOUND_DB, LEVEL_BOUND_DB, "give dB")
        if self.low_db >= self.high_db:
            raise Error(
                f"counts: low_db must be less than high_db (got {self.low_db:g} and {self.high_db:g})"
            )
        if self.gain_percentile is not None:
            check_number("counts: gain_percentile", self.gain_percentile, 0.0, 100.0)
            if self.gain_db:
                raise Error(
                    "counts: gain_db and gain_percentile exclude each other "
                    f"(got {self.gain_db:g} and {self.gain_percentile:g}; leave one out)"
                )
        if not is_whole_number(self.bits) or self.bits not in (8, 16):
            is_between = is_whole_number(self.bits) and 8 < self.bits < 16
            cure = f"; take 16, and shift its counts right by {16 - self.bits} bits" if is_between else ""
            raise Error(f"counts: bits must be 8 or 16 (got {shown(self.bits)}{cure})")

    @property
    def full_scale(self) -> int:
        """The largest count."""
        return 2**self.bits - 1

    def changed(self, values: Mapping) -> Counts:
        """Return this law with other values of some fields, as a file or an option gives them.

        A gain that is given replaces the other kind of gain. Raises Error for an unknown field, and for one that the
        law does not use, unless the values are those of all fields, as in the record of a ping.

        >>> Counts("power", gain_percentile=99).changed({"gain_db": 20})
        Counts(law='power', exponent=0.26, low_db=-60.0, high_db=0.0, gain_db=20, gain_percentile=None, bits=8)
        """
        known = [field.name for field in fields(self)]
        if not isinstance(values, Mapping):
            raise Error(
                f'counts must be a table such as {{ law = "db", low_db = -50 }} (got {shown(values)})'
            )
        for key in values:
            check_choice("key", key, known, "counts")
        gains = {"gain_db": 0.0, "gain_percentile": None}
        reset = gains if any(values.get(key) is not None for key in gains) else {}
        out = replace(self, **{**reset, **values})
        for law, keys in LAWS.items():
            for key in keys:
                if key in values and law != out.law and len(values) < len(known):
                    raise Error(f"counts: {key} needs the law {law!r} (got the law {out.law!r})")
        return out

    def parse_changes(self, text: str) -> Counts:
        """Return this law with the changes of `key=value,...`; raises Error like `changed`.

        >>> Counts().parse_changes("low_db=-50,gain_percentile=99").gain_percentile
        99.0
        """
        return self.changed(parse_fields("counts", text, Counts)[1])

    def settle(self, intensity: np.ndarray) -> Counts:
        """Return this law with the automatic gain of a ping as a fixed one; a law without automatic gain as it is.

        Parameters
        ----------
        intensity : (B, K) linear; without any echo the gain is 0 dB

        Raises
        ------
        Error
            if there is something else than numbers, or an infinite one.
        """
        if self.gain_percentile is None:
            return self
        intensity = _numbers(intensity)
        level = _percentile_of_echoes(intensity, self.gain_percentile)
        if level == math.inf:
            raise Error("automatic gain needs finite intensities (got infinity)")
        gain_db = (self.high_db if self.law == "db" else 0.0) - 10 * math.log10(level) if level else 0.0
        gain_db = min(max(gain_db, -LEVEL_BOUND_DB), LEVEL_BOUND_DB)
        return replace(self, gain_db=gain_db, gain_percentile=None)

    def share(self, intensity: np.ndarray) -> np.ndarray:
        """Return the share of full scale, float32 0..1 and not rounded, of intensities, (N, M) or (N,).

        NaN, an unknown intensity, has the share 0, as no echo has. Automatic gain is that of these intensities. Raises
        Error if they are no array of numbers.
        """
        import cv2  # its functions take a tenth of NumPy's time; what only lists sonars need not wait for it

        intensity = _numbers(intensity)
        law, intensity = self.settle(intensity), np.asarray(intensity, np.float32)
        if law.law == "power":
            full = 10 ** (-law.gain_db / 10)  # intensity of full scale
            share = np.clip(intensity, np.float32(0), np.float32(full), order="C")
            flat = share.reshape(1, -1)
            cv2.pow(flat, law.exponent, dst=flat)
            flat *= full**-law.exponent
        else:
            dark_db, window_db = law.low_db - law.gain_db, law.high_db - law.low_db
            # from the window's lower end on, whose logarithm is 0 to the bit, however narrow the window is
            with np.errstate(over="ignore", under="ignore"):  # infinity is full scale
                share = np.multiply(intensity, np.float32(10 ** (-dark_db / 10)), order="C")
            np.maximum(share, np.float32(1), out=share)
            flat = share.reshape(1, -1)
            cv2.log(flat, dst=flat)
            flat *= 10 / math.log(10) / window_db
        cv2.patchNaNs(flat, 0.0)  # what a cast makes of them depends on the processor
        return np.minimum(share, np.float32(1), out=share)

    def apply(self, intensity: np.ndarray) -> np.ndarray:
        """Return the counts of intensities, (N, M) or (N,), uint8 or uint16 by `bits`, rounded to the nearest."""
        return self.counts_of(self.share(intensity))

    def least_shown(self, intensity: np.ndarray) -> float:
        """Return the intensity, linear, from which on a display of these intensities, (B, K), is not black.

        It has the share `BLACK` of full scale. Automatic gain is that of these intensities.

        >>> least = Counts(low_db=-64.0).least_shown(np.ones((1, 1)))
        >>> round(10 * math.log10(least), 3)  # 1/32 of 64 dB above the window's lower end
        -62.0
        """
        least = float(np.float32(_intensity_at(self.settle(intensity), BLACK)))
        # of a small exponent it is less than float32 holds; a bin without echo is always black
        return max(least, LEAST_FLOAT32)

    def counts_of(self, share: np.ndarray) -> np.ndarray:
        """Return shares of full scale, float 0..1, as counts, uint8 or uint16."""
        return (share * np.float32(self.full_scale) + np.float32(0.5)).astype(f"uint{self.bits}")

    def intensity_of(self, counts: ArrayLike) -> np.ndarray:
        """Return the intensities, float32, that give these counts, which may be fractions of a count.

        What was clipped is lost: full scale stands for all that is above it, and in the law "db" 0 for all below.
        Raises Error if the gain is automatic; `settle` finds that of a ping.
        """
        if self.gain_percentile is not None:
            raise Error(
                f"intensity_of needs a fixed gain (got gain_percentile = {self.gain_percentile:g}; "
                "Ping.counts_law finds the gain of a ping)"
            )
        share = np.asarray(_numbers(counts, "counts"), np.float64) / self.full_scale
        return _intensity_at(self, share).astype(np.float32)


def _intensity_at(law: Counts, share):
    """Return the intensity of a share of full scale, or of an array of shares, by a law with a fixed gain."""
    if law.law == "power":
        intensity = share ** (1 / law.exponent)
    else:
        intensity = 10 ** ((law.low_db + share * (law.high_db - law.low_db)) / 10)
    return intensity / 10 ** (law.gain_db / 10)


def _percentile_of_echoes(intensity: np.ndarray, percentile: float) -> float:
    """Return a percentile of the intensities above 0, as `np.percentile` does; 0 without any, infinity if there is one.

    A sample tells above which intensity the percentile lies for sure, and the few bins above it are sorted.
    """
    flat, step = intensity.ravel(), max(1, intensity.size // PERCENTILE_BINS)
    n_echoes = np.count_nonzero(flat > 0)
    if not n_echoes:
        return 0.0
    place = percentile / 100 * (n_echoes - 1)
    n_above = n_echoes - int(place)  # echoes from the one at or below that place on
    while math.gcd(step, intensity.shape[-1]) > 1:  # else the same bins of all beams, and no others
        step += 1
    sample = flat[::step]
    sample, share = sample[sample > 0], percentile / 100
    above = flat[:0]
    if sample.size:
        share -= SURE_DEVIATIONS * math.sqrt((share * (1 - share) + 1 / sample.size) / sample.size)
        least = np.partition(sample, k := int(max(share, 0.0) * (sample.size - 1)))[k]
        above = flat[np.flatnonzero(flat >= least)]  # a fourth of the time of a mask, as few bins are taken
    if above.size < n_above:  # the sample deceived, as it may where echoes lie in its pattern
        above = flat[flat > 0]
    if above.max() == math.inf:
        return math.inf
    first = above.size - n_above
    last = min(first + 1, above.size - 1)
    above.partition((first, last))
    return float(above[first] + (place - int(place)) * (float(above[last]) - above[first]))


def _numbers(values, what: str = "intensity") -> np.ndarray:
    """Return an array of floats, those that are given where they are some; raise an `Error` if they are no numbers."""
    out = np.asarray(values)
    if not holds_numbers(out) or (out.ndim == 0 and what == "intensity"):
        wanted = "an array of real numbers" if what == "intensity" else "real numbers"
        raise Error(f"{what} must be {wanted} (got {shown(values)})")
    return out if out.dtype.kind == "f" else out.astype(np.float64)


DEFAULT_COUNTS = Counts()  # of a sonar that states none
