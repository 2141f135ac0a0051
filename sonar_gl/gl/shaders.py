"""Shader files, their `#include` directives, and programs compiled from them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import moderngl


def load_shader(name: str, folder: Path, defines: dict[str, int]) -> tuple[str, list[tuple[str, int]]]:
    """Read a shader file, insert the files that it includes, and put `#define`s after `#version`.

    Returns the GLSL text, and for each of its lines the file and the number that it comes from, for error messages.
    """
    text, lines = [], []

    def add(file: str):
        for number, line in enumerate((folder / file).read_text(encoding="utf-8").splitlines(), 1):
            include = re.match(r'\s*#include\s+"([^"]+)"', line)
            if include:
                add(include[1])
                continue
            text.append(line)
            lines.append((file, number))
            if line.startswith("#version"):
                for key, value in defines.items():
                    text.append(f"#define {key} {value}")
                    lines.append((file, number))

    add(name)
    return "\n".join(text) + "\n", lines


# how drivers name a line: Mesa 0:12(3), NVIDIA 0(12)
LINE = re.compile(r"\b0(?::(\d+)(?:\(\d+\))?|\((\d+)\))")
STAGES = {".vert": "vertex_shader", ".geom": "geometry_shader", ".frag": "fragment_shader"}


def compile_program(context, folder: Path, names: Sequence[str], defines: dict[str, int]) -> moderngl.Program:
    """Compile a program from files of the shader folder, each of which is the stage that its suffix names.

    Raises RuntimeError, which names file and line, if a shader does not compile.
    """
    sources = {STAGES[Path(name).suffix]: load_shader(name, folder, defines) for name in names}
    try:
        return context.program(**{stage: text for stage, (text, _) in sources.items()})
    except moderngl.Error as why:
        failed = next((stage for stage in sources if stage in str(why)), "vertex_shader")
        lines = sources[failed][1]

        def source_line(match):
            index = int(match[1] or match[2]) - 1
            return "{}:{}".format(*lines[index]) if 0 <= index < len(lines) else match[0]

        raise RuntimeError(LINE.sub(source_line, str(why))) from None
