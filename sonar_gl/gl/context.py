"""OpenGL contexts without a window, the EGL devices they can use, and what a driver reports about itself."""

from __future__ import annotations

import ctypes
import os
import re
from contextlib import contextmanager
from typing import NamedTuple

import glcontext
import moderngl

from sonar_gl.core.checks import is_whole_number
from sonar_gl.core.errors import Error
from sonar_gl.gl import egl
from sonar_gl.gl.egl import LIBRARIES
from sonar_gl.gl.lifetime import release_waiting

REQUIRED_GL = 330
SETTINGS = {  # environment variable: where its value may come from; ours, and the one that glcontext reads
    "SONAR_GL_DEVICE": "--device or the variable SONAR_GL_DEVICE",
    "GLCONTEXT_DEVICE_INDEX": "the variable GLCONTEXT_DEVICE_INDEX",
}
DEVICE_VARIABLES = tuple(SETTINGS)
EGL_DRM_DEVICE_FILE_EXT, EGL_RENDERER_EXT = 0x3233, 0x335F  # names for eglQueryDeviceStringEXT
NO_EGL = (
    "OpenGL must be reachable through EGL, without a display (got: {why}); pings need none with the "
    "engine 'cpu'; on Debian or Ubuntu install it with 'apt-get install libegl1 libgl1', in a container with a GPU let "
    "the driver's EGL library in"
)
# 0 or 1 in place of what the driver's name says, to test the other path
SOFTWARE_VARIABLE = "SONAR_GL_SOFTWARE"
SOFTWARE = re.compile(r"llvmpipe|softpipe|swrast|swiftshader|software", re.IGNORECASE)


class Device(NamedTuple):
    """An EGL device."""

    index: int  # EGL's index of the device
    name: str  # the renderer's name, or EGL's name for the device if it has no OpenGL
    trouble: str = ""  # why the device has no usable OpenGL; '' if it has

    def __str__(self):
        return f"{self.index} {self.name}" + (f" (not to be used: {self.trouble})" if self.trouble else "")


def egl_devices() -> list[str] | None:
    """Return EGL's names for its devices, by index, '' for those without; None if EGL cannot list devices.

    Raises OSError if EGL is not installed.
    """
    library = ctypes.CDLL(LIBRARIES["libegl"])
    library.eglGetProcAddress.restype = ctypes.c_void_p
    addresses = [library.eglGetProcAddress(n) for n in (b"eglQueryDevicesEXT", b"eglQueryDeviceStringEXT")]
    if not all(addresses):
        return None
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    query = ctypes.CFUNCTYPE(ctypes.c_uint, integer, pointer, ctypes.POINTER(integer))(addresses[0])
    query_string = ctypes.CFUNCTYPE(ctypes.c_char_p, pointer, integer)(addresses[1])
    count = integer(0)
    query(0, None, ctypes.byref(count))
    devices = (pointer * count.value)()
    query(count.value, devices, ctypes.byref(count))
    names = []
    for device in devices:
        extensions = (query_string(device, egl.EXTENSIONS) or b"").split()
        name = None
        if b"EGL_EXT_device_query_name" in extensions:
            name = query_string(device, EGL_RENDERER_EXT)
        if not name and b"EGL_EXT_device_drm" in extensions:
            name = query_string(device, EGL_DRM_DEVICE_FILE_EXT)
        names.append((name or b"").decode(errors="replace"))
    return names


def devices() -> list[Device]:
    """Return the EGL devices of this machine, each tried; not to be called inside a `with context` block."""
    try:
        names = egl_devices() or []
    except OSError:
        names = []
    found = []
    with egl.preserve_current():
        for index, name in enumerate(names):
            try:
                context = egl_context(index)
            except Exception as why:  # moderngl and glcontext raise plain Exception
                found.append(Device(index, name or "without a name", " ".join(str(why).split())))
            else:
                found.append(Device(index, context.info["GL_RENDERER"]))
                context.release()
    return found


def chosen_device(device: int | None = None) -> tuple[int | None, str]:
    """Return the index of the device to use, or None for EGL's first, and the index with what chose it, or ''.

    device : index; None takes the first of DEVICE_VARIABLES that is set. Error unless it is a whole number of 0 or more
    """
    if device is not None:
        if not (is_whole_number(device) and device >= 0):
            raise Error(no_device_message(repr(device)))
        return int(device), str(device)
    for variable in DEVICE_VARIABLES:
        if text := os.environ.get(variable, "").strip():
            if not re.fullmatch("[0-9]{1,9}", text):
                raise Error(no_device_message(f"{text}, by {SETTINGS[variable]}"))
            return int(text), f"{text}, by {SETTINGS[variable]}"
    return None, ""


def no_device_message(got: str) -> str:
    """Return the error message for an index that is no device's; it lists those that there are."""
    found = devices()
    if not found:
        return f"the OpenGL device must be the index of an EGL device (got {got}; there are 0)"
    indices = "0" if len(found) == 1 else f"0 to {len(found) - 1}"
    there = f"there {'is' if len(found) == 1 else 'are'} {len(found)}: {', '.join(map(str, found))}"
    return f"the OpenGL device must be {indices} (got {got}; {there})"


