"""All state of an OpenGL context that matters to a host, read and set without the code of the package."""

import ctypes
from functools import cache

import numpy as np
from OpenGL import GL as NAMES

LATER = {  # newer than PyOpenGL
    "CLIP_ORIGIN": 0x935C,
    "CLIP_DEPTH_MODE": 0x935D,
    "ZERO_TO_ONE": 0x935F,
    "PACK_INVERT_MESA": 0x8758,
}
# The version of OpenGL that includes each extension. Drivers list many of them in older contexts, too.
SINCE = {
    "ARB_draw_buffers_blend": 400,
    "ARB_draw_indirect": 400,
    "ARB_sample_shading": 400,
    "ARB_tessellation_shader": 400,
    "ARB_texture_cube_map_array": 400,
    "ARB_transform_feedback2": 400,
    "ARB_separate_shader_objects": 410,
    "ARB_viewport_array": 410,
    "ARB_compressed_texture_pixel_storage": 420,
    "ARB_shader_atomic_counters": 420,
    "ARB_shader_image_load_store": 420,
    "ARB_ES3_compatibility": 430,
    "ARB_compute_shader": 430,
    "ARB_shader_storage_buffer_object": 430,
    "KHR_debug": 430,
    "ARB_query_buffer_object": 440,
    "ARB_clip_control": 450,
    "MESA_pack_invert": 999,
}

