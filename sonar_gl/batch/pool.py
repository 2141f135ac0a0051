"""Processes that make parts: each at one part at a time, replaced when it dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait

from sonar_gl.batch.worker import serve
from sonar_gl.types import Error

IN_HAND = 9  # pings that a sequence may be at after the last that it gave, two batches and one
STALL_S = 900.0  # without a word, after which a process is taken for hung
DEATHS = 2  # at a ping, after which it is set aside
GIVE_UP = 5  # deaths at one part that no ping is to blame for
# Of a process: the software driver would take all cores for each, and so would libraries.
ONE_THREAD = ("LP_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Of a process that was killed: what it holds is taken back, and there is nothing to be told.
QUIET = {"PYTHONWARNINGS": "ignore::UserWarning:multiprocessing.resource_tracker"}


@contextmanager
def _inherited():
    """What a process that starts here finds: one thread for libraries, and no Ctrl-C, which is the pool's."""
    settings = dict.fromkeys(ONE_THREAD, "1") | QUIET
    before = {key: os.environ.get(key) for key in settings}
    os.environ.update(settings)
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, interrupt)
        for key, value in before.items():
            os.environ.pop(key) if value is None else os.environ.update({key: value})


@dataclass
class Task:
    """A part to be made.

    set_aside : numbers of pings to leave out, and why; deaths : of processes, at each ping, and at None
    """

    part: int
    one_by_one: bool = False
    set_aside: dict = field(default_factory=dict)
    deaths: dict = field(default_factory=dict)

    def died(self, pings) -> None:
        """A process died of one of these pings; of something else if there are none."""
        for n in pings or [None]:
            self.deaths[n] = self.deaths.get(n, 0) + 1
        if len(pings) == 1 and self.deaths[pings[0]] >= DEATHS:
            self.set_aside[pings[0]] = f"the process that made it died, {DEATHS} times"
        self.one_by_one = True


class Process:
    """One process of a pool.

    Attributes
    ----------
    task : what it is at, or None
    pings : numbers that it may be at
    heard_s : when it was heard of last
    """

    def __init__(self, *made_of):
        spawning = multiprocessing.get_context("spawn")  # a fork would share the parent's OpenGL
        self.made_of = made_of
        self.pipe, theirs = spawning.Pipe()
        self.process = spawning.Process(target=serve, args=(theirs, *made_of), daemon=True)
        with _inherited():
            self.process.start()
        theirs.close()
        self.task, self.pings, self.heard_s = None, range(0), time.monotonic()

    def send(self, task, *command):
        """Have it do something."""
        self.task, self.pings, self.heard_s = task, range(0), time.monotonic()
        with suppress(OSError):  # if it is dead `has_died` tells
            self.pipe.send(command)

    def heard(self):
        """Messages that it has sent."""
        try:
            while self.pipe.poll():
                word, value = self.pipe.recv()
                self.heard_s = time.monotonic()
                if word == "before":
                    self.pings = range(value, value + 1)
                elif word == "from":
                    self.pings = range(value, value + IN_HAND)
                elif word == "after":
                    several = len(self.pings) > 1
                    self.pings = range(value + 1, value + 1 + IN_HAND) if several else range(0)
                else:
                    yield word, value
        except (EOFError, OSError):
            return

    def has_died(self) -> bool:
        """Whether it has, or hangs."""
        return not self.process.is_alive() or time.monotonic() - self.heard_s > STALL_S

    def end(self) -> int:
        """End it, as it always ends: what it has made is stored, all else goes; its exit code."""
        self.process.kill()
        self.process.join()
        self.pipe.close()
        return self.process.exitcode


class Pool:
    """Makes parts of a job in several processes. Use it in a `with` block, which leaves none behind.

    Parameters
    ----------
    job : as plain values; url : of the folder
    devices : index of the EGL device of each process, or None for the default one
    warn : function (text)

    Attributes
    ----------
    stopping : set it to have no more parts begun
    """

    def __init__(self, job: dict, url: str, devices, warn):
        self._made_of = [(job, url, device) for device in devices]
        self._processes: dict[int, Process] = {}
        self.warn, self.stopping = warn, False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self._processes.values():
            process.end()

    def ask(self, *command):
        """What a process makes of one of the commands of `worker.serve`, however long that takes."""
        process = self._at(0)
        process.send(None, *command)
        while True:
            wait([process.pipe, process.process.sentinel], timeout=1.0)
            died = not process.process.is_alive()  # before the last it said is heard
            for word, value in process.heard():
                if word == "done":
                    return value
                self._take(word, value)
            if died:
                raise Error(
                    f"a process must live (it ended with exit code {process.end()}, at {command[0]!r}; "
                    "'sonar-gl doctor' may say why)"
                )

    def run(self, parts, numbers, done, one_by_one: bool = False) -> None:
        """Make parts.

        Parameters
        ----------
        parts : which, rising
        numbers : function (part) -> range of its pings
        done : function (record), called as each is done
        one_by_one : at once, not only after a death

        Raises
        ------
        Error
            for a user's mistake, or when files cannot be written; parts in hand are finished first.
        """
        fresh, again, refused = (Task(part, one_by_one) for part in parts), deque(), None
        while True:
            for place in range(len(self._made_of)):
                self._employ(place, again, fresh)
            busy = [process for process in self._processes.values() if process.task is not None]
            if not busy:
                break
            wait([end for p in busy for end in (p.pipe, p.process.sentinel)], timeout=1.0)
            for process in busy:
                died = process.has_died()
                try:
                    for word, value in process.heard():
                        if word == "done":
                            process.task = None
                            done(value)
                        else:
                            self._take(word, value)
                    if died and process.task is not None:
                        again.append(self._bury(process, numbers))
                except Error as why:
                    refused, self.stopping, process.task = why, True, None
        if refused is not None:
            raise refused

    def _at(self, place: int) -> Process:
        """The process of a place, alive."""
        here = self._processes.get(place)
        if here is None or not here.process.is_alive():
            here = self._processes[place] = Process(*self._made_of[place])
        return here

    def _employ(self, place: int, again, fresh):
        """Give the process of a place something to do, if there is something."""
        here = self._processes.get(place)
        if self.stopping or (here is not None and here.task is not None):
            return
        if (task := again.popleft() if again else next(fresh, None)) is not None:
            self._at(place).send(task, "part", task.part, task.set_aside, task.one_by_one)

    def _take(self, word, value):
        """A message that is no result."""
        if word == "warning":
            self.warn(value)
        else:
            raise Error(value)

    def _bury(self, process: Process, numbers) -> Task:
        """What a dead process was at, to be done again ping by ping."""
        task, code = process.task, process.end()
        process.task = None
        task.died([n for n in process.pings if n in numbers(task.part)])
        if task.deaths.get(None, 0) >= GIVE_UP:
            raise Error(
                f"processes must live (part {task.part} ended {GIVE_UP} of them at no ping, the last with "
                f"exit code {code}; is memory short? 'sonar-gl doctor' may say why)"
            )
        self.warn(f"a process died at part {task.part} (exit code {code}); another takes its place")
        return task
