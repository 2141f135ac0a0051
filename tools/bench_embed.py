#!/usr/bin/env python
"""Times and judges the ways into `sonar_gl.embed`, in a bare OpenGL host and in the hosts of examples/.

    python tools/bench_embed.py                   # writes the tables of docs/embedding.md, and its chart
    python tools/bench_embed.py --only pylon      # prints; writes nothing unless --docs is given
    python tools/bench_embed.py --hosts           # the hosts of examples/ alone

The scenes are the chart's: 256 box beams a degree wide over 45 degrees, 512 bins to 30 m, profile ideal,
faces flat, errors against `sonar_gl.reference_ping`. Pings are timed in turns, a round of all and then the
next; times are medians. What the host draws anyway, its images, is not counted; what it draws for the sonar
alone, its sectors, is.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter

import numpy as np
from ablation import splice
from chart_scenes import make_scene, make_sonar, make_truth
from PIL import Image

import sonar_gl as sg
from sonar_gl import embed
from sonar_gl.foreign import Host, Tenant
from sonar_gl.textures import read_all
from sonar_gl.verify import ping_error

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import gl_host  # noqa: E402, the tests' host

DOCS = ROOT / "docs"
SCENES = ("pylon", "tank", "ocean_floor")
SAMPLES = ((0.5, 24), (1, 48), (2, 96), (4, 192))  # columns a beam, rows
PIXELS_DEG = (0.8, 0.4, 0.2, 0.1, 0.05)
ALONE, JOINED, DRAWN = "standalone", "1: joins the context", "2: host draws the sectors"
TEXTURES, ARRAYS = "3: textures with normals", "4: arrays with normals"
BARE = "4: arrays, normals from depth"
LOOKS = {
    ALONE: ("#222222", "s"),
    JOINED: ("#1f77b4", "o"),
    DRAWN: ("#2ca02c", "^"),
    TEXTURES: ("#9467bd", "D"),
    ARRAYS: ("#d62728", "v"),
    BARE: ("#ff9896", "x"),
}
KINDS = "metres", "normals", "numbers"
HOSTS = ("pyrender_host", "egl_host", "deferred_host", "window_host", "mujoco_host", "panda3d_host")
SHOWN = "pyrender_host", "mujoco_host"  # in the page
REPEATS = 15


class Ways:
    """All ways to a ping of one scene, in a host that draws it."""

    def __init__(self, scene, sonar, stack, quick):
        self.scene, self.sonar, self.stack, self.pose = scene, sonar, stack, scene.sonar_pose
        self.ideal, self.host, self.ways = sg.Acoustics.ideal(), gl_host.Program(scene), []
        self.mu = {number: float(np.mean(body.reflectivity)) for number, body in enumerate(scene.bodies, 1)}
        for columns, rows in SAMPLES[:2] if quick else SAMPLES:
            made_of = sonar, self.ideal, sg.Sampling(columns, rows)
            alone = stack.enter_context(sg.Simulator(scene, *made_of))
            joined = stack.enter_context(sg.Simulator(scene, *made_of, context="current"))
            sensor = stack.enter_context(embed.Sensor(*made_of))
            rung = f"{columns:g} x {rows}"
            self.ways += [
                (ALONE, rung, lambda it=alone: it.ping(self.pose)),
                (JOINED, rung, lambda it=joined: it.ping(self.pose)),
                (DRAWN, rung, lambda it=sensor: self.draw(it)),
            ]
        for pixel_deg in PIXELS_DEG[:2] if quick else PIXELS_DEG:
            self.add_images(pixel_deg)

    def draw(self, sensor):
        """Have the host draw the sectors."""
        for sector in sensor.sectors(self.pose):
            with sector:
                self.host.draw("sonar", sector.view, sector.projection, sector.lattice)
        return sensor.finish()

    def add_images(self, pixel_deg):
        """Have the host draw images as fine as that, once, and hear them."""
        cameras = sg.Camera.covering(self.sonar, self.ideal, pixel_deg)
        sensor = self.stack.enter_context(embed.Sensor(self.sonar, self.ideal))
        drawn, metres, normals, numbers, projections = [], [], [], [], []
        for number, camera in enumerate(cameras):
            view, projection = np.linalg.inv(camera.pose_gl(self.pose)), camera.projection(0.1, 300.0)
            # textures of one size are one set: images of several cameras must not lie on each other
            self.host.framebuffers.pop((camera.width, camera.height), None)
            drawn.append(self.host.textures(view, projection, camera.width, camera.height))
            projections.append(projection)
            images = read_all(Tenant(Host()), [(drawn[number][kind], kind, kind) for kind in KINDS])
            metres.append(images[0])
            normals.append(images[1][..., :3] * np.float32([1, -1, -1]))
            numbers.append(images[2])
        rotations, mu = [camera.rotation for camera in cameras], {"reflectivity": self.mu}
        size = f"{cameras[0].width} x {cameras[0].height}" + (f", {len(cameras)}" if len(cameras) > 1 else "")

        def textures():
            names = [[one[name] for one in drawn] for name in ("z-buffer", "normals", "numbers")]
            more = {"rotation": rotations, "normals": names[1], "body_id": names[2], **mu}
            return sensor.ping_from_textures(names[0], projections, self.pose, **more)

        def arrays(normals=None):
            return sensor.ping_from_depth(metres, cameras, self.pose, normals=normals, body_id=numbers, **mu)

        self.ways += [
            (TEXTURES, size, textures),
            (ARRAYS, size, lambda: arrays(normals)),
            (BARE, size, arrays),
        ]


def measure(name: str, repeats: int, quick: bool) -> list[dict]:
    """One row a way and rung."""
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    truth = make_truth(scene, sonar, quick=True)
    context = gl_host.make_context()
    with ExitStack() as stack:
        ways = Ways(scene, sonar, stack, quick).ways
        errors = [ping_error(ping(), truth) for *_, ping in ways]
        times = [[] for _ in ways]
        for _ in range(repeats):
            for (*_, ping), mine in zip(ways, times, strict=True):
                ping()
                start = perf_counter()
                ping()
                mine.append(1e3 * (perf_counter() - start))
    context.release()
    medians = [float(np.median(mine)) for mine in times]
    alone = {rung: ms for (way, rung, _), ms in zip(ways, medians, strict=True) if way == ALONE}
    return [
        {
            "way": way,
            "rung": rung,
            "ms": ms,
            "error": error,
            "ratio": ms / alone[rung] if rung in alone else None,
        }
        for (way, rung, _), ms, error in zip(ways, medians, errors, strict=True)
    ]


def table(rows) -> str:
    """As Markdown."""
    lines = [
        "| door | samples, or pixels | ms | over standalone | echo in wrong bins |",
        "|---|---|---|---|---|",
    ]
    for way in LOOKS:
        for row in (row for row in rows if row["way"] == way):
            ratio = "" if row["ratio"] is None or way == ALONE else f"{row['ratio']:.2f}"
            lines.append(
                f"| {way} | {row['rung']} | {row['ms']:.1f} | {ratio} | {100 * row['error']:.2f} % |"
            )
    return "\n".join(lines)


def draw_chart(path: Path, charts: dict, about: str):
    """Time and error of all ways, one panel a scene."""
    from matplotlib import pyplot
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, panels = pyplot.subplots(1, len(charts), figsize=(3.6 * len(charts) + 0.6, 5.0), sharey=True)
    panels = np.atleast_1d(panels)
    for axes, (name, rows) in zip(panels, charts.items(), strict=True):
        for way, (colour, marker) in LOOKS.items():
            mine = [(row["ms"], 100 * row["error"]) for row in rows if row["way"] == way]
            axes.loglog(*zip(*mine, strict=True), color=colour, marker=marker, markersize=5, label=way)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("ping, ms (median)")
        axes.grid(True, which="major", color="#dddddd")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(10, (1.0, 3.0)))
            axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
            axis.set_minor_formatter(NullFormatter())
    panels[0].set_ylabel("echo in wrong bins, %")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(
        *handles, loc="lower center", ncols=3, fontsize=8.5, frameon=False, bbox_to_anchor=(0.5, 0.05)
    )
    figure.text(0.5, 0.015, about, ha="center", fontsize=7.2, color="#444444")
    figure.subplots_adjust(left=0.08, right=0.985, top=0.93, bottom=0.29, wspace=0.06)
    held = io.BytesIO()
    figure.savefig(held, dpi=110, format="png")
    pyplot.close(figure)
    Image.open(held).convert("RGB").quantize(96).save(path, format="png", optimize=True)


def measure_host(name: str, pictures: Path | None) -> list[list[str]]:
    """(door, ms, standalone ms, ratio) of the doors of an example; keeps its picture, if that is shown."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(ROOT / "tools" / "bench_host.py"), name, folder]
        if name == "window_host" and "DISPLAY" not in os.environ:
            command = ["xvfb-run", "-a", *command]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{name} failed:\n{done.stdout}{done.stderr}")
        if pictures and name in SHOWN:
            picture = Image.open(Path(folder) / f"{name}.png").convert("RGB").quantize(160)
            picture.save(pictures / f"embedding_{name}.png", optimize=True)
    return [line.split() for line in re.findall("^door (.+)$", done.stdout, re.MULTILINE)]


