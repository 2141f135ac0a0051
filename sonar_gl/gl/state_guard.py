"""A guard that saves the OpenGL state of a host's context, sets OpenGL's defaults, and restores the state.

The tables list the state that affects drawing and reading pixels: how each part is read, which function sets
it, and its default.
"""

from __future__ import annotations

import ctypes
import math
from typing import NamedTuple

from sonar_gl.gl.enums import (
    CLIP_DISTANCE0,
    DEPTH_TEST,
    DRAW_FRAMEBUFFER,
    DRAW_FRAMEBUFFER_BINDING,
    RENDERBUFFER,
    TEXTURE_2D,
)
from sonar_gl.gl.functions import Functions

# The version of OpenGL that includes each extension. Drivers list many of them in older contexts, too.
CORE_SINCE = {
    "ARB_draw_buffers_blend": 400,
    "ARB_draw_indirect": 400,
    "ARB_sample_shading": 400,
    "ARB_viewport_array": 410,
    "ARB_ES3_compatibility": 430,
    "KHR_debug": 430,
    "ARB_clip_control": 450,
    "EXT_depth_bounds_test": math.inf,
    "MESA_pack_invert": math.inf,
}


class Value(NamedTuple):
    """A part of the state that has one value."""

    name: int  # enum that `glGetIntegerv` takes
    setter: str  # function that sets it
    target: tuple[int, ...] = ()  # the setter's arguments before the value
    # value inside the block; None leaves the host's, which does not affect drawing
    default: int | None = None
    extension: str = ""  # key of CORE_SINCE that it came with, "" for OpenGL 3.3


MULTISAMPLE, DITHER = 0x809D, 0x0BD0
# GL_{UNPACK,PACK}_: SWAP_BYTES, LSB_FIRST, ROW_LENGTH, SKIP_ROWS, SKIP_PIXELS, ALIGNMENT
UNPACK, PACK, ALIGNMENT = range(0x0CF0, 0x0CF6), range(0x0D00, 0x0D06), (0x0CF5, 0x0D05)

