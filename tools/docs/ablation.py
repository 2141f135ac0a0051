"""Measure and draw what each term of the model changes in the bundled scenes and in a tank.

    python -m tools.docs.ablation               # writes the tables of docs/ablation.md, and its pictures
    python -m tools.docs.ablation pylon tank    # of these scenes alone
    python -m tools.docs.ablation --only bubbles     # the rows of this term, and of terms that have none yet
    python -m tools.docs.ablation --cost        # what multipath costs over one more ping; writes that table

A picture shows the image with everything on, then for some terms the image with everything on minus the image
without that term, both without noise, with the samples that tolerance 0.01 asks for with everything on.

With --only, which may be repeated, all other rows keep their costs, which vary from run to run and between machines.
Pictures stay where the terms change nothing. Where a term without a row changes the image, everything on is another
image, so that all rows are measured anew.
"""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from PIL import Image

import sonar_gl as sg
from sonar_gl.analysis.terms import TERMS, differs, everything_on, price, without
from sonar_gl.cli.plan import percent
from sonar_gl.scene.reflectors import planar_reflectors
from tools import internals
from tools.bench import harness
from tools.bench.harness import Contender
from tools.chart import scenes
from tools.docs.pages import DOCS, find_table, put_table
from tools.pictures import write_small_png

SCENES = {
    "pylon": 30.0,
    "diver": 10.0,
    "diver_vertical": 8.0,
    "ocean_floor": 30.0,
    "tank": 13.0,
}  # range, metres
SONAR, TOLERANCE = "p900-45", 0.01
# terms that are even over the image, or grain: a difference shows nothing
UNDRAWN = ("absorption", "speckle", "receiver noise")
LEAST_CHANGE = 1e-3  # of the image; terms that change less are not drawn
SPAN_DB = 50.0  # of an image, below its strongest bin
HEIGHT, WIDEST = 300, 1500  # of a fan, and of a picture, pixels
ROUNDS = 15


def tank() -> sg.Scene:
    """Make the chart's tank, full: the water's surface, which reflects, in place of its roof."""
    scene = scenes.tank()
    walls = scene.bodies[0].mesh
    roof = (walls.vertices[walls.faces][..., 2] > 1.99).all(axis=1)
    open_walls = trimesh.Trimesh(walls.vertices, walls.faces[~roof], process=False)
    bodies = [replace(scene.bodies[0], mesh=open_walls), *scene.bodies[1:]]
    return sg.Scene(bodies, scene.sonar_pose, "tank", surface_z_m=0.0)


def setting(name: str):
    """Return the scene and the sonar."""
    scene = tank() if name == "tank" else sg.load_scene(name)
    return scene, sg.load_sonar(SONAR).with_range(SCENES[name])


def table(prices) -> str:
    """Return the prices as a table of a page."""
    return harness.markdown(
        [
            {
                "without": one.name,
                "change of the image": percent(one.changes),
                "worst bin": percent(one.worst_bin),
                "bins > 3 dB": percent(one.changed_bins),
                "cost, ms": f"{one.time_ms:.1f}" if one.changes else "-",
                "needed at 1 %": "on" if one.on else "off",
            }
            for one in prices
        ]
    )


def rows_of(text: str) -> dict[str, str]:
    """Return the rows of a table, by the names of their terms."""
    return {found[1]: found[0] for found in re.finditer(r"^\| ([\w -]+) \|.*$", text, re.MULTILINE)}


def keep_rows(text: str, standing: str, names) -> str:
    """Return a table with the rows of some terms; those of others, and the line above, are those of a standing one."""
    kept = {name: row for name, row in rows_of(standing).items() if name not in names}
    rows = [kept.get(name, row) for name, row in rows_of(text).items()]
    head, lines = standing.partition("\n")[0], text.split("\n")
    rows.insert(1, lines[3])  # the rule below the head
    return "\n".join([head, "", *rows])


def measure(name: str, standing: str, only) -> tuple[str, bool]:
    """Return the table of a scene, and whether its picture is to be drawn.

    standing : the table whose rows stay, but for those of the terms `only` and those that it lacks; empty for none
    """
    scene, sonar = setting(name)
    kept = rows_of(standing).keys() - set(only)
    with sg.Simulator(scene, sonar) as simulator:
        renderer = simulator.gl_info["renderer"]
        prices = price(simulator, sonar, TOLERANCE, timed={term.name for term in TERMS} - kept)
        new = [one for one in prices if one.name not in rows_of(standing)]
        if kept and any(one.changes for one in new):
            kept, prices = set(), price(simulator, sonar, TOLERANCE)
    bodies = f"{sonar.name}, {sonar.n_beams} beams x {sonar.n_bins} bins to {sonar.range_max_m:g} m"
    text = f"{bodies}; times on {renderer}.\n\n{table(prices)}"
    is_other = any(one.changes for one in prices if one.name not in kept)
    return keep_rows(text, standing, {one.name for one in prices} - kept) if kept else text, is_other


