"""MuJoCo moves things in a tank, and a sonar watches them in two ways.

    python examples/mujoco_host.py [--out FOLDER]

Writes mujoco_host.gif and its last frame, mujoco_host.png: what MuJoCo draws, a ping of the model's bodies in
MuJoCo's OpenGL context, and a ping of its depth and segmentation images alone.
"""

import argparse
import os
from ctypes import c_void_p

os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = "egl"

from OpenGL import EGL

# MuJoCo's EGL needs it, and PyOpenGL 3.1.0, which pyrender pins, has none
if not hasattr(EGL, "EGLDeviceEXT"):
    EGL.EGLDeviceEXT = c_void_p
import mujoco
import numpy as np

import sonar_gl as sg
from sonar_gl.imaging.files import output_folder

HEIGHT, FRAMES, PERIOD_S = 360, 24, 0.1
# Materials of these names have acoustic properties. The camera named "sonar" is where the sonar is.
TANK = """
<mujoco>
  <option density="1000" viscosity="0.001"/>
  <visual>
    <global offwidth="2000" offheight="1000"/>
    <headlight ambient=".3 .3 .3" diffuse=".6 .6 .6"/>
  </visual>
  <default><geom density="3000"/></default>
  <asset>
    <material name="sand" rgba=".6 .55 .4 1"/>
    <material name="concrete" rgba=".5 .6 .6 1"/>
    <material name="rock" rgba=".4 .4 .4 1"/>
    <material name="granite" rgba=".8 .2 .2 1"/>
    <material name="wood" rgba=".3 .4 .5 1"/>
    <material name="foam_neoprene" rgba=".1 .1 .2 1"/>
    <mesh name="rock" vertex="-.5 -.4 0  .5 -.5 0  .6 .4 0  -.4 .5 0  -.2 -.3 .5  .3 -.1 .6  .1 .3 .4"/>
  </asset>
  <worldbody>
    <light pos="2 1 6" dir="0.3 0 -1" castshadow="false"/>
    <body pos="0 0 1.6" euler="0 11.5 0">
      <camera name="eye" xyaxes="0 -1 0 0 0 1" fovy="43"/>
      <camera name="sonar" xyaxes="0 -1 0 0 0 1" fovy="{fovy}"/>
    </body>
    <geom name="floor" type="plane" size="15 5 1" material="sand"/>
    <geom name="back wall" type="box" pos="11 0 1.5" size=".1 5 1.5" material="concrete"/>
    <geom name="port wall" type="box" pos="5 5 1.5" size="6 .1 1.5" material="concrete"/>
    <geom name="rock" type="mesh" mesh="rock" pos="5 -.9 0" material="rock"/>
    <body name="rod" pos="6.5 1.3 3.2">
      <joint name="swing" axis="1 0 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -2.1" size=".03" material="rock"/>
      <body name="bob" pos="0 0 -2.3">
        <geom type="sphere" size=".25" density="7800" material="granite"/>
      </body>
    </body>
    <body name="box" pos="8 -1.2 .4">
      <joint name="slide" type="slide" axis="0 1 0" stiffness="2000"/>
      <geom type="box" size=".4 .4 .4" material="wood"/>
    </body>
    <body name="diver" pos="8.5 .3 .7">
      <joint name="sway" axis="0 0 1" stiffness="500"/>
      <geom type="capsule" fromto="0 -.3 0 0 .3 .1" size=".2" material="foam_neoprene"/>
      <geom type="cylinder" fromto="0 -.3 .28 0 .2 .36" size=".1" material="foam_neoprene"/>
      <geom type="ellipsoid" pos="0 .6 .15" size=".12 .15 .13" material="foam_neoprene"/>
      <geom type="capsule" fromto="0 -.4 0 0 -1.1 -.15" size=".1" material="foam_neoprene"/>
    </body>
  </worldbody>
</mujoco>
"""


def depth_and_bodies(renderer, data, number_of_geom):
    """Depth, metres, and the number of the body that is seen, 0 for none."""
    renderer.update_scene(data, "sonar")
    renderer.enable_depth_rendering()
    depth = renderer.render()
    renderer.enable_segmentation_rendering()
    geom, kind = np.moveaxis(renderer.render(), 2, 0)
    return depth, np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number_of_geom[geom], 0)


def main(out="out"):
    """Swing, slide, sway and ping; what was pinged last comes back."""
    sonar = sg.load_sonar("p900-45").with_range(12.0)
    (camera,) = sg.Camera.covering(sonar)
    fovy = np.degrees(2 * np.arctan(camera.height / 2 / camera.intrinsics[1, 1]))
    model = mujoco.MjModel.from_xml_string(TANK.format(fovy=fovy))
    data = mujoco.MjData(model)
    for joint, start in (("swing", 0.5), ("slide", -0.5), ("sway", 0.6)):
        data.joint(joint).qpos = start

    scene = sg.load_scene(model)
    names = [body.name for body in scene.bodies]
    reflectivity = {number: body.reflectivity for number, body in enumerate(scene.bodies, 1)}
    # a geom of the world is a body of its own; others belong to their body
    geoms = [model.geom(k) for k in range(model.ngeom)]
    owners = [geom.name if geom.bodyid == 0 else model.body(geom.bodyid[0]).name for geom in geoms]
    number_of_geom = np.array([1 + names.index(owner) for owner in owners])
    frames = []
    with (
        mujoco.Renderer(model, HEIGHT, 4 * HEIGHT // 3) as eye,
        mujoco.Renderer(model, camera.height, camera.width) as fan,  # its context is current now
        sg.Simulator(scene, sonar, context="current") as simulator,
    ):
        for _ in range(FRAMES):
            while data.time < len(frames) * PERIOD_S:
                mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
            place, poses = sg.mujoco_sonar_pose(data), sg.mujoco_poses(scene, data)
            ping = simulator.ping(place, bodies=poses, labels=True)

            depth, numbers = depth_and_bodies(fan, data, number_of_geom)
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
        "scene": scene, "sonar": sonar, "pose": place, "bodies": poses,
        "ping": ping, "depth_ping": depth_ping,
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the pictures")
    main(parser.parse_args().out)
