"""A host that draws sectors and hands over textures, and the changes of its OpenGL state by each call."""

from contextlib import suppress
from itertools import cycle, islice

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.embed import sensor as embed
from tests.support import soak
from tests.support.host_state import (
    ERRORS,
    GL,
    changes,
    enum,
    make_buffer,
    make_hostile,
    make_program,
    objects,
)
from tests.support.hosts import Scene

POSE = sg.pose(0.1, 0, 0, 0.1, 0.05, 0.2)
VERTEX = b"""#version 330 core
uniform mat4 view, projection;
layout(location = 0) in vec3 position;
void main() { gl_Position = projection * view * vec4(position, 1.0); }"""
FRAGMENT = "#version 330 core\n" + embed.glsl() + "void main() { sonar_gl_write(vec3(0.0), 0.7, 1u); }"
WIDTH, HEIGHT = 120, 50


class HostObjects:
    """A host's OpenGL objects: a ball with a program to draw it, and textures of a wall."""

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
        """Return the name of a new texture, which is left unbound."""
        gl, name = self.gl, self.gl.name("Textures")
        gl.BindTexture(enum("TEXTURE_2D"), name)
        size = 0, enum(inside), WIDTH, HEIGHT, 0
        gl.TexImage2D(enum("TEXTURE_2D"), *size, enum(layout), enum(numbers), data)
        gl.BindTexture(enum("TEXTURE_2D"), 0)
        return name

    def draw(self, sector):
        """Draw the ball into a sector."""
        gl = self.gl
        gl.UseProgram(self.program)
        for name in ("view", "projection"):
            at = gl.GetUniformLocation(self.program, name.encode())
            gl.UniformMatrix4fv(at, 1, 1, np.ascontiguousarray(getattr(sector, name), np.float32))
        at = gl.GetUniformLocation(self.program, b"sonar_gl_lattice")
        gl.UniformMatrix3fv(at, 1, 1, np.ascontiguousarray(sector.lattice, np.float32))
        gl.BindVertexArray(self.array)
        gl.DrawArrays(enum("TRIANGLES"), 0, self.count)


def run_both_modes(host_objects: HostObjects):
    """Use host-drawn sectors and textures; yield the name of each step and its pings."""
    sensor = embed.Sensor(soak.SONAR, sampling=sg.Sampling(2, 40))
    yield "make", []
    sectors = sensor.sectors(POSE)
    yield "aim", []
    for _ in range(2):  # the first time makes the framebuffers
        for sector in sectors:
            with sector:
                host_objects.draw(sector)
        yield "draw", []
    yield "finish", [sensor.finish(labels=True)]
    with suppress(KeyError), sectors[0]:
        host_objects.draw(sectors[0])
        raise KeyError
    yield "fail", []
    camera = sg.Camera.of_fov(WIDTH, HEIGHT, fov_x_rad=1.5)
    metres, normals, numbers = host_objects.textures
    more = {"holds": "planar", "normals": normals, "body_id": numbers, "labels": True}
    yield "textures", [sensor.ping_from_textures(metres, camera.projection(0.1, 50), POSE, **more)]
    with suppress(sg.Error):
        sensor.ping_from_textures(metres, camera.projection(0.1, 50), POSE)  # metres, not a z-buffer
    yield "refuse", []
    sensor.close()
    yield "close", []


def run(trial, state: str, first: int) -> tuple[dict, dict]:
    """Run both modes with pending errors of each kind; return the changes of state and objects, and the pings.

    For a host in state "working", the changes include the number of changed values of its frame after each step.

    trial : `embed_state.Trial` in a pristine state
    """
    host_objects, scene, frames = HostObjects(trial.gl), None, {}
    if state == "working":
        scene = Scene(trial.gl)
    elif state == "hostile":
        make_hostile(trial.gl)
    frame = scene and scene.draw()
    state_before, objects_before = trial.snapshot(), objects(trial.gl)
    changed, pings, steps = {}, {}, run_both_modes(host_objects)
    for n, pending in enumerate(islice(cycle([None, *ERRORS]), first, None)):
        if pending:
            trial.gl.make_error(pending)
        if (done := next(steps, None)) is None:
            break
        name, pings[done[0]] = f"{n} {done[0]}", done[1]
        changed[name] = changes(state_before | {"errors": [pending] if pending else []}, trial.snapshot())
        if scene:
            frames[name] = int((scene.draw() != frame).sum())
    trial.gl.errors()
    left = changes(objects_before, objects(trial.gl))
    trial.host.destroy()
    return {"changed": changed, "left": left, "frames": frames}, pings
