"""Pings of what other programs have drawn: depth images from the sonar's place."""

from __future__ import annotations

import math
import sys
import warnings
from functools import lru_cache
from threading import Lock
from types import SimpleNamespace

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.camera import Camera, covered
from sonar_gl.depth_images import UNKNOWN, images_of, names_of
from sonar_gl.fan import MAX_COLUMNS_PER_BEAM, MAX_ROW_DEG, MAX_ROWS, MIN_COLUMNS, MIN_ROWS, Sampling
from sonar_gl.hearing import Hearing
from sonar_gl.motion import check_velocity
from sonar_gl.noise import Noise, add_noise, check_seed
from sonar_gl.nothing import why_unheard
from sonar_gl.pair import Pair
from sonar_gl.record import Record
from sonar_gl.resample import Planes
from sonar_gl.rigid import check_pose
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, Ping, check_kind

KEPT = 4  # sonars of `ping_from_depth`, and sets of cameras of each
FINER = 1.0  # samples than pixels, across and up
MAX_SAMPLES = 1 << 22  # that are chosen
# Less of the fan is worth a warning: rays that graze the border of an image may miss it.
COVERED = 0.999


class _Setup:
    """What one set of cameras needs again at every ping."""

    def __init__(self, sonar: Sonar, acoustics: Acoustics, cameras: list[Camera], sampling: Sampling | None):
        self.hearing = Hearing(sonar, acoustics, sampling or sampling_of(sonar, cameras))
        self.pair = Pair()
        self.planes = [Planes(camera, self.pair) for camera in cameras]
        self.views = [
            (s, np.zeros((s.rows, s.columns, 4), np.float32), np.zeros((s.rows, s.columns), np.uint16))
            for s in self.hearing.fan.sectors
        ]
        # cameras that a sector's rays look at, one after the other; rays beside all images come last
        order = range(len(cameras))
        looks = [(n, False) for n in order if len(cameras) > 1] + [(n, True) for n in order]
        self.looks = [list(looks) for _ in self.views]

    def close(self):
        self.hearing.reducer.close()
        self.pair.close()


def _check_coverage(sonar: Sonar, cameras) -> None:
    """Warn if the cameras do not see all of the fan, or an Error if nothing."""
    share = covered(sonar, cameras)
    if share == 0:
        raise Error(f"the cameras must look into the sonar's fan (they see nothing of it; {_needed(sonar)})")
    if share < COVERED:
        _warn(
            f"the cameras see {100 * share:.1f} % of the sonar's fan, and nothing is heard of the rest: "
            + _needed(sonar)
        )


def _warn(message: str) -> None:
    """Warn whoever called this module."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals is globals():
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


def _needed(sonar: Sonar) -> str:
    return (
        f"azimuths within ±{sonar.azimuth_fov_deg / 2:g}° and elevations within "
        f"±{sonar.elevation_fov_deg / 2:g}° are needed, which the cameras of Camera.covering(sonar) see"
    )


def sampling_of(sonar: Sonar, cameras) -> Sampling:
    """Samples as fine as the finest of the cameras' pixels, so that the images err and not the samples."""
    across, up = (min(size) / FINER for size in zip(*(c.pixel_rad() for c in cameras), strict=True))
    columns = max(math.radians(sonar.azimuth_fov_deg) / across, MIN_COLUMNS)
    aperture = 2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    rows = max(aperture / min(up, math.radians(MAX_ROW_DEG)), MIN_ROWS)
    fewer = math.sqrt(min(1.0, MAX_SAMPLES / (columns * rows)))
    return Sampling(
        min(fewer * columns / sonar.n_beams, MAX_COLUMNS_PER_BEAM), min(math.ceil(fewer * rows), MAX_ROWS)
    )


