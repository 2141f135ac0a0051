"""A program that compares a host's OpenGL state before and after all that a sonar does in its context.

    embed_state.py egl 3.3 | 4.1 | 4.5
    embed_state.py glx 3.3 | 4.1 | 4.5 | compatible

It prints one JSON object, which tests/gl/test_state_guard.py checks. Mesa gives a host exactly that version
only if MESA_GL_VERSION_OVERRIDE is set.
"""

import ctypes
import json
import sys
from dataclasses import replace
from itertools import cycle, islice

import moderngl
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.embed import sensor as embed
from sonar_gl.gl import context as gl
from sonar_gl.gl.host import CurrentContext
from sonar_gl.gl.state_guard import StateGuard
from sonar_gl.raster.opengl import engine as opengl
from tests.support import embed_modes, soak
from tests.support.host_state import (
    ERRORS,
    changes,
    enum,
    make_buffer,
    make_hostile,
    make_program,
    make_texture,
    objects,
    snapshot,
)
from tests.support.hosts import HOSTS, SIZE, Scene

POSE = sg.pose(0.2, 0.1, -0.5, 0.1, 0.15, 0.05)
MULTIPATH = sg.Acoustics.physical(multipath="incoherent")
STATES = "pristine", "working", "hostile"


def arrays_of(one) -> list:
    """Return the arrays of a ping or a G-buffer."""
    if isinstance(one, sg.Ping):
        return [one.intensity, one.body_id, one.elevation_rad, one.body_echo]
    return [one.range_m, one.normal, one.echo, one.body_id]


def use(context=None):
    """Do all that can be done with a simulator. Yield (name, pings or G-buffers) after each step."""
    scene = sg.Scene(soak.make_bodies(), surface_z_m=3.0)
    simulator = sg.Simulator(scene, soak.SONAR, sampling=sg.Sampling(2, 40), context=context)
    yield "construct", []
    yield "ping", [simulator.ping(POSE)]
    yield "labels", [simulator.ping(POSE, labels=True)]
    yield "pings", list(simulator.pings([soak.pose_of(k) for k in range(4)]))
    simulator.place({"ball": sg.pose(6, 1, -1)})
    yield "place", []
    simulator.add(sg.Body("rod", trimesh.creation.cylinder(0.2, 3.0), sg.pose(5, -1, -1)))
    yield "add", []
    yield "ping after the changes", [simulator.ping(POSE, labels=True)]
    other = sg.Simulator(simulator, replace(soak.SONAR, n_beams=32), MULTIPATH, tolerance=0.1)
    yield "second", []
    yield "multipath", [other.ping(POSE)]
    yield "gbuffers", simulator.gbuffers(POSE)
    simulator.point_cloud(POSE, 20, 5)
    yield "point cloud", []
    other.close()
    yield "close second", []
    simulator.close()
    yield "close", []


def wrong(got, wanted) -> int:
    """Return how many bytes of pings or G-buffers differ."""
    n = 0
    for one, other in zip(got, wanted, strict=True):
        for a, b in zip(arrays_of(one), arrays_of(other), strict=True):
            n += a is not b and int((np.asarray(a).view(np.uint8) != np.asarray(b).view(np.uint8)).sum())
    return n


class HostRun:
    """A host whose context is in one of STATES."""

    def __init__(self, kind: str, version, state: str):
        self.host = HOSTS[kind](version)
        self.gl, self.scene = self.host.gl, None
        if state == "working":
            self.scene = Scene(self.gl)
        elif state == "hostile":
            make_hostile(self.gl)

    def snapshot(self):
        return snapshot(self.gl, self.host.platform)

    def run(self, wanted, first: int) -> dict:
        """Take each step of `use` with another error pending, or none, and compare the state after it.

        Parameters
        ----------
        wanted : dict from the steps' names to the pings of a simulator with a context of its own
        first : index of the error that is pending at the first step

        Returns
        -------
        dict of the state that each step changed, the wrong bytes of its pings, the wrong bytes of the host's
        frame after it, and the objects that are left
        """
        before, there = self.snapshot(), objects(self.gl)
        out = {"values": len(before), "changed": {}, "wrong": {}, "frames": {}}
        frame, doing = self.scene and self.scene.draw(), use("current")
        for pending in islice(cycle([None, *ERRORS]), first, None):
            if pending:
                self.gl.make_error(pending)
            if (done := next(doing, None)) is None:
                break
            name, got = done
            after = self.snapshot()
            out["changed"][name] = changes(before | {"errors": [pending] if pending else []}, after)
            out["wrong"][name] = wrong(got, wanted[name])
            if self.scene:
                out["frames"][name] = int((self.scene.draw() != frame).sum())
        self.gl.errors()
        out["left"] = changes(there, objects(self.gl))
        out["colours"] = len(np.unique(frame.reshape(-1, 4), axis=0)) if self.scene else 0
        self.host.destroy()
        return out


