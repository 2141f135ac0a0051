"""Interrupts (Ctrl-C) at chosen lines of sonar_gl, and actions of a small scene to interrupt.

python -m tests.support.interrupts          # every line of every action, many minutes; prints a table
python -m tests.support.interrupts NAME     # of one action
"""

from __future__ import annotations

import faulthandler
import sys
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.ping import BIN_LABELS

PACKAGE = str(Path(sg.__file__).parent)
SONAR = sg.Sonar("narrow", 900e3, 4, 30, 20.0, 10.0, 3.0, 0.5, 10.0)
BALL = trimesh.creation.icosphere(1, 0.4)
BOX = trimesh.creation.box((1, 1, 1))
POSES = [sg.pose(0.1 + 0.3 * k, 0.02 * k, 0.3, 0, 0.1, 0.01 * k) for k in range(5)]
MOVED = {"box": sg.pose(4, -0.2, 0.1)}
MOTION = [None, MOVED, None, {"box": None}, MOVED]
MORE = (
    sg.Body("ball", BALL, sg.pose(4, 0.3, 0.2), 0.9, np.asarray(BALL.vertices, np.float32)),
    sg.Body("cube", trimesh.creation.box((0.5, 0.5, 0.5)), sg.pose(4, -0.3, 0.2), np.linspace(0.1, 1, 12)),
)
FIELDS = ("intensity", *BIN_LABELS, "body_echo")
HANG_S = 1800
Place = tuple[str, int]


class Interrupter:
    """Notes the lines of sonar_gl that this thread runs in a `with` block, and interrupts one of them.

    Finalisers are left out, since Python prints and drops whatever they raise.

    Parameters
    ----------
    at : KeyboardInterrupt is raised before the line of this number, or at this place for the first time; None: never

    Attributes
    ----------
    places : (file, line) of each so far
    """

    def __init__(self, at: int | Place | None = None):
        self.places, self._at, self._is_finalising = [], at, False

    def _enter(self, frame, _event, _argument):
        if not frame.f_code.co_filename.startswith(PACKAGE):
            return None
        if frame.f_code.co_name == "__del__":
            self._is_finalising = True
            return self._finalise
        return None if self._is_finalising else self._step

    def _finalise(self, _frame, event, _argument):
        self._is_finalising = event != "return"
        return self._finalise

    def _step(self, frame, event, _argument):
        if event == "line":
            place = frame.f_code.co_filename[len(PACKAGE) + 1 :], frame.f_lineno
            self.places.append(place)
            if self._at in (len(self.places) - 1, place):
                sys.settrace(None)
                raise KeyboardInterrupt
        return self._step

    def __enter__(self):
        sys.settrace(self._enter)
        return self

    def __exit__(self, *_):
        sys.settrace(None)


def contents(ping) -> tuple:
    """Return the bytes of a ping's fields, and how it was sampled."""
    arrays = (getattr(ping, field) for field in FIELDS)
    return (*(None if array is None else array.tobytes() for array in arrays), str(ping.meta["sampling"]))


class Action(NamedTuple):
    """Something that a simulator does.

    Attributes
    ----------
    settings : of the simulator
    do : function (simulator), to be interrupted
    look : function (simulator) -> what the simulator makes afterwards
    alters : `look` may differ before and after `do`
    closes : afterwards the simulator is closed
    """

    settings: dict
    do: Callable
    look: Callable
    alters: bool = False
    closes: bool = False


def _ping(**options) -> tuple[Callable, Callable]:
    def make(simulator):
        return [contents(simulator.ping(POSES[0], **options))]

    return make, make


def _pings(**options) -> tuple[Callable, Callable]:
    def make(simulator):
        return [contents(ping) for ping in simulator.pings(POSES, **options)]

    return make, make


