#!/usr/bin/env python
"""Times the pings of one of the hosts in examples/, each beside one of a standalone Simulator.

    python tools/bench_host.py pyrender_host FOLDER     # where its pictures go

Prints a line for each door: its number, and the medians of its milliseconds, of those of a standalone
Simulator of the same scene, samples and arguments, and of the ratio of the two, timed in turns while the host
runs. The standalone one has a thread of its own, for a context of GLX lets no other be current beside it.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from time import perf_counter

import numpy as np

import sonar_gl as sg
from sonar_gl import embed

PINGS, ROUNDS = 3, 12  # of an example that are timed, and how often
FRAMES = {"window_host": {"frames": 60}}  # of those that have no end
DOORS = {
    "1": (sg.Simulator, "ping"),
    "3": (embed.Sensor, "ping_from_textures"),
    "4": (embed.Sensor, "ping_from_depth"),
}


def timed(ping, *arguments, **keywords) -> float:
    """Milliseconds."""
    start = perf_counter()
    ping(*arguments, **keywords)
    return 1e3 * (perf_counter() - start)


class Clock:
    """Takes the place of what pings, and times that, beside `alone` where a Simulator has pinged before."""

    def __init__(self, example):
        self.pool, self.alone, self.again = ThreadPoolExecutor(1), None, None
        self.times = {door: [] for door in "1234"}
        for door, (owner, name) in DOORS.items():
            setattr(owner, name, self.wrap(door, getattr(owner, name)))
        if hasattr(example, "draw_ping"):  # all from its sectors to the ping
            example.draw_ping = self.wrap("2", example.draw_ping)

    def wrap(self, door, plain):
        """The function, timed."""

        def ping(*arguments, **keywords):
            out = plain(*arguments, **keywords)
            if door == "1":
                it, *given = arguments
                if self.alone is None:
                    self.make_alone(it.scene, it.sonar, out)
                self.again = given, keywords
            for _ in range(ROUNDS if len(self.times[door]) < PINGS * ROUNDS else 0):
                own = timed(plain, *arguments, **keywords)
                self.times[door].append((own, self.time_alone() if self.alone else np.nan))
            return out

        self.pings = getattr(self, "pings", {}) | {door: plain}
        return ping

    def make_alone(self, scene, sonar, ping):
        """A standalone simulator with the samples of a ping, in the other thread."""
        sampling = sg.Sampling(**ping.meta["sampling"])
        self.alone = self.pool.submit(sg.Simulator, scene, sonar, sampling=sampling).result()

    def time_alone(self) -> float:
        """Milliseconds of its ping, made as the host made its last one."""
        given, keywords = self.again
        return self.pool.submit(timed, self.pings["1"], self.alone, *given, **keywords).result()

    def finish(self, found):
        """Time the standalone one now, where the host had no Simulator to go by."""
        if self.alone is None:
            ping = found["texture_ping"]
            self.make_alone(found["scene"], found["sonar"], ping)
            self.again = (found["pose"],), {"bodies": found.get("bodies"), "labels": ping.body_id is not None}
            self.time_alone()
            for times in self.times.values():
                times[:] = [(own, self.time_alone()) for own, _ in times]
        self.pool.submit(self.alone.close).result()


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", help="of a file in examples/")
    parser.add_argument("folder", help="where its pictures go")
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
    example = import_module(options.name)
    clock = Clock(example)
    clock.finish(example.main(options.folder, **FRAMES.get(options.name, {})))
    for door, times in clock.times.items():
        if times:
            own, alone = np.array(times).T
            numbers = np.median(own), np.median(alone), np.median(own / alone)
            print("door", door, *(f"{number:.4g}" for number in numbers))


if __name__ == "__main__":
    main()
