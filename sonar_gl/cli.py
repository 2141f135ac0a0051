"""The command line `sonar-gl`. Heavy modules load inside the commands, so that `--help` stays quick."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from types import SimpleNamespace

import click

from sonar_gl._version import __version__
from sonar_gl.batch.command import batch
from sonar_gl.checks import verify
from sonar_gl.commands import Commands, load_numba, numbers, progress
from sonar_gl.costs import cost_plans, plan_text
from sonar_gl.options import DEVICE
from sonar_gl.options import acoustics as _acoustics
from sonar_gl.options import judged as _judged
from sonar_gl.options import option as _option
from sonar_gl.options import poses as _poses
from sonar_gl.options import sonar as _sonar

FAN_ONLY = ("scale", "db_range", "colormap", "axes")  # options that one style knows
DEMARCO_ONLY = ("form", "join")


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 100},
    epilog="Example: sonar-gl render pylon --sonar p900-90 --axes",
)
@click.version_option(__version__, prog_name="sonar-gl")
def main():
    """Simulate a 2D imaging sonar, with OpenGL and without a display."""


main.add_command(verify)
main.add_command(batch)

RENDER_EXAMPLES = """\b
Examples:
  sonar-gl render pylon
  sonar-gl render diver --sonar didson-hf --noise physical --axes
  sonar-gl render diver --sonar demarco-2015 --style demarco2015 --range-law constant
  sonar-gl render ocean_floor --pose "0 0 -5 0 0.3 0" --range 20
  sonar-gl render harbour.sdf --poses dive.csv --format mp4 --fps 15 --out dive
"""


@main.command(epilog=RENDER_EXAMPLES, short_help="Make pings of a scene, and pictures of them.")
@click.argument("scene")
@_option("sonar", default="p900-45")
@_option("pose", show_default="the scene's")
@_option("poses")
@_option("range", type=float)
@_option("bins", type=int)
@_option("profile", "ideal", "demarco2015", "physical", show_default="physical; demarco2015 in that style")
@_option("acoustics", show_default="the profile's")
@_option("range_law", "printed", "constant", "inverse", show_default="printed")
@_option("noise", show_default="none; demarco2015 in that style")
@_option("style", "fan", "demarco2015", default="fan")
@_option("scale", "db", "linear", default="db")
@_option("db_range", default="-60 0")
@_option("colormap", default="jet")
@_option("axes", is_flag=True)
@_option("form", "isotropic", "printed", default="isotropic")
@_option("join", "circles", "polygons", default="circles")
@_option("height", type=int, default=800)
@_option("tolerance", type=float, default=0.01)
@_option("device", **DEVICE)
@_option("seed", type=int, default=0)
@_option("formats", "png", "npz", "gif", "mp4", multiple=True, default=("png", "npz"))
@_option("fps", type=float, default=10.0)
@_option("labels", is_flag=True)
@_option("resource_path", multiple=True)
@_option("skip_missing", is_flag=True)
@_option("out", default=".")
@click.pass_context
def render(ctx, scene, **options):
    """Make pings of SCENE, a bundled scene (`sonar-gl scenes` lists them) or a file, and pictures of them.

    Files are named after the scene: pylon.png, pylon.npz; pylon_0000.png and so on in a sequence. The NPZ
    holds the ping, its pose, and how it was made.
    """
    given = {name for name in options if ctx.get_parameter_source(name).name == "COMMANDLINE"}
    o = SimpleNamespace(**options)
    _check_together(o, given)
    load_numba()

    from sonar_gl.acoustics import Acoustics
    from sonar_gl.dump import Dump, demarco_artist, fan_artist
    from sonar_gl.export import output_folder
    from sonar_gl.load import load_scene
    from sonar_gl.noise import Noise
    from sonar_gl.simulator import Simulator
    from sonar_gl.types import Error

    in_demarco = o.style == "demarco2015"
    profile = o.profile or ("demarco2015" if in_demarco else "physical")
    if o.range_law is not None and profile != "demarco2015":
        raise Error(f"--range-law must stand with --profile demarco2015 (got --profile {profile})")
    acoustics = _acoustics(o, profile)
    if o.range_law is not None:
        acoustics = replace(acoustics, range_law=o.range_law)
    noise = Noise.parse(("demarco2015" if in_demarco else "none") if o.noise is None else o.noise)
    sonar = _sonar(o)
    if in_demarco:
        artist = demarco_artist(o.height, o.form, o.join, noise, o.seed)
    else:
        db_range = numbers("--db-range", o.db_range, "darkest brightest")
        artist = fan_artist(o.height, o.scale, db_range, o.colormap, o.axes)
    scene = load_scene(scene, o.resource_path, o.skip_missing)
    times_s, poses = _poses(o, scene)
    acoustics = acoustics or Acoustics.needed(scene, sonar, o.tolerance, poses)
    folder = output_folder(o.out)
    shown = progress if o.poses is not None else contextlib.nullcontext
    with Simulator(scene, sonar, acoustics, tolerance=o.tolerance) as simulator:
        if not in_demarco or "npz" in o.formats:  # the paper's picture is made of points alone
            simulator.plan(poses)  # before the first ping, so that none depends on those before it
        dump = Dump(simulator, artist, folder, o.formats, noise, o.seed, o.labels, o.fps, shown)
        click.echo(dump.write(poses, times_s))


def _check_together(o, given: set[str]):
    """Refuse options that do not go together."""
    from sonar_gl.types import Error

    for style, names in (("fan", FAN_ONLY), ("demarco2015", DEMARCO_ONLY)):
        for name in names:
            if name in given and o.style != style:
                option = "--" + name.replace("_", "-")
                raise Error(f"{option} must stand with --style {style} (got --style {o.style})")
    films = [f for f in ("gif", "mp4") if f in o.formats]
    if films and o.poses is None:
        raise Error(f"--format {films[0]} must stand with --poses (a film needs a sequence of poses)")
    if "fps" in given and not films:
        raise Error("--fps must stand with --format gif or --format mp4 (nothing else has frames)")


PLAN_EPILOG = """\b
Examples:
  sonar-gl plan pylon
  sonar-gl plan pylon --poses dive.csv --tolerance 0.02 --json

