"""What bench_batch.py takes: stores for the same pings, where a worker's time goes, sizes and settings."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
import zarr

from sonar_gl.batch import layers, store
from sonar_gl.batch.files import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.maker import Maker
from sonar_gl.batch.orders import Orders

STAGES = {  # of writing: what a `Maker` calls, and the clock of its processors
    "make room": time.thread_time,
    "encode": time.thread_time,
    "pack and store": time.process_time,  # in threads of Zarr's, and nothing else runs then
    "other files": time.thread_time,
    "checksums": time.thread_time,
}


def size_of(folder) -> tuple[int, int]:
    """Bytes and number of all files in a folder."""
    sizes = [path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()]
    return sum(sizes), len(sizes)


def resident_mb(pid) -> float:
    """Memory that a process holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def disk_mb_s(folder: str, size: int) -> float:
    """Written at one go, until it is on the disk."""
    data, start = os.urandom(size), time.perf_counter()
    with open(f"{folder}/disk", "wb", buffering=0) as file:
        file.write(data)
        os.fsync(file.fileno())
    return size / 1e6 / (time.perf_counter() - start)


@contextmanager
def settings(**changes):
    """The environment of processes that start in the block."""
    before = dict(os.environ)
    os.environ.update(changes)
    yield
    os.environ.clear()
    os.environ.update(before)


def watch_maker(job: dict, planned, url: str, rounds: int) -> dict[str, tuple[float, float]]:
    """Seconds a ping of the stages of writing and of all, by the clock and of processors, on one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    maker, spent = Maker(Orders(Job(**job)), planned, Folder(url)), defaultdict(lambda: np.zeros(2))

    def watched(stage, function, busy_s):
        def call(*arguments):
            start = np.array([time.perf_counter(), busy_s()])
            try:
                return function(*arguments)
            finally:
                spent[stage] += np.array([time.perf_counter(), busy_s()]) - start

        return call

    (arrays,), folder = maker.outputs, maker.folder
    of_stage = (arrays, "begin"), (arrays, "take"), (arrays, "end"), (folder, "put"), (folder, "checksum")
    for (stage, busy_s), (owner, name) in zip(STAGES.items(), of_stage, strict=True):
        setattr(owner, name, watched(stage, getattr(owner, name), busy_s))
    told = defaultdict(list)
    for k in range(rounds + 1):
        spent.clear()
        record = watched("all", maker.make, time.process_time)(k)
        for stage, seconds in spent.items() if k else ():  # the first compiles, and opens the simulator
            told[stage].append(seconds / record["pings"])
    maker.close()
    return {stage: tuple(np.median(seconds, axis=0)) for stage, seconds in told.items()}


def made_arrays(job: Job, planned, url: str, pings: int) -> dict[str, np.ndarray]:
    """Exact intensities and labels as a batch keeps them, (N, B, K) by name."""
    exact = job.model_copy(update={"arrays": job.arrays.model_copy(update={"mantissa_bits": 23})})
    maker, found = Maker(Orders(exact), planned, Folder(url)), defaultdict(list)
    (output,) = maker.outputs

    def end():  # in place of writing
        (arrays,) = output.arrays.values()
        for name, values in arrays.items():
            found[name].append(values.copy())
        return []

    output.end = end
    for part in range(-(-pings // planned.pings_per_part)):
        maker.make(part)
    maker.close()
    return {name: np.concatenate(values)[:pings] for name, values in found.items()}


def ways(job: Job, planned, arrays: dict) -> dict:
    """By store and how it keeps intensities: a generator function, which makes a store, yields, and then
    writes; and the arrays that it takes."""
    orders, part = Orders(job), planned.pings_per_part
    ((name, sonar),) = orders.sonars.items()

    def shards(folder, arrays):
        """As a batch does."""
        kept = [replace(layer, dtype=arrays[layer.name].dtype.name) for layer in Kept(orders).layers(name)[0]]
        where, n_pings = Folder(folder), len(arrays["intensity"])
        store.create(where, n_pings, part, {name: (sonar, kept, [], {})}, {})
        writer = store.Writer(where, 1)
        yield
        for first in range(0, n_pings, part):
            writer.write(name, first, {k: values[first : first + part] for k, values in arrays.items()})

    def chunks(folder, arrays):
        """A file of each ping and array, packed alike."""
        group = zarr.open_group(folder, mode="w")
        for key, values in arrays.items():
            codec = store.FLOATS if values.dtype.kind == "f" else store.LABELS
            made = {"chunks": (1, *values.shape[1:]), "compressors": codec}
            group.create_array(key, shape=values.shape, dtype=values.dtype, **made)
        yield
        for key, values in arrays.items():
            group[key].with_config({"write_empty_chunks": True})[:] = values

    def hdf5(how):
        def write(folder, arrays):
            with h5py.File(f"{folder}/pings.h5", "w") as file:
                yield
                for key, values in arrays.items():
                    chunks = (1, *values.shape[1:])
                    file.create_dataset(key, data=values, chunks=chunks, compression=how, shuffle=True)

        return write

    rounded = [layers.round_mantissa(ping, job.arrays.mantissa_bits) for ping in arrays["intensity"]]
    rounded = arrays | {"intensity": np.stack(rounded)}
    half = arrays | {"intensity": arrays["intensity"].astype(np.float16)}
    bits = f"{job.arrays.mantissa_bits} bits"
    out = {
        ("Zarr shards, as a batch", bits): (shards, rounded),
        ("Zarr shards, as a batch", "exact"): (shards, arrays),
        ("Zarr shards, as a batch", "float16"): (shards, half),
        ("Zarr, a file a ping", bits): (chunks, rounded),
    }
    try:
        import h5py
    except ModuleNotFoundError:
        print("HDF5 is left out: h5py is not installed")
        return out
    return out | {(f"HDF5, {how}", bits): (hdf5(how), rounded) for how in ("lzf", "gzip")}


def bench_stores(job: Job, planned, url: str, pings: int, rounds: int) -> dict:
    """Milliseconds and kB a ping, and files, of each way."""
    arrays, took, sizes = made_arrays(job, planned, url, pings), defaultdict(list), {}
    written = ways(job, planned, arrays)
    for _ in range(rounds):
        for way, (write, values) in written.items():
            with TemporaryDirectory() as folder:
                next(writing := write(folder, values))
                start = time.perf_counter()
                next(writing, None)
                took[way].append(1e3 * (time.perf_counter() - start) / pings)
                sizes[way] = size_of(folder)
    return {way: (median(took[way]), size / pings / 1e3, files) for way, (size, files) in sizes.items()}
