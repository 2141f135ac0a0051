"""Files of every kind that the product reads, with random mistakes in them.

By hand, `python -m tests.support.file_fuzzer SEED SECONDS` goes on for that time and prints each crash once.
"""

from __future__ import annotations

import json
import random
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.batch.job import read_job
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.poses import read_poses
from sonar_gl.imaging.files import load_npz, save_npz

SLOW_S = 20  # a case that takes longer is a hang
NUMBER = rb"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])"
WORD = rb"[A-Za-z_][\w.:]*"
ODD_NUMBERS = b"""0 -0.0 1 -1 0.5 3 7 255 256 65535 65536 -2147483648 4294967296 1e308 -1e308 1e-308 1e20 -1e20 1e400
1e-12 nan inf -inf 6.2832 3.14159265 90 180 true false [] [[]] {} [1,[],2] "" 'x' 0x10 1_000""".split()
ODD_NUMBERS += [b"9" * 400, b"1" + b"0" * 5000, b"", "²".encode(), "١".encode()]
ODD_BYTES = [text.encode() for text in ("\x9b31m", "\u202egnp", "../", "file:///etc/passwd", "1e999", "'''")]
ODD_BYTES += [b"\xff\xfe", b"\x9b", b"\n\n", *(bytes([code]) for code in b'\0"<>&\r#,]= \t-')]

