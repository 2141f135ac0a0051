"""Read the chart's points: fronts, times at an error, ratios, aims, and whether ours keeps to the front.

A point is (milliseconds, error). Nothing is extrapolated: where a method's points end before an error, a mark
says on which side the true time lies.
"""

from __future__ import annotations

import numpy as np

OURS, OUR_OPENGL, OUR_RAYS, JITTERED = "ours", "ours_opengl", "rays_footprints", "rays_jittered"
JUDGED = (0.01, 0.003)  # errors at which times are compared
AIMS = {  # the rival's time over ours, at each error of JUDGED
    JITTERED: {"pylon": (35.0,), "diver": (25.0,), "ocean_floor_1m": (12.0,)},
    OUR_RAYS: dict.fromkeys(("pylon", "diver", "ocean_floor", "ocean_floor_1m", "tank"), (1.5, 2.0)),
}
TUBES = "tubes"
COLUMNS = {  # of the tables in chart.md: method, and 0 for milliseconds or 1 for the ratio
    "ours, ms": (OURS, 0),
    "ours by OpenGL": (OUR_OPENGL, 1),
    "rays, our footprints": (OUR_RAYS, 1),
    "rays, jittered": (JITTERED, 1),
    "tubes": (TUBES, 1),
}
BAND = np.geomspace(0.03, 0.005, 8)  # errors at which `violations` compares
NOISE = 1.25  # a rival must be this much quicker to count
UNJUDGED = (OURS, OUR_OPENGL, "slices")  # slices are for scenes of few faces, and only shown


def envelope(points) -> np.ndarray:
    """Return the (N, 2) points that no other point beats in time and error, by rising time."""
    front = []
    for ms, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((ms, error))
    return np.array(front)


def time_at(points, error: float) -> tuple[float, str]:
    """Return the milliseconds for an error, log-log between the points of the envelope, and a mark.

    The mark is ">" where the slowest point still errs more, "<" where all points err less, with the time of the
    quickest; else "". Where that of the quickest does, and a slower one errs more, nothing is quicker.
    """
    front = envelope(points)
    if error < front[-1, 1]:
        return float(front[-1, 0]), ">"
    if error > front[0, 1]:
        return float(front[0, 0]), "" if max(one for _, one in points) >= error else "<"
    ms, errors = np.log(front[::-1]).T
    return float(np.exp(np.interp(np.log(error), errors, ms))), ""


def ratio_at(rival, ours, error: float) -> tuple[float, str]:
    """Return the rival's time over ours and a mark: ">" (at least), "<" (at most), "?" (not known) or ""."""
    (theirs, mark), (own, own_mark) = time_at(rival, error), time_at(ours, error)
    if own_mark and mark == own_mark:
        return theirs / own, "?"
    return theirs / own, mark or {">": "<", "<": ">", "": ""}[own_mark]


def aim_met(scene: str, method: str, ratios) -> str:
    """Return whether ours is as far ahead as AIMS say, as text.

    ratios : of `ratio_at`, at JUDGED
    """
    aims = AIMS.get(method, {}).get(scene, ())
    judged = zip(aims, ratios, JUDGED, strict=False)  # some have no aim at the second error
    return ", ".join(f"{_passes(*ratio, aim)} at {100 * error:g} %" for aim, ratio, error in judged)


def _passes(ratio: float, mark: str, aim: float) -> str:
    if mark == "?" or (mark == ">" and ratio < aim) or (mark == "<" and ratio >= aim):
        return "open"
    return "met" if ratio >= aim else "missed"


def table(charts) -> list[dict]:
    """Return rows of times and ratios; charts: {(scene, beams): {method: points}}."""
    rows = []
    for (scene, beams), methods in charts.items():
        for method, points in methods.items():
            row = {"scene": scene, "beams": beams, "method": method}
            ratios = [ratio_at(points, methods[OURS], error) for error in JUDGED]
            for error, (ratio, mark) in zip(JUDGED, ratios, strict=True):
                ms, side = time_at(points, error)
                row[f"ms_at_{error:g}"] = f"{side}{ms:.3g}"
                row[f"ratio_at_{error:g}"] = f"{mark}{ratio:.3g}"
            rows.append({**row, "aim": aim_met(scene, method, ratios)})
    return rows


def by_scene(times, error: float) -> list[dict]:
    """Return rows of a page: our time and the ratios of some rivals, a scene a row, wide / narrow beams.

    times : rows of `table`; scenes on which ours never has an error as large are left out
    """
    cells = {
        (row["scene"], row["method"], row["beams"]): (row[f"ms_at_{error:g}"], row[f"ratio_at_{error:g}"])
        for row in times
    }
    rows = []
    for scene in dict.fromkeys(row["scene"] for row in times):
        if any(cells[scene, OURS, beams][0].startswith("<") for beams in ("wide", "narrow")):
            continue
        row = {f"at {100 * error:g} %": f"`{scene}`"}
        for column, (method, which) in COLUMNS.items():
            both = [cells.get((scene, method, beams)) for beams in ("wide", "narrow")]
            row[column] = " / ".join(mark_and_digits(cell[which]) if cell else "-" for cell in both)
        rows.append(row)
    return rows


def mark_and_digits(cell: str) -> str:
    """Return a cell of `table` with two digits."""
    digits = cell.lstrip("<>?")
    return cell[: len(cell) - len(digits)] + f"{float(f'{float(digits):.2g}'):g}"


def violations(charts) -> list[str]:
    """Return a line for each rival that is quicker than ours by more than noise, at an error within BAND."""
    out = []
    for (scene, beams), methods in charts.items():
        for method, points in methods.items():
            if method in UNJUDGED:
                continue
            worst = None
            for error in BAND:
                ratio, mark = ratio_at(points, methods[OURS], error)
                # neither a lower bound nor "not known" proves anything against ours
                if ratio * NOISE < 1 and mark in ("", "<") and (worst is None or ratio < worst[0]):
                    worst = ratio, error
            if worst:
                out.append(
                    f"{scene}, {beams} beams: {method} takes {worst[0]:.2f} of our time "
                    f"at {worst[1]:.2%} error"
                )
    return out


def false_change(methods) -> tuple[float, str]:
    """Return ours' largest share of a rival's shimmer at the same time, and that rival's name.

    methods : {method: points}, (ms, shimmer); times within both methods' points are compared
    """
    worst = 0.0, ""
    own = envelope(methods[OURS])
    for method, points in methods.items():
        if method == OURS:
            continue
        front = envelope(points)
        times = np.geomspace(max(own[0, 0], front[0, 0]), min(own[-1, 0], front[-1, 0]), 30)
        ours, theirs = (np.interp(np.log(times), *np.log(f).T) for f in (own, front))
        share = float(np.exp(ours - theirs).max())
        if share > worst[0]:
            worst = share, method
    return worst
