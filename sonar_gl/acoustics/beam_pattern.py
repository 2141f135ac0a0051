"""Beam patterns: line arrays with tapers, Gaussian beams and boxes.

The one-way power pattern of a line array of length L is B(x), x = u L/λ, where u is the sine of the angle off
the array's axis, or the difference of two sines for a steered array. A data sheet gives the −3 dB width in
place of L: with x₃ defined by B(x₃) = 1/2, L/λ = x₃ / sin(width / 2) makes the width exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

HAMMING = 0.23 / 0.54  # half the amplitude of cos(2πz/L) over the mean weight
# A line array's pattern is cut at this null, its 4th: the main lobe and three side lobes to each side are
# kept.
SUPPORT_NULL = 4
# Cosine of the angle off the axis, 75 degrees, from which on far side lobes of beams steered "alike" fall to nothing.
FADE_COSINE = 0.26


@lru_cache(maxsize=64)
def taper_series(taper: str, side_lobe_db: float) -> tuple[float, ...]:
    """Return F₁, F₂, … of the weights 1 + 2 Σ F_m cos(2πmz/L) of a tapered aperture, |z| <= L/2.

    Raises ValueError if the taper has no such series, as "chebyshev", whose pattern `ArrayPattern` has.

    taper : "uniform", "hamming" or "taylor"
    side_lobe_db : level of the side lobes of "taylor", dB below the main lobe

    Taylor's n̄ is the least that he allows, 2A² + 1/2, and at least 4; πA = arcosh 10^(side_lobe_db/20).

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
    if taper != "taylor":  # whose side lobes would be taken for those of the other
        raise ValueError(
            f"taper must be one with a series (got {taper!r}; ArrayPattern has the patterns of others)"
        )
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
    """Return the one-way power pattern of a line array, 1 on its axis.

    x : u L/λ, any shape
    taper, side_lobe_db : as for `taper_series`

    (sinc x + Σ F_m (sinc(x − m) + sinc(x + m)))², F_m of `taper_series`.

    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983; Van Trees, Optimum Array Processing, 2002

    >>> round(float(10 * np.log10(aperture_pattern(1.4303))), 3)
    -13.261
    """
    return aperture_field(x, taper_series(taper, side_lobe_db)) ** 2


def aperture_field(x, series: tuple[float, ...]) -> np.ndarray:
    """Return the far-field amplitude of a line aperture, 1 on its axis.

    It is the Fourier transform of the aperture's weights, and also the range response of a pulse whose
    spectrum has these weights.

    x : u L/λ, any shape
    series : F₁, F₂, … of `taper_series`

    >>> aperture_field([0.0, 1.0], taper_series("hamming", 0.0)).round(4).tolist()  # 0.23 / 0.54 at 1
    [1.0, 0.4259]
    """
    x = np.asarray(x, np.float64)
    field = np.sinc(x)
    for m, share in enumerate(series, 1):
        field = field + share * (np.sinc(x - m) + np.sinc(x + m))
    return field


def aperture_weights(z, series: tuple[float, ...]) -> np.ndarray:
    """Return the weights of a tapered aperture at z, in its lengths, −1/2..1/2; or of a pulse's spectrum likewise.

    series : F₁, F₂, … of `taper_series`

    >>> aperture_weights(np.array([0.0, 0.5]), taper_series("hamming", 0.0)).round(4).tolist()  # 0.54 ± 0.46, over 0.54
    [1.8519, 0.1481]
    """
    return 1 + 2 * sum(
        (share * np.cos(2 * np.pi * m * z) for m, share in enumerate(series, 1)), np.zeros_like(z)
    )


