"""Points of a plain grid of rays, as a ray sensor would give them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sonar_gl.raster.engine import RasterEngine
from sonar_gl.sonar.fan import make_fan
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sonar import Sonar


def point_cloud(engine: RasterEngine, sonar: Sonar, head_pose, columns: int, rows: int):
    """Return what `Simulator.point_cloud` gives; inside `drawing`."""
    # one beam a column, that reach to the edges of the field of view and not beyond
    sonar = replace(sonar, n_beams=columns, beam_azimuths_deg=None, beam_spacing="angle")
    reach = math.radians(sonar.azimuth_fov_deg) / columns / 2
    fan = make_fan(sonar, Sampling(1, rows), reach, shear=0.0)
    (view,) = engine.make_renderer(fan, False, engine.make_room()).render([head_pose], full=True)
    points, echoes = [], []
    for sector, plane_echo, _ in view.sectors:
        u, v = sector.sample_coordinates()
        q = plane_echo[..., 0]
        missed = (q <= 0) | (np.abs(v) > sector.tan_elevation * np.sqrt(1 + u * u))
        x = np.where(missed, np.nan, 1 / np.where(missed, 1, q))
        echo = plane_echo[..., 3] / (x * np.sqrt(1 + u * u + v * v))
        rays = np.stack([x, -u * x, v * x], axis=-1) @ sector.rotation()
        # only this sector's own rays, by rising azimuth
        inner = np.abs(u[0]) < math.tan(sector.half_width_rad)
        points.append(rays[:, inner][:, ::-1].astype(np.float32))
        echoes.append(np.where(missed, 0, echo)[:, inner][:, ::-1])
    return np.concatenate(points, axis=1), np.concatenate(echoes, axis=1)
