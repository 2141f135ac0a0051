"""What commands share: the objects that options stand for, and progress."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import DEFAULT_WATER, Water
from sonar_gl.cli.options import POSE
from sonar_gl.cli.output import echo
from sonar_gl.core.checks import check_number
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.poses import pose, read_poses
from sonar_gl.scene.load import load_scene
from sonar_gl.scene.scene import Scene, hull_patterns, hull_text
from sonar_gl.scene.sonar_sensor import DEFAULT_SONAR
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

MAX_NAMED = 3  # sensors that are not taken
FILES = ".png", ".npz", ".gif", ".mp4"  # ends of the names of files that commands write
FILES_ARE_COMPLETE = "the files written so far are complete"  # of a KeyboardInterrupt


def scene_from(scene_name: str, options) -> Scene:
    """Return the scene of a command line, with the bodies and the water's surface that its options name."""
    scene = loaded = load_scene(scene_name, options.resource_path, options.skip_missing)
    if options.only:
        scene = scene.only(*options.only)
    if options.without:
        scene = scene.without(*options.without)
    if loaded.bodies and not scene.bodies:
        n = len(loaded.bodies)
        left_out = f"all {n} bodies" if n > 1 else f"{loaded.bodies[0].name!r}, the only body"
        raise Error(
            f"--without and --only must leave a body (they leave out {left_out} of scene {scene.name!r}; "
            "'sonar-gl doctor --scene' lists them)"
        )
    return scene if options.surface is None else scene.with_surface(options.surface)


def sonar_from(options, scene: Scene) -> Sonar:
    """Return the sonar of --sonar, --range and --bins; without --sonar the scene's or a preset, and say which."""
    if options.sonar is None:
        echo(f"sonar: {describe_sonar(scene)}", err=True)
        sonar = scene.sonar or load_sonar(DEFAULT_SONAR)
    else:
        sonar = named_sonar(options.sonar)
    if options.range is not None:
        sonar = sonar.with_range(options.range, options.bins)
    elif options.bins is not None:
        sonar = replace(sonar, n_bins=options.bins)
    if beyond := sonar.beyond_limit_text():
        warnings.warn(beyond, stacklevel=2)
    return sonar


def named_sonar(text: str) -> Sonar:
    """Return the sonar of --sonar, in which ~ is the home folder."""
    return load_sonar(os.path.expanduser(text))


def describe_sonar(scene: Scene) -> str:
    """Return which sonar a command takes for a scene without --sonar."""
    if scene.sonar is None:
        return f"preset {DEFAULT_SONAR}, as the scene states none"
    first, *others = scene.sensors
    text = f"the scene's own, {first}: {first.describe()}"
    if not others:
        return text
    more = f" and {len(others) - MAX_NAMED} more" if len(others) > MAX_NAMED else ""
    return f"{text}; not taken: {', '.join(map(str, others[:MAX_NAMED]))}{more}"


def acoustics_from(options, profile: str) -> Acoustics | None:
    """Return the acoustics of --water and --acoustics, which changes `profile`; None for `--acoustics needed`."""
    water = water_from(options)
    if options.acoustics == "needed":
        if profile != "physical":
            raise Error(f"--acoustics needed needs --profile physical (got --profile {profile})")
        return None
    if options.acoustics is None:
        return Acoustics(profile, water=water)
    try:
        return replace(Acoustics.parse(options.acoustics, profile), water=water)
    except Error as why:
        raise Error(f"--{why}") from None


def water_from(options) -> Water:
    if options.water is None:
        return DEFAULT_WATER
    try:
        return Water.parse(options.water)
    except Error as why:
        raise Error(f"--{why}") from None


def poses_from(options, scene: Scene) -> tuple[np.ndarray | None, list | np.ndarray]:
    """Return the times (None for a single ping) and poses of --poses, --pose or the scene."""
    if options.pose is not None and options.poses is not None:
        raise Error(
            "--pose and --poses exclude each other (the file of --poses has all poses; leave one out)"
        )
    if options.poses is not None:
        return read_poses(options.poses)
    if options.pose is not None:
        return None, [_parse_pose(options.pose)]
    if scene.sonar_pose is None:
        raise Error(f"scene {scene.name!r} has no sonar in it; give its place with --pose {POSE}")
    return None, [scene.sonar_pose]


def warn_of_hull(scene: Scene) -> None:
    """Warn that a sonar that moves leaves the hull of its vehicle behind, if the scene has one."""
    if (model := scene.vehicle()) is not None:
        options = " ".join(f"--without '{pattern}'" for pattern in hull_patterns(scene, model))
        warnings.warn(f"{hull_text(model)} (leave it out: {options})", stacklevel=2)


def _parse_pose(text: str) -> np.ndarray:
    must = "--pose must be 6 numbers, 'x y z roll pitch yaw'"
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise Error(f"{must} (got {text!r})") from None
    if len(values) != 6:
        raise Error(f"{must} (got {len(values)}: {text!r})")
    with errors_at(f"--pose {text!r}"):
        return pose(*values)


def check_duration(options) -> None:
    if options.duration is not None:
        check_number("--duration", options.duration, 0.0, 1e9, "seconds")


def check_output(options) -> None:
    """Raise an Error where --out looks like the name of a file; a folder of that name may be there."""
    if Path(options.out).suffix.lower() in FILES and not os.path.exists(options.out):
        raise Error(
            f"--out must be a folder (got {options.out!r}; the files in it are named after the scene)"
        )


def check_address(option: str, text: str) -> None:
    """Raise an Error for an address of no characters, which would be that of all networks."""
    if not text:
        raise Error(f"{option} must be an address (got an empty text; is a variable of the shell empty?)")


def progress(numbers):
    """Return a context manager that yields `numbers`: with a progress bar on a terminal, else without."""
    if sys.stderr.isatty():
        return click.progressbar(numbers, file=sys.stderr)
    return contextlib.nullcontext(numbers)
