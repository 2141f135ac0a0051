"""What a ping says of its making: its `meta`."""

from __future__ import annotations

from dataclasses import dataclass

from sonar_gl._version import __version__
from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.sonar.sonar import Sonar


@dataclass(frozen=True)
class SampleOrigin:
    """Where the samples of pings come from, as their `meta` tells it.

    scene : name of the scene
    bodies, plumes : their names
    tolerance : that the samples keep, or None
    gl_renderer : what draws
    engine : "opengl" or "cpu"; "host" where a host program draws
    """

    scene: str
    bodies: tuple[str, ...]
    plumes: tuple[str, ...]
    tolerance: float | None
    gl_renderer: str
    engine: str = "host"


class _Template:
    """A table, or a list, of plain values, to be copied with the tables and lists in it: much quicker than deepcopy."""

    def __init__(self, values: dict | list):
        self._values = values
        items = values.items() if isinstance(values, dict) else enumerate(values)
        self._parts = [(key, _Template(value)) for key, value in items if isinstance(value, (dict, list))]

    def copy(self) -> dict | list:
        """Return a copy, which shares nothing that can be changed."""
        out = self._values.copy()
        for key, part in self._parts:
            out[key] = part.copy()
        return out


class Provenance:
    """Makes the `meta` of pings of one sonar."""

    def __init__(self, sonar: Sonar, acoustics: Acoustics):
        self._sonar, self._acoustics, self._last = sonar, acoustics, (None, None)

    def meta(self, origin: SampleOrigin, acoustics: Acoustics, **own) -> dict:
        """Return the meta of a ping; `own` is of this ping alone. Threads may call it at once."""
        last = self._last  # read once, and replaced as a whole
        if origin is not last[0] and origin != last[0]:
            last = self._last = origin, _Template(self._described(origin))
        meta = last[1].copy() | own  # each ping gets its own
        if acoustics is not self._acoustics:
            meta |= self._water(acoustics)
        return meta

    def _described(self, origin: SampleOrigin) -> dict:
        """Return the part of the meta that all pings of an origin have in common."""
        return {
            "sonar": self._sonar.meta(),
            **self._water(self._acoustics),
            "profile": self._acoustics.profile,
            "tolerance": origin.tolerance,
            "bin_size_m": self._sonar.bin_size_m,
            "scene": origin.scene,
            "bodies": list(origin.bodies),
            **({"plumes": list(origin.plumes)} if origin.plumes else {}),
            "version": __version__,
            "gl_renderer": origin.gl_renderer,
            "engine": origin.engine,
        }

    def _water(self, acoustics: Acoustics) -> dict:
        return {
            "acoustics": acoustics.meta(),
            "absorption_db_m": acoustics.water.absorption(self._sonar.frequency_hz),
            "sound_speed_m_s": acoustics.water.sound_speed(),
        }