SONAR = """[one]
frequency_hz = 900e3
n_beams = 16
n_bins = 32
azimuth_fov_deg = 60.0
elevation_fov_deg = 20.0
beam_width_deg = 4.0
range_min_m = 0.5
range_max_m = 10.0
bandwidth_hz = 30e3
beam_spacing = "sine"
source = "made up"
"""
BEAMS = "beam_azimuths_deg = [" + ", ".join(f"{-29 + 3.8 * k:.1f}" for k in range(16)) + "]\n"
JOB = """seed = 3
tolerance = 0.05
scenes = ["scene.sdf"]
pings_per_part = 4

[acoustics]
profile = "physical"
tvg_k = 30.0
pulse = true

[water]
temperature_c = 8.0

[noise]
preset = "physical"
speckle = true
looks = 2

[[sonars]]
sonar = "sonar.toml"
name = "front"
range_m = 8.0
bins = 24
mount = [0.1, 0.0, 0.2, 0.0, 0.1, 0.0]

[[poses]]
kind = "trajectory"
file = "poses.csv"

[[poses]]
kind = "lawnmower"
centre_m = [0.0, 1.0]
z_m = -2.0
length_m = 4.0
width_m = 4.0
line_spacing_m = 2.0
speed_m_s = 1.0
ping_rate_hz = 2.0
yaw_rad = 0.3

[[poses]]
kind = "orbit"
centre_m = [0.0, 0.0, -3.0]
radius_m = 5.0
z_m = -2.0
n_pings = 8
turns = 1.0

[[poses]]
kind = "sector"
position_m = [0.0, 0.0, -1.0]
pan_rad = [-0.5, 0.5]
n_pings = 5
ping_rate_hz = 1.0
sweep_s = 3.0

[[poses]]
kind = "random_views"
target_m = [3.0, 0.0, -2.0]
target_size_m = [1.0, 1.0, 1.0]
range_m = [2.0, 6.0]
n_pings = 6
elevation_rad = [-0.3, 0.5]
z_m = [-9.0, 0.0]
azimuth_jitter_rad = 0.1
seed = 4

[[vary.bodies]]
names = ["rock*"]
x_m = [-1.0, 1.0]
yaw_rad = [-3.0, 3.0]
there = 0.8
reflectivity = [0.2, 0.9]

[vary.water]
temperature_c = [4.0, 12.0]

[vary.noise]
ambient_db = [-90.0, -60.0]
looks = [1, 3]

[labels]
layers = ["body", "class", "shadow", "boxes"]
background = ["floor"]
height = 64
level_db = -50.0

[labels.classes]
stone = ["rock"]

[coco]
height = 64
counts = { law = "db", low_db = -50.0, gain_percentile = 99.0 }

[pictures]
formats = ["png"]
height = 64
counts = { law = "power", exponent = 0.3, bits = 16 }
colormap = "gray"
fps = 5.0
"""
SHAPES = """<cylinder><radius>0.5</radius><length>2</length></cylinder>
<sphere><radius>0.4</radius></sphere>
<capsule><radius>0.2</radius><length>1</length></capsule>
<ellipsoid><radii>1 2 3</radii></ellipsoid>
<cone><radius>1</radius><length>2</length></cone>
<polyline><point>0 0</point><point>1 0</point><point>1 1</point><height>2</height></polyline>
<heightmap><uri>map.png</uri><size>9 9 1</size><pos>0 0 -5</pos></heightmap>"""
COLLISIONS = "\n".join(
    f"<collision name='{k}'><geometry>{shape}</geometry><laser_retro>{k}</laser_retro></collision>"
    for k, shape in enumerate(SHAPES.split("\n"))
)
SCENE = f"""<?xml version="1.0"?>
<sdf version="1.9"><world name="w">
<!-- a small world -->
<sonar_gl:surface roughness="0.001">2.0</sonar_gl:surface>
<model name="floor"><static>true</static><link name="link"><collision name="c"><geometry>
<plane><normal>0 0 1</normal><size>20 20</size></plane></geometry><laser_retro>120</laser_retro></collision></link>
</model>
<model name="rock"><pose>3 0 -1 0.1 0.2 0.3</pose><link name="link"><pose degrees="true">0 0 0 10 20 30</pose>
<collision name="a"><geometry><mesh><uri>mesh.obj</uri><scale>1 1 2</scale></mesh></geometry>
<laser_retro>200</laser_retro></collision>
<collision name="b"><pose relative_to="link">0 1 0 0 0 0</pose><geometry><box><size>1 2 3</size></box></geometry>
<sonar_gl:material>rock</sonar_gl:material><sonar_gl:specular>0.2</sonar_gl:specular></collision></link></model>
<model name="things"><link name="l">
{COLLISIONS}
<collision name="map"><geometry><box><size>1 1 1</size></box></geometry>
<sonar_gl:reflectivity_map>map.png</sonar_gl:reflectivity_map></collision>
<sonar_gl:bubbles name="air"><pose>1 0 -2 0 0 0</pose><rate>20</rate><radius>0.004</radius><height>2</height>
</sonar_gl:bubbles></link>
<frame name="f" attached_to="l"><pose>1 2 3 0 0 0</pose></frame></model>
<model name="vehicle"><pose>0 0 0.5 0 0.2 0</pose><link name="link">
<sensor name="sonar" type="custom"><pose>0 0 0 0 0 0</pose></sensor></link></model>
<include><uri>model://ground_plane</uri><pose>0 0 -9 0 0 0</pose></include>
</world></sdf>
"""
POSES = "t,x,y,z,roll,pitch,yaw,note\n" + "".join(
    f"{0.5 * k},{0.1 * k:.2f},1.5,-2,0,{0.05 * k:.2f},{0.7 * k:.2f},row {k}\n" for k in range(12)
)


class Kind(NamedTuple):
    """A kind of file: its name, content, and the function that reads it."""

    name: str
    content: bytes
    read: Callable[[Path], object]


def read_all_of_job(path: Path) -> None:
    """Read a job, and the requests for its first and last ping."""
    requests = BatchRequests(read_job(path))
    for number in (0, len(requests) - 1):
        requests[number].for_sonar(requests.mounts["front"] if "front" in requests.mounts else np.eye(4))


