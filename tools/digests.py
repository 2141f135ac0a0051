"""Record digests of pings, and compare them after a change that must keep images bit for bit.

    python -m tools.digests --record              # writes tools/digests.json
    python -m tools.digests                       # compares with it; exit status 1 if anything differs
    python -m tools.digests --only "noise/*"      # some cases only, for either
    python -m tools.digests --record --arrays before      # keeps the arrays themselves, too
    python -m tools.digests --arrays before               # reports by how much they differ

A case is a ping, a sequence, a picture, or the files of a batch, made through the public API alone. Run it from
the root of the checkout. Bits depend on the processor, the OpenGL driver and the versions of libraries, which
the record names: record before the change, on the machine that compares after it.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from time import perf_counter

import numpy as np

import sonar_gl as sg
from tests.support import gl_host
from tests.support.gl_host import GL  # for EGL, whatever was imported before
from tests.support.settings import described

ROOT = Path(__file__).resolve().parents[1]
RECORD = Path(__file__).with_suffix(".json")
LIBRARIES = "numpy", "numba", "llvmlite", "opencv-contrib-python-headless", "trimesh", "embreex", "zarr"
STABLE_META = "sampling", "has_echo", "absorption_db_m", "sound_speed_m_s", "n_rays", "difference"
NOT_DIGESTED = "done.json", "parts/*.json", ".lock"  # of a batch: checksums of the other files, and the lock
SETTINGS = "sonar", "acoustics"  # of a ping: what made it
# keys of a batch's JSON files
VOLATILE = {"version", "source", "gl_renderer", "gl_version", "numpy", "numba", "system", "folder", "sha256"}

SONAR = sg.Sonar("digests", 900e3, 96, 300, 60.0, 20.0, 1.0, 0.5, 15.0)
POSE = sg.pose(0, 0, -1, 0.05, 0.15, 0.1)
PATH = [POSE @ sg.pose(0.15 * k, 0.05 * k, 0, 0, 0.005 * k, 0.03 * k) for k in range(6)]
IDEAL, PAPER, PHYSICAL = sg.Acoustics.ideal(), sg.Acoustics.demarco2015(), sg.Acoustics.physical()
FIXED = sg.Sampling(2, 60)
LABELS = {"labels": True, "background": ["floor"]}
FAR_M = 5e5


def yard(far_m: float = 0.0, *plumes: sg.Bubbles) -> sg.Scene:
    """A floor and a wall that mirror, and bodies of each kind of reflectivity and normals.

    far_m : how far east and north of the origin all of it lies
    """
    import trimesh

    make = trimesh.creation
    ball, box, sheet = make.icosphere(4, 0.8), make.box((1.0, 1.0, 1.6)), make.box((0.05, 2.0, 2.0))
    rock = trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 0, 1]], [[0, 1, 2]], process=False)
    chequers = np.indices((12, 12)).sum(axis=0) % 2 * 0.8 + 0.1

    def at(*numbers, **angles):
        out = sg.pose(*numbers, **angles)
        out[:2, 3] += far_m
        return out

    things = [
        sg.Body("floor", make.box((60, 60, 1)), at(0, 0, -3.5), "smooth_concrete"),
        sg.Body("wall", make.box((0.3, 14, 6)), at(13, -2, -1, yaw=0.3), 0.4),
        sg.Body("ball", ball, at(7, 2.5, -1.6), 0.8, normals=ball.vertices / 0.8),
        sg.Body("pipe", make.cylinder(0.25, 3, sections=48), at(6, -2, -2.2, 0.2, 1.3, 0.4), "steel"),
        sg.Body("lobe", box, at(9, 0.3, -2.2, yaw=0.5), 0.4, specular=0.5, roughness_rad=0.2),
        sg.Body("faces", box, at(10, 4, -2.2, yaw=0.9), np.linspace(0.1, 0.9, len(box.faces))),
        sg.textured_body("map", sheet, chequers, sheet.vertices[:, 1:] / 2 + 0.5, at(8, -3.5, -1.8, yaw=0.4)),
        sg.Body("open", rock, at(5, 0.8, -2.4, 0.3, -0.2, 0.5), 0.7),
    ]
    return sg.Scene([*things, *plumes], at(0, 0, -1, 0.05, 0.15, 0.1), "yard", surface_z_m=0.0)


def patchy() -> sg.Scene:
    """`yard` with a texture on its floor and its wall."""
    scene, shapes = yard(), {"floor": 0.8, "wall": 3.0}
    bodies = [dataclasses.replace(body, speckle_shape=shapes.get(body.name)) for body in scene.bodies]
    return sg.Scene(bodies, scene.sonar_pose, "patchy", scene.surface_z_m)


def breath(far_m: float = 0.0) -> sg.Bubbles:
    """A plume before the ball of `yard`."""
    return sg.Bubbles("breath", sg.pose(far_m + 5.5, far_m + 1, -2.9), rate_hz=80, breath_s=3.0, seed=3)


def crowd() -> sg.Scene:
    """Many bodies of one mesh and of meshes of their own, and one of many triangles."""
    import trimesh

    rng, ball = np.random.default_rng(0), trimesh.creation.icosphere(2, 0.15)
    places = rng.uniform((3, -5, -2.8), (14, 5, 0), (240, 3))
    bodies = [sg.Body(f"ball {k}", ball, sg.pose(*place), 0.6) for k, place in enumerate(places)]
    for k, place in enumerate(rng.uniform((4, -5, -2.8), (14, 5, 0), (40, 3))):
        box = trimesh.creation.box(rng.uniform(0.1, 0.6, 3))
        bodies.append(sg.Body(f"box {k}", box, sg.pose(*place, *rng.uniform(-3, 3, 3)), rng.uniform(0.1, 1)))
    fine = trimesh.creation.icosphere(7, 1.0)
    bodies.append(sg.Body("fine", fine, sg.pose(12, -3, -1.5), 0.5, normals=np.asarray(fine.vertices)))
    return sg.Scene(bodies, sg.pose(0, 0, -1.3), "crowd")


SCENES = {
    "yard": yard,
    "patchy": patchy,
    "bubbles": lambda: yard(0.0, breath()),
    "far": lambda: yard(FAR_M, breath(FAR_M)),
    "crowd": crowd,
}


@cache
def scene_of(name: str) -> sg.Scene:
    return SCENES[name]() if name in SCENES else sg.load_scene(name)


def fan_of(fov_deg: float, n_beams: int = 120, **more) -> sg.Sonar:
    """The sonar with another fan."""
    return dataclasses.replace(SONAR, azimuth_fov_deg=float(fov_deg), n_beams=n_beams, **more)


def one(scene="yard", sonar=SONAR, acoustics=PHYSICAL, sampling=None, tolerance=0.05, **how):
    """A ping from the scene's own place."""
    scene = scene_of(scene)
    with sg.Simulator(scene, sonar, acoustics, sampling, tolerance) as simulator:
        return simulator.ping(scene.sonar_pose, **how)


