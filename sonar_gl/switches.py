"""The terms of the acoustics and of the noise that can be switched on and off one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from sonar_gl.acoustics import Acoustics
from sonar_gl.noise import Noise
from sonar_gl.sonar import Sonar


@dataclass(frozen=True, eq=False)
class Term:
    """One term, and what switches it.

    Attributes
    ----------
    name : as it is told
    on : function (acoustics, noise, sonar) -> fields to change where the term is off, {} where it is on
    off : fields to change
    of_noise : whether the fields are those of Noise, or of Acoustics
    """

    name: str
    on: Callable
    off: dict
    of_noise: bool = False


def _switch(key: str, on, off):
    """Of a field that is `off` or something else: `on`, where nothing else is said."""
    return lambda acoustics, noise, sonar: {key: on} if getattr(acoustics, key) == off else {}


def _absorption(acoustics, noise, sonar):
    return {"absorption_db_m": None} if acoustics.absorption_db_m == 0 else {}


def _pulse(acoustics, noise, sonar):
    """A pulse as short as the bins, tapered: without, its side lobes would reach over hundreds of them."""
    if acoustics.bandwidth_hz is not None:
        return {}
    speed_m_s = acoustics.sonar_sound_speed_m_s or acoustics.sound_speed()
    return {"bandwidth_hz": speed_m_s / (2 * sonar.bin_size_m), "pulse_taper": "hamming"}


def _receiver(acoustics, noise, sonar):
    heard = (noise.electronic_db, noise.ambient_db) != (None, None)
    return {} if heard else {"electronic_db": Noise.physical().electronic_db}


TERMS = (
    # the TVG stays as it is set: where it believes in the right absorption, in none
    Term("absorption", _absorption, {"absorption_db_m": 0.0}),
    Term(
        "azimuth pattern",
        _switch("beam_pattern", "line_array", "box"),
        {"beam_pattern": "box", "steered": "alike"},
    ),
    Term(
        "elevation pattern",
        _switch("elevation_pattern", "line_array", "box"),
        {"elevation_pattern": "box"},
    ),
    Term("pulse", _pulse, {"bandwidth_hz": None}),
    Term("lobes", _switch("specular", True, False), {"specular": False}),
    Term("bubbles", _switch("bubbles", True, False), {"bubbles": False}),
    Term("multipath", _switch("multipath", "incoherent", "none"), {"multipath": "none"}),
    Term(
        "speckle",
        lambda acoustics, noise, sonar: {} if noise.speckle else {"speckle": True},
        {"speckle": False, "speckle_shape": None, "looks": 1, "follow_motion": False},
        of_noise=True,
    ),
    Term("receiver noise", _receiver, {"electronic_db": None, "ambient_db": None}, of_noise=True),
)
SPECKLE = TERMS[-2]


def everything_on(acoustics: Acoustics, noise: Noise, sonar: Sonar) -> tuple[Acoustics, Noise]:
    """Both with every term switched on; what is on already stays as it is."""
    for term in TERMS:
        more = term.on(acoustics, noise, sonar)
        if term.of_noise:
            noise = replace(noise, **more)
        else:
            acoustics = replace(acoustics, **more)
    return acoustics, noise


def without(acoustics: Acoustics, noise: Noise, terms) -> tuple[Acoustics, Noise]:
    """Both with some terms switched off."""
    for term in terms:
        if term.of_noise:
            noise = replace(noise, **term.off)
        else:
            acoustics = replace(acoustics, **term.off)
    return acoustics, noise
