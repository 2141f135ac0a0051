#!/usr/bin/env python
"""Times a whole frame by its stages, beside one trace of as many rays through Embree.

    python tools/bench_frame.py                     # pylon, two sonars
    python tools/bench_frame.py --scene diver --repeats 200

A frame is a ping of profile `physical` with `Noise.physical()`, as a fan image 800 pixels high in Jet. What
it adds to a bare ping, of profile `ideal` and without noise, is told over the time of tracing 256 x 512
regular rays over the same fan: as the chart's rivals do (packets of eight rays, two threads), and through
`embreex` (one thread). So is what beam patterns, speckle and receiver noise add by themselves. PNG encoding
stands beside: sequences are written while the next ping is made.

Both pings have the samples that tolerance 0.01 asks for with profile `ideal`. Stages are timed in turns, a
round of all and then the next, while the sonar creeps; times are medians of the rounds, ratios medians of the
rounds' ratios.
"""

from __future__ import annotations

import argparse
import os
from contextlib import ExitStack
from dataclasses import replace
from time import perf_counter

import chart_scenes
import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from rivals.rays import Rays

import sonar_gl as sg
from sonar_gl.noise import add_noise

ADDED = ("noise", "fan image", "Jet")
RAYS = (256, 512)  # across the fan, up the aperture
CREEP_M = 0.001
WARM_UP = 3


class Traces:
    """A regular fan of rays through a scene in Embree, by two ways."""

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
        """As the chart's rivals trace, in two threads."""
        rotation, origin = self.packets.embree.place(pose)
        self.packets.both(lambda half: self.packets.trace(half, rotation, origin, self.far_m))

    def by_embreex(self, pose):
        """By the function that Python offers, in one thread."""
        origin = self.packets.embree.place(pose)[1]
        self.plain.run(np.repeat(origin[None], len(self.rays), axis=0), self.rays)


def measure(scene, sonar, repeats: int) -> dict[str, np.ndarray]:
    """Times in ms, (repeats,) of each stage and of the traces."""
    times = {}

    def timed(stage, function, *arguments):
        start = perf_counter()
        out = function(*arguments)
        times.setdefault(stage, []).append(1e3 * (perf_counter() - start))
        return out

    with sg.Simulator(scene, sonar, sg.Acoustics.ideal()) as simulator:
        simulator.plan([scene.sonar_pose])
        sampling = simulator.sampling
    with ExitStack() as stack:
        bare, heard = (
            stack.enter_context(sg.Simulator(scene, sonar, acoustics, sampling))
            for acoustics in (sg.Acoustics.ideal(), sg.Acoustics.physical())
        )
        traces = Traces(scene, sonar)
        for number in range(WARM_UP + repeats):
            pose = scene.sonar_pose @ sg.pose(x=CREEP_M * number)
            timed("ping, ideal", bare.ping, pose)
            ping = timed("ping, physical", heard.ping, pose)
            noisy = timed("noise", add_noise, ping, sg.Noise.physical(), 0, number)
            image = timed("fan image", sg.fan_image, noisy)
            picture = timed("Jet", sg.colorize, image)
            timed("PNG, beside", cv2.imencode, ".png", picture)
            timed("rays by packets", traces.by_packets, pose)
            timed("rays by embreex", traces.by_embreex, pose)
    return {stage: np.array(ms[WARM_UP:]) for stage, ms in times.items()}


def bench_frame(scene, sonar, repeats: int) -> dict[str, float]:
    """Medians in ms of stages and traces, what a frame adds to a bare ping, and its ratios to the traces."""
    times = measure(scene, sonar, repeats)
    added = sum(times[stage] for stage in ADDED)
    times["physical over ideal"] = times["ping, physical"] - times["ping, ideal"]
    times["beams, speckle, noise"] = times["physical over ideal"] + times["noise"]
    times["frame over bare ping"] = added + times["physical over ideal"]
    for way in ("packets", "embreex"):
        times[f"beams.. / {way}"] = times["beams, speckle, noise"] / times[f"rays by {way}"]
        times[f"frame / {way}"] = times["frame over bare ping"] / times[f"rays by {way}"]
    return {stage: float(np.median(ms)) for stage, ms in times.items()}


def tell(title: str, found: dict[str, float]):
    """Print one table."""
    print(f"\n{title}")
    for stage, value in found.items():
        print(f"  {stage:22} {value:8.2f}" + ("" if "/" in stage else " ms"))


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scene", default="pylon", help="a bundled scene, or a file")
    parser.add_argument("--repeats", type=int, default=100, help="rounds")
    options = parser.parse_args()
    scene = sg.load_scene(options.scene)
    scene = sg.Scene([replace(body, normals=None) for body in scene.bodies], scene.sonar_pose, scene.name)
    sonars = sg.load_sonar("p900-45"), chart_scenes.make_sonar(scene.name, "wide")
    with sg.Simulator(sg.Scene([]), sonars[0]) as simulator:
        print(f"sonar_gl {sg.__version__} on {simulator.gl_info['renderer']}; {os.cpu_count()} cores")
    print(f"{options.repeats} rounds, medians; the load at the start is {os.getloadavg()[0]:.1f}")
    for sonar in sonars:
        title = f"{scene.name}, {sonar.name}: {sonar.n_beams} beams x {sonar.n_bins} bins"
        tell(title, bench_frame(scene, sonar, options.repeats))


if __name__ == "__main__":
    main()
