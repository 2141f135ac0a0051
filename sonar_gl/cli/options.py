"""Options that commands share: names, types and help. Imports no library but click."""

from __future__ import annotations

import os
from contextlib import contextmanager

import click

from sonar_gl.core.errors import Error
from sonar_gl.imaging.colormaps import OFFERED
from sonar_gl.raster.engine_names import ENGINES

POSE = '"x y z roll pitch yaw", metres and radians'
HELP = {
    "sonar": "Preset (`sonar-gl sonars` lists them) or .toml file; changes may follow: p900-45,bandwidth_hz=30e3.",
    "pose": f"Pose of the sonar: {POSE}.",
    "poses": "CSV file with a sequence of poses; its columns are t,x,y,z,roll,pitch,yaw, or end in qx,qy,qz,qw.",
    "range": "Maximum range, metres. The size of a bin stays, or the number of bins, as in the device.",
    "bins": "Number of range bins.",
    "profile": "Acoustic model: ideal (box beams, no losses), demarco2015, or physical (the whole device).",
    "acoustics": "Changes to the profile, such as tvg_k=30,multipath=coherent; or needed: terms that the scene needs.",
    "water": "The water, such as temperature_c=4,salinity_psu=8, or absorption_db_m=0.3,sound_speed_m_s=1480.",
    "range_law": "Profile demarco2015: range gain as printed, rising with range (eq. (4)), constant, or inverse.",
    "noise": "none, demarco2015 or physical, also with changes: physical,follow_motion=no; or terms: gaussian=1e-4.",
    "style": "Picture: a fan image, or that of DeMarco et al. (2015).",
    "counts": "How intensity becomes counts, the device's gray levels, such as law=db,low_db=-50,gain_percentile=99.",
    "colormap": f"Colour map of the fan image: {', '.join(OFFERED)}, or another of OpenCV.",
    "axes": "Draw range and azimuth axes around the fan image, a title, and a colour bar.",
    "form": "Style demarco2015: equal scales, or eqs. (8)-(9) of the paper as printed.",
    "join": "Style demarco2015: draw each point as a circle, or fill polygons between neighbouring points.",
    "polar": "Show beams as columns and ranges as rows, in place of a fan.",
    "height": "Height of the picture without axes, pixels.",
    "tolerance": "Largest share of the echo that may lie in wrong bins.",
    "engine": "What draws: opengl, cpu, or auto, which takes OpenGL where there is a graphics card.",
    "device": "Index of the OpenGL device; `sonar-gl doctor` lists the devices.",
    "seed": "Seed of the noise.",
    "formats": "File format; may be repeated. gif and mp4 need --poses.",
    "fps": "Frames per second of gif (100 at most) and mp4 (120), whatever the times of the poses.",
    "labels": "Add labels to the NPZ: the body with the strongest echo in each bin, and its elevation.",
    "label_level": "Label bins where a body's mean echo is at least this, dB, whatever the noise; needs --labels.",
    "resource_path": "Folder to search for model:// and package:// URIs; may be repeated.",
    "skip_missing": "Leave out models and meshes that are not found or cannot be read, and unknown shapes, with a "
    "warning. Files that a xacro file includes are still needed.",
    "without": 'Leave out bodies of this name, such as "boat*"; `doctor --scene` lists names. May be repeated.',
    "only": 'Keep only bodies of this name, such as "pylon*"; may be repeated.',
    "surface": "Height (z) of the water's surface, metres.",
    "model": "Model of the device.",
    "host": "Address to listen at; others than 127.0.0.1 let other machines use the sonar.",
    "port": "Port to listen at.",
    "status_to": "Address that receives the device's status, such as 192.168.1.255, which reaches all of a network.",
    "duration": "Stop after so many seconds.",
    "config": "TOML file with options and settings of topics; the command line takes precedence.",
    "transport": "Middleware that carries the topics; may be repeated.",
    "rate": "Pings per second.",
    "clock": "Clock of the time stamps: own, published on /clock; ros, which follows /clock; or system, the machine's.",
    "name": "Name of the sonar: topics are /NAME/image and so on, frames NAME and NAME_beams.",
    "topics": "Publish only these: some of projected_image,raw_image,image,points,tf,clock.",
    "pose_from": "Messages that move the sonar: odometry=TOPIC, pose=TOPIC or tf=FRAME.",
    "bodies_from": "Topic of tf2_msgs/TFMessage that moves bodies, whose names are the child frames.",
    "domain": "Domain of ROS 2.",
    "job": "Job file of `sonar-gl batch` to which the page adds poses; otherwise one in the output folder.",
    "json": "Print one JSON object instead of text.",
    "out": "Output folder; created if it does not exist.",
}