def make_kinds(folder: Path) -> list[Kind]:
    """Write a sound file of every kind into a folder, and return the kinds."""
    ball = trimesh.creation.icosphere(1, 0.5)
    mesh_scene = trimesh.Scene([ball, trimesh.creation.box((1, 2, 3))])
    ball.export(folder / "mesh.obj")
    cv2.imwrite(str(folder / "map.png"), np.arange(81, dtype=np.uint8).reshape(9, 9) * 3)
    (folder / "sonar.toml").write_text(SONAR)
    (folder / "poses.csv").write_text(POSES)
    (folder / "scene.sdf").write_text(SCENE)
    rng = np.random.default_rng(0)
    beams = np.linspace(-0.4, 0.4, 4), np.linspace(1.0, 3.0, 6)
    labels = {
        "body_id": np.ones((4, 6), np.uint16),
        "share": np.ones((4, 6), np.float32),
        "body_echo": np.ones(2),
    }
    sonar, meta = sg.load_sonar(folder / "sonar.toml"), {"sonar": None, "bin_size_m": 0.4}
    ping = sg.Ping(rng.random((4, 6), np.float32), *beams, pose=np.eye(4), sonar=sonar, meta=meta, **labels)
    save_npz(folder / "ping.npz", ping)
    gltf = {name: bytes(data) for name, data in trimesh.exchange.gltf.export_gltf(mesh_scene).items()}
    for name, data in gltf.items():
        (folder / name).write_bytes(data)
    meshes = {
        "obj": ball.export(file_type="obj").encode(),
        "stl": ball.export(file_type="stl"),
        "text.stl": ball.export(file_type="stl_ascii").encode(),
        "ply": ball.export(file_type="ply"),
        "text.ply": ball.export(file_type="ply", encoding="ascii"),
        "glb": mesh_scene.export(file_type="glb"),
        "gltf": gltf["model.gltf"],
        "dae": ball.export(file_type="dae"),
    }
    return [
        Kind("sonar.toml", SONAR.encode(), sg.load_sonar),
        Kind("beams.toml", (SONAR + BEAMS).encode(), sg.load_sonar),
        Kind("job.toml", JOB.encode(), read_all_of_job),
        Kind("scene.sdf", SCENE.encode(), sg.load_scene),
        Kind("poses.csv", POSES.encode(), read_poses),
        Kind("ping.npz", (folder / "ping.npz").read_bytes(), load_npz),
        Kind("members.npz", (folder / "ping.npz").read_bytes(), load_npz),
        *(Kind(f"a.{suffix}", data, sg.load_scene) for suffix, data in meshes.items()),
    ]


def spoil(content: bytes, random: random.Random) -> bytes:
    """Return a content with some mistakes."""
    for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
        content = random.choice(MISTAKES)(content, random)
    return content


def _spot(content: bytes, random) -> int:
    return random.randrange(len(content) + 1)


def _change_byte(content, random):
    at = _spot(content, random)
    return content[:at] + bytes([random.randrange(256)]) + content[at + 1 :]


def _insert(content, random):
    at = _spot(content, random)
    return content[:at] + random.choice(ODD_BYTES) + content[at:]


def _cut(content, random):
    at = _spot(content, random)
    return content[:at] + content[at + random.choice((1, 4, 30, 10**9)) :]


def _repeat(content, random):
    at, length = _spot(content, random), random.choice((1, 8, 60))
    return content[:at] + content[at : at + length] * random.choice((2, 9)) + content[at + length :]


def _line(content, random):
    lines = content.split(b"\n")
    at, other = random.randrange(len(lines)), random.randrange(len(lines))
    lines[at : at + 1] = random.choice(([], [lines[at]] * 2, [lines[other]]))
    return b"\n".join(lines)


def _replace(pattern, choose):
    def change(content, random):
        found = list(re.finditer(pattern, content[:20_000]))
        if not found:
            return _change_byte(content, random)
        one = random.choice(found)
        return content[: one.start()] + choose(found, random) + content[one.end() :]

    return change


