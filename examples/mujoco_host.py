"""MuJoCo moves things in a tank, and a sonar watches them in two ways.

    python examples/mujoco_host.py [--out FOLDER]

Writes mujoco_host.gif and its last frame, mujoco_host.png: what MuJoCo draws, a ping of the model's geoms in
MuJoCo's OpenGL context, and a ping of its depth and segmentation images alone.
"""

import argparse
import os
from ctypes import c_void_p

os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = "egl"

from OpenGL import EGL

if not hasattr(
    EGL, "EGLDeviceEXT"
):  # MuJoCo's EGL needs it, and PyOpenGL 3.1.0, which pyrender pins, has none
    EGL.EGLDeviceEXT = c_void_p
import mujoco
import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.imaging.files import output_folder

HEIGHT, FRAMES, PERIOD_S = 360, 24, 0.1
# Reflectivities are the geoms' user numbers. The sonar's body has the sonar's axes: x ahead, y to port, z up.
TANK = """
<mujoco>
  <size nuser_geom="1"/>
  <option density="1000" viscosity="0.001"/>
  <visual>
    <global offwidth="2000" offheight="1000"/>
    <headlight ambient=".3 .3 .3" diffuse=".6 .6 .6"/>
  </visual>
  <default><geom user="0.5" density="3000"/></default>
  <asset>
    <mesh name="rock" vertex="-.5 -.4 0  .5 -.5 0  .6 .4 0  -.4 .5 0  -.2 -.3 .5  .3 -.1 .6  .1 .3 .4"/>
  </asset>
  <worldbody>
    <light pos="2 1 6" dir="0.3 0 -1" castshadow="false"/>
    <body name="sonar" pos="0 0 1.6" euler="0 11.5 0">
      <camera name="eye" xyaxes="0 -1 0 0 0 1" fovy="43"/>
      <camera name="fan" xyaxes="0 -1 0 0 0 1" fovy="{fovy}"/>
    </body>
    <geom name="floor" type="plane" size="15 5 1" user="0.25" rgba=".6 .55 .4 1"/>
    <geom name="back wall" type="box" pos="11 0 1.5" size=".1 5 1.5" rgba=".5 .6 .6 1"/>
    <geom name="port wall" type="box" pos="5 5 1.5" size="6 .1 1.5" rgba=".5 .6 .6 1"/>
    <geom name="rock" type="mesh" mesh="rock" pos="5 -.9 0" rgba=".4 .4 .4 1"/>
    <body name="pendulum" pos="6.5 1.3 3.2">
      <joint name="swing" axis="1 0 0"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -2.1" size=".03" rgba=".3 .3 .3 1"/>
      <geom name="bob" type="sphere" pos="0 0 -2.3" size=".25" user="0.8" density="7800" rgba=".8 .2 .2 1"/>
    </body>
    <body name="box" pos="8 -1.2 .4">
      <joint name="slide" type="slide" axis="0 1 0" stiffness="2000"/>
      <geom name="box" type="box" size=".4 .4 .4" user="0.7" rgba=".3 .4 .5 1"/>
    </body>
    <body name="diver" pos="8.5 .3 .7">
      <joint name="sway" axis="0 0 1" stiffness="500"/>
      <geom name="trunk" type="capsule" fromto="0 -.3 0 0 .3 .1" size=".2" rgba=".1 .1 .2 1"/>
      <geom name="bottle" type="cylinder" fromto="0 -.3 .28 0 .2 .36" size=".1" user="0.9" rgba=".7 .7 .7 1"/>
      <geom name="head" type="ellipsoid" pos="0 .6 .15" size=".12 .15 .13" rgba=".8 .6 .5 1"/>
      <geom name="legs" type="capsule" fromto="0 -.4 0 0 -1.1 -.15" size=".1" rgba=".1 .1 .2 1"/>
    </body>
  </worldbody>
</mujoco>
"""


