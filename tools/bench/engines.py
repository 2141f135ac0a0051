"""Time the two raster engines, and what labels, multipath and pictures add to a ping, beside what is aimed at.

python -m tools.bench engines               # pylon, diver, ocean_floor; some minutes
python -m tools.bench engines --quick

Tolerance 0.01, the chart's sonar (256 beams a degree wide over 45 x 20 degrees, 512 bins to 30 m) and profile `ideal`
where nothing else is said. OpenGL draws by the driver that is there: by software where there is no graphics card.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.core.warn import collected_warnings
from tools import internals
from tools.bench import harness
from tools.bench.harness import Aim
from tools.chart.scenes import make_scene, make_sonar

ROUNDS = 60, 3
SCENES = {
    "pylon": 2.5,
    "diver": 2.5,
    "ocean_floor": 1.5,
}  # name: OpenGL's time over that of the engine cpu, aimed at
IDEAL = sg.Acoustics.ideal()
FEW = 48  # pings of a sequence: workers take some to start
VIEW_TOLERANCE = 0.05


def one_triangle() -> sg.Scene:
    """Make a triangle of half a metre, 5 m ahead."""
    mesh = trimesh.Trimesh([(5, -0.25, -0.25), (5, 0.25, -0.25), (5, 0, 0.25)], [(0, 2, 1)])
    return sg.Scene([sg.Body("triangle", mesh)], np.eye(4), "one triangle")


def nothing() -> sg.Scene:
    """Make an empty scene: the time of its ping is what Python takes around a ping."""
    return sg.Scene([], np.eye(4), "nothing")


def pinger(
    stack, scene, sonar, acoustics=IDEAL, engine: str | None = None, finish=lambda ping: None, **options
) -> Callable[[int], None]:
    """Return a contender that pings from a scene's own pose, with options of a ping, which `finish` then takes."""
    simulator = stack.enter_context(sg.Simulator(scene, sonar, acoustics, engine=engine))
    simulator.plan([scene.sonar_pose])
    return lambda number: finish(simulator.ping(harness.creep(scene.sonar_pose, number), **options))


def drop(pings):
    """Make all pings and keep none, so that their arrays are reused."""
    deque(pings, maxlen=0)


def sequence_gain(scene, sonar, rounds: int) -> float:
    """Return the time of FEW pings one by one over that of a sequence (`Simulator.pings`)."""
    poses = [harness.creep(scene.sonar_pose, k) for k in range(FEW)]
    with sg.Simulator(scene, sonar, IDEAL, engine="cpu") as simulator:
        simulator.plan([scene.sonar_pose])
        ways = {
            "one by one": lambda _: drop(map(simulator.ping, poses)),
            "sequence": lambda _: drop(simulator.pings(poses)),
        }
        times = harness.take_turns(ways, rounds)
    return harness.ratio(times["one by one"], times["sequence"])


