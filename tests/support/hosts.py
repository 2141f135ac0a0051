"""Host programs with an OpenGL context of their own, one of EGL and one of GLX.

Each draws a scene with state that it sets once, and relies on from then on.
"""

import ctypes
import math
import os

import numpy as np

from tests.support.host_state import GL, enum, make_buffer, make_program

EGL_PLATFORM_SURFACELESS, EGL_OPENGL_API, EGL_OPENGL_ES_API = 0x31DD, 0x30A2, 0x30A0
PBUFFER_BIT, NONE = 1, 0x3038
CONFIG = 0x3033, PBUFFER_BIT, 0x3040, 0x8, 0x3024, 8, 0x3025, 24, NONE  # any OpenGL, with red and depth bits
SIZE = 64


class EglHost:
    """A host with an EGL context and a pbuffer.

    Parameters
    ----------
    version : (major, minor) of a core profile; None is OpenGL ES 3
    more : further attributes of the context, names and values of EGL
    """

    def __init__(self, version=(3, 3), more=()):
        self.egl = egl = ctypes.CDLL("libEGL.so.1")
        for name in ("GetPlatformDisplay", "CreateContext", "CreatePbufferSurface", "GetCurrentContext"):
            getattr(egl, f"egl{name}").restype = ctypes.c_void_p
        for name in ("GetCurrentDisplay", "GetCurrentSurface"):
            getattr(egl, f"egl{name}").restype = ctypes.c_void_p
        self.display = ctypes.c_void_p(egl.eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS, None, None))
        assert egl.eglInitialize(self.display, None, None)
        config, found = ctypes.c_void_p(), ctypes.c_int()
        wanted = (ctypes.c_int * len(CONFIG))(*CONFIG)
        assert egl.eglChooseConfig(self.display, wanted, ctypes.byref(config), 1, ctypes.byref(found))
        assert found.value, "EGL must have a config"
        egl.eglBindAPI(EGL_OPENGL_API if version else EGL_OPENGL_ES_API)
        wanted_version = (
            (0x3098, version[0], 0x30FB, version[1], 0x30FD, 1, *more, NONE) if version else (0x3098, 3, NONE)
        )
        attributes = (ctypes.c_int * len(wanted_version))(*wanted_version)
        self.context = ctypes.c_void_p(egl.eglCreateContext(self.display, config, None, attributes))
        assert self.context.value, f"EGL must make a context of {version} (got error {egl.eglGetError():#x})"
        size = (ctypes.c_int * 5)(0x3057, SIZE, 0x3056, SIZE, NONE)
        self.surface = ctypes.c_void_p(egl.eglCreatePbufferSurface(self.display, config, size))
        self.make_current()
        self.gl = GL()

    def make_current(self):
        assert self.egl.eglMakeCurrent(self.display, self.surface, self.surface, self.context)

    def make_none_current(self):
        self.egl.eglMakeCurrent(self.display, None, None, None)

    def platform(self) -> tuple:
        """Return the context, display and surfaces that are current in this thread, and the bound API."""
        egl = self.egl
        surfaces = egl.eglGetCurrentSurface(0x3059), egl.eglGetCurrentSurface(0x305A)
        return egl.eglGetCurrentContext(), egl.eglGetCurrentDisplay(), *surfaces, egl.eglQueryAPI()

    def destroy(self):
        self.make_none_current()
        self.egl.eglDestroyContext(self.display, self.context)

    def terminate(self):
        """Close the display and all contexts in it, as pyrender's `delete` does."""
        self.destroy()
        self.egl.eglTerminate(self.display)


class GlxHost:
    """A host with a GLX context, in a hidden window. Needs DISPLAY.

    Parameters
    ----------
    version : (major, minor) of a core profile; None is the driver's default, of the compatibility profile
    """

    def __init__(self, version=None):
        import glfw

        self.glfw = glfw
        os.environ.pop("WAYLAND_DISPLAY", None)
        assert glfw.init(), "glfw must find a display"
        glfw.default_window_hints()
        glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
        if version is not None:
            glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, version[0])
            glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, version[1])
            glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        self.window = glfw.create_window(SIZE, SIZE, "host", None, None)
        assert self.window, "glfw must make a window"
        self.make_current()
        self.gl = GL()
        self.glx = ctypes.CDLL("libGL.so.1")
        for name in ("Context", "Display", "Drawable", "ReadDrawable"):
            getattr(self.glx, f"glXGetCurrent{name}").restype = ctypes.c_void_p

    def make_current(self):
        self.glfw.make_context_current(self.window)

    def make_none_current(self):
        self.glfw.make_context_current(None)

    def platform(self) -> tuple:
        """Return the context, display and drawables that are current in this thread."""
        names = "Context", "Display", "Drawable", "ReadDrawable"
        return tuple(getattr(self.glx, f"glXGetCurrent{name}")() for name in names)

    def destroy(self):
        self.make_none_current()
        self.glfw.destroy_window(self.window)


