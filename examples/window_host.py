"""A window to swim about in: glfw and moderngl draw, and a sonar pings ten times a second.

    python examples/window_host.py [--frames N] [--out FOLDER]

Arrow keys: ahead, back, and turns to port and starboard. The last fan image hangs in the window's lower right
corner. With --frames it ends by itself after so many, and writes window_host.png, a picture of the window.
"""

import argparse
import sys
import warnings

import glfw
import moderngl
import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.imaging.files import output_folder

WIDTH, HEIGHT, FAN_HEIGHT = 960, 600, 280
PING_PERIOD_S = 0.1
SPEED_M_S, TURN_RAD_S = 1.0, 0.6
BODIES = [
    ("floor", trimesh.creation.box((60, 60, 0.2)), sg.pose(10, 0, -0.1), (0.55, 0.5, 0.4)),
    ("pile", trimesh.creation.cylinder(0.3, 4), sg.pose(7, 1.5, 2), (0.7, 0.25, 0.1)),
    ("crate", trimesh.creation.box((0.9, 0.9, 0.9)), sg.pose(6, -1.3, 0.45, yaw=0.4), (0.3, 0.4, 0.45)),
    ("buoy", trimesh.creation.icosphere(3, 0.4), sg.pose(9, -0.2, 1.2), (0.2, 0.5, 0.3)),
]
WORLD_SHADERS = {
    "vertex_shader": """#version 330 core
        in vec3 position, normal;
        uniform mat4 clip_from_world;
        out vec3 facing;
        void main() { facing = normal; gl_Position = clip_from_world * vec4(position, 1.0); }""",
    "fragment_shader": """#version 330 core
        in vec3 facing;
        uniform vec3 colour;
        out vec4 pixel;
        void main() {
            float light = max(dot(normalize(facing), normalize(vec3(-0.6, 0.3, 0.7))), 0.0);
            pixel = vec4(colour * (0.4 + 0.6 * light), 1.0);
        }""",
}
CORNER_SHADERS = {
    "vertex_shader": """#version 330 core
        out vec2 at;
        void main() {
            at = vec2(gl_VertexID % 2, gl_VertexID / 2);
            gl_Position = vec4(2.0 * at - 1.0, 0.0, 1.0);
        }""",
    "fragment_shader": """#version 330 core
        in vec2 at;
        uniform sampler2D fan;
        out vec4 pixel;
        void main() { pixel = texture(fan, vec2(at.x, 1.0 - at.y)); }""",  # a picture's first row is the top
}


