"""OpenGL without a window: contexts, devices, what the driver says of itself."""

from __future__ import annotations

import ctypes
import os
import re
from collections import deque
from contextlib import contextmanager
from threading import Lock
from typing import NamedTuple

import glcontext.egl
import moderngl

from sonar_gl import egl
from sonar_gl.egl import LIBRARIES
from sonar_gl.types import Error

REQUIRED_GL = 330
DEVICE_VARIABLES = ("SONAR_GL_DEVICE", "GLCONTEXT_DEVICE_INDEX")  # ours, and that of the library below
EGL_DRM_DEVICE_FILE_EXT, EGL_RENDERER_EXT = 0x3233, 0x335F  # for eglQueryDeviceStringEXT
NO_EGL = (
    "OpenGL must be reachable through EGL, without a display (got: {why}); on Debian or Ubuntu install it "
    "with 'apt-get install libegl1 libgl1', in a container with a GPU let the driver's EGL library in"
)

_discarded: deque[moderngl.Context] = deque()
# What could not be released. One whose host is gone is not to be told from one whose host is not current,
# and each is tried again with each ping: the oldest are given up.
_out_of_reach: deque[moderngl.Context] = deque(maxlen=16)
_releasing = Lock()


def discard(context: moderngl.Context) -> None:
    """Have a context released later, when nobody is drawing.

    For finalisers: the garbage collector may call them in the midst of another context's drawing.
    """
    _discarded.append(context)


def release(context: moderngl.Context) -> None:
    """Give a context back with all that is in it and that nobody holds; later, if it is out of reach."""
    try:
        with context:
            context.fbo = None  # the last one drawn into, that else would be held
            context.gc()  # in a host's share group objects would outlive it
    except Error:
        if not context.extra.is_gone:
            _out_of_reach.append(context)
            return
    context.release()


def release_discarded() -> None:
    """Release what was discarded and is in reach; not to be called inside a `with context` block."""
    with _releasing:
        for waiting in (_out_of_reach, _discarded):
            for _ in range(len(waiting)):
                release(waiting.popleft())


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
        known = (ask(device, egl.EXTENSIONS) or b"").split()
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
    with egl.kept():
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


@contextmanager
def _its_own_default():
    """Leave moderngl's default context, which a host may use, as it is: making one makes it that."""
    was = moderngl._store.default_context
    try:
        yield
    finally:
        moderngl._store.default_context = was


def make_context(loader) -> moderngl.Context:
    """A moderngl context in what `loader` makes current in `with` blocks."""
    with loader, _its_own_default():
        context = moderngl.create_context(context=loader, require=REQUIRED_GL)
    context.gc_mode, context.extra = "context_gc", loader  # the mode as in `create_context`
    return context


@_its_own_default()
def _create(index: int | None) -> moderngl.Context:
    how = {"mode": "standalone", "glversion": REQUIRED_GL, **LIBRARIES}
    if index is None:  # whatever glcontext takes of itself
        made = glcontext.get_backend_by_name("egl")(**how)
    else:  # beneath the layer where variables would win over an index
        made = glcontext.egl.create_context(device_index=index, **how)
    if egl.current() is None:
        made.release()
        raise Error(egl.REFUSED)
    display, surface, _, handle = egl.current()
    loader = egl.Private(display, surface, handle, made.release)
    context = moderngl.create_context(context=loader, require=REQUIRED_GL)
    context.extra = loader
    return context


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
    except Error:
        raise
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
