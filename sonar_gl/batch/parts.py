"""The steps of a batch in one process: begin it, create its store, make a part, finalize it."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import NamedTuple

import numpy as np

from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.manifest import (
    CHUNK_PINGS,
    DoneRecord,
    Manifest,
    PartRecord,
    default_pings_per_part,
    table_name,
)
from sonar_gl.batch.outputs import LabelledBins, make_outputs, try_outputs
from sonar_gl.batch.requests import BatchRequest, BatchRequests
from sonar_gl.batch.schema import Schema
from sonar_gl.batch.store import (
    MADE,
    SET_ASIDE,
    PingTable,
    SonarGroup,
    check_groups,
    consolidate,
    create_arrays,
    gather_ping_variables,
    rows_to_bytes,
    shared_files,
)
from sonar_gl.batch.system import System, processor
from sonar_gl.core.errors import Error, is_out_of_memory
from sonar_gl.core.warn import CollectedWarning, collected_warnings
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.sequence import make_pings
from sonar_gl.noise.noise import add_noise
from sonar_gl.ping import Ping
from sonar_gl.scene.extent import body_around
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sampling import WORST_BODY, ToleranceWarning

SURVEYED = 24  # pings of a scene, by a dry run
TRIES = 2  # of a ping that fails, before it is set aside

# A step reports its progress by calls of report(kind, value):
#   "sequence", number : pings from this one on are being made, several at once
#   "started", number  : this ping is being made, and no other
#   "finished", number : this ping is made
#   "warning", text
Report = Callable[[str, object], None]


def no_report(_kind: str, _value) -> None:
    """Report nothing."""


class Batch:
    """A job and the folder of its data set, as one process needs them. Call `close()` at the end.

    Parameters
    ----------
    job : Job
    folder : folder of the batch
    device : index of an EGL device, or None for the default
    any_system : make parts also with another engine, driver or libraries than those that began the batch

    Attributes
    ----------
    requests, schema, table : built once, and checked, as they load and hash every scene of the job

    Raises
    ------
    Error
        if the job is invalid, or Python cannot make its store.
    """

    def __init__(self, job: Job, folder: Folder, device: int | None = None, any_system: bool = False):
        self.folder, self.device, self.any_system = folder, device, any_system
        self.requests = BatchRequests(job)
        check_groups(len(self.requests.sonars))
        self.schema = Schema(self.requests)
        self.table = PingTable(self.requests)

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest in the folder, which must be there."""
        if (manifest := Manifest.load(self.folder)) is None:
            raise Error(f"{self.folder.url}: must hold the manifest of a batch (got none)")
        return manifest

    @cached_property
    def maker(self) -> PartMaker:
        """The maker of parts of this process, whose simulators stay open."""
        return PartMaker(self)

    def close(self) -> None:
        """Close the simulators."""
        if "maker" in vars(self):
            self.maker.close()


# ---- steps ------------------------------------------------------------------------------------------


def begin(batch: Batch, report: Report = no_report) -> Manifest:
    """Return the manifest of a new batch, with the engine, driver and libraries of this process.

    Raises Error if an output cannot be written here.
    """
    job, schema = batch.requests.job, batch.schema
    with ExitStack() as stack:
        system = System.of(next(iter(_open_simulators(batch, 0, stack).values())).gl_info)
    try_outputs(batch.requests, schema, batch.folder)
    n_pings = len(batch.requests)
    per_part = job.pings_per_part or default_pings_per_part(schema.bytes_per_ping, n_pings)
    made_of = schema.digest, n_pings, per_part, system, schema.files
    return Manifest(job.plain, *made_of, processor=processor())


def create_store(batch: Batch, report: Report = no_report) -> None:
    """Create the store, empty, as far as it does not exist; what is there of it is repaired."""
    schema, manifest, groups = batch.schema, batch.manifest, {}
    for name, sonar in batch.requests.sonars.items():
        groups[name] = SonarGroup(sonar, schema.arrays(name), schema.sonar_attributes(name))
    create_arrays(batch.folder, manifest, groups, schema.attributes(manifest))