def open_window():
    """A window of OpenGL 3.3 core, current."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)  # says the same at greater length
        has_display = glfw.init()
    if not has_display:
        print(
            "error: a display is needed (without one: xvfb-run python examples/window_host.py --frames 60)",
            file=sys.stderr,
        )
        raise SystemExit(2)
    for hint, value in (
        (glfw.CONTEXT_VERSION_MAJOR, 3),
        (glfw.CONTEXT_VERSION_MINOR, 3),
        (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
        (glfw.RESIZABLE, False),
    ):
        glfw.window_hint(hint, value)
    window = glfw.create_window(WIDTH, HEIGHT, "A sonar's place", None, None)
    glfw.make_context_current(window)
    glfw.swap_interval(1)
    return window


def moved(place, window, seconds):
    """Where the keys lead from `place`, x y yaw, in some seconds."""
    ahead, turn = (
        (glfw.get_key(window, more) == glfw.PRESS) - (glfw.get_key(window, less) == glfw.PRESS)
        for more, less in ((glfw.KEY_UP, glfw.KEY_DOWN), (glfw.KEY_LEFT, glfw.KEY_RIGHT))
    )
    x, y, yaw = place
    ahead_m = ahead * SPEED_M_S * seconds
    yaw = (yaw + turn * TURN_RAD_S * seconds) % (2 * np.pi)
    return x + ahead_m * np.cos(yaw), y + ahead_m * np.sin(yaw), yaw


def sonar_pose(place):
    """1.6 m above the floor, pitched down a little."""
    x, y, yaw = place
    return sg.pose(x, y, 1.6, pitch=0.2, yaw=yaw)


class View:
    """What the window shows: the world from a pose, and the last fan image in a corner."""

    def __init__(self, gl, fan):
        self.gl, self.camera = gl, sg.Camera.of_fov(WIDTH, HEIGHT, fov_y_rad=0.75)
        self.world, corner = gl.program(**WORLD_SHADERS), gl.program(**CORNER_SHADERS)
        self.arrays = []
        for _, mesh, pose, colour in BODIES:
            placed = mesh.copy().apply_transform(pose)
            normals = np.repeat(placed.face_normals[:, None], 3, axis=1)
            data = gl.buffer(np.concatenate([placed.triangles, normals], axis=2).astype("f4"))
            self.arrays.append((gl.vertex_array(self.world, [(data, "3f 3f", "position", "normal")]), colour))
        self.corner = gl.vertex_array(corner, [])
        self.fan = gl.texture(fan.shape[1::-1], 3, fan.tobytes(), alignment=1)

    def draw(self, pose):
        """All of it, into the window's next frame."""
        self.gl.screen.use()
        self.gl.viewport = 0, 0, WIDTH, HEIGHT
        self.gl.clear(0.05, 0.2, 0.3)
        self.gl.enable_only(moderngl.DEPTH_TEST)
        clip_from_world = self.camera.projection(0.1, 60.0) @ np.linalg.inv(self.camera.pose_gl(pose))
        self.world["clip_from_world"] = clip_from_world.T.ravel().tolist()  # OpenGL stores columns
        for array, colour in self.arrays:
            self.world["colour"] = colour
            array.render()
        self.gl.enable_only(moderngl.NOTHING)
        self.gl.viewport = WIDTH - self.fan.width, 0, *self.fan.size
        self.fan.use()
        self.corner.render(moderngl.TRIANGLE_STRIP, vertices=4)


def fan_picture(ping):
    """(H, W, 3) for the corner."""
    return sg.colorize(sg.fan_image(ping, height=FAN_HEIGHT))


def main(out="out", frames=None):
    """Run the window; what was pinged last comes back."""
    window = open_window()
    gl = moderngl.create_context()
    sonar = sg.load_sonar("p900-45").with_range(12.0)
    scene = sg.Scene([sg.Body(name, mesh, pose) for name, mesh, pose, _ in BODIES])
    place, drawn, pings = (0.0, 0.0, 0.0), 0, 1

    with sg.Simulator(scene, sonar, context="current") as simulator:
        ping = simulator.ping(sonar_pose(place))
        view = View(gl, fan_picture(ping))
        start_s = before_s = now_s = glfw.get_time()
        next_ping_s = start_s + PING_PERIOD_S
        while not glfw.window_should_close(window) and drawn != frames:
            now_s = glfw.get_time()
            place, before_s = moved(place, window, now_s - before_s), now_s
            if now_s >= next_ping_s:  # the sonar keeps its own time, whatever the window's is
                ping = simulator.ping(sonar_pose(place))
                view.fan.write(fan_picture(ping).tobytes(), alignment=1)
                pings, next_ping_s = pings + 1, next_ping_s + PING_PERIOD_S
                if next_ping_s <= now_s:  # the window was held up: pings that were missed stay so
                    next_ping_s = now_s + PING_PERIOD_S
            view.draw(sonar_pose(place))
            glfw.swap_buffers(window)
            glfw.poll_events()
            drawn += 1

    print(f"{drawn} frames and {pings} pings in {now_s - start_s:.1f} s")
    if frames is not None:
        view.draw(sonar_pose(place))
        pixels = np.frombuffer(gl.screen.read(components=3, alignment=1), np.uint8)
        sg.save_png(output_folder(out) / "window_host.png", pixels.reshape(HEIGHT, WIDTH, 3)[::-1])
    gl.release()
    glfw.terminate()
    return {"scene": scene, "sonar": sonar, "pose": ping.pose, "ping": ping}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, help="end after so many, and write a picture")
    parser.add_argument("--out", default="out", help="folder for the picture")
    arguments = parser.parse_args()
    main(arguments.out, arguments.frames)
