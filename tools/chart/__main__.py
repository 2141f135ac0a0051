"""Chart time against error of a whole ping, for ours and its rivals, over several resolutions.

    python -m tools.chart --out docs     # six scenes, two widths of beams, shimmer; about 20 minutes
    python -m tools.chart --only pylon
    python -m tools.chart --device --out docs    # what the whole device costs over profile ideal; writes that table
    python -m tools.chart --quick        # under 2 minutes; exit status 1 if ours has left the front

Times are medians, with the 95th percentile beside them, of pings that take turns while the sonar creeps.
Errors are those of flat faces at the scene's own pose, of profile `ideal`, against
`sonar_gl.reference_ping`. docs/chart.md says how to read the result.
"""

from __future__ import annotations

import argparse
import datetime
from contextlib import ExitStack, closing
from pathlib import Path
from time import perf_counter

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error, worst_body
from sonar_gl.core.errors import MachineError
from tools.bench import harness
from tools.bench.harness import Contender
from tools.chart import device
from tools.chart.front import JUDGED, OUR_OPENGL, OURS, by_scene, false_change, table, violations
from tools.chart.rivals.methods import METHODS, best_factor
from tools.chart.scenes import BEAMS, SCENES, make_scene, make_sonar, make_truth
from tools.chart.shimmer import shimmer
from tools.docs.pages import put_table

SLOW_MS = 40.0  # what is slower takes every third round only
# Of a scene in which a rival is quicker, before ours has left the front. Of a virtual machine with two cores the second
# may be late for half a minute: pings of two threads then take half as long again, those of rivals a quarter.
MORE_TRIES = 6
SHORT_MS = 10.0  # what is quicker pings once untimed before, so that its caches are warm
POINTS = [
    "scene",
    "beams",
    "method",
    "resolution",
    "samples",
    "ms_median",
    "ms_p95",
    "error",
    "worst_body",
    "renderer",
    "date",
]


def judge(rival, method, truth) -> tuple[float, str]:
    """Return the error at the scene's own pose; and the worst body's, for ours."""
    pose = truth.pose
    if method == "raster_mean":
        rival.factor = best_factor(rival.ping(pose), truth.intensity)
    echo = sg.Ping(rival.ping(pose), truth.azimuth_rad, truth.range_m)
    if method not in (OURS, OUR_OPENGL):
        return ping_error(echo, truth), ""
    labelled = rival.simulator.ping(pose, labels=True)
    return ping_error(echo, truth), f"{worst_body(labelled, truth)[0]:.5f}"


def contender_of(rival, pose) -> Contender:
    """Return how often a rival pings, by what one ping takes."""
    ms, _ = harness.timed(rival.ping, pose)

    def warm(number):
        rival.ping(harness.creep(pose, number + 0.5))

    return Contender(
        lambda number: rival.ping(harness.creep(pose, number + 1)),
        before=warm if ms < SHORT_MS else None,
        every=3 if ms > SLOW_MS else 1,
    )


def has_opengl() -> bool:
    """Return whether OpenGL can draw here; print why not."""
    try:
        sg.Simulator(sg.Scene([]), make_sonar("pylon", "wide"), engine="opengl").close()
    except MachineError as error:
        print(f"without {OUR_OPENGL}: {error}")
        return False
    return True


def measure(scene, sonar, beams: str, truth, rounds: int, quick: bool, left_out) -> list[dict]:
    """Return one row a method and resolution, but for methods that are left out; see POINTS, and `ms_least`."""
    acoustics, pose = sg.Acoustics.ideal(), scene.sonar_pose
    rows, contenders = [], {}
    with ExitStack() as stack:
        for name, method in METHODS.items():
            if name in left_out or (method.scenes and scene.name not in method.scenes):
                continue
            for resolution in method.resolutions(beams, quick):
                rival = stack.enter_context(closing(method.make(scene, sonar, acoustics, pose, resolution)))
                error, worst = judge(rival, name, truth)
                contenders[len(rows)] = contender_of(rival, pose)
                rows.append(
                    {
                        "scene": scene.name,
                        "beams": beams,
                        "method": name,
                        "resolution": "x".join(f"{n:g}" for n in resolution),
                        "samples": rival.samples,
                        "error": error,
                        "worst_body": worst,
                        "renderer": rival.renderer,
                    }
                )
        times = harness.take_turns(contenders, rounds, warm_up=0)
    for row, ms in zip(rows, times.values(), strict=True):
        spread = harness.spread_of(ms)
        row["ms_median"], row["ms_p95"], row["ms_least"] = spread["median"], spread["p95"], float(ms.min())
    return rows


def measure_again(rows, rounds: int, left_out) -> None:
    """Lower the least times of rows whose scene and beams show ours behind a rival, where they were shorter this time.

    On a busy machine the least of a few rounds of one method may hold other work, and that of another none.
    """
    for key, methods in points_of(rows, "ms_least").items():
        if violations({key: methods}):
            name, beams = key
            print(f"{name}, {beams}: measured again", flush=True)
            scene, sonar = make_scene(name), make_sonar(name, beams)
            found = measure(scene, sonar, beams, make_truth(scene, sonar, True), rounds, True, left_out)
            mine = [row for row in rows if (row["scene"], row["beams"]) == key]
            for row, again in zip(mine, found, strict=True):
                row["ms_least"] = min(row["ms_least"], again["ms_least"])


