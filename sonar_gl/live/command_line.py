"""Live settings as the texts that command lines and job files hold."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import DEFAULT_WATER
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import pose_numbers
from sonar_gl.imaging.colormaps import DEFAULT_COLORMAP
from sonar_gl.live.settings import LiveSettings
from sonar_gl.noise.settings import PRESETS, Noise
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sonar import UNPARSED, Sonar
from sonar_gl.sonar.sonar_files import presets

POSE_DECIMALS = 6  # of metres and radians: what files and command lines hold of a pose


@dataclass(frozen=True)
class SceneSource:
    """How a command line names a scene and the sonar that a session begins with."""

    name: str  # of a bundled scene, or a path
    # resource_paths, skip_missing, without, only, surface_z_m: as the options of `sonar-gl render`
    resource_paths: tuple[str, ...] = ()
    skip_missing: bool = False
    without: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    surface_z_m: float | None = None
    # text of `load_sonar`, of `loaded`; None if the sonar is the scene's own, or made in Python
    sonar: str | None = None
    loaded: Sonar | None = None  # the Sonar that the text names

    def words(self) -> list[str]:
        out = [self.name]
        for option, values in (
            ("--resource-path", self.resource_paths),
            ("--without", self.without),
            ("--only", self.only),
        ):
            for value in values:
                out += [option, value]
        out += ["--skip-missing"] if self.skip_missing else []
        return out if self.surface_z_m is None else [*out, "--surface", repr(self.surface_z_m)]


def rounded_pose_numbers(world_from_sonar: np.ndarray) -> list[float]:
    """Return x y z roll pitch yaw with as many decimals as files and command lines hold."""
    # + 0.0 makes 0 of -0
    return [round(number, POSE_DECIMALS) + 0.0 for number in pose_numbers(world_from_sonar)]


def changes(new, old, without: Iterable[str] = ()) -> dict:
    """Return the fields of a dataclass that differ from those of another, by name."""
    names = [field.name for field in fields(new) if field.name not in set(without)]
    return {name: getattr(new, name) for name in names if getattr(new, name) != getattr(old, name)}


def changes_text(values: Mapping) -> str:
    """Return `key=value,...`, as `core.key_values.parse_fields` reads it.

    >>> changes_text({"pulse": False, "tvg_k": 30.0, "range_law": "constant", "tvg_absorption_db_m": None})
    'pulse=no,tvg_k=30.0,range_law=constant,tvg_absorption_db_m=none'
    """
    return ",".join(f"{name}={_value_text(value)}" for name, value in values.items())


def _value_text(value) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def sonar_text(sonar: Sonar, source: SceneSource) -> tuple[str, Counts]:
    """Return the text by which `load_sonar` makes a sonar again, and the law of counts, which is not changed, of that.

    Raises Error where no text does.
    """
    known = [(name, one) for name, one in presets().items() if one.name == sonar.name]
    if source.loaded is not None:
        known.append((source.sonar, source.loaded))
    texts = []
    for name, one in known:
        found = changes(sonar, one, without=["counts"])
        if not set(UNPARSED) & set(found):
            # the user's text may change a field that is changed once more
            items = [item for item in name.split(",") if item.partition("=")[0].strip() not in found]
            text = ",".join([*items, changes_text(found)]) if found else name
            texts.append((len(found), text, one.counts))
    if not texts:
        raise Error(
            f"a sonar on a command line must be a preset, or of a .toml file (got {sonar.name!r}, made otherwise; "
            "write it to a file by sonar_gl.save_sonar or 'sonar-gl sonars --scene', and give that by --sonar)"
        )
    return min(texts, key=lambda one: one[:2])[1:]


def acoustics_changes(acoustics: Acoustics) -> dict:
    """Return the fields in which acoustics differ from their profile, but for the water."""
    return changes(acoustics, Acoustics(acoustics.profile), without=["profile", "water"])


def noise_changes(noise: Noise) -> tuple[str, dict]:
    """Return the preset of noise from which fewest fields differ, and these."""
    found = {name: changes(noise, preset) for name, preset in PRESETS.items()}
    name = min(found, key=lambda name: len(found[name]))
    return name, found[name]


def render_line(
    settings: LiveSettings, world_from_sonar: np.ndarray, source: SceneSource, own: Sonar | None
) -> str:
    """Return the line of a shell by which `sonar-gl render` makes the picture of these settings.

    Raises Error if no text names the sonar.

    world_from_sonar : (4, 4), which is rounded
    own : the scene's own Sonar
    """
    words = ["sonar-gl", "render", *source.words()]
    sonar, acoustics = settings.sonar, settings.acoustics
    base_counts = sonar.counts
    if sonar != own or source.sonar is not None:
        text, base_counts = sonar_text(sonar, source)
        words += ["--sonar", text]
    if settings.range_m is not None:
        words += ["--range", repr(float(settings.range_m))]
    if settings.n_bins is not None:
        words += ["--bins", str(settings.n_bins)]
    preset, amounts = noise_changes(settings.noise)
    law = settings.law
    values = {
        "--profile": "" if acoustics.profile == "physical" else acoustics.profile,
        "--acoustics": changes_text(acoustics_changes(acoustics)),
        "--water": changes_text(changes(acoustics.water, DEFAULT_WATER)),
        "--noise": ",".join(filter(None, [preset, changes_text(amounts)])),
        "--counts": changes_text({"law": law.law, **changes(law, base_counts)}) if law != base_counts else "",
        "--colormap": "" if settings.colormap == DEFAULT_COLORMAP else settings.colormap,
        "--height": str(settings.height),
        "--tolerance": repr(float(settings.tolerance)),
        "--engine": settings.engine or "",
        "--seed": str(settings.seed) if settings.seed else "",
        "--pose": " ".join(
            f"{number:g}" if number == int(number) else str(number)
            for number in rounded_pose_numbers(world_from_sonar)
        ),
    }
    for option, text in values.items():
        words += [option, text] if text else []
    return shlex.join(words)
