#!/usr/bin/env python
"""Times what a headless batch costs beside its pings: processes, encoding, packing, files.

    python tools/bench_batch.py                       # rate writing stores plan: some minutes
    python tools/bench_batch.py rate plan
    python tools/bench_batch.py long --pings 10000    # one batch, whole
    python tools/bench_batch.py --quick

All pings are of the scene pylon, sonar p900-45, with labels and `Noise.physical()`. What is compared takes
turns in one run; medians of the rounds are told.

rate : pings a second of (a) `Simulator.pings` and `add_noise` in one process, the software driver free to use
    all cores, (b) a batch with one worker, (c) with two. Of a batch it is the time of a round's parts, by
    workers that have made some before. How long a worker takes to get there is told alone, without planning
writing : where a worker's time goes, alone on one core, by the clock and by that of its processors
stores : the same noisy pings and labels, written in several ways
plan : what 10^7 such pings take by the rates and sizes of this run, and how many workers one parent and one
    disk can serve
long : a batch from its beginning: rate of the first and the last pings, memory of all processes, size
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

from bench_stores import STAGES, bench_stores, disk_mb_s, resident_mb, settings, size_of, watch_maker

import sonar_gl as sg
from sonar_gl.batch.files import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.maker import record_name
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.planned import pings_per_part
from sonar_gl.batch.pool import ONE_THREAD, Pool
from sonar_gl.batch.run import run
from sonar_gl.batch.work import Work
from sonar_gl.noise import add_noise
from sonar_gl.rigid import numbers_of

WHOLE = 10_000_000  # pings of the data set that is planned
WORKERS = 1, 2, 10, 100


def make_job(pings: int, quick: bool) -> Job:
    """Pings of a sonar that turns to and fro before the pylon, once in each part, that all be alike."""
    x, y, z, _, tilt_rad, yaw_rad = (float(n) for n in numbers_of(sg.load_scene("pylon").sonar_pose))
    path = {"kind": "sector", "position_m": [x, y, z], "pan_rad": [yaw_rad - 0.2, yaw_rad + 0.2]}
    path |= {"n_pings": pings, "ping_rate_hz": 5.0, "sweep_s": 3.1, "tilt_rad": tilt_rad}
    job = {"name": "bench", "scenes": ["pylon"], "sonars": [{"sonar": "p900-45"}], "poses": [path]}
    job |= {"noise": {"preset": "physical"}, "labels": {}}
    small = {"tolerance": 0.1, "pings_per_part": 4, "sonars": [{"sonar": "p900-45", "bins": 100}]}
    return Job(**job | (small if quick else {}))


def begun(job: Job, planned, url: str) -> str:
    """A folder with a batch whose plan is made, and none of its pings."""
    planned.save(Folder(url))
    Work(job.plain, url, None).create()
    return url


def make_alone(simulator, orders, numbers):
    """These pings, with noise and labels, that nobody keeps."""
    asked = [orders[n] for n in numbers]
    pings = simulator.pings([order.pose for order in asked], labels=True)
    for order, ping in zip(asked, pings, strict=True):
        add_noise(ping, order.noise, 0, order.number)


def seconds(function, *arguments) -> float:
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


def bench_rate(job: Job, planned, rounds: int, folder: str) -> dict[str, float]:
    """Pings a second of a, b and c, their ratios, and what else was seen."""
    orders, found, pools = Orders(job), defaultdict(list), {}
    ((name, sonar),) = orders.sonars.items()
    sampling = sg.Sampling(**planned.samplings[0][name])
    each = (planned.n_parts - 2) // rounds
    with ExitStack() as stack:
        made_of = orders.scene(0), sonar, orders.acoustics, sampling
        simulator = stack.enter_context(sg.Simulator(*made_of))
        make_alone(simulator, orders, planned.numbers(0))
        for way, workers in (("b", 1), ("c", 2)):
            url = begun(job, planned, f"{folder}/{way}")
            pool = pools[way] = stack.enter_context(Pool(job.plain, url, [None] * workers, print))
            found[f"begin {way}"] = seconds(pool.run, range(workers), planned.numbers, lambda record: None)
        for k in range(rounds):
            parts, records = range(2 + k * each, 2 + (k + 1) * each), []
            numbers = range(planned.numbers(parts[0])[0], planned.numbers(parts[-1])[-1] + 1)
            found["a"].append(len(numbers) / seconds(make_alone, simulator, orders, numbers))
            for way, pool in pools.items():
                busy_s = time.process_time()
                took_s = seconds(pool.run, parts, planned.numbers, records.append)
                found[way].append(len(numbers) / took_s)
                found["parent, ms a part"].append(1e3 * (time.process_time() - busy_s) / each)
        last = records[-1]
        names = [f"{folder}/c/{file}" for file in [*last["files"], record_name(last["part"])]]
        sizes = [Path(file).stat().st_size for file in names if Path(file).exists()]
    begin_s = found.pop("begin b"), found.pop("begin c")
    for ratio in ("b / a", "c / a", "c / b"):
        found[ratio] = [x / y for x, y in zip(found[ratio[0]], found[ratio[-1]], strict=True)]
    out = {what: median(values) for what, values in found.items()}
    out["start of a worker, s"] = begin_s[0] - planned.pings_per_part / out["b"]
    out["start of two, s"] = begin_s[1] - 2 * planned.pings_per_part / out["c"]
    return out | {"kB a ping": sum(sizes) / last["pings"] / 1e3, "files a part": len(sizes)}


def bench_writing(job: Job, planned, rounds: int, folder: str) -> dict[str, tuple[float, float]]:
    """Seconds a ping of STAGES and "all", by the clock and of processors, in a process as a worker is."""
    url = begun(job, planned, f"{folder}/watched")
    spawning = multiprocessing.get_context("spawn")
    with settings(**dict.fromkeys(ONE_THREAD, "1")), ProcessPoolExecutor(1, spawning) as child:
        return child.submit(watch_maker, job.plain, planned, url, rounds).result()


def bench_long(job: Job, pings: int, folder: str):
    """Print what a whole batch does over its time."""
    seen, marks = [], [0.1, 0.5, 1.0]
    print(f"\nlong: {pings} pings, two workers")

    @contextmanager
    def progress(total, _there):
        begin_s, done = time.perf_counter(), 0

        def more(count):
            nonlocal done
            done += count
            seen.append((time.perf_counter() - begin_s, done))
            if marks and done >= marks[0] * total:
                workers = [f"{resident_mb(child.pid):.0f}" for child in multiprocessing.active_children()]
                parent = resident_mb(os.getpid())
                print(
                    f"  {marks.pop(0):4.0%} resident, MB: parent {parent:.0f}, workers {', '.join(workers)}"
                )

        yield more

    whole_s = seconds(run, job, f"{folder}/long", [None, None], False, print, progress)
    few = min(1000, pings // 4)
    first = next(k for k, (_, done) in enumerate(seen) if done - seen[0][1] >= few)
    last = next(k for k in reversed(range(len(seen))) if seen[-1][1] - seen[k][1] >= few)
    for name, begin, end in (("first", 0, first), ("last", last, -1)):
        (begin_s, done_before), (end_s, done) = seen[begin], seen[end]
        print(f"  {name} {done - done_before} pings: {(done - done_before) / (end_s - begin_s):8.1f} pings/s")
    size, files = size_of(f"{folder}/long")
    print(f"  whole: {whole_s:.0f} s with planning, {size / 1e6:.0f} MB in {files} files")


def tell_plan(rate: dict[str, float], planned, disk: float):
    """Print what so many pings take."""
    part, alone = planned.pings_per_part, rate["c"] / 2
    size_tb, files = WHOLE * rate["kB a ping"] / 1e9, WHOLE / part * rate["files a part"]
    print(f"\nplan: {WHOLE:.0e} pings, {size_tb:.2f} TB in {files:.2g} files, parts of {part}")
    for workers in WORKERS:
        hours = WHOLE / (alone * workers) / 3600
        mb_s = alone * workers * rate["kB a ping"] / 1e3
        print(f"  {workers:4} workers {hours:10.1f} hours {mb_s:10.1f} MB/s")
    parts_s = 1e3 / rate["parent, ms a part"]
    print(f"  the parent takes {parts_s:.0f} records a second, those of {parts_s * part / alone:.0f} workers")
    fed = disk / (alone * rate["kB a ping"] / 1e3)
    print(f"  the disk takes {disk:.0f} MB/s, those of {fed:.0f} workers")


def tell_aim(name: str, value: float, sign: str, aim: float):
    met = value >= aim if sign == ">=" else value <= aim
    print(f"  {name:24} {value:8.3f}   {sign} {aim}  {'met' if met else 'missed'}")


def tell_rate(rate: dict[str, float]):
    print("\nrate, pings a second")
    for way, name in (("a", "one process"), ("b", "batch, 1 worker"), ("c", "batch, 2 workers")):
        print(f"  {way} {name:22} {rate[way]:8.1f}")
    tell_aim("b / a", rate["b / a"], ">=", 0.7)
    tell_aim("c / a", rate["c / a"], ">=", 1.4)
    for name in ("c / b", "start of a worker, s", "kB a ping", "files a part", "parent, ms a part"):
        print(f"  {name:24} {rate[name]:8.3f}")


def tell_writing(spent: dict[str, tuple[float, float]]):
    print(f"\nwriting, ms a ping {'clock':>10} {'busy':>8}")
    for stage, both_s in spent.items():
        print(f"  {stage:18} {1e3 * both_s[0]:8.3f} {1e3 * both_s[1]:8.3f}")
    for k, name in enumerate(("share, by the clock", "share, busy")):
        tell_aim(name, sum(spent[stage][k] for stage in STAGES) / spent["all"][k], "<=", 0.2)


def tell_stores(found: dict):
    print(f"\nstores {'intensity':>32} {'ms a ping':>12} {'kB a ping':>10} {'files':>6}")
    for (name, kept), (ms, kb, files) in found.items():
        print(f"  {name:28} {kept:9} {ms:11.2f} {kb:10.1f} {files:6}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    kinds = ["rate", "writing", "stores", "plan", "long"]
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"{', '.join(kinds)}; without, all but long")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--parts", type=int, default=8, help="of a round of `rate`")
    parser.add_argument("--pings", type=int, default=10_000, help="of `long`")
    parser.add_argument("--quick", action="store_true", help="little of all, by a small sonar")
    options = parser.parse_args()
    what = set(options.what or kinds[:4])
    if unknown := what - set(kinds):
        parser.error(f"WHAT must be of {', '.join(kinds)} (got {', '.join(unknown)})")
    quick, rounds, parts = options.quick, options.rounds, options.parts
    if quick:
        rounds, parts = 1, 2
    few = make_job(1, quick)
    part = few.pings_per_part or pings_per_part(Kept(Orders(few)).bytes_per_ping)
    job = make_job((2 + rounds * parts) * part, quick)
    with tempfile.TemporaryDirectory() as folder:
        start_s = time.perf_counter()
        planned = Work(job.plain, folder, None).plan()
        plan_s = time.perf_counter() - start_s
        print(f"sonar_gl {sg.__version__} on {planned.gl_renderer}; {os.cpu_count()} cores, ", end="")
        print(f"load {os.getloadavg()[0]:.1f}; planning took {plan_s:.1f} s; {rounds} rounds, medians")
        if {"rate", "plan"} & what:
            tell_rate(rate := bench_rate(job, planned, rounds, folder))
        if "writing" in what:
            tell_writing(bench_writing(job, planned, rounds, folder))
        if "stores" in what:
            url = begun(job, planned, f"{folder}/arrays")
            tell_stores(bench_stores(job, planned, url, 4 if quick else 64, min(3, rounds)))
        if "plan" in what:
            tell_plan(rate, planned, disk_mb_s(folder, 4_000_000 if quick else 256_000_000))
        if "long" in what:
            bench_long(make_job(options.pings, quick), options.pings, folder)


if __name__ == "__main__":
    main()