class Sensor:
    """A sonar that hears what other programs draw. Use it in a `with` block, or call `close()`.

    Parameters
    ----------
    sonar : Sonar
    acoustics : Acoustics; None is `Acoustics.physical()`. No smooth faces are known, and so no lobes of them
    sampling : Sampling; None is as fine as the images

    Raises
    ------
    Error
        if the acoustics have multipath, which needs a scene.
    """

    def __init__(self, sonar: Sonar, acoustics: Acoustics | None = None, sampling: Sampling | None = None):
        check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()")
        check_kind("sampling", sampling, Sampling | None, "such as sonar_gl.Sampling(2, 100)")
        self.sonar, self.sampling = sonar, sampling
        self.acoustics = acoustics if acoustics is not None else Acoustics.physical()
        if self.acoustics.multipath != "none":
            raise Error(
                'acoustics of depth images must have multipath "none" '
                f'(got "{self.acoustics.multipath}"; mirrors need the scene: use a Simulator)'
            )
        self._record, self._setups, self._lock = Record(sonar, self.acoustics), {}, Lock()

    def ping_from_depth(
        self, depth, camera, pose=None, planar=True, normals=None, body_id=None, reflectivity=UNKNOWN,
        bodies=(), noise=None, seed=0, labels=False, ping_number=0, velocity=None,
    ) -> Ping:  # fmt: skip
        """A ping of depth images drawn from the sonar's place.

        Parameters
        ----------
        depth : (H, W) float, metres; 0, NaN, infinity and less than 0 are nothing. The first row is the
            top one
        camera : Camera; or a list of several, to see a wide fan, of depth, and of normals, body_id and an
            image of reflectivity where given, then lists as long. What several see the first one shows
        pose : (4, 4) world_from_sonar, None for the origin; it is kept with the ping, and decides the
            speckle of noise that stays with the place
        planar : depth runs along the camera's axis, as in z-buffers and most depth cameras; False: along each
            pixel's ray, as ranges do
        normals : (H, W, 3) of the faces themselves, not smoothed, of any length and either side, camera axes
            (x right, y down, z ahead); None, and 0 or NaN in a pixel: found from the depth beside it
        body_id : (H, W) whole numbers, 1..65534 of bodies, 0 where none is known, which still echoes
        reflectivity : μ in 0..1: one; or (H, W); or a dict from numbers of bodies, others having 0.5
        bodies : names of the bodies for the ping's meta, that of number 1 first
        noise, seed, labels, ping_number, velocity : as of `Simulator.ping`; with labels the first entry of
            `body_echo` is the echo of what has number 0

        Warns
        -----
        UserWarning
            if the cameras do not see all of the fan, once for a set of them; if nothing came back.

        Raises
        ------
        Error
            if an image does not fit its camera, or the cameras see nothing of the fan.
        """
        pose = check_pose(np.eye(4) if pose is None else pose)
        seed, velocity = check_seed(seed), check_velocity(velocity)
        check_kind("noise", noise, Noise | None, "such as sonar_gl.Noise.physical()")
        bodies = names_of(bodies)
        cameras, images = images_of(camera, depth, normals, body_id, reflectivity)
        with self._lock:
            setup = self._setup(cameras)
            intensity, total, found = self._hear(setup, images, planar, labels, len(bodies))
            if total <= 0:
                drawn = setup.hearing.fan.sonar
                why = why_unheard(self.sonar, drawn, setup.views)
                nothing = "no echo came back: the images show no surface in the fan"
                _warn(why or nothing)
            if self._record.scene is None or [b.name for b in self._record.scene.bodies] != bodies:
                shown = [SimpleNamespace(name=name) for name in bodies]
                scene = SimpleNamespace(name="depth_image", bodies=shown, plumes=())
                self._record.describe(scene, None, "none: depth image")
            sampling = setup.hearing.sampling
            ping = self._record.ping(pose, intensity, found, sampling, seed, total > 0, None, velocity)
        return ping if noise is None else add_noise(ping, noise, seed, ping_number)

    def _setup(self, cameras) -> _Setup:
        """That of these cameras."""
        key = tuple((c.width, c.height, c.intrinsics.tobytes(), c.rotation.tobytes()) for c in cameras)
        if (found := self._setups.pop(key, None)) is None:
            _check_coverage(self.sonar, cameras)
            found = _Setup(self.sonar, self.acoustics, cameras, self.sampling)
        self._setups[key] = found  # the last one used is last
        while len(self._setups) > KEPT:
            self._setups.pop(next(iter(self._setups))).close()
        return found

    def _hear(self, setup, images, planar, labels, n_bodies):
        """(B, K) intensity, its sum, and labels or three None."""
        if labels:
            n_bodies = max([n_bodies] + [int(image.body_id.max(initial=0)) for image in images])
        hearing = setup.hearing
        for image, planes in zip(images, setup.planes, strict=True):
            planes.find(image.depth, bool(planar), image.normals, image.reflectivity)
        for looks, (sector, plane_echo, numbers) in zip(setup.looks, setup.views, strict=True):
            counts = [
                setup.planes[n].lay(sector, images[n].body_id, k == 0, beyond, plane_echo, numbers)
                for k, (n, beyond) in enumerate(looks)
            ]
            # the first of them clears the rest, too
            looks[1:] = [look for look, count in zip(looks[1:], counts[1:], strict=True) if count]
            if labels:  # the sums take 0 for all bodies: what is unknown gets a number of its own
                numbers[(numbers == 0) & (plane_echo[..., 3] > 0)] = n_bodies + 1
        intensity = hearing.intensity(setup.views)
        total, found = hearing.reducer.total, (None,) * 3
        if labels:
            body, elevation, echo = hearing.reducer.labels(setup.views, hearing.gain, n_bodies + 1)
            body[body == n_bodies + 1] = 0
            found = body, elevation, np.append(echo[-1], echo[1:-1])
        return intensity, total, found

    def close(self):
        """Give back what this holds; twice does no harm."""
        with self._lock:
            while self._setups:
                self._setups.popitem()[1].close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


@lru_cache(KEPT)
def _sensor(sonar, acoustics, sampling) -> Sensor:
    return Sensor(sonar, acoustics, sampling)


def ping_from_depth(
    depth, sonar, camera, acoustics: Acoustics | None = None, sampling: Sampling | None = None, **more
) -> Ping:
    """A ping of depth images that another program drew from the sonar's place.

    What it makes for a sonar is kept for the next call, of the last four sonars.

    Parameters
    ----------
    sonar, acoustics, sampling : as for `Sensor`
    depth, camera, more : as for `Sensor.ping_from_depth`
    """
    for thing in (sonar, acoustics, sampling):
        if type(thing).__hash__ is None:  # named in the error of `Sensor`, not in one of the cache
            Sensor(sonar, acoustics, sampling)
    return _sensor(sonar, acoustics, sampling).ping_from_depth(depth, camera, **more)
