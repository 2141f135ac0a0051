"""Time pings of scenes by stages, and judge them against the ray-cast reference.

    python -m tools.bench                                # three scenes, some minutes
    python -m tools.bench --quick                        # fewer rounds and rays, less than a minute
    python -m tools.bench ping --scene my.sdf --rays 0   # where the time of a ping of another scene goes
    python -m tools.bench --rays 0                       # times only

The setting is the same for all: 256 beams of 1 degree boxes over 45 x 20 degrees, 512 bins to 30 m, profile
`ideal`. Ratios are to the row `tolerance 0.01`, the default.

The error is the sum of |E - T| over the sum of T, over beams and bins, where T is `sonar_gl.reference_ping`
(Embree; the extra `reference`), with flat faces, at the scene's own pose. The reference is the mean of two
halves of its rays; it is itself wrong by about half of their printed difference.

A tolerance is reviewed while the sonar moves. The cost of that is the summed time of pings of a moving sonar
over that of pings with the same samples, fixed beforehand.

The picture is a ping of profile `physical` with `Noise.physical()`, as a colour fan image 800 pixels high.
"""

from __future__ import annotations

import warnings
from contextlib import ExitStack
from dataclasses import asdict, replace

import numpy as np

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from tools import internals
from tools.bench import harness
from tools.internals import STAGES

ROUNDS = 100, 12
SCENES = ("pylon", "diver", "ocean_floor")
SONAR = sg.Sonar(
    name="bench",
    frequency_hz=900e3,
    n_beams=256,
    n_bins=512,
    azimuth_fov_deg=45.0,
    elevation_fov_deg=20.0,
    beam_width_deg=1.0,
    range_min_m=0.5,
    range_max_m=30.0,
)
SAMPLINGS = {  # name of a row: arguments of `Simulator`
    "tolerance 0.05": {"tolerance": 0.05},
    "tolerance 0.02": {"tolerance": 0.02},
    "tolerance 0.01": {"tolerance": 0.01},
    "1.5 x 48": {"sampling": sg.Sampling(1.5, 48)},
    "2 x 64": {"sampling": sg.Sampling(2, 64)},
    "2 x 64, point": {"sampling": sg.Sampling(2, 64, "point")},
}
BASE = "tolerance 0.01"
STEPS = ("ping", "fan image", "colours")  # of a finished picture


class Picture:
    """The steps from a pose to a finished picture; each takes what the one before it left."""

    def __init__(self, simulator, pose):
        self._simulator, self._pose = simulator, pose

    def ping(self, number: int):
        """Ping with noise."""
        pose = harness.creep(self._pose, number)
        self._ping = self._simulator.ping(pose, sg.Noise.physical(), seed=0, ping_number=number)

    def form(self, _number: int):
        """Form the fan image."""
        self._image = sg.fan_image(self._ping, 800)

    def colour(self, _number: int):
        """Colour it."""
        sg.colorize(self._image, "jet")


def time_pings(scene, rounds: int) -> tuple[dict, dict, dict]:
    """Return milliseconds of the rows' pings, of their stages (rounds, STAGES), and of STEPS; and sizes."""
    with ExitStack() as stack:
        simulators = {
            name: stack.enter_context(sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), **how))
            for name, how in SAMPLINGS.items()
        }
        physical = stack.enter_context(sg.Simulator(scene, SONAR, sg.Acoustics.physical()))
        for simulator in (*simulators.values(), physical):
            simulator.plan([scene.sonar_pose])
        clocks = {name: internals.StageClock(simulator) for name, simulator in simulators.items()}
        stages = {name: [] for name in simulators}

        def pinger(name):
            def ping(number):
                simulators[name].ping(harness.creep(scene.sonar_pose, number))
                stages[name].append(clocks[name].lap_ms())

            return ping

        picture = Picture(physical, scene.sonar_pose)
        steps = zip(STEPS, (picture.ping, picture.form, picture.colour), strict=True)
        times = harness.take_turns({**{name: pinger(name) for name in simulators}, **dict(steps)}, rounds)
        sizes = {}
        for name, simulator in simulators.items():
            columns, rows = internals.sample_grid(simulator)
            sizes[name] = {"columns": columns, "rows": rows, "sampling": asdict(simulator.sampling)}
    return times, {name: np.array(ms[harness.WARM_UP :]) for name, ms in stages.items()}, sizes


