"""Options that commands share, and the poses that they mean."""

from __future__ import annotations

import os
from contextlib import contextmanager

import click

from sonar_gl.commands import numbers

POSE = '"x y z roll pitch yaw", metres and radians'
HELP = {
    "sonar": "A preset (`sonar-gl sonars` lists them) or a .toml file.",
    "pose": f"Place of the sonar: {POSE}.",
    "poses": "CSV file of poses, a sequence; its columns are t,x,y,z,roll,pitch,yaw.",
    "range": "Another maximum range, metres; keeps the size of a bin.",
    "bins": "Another number of bins.",
    "profile": "How sound weakens and how beams hear.",
    "acoustics": "Changes of the profile, such as tvg_k=30,multipath=coherent; or needed, by the scene.",
    "range_law": "Of profile demarco2015: eq. (4) as printed, which grows with range, or another reading.",
    "noise": "none, demarco2015, physical, or amounts such as gaussian=1e-4,median=3.",
    "style": "Of the picture: a fan image, or the founding paper's.",
    "scale": "Of a fan image's brightness.",
    "db_range": "Darkest and brightest dB of a fan image.",
    "colormap": "Of a fan image: gray, jet, viridis, and others of OpenCV.",
    "axes": "Draw ranges and azimuths about a fan image.",
    "form": "Of demarco2015: equal scales, or eqs. (8)-(9) of the paper as printed.",
    "join": "Of demarco2015: how its points are drawn.",
    "height": "Of the picture, pixels, not counting the axes.",
    "tolerance": "Share of the echo that may lie in wrong bins.",
    "device": "Index of the OpenGL device to draw with; `sonar-gl doctor` lists them.",
    "seed": "Of the noise.",
    "formats": "What to write; may be repeated. gif and mp4 are for sequences.",
    "fps": "Frames a second of gif and mp4.",
    "labels": "Add to the NPZ the strongest body of each bin, and what is known of its echo.",
    "resource_path": "Folder that model:// means; may be repeated.",
    "skip_missing": "Carry on without models that are not found.",
    "json": "Print one JSON object instead of text.",
    "out": "Folder to write into, made if it is not there.",
}


def option(name: str, *choices: str, **settings):
    """A click option, with its help; `formats` is --format, the others are called as they are."""
    flag = "--format" if name == "formats" else "--" + name.replace("_", "-")
    if choices:
        settings["type"] = click.Choice(choices)
    return click.option(flag, name, help=HELP[name], **settings)


@contextmanager
def _device_variable(index: int):
    """SONAR_GL_DEVICE for the time of the block."""
    before = os.environ.get("SONAR_GL_DEVICE")
    os.environ["SONAR_GL_DEVICE"] = str(index)
    try:
        yield
    finally:
        os.environ.pop("SONAR_GL_DEVICE")
        if before is not None:
            os.environ["SONAR_GL_DEVICE"] = before


def _draw_with(ctx, _parameter, index):
    """All contexts of a command are made on this device."""
    if index is not None:
        ctx.with_resource(_device_variable(index))


DEVICE = {
    "type": click.IntRange(min=0),
    "show_default": "the variable SONAR_GL_DEVICE, or 0",
    "callback": _draw_with,
    "expose_value": False,
}
JUDGED = {
    "sonar": {"default": "p900-45"},
    "pose": {"show_default": "the scene's"},
    "range": {"type": float},
    "bins": {"type": int},
    "profile": {"type": click.Choice(("ideal", "demarco2015", "physical")), "default": "physical"},
    "acoustics": {"show_default": "the profile's"},
    "tolerance": {"type": float, "default": 0.01},
    "device": DEVICE,
    "resource_path": {"multiple": True},
    "skip_missing": {"is_flag": True},
    "json": {"is_flag": True},
}


def judged(**more):
    """Decorator of commands that judge pings: SCENE, the options JUDGED, and more, in the order of HELP."""
    settings = {**JUDGED, **more}

    def decorate(command):
        for name in reversed([name for name in HELP if name in settings]):
            command = option(name, **settings[name])(command)
        return click.argument("scene")(command)

    return decorate


def sonar(o):
    """The Sonar that the options mean."""
    from dataclasses import replace

    from sonar_gl.sonar import load_sonar

    known = load_sonar(o.sonar)
    known = known if o.range is None else known.with_range(o.range)
    return known if o.bins is None else replace(known, n_bins=o.bins)


def acoustics(o, profile: str):
    """The Acoustics that the options mean; None where the scene is to say what it needs."""
    from sonar_gl.acoustics import Acoustics
    from sonar_gl.types import Error

    if o.acoustics == "needed":
        if profile != "physical":
            raise Error(f"--acoustics needed must stand with --profile physical (got --profile {profile})")
        return None
    if o.acoustics is None:
        return Acoustics(profile)
    try:
        return Acoustics.parse(o.acoustics, profile)
    except Error as why:
        raise Error(f"--{why}") from None


def poses(o, scene):
    """(times or None, poses) as the options and the scene have them."""
    from sonar_gl.poses import read_poses
    from sonar_gl.scene import pose
    from sonar_gl.types import Error

    if o.pose is not None and o.poses is not None:
        raise Error("--pose and --poses must not stand together (the file of --poses holds every pose)")
    if o.poses is not None:
        return read_poses(o.poses)
    if o.pose is not None:
        values = numbers("--pose", o.pose, "x y z roll pitch yaw")
        try:
            return None, [pose(*values)]
        except Error as why:
            raise Error(f"--pose {o.pose!r}: {why}") from None
    if scene.sonar_pose is None:
        raise Error(f"scene {scene.name!r} has no sonar in it; give its place with --pose {POSE}")
    return None, [scene.sonar_pose]
