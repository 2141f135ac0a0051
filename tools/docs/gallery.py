"""Make the pictures of docs/gallery.md: bundled scenes as the founding paper drew them, and as `physical`.

    python -m tools.docs.gallery                # all, into docs/pictures
    python -m tools.docs.gallery pylon_45       # one pair
    python -m tools.docs.gallery --out trial    # elsewhere

The same seed gives the same bytes on one machine; OpenGL drivers may differ in the last digit of an echo.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

import sonar_gl as sg
from tools.docs.pages import DOCS
from tools.pictures import MAX_BYTES

PICTURES = DOCS / "pictures"
SEED = 0
TIME_S = 4.0  # the divers have just breathed out
COLORMAP = "copper"  # of fan images; the founding paper's are Jet


class Comparison(NamedTuple):
    """Two pictures of one scene; the height is that of the fan, without the axes' margin."""

    scene: str
    sonar: str
    range_m: float
    height: int = 480
    styles: tuple[str, str] = ("demarco2015", "physical")


class Model(NamedTuple):
    """What a style other than the founding paper's draws: the acoustics, the noise and the time of a ping."""

    acoustics: sg.Acoustics
    noise: sg.Noise
    time_s: float | None = None


COMPARISONS = {
    "pylon_45": Comparison("pylon", "p900-45", 30.0),
    "pylon_130": Comparison("pylon", "p900-130", 30.0, 360),
    "diver": Comparison("diver", "p900-45", 10.0),
    "diver_vertical": Comparison("diver_vertical", "p900-45", 8.0),
    "diver_swimming": Comparison("diver_swimming", "p900-45", 10.0),
    "ocean_floor": Comparison("ocean_floor", "p900-45", 30.0),
    "harbour": Comparison("harbour", "p900-45", 18.0),
    "harbour_130": Comparison("harbour", "p900-130", 18.0, 360),
    # effects that the founding paper shows in its real images and leaves out
    "diver_upright": Comparison("diver_vertical", "p900-90", 10.0, 400, ("without", "with")),
    "diver_breath": Comparison("diver_swimming", "p900-45", 10.0, 480, ("without", "with")),
}

PHYSICAL = Model(sg.Acoustics.physical(), sg.Noise.physical())
REFLECTED = replace(PHYSICAL.acoustics, multipath="incoherent")
BARE = sg.Acoustics.physical(elevation_pattern="box", pulse=False, bubbles=False)
MODELS = {
    "physical": PHYSICAL,
    "without": Model(BARE, sg.Noise(speckle=True), TIME_S),
    "with": Model(REFLECTED, sg.Noise.physical(), TIME_S),
}


def draw(pair: Comparison) -> list[np.ndarray]:
    """Return the pictures of a pair, RGB, all of one size."""
    scene, sonar = sg.load_scene(pair.scene), sg.load_sonar(pair.sonar).with_range(pair.range_m)
    pose = scene.sonar_pose
    pictures = []
    for style in pair.styles:
        model = MODELS.get(style, PHYSICAL)
        with sg.Simulator(scene, sonar, model.acoustics) as simulator:
            if style == "demarco2015":
                # "constant" is what eq. (4) comes to in its author's published code; as printed, near echoes are dark
                picture = sg.demarco_image(simulator, pose, SEED, height=pair.height, range_law="constant")
            else:
                ping = simulator.ping(pose, model.noise, SEED, time_s=model.time_s)
                picture = fan_picture(ping, pair.height)
        pictures.append(picture)
    height, width = np.max([picture.shape[:2] for picture in pictures], axis=0)
    return [with_margin(picture, height, width) for picture in pictures]


def with_margin(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a picture with the black margin of axes, which the founding paper's has not."""
    rows, columns = picture.shape[:2]
    above = (height - rows) // 2  # and as much on the left; on the right is the bar of colours
    return np.pad(picture, ((above, height - rows - above), (above, width - columns - above), (0, 0)))


def fan_picture(ping: sg.Ping, height: int) -> np.ndarray:
    """Return a fan image with axes, RGB."""
    return sg.draw_axes(sg.colorize(sg.fan_image(ping, height), COLORMAP), ping, COLORMAP)


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
        for style, picture in zip(pair.styles, draw(pair), strict=True):
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
