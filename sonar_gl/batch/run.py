"""A batch from beginning to end: begin or resume it, make its parts, finalize it; and a dry run."""

from __future__ import annotations

import signal
import tempfile
import threading
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np

from sonar_gl.batch.cluster import Cluster
from sonar_gl.batch.folder import DamagedRecordError, Folder
from sonar_gl.batch.job import LOCATION_KEYS, Job
from sonar_gl.batch.manifest import (
    MANIFEST_NAME,
    DoneRecord,
    Manifest,
    PartRecord,
    discard_damaged,
    part_records,
    recorded_parts,
)
from sonar_gl.batch.parts import Batch, HardView, SeenClasses
from sonar_gl.batch.pool import Pool
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.cores import count_cores
from sonar_gl.core.errors import Error, some_names
from sonar_gl.core.poses import pose_numbers
from sonar_gl.scene.extent import other_unit_text
from sonar_gl.scene.scene import Scene

# of each scene and sonar, a dry run names so many
HARDEST = 3  # views
RAREST = 10  # classes


@dataclass
class Outcome:
    """The state of a batch.

    Attributes
    ----------
    requests : the requests of the job
    n_pings : number of pings of the job
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

    Attributes
    ----------
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

    Parameters
    ----------
    url : folder of the batch
    devices : EGL device of each process, see `devices_of`
    report : function that shows a line of text
    progress : function (pings in all, pings done) -> context manager of a function (further pings)

    Raises
    ------
    Error
        if the job or the folder is unsuitable, or parts cannot be made.
    MachineError
        if processes die again and again.
    """
    folder = Folder(url, create=False)
    if "memory" in folder.fs.protocol:
        raise Error(f"{url}: must be a folder that other processes see (got the memory of this one)")
    if job.ros is not None and not folder.is_local:
        raise Error(f"{job.where}: ros must be written to a folder of this machine (got {url!r})")
    batch = Batch(job, folder)  # finds what is wrong with the job before anything is made
    for text in (*batch.requests.device_warnings(), *batch.requests.hull_warnings()):
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
        outcome, finished = Outcome(batch.requests, manifest.n_pings), set()
        for record in part_records(folder, manifest):
            outcome.add(record)
            finished.add(record.part)
        if outcome.is_complete and DoneRecord.load(folder) is not None:
            return outcome
        workers.call("create")  # the batch may have been stopped before or during it
        missing = [part for part in range(manifest.n_parts) if part not in finished]
        if missing:
            with progress(manifest.n_pings, outcome.n_done) as advance:

                def done(record):
                    outcome.add(record)
                    advance(record.pings)

                if remote is not None:
                    missing = remote.run_parts(missing, done, report)
                with _stop_on_signals(pool, report):
                    pool.run_parts(missing, manifest.numbers, done, one_by_one=remote is not None)
        if outcome.is_complete:
            pool.call("finalize")
    return outcome


def _begin(batch: Batch, settings: RunSettings, call: Callable, report: Callable[[str], None]) -> Manifest:
    """Return the manifest in the folder, or make a new one.

    Raises
    ------
    Error
        if there is a batch that shall not be resumed, or one of another job, or other files.
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
    if manifest.digest == batch.schema.digest:
        return
    now, then = batch.requests.job.plain, manifest.job
    changed = [key for key in sorted({*now, *then} - {*LOCATION_KEYS}) if now.get(key) != then.get(key)]
    changed += manifest.changed_files(batch.schema.files)
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


@contextmanager
def _stop_on_signals(pool: Pool, report: Callable[[str], None]):
    """Let the first SIGINT or SIGTERM stop the pool after the parts in progress; the second ends it."""

    def stop(_signal, _frame):
        if pool.stopping:
            raise KeyboardInterrupt
        pool.stopping = True
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


# ---- dry run ----------------------------------------------------------------------------------------


def dry_run(job: Job, devices: list, report: Callable[[str], None]) -> str:
    """Make some pings of a job in a temporary folder, and return a text on the job's size and time."""
    requests = BatchRequests(job)
    for text in (*requests.device_warnings(), *requests.hull_warnings()):
        report(text)
    with (
        tempfile.TemporaryDirectory() as url,
        Pool(job.plain, url, devices, report, is_dry_run=True) as pool,
    ):
        manifest = pool.call("begin")
        manifest.save(Folder(url))
        pool.call("create")
        tried = pool.call("try")
        surveys = [pool.call("survey", scene) for scene in range(len(job.scenes))]
    n, lines = manifest.n_pings, []
    for run in requests.runs:
        first, last = run.numbers[0], run.numbers[-1]
        start_s, end_s = requests[first].time_s, requests[last].time_s
        lines.append(f"pings {first}..{last}: scene {job.scenes[run.scene]}, {start_s:g} to {end_s:g} s")
    for scene, name in enumerate(job.scenes) if job.changes_scenes else ():
        lines.append(f"scene {name}: {_contents_text(requests.scene(scene))}")
    for scene, views in enumerate(surveys):
        for name, sonar in requests.sonars.items():
            size = f"{name} in {job.scenes[scene]}: {sonar.n_beams} beams x {sonar.n_bins} bins"
            lines += _views_text(size, [view for view in views if view.sonar == name], requests)
            lines += [_seen_text(one) for one in tried.seen if (one.scene, one.sonar) == (scene, name)]
        if text := other_unit_text(requests.scene(scene)):
            report(f"warning: {job.scenes[scene]}: {text}")
    parts = "1 part" if manifest.n_parts == 1 else f"{manifest.n_parts} parts of {manifest.pings_per_part}"
    lines.append(f"{n} pings in {parts}")
    size = _amount(n * tried.bytes_per_ping)
    lines.append(f"size: {size} ({tried.bytes_per_ping / 1e3:.0f} kB a ping)")
    one_s, processes = n * tried.seconds_per_ping, min(len(devices), manifest.n_parts)
    best_s = _busiest_pings(manifest, processes) * tried.seconds_per_ping
    lines.append(
        f"speed: {1 / tried.seconds_per_ping:.3g} pings a second in one process ({1e3 * tried.seconds_per_ping:.1f} ms "
        f"a ping, on {manifest.system.gl_renderer}; measured on this machine by "
        f"{_numbers_text(tried.numbers)}, after all was compiled)"
    )
    lines.append(
        f"time: {_duration(one_s)} for all pings in one process, {_duration(best_s)} at best in {processes}, if each "
        "has as many cores"
    )
    return "\n".join(lines)


