"""Many pings: some are made while those before are awaited."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import count, repeat

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.core.worker import Job, JobThread
from sonar_gl.engine.error_model import Plan
from sonar_gl.engine.flow import PingSetup
from sonar_gl.engine.multipath import ImageSources
from sonar_gl.engine.ping_worker import PingWorker, n_threads
from sonar_gl.engine.pipeline import draw, finish, receive, sample
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.run import Run
from sonar_gl.ping import Ping

BATCH = 4  # pings drawn at once
# Samples drawn at once, unless a single ping has more: 21 MB of render targets, twice, as others are summed meanwhile.
# From half as many samples on, a ping gains nothing by being drawn with others.
BATCH_SAMPLES = 1 << 19
IMAGE_POSES = 5  # of a planned sequence, that decide how finely image sources are sampled


def requests_of(poses, per_ping: dict, **common) -> Iterator[PingRequest]:
    """Yield the request of each ping.

    Parameters
    ----------
    poses : (4, 4) world_from_sonar of each
    per_ping : field of `PingRequest` -> (name in messages, value of each ping, or None for none)
    common : fields of `PingRequest` that all have in common

    Raises
    ------
    Error
        if one of these is not one value per ping; at once, whereas values are checked one by one.
    """
    columns = [_per_ping(values, name, poses) for name, values in per_ping.values()]
    rows = zip(several_poses(poses), *columns, strict=False)

    def requests():
        for number, (pose, *values) in zip(count(), rows, strict=False):
            yield PingRequest(pose, number=number, **common, **dict(zip(per_ping, values, strict=True)))

    return requests()


def several_poses(poses) -> Iterable:
    """Return the poses, or raise an Error if this is not several of them."""
    if not isinstance(poses, Iterable) or (isinstance(poses, np.ndarray) and poses.ndim == 2):
        raise Error(f"poses must be several poses (got {type(poses).__name__}; make [pose] of one)")
    return poses


def _per_ping(values, name: str, poses) -> Iterable:
    """Return one value per ping, or None for each; an Error if it is one value alone, or of another number."""
    if not isinstance(values, Iterable | None) or isinstance(values, (dict, str)):
        raise Error(f"{name} must be several, one a pose (got {values!r})")
    counted = values is not None and hasattr(values, "__len__") and hasattr(poses, "__len__")
    if counted and len(values) != len(poses):
        raise Error(f"{name} must be as many as poses (got {len(values)} for {len(poses)} poses)")
    return repeat(None) if values is None else values


def plan(run: Run, requests: Iterable[PingRequest]) -> Plan | None:
    """Choose the samples for all of these pings, and stay with them; if that is broken off, with those before."""
    setups = [run.set_up(request) for request in requests]
    with run.drawing():
        setups = [run.with_later_bodies(setup) for setup in setups]
        sampler, images = run.sampler, run.image_sources
        before = sampler.choice, images and images.choice
        try:
            chosen = sampler.fix(setups)
            if images is not None:
                _fix_images(run, images, setups)
        except BaseException:
            sampler.choice = before[0]
            if images is not None:
                images.choice = before[1]
            raise
    return chosen


def _fix_images(run: Run, images: ImageSources, setups: Sequence[PingSetup]) -> None:
    """Choose the samples of image sources for all of some pings, for IMAGE_POSES of many, and stay with them."""
    images.release()
    least = images.COARSEST
    for at in np.unique(np.linspace(0, len(setups) - 1, IMAGE_POSES).round().astype(int)):
        images.reset()
        if (found := sample(run, setups[at]).drawn.images) is not None:
            least = min(least, found.halvings)
    images.fix(least)


class _Upcoming:
    """Pings to come.

    Parameters
    ----------
    requests : may come from a user's generator, which may use the simulator itself

    Attributes
    ----------
    failure : why there are no more; or None
    """

    def __init__(self, run: Run, requests: Iterator[PingRequest]):
        self._run, self._requests = run, requests
        self._setups: deque[PingSetup] = deque()
        self._is_over, self.failure = False, None

    def fill(self, count: int) -> bool:
        """Set up pings until there are so many; return whether any is there. Not inside `drawing`."""
        while len(self._setups) < count and not self._is_over:
            try:
                self._setups.append(self._run.set_up(next(self._requests)))
            except StopIteration:
                self._is_over = True
            except (
                KeyboardInterrupt
            ):  # at once: a caller that stops at one of the pings before would never get it
                raise
            except BaseException as why:  # of this request: the pings before it come first
                self.failure, self._is_over = why, True
        return bool(self._setups)

    def next_batch(self, most: int) -> tuple[list[PingSetup], PingSetup | None]:
        """Return pings that can be drawn at once, and the one after them if its error is to be estimated."""
        batch, sectors = [], self._run.sampler.resolution.stage.fan.sectors
        most = min(most, BATCH_SAMPLES // sum(sector.columns * sector.rows for sector in sectors))
        while self._setups and len(batch) < max(most, 1):
            setup = self._run.with_later_bodies(self._setups.popleft())
            if self._run.sampler.notice(setup):
                return batch, setup
            batch.append(setup)
        return batch, None


class _Overlap:
    """OpenGL draws some pings at once, in the caller's thread, while another thread receives those before.

    Attributes
    ----------
    most : pings that are started at once
    ahead : how many such groups are in flight while the caller waits for one
    """

    most, ahead = BATCH, 1

    def __init__(self, run: Run):
        self._run, self._thread = run, JobThread("sonar_gl receiver")

    def start(self, setups: list[PingSetup]) -> Job:
        """Draw some pings, and begin to receive them; inside `drawing`."""
        drawn = draw(self._run, setups, self._run.sampler.resolution, keep_last=True)
        job = self._run.receive_later(lambda: [receive(one) for one in drawn])
        self._thread.submit(job)
        return job

    def close(self) -> None:
        """End the thread."""
        self._thread.close()


class _Workers:
    """Threads each make their own pings, without a context; attributes as of `_Overlap`."""

    most = 1

    def __init__(self, run: Run):
        self._run, self._number = run, 0
        sonar, acoustics = run.instrument.sonar, run.instrument.acoustics
        made_of = run.world.engine, sonar, acoustics, run.world.scene, run.tolerance
        self._workers = [PingWorker(*made_of) for _ in range(n_threads())]
        self.ahead = 2 * len(self._workers) - 1

    def start(self, setups: list[PingSetup]) -> Job:
        """Begin to make a ping."""
        run, worker = self._run, self._workers[self._number % len(self._workers)]
        (setup,), self._number = setups, self._number + 1
        job = run.await_job(worker.job(setup, run.sampler.resolution, run.image_choice(), run.world.scene))
        worker.submit(job)
        return job

    def close(self) -> None:
        """End the threads."""
        for worker in self._workers:
            worker.close()


def make_pings(run: Run, requests: Iterator[PingRequest]) -> Iterator[Ping]:
    """Yield pings, in order: some are made by other threads while the caller has those before."""
    in_flight: deque[Job] = deque()
    upcoming = _Upcoming(run, requests)
    with run.drawing():
        threads = _Overlap(run) if run.world.engine.name == "opengl" else _Workers(run)
    try:
        while upcoming.fill(threads.most):
            with run.drawing(beside=in_flight):
                batch, to_check = upcoming.next_batch(threads.most)
                if batch:
                    in_flight.append(threads.start(batch))
            while in_flight and (len(in_flight) > threads.ahead or to_check is not None):
                yield from _finished(run, in_flight)
            if to_check is not None:
                yield _sampled(run, to_check)
        while in_flight:
            yield from _finished(run, in_flight)
    finally:
        threads.close()
    if upcoming.failure is not None:
        raise upcoming.failure


def _finished(run: Run, in_flight: deque[Job]) -> Iterator[Ping]:
    """Yield the pings of the job that was started first."""
    for received in in_flight.popleft().result():
        with run.world.unchanged():
            report = None if run.is_outdated(received) else run.report(received)
        if report is None:
            yield _sampled(run, received.drawn.setup)
        else:
            yield finish(run.instrument, received, report)


def _sampled(run: Run, setup: PingSetup) -> Ping:
    """Return a ping that is sampled alone, with a check of its error."""
    with run.drawing():
        received = sample(run, setup, check=True)
        report = run.report(received)
    return finish(run.instrument, received, report)