def make_part(
    batch: Batch,
    part: int,
    set_aside: dict[int, str] | None = None,
    one_by_one: bool = False,
    report: Report = no_report,
) -> PartRecord:
    """Make a part, see `PartMaker.make`."""
    return batch.maker.make(part, set_aside, one_by_one, report)


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

    Attributes
    ----------
    seconds_per_ping, bytes_per_ping : means over the job
    numbers : of the pings, rising
    seen : of each scene and sonar; empty if the job stores no labels
    """

    seconds_per_ping: float
    bytes_per_ping: float
    numbers: tuple[int, ...]
    seen: list[SeenClasses]


def try_pings(batch: Batch, report: Report = no_report) -> DryRun:
    """Return what a ping costs, of about as many as a part has, spread over the job, and which classes are seen.

    The pings of each scene are made twice, as a part is made, since only the second time is typical: the first one
    opens the scene, and compiles. With labels, the first time there are SURVEYED at least, since few say little.
    """
    requests, folder = batch.requests, batch.folder
    n_scenes, n_part = len(requests.job.scenes), len(batch.manifest.numbers(0))
    # of each scene a chunk at least, since few pings have more than their share of what a part needs once
    n_each = min(n_part, max(CHUNK_PINGS, -(-n_part // n_scenes)))
    seconds, sizes, numbers, weights, seen = [], [], [], [], []
    for scene in range(n_scenes):
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
    return [_seen_classes(batch, scene, sonar, bins) for sonar, bins in labelled.counts.items()]


def _seen_classes(batch: Batch, scene: int, sonar: str, bins: list[np.ndarray]) -> SeenClasses:
    """Return in how many pings the classes are seen, given the bins of each class in each ping."""
    schema, counts, found = batch.schema, np.array(bins), []
    n_bodies = len(batch.requests.scene(scene).bodies)
    for number in sorted({*schema.scene_class_id(scene)[1 : 1 + n_bodies].tolist()} - {0}):
        where_seen = counts[counts[:, number] > 0, number]
        median = int(np.median(where_seen)) if len(where_seen) else 0
        found.append(SeenClass(schema.classes[number - 1], len(where_seen), median))
    return SeenClasses(scene, sonar, len(bins), sorted(found, key=lambda one: one.n_pings))


class HardView(NamedTuple):
    """What the view of a ping needs.

    Attributes
    ----------
    number : of the ping
    sonar : its name
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
    scene_bodies = requests.scene(scene).bodies
    bodies = ["", *(body.name for body in scene_bodies)]
    with ExitStack() as stack:
        for name, simulator in _open_simulators(batch, scene, stack).items():
            run, mount = simulator.run, requests.mounts[name]
            with _warnings_to(report, batch, scene, name):
                for request in spread:
                    setup = run.set_up(request.for_sonar(mount))
                    with run.drawing():
                        tried, plan = run.sampler.search.choose(setup)
                        has_echo = tried.echo.total > 0
                    decides = plan.worst_body_estimate / WORST_BODY > plan.error_estimate
                    body, n_samples = bodies[plan.worst_body * decides], plan.n_samples
                    place, state = (request.vehicle_pose @ mount)[:3, 3], setup.state
                    around = body_around(scene_bodies, state.poses, state.present, place)
                    found.append(
                        HardView(request.number, name, n_samples, plan.bound, body, has_echo, around)
                    )
    return found


@contextmanager
def _warnings_to(report: Report, batch: Batch, scene: int, sonar: str) -> Iterator[None]:
    """Report the warnings of a block, also if it fails, but not of tolerances: the estimates tell of these."""
    with collected_warnings() as found:
        try:
            yield
        finally:
            for warning in found:
                if not issubclass(warning.category, ToleranceWarning):
                    report("warning", _placed(warning, batch, scene, sonar))


def _placed(warning: CollectedWarning, batch: Batch, scene: int, sonar: str) -> str:
    """Return the text of a warning with the sonar and the scene of which it is."""
    return f"warning: {sonar} in {batch.requests.job.scenes[scene]}: {warning.text}"


def finalize(batch: Batch, report: Report = no_report) -> None:
    """Join the files of all parts, and write the file that says that the batch is complete."""
    requests, schema, manifest, folder = batch.requests, batch.schema, batch.manifest, batch.folder
    gather_ping_variables(requests, batch.table, manifest, folder)
    consolidate(folder)
    files = [name for output in make_outputs(requests, schema, folder) for name in output.join(manifest)]
    part_arrays = {array.name for sonar in requests.sonars for array in schema.arrays(sonar)}
    files += shared_files(folder, part_arrays)
    checksums = {name: folder.checksum(name) for name in sorted(files)}
    DoneRecord(manifest.n_parts, manifest.n_pings, checksums).save(folder)


# The steps by name, as pools and clusters run them: function (batch, *arguments, report).
STEPS = {
    "begin": begin,
    "create": create_store,
    "make": make_part,
    "try": try_pings,
    "survey": survey,
    "finalize": finalize,
}


def _spread_numbers(requests: BatchRequests, scene: int, count: int) -> list[int]:
    """Return the numbers of so many pings, or of all, spread evenly over those of a scene."""
    ranges = [run.numbers for run in requests.runs if run.scene == scene]
    starts = np.cumsum([0, *map(len, ranges)]).tolist()
    picked = np.unique(np.linspace(0, starts[-1] - 1, count).round().astype(int)).tolist()
    runs = [bisect_right(starts, index) - 1 for index in picked]
    return [ranges[run][index - starts[run]] for run, index in zip(runs, picked, strict=True)]