def _numbers_text(numbers: tuple[int, ...]) -> str:
    """Return a text that names pings spread over a job.

    >>> _numbers_text((0, 9)), _numbers_text((0, 3, 5, 8, 11))
    ('pings 0, 9', '5 pings spread over the job: 0, 3, 5, .., 11')
    """
    if len(numbers) < 5:
        return f"{'pings' if len(numbers) > 1 else 'ping'} {', '.join(map(str, numbers))}"
    first = ", ".join(map(str, numbers[:3]))
    return f"{len(numbers)} pings spread over the job: {first}, .., {numbers[-1]}"


def _busiest_pings(manifest: Manifest, processes: int) -> float:
    """Return how many pings one of these processes makes at least, since a part is made by one process.

    >>> manifest = Manifest({}, "", 20, 8, None, {})
    >>> [_busiest_pings(manifest, processes) for processes in (1, 2, 3)]
    [20.0, 10.0, 8]
    """
    return max(manifest.n_pings / processes, min(manifest.n_pings, manifest.pings_per_part))


def _views_text(size: str, views: list[HardView], requests: BatchRequests) -> list[str]:
    """Return lines on the samples that the views of a sonar need, and on those that need most."""
    counts = sorted(view.n_samples for view in views)
    middle = counts[len(counts) // 2]
    lines = [f"{size}, {counts[0]} to {counts[-1]} samples a ping, median {middle}, of {len(views)} pings"]
    hardest = sorted(views, key=lambda view: -view.n_samples)[:HARDEST]
    for view in hardest if counts[-1] > counts[0] else ():
        pose = _pose_text(requests[view.number].vehicle_pose)
        why = f"body {view.body!r}" if view.body else "the whole ping"
        lines.append(
            f"  ping {view.number}, vehicle at {pose}: {view.n_samples} samples for {why}, estimated error "
            f"{view.error_estimate:.2g}"
        )
    silent = [view for view in views if not view.has_echo]
    if silent:
        first, verb = silent[0], "has" if len(silent) == 1 else "have"
        pose = requests[first.number].vehicle_pose @ requests.mounts[first.sonar]
        lines.append(
            f"  {len(silent)} of these {len(views)} pings {verb} no echo, such as ping {first.number}, sonar at "
            f"{_pose_text(pose)} ('sonar-gl render --pose' says why)"
        )
    enclosed = [view for view in views if view.around]
    if enclosed:
        first, verb = enclosed[0], "has" if len(enclosed) == 1 else "have"
        pose = requests[first.number].vehicle_pose @ requests.mounts[first.sonar]
        lines.append(
            f"  {len(enclosed)} of these {len(views)} pings {verb} the sonar in a body or below a floor, such as ping "
            f"{first.number}, sonar at {_pose_text(pose)}, in or below {first.around!r}"
        )
    return lines


def _seen_text(seen: SeenClasses) -> str:
    """Return a line on how often the classes are seen.

    >>> from sonar_gl.batch.parts import SeenClass
    >>> _seen_text(SeenClasses(0, "p900_45", 16, [SeenClass("diver", 0, 0), SeenClass("box", 9, 210)]))
    '  labels of 16 pings, with the median of their bins: diver in none, box in 9 (210)'
    """
    texts = [
        f"{one.name} in {one.n_pings} ({one.median_bins})" if one.n_pings else f"{one.name} in none"
        for one in seen.classes
    ]
    more = f", and {len(texts) - RAREST} more" if len(texts) > RAREST else ""
    rarest = ", ".join(texts[:RAREST]) or "no class"
    return f"  labels of {seen.n_pings} pings, with the median of their bins: {rarest}{more}"


def _pose_text(pose: np.ndarray) -> str:
    """Return a pose as --pose takes it."""
    return repr(" ".join(f"{x + 0.0:.4g}" for x in pose_numbers(pose)))


def _contents_text(scene: Scene) -> str:
    """Return what is in a scene: its bodies, plumes, and water's surface."""
    names = ", ".join(entry.name for entry in scene.bodies_and_plumes)
    surface = "" if scene.surface_z_m is None else f"; the water's surface at z = {scene.surface_z_m:g} m"
    return names + surface


def _amount(size: float) -> str:
    for unit in ("kB", "MB", "GB"):
        size /= 1000
        if size < 1000:
            return f"{size:.3g} {unit}"
    return f"{size / 1000:.3g} TB"


def _duration(seconds: float) -> str:
    for unit, length in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} seconds"
