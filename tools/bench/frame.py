"""Time a whole frame by its stages, beside one trace of as many rays through Embree.

    python -m tools.bench frame                     # pylon, two sonars
    python -m tools.bench frame --scene diver --rounds 200

A frame is a ping of profile `physical` with `Noise.physical()`, as a fan image 800 pixels high in Jet. What
it adds to a bare ping (profile `ideal`, no noise) is divided by the time of tracing 256 x 512 regular rays
over the same fan: as the chart's rivals do (packets of eight rays, two threads), and through `embreex` (one
thread). So is what beam patterns, speckle and receiver noise add by themselves. The time of PNG encoding is
printed beside: sequences are written while the next ping is made; and so is noise where the sonar has not
moved, and with new speckle in each ping.

Both pings have the samples that tolerance 0.01 asks for with profile `ideal`.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import sonar_gl as sg
from sonar_gl.noise.noise import add_noise
from tools.bench import harness
from tools.chart import scenes
from tools.chart.rivals.rays import Rays

ROUNDS = 100, 2
ADDED = ("noise", "fan image", "Jet")
NEW_SPECKLE = replace(sg.Noise.physical(), follow_motion=False)
RAYS = (256, 512)  # across the fan, up the aperture


class Traces:
    """A regular fan of rays through a scene in Embree, traced in two ways."""

    def __init__(self, scene, sonar):
        across, up = RAYS
        azimuth = np.radians(sonar.azimuth_fov_deg) * ((np.arange(across) + 0.5) / across - 0.5)
        elevation = np.radians(sonar.elevation_fov_deg) * ((np.arange(up) + 0.5) / up - 0.5)
        azimuth, elevation = azimuth.reshape(-1, 1, 8), elevation[:, None]  # eight side by side, then up
        d = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        rays = np.stack(np.broadcast_arrays(*d), axis=-1).reshape(-1, 3).astype(np.float32)
        self.far_m = sonar.range_max_m
        self.packets = Rays(scene, sonar, sg.Acoustics.ideal(), scene.sonar_pose)
        self.packets.lay(rays)
        self.plain, self.rays = EmbreeScene(), rays
        inverse = np.linalg.inv(scene.sonar_pose)
        for body in scene.bodies:
            matrix = inverse @ body.pose
            vertices = np.asarray(body.mesh.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
            corners = vertices[np.asarray(body.mesh.faces)]
            TriangleMesh(self.plain, np.ascontiguousarray(corners, np.float32))

    def by_packets(self, pose):
        """Trace as the chart's rivals do, in two threads."""
        rotation, origin = self.packets.embree.place(pose)
        self.packets.both(lambda half: self.packets.trace(half, rotation, origin, self.far_m))

    def by_embreex(self, pose):
        """Trace with the function that Python offers, in one thread."""
        origin = self.packets.embree.place(pose)[1]
        self.plain.run(np.repeat(origin[None], len(self.rays), axis=0), self.rays)


def measure(scene, sonar, rounds: int) -> dict[str, np.ndarray]:
    """Return milliseconds, (rounds,) of each stage and of the traces."""
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal()) as simulator:
        simulator.plan([scene.sonar_pose])
        sampling = simulator.sampling
    with ExitStack() as stack:
        ideal, physical = (
            stack.enter_context(sg.Simulator(scene, sonar, acoustics, sampling))
            for acoustics in (sg.Acoustics.ideal(), sg.Acoustics.physical())
        )
        traces, frame = Traces(scene, sonar), {}

        def pose(number):
            return harness.creep(scene.sonar_pose, number)

        def step(result, function):
            """A stage that leaves its result for those after it."""
            return lambda number: frame.update({result: function(number)})

        return harness.take_turns(
            {
                "ping, ideal": lambda number: ideal.ping(pose(number)),
                "ping, physical": step("ping", lambda number: physical.ping(pose(number))),
                "noise": step("noisy", lambda k: add_noise(frame["ping"], sg.Noise.physical(), 0, k)),
                "noise, at rest": lambda k: add_noise(frame["ping"], sg.Noise.physical(), 0, k),
                "noise, new speckle": lambda k: add_noise(frame["ping"], NEW_SPECKLE, 0, k),
                "fan image": step("image", lambda _: sg.fan_image(frame["noisy"])),
                "Jet": step("picture", lambda _: sg.colorize(frame["image"])),
                "PNG, beside": lambda _: cv2.imencode(".png", frame["picture"]),
                "rays by packets": lambda number: traces.by_packets(pose(number)),
                "rays by embreex": lambda number: traces.by_embreex(pose(number)),
            },
            rounds,
        )


def figures_of(scene, sonar, rounds: int) -> dict[str, float]:
    """Return medians in ms of stages and traces, what a frame adds to a bare ping, its ratios to traces."""
    times = measure(scene, sonar, rounds)
    added = sum(times[stage] for stage in ADDED)
    times["physical over ideal"] = times["ping, physical"] - times["ping, ideal"]
    times["beams, speckle, noise"] = times["physical over ideal"] + times["noise"]
    times["frame over bare ping"] = added + times["physical over ideal"]
    for way in ("packets", "embreex"):
        times[f"beams.. / {way}"] = times["beams, speckle, noise"] / times[f"rays by {way}"]
        times[f"frame / {way}"] = times["frame over bare ping"] / times[f"rays by {way}"]
    return {stage: float(np.median(ms)) for stage, ms in times.items()}


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument("--scene", default="pylon", help="a bundled scene, or a file")


def run(options) -> dict:
    """Return the figures of both sonars."""
    scene = sg.load_scene(options.scene)
    scene = sg.Scene([replace(body, normals=None) for body in scene.bodies], scene.sonar_pose, scene.name)
    found = {}
    for sonar in (sg.load_sonar("p900-45"), scenes.make_sonar(scene.name, "wide")):
        title = f"{scene.name}, {sonar.name}: {sonar.n_beams} beams x {sonar.n_bins} bins"
        found[title] = figures_of(scene, sonar, options.rounds)
    return {"frames": found}


def report(found: dict):
    """Print one table a sonar."""
    for title, figures in found["frames"].items():
        print(f"\n{title}")
        for stage, value in figures.items():
            print(f"  {stage:22} {value:8.2f}" + ("" if "/" in stage else " ms"))