def _open_simulators(batch: Batch, scene: int, stack: ExitStack) -> dict[str, Simulator]:
    """Open a simulator for each sonar, all with one OpenGL context."""
    requests, shared, simulators = batch.requests, batch.requests.scene(scene), {}
    settings = {"tolerance": requests.job.tolerance, "device": batch.device}
    for name, sonar in requests.sonars.items():
        shared = simulators[name] = stack.enter_context(
            Simulator(shared, sonar, requests.acoustics, **settings)
        )
    return simulators


# ---- parts ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part:
    """A part that is being made.

    Attributes
    ----------
    numbers : numbers of its pings
    requests : their requests
    rows : (pings, width) rows of the ping table
    failed : number of each ping that is set aside -> why; grows
    one_by_one : whether each ping is reported before it is made
    """

    numbers: range
    requests: list[BatchRequest]
    rows: np.ndarray
    failed: dict[int, str]
    one_by_one: bool
    report: Report


class PartMaker:
    """Makes the parts of a batch. The simulators of the last scene stay open until `close()`.

    Raises
    ------
    Error
        from `make`, if OpenGL or a library is not that which began the batch, unless the batch allows it.
    """

    def __init__(self, batch: Batch):
        self._batch, self.folder, self._system = batch, batch.folder, None
        self.outputs = make_outputs(batch.requests, batch.schema, batch.folder, device=batch.device)
        self._stack, self._scene, self._simulators = ExitStack(), None, {}
        # scene and sonar of which it was said that a tolerance is not met
        self._unmet: set[tuple[int, str]] = set()

    def _simulators_of(self, scene: int) -> dict[str, Simulator]:
        """Return the simulators of a scene, one for each sonar."""
        if scene != self._scene:
            self.close()
            self._simulators = _open_simulators(self._batch, scene, self._stack)
            self._system = System.of(next(iter(self._simulators.values())).gl_info)
            if not self._batch.any_system:
                self._system.check(self._batch.manifest.system, self.folder.url)
            self._scene = scene  # last: after an error the next part is checked again
        return self._simulators

    def close(self) -> None:
        """Close the simulators."""
        self._stack.close()
        self._simulators, self._scene = {}, None

    def make(
        self,
        part: int,
        set_aside: dict[int, str] | None = None,
        one_by_one: bool = False,
        report: Report = no_report,
    ) -> PartRecord:
        """Make a part and write its files, the record last.

        Parameters
        ----------
        set_aside : numbers of pings to leave out -> why
        one_by_one : make and report each ping alone, so that it is known which one kills the process
        report : see `Report`

        Raises
        ------
        Error
            if every ping of the part fails for the same reason.
        OSError
            if a file cannot be written.
        """
        numbers = self._batch.manifest.numbers(part)
        requests = [self._batch.requests[number] for number in numbers]
        return self._make(part, self._task(requests, dict(set_aside or {}), one_by_one, report))

    def make_sample(self, numbers: list[int], report: Report = no_report) -> PartRecord:
        """Make these pings, no more than a part has, as if they were the first part, whose files they replace.

        They are numbered anew, so that the files are no data set, but as large as those of one.
        """
        requests = [replace(self._batch.requests[number], number=k) for k, number in enumerate(numbers)]
        return self._make(0, self._task(requests, {}, False, report))

    def _task(
        self, requests: list[BatchRequest], failed: dict[int, str], one_by_one: bool, report: Report
    ) -> _Part:
        """Return the part that has these requests, whose numbers follow one another."""
        numbers = range(requests[0].number, requests[-1].number + 1)
        rows = np.array([self._batch.table.row(request) for request in requests])
        return _Part(numbers, requests, rows, failed, one_by_one, report)

    def _make(self, part: int, task: _Part) -> PartRecord:
        """Make a part and write its files, the record last."""
        batch, numbers, any_left_out = self._batch, task.numbers, bool(task.failed)
        for output in self.outputs:
            output.begin(part, numbers)
        for scene, run in groupby(task.requests, lambda request: request.scene):
            run = list(run)
            for sonar in batch.requests.sonars:
                for request, ping in self._pings(task, scene, sonar, run):
                    self._store(task, request, sonar, ping)
        reasons = set(task.failed.values())
        if len(task.failed) == len(numbers) > 1 and not any_left_out and len(reasons) == 1:
            raise Error(f"no ping of part {part} could be made ({reasons.pop()})")
        return self._finish(part, task)

    def _store(self, task: _Part, request: BatchRequest, sonar: str, ping: Ping) -> None:
        """Give a ping to the outputs, and enter its numbers into the table."""
        table, row = self._batch.table, task.rows[request.number - task.numbers[0]]
        table.column(row, "status")[:] = MADE
        table.column(row, ("has_echo", sonar))[:] = ping.meta["has_echo"]
        table.column(row, ("echo", sonar))[:] = ping.intensity.sum(dtype=np.float64)
        table.column(row, ("error_estimate", sonar))[:] = ping.error_estimate
        samples = ping.meta["sampling"]
        table.column(row, ("sampling", sonar))[:] = samples["columns_per_beam"], samples["rows"]
        noise_seed = self._batch.requests.noise_seed(sonar)
        noisy = add_noise(ping, request.noise, noise_seed, request.number)
        # the gain without noise is found once for all outputs
        quiet = replace(ping, sonar=replace(ping.sonar, counts=ping.counts_law()))
        for output in self.outputs:
            output.add(request, sonar, noisy, quiet)

    def _finish(self, part: int, task: _Part) -> PartRecord:
        """Write what is left of a part's files, and its record."""
        table, rows, first = self._batch.table, task.rows, task.numbers[0]
        for number in task.failed:
            table.column(rows[number - first], "status")[:] = SET_ASIDE
        files = [name for output in self.outputs for name in output.end()]
        files.append(table_name(part))
        self.folder.put(files[-1], rows_to_bytes(rows))
        has_echo = [table.column(rows, ("has_echo", sonar)) == 1 for sonar in self._batch.requests.sonars]
        is_silent = (table.column(rows, "status") == MADE) & ~np.any(has_echo, axis=0)
        manifest = self._batch.manifest
        record = PartRecord(
            manifest.identity,
            part,
            first,
            len(task.numbers),
            {str(number): why for number, why in sorted(task.failed.items())},
            int(is_silent.sum()),
            {file: self.folder.checksum(file) for file in files},
            None if self._system in (None, manifest.system) else asdict(self._system),
        )
        record.save(self.folder)
        return record

    def _pings(
        self, task: _Part, scene: int, sonar: str, requests: list[BatchRequest]
    ) -> Iterator[tuple[BatchRequest, Ping]]:
        """Yield the pings of consecutive requests in one scene. Those that fail are added to task.failed."""
        run, mount = self._simulators_of(scene)[sonar].run, self._batch.requests.mounts[sonar]
        table = self._batch.requests.job.labels
        labels = {} if table is None else {"labels": True, "label_level_db": table.level_db}
        background = self._batch.schema.background(scene)

        def for_sonar(request: BatchRequest) -> PingRequest:
            return request.for_sonar(mount, background=background, **labels)

        remaining = deque(request for request in requests if request.number not in task.failed)
        if remaining and not task.one_by_one:
            task.report("sequence", remaining[0].number)
            pings = make_pings(run, map(for_sonar, list(remaining)))
            try:
                while remaining:
                    yield remaining[0], self._report_warnings(lambda: next(pings), task, scene, sonar)
                    task.report("finished", remaining.popleft().number)
            except Exception as why:  # of one of several pings; made alone, the one shows
                if isinstance(why, OSError) or is_out_of_memory(why):
                    raise
                pings.close()
        for request in remaining:
            ping = self._make_alone(task, request, sonar, lambda r: make_ping(run, for_sonar(r)))
            if ping is not None:
                yield request, ping
                task.report("finished", request.number)

    def _make_alone(
        self, task: _Part, request: BatchRequest, sonar: str, make: Callable[[BatchRequest], Ping]
    ) -> Ping | None:
        """Make a ping, in several tries. Return None after the last, with the reason in task.failed."""
        reason = ""
        for _ in range(TRIES):
            task.report("started", request.number)
            try:
                return self._report_warnings(lambda: make(request), task, request.scene, sonar)
            except Exception as why:
                if isinstance(why, OSError) or is_out_of_memory(why):
                    raise
                kind = "" if isinstance(why, Error) else f"{type(why).__name__}: "
                reason = f"{kind}{why}"
        task.failed[request.number] = reason
        return None

    def _report_warnings(self, make: Callable[[], Ping], task: _Part, scene: int, sonar: str) -> Ping:
        """Make a ping and report its warnings, but not that it has no echo, which the table says.

        That a tolerance is not met is said once for each scene and sonar: the estimates tell of which pings.
        No warning names its ping, since in a sequence it may be one that is made ahead.
        """
        with collected_warnings() as found:
            try:
                return make()
            finally:  # also if it fails: the next try does not warn of what a simulator says once
                for warning in found:
                    self._report_warning(warning, task, scene, sonar)

    def _report_warning(self, warning: CollectedWarning, task: _Part, scene: int, sonar: str) -> None:
        if issubclass(warning.category, NoEchoWarning):
            return
        text = _placed(warning, self._batch, scene, sonar)
        if issubclass(warning.category, ToleranceWarning):
            if (scene, sonar) in self._unmet:
                return
            self._unmet.add((scene, sonar))
            text += "; this is said once, error_estimate of the arrays tells of each ping"
        task.report("warning", text)
