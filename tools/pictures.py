"""Small PNG files: figures of matplotlib and images of few colours, written whole or not at all."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from sonar_gl.core.atomic_file import atomic_write

MAX_BYTES = 120_000  # of a picture of the documentation
COLOURS = 256, 192, 160, 128, 96, 64, 48, 32


def write_png(path: Path, image: Image.Image, colours: int = 96):
    """Write an image with a palette: a third of the bytes, while lines and letters look the same."""
    with atomic_write(Path(path)) as name:
        # the median cut alone gives a dark gradient the colour of a few red lines
        image.convert("RGB").quantize(colours, kmeans=3).save(name, format="png", optimize=True)


def write_small_png(path: Path, image: Image.Image):
    """Write an image with as many COLOURS as leave it within MAX_BYTES; end the program if none do."""
    for colours in COLOURS:
        write_png(path, image, colours)
        if path.stat().st_size <= MAX_BYTES:
            return
    raise SystemExit(
        f"{path} must have at most {MAX_BYTES} bytes (got {path.stat().st_size}; give it less height)"
    )


def write_figure(path: Path, figure, dpi: int):
    """Write a figure of matplotlib, and close it."""
    from matplotlib import pyplot

    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=dpi, format="png")
    pyplot.close(figure)
    write_png(path, Image.open(drawn))