def means(scene, sonar) -> tuple:
    """Return the ping with everything on, and {term: (ping without it, share that it changes)}, no noise."""
    acoustics, noise = everything_on(sg.Acoustics.physical(), sg.Noise.physical())
    pose, out = scene.sonar_pose, {}
    with sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE) as simulator:
        simulator.plan([pose])
        whole = simulator.ping(pose)
        for term in TERMS:
            if term.name not in UNDRAWN:
                less, _ = without(acoustics, noise, [term])
                with sg.Simulator(simulator, sonar, less, simulator.sampling, TOLERANCE) as other:
                    part = other.ping(pose)
                out[term.name] = part, differs(whole.intensity, part.intensity)[0]
    return whole, out


def picture(scene, sonar) -> np.ndarray:
    """Draw the image with everything on, and what some terms change, side by side."""
    whole, parts = means(scene, sonar)
    parts = {name: part for name, (part, changes) in parts.items() if changes > LEAST_CHANGE}
    height = min(HEIGHT, int(WIDEST / (len(parts) + 1) / 0.9))
    top_db = 10 * np.log10(float(whole.intensity.max()))
    law = sg.Counts(low_db=top_db - SPAN_DB, high_db=top_db)
    image = sg.colorize(sg.fan_image(whole, height, law), "jet")
    panels = [(sg.draw_axes(image, whole), "everything on")]
    for name, part in parts.items():
        signed = whole.intensity.astype(np.float64) - part.intensity
        more, less = (
            sg.fan_image(replace(whole, intensity=side.clip(0).astype(np.float32)), height, law)
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


def cost(name: str) -> str:
    """Return one line: what multipath costs over a ping without it of the same samples.

    By itself a ping first finds how many samples its multipath needs. In a sequence those of the ping before do.
    """
    scene, sonar = setting(name)
    pose = scene.sonar_pose
    acoustics, _ = everything_on(sg.Acoustics.physical(), sg.Noise.physical())
    with sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE) as simulator:
        simulator.plan([pose])
        sampling = simulator.sampling
        none = replace(acoustics, multipath="none")
        with (
            sg.Simulator(simulator, sonar, acoustics, sampling, TOLERANCE) as with_multipath,
            sg.Simulator(simulator, sonar, none, sampling, TOLERANCE) as without_it,
        ):

            def contender(one):  # untimed first: the pings before it leave cold caches
                return Contender(lambda _: one.ping(pose), before=lambda _: one.ping(pose))

            times = harness.take_turns(
                {
                    "alone": contender(with_multipath),
                    "in sequence": contender(simulator),
                    "direct": contender(without_it),
                },
                ROUNDS,
                warm_up=1,
            )
            sources = internals.count_image_sources(with_multipath, pose)
    direct = times["direct"]
    # below 0 it is the variation of the times
    alone, following = (
        max(harness.ratio(times[way] - direct, direct), 0.0) for way in ("alone", "in sequence")
    )
    reflectors = planar_reflectors(scene, 2 * np.pi * sonar.frequency_hz / acoustics.water.sound_speed())
    each = (
        f", {alone / sources:.2f} per reflector; in a sequence {following / sources:.2f}" if sources else ""
    )
    return (
        f"{name:14} {len(reflectors):3} planar reflectors, {sources} simulated; "
        f"a ping {np.median(direct):6.2f} ms, multipath {alone:5.2f} of it{each}"
    )


def main():
    """Write the tables and pictures that are named."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.docs.ablation", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("scenes", nargs="*", metavar="scene", help=f"of {', '.join(SCENES)}; default: all")
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        choices=[term.name for term in TERMS],
        metavar="TERM",
        help="only the rows of this term, and of terms that have none; may be repeated",
    )
    parser.add_argument("--cost", action="store_true", help="only what multipath costs over a ping")
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
        text, is_other = measure(name, find_table(path, name)[1] if options.only else "", options.only)
        print(f"{name}: {text}\n")
        put_table(path, name, text)
        if not is_other:
            continue
        drawn = options.docs / "pictures" / f"ablation_{name}.png"
        write_small_png(drawn, Image.fromarray(picture(*setting(name))))
        print(f"{drawn.name}: {drawn.stat().st_size / 1e3:.0f} kB\n")
    if options.cost and not options.scenes:
        put_table(path, "cost", "```text\n" + "\n".join(lines) + "\n```")


if __name__ == "__main__":
    main()
