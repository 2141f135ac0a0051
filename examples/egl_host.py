"""A bare EGL program draws three things with OpenGL of its own, and pings them in two ways.

    python examples/egl_host.py [--out FOLDER]

Writes egl_host.png: what it draws, a ping of the same meshes by a context that joins its own, and a ping of
what it draws itself for the sonar.
"""

import argparse
import os
from ctypes import CFUNCTYPE, c_int, c_void_p, pointer
from functools import partial

os.environ["PYOPENGL_PLATFORM"] = "egl"

import numpy as np
import trimesh
from OpenGL import EGL, GL

import sonar_gl as sg
from sonar_gl.embed import sensor as embed
from sonar_gl.imaging.files import output_folder

VERTEX = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
uniform mat4 clip_from_world, world_from_body;
out vec3 facing;
void main() {
    facing = mat3(world_from_body) * normal;
    gl_Position = clip_from_world * world_from_body * vec4(position, 1.0);
}"""
PICTURE = """#version 330 core
in vec3 facing;
uniform vec3 colour;
out vec4 pixel;
void main() {
    float light = max(dot(normalize(facing), normalize(vec3(-0.6, 0.3, 0.7))), 0.0);
    pixel = vec4(colour * (0.4 + 0.6 * light), 1.0);
}"""
SONAR = f"""#version 330 core
{embed.glsl()}
uniform float reflectivity;
uniform uint number;
void main() {{ sonar_gl_write(vec3(0.0), reflectivity, number); }}"""  # vec3(0.0): faces are flat
MESHES = {
    "floor": trimesh.creation.box((40, 40, 0.2)),
    "pipe": trimesh.creation.cylinder(0.25, 3),
    "block": trimesh.creation.box((1, 1, 0.6)),
}
COLOURS = {"floor": (0.5, 0.48, 0.4), "pipe": (0.8, 0.6, 0.1), "block": (0.3, 0.5, 0.6)}
REFLECTIVITY = {"floor": 0.25, "pipe": 0.7, "block": 0.5}


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


def make_program(fragment):
    """The vertex shader and this one, linked."""
    program = GL.glCreateProgram()
    for kind, text in ((GL.GL_VERTEX_SHADER, VERTEX), (GL.GL_FRAGMENT_SHADER, fragment)):
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
    """All bodies into what is bound; OpenGL ignores uniforms that the program has not."""
    at = partial(GL.glGetUniformLocation, program)
    GL.glUseProgram(program)
    GL.glUniformMatrix4fv(at("clip_from_world"), 1, True, clip_from_world.astype(np.float32))
    for number, (name, (array, count)) in enumerate(arrays.items(), 1):
        GL.glUniformMatrix4fv(at("world_from_body"), 1, True, poses[name].astype(np.float32))
        GL.glUniform3f(at("colour"), *COLOURS[name])
        GL.glUniform1f(at("reflectivity"), REFLECTIVITY[name])
        GL.glUniform1ui(at("number"), number)
        GL.glBindVertexArray(array)
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, count)


def draw_picture(program, *what):
    """What a person would see."""
    GL.glClearColor(0.05, 0.2, 0.3, 1.0)
    GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
    GL.glEnable(GL.GL_DEPTH_TEST)
    draw(program, *what)


def draw_ping(sensor, place, program, arrays, poses):
    """Return the ping of what is drawn for each sector; OpenGL's state afterwards is what it was before."""
    for sector in sensor.sectors(place):
        with sector:
            GL.glUseProgram(program)
            lattice = GL.glGetUniformLocation(program, "sonar_gl_lattice")
            GL.glUniformMatrix3fv(lattice, 1, True, sector.lattice.astype(np.float32))
            draw(program, arrays, poses, sector.projection @ sector.view)
    return sensor.finish(labels=True, bodies=list(arrays))


def main(out="out"):
    """Draw, ping, draw again and write the picture; what was pinged comes back."""
    sonar, place = sg.load_sonar("p900-45").with_range(12.0), sg.pose(0, 0, 1.6, pitch=0.2)
    poses = {"floor": sg.pose(10, 0, -0.1), "pipe": sg.pose(6.5, 1.5, 0.25, roll=1.57)}

    display, context = make_context()
    width, height = 640, 600
    make_framebuffer(width, height)
    GL.glViewport(0, 0, width, height)
    picture_program, sonar_program = make_program(PICTURE), make_program(SONAR)
    arrays = {name: make_vertex_array(mesh) for name, mesh in MESHES.items()}
    camera = sg.Camera.of_fov(width, height, fov_y_rad=0.75)
    clip_from_world = camera.projection(0.1, 50.0) @ np.linalg.inv(camera.pose_gl(place))

    # Embedding mode 1: the sonar joins the current context; each ping says where the bodies are.
    scene = sg.Scene([sg.Body(name, mesh, reflectivity=REFLECTIVITY[name]) for name, mesh in MESHES.items()])
    with sg.Simulator(scene, sonar, context="current") as simulator:
        for x in (6.5, 7.5):
            poses["block"] = sg.pose(x, -1, 0.3, yaw=0.4)
            draw_picture(picture_program, arrays, poses, clip_from_world)
            ping = simulator.ping(place, bodies=poses, labels=True)
            echoes = zip(MESHES, ping.body_echo[1:], strict=True)
            print(f"block at x = {x} m: " + ", ".join(f"{name} {echo:.3g}" for name, echo in echoes))

    # Embedding mode 2: this program draws for the sonar, here with as many samples as mode 1 took.
    with embed.Sensor(sonar, sampling=sg.Sampling(**ping.meta["sampling"])) as sensor:
        drawn_ping = draw_ping(sensor, place, sonar_program, arrays, poses)

    pixels = GL.glReadPixels(0, 0, width, height, GL.GL_RGB, GL.GL_UNSIGNED_BYTE)
    picture = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)[::-1]
    fans = [sg.colorize(sg.fan_image(one, height=height)) for one in (ping, drawn_ping)]
    sg.save_png(output_folder(out) / "egl_host.png", np.hstack([picture, *fans]))
    EGL.eglDestroyContext(display, context)
    EGL.eglTerminate(display)
    return {
        "scene": scene, "sonar": sonar, "pose": place, "bodies": poses,
        "ping": ping, "drawn_ping": drawn_ping,
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the picture")
    main(parser.parse_args().out)
