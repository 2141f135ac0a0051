#!/usr/bin/env python
"""How the time of a ping grows: with triangles, beams, bins, field of view, bodies and tolerance.

    python tools/bench_scaling.py                  # some minutes; prints times and aims
    python tools/bench_scaling.py --out docs       # also docs/scaling.csv and docs/pictures/scaling.png
    python tools/bench_scaling.py --large          # also 10 million triangles, in a process of their own
    python tools/bench_scaling.py --quick          # a few seconds: does it run?

The setting is the chart's: 256 beams of 1 degree boxes over 45 x 20 degrees, 512 bins to 30 m, profile
`ideal`; scene `pylon`, but for triangles, which are those of the floor of `ocean_floor`, interpolated, and
bodies, which are balls of 20 triangles in open water. "Same samples" are as many to a degree as tolerance
0.01 asks for in the scene as it is bundled; "tolerance 0.01" chooses for each case.

What is compared takes turns, a round of all and then the next, after some rounds untimed, while the sonar
creeps; times are medians of the rounds, ratios medians of the rounds' ratios.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import os
import pathlib
from collections.abc import Callable
from dataclasses import replace

import bench_changes
import numpy as np
from bench_cases import (
    EACH,
    JOINED,
    QUICK,
    SAME,
    SHARED,
    Case,
    Sizes,
    of_a_triangle,
    of_bodies,
    of_sonars,
    of_tolerances,
    of_triangles,
    race,
    widened,
)
from chart_scenes import make_sonar

import sonar_gl as sg


def between(cases, last, first) -> float:
    """Median over the rounds of the time of one (line, value) over another's."""
    known = {(case.line, case.at): case.ms for case in cases}
    return float(np.median(np.divide(known[last], known[first])))


def measure(sizes: Sizes, tell: Callable) -> tuple[list[Case], list[tuple]]:
    """All cases that are timed in rounds; and aims: (what, measured, unit, aim, whether at least).

    tell : is given each axis' cases when they are known
    """
    cases, aims = [], []

    def run(made):
        found = race(made, sizes.rounds)
        tell(found)
        cases.extend(replace(case, scene=None) for case in found)  # large scenes are let go
        return found

    found = run(of_triangles(sizes.triangles))
    first, last = found[0].at, found[-1].at
    name = f"{last:,} triangles / {first:,}".replace(",", " ")
    aims.append((name, between(found, (SAME, last), (SAME, first)), "times", 2.0, False))
    del found
    run(of_sonars("beams", sizes.beams, lambda sonar, n: replace(sonar, n_beams=n)))
    run(of_sonars("bins", sizes.bins, lambda sonar, n: replace(sonar, n_bins=n)))
    found = run(of_sonars("field of view, degrees", sizes.fields_deg, widened))
    first, last = found[0].at, found[-1].at
    name = f"{last:g} degrees / {first:g}"
    aims.append((name, between(found, (SAME, last), (SAME, first)), "times", 9.0, False))
    found = run(of_bodies(sizes.bodies))
    n = found[-1].at
    for line in (EACH, SHARED):
        name = f"{n} {line} / {JOINED}"
        aims.append((name, between(found, (line, n), (JOINED, n)), "times", 3.0, False))
    run(of_tolerances(sizes.tolerances))
    (triangle,) = run(of_a_triangle())
    aims.append(("one visible triangle", float(np.median(triangle.ms)), "ms", 0.4, False))
    aims += bench_changes.measure(sizes)
    return cases, aims


def tell(cases: list[Case]):
    """Print one axis."""
    print(f"\n{cases[0].axis}")
    wide = max(len(case.line) for case in cases)
    for line in dict.fromkeys(case.line for case in cases):
        for case in (one for one in cases if one.line == line):
            median, p95 = np.median(case.ms), np.quantile(case.ms, 0.95)
            print(f"  {line:{wide}}  {case.at:>9.7g}  {case.samples:>12}  {median:8.2f} ms  p95 {p95:8.2f}")


def tell_aims(aims):
    """Print what was aimed at, and what came of it."""
    wide = max(len(what) for what, *_ in aims)
    print(f"\n{'aims':{wide + 2}}  {'measured':>8}         {'aim':>8}")
    for what, measured, unit, aim, at_least in aims:
        met = measured >= aim if at_least else measured <= aim
        sign = ">=" if at_least else "<="
        print(
            f"  {what:{wide}}  {measured:8.3g} {unit:5}  {f'{sign} {aim:g}':>8}  {'met' if met else 'missed'}"
        )


def rows_of(cases, renderer: str) -> list[dict]:
    """What goes into the CSV file."""
    date = datetime.date.today().isoformat()
    return [
        {
            "axis": case.axis,
            "line": case.line,
            "at": f"{case.at:g}",
            "samples": case.samples,
            "ms_median": f"{np.median(case.ms):.4g}",
            "ms_p95": f"{np.quantile(case.ms, 0.95):.4g}",
            "renderer": renderer,
            "date": date,
        }
        for case in cases
    ]


def scaling(quick: bool = False, with_large: bool = False, out: pathlib.Path | None = None):
    """Measure, print and, into the folder `out`, write and draw."""
    if out:
        import bench_draw  # needs matplotlib, which the numbers alone do not

        (out / "pictures").mkdir(parents=True, exist_ok=True)
    sizes = QUICK if quick else Sizes()
    with sg.Simulator(sg.Scene([]), make_sonar("pylon", "wide")) as simulator:
        renderer = simulator.gl_info["renderer"]
    about = f"sonar_gl {sg.__version__} on {renderer}, {os.cpu_count()} cores"
    print(f"{about}; {sizes.rounds} rounds, load {os.getloadavg()[0]:.1f} (quiet is below 0.3)")
    cases, aims = measure(sizes, tell)
    if with_large:
        found = bench_changes.large(sizes.large)
        print(
            f"\n{found['triangles']} triangles from a file: loaded in {found['load_s']:.1f} s, "
            f"simulator made in {found['make_s']:.1f} s, ping {found['ping_ms']:.2f} ms"
        )
        aims.append(
            (f"memory of {found['triangles']} triangles, peak", found["peak_mb"], "MB", 4096.0, False)
        )
    tell_aims(aims)
    if out:
        rows = rows_of(cases, renderer)
        with open(out / "scaling.csv", "w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        bench_draw.scaling(out / "pictures" / "scaling.png", rows, about)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few sizes and rounds; says little")
    parser.add_argument("--large", action="store_true", help="also 10 million triangles")
    parser.add_argument("--out", type=pathlib.Path, help="where scaling.csv goes, and pictures/; else none")
    options = parser.parse_args()
    scaling(options.quick, options.large, options.out)


if __name__ == "__main__":
    main()
