"""What a process does for a batch: plan it, try it, make parts of it."""

from __future__ import annotations

import json
import os
import time
import warnings
from dataclasses import asdict
from functools import lru_cache

import numpy as np

from sonar_gl.batch import planned, store
from sonar_gl.batch.files import Folder
from sonar_gl.batch.finish import finish
from sonar_gl.batch.job import Job
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.maker import Maker
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.planned import Planned
from sonar_gl.plan import POSES
from sonar_gl.simulator import Simulator


class Work:
    """Does things for a job, in one process and with one device.

    Parameters
    ----------
    job : as plain values; url : of the folder; device : index of an EGL device, or None
    """

    def __init__(self, job: dict, url: str, device: int | None):
        self.orders, self.url, self.device = Orders(Job(**job)), url, device
        self._maker = None

    def plan(self, tell=lambda *_: None) -> Planned:
        """Choose the samples of each scene and sonar, by a few pings that lie all over them."""
        orders, samplings, estimates, renderer = self.orders, [], [], ""
        of_scene = [[] for _ in orders.job.scenes]
        for scene, numbers in orders.runs():
            of_scene[scene].append(numbers)
        for scene, runs in enumerate(of_scene):
            total = sum(map(len, runs))
            picked = np.unique(np.linspace(0, total - 1, POSES).round().astype(int)).tolist()
            asked = [orders[_nth(runs, k)] for k in picked]
            chosen, thought, world = {}, {}, orders.scene(scene)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", UserWarning)
                opened = []
                for name, sonar in orders.sonars.items():
                    made = orders.acoustics, None, orders.job.tolerance, self.device
                    world = Simulator(world, sonar, *made)
                    opened.append(world)
                    plan = world.plan(
                        [order.pose @ orders.mounts[name] for order in asked],
                        [order.bodies for order in asked],
                        [order.time_s for order in asked],
                        [order.reflectivity for order in asked],
                        [order.water or None for order in asked],
                    )
                    chosen[name] = asdict(plan.sampling)
                    thought[name] = plan.error_estimate
                    renderer = world.gl_info["renderer"]
                for simulator in opened:
                    simulator.close()
            for warning in caught:
                tell("warning", f"scene {orders.job.scenes[scene]!r}: {warning.message}")
            samplings.append(chosen)
            estimates.append(thought)
        job, kept = orders.job.plain, Kept(orders)
        part = orders.job.pings_per_part or planned.pings_per_part(kept.bytes_per_ping)
        return Planned(job, kept.digest(), len(orders), part, samplings, estimates, gl_renderer=renderer)

    def create(self, tell=lambda *_: None) -> None:
        """Make the store, empty, as far as it is not there."""
        kept, found = Kept(self.orders), Planned.load(Folder(self.url))
        sonars = {}
        for name, sonar in self.orders.sonars.items():
            sonars[name] = sonar, *kept.layers(name), kept.about(found, name)
        attributes = kept.attributes(found)
        store.create(Folder(self.url), found.n_pings, found.pings_per_part, sonars, attributes)

    def probe(self, found: Planned, tell=lambda *_: None) -> dict:
        """Make the first part, twice, the second time for the clock.

        Returns
        -------
        seconds and bytes of a ping, and seconds until the first
        """
        begun = time.perf_counter()
        folder = Folder(self.url)
        maker = Maker(self.orders, found, folder, self.device)
        maker.make(0, tell=tell)
        first_s, begun = time.perf_counter() - begun, time.perf_counter()
        record = maker.make(0, tell=tell)
        ping_s = (time.perf_counter() - begun) / record["pings"]
        maker.close()
        sizes = [folder.fs.size(folder.path(name)) for name, sum_ in record["files"].items() if sum_]
        return {"ping_s": ping_s, "first_s": first_s, "ping_bytes": sum(sizes) / record["pings"]}

    def finish(self, tell=lambda *_: None) -> None:
        """Join what all parts have made."""
        folder = Folder(self.url)
        finish(self.orders, Planned.load(folder), folder)

    def close(self) -> None:
        """Give back what parts were made with."""
        if self._maker is not None:
            self._maker.close()

    def part(self, part: int, set_aside, one_by_one: bool, tell=lambda *_: None) -> dict:
        """Make a part; its record."""
        if self._maker is None:
            folder = Folder(self.url)
            self._maker = Maker(self.orders, Planned.load(folder), folder, self.device)
        return self._maker.make(part, set_aside, one_by_one, tell)


@lru_cache(1)
def _of_worker(job: str, url: str) -> Work:
    os.environ.setdefault("LP_NUM_THREADS", "1")  # of the software driver, which would take all cores
    return Work(json.loads(job), url, None)


def on_cluster(job: str, url: str, command: str, arguments: tuple, part: int):
    """What a worker of a cluster does: a part, or another method of `Work`.

    job : plain values as JSON, the same from part to part
    """
    work = _of_worker(job, url)
    return work.part(part, {}, False) if command == "part" else getattr(work, command)(*arguments)


def _nth(runs, k: int) -> int:
    """The k-th of the numbers of all runs."""
    for numbers in runs:
        if k < len(numbers):
            return numbers[k]
        k -= len(numbers)
    raise IndexError(k)
