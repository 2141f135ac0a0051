"""The slow truth: the same integral by stratified, jittered Embree rays, sharing no code with reduce."""

from __future__ import annotations

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.scene import Scene, check_pose
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, Ping

FINE = 16  # columns to a beam spacing; the box of a beam ends inside one of them


def cos_incidence(normal, direction):
    """Lambert: per steradian the echo is the cosine of incidence, never above 1 or below 0.

    Parameters
    ----------
    normal : (..., 3) unit, on the side of the sonar; direction : (..., 3) unit, from the sonar

    GLSL twin: shaders/echo.glsl.

    >>> float(cos_incidence(np.array([-1.0, 0, 0]), np.array([1.0, 0, 0])))
    1.0
    """
    return np.clip(-(normal * direction).sum(axis=-1), 0.0, 1.0)


def _embree_scene(scene: Scene, pose):
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except ImportError:
        raise Error(
            "the reference needs Embree (got no module embreex); install it with "
            "\"pip install 'sonar_gl[reference]'\""
        ) from None
    embree = rtcore_scene.EmbreeScene()
    sonar_from_world = np.linalg.inv(pose)
    reflectivity, keep = [], []
    for body in scene.bodies:
        matrix = sonar_from_world @ body.pose
        vertices = np.asarray(body.mesh.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        triangles = vertices[np.asarray(body.mesh.faces)]
        keep.append(TriangleMesh(embree, np.ascontiguousarray(triangles, np.float32)))
        reflectivity.append(np.broadcast_to(body.reflectivity, len(triangles)))
    return embree, keep, reflectivity


def reference_ping(
    scene: Scene,
    sonar: Sonar,
    pose,
    acoustics: Acoustics | None = None,
    n_rays: int = 20_000_000,
    seed: int = 0,
) -> Ping:
    """A ping by ray casting, for judging the fast one; faces count as flat, shading normals are not used.

    Parameters
    ----------
    scene, sonar, acoustics : as for `Simulator`; pose : (4, 4) world_from_sonar
    n_rays : about so many rays, equal in solid angle, one to a cell of a (azimuth, elevation) grid
    seed : of the jitter inside the cells

    Raises
    ------
    Error
        if Embree is not installed.
    """
    pose = check_pose(pose)
    acoustics = Acoustics.physical() if acoustics is None else acoustics
    embree, _keep, reflectivity = _embree_scene(scene, pose)
    rng = np.random.default_rng(seed)
    B, K = sonar.n_beams, sonar.n_bins
    axes = sonar.azimuth_rad
    reach, pattern = acoustics.beam_reach_rad(sonar), acoustics.beam_pattern_function(sonar)
    start, stop = axes[0] - reach, axes[-1] + reach
    if stop - start >= 2 * np.pi:
        start, stop = -np.pi, np.pi
    n_columns = int(np.ceil(FINE * B * (stop - start) / np.radians(sonar.azimuth_fov_deg)))
    per_column = max(1, round(n_rays / n_columns))
    column_rad = (stop - start) / n_columns
    top = np.sin(np.radians(sonar.elevation_fov_deg) / 2)
    sums = np.zeros((n_columns, K))
    step = max(1, 2_000_000 // per_column)
    for first in range(0, n_columns, step):
        columns = np.arange(first, min(first + step, n_columns))
        jitter = rng.random((2, len(columns), per_column))
        # one ray to each of per_column strata of azimuth and to each of elevation, paired at random
        strata = rng.permuted(np.broadcast_to(np.arange(per_column), jitter.shape[1:]), axis=1)
        azimuth = start + column_rad * (columns[:, None] + (strata + jitter[0]) / per_column)
        sine = top * (2 * (np.arange(per_column) + jitter[1]) / per_column - 1)
        cosine = np.sqrt(1 - sine**2)
        d = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine], axis=-1).reshape(-1, 3)
        d = d.astype(np.float32)
        hit = embree.run(np.zeros_like(d), d, output=True)
        good = hit["geomID"] >= 0
        normal = hit["Ng"][good].astype(np.float64)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        normal *= -np.sign((normal * d[good]).sum(axis=1, keepdims=True))
        cosine = cos_incidence(normal, d[good])
        geom, prim = hit["geomID"][good], hit["primID"][good]
        mu = np.empty(len(geom))
        for g in np.unique(geom):
            mu[geom == g] = reflectivity[g][prim[geom == g]]
        k = np.floor((hit["tfar"][good].astype(np.float64) - sonar.range_min_m) / sonar.bin_size_m).astype(
            int
        )
        column = np.repeat(columns - first, per_column)[good]
        inside = (k >= 0) & (k < K)
        flat = np.bincount(column[inside] * K + k[inside], (mu * cosine)[inside], minlength=len(columns) * K)
        sums[first : first + len(columns)] += flat.reshape(len(columns), K)
    sums *= column_rad * 2 * top / per_column
    offset = start + column_rad * (np.arange(n_columns) + 0.5) - axes[:, None]
    offset = (offset + np.pi) % (2 * np.pi) - np.pi
    if pattern is None:
        heard = np.clip((reach - np.abs(offset)) / column_rad + 0.5, 0, 1)
    else:
        heard = pattern(axes[:, None] + offset, axes[:, None]) * (np.abs(offset) <= reach)
    solid_angle = heard.sum(axis=1) * column_rad * 2 * top
    gain = acoustics.gain(sonar.range_m, sonar)
    intensity = (heard @ sums) / solid_angle[:, None] * gain
    return Ping(
        intensity.astype(np.float32), axes, sonar.range_m, pose=pose, meta={"n_rays": per_column * n_columns}
    )
