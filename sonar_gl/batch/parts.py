"""A batch in one process, and its maker of parts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np

from sonar_gl.batch.folder import Folder
from sonar_gl.batch.manifest import Manifest, PartRecord, table_name
from sonar_gl.batch.outputs import make_outputs
from sonar_gl.batch.ping_table import MADE, SET_ASIDE, PingTable, rows_to_bytes
from sonar_gl.batch.requests import BatchRequest, BatchRequests
from sonar_gl.batch.schema import Schema
from sonar_gl.batch.store import check_groups
from sonar_gl.batch.system import System
from sonar_gl.core.errors import Error, is_out_of_memory
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.sequence import make_pings
from sonar_gl.noise.noise import add_noise
from sonar_gl.ping import Ping
from sonar_gl.scene.extent import AirWarning, InsideWarning
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sampling import ToleranceWarning

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

    Raises Error if the job is invalid, or Python cannot make its store.

    device : index of an EGL device, or None for the default
    any_system : make parts also with another engine, driver or libraries than those that began the batch
    schema, table : built once, and checked; for them every scene of the job is read
    """

    def __init__(
        self, requests: BatchRequests, folder: Folder, device: int | None = None, any_system: bool = False
    ):
        self.requests, self.folder, self.device, self.any_system = requests, folder, device, any_system
        check_groups(len(requests.sonars))
        self.schema, self.table = Schema(requests), PingTable(requests)

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


def open_simulators(batch: Batch, scene: int, stack: ExitStack) -> dict[str, Simulator]:
    """Open a simulator for each sonar, all with one OpenGL context."""
    requests, shared, simulators = batch.requests, batch.requests.scenes[scene], {}
    tolerance, device = requests.job.tolerance, batch.device
    for name, sonar in requests.sonars.items():
        shared = simulators[name] = stack.enter_context(
            Simulator(shared, sonar, requests.acoustics, tolerance=tolerance, device=device)
        )
        device = None  # the engine of the first draws for all
    return simulators


@contextmanager
def reported_warnings(
    batch: Batch, scene: int, sonar: str, report: Report, unmet: set[tuple[int, str]]
) -> Iterator[None]:
    """Report the warnings of a block, also if it fails: the next try does not warn of what a simulator says once.

    No warning names its ping, since in a sequence it may be one that is made ahead. That a ping has no echo is not
    reported: the table says it. Nor is a sonar in a body, of which `job_warnings.place_warnings` tells: a simulator
    looks at its own first ping, and which one that is depends on the number of processes. For the same reason a sonar
    in the air is reported without its height.

    unmet : scene and sonar of which it was said that a tolerance is not met, since it is said once; grows
    """
    place = f"warning: {sonar} in {batch.requests.job.scenes[scene]}: "
    with collected_warnings() as found:
        try:
            yield
        finally:
            for warning in found:
                text = place + warning.text
                if issubclass(warning.category, NoEchoWarning | InsideWarning):
                    continue
                if issubclass(warning.category, AirWarning):
                    text = f"{place}the sonar is above the water's surface in some pings, on which it has no effect"
                if issubclass(warning.category, ToleranceWarning):
                    if (scene, sonar) in unmet:
                        continue
                    unmet.add((scene, sonar))
                    text += "; this is said once, error_estimate of the arrays tells of each ping"
                report("warning", text)


@dataclass(frozen=True)
class _Part:
    """A part that is being made.

    rows : (pings, width) rows of the ping table
    failed : number of each ping that is set aside -> why; grows
    one_by_one : whether each ping is reported before it is made
    """

    numbers: range
    rows: np.ndarray
    failed: dict[int, str]
    one_by_one: bool
    report: Report


class PartMaker:
    """Makes the parts of a batch. The simulators of the last scene stay open until `close()`.

    Raises Error from `make`, if OpenGL or a library is not that which began the batch, unless the batch allows it.
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
            self._simulators = open_simulators(self._batch, scene, self._stack)
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

        Raises Error if every ping of the part fails for the same reason; OSError if a file cannot be written.

        set_aside : numbers of pings to leave out -> why
        one_by_one : make and report each ping alone, so that it is known which one kills the process
        """
        numbers = self._batch.manifest.numbers(part)
        requests = [self._batch.requests[number] for number in numbers]
        return self._make(part, requests, dict(set_aside or {}), one_by_one, report)

    def make_sample(self, numbers: list[int], report: Report) -> PartRecord:
        """Make these pings, no more than a part has, as if they were the first part, whose files they replace.

        They are numbered anew, so that the files are no data set, but as large as those of one.
        """
        requests = [replace(self._batch.requests[number], number=k) for k, number in enumerate(numbers)]
        return self._make(0, requests, {}, False, report)

    def _make(
        self,
        part: int,
        requests: list[BatchRequest],
        failed: dict[int, str],
        one_by_one: bool,
        report: Report,
    ) -> PartRecord:
        """Make the part that has these requests, whose numbers follow one another."""
        batch, numbers = self._batch, range(requests[0].number, requests[-1].number + 1)
        rows, any_left_out = np.array([batch.table.row(request) for request in requests]), bool(failed)
        task = _Part(numbers, rows, failed, one_by_one, report)
        for output in self.outputs:
            output.begin(part, numbers)
        for scene, run in groupby(requests, lambda request: request.scene):
            run = list(run)
            for sonar in batch.requests.sonars:
                for request, ping in self._pings(task, scene, sonar, run):
                    self._store(task, request, sonar, ping)
        reasons = set(failed.values())
        if len(failed) == len(numbers) > 1 and not any_left_out and len(reasons) == 1:
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
                    with reported_warnings(self._batch, scene, sonar, task.report, self._unmet):
                        ping = next(pings)
                    yield remaining[0], ping
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
                with reported_warnings(self._batch, request.scene, sonar, task.report, self._unmet):
                    return make(request)
            except Exception as why:
                if isinstance(why, OSError) or is_out_of_memory(why):
                    raise
                kind = "" if isinstance(why, Error) else f"{type(why).__name__}: "
                reason = f"{kind}{why}"
        task.failed[request.number] = reason
        return None
