"""The commands of `sonar-gl`: their options and help.

A command's work is done by another module of the package, which is loaded when the command runs.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import click

from sonar_gl import cli
from sonar_gl._version import __version__
from sonar_gl.cli.command_group import CommandGroup
from sonar_gl.cli.options import DEVICE, ENGINE, LIVE_OPTIONS, PathText, check_device, option, ping_options
from sonar_gl.cli.output import echo
from sonar_gl.core.atomic_file import check_output_file
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_extra
from sonar_gl.imaging.colormaps import DEFAULT_COLORMAP
from sonar_gl.imaging.formats import FORMATS


@click.group(
    cls=CommandGroup,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 100},
    epilog="Example: sonar-gl render pylon --sonar p900-90 --axes",
)
@click.version_option(__version__, prog_name="sonar-gl")
def main():
    """Simulate a 2D imaging sonar (forward-looking sonar), by OpenGL or on the CPU, without a display."""


RENDER_EXAMPLES = """\b
Examples:
  sonar-gl render pylon
  sonar-gl render diver --sonar didson-hf --range 9 --axes
  sonar-gl render diver --sonar demarco-2015 --style demarco2015 --range-law constant
  sonar-gl render ocean_floor --pose "0 0 -8 0 0.25 0" --range 20 --axes
  sonar-gl render pylon --poses dive.csv --format gif --fps 5 --out dive
"""


@main.command(epilog=RENDER_EXAMPLES, short_help="Make pings of a scene, and pictures of them.")
@ping_options(
    profile={
        "type": click.Choice(("ideal", "demarco2015", "physical")),
        "show_default": "physical; demarco2015 in that style",
    },
    range_law={"type": click.Choice(("printed", "constant", "inverse")), "show_default": "printed"},
    noise={"show_default": "physical with that profile, demarco2015 in that style, else none"},
    style={"type": click.Choice(("fan", "demarco2015")), "default": "fan"},
    counts={"show_default": "the sonar's"},
    colormap={"default": DEFAULT_COLORMAP},
    axes={"is_flag": True},
    form={"type": click.Choice(("isotropic", "printed")), "default": "isotropic"},
    join={"type": click.Choice(("circles", "polygons")), "default": "circles"},
    height={"type": int, "default": 800},
    seed={"type": int, "default": 0},
    formats={"type": click.Choice(FORMATS), "multiple": True, "default": ("png", "npz")},
    fps={"type": float, "default": 10.0},
    labels={"is_flag": True},
    label_level={"type": float, "show_default": "what the display shows above the noise"},
    out={"default": ".", "type": PathText()},
    json=None,
)
@click.option("--scale", hidden=True, help="Replaced by --counts.")
@click.option("--db-range", hidden=True, help="Replaced by --counts.")
@click.pass_context
def render(ctx, scene, **options):
    """Make pings of SCENE, a bundled scene (`sonar-gl scenes` lists them) or a file, and pictures of them.

    Files are named after the scene: pylon.png and pylon.npz; in a sequence pylon_0000.png, pylon_0001.png and so on.
    The NPZ file holds the ping, its pose and all settings.
    """
    given = {name for name in options if ctx.get_parameter_source(name).name == "COMMANDLINE"}
    echo(cli.render.render(scene, SimpleNamespace(**options), given))


VERIFY_EPILOG = """\b
Examples:
  sonar-gl verify pylon --bins 200 --tolerance 0.05 --profile ideal
  sonar-gl verify diver_swimming --range 10 --bins 100 --tolerance 0.1 --profile ideal --json

\b
Exit status: 0 the tolerance was kept, 1 it was not, 2 a mistake in the command line or the scene.
"""


@main.command(epilog=VERIFY_EPILOG, short_help="Compare a ping with a slow ray-cast reference.")
@ping_options(poses=None, height={"type": int, "default": 600}, out={"default": ".", "type": PathText()})
@click.pass_context
def verify(ctx, scene, **options):
    """Compare a ping of SCENE with a reference by millions of rays, and draw the difference.

    The error is the share of the echo that lies in wrong bins, without noise. The picture, pylon_error.png for the
    scene pylon, shows the ping, the reference and their difference. Rays are cast until the reference's own error is
    a tenth of the error found. The examples take seconds; many bins, a small tolerance, and the side lobes of profile
    `physical` take minutes. Bubbles are left out, since the reference does not model them. Needs the extra `reference`
    (Embree); without it the error message says how to add it.
    """
    found = cli.verify.verify(scene, SimpleNamespace(**options, poses=None))
    echo(json.dumps(found) if options["json"] else cli.verify.verify_text(found))
    ctx.exit(0 if found["kept"] else 1)


PLAN_EPILOG = """\b
Examples:
  sonar-gl plan pylon
  sonar-gl plan diver --range 10 --tolerance 0.02 --json

