#!/usr/bin/env python
"""Tells what each term of the model is worth in the bundled scenes and in a tank, and draws it.

    python tools/ablation.py               # writes the tables of docs/ablation.md, and its pictures
    python tools/ablation.py pylon tank    # of these scenes alone
    python tools/ablation.py --cost        # what ghosts cost over one more ping; writes nothing

A picture shows the image with everything on, then for some terms the image with everything on minus the image
without that term, both without noise. All with the samples that tolerance 0.01 asks for with everything on.
"""

from __future__ import annotations

import argparse
import io
import re
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import chart_scenes
import cv2
import numpy as np
import trimesh
from PIL import Image

import sonar_gl as sg
from sonar_gl.costs import percent
from sonar_gl.switches import TERMS, everything_on, without
from sonar_gl.terms import differs, price

DOCS = Path(__file__).resolve().parent.parent / "docs"
SCENES = {
    "pylon": 30.0,
    "diver": 10.0,
    "diver_vertical": 8.0,
    "ocean_floor": 30.0,
    "tank": 13.0,
}  # range, metres
SONAR, TOLERANCE = "p900-45", 0.01
UNSEEN = (
    "absorption",
    "speckle",
    "receiver noise",
)  # alike everywhere, or grain: nothing to see in a difference
SEEN = 1e-3  # of the image: what changes less is not drawn
SPAN_DB = 50.0  # of an image, below its strongest bin
HEIGHT, WIDEST = 300, 1500  # of a fan, and of a picture, pixels
MAX_BYTES = 120_000
REPEATS = 15


def tank() -> sg.Scene:
    """The chart's tank, filled to the brim: in place of its roof the water's surface, which mirrors."""
    scene = chart_scenes.tank()
    walls = scene.bodies[0].mesh
    roof = (walls.vertices[walls.faces][..., 2] > 1.99).all(axis=1)
    open_walls = trimesh.Trimesh(walls.vertices, walls.faces[~roof], process=False)
    bodies = [replace(scene.bodies[0], mesh=open_walls), *scene.bodies[1:]]
    return sg.Scene(bodies, scene.sonar_pose, "tank", surface_z_m=0.0)


def setting(name: str):
    """(scene, sonar)."""
    scene = tank() if name == "tank" else sg.load_scene(name)
    return scene, sg.load_sonar(SONAR).with_range(SCENES[name])


def table(prices) -> str:
    """The prices as a table of a page."""
    rows = [
        "| without | the image changes | worst bin | costs, ms | needed at 1 % |",
        "|---|---|---|---|---|",
    ]
    for one in prices:
        ms = f"{one.time_ms:.1f}" if one.changes else "-"
        on = "on" if one.on else "off"
        rows.append(f"| {one.name} | {percent(one.changes)} | {percent(one.worst_bin)} | {ms} | {on} |")
    return "\n".join(rows)


def means(scene, sonar) -> tuple:
    """Ping of everything on; name of a term -> (ping without it, share that it changes). No noise."""
    acoustics, noise = everything_on(sg.Acoustics.physical(), sg.Noise.physical(), sonar)
    pose, out = scene.sonar_pose, {}
    with sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE) as simulator:
        simulator.plan([pose])
        whole = simulator.ping(pose)
        for term in TERMS:
            if term.name not in UNSEEN:
                less, _ = without(acoustics, noise, [term])
                with sg.Simulator(simulator, sonar, less, simulator.sampling, TOLERANCE) as other:
                    part = other.ping(pose)
                out[term.name] = part, differs(whole.intensity, part.intensity)[0]
    return whole, out


def picture(scene, sonar) -> np.ndarray:
    """The image with everything on, and what some terms change, side by side."""
    whole, parts = means(scene, sonar)
    parts = {name: part for name, (part, changes) in parts.items() if changes > SEEN}
    height = min(HEIGHT, int(WIDEST / (len(parts) + 1) / 0.9))
    top_db = 10 * np.log10(float(whole.intensity.max()))
    limits = top_db - SPAN_DB, top_db
    image = sg.colorize(sg.fan_image(whole, height, "db", limits), "jet")
    panels = [(sg.draw_axes(image, whole), "everything on")]
    for name, part in parts.items():
        signed = whole.intensity.astype(np.float64) - part.intensity
        more, less = (
            sg.fan_image(replace(whole, intensity=side.clip(0).astype(np.float32)), height, "db", limits)
            for side in (signed, -signed)
        )
        colour = 1 - np.stack([less, np.maximum(more, less), more], axis=-1)
        panels.append((sg.draw_axes(np.rint(255 * colour).astype(np.uint8), whole), name))
    heads = []
    for panel, title in panels:
        head = np.zeros((30, panel.shape[1], 3), np.uint8)
        (wide, _), _ = cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        place = (panel.shape[1] - wide) // 2, 21
        heads.append(
            cv2.putText(head, title, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, (230,) * 3, 1, cv2.LINE_AA)
        )
    return np.vstack([np.hstack(heads), np.hstack([panel for panel, _ in panels])])


