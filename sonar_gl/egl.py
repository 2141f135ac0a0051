"""EGL: which context is current in a thread, and having it be so again."""

from __future__ import annotations

import ctypes
from contextlib import contextmanager
from functools import cache

# by their sonames: the unversioned ones come with development packages only
LIBRARIES = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
DRAW, READ, EXTENSIONS = 0x3059, 0x305A, 0x3055
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


@contextmanager
def kept():
    """Have what is current before the block current after it: contexts of glcontext leave none."""
    was = current()
    try:
        yield
    finally:
        if was is not None:
            library().eglMakeCurrent(*was)
