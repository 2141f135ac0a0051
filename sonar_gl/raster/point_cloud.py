"""Points of a plain grid of rays, as a ray sensor would give them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sonar_gl.core.checks import check_whole_number
from sonar_gl.raster.engine import RasterEngine
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.sampling import MAX_COLUMNS_PER_BEAM, Sampling
from sonar_gl.sonar.sonar import Sonar

MAX_CLOUD_COLUMNS = 65536  # as many as a sonar may have beams


def point_cloud(engine: RasterEngine, sonar: Sonar, head_pose, columns: int, rows: int):
    """Return what `Simulator.point_cloud` gives; inside `drawing`."""
    columns = check_whole_number("columns of a point cloud", columns, 1, MAX_CLOUD_COLUMNS)
    # as few beams as hold the columns: very many in a narrow fan are a mistake of a data sheet, of which it would warn.
    # They reach to the edges of the field of view and not beyond
    n_beams = math.ceil(columns / MAX_COLUMNS_PER_BEAM)
    sonar = replace(sonar, n_beams=n_beams, beam_azimuths_deg=None, beam_spacing="angle")
    reach = math.radians(sonar.azimuth_fov_deg) / n_beams / 2
    fan = make_fan(sonar, Sampling(columns / n_beams, rows), BeamShape(reach), shear=0.0)
    renderer = engine.make_renderer(fan, False, engine.make_workspace())
    (view,) = renderer.render([head_pose], [_diffuse(engine.meshes)], full=True)
    points, echoes = [], []
    for sector, plane_echo, *_ in view.sectors:
        u, v = sector.sample_coordinates()
        q = plane_echo[..., 0]
        missed = (q <= 0) | ~sector.holds_elevation(u, v)
        x = np.where(missed, np.nan, 1 / np.where(missed, 1, q))
        echo = plane_echo[..., 3] / (x * np.sqrt(1 + u * u + v * v))
        rays = np.stack([x, -u * x, v * x], axis=-1) @ sector.rotation()
        # only this sector's own rays, by rising azimuth
        inner = np.abs(u[0]) < math.tan(sector.half_width_rad)
        points.append(rays[:, inner][:, ::-1].astype(np.float32))
        echoes.append(np.where(missed, 0, echo)[:, inner][:, ::-1])
    return np.concatenate(points, axis=1), np.concatenate(echoes, axis=1)


def _diffuse(meshes: SceneMeshes) -> SceneState:
    """Return the state of a scene whose bodies scatter diffusely what their specular lobes reflect, too.

    A ray sensor has one reflectivity a body, and without its lobe steel would be as dark as sand.
    """
    reflectivity = meshes.reflectivity.copy()
    for number, body in enumerate(meshes.bodies):
        if body.specular > 0:
            mean = float(np.mean(body.reflectivity))
            total = min(mean + body.specular, 1.0)
            # where faces have reflectivities of their own, the number is a factor on them
            is_factor = np.ndim(body.reflectivity) > 0 and mean > 0
            reflectivity[number] = total / mean if is_factor else total
    return replace(meshes.state, reflectivity=reflectivity)
