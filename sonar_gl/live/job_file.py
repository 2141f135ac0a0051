"""Poses that are added to the job file of a batch, which otherwise stays as it is, with its comments."""

from __future__ import annotations

import os
from itertools import count
from pathlib import Path

import numpy as np

from sonar_gl.acoustics.water import DEFAULT_WATER
from sonar_gl.core.atomic_file import atomic_write
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import read_poses
from sonar_gl.core.toml import read_toml, toml_text, value_text
from sonar_gl.live.command_line import (
    SceneSource,
    acoustics_changes,
    changes,
    noise_changes,
    rounded_pose_numbers,
    sonar_text,
)
from sonar_gl.live.recording import write_poses
from sonar_gl.live.settings import LiveSettings
from sonar_gl.scene.load import bundled_scenes
from sonar_gl.sonar.sonar_files import presets

STEP_S = 1.0  # between poses


def add_pose(path: Path, world_from_sonar: np.ndarray) -> None:
    """Add a pose to a job file: to a file of poses beside it, which a table [[poses]] at its end names.

    Raises Error if one of the files cannot be read or written, or the job's poses are not tables.

    path : of the job file, which exists
    world_from_sonar : (4, 4), which is rounded; in the job it is the pose of the vehicle
    """
    job = read_toml(path, "the job file")
    tables = job.get("poses", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise Error(f"{path}: poses must be tables, as in [[poses]] (got {type(tables).__name__})")
    named = [table.get("file") for table in tables]
    # the file that the job names, or else one that no other job has left there
    names = (f"{path.stem}_view{'' if number == 1 else f'_{number}'}.csv" for number in count(1))
    csv = next(csv for csv in map(path.with_name, names) if csv.name in named or not csv.exists())
    rows, names_csv = [], csv.name in named
    if csv.exists():
        times_s, poses = read_poses(csv)
        rows = [
            [float(time_s), *rounded_pose_numbers(pose)] for time_s, pose in zip(times_s, poses, strict=True)
        ]
    time_s = rows[-1][0] + STEP_S if rows else 0.0
    rows.append([time_s, *rounded_pose_numbers(world_from_sonar)])
    if names_csv:
        write_poses(csv, rows)
        return
    text = path.read_text(encoding="utf-8")
    table = f'\n[[poses]]\nkind = "trajectory"\nfile = {value_text(csv.name)}  # by sonar-gl view\n'
    with atomic_write(path) as beside:
        beside.write_text(text + ("" if text.endswith("\n") else "\n") + table, encoding="utf-8")
        try:
            read_toml(beside, "the job file")
        except Error:
            raise Error(
                f"{path}: poses must be tables [[poses]], so that another can follow (got poses = [...] in one line)"
            ) from None
        write_poses(csv, rows)  # before the job names it


def new_job_text(name: str, settings: LiveSettings, source: SceneSource) -> str:
    """Return a job file without poses, in which the first `add_pose` makes the table that a job needs.

    Raises Error if no text names the sonar.
    """
    scene = source.name if source.name in bundled_scenes() else str(Path(source.name).absolute())
    top = {"name": name, "scenes": [scene], "seed": settings.seed, "tolerance": float(settings.tolerance)}
    if source.resource_paths:
        top["resource_paths"] = [str(Path(one).absolute()) for one in source.resource_paths]
    top |= {"skip_missing": True} if source.skip_missing else {}
    top |= {key: list(getattr(source, key)) for key in ("without", "only") if getattr(source, key)}
    top |= {} if source.surface_z_m is None else {"surface_z_m": float(source.surface_z_m)}
    acoustics = settings.acoustics
    preset, amounts = noise_changes(settings.noise)
    sonar = {"sonar": _from_anywhere(sonar_text(settings.sonar, source)[0])}
    sonar |= {} if settings.range_m is None else {"range_m": float(settings.range_m)}
    sonar |= {} if settings.n_bins is None else {"bins": settings.n_bins}
    tables = {
        "# poses that sonar-gl view has added": top,
        "[acoustics]": {"profile": acoustics.profile, **acoustics_changes(acoustics)},
        "[water]": changes(acoustics.water, DEFAULT_WATER),
        "[noise]": {"preset": preset, **amounts},
        "[[sonars]]": sonar,
    }
    parts = []
    for head, values in tables.items():
        if values:
            parts.append(f"{head}\n{toml_text(values)}")
    return "\n".join(parts)


def _from_anywhere(text: str) -> str:
    """Return a text of `load_sonar` with an absolute path, since paths in a job start at its folder."""
    if text.partition(",")[0].strip().casefold() in presets():
        return text
    return str(Path(os.path.expanduser(text)).absolute())  # as `load_sonar` of a command has it
