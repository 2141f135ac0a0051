"""Shaders with noise in 1/x, as of drivers with a sloppy reciprocal or interpolation."""

import shutil
from pathlib import Path

from sonar_gl.core.data_files import data_folder

# what 1/x is, in the shader of the engine, on cards and by software, and in that of hosts
EXACT = {
    "gbuffer.frag": ("clamp(dot(plane, ray), v_bounds.x, v_bounds.y)", "gl_FragCoord.w"),
    "embed.glsl": ("gl_FragCoord.w",),
}
FIRST = {"gbuffer.frag": "void main()", "embed.glsl": "// normal: in the view's axes"}
# even in -1..1, by an integer hash of the pixel
NOISE = """float noise()
{
    uvec2 pixel = uvec2(gl_FragCoord.xy);
    uint h = pixel.x * 1664525u + pixel.y * 22695477u + 1013904223u;
    h ^= h >> 16; h *= 0x7feb352du; h ^= h >> 15; h *= 0x846ca68bu; h ^= h >> 16;
    return float(h) / 2147483648.0 - 1.0;
}

"""


def noisy_shaders(folder: Path, units: float) -> Path:
    """Return a folder of shaders whose 1/x is off by up to `units` times 2^-24, each pixel on its own."""
    made = folder / "shaders"
    shutil.copytree(data_folder("shaders"), made)
    for name, several in EXACT.items():
        text = (made / name).read_text(encoding="utf-8")
        assert text.count(FIRST[name]) == 1
        text = text.replace(FIRST[name], NOISE + FIRST[name])
        for exact in several:
            line = f"float depth_inverse = {exact};"
            assert text.count(line) == 1
            noisy = f"float depth_inverse = {exact} * (1.0 + noise() * {float(units)} / 16777216.0);"
            text = text.replace(line, noisy)
        (made / name).write_text(text, encoding="utf-8")
    return made
