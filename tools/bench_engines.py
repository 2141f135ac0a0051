"""What bench_cluster.py compares: engines that run a function of a part, and such functions."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from time import sleep, time

HERE = Path(__file__).resolve().parent
ONE_THREAD = {"LP_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
SETTINGS = {
    **ONE_THREAD,
    "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)]),
    "RAY_AUTH_MODE": "disabled",  # nobody else comes near
    "RAY_worker_niceness": "0",  # 15 by itself, which a machine that others use would punish
}
START_S = 60.0
LOCAL = {"auto_mkdir": True}  # to fsspec: folders are made as they are needed
KEPT = {}  # a worker's simulator


def make_nothing(part: int) -> dict:
    return {}


def make_part(url: str, pings: int, part: int) -> dict:
    """Make the pings of a part and write them, then that the part is done."""
    import fsspec
    import numpy as np
    import zarr

    import sonar_gl as sg

    if not KEPT:
        scene = sg.load_scene("pylon")
        KEPT["pose"], KEPT["simulator"] = scene.sonar_pose, sg.Simulator(scene, sg.load_sonar("p900-45"))
    made = []
    for number in range(part * pings, (part + 1) * pings):
        made.append(KEPT["simulator"].ping(KEPT["pose"] @ sg.pose(x=0.001 * number), labels=True))
        KEPT.setdefault("first_ping", time())
    store = zarr.open_group(url, mode="r+", storage_options=LOCAL)
    for name in ("intensity", "body_id", "elevation_rad"):
        store[name][part * pings : (part + 1) * pings] = np.stack([getattr(ping, name) for ping in made])
    with fsspec.open(f"{url}.done/{part}.json", "w", **LOCAL) as file:
        json.dump({"part": part, "pings": pings}, file)
    return {"first_ping": KEPT["first_ping"]}


def new_store(url: str, parts: int, pings: int):
    """A Zarr store for the arrays, one shard a part."""
    import zarr

    import sonar_gl as sg

    sonar = sg.load_sonar("p900-45")
    store, sizes = zarr.create_group(url, storage_options=LOCAL), (sonar.n_beams, sonar.n_bins)
    for name, dtype in (("intensity", "f4"), ("body_id", "u2"), ("elevation_rad", "f4")):
        shapes = {"shape": (parts * pings, *sizes), "shards": (pings, *sizes), "chunks": (1, *sizes)}
        store.create_array(name, dtype=dtype, **shapes)


@contextmanager
def programs(*commands):
    """Python programs beside this one, ended with the block; gives their processes' numbers."""
    with TemporaryDirectory() as folder, open(f"{folder}/log", "w") as log:
        options = {"env": {**os.environ, **SETTINGS}, "stdout": log, "stderr": log, "cwd": folder}
        started = [subprocess.Popen([sys.executable, "-m", *command], **options) for command in commands]
        try:
            yield [program.pid for program in started]
        finally:
            for program in reversed(started):
                program.terminate()
                program.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def reachable(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


class Pool:
    """Processes of this machine, as concurrent.futures has them."""

    def __init__(self, stack, workers: int):
        os.environ.update(ONE_THREAD)
        self._pool = stack.enter_context(ProcessPoolExecutor(workers, mp_context=get_context("spawn")))

    @property
    def pids(self) -> list[int]:
        return list(self._pool._processes)

    def run(self, make, parts) -> list[dict]:
        return [future.result() for future in as_completed(self._pool.submit(make, part) for part in parts)]


class Dask:
    """A scheduler, and workers of one thread; sonar_gl's own driver."""

    def __init__(self, stack, workers: int):
        from distributed import Client

        self._address = f"tcp://127.0.0.1:{free_port()}"
        scheduler = ("dask", "scheduler", f"--host={self._address}", "--no-dashboard")
        worker = ("dask", "worker", self._address, "--nthreads=1", "--no-dashboard")
        self.pids = stack.enter_context(programs(scheduler, *[worker] * workers))
        with Client(self._address, timeout=START_S, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=START_S)

    def run(self, make, parts) -> list[dict]:
        from sonar_gl.batch.cluster import run_on_cluster

        found = []
        run_on_cluster(self._address, make, parts, lambda part, told: found.append(told), print)
        return found


class Ray:
    """A head with so many processors; tasks, whose processes Ray keeps."""

    def __init__(self, stack, workers: int):
        os.environ.update(SETTINGS)
        import ray

        self._ray, self._workers = ray, workers
        command = ("ray.scripts.scripts", "start", "--head", "--block", f"--num-cpus={workers}")
        options = (f"--port={(port := free_port())}", "--node-ip-address=127.0.0.1")
        quiet = ("--include-dashboard=false", "--disable-usage-stats")
        self.pids = stack.enter_context(programs((*command, *options, *quiet)))
        end = time() + START_S
        while not reachable(port) and time() < end:  # an attempt before lasts 40 s
            sleep(0.05)
        while not ray.is_initialized():
            try:
                ray.init(f"127.0.0.1:{port}", log_to_driver=False, logging_level="ERROR")
            except (ConnectionError, RuntimeError, ValueError):
                if time() > end:
                    raise
                sleep(0.1)
        stack.callback(ray.shutdown)

    def run(self, make, parts) -> list[dict]:
        task = self._ray.remote(max_retries=1, num_cpus=1)(lambda part: make(part))
        found, hands = [], []
        for part in parts:
            hands.append(task.remote(part))
            if len(hands) > 2 * self._workers:
                ended, hands = self._ray.wait(hands)
                found += self._ray.get(ended)
        return found + self._ray.get(hands)