SINGLE = {  # values without an index, by extension, "" for OpenGL 3.3
    "": """DRAW_FRAMEBUFFER_BINDING READ_FRAMEBUFFER_BINDING RENDERBUFFER_BINDING VERTEX_ARRAY_BINDING
        ARRAY_BUFFER_BINDING COPY_READ_BUFFER COPY_WRITE_BUFFER ELEMENT_ARRAY_BUFFER_BINDING
        PIXEL_PACK_BUFFER_BINDING PIXEL_UNPACK_BUFFER_BINDING UNIFORM_BUFFER_BINDING
        TRANSFORM_FEEDBACK_BUFFER_BINDING CURRENT_PROGRAM ACTIVE_TEXTURE
        BLEND_COLOR BLEND_SRC_RGB BLEND_DST_RGB BLEND_SRC_ALPHA BLEND_DST_ALPHA BLEND_EQUATION_RGB
        BLEND_EQUATION_ALPHA LOGIC_OP_MODE COLOR_WRITEMASK COLOR_CLEAR_VALUE
        DEPTH_FUNC DEPTH_WRITEMASK DEPTH_RANGE DEPTH_CLEAR_VALUE
        STENCIL_FUNC STENCIL_REF STENCIL_VALUE_MASK STENCIL_WRITEMASK STENCIL_FAIL STENCIL_PASS_DEPTH_FAIL
        STENCIL_PASS_DEPTH_PASS STENCIL_BACK_FUNC STENCIL_BACK_REF STENCIL_BACK_VALUE_MASK
        STENCIL_BACK_WRITEMASK STENCIL_BACK_FAIL STENCIL_BACK_PASS_DEPTH_FAIL STENCIL_BACK_PASS_DEPTH_PASS
        STENCIL_CLEAR_VALUE VIEWPORT SCISSOR_BOX
        CULL_FACE_MODE FRONT_FACE POLYGON_MODE POLYGON_OFFSET_FACTOR POLYGON_OFFSET_UNITS
        LINE_WIDTH POINT_SIZE POINT_FADE_THRESHOLD_SIZE POINT_SPRITE_COORD_ORIGIN PROVOKING_VERTEX
        PRIMITIVE_RESTART_INDEX CLAMP_READ_COLOR SAMPLE_COVERAGE_VALUE SAMPLE_COVERAGE_INVERT
        UNPACK_SWAP_BYTES UNPACK_LSB_FIRST UNPACK_ROW_LENGTH UNPACK_IMAGE_HEIGHT UNPACK_SKIP_ROWS
        UNPACK_SKIP_PIXELS UNPACK_SKIP_IMAGES UNPACK_ALIGNMENT
        PACK_SWAP_BYTES PACK_LSB_FIRST PACK_ROW_LENGTH PACK_IMAGE_HEIGHT PACK_SKIP_ROWS PACK_SKIP_PIXELS
        PACK_SKIP_IMAGES PACK_ALIGNMENT
        LINE_SMOOTH_HINT POLYGON_SMOOTH_HINT TEXTURE_COMPRESSION_HINT FRAGMENT_SHADER_DERIVATIVE_HINT
        READ_BUFFER DOUBLEBUFFER STEREO SAMPLE_BUFFERS SAMPLES""",
    "ARB_draw_indirect": "DRAW_INDIRECT_BUFFER_BINDING",
    "ARB_transform_feedback2": """TRANSFORM_FEEDBACK_BINDING TRANSFORM_FEEDBACK_BUFFER_ACTIVE
        TRANSFORM_FEEDBACK_BUFFER_PAUSED""",
    "ARB_sample_shading": "MIN_SAMPLE_SHADING_VALUE",
    "ARB_tessellation_shader": "PATCH_VERTICES PATCH_DEFAULT_INNER_LEVEL PATCH_DEFAULT_OUTER_LEVEL",
    "ARB_separate_shader_objects": "PROGRAM_PIPELINE_BINDING",
    "ARB_shader_atomic_counters": "ATOMIC_COUNTER_BUFFER_BINDING",
    "ARB_compressed_texture_pixel_storage": """UNPACK_COMPRESSED_BLOCK_WIDTH UNPACK_COMPRESSED_BLOCK_HEIGHT
        UNPACK_COMPRESSED_BLOCK_DEPTH UNPACK_COMPRESSED_BLOCK_SIZE PACK_COMPRESSED_BLOCK_WIDTH
        PACK_COMPRESSED_BLOCK_HEIGHT PACK_COMPRESSED_BLOCK_DEPTH PACK_COMPRESSED_BLOCK_SIZE""",
    "ARB_compute_shader": "DISPATCH_INDIRECT_BUFFER_BINDING",
    "ARB_shader_storage_buffer_object": "SHADER_STORAGE_BUFFER_BINDING",
    "KHR_debug": "DEBUG_LOGGED_MESSAGES DEBUG_GROUP_STACK_DEPTH",
    "ARB_query_buffer_object": "QUERY_BUFFER_BINDING",
    "ARB_clip_control": "CLIP_ORIGIN CLIP_DEPTH_MODE",
    "MESA_pack_invert": "PACK_INVERT_MESA",
}
COMPATIBILITY = """
    ALPHA_TEST_FUNC ALPHA_TEST_REF CLAMP_VERTEX_COLOR CLAMP_FRAGMENT_COLOR MAP_COLOR MAP_STENCIL
    INDEX_SHIFT INDEX_OFFSET RED_SCALE RED_BIAS GREEN_SCALE GREEN_BIAS BLUE_SCALE BLUE_BIAS ALPHA_SCALE
    ALPHA_BIAS DEPTH_SCALE DEPTH_BIAS ZOOM_X ZOOM_Y SHADE_MODEL MATRIX_MODE CURRENT_COLOR LINE_STIPPLE_PATTERN
    MODELVIEW_MATRIX PROJECTION_MATRIX CLIENT_ACTIVE_TEXTURE"""
ENABLES = {
    "": """BLEND CULL_FACE DEPTH_TEST DITHER LINE_SMOOTH POLYGON_OFFSET_FILL POLYGON_OFFSET_LINE
        POLYGON_OFFSET_POINT POLYGON_SMOOTH SAMPLE_ALPHA_TO_COVERAGE SAMPLE_ALPHA_TO_ONE SAMPLE_COVERAGE
        SAMPLE_MASK SCISSOR_TEST STENCIL_TEST COLOR_LOGIC_OP DEPTH_CLAMP FRAMEBUFFER_SRGB MULTISAMPLE
        PRIMITIVE_RESTART PROGRAM_POINT_SIZE TEXTURE_CUBE_MAP_SEAMLESS RASTERIZER_DISCARD"""
    + "".join(f" CLIP_DISTANCE{k}" for k in range(8)),
    "ARB_sample_shading": "SAMPLE_SHADING",
    "ARB_ES3_compatibility": "PRIMITIVE_RESTART_FIXED_INDEX",
    "KHR_debug": "DEBUG_OUTPUT DEBUG_OUTPUT_SYNCHRONOUS",
}
COMPATIBILITY_ENABLES = """
    ALPHA_TEST POLYGON_STIPPLE LINE_STIPPLE FOG LIGHTING COLOR_SUM NORMALIZE POINT_SPRITE
    POINT_SMOOTH VERTEX_PROGRAM_TWO_SIDE COLOR_MATERIAL"""
