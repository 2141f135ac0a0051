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
FRAMES = {"window_host": 60}  # of those that have no end
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
    """Takes the place of the methods that ping, and times them beside `alone`."""

    def __init__(self):
        self.pool, self.alone, self.again = ThreadPoolExecutor(1), None, None
        self.times = {door: [] for door in DOORS}
        for door, (owner, name) in DOORS.items():
            setattr(owner, name, self.wrap(door, getattr(owner, name)))

    def wrap(self, door, plain):
        """The method, timed."""

        def ping(it, *arguments, **keywords):
            out = plain(it, *arguments, **keywords)
            if door == "1" and self.alone is None:
                self.again = plain, arguments, keywords
                made_of = it.scene, it.sonar, it.acoustics, sg.Sampling(**out.meta["sampling"])
                self.alone = self.pool.submit(sg.Simulator, *made_of).result()
            if door == "1":
                self.again = plain, arguments, keywords
            if self.alone and len(self.times[door]) < PINGS * ROUNDS:
                method, given, named = self.again
                for _ in range(ROUNDS):
                    own = timed(plain, it, *arguments, **keywords)
                    alone = self.pool.submit(timed, method, self.alone, *given, **named).result()
                    self.times[door].append((own, alone, own / alone))
            return out

        return ping


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", help="of a file in examples/")
    parser.add_argument("folder", help="where its pictures go")
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
    example, clock = import_module(options.name), Clock()
    keywords = {"frames": FRAMES[options.name]} if options.name in FRAMES else {}
    example.main(options.folder, **keywords)
    clock.pool.submit(clock.alone.close).result()
    for door, times in clock.times.items():
        if times:
            print("door", door, *(f"{value:.4g}" for value in np.median(times, axis=0)))


if __name__ == "__main__":
    main()
