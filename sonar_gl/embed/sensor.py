"""A sonar inside a program that renders its own world.

There are four embedding modes. This module implements three: the host draws the sonar's sectors with its own shaders
(`Sensor.sectors`), hands over textures (`Sensor.ping_from_textures`), or hands over depth images as arrays
(`ping_from_depth`). The fourth is a `Simulator` that shares the host's OpenGL context.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.beamform.beamformer import beam_shape, make_beamformer
from sonar_gl.core.checks import check_kind
from sonar_gl.core.closing import Closable
from sonar_gl.core.data_files import data_folder
from sonar_gl.core.errors import Error, closed_error, other_process_error
from sonar_gl.core.poses import check_pose
from sonar_gl.core.warn import warn_caller
from sonar_gl.core.worker import SecondThread, ThreadLock
from sonar_gl.embed.camera import Camera
from sonar_gl.embed.camera_rig import CameraRig
from sonar_gl.embed.depth_images import (
    MAX_BODY_ID,
    check_body_names,
    check_images,
    is_planar,
    normals_suspicion,
    z_buffer_suspicion,
)
from sonar_gl.embed.framebuffer import release_framebuffers
from sonar_gl.embed.sectors import Drawing, DrawnSector
from sonar_gl.embed.textures import read_images
from sonar_gl.engine.flow import DrawnPing, Resolution
from sonar_gl.engine.instrument import Instrument
from sonar_gl.engine.no_echo import why_view_has_no_echo
from sonar_gl.engine.pipeline import assemble, receive
from sonar_gl.engine.provenance import SampleOrigin
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.stage import Stage
from sonar_gl.gl import lifetime
from sonar_gl.gl.host import CurrentContext, HostContext
from sonar_gl.gl.shaders import load_shader
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import DEFAULT_REFLECTIVITY
from sonar_gl.sonar.fan import NEAR_M, fitted_sampling
from sonar_gl.sonar.samples import SectorSamples, ViewSamples
from sonar_gl.sonar.sampling import Sampling, check_tolerance, sampling_at, typical_level
from sonar_gl.sonar.sonar import Sonar

MAX_RIGS = 4


class DepthKind(NamedTuple):
    """What the depths of images are."""

    planar: bool  # whether they lie along the camera's axis; otherwise along each ray
    advice: str  # what to check if a ping has no echo
    may_be_z_buffer: bool = True  # whether a caller may have taken a z-buffer for metres


IMAGES_ADVICE = "depth must be metres ahead of the camera, above 0: OpenGL's z is minus that"
METRES_ADVICE = 'a texture of metres must hold them above 0; a depth attachment is holds="z-buffer"'
Z_BUFFER_ADVICE = (
    "projection must be the one that the z-buffer was drawn with, and zero_to_one be True if glClipControl had set "
    "GL_ZERO_TO_ONE, as for most reversed z-buffers"
)


def glsl() -> str:
    """Return GLSL text that a host's fragment shader includes, after `#version` 330 or higher, to draw sectors.

    The shader calls `sonar_gl_write(vec3 normal, float reflectivity, uint body)` once: normal in the view's axes (x
    right, y up, z back), of any length, or vec3(0) for the normal of the flat face; reflectivity 0..1; body 1..65534, 0
    for none. A fourth argument, vec2, holds |R|², 0..1, and the rms slope, 0.01..0.5, of a smooth face; vec2(0) is
    none. Other values raise an `Error` at the end of the sector's block. The host sets the uniform
    `mat3 sonar_gl_lattice` to the lattice of each sector. The text uses outputs 0 and 1; all of its names begin with
    sonar_gl_.
    """
    return load_shader("embed.glsl", data_folder("shaders"), {})[0]


IN_USE = (
    "a Sensor must not be used while it makes a ping "
    "(got a call from a signal handler or another callback; have it set a flag, and act after the ping)"
)


class Sensor(Closable):
    """A sonar that makes pings of the images that other programs render.

    Use it in a `with` block, or call `close()`.

    Parameters
    ----------
    sonar : Sonar
    acoustics : Acoustics; None is `Acoustics.physical()`
    sampling : Sampling; None chooses samples as fine as the pixels of images, and for sectors the samples that
        most scenes need for the tolerance
    tolerance : 0.001..0.5, for sectors without a sampling; an aim, which a `Simulator` alone guarantees

    Raises
    ------
    Error
        if the acoustics include multipath, which needs a scene.
    """

    def __init__(
        self,
        sonar: Sonar,
        acoustics: Acoustics | None = None,
        sampling: Sampling | None = None,
        tolerance: float = 0.01,
    ):
        self._host = self._drawing = None
        check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()")
        check_kind("sampling", sampling, Sampling | None, "such as sonar_gl.Sampling(2, 100)")
        self.sonar, self.sampling = sonar, sampling
        self.acoustics = acoustics if acoustics is not None else Acoustics.physical()
        if self.acoustics.multipath != "none":
            raise Error(
                'acoustics of what others draw must have multipath "none" '
                f'(got "{self.acoustics.multipath}"; planar reflectors need the scene: use a Simulator)'
            )
        self.tolerance = check_tolerance(tolerance)
        self._instrument, self._thread = Instrument(sonar, self.acoustics), SecondThread()
        self._rigs, self._lock = {}, ThreadLock(IN_USE)
        self._process, self._is_closed = os.getpid(), False

    def sectors(self, pose: ArrayLike, near_m: float = NEAR_M) -> list[DrawnSector]:
        """Return the sectors for the host to draw, as seen from `pose`, in the current OpenGL context.

        Parameters
        ----------
        pose : (4, 4) world_from_sonar
        near_m : near plane of the projections, metres; their far plane lies at eight times range_max_m

        Raises
        ------
        Error
            if no OpenGL context is current, or the thread is another one than before.
        """
        self._check_open()
        pose, host = check_pose(pose), self._current_host()
        if self._drawing is None or self._drawing.near_m != near_m:
            self._release_framebuffers()
            sampling = self.sampling
            if sampling is None:  # what most pings need for the tolerance
                asked = sampling_at(self.sonar, typical_level(self.tolerance))
                sampling = fitted_sampling(self.sonar, asked, beam_shape(self.sonar, self.acoustics))
            self._drawing = Drawing(host, self._stage(sampling), near_m)
        return self._drawing.make_sectors(pose)

    def finish(
        self, bodies: Iterable[str] = (), noise: Noise | None = None, seed: int = 0, labels: bool = False,
        ping_number: int = 0, velocity: ArrayLike | None = None, label_level_db: float | None = None,
    ) -> Ping:  # fmt: skip
        """Return the ping of the sectors that the host has drawn; parameters as for `ping_from_depth`.

        Raises
        ------
        Error
            if the host has not drawn all sectors.
        """
        self._check_open()
        if self._drawing is None:
            raise Error("sectors must be drawn before a ping is finished (got none; see Sensor.sectors)")
        drawing, (samples, pose) = self._drawing, self._drawing.samples()
        request = self._request(pose, noise, seed, ping_number, labels, velocity, label_level_db)
        tolerance = self.tolerance if self.sampling is None else None
        origin = SampleOrigin("host", tuple(check_body_names(bodies)), (), tolerance, self._host.renderer)
        with self._pinging():
            return self._ping(request, drawing.stage, samples, origin, drawing.advice())

    def ping_from_textures(
        self, depth: int | Sequence[int], projection: ArrayLike | Sequence[ArrayLike], pose: ArrayLike | None = None,
        holds: str = "z-buffer", zero_to_one: bool = False,
        rotation: ArrayLike | Sequence[ArrayLike] | None = None, normals: int | Sequence[int] | None = None,
        body_id: int | Sequence[int] | None = None,
        reflectivity: ArrayLike | Sequence[ArrayLike] | dict[int, float] = DEFAULT_REFLECTIVITY,
        bodies: Iterable[str] = (), noise: Noise | None = None, seed: int = 0, labels: bool = False,
        ping_number: int = 0, velocity: ArrayLike | None = None, label_level_db: float | None = None,
    ) -> Ping:  # fmt: skip
        """Return a ping of textures that the host drew at the sonar's position, in the current OpenGL context.

        For several views, depth, projection, rotation, normals and body_id are lists. The other parameters are those
        of `ping_from_depth`; an image of reflectivity is an array, first row on top.

        Parameters
        ----------
        depth : GL name of a 2D texture, first row at the bottom
        projection : (4, 4) OpenGL clip_from_camera of the texture, any perspective, also reversed or infinite
        holds : contents of depth: "z-buffer", the depth attachment; "planar", metres along the view's axis;
            "range", metres along each pixel's ray; the latter two in a red channel of floats
        zero_to_one : whether the z-buffer was drawn with glClipControl's GL_ZERO_TO_ONE
        rotation : (3, 3) sonar_from_camera, as in `Camera`; None for a view along the boresight
        normals : GL name of a texture of floats: normals of the faces, of any length, in the view's axes (x right,
            y up, z back)
        body_id : GL name of a texture of integers, 1..65534, 0 for none

        Raises
        ------
        Error
            if a name is not that of such a texture.
        """
        self._check_open()
        host = self._current_host()
        images = read_images(host, depth, projection, holds, zero_to_one, rotation, normals, body_id)
        request = self._request(pose, noise, seed, ping_number, labels, velocity, label_level_db)
        origin = SampleOrigin("host", tuple(check_body_names(bodies)), (), None, self._host.renderer)
        checked = check_images(*images, reflectivity)
        kind = DepthKind(holds != "range", METRES_ADVICE)
        if holds == "z-buffer":
            kind = DepthKind(True, Z_BUFFER_ADVICE, may_be_z_buffer=False)
        return self._ping_of_images(request, *checked, kind, origin)

    def ping_from_depth(
        self, depth: ArrayLike | Sequence[ArrayLike], camera: Camera | Sequence[Camera],
        pose: ArrayLike | None = None, holds: str = "planar",
        normals: ArrayLike | Sequence[ArrayLike] | None = None,
        body_id: ArrayLike | Sequence[ArrayLike] | None = None,
        reflectivity: ArrayLike | Sequence[ArrayLike] | dict[int, float] = DEFAULT_REFLECTIVITY,
        bodies: Iterable[str] = (), noise: Noise | None = None, seed: int = 0, labels: bool = False,
        ping_number: int = 0, velocity: ArrayLike | None = None, label_level_db: float | None = None,
    ) -> Ping:  # fmt: skip
        """Return a ping of depth images rendered at the sonar's position.

        Parameters
        ----------
        depth : (H, W) float, metres, first row on top; a pixel is empty where it is 0, negative, NaN or infinite
        camera : Camera; or a list of cameras for a wide fan. Then depth is a list as long, and so are normals,
            body_id and an image of reflectivity where they are used. Where images overlap, the first one counts
        pose : (4, 4) world_from_sonar, None for the origin; it is stored with the ping, and place-locked speckle
            depends on it; with None every ping has its own speckle
        holds : contents of depth: "planar", metres along the camera's axis, as in most depth cameras; "range",
            metres along each pixel's ray. `metres_ahead` converts a z-buffer
        normals : (H, W, 3) float, normals of the faces, not smoothed, of any length and on either side, camera axes
            (x right, y down, z ahead). With None, and where a pixel holds 0 or NaN, normals are estimated from the
            neighbouring depths
        body_id : (H, W) whole numbers: 1..65534 for bodies, 0 for an unknown body, which still echoes
        reflectivity : μ in 0..1: a scalar; or (H, W), NaN allowed where a pixel is empty; or a dict from body numbers,
            0.5 for bodies not in it
        bodies : names of the bodies for the ping's meta, that of number 1 first. With labels each entry of
            `body_echo` has a name, such as "body 7" where the list has none
        noise, seed, labels, ping_number, velocity, label_level_db : as for `Simulator.ping`; with labels the first
            entry of `body_echo` is the echo of pixels with number 0

        Depth images do not tell smooth faces, so echoes have no specular lobes.

        Warns
        -----
        UserWarning
            if the cameras do not cover the fan, depth looks like a z-buffer, or normals do not fit it, once for each
            set of cameras; if depth is float16; if the ping has no echo.

        Raises
        ------
        Error
            if an image does not fit its camera, or the cameras see nothing of the fan.
        """
        kind = DepthKind(is_planar(holds), IMAGES_ADVICE)
        checked = check_images(camera, depth, normals, body_id, reflectivity)
        request = self._request(pose, noise, seed, ping_number, labels, velocity, label_level_db)
        origin = SampleOrigin("host", tuple(check_body_names(bodies)), (), None, "none: depth image")
        return self._ping_of_images(request, *checked, kind, origin)

    def _check_open(self) -> None:
        """Raise an `Error` in another process, and after `close`."""
        if os.getpid() != self._process:  # a forked process lacks the threads
            raise other_process_error("Sensor")
        if self._is_closed:
            raise closed_error("Sensor")

    def _stage(self, sampling: Sampling) -> Stage:
        # hosts draw as far up and down as the main lobe receives
        beamformer = make_beamformer(self.sonar, self.acoustics, sampling, self._thread, side_lobes=False)
        return Stage(sampling, beamformer)

    def _request(self, pose, noise, seed, number, labels, velocity, label_level_db) -> PingRequest:
        """Return the checked request; a pose of None is the origin, with speckle that is locked to no place."""
        if pose is None and isinstance(noise, Noise):
            noise = replace(noise, follow_motion=False)
        pose = check_pose(np.eye(4) if pose is None else pose)
        more = {"velocity": velocity, "label_level_db": label_level_db}
        return PingRequest(pose, noise, seed, number, labels, **more)

    @contextmanager
    def _pinging(self):
        """Have one thread make a ping at a time."""
        with self._lock.held():
            self._thread.settle()
            yield

    def _ping_of_images(
        self, request: PingRequest, cameras, images, kind: DepthKind, origin: SampleOrigin
    ) -> Ping:
        self._check_open()
        with self._pinging():
            rig = self._find_rig(cameras, images, kind)
            return self._ping(request, rig.stage, rig.samples(images, kind.planar), origin, kind.advice)

    def _find_rig(self, cameras, images, kind: DepthKind) -> CameraRig:
        """Return the rig of these cameras, from a cache of the `MAX_RIGS` that were used last."""
        key = tuple((c.width, c.height, c.intrinsics.tobytes(), c.rotation.tobytes()) for c in cameras)
        if (rig := self._rigs.pop(key, None)) is None:
            rig = CameraRig(
                self.sonar,
                cameras,
                self.sampling,
                self._stage,
                self._thread,
                self.acoustics.has_cones(self.sonar),
            )
            suspicion = z_buffer_suspicion(images, self.sonar) if kind.may_be_z_buffer else None
            for warning in (rig.warning, suspicion, normals_suspicion(cameras, images, kind.planar)):
                if warning:
                    warn_caller(warning)
        self._rigs[key] = rig  # at the end: the dict is in order of use
        while len(self._rigs) > MAX_RIGS:
            self._rigs.pop(next(iter(self._rigs)))
        return rig

    def _ping(
        self,
        request: PingRequest,
        stage: Stage,
        samples: Sequence[SectorSamples],
        origin: SampleOrigin,
        advice: str,
    ) -> Ping:
        """Return the ping of samples; `advice` ends the warning about a ping without an echo."""
        highest = len(names := origin.bodies)
        if request.labels:
            highest = max([highest] + [int(one.body_id.max(initial=0)) for one in samples])
        if highest > MAX_BODY_ID:
            raise Error(
                f"numbers of bodies must lie in 1..{MAX_BODY_ID}, 0 where none is known (got a higher one)"
            )
        setup = self._instrument.set_up(request, None, highest)
        received = receive(DrawnPing(setup, Resolution(stage), ViewSamples(tuple(samples))))
        if received.total <= 0:
            why = why_view_has_no_echo(self.sonar, stage.fan.sonar, samples)
            if why is None or advice is Z_BUFFER_ADVICE:  # else what was drawn is right
                why = why or "no echo came back: what was drawn shows no surface in the fan"
                why += f"; {advice}"
            warn_caller(why)
        if request.labels:
            unnamed = tuple(f"body {number}" for number in range(len(names) + 1, highest + 1))
            origin = replace(origin, bodies=names + unnamed)
        return assemble(self._instrument, received, origin, self._thread)

    def _current_host(self) -> HostContext:
        """Return the host whose context is current; raise an `Error` if it is another one than before."""
        lifetime.release_waiting()
        if self._host is None:
            self._host = HostContext(CurrentContext())
        self._host.check()
        return self._host

    def _release_framebuffers(self):
        """Release the framebuffers now, or as soon as the host's context is current."""
        drawing, self._drawing = self._drawing, None
        if drawing is not None:
            release_framebuffers(drawing.framebuffers)
        lifetime.release_waiting()

    def close(self) -> None:
        """Release all resources, in the thread of the host's context; a second call does nothing."""
        if self._host is not None:
            self._host.check_thread()
        if self._drawing is not None and self._drawing.is_being_drawn():
            raise Error("a Sensor must be closed outside of the blocks of its sectors (got one being drawn)")
        self._lock.check_free()
        self._is_closed = True
        if os.getpid() == self._process:
            with self._lock.held():
                self._rigs.clear()
            self._thread.close()
        self._release_framebuffers()
        host, self._host = self._host, None
        if host is not None:
            lifetime.release(host)

    def __del__(self):
        # No OpenGL calls here: the garbage collector may run this in the midst of other drawing.
        drawing, host = getattr(self, "_drawing", None), getattr(self, "_host", None)
        # A forked process is no owner. As Python ends, os may have lost its functions: a closed sensor needs none.
        if host is not None and os.getpid() == self._process:
            lifetime.discard(*(drawing.framebuffers if drawing is not None else ()), host)


