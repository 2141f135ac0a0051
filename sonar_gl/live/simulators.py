"""Simulators of one scene whose settings change: those of the last settings are kept."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.scene.scene import Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.counts import DEFAULT_COUNTS
from sonar_gl.sonar.sonar import Sonar

MAX_SIMULATORS = 4  # settings between which a user changes to and fro


class SimulatorPool:
    """Simulators of one scene in one world. To be used by one thread, then closed."""

    def __init__(self, scene: Scene):
        self._scene, self._engine, self._placed = scene, None, {}
        self._simulators: OrderedDict[tuple[Sonar, Acoustics, float], Simulator] = OrderedDict()

    def simulator(
        self, sonar: Sonar, acoustics: Acoustics, tolerance: float, engine: str | None = None
    ) -> Simulator:
        """Return the simulator of these settings; the one that was not used for longest makes room.

        Its law of counts is the default. Another engine than before makes all others go. An Error of the new simulator
        leaves the others as they are.
        """
        # another law needs no other simulator, whose first ping takes far longer
        sonar = replace(sonar, counts=DEFAULT_COUNTS)
        key = sonar, acoustics, tolerance
        if engine != self._engine or not self._simulators:
            simulator = Simulator(self._scene, sonar, acoustics, tolerance=tolerance, engine=engine)
            self.close()
            self._engine = engine
            self._simulators[key] = simulator
            simulator.place(self._placed)
        elif key not in self._simulators:
            known = next(reversed(self._simulators.values()))
            self._simulators[key] = Simulator(known, sonar, acoustics, tolerance=tolerance)
            while len(self._simulators) > MAX_SIMULATORS:
                self._simulators.popitem(last=False)[1].close()
        self._simulators.move_to_end(key)
        return self._simulators[key]

    def place(self, bodies: Mapping[str, np.ndarray | None]) -> None:
        """Put bodies elsewhere from now on, as `Simulator.place` does, also in worlds to come."""
        if self._simulators:
            next(iter(self._simulators.values())).place(dict(bodies))
        self._placed |= bodies

    def close(self) -> None:
        """Give back all that it holds; it may be used again."""
        while self._simulators:
            self._simulators.popitem()[1].close()
