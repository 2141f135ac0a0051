"""The command `plan`: the samples and acoustic terms that a tolerance needs, and their cost."""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack
from dataclasses import asdict

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.analysis.terms import TURNS, needed_acoustics, price
from sonar_gl.cli.common import acoustics_from, poses_from, scene_from, sonar_from, water_from
from sonar_gl.cli.report import facts_text, percent, ping_facts, table_text
from sonar_gl.core.errors import Error
from sonar_gl.core.load_numba import load_numba
from sonar_gl.engine.flow import Plan
from sonar_gl.noise.settings import Noise
from sonar_gl.scene.scene import Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sampling import WORST_BODY, ToleranceWarning, check_tolerance
from sonar_gl.sonar.sonar import Sonar

# Two sampling levels change an estimate by no more than this factor. A largest estimate that is a smaller share of the
# tolerance leaves room for coarser samples: then something else forbids them.
TWO_LEVELS = 0.59
CURE = "these are the most samples that fit; go nearer, narrow the fan, or ask for a larger one"
BOUND_BY = {
    "error": "the error of the whole ping",
    "worst body": "the worst body, whose echo may be off by five times the tolerance",
    "finding": "bodies that coarser samples might miss",
    "nothing": "nothing: these are the coarsest samples",
}


def plan(scene_name: str, options) -> dict:
    """Return the plan of a scene for the tolerance of the options, as plain values."""
    load_numba()
    acoustics, noise = acoustics_from(options, options.profile), Noise.parse(options.noise)
    scene = scene_from(scene_name, options)
    poses = poses_from(options, scene)[1]
    sonar = sonar_from(options, scene)
    acoustics = acoustics or needed_acoustics(scene, sonar, options.tolerance, poses, water_from(options))
    return compare_plans(scene, sonar, acoustics, poses, options.tolerance, noise)


def compare_plans(
    scene: Scene, sonar: Sonar, acoustics: Acoustics, poses, tolerance: float, noise: Noise | None
) -> dict:
    """Plan for a tolerance, for half and for twice of it; time their pings and price the terms."""
    check_tolerance(tolerance)
    simulators, plans, times_ms, has_echo = {}, {}, {}, False
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.simplefilter("ignore", ToleranceWarning)  # the report says so
        for name, factor in (("chosen", 1), ("halved", 0.5), ("doubled", 2)):
            try:
                wanted = check_tolerance(factor * tolerance)
            except Error:
                continue
            simulators[name] = stack.enter_context(Simulator(scene, sonar, acoustics, tolerance=wanted))
            plans[name] = plan_facts(simulators[name].plan(poses), wanted, scene)
            times_ms[name] = []
        for at in np.linspace(0, len(poses) - 1, TURNS).astype(int):
            for name, simulator in simulators.items():
                ping = simulator.ping(poses[at])  # not timed: the other simulator left the caches cold
                start = time.perf_counter()
                simulator.ping(poses[at])
                times_ms[name].append(1e3 * (time.perf_counter() - start))
                has_echo |= ping.meta["has_echo"] or plans[name]["error_estimate"] > 0
        terms = price(simulators["chosen"], sonar, tolerance, poses, acoustics, noise) if has_echo else []
    for name, facts in plans.items():
        facts["time_ms"] = float(np.median(times_ms[name]))
        facts["time_ratio"] = facts["time_ms"] / float(np.median(times_ms["chosen"]))
    return {
        **ping_facts(ping),
        "poses": len(poses),
        "has_echo": has_echo,
        **plans["chosen"],
        "halved": plans.get("halved"),
        "doubled": plans.get("doubled"),
        "terms": [asdict(term) for term in terms],
    }


def plan_facts(plan: Plan, tolerance: float, scene: Scene) -> dict:
    """Return a plan as plain values, with what requires so many samples."""
    facts = asdict(plan)
    del facts["raised_for"]  # of live loops alone
    facts["samples"] = facts.pop("n_samples")
    estimates = {"error": plan.error_estimate, "worst body": plan.worst_body_estimate / WORST_BODY}
    bound_by = max(estimates, key=estimates.get)
    if plan.met and estimates[bound_by] < TWO_LEVELS * tolerance:
        bound_by = "finding" if plan.level else "nothing"
    return {
        "tolerance": tolerance,
        **facts,
        "worst_body": scene.bodies[plan.worst_body - 1].name if plan.worst_body else "",
        "bound_by": bound_by,
    }


def plan_text(found: dict) -> str:
    columns, rows, _ = found["sampling"].values()
    met = "can be met" if found["met"] else f"can NOT be met: {CURE}"
    lines = [("poses", str(found["poses"]))] if found["poses"] > 1 else []
    lines += [
        ("tolerance", f"{100 * found['tolerance']:g} % {met}"),
        ("samples", f"{found['samples']}, with {columns:.4g} columns per beam x {rows} rows in the aperture"),
    ]
    if found["has_echo"]:
        name, (error, off) = found["worst_body"], _estimates(found)
        lines += [
            ("error", f"{error} of the echo, estimated"),
            ("worst body", f"{name!r}, its own echo off by {off}, estimated" if name else "none"),
            ("bound by", BOUND_BY[found["bound_by"]]),
        ]
    else:
        lines.append(("error", "none: no echo comes back from this pose"))
    lines.append(("ping", f"{found['time_ms']:.2f} ms on {found['gl_renderer']}"))
    texts = [facts_text(found, lines), _plans_text(found)]
    if found["terms"]:
        texts.append(_terms_text(found["terms"]))
    return "\n\n".join(texts)


def _estimates(facts: dict) -> tuple[str, str]:
    """Return the estimated errors of the whole ping and of the worst body; each shows whether it breaks its bound."""
    tolerance = facts["tolerance"]
    return (
        percent(facts["error_estimate"], tolerance),
        percent(facts["worst_body_estimate"], WORST_BODY * tolerance),
    )


def _plans_text(found: dict) -> str:
    """Return the table of the plans for half the tolerance, the tolerance and twice the tolerance."""
    rows = [
        (
            f"{100 * facts['tolerance']:g} %",
            str(facts["samples"]),
            *_estimates(facts),
            f"{facts['time_ms']:.2f}",
            f"{facts['time_ratio']:.2f}",
            "yes" if facts["met"] else "no",
        )
        for facts in (found["halved"], found, found["doubled"])
        if facts is not None
    ]
    text = table_text(("tolerance", "samples", "error", "worst body", "ms", "ratio", "met"), rows)
    missing = [name for name in ("halved", "doubled") if found[name] is None]
    return "\n".join([text, *(f"{name}, it would lie outside 0.1 % to 50 %" for name in missing)])


def _terms_text(terms: list[dict]) -> str:
    rows = [
        (
            term["name"],
            percent(term["changes"]),
            percent(term["worst_bin"]),
            percent(term["changed_bins"]),
            f"{term['time_ms']:.2f}",
            "on" if term["on"] else "off",
        )
        for term in terms
    ]
    return table_text(("without", "the image changes", "worst bin", "bins > 3 dB", "ms", "needed"), rows)