# extension, limit of the index, names of the values, glGet... that reads them
INDEXED = [
    ("", "MAX_DRAW_BUFFERS", "COLOR_WRITEMASK", "Booleani_v"),
    (
        "ARB_draw_buffers_blend",
        "MAX_DRAW_BUFFERS",
        "BLEND_SRC_RGB BLEND_DST_RGB BLEND_SRC_ALPHA BLEND_DST_ALPHA",
        "Integeri_v",
    ),
    ("ARB_draw_buffers_blend", "MAX_DRAW_BUFFERS", "BLEND_EQUATION_RGB BLEND_EQUATION_ALPHA", "Integeri_v"),
    ("", "MAX_UNIFORM_BUFFER_BINDINGS", "UNIFORM_BUFFER_{}", "Integer64i_v"),
    ("", "MAX_TRANSFORM_FEEDBACK_SEPARATE_ATTRIBS", "TRANSFORM_FEEDBACK_BUFFER_{}", "Integer64i_v"),
    (
        "ARB_shader_atomic_counters",
        "MAX_ATOMIC_COUNTER_BUFFER_BINDINGS",
        "ATOMIC_COUNTER_BUFFER_{}",
        "Integer64i_v",
    ),
    (
        "ARB_shader_storage_buffer_object",
        "MAX_SHADER_STORAGE_BUFFER_BINDINGS",
        "SHADER_STORAGE_BUFFER_{}",
        "Integer64i_v",
    ),
    ("ARB_viewport_array", "MAX_VIEWPORTS", "VIEWPORT", "Floati_v"),
    ("ARB_viewport_array", "MAX_VIEWPORTS", "SCISSOR_BOX", "Integeri_v"),
    ("ARB_viewport_array", "MAX_VIEWPORTS", "DEPTH_RANGE", "Doublei_v"),
    ("", "MAX_SAMPLE_MASK_WORDS", "SAMPLE_MASK_VALUE", "Integeri_v"),
    (
        "ARB_shader_image_load_store",
        "MAX_IMAGE_UNITS",
        "IMAGE_BINDING_NAME IMAGE_BINDING_LEVEL IMAGE_BINDING_LAYERED IMAGE_BINDING_LAYER "
        "IMAGE_BINDING_ACCESS IMAGE_BINDING_FORMAT",
        "Integeri_v",
    ),
]
INDEXED_ENABLES = [("", "MAX_DRAW_BUFFERS", "BLEND"), ("ARB_viewport_array", "MAX_VIEWPORTS", "SCISSOR_TEST")]
KINDS = {"Integeri_v": "i4", "Integer64i_v": "i8", "Floati_v": "f4", "Doublei_v": "f8", "Booleani_v": "u1"}
TEXTURES = {
    "": """TEXTURE_BINDING_1D TEXTURE_BINDING_2D TEXTURE_BINDING_3D TEXTURE_BINDING_1D_ARRAY
        TEXTURE_BINDING_2D_ARRAY TEXTURE_BINDING_RECTANGLE TEXTURE_BINDING_BUFFER TEXTURE_BINDING_CUBE_MAP
        TEXTURE_BINDING_2D_MULTISAMPLE TEXTURE_BINDING_2D_MULTISAMPLE_ARRAY SAMPLER_BINDING""",
    "ARB_texture_cube_map_array": "TEXTURE_BINDING_CUBE_MAP_ARRAY",
}
OBJECTS = {
    "": "Buffer Texture Framebuffer Renderbuffer VertexArray Program Shader Query Sampler",
    "ARB_transform_feedback2": "TransformFeedback",
    "ARB_separate_shader_objects": "ProgramPipeline",
}
HIGHEST_NAME = 2000
ERRORS = "INVALID_ENUM", "INVALID_VALUE", "INVALID_OPERATION", "INVALID_FRAMEBUFFER_OPERATION"


@cache
def enum(name: str) -> int:
    """Return the number of GL_<name>."""
    return LATER[name] if name in LATER else int(getattr(NAMES, f"GL_{name}"))


