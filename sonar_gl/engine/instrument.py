"""A sonar with its acoustics: what all of its pings have in common, whoever draws them."""

from __future__ import annotations

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.engine.flow import PingSetup
from sonar_gl.engine.provenance import Provenance
from sonar_gl.engine.request import PingRequest
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.sonar import Sonar


class Instrument:
    """A sonar with its acoustics.

    sonar, acoustics
    azimuth_rad, range_m : (B,) and (K,), read-only, of every ping
    gain : (K,) float32 of each bin
    provenance : Provenance of its pings
    """

    def __init__(self, sonar: Sonar, acoustics: Acoustics):
        self.sonar, self.acoustics = sonar, acoustics
        self.azimuth_rad, self.range_m = sonar.azimuth_rad, sonar.range_m
        for axis in (self.azimuth_rad, self.range_m):
            axis.setflags(write=False)  # all pings share them
        self.gain, self._pulse = self._receiver_in(acoustics)
        self.provenance = Provenance(sonar, acoustics)

    def set_up(self, request: PingRequest, state: SceneState | None, n_bodies: int, **of_scene) -> PingSetup:
        """Return a request with what it takes to receive it; `of_scene` are fields of `PingSetup` that have defaults.

        Raises Error if its water makes no sense.
        """
        acoustics, gain, pulse = self.acoustics, self.gain, self._pulse
        if request.water is not None:
            acoustics = acoustics.in_water(request.water)
            gain, pulse = self._receiver_in(acoustics)
        head_pose = self.sonar.head_pose(request.pose)
        return PingSetup(request, head_pose, state, acoustics, gain, pulse, n_bodies, **of_scene)

    def _receiver_in(self, acoustics: Acoustics) -> tuple[np.ndarray, np.ndarray | None]:
        """Return gain and pulse in some water."""
        gain = acoustics.range_gain(self.sonar.range_m, self.sonar).astype(np.float32)
        return gain, acoustics.pulse_weights(self.sonar)
