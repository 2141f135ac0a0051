"""EGL: which context is current in a thread, and contexts of our own, current inside `with` blocks."""

from __future__ import annotations

import ctypes
import os
import secrets
from contextlib import contextmanager
from functools import cache
from typing import NamedTuple

from sonar_gl.core.collector import CollectorPause
from sonar_gl.core.errors import Error
from sonar_gl.gl.functions import Functions, one_object

# The sonames: libraries without a version in their name come with development packages only.
LIBRARIES = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
DRAW, READ, EXTENSIONS = 0x3059, 0x305A, 0x3055
BAD_ACCESS, BAD_CONTEXT = 0x3002, 0x3006  # BAD_ACCESS mostly means that a GLX context is current
SAMPLE_MASK_VALUE = 0x8E52  # the driver stores it bit for bit, and no framebuffer of ours is multisampled
NO_MARK = 0xFFFFFFFF  # the default, and so the value in contexts of others
GONE = (
    "the OpenGL context of this sonar must still be there (got EGL error 0x{error:04x}: its display was "
    "closed, as pyrender's delete() does); make the host's anew if it has one, and then the sonar"
)
REFUSED = (
    "no OpenGL context of GLX may be current where a sonar has one of EGL (got one in this thread); have the "
    "sonar join it by context='current', or make it not current first"
)
TAKEN = (
    "the sonar's OpenGL context must stay current while it draws (got {now}; a signal handler or a finaliser of "
    "another program has changed it, so have that restore what was current)"
)
LOST = (
    "the driver must keep the sonar's OpenGL context (got a lost one, as after a reset of the graphics card; make a "
    "new Simulator)"
)
FORKED = (
    "a process must make its OpenGL contexts where its parent had none before the fork (got a fork of a process with "
    "a context, whose driver's threads it lacks); start processes by multiprocessing.get_context('spawn'), or by "
    "DataLoader(..., multiprocessing_context='spawn')"
)
POINTER = ctypes.c_void_p
# The result first, then the arguments: p is a pointer, i an int, s a string.
SIGNATURES = {
    "BindAPI": "ii",
    "ChooseConfig": "ipppip",
    "CreateContext": "ppppp",
    "DestroyContext": "ipp",
    "GetCurrentContext": "p",
    "GetCurrentDisplay": "p",
    "GetCurrentSurface": "pi",
    "GetError": "i",
    "GetProcAddress": "ps",
    "MakeCurrent": "ipppp",
    "QueryAPI": "i",
    "QueryContext": "ippip",
    "QueryString": "spi",
}


@cache
def library() -> ctypes.CDLL | None:
    """Load libEGL and declare the signatures of its functions. Return None if it is not installed."""
    try:
        out = ctypes.CDLL(LIBRARIES["libegl"])
    except OSError:
        return None
    types = {"p": POINTER, "i": ctypes.c_int, "s": ctypes.c_char_p}
    for name, (result, *arguments) in SIGNATURES.items():
        function = getattr(out, f"egl{name}")
        function.restype, function.argtypes = types[result], [types[kind] for kind in arguments]
    return out


class Binding(NamedTuple):
    """The arguments of `eglMakeCurrent`, as addresses; None is EGL_NO_SURFACE or EGL_NO_CONTEXT."""

    display: int | None
    draw: int | None = None
    read: int | None = None
    context: int | None = None


def current() -> Binding | None:
    """Return the binding of the EGL context that is current in this thread, or None."""
    egl = library()
    context = egl.eglGetCurrentContext() if egl else None
    if not context:
        return None
    surfaces = egl.eglGetCurrentSurface(DRAW), egl.eglGetCurrentSurface(READ)
    return Binding(egl.eglGetCurrentDisplay(), *surfaces, context)


def make_current(binding: Binding) -> None:
    """Make a context current again, or none if it was destroyed meanwhile: ours must not stay current."""
    if not library().eglMakeCurrent(*binding) and (now := current()):
        library().eglMakeCurrent(*Binding(now.display))


@contextmanager
def preserve_current():
    """Restore, after the block, the EGL context that is current before it, or none.

    The garbage collector is paused inside the block, since finalisers of other programs may change what is current.
    """
    pause, before = CollectorPause(), current()
    try:
        yield
    finally:
        if before or (now := current()):
            make_current(before or Binding(now.display))
        pause.end()


class ProcessContexts:
    """Whether OpenGL was used in this process, and in one that it was forked from.

    Drivers keep threads and locks that a fork does not copy; a context made there would hang.
    """

    def __init__(self):
        self._is_used, self._was_used_before_fork = False, False

    def use(self) -> None:
        """Record that a context is about to be made; raise an Error if that would hang."""
        if self._was_used_before_fork:
            raise Error(FORKED)
        self._is_used = True

    def fork(self) -> None:
        """Note in a forked process what its parent did."""
        self._was_used_before_fork = self._is_used


process_contexts = ProcessContexts()
if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=process_contexts.fork)


class EglContext:
    """An EGL context of our own, current inside `with` blocks; the block restores what was current before.

    moderngl takes it for a window system: it needs `load_opengl_function`, `release` and the `with` block. The garbage
    collector is paused inside the block.

    binding : of the context, which is current now
    destroy : function that destroys the context
    """

    def __init__(self, binding: Binding, destroy):
        egl = self._egl = library()
        self.load_opengl_function = lambda name: one_object(egl.eglGetProcAddress(name.encode()) or 0)
        self.binding, self.destroy = binding, destroy
        self._before = []
        self.is_gone = False  # whether a `with` block has found that the context was destroyed by others
        self.gl, self._found = Functions(self.load_opengl_function), ctypes.c_uint()
        # A random mark tells this context from a later one at the same address.
        self.gl.glSampleMaski(0, secrets.randbelow(NO_MARK))
        self._mark = self._read_mark()

    def __enter__(self):
        pause, before = CollectorPause(), current() or Binding(self.binding.display)
        if not self._egl.eglMakeCurrent(*self.binding):
            error = self._egl.eglGetError()
            self.is_gone = error != BAD_ACCESS
            raise Error(GONE.format(error=error) if self.is_gone else REFUSED)
        if self._read_mark() != self._mark:  # another program's context has got the address
            make_current(before)
            self.is_gone = True
            raise Error(GONE.format(error=BAD_CONTEXT))
        self._before.append((before, pause))
        return self

    def __exit__(self, *_):
        try:
            now, is_marked = current(), self._read_mark() == self._mark
        finally:  # of an interrupt, too
            before, pause = self._before.pop()
            try:
                make_current(before)
            finally:
                pause.end()
        if is_marked:
            return
        if now is None or now.context != self.binding.context:
            raise Error(TAKEN.format(now="another one" if now else "none"))
        self.is_gone = True  # a lost context answers no query
        raise Error(LOST)

    def _read_mark(self) -> int:
        self._found.value = NO_MARK  # stays, if no context is current, or a lost one
        self.gl.glGetIntegeri_v(SAMPLE_MASK_VALUE, 0, ctypes.addressof(self._found))
        return self._found.value

    def is_in_reach(self) -> bool:
        """Return whether the context can be made current in this thread now."""
        try:
            with self:
                return True
        except Error:
            return False

    def release(self):
        if not self.is_gone:
            self.destroy()
