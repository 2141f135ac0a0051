"""pyrender draws a harbour, and a sonar looks at it from the same place.

    python examples/pyrender_host.py [--out FOLDER]

Writes pyrender_host.png: what pyrender draws, a ping of its scene in its OpenGL context, and a ping made of
its depth image alone.
"""

import argparse
from dataclasses import replace

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.imaging.files import output_folder
from sonar_gl.scene.pyrender_scene import import_pyrender

pyrender = import_pyrender()  # `import pyrender`, headless, and with numpy 2

REFLECTIVITY = {"floor": 0.25, "pylon": 0.7, "crate": 0.6, "ball": 0.4}


def make_scene():
    """A pyrender.Scene as any program has one: z up, metres; the pylon stands to port (+y)."""
    scene = pyrender.Scene(ambient_light=[0.25, 0.3, 0.35], bg_color=[0.05, 0.2, 0.3])
    things = [
        ("floor", trimesh.creation.box((40, 40, 0.2)), sg.pose(10, 0, -0.1), (0.6, 0.55, 0.4)),
        ("pylon", trimesh.creation.cylinder(0.35, 3), sg.pose(7, 1.4, 1.5), (0.7, 0.25, 0.1)),
        ("crate", trimesh.creation.box((0.8, 0.8, 0.8)), sg.pose(5.5, -0.9, 0.4, yaw=0.5), (0.3, 0.4, 0.45)),
        ("ball", trimesh.creation.icosphere(4, 0.4), sg.pose(8.5, 0.1, 0.4), (0.2, 0.5, 0.3)),
    ]
    for name, mesh, place, colour in things:
        material = pyrender.MetallicRoughnessMaterial(baseColorFactor=colour, roughnessFactor=0.9)
        node = pyrender.Node(name, mesh=pyrender.Mesh.from_trimesh(mesh, material, smooth=name == "ball"))
        scene.add_node(node)
        scene.set_pose(node, place)
    scene.add(pyrender.DirectionalLight(intensity=4.0), pose=sg.pose(pitch=-0.6))
    return scene


def main(out="out"):
    """Draw, ping and write the pictures; what was pinged comes back."""
    sonar, place = sg.load_sonar("p900-45").with_range(12.0), sg.pose(0, 0, 1.6, pitch=0.2)
    scene = make_scene()
    bodies = [replace(body, reflectivity=REFLECTIVITY[body.name]) for body in sg.load_scene(scene).bodies]
    names = [body.name for body in bodies]

    # what a person would see from the sonar's place
    (camera,) = sg.Camera.covering(sonar)
    eye = scene.add(pyrender.PerspectiveCamera(yfov=0.75, znear=0.1), pose=camera.pose_gl(place))
    renderer = pyrender.OffscreenRenderer(640, 600)
    picture, _ = renderer.render(scene)
    scene.remove_node(eye)

    # pyrender's context is current now, and the sonar joins it
    with sg.Simulator(sg.Scene(bodies), sonar, context="current") as simulator:
        ping = simulator.ping(place, labels=True)

    # or pyrender draws depth and numbers of bodies in the fan, and the sonar makes a ping of them
    focal, middle = camera.intrinsics[[0, 1], [0, 1]], (camera.width / 2, camera.height / 2)
    scene.add(pyrender.IntrinsicsCamera(*focal, *middle, znear=0.1, zfar=50.0), pose=camera.pose_gl(place))
    renderer.viewport_width, renderer.viewport_height = camera.width, camera.height
    numbers = {node: (1 + names.index(node.name), 0, 0) for node in scene.mesh_nodes}
    segments, depth = renderer.render(scene, pyrender.RenderFlags.SEG, numbers)
    depth_ping = sg.ping_from_depth(
        depth, sonar, camera, pose=place, body_id=segments[..., 0].astype(int), labels=True, bodies=names,
        reflectivity={number: body.reflectivity for number, body in enumerate(bodies, 1)},
    )  # fmt: skip
    renderer.delete()  # ends EGL's display: only after the simulator was closed

    fans = [sg.colorize(sg.fan_image(one, height=600)) for one in (ping, depth_ping)]
    sg.save_png(output_folder(out) / "pyrender_host.png", np.hstack([picture, *fans]))
    for name, echo, depth_echo in zip(names, ping.body_echo[1:], depth_ping.body_echo[1:], strict=True):
        print(f"{name}: echo {echo:.3g}, by the depth image {depth_echo:.3g}")
    return {"scene": sg.Scene(bodies), "sonar": sonar, "pose": place, "ping": ping, "depth_ping": depth_ping}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the pictures")
    main(parser.parse_args().out)
