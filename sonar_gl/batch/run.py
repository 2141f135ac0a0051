"""A batch from beginning to end: plan, parts, what is joined of them; begun, gone on with, checked."""

from __future__ import annotations

import json
import os
import signal
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

from sonar_gl.batch.cluster import check_installed, run_on_cluster
from sonar_gl.batch.files import Folder
from sonar_gl.batch.job import PLACES, Job
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.planned import DONE, Planned, record_name
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
def _stopped_by_signals(pool: Pool, tell):
    """The first Ctrl-C, or SIGTERM of a queue, has the pool begin nothing more; the second ends it."""

    def stop(_signal, _frame):
        if pool.stopping:
            raise KeyboardInterrupt
        pool.stopping = True
        tell("finishing the pings in hand; Ctrl-C once more ends them")

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def records(folder: Folder, planned: Planned):
    """(part, record) of each part that is done; an Error for what is no record."""
    there = set(folder.names("parts"))
    for part in range(planned.n_parts):
        if record_name(part).partition("/")[2] in there:
            record = folder.get_json(record_name(part))
            if not isinstance(record, dict) or not {"pings", "set_aside", "without_echo"} <= record.keys():
                raise Error(
                    f"{folder.path(record_name(part))}: must tell of a part (it is damaged; delete it)"
                )
            yield part, record


def begin(job: Job, digest: str, folder: Folder, resume: bool, ask, tell) -> Planned:
    """The plan of a job: a new one, or that which is there.

    digest : of `Kept`
    ask : function (command, *arguments) that has a process do it, see `Work`

    Raises
    ------
    Error
        if a batch is there and is not to be gone on with, or is another one.
    """
    planned = Planned.load(folder)
    if planned is not None and not resume:
        cure = "go on with it by --resume, or give another folder"
        raise Error(f"{folder.url}: must hold no batch yet ({cure})")
    if planned is not None and planned.digest != digest:
        now = job.plain
        changed = [k for k in sorted({*now, *planned.job} - {*PLACES}) if now.get(k) != planned.job.get(k)]
        what = ", ".join(changed) or "what is in a file, of the job or of a scene"
        raise Error(
            f"{folder.url}: a batch must be gone on with by the job that began it (changed: {what}; put that "
            "back, or give another folder)"
        )
    if planned is None:
        if any(not name.startswith(".") for name in folder.names("")):  # such as what was torn
            raise Error(f"{folder.url}: must be an empty folder, or one with a batch to --resume (got files)")
        tell("nothing is there yet: choosing the samples" if resume else "choosing the samples")
        planned = ask("plan")
        planned.save(folder)  # from here on there is something to go on with
    return planned


def run(job: Job, url, devices, resume: bool, tell, progress, cluster=None, mend=False) -> Outcome:
    """Make all pings of a job that are not there yet, and join what is joined of them.

    Parameters
    ----------
    devices : of each process, of `devices_of`
    tell : function (text) that shows a line
    progress : function (pings, pings that are there) -> context manager of a function (pings more)
    cluster : address of a Dask scheduler, whose workers make the parts; None has processes here do so
    mend : compare checksums, and make parts again whose files are damaged
    """
    orders, folder = Orders(job), Folder(url)
    if "memory" in folder.fs.protocol:
        raise Error(f"{url}: must be a folder that other processes see (got memory of this one)")
    if job.ros is not None and not folder.is_local:
        raise Error(f"{job.where}: ros must be written to a folder of this machine (got {url!r})")
    kept, _ = Kept(orders), Columns(orders)  # what is wrong with the job is told before anything is made
    with folder.locked(), Pool(job.plain, folder.url, devices, tell) as pool:
        away = None if cluster is None else Away(cluster, job, folder.url)
        ask = pool.ask if away is None else away.ask
        planned = begin(job, kept.digest(), folder, resume, ask, tell)
        if mend:
            from sonar_gl.batch.finish import forget_damage  # with all that makes films

            forget_damage(folder, planned, tell)
        outcome, there = Outcome(orders, planned.n_pings), set()
        for part, record in records(folder, planned):
            outcome.add(record)
            there.add(part)
        if not there or mend:
            ask("create")  # again, if it was not done when the batch was stopped
        missing = [part for part in range(planned.n_parts) if part not in there]
        if missing:
            with progress(planned.n_pings, outcome.done) as more:

                def done(record):
                    outcome.add(record)
                    more(record["pings"])

                if away is not None:
                    missing = away.run(missing, done, tell)
                with _stopped_by_signals(pool, tell):
                    pool.run(missing, planned.numbers, done, one_by_one=away is not None)
        if outcome.is_whole and folder.get(DONE) is None:
            pool.ask("finish")
    return outcome


class Away:
    """The workers of a cluster, which do what a pool's processes do.

    Parameters
    ----------
    address : of a Dask scheduler
    """

    def __init__(self, address: str, job: Job, url: str):
        check_installed()
        self.address, self._made_of = address, (json.dumps(job.plain), url)

    def _work(self, command: str, *arguments):
        from sonar_gl.batch.work import on_cluster  # with all that makes pings: workers need it

        return partial(on_cluster, *self._made_of, command, arguments)

    def ask(self, command: str, *arguments):
        """What a worker makes of a method of `Work`."""
        found = []
        run_on_cluster(
            self.address,
            self._work(command, *arguments),
            [0],
            lambda _part, result: found.append(result),
            lambda _part, why: found.append(Error(f"workers must live (at {command!r} {why})")),
        )
        if isinstance(found[0], Error):
            raise found[0]
        return found[0]

    def run(self, parts, done, tell) -> list[int]:
        """Have parts made; those that workers died of, or all that are left after Ctrl-C none."""
        died = []

        def killed(part, why):
            tell(f"part {part}: {why}; it is made here, ping by ping")
            died.append(part)

        made = {}

        def made_once(part, record):  # after a death a part may be told of twice
            if part not in made:
                made[part] = True
                done(record)

        try:
            run_on_cluster(self.address, self._work("part"), parts, made_once, killed)
        except KeyboardInterrupt:
            return []
        return died
