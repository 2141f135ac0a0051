"""The command `verify`: how far a ping is from the reference."""

from __future__ import annotations

import math
import sys
import time
from contextlib import contextmanager
from dataclasses import replace

import click
import numpy as np

from sonar_gl.analysis.reference import MAX_RAYS, check_known
from sonar_gl.analysis.terms import needed_acoustics
from sonar_gl.analysis.verify import MAX_ROUNDS, Verification, error_picture
from sonar_gl.analysis.verify import verify as verify_ping
from sonar_gl.cli.common import acoustics_from, check_output, poses_from, scene_from, sonar_from, water_from
from sonar_gl.cli.output import echo
from sonar_gl.cli.report import facts_text, percent, ping_facts, table_text
from sonar_gl.imaging.fan_image import fan_geometry
from sonar_gl.imaging.files import output_folder, save_png
from sonar_gl.ping import Ping
from sonar_gl.sonar.sampling import WORST_BODY

LINE_EVERY_S = 30.0  # of progress, without a terminal
CASTING = (
    f"casting rays, {MAX_RAYS / 1e6:g} million at most in each of up to {MAX_ROUNDS} rounds; Ctrl-C stops"
)
MAX_LISTED_BODIES = 12  # a report lists the bodies of scenes with no more


def verify(scene_name: str, options) -> dict:
    """Verify a ping, write the picture, and return the findings as plain values."""
    check_output(options)
    acoustics = acoustics_from(options, options.profile)
    scene = scene_from(scene_name, options)
    _, (pose,) = poses_from(options, scene)
    sonar = sonar_from(options, scene)
    empty = Ping(np.zeros((sonar.n_beams, sonar.n_bins)), sonar.azimuth_rad, sonar.range_m)
    fan_geometry(empty, options.height)  # refuses a wrong height before the work begins
    acoustics = acoustics or replace(
        needed_acoustics(scene, sonar, options.tolerance, pose, water_from(options)), multipath="none"
    )
    check_known(acoustics)
    acoustics = replace(acoustics, bubbles=False)
    folder = output_folder(options.out)
    with _ray_progress() as progress:
        result = verify_ping(scene, sonar, pose, acoustics, options.tolerance, progress=progress)
    path = folder / f"{scene.name}_error.png"
    save_png(path, error_picture(result, options.height))
    return _findings(result, str(path))


@contextmanager
def _ray_progress():
    """Yield a function (rays cast, rays expected) that shows progress: a bar, or lines where there is no terminal."""
    if not sys.stderr.isatty():
        yield _ProgressLines()
        return
    echo(CASTING, err=True)
    bar = click.progressbar(
        length=1, show_eta=False, show_percent=False, file=sys.stderr, item_show_func=lambda text: text
    )
    with bar:

        def show(cast: int, expected: int) -> None:
            if abs(cast - bar.pos) >= expected / 100:  # fewer lines than blocks of rays
                bar.length = expected
                bar.update(cast - bar.pos, _rays_text(cast, expected))

        yield show


class _ProgressLines:
    """A function (rays cast, rays expected) that prints a line at first, and one every half minute."""

    def __init__(self):
        self._start_s = self._last_s = time.monotonic()
        self._round, self._cast = 0, math.inf

    def __call__(self, cast: int, expected: int) -> None:
        if cast < self._cast:  # each round counts from 0
            self._round += 1
            if self._round == 1:  # not before: the reference may be refused
                echo(CASTING, err=True)
        self._cast, now_s = cast, time.monotonic()
        if now_s - self._last_s >= LINE_EVERY_S:
            self._last_s = now_s
            text = f"round {self._round}: {_rays_text(cast, expected)}, {now_s - self._start_s:.0f} s so far"
            echo(text, err=True)


def _rays_text(cast: int, expected: int) -> str:
    return f"{cast / 1e6:.1f} of about {expected / 1e6:.3g} million rays"


def _findings(result: Verification, picture: str) -> dict:
    """Return the findings as plain values; the echoes of bodies are shares of the total echo."""
    ping, truth = result.ping, result.truth
    meta, total = ping.meta, float(truth.body_echo.sum()) or 1.0
    bodies = [
        {
            "name": name,
            "echo": float(t) / total,
            "error": abs(float(e) - float(t)) / float(t) if t > 0 else None,
        }
        for name, e, t in zip(meta["bodies"], ping.body_echo[1:], truth.body_echo[1:], strict=True)
    ]
    return {
        **ping_facts(ping),
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


def verify_text(found: dict) -> str:
    sampling = ", ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in found["sampling"].items()
    )
    rows = [("sampling", sampling)]
    if found["has_echo"]:
        kept = "kept" if found["kept"] else "NOT kept"
        estimate = "none" if found["error_estimate"] is None else percent(found["error_estimate"])
        rows += [
            (
                "error",
                f"{percent(found['error'], found['tolerance'])} of the echo; the tolerance of "
                f"{100 * found['tolerance']:g} % is {kept}",
            ),
            ("estimate", f"{estimate}, by the ping itself"),
            ("worst body", _worst_body_text(found)),
        ]
    else:
        rows.append(("error", "none: no echo comes back from this pose"))
    unsure = "" if found["certain"] or not found["has_echo"] else "; too much to judge this error well"
    rows += [
        (
            "reference",
            f"{found['reference_rays'] / 1e6:.3g} million rays, {found['reference_s']:.3g} s; "
            f"its halves differ by {percent(found['reference_difference'])}{unsure}",
        ),
        ("ping", f"{found['time_ms']:.2f} ms on {found['gl_renderer']}"),
        ("picture", found["picture"]),
    ]
    text = facts_text(found, rows)
    if not found["has_echo"] or not 1 < len(found["bodies"]) <= MAX_LISTED_BODIES:
        return text
    bodies = [
        (body["name"], percent(body["echo"]), "-" if body["error"] is None else percent(body["error"]))
        for body in found["bodies"]
    ]
    return f"{text}\n\n{table_text(('body', 'share of echo', 'error'), bodies)}"


def _worst_body_text(found: dict) -> str:
    name = found["worst_body"]
    if not name:
        return "none"
    share = next(body["echo"] for body in found["bodies"] if body["name"] == name)
    off = percent(found["worst_body_error"], WORST_BODY * found["tolerance"])
    return f"{name!r}, {percent(share)} of the echo; its own is off by {off}"
