"""A host program (EGL, PyOpenGL) that draws a scene: as pictures, into a sonar's sectors, into textures."""

import ctypes
import os

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")  # before OpenGL is imported, which would look for a display

import numpy as np
from glcontext import egl
from OpenGL import GL

import sonar_gl as sg
from sonar_gl.embed import sensor as embed
from tests.support import host_state

VERTEX = """#version 330 core
uniform mat4 view, projection, world;
in vec3 position;
in vec3 normal;
in float reflectivity;
out vec3 view_position;
out vec3 view_normal;
flat out float mu;
void main() {
    vec4 at = view * (world * vec4(position, 1.0));
    view_position = at.xyz;
    view_normal = mat3(view) * (mat3(world) * normal);
    mu = reflectivity;
    gl_Position = projection * at;
}
"""
SONAR = """
in vec3 view_position;
in vec3 view_normal;
flat in float mu;
uniform uint body;
uniform vec2 lobe;
void main() { sonar_gl_write(view_normal, mu, body, lobe); }
"""
# a G-buffer as many engines have it, with normals of faces where meshes have none
DEFERRED = """#version 330 core
in vec3 view_position;
in vec3 view_normal;
uniform uint body;
layout(location = 0) out vec4 normals;
layout(location = 1) out uint numbers;
layout(location = 2) out float metres;
void main() {
    vec3 face = normalize(cross(dFdx(view_position), dFdy(view_position)));
    normals = vec4(view_normal == vec3(0.0) ? face : view_normal, 0.0);
    numbers = body;
    metres = 1.0 / gl_FragCoord.w;
}
"""
PICTURE = """#version 330 core
in vec3 view_position;
in vec3 view_normal;
flat in float mu;
out vec4 colour;
void main() {
    vec3 face = normalize(cross(dFdx(view_position), dFdy(view_position)));
    colour = vec4(vec3(0.2 + 0.8 * abs(face.z)) * mu, 0.6);
}
"""


def new_texture():
    """Return the name of a new texture; PyOpenGL 3.1.0, which pyrender pins, cannot from Python 3.12 on."""
    return host_state.GL().name("Textures")


def make_context():
    """Make an EGL context and make it current; `release()` destroys it."""
    return egl.create_context(mode="standalone", glversion=330, libgl="libGL.so.1", libegl="libEGL.so.1")


def clip_zero_to_one(context):
    """Call glClipControl(GL_LOWER_LEFT, GL_ZERO_TO_ONE), which PyOpenGL 3.1.0 lacks."""
    address = context.load_opengl_function("glClipControl")
    ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_uint)(address)(0x8CA1, 0x935F)


def make_program(vertex, fragment):
    """Return a linked program, with its attributes at fixed locations."""
    program = GL.glCreateProgram()
    for kind, text in ((GL.GL_VERTEX_SHADER, vertex), (GL.GL_FRAGMENT_SHADER, fragment)):
        shader = GL.glCreateShader(kind)
        GL.glShaderSource(shader, text)
        GL.glCompileShader(shader)
        assert GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS), GL.glGetShaderInfoLog(shader)
        GL.glAttachShader(program, shader)
        GL.glDeleteShader(shader)
    for place, name in enumerate(("position", "normal", "reflectivity")):
        GL.glBindAttribLocation(program, place, name)
    GL.glLinkProgram(program)
    assert GL.glGetProgramiv(program, GL.GL_LINK_STATUS), GL.glGetProgramInfoLog(program)
    return program


