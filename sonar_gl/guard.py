"""The state of an OpenGL context: remembered, set to OpenGL's own defaults, put back."""

from __future__ import annotations

import ctypes

from sonar_gl.functions import Functions

# What has one value: the version that brought it, how it is asked for, what sets it, the first argument of
# that, the default that we draw with, None where it does not bear on that.
VALUES = [
    (330, 0x88ED, "glBindBuffer", (0x88EB,), 0),  # PIXEL_PACK_BUFFER
    (330, 0x88EF, "glBindBuffer", (0x88EC,), 0),  # PIXEL_UNPACK_BUFFER
    (330, 0x8894, "glBindBuffer", (0x8892,), None),  # ARRAY_BUFFER
    (330, 0x8F36, "glBindBuffer", (0x8F36,), None),  # COPY_READ_BUFFER
    (330, 0x8F37, "glBindBuffer", (0x8F37,), None),  # COPY_WRITE_BUFFER
    (400, 0x8F43, "glBindBuffer", (0x8F3F,), None),  # DRAW_INDIRECT_BUFFER
    (330, 0x8CA6, "glBindFramebuffer", (0x8CA9,), None),  # DRAW_FRAMEBUFFER
    (330, 0x8CAA, "glBindFramebuffer", (0x8CA8,), None),  # READ_FRAMEBUFFER
    (330, 0x8CA7, "glBindRenderbuffer", (0x8D41,), None),
    (330, 0x85B5, "glBindVertexArray", (), None),
    (330, 0x8B8D, "glUseProgram", (), None),
    (330, 0x84E0, "glActiveTexture", (), None),
    (330, 0x8069, "glBindTexture", (0x0DE1,), None),  # TEXTURE_2D, of the unit that is active
    *(
        (330, 0x0CF0 + k, "glPixelStorei", (0x0CF0 + k,), 4 * (k == 5)) for k in range(6)
    ),  # UNPACK_..., ALIGNMENT
    (330, 0x806D, "glPixelStorei", (0x806D,), 0),  # UNPACK_SKIP_IMAGES
    (330, 0x806E, "glPixelStorei", (0x806E,), 0),  # UNPACK_IMAGE_HEIGHT
    *((330, 0x0D00 + k, "glPixelStorei", (0x0D00 + k,), 4 * (k == 5)) for k in range(6)),  # PACK_...
    (330, 0x806B, "glPixelStorei", (0x806B,), 0),  # PACK_SKIP_IMAGES
    (330, 0x806C, "glPixelStorei", (0x806C,), 0),  # PACK_IMAGE_HEIGHT
    (330, 0x891C, "glClampColor", (0x891C,), 0x891D),  # CLAMP_READ_COLOR: FIXED_ONLY
    (330, 0x0B74, "glDepthFunc", (), 0x0201),  # LESS
    (330, 0x0B72, "glDepthMask", (), 1),
    (330, 0x0B45, "glCullFace", (), 0x0405),  # BACK
    (330, 0x0B46, "glFrontFace", (), 0x0901),  # CCW
    (330, 0x8F9E, "glPrimitiveRestartIndex", (), None),
    (330, 0x8E4F, "glProvokingVertex", (), 0x8E4E),  # LAST_VERTEX_CONVENTION
]
# Switches that bear on what is drawn; all are off by default but MULTISAMPLE and DITHER.
MULTISAMPLE, DITHER = 0x809D, 0x0BD0
SWITCHES = [
    (
        330,
        (0x0B44, 0x0B71, 0x0B90, 0x0BF2, 0x0B20, 0x0B41),
    ),  # culling, depth, stencil, logic, smooth lines, areas
    (330, (0x2A01, 0x2A02, 0x8037, 0x8C89, 0x8642, 0x864F)),  # offsets, discard, point size, depth clamp
    (330, (MULTISAMPLE, 0x809E, 0x809F, 0x80A0, 0x8E51, DITHER)),  # samples: alpha to coverage, to one; masks
    (330, (0x8DB9, 0x8F9D, 0x884F, *range(0x3000, 0x3008))),  # sRGB, restart, seamless cubes, clip distances
    (400, (0x8C36,)),  # SAMPLE_SHADING
    (430, (0x8D69, 0x92E0)),  # PRIMITIVE_RESTART_FIXED_INDEX; DEBUG_OUTPUT, lest the host hear of us
]
# What only contexts of the compatibility profile have, and what of it bears on drawing and reading.
PROFILE_MASK, CORE = 0x9126, 1
OLD_VALUES = [(330, 0x891B, "glClampColor", (0x891B,), 0)]  # CLAMP_FRAGMENT_COLOR, clear values too
OLD_SWITCHES = 0x0BC0, 0x0B42  # ALPHA_TEST, POLYGON_STIPPLE
SCALES = 0x0D14, 0x0D18, 0x0D1A, 0x0D1C, 0x0D1E  # of RED to DEPTH as pixels are transferred
TRANSFERS = [0x0D10, 0x0D11, 0x0D12, 0x0D13, *SCALES, *(scale + 1 for scale in SCALES)]  # and biases, maps
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
    not. Blocks may lie within one another.

    Put back is what is set here and what drawing with moderngl changes. The rest the block leaves alone:
    stencil functions, textures of other units and kinds, samplers, images, buffers bound by index, hints.

    What OpenGL lets nobody ask for is not held: queries and transform feedback that are under way.
    """

    def __init__(self, gl: Functions):
        self.gl, self.version = gl, gl.version()
        self._is_old = not gl.integer(PROFILE_MASK) & CORE
        self._values = [
            (what, getattr(gl, name), first, default)
            for since, what, name, first, default in VALUES + (OLD_VALUES if self._is_old else [])
            if self.version >= since
        ]
        self._switches = [cap for since, caps in SWITCHES if self.version >= since for cap in caps]
        self._switches += OLD_SWITCHES if self._is_old else ()
        self._colours = range(gl.integer(MAX_DRAW_BUFFERS))
        self._viewports = range(gl.integer(MAX_VIEWPORTS)) if self.version >= 410 else None
        self._room = (ctypes.c_double * 16)()  # for what is asked, of any kind
        self._at = ctypes.addressof(self._room)
        self._ints = ctypes.cast(self._at, ctypes.POINTER(ctypes.c_int))
        self._floats = ctypes.cast(self._at, ctypes.POINTER(ctypes.c_float))
        self._bools = ctypes.cast(self._at, ctypes.POINTER(ctypes.c_ubyte))
        self._held = []

    def __enter__(self):
        errors, state, old = self.gl.take_errors(), self._read(), self._read_old()
        self.set_defaults()
        self._held.append((errors, state, old, self._read_clears()))  # those would be read clamped before
        self.gl.glClearColor(0.0, 0.0, 0.0, 0.0)
        self.gl.glClearDepth(1.0)
        return self

    def __exit__(self, *_):
        errors, state, old, clears = self._held.pop()
        self.gl.take_errors()
        self.gl.leave_errors(errors)  # while nobody is told how they are made
        self.gl.glClearColor(*clears[0])
        self.gl.glClearDepth(*clears[1])
        self._put_back(*state)
        self._put_back_old(*old)

    def keep_errors(self):
        """Have errors that are pending in this block be so after it: they are the host's own."""
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
            if self.version >= 400:
                row = []
                for what in (*BLEND_FUNCTIONS, *BLEND_EQUATIONS):
                    gl.glGetIntegeri_v(what, k, at)
                    row.append(self._ints[0])
                functions.append(row)
        if self.version < 400:
            functions = [self._integer(what) for what in (*BLEND_FUNCTIONS, *BLEND_EQUATIONS)]
        clip = (
            [self._integer(what) for what in (CLIP_ORIGIN, CLIP_DEPTH_MODE)] if self.version >= 450 else None
        )
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
        for _, setter, first, default in self._values:
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
        if self.version >= 450:
            gl.glClipControl(LOWER_LEFT, NEGATIVE_ONE_TO_ONE)

    def _put_back(self, values, switches, blends, masks, functions, windows, clip):
        gl = self.gl
        for (_, setter, first, _), value in zip(self._values, values, strict=True):
            setter(*first, value)
        for cap, on in zip(self._switches, switches, strict=True):
            (gl.glEnable if on else gl.glDisable)(cap)
        for k in self._colours:
            (gl.glEnablei if blends[k] else gl.glDisablei)(BLEND, k)
            gl.glColorMaski(k, *masks[k])
            if self.version >= 400:
                gl.glBlendFuncSeparatei(k, *functions[k][:4])
                gl.glBlendEquationSeparatei(k, *functions[k][4:])
        if self.version < 400:
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
