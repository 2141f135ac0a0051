"""Sonars, acoustics and noise of a job: built from its tables, and checked."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics, check_moved
from sonar_gl.acoustics.water import Water
from sonar_gl.batch.job import Job, SonarTable, build, check_keys
from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.input_files import check_no_link_loop
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.noise.receiver import receiver_levels_db
from sonar_gl.noise.settings import PRESETS, Noise, check_moved_amounts
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar, split_sonar


def check_settings(job: Job, sonars: dict[str, Sonar], acoustics: Acoustics, noise: Noise) -> None:
    """Raise an Error if settings of a job do not go with its sonars."""
    with errors_at(f"{job.where}: noise"):
        for sonar in sonars.values():  # those of which the noise needs more than they have
            receiver_levels_db(noise, sonar, acoustics)
    for output, table in job:
        if hasattr(table, "counts"):
            counts_of_output(job, sonars, output)


def counts_of_output(job: Job, sonars: dict[str, Sonar], output: str) -> dict[str, Counts]:
    """Return the law of each sonar's counts in an output such as "pictures", whose table may change the sonar's.

    Raises Error if the changes do not go with the law of a sonar.
    """
    table = getattr(job, output)
    with errors_at(f"{job.where}: {output}"):
        changes = {} if table is None else table.counts
        return {name: sonar.counts.changed(changes) for name, sonar in sonars.items()}


def can_only_be_file(name: str) -> bool:
    """Return whether a name can only be that of a file beside the job: presets and bundled scenes have no such name."""
    return Path(name).suffix != "" or len(Path(name).parts) > 1


def load_sonars(job: Job) -> tuple[dict[str, Sonar], dict[str, np.ndarray]]:
    """Return the sonars of a job by name, and their mounts, (4, 4) vehicle_from_sonar."""
    sonars, mounts = {}, {}
    for k, table in enumerate(job.sonars):
        where = f"{job.where}: sonars[{k}]"
        sonar = _load_sonar(job, table, where)
        plain = "".join(c if c.isalnum() else "_" for c in sonar.name)
        name = table.name or (plain if plain[:1].isalpha() else f"sonar_{plain}")
        if name in sonars:
            raise Error(f"{where}.name must differ from those before (got {name!r})")
        sonars[name], mounts[name] = sonar, make_pose(*table.mount)
    return sonars, mounts


def _load_sonar(job: Job, table: SonarTable, where: str) -> Sonar:
    name, more = split_sonar(table.sonar)
    path = job.path(name)
    with errors_at(where):
        check_no_link_loop(path)
        sonar = load_sonar(f"{path}{more}" if path.is_file() or can_only_be_file(name) else table.sonar)
        if table.range_m is None:
            return sonar if table.bins is None else replace(sonar, n_bins=table.bins)
    with errors_at(f"{where}.range_m"):
        return sonar.with_range(table.range_m, table.bins)


def build_acoustics(job: Job) -> Acoustics:
    """Return the acoustics of a job, before variation."""
    where = f"{job.where}: acoustics"
    check_moved(where, job.acoustics)
    if "water" in job.acoustics:
        raise Error(f"{where}: water is a table of its own (give a line [water], or water = {{ ... }})")
    return build(Acoustics, {**job.acoustics, "water": build(Water, job.water, f"{job.where}: water")}, where)


def build_noise(job: Job) -> Noise:
    """Return the noise of a job, before variation."""
    settings, where = dict(job.noise), f"{job.where}: noise"
    preset = settings.pop("preset", "none")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise Error(f"{where}.preset must be one of {', '.join(PRESETS)} (got {shown(preset)})")
    check_moved_amounts(where, settings)
    settings = asdict(PRESETS[preset]) | settings
    check_keys(Noise, settings, where, also=("preset",))
    return build(Noise, settings, where)
