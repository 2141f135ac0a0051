"""Make the pictures of docs/gallery.md: bundled scenes as the founding paper drew them, and as `physical`.

    python -m tools.docs.gallery                # all, into docs/pictures
    python -m tools.docs.gallery pylon_45       # one pair
    python -m tools.docs.gallery --out trial    # elsewhere

The same seed gives the same bytes on one machine; OpenGL drivers may differ in the last digit of an echo.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

import sonar_gl as sg
from tools.docs.pages import DOCS

PICTURES = DOCS / "pictures"
SEED = 0
TIME_S = 4.0  # the divers have just breathed out
MAX_BYTES = 120_000
COLORMAP = "copper"  # of fan images; the founding paper's are Jet


class Comparison(NamedTuple):
    """Two pictures of one scene; the height is that of the fan, without the axes' margin."""

    scene: str
    sonar: str
    range_m: float
    height: int = 480
    styles: tuple = ("demarco2015", "physical")


COMPARISONS = {
    "pylon_45": Comparison("pylon", "p900-45", 30.0),
    "pylon_130": Comparison("pylon", "p900-130", 30.0, 360),
    "diver": Comparison("diver", "p900-45", 10.0),
    "diver_vertical": Comparison("diver_vertical", "p900-45", 8.0),
    "diver_swimming": Comparison("diver_swimming", "p900-45", 10.0),
    "ocean_floor": Comparison("ocean_floor", "p900-45", 30.0),
    # effects that the founding paper shows in its real images and leaves out
    "diver_upright": Comparison("diver_vertical", "p900-90", 10.0, 400, ("without", "with")),
    "diver_breath": Comparison("diver_swimming", "p900-45", 10.0, 480, ("without", "with")),
}


def draw(pair: Comparison):
    """Return the founding paper's picture and one of profile `physical` with noise and axes, RGB."""
    scene, sonar = sg.load_scene(pair.scene), sg.load_sonar(pair.sonar).with_range(pair.range_m)
    pose = scene.sonar_pose
    with sg.Simulator(scene, sonar) as simulator:
        # "constant" is what eq. (4) comes to in its author's published code; as printed, near echoes are dark
        paper = sg.demarco_image(simulator, pose, SEED, height=pair.height, range_law="constant")
        ping = simulator.ping(pose, sg.Noise.physical(), SEED)
    physical = fan_picture(ping, pair.height)
    # the paper's picture has no axes: the same black margin, so that both fans are of one size
    (rows, columns), (height, width) = paper.shape[:2], physical.shape[:2]
    above = (height - rows) // 2  # and as much on the left; on the right is the bar of colours
    margin = ((above, height - rows - above), (above, width - columns - above), (0, 0))
    return np.pad(paper, margin), physical


def fan_picture(ping: sg.Ping, height: int) -> np.ndarray:
    """Return a fan image with axes, RGB."""
    return sg.draw_axes(sg.colorize(sg.fan_image(ping, height), COLORMAP), ping, COLORMAP)


def draw_terms(pair: Comparison):
    """Return pictures without and with multipath, bubbles, receiver noise and a beam in elevation, RGB."""
    scene, sonar = sg.load_scene(pair.scene), sg.load_sonar(pair.sonar).with_range(pair.range_m)
    bare, bare_noise = (
        sg.Acoustics.physical(bubbles=False, elevation_pattern="box"),
        sg.Noise(speckle=True),
    )
    full = sg.Acoustics.physical(multipath="incoherent")
    out = []
    for acoustics, noise in ((bare, bare_noise), (full, sg.Noise(speckle=True, electronic_db=-80.0))):
        with sg.Simulator(scene, sonar, acoustics) as simulator:
            ping = simulator.ping(scene.sonar_pose, noise, SEED, time_s=TIME_S)
        out.append(fan_picture(ping, pair.height))
    return out


def palette(colormap: str) -> Image.Image:
    """Return the palette of a picture: its colours in 120 steps, the same under the axes' lines, and grays."""
    colours = sg.colorize(np.linspace(0, 1, 120)[None], colormap)[0]
    lines = colours[::2] * 0.55 + 255 * 0.45
    faint = colours[::4] * 0.8
    grays = np.linspace(0, 255, 46)[:, None].repeat(3, axis=1)
    out = Image.new("P", (1, 1))
    out.putpalette(np.rint(np.concatenate([colours, lines, faint, grays])).astype(np.uint8).tobytes())
    return out


def png(picture: np.ndarray, colormap: str) -> bytes:
    """Return the picture as a PNG with a palette: speckle in full colour takes three times the bytes."""
    image = Image.fromarray(picture).quantize(palette=palette(colormap), dither=Image.Dither.NONE)
    data = io.BytesIO()
    image.save(data, format="PNG", optimize=True)
    return data.getvalue()


def main():
    """Write the pictures that are named."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.docs.gallery", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("pairs", nargs="*", metavar="pair", help=f"of {', '.join(COMPARISONS)}; default: all")
    parser.add_argument("--out", type=Path, default=PICTURES, help="folder to write into")
    options = parser.parse_args()
    for name in options.pairs:
        if name not in COMPARISONS:
            parser.error(f"there is no pair {name!r} (known are {', '.join(COMPARISONS)})")
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.pairs or COMPARISONS:
        pair = COMPARISONS[name]
        pictures = draw_terms(pair) if "without" in pair.styles else draw(pair)
        for style, picture in zip(pair.styles, pictures, strict=True):
            colormap = "jet" if style == "demarco2015" else COLORMAP
            path, data = options.out / f"{name}_{style}.png", png(picture, colormap)
            if len(data) > MAX_BYTES:
                raise SystemExit(
                    f"{path} would have {len(data)} bytes (at most {MAX_BYTES}; give it less height)"
                )
            path.write_bytes(data)
            print(f"{path}: {picture.shape[1]} x {picture.shape[0]} pixels, {len(data) / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
