"""Shaders with noise in gl_FragCoord.w, as of drivers with a sloppy reciprocal."""

import shutil
from pathlib import Path

from sonar_gl.core.data_files import data_folder

EXACT = "float depth_inverse = gl_FragCoord.w;"
NOISY = "float depth_inverse = gl_FragCoord.w * (1.0 + noise() * UNITS / 16777216.0);"
# even in -1..1, by an integer hash of the pixel
NOISE = """float noise()
{
    uvec2 pixel = uvec2(gl_FragCoord.xy);
    uint h = pixel.x * 1664525u + pixel.y * 22695477u + 1013904223u;
    h ^= h >> 16; h *= 0x7feb352du; h ^= h >> 15; h *= 0x846ca68bu; h ^= h >> 16;
    return float(h) / 2147483648.0 - 1.0;
}

void main()"""


def noisy_shaders(folder: Path, units: float) -> Path:
    """Return a folder of shaders whose 1/x is off by up to `units` times 2^-24, each pixel on its own."""
    made = folder / "shaders"
    shutil.copytree(data_folder("shaders"), made)
    text = (made / "gbuffer.frag").read_text()
    assert text.count(EXACT) == text.count("void main()") == 1
    text = text.replace("void main()", NOISE).replace(EXACT, NOISY.replace("UNITS", f"{float(units)}"))
    (made / "gbuffer.frag").write_text(text)
    return made