\b
Exit status: 0 the tolerance can be met, 1 it cannot, 2 a mistake in the command line or the scene.
"""


@main.command(epilog=PLAN_EPILOG, short_help="Say how many samples a tolerance needs, and their cost.")
@ping_options(noise={"default": "physical"})
@click.pass_context
def plan(ctx, scene, **options):
    """Choose the number of samples that a tolerance needs in SCENE, and print the reason, the error and the cost.

    The same is printed for half and for twice the tolerance. Errors are estimates that pings make of themselves;
    `sonar-gl verify` finds the true errors. Of a long sequence of poses about two dozen are tried, as by `sonar-gl
    render`.

    Then a table tells how much each term of acoustics and noise matters. For the image without the term it has: the
    change of the image, as a share of its sum; the strongest change of one bin, over the strongest bin; the share of
    the displayed bins that change by more than 3 dB; the milliseconds that the term adds to a ping; and whether the
    scene needs the term, since the sum or the displayed bins change by more than the tolerance. Ring-down, noise
    common to all channels (centre streak) and dropped beams have a row where sonar and noise have them.
    """
    found = cli.plan.plan(scene, SimpleNamespace(**options))
    echo(json.dumps(found) if options["json"] else cli.plan.plan_text(found))
    ctx.exit(0 if found["met"] else 1)


BATCH_EPILOG = """\b
Examples:
  sonar-gl batch survey.toml --dry-run
  sonar-gl batch survey.toml --out survey
  sonar-gl batch survey.toml --out survey --resume
  sonar-gl batch --check survey

\b
Exit status: 0 all pings are made, 1 --check found damage, 2 a mistake in the command line or the job, or a
full disk, 3 all pings are made but some that were set aside, 4 processes died again and again, 130 stopped by
Ctrl-C.
"""


@main.command(epilog=BATCH_EPILOG, short_help="Make a data set of many pings, from a job file.")
@click.argument("job", required=False, type=PathText())
@option("out", default=None, type=PathText(), show_default="named after the job")
@click.option(
    "--dry-run",
    is_flag=True,
    help="Report the size and the time of the data set and its hardest views; write nothing.",
)
@click.option("--resume", is_flag=True, help="Continue the batch in the output folder.")
@click.option("--mend", is_flag=True, help="With --resume: also find damaged files, and make them again.")
@click.option(
    "--any-system",
    is_flag=True,
    help="Go on with another OpenGL or other libraries than those that began the batch; bytes may differ.",
)
@click.option(
    "--check", type=PathText(), metavar="DIR", help="Compare the files of a batch with their checksums."
)
@click.option(
    "--workers",
    type=click.IntRange(1, 4096),
    show_default="one for each core that it may use",
    help="Number of processes.",
)
@option("engine", **ENGINE)
@click.option(
    "--device",
    type=click.IntRange(min=0),
    multiple=True,
    callback=check_device,
    show_default="the variable SONAR_GL_DEVICE, or 0",
    help="Index of an OpenGL device (`sonar-gl doctor` lists them); may be repeated: processes take them in turn.",
)
@click.option(
    "--cluster", metavar="ADDRESS", help="Address of a Dask scheduler whose workers make the pings."
)
@click.pass_context
def batch(ctx, **options):
    """Make the pings that the file JOB describes, with labels, and store them.

    JOB is a TOML file; docs/batch.md describes it.
    """
    try:
        module = cli.batch
    except ModuleNotFoundError as why:
        raise missing_extra("batch", f"batch needs more packages (got no module {why.name})") from None
    ctx.exit(module.batch(SimpleNamespace(**options)))


@main.command(epilog="Example: sonar-gl scenes")
def scenes():
    """List the bundled scenes."""
    echo(cli.listings.scenes_text())


SONARS_EPILOG = """\b
Examples:
  sonar-gl sonars
  sonar-gl sonars p900-45,receive_taper=hamming > mine.toml
  sonar-gl sonars --scene world.sdf > vehicle.toml
