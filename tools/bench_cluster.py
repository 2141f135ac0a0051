#!/usr/bin/env python
"""What it costs to have a batch made by a Dask or a Ray cluster, beside a pool of processes.

    python tools/bench_cluster.py              # two workers each, some minutes
    python tools/bench_cluster.py --rounds 15 --pings 64
    python tools/bench_cluster.py --rounds 1 --parts 2 --pings 1    # what pings have no part in

A part is 32 pings of the scene `pylon` with labels. The worker that makes them writes them into a Zarr store,
one shard a part and array, then a file that says that the part is done. Dask's scheduler and workers are
programs of the command line, as on a cluster, and so is Ray's head; Dask's driver is sonar_gl's own. An
engine that is not installed is left out.

Engines take turns on the same parts, since other programs may use the machine as well. "time by the pool" is
the median over the rounds of an engine's time by the pool's in the same round; "busy" is the time of
processors that all processes of an engine took for a part, the driver's apart. The time that connecting takes
is told alone, a batch does it once. Memory is what all processes of an engine hold at the end, again without
the driver, shared pages shared out. Numba's machine code is there before anything is measured.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from statistics import median
from time import perf_counter, time

from bench_engines import Dask, Pool, Ray, make_nothing, make_part, new_store


def family(pids) -> set:
    """Processes and all below them."""
    import psutil

    found = set()
    for process in map(psutil.Process, pids):
        found |= {process, *process.children(recursive=True)}
    return found


def busy_s(pids) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in family(pids))


def timed(call, *arguments) -> tuple[float, object]:
    start = perf_counter()
    result = call(*arguments)
    return perf_counter() - start, result


def begin(kind, stack, workers: int, url: str) -> tuple[object, dict]:
    """An engine that has made its first pings, and how long that took."""
    began = time()
    row = {}
    row["start, s"], engine = timed(kind, stack, workers)
    row["connect, s"], _ = timed(engine.run, make_nothing, [])
    new_store(url, workers, 1)
    told = engine.run(partial(make_part, url, 1), range(workers))
    row["to the first ping, s"] = min(each["first_ping"] for each in told) - began
    return engine, row


def measure(options, kinds: dict, folder: str) -> dict[str, dict]:
    """What the table shows of each engine."""
    with ExitStack() as stack:
        new_store(url := f"file://{folder}/warm", 1, 1)
        with ExitStack() as first:  # Numba compiles
            Pool(first, 1).run(partial(make_part, url, 1), [0])
        engines, rows, took, busy = {}, {}, {}, {}
        for name, kind in kinds.items():
            url, took[name], busy[name] = f"file://{folder}/{name}", [], []
            engines[name], rows[name] = begin(kind, stack, options.workers, url)
        for number in range(options.rounds):
            for name, engine in engines.items():
                new_store(url := f"file://{folder}/{name}{number}", options.parts, options.pings)
                make, before_s = partial(make_part, url, options.pings), busy_s(engine.pids)
                took_s, _ = timed(engine.run, make, range(options.parts))
                took[name].append((took_s - rows[name]["connect, s"]) / options.parts)
                busy[name].append((busy_s(engine.pids) - before_s) / options.parts)
                shutil.rmtree(f"{folder}/{name}{number}")
        for name, engine in engines.items():
            row, beside = rows[name], zip(took[name], took["pool"], strict=True)
            row["parts a second"] = 1 / median(took[name])
            row["time by the pool"] = median(ours / pool for ours, pool in beside)
            row["busy a part, s"] = median(busy[name])
            row["busy by the pool"] = row["busy a part, s"] / rows["pool"]["busy a part, s"]
            empty_s, _ = timed(engine.run, make_nothing, range(options.empty))
            row["an empty part, ms"] = 1e3 * (empty_s - row["connect, s"]) / options.empty
            row["memory, MB"] = sum(each.memory_full_info().pss for each in family(engine.pids)) / 1e6
        return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7, help="how often each engine makes its parts")
    parser.add_argument("--parts", type=int, default=6, help="of a round")
    parser.add_argument("--pings", type=int, default=32, help="of a part")
    parser.add_argument("--empty", type=int, default=500, help="parts without pings, for what a part costs")
    options = parser.parse_args()
    kinds = {"pool": Pool}
    for name, module, kind in (("dask", "distributed", Dask), ("ray", "ray", Ray)):
        if find_spec(module):
            kinds[name] = kind
        else:
            print(f"{name} is left out: it is not installed")
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(options, kinds, folder)
    print(f"{options.workers} workers, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"{'':22}" + "".join(f"{name:>10}" for name in rows))
    for what in rows["pool"]:
        print(f"{what:22}" + "".join(f"{row[what]:10.2f}" for row in rows.values()))


if __name__ == "__main__":
    main()
