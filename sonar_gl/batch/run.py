"""A batch from beginning to end: begin or resume it, make its parts, finalize it."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

from sonar_gl.batch.cluster import Cluster
from sonar_gl.batch.folder import DamagedRecordError, Folder
from sonar_gl.batch.job import LOCATION_KEYS, Job
from sonar_gl.batch.job_warnings import job_warnings
from sonar_gl.batch.manifest import (
    MANIFEST_NAME,
    DoneRecord,
    Manifest,
    PartRecord,
    discard_damaged,
    part_records,
    recorded_parts,
)
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.pool import Pool
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.cores import count_cores
from sonar_gl.core.errors import Error, some_names
from sonar_gl.core.poses import pose_numbers
from sonar_gl.core.signals import REPEAT_S


@dataclass
class Outcome:
    """The state of a batch.

    n_made : pings in the store
    set_aside : number of each ping that could not be made -> why
    without_echo : pings without an echo
    """

    requests: BatchRequests
    n_pings: int
    n_made: int = 0
    set_aside: dict[int, str] = field(default_factory=dict)
    without_echo: int = 0

    def describe(self, number: int) -> str:
        """Return what is needed to make a ping again: number, seed, pose and scene."""
        request, job = self.requests[number], self.requests.job
        pose = " ".join(f"{x:.9g}" for x in pose_numbers(request.vehicle_pose))
        return f"ping {number} of seed {job.seed}, vehicle at {pose!r} in {job.scenes[request.scene]}"

    def add(self, record: PartRecord) -> None:
        """Count the pings of a finished part."""
        self.n_made += record.pings - len(record.set_aside)
        self.set_aside |= {int(number): why for number, why in record.set_aside.items()}
        self.without_echo += record.without_echo

    @property
    def n_done(self) -> int:
        return self.n_made + len(self.set_aside)

    @property
    def is_complete(self) -> bool:
        return self.n_done == self.n_pings


def devices_of(workers: int | None, devices) -> list[int | None]:
    """Return the EGL device of each process.

    workers : number of processes; None is one for each core that this process may use
    devices : devices that the processes take in turn; empty for the default device
    """
    devices = list(devices) or [None]
    count = workers or max(count_cores(), len(devices))
    return [devices[k % len(devices)] for k in range(count)]


@dataclass(frozen=True)
class RunSettings:
    """How a batch is run.

    resume : continue a batch that is in the folder
    mend : compare checksums, make parts with damaged files again, and write the manifest again if it is damaged
    any_system : make parts also with other OpenGL or libraries than those that began the batch
    cluster : address of a Dask scheduler whose workers make the parts; None uses processes of this machine
    """

    resume: bool = False
    mend: bool = False
    any_system: bool = False
    cluster: str | None = None


def run(
    job: Job,
    url: str,
    devices: list[int | None],
    report: Callable[[str], None],
    progress: Callable,
    settings: RunSettings = RunSettings(),
) -> Outcome:
    """Make all pings of a job that are not in the folder yet, and finalize the batch.

    Raises Error if the job or the folder is unsuitable, or parts cannot be made; MachineError if processes die again
    and again.

    devices : EGL device of each process, see `devices_of`
    progress : function (pings in all, pings done) -> context manager of a function (further pings)
    """
    folder = Folder(url, create=False)
    if "memory" in folder.fs.protocol:
        raise Error(f"{url}: must be a folder that other processes see (got the memory of this one)")
    if job.ros is not None and not folder.is_local:
        raise Error(f"{job.where}: ros must be written to a folder of this machine (got {url!r})")
    requests = BatchRequests(job)
    warnings = list(job_warnings(requests))
    batch = Batch(requests, folder)  # finds what is wrong with the job before anything is made
    for text in warnings:
        report(text)
    folder.create()
    any_system = settings.any_system
    with folder.locked(), Pool(job.plain, folder.url, devices, report, any_system) as pool:
        remote = None
        if settings.cluster is not None:
            remote = Cluster(settings.cluster, job, folder.url, any_system)
        workers = pool if remote is None else remote
        manifest = _begin(batch, settings, workers.call, report)
        if settings.mend:
            discard_damaged(folder, manifest, report)
        outcome, finished = Outcome(requests, manifest.n_pings), set()
        for record in part_records(folder, manifest):
            outcome.add(record)
            finished.add(record.part)
        if outcome.is_complete and DoneRecord.load(folder) is not None:
            return outcome
        workers.call("create")  # the batch may have been stopped before or during it
        missing = [part for part in range(manifest.n_parts) if part not in finished]
        if missing:
            with progress(manifest.n_pings, outcome.n_done) as advance:
                _make_parts(missing, manifest.numbers, pool, remote, report, outcome, advance)
        if outcome.is_complete:
            pool.call("finalize")
    return outcome


def _begin(batch: Batch, settings: RunSettings, call: Callable, report: Callable[[str], None]) -> Manifest:
    """Return the manifest in the folder, or make a new one.

    Raises Error if there is a batch that shall not be resumed, or one of another job, or other files.
    """
    folder = batch.folder
    finished = _finished_batches(folder) if settings.mend else set()
    try:
        manifest = Manifest.load(folder)
    except DamagedRecordError:
        if not finished:
            raise
        manifest = None
    if manifest is not None:
        if not settings.resume:
            cure = "continue it by --resume, or give another folder"
            raise Error(f"{folder.url}: must hold no batch yet ({cure})")
        _check_is_of_job(manifest, batch)
        return manifest
    if finished:
        report(f"{folder.path(MANIFEST_NAME)}: is missing or damaged: writing it again")
        manifest = call("begin")
        if finished != {manifest.identity}:
            raise Error(
                f"{folder.url}: {MANIFEST_NAME} must be written again by the job, OpenGL and libraries that began the "
                "batch (got others than those of the finished parts; restore these, or give another folder)"
            )
    else:
        if any(not name.startswith(".") for name in folder.names("")):  # unfinished files begin with a dot
            is_cut = settings.resume and _finished_batches(folder)
            known = f"there is no {MANIFEST_NAME}; --resume --mend makes it again" if is_cut else "got files"
            raise Error(f"{folder.url}: must be an empty folder, or one with a batch to --resume ({known})")
        if settings.resume:
            report("there is no batch yet: beginning one")
        manifest = call("begin")
    manifest.save(folder)  # from now on the batch can be resumed
    return manifest


def _check_is_of_job(manifest: Manifest, batch: Batch) -> None:
    """Raise an Error if a manifest is of another job, or of other files."""
    if manifest.digest == batch.requests.scenes.digest:
        return
    now, then = batch.requests.job.plain, manifest.job
    changed = [key for key in sorted({*now, *then} - {*LOCATION_KEYS}) if now.get(key) != then.get(key)]
    changed += manifest.changed_files(batch.requests.scenes.files)
    what = some_names(changed) if changed else "the contents of a file, of the job or of a scene"
    raise Error(
        f"{batch.folder.url}: a batch must be resumed with the job that began it (changed: {what}; restore "
        "that, or give another folder)"
    )


def _finished_batches(folder: Folder) -> set[str]:
    """Return the batches of the finished parts whose records can be read; of an undamaged batch it is one."""
    found = set()
    for part in recorded_parts(folder):
        with suppress(DamagedRecordError):
            found.add(PartRecord.load(folder, part).batch)
    return found


def _make_parts(
    parts: list[int],
    numbers: Callable,
    pool: Pool,
    remote: Cluster | None,
    report: Callable[[str], None],
    outcome: Outcome,
    advance: Callable[[int], None],
) -> None:
    """Make parts and add them to the outcome: by a cluster, if there is one, and what it leaves by processes.

    numbers : of the pings of a part, see `Manifest.numbers`
    advance : function (further pings)
    """

    def done(record):
        outcome.add(record)
        advance(record.pings)

    if remote is not None:
        parts = remote.run_parts(parts, done, report)
    with _stop_on_signals(pool, report):
        pool.run_parts(parts, numbers, done, one_by_one=remote is not None)


@contextmanager
def _stop_on_signals(pool: Pool, report: Callable[[str], None]):
    """Let the first SIGINT or SIGTERM stop the pool after the parts in progress; a later one ends it."""
    stopped_s = -math.inf

    def stop(_signal, _frame):
        nonlocal stopped_s
        if time.monotonic() < stopped_s + REPEAT_S:
            return
        if pool.stopping:
            raise KeyboardInterrupt
        pool.stopping, stopped_s = True, time.monotonic()
        report("finishing the parts in progress; Ctrl-C again stops them")

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