class GL:
    """OpenGL's functions by their names without "gl". They take ints, floats (32 bits), arrays and ctypes."""

    def __init__(self):
        self._library = ctypes.CDLL("libGL.so.1")
        self._library.glXGetProcAddressARB.restype = ctypes.c_void_p
        self._room = (ctypes.c_int * 32)()
        self._room_at = ctypes.c_void_p(ctypes.addressof(self._room))
        self.version = 10 * (10 * self.integer("MAJOR_VERSION") + self.integer("MINOR_VERSION"))
        self.is_compatible = bool(self.integer("CONTEXT_PROFILE_MASK") & 2)
        get_string = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_uint, ctypes.c_uint)(
            self._library.glXGetProcAddressARB(b"glGetStringi")
        )
        listed = {
            get_string(enum("EXTENSIONS"), k).decode()[3:] for k in range(self.integer("NUM_EXTENSIONS"))
        }
        self.has = {"", *(name for name, since in SINCE.items() if self.version >= since or name in listed)}

    def __getattr__(self, name):
        address = self._library.glXGetProcAddressARB(f"gl{name}".encode())
        function = ctypes.CFUNCTYPE(ctypes.c_uint)(address)
        if name.startswith("Is"):
            function = ctypes.CFUNCTYPE(ctypes.c_ubyte)(address)

        def call(*arguments):
            try:
                return function(*arguments)
            except ctypes.ArgumentError:  # of arrays and floats, which are rare
                return function(*map(_as_argument, arguments))

        setattr(self, name, call)
        return call

    def doubles(self, name: str) -> tuple:
        """Return all numbers of a value."""
        out = np.full(32, np.nan)
        self.GetDoublev(enum(name), out)
        return tuple(out[: np.isnan(out).argmax()].tolist())

    def integer(self, name: str) -> int:
        self.GetIntegerv(enum(name), self._room_at)
        return self._room[0]

    def integers(self, names) -> list[int]:
        """Return the first number of each value, which is quicker than one by one."""
        out, room, room_at = [], self._room, self._room_at
        get = ctypes.CFUNCTYPE(ctypes.c_uint)(self._library.glXGetProcAddressARB(b"glGetIntegerv"))
        for name in names:
            get(enum(name), room_at)
            out.append(room[0])
        return out

    def text(self, name: str) -> str:
        function = ctypes.CFUNCTYPE(ctypes.c_char_p)(self._library.glXGetProcAddressARB(b"glGetString"))
        return function(enum(name)).decode()

    def name(self, kind: str) -> int:
        """Return the name of a new object, of a kind such as "Buffers"."""
        out = np.zeros(1, np.uint32)
        getattr(self, f"Gen{kind}")(1, out)
        return int(out[0])

    def errors(self) -> list:
        """Return the pending errors, and clear them."""
        out = []
        while len(out) < 8 and (code := self.GetError()):
            out += [name for name in ERRORS if enum(name) == code] or [hex(code)]
        return out

    def drop_messages(self):
        """Clear the log of debug messages."""
        if "KHR_debug" in self.has:
            self.GetDebugMessageLog(100, 0, None, None, None, None, None, None)

    def make_error(self, name: str):
        """Make an error pending, with an empty log of debug messages."""
        if name == "INVALID_ENUM":
            self.Enable(0x1234)
        elif name == "INVALID_VALUE":
            self.Viewport(0, 0, -1, -1)
        elif name == "INVALID_OPERATION":
            shader = self.CreateShader(enum("VERTEX_SHADER"))
            self.UseProgram(shader)
            self.DeleteShader(shader)
        else:
            bound, incomplete = self.integer("DRAW_FRAMEBUFFER_BINDING"), self.name("Framebuffers")
            self.BindFramebuffer(enum("DRAW_FRAMEBUFFER"), incomplete)
            self.Clear(enum("COLOR_BUFFER_BIT"))
            self.BindFramebuffer(enum("DRAW_FRAMEBUFFER"), bound)
            self.DeleteFramebuffers(1, np.array([incomplete], np.uint32))
        self.drop_messages()


def _as_argument(value):
    if isinstance(value, np.ndarray):
        return ctypes.c_void_p(value.ctypes.data)
    return ctypes.c_float(value) if isinstance(value, float) else value