"""


@main.command(epilog=SONARS_EPILOG, short_help="List the preset sonars, or write one as a file.")
@click.argument("sonar", required=False, type=PathText())
@click.option(
    "--scene", type=PathText(), metavar="SCENE", help="Write the sonar of this scene's sensor as a file."
)
@option("resource_path", multiple=True, type=PathText())
@option("skip_missing", is_flag=True)
def sonars(sonar, scene, **options):
    """List the preset sonars: beams, field of view, frequency, range, bin size.

    With SONAR, a preset's name or a file, also with changes, write it as the content of a file instead: to change it,
    and give it to --sonar or to a job.
    """
    if sonar is not None and scene is not None:
        raise Error("SONAR and --scene exclude each other (leave one out)")
    if scene is not None:
        text = cli.listings.scene_sonar_text(scene, SimpleNamespace(**options))
    elif any(options.values()):
        raise Error("--resource-path and --skip-missing need --scene (they say how a scene is read)")
    else:
        text = cli.listings.sonars_text() if sonar is None else cli.listings.named_sonar_text(sonar)
    echo(text)


@main.command(epilog="Example: sonar-gl materials", short_help="List the materials.")
def materials():
    """List the materials: reflection, specular lobe, roughness, echo at two angles, and sources of the numbers.

    A scene names one by <sonar_gl:material>, a body in Python by Body(reflectivity="steel").
    """
    echo(cli.listings.materials_text())


VIEW_EPILOG = """\b
Examples:
  sonar-gl view pylon
  sonar-gl view ocean_floor --sonar oculus-m750d-hf --polar
  sonar-gl view pylon --poses dive.csv
"""


@main.command(epilog=VIEW_EPILOG, short_help="Move a sonar through a scene in the browser.")
@ping_options(
    **LIVE_OPTIONS,
    counts={"show_default": "the sonar's"},
    colormap={"default": DEFAULT_COLORMAP},
    polar={"is_flag": True},
    height={"type": int, "default": 640},
    host={"default": "127.0.0.1"},
    port={"type": click.IntRange(0, 65535), "default": 8080},
    job={"type": PathText()},
    out={"default": "sonar_out", "type": PathText()},
)
def view(scene, **options):
    """Show SCENE in 3D with the sonar in it, and its pings as the device would show them, on a page in the browser.

    The page moves the sonar and the bodies, changes the settings, says what stands under the pointer, records, and
    saves pictures, all into the output folder. In a sequence of poses the sonar follows them, with a time bar. If the
    port is taken, the page takes another. Needs the extra `live`; without it the error says how to add it.
    """
    cli.view.view(scene, SimpleNamespace(**options))


DOCTOR_EPILOG = """\b
Examples:
  sonar-gl doctor
  sonar-gl doctor --report this_machine.json
  sonar-gl doctor --scene pylon
"""


@main.command(epilog=DOCTOR_EPILOG, short_help="Check the installation, or say what a scene holds.")
@click.option(
    "--report",
    "report_path",
    type=PathText(),
    metavar="FILE.json",
    help="Write all this to a file, with the driver's limits, the noise of its samples, and times of the bundled "
    "scenes, to send it in.",
)
@option("engine", **ENGINE)
@option("device", **DEVICE)
@click.option(
    "--scene", type=PathText(), metavar="SCENE", help="Say what this scene holds; check nothing else."
)
@option("resource_path", multiple=True, type=PathText())
@option("skip_missing", is_flag=True)
@option("without", multiple=True)
@option("only", multiple=True)
@option("surface", type=float, show_default="the scene's")
@click.pass_context
def doctor(ctx, report_path, scene, **options):
    """Check what is installed, which OpenGL is found, and whether a known scene comes out right.

    This also compiles the numerical code and keeps it on disk, so that later commands start fast. The first time
    takes a minute or two with two free cores, some minutes with one. The engine of --engine draws the known scene.

    With --scene, list instead the bodies of a scene with their sizes, places, triangles, reflectivity and specular
    lobe, its water, its sonars, and everything that was left out or assumed as it was read.
    """
    if scene is not None:
        if report_path is not None:
            raise Error("--report and --scene exclude each other (a report is of the driver; leave one out)")
        echo(cli.scene_report.scene_report(scene, SimpleNamespace(**options)))
        return
    for name in options:
        if ctx.get_parameter_source(name).name == "COMMANDLINE":
            raise Error(f"--{name.replace('_', '-')} needs --scene (it says how a scene is read)")
    if report_path is not None:
        check_output_file(Path(report_path))  # before the work, which takes a minute
    found = cli.doctor.examine()
    echo(cli.doctor.report_text(found))
    if report_path is not None:
        cli.doctor.write_report(Path(report_path), found)
        echo(f"wrote {report_path}")
    ctx.exit(1 if any(finding.ok is False for finding in found) else 0)


EMULATE_EPILOG = """\b
Examples:
  sonar-gl emulate oculus pylon
  sonar-gl emulate oculus ocean_floor --model m750d --poses dive.csv
  sonar-gl emulate ping360 pylon
