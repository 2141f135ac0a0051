"""What a dry run finds out about a job, in one process: what its pings cost, need and show."""

from __future__ import annotations

import time
from bisect import bisect_right
from contextlib import ExitStack
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sonar_gl.batch.manifest import CHUNK_PINGS
from sonar_gl.batch.outputs import Output
from sonar_gl.batch.parts import Batch, Report, no_report, open_simulators, reported_warnings
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.engine.level_search import evenly_picked
from sonar_gl.scene.extent import body_around
from sonar_gl.sonar.sampling import WORST_BODY

SURVEYED = 24  # pings of a scene
MOST_SCENES = 20  # of a job: with pings of all of many scenes a dry run would take longer than the job


class SeenClass(NamedTuple):
    """In how many of some pings a class has a label, and the median of its bins there, 0 if in none."""

    name: str
    n_pings: int
    median_bins: int


class SeenClasses(NamedTuple):
    """The classes of a scene's bodies in so many pings of a sonar, those in the fewest pings first."""

    scene: int
    sonar: str
    n_pings: int
    classes: list[SeenClass]


@dataclass(frozen=True)
class DryRun:
    """What some pings of a job have shown.

    seconds_per_ping, bytes_per_ping : means over the job
    numbers : of the pings, rising
    seen : of each of `surveyed_scenes` and sonar; empty if the job stores no labels
    """

    seconds_per_ping: float
    bytes_per_ping: float
    numbers: tuple[int, ...]
    seen: list[SeenClasses]


class LabelledBins(Output):
    """The number of bins that have the label of each class; it writes nothing.

    counts : sonar -> for each ping that was added, (1 + classes,) whole numbers, by number of the class
    """

    def __init__(self, *context):
        super().__init__(*context)
        self.counts: dict[str, list[np.ndarray]] = {}

    def add(self, request, sonar, ping, quiet):
        if ping.body_id is not None:
            class_id = self.schema.scene_class_id(request.scene)
            bins = np.bincount(ping.body_id.ravel(), minlength=len(class_id))
            counts = np.bincount(class_id, bins, 1 + len(self.schema.classes)).astype(int)
            self.counts.setdefault(sonar, []).append(counts)


def surveyed_scenes(n_scenes: int) -> list[int]:
    """Return the numbers of the scenes of which a dry run makes pings: all, or MOST_SCENES spread over many.

    >>> surveyed_scenes(3), len(surveyed_scenes(500))
    ([0, 1, 2], 20)
    """
    return evenly_picked(range(n_scenes), MOST_SCENES)


def try_pings(batch: Batch, report: Report = no_report) -> DryRun:
    """Return what a ping costs, of about as many as a part has, spread over the job, and which classes are seen.

    Those of each of `surveyed_scenes` are made twice, as a part is made, since only the second time is typical: the
    first one opens the scene, and compiles. With labels, the first time there are SURVEYED at least, since few say
    little.
    """
    requests, folder = batch.requests, batch.folder
    scenes, n_part = surveyed_scenes(len(requests.job.scenes)), len(batch.manifest.numbers(0))
    # of each scene a chunk at least, since few pings have more than their share of what a part needs once
    n_each = min(n_part, max(CHUNK_PINGS, -(-n_part // len(scenes))))
    seconds, sizes, numbers, weights, seen = [], [], [], [], []
    for scene in scenes:
        picked = _spread_numbers(requests, scene, n_each)
        if requests.job.labels is None:
            batch.maker.make_sample(picked, report)
        else:
            seen += _see_classes(batch, scene, max(n_each, SURVEYED), report)
        begin_s = time.perf_counter()
        record = batch.maker.make_sample(picked, report)
        seconds.append((time.perf_counter() - begin_s) / len(picked))
        sizes.append(sum(folder.fs.size(folder.path(name)) for name in record.files) / len(picked))
        numbers += picked
        weights.append(sum(len(run.numbers) for run in requests.runs if run.scene == scene))
    means = np.average([seconds, sizes], axis=1, weights=weights).tolist()
    return DryRun(*means, tuple(sorted(numbers)), seen)


def _see_classes(batch: Batch, scene: int, count: int, report: Report) -> list[SeenClasses]:
    """Make so many pings spread over those of a scene, and return how often each sonar sees each class."""
    numbers, n_part = _spread_numbers(batch.requests, scene, count), len(batch.manifest.numbers(0))
    labelled = LabelledBins(batch.requests, batch.schema, batch.folder)
    batch.maker.outputs.append(labelled)
    for first in range(0, len(numbers), n_part):
        batch.maker.make_sample(numbers[first : first + n_part], report)
    batch.maker.outputs.remove(labelled)  # a batch does not spend time on it
    schema, out = batch.schema, []
    for sonar, bins in labelled.counts.items():
        counts, found = np.array(bins), []
        for number in sorted({*schema.scene_class_id(scene).tolist()} - {0}):
            where_seen = counts[counts[:, number] > 0, number]
            median = int(np.median(where_seen)) if len(where_seen) else 0
            found.append(SeenClass(schema.classes[number - 1], len(where_seen), median))
        out.append(SeenClasses(scene, sonar, len(bins), sorted(found, key=lambda one: one.n_pings)))
    return out


class HardView(NamedTuple):
    """What the view of a ping needs.

    n_samples : samples that the tolerance takes
    error_estimate : estimated error with them
    body : name of the body that is nearest to its bound; empty if the whole ping is
    has_echo : whether a body returns any
    around : name of the body that the sonar is in, or below if it is a terrain; empty if there is none
    """

    number: int
    sonar: str
    n_samples: int
    error_estimate: float
    body: str
    has_echo: bool
    around: str


def survey(batch: Batch, scene: int, report: Report = no_report) -> list[HardView]:
    """Choose the samples of SURVEYED pings spread over those of a scene, and return what they need."""
    requests, found = batch.requests, []
    spread = [requests[number] for number in _spread_numbers(requests, scene, SURVEYED)]
    scene_bodies = requests.scenes[scene].bodies
    bodies = ["", *(body.name for body in scene_bodies)]
    with ExitStack() as stack:
        for name, simulator in open_simulators(batch, scene, stack).items():
            run, mount = simulator.run, requests.mounts[name]
            unmet = {(scene, name)}  # the estimates tell of it
            with reported_warnings(batch, scene, name, report, unmet):
                for request in spread:
                    setup = run.set_up(request.for_sonar(mount))
                    with run.drawing():
                        tried, plan = run.sampler.search.choose(setup)
                        has_echo = tried.echo.total > 0
                    decides = plan.worst_body_estimate / WORST_BODY > plan.error_estimate
                    body, n_samples = bodies[plan.worst_body * decides], plan.n_samples
                    place, state = (request.vehicle_pose @ mount)[:3, 3], setup.state
                    surface_z_m = setup.surface_z_m
                    around = body_around(scene_bodies, state.poses, state.present, place, surface_z_m)
                    found.append(
                        HardView(request.number, name, n_samples, plan.bound, body, has_echo, around)
                    )
    return found


def _spread_numbers(requests: BatchRequests, scene: int, count: int) -> list[int]:
    """Return the numbers of so many pings, or of all, spread evenly over those of a scene."""
    ranges = [run.numbers for run in requests.runs if run.scene == scene]
    starts = np.cumsum([0, *map(len, ranges)]).tolist()
    picked = np.unique(np.linspace(0, starts[-1] - 1, count).round().astype(int)).tolist()
    runs = [bisect_right(starts, index) - 1 for index in picked]
    return [ranges[run][index - starts[run]] for run, index in zip(runs, picked, strict=True)]