@contextmanager
def _preserve_default_context():
    """Restore moderngl's default context, which a host may use, after the block.

    Every new context becomes the default. moderngl has no public function that sets it.
    """
    before = moderngl._store.default_context
    try:
        yield
    finally:
        moderngl._store.default_context = before


def make_context(loader) -> moderngl.Context:
    """Return a moderngl context for an OpenGL context that exists.

    loader : EglContext or HostContext; it becomes the context's `extra`, and a `with context` block enters it
    """
    with loader, _preserve_default_context():
        context = moderngl.create_context(context=loader, require=REQUIRED_GL)
        loader.gl.take_errors()  # of moderngl's queries
    # Objects that lose their Python name wait for context.gc(), while this context is current. In mode "auto"
    # moderngl would delete names in whichever context is current, and release this one twice.
    context.gc_mode, context.extra = "context_gc", loader
    return context


@_preserve_default_context()
def egl_context(index: int | None) -> moderngl.Context:
    """Return a context without a window on an EGL device, by its index, or on glcontext's own choice for None."""
    from glcontext import egl as native_egl  # which its builds for macOS and Windows lack

    egl.process_contexts.use()
    settings = {"mode": "standalone", "glversion": REQUIRED_GL, **LIBRARIES}
    if index is None:  # glcontext's own choice
        native = glcontext.get_backend_by_name("egl")(**settings)
    else:  # the layer below, where environment variables do not override the index
        native = native_egl.create_context(device_index=index, **settings)
    if egl.current() is None:
        native.release()
        raise Error(egl.REFUSED)
    binding = egl.current()
    loader = egl.EglContext(binding._replace(read=binding.draw), native.release)
    context = moderngl.create_context(context=loader, require=REQUIRED_GL)
    loader.gl.take_errors()  # of moderngl's queries
    context.extra = loader
    return context


def create_context(device: int | None = None) -> moderngl.Context:
    """Return a headless context of OpenGL 3.3 core or newer, current in this thread.

    Raises Error if there is no EGL or no such device, or the driver is too old.

    device : index of an EGL device, as `devices` lists them; None takes the one in the environment variable
        SONAR_GL_DEVICE, or else the first
    """
    release_waiting()
    index, setting = chosen_device(device)
    try:
        context = egl_context(index)
    except Error:
        raise
    except Exception as why:  # moderngl and glcontext raise plain Exception
        text = " ".join(str(why).split())
        if setting and "requested device index" in text:
            raise Error(no_device_message(setting)) from None
        version = re.search(r"got version (\d)(\d)\d", text)
        if version:
            raise Error(too_old_message(f"{version[1]}.{version[2]}")) from None
        if "eglCreateContext failed (0x3009)" in text:  # EGL_BAD_MATCH: the driver lacks the version
            raise Error(too_old_message("an older one")) from None
        if others := [str(one) for one in devices() if not one.trouble]:
            raise Error(
                f"OpenGL device {index or 0} must work (got: {text}); give --device or SONAR_GL_DEVICE one that does: "
                + ", ".join(others)
            ) from None
        raise Error(NO_EGL.format(why=text)) from None
    if context.version_code < REQUIRED_GL:
        code = context.version_code
        context.release()
        raise Error(too_old_message(f"{code // 100}.{code // 10 % 10}"))
    context.gc_mode = "context_gc"  # see `make_context`
    return context


def hardware_context() -> moderngl.Context | None:
    """Return a context of a graphics card, as `create_context` does; None if OpenGL is missing or in software."""
    try:
        context = create_context()
    except Error:
        return None
    if is_software(context.info["GL_RENDERER"]):
        context.release()
        return None
    return context


def too_old_message(got: str) -> str:
    return f"OpenGL must be 3.3 or newer (got {got}); update the driver, or ask for the engine 'cpu', which needs none"


def describe(context: moderngl.Context) -> dict:
    """Return the driver's names, its version, and the limits on the size of a ping's framebuffer."""
    info = context.info
    return {
        "renderer": info["GL_RENDERER"],
        "vendor": info["GL_VENDOR"],
        "version": info["GL_VERSION"],
        "max_texture_size": info["GL_MAX_TEXTURE_SIZE"],
        "max_renderbuffer_size": info["GL_MAX_RENDERBUFFER_SIZE"],
        "max_viewport": list(info["GL_MAX_VIEWPORT_DIMS"]),
        "max_color_attachments": info["GL_MAX_COLOR_ATTACHMENTS"],
    }


def is_software(renderer: str) -> bool:
    """Return whether OpenGL runs on the CPU, given the driver's GL_RENDERER, or SONAR_GL_SOFTWARE where it is set.

    On a CPU samples are read at once, and planes are what the driver interpolates.
    """
    setting = os.environ.get(SOFTWARE_VARIABLE, "").strip()
    if setting not in ("", "0", "1"):
        raise Error(f"{SOFTWARE_VARIABLE} must be 0 or 1, or not be set (got {setting!r})")
    return setting == "1" if setting else bool(SOFTWARE.search(renderer))