def several(scene="yard", acoustics=PHYSICAL, sampling=None, path=PATH, plan=False, alone=False, **how):
    """A sequence of pings, drawn together or one by one, with samples that are chosen before if `plan`."""
    chosen = {}
    with sg.Simulator(scene_of(scene), SONAR, acoustics, sampling, 0.05) as simulator:
        if plan:
            plan = simulator.plan(path)
            chosen = {key: getattr(plan, key) for key in ("sampling", "error_estimate", "met")}
        if alone:
            pings = [simulator.ping(pose, **how, ping_number=k) for k, pose in enumerate(path)]
        else:
            pings = list(simulator.pings(path, **how))
    return {**chosen, "pings": pings}


def changed():
    """Pings before and after bodies are placed, taken away and added."""
    import trimesh

    scene = yard()
    ball = sg.Body("more", trimesh.creation.icosphere(3, 0.4), sg.pose(4.5, -1, -1.5), 0.9)
    with sg.Simulator(scene, SONAR, tolerance=0.05) as simulator:
        pings = [simulator.ping(POSE)]
        for do in (
            partial(simulator.place, {"ball": sg.pose(6, 1, -1.5), "faces": None}),
            partial(simulator.add, ball, breath()),
            partial(simulator.place, {"more": sg.pose(5, -1, -1.5), "breath": sg.pose(5, -1, -2.5)}),
        ):
            do()
            pings.append(simulator.ping(POSE, time_s=2.0, **LABELS))
    return pings


def shared():
    """Two sonars in one world, which bodies of either are placed in."""
    upright = POSE @ sg.pose(roll=np.pi / 2)
    with (
        sg.Simulator(yard(), SONAR, tolerance=0.05) as first,
        sg.Simulator(first, fan_of(150), IDEAL, FIXED) as second,
    ):
        pings = [first.ping(POSE), second.ping(upright, labels=True)]
        second.place({"ball": sg.pose(5, 0, -1.5)})
        return [*pings, first.ping(POSE, labels=True), second.ping(upright)]


def seen(sonar=SONAR, scene="yard"):
    """The G-buffers, and a grid of rays."""
    scene = scene_of(scene)
    with sg.Simulator(scene, sonar, None, FIXED) as simulator:
        buffers = simulator.gbuffers(scene.sonar_pose)
        return {"gbuffers": buffers, "cloud": simulator.point_cloud(scene.sonar_pose, 160, 40)}


def needed(scene):
    """A ping with the terms that the scene needs."""
    acoustics = sg.needed_acoustics(scene_of(scene), SONAR, 0.05)
    terms = {k: getattr(acoustics, k) for k in ("multipath", "elevation_pattern", "pulse", "bubbles")}
    return {"terms": terms, "ping": one(scene, acoustics=acoustics)}


def picture(sonar=SONAR, **how):
    """The fan image of a ping, in colour and with axes."""
    ping = one("yard", sonar, sampling=FIXED, noise=NOISES["physical"], seed=2)
    image = sg.fan_image(ping, **{"height": 300, **how})
    jet, gray = sg.colorize(image, "jet"), sg.colorize(image, "gray")
    return {
        "image": image,
        "jet": jet,
        "gray": gray,
        "axes": sg.draw_axes(jet, ping, "jet", how.get("counts")),
    }


def paper(**how):
    """The founding paper's picture."""
    scene = scene_of("diver")
    with sg.Simulator(scene, sg.load_sonar("demarco-2015"), PAPER, FIXED) as simulator:
        return {"image": sg.demarco_image(simulator, scene.sonar_pose, **{"height": 300, **how})}


def files():
    """What is written for a ping, and read again."""
    ping = one(sampling=FIXED, noise=NOISES["physical"], seed=2, **LABELS)
    frames = [sg.colorize(sg.fan_image(ping, height=60, counts=sg.Counts(low_db=low))) for low in (-60, -40)]
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        sg.save_npz(at / "ping.npz", ping)
        sg.save_png(at / "ping.png", frames[0])
        sg.save_animation(at / "ping.gif", frames, 10.0)
        written = {ending: (at / f"ping.{ending}").read_bytes() for ending in ("png", "gif")}
        return {"read": sg.load_npz(at / "ping.npz"), **written}


def truth(acoustics):
    """A ping of the ray-cast reference."""
    sonar = fan_of(40, 24, n_bins=80)
    return sg.reference_ping(yard(), sonar, POSE, acoustics, error=0.5, max_rays=1e6, seed=1)


