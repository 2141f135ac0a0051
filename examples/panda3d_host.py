"""Panda3D shows its models on a sea floor, and a sonar watches them.

    python examples/panda3d_host.py [--out FOLDER]

Writes panda3d_host.gif and its last frame, panda3d_host.png: what Panda3D draws, without a display, and pings
of its scene graph by a context that joins Panda3D's.
"""

import argparse

from panda3d.core import loadPrcFileData

SETTINGS = """
load-display p3headlessgl
win-size 480 360
audio-library-name null
print-pipe-types false
notify-level-egldisplay error
notify-level-device fatal
"""
loadPrcFileData("", SETTINGS)

import numpy as np
import trimesh
from direct.showbase.ShowBase import ShowBase
from panda3d.core import AmbientLight, CardMaker, DirectionalLight, GeomVertexReader, NodePath

import sonar_gl as sg
from sonar_gl.imaging.files import output_folder

FRAMES, PERIOD_S = 20, 0.1
NODE_FROM_SONAR = sg.pose(yaw=np.pi / 2)  # nodes of Panda3D look along y, and x is to their right
REFLECTIVITY = {"floor": 0.25, "teapot": 0.8, "panda": 0.3, "ball": 0.6}


def fill(base):
    """Things by name, each a NodePath; what scales them goes into their vertices, for poses are rigid."""
    card = CardMaker("floor")
    card.setFrame(-15, 15, -15, 15)
    floor = NodePath("floor")
    floor.attachNewNode(card.generate())
    floor.setP(-90)
    floor.setColor(0.6, 0.55, 0.4, 1)
    floor.flattenLight()
    things = {"floor": floor}
    for name, model, scale, place in (
        ("teapot", "models/teapot", 0.25, (1.5, 7, 0)),
        ("panda", "models/panda", 0.13, (-1.3, 8.5, 0)),
        ("ball", "models/smiley", 0.35, (0.5, 6, 0.35)),
    ):
        things[name] = base.loader.loadModel(model)
        things[name].setScale(scale)
        things[name].flattenLight()
        things[name].setPos(*place)
    for thing in things.values():
        thing.reparentTo(base.render)
    for light, strength in ((AmbientLight("ambient"), 0.4), (DirectionalLight("sun"), 0.7)):
        light.setColor((strength, strength, strength, 1))
        lamp = base.render.attachNewNode(light)
        lamp.setHpr(-30, -50, 0)
        base.render.setLight(lamp)
    return things


def mesh_of(path):
    """All triangles below a NodePath, in its frame: a trimesh.Trimesh."""
    parts = []
    for part in path.findAllMatches("**/+GeomNode"):
        to_path = np.array(part.getMat(path))  # for rows
        for geom in part.node().getGeoms():
            geom = geom.decompose()  # strips and fans into triangles
            reader = GeomVertexReader(geom.getVertexData(), "vertex")
            vertices = [[*reader.getData3()] for _ in range(geom.getVertexData().getNumRows())]
            faces = [np.reshape(primitive.getVertexList(), (-1, 3)) for primitive in geom.getPrimitives()]
            placed = vertices @ to_path[:3, :3] + to_path[3, :3]
            parts.append(trimesh.Trimesh(placed, np.concatenate(faces), process=False))
    return trimesh.util.concatenate(parts)


def pose_of(path, base):
    """(4, 4) world_from_node; Panda3D multiplies rows by its matrices, and sonar_gl columns."""
    return np.array(path.getMat(base.render), float).T


def main(out="out"):
    """Turn, roll and ping; what was pinged last comes back."""
    base = ShowBase(windowType="offscreen")
    base.setBackgroundColor(0.05, 0.2, 0.3)
    base.camLens.setFov(53, 41)
    base.camera.setPosHpr(0, 0, 1.6, 0, -11.5, 0)
    things = fill(base)

    sonar = sg.load_sonar("p900-45").with_range(12.0)
    scene = sg.Scene(
        [sg.Body(name, mesh_of(path), reflectivity=REFLECTIVITY[name]) for name, path in things.items()]
    )
    base.graphicsEngine.renderFrame()  # opens Panda3D's context, and leaves it current
    frames = []
    with sg.Simulator(scene, sonar, context="current") as simulator:
        for _ in range(FRAMES):
            things["teapot"].setH(things["teapot"].getH() + 9)
            things["ball"].setX(things["ball"].getX() - 0.05)
            base.graphicsEngine.renderFrame()
            poses = {name: pose_of(path, base) for name, path in things.items()}
            place = pose_of(base.camera, base) @ NODE_FROM_SONAR
            ping = simulator.ping(place, bodies=poses, labels=True)

            shot = base.win.getScreenshot()
            width, height = shot.getXSize(), shot.getYSize()
            picture = np.frombuffer(shot.getRamImageAs("RGB"), np.uint8).reshape(height, width, 3)[::-1]
            frames.append(np.hstack([picture, sg.colorize(sg.fan_image(ping, height=height))]))
    base.destroy()

    folder = output_folder(out)
    sg.save_animation(folder / "panda3d_host.gif", frames, fps=1 / PERIOD_S)
    sg.save_png(folder / "panda3d_host.png", frames[-1])
    for name, echo in zip(things, ping.body_echo[1:], strict=True):
        print(f"{name}: echo {echo:.3g}")
    return {"scene": scene, "sonar": sonar, "pose": place, "bodies": poses, "ping": ping}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the pictures")
    main(parser.parse_args().out)