class Naive:
    """A host's context as it is, without a guard; it stands in for `HostContext`."""

    is_gone = False

    def __init__(self, host):
        self.load_opengl_function, self.gl = host.address_of, host.gl

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def is_in_reach(self):
        return True

    def release(self):
        pass


def naive(kind, version, state, wanted) -> dict:
    """Return how many values change, and how many bytes of a ping are wrong, without a guard."""
    trial, join = HostRun(kind, version, state), opengl.join
    if "MESA_pack_invert" in trial.gl.has:  # with skipped rows, Mesa would write outside the array
        trial.gl.PixelStorei(enum("PACK_INVERT_MESA"), 0)
    if trial.gl.is_compatible:  # llvmpipe would crash on lines with a flat integer, the numbers of bodies
        trial.gl.PolygonMode(enum("FRONT_AND_BACK"), enum("FILL"))
    before, frame = trial.snapshot(), trial.scene and trial.scene.draw()
    opengl.join = lambda: gl.make_context(Naive(CurrentContext()))
    try:
        doing = use("current")
        next(doing)
        _, (ping,) = next(doing)
        out = {"wrong": wrong([ping], wanted["ping"])}
    except Exception as why:  # moderngl raises plain Exception
        out = {"error": f"{type(why).__name__}: {why}"}
    finally:
        opengl.join = join
    out["changed"] = sorted(changes(before, trial.snapshot()))
    out["frame"] = int((trial.scene.draw() != frame).sum()) if trial.scene else 0
    doing.close()
    return out


def plain_draw(gl) -> np.ndarray:
    """Draw a triangle, relying on OpenGL's default state. Return (SIZE, SIZE, 5) float32: RGBA and depth."""
    framebuffer, array = gl.name("Framebuffers"), gl.name("VertexArrays")
    colour, depth = gl.name("Renderbuffers"), gl.name("Renderbuffers")
    gl.BindFramebuffer(enum("FRAMEBUFFER"), framebuffer)
    for at, kind, one in (
        ("COLOR_ATTACHMENT0", "RGBA32F", colour),
        ("DEPTH_ATTACHMENT", "DEPTH_COMPONENT24", depth),
    ):
        gl.BindRenderbuffer(enum("RENDERBUFFER"), one)
        gl.RenderbufferStorage(enum("RENDERBUFFER"), enum(kind), SIZE, SIZE)
        gl.FramebufferRenderbuffer(enum("FRAMEBUFFER"), enum(at), enum("RENDERBUFFER"), one)
    gl.BindVertexArray(array)
    buffer = make_buffer(gl, "ARRAY_BUFFER", np.array([[-1, -1, 0.5], [3, -1, 0], [-1, 0.5, 1]], np.float32))
    gl.VertexAttribPointer(0, 3, enum("FLOAT"), 0, 12, None)
    gl.EnableVertexAttribArray(0)
    program = make_program(gl)
    gl.UseProgram(program)
    gl.Uniform4f(gl.GetUniformLocation(program, b"colour"), 2.5, -1.0, 0.25, 0.1)
    texture = make_texture(gl, "TEXTURE_2D")  # unbound when it is deleted
    gl.Viewport(0, 0, SIZE, SIZE)
    gl.Enable(enum("DEPTH_TEST"))
    gl.Enable(enum("BLEND"))
    gl.Clear(enum("COLOR_BUFFER_BIT") | enum("DEPTH_BUFFER_BIT"))
    gl.DrawArrays(enum("TRIANGLES"), 0, 3)
    out = np.zeros((SIZE, SIZE, 5), np.float32)
    gl.ReadPixels(0, 0, SIZE, SIZE, enum("RGBA"), enum("FLOAT"), out)
    gl.ReadPixels(0, 0, SIZE, SIZE, enum("DEPTH_COMPONENT"), enum("FLOAT"), out.ravel()[4 * SIZE**2 :])
    for kind, one in (
        ("Framebuffers", framebuffer),
        ("VertexArrays", array),
        ("Renderbuffers", colour),
        ("Renderbuffers", depth),
        ("Buffers", buffer),
        ("Textures", texture),
    ):
        getattr(gl, f"Delete{kind}")(1, np.array([one], np.uint32))
    gl.DeleteProgram(program)
    return out