@contextmanager
def host_of(scene: sg.Scene) -> Iterator[gl_host.Program]:
    """A program with an OpenGL context of its own, which draws a scene with flat faces and one reflectivity a body."""
    context = gl_host.make_context()
    try:
        yield gl_host.Program(sg.Scene([flat_body(body) for body in scene.bodies]))
    finally:
        context.release()


def flat_body(body: sg.Body) -> sg.Body:
    """The body with corners, and a normal, of each face's own, and the mean of its reflectivity."""
    import trimesh

    corners = body.mesh.triangles.reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    normals = np.repeat(body.mesh.face_normals, 3, axis=0)
    return sg.Body(body.name, mesh, body.pose, float(np.mean(body.reflectivity)), normals)


def joined(scene="yard", **how):
    """A simulator in a host's context."""
    scene = scene_of(scene)
    with host_of(scene), sg.Simulator(scene, SONAR, tolerance=0.05, context="current") as simulator:
        path = [scene.sonar_pose @ sg.pose(0.2 * k, yaw=0.05 * k) for k in range(1, 4)]
        return [simulator.ping(scene.sonar_pose, **how), *simulator.pings(path, **how)]


def sectors(sonar=SONAR, scene="yard", sampling=FIXED, **how):
    """A host draws the sectors of a fan."""
    scene = scene_of(scene)
    with host_of(scene) as host, sg.embed.Sensor(sonar, None, sampling, 0.05) as sensor:
        for sector in sensor.sectors(scene.sonar_pose):
            with sector:
                host.draw("sonar", sector.view, sector.projection, sector.lattice, in_double=True)
        return sensor.finish(bodies=[body.name for body in scene.bodies], **how)


def textures(sonar=SONAR, scene="yard", with_normals=True, holds="z-buffer", **how):
    """A host hands over its textures, of as many cameras as cover the fan."""
    scene, cameras = scene_of(scene), sg.Camera.covering(sonar, pixel_deg=0.2)
    mu = {number: float(np.mean(body.reflectivity)) for number, body in enumerate(scene.bodies, 1)}
    with host_of(scene) as host, sg.embed.Sensor(sonar) as sensor:
        projections = [camera.projection(0.1, 100.0) for camera in cameras]
        drawn = []
        for camera, projection in zip(cameras, projections, strict=True):
            host.framebuffers.clear()  # each camera has textures of its own
            view = np.linalg.inv(camera.pose_gl(scene.sonar_pose))
            drawn.append(host.textures(view, projection, camera.width, camera.height, in_double=True))
        names = {key: [one[key] for one in drawn] for key in drawn[0]}
        how |= {
            "rotation": [camera.rotation for camera in cameras],
            "body_id": names["numbers"],
            "reflectivity": mu,
        }
        if with_normals:
            how["normals"] = names["normals"]
        depth = names["metres" if holds == "planar" else holds]
        return sensor.ping_from_textures(depth, projections, scene.sonar_pose, holds, **how)


def images_of(camera: sg.Camera):
    """Depth, normals and numbers of a floor, a wall and a ball, in closed form."""
    row, column = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([column, row, np.ones_like(row)])
    rays = np.einsum("ij,jhw->ihw", camera.rotation @ np.linalg.inv(camera.intrinsics), pixels)
    floor, wall = np.array([0.0, 0.0, 1.0]), np.array([-np.cos(0.3), np.sin(0.3), 0.0])
    centre, radius = np.array([6.0, 1.0, -0.5]), 0.8
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = [-2.0 / np.einsum("i,ihw", floor, rays), -9.0 / np.einsum("i,ihw", wall, rays)]
        square, half = np.einsum("ihw,ihw->hw", rays, rays), np.einsum("i,ihw", centre, rays)
        depths.append((half - np.sqrt(half**2 - square * (centre @ centre - radius**2))) / square)
    depths = np.array([np.where(depth > 0, depth, np.inf) for depth in depths])
    nearest, depth = depths.argmin(axis=0), depths.min(axis=0)
    on_ball = (np.where(np.isfinite(depth), depth, 0.0) * rays).transpose(1, 2, 0) - centre
    normals = np.where((nearest == 2)[..., None], on_ball, np.array([floor, wall, wall])[nearest])
    numbers = np.where(np.isfinite(depth), nearest + 1, 0)
    return depth, normals @ camera.rotation, numbers, np.linalg.norm(rays, axis=0) * depth


def images(sonar=SONAR, cameras=None, holds="planar", with_normals=True, sampling=None, **how):
    """A ping of depth images."""
    cameras = sg.Camera.covering(sonar, pixel_deg=0.2) if cameras is None else cameras
    planar, normals, numbers, ranges = map(list, zip(*map(images_of, cameras), strict=True))
    more = {"pose": POSE, "body_id": numbers, "reflectivity": {1: 0.3, 2: 0.5, 3: 0.9}, **how}
    if with_normals:
        more["normals"] = normals
    given = planar if holds == "planar" else ranges
    return sg.ping_from_depth(given, sonar, cameras, sampling=sampling, holds=holds, **more)


def image():
    """A ping of one image, with a reflectivity for each pixel, and masked in part."""
    camera = sg.Camera.of_fov(400, 200, fov_x_rad=1.2, fov_y_rad=0.5)
    ahead, normals, numbers, _ = images_of(camera)
    mu = np.linspace(0.1, 0.9, ahead.size).reshape(ahead.shape)
    ahead = np.ma.masked_array(ahead, mask=numbers == 3)
    return sg.ping_from_depth(ahead, SONAR, camera, IDEAL, normals=normals, reflectivity=mu)


