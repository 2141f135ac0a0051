"""What is timed to see how the time of a ping grows: scenes, sonars, samplings; and the timing itself."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np
import trimesh
from bench_terrain import finer_floor
from chart_scenes import make_scene, make_sonar

import sonar_gl as sg
from sonar_gl.plan import sampling_of

IDEAL = sg.Acoustics.ideal()
CREEP_M = 0.001  # a round: no two pings alike
WARM_UP = 3
BALL_M = 0.15  # of 20 triangles: a thousand joined are still few enough to be known as closed
SAME, CHOSEN = "same samples", "tolerance 0.01"
EACH, SHARED, JOINED = "bodies, a mesh each", "bodies, one mesh for all", "joined into one mesh"


@dataclass(frozen=True)
class Sizes:
    """What is tried."""

    rounds: int = 40
    triangles: tuple = (250_000, 1_000_000, 4_000_000)
    beams: tuple = (64, 128, 256, 512, 1024)
    bins: tuple = (128, 256, 512, 1024, 2048, 4096)
    fields_deg: tuple = (45, 90, 180, 360)
    bodies: tuple = (1, 10, 100, 1000)
    tolerances: tuple = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
    scenes: tuple = ("pylon", "diver", "ocean_floor")  # of sequences
    scene: str = "ocean_floor"  # of two sonars, and of bodies that come and go
    pings: int = 24  # of a sequence
    large: int = 10_000_000


QUICK = Sizes(
    rounds=2,
    triangles=(10_000, 40_000),
    beams=(64, 256),
    bins=(128, 512),
    fields_deg=(45, 360),
    bodies=(1, 30),
    tolerances=(0.1, 0.02),
    scenes=("pylon",),
    scene="pylon",
    pings=8,
    large=200_000,
)


@dataclass
class Case:
    """One point of a line: what a simulator is given, and what its pings took, ms."""

    axis: str
    line: str
    at: float
    scene: sg.Scene
    sonar: sg.Sonar
    how: dict  # tolerance or sampling
    ms: list = field(default_factory=list)
    samples: str = ""


def race(cases: list[Case], rounds: int) -> list[Case]:
    """Time all cases, round by round. Those of one scene share it."""
    with ExitStack() as stack:
        worlds, simulators = {}, []
        for case in cases:
            world = worlds.get(id(case.scene), case.scene)
            simulators.append(stack.enter_context(sg.Simulator(world, case.sonar, IDEAL, **case.how)))
            worlds.setdefault(id(case.scene), simulators[-1])
            simulators[-1].plan([case.scene.sonar_pose])
        for number in range(-WARM_UP, rounds):
            for case, simulator in zip(cases, simulators, strict=True):
                pose = case.scene.sonar_pose @ sg.pose(x=CREEP_M * (number + WARM_UP))
                start = perf_counter()
                simulator.ping(pose)
                if number >= 0:
                    case.ms.append(1e3 * (perf_counter() - start))
        for case, simulator in zip(cases, simulators, strict=True):
            windows = simulator._samples.now.renderer.windows
            case.samples = f"{sum(w[2] for w in windows)} x {max(w[3] for w in windows)}"
    return cases


def rung_of(scene, sonar) -> int:
    """Of the ladder of samplings, what tolerance 0.01 asks for."""
    with sg.Simulator(scene, sonar, IDEAL) as simulator:
        return simulator.plan([scene.sonar_pose]).rung


def of_triangles(counts) -> list[Case]:
    """The same ground, ever finer."""
    sonar, cases = make_sonar("ocean_floor", "wide"), []
    rung = rung_of(make_scene("ocean_floor"), sonar)
    for count in counts:
        scene = finer_floor(count)
        for line, how in ((SAME, {"sampling": sampling_of(sonar, rung)}), (CHOSEN, {})):
            cases.append(Case("triangles", line, count, scene, sonar, how))
    return cases


def of_sonars(axis: str, values, change: Callable) -> list[Case]:
    """Of `pylon`; change(sonar, value) makes the sonar."""
    scene, sonar = make_scene("pylon"), make_sonar("pylon", "wide")
    rung, cases = rung_of(scene, sonar), []
    for value in values:
        other = change(sonar, value)
        for line, how in ((SAME, {"sampling": sampling_of(other, rung)}), (CHOSEN, {})):
            cases.append(Case(axis, line, value, scene, other, how))
    return cases


def widened(sonar, fov_deg):
    """As many beams to a degree."""
    beams = round(sonar.n_beams * fov_deg / sonar.azimuth_fov_deg)
    return replace(sonar, azimuth_fov_deg=float(fov_deg), n_beams=beams)


def of_bodies(counts) -> list[Case]:
    """Balls in open water, and one mesh of the same triangles."""
    sonar, ball = make_sonar("pylon", "wide"), trimesh.creation.icosphere(0, BALL_M)
    sampling = sampling_of(sonar, rung_of(make_scene("pylon"), make_sonar("pylon", "wide")))
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


def of_tolerances(tolerances) -> list[Case]:
    """Of `pylon`."""
    scene, sonar = make_scene("pylon"), make_sonar("pylon", "wide")
    return [Case("tolerance", "tolerance", one, scene, sonar, {"tolerance": one}) for one in tolerances]


def of_a_triangle() -> list[Case]:
    """The least that a ping can cost: one triangle, 60 cm wide, 10 m ahead."""
    mesh = trimesh.Trimesh([(0, -0.3, -0.24), (0, 0, 0.24), (0, 0.3, -0.24)], [(0, 1, 2)], process=False)
    scene = sg.Scene([sg.Body("triangle", mesh, sg.pose(10))], np.eye(4))
    return [Case("one triangle", CHOSEN, 1, scene, make_sonar("pylon", "wide"), {})]
