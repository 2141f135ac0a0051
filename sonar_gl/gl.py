"""OpenGL without a window: contexts, shader files, what the driver says of itself."""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path
from typing import NamedTuple

import moderngl

from sonar_gl.types import Error

REQUIRED_GL = 330
# by their sonames: the unversioned ones come with development packages only
LIBRARIES = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
DEVICE_VARIABLES = ("SONAR_GL_DEVICE", "GLCONTEXT_DEVICE_INDEX")  # ours, and that of the library below
# of EGL, for eglQueryDeviceStringEXT
EGL_EXTENSIONS, EGL_DRM_DEVICE_FILE_EXT, EGL_RENDERER_EXT = 0x3055, 0x3233, 0x335F
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


class Device(NamedTuple):
    """An EGL device; `trouble` says why no OpenGL can be had of it, '' if it can."""

    index: int
    name: str
    trouble: str = ""

    def __str__(self):
        return f"{self.index} {self.name}" + (f" (not to be used: {self.trouble})" if self.trouble else "")


def egl_devices() -> list[str] | None:
    """What EGL calls its devices, by their index, '' where it does not say; None if it lists none at all.

    Raises
    ------
    OSError
        if there is no EGL.
    """
    library = ctypes.CDLL(LIBRARIES["libegl"])
    library.eglGetProcAddress.restype = ctypes.c_void_p
    addresses = [library.eglGetProcAddress(n) for n in (b"eglQueryDevicesEXT", b"eglQueryDeviceStringEXT")]
    if not all(addresses):
        return None
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    query = ctypes.CFUNCTYPE(ctypes.c_uint, integer, pointer, ctypes.POINTER(integer))(addresses[0])
    ask = ctypes.CFUNCTYPE(ctypes.c_char_p, pointer, integer)(addresses[1])
    count = integer(0)
    query(0, None, ctypes.byref(count))
    devices = (pointer * count.value)()
    query(count.value, devices, ctypes.byref(count))
    names = []
    for device in devices:
        known = (ask(device, EGL_EXTENSIONS) or b"").split()
        name = ask(device, EGL_RENDERER_EXT) if b"EGL_EXT_device_query_name" in known else None
        if not name and b"EGL_EXT_device_drm" in known:
            name = ask(device, EGL_DRM_DEVICE_FILE_EXT)
        names.append((name or b"").decode(errors="replace"))
    return names


def devices() -> list[Device]:
    """The EGL devices of this machine, each tried; not to be called inside a `with context` block."""
    try:
        names = egl_devices() or []
    except OSError:
        names = []
    found = []
    for index, name in enumerate(names):
        try:
            context = _create(index)
        except Exception as why:  # moderngl and glcontext raise plain Exception
            found.append(Device(index, name or "without a name", " ".join(str(why).split())))
        else:
            found.append(Device(index, context.info["GL_RENDERER"]))
            context.release()
    return found


def chosen_device(device: int | None = None) -> tuple[int | None, str]:
    """The index that is meant, `device` or else the first of DEVICE_VARIABLES, and where it is from."""
    if device is not None:
        if isinstance(device, bool) or not isinstance(device, int) or device < 0:
            raise Error(no_device(repr(device)))
        return device, str(device)
    for variable in DEVICE_VARIABLES:
        if text := os.environ.get(variable, "").strip():
            if not re.fullmatch("[0-9]{1,9}", text):
                raise Error(no_device(f"{variable}={text}"))
            return int(text), f"{variable}={text}"
    return None, ""


def no_device(got: str) -> str:
    """The message for a device that is not there."""
    found = devices()
    there = f"there {'is' if len(found) == 1 else 'are'} {len(found)}"
    names = ": " + ", ".join(str(one) for one in found) if found else ""
    return f"the OpenGL device must be the index of an EGL device (got {got}; {there}{names})"


def _create(index: int | None) -> moderngl.Context:
    how = {"standalone": True, "require": REQUIRED_GL}
    if index is None:  # whatever glcontext takes of itself
        return moderngl.create_context(backend="egl", **LIBRARIES, **how)
    from glcontext import egl  # beneath the layer where variables would win over an index

    return moderngl.create_context(
        context=egl.create_context(mode="standalone", glversion=REQUIRED_GL, device_index=index, **LIBRARIES),
        **how,
    )


def create_context(device: int | None = None) -> moderngl.Context:
    """A stand-alone headless context of at least OpenGL 3.3 core, current in this thread.

    Parameters
    ----------
    device : index of an EGL device, as `devices` lists them; None is that of the environment variable
        SONAR_GL_DEVICE, and without it the first

    Raises
    ------
    Error
        if there is no EGL or no such device, or the driver is too old.
    """
    release_discarded()
    index, said = chosen_device(device)
    try:
        context = _create(index)
    except Exception as why:  # moderngl and glcontext raise plain Exception
        text = " ".join(str(why).split())
        if said and "requested device index" in text:
            raise Error(no_device(said)) from None
        version = re.search(r"got version (\d)(\d)\d", text)
        if version:
            raise Error(too_old(f"{version[1]}.{version[2]}")) from None
        if "eglCreateContext failed (0x3009)" in text:  # EGL_BAD_MATCH: no such version
            raise Error(too_old("an older one")) from None
        if others := [str(one) for one in devices() if not one.trouble]:
            raise Error(
                f"OpenGL device {index or 0} must work (got: {text}); set SONAR_GL_DEVICE to one that does: "
                + ", ".join(others)
            ) from None
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