WORLD = """<sdf version="1.9"><world name="tank">{}</world></sdf>"""
MODEL = """<model name="{}"><static>true</static><pose>{}</pose><link name="link"><collision name="c">
<geometry><box><size>{}</size></box></geometry><laser_retro>{}</laser_retro></collision></link></model>"""
MODELS = (
    ("floor", "0 0 -0.9 0 0 0", "40 40 1", 120),
    ("wall", "5.5 0 0 0 0 0", "1 20 20", 255),
    ("box_1", "3 0.3 -0.3 0 0 0", "0.2 0.2 0.2", 200),
)
JOB = """
name = "small"
scenes = ["tank.sdf"]
seed = 5
pings_per_part = 4
tolerance = 0.05
acoustics = { profile = "physical", tvg_absorption_db_m = 0.3 }
noise = { preset = "physical" }
coco = { height = 100 }
pictures = { formats = ["png", "npz", "mp4"], height = 60 }
ros = { image_height = 50 }
optical = { width = 64, height = 48, fov_x_rad = 1.0 }
[[sonars]]
name = "level"
sonar = "small.toml"
[[sonars]]
name = "upright"
sonar = "small.toml"
range_m = 6.5
mount = [0.0, 0.0, 0.0, 1.5707963267948966, 0.0, 0.0]
[[poses]]
kind = "sector"
position_m = [0.0, 0.0, 0.0]
pan_rad = [-0.2, 0.2]
n_pings = 6
ping_rate_hz = 5.0
sweep_s = 1.0
[[poses]]
kind = "random_views"
target_m = [3.0, 0.3, -0.3]
range_m = [1.5, 2.5]
azimuth_rad = [2.5, 3.8]
elevation_rad = [0.1, 0.4]
n_pings = 2
[[vary.bodies]]
names = ["box_*"]
x_m = [-0.5, 0.5]
yaw_rad = [-1.0, 1.0]
there = 0.8
reflectivity = [0.2, 0.9]
[vary]
water = { temperature_c = [2.0, 20.0] }
noise = { ambient_db = [-80.0, -60.0] }
[labels]
layers = ["body", "class", "elevation", "range", "incidence", "share", "shadow", "boxes"]
classes = { fixed = ["wall", "floor"], target = ["box*"] }
"""
SMALL = """frequency_hz = 900e3\nn_beams = 24\nn_bins = 80\nazimuth_fov_deg = 40.0\nelevation_fov_deg = 10.0
beam_width_deg = 2.0\nrange_min_m = 0.5\nrange_max_m = 8.5\n"""


SDF = """<sdf version="1.9" xmlns:sonar_gl="urn:sonar_gl"><world name="files">
<sonar_gl:surface roughness="0.0002">0.5</sonar_gl:surface>
<include><uri>model://ground_plane</uri><name>floor</name><pose>0 0 -3 0 0 0</pose></include>
<include><uri>rock</uri><pose>7 -2 -2 0.3 0 0.5</pose></include>
<include><uri>rock</uri><name>second</name><pose relative_to="post">1 2 0 0 0 0</pose></include>
<frame name="post"><pose rotation_format="quat_xyzw">6 0 -1 0 0 0.2 0.98</pose></frame>
<model name="rig"><pose relative_to="post">0 1 0 0 0 0.3</pose>
<link name="a">
<collision name="c"><sonar_gl:material>steel</sonar_gl:material>
<geometry><cylinder><radius>0.3</radius><length>2</length></cylinder></geometry></collision>
<sonar_gl:bubbles><pose>0 0 1 0 0 0</pose><rate>50</rate><breath>4</breath><seed>2</seed></sonar_gl:bubbles>
</link>
<link name="b"><pose relative_to="a">0.5 -1 0.2 0 1.2 0</pose>
<visual name="v"><laser_retro>140</laser_retro>
<geometry><capsule><radius>0.2</radius><length>1</length></capsule></geometry></visual>
<visual name="w"><pose>0 0 1 0 0 0</pose><laser_retro>60</laser_retro>
<geometry><sphere><radius>0.3</radius></sphere></geometry></visual></link></model>
<model name="chart"><link name="c"><pose>9 1 -1.5 0 0.8 0.2</pose>
<collision name="c"><sonar_gl:reflectivity_map>chart.png</sonar_gl:reflectivity_map>
<geometry><box><size>2 2 0.1</size></box></geometry></collision></link></model>
<model name="sonar"><pose>0 0 -1 0 0.15 0.1</pose>
<link name="l"><sensor name="s" type="custom"/></link></model>
</world></sdf>"""
ROCK = """<sdf version="1.9"><model name="rock"><link name="l"><collision name="c">
<geometry><mesh><uri>rock.stl</uri><scale>1 1.5 -0.7</scale></mesh></geometry><laser_retro>90</laser_retro>
</collision></link></model></sdf>"""


def loaded(what):
    """A scene's bodies and a ping of it; what : a name, or a function (folder) -> what is loaded."""
    with tempfile.TemporaryDirectory() as folder:
        scene = sg.load_scene(what(Path(folder)) if callable(what) else what)
    bodies = {
        body.name: {
            "vertices": np.asarray(body.mesh.vertices),
            "faces": np.asarray(body.mesh.faces),
            **{key: getattr(body, key) for key in ("pose", "reflectivity", "normals", "specular")},
        }
        for body in scene.bodies
    }
    with sg.Simulator(scene, SONAR, sampling=FIXED) as simulator:
        pose = POSE if scene.sonar_pose is None else scene.sonar_pose
        return {"bodies": bodies, "pose": pose, "ping": simulator.ping(pose, labels=True, time_s=1.5)}


def _sdf(folder: Path):
    """A world with frames, includes, a mesh file and tags of our own."""
    import trimesh

    (folder / "rock").mkdir()
    (folder / "files.sdf").write_text(SDF)
    (folder / "rock" / "model.sdf").write_text(ROCK)
    trimesh.creation.icosphere(2, 0.6).export(folder / "rock" / "rock.stl")
    sg.save_png(folder / "chart.png", np.indices((8, 8)).sum(axis=0) % 3 / 2.0)
    return folder / "files.sdf"