ON_BY_DEFAULT = ["MULTISAMPLE", "DITHER"]


def guarded(kind, version, state, wanted) -> dict:
    """Use the guard alone in a host's context, and compare what its blocks draw and what they change."""
    trial = HostRun(kind, version, state)
    guard, before = StateGuard(CurrentContext().gl), trial.snapshot()
    out = {"made": changes(before, trial.snapshot())}
    with guard:
        drawn = [plain_draw(trial.gl)]
        out["errors inside"] = trial.gl.errors()
        out["on inside"] = [name for name in ON_BY_DEFAULT if trial.gl.IsEnabled(enum(name))]
    out["block"] = changes(before, trial.snapshot())
    with pytest.raises(KeyError), guard:
        plain_draw(trial.gl)
        raise KeyError
    out["raises"] = changes(before, trial.snapshot())
    with guard:
        inner = trial.snapshot()
        with guard:
            plain_draw(trial.gl)
        out["nested"] = changes(inner, trial.snapshot())
        drawn.append(plain_draw(trial.gl))
    out["around nested"] = changes(before, trial.snapshot())
    for error in ERRORS:
        trial.gl.make_error(error)
        with guard:
            drawn.append(plain_draw(trial.gl))
        out[error] = changes(before | {"errors": [error]}, trial.snapshot())
    out["drawn wrongly"] = [int((one != wanted).sum()) for one in drawn]
    with guard:
        make_hostile(trial.gl)
    changed = changes(before, trial.snapshot())
    out["not restored"] = sorted({name.split("[")[0] for name in changed})
    trial.host.destroy()
    return out


BOUND = {
    "VERTEX_ARRAY_BINDING": "VertexArrays",
    "ARRAY_BUFFER_BINDING": "Buffers",
    "COPY_READ_BUFFER": "Buffers",
    "PIXEL_PACK_BUFFER_BINDING": "Buffers",
    "PIXEL_UNPACK_BUFFER_BINDING": "Buffers",
    "DRAW_FRAMEBUFFER_BINDING": "Framebuffers",
    "READ_FRAMEBUFFER_BINDING": "Framebuffers",
    "RENDERBUFFER_BINDING": "Renderbuffers",
    "TEXTURE_BINDING_2D": "Textures",
}


def deleting(kind, version) -> dict:
    """Delete bound objects of a host, in a block or before it. Return what is bound and pending after it."""
    trial = HostRun(kind, version, "hostile")
    gl, guard = trial.gl, StateGuard(CurrentContext().gl)
    gl.BindVertexArray(gl.name("VertexArrays"))
    bound = {name: gl.integer(name) for name in (*BOUND, "CURRENT_PROGRAM")}
    gl.DeleteProgram(bound["CURRENT_PROGRAM"])  # exists until another one is used
    gl.make_error("INVALID_VALUE")
    with guard:
        plain_draw(gl)
        for name, objects_ in BOUND.items():
            getattr(gl, f"Delete{objects_}")(1, np.array([bound[name]], np.uint32))
    after = {name: gl.integer(name) for name in bound}
    out = {"before": bound, "errors": gl.errors(), "after": after}
    trial.host.destroy()
    return out


