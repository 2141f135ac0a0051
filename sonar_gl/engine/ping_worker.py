"""What makes whole pings of a sequence beside others, where drawing needs no context."""

from __future__ import annotations

from dataclasses import replace
from threading import Lock

from sonar_gl.core.worker import STEP_BACK, Job
from sonar_gl.engine.flow import PingSetup, ReceivedPing, Resolution
from sonar_gl.engine.level_search import LevelSearch
from sonar_gl.engine.multipath import ImageSources
from sonar_gl.engine.pipeline import choose_samples, draw, receive, receive_chosen
from sonar_gl.engine.run import Run
from sonar_gl.engine.stage import StageCache
from sonar_gl.engine.world import IN_USE
from sonar_gl.scene.scene import Scene


class PingWorker:
    """Makes pings, one after the other, with arrays of its own, in any thread.

    A ping's two halves are done in turn, so that the ping is that of `Simulator.ping` to the last bit.

    run : Run, whose engine, scene and settings it takes
    """

    def __init__(self, run: Run):
        world, sonar, acoustics = run.world, run.instrument.sonar, run.instrument.acoustics
        self._stages = StageCache(world.engine, sonar, acoustics, most_samples=run.stages.most_samples)
        self._images = None
        if acoustics.multipath != "none":
            self._images = ImageSources(self._stages, None, world.scene, run.tolerance)
        self._search = None  # LevelSearch, once a ping chooses its samples
        self._tolerance, self._gain = run.tolerance, run.instrument.gain
        self._making = Lock()  # held by the one job that runs

    def job(self, setup: PingSetup, resolution: Resolution, scene: Scene) -> Job:
        """Return a job that makes one ping.

        resolution : its samples; the stage is replaced by the worker's own
        """

        def make() -> list[ReceivedPing]:
            with self._making, STEP_BACK:  # another thread may make another ping of this worker
                images = self._images_in(scene)
                stage = self._stages.stage(resolution.stage.sampling)
                self._stages.settle(stage.fan.n_samples)
                own = replace(resolution, stage=stage)
                return [receive(one) for one in draw(images, [setup], own)]

        return Job(make, IN_USE)

    def job_apart(self, setup: PingSetup, halvings: int, scene: Scene) -> Job:
        """Return a job that makes one ping with samples chosen from it alone.

        halvings : how often rows are halved for image sources
        """

        def make() -> list[ReceivedPing]:
            with self._making, STEP_BACK:
                images = self._images_in(scene)
                if self._search is None:
                    self._search = LevelSearch(self._stages, self._tolerance, self._gain)
                return [receive_chosen(images, setup, choose_samples(self._search, setup), halvings)]

        return Job(make, IN_USE)

    def _images_in(self, scene: Scene) -> ImageSources | None:
        """Return the image sources in a scene; None without multipath."""
        if self._images is not None:
            self._images.use_scene(scene)
        return self._images
