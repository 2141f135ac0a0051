"""The visible surface whose echo falls into a bin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.core.warn import collected_warnings
from sonar_gl.live.frame import Surface
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.fan import azimuths_of_cones
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
    """Return the visible surface whose echo falls into a bin of a ping.

    simulator : whose world is looked at
    world_from_sonar : (4, 4) pose of the housing
    """
    true = acoustics.true_range_sonar(sonar)
    azimuth_rad = true.azimuth_rad
    spacing_deg = math.degrees(np.diff(azimuth_rad).min()) if true.n_beams > 1 else true.azimuth_fov_deg
    width_deg = max(true.beam_width_deg, spacing_deg)
    shown_rad = float(azimuth_rad[beam])
    first_rad = last_rad = shown_rad
    if acoustics.has_cones(sonar):  # what is seen up and down lies further aside than the beam points
        top_rad = math.radians(true.elevation_fov_deg) / 2
        first_rad, last_rad = azimuths_of_cones(shown_rad, shown_rad, top_rad)
    fov_deg = width_deg + math.degrees(last_rad - first_rad)
    sampling = replace(RAYS, columns_per_beam=RAYS.columns_per_beam * fov_deg / width_deg)
    with collected_warnings():  # of numbers that the sonar itself has, too
        narrow = replace(
            true,
            n_beams=1,
            beam_azimuths_deg=None,
            beam_spacing="angle",
            azimuth_fov_deg=fov_deg,
            beam_width_deg=fov_deg,
            tilt_deg=0.0,
        )
        with Simulator(simulator, narrow, Acoustics.ideal(), sampling=sampling) as eye:
            # the middle becomes the boresight
            head_from_eye = make_pose(yaw=(first_rad + last_rad) / 2)
            cone = None
            if first_rad < last_rad:
                cone = head_from_eye[1, :3], shown_rad, math.radians(width_deg) / 2
            world_from_eye = sonar.head_pose(world_from_sonar) @ head_from_eye
            seen = zip(eye.fan.sectors, eye.gbuffers(world_from_eye), strict=True)
            parts = [
                _points_at(sector, gbuffer, world_from_eye, true.range_m[bin], true.bin_size_m, cone)
                for sector, gbuffer in seen
            ]
    return Surface(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _points_at(sector, gbuffer, world_from_eye, range_m: float, bin_size_m: float, cone: tuple | None):
    """Return points, normals and bodies of a sector's samples at the ranges of a bin.

    cone : the array's axis, (3,), the azimuth at which it shows the cone, and half of the cone's width; None: the beam
        is upright
    """
    u, v = sector.sample_coordinates()
    seen = (
        (gbuffer.body_id > 0) & sector.holds_elevation(u, v) & (np.abs(u) <= math.tan(sector.half_width_rad))
    )
    if cone is not None:
        axis, shown_rad, half_width_rad = cone
        directions = np.stack([np.ones_like(u), -u, v], axis=-1) / np.sqrt(1 + u * u + v * v)[..., None]
        seen &= np.abs(np.arcsin(directions @ (sector.rotation() @ axis)) - shown_rad) <= half_width_rad
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
    turn, origin = world_from_eye[:3, :3], world_from_eye[:3, 3]
    return (
        rays @ turn.T + origin,
        (gbuffer.normal[chosen] @ turn.T).astype(np.float32),
        gbuffer.body_id[chosen],
    )
