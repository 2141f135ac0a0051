"""Every place where the tools look inside a Simulator.

The benches time the stages of a ping, and pings as batches make them; the chart's rivals sum the samples of a ping
in other ways. Neither is part of the public interface. When the package is restructured, this module follows it
and the tools stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

import sonar_gl as sg
from sonar_gl.engine.pipeline import draw, make_ping
from sonar_gl.engine.replan_trigger import CHECK_EVERY
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.sequence import make_pings

PINGS_PER_REVIEW = CHECK_EVERY  # of a tolerance, while the sonar moves slowly
STAGES = ("render", "reduce", "beams")  # draw and read back; samples to columns; columns to beams


def sample_grid(simulator) -> tuple[int, int]:
    """Return the columns, over all sectors, and the most rows of the samples at the scene's own pose."""
    with rendered(simulator, simulator.scene.sonar_pose) as samples:
        shapes = [one.plane_echo.shape for one in samples]
    return sum(columns for _, columns, _ in shapes), max(rows for rows, *_ in shapes)


@contextmanager
def rendered(simulator, pose):
    """Draw from a pose; give the SectorSamples, which stay valid in the block."""
    with simulator.run.drawing():
        (view,) = simulator.run.sampler.resolution.stage.draw([pose], [None])
        yield view.sectors


def count_image_sources(simulator, pose) -> int:
    """Return the number of image sources that are drawn from a pose."""
    run = simulator.run
    setup = run.set_up(PingRequest(pose))
    with run.drawing():
        run.sampler.resolution_for(setup)
        (drawn,) = draw(run.image_sources, [setup], run.resolution_ahead)
    return 0 if drawn.images is None else len(drawn.images.sources)


def ping_alone(simulator, pose, labels: bool = False) -> sg.Ping:
    """Return a ping with samples chosen from it alone, as those of batches are."""
    return make_ping(simulator.run, PingRequest(pose, labels=labels, alone=True))


def ping_with_all_samples(simulator, pose) -> sg.Ping:
    """Return a ping whose image sources have as many samples as its direct echo, however weak they are."""
    simulator.run.image_sampling.fix(0)
    return simulator.ping(pose)


def pings_of(simulator, requests: Iterator[PingRequest]) -> Iterator[sg.Ping]:
    """Yield the pings of requests, as batches make them."""
    return make_pings(simulator.run, requests)


class StageClock:
    """Adds up the time of STAGES while a simulator pings with samples that stay the same."""

    def __init__(self, simulator):
        stage = simulator.run.sampler.resolution.stage
        self._seconds = dict.fromkeys(("render", "sum_view", "weigh"), 0.0)
        for owner, name in zip(
            (stage.renderer, stage.beamformer, stage.beamformer), self._seconds, strict=True
        ):
            setattr(owner, name, self._timed(name, getattr(owner, name)))

    def _timed(self, name, method):
        def timed(*arguments, **keywords):
            start = perf_counter()
            out = method(*arguments, **keywords)
            self._seconds[name] += perf_counter() - start
            return out

        return timed

    def lap_ms(self) -> list[float]:
        """Return the milliseconds of each stage since the last lap."""
        render, both, beams = (1e3 * seconds for seconds in self._seconds.values())
        self._seconds = dict.fromkeys(self._seconds, 0.0)
        return [render, both - beams, beams]