def _names(table: dict, gl: GL) -> list:
    return [name for extension, names in table.items() if extension in gl.has for name in names.split()]


def objects(gl: GL) -> dict:
    """Return the names of existing objects, by kind."""
    out = {}
    for kind in _names(OBJECTS, gl):
        is_one = getattr(gl, f"Is{kind}")
        out[kind] = [name for name in range(1, HIGHEST_NAME) if is_one(name)]
    return out


def snapshot(gl: GL, platform=tuple) -> dict:
    """Return all state but the objects, as a dict from names to values. It takes the pending errors.

    Parameters
    ----------
    platform : function that returns what is current in EGL or GLX
    """
    out = {"current": platform(), "errors": gl.errors()}
    names = _names(SINGLE, gl) + (COMPATIBILITY.split() if gl.is_compatible else [])
    out |= {name: gl.doubles(name) for name in names}
    names = _names(ENABLES, gl) + (COMPATIBILITY_ENABLES.split() if gl.is_compatible else [])
    out |= {name: gl.IsEnabled(enum(name)) for name in names}
    for k in range(gl.integer("MAX_DRAW_BUFFERS")):
        out[f"DRAW_BUFFER{k}"] = gl.integer(f"DRAW_BUFFER{k}")
    for extension, limit, names, getter in INDEXED:
        if extension not in gl.has:
            continue
        get, room = getattr(gl, f"Get{getter}"), np.zeros(8, KINDS[getter])
        room_at = ctypes.c_void_p(room.ctypes.data)
        expanded = (
            [names.format(part) for part in ("BINDING", "START", "SIZE")] if "{" in names else names.split()
        )
        for name in expanded:
            for k in range(gl.integer(limit)):
                room[:] = 0
                get(enum(name), k, room_at)
                out[f"{name}[{k}]"] = tuple(room.tolist())
    for extension, limit, name in INDEXED_ENABLES:
        for k in range(gl.integer(limit) if extension in gl.has else 0):
            out[f"{name}[{k}]"] = gl.IsEnabledi(enum(name), k)
    active = gl.integer("ACTIVE_TEXTURE")
    names = _names(TEXTURES, gl)
    for k in range(gl.integer("MAX_COMBINED_TEXTURE_IMAGE_UNITS")):
        gl.ActiveTexture(enum("TEXTURE0") + k)
        out |= {f"{name}[{k}]": value for name, value in zip(names, gl.integers(names), strict=True)}
    gl.ActiveTexture(active)
    if "KHR_debug" in gl.has:
        room = np.zeros(1, np.uint64)
        for name in ("DEBUG_CALLBACK_FUNCTION", "DEBUG_CALLBACK_USER_PARAM"):
            gl.GetPointerv(enum(name), room)
            out[name] = int(room[0])
    if out["VERTEX_ARRAY_BINDING"][0]:
        out |= _attributes(gl)
    if errors := gl.errors():
        raise AssertionError(f"the snapshot must read only what this context has (got {errors})")
    gl.drop_messages()  # about incomplete framebuffers, which were queried
    return out


def _attributes(gl: GL) -> dict:
    out, room = {}, np.zeros(8, np.int32)
    for k in range(gl.integer("MAX_VERTEX_ATTRIBS")):
        for name in (
            "ENABLED",
            "SIZE",
            "STRIDE",
            "TYPE",
            "NORMALIZED",
            "INTEGER",
            "DIVISOR",
            "BUFFER_BINDING",
        ):
            gl.GetVertexAttribiv(k, enum(f"VERTEX_ATTRIB_ARRAY_{name}"), room)
            out[f"VERTEX_ATTRIB_ARRAY_{name}[{k}]"] = int(room[0])
    return out


def changes(before: dict, after: dict) -> dict:
    """Return the values that differ, as a dict from names to (before, after)."""
    if before == after:
        return {}
    names = before.keys() | after.keys()
    differ = sorted(name for name in names if before.get(name) != after.get(name))
    return {name: (before.get(name), after.get(name)) for name in differ}


VERTEX = b"#version 330\nin vec3 at; void main() { gl_Position = vec4(at, 1.0); }"
FRAGMENT = b"#version 330\nuniform vec4 colour; out vec4 pixel; void main() { pixel = colour; }"


