"""Volume reverberation: the echo of what floats in the water, up to the surfaces that each beam meets.

A backscattering cross section σ at range r adds π σ / r² to the sum over solid angle of μ cos θ, and a solid angle Ω
has the volume r² Ω dr. So water with the cross section s_v per cubic metre returns π s_v dr times the solid angle in
which no surface lies nearer, whatever the range and the width of the beam.

Source: Urick, Principles of Underwater Sound, 3rd ed., 1983, volume reverberation
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sonar_gl.beamform.beamformer import BeamEcho, Beamformer
from sonar_gl.beamform.water_surface import WaterSurface, on_rays, ray_lengths, whole_sector
from sonar_gl.sonar.samples import SectorSamples


def sum_volume(
    beamformer: Beamformer,
    samples: Sequence[SectorSamples],
    gain: np.ndarray,
    strength_db: float,
    surface: WaterSurface | None,
) -> BeamEcho:
    """Return the echo of the water in beams and bins, mean of its speckle.

    In beam b and bin k it is π s_v Δr G_k times the share of the beam, by its two-way pattern, in which no surface lies
    nearer than the bin. Half of what surfaces in the bin itself cover is taken as open.

    samples : of each sector; their surfaces end the water
    gain : (K,) float32, range gain
    strength_db : volume backscattering strength 10 log10 s_v, dB re 1/m
    surface : of the water, which ends it, too; None = out of reach
    """
    first_m = float(beamformer.fan.sonar.bin_edges_m[0] + beamformer.fan.sonar.bin_size_m / 2)
    if surface is not None:
        samples = map(whole_sector, samples, beamformer.fan.sectors)
    closing = [_covered(one, first_m, surface) for one in samples]
    covered = beamformer.sum_footprints(closing).intensity
    scale = math.pi * 10 ** (strength_db / 10) * beamformer.fan.sonar.bin_size_m
    # in float64: a sum over many bins must come to 1 where surfaces fill the beam
    before = np.cumsum(covered, axis=1, dtype=np.float64) - covered / 2
    shares = np.maximum(beamformer.even_response[:, None] - before, 0)
    intensity = (shares * (scale * gain.astype(np.float64))).astype(np.float32)
    return BeamEcho(intensity, float(intensity.sum(dtype=np.float64)))


def _covered(samples: SectorSamples, first_m: float, surface: WaterSurface | None) -> SectorSamples:
    """Return samples whose sum over beams and bins is the share of each beam that surfaces of a bin cover.

    Their echo per steradian is 1. The water's surface is added where it is nearest. Surfaces nearer than `first_m`,
    metres, count as if they were there, so that they cover the bins behind them.
    """
    length = ray_lengths(samples)
    plane = samples.plane_echo[..., :3].astype(np.float64)
    if surface is not None:
        on_surface = on_rays(samples, surface)
        for part, values in enumerate((on_surface.depth_inverse, *on_surface.slopes)):
            np.copyto(plane[..., part], values, where=on_surface.is_nearest)
    is_near = plane[..., 0] * first_m > length
    plane[is_near] = 0
    plane[is_near, 0] = (length / first_m)[is_near]
    echo_range = np.zeros_like(samples.plane_echo)
    echo_range[..., :3] = plane
    np.divide(length, plane[..., 0], out=echo_range[..., 3], where=plane[..., 0] > 0, casting="same_kind")
    return SectorSamples(samples.sector, echo_range, samples.body_id)
