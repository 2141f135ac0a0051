"""The visible surface whose echo falls into a bin."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.live.frame import Surface
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sonar import Sonar

RAYS = Sampling(columns_per_beam=16, rows=2048)  # over the width of a beam and the main lobe in elevation
# Where a bin has no surface of its own, the nearest one within so many bins counts: pulse, and samples as coarse as the
# tolerance allows, spread its echo.
SPREAD_BINS = 5


def surface_in_bin(
    simulator: Simulator,
    sonar: Sonar,
    acoustics: Acoustics,
    world_from_sonar: np.ndarray,
    beam: int,
    bin: int,
) -> Surface:
    """Return the visible surface whose echo falls into a bin.

    Parameters
    ----------
    simulator : whose world is looked at
    sonar, acoustics : of the ping
    world_from_sonar : (4, 4) pose of the housing
    beam, bin : indices
    """
    true = acoustics.true_range_sonar(sonar)
    azimuth_rad = true.azimuth_rad
    spacing_deg = math.degrees(np.diff(azimuth_rad).min()) if true.n_beams > 1 else true.azimuth_fov_deg
    width_deg = max(true.beam_width_deg, spacing_deg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of numbers that the sonar itself has, too
        narrow = replace(
            true,
            n_beams=1,
            beam_azimuths_deg=None,
            beam_spacing="angle",
            azimuth_fov_deg=width_deg,
            beam_width_deg=width_deg,
            tilt_deg=0.0,
        )
        with Simulator(simulator, narrow, Acoustics.ideal(), sampling=RAYS) as eye:
            # the beam's axis becomes the boresight
            world_from_beam = sonar.head_pose(world_from_sonar) @ make_pose(yaw=float(azimuth_rad[beam]))
            seen = zip(eye.fan.sectors, eye.gbuffers(world_from_beam), strict=True)
            parts = [
                _points_at(sector, gbuffer, world_from_beam, true.range_m[bin], true.bin_size_m)
                for sector, gbuffer in seen
            ]
    return Surface(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _points_at(sector, gbuffer, world_from_beam, range_m: float, bin_size_m: float):
    """Return points, normals and bodies of a sector's samples at the ranges of a bin."""
    u, v = sector.sample_coordinates()
    seen = (
        (gbuffer.body_id > 0) & sector.holds_elevation(u, v) & (np.abs(u) <= math.tan(sector.half_width_rad))
    )
    # a sample covers half of the way to its neighbour above or below, whichever is nearer on the same body
    step_m = np.full(seen.shape, np.inf)
    same = seen[1:] & seen[:-1] & (gbuffer.body_id[1:] == gbuffer.body_id[:-1])
    apart_m = np.where(same, np.abs(np.diff(gbuffer.range_m, axis=0)), np.inf)
    step_m[1:] = apart_m
    step_m[:-1] = np.minimum(step_m[:-1], apart_m)
    half_sample_m = np.where(np.isfinite(step_m), step_m, 0.0) / 2
    off_m = np.abs(gbuffer.range_m - range_m) - half_sample_m
    chosen = seen & (off_m <= bin_size_m / 2)
    if seen.any() and not chosen.any():
        nearest_m = off_m[seen].min() + bin_size_m / 2
        chosen = seen & (off_m <= min(nearest_m, (SPREAD_BINS + 0.5) * bin_size_m))
    rays = np.stack([np.ones_like(u), -u, v], axis=-1)[chosen] @ sector.rotation()
    rays *= (gbuffer.range_m[chosen] / np.linalg.norm(rays, axis=-1))[:, None]
    turn, origin = world_from_beam[:3, :3], world_from_beam[:3, 3]
    return (
        (rays @ turn.T + origin).astype(np.float32),
        (gbuffer.normal[chosen] @ turn.T).astype(np.float32),
        gbuffer.body_id[chosen],
    )
