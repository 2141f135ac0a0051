"""A sonar inside a program that draws its world itself: what the program draws is heard, not drawn again.

Of the four ways in this module has three: the host draws the sonar's sectors with its own shaders
(`Sensor.sectors`), hands over textures (`Sensor.ping_from_textures`), or images as arrays
(`ping_from_depth`). The fourth is a `Simulator` that joins the host's OpenGL context.
"""

from __future__ import annotations

import os
from functools import lru_cache

from sonar_gl.acoustics import Acoustics
from sonar_gl.depth_images import UNKNOWN, images_of, is_planar
from sonar_gl.drawn import Drawing, DrawnSector
from sonar_gl.fan import Sampling
from sonar_gl.foreign import Host, Tenant
from sonar_gl.hearing import Hearing
from sonar_gl.ladder import check_tolerance, guess_of, sampling_of
from sonar_gl.listener import KEPT, Asked, Listener
from sonar_gl.load import data_folder
from sonar_gl.programs import load_shader
from sonar_gl.rigid import check_pose
from sonar_gl.sonar import Sonar
from sonar_gl.stock import NEAR_M
from sonar_gl.targets import give_back, leave, release_left
from sonar_gl.textures import metres_ahead, read_images
from sonar_gl.types import Error, Ping

__all__ = ["Sensor", "glsl", "metres_ahead", "ping_from_depth"]


def glsl() -> str:
    """What a host's fragment shader includes to draw for `Sensor.sectors`, after `#version`, 330 or higher.

    It has `sonar_gl_write(vec3 normal, float reflectivity, uint body)`, to be called once: normal in the
    view's axes (x right, y up, z back), or vec3(0) for that of the flat face; reflectivity 0..1; body
    1..65534, 0 for none. A fourth argument, vec2, is |R|² and the rms slope of a smooth face. The uniform
    `mat3 sonar_gl_lattice` is the sector's. Outputs 0 and 1 are taken; all names begin with sonar_gl_.
    """
    return load_shader("embed.glsl", data_folder("shaders"), {})[0]


