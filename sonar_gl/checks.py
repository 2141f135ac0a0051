"""Judging pings instead of making them: what the commands `verify` and `plan` find and say."""

from __future__ import annotations

import json
import sys
import time
import warnings
from contextlib import ExitStack
from dataclasses import asdict
from types import SimpleNamespace

import click

from sonar_gl.options import judged
from sonar_gl.options import poses as _poses
from sonar_gl.options import sonar as _sonar

FEW_BODIES = 12  # so many are listed
TURNS = 7  # of timing the pings of a plan
FIVE = 5.0  # times the tolerance, of the worst body's own echo
TWO_RUNGS = 0.59  # what estimates fall by; of a plan the one that binds is nearer to what is asked for
SHARES = ("tolerance", "error_estimate", "worst_body_estimate")
CURE = "these are the most samples that fit; go nearer, narrow the fan, or ask for a larger one"
BOUND_BY = {
    "error": "the error of the whole",
    "worst body": "the worst body, whose echo may be off by five times the tolerance",
    "finding": "bodies that coarser samples might miss",
    "nothing": "nothing: these are the coarsest samples there are",
}

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
    is a tenth of the one found; this may take a minute. Needs Embree: pip install 'sonar_gl[reference]'
    """
    o = SimpleNamespace(**options, poses=None)

    import numpy as np

    from sonar_gl import verify as judge
    from sonar_gl.acoustics import Acoustics
    from sonar_gl.export import output_folder, save_png
    from sonar_gl.image import fan_geometry
    from sonar_gl.load import load_scene
    from sonar_gl.types import Ping

    sonar = _sonar(o)
    empty = Ping(np.zeros((sonar.n_beams, sonar.n_bins)), sonar.azimuth_rad, sonar.range_m)
    fan_geometry(empty, o.height)  # a height that makes no sense is refused before the work
    scene = load_scene(scene, o.resource_path, o.skip_missing)
    _, (pose,) = _poses(o, scene)
    folder = output_folder(o.out)
    if sys.stderr.isatty():
        click.echo("casting rays ...", err=True)
    result = judge.verify(scene, sonar, pose, getattr(Acoustics, o.profile)(), o.tolerance)
    path = folder / f"{scene.name}_error.png"
    save_png(path, judge.error_picture(result, o.height))
    found = _record(result, str(path))
    click.echo(json.dumps(found) if o.json else _text(found))
    ctx.exit(0 if result.kept else 1)


def _about(ping) -> dict:
    """What was pinged, and with what."""
    plain = {name: ping.meta[name] for name in ("scene", "profile", "gl_renderer")}
    beams, bins = ping.intensity.shape
    return {**plain, "sonar": ping.meta["sonar"]["name"], "beams": beams, "bins": bins}


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
        **_about(ping),
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
    sampling = ", ".join(f"{key} {_plain(value)}" for key, value in found["sampling"].items())
    estimate = "none" if found["error_estimate"] is None else _percent(found["error_estimate"])
    kept = "kept" if found["kept"] else "NOT kept"
    lines = [*_head(found), ("sampling", sampling)]
    if found["has_echo"]:
        share = {body["name"]: body["echo"] for body in found["bodies"]}
        worst = found["worst_body"]
        said = f"{worst!r}, its own echo, {_percent(share[worst])} of all, is off by " if worst else "none"
        lines += [
            (
                "error",
                f"{_percent(found['error'])} of the echo; the tolerance of "
                f"{_percent(found['tolerance'])} is {kept}",
            ),
            ("estimate", f"{estimate}, by the ping itself"),
            ("worst body", said + (_percent(found["worst_body_error"]) if worst else "")),
        ]
    else:
        lines.append(("error", "nothing comes back from here, and there is nothing to judge"))
    rays = f"{found['reference_rays'] / 1e6:.3g} million rays, {found['reference_s']:.3g} s"
    unsure = "" if found["certain"] or not found["has_echo"] else "; too much to judge this error well"
    lines += [
        ("reference", f"{rays}; its halves differ by {_percent(found['reference_difference'])}{unsure}"),
        ("ping", f"{found['time_ms']:.2f} ms on {found['gl_renderer']}"),
        ("picture", found["picture"]),
    ]
    text = [f"{name:10}  {value}" for name, value in lines]
    if found["has_echo"] and 1 < len(found["bodies"]) <= FEW_BODIES:
        wide = max(len("body"), *(len(body["name"]) for body in found["bodies"]))
        text += ["", f"{'body':{wide}}  share of echo    error"]
        for body in found["bodies"]:
            error = "-" if body["error"] is None else _percent(body["error"])
            text.append(f"{body['name']:{wide}}  {_percent(body['echo']):>13}  {error:>7}")
    return "\n".join(text)


def cost_plans(scene, sonar, acoustics, poses, tolerance: float) -> dict:
    """What `sonar-gl plan` finds, as plain values: of a tolerance, of half and of twice of it."""
    import numpy as np

    from sonar_gl.plan import check_tolerance
    from sonar_gl.simulator import Simulator
    from sonar_gl.types import Error

    check_tolerance(tolerance)
    simulators, costs, times_ms, has_echo = {}, {}, {}, False
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "tolerance .* cannot be met")  # which is told by the command
        for name, factor in (("chosen", 1), ("halved", 0.5), ("doubled", 2)):
            try:
                asked = check_tolerance(factor * tolerance)
            except Error:
                continue
            simulators[name] = stack.enter_context(Simulator(scene, sonar, acoustics, tolerance=asked))
            costs[name], times_ms[name] = _cost(simulators[name].plan(poses), asked, scene, sonar), []
        for at in np.linspace(0, len(poses) - 1, TURNS).astype(int):
            for name, simulator in simulators.items():
                ping = simulator.ping(poses[at])  # untimed: what was pinged before it leaves cold caches
                start = time.perf_counter()
                simulator.ping(poses[at])
                times_ms[name].append(1e3 * (time.perf_counter() - start))
                has_echo |= ping.meta["has_echo"] or costs[name]["error_estimate"] > 0
    for name, cost in costs.items():
        cost["time_ms"] = float(np.median(times_ms[name]))
        cost["time_ratio"] = cost["time_ms"] / float(np.median(times_ms["chosen"]))
    others = {name: costs.get(name) for name in ("halved", "doubled")}
    return {**_about(ping), "poses": len(poses), "has_echo": has_echo, **costs["chosen"], **others}


def _cost(plan, tolerance: float, scene, sonar) -> dict:
    """A plan, and what it is that asks for so many samples."""
    asked = {"error": plan.error_estimate, "worst body": plan.worst_body_estimate / FIVE}
    bound_by = max(asked, key=asked.get)
    if plan.met and asked[bound_by] < TWO_RUNGS * tolerance:
        bound_by = "finding" if plan.rung else "nothing"
    return {
        "tolerance": tolerance,
        **asdict(plan),
        "worst_body": scene.bodies[plan.worst_body - 1].name if plan.worst_body else "",
        "samples": round(plan.sampling.columns_per_beam * sonar.n_beams) * plan.sampling.rows,
        "bound_by": bound_by,
    }


def plan_text(found: dict) -> str:
    """The findings of `cost_plans` in words."""
    met = "can be met" if found["met"] else f"can NOT be met: {CURE}"
    columns, rows, _ = found["sampling"].values()
    lines = [*_head(found)] + ([("poses", str(found["poses"]))] if found["poses"] > 1 else [])
    lines += [
        ("tolerance", f"{_percent(found['tolerance'])} {met}"),
        ("samples", f"{columns:.4g} columns per beam x {rows} rows = {found['samples']}"),
    ]
    if found["has_echo"]:
        worst, off = found["worst_body"], _percent(found["worst_body_estimate"])
        lines += [
            ("error", f"{_percent(found['error_estimate'])} of the echo, estimated"),
            ("worst body", f"{worst!r}, its own echo, off by {off}, estimated" if worst else "none"),
            ("bound by", BOUND_BY[found["bound_by"]]),
        ]
    else:
        lines.append(("error", "nothing comes back from here, and there is nothing to err about"))
    lines.append(("ping", f"{found['time_ms']:.2f} ms on {found['gl_renderer']}"))
    text = [f"{name:10}  {value}" for name, value in lines]
    text += ["", "tolerance   samples    error  worst body        ms  ratio"]
    for cost in filter(None, (found["halved"], found, found["doubled"])):
        share, error, body = (_percent(cost[name]) for name in SHARES)
        row = f"{share:>9}  {cost['samples']:8}  {error:>7}  {body:>10}  {cost['time_ms']:8.2f}"
        text.append(f"{row}  {cost['time_ratio']:5.2f}" + ("" if cost["met"] else "  not met"))
    missing = [name for name in ("halved", "doubled") if found[name] is None]
    return "\n".join(text + [f"{name}, it would lie outside 0.1 % to 50 %" for name in missing])


def _head(found: dict) -> list[tuple[str, str]]:
    return [
        ("scene", found["scene"]),
        ("sonar", f"{found['sonar']}, {found['beams']} beams x {found['bins']} bins"),
        ("profile", found["profile"]),
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def _plain(value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
