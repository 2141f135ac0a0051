"""OpenGL without a window: contexts, shader files, what the driver says of itself."""

from __future__ import annotations

import re
from pathlib import Path

import moderngl

from sonar_gl.types import Error

REQUIRED_GL = 330
NO_EGL = (
    "OpenGL must be reachable through EGL, without a display (got: {why}); on Debian or Ubuntu install it "
    "with 'apt-get install libegl1 libgl1', in a container with a GPU let the driver's EGL library in"
)

_discarded: list[moderngl.Context] = []


def discard(context: moderngl.Context) -> None:
    """Have a context released later, when nobody is drawing.

    For finalisers: the garbage collector may call them in the midst of another context's drawing, and
    releasing a context leaves none current.
    """
    _discarded.append(context)


def release_discarded() -> None:
    """Release what was discarded; not to be called inside a `with context` block."""
    while _discarded:
        _discarded.pop().release()


def create_context() -> moderngl.Context:
    """A stand-alone headless context of at least OpenGL 3.3 core, current in this thread.

    Raises
    ------
    Error
        if there is no EGL, or the driver is too old.
    """
    release_discarded()
    try:
        # by their sonames: the unversioned ones come with development packages only
        context = moderngl.create_context(
            standalone=True,
            backend="egl",
            require=REQUIRED_GL,
            libgl="libGL.so.1",
            libegl="libEGL.so.1",
        )
    except Exception as why:  # moderngl and glcontext raise plain Exception
        text = " ".join(str(why).split())
        version = re.search(r"got version (\d)(\d)\d", text)
        if version:
            raise Error(too_old(f"{version[1]}.{version[2]}")) from None
        if "eglCreateContext failed (0x3009)" in text:  # EGL_BAD_MATCH: no such version
            raise Error(too_old("an older one")) from None
        raise Error(NO_EGL.format(why=text)) from None
    if context.version_code < REQUIRED_GL:
        code = context.version_code
        context.release()
        raise Error(too_old(f"{code // 100}.{code // 10 % 10}"))
    # objects that lose their Python name wait for context.gc(), when this context is current; "auto" would
    # delete names in whichever context is, and release this one twice
    context.gc_mode = "context_gc"
    return context


def too_old(got: str) -> str:
    """The message for a driver below OpenGL 3.3."""
    return (
        f"OpenGL must be 3.3 or newer (got {got}); update the driver, or use Mesa's software renderer with "
        "'LIBGL_ALWAYS_SOFTWARE=1'"
    )


def load_shader(name: str, folder: Path, defines: dict[str, int]) -> tuple[str, list[tuple[str, int]]]:
    """GLSL text with `#include "x"` resolved and `#define`s put after `#version`.

    Returns
    -------
    text : str
    lines : for each line of the text the file and line that it came from, for error messages
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
    """A program from two files of the shader folder; a compile error names the file and its line."""
    sources = [load_shader(name, folder, defines) for name in (vertex, fragment)]
    try:
        return context.program(vertex_shader=sources[0][0], fragment_shader=sources[1][0])
    except moderngl.Error as why:
        stage = 1 if "fragment_shader" in str(why) else 0

        def place(match):
            index = int(match[1]) - 1
            lines = sources[stage][1]
            return "{}:{}".format(*lines[index]) if 0 <= index < len(lines) else match[0]

        raise RuntimeError(re.sub(r"\b0:(\d+)(?:\(\d+\))?", place, str(why))) from None


def describe(context: moderngl.Context) -> dict:
    """Driver, version and the limits that bound a ping."""
    info = context.info
    return {
        "renderer": info["GL_RENDERER"],
        "vendor": info["GL_VENDOR"],
        "version": info["GL_VERSION"],
        "max_texture_size": info["GL_MAX_TEXTURE_SIZE"],
        "max_viewport": list(info["GL_MAX_VIEWPORT_DIMS"]),
        "max_color_attachments": info["GL_MAX_COLOR_ATTACHMENTS"],
    }
