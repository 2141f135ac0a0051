"""OpenGL's functions through ctypes, for contexts of other programs. They act on the current context."""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

from sonar_gl.gl.enums import DRAW_FRAMEBUFFER, DRAW_FRAMEBUFFER_BINDING

# e: enum, object name or bit field; i: int; f: float; d: double; b: GLboolean; p: pointer; -: no result.
TYPES = {
    "e": ctypes.c_uint,
    "i": ctypes.c_int,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
    "b": ctypes.c_ubyte,
    "p": ctypes.c_void_p,
    "-": None,
}
# The result first, then the arguments.
SIGNATURES = {
    "glActiveTexture": "-e",
    "glBindBuffer": "-ee",
    "glBindFramebuffer": "-ee",
    "glBindRenderbuffer": "-ee",
    "glBindTexture": "-ee",
    "glBindVertexArray": "-e",
    "glBlendEquationSeparate": "-ee",
    "glBlendEquationSeparatei": "-eee",
    "glBlendEquationSeparateiARB": "-eee",
    "glBlendFuncSeparate": "-eeee",
    "glBlendFuncSeparatei": "-eeeee",
    "glBlendFuncSeparateiARB": "-eeeee",
    "glCheckFramebufferStatus": "ee",
    "glClampColor": "-ee",
    "glClear": "-e",
    "glClearBufferfv": "-eip",
    "glClearBufferuiv": "-eip",
    "glClearColor": "-ffff",
    "glClearDepth": "-d",
    "glClipControl": "-ee",
    "glColorMaski": "-ebbbb",
    "glCullFace": "-e",
    "glDeleteFramebuffers": "-ip",
    "glDeleteRenderbuffers": "-ip",
    "glDeleteSamplers": "-ip",
    "glDepthFunc": "-e",
    "glDepthMask": "-b",
    "glDepthRange": "-dd",
    "glDepthRangeIndexed": "-edd",
    "glDisable": "-e",
    "glDisablei": "-ee",
    "glDrawBuffers": "-ip",
    "glEnable": "-e",
    "glEnablei": "-ee",
    "glFramebufferRenderbuffer": "-eeee",
    "glFrontFace": "-e",
    "glGenFramebuffers": "-ip",
    "glGenRenderbuffers": "-ip",
    "glGenSamplers": "-ip",
    "glGetBooleani_v": "-eep",
    "glGetDoublei_v": "-eep",
    "glGetDoublev": "-ep",
    "glGetError": "e",
    "glGetFloati_v": "-eep",
    "glGetFloatv": "-ep",
    "glGetGraphicsResetStatus": "e",
    "glGetIntegeri_v": "-eep",
    "glGetIntegerv": "-ep",
    "glGetSamplerParameterIuiv": "-eep",
    "glGetString": "pe",
    "glGetStringi": "pee",
    "glGetTexImage": "-eieep",
    "glGetTexLevelParameteriv": "-eiep",
    "glIsBuffer": "be",
    "glIsEnabled": "be",
    "glIsEnabledi": "bee",
    "glIsFramebuffer": "be",
    "glIsProgram": "be",
    "glIsRenderbuffer": "be",
    "glIsSampler": "be",
    "glIsTexture": "be",
    "glIsVertexArray": "be",
    "glLineWidth": "-f",
    "glPixelStorei": "-ei",
    "glPixelTransferf": "-ef",
    "glPolygonMode": "-ee",
    "glPrimitiveRestartIndex": "-e",
    "glProvokingVertex": "-e",
    "glReadBuffer": "-e",
    "glReadPixels": "-iiiieep",
    "glRenderbufferStorage": "-eeii",
    "glSampleMaski": "-ee",
    "glSamplerParameterIuiv": "-eep",
    "glScissor": "-iiii",
    "glScissorIndexed": "-eiiii",
    "glUseProgram": "-e",
    "glViewport": "-iiii",
    "glViewportIndexedf": "-effff",
}
VERSION_STRING, RENDERER, MAJOR, MINOR = 0x1F02, 0x1F01, 0x821B, 0x821C
EXTENSIONS, NUM_EXTENSIONS = 0x1F03, 0x821D
COLOR_BUFFER_BIT = 0x4000
# The errors that can be raised on purpose; GL_OUT_OF_MEMORY cannot.
INVALID_ENUM, INVALID_VALUE, INVALID_OPERATION, INVALID_FRAMEBUFFER_OPERATION = 0x0500, 0x0501, 0x0502, 0x0506
NO_ENUM, NO_NAME = 0xFFFF, 0xFFFFFFF0  # no capability, and no object, has such a number


@cache
def one_object(address: int) -> int:
    """Return an address, the same object for equal ones.

    moderngl never lets go of the addresses that a context finds for it: each new context would leave 670 more.
    """
    return address


class Functions:
    """OpenGL's functions by name, each looked up when it is first called.

    address_of : function (name) -> address of an OpenGL function, 0 if the driver has none
    """

    def __init__(self, address_of):
        self._address_of = address_of

    def __getattr__(self, name: str):
        signature = SIGNATURES[name]
        function = ctypes.CFUNCTYPE(*(TYPES[kind] for kind in signature))(self._address_of(name))
        setattr(self, name, function)
        return function

    def text(self, name: int) -> str:
        """Return a string of `glGetString`."""
        return ctypes.string_at(self.glGetString(name)).decode(errors="replace")

    def version(self) -> int:
        """Return 330 for OpenGL 3.3, and so on; 0 for OpenGL ES, which is another interface."""
        if self.text(VERSION_STRING).startswith("OpenGL ES"):
            return 0
        return 100 * self.integer(MAJOR) + 10 * self.integer(MINOR)

    def extensions(self) -> set[str]:
        """Return the extensions that the driver lists, such as "GL_KHR_debug"."""
        indices = range(self.integer(NUM_EXTENSIONS))
        return {ctypes.string_at(self.glGetStringi(EXTENSIONS, k)).decode() for k in indices}

    def integer(self, name: int) -> int:
        """Return the one number that `glGetIntegerv` gives for a name."""
        return int(self.integers(name, 1)[0])

    def integers(self, name: int, count: int) -> np.ndarray:
        """Return (count,) int32 of `glGetIntegerv`; `count` must be all, or the rest overruns the array."""
        out = np.zeros(count, np.int32)
        self.glGetIntegerv(name, out.ctypes.data)
        return out

    def take_errors(self) -> list[int]:
        out = []
        while len(out) < 8 and (error := self.glGetError()):  # a lost context reports errors without end
            out.append(error)
        return out

    def restore_errors(self, errors) -> None:
        """Make errors pending again, by provoking each: the program that they belong to may still ask."""
        for error in errors:
            if error == INVALID_ENUM:
                self.glEnable(NO_ENUM)
            elif error == INVALID_VALUE:
                self.glLineWidth(-1.0)
            elif error == INVALID_OPERATION:
                self.glBindVertexArray(NO_NAME)
            elif error == INVALID_FRAMEBUFFER_OPERATION:
                bound, incomplete = self.integer(DRAW_FRAMEBUFFER_BINDING), np.zeros(1, np.uint32)
                self.glGenFramebuffers(1, incomplete.ctypes.data)
                self.glBindFramebuffer(DRAW_FRAMEBUFFER, int(incomplete[0]))
                self.glClear(COLOR_BUFFER_BIT)  # fails: the framebuffer has no attachments
                self.glBindFramebuffer(DRAW_FRAMEBUFFER, bound)
                self.glDeleteFramebuffers(1, incomplete.ctypes.data)