class Program:
    """Draws the bodies of a scene with its own shaders, in the current context."""

    def __init__(self, scene: sg.Scene):
        self.scene, self.meshes, self.framebuffers = scene, [], {}
        for body in scene.bodies:
            faces = np.asarray(body.surface.faces)
            points = np.asarray(body.surface.vertices, np.float32)[faces].reshape(-1, 3)
            normals = np.zeros_like(points) if body.normals is None else body.normals[faces].reshape(-1, 3)
            mu = np.repeat(np.broadcast_to(np.float32(body.reflectivity), len(faces)), 3)[:, None]
            data = np.ascontiguousarray(np.hstack([points, normals, mu]), np.float32)
            array, buffer = GL.glGenVertexArrays(1), GL.glGenBuffers(1)
            GL.glBindVertexArray(array)
            GL.glBindBuffer(GL.GL_ARRAY_BUFFER, buffer)
            GL.glBufferData(GL.GL_ARRAY_BUFFER, data.nbytes, data, GL.GL_STATIC_DRAW)
            for place, (size, offset) in enumerate(((3, 0), (3, 12), (1, 24))):
                GL.glEnableVertexAttribArray(place)
                GL.glVertexAttribPointer(place, size, GL.GL_FLOAT, False, 28, ctypes.c_void_p(offset))
            self.meshes.append((body, array, len(data)))
        GL.glBindVertexArray(0)
        self.programs = {
            "picture": make_program(VERTEX, PICTURE),
            "deferred": make_program(VERTEX, DEFERRED),
            "sonar": make_program(VERTEX, "#version 330 core\n" + embed.glsl() + SONAR),
        }

    def draw(self, kind, view, projection, lattice=None, lobes=False, in_double=False):
        """Draw all bodies with one of the programs into the bound framebuffer.

        Parameters
        ----------
        view, projection : (4, 4), which multiply columns
        lattice : that of the sector
        lobes : whether smooth bodies have their specular lobe
        in_double : multiply view and world matrices in float64, on the CPU
        """
        program = self.programs[kind]
        GL.glUseProgram(program)

        def place(name):
            return GL.glGetUniformLocation(program, name)

        GL.glUniformMatrix4fv(place("projection"), 1, True, np.ascontiguousarray(projection, np.float32))
        if lattice is not None:
            GL.glUniformMatrix3fv(place("sonar_gl_lattice"), 1, True, np.asarray(lattice, np.float32))
        for number, (body, array, count) in enumerate(self.meshes, 1):
            matrices = (view @ body.pose, np.eye(4)) if in_double else (view, body.pose)
            for name, matrix in zip(("view", "world"), matrices, strict=True):
                GL.glUniformMatrix4fv(place(name), 1, True, np.ascontiguousarray(matrix, np.float32))
            GL.glUniform1ui(place("body"), number)
            GL.glUniform2f(place("lobe"), body.specular if lobes else 0.0, body.roughness_rad)
            GL.glBindVertexArray(array)
            GL.glDrawArrays(GL.GL_TRIANGLES, 0, count)

    def textures(self, view, projection, width, height, in_double=False):
        """Draw a view into textures, and return their names: z-buffer, normals, numbers and metres.

        in_double : as of `draw`
        """
        if (width, height) not in self.framebuffers:
            names = [new_texture() for _ in range(4)]
            framebuffer = GL.glGenFramebuffers(1)
            GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, framebuffer)
            for name, inside, layout, numbers, attachment in (
                (
                    names[0],
                    GL.GL_DEPTH_COMPONENT32F,
                    GL.GL_DEPTH_COMPONENT,
                    GL.GL_FLOAT,
                    GL.GL_DEPTH_ATTACHMENT,
                ),
                (names[1], GL.GL_RGBA32F, GL.GL_RGBA, GL.GL_FLOAT, GL.GL_COLOR_ATTACHMENT0),
                (names[2], GL.GL_R16UI, GL.GL_RED_INTEGER, GL.GL_UNSIGNED_SHORT, GL.GL_COLOR_ATTACHMENT1),
                (names[3], GL.GL_R32F, GL.GL_RED, GL.GL_FLOAT, GL.GL_COLOR_ATTACHMENT2),
            ):
                GL.glBindTexture(GL.GL_TEXTURE_2D, name)
                GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, inside, width, height, 0, layout, numbers, None)
                GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, attachment, GL.GL_TEXTURE_2D, name, 0)
            GL.glDrawBuffers(3, [GL.GL_COLOR_ATTACHMENT0 + k for k in range(3)])
            assert GL.glCheckFramebufferStatus(GL.GL_FRAMEBUFFER) == GL.GL_FRAMEBUFFER_COMPLETE
            GL.glBindTexture(GL.GL_TEXTURE_2D, 0)
            self.framebuffers[width, height] = framebuffer, names
        framebuffer, names = self.framebuffers[width, height]
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, framebuffer)
        GL.glViewport(0, 0, width, height)
        GL.glEnable(GL.GL_DEPTH_TEST)
        zero = np.zeros(4, np.float32)
        for k in (0, 2):
            GL.glClearBufferfv(GL.GL_COLOR, k, zero)
        GL.glClearBufferuiv(GL.GL_COLOR, 1, zero.view(np.uint32))
        GL.glClearBufferfv(GL.GL_DEPTH, 0, np.ones(1, np.float32))
        self.draw("deferred", view, projection, in_double=in_double)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, 0)
        return dict(zip(("z-buffer", "normals", "numbers", "metres"), names, strict=True))