class Sensor(Listener):
    """A sonar that hears what other programs draw. Use it in a `with` block, or call `close()`.

    Parameters
    ----------
    sonar : Sonar
    acoustics : Acoustics; None is `Acoustics.physical()`
    sampling : Sampling; None is as fine as images are; of sectors, what most scenes need for the tolerance
    tolerance : 0.001..0.5, of sectors; it is aimed at, not looked after as a `Simulator` does

    Raises
    ------
    Error
        if the acoustics have multipath, which needs a scene.
    """

    def __init__(
        self,
        sonar: Sonar,
        acoustics: Acoustics | None = None,
        sampling: Sampling | None = None,
        tolerance: float = 0.01,
    ):
        super().__init__(sonar, acoustics, sampling)
        self.tolerance = check_tolerance(tolerance)
        self._host = self._drawing = None

    def sectors(self, pose, near_m: float = NEAR_M) -> list[DrawnSector]:
        """The views that the host draws, as seen from `pose`, in the context that is current.

        Parameters
        ----------
        pose : (4, 4) world_from_sonar
        near_m : of the projections, metres; what is nearer is cut. Their far plane is eight times
            range_max_m

        Raises
        ------
        Error
            if no context is current, or in another thread than before.
        """
        self._check_open()
        pose, host = check_pose(pose), self._joined()
        if self._drawing is None or self._drawing.near_m != near_m:
            self._give_back()
            sampling = self.sampling or sampling_of(self.sonar, guess_of(self.tolerance))
            self._drawing = Drawing(host, Hearing(self.sonar, self.acoustics, sampling), near_m)
        return self._drawing.aim(pose)

    def finish(
        self, bodies=(), noise=None, seed=0, labels=False, ping_number=0, velocity=None
    ) -> Ping:  # fmt: skip
        """The ping of the sectors, once the host has drawn them all; parameters as of `ping_from_depth`.

        Raises
        ------
        Error
            if some were not drawn.
        """
        self._check_open()
        if self._drawing is None:
            raise Error("sectors must be drawn before a ping is finished (got none; see Sensor.sectors)")
        asked = Asked(bodies, noise, seed, labels, ping_number, velocity).checked()
        drawing, (views, pose) = self._drawing, self._drawing.views()
        how = self.tolerance if self.sampling is None else None, self._host.renderer
        with self._lock:
            return self._ping(drawing.hearing, views, pose, drawing.advice(), how, asked)

    def ping_from_textures(
        self, depth, projection, pose=None, holds="z-buffer", zero_to_one=False, rotation=None, normals=None,
        body_id=None, reflectivity=UNKNOWN, bodies=(), noise=None, seed=0, labels=False, ping_number=0,
        velocity=None,
    ) -> Ping:  # fmt: skip
        """A ping of textures that the host drew from the sonar's place, in the context that is current.

        Several views are lists of depth, projection, rotation, normals and body_id. Other parameters are as
        of `ping_from_depth`: an image of reflectivity is an array, first row on top.

        Parameters
        ----------
        depth : GL name of a 2D texture, first row at the bottom
        projection : (4, 4) OpenGL clip_from_camera that it was drawn with, any perspective; reversed or
            infinite ones, too
        holds : what depth is: "z-buffer", the depth attachment; "planar", metres along the view's axis;
            "range", metres along each pixel's ray; the latter two in a red channel of floats
        zero_to_one : the z-buffer was drawn with glClipControl's GL_ZERO_TO_ONE
        rotation : (3, 3) sonar_from_camera, as of `Camera`; None looks along the boresight
        normals : GL name of a texture of floats: normals of faces, of any length, in the view's axes (x
            right, y up, z back)
        body_id : GL name of a texture of integers, 1..65534, 0 for none

        Raises
        ------
        Error
            if a name is no such texture.
        """
        self._check_open()
        read = read_images(self._joined(), depth, projection, holds, zero_to_one, rotation, normals, body_id)
        asked = Asked(bodies, noise, seed, labels, ping_number, velocity)
        how, made = (None, self._host.renderer), images_of(*read, reflectivity)
        return self._ping_of_images(*made, pose, holds != "range", how, asked)

    def ping_from_depth(
        self, depth, camera, pose=None, holds="planar", normals=None, body_id=None, reflectivity=UNKNOWN,
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
        holds : what depth is: "planar", metres along the camera's axis, as of most depth cameras; "range",
            metres along each pixel's ray. `metres_ahead` makes metres of a z-buffer
        normals : (H, W, 3) float, of the faces themselves, not smoothed, of any length and either side,
            camera axes (x right, y down, z ahead); None, and 0 or NaN in a pixel: found from the depth beside
        body_id : (H, W) whole numbers, 1..65534 of bodies, 0 where none is known, which still echoes
        reflectivity : μ in 0..1: one; or (H, W); or a dict from numbers of bodies, others having 0.5
        bodies : names of the bodies for the ping's meta, that of number 1 first; with labels as many as
            `body_echo` has, "body 7" where none is given
        noise, seed, labels, ping_number, velocity : as of `Simulator.ping`; with labels the first entry of
            `body_echo` is the echo of what has number 0

        No smooth faces are known here, and so no lobes of them.

        Warns
        -----
        UserWarning
            if the cameras do not see all of the fan, or depth looks like a z-buffer, once for a set of them;
            if nothing came back.

        Raises
        ------
        Error
            if an image does not fit its camera, or the cameras see nothing of the fan.
        """
        planar, made = is_planar(holds), images_of(camera, depth, normals, body_id, reflectivity)
        asked = Asked(bodies, noise, seed, labels, ping_number, velocity)
        return self._ping_of_images(*made, pose, planar, (None, "none: depth image"), asked)

    def _joined(self) -> Tenant:
        """The host whose context is current; another one than before is an Error."""
        release_left()
        if self._host is None:
            self._host = Tenant(Host())
        self._host.check()
        return self._host

    def _give_back(self):
        """The framebuffers: now, or where the host's context is not current, as soon as it is."""
        drawing, self._drawing = self._drawing, None
        if drawing is not None:
            drawing.hearing.reducer.close()
            give_back(drawing.things)
        release_left()

    def close(self):
        """Give back what this holds, in the thread of the host's context; twice does no harm."""
        if self._host is not None:
            self._host.check_thread()
        if self._drawing is not None and self._drawing.is_being_drawn():
            raise Error("a Sensor must be closed outside of the blocks of its sectors (got one being drawn)")
        super().close()
        self._give_back()
        host, self._host = self._host, None
        if host is not None:
            give_back([host])

    def __del__(self):
        # nothing may be drawn or released now: the garbage collector may call in the midst of other drawing
        if getattr(self, "_drawing", None) is not None:
            leave(self._drawing.things)
        if getattr(self, "_host", None) is not None:
            leave([self._host])


@lru_cache(KEPT)
def _sensor(sonar, acoustics, sampling, process: int) -> Sensor:
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
    return _sensor(sonar, acoustics, sampling, os.getpid()).ping_from_depth(depth, camera, **more)
