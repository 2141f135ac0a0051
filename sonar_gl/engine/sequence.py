"""Many pings: some are made while those before are awaited."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import partial
from typing import NamedTuple

from sonar_gl.core.cores import n_threads
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.warn import warn_caller
from sonar_gl.core.worker import Job, JobThreads
from sonar_gl.engine.flow import PingReport, PingSetup, ReceivedPing
from sonar_gl.engine.ping_worker import PingWorker
from sonar_gl.engine.pipeline import draw, finish, receive, sample
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.run import Run
from sonar_gl.ping import Ping

BATCH = 4  # pings drawn at once
# Samples drawn at once, unless a single ping has more: 21 MB of render targets, twice, as others are summed meanwhile.
# From half as many samples on, a ping gains nothing by being drawn with others.
BATCH_SAMPLES = 1 << 19
FEW_SAMPLES = 1 << 13  # a ping of fewer, and of a direct echo alone, takes less time than to hand it over


class _TakenPing(NamedTuple):
    """A ping of a sequence, and the sampler's `history` before it."""

    setup: PingSetup
    history: object


class _Batch(NamedTuple):
    """Pings to start together.

    pings : _TakenPing of each; may be none
    is_apart : it is one ping, whose samples its thread chooses from it alone
    must_wait : the ping after these has to wait until they have come out, and those before them; or there is none
    """

    pings: list[_TakenPing]
    is_apart: bool = False
    must_wait: bool = False


class _Started(NamedTuple):
    """Pings that another thread makes.

    job : answers a list of their ReceivedPings
    pings : of the job, those that have not come out
    choice : of the sampler, by which they are made
    """

    job: Job
    pings: list[_TakenPing]
    choice: object