HOSTS = {"egl": EglHost, "glx": GlxHost}


class Scene:
    """A host's drawing: triangles with depth test and blending, in a framebuffer of its own.

    It sets all state once, to uncommon values.
    """

    def __init__(self, gl: GL):
        self.gl = gl
        angle = np.linspace(0, 40, 60)
        points = np.stack([np.cos(angle), np.sin(1.7 * angle), np.cos(2.3 * angle)], 1).astype(np.float32)
        self.array = gl.name("VertexArrays")
        gl.BindVertexArray(self.array)
        make_buffer(gl, "ARRAY_BUFFER", points)
        indices = np.arange(60, dtype=np.uint32)
        indices[20::21] = 77  # the restart index ends a strip
        make_buffer(gl, "ELEMENT_ARRAY_BUFFER", indices)
        gl.VertexAttribPointer(0, 3, enum("FLOAT"), 0, 12, None)
        gl.EnableVertexAttribArray(0)
        program = make_program(gl)
        gl.UseProgram(program)
        self.colour = gl.GetUniformLocation(program, b"colour")
        framebuffer = gl.name("Framebuffers")
        gl.BindFramebuffer(enum("FRAMEBUFFER"), framebuffer)
        for at, kind in (
            ("COLOR_ATTACHMENT0", "SRGB8_ALPHA8"),
            ("DEPTH_STENCIL_ATTACHMENT", "DEPTH24_STENCIL8"),
        ):
            gl.BindRenderbuffer(enum("RENDERBUFFER"), gl.name("Renderbuffers"))
            gl.RenderbufferStorage(enum("RENDERBUFFER"), enum(kind), SIZE, SIZE)
            gl.FramebufferRenderbuffer(
                enum("FRAMEBUFFER"), enum(at), enum("RENDERBUFFER"), gl.integer("RENDERBUFFER_BINDING")
            )
        self.set_state()
        assert not gl.errors()

    def set_state(self):
        """Set the state; called once, at the start."""
        gl = self.gl
        gl.Viewport(4, 2, SIZE - 6, SIZE - 4)
        gl.Scissor(5, 3, SIZE - 9, SIZE - 8)
        tests = "DEPTH_TEST", "SCISSOR_TEST", "STENCIL_TEST", "CULL_FACE"
        for name in (*tests, "BLEND", "FRAMEBUFFER_SRGB", "PRIMITIVE_RESTART", "POLYGON_OFFSET_FILL"):
            gl.Enable(enum(name))
        gl.PrimitiveRestartIndex(77)
        gl.FrontFace(enum("CW"))
        gl.PolygonOffset(1.0, 3.0)
        gl.DepthFunc(enum("GEQUAL"))
        gl.DepthRange(ctypes.c_double(0.9), ctypes.c_double(0.1))
        gl.ClearDepth(ctypes.c_double(0.05))
        gl.ClearColor(0.1, 0.2, 0.3, 0.4)
        gl.ClearStencil(2)
        gl.StencilFunc(enum("LEQUAL"), 2, 0xFF)
        gl.StencilOp(enum("KEEP"), enum("KEEP"), enum("INCR"))
        gl.BlendFuncSeparate(enum("SRC_ALPHA"), enum("ONE_MINUS_SRC_ALPHA"), enum("ONE"), enum("ONE"))
        gl.BlendEquation(enum("FUNC_ADD"))
        gl.ColorMask(1, 1, 0, 1)
        gl.PixelStorei(enum("PACK_ROW_LENGTH"), SIZE + 8)
        gl.PixelStorei(enum("PACK_SKIP_PIXELS"), 4)

    def draw(self) -> np.ndarray:
        """Draw a frame, and return it as the host reads it: (SIZE, SIZE + 8, 4) uint8."""
        gl = self.gl
        gl.Clear(enum("COLOR_BUFFER_BIT") | enum("DEPTH_BUFFER_BIT") | enum("STENCIL_BUFFER_BIT"))
        for k in range(3):
            gl.Uniform4f(self.colour, math.cos(k) ** 2, math.sin(k) ** 2, 0.5, 0.3 + 0.2 * k)
            gl.DrawElements(enum("TRIANGLE_STRIP"), 60 - 7 * k, enum("UNSIGNED_INT"), None)
        out = np.zeros((SIZE, SIZE + 8, 4), np.uint8)
        gl.ReadPixels(0, 0, SIZE, SIZE, enum("RGBA"), enum("UNSIGNED_BYTE"), out)
        return out