def _meshes(ending: str, folder: Path):
    """A mesh file with several parts, or the scene itself."""
    import trimesh

    scene = trimesh.Scene()
    for k in range(3):
        part = trimesh.creation.icosphere(2, 0.4 + 0.2 * k)
        scene.add_geometry(part, f"part {k}", transform=sg.pose(6 + k, 2 - 1.5 * k, 0.5 * k - 1.5, 0.2 * k))
    if ending:
        scene.export(folder / f"parts.{ending}")
    return folder / f"parts.{ending}" if ending else scene


def batch():
    """The files of a small batch, without what tells versions, machines and folders."""
    with tempfile.TemporaryDirectory() as folder:
        at, out = Path(folder), Path(folder) / "out"
        (at / "tank.sdf").write_text(WORLD.format("".join(MODEL.format(*model) for model in MODELS)))
        (at / "small.toml").write_text(SMALL)
        (at / "job.toml").write_text(JOB)
        command = [sys.executable, "-m", "sonar_gl", "batch", "job.toml", "--out", str(out), "--workers", "2"]
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        done = subprocess.run(
            command, cwd=at, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
        )
        if done.returncode:
            raise RuntimeError(f"sonar-gl batch failed: {done.stderr[-2000:]}")
        names = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
        names = [name for name in names if not any(fnmatchcase(name, skip) for skip in NOT_DIGESTED)]
        return {name: _content(out / name) for name in names}


def _content(path: Path):
    if path.suffix == ".npz":
        return json.dumps({field: digest(value) for field, value in flat(sg.load_npz(path))}).encode()
    if path.suffix == ".json":
        return json.dumps(_lasting(json.loads(path.read_text())), sort_keys=True).encode()
    return path.read_bytes()


def _lasting(value):
    """What a JSON file says, but for what is not of the pings."""
    if isinstance(value, dict):
        return {key: _lasting(one) for key, one in value.items() if key not in VOLATILE}
    return [_lasting(one) for one in value] if isinstance(value, list) else value


PROFILES = {"ideal": IDEAL, "demarco2015": PAPER, "physical": PHYSICAL}
TERMS = {
    "taper hamming": {"receive_taper": "hamming"},
    "taper taylor": {"receive_taper": "taylor", "side_lobe_db": 35.0},
    "taper chebyshev": {"receive_taper": "chebyshev"},
    "straight array": {"steered": "straight"},
    "gaussian beams": {"beam_pattern": "gaussian"},
    "transmit beam": {"transmit_width_deg": 40.0, "transmit_taper": "hamming"},
    "elevation line array": {"elevation_pattern": "line_array", "elevation_taper": "taylor"},
    "elevation gaussian": {"elevation_pattern": "gaussian"},
    "pulse": {"pulse": True, "bandwidth_hz": 20e3, "pulse_taper": "uniform"},
    "pulse hamming": {"pulse": True, "bandwidth_hz": 30e3, "pulse_taper": "hamming"},
    "water": {"water": sg.Water(4.0, 8.0, ph=7.9), "tvg_absorption_db_m": 0.3},
    "other absorption": {"water": sg.Water(absorption_formula="ainslie_mccolm"), "tvg_absorption_db_m": 0.3},
    "TVG": {"tvg_k": 40.0, "tvg_absorption_db_m": 0.2},
    "set speed": {"water": sg.Water(sound_speed_m_s=1450.0), "sonar_sound_speed_m_s": 1500.0},
    "sine spacing": {"beam_spacing": "sine"},
    "element errors": {"element_error_db": -36.0},
    "cross-talk": {"cross_talk_db": -20.0, "cross_talk_beams": 4},
    "tilt": {"tilt_deg": 12.0},
    "volume reverberation": {"water": sg.Water(volume_backscatter_db=-60.0)},
    "surface reverberation": {"water": sg.Water(wind_speed_m_s=7.0)},
    "no lobes": {"specular": False},
    "elevation box": {"elevation_pattern": "box"},
    "no pulse": {"pulse": False},
}
NOISES = {
    "gaussian": sg.Noise(gaussian=0.02),
    "median 3": sg.Noise(median=3),
    "median 5": sg.Noise(median=5),
    "salt and pepper": sg.Noise(salt_and_pepper=0.01),
    "demarco2015": sg.Noise.demarco2015(),
    "physical": sg.Noise.physical(),
    "speckle": sg.Noise(speckle=True),
    "looks": sg.Noise(speckle=True, looks=3, ambient_db=-80.0),
    "ambient": sg.Noise(speckle=True, self_noise=True, ambient_db=-70.0),
    "interference": sg.Noise(interference_lines=6.0),
    "locked": sg.Noise(speckle=True, follow_motion=True),
    "dropped beams": sg.Noise(dropped_beams=0.1),
    "all": sg.Noise(
        speckle=True,
        gaussian=0.01,
        salt_and_pepper=0.005,
        median=3,
        looks=2,
        follow_motion=True,
        self_noise=True,
        ambient_db=-80.0,
        interference_lines=3.0,
    ),
}
FANS = {
    "one beam": fan_of(1, 1),
    **{f"{fov} degrees": fan_of(fov) for fov in (45, 120, 130, 179, 180, 270, 360)},
    "tall": fan_of(45, elevation_fov_deg=110.0),
    "table of azimuths": fan_of(90, 60, beam_azimuths_deg=tuple(44 * np.sin(np.linspace(-1.5, 1.5, 60)))),
    "one bin": fan_of(45, n_bins=1),
}
SPEEDS = {
    "ahead": (3.0, 0, 0, 0, 0, 0),
    "aside": (0, -2.0, 0, 0, 0, 0),
    "turning": (1.0, 0.5, 0.2, 0.1, 0.2, 0.6),
}
SAMPLINGS = {
    "footprint coarse": sg.Sampling(0.5, 16),
    "footprint fine": sg.Sampling(6, 200),
    "point coarse": sg.Sampling(1, 40, "point"),
    "point fine": sg.Sampling(6, 200, "point"),
}
MOVED = [
    None if k == 2 else {"ball": sg.pose(6, 2 - 0.5 * k, -1.5), "faces": None if k % 2 else POSE @ sg.pose(8)}
    for k in range(len(PATH))
]
SCALED = {
    "ball": sg.pose(6, 2, -1.5) @ np.diag([1.5, 1.5, 1.5, 1.0]),
    "wall": sg.pose(13, -2, -1, yaw=0.3) @ np.diag([0.6, 0.6, 0.6, 1.0]),
}
EMBEDDED = {
    "current": joined,
    "current, labels": partial(joined, **LABELS),
    "current, far": partial(joined, "far"),
    "sectors": partial(sectors, labels=True),
    "sectors, 150 degrees": partial(sectors, fan_of(150), labels=True),
    "sectors, tolerance": partial(
        sectors, sampling=None, noise=NOISES["physical"], velocity=SPEEDS["turning"]
    ),
    "sectors, far": partial(sectors, scene="far"),
    "textures": partial(textures, labels=True),
    "textures, 150 degrees": partial(textures, fan_of(150), labels=True),
    "textures, no normals": partial(textures, with_normals=False),
    "textures, metres": partial(textures, holds="planar"),
    "textures, far": partial(textures, scene="far", noise=NOISES["physical"]),
    "depth, one camera": partial(images, labels=True),
    "depth, four cameras": partial(images, fan_of(300), labels=True),
    "depth, ranges": partial(images, holds="range", sampling=FIXED),
    "depth, no normals": partial(
        images, with_normals=False, noise=NOISES["physical"], velocity=SPEEDS["aside"]
    ),
    "depth, image of reflectivity": image,
    "depth, narrow": partial(images, cameras=[sg.Camera.of_fov(320, 200, fov_x_rad=0.6)], reflectivity=0.6),
}


