"""Measure how the time of a ping grows: with triangles, beams, bins, field of view, bodies and tolerance.

    python -m tools.bench scaling                  # some minutes; prints times and aims
    python -m tools.bench scaling --out docs       # also docs/scaling.csv and docs/pictures/scaling.png
    python -m tools.bench scaling --large          # also 10 million triangles, in a process of their own
    python -m tools.bench scaling --quick          # a few seconds: does it run?

The setting is the chart's: 256 beams of 1 degree boxes over 45 x 20 degrees, 512 bins to 30 m, profile
`ideal`, scene `pylon`. Two axes differ: triangles are those of the floor of `ocean_floor`, interpolated;
bodies are balls of 20 triangles in open water. "Same samples" are as many a degree as tolerance 0.01 asks for
in the scene as it is bundled; "tolerance 0.01" chooses for each case.
"""

from __future__ import annotations

import datetime
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.sonar.sampling import sampling_at
from tools import internals
from tools.bench import harness
from tools.bench.harness import Aim
from tools.chart.scenes import make_scene, make_sonar
from tools.chart.terrain import finer_floor

ROUNDS = 40, 2
IDEAL = sg.Acoustics.ideal()
BALL_M = 0.15  # of 20 triangles: a thousand joined are still few enough to be recognised as closed
LARGE_PINGS = 9
SAME, CHOSEN = "same samples", "tolerance 0.01"
EACH, SHARED, JOINED = "bodies, a mesh each", "bodies, one mesh for all", "joined into one mesh"


@dataclass(frozen=True)
class Sizes:
    """The values along each axis."""

    triangles: tuple = (250_000, 1_000_000, 4_000_000)
    beams: tuple = (64, 128, 256, 512, 1024)
    bins: tuple = (128, 256, 512, 1024, 2048, 4096)
    fields_deg: tuple = (45, 90, 180, 360)
    bodies: tuple = (1, 10, 100, 1000)
    tolerances: tuple = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
    large: int = 10_000_000


QUICK = Sizes(
    triangles=(10_000, 40_000),
    beams=(64, 256),
    bins=(128, 512),
    fields_deg=(45, 360),
    bodies=(1, 30),
    tolerances=(0.1, 0.02),
    large=200_000,
)


@dataclass(frozen=True)
class Case:
    """One point of a line: what a simulator is made of."""

    axis: str
    line: str
    at: float
    scene: sg.Scene
    sonar: sg.Sonar
    how: dict  # tolerance or sampling


@dataclass(frozen=True)
class Point:
    """One measured point of a line."""

    axis: str
    line: str
    at: float
    samples: str
    ms: np.ndarray


def time_cases(cases: list[Case], rounds: int) -> list[Point]:
    """Time the cases of an axis. Those of one scene share it."""
    with ExitStack() as stack:
        worlds, simulators = {}, []
        for case in cases:
            world = worlds.get(id(case.scene), case.scene)
            simulators.append(stack.enter_context(sg.Simulator(world, case.sonar, IDEAL, **case.how)))
            worlds.setdefault(id(case.scene), simulators[-1])
            simulators[-1].plan([case.scene.sonar_pose])

        def pinger(case, simulator):
            return lambda number: simulator.ping(harness.creep(case.scene.sonar_pose, number))

        pairs = enumerate(zip(cases, simulators, strict=True))
        times = harness.take_turns({number: pinger(*pair) for number, pair in pairs}, rounds)
        samples = ["{} x {}".format(*internals.sample_grid(simulator)) for simulator in simulators]
    return [
        Point(case.axis, case.line, case.at, size, ms)
        for case, size, ms in zip(cases, samples, times.values(), strict=True)
    ]


def level_of(scene, sonar) -> int:
    """Return the sampling level that tolerance 0.01 asks for."""
    with sg.Simulator(scene, sonar, IDEAL) as simulator:
        return simulator.plan([scene.sonar_pose]).level


def cases_of_triangles(counts) -> list[Case]:
    """Make the same ground, ever finer."""
    sonar, cases = make_sonar("ocean_floor", "wide"), []
    level = level_of(make_scene("ocean_floor"), sonar)
    for count in counts:
        scene = finer_floor(count)
        for line, how in ((SAME, {"sampling": sampling_at(sonar, level)}), (CHOSEN, {})):
            cases.append(Case("triangles", line, count, scene, sonar, how))
    return cases