def mesh_of(model, geom):
    """The surface of a geom in its own frame, a trimesh.Trimesh."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    match kind:
        case mujoco.mjtGeom.mjGEOM_PLANE:
            x, y = np.where(size[:2] > 0, size[:2], 50.0)  # 0: the plane has no end
            return trimesh.Trimesh([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]], [[0, 1, 2], [0, 2, 3]])
        case mujoco.mjtGeom.mjGEOM_BOX:
            return trimesh.creation.box(2 * size)
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return trimesh.creation.icosphere(4, size[0])
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return trimesh.creation.icosphere(4).apply_scale(size)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return trimesh.creation.capsule(2 * size[1], size[0])
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(size[0], 2 * size[1], sections=64)
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            first, count = mesh.vertadr[0], mesh.vertnum[0]
            vertices = model.mesh_vert[first : first + count]
            first, count = mesh.faceadr[0], mesh.facenum[0]
            return trimesh.Trimesh(vertices, model.mesh_face[first : first + count])
    raise ValueError(f"geom {model.geom(geom).name!r} must be of a kind that has a surface (got {kind.name})")


def bodies_of(model):
    """A sonar_gl.Body of each geom, in the model's order."""
    return [
        sg.Body(model.geom(i).name or f"geom {i}", mesh_of(model, i), reflectivity=model.geom_user[i, 0])
        for i in range(model.ngeom)
    ]


def pose_of(position, rotation):
    """(4, 4) of MuJoCo's (3,) and (9,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
    return pose


def depth_and_bodies(renderer, data):
    """Depth, metres, and 1 + the number of the geom that is seen, 0 for none."""
    renderer.update_scene(data, "fan")
    renderer.enable_depth_rendering()
    depth = renderer.render()
    renderer.enable_segmentation_rendering()
    number, kind = np.moveaxis(renderer.render(), 2, 0)
    return depth, np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number + 1, 0)


def main(out="out"):
    """Swing, slide, sway and ping; what was pinged last comes back."""
    sonar = sg.load_sonar("p900-45").with_range(12.0)
    (camera,) = sg.Camera.covering(sonar)
    fovy = np.degrees(2 * np.arctan(camera.height / 2 / camera.intrinsics[1, 1]))
    model = mujoco.MjModel.from_xml_string(TANK.format(fovy=fovy))
    data = mujoco.MjData(model)
    for joint, start in (("swing", 0.5), ("slide", -0.5), ("sway", 0.6)):
        data.joint(joint).qpos = start

    bodies = bodies_of(model)
    names = [body.name for body in bodies]
    reflectivity = {number: body.reflectivity for number, body in enumerate(bodies, 1)}
    frames = []
    with (
        mujoco.Renderer(model, HEIGHT, 4 * HEIGHT // 3) as eye,
        mujoco.Renderer(model, camera.height, camera.width) as fan,  # its context is current now
        sg.Simulator(sg.Scene(bodies), sonar, context="current") as simulator,
    ):
        for _ in range(FRAMES):
            while data.time < len(frames) * PERIOD_S:
                mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
            place = pose_of(data.body("sonar").xpos, data.body("sonar").xmat)
            poses = dict(zip(names, map(pose_of, data.geom_xpos, data.geom_xmat), strict=True))
            ping = simulator.ping(place, bodies=poses, labels=True)

            depth, numbers = depth_and_bodies(fan, data)
            depth_ping = sg.ping_from_depth(
                depth,
                sonar,
                camera,
                pose=place,
                body_id=numbers,
                reflectivity=reflectivity,
                bodies=names,
                labels=True,
            )
            eye.update_scene(data, "eye")
            fans = [sg.colorize(sg.fan_image(one, height=HEIGHT)) for one in (ping, depth_ping)]
            frames.append(np.hstack([eye.render(), *fans]))

    folder = output_folder(out)
    sg.save_animation(folder / "mujoco_host.gif", frames, fps=1 / PERIOD_S)
    sg.save_png(folder / "mujoco_host.png", frames[-1])
    for name, echo, depth_echo in zip(names, ping.body_echo[1:], depth_ping.body_echo[1:], strict=True):
        print(f"{name}: echo {echo:.3g}, by the depth image {depth_echo:.3g}")
    return {
        "scene": sg.Scene(bodies), "sonar": sonar, "pose": place, "bodies": poses,
        "ping": ping, "depth_ping": depth_ping,
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the pictures")
    main(parser.parse_args().out)