def make_program(gl: GL, vertex: bytes = VERTEX, fragment: bytes = FRAGMENT) -> int:
    """Return a linked program whose first attribute is `at`; its shaders are deleted."""
    program = gl.CreateProgram()
    for kind, source in (("VERTEX_SHADER", vertex), ("FRAGMENT_SHADER", fragment)):
        shader, text = gl.CreateShader(enum(kind)), ctypes.c_char_p(source)
        gl.ShaderSource(shader, 1, ctypes.byref(text), None)
        gl.CompileShader(shader)
        gl.AttachShader(program, shader)
        gl.DeleteShader(shader)
    gl.BindAttribLocation(program, 0, b"at")
    gl.LinkProgram(program)
    linked = np.zeros(1, np.int32)
    gl.GetProgramiv(program, enum("LINK_STATUS"), linked)
    assert linked[0], "the host's own program must link"
    return program


def make_buffer(gl: GL, target: str, data: np.ndarray) -> int:
    """Return a new buffer with data in it, bound to a target."""
    buffer = gl.name("Buffers")
    gl.BindBuffer(enum(target), buffer)
    gl.BufferData(enum(target), ctypes.c_ssize_t(data.nbytes), data, enum("STATIC_DRAW"))
    return buffer


def make_texture(gl: GL, target: str) -> int:
    """Return a new 4 by 4 texture, bound to the active unit."""
    texture = gl.name("Textures")
    gl.BindTexture(enum(target), texture)
    if target == "TEXTURE_2D":
        gl.TexImage2D(enum(target), 0, enum("RGBA8"), 4, 4, 0, enum("RGBA"), enum("UNSIGNED_BYTE"), None)
    return texture


def make_hostile(gl: GL) -> None:
    """Set all state to legal values with which nothing would be drawn, or read, correctly."""
    junk = np.arange(1 << 12, dtype=np.uint32)
    make_texture(gl, "TEXTURE_2D")  # before the pixel store is changed
    _hostile_bindings(gl, junk)
    for where in ("UNPACK", "PACK"):
        for name, value in (
            ("SWAP_BYTES", 1),
            ("LSB_FIRST", 1),
            ("ROW_LENGTH", 7),
            ("IMAGE_HEIGHT", 5),
            ("SKIP_ROWS", 3),
            ("SKIP_PIXELS", 2),
            ("SKIP_IMAGES", 1),
            ("ALIGNMENT", 8),
        ):
            gl.PixelStorei(enum(f"{where}_{name}"), value)
    gl.ClampColor(enum("CLAMP_READ_COLOR"), 1)
    gl.ColorMask(0, 0, 0, 0)
    gl.ClearColor(0.25, -3.0, 7.0, 0.5)
    gl.ClearDepth(ctypes.c_double(0.125))
    gl.ClearStencil(5)
    gl.DepthFunc(enum("GREATER"))
    gl.DepthMask(0)
    gl.DepthRange(ctypes.c_double(0.75), ctypes.c_double(0.25))
    gl.StencilFuncSeparate(enum("FRONT"), enum("NEVER"), 3, 0x55)
    gl.StencilFuncSeparate(enum("BACK"), enum("LESS"), 9, 0xAA)
    gl.StencilOpSeparate(enum("FRONT"), enum("INCR"), enum("DECR"), enum("INVERT"))
    gl.StencilOpSeparate(enum("BACK"), enum("ZERO"), enum("REPLACE"), enum("INCR_WRAP"))
    gl.StencilMaskSeparate(enum("FRONT"), 0x0F)
    gl.StencilMaskSeparate(enum("BACK"), 0xF0)
    gl.LogicOp(enum("XOR"))
    gl.BlendColor(0.1, 0.2, 0.3, 0.4)
    gl.BlendFuncSeparate(enum("DST_COLOR"), enum("CONSTANT_COLOR"), enum("ZERO"), enum("SRC_ALPHA_SATURATE"))
    gl.BlendEquationSeparate(enum("FUNC_REVERSE_SUBTRACT"), enum("MIN"))
    gl.CullFace(enum("FRONT"))
    gl.FrontFace(enum("CW"))
    gl.PolygonMode(enum("FRONT_AND_BACK"), enum("LINE"))
    gl.PolygonOffset(3.0, 1000.0)
    gl.LineWidth(2.0 if gl.is_compatible else 1.0)
    gl.PointSize(5.0)
    gl.PointParameterf(enum("POINT_FADE_THRESHOLD_SIZE"), 2.0)
    gl.PointParameteri(enum("POINT_SPRITE_COORD_ORIGIN"), enum("LOWER_LEFT"))
    gl.ProvokingVertex(enum("FIRST_VERTEX_CONVENTION"))
    gl.PrimitiveRestartIndex(0)
    gl.SampleCoverage(0.25, 1)
    gl.SampleMaski(0, 0)
    for name in ("LINE_SMOOTH", "POLYGON_SMOOTH", "TEXTURE_COMPRESSION", "FRAGMENT_SHADER_DERIVATIVE"):
        gl.Hint(enum(f"{name}_HINT"), enum("NICEST"))
    gl.Viewport(3, 5, 7, 11)
    gl.Scissor(1, 2, 3, 4)
    on = [name for name in _names(ENABLES, gl) if name not in ("DITHER", "MULTISAMPLE")]
    for name in on:
        gl.Enable(enum(name))
    for name in ("DITHER", "MULTISAMPLE"):
        gl.Disable(enum(name))
    _hostile_by_index(gl)
    if "KHR_debug" in gl.has:
        anything = enum("DONT_CARE")  # errors only: the driver also comments on the host's own calls
        gl.DebugMessageControl(anything, anything, anything, 0, None, 0)
        gl.DebugMessageControl(anything, enum("DEBUG_TYPE_ERROR"), anything, 0, None, 1)
        gl.PushDebugGroup(enum("DEBUG_SOURCE_APPLICATION"), 1, -1, b"the host's")
    if "MESA_pack_invert" in gl.has:
        gl.PixelStorei(enum("PACK_INVERT_MESA"), 1)
    if "ARB_clip_control" in gl.has:
        gl.ClipControl(enum("UPPER_LEFT"), enum("ZERO_TO_ONE"))
    if gl.is_compatible:
        _hostile_compatibility(gl)
    gl.drop_messages()
    errors = gl.errors()
    assert not errors, f"hostile state must be legal: {errors}"