def cases_of_sonars(axis: str, values, change: Callable) -> list[Case]:
    """Make sonars before the pylon by change(sonar, value)."""
    scene, sonar = make_scene("pylon"), make_sonar("pylon", "wide")
    level, cases = level_of(scene, sonar), []
    for value in values:
        other = change(sonar, value)
        for line, how in ((SAME, {"sampling": sampling_at(other, level)}), (CHOSEN, {})):
            cases.append(Case(axis, line, value, scene, other, how))
    return cases


def widened(sonar, fov_deg):
    """Return the sonar with another field of view and as many beams a degree."""
    beams = round(sonar.n_beams * fov_deg / sonar.azimuth_fov_deg)
    return replace(sonar, azimuth_fov_deg=float(fov_deg), n_beams=beams)


def cases_of_bodies(counts) -> list[Case]:
    """Make balls in open water, and one mesh of the same triangles."""
    sonar, ball = make_sonar("pylon", "wide"), trimesh.creation.icosphere(0, BALL_M)
    sampling = sampling_at(sonar, level_of(make_scene("pylon"), sonar))
    cases = []
    for count in counts:
        rng = np.random.default_rng(0)
        range_m, azimuth, elevation = rng.uniform((4, -0.38, -0.16), (28, 0.38, 0.16), (count, 3)).T
        places = [
            sg.pose(r * np.cos(b) * np.cos(a), r * np.cos(b) * np.sin(a), r * np.sin(b))
            for r, a, b in zip(range_m, azimuth, elevation, strict=True)
        ]
        joined = trimesh.util.concatenate([ball.copy().apply_transform(place) for place in places])
        worlds = {
            EACH: [sg.Body(f"ball {k}", ball.copy(), place) for k, place in enumerate(places)],
            SHARED: [sg.Body(f"ball {k}", ball, place) for k, place in enumerate(places)],
            JOINED: [sg.Body("balls", joined)],
        }
        for line, bodies in worlds.items():
            scene = sg.Scene(bodies, np.eye(4))
            cases.append(Case("bodies", line, count, scene, sonar, {"sampling": sampling}))
    return cases


def cases_of_tolerances(tolerances) -> list[Case]:
    """Make tolerances before the pylon."""
    scene, sonar = make_scene("pylon"), make_sonar("pylon", "wide")
    return [Case("tolerance", "tolerance", one, scene, sonar, {"tolerance": one}) for one in tolerances]


def axes_of(sizes: Sizes) -> Iterator[list[Case]]:
    """Make the cases of one axis after the other; large scenes are dropped in between."""
    yield cases_of_triangles(sizes.triangles)
    yield cases_of_sonars("beams", sizes.beams, lambda sonar, n: replace(sonar, n_beams=n))
    yield cases_of_sonars("bins", sizes.bins, lambda sonar, n: replace(sonar, n_bins=n))
    yield cases_of_sonars("field of view, degrees", sizes.fields_deg, widened)
    yield cases_of_bodies(sizes.bodies)
    yield cases_of_tolerances(sizes.tolerances)


def aims_of(points: list[Point]) -> list[Aim]:
    """Compare the ends of some axes with what was aimed at."""
    axes = {}
    for point in points:
        axes.setdefault(point.axis, {})[point.line, point.at] = point.ms

    def over(axis, last, first):
        return harness.ratio(axes[axis][last], axes[axis][first])

    def same(axis):
        return [at for line, at in axes[axis] if line == SAME]

    few, *_, many = same("triangles")
    name = f"{many:,} triangles / {few:,}".replace(",", " ")
    out = [Aim(name, over("triangles", (SAME, many), (SAME, few)), "times", 2.0)]
    narrow, *_, wide = same("field of view, degrees")
    name = f"{wide:g} degrees / {narrow:g}"
    out.append(Aim(name, over("field of view, degrees", (SAME, wide), (SAME, narrow)), "times", 9.0))
    n = max(at for _, at in axes["bodies"])
    for line in (EACH, SHARED):
        name = f"{n} {line} / {JOINED}"
        out.append(Aim(name, over("bodies", (line, n), (JOINED, n)), "times", 3.0))
    return out