def review_cost(scene, rounds: int) -> float:
    """Return what keeping a tolerance costs while the sonar moves, as a share of the time of pings."""
    ideal, cycles, spent = sg.Acoustics.ideal(), max(2, rounds // 20), np.zeros(2)
    with sg.Simulator(scene, SONAR, ideal) as live, sg.Simulator(scene, SONAR, ideal) as fixed:
        fixed.plan([scene.sonar_pose])
        live.ping(scene.sonar_pose)
        for number in range(1, 1 + internals.PINGS_PER_REVIEW * cycles):  # whole cycles of one review each
            pose = harness.creep(scene.sonar_pose, number)
            spent += [harness.timed(simulator.ping, pose)[0] for simulator in (live, fixed)]
    return float(spent[0] / spent[1] - 1)


def errors_of(scene, n_rays: int) -> tuple[dict, float]:
    """Return the error of each row, and the difference of the reference's two halves."""
    flat = sg.Scene([replace(body, normals=None) for body in scene.bodies], scene.sonar_pose, scene.name)
    ideal = sg.Acoustics.ideal()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the difference of the halves is printed
        truth = sg.reference_ping(flat, SONAR, flat.sonar_pose, ideal, 0.005, n_rays)
    out = {}
    for name, how in SAMPLINGS.items():
        with sg.Simulator(flat, SONAR, ideal, **how) as simulator:
            out[name] = ping_error(simulator.ping(flat.sonar_pose), truth)
    return out, truth.meta["difference"]


def measure(name: str, rounds: int, n_rays: int) -> dict:
    """Return all figures of one scene; times in ms."""
    scene = sg.load_scene(name)
    if scene.sonar_pose is None:
        raise sg.Error(f"{name}: a scene to be timed must state where its sonar is (got none)")
    times, stages, rows = time_pings(scene, rounds)
    error, difference = errors_of(scene, n_rays) if n_rays else ({}, None)
    for row, figures in rows.items():
        figures |= {
            "ping_ms": harness.spread_of(times[row]),
            "stages_ms": dict(zip(STAGES, np.median(stages[row], axis=0).tolist(), strict=True)),
            "rest_ms": float(np.median(times[row] - stages[row].sum(axis=1))),
            "ratio": harness.ratio(times[row], times[BASE]),
            "error": error.get(row),
        }
    return {
        "scene": name,
        "triangles": scene.n_triangles,
        "bodies": len(scene.bodies),
        "reference_rays": n_rays,
        "reference_halves_differ": difference,
        "samplings": rows,
        "review_cost": review_cost(scene, rounds),
        "picture_ms": {
            **harness.spread_of(sum(times[step] for step in STEPS)),
            **{step: float(np.median(times[step])) for step in STEPS},
        },
    }


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument(
        "--scene",
        action="append",
        help=f"bundled scene, or a file with a sonar in it; may be repeated; default: {', '.join(SCENES)}",
    )
    parser.add_argument(
        "--rays", type=int, help="of a reference at most; 80 million, or 4 if quick; 0 for no errors"
    )


def run(options) -> dict:
    """Return the figures of the scenes."""
    n_rays = options.rays if options.rays is not None else (4_000_000 if options.quick else 80_000_000)
    try:
        scenes = [measure(name, options.rounds, n_rays) for name in options.scene or SCENES]
    except sg.Error as why:
        raise SystemExit(f"{why}; or leave the errors out with --rays 0" if n_rays else str(why)) from None
    return {"sonar": asdict(SONAR), "scenes": scenes}


def report(found: dict):
    """Print one table a scene."""
    for scene in found["scenes"]:
        print(f"\n{scene['scene']}: {scene['triangles']} triangles, {scene['bodies']} bodies")
        harness.print_table(
            [
                {
                    "sampling": name,
                    "columns x rows": f"{row['columns']} x {row['rows']}",
                    "ping, ms": f"{row['ping_ms']['median']:.2f}",
                    "p95": f"{row['ping_ms']['p95']:.2f}",
                    "ratio": f"{row['ratio']:.2f}",
                    **{stage: f"{ms:.2f}" for stage, ms in row["stages_ms"].items()},
                    "rest": f"{row['rest_ms']:.2f}",
                    "error": "-" if row["error"] is None else f"{row['error']:.2%}",
                }
                for name, row in scene["samplings"].items()
            ]
        )
        if scene["reference_rays"]:
            rays, differ = scene["reference_rays"] / 1e6, scene["reference_halves_differ"]
            print(f"  the reference's halves, {rays:g} million rays at most, differ by {differ:.2%}")
        print(f"  reviewing tolerance 0.01 of a moving sonar costs {scene['review_cost']:+.0%} of the time")
        steps = ", ".join(f"{step} {scene['picture_ms'][step]:.2f}" for step in STEPS)
        picture = scene["picture_ms"]
        print(f"  colour image with noise: {picture['median']:.2f} ms, p95 {picture['p95']:.2f} ({steps})")
