"""What becomes of a host's context while it draws a sonar's sectors itself, or hands over textures."""

from contextlib import suppress
from itertools import cycle, islice

import numpy as np
import soak
import trimesh
from host_state import ERRORS, GL, changes, enum, make_buffer, make_hostile, make_program, objects
from hosts import Scene

import sonar_gl as sg
from sonar_gl import embed

POSE = sg.pose(0.1, 0, 0, 0.1, 0.05, 0.2)
VERTEX = b"""#version 330 core
uniform mat4 view, projection;
layout(location = 0) in vec3 position;
void main() { gl_Position = projection * view * vec4(position, 1.0); }"""
FRAGMENT = "#version 330 core\n" + embed.glsl() + "void main() { sonar_gl_write(vec3(0.0), 0.7, 1u); }"
WIDTH, HEIGHT = 120, 50


class Things:
    """What the host has: a ball with a program to draw it, and textures of a wall; made in plain state."""

    def __init__(self, gl: GL):
        self.gl = gl
        ball = trimesh.creation.icosphere(3, 1.0).apply_translation((6, 1, 0))
        self.count = 3 * len(ball.faces)
        self.program, self.array = make_program(gl, VERTEX, FRAGMENT.encode()), gl.name("VertexArrays")
        gl.BindVertexArray(self.array)
        make_buffer(gl, "ARRAY_BUFFER", np.ascontiguousarray(ball.triangles, np.float32))
        gl.VertexAttribPointer(0, 3, enum("FLOAT"), 0, 12, None)
        gl.EnableVertexAttribArray(0)
        self.textures = [
            self.texture("R32F", "RED", "FLOAT", np.full((HEIGHT, WIDTH), 7, np.float32)),
            self.texture("RGBA32F", "RGBA", "FLOAT", np.tile(np.float32([0, 0, 1, 0]), (HEIGHT, WIDTH, 1))),
            self.texture("R16UI", "RED_INTEGER", "UNSIGNED_SHORT", np.full((HEIGHT, WIDTH), 3, np.uint16)),
        ]

    def texture(self, inside, layout, numbers, data):
        """The name of one, bound nowhere."""
        gl, name = self.gl, self.gl.name("Textures")
        gl.BindTexture(enum("TEXTURE_2D"), name)
        size = 0, enum(inside), WIDTH, HEIGHT, 0
        gl.TexImage2D(enum("TEXTURE_2D"), *size, enum(layout), enum(numbers), data)
        gl.BindTexture(enum("TEXTURE_2D"), 0)
        return name

    def draw(self, sector):
        """The ball, into a sector."""
        gl = self.gl
        gl.UseProgram(self.program)
        for name in ("view", "projection"):
            at = gl.GetUniformLocation(self.program, name.encode())
            gl.UniformMatrix4fv(at, 1, 1, np.ascontiguousarray(getattr(sector, name), np.float32))
        at = gl.GetUniformLocation(self.program, b"sonar_gl_lattice")
        gl.UniformMatrix3fv(at, 1, 1, np.ascontiguousarray(sector.lattice, np.float32))
        gl.BindVertexArray(self.array)
        gl.DrawArrays(enum("TRIANGLES"), 0, self.count)


def use(things: Things):
    """Go through both doors: yields (name, pings that came of it) after each step."""
    sensor = embed.Sensor(soak.SONAR, sampling=sg.Sampling(2, 40))
    yield "make", []
    sectors = sensor.sectors(POSE)
    yield "aim", []
    for _ in range(2):  # the first time framebuffers are made
        for sector in sectors:
            with sector:
                things.draw(sector)
        yield "draw", []
    yield "finish", [sensor.finish(labels=True)]
    with suppress(KeyError), sectors[0]:
        things.draw(sectors[0])
        raise KeyError
    yield "fail", []
    camera = sg.Camera.of_fov(WIDTH, HEIGHT, fov_x_rad=1.5)
    metres, normals, numbers = things.textures
    more = {"holds": "planar", "normals": normals, "body_id": numbers, "labels": True}
    yield "textures", [sensor.ping_from_textures(metres, camera.projection(0.1, 50), POSE, **more)]
    with suppress(sg.Error):
        sensor.ping_from_textures(metres, camera.projection(0.1, 50), POSE)  # which is no z-buffer
    yield "refuse", []
    sensor.close()
    yield "close", []


def run(trial, state: str, first: int) -> tuple[dict, dict]:
    """What changed by each step, an error of each kind pending or none, and what was left; and the pings.

    Of a host that works, too, how many numbers of its frame are others after each step.

    trial : of `embed_state.Trial`, pristine
    """
    things, scene, frames = Things(trial.gl), None, {}
    if state == "working":
        scene = Scene(trial.gl)
    elif state == "hostile":
        make_hostile(trial.gl)
    frame = scene and scene.draw()
    before, there = trial.snapshot(), objects(trial.gl)
    changed, pings, doing = {}, {}, use(things)
    for n, pending in enumerate(islice(cycle([None, *ERRORS]), first, None)):
        if pending:
            trial.gl.make_error(pending)
        if (done := next(doing, None)) is None:
            break
        name, pings[done[0]] = f"{n} {done[0]}", done[1]
        changed[name] = changes(before | {"errors": [pending] if pending else []}, trial.snapshot())
        if scene:
            frames[name] = int((scene.draw() != frame).sum())
    trial.gl.errors()
    left = changes(there, objects(trial.gl))
    trial.host.destroy()
    return {"changed": changed, "left": left, "frames": frames}, pings
