"""The OpenGL context of a host, which is the program that a sonar is embedded in.

A host's context is found where it is current. On EGL the sonar gets a context of its own that shares the
host's objects, so that the host's state is never touched. On GLX it draws in the host's own context, under a
`StateGuard`.
"""

from __future__ import annotations

import ctypes
import os
import threading

import moderngl

from sonar_gl.core.collector import CollectorPause
from sonar_gl.core.errors import Error
from sonar_gl.gl import egl
from sonar_gl.gl.context import REQUIRED_GL, make_context
from sonar_gl.gl.functions import RENDERER, Functions, one_object
from sonar_gl.gl.state_guard import StateGuard

OPENGL_API, CONFIG_ID, NONE = 0x30A2, 0x3028, 0x3038
# EGL_CONTEXT_MAJOR_VERSION 3, EGL_CONTEXT_MINOR_VERSION 3, EGL_CONTEXT_OPENGL_PROFILE_MASK: core
CORE_33 = 0x3098, 3, 0x30FB, 3, 0x30FD, 1
# EGL_CONTEXT_OPENGL_RESET_NOTIFICATION_STRATEGY: EGL_LOSE_CONTEXT_ON_RESET; EGL_CONTEXT_OPENGL_NO_ERROR_KHR: EGL_TRUE.
# A driver that made such a context for a host knows them.
LOST_ON_RESET, WITHOUT_ERRORS = (0x31BD, 0x31BF), (0x31B3, 1)
# names and values of OpenGL that tell of a context made so
CONTEXT_FLAGS, NO_ERROR_BIT = 0x821E, 8
RESET_NOTIFICATION_STRATEGY, LOSE_CONTEXT_ON_RESET = 0x8256, 0x8252
ROBUSTNESS = {"GL_ARB_robustness", "GL_KHR_robustness"}  # part of OpenGL 4.5
SURFACELESS = b"EGL_KHR_surfaceless_context"
NONE_CURRENT = (
    "an OpenGL context must be current in this thread, to be joined (got none in {thread!r}; make the host's "
    "current first)"
)
GONE = (
    "the OpenGL context that was joined must still be there (got another one that is current in its place); "
    "make a new sonar in that"
)
DESTROYED = (
    "an OpenGL context must be current in this thread, to be joined (got one that was destroyed, or whose display was "
    "closed, as pyrender's delete() does; make a new one current first)"
)
REFUSED = (
    "the driver must make an OpenGL context that shares the host's objects (got EGL error 0x{:04x}; 0x3009 means that "
    "the host's has attributes that ours lacks; make it with version and profile alone, or leave out context='current')"
)
BORDER_COLOR = 0x1004  # a sampler stores it as integers bit for bit, and no texture of ours has a border


def _glx_library():
    """Load libGL and declare the signatures of its GLX functions. Return None if there are none."""
    try:
        glx = ctypes.CDLL(egl.LIBRARIES["libgl"])
    except OSError:
        return None
    if not hasattr(glx, "glXGetCurrentContext"):
        return None
    glx.glXGetCurrentContext.restype = glx.glXGetProcAddressARB.restype = ctypes.c_void_p
    glx.glXGetProcAddressARB.argtypes = [ctypes.c_char_p]
    return glx


def check_thread(thread) -> None:
    """Raise an Error if `thread` is not the current thread."""
    if (here := threading.current_thread()) is not thread:
        raise Error(
            "what joined a host's OpenGL context must be used in the thread where that was current (got "
            f"{here.name!r}, made in {thread.name!r}); hand pings to other threads, not the sonar"
        )


class CurrentContext:
    """The OpenGL context that is current in this thread when this object is made; another program made it.

    Raises Error if no context is current, or it is older than OpenGL 3.3, or it is one of OpenGL ES.

    by_egl : whether it is an EGL context; else it is one of GLX
    handle : address of the EGLContext or GLXContext
    thread : where it is current
    address_of : function (name) -> address of an OpenGL function, or 0
    """

    def __init__(self):
        self.thread, self.by_egl = threading.current_thread(), egl.current() is not None
        library = egl.library() if self.by_egl else _glx_library()
        self._get_current = library and (
            library.eglGetCurrentContext if self.by_egl else library.glXGetCurrentContext
        )
        self.handle = self._get_current and self._get_current()
        if not self.handle:
            raise Error(NONE_CURRENT.format(thread=self.thread.name))
        egl.process_contexts.use()
        get_address = library.eglGetProcAddress if self.by_egl else library.glXGetProcAddressARB
        self.address_of = lambda name: get_address(name.encode()) or 0
        self.gl = Functions(self.address_of)
        version = self.gl.version()
        if version < REQUIRED_GL:
            got = f"{version // 100}.{version // 10 % 10}" if version else "OpenGL ES"
            raise Error(
                f"the context to be joined must be of OpenGL 3.3 or newer (got {got}); ask the host for one"
            )
        self.renderer = self.gl.text(RENDERER)

    def check(self) -> None:
        """Raise an Error if this is another thread, or the context is not current."""
        check_thread(self.thread)
        if (now := self._get_current()) != self.handle:
            raise Error(
                "the host's OpenGL context must be current when its sonar is used (got "
                f"{'another one' if now else 'none'}); make it current first"
            )