@lru_cache(MAX_RIGS)
def _cached_sensor(sonar, acoustics, sampling, process: int) -> Sensor:
    """Return the sensor of these arguments in this process."""
    return Sensor(sonar, acoustics, sampling)


def ping_from_depth(
    depth: ArrayLike | Sequence[ArrayLike],
    sonar: Sonar,
    camera: Camera | Sequence[Camera],
    acoustics: Acoustics | None = None,
    sampling: Sampling | None = None,
    **more,
) -> Ping:
    """Return a ping of depth images that another program rendered at the sonar's position.

    A cache holds the sensors of the last four sonars for later calls.

    Parameters
    ----------
    depth : (H, W) float, metres along the camera's axis, first row on top; or a list of such images
    sonar, acoustics : as for `Simulator`
    camera : Camera; or a list, one for each image
    sampling : as for `sonar_gl.embed.Sensor`
    more : as for `sonar_gl.embed.Sensor.ping_from_depth`, such as reflectivity, body_id, normals, noise and seed

    Warns
    -----
    UserWarning
        as for `sonar_gl.embed.Sensor.ping_from_depth`.

    Raises
    ------
    Error
        if an argument is wrong, an image does not fit its camera, or the cameras see nothing of the fan.
    """
    for argument in (sonar, acoustics, sampling):
        if type(argument).__hash__ is None:  # `Sensor` raises the error that names it; the cache would not
            Sensor(sonar, acoustics, sampling)
    return _cached_sensor(sonar, acoustics, sampling, os.getpid()).ping_from_depth(depth, camera, **more)
