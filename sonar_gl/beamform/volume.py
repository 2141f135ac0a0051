"""Volume reverberation: the echo of what floats in the water, up to the surfaces that each beam meets.

A backscattering cross section σ at range r adds π σ / r² to the sum over solid angle of μ cos θ, and a solid angle Ω
has the volume r² Ω dr. So water with the cross section s_v per cubic metre returns π s_v dr times the solid angle in
which no surface lies nearer, whatever the range and the width of the beam.

Source: Urick, Principles of Underwater Sound, 3rd ed., 1983, volume reverberation
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.beamformer import BeamEcho, Beamformer
from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sector import Sector


class WaterSurface(NamedTuple):
    """The water's surface in the sonar's frame.

    Attributes
    ----------
    up : (3,) unit vector, upright
    height_m : of the surface over the sonar, metres, above 0
    """

    up: np.ndarray
    height_m: float


def water_surface(pose: np.ndarray, surface_z_m: float | None) -> WaterSurface | None:
    """Return the surface over a sonar in the water; None if there is none, or the sonar is above it.

    Parameters
    ----------
    pose : (4, 4) world_from_sonar
    surface_z_m : height of the surface in the world, metres, or None
    """
    if surface_z_m is None or pose[2, 3] >= surface_z_m:
        return None
    return WaterSurface(pose[2, :3], surface_z_m - pose[2, 3])


def sum_volume(
    beamformer: Beamformer,
    samples: Sequence[SectorSamples],
    gain: np.ndarray,
    strength_db: float,
    surface: WaterSurface | None = None,
) -> BeamEcho:
    """Return the echo of the water in beams and bins, mean of its speckle.

    In beam b and bin k it is π s_v Δr G_k times the share of the beam, by its two-way pattern, in which no surface lies
    nearer than the bin. Half of what surfaces in the bin itself cover is taken as open.

    Parameters
    ----------
    beamformer : Beamformer
    samples : of each sector; their surfaces end the water
    gain : (K,) float32, range gain
    strength_db : volume backscattering strength 10 log10 s_v, dB re 1/m
    surface : of the water, which ends it, too; None = out of reach
    """
    first_m = float(beamformer.fan.sonar.bin_edges_m[0] + beamformer.fan.sonar.bin_size_m / 2)
    if surface is not None:
        samples = [_whole(*pair) for pair in zip(samples, beamformer.fan.sectors, strict=True)]
    closing = [_covered(one, first_m, surface) for one in samples]
    covered = beamformer.sum_footprints(closing).intensity
    scale = math.pi * 10 ** (strength_db / 10) * beamformer.fan.sonar.bin_size_m
    # in float64: a sum over many bins must come to 1 where surfaces fill the beam
    before = np.cumsum(covered, axis=1, dtype=np.float64) - covered / 2
    shares = np.maximum(beamformer.even_response[:, None] - before, 0)
    intensity = (shares * (scale * gain.astype(np.float64))).astype(np.float32)
    return BeamEcho(intensity, float(intensity.sum(dtype=np.float64)))


def _whole(samples: SectorSamples, sector: Sector) -> SectorSamples:
    """Return samples of a whole sector from those of a window in it, outside of which there are no bodies."""
    rows, columns = samples.plane_echo.shape[:2]
    lattice = np.array([sector.u[1:], sector.v[1:]])
    apart = samples.sector.u[0] - sector.u[0], samples.sector.v[0] - sector.v[0]
    i, j = np.rint(np.linalg.solve(lattice, apart)).astype(int)
    plane_echo = np.zeros((sector.rows, sector.columns, 4), np.float32)
    plane_echo[j : j + rows, i : i + columns] = samples.plane_echo
    return SectorSamples(sector, plane_echo, samples.body_id)


def _covered(samples: SectorSamples, first_m: float, surface: WaterSurface | None) -> SectorSamples:
    """Return samples whose sum over beams and bins is the share of each beam that surfaces of a bin cover.

    Their echo per steradian is 1. The water's surface is added where it is nearest. Surfaces nearer than `first_m`,
    metres, count as if they were there, so that they cover the bins behind them.
    """
    sector = samples.sector
    rows, columns = samples.plane_echo.shape[:2]
    j, i = np.mgrid[0:rows, 0:columns]
    u, v = (at[0] + at[1] * i + at[2] * j for at in (sector.u, sector.v))
    length = np.sqrt(1 + u * u + v * v)
    plane = samples.plane_echo[..., :3].astype(np.float64)
    if surface is not None:
        x, y, z = sector.rotation() @ surface.up / surface.height_m
        nearness = x - y * u + z * v
        is_surface = nearness > plane[..., 0]
        plane[is_surface] = np.stack([nearness, np.full_like(u, -y), np.full_like(u, z)], axis=-1)[is_surface]
    is_near = plane[..., 0] * first_m > length
    plane[is_near] = 0
    plane[is_near, 0] = (length / first_m)[is_near]
    echo_range = np.zeros((rows, columns, 4), np.float32)
    echo_range[..., :3] = plane
    np.divide(length, plane[..., 0], out=echo_range[..., 3], where=plane[..., 0] > 0, casting="same_kind")
    return SectorSamples(sector, echo_range, samples.body_id)