class PathText(click.ParamType):
    """The text of a path, in which ~ is the home folder: a shell leaves it as it is in `--out=~/pings`."""

    name = "path"

    def convert(self, value, param, ctx):
        """Return the path; an `Error` for an empty text, which would be that of the working directory."""
        if value == "":
            what = param.opts[0] if param.opts[0].startswith("-") else param.human_readable_name
            raise Error(f"{what} must be a path (got an empty text; is a variable of the shell empty?)")
        return os.path.expanduser(value)


def option(name: str, **settings):
    """Return a click option with its help; `formats` becomes --format, other names stay as they are."""
    flag = "--format" if name == "formats" else "--" + name.replace("_", "-")
    return click.option(flag, name, help=HELP[name], **settings)


@contextmanager
def _variable(name: str, value: str):
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name)
        if before is not None:
            os.environ[name] = before


def _set_variable(ctx, parameter, value):
    """Set the variable SONAR_GL_<NAME> of this option for the whole command, which its processes inherit."""
    if value is not None:
        ctx.with_resource(_variable(f"SONAR_GL_{parameter.name.upper()}", str(value)))


def check_device(_ctx, parameter, value):
    """Return the device or devices of --device; an `Error` beside the engine `cpu`, which would draw on none of them.

    The engine is that of the variable here, since ENGINE is eager: `--engine` has set it, wherever it stands.
    """
    if value in (None, ()) or os.environ.get("SONAR_GL_ENGINE", "").strip() != "cpu":
        return value
    got = value if isinstance(value, int) else value[0]
    raise Error(
        f"{parameter.opts[0]} must not be given with the engine cpu, which needs no OpenGL device (got {got}; leave it "
        "out, or give --engine opengl)"
    )


def _set_device(ctx, parameter, value):
    """Set the variable of --device for a command that draws with one engine alone."""
    _set_variable(ctx, parameter, check_device(ctx, parameter, value))


DEVICE = {
    "type": click.IntRange(min=0),
    "show_default": "the variable SONAR_GL_DEVICE, or 0",
    "callback": _set_variable,
    "expose_value": False,
}
ENGINE = {
    "type": click.Choice(ENGINES),
    "show_default": "the variable SONAR_GL_ENGINE, or auto",
    "is_eager": True,
    "callback": _set_variable,
    "expose_value": False,
}
PING_OPTIONS = {
    "sonar": {"show_default": "the scene's, or p900-45"},
    "pose": {"show_default": "the scene's"},
    "poses": {"type": PathText()},
    "range": {"type": float},
    "bins": {"type": int},
    "profile": {"type": click.Choice(("ideal", "demarco2015", "physical")), "default": "physical"},
    "acoustics": {"show_default": "the profile's"},
    "water": {"show_default": "the sea at 10 °C"},
    "tolerance": {"type": float, "default": 0.01},
    "engine": ENGINE,
    "device": {**DEVICE, "callback": _set_device},
    "resource_path": {"multiple": True, "type": PathText()},
    "skip_missing": {"is_flag": True},
    "without": {"multiple": True},
    "only": {"multiple": True},
    "surface": {"type": float, "show_default": "the scene's"},
    "json": {"is_flag": True},
}
# of commands that ping until they are stopped: what differs from PING_OPTIONS
LIVE_OPTIONS = {
    "noise": {"default": "physical"},
    "tolerance": {"type": float, "default": 0.05},
    "seed": {"type": int, "default": 0},
    "duration": {"type": float, "show_default": "until Ctrl-C"},
    "json": None,
}


def ping_options(**more):
    """Decorate a command that evaluates pings: the argument SCENE, PING_OPTIONS and `more`, in the order of HELP.

    more : name of an option -> its settings; None leaves out an option of PING_OPTIONS
    """
    settings = {name: given for name, given in {**PING_OPTIONS, **more}.items() if given is not None}

    def decorate(command):
        for name in reversed([name for name in HELP if name in settings]):
            command = option(name, **settings[name])(command)
        return click.argument("scene", type=PathText())(command)

    return decorate
