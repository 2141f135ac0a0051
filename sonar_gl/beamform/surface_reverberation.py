"""Surface reverberation: the echo of a rough water surface, where no body hides it.

An area dA at range r and grazing angle g has the cross section σ dA, which adds π σ dA / r² to the sum over solid angle
of μ cos θ, and the solid angle sin g dA / r²: the surface returns π σ / sin g per steradian. A level surface at the
height h over the sonar is met at range r at sin g = h / r, so that its backscatter is a function of the range alone.
The samples are summed by Lambert's law, sin g per steradian, which is exact on planes; then each bin is multiplied by
π σ / sin² g. So far away, where a sample covers many bins, each bin has its own grazing angle. Overhead, where one bin
covers many angles, each sample has its own.

Source: Urick, Principles of Underwater Sound, 3rd ed., 1983, surface reverberation
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from sonar_gl.beamform.beamformer import BeamEcho, Beamformer
from sonar_gl.beamform.water_surface import SurfaceOnRays, WaterSurface, on_rays, whole_sector
from sonar_gl.sonar.samples import SectorSamples

# in each bin: near the vertical it spans some degrees
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(8)
SHORTEST = 1e-6  # of 1 over range, what a sample covers at least: one straight above covers none
MAX_CHANGE = 0.01  # of π σ / sin² g within a bin, up to which all samples have the mean of the bin


def sum_surface(
    beamformer: Beamformer,
    samples: Sequence[SectorSamples],
    gain: np.ndarray,
    surface: WaterSurface,
    backscatter: Callable,
) -> BeamEcho:
    """Return the echo of the water's surface in beams and bins, mean of its speckle.

    samples : of each sector; their bodies hide the surface
    gain : (K,) float32, range gain
    backscatter : function (grazing_rad) -> σ, cross section per area and steradian
    """
    edges_m = beamformer.fan.sonar.bin_edges_m
    law = over_lambert(edges_m, surface.height_m, backscatter)
    of_samples = partial(_over_bin_mean, edges_m=edges_m, law=law, surface=surface, backscatter=backscatter)
    steep_m = edges_m[0], _end_of_steep_bins(edges_m, surface, backscatter)
    is_spread = beamformer.fan.sampling.reducer == "footprint"
    alone = [
        _surface_alone(one, surface, steep_m, of_samples, is_spread)
        for one in map(whole_sector, samples, beamformer.fan.sectors)
    ]
    by_lambert = beamformer.sum_footprints(alone).intensity
    intensity = by_lambert * (law * gain).astype(np.float32)
    return BeamEcho(intensity, float(intensity.sum(dtype=np.float64)))


def over_lambert(bin_edges_m: np.ndarray, height_m: float, backscatter: Callable) -> np.ndarray:
    """Return the echo of a level surface over that by Lambert's law with a reflectivity of 1, in each bin.

    It is the mean of π σ / sin² g over the part of a bin that the surface reaches, weighted by Lambert's law: by
    sin² g, to which its echo adds up. 0 where a bin ends before the surface.

    Returns (K,) float64.

    bin_edges_m : (K + 1,) ranges, metres
    height_m : of the surface over the sonar
    backscatter : as for `sum_surface`

    >>> over_lambert(np.array([1.0, 2.0, 4.0]), 2.0, lambda g: 0.1 / np.pi * np.sin(g) ** 2).round(9).tolist()
    [0.0, 0.1]
    """
    sines = height_m / np.maximum(bin_edges_m, height_m)
    off_vertical = np.arccos(sines)
    near, far = off_vertical[:-1, None], off_vertical[1:, None]
    at = near + (far - near) * (NODES + 1) / 2
    # Lambert's law adds up to sin² g, whose derivative is 2 sin g cos g: of π σ / sin² g times it 2 π σ cot g is left
    law = 2 * np.pi * backscatter(np.pi / 2 - at) * np.tan(at)
    echo = (far - near)[:, 0] / 2 * (law @ NODE_WEIGHTS)
    lambert = sines[:-1] ** 2 - sines[1:] ** 2
    return np.divide(echo, lambert, out=np.zeros_like(echo), where=lambert > 0)


def _over_bin_mean(
    inverse_m, half_length, edges_m, law, surface: WaterSurface, backscatter: Callable
) -> np.ndarray:
    """Return π σ / sin² g of samples of the surface over its mean in the bins that they cover.

    The next bin may return many times as much: over the mean of the bin of their rays alone, samples that cover parts
    of both would return too much.

    inverse_m, half_length : (n,) 1 over range, and half of what a sample covers of it
    edges_m, law : (K + 1,) edges of bins, and (K,) means in bins
    """
    sines = np.minimum(surface.height_m * inverse_m, 1.0)
    own = np.pi * backscatter(np.arcsin(sines)) / sines**2
    # the echo of a footprint rises as the square of 1 over range, see `BinTable`
    squares = 1 / np.maximum(edges_m, 1e-6)[::-1] ** 2
    up_to = np.append(0.0, np.cumsum(law[::-1] * np.diff(squares)))
    half_length = np.maximum(half_length, SHORTEST * inverse_m)
    ends = np.array([np.maximum(inverse_m - half_length, 0.0), inverse_m + half_length])
    far, near = np.clip(ends**2, squares[0], squares[-1])
    covered = np.interp(near, squares, up_to) - np.interp(far, squares, up_to)
    return np.divide(own * (near - far), covered, out=np.ones_like(own), where=covered > 0)


def _half_lengths(samples: SectorSamples, met: SurfaceOnRays) -> np.ndarray:
    """Return (R, C) half of what samples of the surface, a column wide and a row high, cover in 1 over range."""
    sector, over_length2 = samples.sector, met.depth_inverse / met.ray_length**2
    (u, v), (_, u_i, u_j), (_, v_i, v_j) = sector.sample_coordinates(), sector.u, sector.v
    across, along = met.slopes[0] - over_length2 * u, met.slopes[1] - over_length2 * v
    return np.hypot(across * u_i, along * (v_j - v_i * u_j / u_i)) / 2 / met.ray_length


def _end_of_steep_bins(edges_m, surface: WaterSurface, backscatter: Callable) -> float:
    """Return the range up to which π σ / sin² g changes by more than MAX_CHANGE within a bin."""
    sines = surface.height_m / np.maximum(edges_m, surface.height_m)
    at_edges = backscatter(np.arcsin(sines)) / sines**2
    wide = np.flatnonzero(np.abs(at_edges[1:] / at_edges[:-1] - 1) > MAX_CHANGE)
    return edges_m[wide[-1] + 1] if len(wide) else edges_m[0]


def _surface_alone(
    samples: SectorSamples,
    surface: WaterSurface,
    steep_m: tuple[float, float],
    over_bin_mean: Callable,
    is_spread: bool,
) -> SectorSamples:
    """Return samples of the surface alone, where no body is nearer; their echo is that by Lambert's law.

    steep_m : between these ranges samples have a factor of their own
    over_bin_mean : function (inverse_m, half_length) -> that factor
    is_spread : samples are spread over their footprints; else each is added to one bin
    """
    met = on_rays(samples, surface)
    plane_echo = np.zeros_like(samples.plane_echo)
    # sin g times slant range is the height
    for part, values in enumerate((met.depth_inverse, *met.slopes, surface.height_m)):
        np.copyto(plane_echo[..., part], values, where=met.is_nearest, casting="same_kind")
    # range below the end, without a division by the 1/x of rays that never meet the surface
    near, far = (met.depth_inverse * edge_m for edge_m in steep_m)
    is_steep = met.is_nearest & (met.ray_length >= near) & (met.ray_length < far)
    if is_steep.any():
        inverse_m = met.depth_inverse[is_steep] / met.ray_length[is_steep]
        plane_echo[is_steep, 3] *= over_bin_mean(inverse_m, is_spread * _half_lengths(samples, met)[is_steep])
    return SectorSamples(samples.sector, plane_echo, samples.body_id)
