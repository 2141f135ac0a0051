"""Processes of this machine that make parts, one at a time each. A process that dies is replaced."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait

from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.manifest import PartRecord
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.steps import STEPS
from sonar_gl.core.cores import count_cores, limit_threads
from sonar_gl.core.errors import RAISE_FILE_LIMIT, Error, MachineError, is_out_of_memory
from sonar_gl.core.load_numba import load_numba
from sonar_gl.core.warn import collected_warnings, warn_caller

IN_PROGRESS = 9  # pings after the last finished one that a sequence may be at: two of its batches and one
STALL_S = 900.0  # a process that is silent for longer is taken to hang
MAX_DEATHS = 2  # at a ping, after which it is set aside
MAX_UNEXPLAINED_DEATHS = 5  # at one part while no ping was being made
MAX_DEATHS_IN_STEP = 3  # of processes that begin, create or finalize
LAST_WARNINGS = 100  # none of which is passed on once more
# The software driver, like other libraries, would otherwise use all cores in every process.
ONE_THREAD = ("LP_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# A killed process leaks resources, which the tracker frees; its warning would only confuse.
NO_LEAK_WARNING = {"PYTHONWARNINGS": "ignore::UserWarning:multiprocessing.resource_tracker"}


# ---- in the process that makes parts ----------------------------------------------------------------


def serve(
    pipe: Connection,
    n_threads: int,
    job: dict,
    url: str,
    device: int | None,
    any_system: bool,
    is_dry_run: bool,
) -> None:
    """Run the steps that come through a pipe until None comes or the pipe closes.

    In: the name of one of `steps.STEPS`, and its arguments. Out: (kind, value) for all that the step reports,
    and at its end ("of files", text) for each warning of what it has read, and ("result", value), or ("error",
    text) for an Error, a failed write and everything else.
    """
    # the pool decides when to stop; queues signal all processes
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _die_with_parent()
    limit_threads(n_threads)
    batch = None

    def report(kind, value):
        pipe.send((kind, value))

    while (command := _receive(pipe)) is not None:
        with collected_warnings() as found:  # of files, which this process would show in a form of its own
            try:
                if batch is None:
                    load_numba()
                    batch = Batch(BatchRequests(Job(**job)), Folder(url), device, any_system)
                name, *arguments = command
                message = "result", STEPS[name](batch, *arguments, report=report)
            except BaseException as why:
                message = "error", _describe_failure(why, url, is_dry_run)
        try:
            for warning in found:
                pipe.send(("of files", warning.text))
            pipe.send(message)
        except OSError:  # the pool has gone
            return


def _describe_failure(why: BaseException, url: str, is_dry_run: bool) -> str:
    """Return the text of an error; only for a mistake in the code it is more than a sentence."""
    if is_out_of_memory(why):
        again = "try again" if is_dry_run else "continue with --resume"
        cure = f"have fewer --workers, or ask for fewer beams, bins or pixels, and {again}"
        return f"memory ran out ({why or type(why).__name__}); {cure}"
    if isinstance(why, Error):
        return str(why)
    if isinstance(why, OSError):
        cure = "set TMPDIR to another folder for temporary files" if is_dry_run else "continue with --resume"
        if why.errno == errno.EMFILE:
            cure = RAISE_FILE_LIMIT if is_dry_run else f"{RAISE_FILE_LIMIT}, and {cure}"
        return f"{why.filename or url}: {why.strerror or why}; {cure}"
    return f"a part could not be made:\n{''.join(traceback.format_exception(why))}"


def _receive(pipe: Connection):
    """Return the next message, or None if the pipe is closed."""
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return None


def _die_with_parent() -> None:
    """End this process as soon as its parent ends: the next batch may be making the same part."""
    parent = multiprocessing.parent_process()

    def end_after_parent():
        parent.join()
        os._exit(1)

    threading.Thread(target=end_after_parent, daemon=True).start()


# ---- in the process that runs the batch -------------------------------------------------------------


@dataclass
class Task:
    """A part to be made.

    one_by_one : whether each ping is made alone, so that it is known which one kills a process
    set_aside : numbers of pings to leave out -> why
    deaths : number of a ping -> deaths of processes at it; None counts deaths at no ping
    """

    part: int
    one_by_one: bool = False
    set_aside: dict[int, str] = field(default_factory=dict)
    deaths: dict[int | None, int] = field(default_factory=dict)

    def count_death(self, pings: list[int]) -> None:
        """Count the death of a process that was making one of these pings, or none."""
        for number in pings or [None]:
            self.deaths[number] = self.deaths.get(number, 0) + 1
        if len(pings) == 1 and self.deaths[pings[0]] >= MAX_DEATHS:
            self.set_aside[pings[0]] = f"the process that made it died, {MAX_DEATHS} times"
        self.one_by_one = True


@contextmanager
def _environment_of_children():
    """Set what child processes inherit: one thread for each library, and no Ctrl-C, which the pool handles."""
    settings = dict.fromkeys(ONE_THREAD, "1") | NO_LEAK_WARNING
    before = {key: os.environ.get(key) for key in settings}
    os.environ.update(settings)
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, interrupt)
        for key, value in before.items():
            os.environ.pop(key) if value is None else os.environ.update({key: value})


class Process:
    """One process of a pool; its arguments are those of `serve`, but for the pipe.

    task : what it is making, or None
    pings : numbers of pings of which it may be making one
    """

    def __init__(self, *arguments):
        context = multiprocessing.get_context("spawn")  # a fork would share the parent's OpenGL
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, *arguments), daemon=True)
        with _environment_of_children():
            self._process.start()
        theirs.close()
        self.pid = self._process.pid
        self.task, self.pings, self._last_message_s = None, range(0), time.monotonic()

    @property
    def handles(self) -> list:
        """What `wait` takes to wait for a message or for the end of the process."""
        return [self._pipe, self._process.sentinel]

    def send(self, task: Task | None, name: str, *arguments) -> None:
        """Have it run a step."""
        self.task, self.pings, self._last_message_s = task, range(0), time.monotonic()
        with suppress(OSError):  # a dead process shows in `has_died`
            self._pipe.send((name, *arguments))

    def messages(self) -> Iterator[tuple[str, object]]:
        """Yield (kind, value) of the messages that have come, except those about its progress."""
        try:
            while self._pipe.poll():
                kind, value = self._pipe.recv()
                self._last_message_s = time.monotonic()
                if kind == "started":
                    self.pings = range(value, value + 1)
                elif kind == "sequence":
                    self.pings = range(value, value + IN_PROGRESS)
                elif kind == "finished":
                    is_sequence = len(self.pings) > 1
                    self.pings = range(value + 1, value + 1 + IN_PROGRESS) if is_sequence else range(0)
                else:
                    yield kind, value
        except (EOFError, OSError):
            return

    def is_alive(self) -> bool:
        return self._process.is_alive()

    def has_died(self) -> bool:
        """Return whether it is dead or hangs."""
        return not self.is_alive() or time.monotonic() - self._last_message_s > STALL_S

    def end(self) -> str:
        """Kill it, and say how it ended. Finished parts are stored; nothing else matters."""
        self._process.kill()
        self._process.join()
        self._pipe.close()
        code = self._process.exitcode
        return f"exit code {code}" if code >= 0 else signal.Signals(-code).name


class Pool:
    """A pool of processes that run the steps of a batch. Use it in a `with` block, which ends them all.

    devices : index of the EGL device of each process, or None for the default
    is_dry_run : whether the folder is a temporary one, of which errors do not say that it can be resumed
    stopping : if set, no more parts are begun
    processes : place in the pool -> its process
    """

    def __init__(
        self,
        job: dict,
        url: str,
        devices: list[int | None],
        warn: Callable[[str], None],
        any_system: bool = False,
        is_dry_run: bool = False,
    ):
        # more threads than cores take turns, and overwrite what another has in fast memory
        n_threads = max(1, count_cores() // len(devices))
        self._arguments = [(n_threads, job, url, device, any_system, is_dry_run) for device in devices]
        self._again = "" if is_dry_run else " by --resume"
        self.processes: dict[int, Process] = {}
        self.warn, self.stopping = warn, False
        self._warned = deque(maxlen=LAST_WARNINGS)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self.processes.values():
            process.end()

    def call(self, name: str, *arguments):
        """Run one of `steps.STEPS` in a process, and return its result. If it dies, another takes its place.

        Raises Error if the step fails; MachineError if processes die of it again and again.
        """
        for death in range(1, MAX_DEATHS_IN_STEP + 1):
            process, is_dead = self._living_process(0), False
            process.send(None, name, *arguments)
            while not is_dead:
                wait(process.handles, timeout=1.0)
                is_dead = not process.is_alive()  # asked before its last messages are read
                for kind, value in process.messages():
                    if kind == "result":
                        return value
                    self._handle(kind, value)
            ending = process.end()
            if death < MAX_DEATHS_IN_STEP:
                self.warn(f"a process died in the step {name!r} ({ending}); another takes its place")
        raise MachineError(
            f"processes must live (the step {name!r} ended {MAX_DEATHS_IN_STEP} of them, the last by {ending}; "
            f"is memory short? 'sonar-gl doctor' may say why; try again{self._again})"
        )

    def run_parts(
        self,
        parts: Iterable[int],
        numbers: Callable[[int], range],
        done: Callable[[PartRecord], None],
        one_by_one: bool = False,
    ) -> None:
        """Make parts.

        Raises Error if a step fails, such as for a full disk, MachineError if processes die of a part again and again;
        both after the parts in progress are finished.

        numbers : function (part) -> numbers of its pings
        done : called with the record of each part as it is done
        one_by_one : make each ping alone from the beginning, not only after a death
        """
        new, again, failure = (Task(part, one_by_one) for part in parts), deque(), None
        while True:
            for place in range(len(self._arguments)):
                self._assign(place, again, new)
            busy = [process for process in self.processes.values() if process.task is not None]
            if not busy:
                break
            wait([handle for process in busy for handle in process.handles], timeout=1.0)
            for process in busy:
                has_died = process.has_died()  # asked before its last messages are read
                try:
                    for kind, value in process.messages():
                        if kind == "result":
                            process.task = None
                            done(value)
                        else:
                            self._handle(kind, value)
                    if has_died and process.task is not None:
                        again.append(self._take_task_back(process, numbers))
                except Error as why:
                    failure, self.stopping, process.task = why, True, None
        if failure is not None:
            raise failure

    def _living_process(self, place: int) -> Process:
        """Return the process at a place in the pool, a new one if it is dead."""
        process = self.processes.get(place)
        if process is None or not process.is_alive():
            process = self.processes[place] = Process(*self._arguments[place])
        return process

    def _assign(self, place: int, again: deque, new: Iterator[Task]) -> None:
        """Give the process at a place a task, if it has none and there is one."""
        process = self.processes.get(place)
        if self.stopping or (process is not None and process.task is not None):
            return
        if (task := again.popleft() if again else next(new, None)) is not None:
            step = "make", task.part, task.set_aside, task.one_by_one
            self._living_process(place).send(task, *step)

    def _handle(self, kind: str, value) -> None:
        """Pass on a warning, or raise an error, that a process reports."""
        if kind == "warning":
            if value not in self._warned:  # other processes, and other steps, have simulators of their own
                self._warned.append(value)
                self.warn(value)
        elif kind == "of files":
            warn_caller(value)  # which a command shows once, whatever the number of processes
        else:
            raise Error(value)

    def _take_task_back(self, process: Process, numbers: Callable[[int], range]) -> Task:
        """Return the task of a dead process, to be made again ping by ping."""
        task, ending = process.task, process.end()
        process.task = None
        task.count_death([number for number in process.pings if number in numbers(task.part)])
        if task.deaths.get(None, 0) >= MAX_UNEXPLAINED_DEATHS:
            raise MachineError(
                f"processes must live (part {task.part} ended {MAX_UNEXPLAINED_DEATHS} of them at no ping, "
                f"the last by {ending}; is memory short? 'sonar-gl doctor' may say why; try again by --resume)"
            )
        self.warn(f"a process died at part {task.part} ({ending}); another takes its place")
        return task