_number = _replace(NUMBER, lambda found, random: random.choice(ODD_NUMBERS))
_word = _replace(WORD, lambda found, random: random.choice(found)[0])
MISTAKES = [_change_byte, _insert, _cut, _repeat, _line, _number, _number, _number, _word]


def spoil_members(content: bytes, path: Path, random: random.Random) -> bytes:
    """Return an archive whose members are sound or spoiled, with right checksums."""
    path.write_bytes(content)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    names = list(members)
    for name in random.sample(names, random.choice((1, 1, 2))):
        kind = random.choice(("spoil", "drop", "other", "object", "text", "json"))
        if kind == "drop":
            members.pop(name)
        elif kind == "other":
            members[name] = members.get(random.choice(names), b"")
        elif kind == "json":
            odd = random.choice(([], 3, None, {"sonar": 5}, {"sonar": {"name": [1]}}, {"acoustics": "x"}))
            members["meta.npy"] = _npy(np.array(json.dumps(odd)))
        elif kind in ("object", "text"):
            odd = {"object": np.array([{}, []], object), "text": np.array(["a", "b"])}[kind]
            members[name] = _npy(odd)
        else:
            members[name] = spoil(members[name], random)
    with zipfile.ZipFile(path, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path.read_bytes()


def _npy(array) -> bytes:
    with tempfile.TemporaryFile() as file:
        np.save(file, array, allow_pickle=True)
        file.seek(0)
        return file.read()


def is_sound_message(text: str) -> bool:
    """Return whether a message is of bounded length, and has no character that a terminal would obey."""
    return len(text) < 3000 and not re.search(
        "[\\0-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069]", text
    )


def try_case(kind: Kind, folder: Path, random: random.Random) -> bool:
    """Read a spoiled file; return whether it was accepted. Anything but an `Error` is raised."""
    path = folder / f"spoiled_{kind.name}"
    if kind.name == "members.npz":
        content = spoil_members(kind.content, path, random)
    else:
        content = spoil(kind.content, random)
    path.write_bytes(content)
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        try:
            kind.read(path)
        except sg.Error as why:
            if not is_sound_message(str(why)):
                raise AssertionError(f"the message is unsound: {str(why)[:300]!r}") from why
            return False
    return True


def main(seed: int, seconds: float) -> int:
    """Try cases for a time, and print each crash once, with the file that causes it."""
    start, counts, crashes = time.monotonic(), Counter(), {}
    signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(TimeoutError("a hang")))
    with tempfile.TemporaryDirectory() as name:
        folder, chance = Path(name), random.Random(seed)
        kinds = make_kinds(folder)
        for kind in kinds:
            (folder / f"sound_{kind.name}").write_bytes(kind.content)
            kind.read(folder / f"sound_{kind.name}")
        while time.monotonic() < start + seconds:
            kind = chance.choice(kinds)
            signal.alarm(SLOW_S)
            try:
                counts[kind.name, try_case(kind, folder, chance)] += 1
            except BaseException as why:
                if isinstance(why, KeyboardInterrupt):
                    raise
                last = traceback.extract_tb(why.__traceback__)
                ours = [
                    f"{f.filename.rpartition('/')[2]}:{f.lineno}" for f in last if "sonar_gl" in f.filename
                ]
                key = (kind.name, type(why).__name__, ours[-1] if ours else str(last[-1]))
                if key not in crashes:
                    kept = Path(tempfile.gettempdir()) / f"crash_{seed}_{len(crashes)}_{kind.name}"
                    with suppress(OSError):
                        kept.write_bytes((folder / f"spoiled_{kind.name}").read_bytes())
                    print(*key, str(why)[:200], kept, flush=True)
                crashes[key] = crashes.get(key, 0) + 1
            finally:
                signal.alarm(0)
    n_accepted = sum(n for (_, accepted), n in counts.items() if accepted)
    print(
        f"seed {seed}: {sum(counts.values())} cases, {n_accepted} accepted, {sum(crashes.values())} crashes"
    )
    return bool(crashes)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), float(sys.argv[2])))
