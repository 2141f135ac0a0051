#!/usr/bin/env python
"""Charts time against error of a whole ping, for ours and its rivals, over ladders of samples.

    python tools/chart.py --out docs     # six scenes, two widths of beams, shimmer; about 20 minutes
    python tools/chart.py --only pylon
    python tools/chart.py --quick        # under 2 minutes; exit status 1 if ours has left the front

Times are medians, with the 95th percentile beside them, of pings interleaved round by round while the sonar
creeps; errors are those of flat faces at the scene's own pose, of profile `ideal`, against
`sonar_gl.reference_ping`. docs/chart.md tells how to read what comes out.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import os
import pathlib
from contextlib import ExitStack, closing
from time import perf_counter

import numpy as np
from chart_front import OURS, false_change, table, violations
from chart_scenes import BEAMS, CACHE, SCENES, make_scene, make_sonar, make_truth
from chart_shimmer import shimmer
from rivals.methods import METHODS, best_factor

import sonar_gl as sg
from sonar_gl.verify import ping_error, worst_body

CREEP_M = 0.001  # a round: no two pings alike
SLOW_MS = 40.0  # rungs slower than that take every third round only
SHORT_MS = (
    10.0  # quicker ones ping once untimed before, so that the rungs before them do not chill their caches
)
POINTS = [
    "scene",
    "beams",
    "method",
    "rung",
    "samples",
    "ms_median",
    "ms_p95",
    "error",
    "worst_body",
    "renderer",
    "date",
]


def judge(contender, method, truth) -> tuple[float, str]:
    """Error at the scene's own pose; and worst body, for ours."""
    pose = truth.pose
    if method == "raster_mean":
        contender.factor = best_factor(contender.ping(pose), truth.intensity)
    echo = sg.Ping(contender.ping(pose), truth.azimuth_rad, truth.range_m)
    if method != OURS:
        return ping_error(echo, truth), ""
    labelled = contender.simulator.ping(pose, labels=True)
    return ping_error(echo, truth), f"{worst_body(labelled, truth)[0]:.5f}"


def measure(scene, sonar, beams: str, truth, repeats: int, quick: bool) -> list[dict]:
    """One row a method and rung; see POINTS."""
    acoustics, pose = sg.Acoustics.ideal(), scene.sonar_pose
    rows, contenders = [], []
    with ExitStack() as stack:
        for name, method in METHODS.items():
            if method.scenes and scene.name not in method.scenes:
                continue
            for rung in method.ladder(beams, quick):
                contender = stack.enter_context(closing(method.make(scene, sonar, acoustics, pose, rung)))
                error, worst = judge(contender, name, truth)
                start = perf_counter()
                contender.ping(pose)
                contenders.append((contender, 1e3 * (perf_counter() - start), []))
                rows.append(
                    {
                        "scene": scene.name,
                        "beams": beams,
                        "method": name,
                        "rung": "x".join(f"{n:g}" for n in rung),
                        "samples": contender.samples,
                        "error": error,
                        "worst_body": worst,
                    }
                )
        for number in range(repeats):
            here = pose @ sg.pose(x=CREEP_M * (number + 1))
            before = pose @ sg.pose(x=CREEP_M * (number + 0.5))
            for contender, about_ms, times in contenders:
                if about_ms > SLOW_MS and number % 3:
                    continue
                if about_ms < SHORT_MS:
                    contender.ping(before)
                start = perf_counter()
                contender.ping(here)
                times.append(1e3 * (perf_counter() - start))
    for row, (_, _, times) in zip(rows, contenders, strict=True):
        row["ms_median"], row["ms_p95"] = float(np.median(times)), float(np.quantile(times, 0.95))
    return rows


def points_of(rows) -> dict:
    """{(scene, beams): {method: [(ms, error), ...]}}."""
    out = {}
    for row in rows:
        methods = out.setdefault((row["scene"], row["beams"]), {})
        methods.setdefault(row["method"], []).append((row["ms_median"], row["error"]))
    return out


