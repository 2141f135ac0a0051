"""One run: a sonar in a world, and the stages that make pings of them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from concurrent.futures import wait
from contextlib import contextmanager
from itertools import count

from sonar_gl.acoustics import Acoustics
from sonar_gl.cloud import points_of
from sonar_gl.fan import Fan, Sampling
from sonar_gl.motion import check_velocity
from sonar_gl.multipath import Multipath
from sonar_gl.noise import Noise, add_noise, check_seed
from sonar_gl.passes import Fixed, Passes
from sonar_gl.plan import Plan, Planner
from sonar_gl.record import Record
from sonar_gl.scene import Scene, check_pose
from sonar_gl.sequence import alone, each, finish, fix_ghosts, in_batches, several, spots_of
from sonar_gl.shadows import labels_of
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, GBuffer, Ping, check_kind
from sonar_gl.world import World


class Simulator:
    """Makes pings of a scene with a sonar. Use it in a `with` block, or call `close()`.

    Parameters
    ----------
    scene : Scene; or another Simulator, to put a second sonar into its scene: both share the OpenGL context,
        the meshes and what is done to the bodies
    sonar : Sonar
    acoustics : Acoustics; None is `Acoustics.physical()`
    sampling : Sampling, overrides what `tolerance` would choose
    tolerance : 0.001..0.5, the share of the echo that may lie in wrong bins
    device : index of an EGL device, as `sonar-gl doctor` lists them; None is that of the environment variable
        SONAR_GL_DEVICE, or else the first
    context : "current" joins the OpenGL context that is current, a host's; None has one of its own

    Raises
    ------
    Error
        if there is no usable OpenGL, or none to join, or the samples do not fit its limits.
    """

    def __init__(
        self,
        scene: Scene,
        sonar: Sonar,
        acoustics: Acoustics | None = None,
        sampling: Sampling | None = None,
        tolerance: float = 0.01,
        device: int | None = None,
        context: str | None = None,
    ):
        self._world = self._underway = None
        for name, value, kind, cure in (
            ("scene", scene, Scene | Simulator, "sonar_gl.load_scene makes one from a name or a file"),
            ("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file"),
            ("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()"),
            ("sampling", sampling, Sampling | None, "such as sonar_gl.Sampling(2, 100)"),
        ):
            check_kind(name, value, kind, cure)
        self.sonar = sonar
        self.acoustics = acoustics if acoustics is not None else Acoustics.physical()
        world = scene._open_world() if isinstance(scene, Simulator) else World(scene, device, context)
        world.users += 1
        self._world, self.gl_info = world, world.gl_info
        passes = self._passes = Passes(world.gpu, sonar, self.acoustics)
        self._multipath, self._record = None, Record(sonar, self.acoustics)
        with self._drawing():
            if self.acoustics.multipath != "none":
                self._multipath = Multipath(self._passes, world.scene, tolerance)
            self._samples = Planner(passes, tolerance) if sampling is None else Fixed(passes, sampling)
            self._passes.warm()

    def _open_world(self) -> World:
        if self._world is None:
            raise Error("this Simulator is closed; make a new one")
        return self._world

    @property
    def scene(self) -> Scene:
        """The scene, with all bodies that were added to it."""
        return self._open_world().scene

    @property
    def sampling(self) -> Sampling:
        """The samples of the last ping, or of the first to come."""
        return self._samples.now.sampling

    @property
    def fan(self) -> Fan:
        """The fan with these samples."""
        return self._samples.now.fan

    def plan(self, poses) -> Plan | None:
        """Choose the samples for these poses, a few of a long sequence, and stay with them from now on.

        Without this a tolerance is looked after ping by ping, and the samples of one depend on those before.

        Parameters
        ----------
        poses : sequence of (4, 4) world_from_sonar

        Returns
        -------
        Plan, or None if the samples were given to begin with
        """
        if not (poses := [check_pose(pose) for pose in several(poses)]):
            raise Error("poses must hold at least one pose (got none)")
        with self._drawing():
            where = self._world.moved(None, None, self.acoustics.bubbles)
            plan = self._samples.fix(poses, where)
            fix_ghosts(self, poses, where)
        self._warn()
        return plan

    def _warn(self):
        if self._samples.warning:
            warnings.warn(self._samples.warning, stacklevel=3)
            self._samples.warning = None

    def ping(
        self, pose, noise=None, seed=0, labels=False, ping_number=0, bodies=None, time_s=None, velocity=None,
        background=None,
    ) -> Ping:  # fmt: skip
        """One transmission from `pose` and what it brings back.

        Parameters
        ----------
        pose : (4, 4) world_from_sonar, metres; `sonar_gl.pose` makes one from x y z roll pitch yaw
        noise : Noise, or None for none
        seed, ping_number : of the noise; the same two give the same bytes
        labels : also find the body of the strongest echo in each bin, and what `Ping` has of that echo
        bodies : of this ping alone, names to (4, 4) world_from_body, or to None for what is not there
        time_s : seconds, at which plumes of bubbles are seen; None = 0
        velocity : (6,) vx vy vz, m/s, wx wy wz, rad/s, of the sonar in its frame while sound travels; see
            `motion.shown_at`. None = it stands
        background : with labels, names of bodies such as the floor on whose echo others throw a `shadow`

        Warns
        -----
        UserWarning : if nothing came back, saying what was nearest and why.
        """
        pose, seed, velocity = check_pose(pose), check_seed(seed), check_velocity(velocity)
        check_kind("noise", noise, Noise | None, "such as sonar_gl.Noise.physical()")
        with self._drawing():
            wanted = labels_of(labels, background, self._world.numbers)
            where = self._world.moved(bodies, time_s, self.acoustics.bubbles)
            ping = finish(self, *alone(self, pose, where, wanted), seed, velocity)
        self._warn()
        return ping if noise is None else add_noise(ping, noise, seed, ping_number)

    def pings(
        self, poses, noise=None, seed=0, labels=False, bodies=None, times_s=None, velocities=None,
        background=None,
    ) -> Iterator[Ping]:  # fmt: skip
        """Pings from one pose after the other, quicker than alone: some are drawn while others are summed.

        Parameters
        ----------
        poses : (4, 4) world_from_sonar each; may be an endless generator
        noise, seed, labels, background : as of `ping`; the noise's ping_number counts from 0
        bodies, times_s, velocities : for each pose what `ping` takes; None for none at all

        Yields
        ------
        Ping
        """
        seed = check_seed(seed)
        check_kind("noise", noise, Noise | None, "such as sonar_gl.Noise.physical()")
        wanted = labels_of(labels, background, self._open_world().numbers)
        made = in_batches(self, spots_of(poses, bodies, times_s), wanted)
        for number, one, velocity in zip(count(), made, each(velocities, "velocities", poses), strict=False):
            ping = finish(self, *one, seed, check_velocity(velocity))
            self._warn()
            yield ping if noise is None else add_noise(ping, noise, seed, number)

    def place(self, bodies: dict) -> None:
        """Put bodies elsewhere, from now on: names to (4, 4) world_from_body, or to None to take one away."""
        with self._drawing():
            self._world.place(bodies)

    def add(self, *bodies) -> None:
        """Put more bodies or plumes into the scene; the numbers of those that are there stay."""
        with self._drawing():
            self._world.add(bodies)

    def gbuffers(self, pose) -> list[GBuffer]:
        """What the depth + normal pass sees from `pose`, one G-buffer a sector of `self.fan.sectors`."""
        with self._drawing():
            self._samples.now.views(check_pose(pose), labels=True, whole=True)
            return self._samples.now.renderer.gbuffers()

    def point_cloud(self, pose, columns: int, rows: int):
        """Points of a plain grid of rays over the field of view, as a ray sensor would give them.

        Returns
        -------
        points : (rows', columns', 3) float32, metres, sonar frame; NaN where nothing was met. About as many
            as asked for: beyond one perspective view, columns' is a multiple of the views
        echo : (rows', columns') float32, μ cos θ
        """
        with self._drawing():
            return points_of(self._world.gpu, self.sonar, check_pose(pose), columns, rows)

    @contextmanager
    def _drawing(self, beside=None):
        """The context, current for the time of the block, in one thread at a time.

        What a sequence adds up in another thread is waited for, but for `beside`.
        """
        world = self._open_world()
        with world.drawing() as context:
            if self._underway is not None and self._underway is not beside:
                wait([self._underway])
            if self._world is None:  # closed while this one waited
                raise Error("this Simulator is closed; make a new one")
            yield context

    def close(self):
        """Give back all that this holds, and the OpenGL context if no other uses it; twice does no harm."""
        world = self._world
        if world is not None:
            world.check_thread()
            self._world = None
            world.leave(self._give_back)

    def _give_back(self):
        if self._underway is not None:
            wait([self._underway])
        self._passes.close()
        if self._multipath is not None:
            self._multipath.close()
        self._passes = self._samples = self._multipath = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def __del__(self):
        world = getattr(self, "_world", None)
        if world is not None:
            world.forget()