def _actions() -> dict[str, Action]:
    ideal, paths = sg.Acoustics.ideal(), sg.Acoustics.physical(multipath="incoherent")
    fixed = {"acoustics": ideal, "sampling": sg.Sampling(1, 8)}
    adaptive = {"acoustics": ideal, "tolerance": 0.3}
    with_paths = {"acoustics": paths, "sampling": sg.Sampling(1, 8)}
    both = {"acoustics": paths, "tolerance": 0.5}
    shadow = {"labels": True, "background": ["floor"]}
    look = _ping(labels=True)[0]
    noise = {"noise": sg.Noise.physical(), "seed": 3}
    return {
        "ping": Action(fixed, *_ping()),
        "ping with labels": Action(fixed, *_ping(**shadow)),
        "ping with noise": Action(fixed, *_ping(**noise)),
        "ping with moved bodies": Action(fixed, *_ping(bodies=MOVED, labels=True)),
        "ping by tolerance": Action(adaptive, *_ping(labels=True)),
        "ping with multipath": Action(with_paths, *_ping()),
        "ping with multipath by tolerance": Action(both, *_ping()),
        "pings": Action(fixed, *_pings()),
        "pings with labels and moving bodies": Action(fixed, *_pings(bodies=MOTION, labels=True)),
        "pings by tolerance": Action(adaptive, *_pings(bodies=MOTION)),
        "pings with labels by tolerance": Action(adaptive, *_pings(bodies=MOTION, labels=True)),
        "pings with multipath": Action(with_paths, *_pings()),
        "plan": Action(adaptive, lambda it: it.plan(POSES[:2]), look, alters=True),
        "plan with multipath": Action(both, lambda it: it.plan(POSES[:2]), look, alters=True),
        "add": Action(fixed, lambda it: it.add(*MORE), look, alters=True),
        "place": Action(fixed, lambda it: it.place(MOVED), look, alters=True),
        "close": Action(fixed, lambda it: it.close(), look, closes=True),
    }


ACTIONS = _actions()


def make_simulator(settings: dict, world=None):
    """Return a simulator, in the world of another one if there is one."""
    floor = sg.Body("floor", trimesh.creation.box((20, 20, 1)), sg.pose(5, 0, -1.5), 0.3)
    box = sg.Body("box", BOX, sg.pose(5, 0.2, 0), 0.8)
    return sg.Simulator(world or sg.Scene([floor, box], surface_z_m=2.0), SONAR, **settings)


class Findings(NamedTuple):
    """What interrupts of an action have done.

    Attributes
    ----------
    places : (file, line) of all lines that the action runs, in order
    n_interrupts : how many of them were interrupted
    faults : for each that left something wrong, where, and what
    """

    places: list[Place]
    n_interrupts: int
    faults: list[str]


def every_line(places: list[Place]) -> Iterable[int]:
    """Return the numbers of all lines."""
    return range(len(places))


def interrupt(action: Action, choose: Callable = every_line) -> Findings:
    """Interrupt an action of a new simulator, once at each chosen line, and look what the simulator does then.

    It must make the same bytes as one that was not interrupted, or raise an Error; and the action repeated must do
    what it does without an interrupt.

    Parameters
    ----------
    choose : function (places of all lines) -> numbers or places of those to interrupt. What the two threads of a
        simulator share out may differ the next time: a line that does not come is passed over
    """
    # what is done to the scene is done to all simulators of a world, so that only some may share one
    shares = not (action.alters and "tolerance" not in action.settings) and not action.closes
    world = make_simulator(action.settings)

    def fresh():
        return make_simulator(action.settings, world if shares else None)

    def run(simulator, at=None):
        with Interrupter(at) as interrupter:
            action.do(simulator)
        return interrupter.places

    with fresh() as simulator:
        before = action.look(simulator)
    with fresh() as simulator:
        places = run(simulator)
        after = None if action.closes else action.look(simulator)
    faults, n_interrupts = [], 0
    for at in choose(places):
        simulator, where = fresh(), places[at] if isinstance(at, int) else at
        try:
            run(simulator, at)
        except KeyboardInterrupt:
            n_interrupts += 1
        else:
            simulator.close()
            continue
        try:
            seen = None if action.alters else after
            if action.alters or action.closes:
                try:
                    seen = action.look(simulator)
                except sg.Error:
                    if action.alters:
                        raise
                if seen not in ((before, after) if action.alters else (before, None)):
                    faults.append(f"{where}: other bytes")
            if not (action.alters and seen == after and seen != before):
                action.do(simulator)
            if action.closes:
                continue
            if action.look(simulator) != after:
                faults.append(f"{where}: other bytes when repeated")
        except sg.Error as why:
            faults.append(f"{where}: Error {why}")
        except Exception as why:
            faults.append(f"{where}: {type(why).__name__} {why}")
        finally:
            simulator.close()
    world.close()
    return Findings(places, n_interrupts, faults)


def main() -> None:
    """Interrupt every line of all actions, or of those named."""
    warnings.simplefilter("ignore")
    for name in sys.argv[1:] or ACTIONS:
        start = perf_counter()
        faulthandler.dump_traceback_later(HANG_S, exit=True)
        found = interrupt(ACTIONS[name])
        counts = f"{len(found.places)} lines, {found.n_interrupts} interrupts, {len(found.faults)} faults"
        print(f"{name}: {counts}, {perf_counter() - start:.0f} s", *found.faults, sep="\n    ", flush=True)


if __name__ == "__main__":
    main()