def chebyshev_pattern(x, elements: int, side_lobe_db: float) -> np.ndarray:
    """Return the one-way power pattern of a Dolph-Chebyshev array, 1 on its axis; all its side lobes are
    equal.

    x : u L/λ, any shape, where L is the number of elements times their spacing
    elements : number of elements N, 2 or more
    side_lobe_db : level of the side lobes, dB below the main lobe

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
def main_lobe_edge(series: tuple[float, ...], level: float) -> float:
    """Return the x at which the power of `aperture_field` first falls to a level.

    series : F₁, F₂, … of `taper_series`
    level : linear power relative to the axis, above 0 and below 1

    >>> round(2 * main_lobe_edge((), 0.5), 6)  # −3 dB width in λ/L
    0.885893
    """
    high = 0.01
    while aperture_field(high, series) ** 2 > level:
        high += 0.01
    low = high - 0.01
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if aperture_field(middle, series) ** 2 > level else (low, middle)
    return low


def _chebyshev_edge(elements: int, side_lobe_db: float, level: float) -> float:
    """Return the x at which `chebyshev_pattern` first falls to a level above its side lobes."""
    ratio, order = 10 ** (side_lobe_db / 20), elements - 1
    z = math.cosh(math.acosh(ratio * math.sqrt(level)) / order) / math.cosh(math.acosh(ratio) / order)
    return elements / math.pi * math.acos(z)


@dataclass(frozen=True)
class ArrayPattern:
    """The one-way power pattern of an unsteered array, as a function of the sine u of the angle off its axis.

    shape : "line_array" or "gaussian"
    width_rad : −3 dB full width, radians, 0..π
    taper, side_lobe_db : of the line array, as `Sonar.receive_taper` and `Sonar.side_lobe_db`
    two_way_width : whether `width_rad` is the width of the two-way pattern, of a transmitter and a receiver
        that are both such arrays, instead of the one-way width
    """

    shape: str
    width_rad: float
    taper: str = "uniform"
    side_lobe_db: float = 30.0
    two_way_width: bool = False

    def _edge_and_elements(self, level: float) -> tuple[float, int]:
        """Return the x where the main lobe falls to a level, and the number of elements of a Chebyshev array
        or 0.

        The elements lie half a wavelength apart, or slightly less.
        """
        if self.taper != "chebyshev":
            return main_lobe_edge(taper_series(self.taper, self.side_lobe_db), level), 0
        edge = _chebyshev_edge(1000, self.side_lobe_db, self._edge_level)
        elements = max(math.ceil(2 * edge / self._edge_sine), 2)
        return _chebyshev_edge(elements, self.side_lobe_db, level), elements

    @property
    def _edge_level(self) -> float:
        """The one-way power at the edge of the width."""
        return math.sqrt(0.5) if self.two_way_width else 0.5

    @property
    def _edge_sine(self) -> float:
        return math.sin(self.width_rad / 2)

    def power(self, sine) -> np.ndarray:
        """Return the one-way power, 1 on the axis, of the shape of `sine`.

        >>> pattern = ArrayPattern("line_array", math.radians(20.0), two_way_width=True)
        >>> round(float(pattern.power(math.sin(math.radians(10.0)))), 9)
        0.707106781
        """
        u = np.asarray(sine, np.float64) / self._edge_sine
        if self.shape == "gaussian":
            return self._edge_level ** (u**2)
        x, elements = self._edge_and_elements(self._edge_level)
        if elements:
            return chebyshev_pattern(u * x, elements, self.side_lobe_db)
        return aperture_pattern(u * x, self.taper, self.side_lobe_db)

    def correlation(self, sine) -> np.ndarray:
        """Return ∫a(v) a(v − u) dv / ∫a² dv of the amplitude a, of the shape of `sine`: 1 at 0.

        So correlate what beams receive of two directions, u apart in sine. Of a line array it is the transform of its
        squared weights (Parseval). A Chebyshev array, which has no series, counts as Taylor's of the same side lobes.

        Source: Van Trees, Optimum Array Processing, 2002

        >>> pattern = ArrayPattern("line_array", math.radians(1.0))
        >>> pattern.correlation(pattern.null_sine() * np.array([0.0, 0.5, 1.0])).round(4).tolist()  # a sinc
        [1.0, 0.6366, 0.0]
        """
        if self.shape == "gaussian":
            return self.power(sine) ** 0.25
        taper = "taylor" if self.taper == "chebyshev" else self.taper
        series = taper_series(taper, self.side_lobe_db)
        of_field = np.array([*reversed(series), 1.0, *series])
        of_square = np.convolve(of_field, of_field)[2 * len(series) :]
        null_sine = replace(self, taper=taper).null_sine()
        return aperture_field(np.asarray(sine) / null_sine, tuple(of_square[1:] / of_square[0]))

    def main_lobe_sine(self, level: float) -> float:
        """Return |u| at which the main lobe first falls to a one-way power; it may exceed 1."""
        if self.shape == "gaussian":
            return self._edge_sine * math.sqrt(math.log(level) / math.log(self._edge_level))
        x, edge = (self._edge_and_elements(one)[0] for one in (level, self._edge_level))
        return self._edge_sine * x / edge

    def null_sine(self) -> float:
        """Return |u| of 1 in u L/λ, the distance of two far nulls and the shortest period of the power.

        Of a Gaussian pattern, whose longest periods hold all but 4e-8, a quarter of |u| where the power is 1e-4.
        """
        if self.shape == "gaussian":
            return self.main_lobe_sine(1e-4) / 4
        return self._edge_sine / self._edge_and_elements(self._edge_level)[0]

    def support_sine(self) -> float:
        """Return |u| of the null at which the pattern of a line array is cut; it may exceed 1.

        It is the 4th null, which is x = 4 without taper and for Hamming's, whose nulls are 2, 2.6, 3 and 4; the
        n̄-th null of Taylor's, n̄ >= 4; and an earlier one of Chebyshev arrays with few elements. The lobes beyond are
        below −23 dB without taper, and no higher than the side lobes of a taper.
        """
        x, elements = self._edge_and_elements(self._edge_level)
        if elements:
            order = elements - 1
            null = min(SUPPORT_NULL, max(order // 2, 1))
            z = math.cos(math.pi * (null - 0.5) / order)
            z /= math.cosh(math.acosh(10 ** (self.side_lobe_db / 20)) / order)
            return self._edge_sine * elements / math.pi * math.acos(z) / x
        return self._edge_sine * self.support_nulls() / x

    def support_nulls(self) -> int:
        """Return the number of nulls up to that at `support_sine`; beyond, they are about evenly spread."""
        if self.taper == "chebyshev":
            _, elements = self._edge_and_elements(self._edge_level)
            return min(SUPPORT_NULL, max((elements - 1) // 2, 1))
        # every whole x above the order of the series is a null
        return max(SUPPORT_NULL, len(taper_series(self.taper, self.side_lobe_db)) + 1)


@dataclass(frozen=True)
class FarPattern:
    """What a beam of a line array receives beyond the support of its pattern, continued into the support.

    Of the support, it has a ripple as high as the next side lobe in place of the main lobe and of the first side
    lobes: all of it oscillates alike, so that a few functions of azimuth describe it.

    array : ArrayPattern, "line_array"
    steered : as for `line_array_pattern`
    floor : mean power that element errors receive from any direction in front of the array, relative to the axis
    """

    array: ArrayPattern
    steered: str = "alike"
    floor: float = 0.0

    @property
    def lobe_sine(self) -> float:
        """Width of a far side lobe, the distance of two nulls, in sine."""
        return self.array.support_sine() / self.array.support_nulls()

    def coordinate(self, azimuth_rad) -> np.ndarray:
        """Return the coordinate of which the pattern takes differences: azimuth, or its sine."""
        azimuth = np.asarray(azimuth_rad, np.float64)
        return np.sin(azimuth) if self.steered == "straight" else azimuth

    def sine_of(self, difference) -> np.ndarray:
        """Return |u| of a difference of coordinates."""
        return np.abs(difference if self.steered == "straight" else np.sin(difference))

    def is_far(self, difference) -> np.ndarray:
        """Return where `power` is the pattern."""
        if self.steered == "straight":
            return np.abs(difference) >= self.array.support_sine()
        return (np.cos(difference) >= FADE_COSINE) & (self.sine_of(difference) >= self.array.support_sine())

    def power(self, difference) -> np.ndarray:
        """Return the far side lobes and the floor, by the difference of the coordinates of direction and axis.

        Beams steered "alike" receive nothing from behind, and their power falls to that from FADE_COSINE on, not in a
        step.
        """
        u, null = self.sine_of(difference), self.array.support_sine()
        within = u < null
        ripple = self.ripple_power() * np.sin(np.pi * u / self.lobe_sine) ** 2
        power = self.floor + np.where(within, ripple, self.array.power(np.where(within, null, u)))
        if self.steered == "straight":
            return power
        t = np.clip(np.cos(difference) / FADE_COSINE, 0, 1)
        return power * t * t * (3 - 2 * t)

    def peak(self, difference) -> np.ndarray:
        """Return the floor and the greatest power of the side lobe at a difference of coordinates."""
        lobe, u = self.lobe_sine, self.sine_of(difference)
        place = np.arange(math.ceil(u.max() / lobe) + 1)
        near = np.abs(lobe * (place[:, None] + np.linspace(-1, 1, 65)))
        power = np.where(near < self.array.support_sine(), 0.0, self.array.power(near)).max(axis=1)
        power = np.where(power == 0, self.ripple_power(), power)
        return self.floor + np.interp(u, lobe * place, power)

    def ripple_power(self) -> float:
        """Return the power of the strongest lobe beyond the support."""
        null = self.array.support_sine()
        return float(self.array.power(null * np.linspace(1, 2, 1001)).max())


def line_array_pattern(
    azimuth_rad,
    steer_azimuth_rad,
    beam_width_rad,
    taper="uniform",
    side_lobe_db=30.0,
    steered="alike",
    floor=0.0,
):
    """Return the one-way power pattern of a beam of a line array, 1 on its axis (1 + floor with element errors).

    The pattern is 0 behind the array: more than 90° from the beam's axis, or from the straight array's. Azimuths are
    those at which the array shows a direction: of beams that are cones not the true ones.

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad : direction and axis of the beam, radians, shapes that broadcast
    beam_width_rad : −3 dB full width of the unsteered beam, radians, 0..π
    taper, side_lobe_db : as `Sonar.receive_taper` and `Sonar.side_lobe_db`
    steered : "alike": u = sin(ψ − ψ0), since a data sheet gives one width, and curved or many-faced arrays
        keep it over the fan. "straight": u = sin ψ − sin ψ0, as for one straight array: the width grows as
        1/cos ψ0, by 1.414 at 45° and 2.366 at 65°
    floor : mean power that random errors of the elements add in every direction, relative to the axis

    Notes
    -----
    Errors of the gain and the phase of N equal elements, independent, of variance σ², add σ²/N to the mean power
    pattern, in all directions alike: Van Trees, 2002, section 2.6.3; Skolnik, Introduction to Radar Systems,
    3rd ed., 2001, section 9.12. A single array's floor varies about this mean.

    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983; Van Trees, Optimum Array Processing, 2002

    >>> round(float(line_array_pattern(np.radians(0.5), 0.0, np.radians(1.0))), 9)
    0.5
    """
    pattern = ArrayPattern("line_array", float(beam_width_rad), taper, side_lobe_db)
    return _steered_power(pattern, azimuth_rad, steer_azimuth_rad, steered, floor)


def gaussian_pattern(azimuth_rad, steer_azimuth_rad, beam_width_rad, steered="alike"):
    """Return the one-way power pattern of a beam without side lobes, 1 on its axis.

    2^−(u / u₃)², u₃ = sin(width / 2).

    azimuth_rad, steer_azimuth_rad, beam_width_rad, steered : as for `line_array_pattern`

    >>> round(float(gaussian_pattern(np.radians(1.0), 0.0, np.radians(1.0))), 4)
    0.0625
    """
    pattern = ArrayPattern("gaussian", float(beam_width_rad))
    return _steered_power(pattern, azimuth_rad, steer_azimuth_rad, steered)


def _steered_power(pattern: ArrayPattern, azimuth_rad, steer_azimuth_rad, steered: str, floor=0.0):
    """Return the power of a steered array, 0 behind it."""
    azimuth, steer = (np.asarray(a, np.float64) for a in (azimuth_rad, steer_azimuth_rad))
    if steered == "straight":
        off_array, sine = azimuth, np.sin(azimuth) - np.sin(steer)
    else:
        off_array = azimuth - steer
        sine = np.sin(off_array)
    power = pattern.power(sine) + floor
    if np.abs(off_array).max(initial=0) < math.pi / 2:  # all in front: a cosine takes as long as the pattern
        return power
    return np.where(np.cos(off_array) > 0, power, 0.0)
