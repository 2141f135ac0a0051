"""The cameras whose images a sonar hears: what of the fan they see, and the samples of it."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.camera import Camera, covered
from sonar_gl.fan import MAX_COLUMNS_PER_BEAM, MAX_ROW_DEG, MAX_ROWS, MIN_COLUMNS, MIN_ROWS, Sampling
from sonar_gl.hearing import Hearing
from sonar_gl.pair import Pair
from sonar_gl.resample import Planes
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error

MAX_SAMPLES = 1 << 22  # that are chosen
# Less of the fan is worth a warning: rays that graze the border of an image may miss it.
COVERED = 0.999


class Cameras:
    """One set of cameras, and what is needed again at every ping of their images.

    Attributes
    ----------
    hearing : Hearing
    warning : None, or a sentence about what they do not see

    Raises
    ------
    Error
        if they see nothing of the fan.
    """

    def __init__(self, sonar: Sonar, acoustics: Acoustics, cameras: list[Camera], sampling: Sampling | None):
        share = covered(sonar, cameras)
        needed = (
            f"azimuths within ±{sonar.azimuth_fov_deg / 2:g}° and elevations within "
            f"±{sonar.elevation_fov_deg / 2:g}° are needed, which the cameras of Camera.covering(sonar) see"
        )
        if share == 0:
            raise Error(f"the cameras must look into the sonar's fan (they see nothing of it; {needed})")
        self.warning = None
        if share < COVERED:
            seen = f"the cameras see {100 * share:.1f} % of the sonar's fan"
            self.warning = f"{seen}, and nothing is heard of the rest: {needed}"
        self.hearing = Hearing(sonar, acoustics, sampling or finest_of(sonar, cameras))
        self._pair = Pair()
        self._planes = [Planes(camera, self._pair) for camera in cameras]
        self._views = [
            (s, np.zeros((s.rows, s.columns, 4), np.float32), np.zeros((s.rows, s.columns), np.uint16))
            for s in self.hearing.fan.sectors
        ]
        # cameras that a sector's rays look at, one after the other; rays beside all images come last
        order = range(len(cameras))
        looks = [(n, False) for n in order if len(cameras) > 1] + [(n, True) for n in order]
        self._looks = [list(looks) for _ in self._views]

    def views(self, images, planar: bool) -> list:
        """(sector, (R, C, 4) plane and echo, (R, C) body) of each sector, until the next call."""
        for image, planes in zip(images, self._planes, strict=True):
            planes.find(image.depth, planar, image.normals, image.reflectivity)
        for looks, (sector, plane_echo, numbers) in zip(self._looks, self._views, strict=True):
            counts = [
                self._planes[n].lay(sector, images[n].body_id, k == 0, beyond, plane_echo, numbers)
                for k, (n, beyond) in enumerate(looks)
            ]
            # the first of them clears the rest, too
            looks[1:] = [look for look, count in zip(looks[1:], counts[1:], strict=True) if count]
        return self._views

    def close(self):
        """End the other threads."""
        self.hearing.reducer.close()
        self._pair.close()


def finest_of(sonar: Sonar, cameras) -> Sampling:
    """Samples as fine as the finest of the cameras' pixels, so that the images err and not the samples."""
    across, up = (min(size) for size in zip(*(c.pixel_rad() for c in cameras), strict=True))
    columns = max(math.radians(sonar.azimuth_fov_deg) / across, MIN_COLUMNS)
    aperture = 2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    rows = max(aperture / min(up, math.radians(MAX_ROW_DEG)), MIN_ROWS)
    fewer = math.sqrt(min(1.0, MAX_SAMPLES / (columns * rows)))
    return Sampling(
        min(fewer * columns / sonar.n_beams, MAX_COLUMNS_PER_BEAM), min(math.ceil(fewer * rows), MAX_ROWS)
    )