class _Upcoming:
    """Pings to come. The sampler's history has those that were taken, unless they are put back.

    requests : may come from a user's generator, which may use the simulator itself

    n_requests : number of requests that have come
    failure : why there are no more; or None
    are_small : to hand them to other threads gains nothing, by the last ping; so it is until a ping tells
    """

    def __init__(self, run: Run, requests: Iterator[PingRequest]):
        self._run, self._requests = run, requests
        self._setups: deque[PingSetup] = deque()
        self._is_over, self.failure, self.n_requests, self.are_small = False, None, 0, True
        self._history = run.sampler.history  # the sampler has another one, if others made pings since

    def fill(self, count: int) -> bool:
        """Set up pings until there are so many; return whether any is there. Not inside `drawing`."""
        while len(self._setups) < count and not self._is_over:
            try:
                self._setups.append(self._run.set_up(self._run.world.next_request(self._requests)))
                self.n_requests += 1
            except StopIteration:
                self._is_over = True
            except KeyboardInterrupt:
                raise  # at once: a caller that stops at one of the pings before would never get it
            except BaseException as why:  # of this request: the pings before it come first
                self.failure, self._is_over = why, True
        return bool(self._setups)

    def take(self, most: int, can_choose: bool) -> _Batch:
        """Take the next pings that can be drawn at once, `most` of them or as many as BATCH_SAMPLES allow.

        A ping has to wait if its error, or that of its multipath, is to be estimated, or if it makes what finer samples
        need, or follows one that is still to choose its samples.
        So has one whose samples are chosen from it alone, unless a thread can do that. If its request asks for it, none
        can: its image sources, too, depend on no other ping.
        """
        sampler, batch = self._run.sampler, []
        if most > 1:
            most = max(1, min(most, BATCH_SAMPLES // sampler.resolution.stage.fan.n_samples))
        while len(batch) < most:
            if not self._setups:
                return _Batch(batch, must_wait=True)
            setup = self._run.with_later_bodies(self._setups[0])
            if sampler.is_apart(setup):
                if batch or setup.request.alone or not can_choose:
                    return _Batch(batch, must_wait=True)
                return _Batch([self._taken(setup, sampler.history_with_apart(setup))], is_apart=True)
            history = sampler.history_with(setup)
            if sampler.is_deciding(history) or self._run.image_sampling.choice.is_due:
                return _Batch(batch, must_wait=True)
            batch.append(self._taken(setup, history))
        return _Batch(batch)

    def _taken(self, setup: PingSetup, history: object) -> _TakenPing:
        """Take the next ping, with which the sampler's history is this one."""
        ping = _TakenPing(setup, self._run.sampler.history)
        self._setups.popleft()
        self._run.sampler.history = self._history = history
        return ping

    def pop(self) -> PingSetup:
        """Return the next ping, which is not in the sampler's history until it is sampled."""
        return self._setups.popleft()

    def put_back(self, pings: Sequence[_TakenPing]) -> None:
        """Have these pings come first, in their order, as if they had not been taken."""
        self._setups.extendleft(one.setup for one in reversed(pings))
        if pings:
            self._run.sampler.history = self._history = pings[0].history

    def follow(self, ping: _TakenPing, received: ReceivedPing) -> None:
        """Have later pings follow one whose samples were chosen from it alone, unless other pings were made since."""
        sampler, plan = self._run.sampler, received.drawn.resolution.plan
        if sampler.history is self._history:
            n_pings = ping.history.n_pings + 1
            sampler.follow(ping.setup, plan, received.direct.total, received.coverage, n_pings)
            self._history = sampler.history

    def review_size(self, received: ReceivedPing) -> None:
        """Take the next pings to be as small, or not, as one that was received."""
        view, has_lobes = received.drawn.view, received.lobes is not None or received.texture is not None
        has_echoes = bool(received.others) or view.bubbles is not None
        has_more = has_lobes or has_echoes or received.labels is not None
        self.are_small = not has_more and view.n_samples < FEW_SAMPLES

    def leave(self, pings: Sequence[_TakenPing]) -> None:
        """Have the sampler's history end with the ping that came out last: these, made ahead, never will.

        Unless other pings were made since, or the run is closed.
        """
        sampler = self._run.sampler
        if sampler is not None and sampler.history is self._history:
            self.put_back(pings)


class ReceiverThread:
    """OpenGL draws some pings at once, in the caller's thread, while another thread receives those before.

    most : pings that are started at once
    can_choose : it can choose the samples of a ping from it alone
    ahead : how many such groups are in flight while the caller waits for one
    gain : they make pings faster than the caller alone
    """

    most, ahead, can_choose, gain = BATCH, 1, False, True

    def __init__(self, run: Run):
        self._run, self._thread = run, JobThreads("sonar_gl receiver")

    def start(self, batch: _Batch) -> Job:
        """Draw some pings, and begin to receive them; inside `drawing`."""
        run, setups = self._run, [ping.setup for ping in batch.pings]
        drawn = draw(run.image_sources, setups, run.resolution_ahead, keep_last=True)
        job = run.receive_later(lambda: [receive(one) for one in drawn])
        self._thread.submit(job)
        return job

    def help_with(self, jobs: Sequence[Job]) -> None:
        """Do nothing: these jobs are done one at a time."""

    def close(self) -> None:
        """End the thread."""
        self._thread.close()


class PingThreads:
    """Threads each make their own pings, without a context; attributes as of `ReceiverThread`.

    The caller is one of them while it waits: one more would take its core in turns with it.
    """

    most, can_choose = 1, True

    def __init__(self, run: Run):
        n = n_threads()
        self._run, self._number, self._workers, self._n_workers = run, 0, [], n
        self._threads = JobThreads("sonar_gl ping", n - 1)
        self.ahead, self.gain = 2 * n - 1, n > 1

    def start(self, batch: _Batch) -> Job:
        """Begin to make the only ping of a batch, by the workers in turn; inside `drawing`."""
        run = self._run
        if not self._workers:
            self._workers = run.take_workers(self._n_workers, partial(PingWorker, run))
        worker = self._workers[self._number % self._n_workers]
        self._number += 1
        (ping,) = batch.pings
        if batch.is_apart:
            job = worker.job_apart(ping.setup, run.image_sampling.halvings_alone, run.world.scene)
        else:
            job = worker.job(ping.setup, run.resolution_ahead, run.world.scene)
        run.await_job(job)
        self._threads.submit(job)
        return job

    def help_with(self, jobs: Sequence[Job]) -> None:
        """Make pings that no other thread has begun, until the first of all has been made."""
        for job in jobs:
            if jobs[0].is_over:
                break
            job.begin()

    def close(self) -> None:
        """End the threads; the next sequence goes on with the stages of the workers."""
        self._threads.close()
        self._run.keep_workers(self._workers)


def make_pings(run: Run, requests: Iterator[PingRequest]) -> Iterator[Ping]:
    """Yield pings, in order: some are made by other threads while the caller has those before.

    Warns once if the caller places or adds bodies while it has a ping, and others were requested ahead.
    """
    world, upcoming, has_warned = run.world, _Upcoming(run, requests), False
    with closing(_make_ahead(run, upcoming)) as pings:
        for number, ping in enumerate(pings, 1):
            n_changes = world.n_changes
            yield ping
            del ping  # a caller that has dropped it, too, lets the next one have its arrays
            n_ahead = upcoming.n_requests - number
            if world.n_changes != n_changes and n_ahead and not has_warned:
                has_warned = True
                _warn_of_late_bodies(n_ahead)


def _warn_of_late_bodies(n_ahead: int) -> None:
    several = "ping is made ahead and has" if n_ahead == 1 else f"{n_ahead} pings are made ahead and have"
    warn_caller(
        f"bodies were placed or added between two pings of a sequence, whose next {several} them as they were; give "
        "bodies= to pings(), place them in the generator of poses, or use ping()"
    )


def _make_ahead(run: Run, upcoming: _Upcoming) -> Iterator[Ping]:
    """Yield the pings to come, in order. A ping that has to wait is made here, once all before it have come out."""
    in_flight: deque[_Started] = deque()
    with run.drawing():
        threads = PingThreads(run) if run.world.engine.draws_in_threads else ReceiverThread(run)
    try:
        while upcoming.fill(_n_to_set_up(upcoming, threads)) or in_flight:
            must_wait = _makes_here(upcoming, threads) or _start_next(run, upcoming, threads, in_flight)
            if must_wait and not in_flight:
                yield _make_here(run, upcoming)
            while in_flight and (must_wait or len(in_flight) > threads.ahead):
                threads.help_with([started.job for started in in_flight])
                yield from _finish_first(run, upcoming, in_flight)
    finally:
        threads.close()
        upcoming.leave(_undelivered(in_flight))
    if upcoming.failure is not None:
        raise upcoming.failure


def _makes_here(upcoming: _Upcoming, threads: ReceiverThread | PingThreads) -> bool:
    """Return whether the caller makes the next ping, since other threads would gain nothing."""
    return upcoming.are_small or not threads.gain


def _n_to_set_up(upcoming: _Upcoming, threads: ReceiverThread | PingThreads) -> int:
    """Return how many pings to set up now: with those in flight, as many at a time, whoever makes them."""
    return threads.most * (threads.ahead + 1) if _makes_here(upcoming, threads) else threads.most


def _start_next(
    run: Run, upcoming: _Upcoming, threads: ReceiverThread | PingThreads, in_flight: deque[_Started]
) -> bool:
    """Start the next pings; return whether no more can be started before all in flight have come out."""
    with run.drawing(beside=[started.job for started in in_flight]):
        batch = upcoming.take(threads.most, threads.can_choose)
        try:
            if batch.pings:
                in_flight.append(_Started(threads.start(batch), batch.pings, run.sampler.choice))
        except SampleLimitError:  # as it is made by itself, it gets fewer samples
            upcoming.put_back(batch.pings)
            return True
        except BaseException:
            upcoming.put_back(batch.pings)
            raise
    return batch.must_wait


def _undelivered(in_flight: deque[_Started]) -> list[_TakenPing]:
    return [ping for started in in_flight for ping in started.pings]


def _finish_first(run: Run, upcoming: _Upcoming, in_flight: deque[_Started]) -> Iterator[Ping]:
    """Yield the pings that were started first; one that has to be made again is, and those after it are put back."""
    first = in_flight[0]
    try:
        answers = first.job.result()
    except SampleLimitError:  # of the first of them that has not come out: it is to get fewer samples
        answers = [None]
    for received in answers:
        reviewed = None if received is None else _review(run, upcoming, first, received)
        if reviewed is None:
            upcoming.put_back(_undelivered(in_flight))
            in_flight.clear()
            yield _make_here(run, upcoming)
            return
        # before the ping is finished: as in single calls, one that fails from here on counts for those after it
        first.pings.pop(0)
        yield finish(run, *reviewed)
    in_flight.popleft()


def _review(
    run: Run, upcoming: _Upcoming, started: _Started, received: ReceivedPing
) -> tuple[ReceivedPing, PingReport] | None:
    """Review the first ping of those started together that has not come out; return it with its report.

    Return None if its samples were not those that it has to have.
    """
    upcoming.review_size(received)
    with run.choices_kept():
        with run.world.unchanged():
            if run.review_ahead(received, started.choice):
                return None
            if received.drawn.resolution.plan is not None:
                upcoming.follow(started.pings[0], received)
            if not run.is_to_explain(received):
                return received, run.report(received)
        # drawn again, since the samples that tell why it has no echo may have been overwritten
        with run.drawing():
            setup = run.with_later_bodies(received.drawn.setup)
            (drawn,) = draw(run.image_sources, [setup], run.resolution_ahead)
            received = receive(drawn)
            return received, run.report(received)


def _make_here(run: Run, upcoming: _Upcoming) -> Ping:
    """Return the next ping, made in this thread, as `Simulator.ping` makes it."""
    setup = upcoming.pop()
    with run.drawing():
        received, report = sample(run, setup)
    upcoming.review_size(received)
    return finish(run, received, report)
