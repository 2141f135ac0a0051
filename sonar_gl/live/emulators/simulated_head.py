"""A sonar in a scene whose settings change while it runs; what emulators ask for pings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.live.simulators import SimulatorPool
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene
from sonar_gl.sonar.sonar import Sonar


class SimulatedHead:
    """Makes pings of one scene with sonars and acoustics that change. To be used by one thread, then closed.

    sonar : that the scene is prepared for
    track : of the sonar
    """

    def __init__(
        self,
        scene: Scene,
        sonar: Sonar,
        acoustics: Acoustics,
        noise: Noise,
        track: PoseTrack,
        tolerance: float = 0.05,
        seed: int = 0,
    ):
        self.acoustics, self.track = acoustics, track
        self._noise, self._tolerance, self._seed = noise, tolerance, seed
        self._simulators = SimulatorPool(scene)
        self.renderer = self._simulators.simulator(sonar, acoustics, tolerance).gl_info["renderer"]

    def ping(
        self, sonar: Sonar, acoustics: Acoustics, time_s: float, number: int, turn: np.ndarray | None = None
    ) -> Ping:
        """Return a ping at a time in seconds.

        number : of the ping, for its noise
        turn : (4, 4) pose of the transducer in the sonar; None where they are the same
        """
        pose = self.track.at(time_s)
        pose = pose if turn is None else pose @ turn
        simulator = self._simulators.simulator(sonar, acoustics, self._tolerance)
        with collected_warnings(NoEchoWarning):  # a device does not say that it sees nothing
            ping = simulator.ping(pose, self._noise, self._seed, ping_number=number, time_s=time_s)
        return replace(ping, sonar=sonar)

    def close(self) -> None:
        self._simulators.close()
