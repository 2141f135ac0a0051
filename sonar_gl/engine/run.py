"""A run: one sonar in a world, with its samplers and stages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import contextmanager
from dataclasses import replace
from threading import Lock

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.errors import SampleLimitError, closed_error
from sonar_gl.core.warn import warn_caller
from sonar_gl.core.worker import STEP_BACK, Job
from sonar_gl.engine.adaptive import AdaptiveSampling
from sonar_gl.engine.flow import PingReport, PingSetup, ReceivedPing, Resolution
from sonar_gl.engine.image_sampling import ImageSampling, MultipathEcho
from sonar_gl.engine.instrument import Instrument
from sonar_gl.engine.multipath import ImageSources
from sonar_gl.engine.no_echo import ECHO_LOST, SilentPings, why_no_echo
from sonar_gl.engine.provenance import SampleOrigin
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.sampler import FixedSampling
from sonar_gl.engine.stage import StageCache
from sonar_gl.engine.world import IN_USE, World
from sonar_gl.raster.views import MAX_CHOSEN_SAMPLES, MAX_SAMPLES
from sonar_gl.scene.extent import AirWarning, InsideWarning, air_text, inside_text
from sonar_gl.scene.scene import Scene
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sonar import Sonar


class Run:
    """One sonar in a world, with the objects that make its pings.

    world : World; the run counts as one of its users
    sonar, acoustics, sampling, tolerance : as for `Simulator`

    instrument : Instrument
    sampler : Sampler, which chooses the resolution of each ping
    image_sampling : ImageSampling, which chooses how finely image sources are sampled
    silent_pings : SilentPings, which chooses of which pings a warning says why they have no echo
    tolerance : as given, whether or not the sampler keeps it
    """

    def __init__(
        self, world: World, sonar: Sonar, acoustics: Acoustics, sampling: Sampling | None, tolerance: float
    ):
        world.join(id(self))
        self._world, self._is_closed, self._has_warned_of_air, self._has_looked = world, False, False, False
        self._in_flight: list[Job] = []  # for which `drawing` waits
        self._summing = Lock()  # held by the one job of `receive_later` that runs
        self._idle_workers = []  # PingWorkers of past sequences
        self._origin, self._described = None, None  # a SampleOrigin, and the scene that it describes
        self._image_sources, self.tolerance = None, tolerance
        self.silent_pings = SilentPings()
        self.image_sampling = ImageSampling(tolerance, each_alone=sampling is not None)
        try:
            self.instrument = Instrument(sonar, acoustics)
            self._make_stages(sampling, tolerance)
        except BaseException:
            self.forget()  # the exception holds what is in the context
            raise

    def _make_stages(self, sampling: Sampling | None, tolerance: float) -> None:
        world, sonar, acoustics = self.world, self.instrument.sonar, self.instrument.acoustics
        with self.drawing():
            most = MAX_SAMPLES if sampling else MAX_CHOSEN_SAMPLES
            self.stages = StageCache(world.engine, sonar, acoustics, world.thread, most_samples=most)
            if acoustics.multipath != "none":
                self._image_sources = ImageSources(self.stages, world.thread, world.scene, tolerance)
            if sampling:
                self.sampler = FixedSampling(self.stages, sampling)
            else:
                self.sampler = AdaptiveSampling(self.stages, tolerance, self.instrument.gain)

    def check_open(self) -> None:
        """Raise an Error once the run is closed."""
        if self._is_closed:
            raise closed_error("Simulator")

    @property
    def world(self) -> World:
        """The world; an Error once the run is closed."""
        self.check_open()
        return self._world

    @contextmanager
    def drawing(self, beside: Collection[Job] = ()):
        """Have the engine ready to draw inside a `with` block, in one thread at a time.

        The block waits for the pings that other threads still make, except for those of `beside`.
        """
        world = self.world
        with world.unchanged():
            if world.thread is not None:
                world.thread.settle()
            with world.engine.drawing() as context:
                awaited = [job for job in self._in_flight if job not in beside]
                for job in awaited:
                    job.check_free()  # first: one that another thread does may wait for what this thread's job holds
                for job in awaited:
                    job.settle()
                self._in_flight = [job for job in self._in_flight if not job.is_over]  # they hold arrays
                self.check_open()  # it may have been closed while this one waited
                yield context

    def receive_later(self, work: Callable[[], list]) -> Job:
        """Return a job that sums pings into arrays of this run, for another thread to do; `drawing` waits for it.

        Such jobs run one at a time, since they share these arrays.
        """

        def alone():
            with self._summing, STEP_BACK:
                return work()

        return self.await_job(Job(alone, IN_USE))

    def await_job(self, job: Job) -> Job:
        """Return a job after noting that `drawing`, and `World.add` of other runs, must wait for it.

        If an interrupt comes before a thread has taken the job, `drawing` does it.
        """
        self.world.await_job(job)
        self._in_flight = [*(one for one in self._in_flight if not one.is_over), job]
        return job

    def set_up(self, request: PingRequest) -> PingSetup:
        """Return a request resolved in the scene as it is now; do not call it inside `drawing`.

        Raises Error if it names a body that the scene lacks, or its water is invalid.
        """
        with self.world.unchanged():
            return self.resolve(request)

    def resolve(self, request: PingRequest) -> PingSetup:
        """Return what `set_up` returns; call it inside `drawing`."""
        world, bubbles, needs_parts = self.world, self.instrument.acoustics.bubbles, request.needs_noise_parts
        scene = world.scene
        self._warn_of_air(scene, request.pose)
        state = world.state_of(request.bodies, request.time_s, bubbles, request.reflectivity)
        return self.instrument.set_up(
            request,
            state,
            len(scene.bodies),
            background=None if request.background is None else world.mask_of(request.background),
            surface_z_m=scene.surface_z_m,
            needs_lobes=needs_parts and self._returns_lobes(state),
            texture=self._texture_of(state) if needs_parts else None,
            n_plumes=len(scene.plumes),
        )

    def _returns_lobes(self, state: SceneState) -> bool:
        """Return whether a body that is present may return a specular lobe."""
        bodies = zip(self.world.scene.bodies, state.present, strict=True)
        return self.instrument.acoustics.specular and any(
            one.specular > 0 for one, present in bodies if present
        )

    def _texture_of(self, state: SceneState) -> np.ndarray | None:
        """Return `PingSetup.texture`: reflectivity over √ν of bodies that have a texture, 0 of others."""
        bodies = self.world.scene.bodies
        if all(
            one.speckle_shape is None or not present
            for one, present in zip(bodies, state.present, strict=True)
        ):
            return None
        own = [one.reflectivity if np.ndim(one.reflectivity) == 0 else 1.0 for one in bodies]
        shapes = [np.inf if one.speckle_shape is None else one.speckle_shape for one in bodies]
        return np.float32((own if state.reflectivity is None else state.reflectivity) / np.sqrt(shapes))

    def _warn_of_air(self, scene: Scene, pose: np.ndarray) -> None:
        """Warn, once, of a sonar above the water's surface."""
        if not self._has_warned_of_air and (text := air_text(scene, pose)):
            self._has_warned_of_air = True
            warn_caller(text, AirWarning)

    def _warn_of_body(self, setup: PingSetup) -> None:
        """Warn of a sonar inside a body in the first ping: to look at each would take as long as a ping."""
        if not self._has_looked:
            self._has_looked = True
            bodies, state = self.world.scene.bodies[: setup.n_bodies], setup.state
            place, surface_z_m = setup.head_pose[:3, 3], setup.surface_z_m
            text = inside_text(bodies, state.poses, state.present, place, surface_z_m)
            if text:
                warn_caller(text, InsideWarning)

    def with_later_bodies(self, setup: PingSetup) -> PingSetup:
        """Return a setup with the bodies that were added to the scene after it was made, as absent ones.

        They have no number in the ping, whose `n_bodies` stays: others of the same scene were drawn before they came.
        """
        n = len(self.world.scene.bodies) - len(setup.state.present)
        if not n:
            return setup
        background = None if setup.background is None else np.append(setup.background, np.zeros(n, bool))
        texture = None if setup.texture is None else np.append(setup.texture, np.zeros(n, np.float32))
        state = setup.state.with_absent(n)
        return replace(setup, state=state, background=background, texture=texture)

    @property
    def choices(self) -> tuple:
        """What chooses samples, of the direct view and of image sources, as it is now; may be put back."""
        return self.sampler.choice, self.image_sampling.choice

    @choices.setter
    def choices(self, before: tuple):
        self.sampler.choice, self.image_sampling.choice = before

    @contextmanager
    def choices_kept(self):
        """Have a block that fails, or is interrupted, leave the choices of samples as they were."""
        before = self.choices
        try:
            yield
        except BaseException:
            self.choices = before
            raise

    @property
    def resolution_ahead(self) -> Resolution:
        """The resolution of a ping of a sequence that is made before the pings ahead of it have been reviewed."""
        return replace(self.sampler.resolution, halvings=self.image_sampling.halvings_ahead)

    @property
    def image_sources(self) -> ImageSources | None:
        """The image sources in the scene as it is now; None without multipath."""
        if self._image_sources is not None:
            self._image_sources.use_scene(self.world.scene)
        return self._image_sources

    def take_workers(self, count: int, make: Callable) -> list:
        """Return so many `PingWorker`s: those of past sequences, whose stages are made already, then new ones."""
        return [self._idle_workers.pop() if self._idle_workers else make() for _ in range(count)]

    def keep_workers(self, workers: Sequence) -> None:
        """Keep workers of a sequence that is over for the next one; as many at most as this sequence had."""
        if workers and not self._is_closed:  # a closed run would keep their stages in memory
            self._idle_workers[:] = [*self._idle_workers, *workers][-len(workers) :]

    def review(self, received: ReceivedPing, coarser: ReceivedPing | None = None) -> Resolution | None:
        """Return the resolution with which to sample a ping again, or None if its samples keep the tolerance.

        coarser : the ping with fewer samples of image sources, to compare with; None for none
        """
        resolution = self.sampler.review(received)
        if resolution is None and self._review_images(received, coarser):
            halvings = self.image_sampling.choice.halvings
            return replace(received.drawn.resolution, halvings=halvings, is_final=True, finer_images=True)
        return resolution

    def fewer_samples(
        self, error: SampleLimitError, received: ReceivedPing | None, resolution: Resolution
    ) -> Resolution | None:
        """Return a coarser resolution in place of one whose samples are more than fit, or raise the error again.

        Return None if only image sources were to be finer, and `received` has the finest that fit.

        error : of the samples that do not fit
        received : the ping with coarser samples; None before it was received
        resolution : that does not fit
        """
        if not resolution.finer_images:
            return self.sampler.fewer_samples(error)
        halvings = resolution.halvings + 1
        self.image_sampling.keep_to(halvings)
        return replace(resolution, halvings=halvings) if halvings < received.drawn.images.halvings else None

    def review_ahead(self, received: ReceivedPing, choice: object) -> bool:
        """Review a ping of a sequence that was made ahead; return whether it must be made again.

        Pings must be reviewed in their order, since each may change how finely image sources are sampled in the next.

        choice : `Sampler.choice` when the ping was started
        """
        before = self.image_sampling.choice
        if must_again := self._must_again(received, choice):
            self.image_sampling.choice = before  # as if the ping had not been made
        return must_again

    def _must_again(self, received: ReceivedPing, choice: object) -> bool:
        """Adapt how finely image sources are sampled; return whether a ping of `review_ahead` must be made again."""
        resolution = received.drawn.resolution
        if resolution.plan is not None:  # its samples were chosen from it alone
            self.image_sampling.begin_alone()
            return self._review_images(received)
        sampler = self.sampler
        if choice is not sampler.choice or sampler.has_changed(received):
            return True
        if not sampler.costs_as_expected(received.coverage):
            return True
        # those before may have changed how finely it has to be sampled
        halvings = self.image_sampling.begin(check=False, n_samples=resolution.stage.fan.n_samples)
        return halvings != resolution.halvings or self._review_images(received)

    def _review_images(self, received: ReceivedPing, coarser: ReceivedPing | None = None) -> bool:
        """Adapt how finely image sources are sampled; return whether those of this ping are to be drawn finer.

        coarser : as of `review`
        """
        echo = self._multipath_of(received)
        return echo is not None and self.image_sampling.review(echo, coarser and self._multipath_of(coarser))

    def _multipath_of(self, received: ReceivedPing) -> MultipathEcho | None:
        """Return what the image sampling needs of a ping; None without multipath."""
        if received.multipath is None:
            return None
        echoes = received.multipath, received.direct
        return MultipathEcho(received.drawn.images, *echoes, self._direct_error(received))

    def _direct_error(self, received: ReceivedPing) -> float | None:
        """Return the estimated error of a ping's direct echo; None without one."""
        drawn = received.drawn
        plan = drawn.resolution.plan
        return self.sampler.error_estimate(drawn.setup) if plan is None else plan.bound

    def is_to_explain(self, received: ReceivedPing) -> bool:
        """Return whether `report` will say in detail why a ping has no echo, for which it needs the ping's samples."""
        return self.silent_pings.is_to_explain(received.total, self._is_live(received))

    def _is_live(self, received: ReceivedPing) -> bool:
        """Return whether a ping follows those before, in small steps."""
        return self.sampler.is_live and received.drawn.resolution.plan is None

    def sample_origin(self) -> SampleOrigin:
        """Return what the `meta` of pings states about the scene and the driver; made again when the scene changes."""
        scene = self.world.scene
        if self._described is not scene:  # at first, and when bodies were added
            self._origin = SampleOrigin(
                scene.name,
                tuple(body.name for body in scene.bodies),
                tuple(plume.name for plume in scene.plumes),
                self.sampler.tolerance,
                self.world.gl_info["renderer"],
                self.world.gl_info["engine"],
            )
            self._described = scene
        return self._origin

    def report(self, received: ReceivedPing) -> PingReport:
        """Return what a ping tells beside its echo; inside `drawing`, or with the world `unchanged`.

        Warns of multipath that breaks the tolerance, and, in the first ping, of a body around the sonar.
        """
        setup = received.drawn.setup
        self._warn_of_body(setup)
        no_echo, total, is_live = None, received.total, self._is_live(received)
        if self.silent_pings.has_lost_echo(total, is_live):
            no_echo = ECHO_LOST
        is_to_explain = self.silent_pings.is_to_explain(total, is_live)
        self.silent_pings.add(total)
        if is_to_explain:
            instrument, view = self.instrument, received.drawn.view.sectors
            no_echo = why_no_echo(self.world.scene, setup.state, instrument, setup.head_pose, view)
        estimate, echo = self._direct_error(received), self._multipath_of(received)
        if estimate is not None:
            self.image_sampling.warn_if_unmet(echo)
            estimate = estimate if echo is None else max(estimate, self.image_sampling.error_of(echo))
        origin = self.sample_origin()
        # bodies and plumes that were added after the set-up are not in the ping, whenever it was drawn
        if setup.n_bodies < len(origin.bodies) or setup.n_plumes < len(origin.plumes):
            known = {"bodies": origin.bodies[: setup.n_bodies], "plumes": origin.plumes[: setup.n_plumes]}
            origin = replace(origin, **known)
        return PingReport(origin, estimate, no_echo)

    def close(self) -> None:
        """Release all resources, and the OpenGL context if no other run uses it; a second call does nothing.

        After an interrupt, a second call releases the rest.
        """
        world = self._world
        if world is not None:
            world.check_thread()
            world.check_idle()
            for job in self._in_flight:
                job.check_free()  # first: what is half closed would end the sequence with another error
            self._is_closed = True
            world.leave(id(self), self._release)
            self._world = None

    def _release(self) -> None:
        for job in self._in_flight:
            job.settle()
        self.stages = self.sampler = self._image_sources = None
        self._in_flight, self._idle_workers = [], []

    def forget(self) -> None:
        """Count this run as unused without closing it, since finalisers must not call OpenGL."""
        if self._world is not None:
            self._world.forget(id(self))
