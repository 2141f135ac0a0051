"""A set of cameras at the sonar's position, and the samples of the fan taken from their images."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.core.worker import SecondThread
from sonar_gl.embed.camera import Camera, covered_fraction
from sonar_gl.embed.resample import PixelPlanes
from sonar_gl.engine.stage import Stage
from sonar_gl.sonar.fan import azimuths_of_cones
from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sampling import (
    MAX_COLUMNS_PER_BEAM,
    MAX_ROW_DEG,
    MAX_ROWS,
    MIN_COLUMNS,
    MIN_ROWS,
    Sampling,
)
from sonar_gl.sonar.sonar import Sonar

MAX_SAMPLES = 1 << 22  # of a sampling that follows from the images
# A smaller covered fraction of the fan causes a warning. It is below 1, since rays that graze the border of an image
# may miss it.
MIN_COVERED_FRACTION = 0.999


class CameraRig:
    """A set of cameras with the arrays that every ping of their images reuses; Error if they see nothing of the fan.

    sampling : None chooses samples as fine as the pixels
    make_stage : function (sampling) -> Stage of the sonar
    are_cones : whether beams are cones
    """

    def __init__(
        self,
        sonar: Sonar,
        cameras: list[Camera],
        sampling: Sampling | None,
        make_stage: Callable[[Sampling], Stage],
        thread: SecondThread,
        are_cones: bool,
    ):
        if sonar.tilt_deg:
            cameras = [camera.seen_from_head(sonar) for camera in cameras]
        covered = covered_fraction(sonar, cameras, are_cones)
        edges = sonar.fan_edges_rad
        if are_cones:
            edges = azimuths_of_cones(*edges, math.radians(sonar.elevation_fov_deg) / 2)
        low_deg, high_deg = np.degrees(edges).tolist()
        is_even = math.isclose(-low_deg, high_deg)
        azimuths = f"within ±{high_deg:.4g}°" if is_even else f"from {low_deg:.4g}° to {high_deg:.4g}°"
        tilted = f" of a head tilted {sonar.tilt_deg:g}° down" if sonar.tilt_deg else ""
        needed = (
            f"azimuths {azimuths} and elevations within "
            f"±{sonar.elevation_fov_deg / 2:g}°{tilted} are needed, which the cameras of Camera.covering(sonar) see"
        )
        if covered == 0:
            raise Error(f"the cameras must look into the sonar's fan (they see nothing of it; {needed})")
        self.warning = None  # or a sentence about the part of the fan that no camera sees
        if covered < MIN_COVERED_FRACTION:
            finding = f"the cameras see {100 * covered:.1f} % of the sonar's fan"
            self.warning = f"{finding}, and the rest returns no echo: {needed}"
        self.stage = make_stage(sampling or finest_sampling(sonar, cameras))
        self._planes = [PixelPlanes(camera, thread) for camera in cameras]
        self._samples = [
            SectorSamples(
                s, np.zeros((s.rows, s.columns, 4), np.float32), np.zeros((s.rows, s.columns), np.uint16)
            )
            for s in self.stage.fan.sectors
        ]
        # For each sector, (camera, include_border) in the order in which its rays try the images. Rays just outside
        # of all images come last: they take the nearest border.
        order = range(len(cameras))
        lookups = [(n, False) for n in order if len(cameras) > 1] + [(n, True) for n in order]
        self._lookups = [list(lookups) for _ in self._samples]

    def samples(self, images, planar: bool) -> list[SectorSamples]:
        """Return the samples of each sector, valid until the next call."""
        for image, planes in zip(images, self._planes, strict=True):
            planes.find(image.depth, planar, image.normals, image.reflectivity)
        for lookups, samples in zip(self._lookups, self._samples, strict=True):
            counts = [
                self._planes[n].sample(samples, images[n].body_id, k == 0, include_border)
                for k, (n, include_border) in enumerate(lookups)
            ]
            # Later pings skip the images that no ray hits; the first one stays, since it also clears the samples.
            lookups[1:] = [one for one, count in zip(lookups[1:], counts[1:], strict=True) if count]
        return self._samples


def finest_sampling(sonar: Sonar, cameras) -> Sampling:
    """Return samples as fine as the smallest pixel of the cameras, so that the images limit the accuracy."""
    across, up = (min(size) for size in zip(*(c.pixel_rad() for c in cameras), strict=True))
    columns = max(math.radians(sonar.azimuth_fov_deg) / across, MIN_COLUMNS)
    aperture = 2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    rows = max(aperture / min(up, math.radians(MAX_ROW_DEG)), MIN_ROWS)
    fewer = math.sqrt(min(1.0, MAX_SAMPLES / (columns * rows)))
    return Sampling(
        min(fewer * columns / sonar.n_beams, MAX_COLUMNS_PER_BEAM), min(math.ceil(fewer * rows), MAX_ROWS)
    )
