"""The OpenGL context of another program: found where it is current, and joined.

Where the other one came by EGL, a context of our own joins its share group: its state is never touched.
Elsewhere (GLX) we draw in the other's own context, under a `Guard`.
"""

from __future__ import annotations

import ctypes
import os
import threading

import moderngl

from sonar_gl import egl
from sonar_gl.functions import RENDERER, Functions
from sonar_gl.gl import REQUIRED_GL, make_context
from sonar_gl.guard import Guard
from sonar_gl.types import Error

OPENGL_API, CONFIG_ID, NONE = 0x30A2, 0x3028, 0x3038
# EGL_CONTEXT_MAJOR_VERSION, ..._MINOR_VERSION and ..._OPENGL_PROFILE_MASK, its core bit
CORE_33 = 0x3098, 3, 0x30FB, 3, 0x30FD, 1, NONE
SURFACELESS = b"EGL_KHR_surfaceless_context"
NONE_CURRENT = (
    "an OpenGL context must be current in this thread, to be joined (got none in {thread!r}; make the host's "
    "current first)"
)
GONE = (
    "the OpenGL context that was joined must still be there (got another one that is current in its place); "
    "make a new sonar in that"
)
BORDER_COLOR = 0x1004  # of a sampler: as integers it is kept bit for bit, and none of ours has a border


def _glx():
    """libGL with the signatures of its GLX part, or None."""
    try:
        glx = ctypes.CDLL(egl.LIBRARIES["libgl"])
    except OSError:
        return None
    if not hasattr(glx, "glXGetCurrentContext"):
        return None
    glx.glXGetCurrentContext.restype = glx.glXGetProcAddressARB.restype = ctypes.c_void_p
    glx.glXGetProcAddressARB.argtypes = [ctypes.c_char_p]
    return glx


class Host:
    """The context that is current in this thread as this is made, which is another program's.

    Attributes
    ----------
    gl : Functions
    guard : Guard of its state
    renderer : what the driver calls itself

    Raises
    ------
    Error
        if there is none, or it is older than OpenGL 3.3 or of OpenGL ES.
    """

    def __init__(self):
        self.thread, self.by_egl = threading.current_thread(), egl.current() is not None
        library = egl.library() if self.by_egl else _glx()
        self._current = library and (
            library.eglGetCurrentContext if self.by_egl else library.glXGetCurrentContext
        )
        self.handle = self._current and self._current()
        if not self.handle:
            raise Error(NONE_CURRENT.format(thread=self.thread.name))
        address_of = library.eglGetProcAddress if self.by_egl else library.glXGetProcAddressARB
        self.address_of = lambda name: address_of(name.encode()) or 0
        self.gl = Functions(self.address_of)
        version = self.gl.version()
        if version < REQUIRED_GL:
            got = f"{version // 100}.{version // 10 % 10}" if version else "OpenGL ES"
            raise Error(
                f"the context to be joined must be of OpenGL 3.3 or newer (got {got}); ask the host for one"
            )
        self.guard, self.renderer = Guard(self.gl), self.gl.text(RENDERER)

    def check(self) -> None:
        """An Error in another thread, or where it is not current."""
        check_thread(self.thread)
        if self._current() != self.handle:
            raise Error(
                "the host's OpenGL context must be current when its sonar is used (got "
                f"{'another one' if self._current() else 'none'}); make it current first"
            )


def check_thread(thread) -> None:
    """An Error in another thread than this."""
    if (here := threading.current_thread()) is not thread:
        raise Error(
            "what joined a host's OpenGL context must be used in the thread where that was current (got "
            f"{here.name!r}, made in {thread.name!r}); hand pings to other threads, not the sonar"
        )


def make_guest(host: Host) -> egl.Private:
    """A context of our own in the share group of a host's, which came by EGL."""
    number, config, library = ctypes.c_int(0), ctypes.c_void_p(None), egl.library()
    display = library.eglGetCurrentDisplay()
    if SURFACELESS not in (library.eglQueryString(display, egl.EXTENSIONS) or b"").split():
        raise Error(
            f"EGL must have {SURFACELESS.decode()} (got a driver without); leave out context='current'"
        )
    library.eglQueryContext(display, host.handle, CONFIG_ID, ctypes.addressof(number))
    if number.value:  # else the host's was made without one
        wanted = (ctypes.c_int * 3)(CONFIG_ID, number.value, NONE)
        found = ctypes.addressof(config), 1, ctypes.addressof(number)
        library.eglChooseConfig(display, ctypes.addressof(wanted), *found)
    attributes, api = (ctypes.c_int * 7)(*CORE_33), library.eglQueryAPI()
    library.eglBindAPI(OPENGL_API)
    handle = library.eglCreateContext(display, config.value, host.handle, ctypes.addressof(attributes))
    error = library.eglGetError()
    library.eglBindAPI(api)
    refusal = "the host's OpenGL context must let another join it (got EGL error 0x{:04x})"
    if not handle:
        raise Error(refusal.format(error))
    with egl.kept():
        if not library.eglMakeCurrent(display, None, None, handle):
            raise Error(refusal.format(library.eglGetError()))
        return egl.Private(display, None, handle, lambda: library.eglDestroyContext(display, handle))


class Tenant:
    """A host's own context, guarded inside `with` blocks; it may stand for a window system with moderngl.

    Attributes
    ----------
    gl, guard, renderer : of `Host`
    is_gone : whether it has turned out to be there no more
    """

    def __init__(self, host: Host):
        self._host, self.load_opengl_function, self.is_gone = host, host.address_of, False
        self.gl, self.guard, self.renderer = host.gl, host.guard, host.renderer
        self._name = ctypes.c_uint(0)
        host.gl.glGenSamplers(1, ctypes.addressof(self._name))
        host.gl.glSamplerParameterIuiv(self._name.value, BORDER_COLOR, os.urandom(16))
        self._mark = self._read_mark()

    def check(self) -> None:
        """An Error in another thread, or where it is not current or is there no more."""
        self._host.check()
        if not self.gl.glIsSampler(self._name.value) or self._read_mark() != self._mark:
            self.is_gone = True  # a later one has its address
            raise Error(GONE)

    def _read_mark(self) -> bytes:
        found = (ctypes.c_ubyte * 16)()
        self.gl.glGetSamplerParameterIuiv(self._name.value, BORDER_COLOR, ctypes.addressof(found))
        return bytes(found)

    def check_thread(self) -> None:
        """An Error in another thread."""
        check_thread(self._host.thread)

    def is_in_reach(self) -> bool:
        """Whether it can be drawn in here and now."""
        try:
            self.check()
        except Error:
            return False
        return True

    def __enter__(self):
        self.check()
        self.guard.__enter__()
        return self

    def __exit__(self, *_):
        if self.is_in_reach():
            self.guard.__exit__()
        else:  # the block has made another one current, or has ended it
            self.guard.drop()

    def release(self):
        """Give back what marks it; the context is the host's."""
        if not self.is_gone:
            self.gl.glDeleteSamplers(1, ctypes.addressof(self._name))


def join() -> moderngl.Context:
    """A moderngl context that draws beside the host whose context is current."""
    host = Host()
    return make_context(make_guest(host) if host.by_egl else Tenant(host))
