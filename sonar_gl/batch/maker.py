"""Makes parts of a batch in one process: pings, what is kept of them, and the record that they are done."""

from __future__ import annotations

import warnings
from contextlib import ExitStack
from itertools import groupby

import numpy as np

from sonar_gl.batch import formats, table
from sonar_gl.batch.files import Folder
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.planned import Planned, record_name, table_name
from sonar_gl.fan import Sampling
from sonar_gl.noise import add_noise
from sonar_gl.simulator import Simulator
from sonar_gl.types import Error

TRIES = 2  # of a ping that fails, before it is set aside


class Maker:
    """Makes parts. The simulators of the last scene stay open.

    Parameters
    ----------
    orders, planned
    folder : of the batch
    device : index of an EGL device
    """

    def __init__(self, orders: Orders, planned: Planned, folder: Folder, device: int | None = None):
        self.orders, self.planned, self.folder, self.device = orders, planned, folder, device
        self.columns, self.kept = table.Columns(orders), Kept(orders)
        self.outputs = formats.outputs_of(orders, self.kept, folder)
        self._open, self._scene, self._simulators = ExitStack(), None, {}

    def simulators(self, scene: int) -> dict[str, Simulator]:
        """One for each sonar, all in one world."""
        if scene != self._scene:
            self.close()
            world = self.orders.scene(scene)
            for name, sonar in self.orders.sonars.items():
                sampling = Sampling(**self.planned.samplings[scene][name])
                world = Simulator(world, sonar, self.orders.acoustics, sampling, device=self.device)
                self._simulators[name] = self._open.enter_context(world)
            self._scene = scene
        return self._simulators

    def close(self):
        """Give the simulators back."""
        self._open.close()
        self._simulators, self._scene = {}, None

    def make(self, part: int, set_aside=None, one_by_one: bool = False, tell=lambda *_: None) -> dict:
        """Make a part, write what is kept of it, and last of all its record.

        Parameters
        ----------
        set_aside : numbers of pings to leave out, and why
        one_by_one : have `tell` hear of each ping before it is made, not after
        tell : function (word, value): "from" and the number of the first of several pings, "before" or
            "after" and that of one, "warning" and a text

        Returns
        -------
        dict : the record
        """
        numbers, failed = self.planned.numbers(part), dict(set_aside or {})
        asked = [self.orders[n] for n in numbers]
        rows = np.array([self.columns.row(order) for order in asked])
        for output in self.outputs:
            output.begin(part, numbers)
        for scene, run in groupby(asked, lambda order: order.scene):
            run = list(run)
            for name in self.orders.sonars:
                for order, ping in self._pings(scene, name, run, failed, one_by_one, tell):
                    row = rows[order.number - numbers[0]]
                    self.columns.of(row, "status")[:] = table.MADE
                    self.columns.of(row, ("has_echo", name))[:] = ping.meta["has_echo"]
                    self.columns.of(row, ("echo", name))[:] = ping.intensity.sum(dtype=np.float64)
                    noisy = add_noise(ping, order.noise, self.orders.noise_seed(name), order.number)
                    for output in self.outputs:
                        output.take(order, name, noisy)
        if len(failed) == len(numbers) > 1 and not set_aside and len(set(failed.values())) == 1:
            raise Error(f"no ping of part {part} could be made ({failed[numbers[0]]})")
        for n in failed:
            self.columns.of(rows[n - numbers[0]], "status")[:] = table.SET_ASIDE
        files = [name for output in self.outputs for name in output.end()]
        self.folder.put(table_name(part), table.to_bytes(rows))
        heard = [self.columns.of(rows, ("has_echo", name)) == 1 for name in self.orders.sonars]
        silent = (self.columns.of(rows, "status") == table.MADE) & ~np.any(heard, axis=0)
        record = {
            "part": part,
            "first": numbers[0],
            "pings": len(numbers),
            "set_aside": {str(n): why for n, why in sorted(failed.items())},
            "without_echo": int(silent.sum()),
            "files": {file: self.folder.checksum(file) for file in [*files, table_name(part)]},
        }
        self.folder.put_json(record_name(part), record)
        return record

    def _pings(self, scene, name, run, failed, one_by_one, tell):
        """(order, ping) of each of consecutive pings in one scene; those that fail go to `failed`."""
        simulator, mount = self.simulators(scene)[name], self.orders.mounts[name]
        labels = self.orders.job.labels is not None
        background = self.kept.background(scene)
        run = [order for order in run if order.number not in failed]
        if run and not one_by_one:
            tell("from", run[0].number)
            several = simulator.pings(
                [order.pose @ mount for order in run],
                labels=labels,
                bodies=[order.bodies for order in run],
                times_s=[order.time_s for order in run],
                reflectivities=[order.reflectivity for order in run],
                waters=[order.water or None for order in run],
                background=background,
            )
            try:
                for order in run[:]:
                    ping = self._quietly(next, several, tell)
                    yield order, ping
                    run.pop(0)
                    tell("after", order.number)
            except (OSError, MemoryError, GeneratorExit):
                raise
            except Exception:  # of whichever ping; by themselves they tell
                several.close()
        for order in run:
            for attempt in range(TRIES):
                tell("before", order.number)
                try:
                    ping = self._quietly(
                        lambda order: simulator.ping(
                            order.pose @ mount,
                            labels=labels,
                            bodies=order.bodies,
                            time_s=order.time_s,
                            reflectivity=order.reflectivity,
                            water=order.water or None,
                            background=background,
                        ),
                        order,
                        tell,
                    )
                except (OSError, MemoryError):
                    raise
                except Exception as why:
                    if attempt == TRIES - 1:
                        name = "" if isinstance(why, Error) else f"{type(why).__name__}: "
                        failed[order.number] = f"{name}{why}"
                else:
                    yield order, ping
                    tell("after", order.number)
                    break

    def _quietly(self, function, argument, tell):
        """What a function makes of an argument; its warnings are told, but for that of no echo."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            ping = function(argument)
        for warning in caught if ping.meta["has_echo"] else ():
            tell("warning", str(warning.message))
        return ping