def cases() -> Iterator[tuple[str, Callable]]:
    """(name, function that makes what is digested) of each case; no case knows of another."""
    full = sg.load_sonar("p900-45")
    for scene in sg.bundled_scenes():
        yield f"load/{scene}", partial(loaded, scene)
        for profile, acoustics in PROFILES.items():
            yield f"{scene}/{profile}/plain", partial(one, scene, full, acoustics)
            yield f"{scene}/{profile}/labels", partial(one, scene, full, acoustics, **LABELS)
    yield "load/sdf", partial(loaded, _sdf)
    for ending in ("stl", "obj", "ply", "glb", ""):
        yield f"load/{ending or 'trimesh'}", partial(loaded, partial(_meshes, ending))
    for name, fields in TERMS.items():
        sonar, acoustics = described(SONAR, **fields)
        yield f"term/{name}", partial(one, sonar=sonar, acoustics=acoustics)
    for law in ("constant", "inverse"):
        yield f"term/law {law}", partial(one, acoustics=sg.Acoustics.demarco2015(law))
    for scene in ("pylon", "diver_vertical"):
        yield f"term/needed {scene}", partial(needed, scene)

    for way in ("incoherent", "coherent"):
        acoustics = sg.Acoustics.physical(multipath=way)
        yield f"multipath/{way}/tolerance", partial(one, acoustics=acoustics, **LABELS)
        yield f"multipath/{way}/sampling", partial(one, acoustics=acoustics, sampling=FIXED)
        yield f"multipath/{way}/diver", partial(one, "diver", acoustics=acoustics, time_s=1.0)
        yield f"multipath/{way}/130 degrees", partial(one, "bubbles", fan_of(130), acoustics=acoustics)
    for time_s in (0.0, 2.5, 1234.5):
        yield f"bubbles/{time_s:g} s", partial(one, "bubbles", time_s=time_s, **LABELS)
    yield "bubbles/none", partial(one, "bubbles", acoustics=sg.Acoustics.physical(bubbles=False), time_s=2.5)
    yield "bubbles/diver_vertical", partial(one, "diver_vertical", sg.load_sonar("p900-90"), time_s=7.25)
    for name, velocity in SPEEDS.items():
        yield f"motion/{name}", partial(one, velocity=velocity, noise=NOISES["physical"], **LABELS)

    for name in ("speckle", "locked", "all"):
        yield f"noise/{name}, patchy", partial(one, "patchy", sampling=FIXED, noise=NOISES[name], seed=7)
    for name, noise in NOISES.items():
        yield f"noise/{name}", partial(one, sampling=FIXED, noise=noise, seed=7, ping_number=3)
    ringing = dataclasses.replace(
        SONAR, ring_down_db=-20.0, common_noise_db=-70.0, source_level_db=210.0, bandwidth_hz=20e3
    )
    receiver = sg.Noise(self_noise=True, thermal_noise=True)
    yield "noise/receiver", partial(one, sonar=ringing, sampling=FIXED, noise=receiver)
    few = sg.Acoustics.physical(water=sg.Water(volume_backscatter_db=-60.0, scatterer_density_m3=20.0))
    for name in ("speckle", "locked"):
        yield f"noise/{name}, few scatterers", partial(one, acoustics=few, sampling=FIXED, noise=NOISES[name])
    circle = FANS["360 degrees"]
    straight = {"bandwidth_hz": 20e3, "pulse_taper": "uniform", "steered": "straight"}
    straight, pulse = described(SONAR, pulse=True, **straight)
    for name in ("physical", "locked"):
        yield (
            f"noise/{name}, pulse",
            partial(one, sonar=straight, acoustics=pulse, sampling=FIXED, noise=NOISES[name]),
        )
        yield f"noise/{name}, 360 degrees", partial(one, "yard", circle, sampling=FIXED, noise=NOISES[name])
    creep = [POSE @ sg.pose(0.42 + 0.02 * k, 0.01 * k, 0, 0, 0, 0.01 * k) for k in range(6)]
    yield "noise/locked, moving", partial(several, sampling=FIXED, path=creep, noise=NOISES["locked"])

    for name, sonar in FANS.items():
        yield f"fan/{name}", partial(one, sonar=sonar, **LABELS)
    yield "fan/360 degrees, sampling", partial(one, "bubbles", circle, sampling=FIXED)
    for name, sampling in SAMPLINGS.items():
        yield f"sampling/{name}", partial(one, sampling=sampling, labels=True)
    for tolerance in (0.2, 0.02, 0.005):
        yield f"tolerance/{tolerance:g}", partial(one, tolerance=tolerance, labels=True)
    yield "crowd/tolerance", partial(one, "crowd", labels=True)
    yield "crowd/sampling", partial(one, "crowd", sampling=FIXED)
    for way in ("tolerance", "sampling"):
        sampling = FIXED if way == "sampling" else None
        yield f"far/{way}", partial(one, "far", sampling=sampling, time_s=2.5, **LABELS)
    yield "far/multipath", partial(one, "far", acoustics=sg.Acoustics.physical(multipath="incoherent"))

    mu, water = {"ball": 0.1, "map": 0.5, "floor": 0.9}, sg.Water(temperature_c=20.0, salinity_psu=5.0)
    tvg = sg.Acoustics.physical(tvg_absorption_db_m=0.3)
    yield "this ping/bodies", partial(one, bodies=MOVED[1], **LABELS)
    yield "this ping/scales", partial(one, bodies=SCALED, **LABELS)
    mirrored = sg.Acoustics.physical(multipath="incoherent")
    yield "this ping/scales, multipath", partial(one, acoustics=mirrored, bodies=SCALED)
    yield "this ping/reflectivity", partial(one, reflectivity=mu, **LABELS)
    yield "this ping/water", partial(one, acoustics=tvg, water=water, noise=NOISES["physical"])
    yield "world/place and add", changed
    yield "world/shared", shared

    planned = partial(several, plan=True)
    yield "sequence/tolerance", several
    yield "sequence/one by one", partial(several, alone=True, noise=NOISES["physical"], seed=5)
    yield "sequence/planned", partial(planned, noise=NOISES["physical"], seed=5)
    yield "sequence/planned, one by one", partial(planned, alone=True, noise=NOISES["physical"], seed=5)
    yield "sequence/sampling", partial(several, sampling=FIXED, **LABELS)
    yield "sequence/bodies", partial(planned, bodies=MOVED, **LABELS)
    yield "sequence/times", partial(planned, "bubbles", times_s=[0.5 * k for k in range(6)])
    yield "sequence/velocities", partial(planned, velocities=[None, *SPEEDS.values(), None, None])
    yield "sequence/reflectivities", partial(planned, reflectivities=[mu, None, mu, None, None, mu])
    yield "sequence/waters", partial(planned, acoustics=tvg, waters=[water, None, None, water, water, None])
    yield "sequence/multipath", partial(planned, acoustics=sg.Acoustics.physical(multipath="coherent"))
    far = [sg.pose(FAR_M, FAR_M) @ pose for pose in PATH]
    yield "sequence/far", partial(several, "far", path=far)
    floor = [sg.pose(0.4 * k - 22, 0.1 * k, -6.74, 0, 0.25, 0.05 * k) for k in range(6)]
    yield "sequence/ocean_floor", partial(several, "ocean_floor", path=floor, plan=True)

    yield "seen/60 degrees", seen
    yield "seen/180 degrees", partial(seen, FANS["180 degrees"])
    yield "seen/360 degrees", partial(seen, circle)
    yield "seen/ocean_floor", partial(seen, scene="ocean_floor")
    for name, function in EMBEDDED.items():
        yield f"embed/{name}", function

    yield "picture/counts", picture
    yield "picture/linear", partial(picture, counts=sg.Counts("power", exponent=1.0))
    yield "picture/small", partial(picture, height=80, counts=sg.Counts(low_db=-40.0, high_db=-5.0))
    for name in ("one beam", "180 degrees", "360 degrees", "table of azimuths"):
        yield f"picture/{name}", partial(picture, FANS[name])
    yield "picture/files", files
    yield "paper/circles", paper
    yield "paper/printed", partial(paper, form="printed", range_law="constant", seed=3)
    yield "paper/polygons", partial(paper, join="polygons", range_law="inverse", noise=sg.Noise.none())
    for profile in ("ideal", "physical"):
        yield f"reference/{profile}", partial(truth, PROFILES[profile])
    yield "batch", batch


