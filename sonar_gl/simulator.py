"""The public face: a sonar in a scene, and its pings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import Water
from sonar_gl.core.checks import check_kind, shown
from sonar_gl.core.closing import Closable
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import check_pose
from sonar_gl.engine.flow import Plan
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.planning import plan
from sonar_gl.engine.request import PingRequest, requests_of
from sonar_gl.engine.run import Run
from sonar_gl.engine.sequence import make_pings
from sonar_gl.engine.warm_up import warm_up
from sonar_gl.engine.world import World
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import GBuffer, Ping
from sonar_gl.raster.gbuffers import gbuffers_of
from sonar_gl.raster.point_cloud import point_cloud
from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.scene import Body, Scene
from sonar_gl.sonar.fan import Fan
from sonar_gl.sonar.sampling import Sampling, check_tolerance
from sonar_gl.sonar.sonar import Sonar


class Simulator(Closable):
    """Makes pings of a scene with a sonar. Use it in a `with` block, or call `close()`.

    Parameters
    ----------
    scene : Scene; or another Simulator, to put a second sonar into its scene: both share the engine,
        the meshes and what is done to the bodies
    sonar : Sonar
    acoustics : Acoustics; None is `Acoustics.physical()`
    sampling : Sampling, overrides what `tolerance` would choose; with multipath, `tolerance` still decides which
        reflectors return any, and how many of these samples they take
    tolerance : 0.001..0.5, the share of the echo that may lie in wrong bins
    engine : "opengl" draws on a graphics card, "cpu" by compiled code without OpenGL; "auto" takes OpenGL where
        there is a graphics card; None is the environment variable SONAR_GL_ENGINE, or "auto"
    device : index of an EGL device, as `sonar-gl doctor` lists them; None is that of the environment variable
        SONAR_GL_DEVICE, or else the first
    context : "current" joins the OpenGL context that is current, a host's; None creates one; beside a Simulator this,
        `engine` and `device` must be None

    Attributes
    ----------
    sonar, acoustics : as given
    gl_info : names and limits of what draws, such as "engine", "renderer" and "version"

    Raises
    ------
    Error
        if an argument is wrong, there is no usable OpenGL where it is asked for, or none to join, or the samples do not
        fit its limits. Its methods raise one, too, for an argument that is wrong or names what the scene lacks, for
        samples that do not fit, in a thread that may not draw, and once it is closed.
    """

    def __init__(
        self,
        scene: Scene | Simulator,
        sonar: Sonar,
        acoustics: Acoustics | None = None,
        sampling: Sampling | None = None,
        tolerance: float = 0.01,
        device: int | None = None,
        context: str | None = None,
        engine: str | None = None,
    ):
        self._run = None
        check_kind("scene", scene, Scene | Simulator, "sonar_gl.load_scene makes one from a name or a file")
        check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()")
        check_kind("sampling", sampling, Sampling | None, "such as sonar_gl.Sampling(2, 100)")
        tolerance = check_tolerance(tolerance)  # beside samples, multipath keeps it
        self._sonar = sonar
        self._acoustics = acoustics if acoustics is not None else Acoustics.physical()
        if isinstance(scene, Simulator):
            given = {"engine": engine, "device": device, "context": context}
            for name, value in given.items():
                if value is not None:
                    raise Error(
                        f"{name} must be left out beside a Simulator, whose engine draws (got {shown(value)})"
                    )
            world = scene.world
        else:
            world = World(scene, engine, device, context)
        self._run = Run(world, sonar, self.acoustics, sampling, tolerance)
        self.gl_info = world.gl_info
        warm_up(self._run)

    @property
    def sonar(self) -> Sonar:
        """The sonar, as given; setting it is an Error."""
        return self._sonar

    @sonar.setter
    def sonar(self, _):
        raise _fixed_error("sonar")

    @property
    def acoustics(self) -> Acoustics:
        """The acoustics, as given; setting them is an Error."""
        return self._acoustics

    @acoustics.setter
    def acoustics(self, _):
        raise _fixed_error("acoustics")

    @property
    def run(self) -> Run:
        """What makes the pings, for tools that look inside; an Error once this simulator is closed."""
        self._run.check_open()
        return self._run

    @property
    def world(self) -> World:
        """The scene in its raster engine, which simulators may share; an Error once this one is closed."""
        return self._run.world

    @property
    def scene(self) -> Scene:
        """The scene, with all bodies that were added to it, as they were given."""
        return self.world.given_scene

    @property
    def sampling(self) -> Sampling:
        """The `Sampling` of the last ping; before the first ping, that of the first."""
        return self.run.sampler.resolution.stage.sampling

    @property
    def fan(self) -> Fan:
        """The `Fan`, beams and sectors, at the current `sampling`."""
        return self.run.sampler.resolution.stage.fan

    def plan(
        self, poses: Iterable[ArrayLike], bodies: Iterable[dict | None] | None = None,
        times_s: Iterable[float | None] | None = None, reflectivities: Iterable[dict | None] | None = None,
        waters: Iterable[Water | None] | None = None,
    ) -> Plan | None:  # fmt: skip
        """Choose the samples that keep the tolerance at these poses, of many at a few, and use them from now on.

        Without this the samples of a ping are chosen ping by ping, and depend on the pings before. Pings with another
        pose, other bodies, reflectivity or water than these have the same samples, and no `Ping.error_estimate`.

        Parameters
        ----------
        poses : sequence of (4, 4) world_from_sonar; bodies, ... : as for `pings`

        Returns
        -------
        Plan, or None if the samples were given to begin with; those of image sources, which no sampling gives, are
            chosen for these poses also then

        Warns
        -----
        sonar_gl.sonar.sampling.ToleranceWarning
            if the tolerance cannot be met; a UserWarning, too.
        """
        per_ping = {"bodies": bodies, "times_s": times_s, "reflectivities": reflectivities, "waters": waters}
        requests = list(requests_of(poses, per_ping))
        if not requests:
            raise Error("poses must hold at least one pose (got none)")
        return plan(self._run, requests)

    def ping(
        self, pose: ArrayLike, noise: Noise | None = None, seed: int = 0, labels: bool = False, ping_number: int = 0,
        bodies: dict | None = None, time_s: float | None = None, velocity: ArrayLike | None = None,
        reflectivity: dict | None = None, water: Water | None = None, background: Iterable[str] | None = None,
        label_level_db: float | None = None,
    ) -> Ping:  # fmt: skip
        """Return the ping that the sonar makes from `pose`.

        Parameters
        ----------
        pose : (4, 4) world_from_sonar, metres, of the housing; `sonar_gl.pose` makes one from x y z roll pitch yaw
        noise : Noise, or None for none
        seed, ping_number : of the noise; the same two give the same bytes, so count ping_number in a loop of your own
        labels : whether to find the body with the strongest echo in each bin: `Ping.body_id` and the other labels
        bodies : of this ping alone, names to (4, 4) world_from_body, or to None for a body that is absent; the name of
            a model of several links, of `Scene.models`, stands for all of them. A pose may scale by one factor for all
            axes: `sonar_gl.pose(x=5) @ np.diag([2, 2, 2, 1])` has a body twice as large; bubbles keep their size
        time_s : seconds, at which plumes of bubbles are seen; None = 0
        velocity : (6,) vx vy vz, m/s, wx wy wz, rad/s, of the sonar in its frame, that of the housing, while sound
            travels, as docs/acoustics.md says; None = it stands
        reflectivity : of this ping alone, names of bodies to μ, 0..1; where each face has its own, a factor
        water : Water of this ping alone; None is that of the acoustics
        background : with labels, names of bodies such as the floor on whose echo others cast a `shadow`
        label_level_db : with labels, the level of a body's mean echo in a bin, dB of `Ping.intensity`, from which on it
            is labelled, whatever the noise. None: it is labelled where a display of the sonar's counts shows this echo,
            see `Counts.least_shown`, and, in a noisy ping, where it is no weaker than the mean power of the receiver's
            noise

        Warns
        -----
        UserWarning
            if the ping has no echo; the message names the nearest surface and why it returned none. Of pings in a row
            without echo the first five are warned of; `meta["has_echo"]` tells of each.
        sonar_gl.sonar.sampling.ToleranceWarning
            if the tolerance cannot be met; a UserWarning, too.
        """
        request = PingRequest(
            pose=pose,
            noise=noise,
            seed=seed,
            number=ping_number,
            labels=labels,
            background=background,
            label_level_db=label_level_db,
            bodies=bodies,
            time_s=time_s,
            velocity=velocity,
            reflectivity=reflectivity,
            water=water,
        )
        return make_ping(self._run, request)

    def pings(
        self, poses: Iterable[ArrayLike], noise: Noise | None = None, seed: int = 0, labels: bool = False,
        bodies: Iterable[dict | None] | None = None, times_s: Iterable[float | None] | None = None,
        velocities: Iterable[ArrayLike | None] | None = None, reflectivities: Iterable[dict | None] | None = None,
        waters: Iterable[Water | None] | None = None, background: Iterable[str] | None = None,
        label_level_db: float | None = None,
    ) -> Iterator[Ping]:  # fmt: skip
        """Yield pings from one pose after the other, faster than `ping` would, since several are made at a time.

        Parameters
        ----------
        poses : (4, 4) world_from_sonar, as many as there are; may be an endless generator
        noise, seed, labels, background, label_level_db : as for `ping`; the noise's ping_number counts from 0
        bodies, times_s, velocities, reflectivities, waters : for each pose the value that `ping` takes, or None for
            none at all; iterators may have more values than there are poses, or be endless

        Notes
        -----
        Poses are taken several pings ahead, and a ping has the bodies where they are when its pose is taken. Where
        bodies move, give `bodies`, or have a generator of poses `place` them before it yields the pose. A `place` or
        `add` between two pings that come out acts several pings later; a warning says so once. Where a pose depends
        on the pings before, use `ping`.

        Raises
        ------
        Error
            for what is wrong with a ping: after the pings before it have come out.

        Warns
        -----
        UserWarning
            as `ping`; and once, if bodies were placed or added too late for some pings.
        """
        per_ping = {"bodies": bodies, "times_s": times_s, "velocities": velocities}
        per_ping |= {"reflectivities": reflectivities, "waters": waters}
        common = {"noise": noise, "seed": seed, "labels": labels, "background": background}
        common["label_level_db"] = label_level_db
        yield from make_pings(self._run, requests_of(poses, per_ping, **common))

    def place(self, bodies: dict) -> None:
        """Put bodies elsewhere, or take them away, from now on.

        Pings of `pings` whose poses were taken before have the bodies where they were, see there.

        Parameters
        ----------
        bodies : names to (4, 4) world_from_body, or to None to take a body away, until it is placed again. The name of
            a model of several links, of `Scene.models`, stands for all of them, and the pose is the model's. A pose may
            scale, as in `ping`
        """
        with self._run.drawing():
            self.world.place(bodies)

    def add(self, *bodies: Body | Bubbles) -> None:
        """Put more bodies or plumes into the scene; the numbers of those that are there stay.

        Bodies may come one by one: a call takes no longer where many are there.

        Parameters
        ----------
        bodies : Body or Bubbles objects, with names that the scene does not have
        """
        with self._run.drawing():
            self.world.add(bodies)

    def gbuffers(self, pose: ArrayLike) -> list[GBuffer]:
        """Return what the depth + normal pass sees from `pose`: one `GBuffer` for each of `self.fan.sectors`.

        Axes are those of the head, `Sonar.head_pose` of the pose.

        Parameters
        ----------
        pose : (4, 4) world_from_sonar, metres, of the housing
        """
        with self._run.drawing():
            renderer = self._run.sampler.resolution.stage.renderer
            head_pose = self.sonar.head_pose(check_pose(pose))
            (view,) = renderer.render([head_pose], with_bodies=True, full=True)
            return gbuffers_of(view)

    def point_cloud(self, pose: ArrayLike, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """Return points of a plain grid of rays over the field of view, as a ray sensor would give them.

        Parameters
        ----------
        pose : (4, 4) world_from_sonar, metres, of the housing
        columns, rows : about how many rays, in azimuth and in elevation

        Returns
        -------
        points : (rows', columns', 3) float32, metres, in the frame of the head, `Sonar.head_pose` of the pose; NaN
            where nothing was met. Fans of several perspective views have a multiple of their number as columns'
        echo : (rows', columns') float32, μ cos θ, where μ includes the |R|² of specular lobes, at most 1
        """
        with self._run.drawing():
            head_pose = self.sonar.head_pose(check_pose(pose))
            return point_cloud(self.world.engine, self.sonar, head_pose, columns, rows)

    def close(self) -> None:
        """Release all that it holds, and the engine unless another simulator uses it; a second call does nothing."""
        if self._run is not None:
            self._run.close()

    def __repr__(self):
        if self._run is None:  # an argument is wrong
            return "<Simulator>"
        try:
            world = self.world
        except Error:
            return f"<Simulator of sonar {self.sonar.name!r}, closed>"
        name, by = world.given_scene.name, world.gl_info["renderer"]
        return f"<Simulator of scene {name!r}, sonar {self.sonar.name!r}, by {by}>"

    def __del__(self):
        if getattr(self, "_run", None) is not None:
            self._run.forget()


def _fixed_error(name: str) -> Error:
    """Return the Error for a new value of what a simulator was made with."""
    return Error(
        f"the {name} of a Simulator must not be changed (got a new value; for another range, say, make a second one in "
        "the same scene: Simulator(simulator, sonar.with_range(10)))"
    )