CALLBACK = ctypes.CFUNCTYPE(None, *[ctypes.c_uint] * 4, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p)


def debug_callback(kind, version) -> dict:
    """Return how often a host's debug callback was called, and which errors were pending after it."""
    trial = HostRun(kind, version, "pristine")
    gl, guard, calls, out = trial.gl, StateGuard(CurrentContext().gl), [], {}
    callback = CALLBACK(lambda *_: calls.append(None))
    gl.Enable(enum("DEBUG_OUTPUT"))
    gl.Enable(enum("DEBUG_OUTPUT_SYNCHRONOUS"))
    gl.DebugMessageControl(enum("DONT_CARE"), enum("DONT_CARE"), enum("DONT_CARE"), 0, None, 0)
    gl.DebugMessageControl(enum("DONT_CARE"), enum("DEBUG_TYPE_ERROR"), enum("DONT_CARE"), 0, None, 1)
    gl.DebugMessageCallback(callback, None)

    def note(name):
        out[name] = len(calls), gl.errors()
        calls.clear()

    for error in ERRORS:
        gl.make_error(error)
        calls.clear()
        with guard:
            gl.make_error("INVALID_ENUM")
        note(error)
    with guard:
        gl.make_error("INVALID_ENUM")
        gl.errors()
        guard.resume_debug_output()
        gl.make_error("INVALID_VALUE")
        guard.save_host_errors()
        gl.make_error("INVALID_ENUM")
    note("while the host draws")
    with embed.Sensor(soak.SONAR, sampling=sg.Sampling(1, 8)) as sensor:
        sector, *_ = sensor.sectors(POSE)
        with sector:
            gl.make_error("INVALID_VALUE")
    note("in a sector")
    gl.make_error("INVALID_ENUM")
    note("after")
    gl.Disable(enum("DEBUG_OUTPUT"))
    with guard:
        guard.resume_debug_output()
        gl.make_error("INVALID_VALUE")
        guard.save_host_errors()
    note("switched off")
    gl.DebugMessageCallback(None, None)
    trial.host.destroy()
    return out


def host_with_moderngl(kind, version, wanted) -> dict:
    """Use a simulator beside a host that uses moderngl, too, and whose context is moderngl's default."""
    trial = HostRun(kind, version, "pristine")
    mine = moderngl.create_context()
    buffer, same, wrongs = mine.buffer(b"mine"), [], 0
    for name, got in use("current"):
        same.append(moderngl.get_context() is mine)
        wrongs += wrong(got, wanted[name])
    out = {"same": all(same), "wrong": wrongs, "buffer": buffer.read().decode()}
    mine.release()
    trial.host.destroy()
    return out


def main(kind: str, version: str):
    """Print the results of all trials."""
    wanted = dict(use())  # before a GLX context is current, beside which EGL refuses
    version = None if version == "compatible" else tuple(map(int, version.split(".")))
    trial = HostRun(kind, version, "pristine")
    out = {
        "version": trial.gl.version,
        "name": trial.gl.text("VERSION"),
        "compatible": trial.gl.is_compatible,
    }
    triangle = plain_draw(trial.gl)
    trial.host.destroy()
    out["runs"] = {s: HostRun(kind, version, s).run(wanted, 2 * k) for k, s in enumerate(STATES)}
    out["guard"] = {state: guarded(kind, version, state, triangle) for state in STATES}
    out["deleting"], out["debug callback"] = deleting(kind, version), debug_callback(kind, version)
    out["moderngl"] = host_with_moderngl(kind, version, wanted)
    out["modes"], pings = {}, {}
    for k, state in enumerate(STATES):
        out["modes"][state], pings[state] = embed_modes.run(HostRun(kind, version, "pristine"), state, 3 * k)
        wrongs = [wrong(pings[state][name], pings["pristine"][name]) for name in pings["pristine"]]
        out["modes"][state]["wrong"] = sum(wrongs)
    out["naive"] = {state: naive(kind, version, state, wanted) for state in STATES}
    print(json.dumps(out, default=str))


if __name__ == "__main__":
    main(*sys.argv[1:])