def flat(value, name: str = "") -> Iterator[tuple[str, object]]:
    """(name, array, bytes, number or text) of all that a result holds."""
    if dataclasses.is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.name not in SETTINGS}
    elif isinstance(value, (list, tuple)):
        value = dict(enumerate(value))
    if isinstance(value, dict):
        for key, part in value.items():
            if key == "meta":
                yield from flat({k: part[k] for k in STABLE_META if k in part}, name)
            else:
                yield from flat(part, f"{name}.{key}" if name else str(key))
    elif value is not None:
        yield name, value


def digest(value) -> str:
    """A hash of an array's type, shape and bytes, all NaN alike, or of bytes; a number without rounding."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "f":
            value = np.where(np.isnan(value), value.dtype.type(np.nan), value)
        value = f"{value.dtype.str} {value.shape} ".encode() + value.tobytes()
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()[:16]
    return float(value).hex() if isinstance(value, (float, np.floating)) else str(value)


def fingerprint() -> dict[str, str]:
    """What bits depend on: the processor (its name, family, model and stepping), OpenGL, versions."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().split("\n\n")[0].splitlines() if cpuinfo.exists() else []
    about = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    kinds = [about[key] for key in ("model name", "cpu family", "model", "stepping") if key in about]
    opengl = {"OpenGL renderer": one(sampling=FIXED).meta["gl_renderer"]}
    with host_of(yard()):
        opengl["OpenGL version"] = GL.glGetString(GL.GL_VERSION).decode()
    versions = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "none"
    return {"processor": ", ".join(kinds) or platform.processor(), **opengl, **versions}


