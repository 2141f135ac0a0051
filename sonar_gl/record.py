"""What the pings of a run say of themselves, and the last steps that make one."""

from __future__ import annotations

import pickle
from dataclasses import asdict

from sonar_gl._version import __version__
from sonar_gl.acoustics import Acoustics
from sonar_gl.motion import in_motion
from sonar_gl.pulse import smear
from sonar_gl.sonar import Sonar
from sonar_gl.types import Ping


class Record:
    """What all pings of a sonar have in common.

    Attributes
    ----------
    axes : azimuths of beams and ranges of bins, of every ping
    described : key of what was described last
    """

    def __init__(self, sonar: Sonar, acoustics: Acoustics):
        self.sonar, self.acoustics, self.described, self._meta = sonar, acoustics, None, b""
        self.axes = sonar.azimuth_rad, sonar.range_m
        for axis in self.axes:
            axis.setflags(write=False)  # all pings share them
        self._pulse = acoustics.pulse_weights(sonar)

    def describe(self, key, scene: str, bodies, plumes, tolerance: float | None, gl_renderer: str) -> None:
        """Have pings say that they are of this scene, bodies and plumes, by name; key is kept."""
        sonar = self.sonar
        meta = {
            "sonar": asdict(sonar),
            **self._water(self.acoustics),
            "profile": self.acoustics.profile,
            "tolerance": tolerance,
            "bin_size_m": sonar.bin_size_m,
            "scene": scene,
            "bodies": bodies,
            **({"plumes": plumes} if plumes else {}),
            "version": __version__,
            "gl_renderer": gl_renderer,
        }
        # each ping gets its own copy, ten times quicker than by deepcopy
        self.described, self._meta = key, pickle.dumps(meta)

    def _water(self, acoustics: Acoustics) -> dict:
        return {
            "acoustics": acoustics.meta(),
            "absorption_db_m": acoustics.absorption(self.sonar.frequency_hz),
            "sound_speed_m_s": acoustics.sound_speed(),
        }

    def ping(
        self, pose, intensity, found, sampling, seed, has_echo, estimate, velocity=None, acoustics=None,
        **more,
    ) -> Ping:  # fmt: skip
        """A ping from what was summed.

        Parameters
        ----------
        found : of `Reducer.labels`, or empty
        velocity : of `in_motion`
        acoustics : in the ping's own water, or None
        more : for its meta
        """
        pulse = self._pulse if acoustics is None else acoustics.pulse_weights(self.sonar)
        if pulse is not None:
            intensity = smear(intensity, pulse)
        for array in (intensity, *found.values()):
            if array is not None:
                array.setflags(write=False)
        meta = pickle.loads(self._meta)
        meta |= {"sampling": asdict(sampling), "seed": seed, "has_echo": has_echo, **more}
        if acoustics is not None:
            meta |= self._water(acoustics)
        ping = Ping(intensity, *self.axes, pose=pose, meta=meta, error_estimate=estimate, **found)
        return in_motion(ping, velocity, acoustics or self.acoustics)