def measure_large(triangles: int) -> dict[str, float]:
    """Measure a floor from a file in a process of its own; see `load_large`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "floor.ply"
        finer_floor(triangles).bodies[0].mesh.export(path)
        command = [sys.executable, "-m", "tools.bench.scaling", str(path)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} ended with exit status {done.returncode}")
    return json.loads(done.stdout)


def load_large(path: str) -> dict[str, float]:
    """Return the seconds to load a floor and to make a simulator, the ms of a ping, peak memory in MB."""
    bundled, sonar = make_scene("ocean_floor"), make_sonar("ocean_floor", "wide")
    sampling = sampling_at(sonar, level_of(bundled, sonar))
    load_ms, (floor,) = harness.timed(lambda: sg.load_scene(path).bodies)
    scene = sg.Scene([floor, *bundled.bodies[1:]], bundled.sonar_pose)
    make_ms, simulator = harness.timed(sg.Simulator, scene, sonar, IDEAL, sampling)
    with simulator:
        times = harness.take_turns(
            {"ping": lambda number: simulator.ping(harness.creep(scene.sonar_pose, number))}, LARGE_PINGS, 0
        )
    return {
        "triangles": scene.n_triangles,
        "load_s": load_ms / 1e3,
        "make_s": make_ms / 1e3,
        "ping_ms": float(np.median(times["ping"])),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
    }


def print_axis(points: list[Point]):
    """Print one axis, line by line."""
    print(f"\n{points[0].axis}")
    wide = max(len(point.line) for point in points)
    for line in dict.fromkeys(point.line for point in points):
        for point in (one for one in points if one.line == line):
            ms = harness.spread_of(point.ms)
            print(
                f"  {line:{wide}}  {point.at:>9.7g}  {point.samples:>12}  {ms['median']:8.2f} ms"
                f"  p95 {ms['p95']:8.2f}",
                flush=True,
            )


def rows_of(points: list[Point], renderer: str) -> list[dict]:
    """Return the rows of the CSV file."""
    date = datetime.date.today().isoformat()
    return [
        {
            "axis": point.axis,
            "line": point.line,
            "at": f"{point.at:g}",
            "samples": point.samples,
            "ms_median": f"{np.median(point.ms):.4g}",
            "ms_p95": f"{np.quantile(point.ms, 0.95):.4g}",
            "renderer": renderer,
            "date": date,
        }
        for point in points
    ]


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument("--large", action="store_true", help="also 10 million triangles")
    parser.add_argument("--out", type=Path, help="folder for scaling.csv and pictures/; none if left out")


def run(options) -> dict:
    """Measure and print axis by axis; write and draw into the folder `out`."""
    if options.out:
        from tools.bench import scaling_chart  # needs matplotlib, which the numbers alone do not

        (options.out / "pictures").mkdir(parents=True, exist_ok=True)
    sizes, points = QUICK if options.quick else Sizes(), []
    for cases in axes_of(sizes):
        found = time_cases(cases, options.rounds)
        print_axis(found)
        points += found
    aims, large = aims_of(points), None
    if options.large:
        large = measure_large(sizes.large)
        aims.append(Aim(f"memory of {large['triangles']} triangles, peak", large["peak_mb"], "MB", 4096.0))
    machine = harness.describe_machine()
    rows = rows_of(points, machine["gl_renderer"])
    if options.out:
        harness.write_csv(options.out / "scaling.csv", rows)
        scaling_chart.draw(options.out / "pictures" / "scaling.png", rows, harness.one_line(machine))
    return {"points": rows, "large": large, "aims": aims}


def report(found: dict):
    """Print the large mesh and the aims; the axes are printed as they are measured."""
    if large := found["large"]:
        print(
            f"\n{large['triangles']} triangles from a file: loaded in {large['load_s']:.1f} s, "
            f"simulator made in {large['make_s']:.1f} s, ping {large['ping_ms']:.2f} ms"
        )
    harness.print_aims(found["aims"])


if __name__ == "__main__":
    print(json.dumps(load_large(sys.argv[1])))
