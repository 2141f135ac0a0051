"""Shader files, their `#include` directives, and programs compiled from them."""

from __future__ import annotations

import re
from pathlib import Path

import moderngl

from sonar_gl.core.errors import Error


def load_shader(name: str, folder: Path, defines: dict[str, int]) -> tuple[str, list[tuple[str, int]]]:
    """Read a shader file, insert the files that it includes, and put `#define`s after `#version`.

    Parameters
    ----------
    name : of the file in `folder`
    defines : names of macros to their values

    Returns
    -------
    text : str, GLSL
    lines : for each line of the text, the file and the line number that it comes from, for error messages

    Raises
    ------
    Error
        if files include each other in a ring.
    """
    text, lines = [], []

    def add(file: str, included: tuple[str, ...]):
        if file in included:
            raise Error(f"shader files must not include each other in a ring (got {' > '.join(included)})")
        for number, line in enumerate((folder / file).read_text(encoding="utf-8").splitlines(), 1):
            include = re.match(r'\s*#include\s+"([^"]+)"', line)
            if include:
                add(include[1], (*included, file))
                continue
            text.append(line)
            lines.append((file, number))
            if line.startswith("#version"):
                for key, value in defines.items():
                    text.append(f"#define {key} {value}")
                    lines.append((file, number))

    add(name, ())
    return "\n".join(text) + "\n", lines


def compile_program(context, folder: Path, vertex: str, fragment: str, defines) -> moderngl.Program:
    """Compile a program from two files of the shader folder.

    Raises
    ------
    RuntimeError
        if a shader does not compile; the message names file and line.
    """
    sources = [load_shader(name, folder, defines) for name in (vertex, fragment)]
    try:
        return context.program(vertex_shader=sources[0][0], fragment_shader=sources[1][0])
    except moderngl.Error as why:
        stage = 1 if "fragment_shader" in str(why) else 0

        def source_line(match):
            index = int(match[1]) - 1
            lines = sources[stage][1]
            return "{}:{}".format(*lines[index]) if 0 <= index < len(lines) else match[0]

        raise RuntimeError(re.sub(r"\b0:(\d+)(?:\(\d+\))?", source_line, str(why))) from None