def host_table(found: dict) -> str:
    """As Markdown; found : of `measure_host` by name."""
    lines = ["| example | door | ms | over standalone |", "|---|---|---|---|"]
    for name, doors in found.items():
        for door, ms, _, ratio in doors:
            lines.append(f"| `{name}.py` | {door} | {float(ms):.1f} | {float(ratio):.2f} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", action="append", choices=SCENES, help="may be repeated; all if left out")
    parser.add_argument("--hosts", action="store_true", help="the hosts of examples/ alone")
    parser.add_argument("--quick", action="store_true", help="few samples and pixels, one round")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="rounds")
    parser.add_argument(
        "--docs", type=Path, help="folder of embedding.md and pictures; docs if nothing is left out"
    )
    options = parser.parse_args()
    whole = not (options.only or options.hosts or options.quick)
    docs = options.docs or (DOCS if whole else None)
    with sg.Simulator(sg.Scene([]), make_sonar("pylon", "wide")) as simulator:
        about = f"{simulator.gl_info['renderer']}, {os.cpu_count()} CPUs"
    charts, texts = {}, {}
    for name in () if options.hosts else options.only or SCENES:
        charts[name] = measure(name, 1 if options.quick else options.repeats, options.quick)
        texts[name] = table(charts[name])
        print(f"{name}; {about}\n\n{texts[name]}\n", flush=True)
    if whole or options.hosts:
        pictures = docs and docs / "pictures"
        texts["hosts"] = host_table({name: measure_host(name, pictures) for name in HOSTS})
        print(f"hosts; {about}\n\n{texts['hosts']}\n")
    if docs:
        if charts:
            draw_chart(
                docs / "pictures" / "chart_embedding.png", charts, f"sonar_gl {sg.__version__}, {about}"
            )
        page = (docs / "embedding.md").read_text(encoding="utf-8")
        for name, text in texts.items():
            page = splice(page, name, f"Times on {about}.\n\n{text}")
        (docs / "embedding.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
