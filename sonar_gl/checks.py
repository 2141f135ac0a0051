"""Judging pings instead of making them: the command `verify`, and what it finds and says."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import click

from sonar_gl.costs import about, head, percent, plain
from sonar_gl.options import acoustics as _acoustics
from sonar_gl.options import judged
from sonar_gl.options import poses as _poses
from sonar_gl.options import sonar as _sonar

FEW_BODIES = 12  # so many are listed


VERIFY_EPILOG = """\b
Examples:
  sonar-gl verify pylon
  sonar-gl verify diver --sonar didson-hf --tolerance 0.005 --json

\b
Exit status: 0 the tolerance was kept, 1 it was not, 2 a mistake in the command line or the scene.
"""


@click.command(epilog=VERIFY_EPILOG, short_help="Say how far a ping is from the truth.")
@judged(height={"type": int, "default": 600}, out={"default": "."})
@click.pass_context
def verify(ctx, scene, **options):
    """Compare a ping of SCENE with the same integral by millions of rays, and draw where they differ.

    The error is the share of the echo that lies in wrong bins, noise off. The picture, pylon_error.png for
    the scene pylon, shows the ping, the reference and their difference. Rays are cast until their own error
    is a tenth of the one found; this may take a minute. Bubbles are left out, for the rays know none. Needs
    Embree: pip install 'sonar_gl[reference]'
    """
    o = SimpleNamespace(**options, poses=None)

    from dataclasses import replace

    import numpy as np

    from sonar_gl import verify as judge
    from sonar_gl.acoustics import Acoustics
    from sonar_gl.export import output_folder, save_png
    from sonar_gl.image import fan_geometry
    from sonar_gl.load import load_scene
    from sonar_gl.reference import check_known
    from sonar_gl.types import Ping

    sonar, acoustics = _sonar(o), _acoustics(o, o.profile)
    empty = Ping(np.zeros((sonar.n_beams, sonar.n_bins)), sonar.azimuth_rad, sonar.range_m)
    fan_geometry(empty, o.height)  # a height that makes no sense is refused before the work
    scene = load_scene(scene, o.resource_path, o.skip_missing)
    _, (pose,) = _poses(o, scene)
    acoustics = acoustics or replace(Acoustics.needed(scene, sonar, o.tolerance, pose), multipath="none")
    check_known(acoustics)
    acoustics = replace(acoustics, bubbles=False)
    folder = output_folder(o.out)
    if sys.stderr.isatty():
        click.echo("casting rays ...", err=True)
    result = judge.verify(scene, sonar, pose, acoustics, o.tolerance)
    path = folder / f"{scene.name}_error.png"
    save_png(path, judge.error_picture(result, o.height))
    found = _record(result, str(path))
    click.echo(json.dumps(found) if o.json else _text(found))
    ctx.exit(0 if result.kept else 1)


def _record(result, picture: str) -> dict:
    """What was found, as plain values; echoes of bodies are shares of the whole echo."""
    ping, truth = result.ping, result.truth
    meta, whole = ping.meta, float(truth.body_echo.sum()) or 1.0
    bodies = [
        {
            "name": name,
            "echo": float(t) / whole,
            "error": abs(float(e) - float(t)) / float(t) if t > 0 else None,
        }
        for name, e, t in zip(meta["bodies"], ping.body_echo[1:], truth.body_echo[1:], strict=True)
    ]
    return {
        **about(ping),
        "sampling": meta["sampling"],
        "tolerance": result.tolerance,
        "error": result.error,
        "kept": result.kept,
        "error_estimate": ping.error_estimate,
        "worst_body": result.worst_body,
        "worst_body_error": result.worst_body_error,
        "bodies": bodies,
        "has_echo": bool(truth.intensity.any()),
        "reference_difference": result.difference,
        "reference_rays": truth.meta["n_rays"],
        "reference_s": result.reference_s,
        "certain": result.certain,
        "time_ms": result.time_ms,
        "picture": picture,
    }


def _text(found: dict) -> str:
    """The record in words."""
    sampling = ", ".join(f"{key} {plain(value)}" for key, value in found["sampling"].items())
    estimate = "none" if found["error_estimate"] is None else percent(found["error_estimate"])
    kept = "kept" if found["kept"] else "NOT kept"
    lines = [*head(found), ("sampling", sampling)]
    if found["has_echo"]:
        share = {body["name"]: body["echo"] for body in found["bodies"]}
        worst = found["worst_body"]
        said = f"{worst!r}, its own echo, {percent(share[worst])} of all, is off by " if worst else "none"
        lines += [
            (
                "error",
                f"{percent(found['error'])} of the echo; the tolerance of "
                f"{percent(found['tolerance'])} is {kept}",
            ),
            ("estimate", f"{estimate}, by the ping itself"),
            ("worst body", said + (percent(found["worst_body_error"]) if worst else "")),
        ]
    else:
        lines.append(("error", "nothing comes back from here, and there is nothing to judge"))
    rays = f"{found['reference_rays'] / 1e6:.3g} million rays, {found['reference_s']:.3g} s"
    unsure = "" if found["certain"] or not found["has_echo"] else "; too much to judge this error well"
    lines += [
        ("reference", f"{rays}; its halves differ by {percent(found['reference_difference'])}{unsure}"),
        ("ping", f"{found['time_ms']:.2f} ms on {found['gl_renderer']}"),
        ("picture", found["picture"]),
    ]
    text = [f"{name:10}  {value}" for name, value in lines]
    if found["has_echo"] and 1 < len(found["bodies"]) <= FEW_BODIES:
        wide = max(len("body"), *(len(body["name"]) for body in found["bodies"]))
        text += ["", f"{'body':{wide}}  share of echo    error"]
        for body in found["bodies"]:
            error = "-" if body["error"] is None else percent(body["error"])
            text.append(f"{body['name']:{wide}}  {percent(body['echo']):>13}  {error:>7}")
    return "\n".join(text)
