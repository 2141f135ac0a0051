"""Beam patterns of line arrays by the sine of the angle, with tapers; and of a Gaussian beam and a box.

An aperture of length L hears from the angle whose sine is u, against the sine that it is steered to, the
power B(x), x = u L/λ. A data sheet gives the −3 dB width instead of L: with x₃ of B(x₃) = 1/2 it is
L/λ = x₃ / sin(width / 2), so that the width is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

TAPERS = ("uniform", "hamming", "taylor", "chebyshev")
LOBES = 4  # of a line array, the main lobe and side lobes to each side of it, that count
HAMMING = 0.23 / 0.54  # of cos(2πz/L) over the mean, by half


@lru_cache(maxsize=64)
def taper_series(taper: str, side_lobe_db: float) -> tuple[float, ...]:
    """F₁, F₂, … of an aperture's weights 1 + 2 Σ F_m cos(2πmz/L), |z| <= L/2.

    Parameters
    ----------
    taper : "uniform", "hamming" or "taylor"; side_lobe_db : of "taylor", dB below the main lobe

    Taylor's n-bar is the least that he allows, 2A² + 1/2, and 4 at least; πA = arcosh 10^(side_lobe_db/20).
    Source: Taylor, "Design of line-source antennas for narrow beamwidth and low side lobes", IRE Trans.
    Antennas Propag. 3, 16-28, 1955; Harris, "On the use of windows for harmonic analysis with the discrete
    Fourier transform", Proc. IEEE 66, 51-83, 1978 (Hamming)

    >>> [round(f, 4) for f in taper_series("taylor", 30.0)]
    [0.2927, -0.0158, 0.0022]
    """
    if taper == "uniform":
        return ()
    if taper == "hamming":
        return (HAMMING,)
    a2 = (math.acosh(10 ** (side_lobe_db / 20)) / math.pi) ** 2
    n_bar = max(4, round(2 * a2 + 0.5))
    stretch2 = n_bar**2 / (a2 + (n_bar - 0.5) ** 2)
    series = []
    for m in range(1, n_bar):
        zeros = [1 - m * m / (stretch2 * (a2 + (n - 0.5) ** 2)) for n in range(1, n_bar)]
        others = [1 - (m / n) ** 2 for n in range(1, n_bar) if n != m]
        series.append((-1) ** (m + 1) / 2 * math.prod(zeros) / math.prod(others))
    return tuple(series)


def aperture_pattern(x, taper: str = "uniform", side_lobe_db: float = 30.0) -> np.ndarray:
    """Power that a line array hears, one way, 1 on its axis: (sinc x + Σ F_m (sinc(x − m) + sinc(x + m)))².

    x : u L/λ, any shape; taper, side_lobe_db : of `taper_series`.
    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983; Van Trees, Optimum Array Processing, 2002

    >>> round(float(10 * np.log10(aperture_pattern(1.4303))), 3)
    -13.261
    """
    return aperture_field(x, taper_series(taper, side_lobe_db)) ** 2


def aperture_field(x, series: tuple[float, ...]) -> np.ndarray:
    """Its amplitude, by the series of `taper_series`; not divided by that on the axis, which is 1.

    Pulses have it, too: of a spectrum that is weighed so, over time.
    """
    x = np.asarray(x, np.float64)
    field = np.sinc(x)
    for m, share in enumerate(series, 1):
        field = field + share * (np.sinc(x - m) + np.sinc(x + m))
    return field


def chebyshev_pattern(x, elements: int, side_lobe_db: float) -> np.ndarray:
    """Power that a Dolph-Chebyshev array hears, one way, 1 on its axis: side lobes all so many dB down.

    Parameters
    ----------
    x : u L/λ, any shape, with L/λ the elements' count times their spacing
    elements : 2 or more; side_lobe_db : dB below the main lobe

    (T(x₀ cos(πx/N)) / R)², T the Chebyshev polynomial of order N − 1, T(x₀) = R = 10^(side_lobe_db/20).
    Source: Dolph, "A current distribution for broadside arrays which optimizes the relationship between beam
    width and side-lobe level", Proc. IRE 34, 335-348, 1946

    >>> round(float(10 * np.log10(chebyshev_pattern(np.linspace(2, 20, 100_001), 102, 30.0).max())), 3)
    -30.0
    """
    ratio, order = 10 ** (side_lobe_db / 20), elements - 1
    z = np.abs(math.cosh(math.acosh(ratio) / order) * np.cos(np.pi * np.asarray(x, np.float64) / elements))
    inside, outside = np.arccos(np.minimum(z, 1)), np.arccosh(np.maximum(z, 1))
    return (np.where(z > 1, np.cosh(order * outside), np.cos(order * inside)) / ratio) ** 2


@lru_cache(maxsize=64)
def first_of(series: tuple[float, ...], level: float) -> float:
    """x at which the power of `aperture_field` has first fallen to this level, 0 < level < 1."""
    high = 0.01
    while aperture_field(high, series) ** 2 > level:
        high += 0.01
    low = high - 0.01
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if aperture_field(middle, series) ** 2 > level else (low, middle)
    return low


def _chebyshev_at(elements: int, side_lobe_db: float, level: float) -> float:
    """The same of `chebyshev_pattern`, for levels above its side lobes."""
    ratio, order = 10 ** (side_lobe_db / 20), elements - 1
    z = math.cosh(math.acosh(ratio * math.sqrt(level)) / order) / math.cosh(math.acosh(ratio) / order)
    return elements / math.pi * math.acos(z)


@dataclass(frozen=True)
class Lobe:
    """How one array hears by the sine u of the angle off its axis.

    Parameters
    ----------
    shape : "line_array" or "gaussian"
    width_rad : −3 dB full width, radians, 0..π, of the beam one way; or, if both_ways, of the product of two
        such beams, a transmitter's and a receiver's
    taper, side_lobe_db : of the line array
    """

    shape: str
    width_rad: float
    taper: str = "uniform"
    side_lobe_db: float = 30.0
    both_ways: bool = False

    def _at(self, level: float) -> tuple[float, int]:
        """x of that power; the elements of a Chebyshev array, half a wavelength apart or a little less."""
        if self.taper != "chebyshev":
            return first_of(taper_series(self.taper, self.side_lobe_db), level), 0
        elements = math.ceil(2 * _chebyshev_at(1000, self.side_lobe_db, self._half) / self._edge)
        return _chebyshev_at(max(elements, 2), self.side_lobe_db, level), max(elements, 2)

    @property
    def _half(self) -> float:
        """The power one way at the edge of the width."""
        return math.sqrt(0.5) if self.both_ways else 0.5

    @property
    def _edge(self) -> float:
        return math.sin(self.width_rad / 2)

    def power(self, sine) -> np.ndarray:
        """Power one way, 1 on the axis, of the shape of `sine`.

        >>> lobe = Lobe("line_array", math.radians(20.0), both_ways=True)
        >>> round(float(lobe.power(math.sin(math.radians(10.0)))), 9)
        0.707106781
        """
        u = np.asarray(sine, np.float64) / self._edge
        if self.shape == "gaussian":
            return self._half ** (u**2)
        x, elements = self._at(self._half)
        if elements:
            return chebyshev_pattern(u * x, elements, self.side_lobe_db)
        return aperture_pattern(u * x, self.taper, self.side_lobe_db)

    def sine_at(self, level: float) -> float:
        """|u| at which the main lobe has first fallen to this power one way; may exceed 1."""
        if self.shape == "gaussian":
            return self._edge * math.sqrt(math.log(level) / math.log(self._half))
        return self._edge * self._at(level)[0] / self._at(self._half)[0]

    def last_null(self) -> float:
        """|u| of the LOBES-th null, from which on a line array counts for nothing; may exceed 1.

        What lies beyond is below −23 dB without taper, and below the side lobes that the taper has.
        """
        x, elements = self._at(self._half)
        if elements:
            order = elements - 1
            lobes = min(LOBES, max(order // 2, 1))
            z = math.cos(math.pi * (lobes - 0.5) / order)
            z /= math.cosh(math.acosh(10 ** (self.side_lobe_db / 20)) / order)
            return self._edge * elements / math.pi * math.acos(z) / x
        # every whole x beyond the series' end is a null
        return self._edge * max(LOBES, len(taper_series(self.taper, self.side_lobe_db)) + 1) / x


def line_array_pattern(
    azimuth_rad, steer_azimuth_rad, beam_width_rad, taper="uniform", side_lobe_db=30.0, steered="alike"
):
    """What a beam of a line array hears from each direction, linear power, 1 on its axis.

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad : radians, shapes that broadcast: the direction, the beam's axis
    beam_width_rad : −3 dB full width, radians, 0..π, of the beam that is not steered
    taper, side_lobe_db : "uniform", "hamming", "taylor" or "chebyshev"; of the last two, dB down
    steered : "alike": u = sin(ψ − ψ0); a data sheet gives one width, and curved or many-faced arrays keep it
        over the fan. "straight": u = sin ψ − sin ψ0, as one straight array has it: the width grows as
        1/cos ψ0, 1.414 at 45° and 2.366 at 65°

    The array hears nothing from behind: more than 90° from the beam's axis, or from the straight array's.
    Elevation is left out: a beam is taken to be upright, not a cone about the array's line.
    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983; Van Trees, Optimum Array Processing, 2002

    >>> round(float(line_array_pattern(np.radians(0.5), 0.0, np.radians(1.0))), 9)
    0.5
    """
    lobe = Lobe("line_array", float(beam_width_rad), taper, side_lobe_db)
    return _steered_power(lobe, azimuth_rad, steer_azimuth_rad, steered)


def gaussian_pattern(azimuth_rad, steer_azimuth_rad, beam_width_rad, steered="alike"):
    """A beam without side lobes, linear power, 1 on its axis: 2^−(u / u₃)², u₃ = sin(width / 2).

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad, beam_width_rad, steered : of `line_array_pattern`

    >>> round(float(gaussian_pattern(np.radians(1.0), 0.0, np.radians(1.0))), 4)
    0.0625
    """
    return _steered_power(Lobe("gaussian", float(beam_width_rad)), azimuth_rad, steer_azimuth_rad, steered)


def _steered_power(lobe: Lobe, azimuth_rad, steer_azimuth_rad, steered: str):
    """Of a lobe, ahead of the array."""
    azimuth, steer = (np.asarray(a, np.float64) for a in (azimuth_rad, steer_azimuth_rad))
    if steered == "straight":
        return np.where(np.cos(azimuth) > 0, lobe.power(np.sin(azimuth) - np.sin(steer)), 0.0)
    return np.where(np.cos(azimuth - steer) > 0, lobe.power(np.sin(azimuth - steer)), 0.0)


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