def png(image: np.ndarray) -> bytes:
    """The picture as a PNG of as many colours as fit."""
    for colours in (256, 128, 96, 64, 48, 32):
        data = io.BytesIO()
        Image.fromarray(image).quantize(colours, dither=Image.Dither.NONE).save(data, "PNG", optimize=True)
        if data.tell() <= MAX_BYTES:
            return data.getvalue()
    raise SystemExit(f"a picture would have {data.tell()} bytes (at most {MAX_BYTES}; give it less height)")


def splice(page: str, name: str, text: str) -> str:
    """The page with this text between the marks of a table."""
    marks = f"<!-- table {name} -->\n", "\n<!-- end -->"
    pattern = re.compile(re.escape(marks[0]) + ".*?" + re.escape(marks[1]), re.DOTALL)
    if not pattern.search(page):
        raise SystemExit(
            f"the page must have the line {marks[0].strip()!r}, and a later {marks[1].strip()!r}"
        )
    return pattern.sub(lambda _: marks[0] + text + marks[1], page, count=1)


def cost(name: str) -> str:
    """One line: what ghosts cost, over a ping without them of the same samples."""
    scene, sonar = setting(name)
    pose = scene.sonar_pose
    acoustics, _ = everything_on(sg.Acoustics.physical(), sg.Noise.physical(), sonar)
    with sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE) as simulator:
        simulator.plan([pose])
        sampling = simulator.sampling
        plain = replace(acoustics, multipath="none")
        with (
            sg.Simulator(simulator, sonar, acoustics, sampling, TOLERANCE) as ghostly,
            sg.Simulator(simulator, sonar, plain, sampling, TOLERANCE) as bare,
        ):
            times = {ghostly: [], bare: []}
            for _ in range(REPEATS + 1):
                for one, took in times.items():
                    one.ping(pose)  # untimed: what was pinged before it leaves cold caches
                    start = perf_counter()
                    one.ping(pose)
                    took.append(1e3 * (perf_counter() - start))
            with ghostly._drawing():
                now = ghostly._samples.now
                now.views(pose)
                (ghosts,) = ghostly._multipath.draw(now, [pose], [None])
            found, drawn = len(ghostly._multipath.mirrors), len(ghosts.mirrored) if ghosts else 0
            both, alone = (np.array(took[1:]) for took in times.values())
    more, ms = np.median((both - alone) / alone), np.median(alone)
    each = f", {more / drawn:.2f} a mirror" if drawn else ""
    return f"{name:15} {found:2} mirrors, {drawn} drawn; a ping {ms:6.2f} ms, ghosts {more:5.2f} of it{each}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "scenes", nargs="*", metavar="scene", help=f"of {', '.join(SCENES)}; all if none is named"
    )
    parser.add_argument("--cost", action="store_true", help="what ghosts cost over a ping, and no more")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of ablation.md and pictures")
    options = parser.parse_args()
    for name in options.scenes:
        if name not in SCENES:
            parser.error(f"there is no scene {name!r} (known are {', '.join(SCENES)})")
    path, lines = options.docs / "ablation.md", []
    for name in options.scenes or SCENES:
        if options.cost:
            lines.append(cost(name))
            print(lines[-1])
            continue
        scene, sonar = setting(name)
        with sg.Simulator(scene, sonar) as simulator:
            renderer = simulator.gl_info["renderer"]
            prices = price(simulator, sonar, TOLERANCE)
        bodies = f"{sonar.name}, {sonar.n_beams} beams x {sonar.n_bins} bins to {sonar.range_max_m:g} m"
        text = f"{bodies}; times on {renderer}.\n\n{table(prices)}"
        print(f"{name}: {text}\n")
        path.write_text(splice(path.read_text(encoding="utf-8"), name, text), encoding="utf-8")
        data = png(picture(scene, sonar))
        (options.docs / "pictures" / f"ablation_{name}.png").write_bytes(data)
        print(f"ablation_{name}.png: {len(data) / 1e3:.0f} kB\n")
    if options.cost and not options.scenes:
        text = "```text\n" + "\n".join(lines) + "\n```"
        path.write_text(splice(path.read_text(encoding="utf-8"), "cost", text), encoding="utf-8")


if __name__ == "__main__":
    main()