def engines_of(name: str, rounds: int) -> dict[str, float]:
    """Return the times of one scene: both engines, labels, sequence; milliseconds and ratios."""
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    with ExitStack() as stack:
        contenders = {
            "cpu": pinger(stack, scene, sonar, engine="cpu"),
            "labels": pinger(stack, scene, sonar, engine="cpu", labels=True),
        }
        with suppress(sg.Error):
            contenders["opengl"] = pinger(stack, scene, sonar, engine="opengl")
        times = harness.take_turns(contenders, rounds)
    out = {"ping, ms": float(np.median(times["cpu"]))}
    if "opengl" in times:
        out["opengl / cpu"] = harness.ratio(times["opengl"], times["cpu"])
    out["labels"] = harness.ratio(times["labels"], times["cpu"])
    out["one by one / sequence"] = sequence_gain(scene, sonar, max(3, rounds // 12))
    return out


def views(acoustics, rounds: int) -> float:
    """Return the time of pings that choose their samples alone, as in batches, over that with samples planned for each.

    From random poses, as many as rounds; the least of three times with planned samples.
    """
    scene, sonar, rng = sg.load_scene("pylon"), sg.load_sonar("p900-45"), np.random.default_rng(0)
    alone_ms, planned_ms = [], []
    with ExitStack() as stack:
        alone, planned = (
            stack.enter_context(sg.Simulator(scene, sonar, acoustics, tolerance=VIEW_TOLERANCE))
            for _ in range(2)
        )
        for number in range(-3, rounds):
            move, angles = rng.uniform(-2, 2, 3), rng.uniform(-1, 1, 3) * (0.1, 0.1, 0.6)
            pose = scene.sonar_pose @ sg.pose(*move, *angles)
            took_ms = harness.timed(internals.ping_alone, alone, pose)[0]
            planned.plan([pose])
            again_ms = [harness.timed(planned.ping, pose)[0] for _ in range(4)]
            if number >= 0:
                alone_ms.append(took_ms)
                planned_ms.append(min(again_ms))
    return sum(alone_ms) / sum(planned_ms)


def picture(ping: sg.Ping) -> None:
    """Form the picture that a device shows."""
    sg.colorize(sg.fan_image(ping))


def others(rounds: int) -> dict[str, float]:
    """Return the times of nothing, of a triangle, of what a strong image source adds to a ping, and of a frame."""
    sonar, p900 = make_sonar("pylon", "wide"), sg.load_sonar("p900-45")
    out = {}
    with ExitStack() as stack, collected_warnings():  # that no echo came back
        for what, scene in (("nothing, ms", nothing()), ("one triangle, ms", one_triangle())):
            alone = {"cpu": pinger(stack, scene, sonar, engine="cpu")}
            out[what] = float(np.median(harness.take_turns(alone, rounds)["cpu"]))
    scene, ideal = sg.load_scene("pylon"), sg.Acoustics(multipath="none")
    # sand and concrete are too rough to reflect; bodies of known reflectivity alone are taken for smoother
    smoother = [replace(body, material=None) for body in scene.bodies]
    smooth = sg.Scene(smoother, scene.sonar_pose, scene.name)
    with ExitStack() as stack:
        ways = {"without": ideal, "with": sg.Acoustics(multipath="incoherent")}
        contenders = {way: pinger(stack, smooth, p900, acoustics) for way, acoustics in ways.items()}
        times = harness.take_turns(contenders, rounds)
    with sg.Simulator(smooth, p900, sg.Acoustics(multipath="incoherent")) as simulator:
        simulator.plan([scene.sonar_pose])
        out["image sources"] = internals.count_image_sources(simulator, scene.sonar_pose)
    out["multipath"] = harness.ratio(times["with"], times["without"])
    with ExitStack() as stack:
        physical, noise = sg.Acoustics.physical(), sg.Noise.physical()
        frame = {"frame": pinger(stack, scene, p900, physical, finish=picture, noise=noise)}
        out["frame, ms"] = float(np.median(harness.take_turns(frame, rounds)["frame"]))
    return out


def add_options(parser):
    """Add the scene."""
    parser.add_argument("--only", choices=SCENES, help="this scene")


def run(options) -> dict:
    """Return the figures beside their aims."""
    names = [options.only] if options.only else list(SCENES)[: 1 if options.quick else None]
    scenes = {name: engines_of(name, options.rounds) for name in names}
    more, aims = others(options.rounds), []
    for name, one in scenes.items():
        if "opengl / cpu" in one:
            aims.append(
                Aim(f"{name}: opengl / cpu", one["opengl / cpu"], "times", SCENES[name], at_least=True)
            )
        aims.append(Aim(f"{name}: with labels / without", one["labels"], "times", 1.6))
        aims.append(
            Aim(f"{name}: ping() / pings()", one["one by one / sequence"], "times", 1.6, at_least=True)
        )
    for profile in "ideal", "physical":
        ratio = views(getattr(sg.Acoustics, profile)(), options.rounds)
        aims.append(
            Aim(f"pylon, p900-45, {profile}: samples chosen for each ping / planned", ratio, "times", 2.0)
        )
    aims.append(Aim("empty scene, a ping: the share of Python", more["nothing, ms"], "ms", 0.06))
    aims.append(Aim("one triangle, a ping", more["one triangle, ms"], "ms", 0.2))
    n = more["image sources"]
    each = (more["multipath"] - 1) / n if n else 0.0
    aims.append(Aim(f"pylon, p900-45: multipath, each of {n} image sources", each, "pings", 1.2))
    aims.append(Aim("pylon, p900-45: colour frame with noise", more["frame, ms"], "ms", 4.0))
    return {"scenes": scenes, "others": more, "aims": aims}


def report(found: dict):
    """Print a row for each scene, and the aims."""
    rows = [
        {"scene": name, **{what: f"{value:.2f}" for what, value in one.items()}}
        for name, one in found["scenes"].items()
    ]
    harness.print_table(rows)
    print(f"  pylon, p900-45, with multipath / without: {found['others']['multipath']:.2f}")
    harness.print_aims(found["aims"])