def arrays_file(folder: Path, name: str) -> Path:
    return folder / f"{name.replace('/', '__')}.npz"


def how_far(now, then) -> str:
    """By how much two arrays differ, in words."""
    if now.shape != then.shape or now.dtype != then.dtype:
        return f"{then.dtype} {then.shape} has become {now.dtype} {now.shape}"
    other = ~((now == then) | ((now != now) & (then != then)))
    out = f"{other.sum()} of {other.size} differ"
    if now.dtype.kind == "f":
        a, b = (np.nan_to_num(one.astype(np.float64), posinf=0.0, neginf=0.0) for one in (now, then))
        out += f", by {np.abs(a - b).sum() / max(np.abs(b).sum(), 1e-300):.2g} of the sum"
    return out


def make(function) -> dict[str, object]:
    """All that a case makes, by field."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # no echo, samples that cannot be met: as they may be
        return dict(flat(function()))


def compare(name: str, made: dict, then: dict[str, str], arrays: Path | None) -> list[str]:
    """What differs, in words, a line a field."""
    now, arrays_then, out = {field: digest(value) for field, value in made.items()}, {}, []
    if arrays is not None and arrays_file(arrays, name).exists():
        with np.load(arrays_file(arrays, name)) as file:
            arrays_then = {field: file[field] for field in file.files}
    for field in sorted({*now, *then}):
        if now.get(field) == then.get(field):
            continue
        what = f"{then.get(field, 'nothing')} has become {now.get(field, 'nothing')}"
        if field in arrays_then and isinstance(made.get(field), np.ndarray):
            what = how_far(made[field], arrays_then[field])
        out.append(f"{name}: {field}: {what}")
    return out


def write(machine: dict, digests: dict) -> None:
    """The record, a line a case."""
    lines = [f"  {json.dumps(name)}: {json.dumps(fields)}" for name, fields in digests.items()]
    text = '{{\n "machine": {},\n "digests": {{\n{}\n }}\n}}\n'
    RECORD.write_text(text.format(json.dumps(machine), ",\n".join(lines)))


def main() -> int:
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m tools.digests", description=__doc__, formatter_class=as_written
    )
    parser.add_argument("--record", action="store_true", help="write the digests instead of comparing them")
    parser.add_argument("--only", metavar="GLOB", default="*", help='names of cases, such as "fan/*"')
    parser.add_argument("--arrays", metavar="DIR", type=Path, help="folder of the arrays themselves, as NPZ")
    parser.add_argument("--list", action="store_true", help="list the cases")
    args = parser.parse_args()
    table = {name: function for name, function in cases() if fnmatchcase(name, args.only)}
    if args.list:
        print("\n".join(table))
        return 0
    if not table:
        parser.error(f"--only {args.only!r} must name a case; --list lists them")
    if args.arrays and not args.record and not args.arrays.is_dir():
        parser.error(f"--arrays {args.arrays} must be the folder that --record wrote")
    machine = fingerprint()
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {"machine": machine, "digests": {}}
    there = {key: (record["machine"].get(key), machine.get(key)) for key in {*record["machine"], *machine}}
    other = {key: pair for key, pair in there.items() if pair[0] != pair[1]}
    print(f"{len(table)} cases of {Path(sg.__file__).parent}", flush=True)
    if args.record and (args.only == "*" or not record["digests"]):
        record = {"machine": machine, "digests": {}}
    elif args.record and other:
        parser.error(
            f"a record of another machine must be made anew; leave out --only, or delete {RECORD} first"
        )
    for key, (then, now) in sorted(other.items()) if not args.record else ():
        print(f"ANOTHER MACHINE: {key} was {then!r} and is {now!r}; bits may differ for that alone")

    def tell(lines):
        wrong.extend(lines)
        for line in lines:
            print(line, flush=True)

    wrong, start = [], perf_counter()
    if args.record and args.arrays:
        args.arrays.mkdir(parents=True, exist_ok=True)
    for name, function in table.items():
        if args.record:
            made = make(function)
            record["digests"][name] = {field: digest(value) for field, value in made.items()}
            if args.arrays:
                found = {field: value for field, value in made.items() if isinstance(value, np.ndarray)}
                np.savez_compressed(arrays_file(args.arrays, name), **found)
        elif name not in record["digests"]:
            tell([f"{name}: not in the record"])
        else:
            try:
                tell(compare(name, make(function), record["digests"][name], args.arrays))
            except Exception as why:  # a name that is gone, say: the other cases go on
                tell([f"{name}: {type(why).__name__}: {why}"])
    took = f"{perf_counter() - start:.0f} s"
    if args.record:
        write(machine, record["digests"])
        print(f"recorded {len(table)} cases in {RECORD} ({took})")
        return 0
    gone = [name for name in record["digests"] if fnmatchcase(name, args.only) and name not in table]
    tell([f"{name}: in the record, but there is no such case" for name in gone])
    differing = {line.split(": ")[0] for line in wrong}
    print(f"{len(differing)} of {len(table) + len(gone)} cases differ, in {len(wrong)} fields ({took})")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