\b
Exit status: 0 the tolerance can be met, 1 it cannot, 2 a mistake in the command line or the scene.
"""


@main.command(epilog=PLAN_EPILOG, short_help="Say which samples a tolerance asks for, and their cost.")
@_judged(poses={})
@click.pass_context
def plan(ctx, scene, **options):
    """Choose samples for a tolerance by what the sonar sees in SCENE, and say why and at what cost.

    The same is done for half the tolerance and for twice of it. Errors are those that pings are thought to
    have, without a reference; `sonar-gl verify` finds the true ones. Of a long sequence of poses two dozen
    are tried, as by `sonar-gl render`.

    Then each term of acoustics and noise is priced: how much the image would change without it, as a share
    of its sum; the strongest change of one bin, over the strongest bin; the milliseconds that it adds to a
    ping; and whether it is needed for the image to change by no more than the tolerance.
    """
    o = SimpleNamespace(**options)

    import json

    from sonar_gl.acoustics import Acoustics
    from sonar_gl.load import load_scene

    load_numba()
    sonar, acoustics = _sonar(o), _acoustics(o, o.profile)
    scene = load_scene(scene, o.resource_path, o.skip_missing)
    poses = _poses(o, scene)[1]
    acoustics = acoustics or Acoustics.needed(scene, sonar, o.tolerance, poses)
    found = cost_plans(scene, sonar, acoustics, poses, o.tolerance)
    click.echo(json.dumps(found) if o.json else plan_text(found))
    ctx.exit(0 if found["met"] else 1)


@main.command(epilog="Example: sonar-gl scenes")
def scenes():
    """List the bundled scenes."""
    from sonar_gl.load import bundled_scenes, scene_description

    formatter = click.HelpFormatter(max_width=100)
    formatter.write_dl([(name, scene_description(path)) for name, path in bundled_scenes().items()])
    click.echo(formatter.getvalue(), nl=False)


@main.command(epilog="Example: sonar-gl sonars", short_help="List the sonars known by name.")
def sonars():
    """List the sonars known by name: beams, field of view, frequency, range, size of a bin."""
    from sonar_gl.sonar import presets

    known = presets()
    wide = max(map(len, known))
    click.echo(f"{'name':{wide}}  beams   view, deg    kHz      range, m  bin, mm")
    for name, s in known.items():
        view = f"{s.azimuth_fov_deg:g} x {s.elevation_fov_deg:g}"
        reach = f"{s.range_min_m:g} to {s.range_max_m:.4g}"
        click.echo(
            f"{name:{wide}}  {s.n_beams:5}  {view:>10}  {s.frequency_hz / 1e3:5g}  {reach:>12}"
            f"  {1e3 * s.bin_size_m:7.4g}"
        )


@main.command(epilog="Example: sonar-gl doctor", short_help="Say whether all that is needed works here.")
@click.pass_context
def doctor(ctx):
    """Say what is installed, which OpenGL is found, and whether a known scene comes out right."""
    from sonar_gl.doctor import examine

    findings = examine()
    wide = max(len(f.what) for f in findings)
    for f in findings:
        mark = {True: "ok", False: "FAIL", None: "-"}[f.ok]
        click.echo(f"{mark:4}  {f.what:{wide}}  {f.detail}")
        if f.ok is not True and f.cure:
            click.echo(f"{'':4}  {'':{wide}}  {f.cure}")
    wrong = sum(f.ok is False for f in findings)
    click.echo(f"{wrong} of {len(findings)} found wanting" if wrong else "all is well")
    ctx.exit(1 if wrong else 0)
