"""The state of an OpenGL context: remembered, set to OpenGL's own defaults, put back."""

from __future__ import annotations

import ctypes

from sonar_gl.functions import Functions
from sonar_gl.state import (
    DITHER,
    IS_THERE,
    MULTISAMPLE,
    OLD_SWITCHES,
    OLD_VALUES,
    SCALES,
    SINCE,
    SWITCHES,
    TRANSFERS,
    VALUES,
)

PROFILE_MASK, CORE, DEBUG_OUTPUT = 0x9126, 1, 0x92E0
POLYGON_MODE, FRONT, BACK, FRONT_AND_BACK, FILL = 0x0B40, 0x0404, 0x0405, 0x0408, 0x1B02
BLEND, SCISSOR_TEST = 0x0BE2, 0x0C11
BLEND_FUNCTIONS, BLEND_EQUATIONS = (0x80C9, 0x80C8, 0x80CB, 0x80CA), (0x8009, 0x883D)
ZERO, ONE, FUNC_ADD = 0, 1, 0x8006
COLOR_WRITEMASK, COLOR_CLEAR_VALUE, DEPTH_CLEAR_VALUE = 0x0C23, 0x0C22, 0x0B73
VIEWPORT, SCISSOR_BOX, DEPTH_RANGE = 0x0BA2, 0x0C10, 0x0B70
MAX_DRAW_BUFFERS, MAX_VIEWPORTS = 0x8824, 0x825B
CLIP_ORIGIN, CLIP_DEPTH_MODE, LOWER_LEFT, NEGATIVE_ONE_TO_ONE = 0x935C, 0x935D, 0x8CA1, 0x935E


