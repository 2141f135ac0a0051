"""Measure what a headless batch costs beside its pings: processes, encoding, packing, files.

    python -m tools.bench batch                            # rate, writing, plan: some minutes
    python -m tools.bench batch rate plan
    python -m tools.bench batch rate --workers 15          # on a machine with more cores
    python -m tools.bench batch flushes
    python -m tools.bench batch long --pings 10000         # one batch from its beginning to its end
    python -m tools.bench batch --quick

All pings are of the scene pylon, sonar p900-45, with labels and `Noise.physical()`.

rate : pings a second of (a) `Simulator.pings` and `add_noise` in one process, where the software driver may
    use all cores, (b) a batch with one worker, (c) with several, two by default. The rate of a batch is that of a
    round's parts, by workers that have made some before. The start of a worker is measured apart
writing : where a worker's time goes, alone on one core, by the clock and by the time of its processors
flushes : what it costs that each part is on the disk before its record, by a worker that does so and does not by
    turns
plan : what 10^7 such pings take by the rates and sizes of this run, and how many workers one parent and one
    disk can serve
long : a batch from its beginning: rate of the first and the last pings, memory of all processes, size
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

import numpy as np

import sonar_gl as sg
from sonar_gl.batch import folder as folder_module
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.manifest import Manifest, default_pings_per_part, record_name
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.pool import ONE_THREAD, Pool
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.run import run as run_batch
from sonar_gl.batch.schema import Schema
from sonar_gl.batch.steps import begin, create_store
from sonar_gl.core.poses import pose_numbers
from sonar_gl.noise.noise import add_noise
from tools import internals
from tools.bench import harness
from tools.bench.harness import Aim

ROUNDS = 7, 1
PARTS = "rate", "writing", "flushes", "plan", "long"
PLANNED_PINGS = 10_000_000
WORKERS = 1, 2, 10, 100
STAGES = {  # of writing: name of the stage, clock of its processors
    "make room": time.thread_time,
    "encode": time.thread_time,
    "pack and store": time.process_time,  # in threads of Zarr's, and nothing else runs then
    "other files": time.thread_time,
    "checksums": time.thread_time,
}


def size_of(folder) -> tuple[int, int]:
    """Return bytes and number of all files in a folder."""
    sizes = [path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()]
    return sum(sizes), len(sizes)


def resident_mb(pid) -> float:
    """Return the resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def disk_mb_s(folder: str, size: int) -> float:
    """Return the rate of one large write, until it is on the disk."""
    data, start = os.urandom(size), time.perf_counter()
    with open(f"{folder}/disk", "wb", buffering=0) as file:
        file.write(data)
        os.fsync(file.fileno())
    return size / 1e6 / (time.perf_counter() - start)


@contextmanager
def environment(**changes):
    """Change the environment of processes that start in the block."""
    before = dict(os.environ)
    os.environ.update(changes)
    yield
    os.environ.clear()
    os.environ.update(before)


def make_job(pings: int, quick: bool) -> Job:
    """Make a job of a sonar that turns to and fro before the pylon, once a part, so that parts are alike."""
    x, y, z, _, tilt_rad, yaw_rad = (float(n) for n in pose_numbers(sg.load_scene("pylon").sonar_pose))
    path = {"kind": "sector", "position_m": [x, y, z], "pan_rad": [yaw_rad - 0.2, yaw_rad + 0.2]}
    path |= {"n_pings": pings, "ping_rate_hz": 5.0, "sweep_s": 3.1, "tilt_rad": tilt_rad}
    job = {"name": "bench", "scenes": ["pylon"], "sonars": [{"sonar": "p900-45"}], "poses": [path]}
    job |= {"noise": {"preset": "physical"}, "labels": {}}
    small = {"tolerance": 0.1, "pings_per_part": 4, "sonars": [{"sonar": "p900-45", "bins": 100}]}
    return Job(**job | (small if quick else {}))


def begin_batch(job: Job, manifest: Manifest, url: str) -> str:
    """Make a folder with a batch that has none of its pings; return its URL."""
    folder = Folder(url)
    manifest.save(folder)
    create_store(Batch(BatchRequests(job), folder))
    return url


def seconds(function, *arguments) -> float:
    """Call a function; return the time it takes."""
    return harness.timed(function, *arguments)[0] / 1e3


