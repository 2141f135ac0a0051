"""What hears samples that others drew: views in, pings out."""

from __future__ import annotations

import sys
import warnings
from threading import Lock
from types import SimpleNamespace

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.cameras import Cameras
from sonar_gl.depth_images import LAST_BODY, doubt_of, names_of
from sonar_gl.fan import Sampling
from sonar_gl.hearing import Hearing
from sonar_gl.motion import check_velocity
from sonar_gl.noise import Noise, add_noise, check_seed
from sonar_gl.nothing import why_unheard
from sonar_gl.record import Record
from sonar_gl.rigid import check_pose
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, Ping, check_kind

KEPT = 4  # sets of cameras
IMAGES_ADVICE = "depth must be metres ahead of the camera, above 0: OpenGL's z is minus that"


class Listener:
    """A sonar, its acoustics, and what pings have in common, whoever draws for them.

    Parameters are as for `embed.Sensor`.
    """

    def __init__(self, sonar: Sonar, acoustics: Acoustics | None, sampling: Sampling | None):
        check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()")
        check_kind("sampling", sampling, Sampling | None, "such as sonar_gl.Sampling(2, 100)")
        self.sonar, self.sampling = sonar, sampling
        self.acoustics = acoustics if acoustics is not None else Acoustics.physical()
        if self.acoustics.multipath != "none":
            raise Error(
                'acoustics of what others draw must have multipath "none" '
                f'(got "{self.acoustics.multipath}"; mirrors need the scene: use a Simulator)'
            )
        self._record, self._cameras, self._lock = Record(sonar, self.acoustics), {}, Lock()
        self._is_closed = False

    def _check_open(self):
        if self._is_closed:
            raise Error("this Sensor is closed; make a new one")

    def _ping_of_images(self, cameras, images, pose, planar: bool, *rest) -> Ping:
        pose = check_pose(np.eye(4) if pose is None else pose)
        with self._lock:
            self._check_open()
            heard = self._cameras_of(cameras, images)
            return self._ping(heard.hearing, heard.views(images, planar), pose, IMAGES_ADVICE, *rest)

    def _cameras_of(self, cameras, images) -> Cameras:
        key = tuple((c.width, c.height, c.intrinsics.tobytes(), c.rotation.tobytes()) for c in cameras)
        if (found := self._cameras.pop(key, None)) is None:
            found = Cameras(self.sonar, self.acoustics, cameras, self.sampling)
            for warning in (found.warning, doubt_of(images)):
                if warning:
                    _warn(warning)
        self._cameras[key] = found  # the last one used is last
        while len(self._cameras) > KEPT:
            self._cameras.pop(next(iter(self._cameras))).close()
        return found

    def _ping(
        self, hearing, views, pose, advice, how, bodies, noise, seed, labels, ping_number, velocity
    ) -> Ping:
        """A ping of what was drawn; advice : if that is nothing; how : the tolerance, and which renderer."""
        seed, velocity, bodies = check_seed(seed), check_velocity(velocity), names_of(bodies)
        check_kind("noise", noise, Noise | None, "such as sonar_gl.Noise.physical()")
        intensity = hearing.intensity(views)
        total, found = hearing.reducer.total, (None,) * 3
        if total <= 0:
            nothing = f"no echo came back: what was drawn shows no surface in the fan; {advice}"
            _warn(why_unheard(self.sonar, hearing.fan.sonar, views) or nothing)
        if labels:
            found = _labels(hearing, views, len(bodies))
            bodies += [f"body {number}" for number in range(len(bodies) + 1, len(found[2]))]
        scene = self._record.scene
        if scene is None or ([body.name for body in scene.bodies], scene.how) != (bodies, how):
            named = [SimpleNamespace(name=name) for name in bodies]
            self._record.describe(SimpleNamespace(name="host", bodies=named, plumes=(), how=how), *how)
        ping = self._record.ping(pose, intensity, found, hearing.sampling, seed, total > 0, None, velocity)
        return ping if noise is None else add_noise(ping, noise, seed, ping_number)

    def close(self):
        """End what runs beside; twice does no harm."""
        with self._lock:
            self._is_closed = True
            while self._cameras:
                self._cameras.popitem()[1].close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def _labels(hearing: Hearing, views, n_bodies: int):
    """As of `Reducer.labels`; what has number 0 counts under that."""
    unknown = 1 + max([n_bodies] + [int(numbers.max(initial=0)) for *_, numbers in views])
    if unknown > 1 + LAST_BODY:
        raise Error(f"numbers of bodies must lie in 1..{LAST_BODY}, 0 where none is known (got a higher one)")
    shown = []
    for sector, plane_echo, numbers in views:  # the sums take 0 for all bodies
        numbers = np.where((numbers == 0) & (plane_echo[..., 3] > 0), np.uint16(unknown), numbers)
        shown.append((sector, plane_echo, numbers))
    body_id, elevation_rad, echo = hearing.reducer.labels(shown, hearing.gain, unknown)
    body_id[body_id == unknown] = 0
    return body_id, elevation_rad, np.append(echo[-1], echo[1:-1])


def _warn(message: str) -> None:
    """Warn whoever called this package."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and frame.f_globals["__name__"].startswith("sonar_gl."):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)