def write(path: pathlib.Path, rows, columns=None):
    """A CSV file, written beside and renamed."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    with open(beside, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns or list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()})
    os.replace(beside, path)


def tell(rows):
    """Print the table of times and ratios."""
    columns = list(rows[0])
    wide = [
        max(len(str(row[c])) for row in [*rows, dict(zip(columns, columns, strict=True))]) for c in columns
    ]
    for row in [dict(zip(columns, columns, strict=True)), *rows]:
        print("  ".join(f"{row[c]!s:{w}}" for c, w in zip(columns, wide, strict=True)).rstrip())


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--only", action="append", choices=(*SCENES, "shimmer"), help="may be repeated; all if left out"
    )
    parser.add_argument(
        "--quick", action="store_true", help="two scenes, few rungs; does ours keep the front?"
    )
    parser.add_argument("--out", type=pathlib.Path, help="where the CSV files go, and pictures/; else none")
    parser.add_argument("--cache", type=pathlib.Path, default=CACHE, help=f"where truths are kept; {CACHE}")
    parser.add_argument("--repeats", type=int, help="rounds; 15, or 9 if quick")
    options = parser.parse_args()
    began = perf_counter()
    only = options.only or (("pylon", "tank") if options.quick else (*SCENES, "shimmer"))
    repeats = options.repeats or (9 if options.quick else 15)
    with sg.Simulator(sg.Scene([]), make_sonar("pylon", "wide")) as simulator:
        renderer = simulator.gl_info["renderer"]
    date = datetime.date.today().isoformat()
    about = f"sonar_gl {sg.__version__}, {renderer}, {os.cpu_count()} CPUs, {date}"
    print(f"{about}; load at the start {os.getloadavg()[0]:.1f} (quiet is below 0.3)", flush=True)
    if options.out:
        import chart_draw  # needs matplotlib, which the numbers alone do not

        (options.out / "pictures").mkdir(parents=True, exist_ok=True)
    rows = []
    for name in [n for n in only if n != "shimmer"]:
        scene, doubts = make_scene(name), {}
        for beams in BEAMS:
            start, sonar = perf_counter(), make_sonar(name, beams)
            truth = make_truth(scene, sonar, options.quick, options.cache)
            doubts[beams] = truth.meta["difference"] / 2
            known = perf_counter()
            rows += measure(scene, sonar, beams, truth, repeats, options.quick)
            print(
                f"{name}, {beams}: truth {known - start:.0f} s, doubt {100 * doubts[beams]:.1g} %; "
                f"charted in {perf_counter() - known:.0f} s",
                flush=True,
            )
        if options.out:
            mine = [row for row in rows if row["scene"] == name]
            path = options.out / "pictures" / f"chart_{name}.png"
            chart_draw.chart(path, name, points_of(mine), doubts, make_sonar, about)
    if rows:
        charts = points_of(rows)
        times = table(charts)
        tell(times)
        for row in rows:
            row |= {"renderer": renderer, "date": date}
        if options.out:
            write(options.out / "chart_points.csv", rows, POINTS)
            write(options.out / "chart_times.csv", times)
    if "shimmer" in only:
        found, doubts = shimmer(repeats)
        for beams, doubt in doubts.items():
            methods = {}
            for row in (row for row in found if row["beams"] == beams):
                methods.setdefault(row["method"], []).append((row["ms_median"], row["shimmer"]))
            share, rival = false_change(methods)
            print(
                f"shimmer, {beams}: at equal time ours is at most {share:.2f} of a rival's ({rival}); "
                f"aim 0.5 {'met' if share <= 0.5 else 'missed'}; doubt of the truth {doubt:.1%}"
            )
        if options.out:
            write(options.out / "chart_shimmer.csv", found)
            chart_draw.shimmer(options.out / "pictures" / "chart_shimmer.png", found, doubts, about)
    print(f"took {perf_counter() - began:.0f} s, load at the end {os.getloadavg()[0]:.1f}")
    if options.quick and rows:
        left = violations(charts)
        print("\n".join(left) or "ours keeps the front")
        raise SystemExit(1 if left else 0)


if __name__ == "__main__":
    main()