class HostContext:
    """A host's own context. A `with` block draws in it with OpenGL's default state, and restores the host's.

    The garbage collector is paused inside the block.

    moderngl takes it for a window system: it needs `load_opengl_function`, `release` and the `with` block.

    """

    def __init__(self, current: CurrentContext):
        self.current = current
        self.is_gone = False  # whether a check has found that the context was destroyed
        self.load_opengl_function = lambda name: one_object(current.address_of(name))
        self.gl, self.renderer, self.guard = current.gl, current.renderer, StateGuard(current.gl)
        # A sampler with a random border colour tells this context from a later one at the same address.
        self._sampler = ctypes.c_uint(0)
        self.gl.glGenSamplers(1, ctypes.addressof(self._sampler))
        self.gl.glSamplerParameterIuiv(self._sampler.value, BORDER_COLOR, os.urandom(16))
        self._mark, self._pauses = self._read_mark(), []

    def _read_mark(self) -> bytes:
        found = (ctypes.c_ubyte * 16)()
        self.gl.glGetSamplerParameterIuiv(self._sampler.value, BORDER_COLOR, ctypes.addressof(found))
        return bytes(found)

    def check(self) -> None:
        """Raise an Error if this is another thread, or the context is not current, or it was destroyed."""
        self.current.check()
        if not self.gl.glIsSampler(self._sampler.value) or self._read_mark() != self._mark:
            self.is_gone = True  # a later context has its address
            raise Error(GONE)

    def check_thread(self) -> None:
        """Raise an Error if this is another thread than that of the context."""
        check_thread(self.current.thread)

    def is_in_reach(self) -> bool:
        """Return whether the context is current in this thread now."""
        try:
            self.check()
        except Error:
            return False
        return True

    def __enter__(self):
        pause = CollectorPause()
        self.check()
        n_blocks = len(self._pauses)
        self._pauses.append(pause)  # before the guard is entered: `leave` may follow at once
        try:
            self.guard.__enter__()
            return self
        except BaseException:
            self.end_blocks(n_blocks)
            raise

    def end_blocks(self, n_left: int) -> None:
        """End the innermost blocks, so that `n_left` remain, after an interrupt; the context must be in reach."""
        self.guard.end_blocks(n_left)
        while len(self._pauses) > n_left:
            self._pauses.pop().end()

    def leave(self) -> bool:
        """End the block; return whether the context was still there, so that its state was restored."""
        pause = self._pauses.pop()
        try:
            is_in_reach = self.is_in_reach()
            if is_in_reach:
                self.guard.__exit__()
            else:  # the block has made another context current, or has destroyed this one
                self.guard.abandon()
        finally:
            pause.end()
        return is_in_reach

    def __exit__(self, *_):
        if not self.leave():
            self.check()  # raises the Error that says why

    def release(self):
        """Delete the sampler that marks the context; the context is the host's."""
        if not self.is_gone:
            self.gl.glDeleteSamplers(1, ctypes.addressof(self._sampler))


def _attributes_to_share(gl: Functions) -> tuple[int, ...]:
    """Return what EGL demands of both contexts that share objects, as attributes of the one that is current."""
    out = ()
    if gl.version() >= 450 or gl.extensions() & ROBUSTNESS:
        lost = gl.integer(RESET_NOTIFICATION_STRATEGY) == LOSE_CONTEXT_ON_RESET
        out += LOST_ON_RESET if lost else ()
    return out + (WITHOUT_ERRORS if gl.integer(CONTEXT_FLAGS) & NO_ERROR_BIT else ())


def make_shared_context(host: CurrentContext) -> egl.EglContext:
    """Return an EGL context of our own that shares the objects of a host's EGL context."""
    number, config, library = ctypes.c_int(0), ctypes.c_void_p(None), egl.library()
    display = library.eglGetCurrentDisplay()
    if not library.eglQueryContext(display, host.handle, CONFIG_ID, ctypes.addressof(number)):
        raise Error(DESTROYED)  # it is current until another one is
    if SURFACELESS not in (library.eglQueryString(display, egl.EXTENSIONS) or b"").split():
        raise Error(
            f"EGL must have {SURFACELESS.decode()} (got a driver without); leave out context='current'"
        )
    if number.value:  # 0: the host's context was made without a config
        wanted = (ctypes.c_int * 3)(CONFIG_ID, number.value, NONE)
        found = ctypes.addressof(config), 1, ctypes.addressof(number)
        library.eglChooseConfig(display, ctypes.addressof(wanted), *found)
    wanted = *CORE_33, *_attributes_to_share(host.gl), NONE
    attributes, api = (ctypes.c_int * len(wanted))(*wanted), library.eglQueryAPI()
    library.eglBindAPI(OPENGL_API)
    handle = library.eglCreateContext(display, config.value, host.handle, ctypes.addressof(attributes))
    error = library.eglGetError()
    library.eglBindAPI(api)
    if not handle:
        raise Error(REFUSED.format(error))
    binding = egl.Binding(display, context=handle)
    with egl.preserve_current():
        if not library.eglMakeCurrent(*binding):
            raise Error(REFUSED.format(library.eglGetError()))
        return egl.EglContext(binding, lambda: library.eglDestroyContext(display, handle))


def join() -> moderngl.Context:
    """Return a moderngl context that draws beside the host whose context is current in this thread."""
    host = CurrentContext()
    return make_context(make_shared_context(host) if host.by_egl else HostContext(host))