def _hostile_bindings(gl: GL, junk) -> None:
    gl.UseProgram(make_program(gl))
    gl.BindVertexArray(0)
    make_buffer(gl, "ARRAY_BUFFER", junk)
    for name in ("COPY_READ_BUFFER", "COPY_WRITE_BUFFER", "PIXEL_PACK_BUFFER", "TEXTURE_BUFFER"):
        make_buffer(gl, name, junk)
    indexed = [("UNIFORM_BUFFER", ""), ("TRANSFORM_FEEDBACK_BUFFER", "")]
    indexed += [("ATOMIC_COUNTER_BUFFER", "ARB_shader_atomic_counters")]
    indexed += [("SHADER_STORAGE_BUFFER", "ARB_shader_storage_buffer_object")]
    for name, extension in indexed:
        if extension in gl.has:
            buffer = make_buffer(gl, name, junk)
            for k in (0, 1, 3):
                gl.BindBufferRange(
                    enum(name), k, buffer, ctypes.c_ssize_t(256 * k), ctypes.c_ssize_t(256 + 4 * k)
                )
            make_buffer(gl, name, junk)  # another one at the binding point without an index
    later = [("DRAW_INDIRECT_BUFFER", "ARB_draw_indirect"), ("QUERY_BUFFER", "ARB_query_buffer_object")]
    for name, extension in [*later, ("DISPATCH_INDIRECT_BUFFER", "ARB_compute_shader")]:
        if extension in gl.has:
            make_buffer(gl, name, junk)
    for unit in (0, 1, 5, gl.integer("MAX_COMBINED_TEXTURE_IMAGE_UNITS") - 1):
        gl.ActiveTexture(enum("TEXTURE0") + unit)
        gl.BindBuffer(enum("PIXEL_UNPACK_BUFFER"), 0)
        for name in ("TEXTURE_2D", "TEXTURE_CUBE_MAP", "TEXTURE_2D_ARRAY", "TEXTURE_BUFFER"):
            texture = make_texture(gl, name)
            images = gl.integer("MAX_IMAGE_UNITS") if "ARB_shader_image_load_store" in gl.has else 0
            if name == "TEXTURE_2D" and unit < images:
                gl.BindImageTexture(unit, texture, 0, 0, 0, enum("READ_WRITE"), enum("RGBA8"))
        sampler = gl.name("Samplers")
        gl.BindSampler(unit, sampler)
        gl.SamplerParameteri(sampler, enum("TEXTURE_COMPARE_MODE"), enum("COMPARE_REF_TO_TEXTURE"))
    gl.ActiveTexture(enum("TEXTURE0") + 5)
    make_buffer(gl, "PIXEL_UNPACK_BUFFER", junk)
    if "ARB_separate_shader_objects" in gl.has:
        pipeline = gl.name("ProgramPipelines")
        gl.BindProgramPipeline(pipeline)
    gl.BindRenderbuffer(enum("RENDERBUFFER"), gl.name("Renderbuffers"))
    gl.BindFramebuffer(enum("READ_FRAMEBUFFER"), gl.name("Framebuffers"))  # both incomplete
    gl.BindFramebuffer(enum("DRAW_FRAMEBUFFER"), gl.name("Framebuffers"))
    gl.DrawBuffers(3, np.array([enum("COLOR_ATTACHMENT2"), 0, enum("COLOR_ATTACHMENT1")], np.uint32))
    gl.ReadBuffer(enum("COLOR_ATTACHMENT1"))


