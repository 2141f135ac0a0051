"""What hears samples that others drew: views in, pings out."""

from __future__ import annotations

import os
import sys
import warnings
from threading import Lock
from typing import NamedTuple

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


class Asked(NamedTuple):
    """What is asked of a ping, whoever draws for it; see `embed.Sensor.ping_from_depth`."""

    bodies: object
    noise: Noise | None
    seed: int
    labels: bool
    ping_number: int
    velocity: object

    def checked(self) -> Asked:
        """The same, or an Error."""
        check_kind("noise", self.noise, Noise | None, "such as sonar_gl.Noise.physical()")
        seed, velocity = check_seed(self.seed), check_velocity(self.velocity)
        return self._replace(bodies=names_of(self.bodies), seed=seed, velocity=velocity)


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
        self._process, self._is_closed = os.getpid(), False

    def _check_open(self):
        if os.getpid() != self._process:  # a fork has not the threads
            raise Error("a Sensor must be used in the process that made it; make one in each process")
        if self._is_closed:
            raise Error("this Sensor is closed; make a new one")

    def _ping_of_images(self, cameras, images, pose, planar: bool, how, asked: Asked) -> Ping:
        """A ping of depth images; how : of `_ping`."""
        pose, asked = check_pose(np.eye(4) if pose is None else pose), asked.checked()
        self._check_open()
        with self._lock:
            heard = self._cameras_of(cameras, images)
            return self._ping(heard.hearing, heard.views(images, planar), pose, IMAGES_ADVICE, how, asked)

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

    def _ping(self, hearing, views, pose, advice: str, how, asked: Asked) -> Ping:
        """A ping of what was drawn, one at a time.

        Parameters
        ----------
        advice : what to look at if that is nothing
        how : the tolerance, or None, and the renderer
        asked : checked
        """
        intensity = hearing.intensity(views)
        total, found, bodies = hearing.reducer.total, {}, asked.bodies
        if total <= 0:
            nothing = f"no echo came back: what was drawn shows no surface in the fan; {advice}"
            _warn(why_unheard(self.sonar, hearing.fan.sonar, views) or nothing)
        if asked.labels:
            found = _labels(hearing, views, len(bodies))
            bodies = bodies + [f"body {number}" for number in range(len(bodies) + 1, len(found["body_echo"]))]
        if self._record.described != (bodies, how):
            self._record.describe((bodies, how), "host", bodies, [], *how)
        sums = intensity, found, hearing.sampling, asked.seed, total > 0, None
        ping = self._record.ping(pose, *sums, asked.velocity)
        return ping if asked.noise is None else add_noise(ping, asked.noise, asked.seed, asked.ping_number)

    def close(self):
        """End what runs beside; twice does no harm."""
        self._is_closed = True
        if os.getpid() != self._process:
            return
        with self._lock:
            while self._cameras:
                self._cameras.popitem()[1].close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def _labels(hearing: Hearing, views, n_bodies: int) -> dict:
    """As of `Reducer.labels`; what has number 0 counts under that."""
    highest = max([n_bodies] + [int(numbers.max(initial=0)) for *_, numbers in views])
    if highest > LAST_BODY:
        raise Error(f"numbers of bodies must lie in 1..{LAST_BODY}, 0 where none is known (got a higher one)")
    return hearing.reducer.labels(views, hearing.gain, highest)


def _warn(message: str) -> None:
    """Warn whoever called this package."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and frame.f_globals["__name__"].startswith("sonar_gl."):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)
