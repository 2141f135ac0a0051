"""The founding paper's picture of a scene, from the rays of its sensor on."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.demarco import demarco_picture
from sonar_gl.noise import Noise


def demarco_image(
    simulator,
    pose,
    seed: int = 0,
    noise: Noise | None = None,
    height: int = 600,
    form: str = "isotropic",
    join: str = "circles",
    range_law: str | None = None,
) -> np.ndarray:
    """The founding paper's picture of a scene: its sensor's rays, 280 x 70 to 45 x 20 degrees, and its chain.

    Parameters
    ----------
    simulator : Simulator, for its scene and sonar
    pose : (4, 4) world_from_sonar
    noise : Noise; None is `Noise.demarco2015()`
    seed, height, form, join : of `demarco_picture`
    range_law : eq. (4) as "printed", "constant" or "inverse"; None is the simulator's own, where it is one
        of these, else "printed"

    Returns
    -------
    array of shape (H, W, 3), uint8 RGB
    """
    noise = Noise.demarco2015() if noise is None else noise
    sonar = simulator.sonar
    columns = max(2, round(280 / 45 * sonar.azimuth_fov_deg))
    rows = max(2, round(70 / 20 * sonar.elevation_fov_deg))
    points, echo = simulator.point_cloud(pose, columns, rows)
    points = points.astype(np.float64)
    range_m = np.linalg.norm(points, axis=-1)
    points[~((range_m >= sonar.range_min_m) & (range_m < sonar.range_max_m))] = np.nan
    own = simulator.acoustics.range_law
    law = range_law or (own if own in ("printed", "constant", "inverse") else "printed")
    gain = Acoustics.demarco2015(law).gain(np.nan_to_num(range_m), sonar)
    return demarco_picture(
        points.reshape(-1, 3),
        (255 * echo * gain).ravel(),
        math.radians(sonar.azimuth_fov_deg),
        sonar.range_max_m,
        height,
        form,
        join,
        echo.shape,
        noise.cloud_gaussian_m,
        noise.median,
        noise.salt_and_pepper,
        seed,
    )
