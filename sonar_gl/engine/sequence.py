"""Many pings: some are made while those before are awaited."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import closing
from functools import partial
from typing import NamedTuple

from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.warn import warn_caller
from sonar_gl.core.worker import Job, JobThread
from sonar_gl.engine.flow import PingSetup, Plan
from sonar_gl.engine.ping_worker import PingWorker, n_threads
from sonar_gl.engine.pipeline import draw, finish, receive, sample
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.run import Run
from sonar_gl.ping import Ping

BATCH = 4  # pings drawn at once
# Samples drawn at once, unless a single ping has more: 21 MB of render targets, twice, as others are summed meanwhile.
# From half as many samples on, a ping gains nothing by being drawn with others.
BATCH_SAMPLES = 1 << 19


class _QueuedPing(NamedTuple):
    """A ping of a sequence, and the sampler's `history` before it."""

    setup: PingSetup
    history: object


class _Started(NamedTuple):
    """Pings that another thread makes.

    Attributes
    ----------
    job : answers a list of their ReceivedPings, or the only one and the Plan behind its samples
    pings : of the job
    choice : of the sampler, by which they are made
    is_apart : the samples of its only ping are chosen from it alone
    """

    job: Job
    pings: list[_QueuedPing]
    choice: object
    is_apart: bool = False