VALUES = [
    # bindings: those of buffers through which pixels pass are reset, the others stay the host's
    Value(0x88ED, "glBindBuffer", (0x88EB,), 0),  # PIXEL_PACK_BUFFER
    Value(0x88EF, "glBindBuffer", (0x88EC,), 0),  # PIXEL_UNPACK_BUFFER
    Value(0x8894, "glBindBuffer", (0x8892,)),  # ARRAY_BUFFER
    Value(0x8F36, "glBindBuffer", (0x8F36,)),  # COPY_READ_BUFFER
    Value(0x8F37, "glBindBuffer", (0x8F37,)),  # COPY_WRITE_BUFFER
    Value(0x8F43, "glBindBuffer", (0x8F3F,), extension="ARB_draw_indirect"),  # DRAW_INDIRECT_BUFFER
    Value(DRAW_FRAMEBUFFER_BINDING, "glBindFramebuffer", (DRAW_FRAMEBUFFER,)),
    Value(0x8CAA, "glBindFramebuffer", (0x8CA8,)),  # READ_FRAMEBUFFER
    Value(0x8CA7, "glBindRenderbuffer", (RENDERBUFFER,)),
    Value(0x85B5, "glBindVertexArray"),
    Value(0x8B8D, "glUseProgram"),
    Value(0x84E0, "glActiveTexture"),
    Value(0x8069, "glBindTexture", (TEXTURE_2D,)),  # of the active unit
    # how pixels lie in memory
    *(Value(name, "glPixelStorei", (name,), 4 if name in ALIGNMENT else 0) for name in UNPACK),
    Value(0x806D, "glPixelStorei", (0x806D,), 0),  # UNPACK_SKIP_IMAGES
    Value(0x806E, "glPixelStorei", (0x806E,), 0),  # UNPACK_IMAGE_HEIGHT
    *(Value(name, "glPixelStorei", (name,), 4 if name in ALIGNMENT else 0) for name in PACK),
    Value(0x806B, "glPixelStorei", (0x806B,), 0),  # PACK_SKIP_IMAGES
    Value(0x806C, "glPixelStorei", (0x806C,), 0),  # PACK_IMAGE_HEIGHT
    Value(0x8758, "glPixelStorei", (0x8758,), 0, "MESA_pack_invert"),  # PACK_INVERT: last row first
    # drawing
    Value(0x891C, "glClampColor", (0x891C,), 0x891D),  # CLAMP_READ_COLOR: FIXED_ONLY
    Value(0x0B74, "glDepthFunc", (), 0x0201),  # LESS
    Value(0x0B72, "glDepthMask", (), 1),
    Value(0x0B45, "glCullFace", (), 0x0405),  # BACK
    Value(0x0B46, "glFrontFace", (), 0x0901),  # CCW
    Value(0x8F9E, "glPrimitiveRestartIndex"),
    Value(0x8E4F, "glProvokingVertex", (), 0x8E4E),  # LAST_VERTEX_CONVENTION
]
# For each function that binds an object, the one that says whether the object still exists.
EXISTS = {
    "glBindBuffer": "glIsBuffer",
    "glBindFramebuffer": "glIsFramebuffer",
    "glBindRenderbuffer": "glIsRenderbuffer",
    "glBindTexture": "glIsTexture",
    "glBindVertexArray": "glIsVertexArray",
    "glUseProgram": "glIsProgram",
}
# by the extension that brought them, "" for OpenGL 3.3; all are off by default, except for MULTISAMPLE and DITHER
SWITCHES = {
    "": (
        *(0x0B44, DEPTH_TEST, 0x0B90),  # CULL_FACE, STENCIL_TEST
        *(0x0BF2, 0x0B20, 0x0B41),  # COLOR_LOGIC_OP, LINE_SMOOTH, POLYGON_SMOOTH
        *(0x2A01, 0x2A02, 0x8037),  # POLYGON_OFFSET_POINT, _LINE, _FILL
        *(0x8C89, 0x8642, 0x864F),  # RASTERIZER_DISCARD, PROGRAM_POINT_SIZE, DEPTH_CLAMP
        *(MULTISAMPLE, 0x809E, 0x809F),  # SAMPLE_ALPHA_TO_COVERAGE, SAMPLE_ALPHA_TO_ONE
        *(0x80A0, 0x8E51, DITHER),  # SAMPLE_COVERAGE, SAMPLE_MASK
        *(0x8DB9, 0x8F9D, 0x884F),  # FRAMEBUFFER_SRGB, PRIMITIVE_RESTART, TEXTURE_CUBE_MAP_SEAMLESS
        *range(CLIP_DISTANCE0, CLIP_DISTANCE0 + 8),
    ),
    "ARB_sample_shading": (0x8C36,),  # SAMPLE_SHADING
    "ARB_ES3_compatibility": (0x8D69,),  # PRIMITIVE_RESTART_FIXED_INDEX
    "EXT_depth_bounds_test": (0x8890,),  # DEPTH_BOUNDS_TEST
}
# Contexts of the compatibility profile have these, too; CLAMP_FRAGMENT_COLOR clamps clear values, too.
COMPATIBILITY_VALUES = [Value(0x891B, "glClampColor", (0x891B,), 0)]
COMPATIBILITY_SWITCHES = 0x0BC0, 0x0B42  # ALPHA_TEST, POLYGON_STIPPLE
# RED_SCALE, GREEN_, BLUE_, ALPHA_, DEPTH_; each + 1 is the bias
SCALES = (0x0D14, 0x0D18, 0x0D1A, 0x0D1C, 0x0D1E)
# glPixelTransfer: MAP_COLOR, MAP_STENCIL, INDEX_SHIFT, INDEX_OFFSET, scales, biases
PIXEL_TRANSFERS = [0x0D10, 0x0D11, 0x0D12, 0x0D13, *SCALES, *(scale + 1 for scale in SCALES)]

PROFILE_MASK, CORE_PROFILE_BIT, DEBUG_OUTPUT = 0x9126, 1, 0x92E0
POLYGON_MODE, FRONT, BACK, FRONT_AND_BACK, FILL = 0x0B40, 0x0404, 0x0405, 0x0408, 0x1B02
BLEND, SCISSOR_TEST = 0x0BE2, 0x0C11
# BLEND_SRC_RGB, _DST_RGB, _SRC_ALPHA, _DST_ALPHA; BLEND_EQUATION_RGB, _ALPHA
BLEND_FUNCTIONS, BLEND_EQUATIONS = (0x80C9, 0x80C8, 0x80CB, 0x80CA), (0x8009, 0x883D)
ZERO, ONE, FUNC_ADD = 0, 1, 0x8006
COLOR_WRITEMASK, COLOR_CLEAR_VALUE, DEPTH_CLEAR_VALUE = 0x0C23, 0x0C22, 0x0B73
VIEWPORT, SCISSOR_BOX, DEPTH_RANGE = 0x0BA2, 0x0C10, 0x0B70
MAX_DRAW_BUFFERS, MAX_VIEWPORTS = 0x8824, 0x825B
CLIP_ORIGIN, CLIP_DEPTH_MODE, LOWER_LEFT, NEGATIVE_ONE_TO_ONE = 0x935C, 0x935D, 0x8CA1, 0x935E


