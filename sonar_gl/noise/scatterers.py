"""Volume reverberation of few scatterers: each is an echo of its own, and many are speckle.

The field is shot noise: the sum of one response of beam and pulse for each scatterer, with a random phase. Where many
lie in a resolution cell, it becomes the Gaussian field of `speckle`, with the same correlation of beams and bins.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import float32, uint64

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.beam_pattern import aperture_field
from sonar_gl.acoustics.pulse import convolve
from sonar_gl.core.compiled import compiled
from sonar_gl.noise.speckle import FieldCorrelation, add_field, aperture_width
from sonar_gl.sonar.sonar import Sonar

SUPPORT = 4.0  # a beam is cut here, in λ/L: at the 4th null, as beams are elsewhere
POINTS = 256  # of the table of a beam's response per λ/L; linear interpolation errs by less than 1e-5
ELEVATIONS = 4096  # at which the pattern in elevation is tabulated
# Mean number of scatterers in a resolution cell from which on they are speckle: the contrast of the intensity exceeds
# that of speckle by less than 3 %, since its square does by about one part in the number.
MANY = 20.0


class Scatterers(NamedTuple):
    """Where scatterers may be, and how strong their echoes are. K bins.

    per_bin : (K,) mean number in each bin over the whole fan
    first_rad, last_rad : azimuths between which they lie
    strength : (n,) float32, power of a scatterer's echo at sines of its elevation that are evenly spread, mean 1
    few_bins : number of bins, from the first one on, with less than MANY scatterers in a cell
    """

    per_bin: np.ndarray
    first_rad: float
    last_rad: float
    strength: np.ndarray
    few_bins: int


def scatterers_of(
    density_m3: float, range_m: np.ndarray, correlation: FieldCorrelation, sonar: Sonar, acoustics: Acoustics
) -> Scatterers:
    """Return the scatterers that a sonar meets in a ping.

    All are equal, and lie evenly in the volume of the fan, which is as high as the main lobe of the pattern in
    elevation. A bin of length Δr at range r has the volume r² Δr Δψ 2 sin φ.

    density_m3 : mean number per cubic metre
    range_m : (K,) ranges that the sonar shows, metres, evenly spread
    correlation : azimuths, width and taper of the beams
    """
    azimuth_rad, width_rad, series, _ = correlation
    margin_rad = SUPPORT * width_rad / aperture_width(series)
    first_rad, last_rad = azimuth_rad[0] - margin_rad, azimuth_rad[-1] + margin_rad
    if margin_rad < math.pi:  # the ends of a full circle see the same scatterers
        last_rad = min(last_rad, first_rad + 2 * math.pi)
    top_sine = math.sin(math.radians(acoustics.elevation_support_deg(sonar)))
    two_way = acoustics.two_way_elevation_pattern(sonar)
    sines = np.linspace(-top_sine, top_sine, ELEVATIONS)
    strength = np.ones(ELEVATIONS) if two_way is None else two_way(sines)
    r, size_m = (one / acoustics.shown_per_true() for one in (np.asarray(range_m), sonar.bin_size_m))
    per_rad = density_m3 * r**2 * size_m * 2 * top_sine
    is_many = per_rad * beam_angle_rad(width_rad, series) >= MANY
    return Scatterers(
        per_rad * (last_rad - first_rad),
        first_rad,
        last_rad,
        (strength / strength.mean()).astype(np.float32),
        int(is_many.argmax()) if is_many.any() else len(r),
    )


@lru_cache(maxsize=8)
def beam_response(taper_series: tuple[float, ...]) -> np.ndarray:
    """Return the amplitude response of a beam from its axis to its support, (SUPPORT · POINTS + 1,) float32."""
    out = aperture_field(np.arange(int(SUPPORT * POINTS) + 1) / POINTS, taper_series).astype(np.float32)
    out.setflags(write=False)
    return out


def beam_angle_rad(beam_width_rad: float, taper_series: tuple[float, ...]) -> float:
    """Return the integral of a beam's power pattern over the azimuths of its support, radians.

    >>> round(float(beam_angle_rad(1.0, ())), 3)  # a uniform array: λ/L, less the 2.5 % beyond the support
    1.1
    """
    power = beam_response(taper_series).astype(np.float64) ** 2
    return beam_width_rad / aperture_width(taper_series) * (2 * power.sum() - power[0]) / POINTS


def add_scatterers(
    total: np.ndarray,
    power: np.ndarray,
    scatterers: Scatterers,
    correlation: FieldCorrelation,
    generator: np.random.Generator,
) -> None:
    """Add the field of a random set of scatterers to total, in place.

    total : (B, 2, K) float32, real and imaginary parts
    power : (B, K) float32, mean of |field|²
    correlation : azimuths, width and taper of the beams, and the pulse

    The number of scatterers in a volume is Poisson-distributed. A scatterer at ψ in bin k adds √p e^iφ A(ψ_b − ψ) w_k
    to beam b, with the amplitude response A of the beam and w of the pulse. By Campbell's theorem the mean of the
    sum's square is the rate times ∫A² ∫w², which `power` is divided by. So |field|² has the mean `power`, and the
    mean square 2 + η times its square, where η falls as one over the number in a cell.

    Source: Rice, "Mathematical analysis of random noise", Bell Syst. Tech. J. 23, 282-332, 1944
    """
    amplitude = np.sqrt(power)
    few, n_bins = scatterers.few_bins, total.shape[2]
    if few:
        field = _few(scatterers, correlation, generator)
        total[:, :, :few] += amplitude[:, None, :few] * field
    if few < n_bins:
        add_field(total[:, :, few:], amplitude[:, few:], correlation, generator)


def _few(scatterers: Scatterers, correlation: FieldCorrelation, generator: np.random.Generator) -> np.ndarray:
    """Return the field of the bins with few scatterers in a cell, (B, 2, few_bins) float32, of mean power 1."""
    azimuth_rad, width_rad, series, pulse_weights = correlation
    weights = np.ones(1, np.float32) if pulse_weights is None else pulse_weights
    few, half = scatterers.few_bins, len(weights) // 2
    # the pulse also brings echoes from beyond the first and the last bin, where the density is that of these
    per_bin = np.pad(scatterers.per_bin[:few], half, mode="edge")
    number = generator.poisson(per_bin)
    n = int(number.sum())
    k = np.repeat(np.arange(len(number)), number)
    shares = generator.random((3, n), dtype=np.float32)
    fan_rad = scatterers.last_rad - scatterers.first_rad
    at_rad = scatterers.first_rad + fan_rad * shares[0].astype(np.float64)
    strength = scatterers.strength[(shares[1] * len(scatterers.strength)).astype(np.int64)]
    rate = per_bin / fan_rad * beam_angle_rad(width_rad, series)
    amplitude = np.sqrt(strength / rate[k])
    phase = 2 * np.pi * shares[2]
    echo = (amplitude * np.stack([np.cos(phase), np.sin(phase)])).astype(np.float32)

    scale = aperture_width(series) / width_rad  # λ/L per radian
    azimuth, reach_rad = np.asarray(azimuth_rad), SUPPORT / scale
    # of a full circle, those about its first beam once more, for its last ones
    once_round = at_rad + 2 * np.pi
    again = np.flatnonzero((once_round >= scatterers.last_rad) & (once_round < azimuth[-1] + reach_rad))
    at_rad = np.append(at_rad, once_round[again])
    echo, k = np.concatenate([echo, echo[:, again]], axis=1), np.append(k, k[again])
    first = np.searchsorted(azimuth, at_rad - reach_rad)
    last = np.searchsorted(azimuth, at_rad + reach_rad)
    out = np.zeros((len(azimuth), 2, len(number)), np.float32)
    _spread(echo, k, at_rad, first, last, azimuth, scale * POINTS, beam_response(series), out)
    return convolve(out.reshape(-1, len(number)), weights).reshape(len(azimuth), 2, few)


@compiled
def _spread(echo, bins, at_rad, first, last, azimuth_rad, points_per_rad, response, out):
    """Add echoes (2, n) to the beams from `first` to `last` of out (B, 2, K), as `response` falls with the angle."""
    for i in range(uint64(len(bins))):
        k = uint64(bins[i])
        for b in range(first[i], last[i]):
            place = abs(azimuth_rad[b] - at_rad[i]) * points_per_rad
            point = uint64(place)
            part = float32(place - point)
            if point + 1 >= uint64(len(response)):
                continue
            here = response[point] + part * (response[point + 1] - response[point])
            out[b, 0, k] += here * echo[0, i]
            out[b, 1, k] += here * echo[1, i]
