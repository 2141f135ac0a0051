"""A batch from beginning to end: plan, parts, what is joined of them; begun, gone on with, checked."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field

from sonar_gl.batch.files import Folder
from sonar_gl.batch.finish import DONE
from sonar_gl.batch.job import PLACES, Job
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.maker import record_name
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.planned import Planned
from sonar_gl.batch.pool import Pool
from sonar_gl.batch.table import Columns
from sonar_gl.rigid import numbers_of
from sonar_gl.types import Error


@dataclass
class Outcome:
    """What became of a batch.

    Attributes
    ----------
    pings, made : of the job, and of these those that are stored
    set_aside : number of a ping to why
    without_echo : pings that brought nothing back
    """

    orders: Orders
    pings: int
    made: int = 0
    set_aside: dict = field(default_factory=dict)
    without_echo: int = 0

    def describe(self, number: int) -> str:
        """A ping that was set aside, by what makes it again."""
        order = self.orders[number]
        place = " ".join(f"{x:.9g}" for x in numbers_of(order.pose))
        job = self.orders.job
        return f"ping {number} of seed {job.seed}, vehicle at {place!r} in {job.scenes[order.scene]}"

    def add(self, record: dict) -> None:
        """A part is done."""
        self.made += record["pings"] - len(record["set_aside"])
        self.set_aside |= {int(n): why for n, why in record["set_aside"].items()}
        self.without_echo += record["without_echo"]

    @property
    def done(self) -> int:
        return self.made + len(self.set_aside)

    @property
    def is_whole(self) -> bool:
        return self.done == self.pings


def devices_of(workers: int | None, devices) -> list:
    """The EGL device of each process: those given in turn; of no workers as many as there are cores."""
    devices = list(devices) or [None]
    return [
        devices[k % len(devices)] for k in range(workers or max(len(os.sched_getaffinity(0)), len(devices)))
    ]


@contextmanager
def _stopped_by_ctrl_c(pool: Pool, tell):
    """The first Ctrl-C has the pool begin nothing more; the second ends it at once."""

    def stop(_signal, _frame):
        if pool.stopping:
            raise KeyboardInterrupt
        pool.stopping = True
        tell("finishing the pings in hand; Ctrl-C once more ends them")

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def records(folder: Folder, planned: Planned):
    """(part, record) of each part that is done."""
    there = set(folder.names("parts"))
    for part in range(planned.n_parts):
        if record_name(part).partition("/")[2] in there:
            yield part, folder.get_json(record_name(part))


def begin(job: Job, folder: Folder, resume: bool, pool: Pool, tell) -> Planned:
    """The plan of a job: a new one, or that which is there.

    Raises
    ------
    Error
        if a batch is there and is not to be gone on with, or is another one.
    """
    planned = Planned.load(folder)
    if planned is not None and not resume:
        cure = "go on with it by --resume, or give another folder"
        raise Error(f"{folder.url}: must hold no batch yet ({cure})")
    if planned is not None and planned.digest != job.digest:
        now = job.plain
        changed = [k for k in sorted({*now, *planned.job} - {*PLACES}) if now.get(k) != planned.job.get(k)]
        what = ", ".join(changed) or "the contents of a file that it names"
        raise Error(
            f"{folder.url}: a batch must be gone on with by the job that began it (changed: {what}; put that "
            "back, or give another folder)"
        )
    if planned is None:
        if folder.names(""):
            raise Error(f"{folder.url}: must be an empty folder, or one with a batch to --resume (got files)")
        tell("choosing the samples")
        planned = pool.ask("plan")
        pool.ask("create", planned)
        planned.save(folder)  # last: from here on there is something to go on with
    return planned


def run(job: Job, url: str, devices, resume: bool, tell, progress) -> Outcome:
    """Make all pings of a job that are not there yet, and join what is joined of them.

    Parameters
    ----------
    devices : of each process, of `devices_of`
    tell : function (text) that shows a line
    progress : function (pings, pings that are there) -> context manager of a function (pings more)
    """

    orders, folder = Orders(job), Folder(url)
    if job.ros is not None and not folder.is_local:
        raise Error(
            f"{job.where}: ros must be written to a folder of this machine (got {url!r}; leave it out)"
        )
    Kept(orders), Columns(orders)  # what is wrong with the job is told before anything is made
    with Pool(job.plain, folder.url, devices, tell) as pool:
        planned = begin(job, folder, resume, pool, tell)
        outcome, there = Outcome(orders, planned.n_pings), set()
        for part, record in records(folder, planned):
            outcome.add(record)
            there.add(part)
        missing = [part for part in range(planned.n_parts) if part not in there]
        if missing:
            with progress(planned.n_pings, outcome.done) as more, _stopped_by_ctrl_c(pool, tell):

                def done(record):
                    outcome.add(record)
                    more(record["pings"])

                pool.run(missing, planned.numbers, done)
        if outcome.is_whole and folder.get(DONE) is None:
            pool.ask("finish")
    return outcome


def dry_run(job: Job, devices, tell) -> str:
    """What a job would make, its size and the time that it takes, by a short trial."""
    orders = Orders(job)
    with tempfile.TemporaryDirectory() as url, Pool(job.plain, url, devices, tell) as pool:
        planned = pool.ask("plan")
        pool.ask("create", planned)
        trial = pool.ask("probe", planned)
    n, lines = planned.n_pings, []
    for scene, run in orders.runs():
        start_s, end_s = orders[run[0]].time_s, orders[run[-1]].time_s
        lines.append(f"pings {run[0]}..{run[-1]}: scene {job.scenes[scene]}, {start_s:g} to {end_s:g} s")
    for scene, (samplings, estimates) in enumerate(zip(planned.samplings, planned.estimates, strict=True)):
        for name, sampling in samplings.items():
            sonar = orders.sonars[name]
            size = f"{sonar.n_beams} beams x {sonar.n_bins} bins"
            samples = f"{sampling['columns_per_beam'] * sonar.n_beams:.0f} x {sampling['rows']} samples"
            error = f"error thought to be below {estimates[name]:.2g}"
            lines.append(f"{name} in {job.scenes[scene]}: {size}, {samples}, {error}")
    lines.append(f"{n} pings in {planned.n_parts} parts of {planned.pings_per_part}")
    lines.append(f"size: {_amount(n * trial['ping_bytes'])} ({trial['ping_bytes'] / 1e3:.0f} kB a ping)")
    alone_s = n * trial["ping_s"]
    lines.append(
        f"time: {_duration(alone_s)} in one process ({1e3 * trial['ping_s']:.1f} ms a ping, on "
        f"{planned.gl_renderer}), {_duration(alone_s / len(devices))} at best in {len(devices)}"
    )
    return "\n".join(lines)


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