class Viewport(NamedTuple):
    """A viewport's rectangle, the scissor test and box that belong to it, and its range of depths."""

    rectangle: list[float]
    scissor_test: bool
    scissor_box: list[int]
    depth_range: list[float]


class SavedState(NamedTuple):
    """The state of a context."""

    # values, switches: as the guard's tables
    values: list[int]
    switches: list[bool]
    # blend_enabled, color_masks: for each draw buffer
    blend_enabled: list[bool]
    color_masks: list[list[int]]
    blend_functions: list  # four functions and two equations, for each draw buffer if the driver has them so
    viewports: list[Viewport]  # Viewport of each
    clip_control: list[int] | None  # origin and depth mode, or None
    polygon_modes: list[int]  # of front and back, which differ in compatibility profiles only
    pixel_transfers: list[float]  # as PIXEL_TRANSFERS, in compatibility profiles


class Block(NamedTuple):
    """A `with` block that is under way: what it restores at its end."""

    errors: list[int]  # that are pending for the host
    debug_output: bool  # whether the host's debug callback is on
    state: SavedState | None = None  # None until it is read
    # color and depth, read after the defaults are set, before which they would be clamped; None until then
    clear_values: tuple[list[float], list[float]] | None = None


class StateGuard:
    """Saves the state of the current context at the start of a `with` block, and restores it at the end.

    Inside the block, all state that affects drawing and reading pixels has OpenGL's defaults. Other bindings
    stay the host's. After the block, the errors that were pending before it are pending again, and errors of
    the block are cleared. The host's debug callback receives neither. Blocks may be nested.

    The guard restores the state that it sets itself and the state that drawing with moderngl changes. It does
    not touch the rest: stencil functions, textures of other units and targets, samplers, images, buffers bound
    by index, hints.

    OpenGL has no queries for some of its state: running queries and transform feedback are not saved. Objects
    that no longer exist are not bound again. The block deleted them, or the host did before: OpenGL deletes a
    program in use as soon as another program is used.
    """

    def __init__(self, gl: Functions):
        self.gl, version, listed = gl, gl.version(), gl.extensions()
        has = {
            "",
            *(name for name, since in CORE_SINCE.items() if version >= since or f"GL_{name}" in listed),
        }
        self._is_compatibility = not gl.integer(PROFILE_MASK) & CORE_PROFILE_BIT
        values = VALUES + (COMPATIBILITY_VALUES if self._is_compatibility else [])
        self._values = [value for value in values if value.extension in has]
        self._setters = [getattr(gl, value.setter) for value in self._values]
        self._exists = [
            getattr(gl, EXISTS[value.setter]) if value.setter in EXISTS else None for value in self._values
        ]
        self._switches = [
            one for name, capabilities in SWITCHES.items() if name in has for one in capabilities
        ]
        self._switches += COMPATIBILITY_SWITCHES if self._is_compatibility else ()
        self._draw_buffers = range(gl.integer(MAX_DRAW_BUFFERS))
        self._viewports = range(gl.integer(MAX_VIEWPORTS)) if "ARB_viewport_array" in has else None
        self._set_blending = None  # what sets functions and equations of one draw buffer
        if "ARB_draw_buffers_blend" in has:
            names = "glBlendFuncSeparatei", "glBlendEquationSeparatei"
            self._set_blending = [getattr(gl, name if version >= 400 else f"{name}ARB") for name in names]
        self._has_clip_control, self._has_debug = "ARB_clip_control" in has, "KHR_debug" in has
        # Memory for the answers of glGet..., and what it holds as each type of numbers
        self._doubles = (ctypes.c_double * 16)()
        self._address = ctypes.addressof(self._doubles)
        self._ints = ctypes.cast(self._address, ctypes.POINTER(ctypes.c_int))
        self._floats = ctypes.cast(self._address, ctypes.POINTER(ctypes.c_float))
        self._bytes = ctypes.cast(self._address, ctypes.POINTER(ctypes.c_ubyte))
        self._blocks: list[Block] = []

    def __enter__(self):
        block = Block([], self._has_debug and self.gl.glIsEnabled(DEBUG_OUTPUT))
        n_blocks = self.n_blocks
        try:
            block.errors.extend(self.gl.take_errors())
            self._set_debug_output(False)
            block = block._replace(state=self._save())
            self.set_defaults()
            block = block._replace(clear_values=self._read_clear_values())
            self.gl.glClearColor(0.0, 0.0, 0.0, 0.0)
            self.gl.glClearDepth(1.0)
            self._blocks.append(block)
            return self
        except BaseException:  # an interrupt; no __exit__ follows
            del self._blocks[n_blocks:]
            if block.state is None:  # what is pending is the host's
                block.errors.extend(self.gl.take_errors())
            self._end(block)
            raise

    def __exit__(self, *_):
        self.end_blocks(self.n_blocks - 1)

    @property
    def n_blocks(self) -> int:
        return len(self._blocks)

    def end_blocks(self, n_left: int) -> None:
        """End the innermost blocks, so that `n_left` remain. It may be repeated where it was interrupted."""
        while self.n_blocks > n_left:
            block = self._blocks[-1]
            try:
                self._end(block)
            except BaseException:  # an interrupt: restoring may be repeated
                self._end(block)
                self._blocks.pop()
                raise
            self._blocks.pop()

    def _end(self, block: Block) -> None:
        """Restore what a block has saved so far."""
        self._set_debug_output(False)
        if block.clear_values is not None:
            color, depth = block.clear_values
            self.gl.glClearColor(*color)
            self.gl.glClearDepth(*depth)
        if block.state is not None:
            self._restore(block.state)
        self.gl.take_errors()
        self.gl.restore_errors(block.errors)  # while the host's debug callback is off
        self._set_debug_output(block.debug_output)

    def abandon(self):
        """End the block without restoring anything, since its context is gone."""
        self._blocks.pop()

    def resume_debug_output(self):
        """Report errors to the host's debug callback as outside the block: from now on the host draws."""
        self._set_debug_output(self._blocks[-1].debug_output)

    def save_host_errors(self):
        """Keep the errors that are pending now for after the block: the host, which drew, caused them."""
        self._set_debug_output(False)
        self._blocks[-1].errors.extend(self.gl.take_errors())

    def _set_debug_output(self, is_on):
        if self._has_debug:
            (self.gl.glEnable if is_on else self.gl.glDisable)(DEBUG_OUTPUT)

    def set_defaults(self):
        """Set OpenGL's defaults again, whatever the block has changed."""
        gl = self.gl
        for value, setter in zip(self._values, self._setters, strict=True):
            if value.default is not None:
                setter(*value.target, value.default)
        for capability in self._switches:
            (gl.glEnable if capability in (MULTISAMPLE, DITHER) else gl.glDisable)(capability)
        for name in PIXEL_TRANSFERS if self._is_compatibility else ():
            gl.glPixelTransferf(name, float(name in SCALES))
        gl.glPolygonMode(FRONT_AND_BACK, FILL)
        gl.glDisable(BLEND)
        gl.glBlendFuncSeparate(ONE, ZERO, ONE, ZERO)
        gl.glBlendEquationSeparate(FUNC_ADD, FUNC_ADD)
        gl.glDisable(SCISSOR_TEST)
        gl.glDepthRange(0.0, 1.0)
        for k in self._draw_buffers:
            gl.glColorMaski(k, 1, 1, 1, 1)
        if self._has_clip_control:
            gl.glClipControl(LOWER_LEFT, NEGATIVE_ONE_TO_ONE)

    # ---- reading ----------------------------------------------------------------------------------------

    def _save(self) -> SavedState:
        gl, address = self.gl, self._address
        values = [self._integer(value.name) for value in self._values]
        switches = [gl.glIsEnabled(capability) for capability in self._switches]
        blend_enabled, color_masks, blend_functions = [], [], []
        for k in self._draw_buffers:
            blend_enabled.append(gl.glIsEnabledi(BLEND, k))
            gl.glGetBooleani_v(COLOR_WRITEMASK, k, address)
            color_masks.append(self._bytes[0:4])
            if self._set_blending:
                row = []
                for name in (*BLEND_FUNCTIONS, *BLEND_EQUATIONS):
                    gl.glGetIntegeri_v(name, k, address)
                    row.append(self._ints[0])
                blend_functions.append(row)
        if not self._set_blending:
            blend_functions = [self._integer(name) for name in (*BLEND_FUNCTIONS, *BLEND_EQUATIONS)]
        viewports, clip_control = self._read_viewports(), None
        if self._has_clip_control:
            clip_control = [self._integer(name) for name in (CLIP_ORIGIN, CLIP_DEPTH_MODE)]
        gl.glGetIntegerv(POLYGON_MODE, address)
        polygon_modes, pixel_transfers = self._ints[0:2], []
        for name in PIXEL_TRANSFERS if self._is_compatibility else ():
            gl.glGetFloatv(name, address)
            pixel_transfers.append(self._floats[0])
        blending = blend_enabled, color_masks, blend_functions
        return SavedState(
            values, switches, *blending, viewports, clip_control, polygon_modes, pixel_transfers
        )

    def _integer(self, name: int) -> int:
        self.gl.glGetIntegerv(name, self._address)
        return self._ints[0]

    def _read_viewports(self) -> list[Viewport]:
        gl, address, out = self.gl, self._address, []
        if self._viewports is None:
            gl.glGetIntegerv(VIEWPORT, address)
            rectangle = self._ints[0:4]
            gl.glGetIntegerv(SCISSOR_BOX, address)
            box, test = self._ints[0:4], gl.glIsEnabled(SCISSOR_TEST)
            gl.glGetDoublev(DEPTH_RANGE, address)
            return [Viewport(rectangle, test, box, self._doubles[0:2])]
        for k in self._viewports:
            gl.glGetFloati_v(VIEWPORT, k, address)
            rectangle = self._floats[0:4]
            gl.glGetIntegeri_v(SCISSOR_BOX, k, address)
            box, test = self._ints[0:4], gl.glIsEnabledi(SCISSOR_TEST, k)
            gl.glGetDoublei_v(DEPTH_RANGE, k, address)
            out.append(Viewport(rectangle, test, box, self._doubles[0:2]))
        return out

    def _read_clear_values(self):
        out = []
        for name, count in ((COLOR_CLEAR_VALUE, 4), (DEPTH_CLEAR_VALUE, 1)):
            self.gl.glGetDoublev(name, self._address)
            out.append(self._doubles[0:count])
        return tuple(out)

    # ---- restoring --------------------------------------------------------------------------------------

    def _restore(self, state: SavedState):
        gl = self.gl
        rows = zip(self._values, self._setters, self._exists, state.values, strict=True)
        for value, setter, exists, saved in rows:
            setter(*value.target, saved if exists is None or exists(saved) else 0)
        for capability, is_on in zip(self._switches, state.switches, strict=True):
            (gl.glEnable if is_on else gl.glDisable)(capability)
        for k in self._draw_buffers:
            (gl.glEnablei if state.blend_enabled[k] else gl.glDisablei)(BLEND, k)
            gl.glColorMaski(k, *state.color_masks[k])
            if self._set_blending:
                self._set_blending[0](k, *state.blend_functions[k][:4])
                self._set_blending[1](k, *state.blend_functions[k][4:])
        if not self._set_blending:
            gl.glBlendFuncSeparate(*state.blend_functions[:4])
            gl.glBlendEquationSeparate(*state.blend_functions[4:])
        self._restore_viewports(state.viewports)
        if state.clip_control is not None:
            gl.glClipControl(*state.clip_control)
        if self._is_compatibility:
            gl.glPolygonMode(FRONT, state.polygon_modes[0])
            gl.glPolygonMode(BACK, state.polygon_modes[1])
        else:
            gl.glPolygonMode(FRONT_AND_BACK, state.polygon_modes[0])
        for name, saved in zip(PIXEL_TRANSFERS, state.pixel_transfers, strict=False):  # none in core profiles
            gl.glPixelTransferf(name, saved)

    def _restore_viewports(self, viewports: list[Viewport]):
        gl = self.gl
        if self._viewports is None:
            (one,) = viewports
            gl.glViewport(*one.rectangle)
            (gl.glEnable if one.scissor_test else gl.glDisable)(SCISSOR_TEST)
            gl.glScissor(*one.scissor_box)
            gl.glDepthRange(*one.depth_range)
            return
        for k, one in enumerate(viewports):
            gl.glViewportIndexedf(k, *one.rectangle)
            (gl.glEnablei if one.scissor_test else gl.glDisablei)(SCISSOR_TEST, k)
            gl.glScissorIndexed(k, *one.scissor_box)
            gl.glDepthRangeIndexed(k, *one.depth_range)