class _Upcoming:
    """Pings to come.

    Parameters
    ----------
    requests : may come from a user's generator, which may use the simulator itself

    Attributes
    ----------
    n_taken : number of pings whose requests were taken
    failure : why there are no more; or None
    """

    def __init__(self, run: Run, requests: Iterator[PingRequest]):
        self._run, self._requests = run, requests
        self._setups: deque[PingSetup] = deque()
        self._is_over, self.failure, self.n_taken = False, None, 0
        self._history = run.sampler.history  # after the last ping that was taken or put back

    def fill(self, count: int) -> bool:
        """Set up pings until there are so many; return whether any is there. Not inside `drawing`."""
        while len(self._setups) < count and not self._is_over:
            try:
                with self._run.world.taking_request():
                    request = next(self._requests)
                self._setups.append(self._run.set_up(request))
                self.n_taken += 1
            except StopIteration:
                self._is_over = True
            except KeyboardInterrupt:
                raise  # at once: a caller that stops at one of the pings before would never get it
            except BaseException as why:  # of this request: the pings before it come first
                self.failure, self._is_over = why, True
        return bool(self._setups)

    def next_apart(self) -> _QueuedPing | None:
        """Return the next ping if its samples are chosen from it alone, since it lies far from the last; else None.

        One whose request asks for that depends on no other ping, nor by its image sources, and is made by itself.
        """
        sampler, setup = self._run.sampler, self._run.with_later_bodies(self._setups[0])
        if setup.request.alone or not sampler.is_apart(setup):
            return None
        before = sampler.history
        sampler.history = sampler.history_with_apart(setup)
        self._setups.popleft()
        self._history = sampler.history
        return _QueuedPing(setup, before)

    def next_batch(self, most: int) -> tuple[list[_QueuedPing], bool]:
        """Return pings that can be drawn at once, and whether the one after them has to wait for those before it.

        So has one whose error is to be estimated, and one that follows a ping that is still to choose its samples.
        """
        batch, sampler = [], self._run.sampler
        if most > 1:
            sectors = sampler.resolution.stage.fan.sectors
            most = min(most, BATCH_SAMPLES // sum(sector.columns * sector.rows for sector in sectors))
        while self._setups and len(batch) < max(most, 1):
            setup = self._run.with_later_bodies(self._setups[0])
            if sampler.is_apart(setup) or sampler.is_check_due(history := sampler.history_with(setup)):
                return batch, True
            self._setups.popleft()
            batch.append(_QueuedPing(setup, sampler.history))
            sampler.history = self._history = history
        return batch, False

    def pop(self) -> PingSetup:
        """Return the next ping."""
        return self._setups.popleft()

    def put_back(self, pings: Iterable[_QueuedPing]) -> None:
        """Have these pings come first, in their order, as if they were not in the sampler's history."""
        pings = list(pings)
        self._setups.extendleft(one.setup for one in reversed(pings))
        if pings:
            self._run.sampler.history = self._history = pings[0].history

    def follow(self, ping: _QueuedPing, plan: Plan, total: float) -> None:
        """Have later pings follow one whose samples were chosen from it alone, unless other pings were made since.

        total : the sum of its echo
        """
        sampler = self._run.sampler
        if sampler.history is self._history:
            sampler.follow(ping.setup, plan, total, ping.history.n_pings + 1)
            self._history = sampler.history

    def leave(self, pings: Iterable[_QueuedPing]) -> None:
        """Have the sampler's history end with the ping that came out last: these, made ahead, never will.

        Unless other pings were made since, or the run is closed.
        """
        sampler = self._run.sampler
        if sampler is not None and sampler.history is self._history:
            self.put_back(pings)


class _Overlap:
    """OpenGL draws some pings at once, in the caller's thread, while another thread receives those before.

    Attributes
    ----------
    most : pings that are started at once
    can_choose : its threads can choose the samples of a ping from it alone
    ahead : how many such groups are in flight while the caller waits for one
    """

    most, ahead, can_choose = BATCH, 1, False

    def __init__(self, run: Run):
        self._run, self._thread = run, JobThread("sonar_gl receiver")

    def start(self, setups: list[PingSetup]) -> Job:
        """Draw some pings, and begin to receive them; inside `drawing`."""
        drawn = draw(self._run.image_sources, setups, self._run.resolution_ahead, keep_last=True)
        job = self._run.receive_later(lambda: [receive(one) for one in drawn])
        self._thread.submit(job)
        return job

    def close(self) -> None:
        """End the thread."""
        self._thread.close()


class _Workers:
    """Threads each make their own pings, without a context; attributes as of `_Overlap`."""

    most, can_choose = 1, True

    def __init__(self, run: Run):
        self._run, self._number = run, 0
        self._workers = run.take_workers(n_threads(), partial(PingWorker, run))
        self.ahead = 2 * len(self._workers) - 1

    def start(self, setups: list[PingSetup]) -> Job:
        """Begin to make a ping."""
        run, worker, (setup,) = self._run, self._next(), setups
        job = run.await_job(worker.job(setup, run.resolution_ahead, run.world.scene))
        worker.submit(job)
        return job

    def start_apart(self, setup: PingSetup) -> Job:
        """Begin to make a ping with samples chosen from it alone."""
        run, worker = self._run, self._next()
        job = run.await_job(worker.job_apart(setup, run.image_sampling.alone, run.world.scene))
        worker.submit(job)
        return job

    def _next(self) -> PingWorker:
        """Return the workers in turn."""
        worker, self._number = self._workers[self._number % len(self._workers)], self._number + 1
        return worker

    def close(self) -> None:
        """End the threads; the next sequence goes on with their stages."""
        for worker in self._workers:
            worker.close()
        self._run.keep_workers(self._workers)


def make_pings(run: Run, requests: Iterator[PingRequest]) -> Iterator[Ping]:
    """Yield pings, in order: some are made by other threads while the caller has those before.

    Warns once if the caller places or adds bodies while it has a ping, and others were taken ahead.
    """
    world, upcoming, has_warned = run.world, _Upcoming(run, requests), False
    with closing(_made(run, upcoming)) as pings:
        for number, ping in enumerate(pings, 1):
            n_changes = world.n_changes
            yield ping
            n_ahead = upcoming.n_taken - number
            if world.n_changes != n_changes and n_ahead and not has_warned:
                has_warned = True
                _warn_of_late_bodies(n_ahead)


def _warn_of_late_bodies(n_ahead: int) -> None:
    several = "ping is made ahead and has" if n_ahead == 1 else f"{n_ahead} pings are made ahead and have"
    warn_caller(
        f"bodies were placed or added between two pings of a sequence, whose next {several} them as they were; give "
        "bodies= to pings(), place them in the generator of poses, or use ping()"
    )


def _made(run: Run, upcoming: _Upcoming) -> Iterator[Ping]:
    """Yield the pings to come, in order."""
    in_flight: deque[_Started] = deque()
    with run.drawing():
        threads = _Overlap(run) if run.world.engine.name == "opengl" else _Workers(run)
    try:
        while (is_more := upcoming.fill(threads.most)) or in_flight:
            with run.drawing(beside=[started.job for started in in_flight]):
                apart = upcoming.next_apart() if is_more and threads.can_choose else None
                batch, is_alone = ([apart], False) if apart else upcoming.next_batch(threads.most)
                try:
                    if apart:
                        job = threads.start_apart(apart.setup)
                        in_flight.append(_Started(job, batch, run.sampler.choice, is_apart=True))
                    elif batch:
                        job = threads.start([one.setup for one in batch])
                        in_flight.append(_Started(job, batch, run.sampler.choice))
                except SampleLimitError:
                    upcoming.put_back(batch)
                    is_alone = True
                except BaseException:
                    upcoming.put_back(batch)
                    raise
            if is_alone and not in_flight:
                yield _sampled(run, upcoming.pop())
            while in_flight and (len(in_flight) > threads.ahead or is_alone or not is_more):
                yield from _finished(run, in_flight, upcoming)
    finally:
        threads.close()
        upcoming.leave(_undelivered(in_flight))
    if upcoming.failure is not None:
        raise upcoming.failure


def _undelivered(in_flight: deque[_Started]) -> list[_QueuedPing]:
    return [ping for started in in_flight for ping in started.pings]


def _finished(run: Run, in_flight: deque[_Started], upcoming: _Upcoming) -> Iterator[Ping]:
    """Yield the pings of the job that was started first; if one has to be sampled anew, those after it, too."""
    started, plan = in_flight[0], None
    try:
        received = started.job.result()
        if started.is_apart:
            one, plan = received
            received = [one]
    except SampleLimitError:
        received = [None] * len(started.pings)
    for one in received:
        with run.world.unchanged():
            is_good = one is not None and not (
                run.review_apart(one) if started.is_apart else run.is_outdated(one, started.choice)
            )
            if is_good and plan is not None:
                upcoming.follow(started.pings[0], plan, one.direct.total)
            report = run.report(one) if is_good and one.total > 0 else None
        if not is_good:
            upcoming.put_back(_undelivered(in_flight))
            in_flight.clear()
            yield _sampled(run, upcoming.pop())
            return
        ping = _without_echo(run, one.drawn.setup) if report is None else finish(run, one, report)
        started.pings.pop(0)
        yield ping
    in_flight.popleft()


def _sampled(run: Run, setup: PingSetup) -> Ping:
    """Return a ping that is sampled alone, as `Simulator.ping` does."""
    with run.drawing():
        received, report = sample(run, setup)
    return finish(run, received, report)


def _without_echo(run: Run, setup: PingSetup) -> Ping:
    """Return a ping without an echo, drawn again, since the samples that tell why may have been overwritten."""
    with run.drawing():
        (drawn,) = draw(run.image_sources, [run.with_later_bodies(setup)], run.resolution_ahead)
        received = receive(drawn)
        report = run.report(received)
    return finish(run, received, report)
