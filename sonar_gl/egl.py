"""EGL: which context is current in a thread, and having it be so again."""

from __future__ import annotations

import ctypes
import secrets
from contextlib import contextmanager
from functools import cache

from sonar_gl.functions import Functions
from sonar_gl.types import Error

# by their sonames: the unversioned ones come with development packages only
LIBRARIES = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
DRAW, READ, EXTENSIONS = 0x3059, 0x305A, 0x3055
BAD_ACCESS, BAD_CONTEXT = 0x3002, 0x3006  # the former most often because a context of GLX is current
SAMPLE_MASK_VALUE = 0x8E52  # kept bit for bit, and none of ours has several samples
GONE = (
    "the OpenGL context of this sonar must still be there (got EGL error 0x{error:04x}: its display was "
    "closed, as pyrender's delete() does); make the host's anew if it has one, and then the sonar"
)
REFUSED = (
    "no OpenGL context of GLX may be current where a sonar has one of EGL (got one in this thread); have the "
    "sonar join it by context='current', or make it not current first"
)
POINTER = ctypes.c_void_p
# what is returned and what is taken: p a pointer, i an int, s a text
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
    """libEGL with its signatures, or None where there is none."""
    try:
        out = ctypes.CDLL(LIBRARIES["libegl"])
    except OSError:
        return None
    kinds = {"p": POINTER, "i": ctypes.c_int, "s": ctypes.c_char_p}
    for name, (returned, *taken) in SIGNATURES.items():
        function = getattr(out, f"egl{name}")
        function.restype, function.argtypes = kinds[returned], [kinds[kind] for kind in taken]
    return out


def current() -> tuple | None:
    """Display, surfaces and context that are current in this thread, or None."""
    egl = library()
    context = egl.eglGetCurrentContext() if egl else None
    if not context:
        return None
    surfaces = egl.eglGetCurrentSurface(DRAW), egl.eglGetCurrentSurface(READ)
    return egl.eglGetCurrentDisplay(), *surfaces, context


class Private:
    """A context of ours, current inside `with` blocks; what was current before one is so after it.

    It is what moderngl takes for a window system.

    Parameters
    ----------
    display, surface, handle : of EGL; it is current now
    destroy : function that gives it back

    Attributes
    ----------
    is_gone : whether it has turned out to be there no more
    """

    def __init__(self, display, surface, handle, destroy):
        egl = self._egl = library()
        self.load_opengl_function = lambda name: egl.eglGetProcAddress(name.encode()) or 0
        self.display, self._ours, self._destroy = display, (display, surface, surface, handle), destroy
        self._before, self.is_gone = [], False
        self._gl, self._found = Functions(self.load_opengl_function), ctypes.c_uint()
        self._gl.glSampleMaski(0, secrets.randbelow(0xFFFFFFFF))  # not all ones, as in contexts of others
        self._mark = self._read_mark()

    def __enter__(self):
        before = current() or (self.display, None, None, None)
        if not self._egl.eglMakeCurrent(*self._ours):
            error = self._egl.eglGetError()
            self.is_gone = error != BAD_ACCESS
            raise Error(GONE.format(error=error) if self.is_gone else REFUSED)
        if self._read_mark() != self._mark:  # a later one of somebody else has its address
            make_current(before)
            self.is_gone = True
            raise Error(GONE.format(error=BAD_CONTEXT))
        self._before.append(before)
        return self

    def __exit__(self, *_):
        make_current(self._before.pop())

    def _read_mark(self) -> int:
        self._gl.glGetIntegeri_v(SAMPLE_MASK_VALUE, 0, ctypes.addressof(self._found))
        return self._found.value

    def release(self):
        """Give the context back, if it is there."""
        if not self.is_gone:
            self._destroy()


@contextmanager
def kept():
    """Have what is current before the block current after it, be it none."""
    was = current()
    try:
        yield
    finally:
        if was or (now := current()):
            make_current(was or (now[0], None, None, None))


def make_current(was: tuple) -> None:
    """Have again what `current` gave, or nothing, if that was ended meanwhile: ours must not stay instead."""
    if not library().eglMakeCurrent(*was) and (now := current()):
        library().eglMakeCurrent(now[0], None, None, None)