def measure_rate(job: Job, manifest: Manifest, rounds: int, workers: int, folder: str) -> dict[str, float]:
    """Return pings a second of a, b and c, their ratios, start of workers, sizes, the parent's work."""
    requests, found, pools = BatchRequests(job), defaultdict(list), {}
    ((name, sonar),) = requests.sonars.items()
    parts_a_round = (manifest.n_parts - workers) // rounds
    with ExitStack() as stack:
        settings = {"tolerance": job.tolerance}
        simulator = stack.enter_context(
            sg.Simulator(requests.scenes[0], sonar, requests.acoustics, **settings)
        )
        mount = requests.mounts[name]

        def ping_without_batch(numbers):
            in_part = [requests[n] for n in numbers]
            pings = internals.pings_of(simulator, (one.for_sonar(mount, labels=True) for one in in_part))
            for request, ping in zip(in_part, pings, strict=True):
                add_noise(ping, request.noise, 0, request.number)

        ping_without_batch(manifest.numbers(0))
        for way, count in (("b", 1), ("c", workers)):
            url = begin_batch(job, manifest, f"{folder}/{way}")
            pool = pools[way] = stack.enter_context(Pool(job.plain, url, [None] * count, print))
            found[f"start {way}"] = seconds(
                pool.run_parts, range(count), manifest.numbers, lambda record: None
            )
        for k in range(rounds):
            parts, records = range(workers + k * parts_a_round, workers + (k + 1) * parts_a_round), []
            few = parts[: max(1, parts_a_round // workers)]  # for one worker, which takes as long
            numbers = [number for part in few for number in manifest.numbers(part)]
            found["a"].append(len(numbers) / seconds(ping_without_batch, numbers))
            for way, its_parts in (("b", few), ("c", parts)):
                busy_s = time.process_time()
                took_s = seconds(pools[way].run_parts, its_parts, manifest.numbers, records.append)
                found[way].append(sum(len(manifest.numbers(part)) for part in its_parts) / took_s)
                found["parent, ms a part"].append(1e3 * (time.process_time() - busy_s) / len(its_parts))
        last = records[-1]
        names = [f"{folder}/c/{file}" for file in [*last.files, record_name(last.part)]]
        sizes = [Path(file).stat().st_size for file in names if Path(file).exists()]
    start_s = found.pop("start b"), found.pop("start c")
    for pair in ("b / a", "c / a", "c / b"):
        found[pair] = [x / y for x, y in zip(found[pair[0]], found[pair[-1]], strict=True)]
    out = {what: median(values) for what, values in found.items()}
    out["start of a worker, s"] = start_s[0] - manifest.pings_per_part / out["b"]
    out["start of all, s"] = start_s[1] - workers * manifest.pings_per_part / out["c"]
    out["workers"] = workers
    return out | {"kB a ping": sum(sizes) / last.pings / 1e3, "files a part": len(sizes)}


def like_worker(measure: Callable, job: Job, manifest: Manifest, rounds: int, folder: str) -> dict:
    """Return what `measure` does of a batch of its own, in a process with as many threads as a worker."""
    url = begin_batch(job, manifest, f"{folder}/{measure.__name__}")
    spawning = multiprocessing.get_context("spawn")
    with environment(**dict.fromkeys(ONE_THREAD, "1")), ProcessPoolExecutor(1, spawning) as child:
        return child.submit(measure, job.plain, url, rounds).result()


def measure_writing(job: dict, url: str, rounds: int) -> dict[str, tuple[float, float]]:
    """Return seconds a ping of STAGES and "all", by the clock and of processors, on one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    maker, spent = Batch(BatchRequests(Job(**job)), Folder(url)).maker, defaultdict(lambda: np.zeros(2))
    running = []  # stages; of a file that the store writes, its stage counts, and not "other files"

    def clocked(stage, function, busy_s):
        def call(*arguments, **more):
            if running and running[-1] != "all":
                return function(*arguments, **more)
            running.append(stage)
            start = np.array([time.perf_counter(), busy_s()])
            try:
                return function(*arguments, **more)
            finally:
                spent[stage] += np.array([time.perf_counter(), busy_s()]) - start
                running.pop()

        return call

    (arrays,), files = maker.outputs, maker.folder
    methods = (arrays, "begin"), (arrays, "add"), (arrays, "end"), (files, "put"), (files, "checksum")
    for (stage, busy_s), (owner, name) in zip(STAGES.items(), methods, strict=True):
        setattr(owner, name, clocked(stage, getattr(owner, name), busy_s))
    found = defaultdict(list)
    for part in range(rounds + 1):
        spent.clear()
        record = clocked("all", maker.make, time.process_time)(part)
        for stage, pair in spent.items() if part else ():  # the first compiles, and opens the simulator
            found[stage].append(pair / record.pings)
    maker.close()
    return {stage: tuple(np.median(pairs, axis=0).tolist()) for stage, pairs in found.items()}


def measure_flushes(job: dict, url: str, rounds: int) -> dict[str, float]:
    """Return the times of parts that are flushed to the disk and of parts that are not."""
    maker, flushes_s, parts_s = Batch(BatchRequests(Job(**job)), Folder(url)).maker, [], {True: [], False: []}
    real = {name: getattr(folder_module, name) for name in ("sync", "sync_file_system")}
    is_flushed = False

    def clocked(flush):
        def call(path):
            start_s = time.perf_counter()
            if is_flushed:
                flush(path)
            flushes_s.append(time.perf_counter() - start_s)

        return call

    for name, flush in real.items():
        setattr(folder_module, name, clocked(flush))
    maker.make(0)  # compiles, and opens the simulator
    totals_s = []
    for part in range(1, 2 * rounds + 1):
        is_flushed = part % 2 == 1
        flushes_s.clear()
        start_s = time.perf_counter()
        maker.make(part)
        parts_s[is_flushed].append(time.perf_counter() - start_s)
        totals_s += [sum(flushes_s)] if is_flushed else []
    maker.close()
    with_s, without_s = median(parts_s[True]), median(parts_s[False])
    return {"ms a part": 1e3 * median(totals_s), "part, s": with_s, "ratio": with_s / without_s}


def measure_long(job: Job, pings: int, folder: str) -> dict:
    """Return the rates of a batch's first and last pings, memory on the way, time and size."""
    progress_made, marks, memory = [], [0.1, 0.5, 1.0], []

    @contextmanager
    def progress(total, _there):
        start_s, done = time.perf_counter(), 0

        def more(count):
            nonlocal done
            done += count
            progress_made.append((time.perf_counter() - start_s, done))
            if marks and done >= marks[0] * total:
                workers = [resident_mb(child.pid) for child in multiprocessing.active_children()]
                memory.append(
                    {"at": marks.pop(0), "parent_mb": resident_mb(os.getpid()), "workers_mb": workers}
                )

        yield more

    took_s = seconds(run_batch, job, f"{folder}/long", [None, None], print, progress)
    few = min(1000, pings // 4)
    first = next(k for k, (_, done) in enumerate(progress_made) if done - progress_made[0][1] >= few)
    last = next(
        k for k in reversed(range(len(progress_made))) if progress_made[-1][1] - progress_made[k][1] >= few
    )
    rates = {}
    for name, from_, to in (("first", 0, first), ("last", last, -1)):
        (begin_s, done_before), (end_s, done) = progress_made[from_], progress_made[to]
        rates[name] = {"pings": done - done_before, "pings_s": (done - done_before) / (end_s - begin_s)}
    size, files = size_of(f"{folder}/long")
    return {"pings": pings, "rates": rates, "memory": memory, "s": took_s, "mb": size / 1e6, "files": files}


def plan_of(rate: dict[str, float], manifest: Manifest, disk: float) -> dict:
    """Return what PLANNED_PINGS take; disk : MB/s."""
    worker = rate["c"] / rate["workers"]
    parts_s = 1e3 / rate["parent, ms a part"]
    return {
        "tb": PLANNED_PINGS * rate["kB a ping"] / 1e9,
        "files": PLANNED_PINGS / manifest.pings_per_part * rate["files a part"],
        "pings_per_part": manifest.pings_per_part,
        "workers": [
            {
                "workers": workers,
                "hours": PLANNED_PINGS / (worker * workers) / 3600,
                "mb_s": worker * workers * rate["kB a ping"] / 1e3,
            }
            for workers in WORKERS
        ],
        "parent_parts_s": parts_s,
        "parent_serves": parts_s * manifest.pings_per_part / worker,
        "disk_mb_s": disk,
        "disk_serves": disk / (worker * rate["kB a ping"] / 1e3),
    }


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; default: all but long"
    )
    parser.add_argument("--workers", type=int, default=2, help="of c, for `rate`; 2")
    parser.add_argument("--pings", type=int, default=10_000, help="of `long`")


def run(options) -> dict:
    """Return the figures of the parts."""
    parts, quick, rounds = set(options.parts or PARTS[:4]), options.quick, options.rounds
    if unknown := parts - set(PARTS):
        raise SystemExit(f"PART must be of {', '.join(PARTS)} (got {', '.join(unknown)})")
    few = make_job(1, quick)
    bytes_per_ping = Schema(BatchRequests(few)).bytes_per_ping
    part = few.pings_per_part or default_pings_per_part(bytes_per_ping, PLANNED_PINGS)
    n_parts = options.workers + rounds * options.workers * (1 if quick else 4)
    job, found = make_job(n_parts * part, quick).model_copy(update={"pings_per_part": part}), {}
    with tempfile.TemporaryDirectory() as folder:
        manifest = begin(Batch(BatchRequests(job), Folder(folder)))
        if {"rate", "plan"} & parts:
            found["rate"] = measure_rate(job, manifest, rounds, options.workers, folder)
        if "writing" in parts:
            found["writing"] = like_worker(measure_writing, job, manifest, rounds, folder)
        if "flushes" in parts:
            found["flushes"] = like_worker(measure_flushes, job, manifest, rounds, folder)
        if "plan" in parts:
            disk = disk_mb_s(folder, 4_000_000 if quick else 256_000_000)
            found["plan"] = plan_of(found["rate"], manifest, disk)
        if "long" in parts:
            found["long"] = measure_long(make_job(options.pings, quick), options.pings, folder)
    found["aims"] = aims_of(found)
    return found


def aims_of(found: dict) -> list[Aim]:
    """Compare rates and writing with what was aimed at."""
    aims = []
    if rate := found.get("rate"):
        aims += [
            Aim(pair, rate[pair], "times", limit, True) for pair, limit in (("b / a", 0.7), ("c / a", 1.4))
        ]
    if writing := found.get("writing"):
        for k, name in enumerate(("writing's share, by the clock", "writing's share, busy")):
            share = sum(writing[stage][k] for stage in STAGES) / writing["all"][k]
            aims.append(Aim(name, share, "", 0.2))
    return aims


def report(found: dict):
    """Print the figures."""
    if rate := found.get("rate"):
        print("\nrate, pings a second")
        several = f"batch, {rate['workers']} workers"
        for way, name in (("a", "one process"), ("b", "batch, 1 worker"), ("c", several)):
            print(f"  {way} {name:22} {rate[way]:8.1f}")
        for name in ("c / b", "start of a worker, s", "kB a ping", "files a part", "parent, ms a part"):
            print(f"  {name:24} {rate[name]:8.3f}")
    if writing := found.get("writing"):
        print("\nwriting, ms a ping")
        harness.print_table(
            [
                {"stage": stage, "clock": f"{1e3 * clock_s:.3f}", "busy": f"{1e3 * busy_s:.3f}"}
                for stage, (clock_s, busy_s) in writing.items()
            ]
        )
    if flushes := found.get("flushes"):
        print(
            f"\nflushes: {flushes['ms a part']:.1f} ms for each part of {flushes['part, s']:.2f} s, "
            f"{flushes['ms a part'] / 10 / flushes['part, s']:.1f} %; a part takes {flushes['ratio']:.3f} times as "
            "long as without"
        )
    if plan := found.get("plan"):
        print(
            f"\nplan: {PLANNED_PINGS:.0e} pings, {plan['tb']:.2f} TB in {plan['files']:.2g} files, "
            f"parts of {plan['pings_per_part']}"
        )
        harness.print_table(
            [
                {"workers": row["workers"], "hours": f"{row['hours']:.1f}", "MB/s": f"{row['mb_s']:.1f}"}
                for row in plan["workers"]
            ]
        )
        print(
            f"  the parent takes {plan['parent_parts_s']:.0f} records a second, those of "
            f"{plan['parent_serves']:.0f} workers\n"
            f"  the disk takes {plan['disk_mb_s']:.0f} MB/s, those of {plan['disk_serves']:.0f} workers"
        )
    if long := found.get("long"):
        print(f"\nlong: {long['pings']} pings, two workers")
        for name, rate in long["rates"].items():
            print(f"  {name} {rate['pings']} pings: {rate['pings_s']:8.1f} pings/s")
        for row in long["memory"]:
            workers = ", ".join(f"{mb:.0f}" for mb in row["workers_mb"])
            print(f"  {row['at']:4.0%} resident, MB: parent {row['parent_mb']:.0f}, workers {workers}")
        print(f"  {long['s']:.0f} s, {long['mb']:.0f} MB in {long['files']} files")
    if found["aims"]:
        harness.print_aims(found["aims"])
