"""A bare EGL program draws three things with OpenGL of its own, and pings them.

    python examples/egl_host.py [--out FOLDER]

Writes egl_host.png: what it draws, and a ping of the same meshes by a context that joins its own.
"""

import argparse
import os
from ctypes import CFUNCTYPE, c_int, c_void_p, pointer

os.environ["PYOPENGL_PLATFORM"] = "egl"

import numpy as np
import trimesh
from OpenGL import EGL, GL

import sonar_gl as sg
from sonar_gl.export import output_folder

VERTEX = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
uniform mat4 clip_from_world, world_from_body;
out vec3 facing;
void main() {
    facing = mat3(world_from_body) * normal;
    gl_Position = clip_from_world * world_from_body * vec4(position, 1.0);
}"""
FRAGMENT = """#version 330 core
in vec3 facing;
uniform vec3 colour;
out vec4 pixel;
void main() {
    float light = max(dot(normalize(facing), normalize(vec3(-0.6, 0.3, 0.7))), 0.0);
    pixel = vec4(colour * (0.4 + 0.6 * light), 1.0);
}"""
COLOURS = {"floor": (0.5, 0.48, 0.4), "pipe": (0.8, 0.6, 0.1), "block": (0.3, 0.5, 0.6)}


def make_context():
    """An OpenGL 3.3 context on EGL's first device, with no window system, current."""
    query = CFUNCTYPE(c_int, c_int, c_void_p, c_void_p)(EGL.eglGetProcAddress("eglQueryDevicesEXT"))
    display_of = CFUNCTYPE(EGL.EGLDisplay, c_int, c_void_p, c_void_p)(
        EGL.eglGetProcAddress("eglGetPlatformDisplayEXT")
    )
    device, number = c_void_p(), EGL.EGLint()
    query(1, pointer(device), pointer(number))
    display, config = display_of(0x313F, device, None), EGL.EGLConfig()  # EGL_PLATFORM_DEVICE_EXT
    EGL.eglInitialize(display, None, None)
    EGL.eglBindAPI(EGL.EGL_OPENGL_API)
    wanted = (EGL.EGLint * 5)(
        EGL.EGL_SURFACE_TYPE, EGL.EGL_PBUFFER_BIT, EGL.EGL_RENDERABLE_TYPE, EGL.EGL_OPENGL_BIT, EGL.EGL_NONE
    )
    EGL.eglChooseConfig(display, wanted, pointer(config), 1, pointer(number))
    version = (EGL.EGLint * 5)(0x3098, 3, 0x30FB, 3, EGL.EGL_NONE)  # EGL_CONTEXT_MAJOR_ and MINOR_VERSION
    context = EGL.eglCreateContext(display, config, EGL.EGL_NO_CONTEXT, version)
    EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, context)
    return display, context


def make_program():
    """Both shaders, linked."""
    program = GL.glCreateProgram()
    for kind, text in ((GL.GL_VERTEX_SHADER, VERTEX), (GL.GL_FRAGMENT_SHADER, FRAGMENT)):
        shader = GL.glCreateShader(kind)
        GL.glShaderSource(shader, text)
        GL.glCompileShader(shader)
        GL.glAttachShader(program, shader)
    GL.glLinkProgram(program)
    return program


def make_vertex_array(mesh):
    """(vertex array, number of vertices) of flat triangles."""
    data = np.stack([mesh.triangles, np.repeat(mesh.face_normals[:, None], 3, axis=1)], axis=2)
    data = np.ascontiguousarray(data, np.float32)
    array, buffer = GL.glGenVertexArrays(1), GL.glGenBuffers(1)
    GL.glBindVertexArray(array)
    GL.glBindBuffer(GL.GL_ARRAY_BUFFER, buffer)
    GL.glBufferData(GL.GL_ARRAY_BUFFER, data.nbytes, data, GL.GL_STATIC_DRAW)
    for location in (0, 1):
        GL.glEnableVertexAttribArray(location)
        GL.glVertexAttribPointer(location, 3, GL.GL_FLOAT, False, 24, c_void_p(12 * location))
    return array, 3 * len(mesh.faces)


def make_framebuffer(width, height):
    """A framebuffer with colour and depth, bound."""
    GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, GL.glGenFramebuffers(1))
    for kind, attachment in (
        (GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0),
        (GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT),
    ):
        buffer = GL.glGenRenderbuffers(1)
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
        GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, width, height)
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)


def draw(program, arrays, poses, clip_from_world):
    """All bodies into what is bound."""

    def put(name, matrix):
        GL.glUniformMatrix4fv(GL.glGetUniformLocation(program, name), 1, True, matrix.astype(np.float32))

    GL.glClearColor(0.05, 0.2, 0.3, 1.0)
    GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
    GL.glEnable(GL.GL_DEPTH_TEST)
    GL.glUseProgram(program)
    put("clip_from_world", clip_from_world)
    for name, (array, count) in arrays.items():
        put("world_from_body", poses[name])
        GL.glUniform3f(GL.glGetUniformLocation(program, "colour"), *COLOURS[name])
        GL.glBindVertexArray(array)
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, count)


def main(out="out"):
    """Draw, ping, draw again and write the picture; what was pinged comes back."""
    sonar, place = sg.load_sonar("p900-45").with_range(12.0), sg.pose(0, 0, 1.6, pitch=0.2)
    meshes = {
        "floor": trimesh.creation.box((40, 40, 0.2)),
        "pipe": trimesh.creation.cylinder(0.25, 3),
        "block": trimesh.creation.box((1, 1, 0.6)),
    }
    poses = {
        "floor": sg.pose(10, 0, -0.1),
        "pipe": sg.pose(6.5, 1.5, 0.25, roll=1.57),
        "block": sg.pose(7, -1, 0.3),
    }

    display, context = make_context()
    width, height = 640, 600
    make_framebuffer(width, height)
    GL.glViewport(0, 0, width, height)
    program = make_program()
    arrays = {name: make_vertex_array(mesh) for name, mesh in meshes.items()}
    camera = sg.Camera.of_fov(width, height, fov_y_rad=0.75)
    clip_from_world = camera.projection(0.1, 50.0) @ np.linalg.inv(camera.pose_gl(place))

    # Door 1: the sonar joins the context that is current, and is told where bodies are, ping by ping.
    scene = sg.Scene([sg.Body(name, mesh) for name, mesh in meshes.items()])
    with sg.Simulator(scene, sonar, context="current") as simulator:
        for x in (6.5, 7.5):
            poses["block"] = sg.pose(x, -1, 0.3, yaw=0.4)
            draw(program, arrays, poses, clip_from_world)
            ping = simulator.ping(place, bodies=poses, labels=True)
            echoes = zip(meshes, ping.body_echo[1:], strict=True)
            print(f"block at x = {x} m: " + ", ".join(f"{name} {echo:.3g}" for name, echo in echoes))
    # Door 2: this program draws with its own shader, sector by sector.
    # Door 3: this program hands over textures that it drew into.

    pixels = GL.glReadPixels(0, 0, width, height, GL.GL_RGB, GL.GL_UNSIGNED_BYTE)
    picture = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)[::-1]
    fan = sg.colorize(sg.fan_image(ping, height=height))
    sg.save_png(output_folder(out) / "egl_host.png", np.hstack([picture, fan]))
    EGL.eglDestroyContext(display, context)
    EGL.eglTerminate(display)
    return {"scene": scene, "sonar": sonar, "pose": place, "bodies": poses, "ping": ping}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the picture")
    main(parser.parse_args().out)