"""


def _emulate_options(**more):
    """Decorate a command that emulates a device: the options of pings that make sense, the network, and `more`."""
    return ping_options(
        **LIVE_OPTIONS,
        sonar=None,
        range=None,
        bins=None,
        counts={"show_default": "the device's"},
        host={"default": "127.0.0.1"},
        port={"type": click.IntRange(0, 65535), "show_default": "the device's"},
        **more,
    )


@main.group(epilog=EMULATE_EPILOG, short_help="Speak the network protocol of a real sonar.")
def emulate():
    """Act as a real sonar on the network: programs of that sonar work unchanged, with pings of a scene."""


@emulate.command("oculus", short_help="An Oculus of Blueprint Subsea (TCP 52100, status by UDP 52102).")
@_emulate_options(
    model={"type": click.Choice(("m370s", "m750d", "m1200d", "m3000d")), "default": "m1200d"},
    status_to={"default": "127.0.0.1"},
)
def emulate_oculus(scene, **options):
    """Emulate an Oculus in SCENE: mode, range, gain, gamma, beams and ping rate are those that the program sends.

    If pings take too long, the ping rate falls. In a sequence of poses the sonar moves in real time, and
    stays at the last pose.
    """
    echo(cli.emulate.oculus(scene, SimpleNamespace(**options)))


@emulate.command("ping360", short_help="A Ping360 of Blue Robotics (UDP 9092).")
@_emulate_options()
def emulate_ping360(scene, **options):
    """Emulate a Ping360 in SCENE: each angle that a program asks for is a ping of one beam.

    Angle 0 points ahead, and angles grow clockwise as seen from above. The head turns in no time.
    """
    echo(cli.emulate.ping360(scene, SimpleNamespace(**options)))


ROS2_EXAMPLES = """\b
Examples:
  sonar-gl ros2 pylon
  sonar-gl ros2 pylon --transport foxglove --topics image,points,tf
  sonar-gl ros2 ocean_floor --poses dive.csv --rate 5
  sonar-gl ros2 pylon --transport zenoh --clock ros --pose-from odometry=/rov/odometry
"""


@main.command(epilog=ROS2_EXAMPLES, short_help="Publish live topics of ROS 2, without ROS.")
@ping_options(
    **LIVE_OPTIONS,
    rate={"type": float, "show_default": "as many as sound and the device allow"},
    counts={"show_default": "the sonar's"},
    config={"type": PathText(), "metavar": "FILE.toml"},
    transport={"type": click.Choice(("dds", "zenoh", "foxglove")), "multiple": True, "default": ("dds",)},
    clock={"type": click.Choice(("own", "ros", "system")), "default": "own"},
    name={"default": "sonar"},
    topics={"show_default": "all"},
    pose_from={"metavar": "KIND=NAME"},
    bodies_from={"metavar": "TOPIC"},
    domain={"type": click.IntRange(0, 232), "show_default": "the variable ROS_DOMAIN_ID, or 0"},
)
@click.pass_context
def ros2(ctx, scene, **options):
    """Publish the pings of a sonar in SCENE as live topics of ROS 2: images, point clouds, frames and the clock.

    The sonar pings at its own rate, in real time or as /clock tells. A ping that would come too late is left out, and
    counted. Poses come from a file, or from topics of other programs. docs/ros2.md describes the topics, the file of
    --config, and the use with Gazebo, Stonefish and bags.
    """
    given = {name for name in options if ctx.get_parameter_source(name).name == "COMMANDLINE"}
    try:
        module = cli.ros2
    except ModuleNotFoundError as why:
        raise missing_extra("live", f"ros2 needs more packages (got no module {why.name})") from None
    echo(module.ros2(scene, SimpleNamespace(**options), given))
