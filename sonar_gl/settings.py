"""What the settings of `Acoustics` may be, and what each profile makes of them."""

from __future__ import annotations

import numpy as np

from sonar_gl.patterns import TAPERS
from sonar_gl.types import Error, nearest_names
from sonar_gl.water import ABSORPTION_FORMULAS, SOUND_SPEED_FORMULAS

RANGE_LAWS = ("constant", "printed", "inverse", "sonar_equation")
PROFILES = {  # name: what it decides where nothing else is said
    "ideal": {"range_law": "constant", "beam_pattern": "box", "specular": False, "bubbles": False},
    "demarco2015": {"range_law": "printed", "beam_pattern": "box", "specular": False, "bubbles": False},
    "physical": {
        "range_law": "sonar_equation",
        "beam_pattern": "line_array",
        "specular": True,
        "bubbles": True,
    },
}
NAMES = {  # field: what it may be called
    "range_law": RANGE_LAWS,
    "beam_pattern": ("box", "line_array", "gaussian"),
    "absorption_formula": tuple(ABSORPTION_FORMULAS),
    "sound_speed_formula": tuple(SOUND_SPEED_FORMULAS),
    "taper": TAPERS,
    "steered": ("alike", "straight"),
    "transmit_taper": TAPERS,
    "elevation_pattern": ("box", "line_array", "gaussian"),
    "elevation_taper": TAPERS,
    "pulse_taper": ("uniform", "hamming"),
    "multipath": ("none", "incoherent", "coherent"),
}
BOUNDS = (
    ("temperature_c", -2, 40, "give °C"),
    ("salinity_psu", 0, 45, "give grams of salt per kilogram of water"),
    ("depth_m", 0, 12000, "give metres below the surface, positive down"),
    ("ph", 7, 9, "sea water has about 8"),
    ("absorption_db_m", 0, 1e5, "give dB per metre one way, a thousandth of dB per km"),
    ("tvg_k", 0, 60, "usual are 20, 30 and 40"),
    ("tvg_absorption_db_m", 0, 1e5, "give dB per metre one way, a thousandth of dB per km"),
    ("sound_speed_m_s", 1000, 2000, "give metres per second, about 1500 in water"),
    ("sonar_sound_speed_m_s", 1000, 2000, "give metres per second, about 1500 in water"),
    ("side_lobe_db", 15, 60, "give dB below the main lobe, positive"),
    ("transmit_width_deg", 1e-3, 180, "give degrees"),
    ("bandwidth_hz", 1, 1e8, "give hertz, 30e3 for 30 kHz"),
)


def check(acoustics):
    """Fill in what the profile decides.

    Raises
    ------
    Error
        if a name is unknown or a number makes no sense.
    """
    _check_name(acoustics, "profile", PROFILES)
    for key, own in PROFILES[acoustics.profile].items():
        if getattr(acoustics, key) is None:
            object.__setattr__(acoustics, key, own)
    for key, known in NAMES.items():
        _check_name(acoustics, key, known)
    for key in ("specular", "bubbles"):
        if not isinstance(getattr(acoustics, key), bool):
            raise Error(f"acoustics: {key} must be True or False (got {getattr(acoustics, key)!r})")
    for key, low, high, hint in BOUNDS:
        value = getattr(acoustics, key)
        if value is None and acoustics.__dataclass_fields__[key].default is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
            raise Error(f"acoustics: {key} must be a number (got {value!r})")
        if not low <= value <= high:  # NaN too
            raise Error(f"acoustics: {key} must lie in {low:g}..{high:g} (got {value:g}; {hint})")
    if acoustics.steered == "straight" and acoustics.beam_pattern == "box":
        raise Error(
            'acoustics: steered "straight" needs a beam_pattern that a straight array can have '
            '(got \'box\'; take "line_array" or "gaussian")'
        )


SWITCHES = {
    "yes": True,
    "true": True,
    "on": True,
    "1": True,
    "no": False,
    "false": False,
    "off": False,
    "0": False,
}


def parse(text: str, fields) -> dict:
    """Values of `Acoustics`' fields from a command line, "key=value,..."; none is None where that may be.

    Raises
    ------
    Error
        if a field is unknown or given twice, or its value is of another kind.
    """
    kinds, out = {field.name: field.type for field in fields if field.name != "profile"}, {}
    for item in text.split(","):
        key, equals, value = (part.strip() for part in item.partition("="))
        if key == "needed":
            raise Error(f"acoustics {text!r}: needed must stand alone: it chooses the terms itself")
        if not key:
            raise Error(
                f"acoustics {text!r}: must be key=value, ... (got a comma or nothing where a key must be)"
            )
        if key not in kinds:
            raise Error(f"acoustics {text!r}: unknown name (got {key!r}; {nearest_names(key, kinds)})")
        if not equals:
            raise Error(f"acoustics {text!r}: {key} must have a value, as in {key}=... (got none)")
        if key in out:
            raise Error(f"acoustics {text!r}: {key} must be given once")
        kind, _, may_be_none = kinds[key].partition(" | ")
        if value == "none" and may_be_none:
            out[key] = None
        elif kind == "bool":
            if value not in SWITCHES:
                raise Error(f"acoustics {text!r}: {key} must be yes or no (got {value!r})")
            out[key] = SWITCHES[value]
        elif kind == "float":
            try:
                out[key] = float(value)
            except ValueError:
                raise Error(f"acoustics {text!r}: {key} must be a number (got {value!r})") from None
        else:
            out[key] = value
    return out


def _check_name(acoustics, key: str, known):
    value = getattr(acoustics, key)
    if str(value) not in known:
        raise Error(f"acoustics: unknown {key} (got {value!r}; {nearest_names(str(value), known)})")
