"""A deferred renderer draws textures of what its camera sees, lights them, and pings them.

    python examples/deferred_host.py [--out FOLDER]

Writes deferred_host.png: the picture that it makes of the textures, and a ping of the same textures.
"""

import argparse

import moderngl
import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.embed import sensor as embed
from sonar_gl.imaging.files import output_folder

BODIES = [
    ("floor", trimesh.creation.box((60, 60, 0.2)), sg.pose(10, 0, -0.1), (0.55, 0.5, 0.4), 0.25),
    ("post", trimesh.creation.cylinder(0.3, 4), sg.pose(8, 1.6, 1), (0.7, 0.25, 0.1), 0.7),
    ("crate", trimesh.creation.box((0.9, 0.9, 0.9)), sg.pose(6, -1.0, 0.45, yaw=0.4), (0.3, 0.4, 0.45), 0.5),
    ("ball", trimesh.creation.icosphere(4, 0.5), sg.pose(9.5, 0.2, 0.5), (0.2, 0.5, 0.3), 0.6),
]
# first what is where: the z-buffer, the faces' normals and the bodies' numbers
GEOMETRY = {
    "vertex_shader": """#version 330 core
        in vec3 position, normal;
        uniform mat4 view, projection;
        out vec3 seen_normal;
        void main() {
            seen_normal = mat3(view) * normal;
            gl_Position = projection * view * vec4(position, 1.0);
        }""",
    "fragment_shader": """#version 330 core
        in vec3 seen_normal;
        uniform uint number;
        layout(location = 0) out vec4 normal;
        layout(location = 1) out uint body;
        void main() { normal = vec4(seen_normal, 0.0); body = number; }""",
}
# then the light, of each pixel once
LIGHT = {
    "vertex_shader": """#version 330 core
        void main() {
            vec2 at = vec2(gl_VertexID % 2, gl_VertexID / 2);
            gl_Position = vec4(2.0 * at - 1.0, 0.0, 1.0);
        }""",
    "fragment_shader": """#version 330 core
        uniform sampler2D normals;
        uniform usampler2D numbers;
        uniform vec3 colours[8];  // of nothing first
        out vec4 pixel;
        void main() {
            ivec2 at = ivec2(gl_FragCoord.xy);
            uint number = texelFetch(numbers, at, 0).r;
            float light = max(dot(texelFetch(normals, at, 0).xyz, normalize(vec3(-0.3, 0.7, 0.6))), 0.0);
            pixel = vec4(colours[number] * (number > 0u ? 0.4 + 0.6 * light : 1.0), 1.0);
        }""",
}


class Renderer:
    """What a deferred renderer has: textures, and a program for each of its two passes."""

    def __init__(self, gl, size):
        self.gl, self.size = gl, size
        self.depth, self.normals = gl.depth_texture(size), gl.texture(size, 4, dtype="f4")
        self.numbers = gl.texture(size, 1, dtype="u2")
        self.textures = gl.framebuffer([self.normals, self.numbers], self.depth)
        self.picture = gl.simple_framebuffer(size, 3)
        self.geometry, light = gl.program(**GEOMETRY), gl.program(**LIGHT)
        self.arrays, self.light = [], gl.vertex_array(light, [])
        for _, mesh, pose, *_ in BODIES:
            placed = mesh.copy().apply_transform(pose)
            normals = np.repeat(placed.face_normals[:, None], 3, axis=1)
            data = gl.buffer(np.concatenate([placed.triangles, normals], axis=2).astype("f4"))
            self.arrays.append(gl.vertex_array(self.geometry, [(data, "3f 3f", "position", "normal")]))
        colours = np.float32([(0.05, 0.2, 0.3), *(colour for *_, colour, _ in BODIES)])
        light["colours"].write(np.resize(colours, (8, 3)).tobytes())
        light["normals"], light["numbers"] = 0, 1

    def draw(self, view, projection):
        """Both passes; the textures hold what is seen until the next call."""
        self.textures.use()
        self.textures.clear()
        self.gl.enable_only(moderngl.DEPTH_TEST)
        for name, matrix in (("view", view), ("projection", projection)):
            self.geometry[name].write(matrix.T.astype("f4").tobytes())  # OpenGL stores columns
        for number, array in enumerate(self.arrays, 1):
            self.geometry["number"] = number
            array.render()
        self.picture.use()
        self.gl.enable_only(moderngl.NOTHING)
        self.normals.use(0)
        self.numbers.use(1)
        self.light.render(moderngl.TRIANGLE_STRIP, vertices=4)

    def read(self):
        """(H, W, 3) uint8, the picture."""
        width, height = self.size
        pixels = np.frombuffer(self.picture.read(components=3, alignment=1), np.uint8)
        return pixels.reshape(height, width, 3)[::-1]


def main(out="out"):
    """Draw, ping and write the picture; what was pinged comes back."""
    sonar, place = sg.load_sonar("p900-45").with_range(12.0), sg.pose(0, 0, 1.6, pitch=0.2)
    names = [name for name, *_ in BODIES]
    reflectivity = {number: mu for number, (*_, mu) in enumerate(BODIES, 1)}
    (camera,) = sg.Camera.covering(sonar, pixel_deg=0.1)  # at the sonar's position; it sees the whole fan
    projection = camera.projection(near_m=0.1, far_m=60.0)

    gl = moderngl.create_context(standalone=True, backend="egl")
    renderer = Renderer(gl, (camera.width, camera.height))
    renderer.draw(np.linalg.inv(camera.pose_gl(place)), projection)

    # Embedding mode 3: the sonar reads the textures that the renderer has, by their OpenGL names.
    with embed.Sensor(sonar) as sensor:
        texture_ping = sensor.ping_from_textures(
            renderer.depth.glo, projection, place, normals=renderer.normals.glo,
            body_id=renderer.numbers.glo, reflectivity=reflectivity, bodies=names, labels=True,
        )  # fmt: skip

    for name, echo in zip(names, texture_ping.body_echo[1:], strict=True):
        print(f"{name}: echo {echo:.3g}")
    fan = sg.colorize(sg.fan_image(texture_ping, height=camera.height))
    sg.save_png(output_folder(out) / "deferred_host.png", np.hstack([renderer.read(), fan]))
    gl.release()
    bodies = [sg.Body(name, mesh, pose, reflectivity=mu) for name, mesh, pose, _, mu in BODIES]
    return {"scene": sg.Scene(bodies), "sonar": sonar, "pose": place, "texture_ping": texture_ping}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the picture")
    main(parser.parse_args().out)
