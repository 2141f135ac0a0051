"""OpenGL's own functions, called in whatever context is current: for a context that another program made."""

from __future__ import annotations

import ctypes

import numpy as np

# e: enum, name or bits; i: int; f: float; d: double; b: bool; p: pointer. What is returned stands first.
KINDS = {
    "e": ctypes.c_uint,
    "i": ctypes.c_int,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
    "b": ctypes.c_ubyte,
    "p": ctypes.c_void_p,
    "-": None,
}
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
# an error can be made again, but not that memory ran out
ENUM, VALUE, OPERATION, FRAMEBUFFER_OPERATION = 0x0500, 0x0501, 0x0502, 0x0506
COLOR_BIT = 0x4000


class Functions:
    """OpenGL's functions by name, each looked up when first called.

    Parameters
    ----------
    address_of : function (name) -> address, 0 if there is none
    """

    def __init__(self, address_of):
        self._address_of = address_of

    def __getattr__(self, name: str):
        signature = SIGNATURES[name]
        made = ctypes.CFUNCTYPE(*(KINDS[kind] for kind in signature))(self._address_of(name))
        setattr(self, name, made)
        return made

    def text(self, what: int) -> str:
        """A string of `glGetString`."""
        return ctypes.string_at(self.glGetString(what)).decode(errors="replace")

    def version(self) -> int:
        """330 for OpenGL 3.3, 0 for OpenGL ES, which is something else."""
        if self.text(VERSION_STRING).startswith("OpenGL ES"):
            return 0
        return 100 * self.integer(MAJOR) + 10 * self.integer(MINOR)

    def extensions(self) -> set[str]:
        """What the driver lists, such as "GL_KHR_debug"."""
        listed = range(self.integer(NUM_EXTENSIONS))
        return {ctypes.string_at(self.glGetStringi(EXTENSIONS, k)).decode() for k in listed}

    def integer(self, what: int) -> int:
        """One number of `glGetIntegerv`, as it is unsigned."""
        return int(self.integers(what, 1)[0])

    def integers(self, what: int, count: int) -> np.ndarray:
        """(count,) int32 of `glGetIntegerv`; what gives more than `count` would be written past the end."""
        out = np.zeros(count, np.int32)
        self.glGetIntegerv(what, out.ctypes.data)
        return out

    def take_errors(self) -> list[int]:
        """The errors that are pending, which then are not."""
        out = []
        while len(out) < 8 and (error := self.glGetError()):  # a lost context has one without end
            out.append(error)
        return out

    def leave_errors(self, errors) -> None:
        """Have these pending again: whoever they are for will ask."""
        for error in errors:
            if error == ENUM:
                self.glEnable(0xFFFF)
            elif error == VALUE:
                self.glLineWidth(-1.0)
            elif error == OPERATION:
                self.glBindVertexArray(0xFFFFFFF0)  # nobody's name
            elif error == FRAMEBUFFER_OPERATION:
                bound, name = self.integer(0x8CA6), np.zeros(1, np.uint32)
                self.glGenFramebuffers(1, name.ctypes.data)
                self.glBindFramebuffer(0x8CA9, int(name[0]))
                self.glClear(COLOR_BIT)  # of what has no attachments
                self.glBindFramebuffer(0x8CA9, bound)
                self.glDeleteFramebuffers(1, name.ctypes.data)