def points_of(rows, time: str = "ms_median") -> dict:
    """Return {(scene, beams): {method: [(ms, error), ...]}}; time names a column of the rows."""
    out = {}
    for row in rows:
        methods = out.setdefault((row["scene"], row["beams"]), {})
        methods.setdefault(row["method"], []).append((row[time], row["error"]))
    return out


def report_shimmer(rows, uncertainties):
    """Print ours' largest share of a rival's shimmer at equal time, of each width of beams."""
    for beams, uncertainty in uncertainties.items():
        methods = {}
        for row in (row for row in rows if row["beams"] == beams):
            methods.setdefault(row["method"], []).append((row["ms_median"], row["shimmer"]))
        share, rival = false_change(methods)
        print(
            f"shimmer, {beams}: at equal time ours is at most {share:.2f} of a rival's ({rival}); "
            f"aim 0.5 {'met' if share <= 0.5 else 'missed'}; uncertainty of the truth {uncertainty:.1%}"
        )


def write_results(page: Path, times):
    """Put the tables of times and ratios at each error into chart.md."""
    for error in JUDGED:
        put_table(page, f"at {100 * error:g} %", harness.markdown(by_scene(times, error)))


def chart_device(names, rounds: int, out: Path | None, about: str):
    """Time the whole device over profile ideal; write the table of chart.md in the folder `out`."""
    costs = {name: device.costs_of(name, rounds) for name in names}
    text = device.table(costs)
    print(text)
    harness.print_aims(device.aims(costs))
    if out:
        put_table(out / "chart.md", "device", f"{about}; {rounds} rounds.\n\n{text}")


def main():
    """Chart what the options name."""
    parser = argparse.ArgumentParser(prog="python -m tools.chart", description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--only", action="append", choices=(*SCENES, "shimmer"), help="may be repeated; default: all"
    )
    parser.add_argument(
        "--quick", action="store_true", help="two scenes, few resolutions: does ours keep the front?"
    )
    parser.add_argument("--device", action="store_true", help="only what the whole device costs over ideal")
    parser.add_argument("--out", type=Path, help="folder for the CSV files and pictures/; none if left out")
    parser.add_argument("--rounds", type=int, help="15, or 9 if quick")
    options = parser.parse_args()
    start = perf_counter()
    only = options.only or (("pylon", "tank") if options.quick else (*SCENES, "shimmer"))
    rounds = options.rounds or (9 if options.quick else 15)
    machine, date = harness.describe_machine(), datetime.date.today().isoformat()
    about = f"{harness.one_line(machine)}, {date}"
    print(f"{about}; load at the start {machine['load']:.1f} (quiet is below 0.3)", flush=True)
    if options.device:
        chart_device([name for name in only if name != "shimmer"], rounds, options.out, about)
        return
    if options.out:
        from tools.chart import draw  # needs matplotlib, which the numbers alone do not

        (options.out / "pictures").mkdir(parents=True, exist_ok=True)
    rows, left_out = [], () if has_opengl() else (OUR_OPENGL,)
    for name in [n for n in only if n != "shimmer"]:
        scene, uncertainties = make_scene(name), {}
        for beams in BEAMS:
            sonar = make_sonar(name, beams)
            truth_ms, truth = harness.timed(make_truth, scene, sonar, options.quick)
            uncertainties[beams] = truth.meta["difference"] / 2
            ms, found = harness.timed(measure, scene, sonar, beams, truth, rounds, options.quick, left_out)
            rows += found
            print(
                f"{name}, {beams}: truth {truth_ms / 1e3:.0f} s, uncertain by "
                f"{100 * uncertainties[beams]:.1g} %; charted in {ms / 1e3:.0f} s",
                flush=True,
            )
        if options.out:
            mine = [row for row in rows if row["scene"] == name]
            path = options.out / "pictures" / f"chart_{name}.png"
            draw.chart(path, name, points_of(mine), uncertainties, make_sonar, about)
    if rows:
        charts = points_of(rows)
        times = table(charts)
        harness.print_table(times, indent=0)
        for row in rows:
            row["date"] = date
        if options.out:
            harness.write_csv(options.out / "chart_points.csv", rows, POINTS)
            harness.write_csv(options.out / "chart_times.csv", times)
            if not options.only:
                write_results(options.out / "chart.md", times)
    if "shimmer" in only:
        found, uncertainties = shimmer(rounds)
        report_shimmer(found, uncertainties)
        if options.out:
            harness.write_csv(options.out / "chart_shimmer.csv", found)
            draw.shimmer(options.out / "pictures" / "chart_shimmer.png", found, uncertainties, about)
    print(f"took {perf_counter() - start:.0f} s")
    if options.quick and rows:
        # other work on the machine only adds time, and seldom to every round
        for _ in range(MORE_TRIES):
            measure_again(rows, rounds, left_out)
        left = violations(points_of(rows, "ms_least"))
        print("\n".join(left) or "ours keeps the front")
        raise SystemExit(1 if left else 0)


if __name__ == "__main__":
    main()