class Guard:
    """Holds the state of the context that is current while a `with` block draws there, and puts it back.

    Inside the block all that bears on drawing and on the reading of pixels is as in a new context; bindings
    that do not bear on it stay. Errors that were pending are so again after it, and those of the block are
    not; a debug callback hears of none of either. Blocks may lie within one another.

    Put back is what is set here and what drawing with moderngl changes. The rest the block leaves alone:
    stencil functions, textures of other units and kinds, samplers, images, buffers bound by index, hints.

    What OpenGL lets nobody ask for is not held: queries and transform feedback that are under way. Nothing
    is bound where what was is there no more: it was deleted in the block, or before that, such as a program
    that was still in use, which OpenGL gives up as soon as another one is.
    """

    def __init__(self, gl: Functions):
        self.gl, version, listed = gl, gl.version(), gl.extensions()
        has = {"", *(name for name, since in SINCE.items() if version >= since or f"GL_{name}" in listed)}
        self._is_old = not gl.integer(PROFILE_MASK) & CORE
        self._values = [
            (what, getattr(gl, name), IS_THERE.get(name) and getattr(gl, IS_THERE[name]), first, default)
            for brought_by, what, name, first, default in VALUES + (OLD_VALUES if self._is_old else [])
            if brought_by in has
        ]
        self._switches = [cap for brought_by, caps in SWITCHES if brought_by in has for cap in caps]
        self._switches += OLD_SWITCHES if self._is_old else ()
        self._colours = range(gl.integer(MAX_DRAW_BUFFERS))
        self._viewports = range(gl.integer(MAX_VIEWPORTS)) if "ARB_viewport_array" in has else None
        self._blend = None  # what sets functions and equations of one colour
        if "ARB_draw_buffers_blend" in has:
            names = "glBlendFuncSeparatei", "glBlendEquationSeparatei"
            self._blend = [getattr(gl, name if version >= 400 else f"{name}ARB") for name in names]
        self._clips, self._tells = "ARB_clip_control" in has, "KHR_debug" in has
        self._room = (ctypes.c_double * 16)()  # for what is asked, of any kind
        self._at = ctypes.addressof(self._room)
        self._ints = ctypes.cast(self._at, ctypes.POINTER(ctypes.c_int))
        self._floats = ctypes.cast(self._at, ctypes.POINTER(ctypes.c_float))
        self._bools = ctypes.cast(self._at, ctypes.POINTER(ctypes.c_ubyte))
        self._held = []

    def __enter__(self):
        errors, tells = self.gl.take_errors(), self._tells and self.gl.glIsEnabled(DEBUG_OUTPUT)
        self._tell(False)
        state, old = self._read(), self._read_old()
        self.set_defaults()
        clears = self._read_clears()  # which would be read clamped before
        self._held.append((errors, tells, state, old, clears))
        self.gl.glClearColor(0.0, 0.0, 0.0, 0.0)
        self.gl.glClearDepth(1.0)
        return self

    def __exit__(self, *_):
        errors, tells, state, old, clears = self._held.pop()
        self._tell(False)
        self.gl.glClearColor(*clears[0])
        self.gl.glClearDepth(*clears[1])
        self._put_back(*state)
        self._put_back_old(*old)
        self.gl.take_errors()
        self.gl.leave_errors(errors)  # while nobody is told how they are made
        self._tell(tells)

    def _tell(self, whether):
        """Have the host's debug callback hear of what is done, or not."""
        if self._tells:
            (self.gl.glEnable if whether else self.gl.glDisable)(DEBUG_OUTPUT)

    def tell_errors(self):
        """Have a debug callback hear of errors, as it would without this block: the host itself draws now."""
        self._tell(self._held[-1][1])

    def keep_errors(self):
        """Have errors that are pending in this block be so after it: they are the host's own, until now."""
        self._tell(False)
        self._held[-1][0].extend(self.gl.take_errors())

    def drop(self):
        """End the block in a context that is gone: there is nothing to put back."""
        self._held.pop()

    def _integer(self, what: int) -> int:
        self.gl.glGetIntegerv(what, self._at)
        return self._ints[0]

    def _read(self):
        gl, at = self.gl, self._at
        values = [self._integer(what) for what, *_ in self._values]
        switches = [gl.glIsEnabled(cap) for cap in self._switches]
        blends, masks, functions = [], [], []
        for k in self._colours:
            blends.append(gl.glIsEnabledi(BLEND, k))
            gl.glGetBooleani_v(COLOR_WRITEMASK, k, at)
            masks.append(self._bools[0:4])
            if self._blend:
                row = []
                for what in (*BLEND_FUNCTIONS, *BLEND_EQUATIONS):
                    gl.glGetIntegeri_v(what, k, at)
                    row.append(self._ints[0])
                functions.append(row)
        if not self._blend:
            functions = [self._integer(what) for what in (*BLEND_FUNCTIONS, *BLEND_EQUATIONS)]
        clip = [self._integer(what) for what in (CLIP_ORIGIN, CLIP_DEPTH_MODE)] if self._clips else None
        return values, switches, blends, masks, functions, self._read_windows(), clip

    def _read_clears(self):
        out = []
        for what, count in ((COLOR_CLEAR_VALUE, 4), (DEPTH_CLEAR_VALUE, 1)):
            self.gl.glGetDoublev(what, self._at)
            out.append(self._room[0:count])
        return out

    def _read_old(self):
        """How front and back are filled, which differ in old profiles only, and how pixels change there."""
        self.gl.glGetIntegerv(POLYGON_MODE, self._at)
        modes, transfers = self._ints[0:2], []
        for what in TRANSFERS if self._is_old else ():
            self.gl.glGetFloatv(what, self._at)
            transfers.append(self._floats[0])
        return modes, transfers

    def _put_back_old(self, modes, transfers):
        if self._is_old:
            self.gl.glPolygonMode(FRONT, modes[0])
            self.gl.glPolygonMode(BACK, modes[1])
        else:
            self.gl.glPolygonMode(FRONT_AND_BACK, modes[0])
        for what, value in zip(TRANSFERS, transfers, strict=False):
            self.gl.glPixelTransferf(what, value)

    def _read_windows(self):
        """Viewport, scissor test and box, and depth range of each viewport."""
        gl, at, out = self.gl, self._at, []
        for k in self._viewports or ():
            gl.glGetFloati_v(VIEWPORT, k, at)
            viewport = self._floats[0:4]
            gl.glGetIntegeri_v(SCISSOR_BOX, k, at)
            box, test = self._ints[0:4], gl.glIsEnabledi(SCISSOR_TEST, k)
            gl.glGetDoublei_v(DEPTH_RANGE, k, at)
            out.append((viewport, test, box, self._room[0:2]))
        if self._viewports is None:
            gl.glGetIntegerv(VIEWPORT, at)
            viewport = self._ints[0:4]
            gl.glGetIntegerv(SCISSOR_BOX, at)
            box, test = self._ints[0:4], gl.glIsEnabled(SCISSOR_TEST)
            gl.glGetDoublev(DEPTH_RANGE, at)
            out.append((viewport, test, box, self._room[0:2]))
        return out

    def set_defaults(self):
        """Be as in a new context again, whatever the block has changed."""
        gl = self.gl
        for _, setter, _, first, default in self._values:
            if default is not None:
                setter(*first, default)
        for cap in self._switches:
            (gl.glEnable if cap in (MULTISAMPLE, DITHER) else gl.glDisable)(cap)
        for what in TRANSFERS if self._is_old else ():
            gl.glPixelTransferf(what, float(what in SCALES))
        gl.glPolygonMode(FRONT_AND_BACK, FILL)
        gl.glDisable(BLEND)
        gl.glBlendFuncSeparate(ONE, ZERO, ONE, ZERO)
        gl.glBlendEquationSeparate(FUNC_ADD, FUNC_ADD)
        gl.glDisable(SCISSOR_TEST)
        gl.glDepthRange(0.0, 1.0)
        for k in self._colours:
            gl.glColorMaski(k, 1, 1, 1, 1)
        if self._clips:
            gl.glClipControl(LOWER_LEFT, NEGATIVE_ONE_TO_ONE)

    def _put_back(self, values, switches, blends, masks, functions, windows, clip):
        gl = self.gl
        for (_, setter, is_there, first, _), value in zip(self._values, values, strict=True):
            setter(*first, value if is_there is None or is_there(value) else 0)
        for cap, on in zip(self._switches, switches, strict=True):
            (gl.glEnable if on else gl.glDisable)(cap)
        for k in self._colours:
            (gl.glEnablei if blends[k] else gl.glDisablei)(BLEND, k)
            gl.glColorMaski(k, *masks[k])
            if self._blend:
                self._blend[0](k, *functions[k][:4])
                self._blend[1](k, *functions[k][4:])
        if not self._blend:
            gl.glBlendFuncSeparate(*functions[:4])
            gl.glBlendEquationSeparate(*functions[4:])
        for k, (viewport, test, box, depths) in enumerate(windows):
            if self._viewports is None:
                gl.glViewport(*viewport)
                (gl.glEnable if test else gl.glDisable)(SCISSOR_TEST)
                gl.glScissor(*box)
                gl.glDepthRange(*depths)
                continue
            gl.glViewportIndexedf(k, *viewport)
            (gl.glEnablei if test else gl.glDisablei)(SCISSOR_TEST, k)
            gl.glScissorIndexed(k, *box)
            gl.glDepthRangeIndexed(k, *depths)
        if clip is not None:
            gl.glClipControl(*clip)
