"""Many pings: some are drawn while those before are received."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count, repeat

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.engine.adaptive import Plan
from sonar_gl.engine.flow import PingSetup, ReceivedPing
from sonar_gl.engine.pipeline import draw, finish, receive, sample
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.run import Run
from sonar_gl.ping import Ping

BATCH = 4  # pings drawn at once
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
    """Choose the samples for all of these pings, and stay with them."""
    with run.drawing():
        setups = [run.set_up(request) for request in requests]
        chosen = run.sampler.fix(setups)
        if (images := run.image_sources) is not None:
            images.release()
            least = images.COARSEST
            for at in np.unique(np.linspace(0, len(setups) - 1, IMAGE_POSES).round().astype(int)):
                images.reset()
                sample(run, setups[at])
                least = min(least, images.halvings)
            images.fix(least)
    return chosen


@dataclass
class _Batch:
    """Pings that can be drawn at once, and what comes after them.

    Attributes
    ----------
    setups : PingSetup of each
    to_check : the ping after them whose error is to be estimated; or None
    failure : why there are no more; or None
    is_last : whether there are no more
    """

    setups: list[PingSetup] = field(default_factory=list)
    to_check: PingSetup | None = None
    failure: Exception | None = None
    is_last: bool = False


def make_pings(run: Run, requests: Iterator[PingRequest]) -> Iterator[Ping]:
    """Yield pings: while one batch is drawn, the one before is received in another thread."""
    in_flight: Future | None = None
    with ThreadPoolExecutor(1, "sonar_gl receiver") as thread:
        batch = _Batch()
        while not batch.is_last:
            with run.drawing(beside=in_flight):
                batch = _next_batch(run, requests)
                upcoming = None
                if batch.setups:
                    drawn = draw(run, batch.setups, run.sampler.resolution, keep_last=True)
                    upcoming = thread.submit(lambda drawn=drawn: [receive(one) for one in drawn])
                    run.receiving(upcoming)
            if in_flight is not None:
                yield from _finished(run, in_flight)
            in_flight = upcoming
            if batch.to_check is not None:
                if in_flight is not None:
                    yield from _finished(run, in_flight)
                    in_flight = None
                with run.drawing():
                    received = sample(run, batch.to_check, check=True)
                yield finish(run, received)
        if in_flight is not None:
            yield from _finished(run, in_flight)
    if batch.failure is not None:
        raise batch.failure


def _next_batch(run: Run, requests: Iterator[PingRequest]) -> _Batch:
    batch = _Batch()
    while len(batch.setups) < BATCH:
        try:
            setup = run.set_up(next(requests))
        except StopIteration:
            batch.is_last = True
            break
        except Exception as why:  # of this request: the pings before it come first
            batch.failure, batch.is_last = why, True
            break
        if run.sampler.is_due(setup):
            batch.to_check = setup
            break
        batch.setups.append(setup)
    return batch


def _finished(run: Run, in_flight: Future) -> Iterator[Ping]:
    """Yield the pings of a batch that was drawn before."""
    for received in in_flight.result():
        yield finish(run, _up_to_date(run, received))


def _up_to_date(run: Run, received: ReceivedPing) -> ReceivedPing:
    """Return a ping, sampled once more if its samples were chosen for another sight."""
    run.check_open()
    if not run.is_outdated(received):
        return received
    with run.drawing():
        return sample(run, received.drawn.setup, check=True)
