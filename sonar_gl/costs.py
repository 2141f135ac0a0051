"""What the command `plan` finds and says: samples and terms that a tolerance asks for, and their costs."""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack
from dataclasses import asdict

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


def about(ping) -> dict:
    """What was pinged, and with what."""
    known = {name: ping.meta[name] for name in ("scene", "profile", "gl_renderer")}
    beams, bins = ping.intensity.shape
    return {**known, "sonar": ping.meta["sonar"]["name"], "beams": beams, "bins": bins}


def cost_plans(scene, sonar, acoustics, poses, tolerance: float) -> dict:
    """What `sonar-gl plan` finds, as plain values: of a tolerance, of half and of twice of it."""
    import numpy as np

    from sonar_gl.plan import check_tolerance
    from sonar_gl.simulator import Simulator
    from sonar_gl.terms import price
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
        priced = price(simulators["chosen"], sonar, tolerance, poses, acoustics) if has_echo else []
    terms = [asdict(term) for term in priced]
    for name, cost in costs.items():
        cost["time_ms"] = float(np.median(times_ms[name]))
        cost["time_ratio"] = cost["time_ms"] / float(np.median(times_ms["chosen"]))
    others = {name: costs.get(name) for name in ("halved", "doubled")}
    return {
        **about(ping),
        "poses": len(poses),
        "has_echo": has_echo,
        **costs["chosen"],
        **others,
        "terms": terms,
    }


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
    lines = [*head(found)] + ([("poses", str(found["poses"]))] if found["poses"] > 1 else [])
    lines += [
        ("tolerance", f"{percent(found['tolerance'])} {met}"),
        ("samples", f"{columns:.4g} columns per beam x {rows} rows = {found['samples']}"),
    ]
    if found["has_echo"]:
        worst, off = found["worst_body"], percent(found["worst_body_estimate"])
        lines += [
            ("error", f"{percent(found['error_estimate'])} of the echo, estimated"),
            ("worst body", f"{worst!r}, its own echo, off by {off}, estimated" if worst else "none"),
            ("bound by", BOUND_BY[found["bound_by"]]),
        ]
    else:
        lines.append(("error", "nothing comes back from here, and there is nothing to err about"))
    lines.append(("ping", f"{found['time_ms']:.2f} ms on {found['gl_renderer']}"))
    text = [f"{name:10}  {value}" for name, value in lines]
    text += ["", "tolerance   samples    error  worst body        ms  ratio"]
    for cost in filter(None, (found["halved"], found, found["doubled"])):
        share, error, body = (percent(cost[name]) for name in SHARES)
        row = f"{share:>9}  {cost['samples']:8}  {error:>7}  {body:>10}  {cost['time_ms']:8.2f}"
        text.append(f"{row}  {cost['time_ratio']:5.2f}" + ("" if cost["met"] else "  not met"))
    missing = [name for name in ("halved", "doubled") if found[name] is None]
    text += [f"{name}, it would lie outside 0.1 % to 50 %" for name in missing]
    return "\n".join(text + _terms_text(found["terms"]))


def _terms_text(terms: list[dict]) -> list[str]:
    """A table of what the terms are worth; nothing of none."""
    if not terms:
        return []
    text = ["", "without            the image changes  worst bin       ms  needed"]
    for term in terms:
        share, bin_ = percent(term["changes"]), percent(term["worst_bin"])
        row = f"{term['name']:17}  {share:>17}  {bin_:>9}  {term['time_ms']:7.2f}"
        text.append(f"{row}  {'on' if term['on'] else 'off'}")
    return text


def head(found: dict) -> list[tuple[str, str]]:
    return [
        ("scene", found["scene"]),
        ("sonar", f"{found['sonar']}, {found['beams']} beams x {found['bins']} bins"),
        ("profile", found["profile"]),
    ]


def percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def plain(value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