def _hostile_by_index(gl: GL) -> None:
    for k in range(gl.integer("MAX_DRAW_BUFFERS")):
        gl.ColorMaski(k, k % 2, 0, k % 3 == 0, 0)
        (gl.Disablei if k == 2 else gl.Enablei)(enum("BLEND"), k)
        if "ARB_draw_buffers_blend" in gl.has:
            factors = (
                enum("SRC_COLOR"),
                enum("ONE_MINUS_DST_ALPHA"),
                enum("CONSTANT_ALPHA"),
                enum("DST_COLOR"),
            )
            gl.BlendFuncSeparatei(k, *np.roll(factors, k).tolist())
            gl.BlendEquationSeparatei(k, enum("MAX") if k % 2 else enum("MIN"), enum("FUNC_SUBTRACT"))
    for k in range(gl.integer("MAX_VIEWPORTS") if "ARB_viewport_array" in gl.has else 0):
        gl.ViewportIndexedf(k, 0.5 + k, 1.25, 3.5, 4.0 + k)
        gl.ScissorIndexed(k, k, 1, 2, 3 + k)
        gl.DepthRangeIndexed(k, ctypes.c_double(0.7), ctypes.c_double(0.2 + k / 100))
        (gl.Disablei if k == 3 else gl.Enablei)(enum("SCISSOR_TEST"), k)
    if "ARB_sample_shading" in gl.has:
        gl.MinSampleShading(0.5)
    if "ARB_tessellation_shader" in gl.has:
        gl.PatchParameteri(enum("PATCH_VERTICES"), 7)


def _hostile_compatibility(gl: GL) -> None:
    gl.AlphaFunc(enum("NEVER"), 0.5)
    gl.PolygonStipple(None)  # from the bound buffer
    gl.PolygonMode(enum("FRONT"), enum("POINT"))
    gl.ShadeModel(enum("FLAT"))
    for name in ("CLAMP_VERTEX_COLOR", "CLAMP_FRAGMENT_COLOR"):
        gl.ClampColor(enum(name), 1)
    for name in (
        "ALPHA_TEST",
        "POLYGON_STIPPLE",
        "LINE_STIPPLE",
        "FOG",
        "LIGHTING",
        "VERTEX_PROGRAM_TWO_SIDE",
    ):
        gl.Enable(enum(name))
    for name in ("RED", "GREEN", "BLUE", "ALPHA", "DEPTH"):
        gl.PixelTransferf(enum(f"{name}_SCALE"), 0.5)
        gl.PixelTransferf(enum(f"{name}_BIAS"), 0.25)
    gl.PixelTransferi(enum("MAP_COLOR"), 1)
    gl.PixelTransferi(enum("INDEX_OFFSET"), 3)
    gl.PixelZoom(-1.0, 2.0)
