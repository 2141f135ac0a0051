"""Write the bundled scenes that are generated: the divers, the harbour, the ocean floor and its heightmap.

    python -m tools.docs.make_scenes            # into scenes/
    python -m tools.docs.make_scenes --out DIR

The same command writes the same bytes. scenes/pylon.sdf is written by hand.
"""

from __future__ import annotations

import argparse
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

import sonar_gl as sg

SCENES = Path(__file__).resolve().parents[2] / "scenes"
COMMAND = "Generated: python -m tools.docs.make_scenes"


class Surface(NamedTuple):
    """What a shape is made of: a material of sonar_gl, the colour that Gazebo shows, and a laser_retro.

    laser_retro, 0..255, overrides the diffuse part of the material; speckle is the shape of its K distribution.
    """

    material: str
    colour: str
    retro: int | None = None
    speckle: float | None = None


SURFACES = {
    "suit": Surface("foam_neoprene", "0.16 0.18 0.22 1"),
    "glove": Surface("foam_neoprene", "0.75 0.62 0.10 1"),
    "hose": Surface("foam_neoprene", "0.20 0.20 0.20 1"),  # full of gas, behind a wall thin to sound
    "fin": Surface("rubber", "0.75 0.62 0.10 1"),
    "brass": Surface("brass", "0.72 0.56 0.24 1"),
    "steel": Surface("steel", "0.45 0.47 0.50 1"),
    "sand": Surface("sand", "0.62 0.55 0.40 1"),
    # so smooth that it reflects; by its laser_retro the diffuse part is weaker than that of bare concrete
    "tiles": Surface("smooth_concrete", "0.62 0.55 0.40 1", 60),
    # few shells and stones in soft mud: stronger grain than of many alike scatterers
    "silt": Surface("silt", "0.36 0.34 0.28 1", speckle=2.0),
    "stone": Surface("rock", "0.42 0.40 0.37 1"),
    "concrete": Surface("concrete", "0.55 0.55 0.52 1"),
    "timber": Surface("wet_wood", "0.35 0.25 0.15 1"),
    "tyre": Surface("rubber", "0.10 0.10 0.10 1"),
    "rust": Surface("corroded_steel", "0.45 0.28 0.16 1"),
}


# --- SDF


def numbers(*values) -> str:
    """Return numbers as SDF writes them, to a tenth of a millimetre (or milliradian)."""
    return " ".join(f"{round(float(v), 4) + 0.0:g}" for v in values)


def add(parent, tag, text=None, **attributes):
    """Add a child element; return it."""
    child = ET.SubElement(parent, tag, attributes)
    child.text = text
    return child


def geometry(parent, shape: str, rings=(), **sizes):
    """Add the `<geometry>` of one shape; rings are the outlines of a polyline, those inside others holes."""
    parent = add(parent, "geometry")
    for ring in rings or ((),):
        inner = add(parent, shape)
        for point in ring:
            add(inner, "point", numbers(*point))
        for tag, value in sizes.items():
            add(inner, tag, value if isinstance(value, str) else numbers(*np.ravel(value)))


def place(link, name: str, surface: str, shape: str, position=(0, 0, 0), rotation=(0, 0, 0), **sizes):
    """Add one shape to a link: its collision, and a visual like it."""
    material, colour, retro, speckle = SURFACES[surface]
    for tag in ("collision", "visual"):
        part = add(link, tag, name=name)
        if np.any(position) or np.any(rotation):
            add(part, "pose", numbers(*position, *rotation))
        geometry(part, shape, **sizes)
        if retro is not None:
            add(part, "laser_retro", str(retro))
        if tag == "visual":
            paint = add(part, "material")
            add(paint, "ambient", colour)
            add(paint, "diffuse", colour)
        add(part, "sonar_gl:material", material)
        if speckle is not None:
            add(part, "sonar_gl:speckle_shape", f"{speckle:g}")


def model(world, name: str, pose=None):
    """Add a static `<model>` of one link; return the link."""
    out = add(world, "model", name=name)
    add(out, "static", "true")
    if pose is not None:
        add(out, "pose", numbers(*pose))
    return add(out, "link", name="link")


def new_world(name: str, sonar_pose):
    """Make a `<world>` with a light and the sonar; return (root, world)."""
    root = ET.Element("sdf", {"version": "1.9", "xmlns:sonar_gl": "urn:sonar_gl"})
    world = add(root, "world", name=name)
    sun = add(world, "light", name="sun", type="directional")
    add(sun, "diffuse", "0.8 0.9 1 1")
    add(sun, "direction", "0.4 0.3 -0.9")
    add(model(world, "sonar", sonar_pose), "sensor", name="imaging_sonar", type="custom")
    return root, world


def add_pool(world, floor: float, depth: float = 3.0):
    """Add a smooth floor, and the calm water's surface above it."""
    place(
        model(world, "floor", (0, 0, floor, 0, 0, 0)),
        "floor",
        "tiles",
        "plane",
        normal=(0, 0, 1),
        size=(40, 40),
    )
    add(world, "sonar_gl:surface", f"{floor + depth:g}")


def add_breath(link, position):
    """Add the bubbles that a diver breathes out, a burst every four seconds."""
    plume = add(link, "sonar_gl:bubbles")
    add(plume, "pose", numbers(*position, 0, 0, 0))
    add(plume, "breath", "4")


def save(path: Path, root, description: str):
    """Write the SDF file: description first, then the command that makes it."""
    ET.indent(root)
    head = f'<?xml version="1.0"?>\n<!-- {description} -->\n<!-- {COMMAND} -->\n'
    path.write_text(head + ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


# --- the diver: joints, and shapes strung between them


def turn(axis) -> np.ndarray:
    """Return roll, pitch, yaw that turn z along `axis`, and leave y as near to itself as that allows."""
    z = np.asarray(axis, float) / np.linalg.norm(axis)
    x = np.cross((0, 1, 0), z)
    if np.linalg.norm(x) < 1e-6:  # along y itself
        x = np.array([1.0, 0, 0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    return np.array([np.arctan2(y[2], z[2]), -np.arcsin(np.clip(x[2], -1, 1)), np.arctan2(x[1], x[0])])


def rod(link, name, surface, shape, start, end, radius):
    """Add a capsule or cylinder from one joint to another."""
    start, end = np.array(start, float), np.array(end, float)
    length = np.linalg.norm(end - start)
    place(link, name, surface, shape, (start + end) / 2, turn(end - start), radius=radius, length=length)


# Upright body frame: x forward, y to the left, z to the head, soles at 0. Pairs: left, right.
STANDING = {
    "gaze": (1, 0.12, -0.10),
    "hip": ((0, 0.10, 0.92), (0, -0.10, 0.92)),
    "knee": ((0.13, 0.19, 0.51), (0.00, -0.19, 0.50)),
    "ankle": ((0.10, 0.25, 0.11), (-0.16, -0.25, 0.11)),
    "toes": ((0.97, 0.22, 0), (0.94, -0.34, 0)),
    "elbow": ((0.02, 0.47, 1.22), (0.17, -0.43, 1.24)),
    "wrist": ((0.20, 0.62, 1.06), (0.43, -0.41, 1.36)),
    "fins": False,
}
SWIMMING = {
    "gaze": (0.75, 0, 0.66),
    "hip": ((0, 0.10, 0.92), (0, -0.10, 0.92)),
    "knee": ((0.03, 0.15, 0.50), (0.14, -0.14, 0.52)),
    "ankle": ((-0.07, 0.18, 0.11), (0.22, -0.18, 0.12)),
    "toes": ((-0.18, 0.10, -0.98), (0.10, -0.12, -0.99)),
    "elbow": ((0.15, 0.38, 1.56), (0.12, -0.46, 1.30)),
    "wrist": ((0.20, 0.30, 1.83), (0.20, -0.58, 1.09)),
    "fins": True,
}


def add_diver(world, posture: dict, pose, centre=(0, 0, 0)):
    """Add the model `diver`: one link of some thirty shapes; `centre` of the body frame goes to `pose`.

    Suit, brass and steel are three bodies, since their specular lobes differ.
    """
    link = model(world, "diver", pose)

    def at(*point):
        return np.array(point, float) - centre

    up = np.array([0, 0, 1.0])

    def joint(name, i):
        return at(*posture[name][i])

    # trunk, weights
    place(link, "pelvis", "suit", "ellipsoid", at(0, 0, 0.95), radii=(0.15, 0.19, 0.16))
    place(link, "trunk", "suit", "ellipsoid", at(0, 0, 1.20), radii=(0.16, 0.20, 0.31))
    rod(link, "shoulders", "suit", "capsule", at(0, -0.19, 1.40), at(0, 0.19, 1.40), 0.10)
    place(link, "weight_left", "steel", "box", at(0.14, 0.09, 1.02), (0, 0, 0.45), size=(0.06, 0.10, 0.12))
    place(link, "weight_right", "steel", "box", at(0.14, -0.09, 1.02), (0, 0, -0.45), size=(0.06, 0.10, 0.12))

    # corselet and helmet with its windows
    gaze = np.array(posture["gaze"]) / np.linalg.norm(posture["gaze"])
    left = np.cross((0, 0, 1), gaze)
    left /= np.linalg.norm(left)
    head = at(0.02, 0, 1.66)
    place(link, "corselet", "brass", "ellipsoid", at(0.01, 0, 1.46), radii=(0.17, 0.22, 0.09))
    rod(link, "collar", "brass", "cylinder", at(0.02, 0, 1.50), at(0.02, 0, 1.57), 0.125)
    place(link, "helmet", "brass", "sphere", head, radius=0.16)
    rod(link, "window_front", "brass", "cylinder", head + 0.12 * gaze, head + 0.185 * gaze, 0.075)
    for side, sign in (("left", 1), ("right", -1)):
        way = 0.35 * gaze + 0.94 * sign * left
        rod(link, f"window_{side}", "brass", "cylinder", head + 0.12 * way, head + 0.175 * way, 0.05)

    add_breath(link, head + 0.13 * gaze + np.array([0, 0, 0.12]))

    # air: plate, tank, valve, and the hose over the right shoulder to the helmet
    place(link, "back_plate", "steel", "box", at(-0.15, 0, 1.22), size=(0.06, 0.26, 0.42))
    rod(link, "tank", "steel", "capsule", at(-0.26, 0, 1.00), at(-0.26, 0, 1.42), 0.095)
    rod(link, "valve", "steel", "cylinder", at(-0.26, 0, 1.50), at(-0.26, 0, 1.58), 0.03)
    rod(link, "hose", "hose", "capsule", at(-0.26, -0.01, 1.56), at(-0.09, -0.07, 1.66), 0.022)

    for i, (side, sign) in enumerate((("left", 1), ("right", -1))):
        elbow, wrist = joint("elbow", i), joint("wrist", i)
        rod(link, f"upper_arm_{side}", "suit", "capsule", at(0, 0.21 * sign, 1.40), elbow, 0.075)
        rod(link, f"forearm_{side}", "suit", "capsule", elbow, wrist, 0.060)
        reach = (wrist - elbow) / np.linalg.norm(wrist - elbow)
        hand = wrist + 0.10 * reach
        place(link, f"hand_{side}", "glove", "ellipsoid", hand, turn(reach), radii=(0.035, 0.05, 0.095))

        knee, ankle, toes = joint("knee", i), joint("ankle", i), np.array(posture["toes"][i])
        rod(link, f"thigh_{side}", "suit", "capsule", joint("hip", i), knee, 0.105)
        cuff = ankle + 0.17 * (knee - ankle) / np.linalg.norm(knee - ankle)
        rod(link, f"shin_{side}", "suit", "capsule", knee, ankle if posture["fins"] else cuff, 0.080)
        if posture["fins"]:
            foot, blade = ankle + 0.10 * toes, ankle + 0.44 * toes
            place(link, f"foot_{side}", "fin", "ellipsoid", foot, turn(toes), radii=(0.06, 0.06, 0.17))
            place(link, f"fin_{side}", "fin", "box", blade, turn(toes), size=(0.025, 0.23, 0.56))
        else:
            cap, sole = ankle + 0.09 * toes - up * 0.04, ankle + 0.09 * toes - up * 0.0875
            level = (0, 0, np.arctan2(toes[1], toes[0]))
            rod(link, f"boot_{side}", "brass", "cylinder", ankle - up * 0.05, cuff, 0.092)
            place(link, f"cap_{side}", "brass", "ellipsoid", cap, level, radii=(0.19, 0.075, 0.075))
            place(link, f"sole_{side}", "steel", "box", sole, level, size=(0.33, 0.13, 0.055))


def make_divers(out: Path):
    """Write three scenes: across a standing diver, up and down it, and across a swimming one."""
    floor = -8.0
    facing = (5.5, 0, floor, 0, 0, np.pi - 0.55)
    across = "A hard-hat diver with weighted boots and an air tank stands on the floor of a pool."
    upright = (
        "The standing diver, the sonar rolled by 90 degrees: the fan stands upright and shows the\n"
        "     profile from the boots to the helmet, and the floor as a line."
    )
    for name, sonar_pose, text in (
        ("diver", (0, 0, floor + 1.5, 0, 0.13, 0), across),
        ("diver_vertical", (1.2, 0.1, floor + 1.1, np.pi / 2, 0, 0), upright),
    ):
        root, world = new_world(name, sonar_pose)
        add_pool(world, floor)
        add_diver(world, STANDING, facing)
        save(out / f"{name}.sdf", root, text + " Range 10 m.")

    root, world = new_world("diver_swimming", (0, 0, floor + 3.3, 0, 0.38, 0))
    add_pool(world, floor, depth=4.0)  # above the sonar, too
    add_diver(world, SWIMMING, (4.3, 0.1, floor + 1.5, 0, 1.42, 2.0), centre=(0, 0, 1.0))
    text = "A diver with fins swims 1.5 m above a pool's floor, its shadow on the floor behind. Range 10 m."
    save(out / "diver_swimming.sdf", root, text)


# --- the harbour; a place at the quay is along the wall (to port), out from it, and up from the floor

BASIN = -9.0  # z of the floor; the surface is at 0
QUAY_AT, QUAY_YAW = (13.5, 0.0), -0.2  # where the wall lies ahead; shapes of this yaw stand square to it
BERTH_PILES = (-9.6, -6.4, -3.2, 0.0, 3.2, 6.4, 9.6)  # along the wall
PILES_OUT = 2.6
RUSTED = 0.0  # the pile here
STEPS = 2.6
RUBBLE = -3.6
STONES, STONES_BELOW = 48, 34  # the others lie on these
MOORING = (9.5, 1.3)  # x y
# x y of the chain that lies on the floor
SLACK = ((9.1, 1.5), (8.6, 1.6), (8.0, 1.4), (7.6, 1.5), (7.4, 2.0), (7.6, 2.6), (8.1, 3.0), (8.6, 3.5))
CHAIN_LINK = (0.05, 0.16)  # thickness and width, as of a bar of 50 mm
CHAIN_PITCH = 0.3


def at_quay(along: float, out: float, up: float) -> np.ndarray:
    """Return x, y, z in the world."""
    c, s = np.cos(QUAY_YAW), np.sin(QUAY_YAW)
    return np.array([QUAY_AT[0] - out * c - along * s, QUAY_AT[1] - out * s + along * c, BASIN + up])


def polygon(radius: float) -> np.ndarray:
    """Return (20, 2) corners of a regular polygon."""
    angles = np.arange(20) * 2 * np.pi / 20
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def note(world, text: str):
    """Add a comment on what follows."""
    world.append(ET.Comment(f" {text} "))


def add_at_quay(link, name: str, surface: str, position, size):
    """Add a box that stands square to the wall: `size` is out from the wall, along it, and up."""
    place(link, name, surface, "box", at_quay(*position), (0, 0, QUAY_YAW), size=size)


def add_tyre(world, name: str, pose):
    """Add a lorry's tyre, a ring about z, its middle at `pose`."""
    rings = [polygon(0.52), polygon(0.28)]
    place(model(world, name, pose), "tyre", "tyre", "polyline", (0, 0, -0.14), rings=rings, height=0.28)


def add_chain(world, name: str, points):
    """Add oblong links along a line of points, every other one turned by 90 degrees."""
    link, points = model(world, name), np.array(points, float)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    count = int(along[-1] / CHAIN_PITCH)
    ends = np.linspace(0, along[-1], count + 1)
    ends = np.stack([np.interp(ends, along, axis) for axis in points.T], axis=1)
    for k, (start, end) in enumerate(pairwise(ends)):
        across = CHAIN_LINK if k % 2 else CHAIN_LINK[::-1]
        middle, axis = (start + end) / 2, turn(end - start)
        # a link reaches into its neighbours
        place(link, f"link_{k + 1}", "rust", "box", middle, axis, size=(*across, 1.3 * CHAIN_PITCH))


def add_rubble(world):
    """Add stones, tilted prisms of five to seven corners: a heap at the wall's foot that thins out."""
    link, rng = model(world, "rubble"), np.random.default_rng(9)
    for k in range(1, STONES + 1):
        n, radius = int(rng.integers(5, 8)), rng.uniform(0.16, 0.42)
        angles = (np.arange(n) + rng.uniform(-0.3, 0.3, n)) * 2 * np.pi / n
        corners = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        corners *= radius * rng.uniform(0.75, 1.1, n)[:, None]
        height = radius * rng.uniform(0.8, 1.4)
        spread = 1.0 if k <= STONES_BELOW else 0.5
        out = min(0.3 + spread * abs(rng.normal(0, 1.8)), 4)
        along = RUBBLE + spread * rng.normal(0, 1.2)
        rotation = (*rng.uniform(-0.5, 0.5, 2), rng.uniform(0, np.pi))
        below = sg.pose(0, 0, 0, *rotation)[2, :2] @ corners.T  # the base's corners
        rests_at = -0.2 * radius if k <= STONES_BELOW else max(0.35 - 0.15 * out, 0)
        position = at_quay(along, out, rests_at - min(below))
        place(link, f"stone_{k}", "stone", "polyline", position, rotation, rings=[corners], height=height)


def make_harbour(out: Path):
    """Write a berth in a basin with a floor of silt."""
    root, world = new_world("harbour", (0, 0, BASIN + 3.2, 0, 0.22, 0))
    note(world, "sheltered water, with ripples of 2 mm: too rough to be a planar reflector")
    add(world, "sonar_gl:surface", "0", roughness="0.002")
    note(world, "soft mud with few shells and stones, which speckles more than many alike scatterers would")
    floor = model(world, "floor", (0, 0, BASIN, 0, 0, 0))
    place(floor, "floor", "silt", "plane", normal=(0, 0, 1), size=(80, 80))

    note(
        world,
        "the quay: wall, fender of timber, iron steps, and the piles of the berth, one of them corroded",
    )
    add_at_quay(model(world, "quay"), "wall", "concrete", (0, -0.6, 5.25), (1.2, 60, 12.5))
    fender = model(world, "fender")
    for k, along in enumerate((-8.0, -4.8, -1.6, 1.6, 4.8, 8.0), 1):
        add_at_quay(fender, f"post_{k}", "timber", (along, 0.15, 5), (0.3, 0.3, 10))
    for k, up in enumerate((7.2, 9.6), 1):
        add_at_quay(fender, f"waler_{k}", "timber", (0, 0.4, up), (0.2, 20, 0.3))
    steps = model(world, "steps")
    for side, sign in (("left", 1), ("right", -1)):
        add_at_quay(steps, f"rail_{side}", "rust", (STEPS + 0.22 * sign, 0.2, 6), (0.08, 0.03, 8.4))
    for k in range(27):
        add_at_quay(steps, f"bar_{k + 1}", "rust", (STEPS, 0.2, 2 + 0.3 * k), (0.03, 0.44, 0.03))
    for k, along in enumerate(BERTH_PILES, 1):
        link = model(world, f"pile_{k}", (*at_quay(along, PILES_OUT, 4.5), 0, 0, 0))
        place(link, "pile", "rust" if along == RUSTED else "steel", "cylinder", radius=0.3, length=13)

    note(world, "on the floor: stones that fell from the quay's foot, two tyres")
    add_rubble(world)
    add_tyre(world, "tyre_flat", (7.6, -0.45, BASIN + 0.12, 0.06, -0.08, 0))
    add_tyre(world, "tyre_leaning", (*at_quay(3.2, PILES_OUT + 0.6, 0.45), 0, 1.2, QUAY_YAW))

    note(world, "a mooring: block on the floor, chain that hangs from the buoy, and its slack end")
    sinker = model(world, "sinker", (*MOORING, BASIN + 0.3, 0.08, 0.05, 0.6))
    place(sinker, "sinker", "concrete", "box", size=(0.9, 0.9, 0.7))
    buoy = model(world, "buoy", (*MOORING, -0.1, 0, 0, 0))
    place(buoy, "buoy", "steel", "cylinder", radius=0.6, length=1.2)
    add_chain(world, "chain", [(*MOORING, BASIN + 0.6), (*MOORING, -0.6)])
    add_chain(world, "slack_chain", [(*xy, BASIN + 0.06) for xy in SLACK])

    text = (
        "A berth in 9 m of water: a quay wall with a fender and steps, steel piles before it, and rubble,\n"
        "     tyres and a mooring's chain on silt. Range 18 m."
    )
    save(out / "harbour.sdf", root, text)


# --- the ocean floor

GRID, EXTENT = 513, 60.0  # samples a side (2^n + 1, as Gazebo wants), metres a side
PILES = ((-10.5, 3.6), (-5.5, 1.2), (-0.5, -1.2))  # a row of steel piles, x y
PILE_RADIUS = 0.7
SPHERE, SPHERE_RADIUS = (-9.5, -3.4), 1.7
SONAR_XY = (-22.0, 0.0)


def fractal(rng, slope: float, shortest: float) -> np.ndarray:
    """Return (GRID, GRID) noise of unit deviation: amplitude ~ k^-slope, none below `shortest` metres."""
    n = 2 * (GRID - 1)
    step = EXTENT / (GRID - 1)
    k = np.hypot(np.fft.fftfreq(n, step)[:, None], np.fft.rfftfreq(n, step)[None, :])
    k[0, 0] = np.inf
    amplitude = k**-slope * np.exp(-((k * shortest) ** 2))
    amplitude[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((n, n))) * amplitude)[:GRID, :GRID]
    return (field - field.mean()) / field.std()


def dunes(x, y, bend, length: float, heading: float) -> np.ndarray:
    """Return dunes 0..1, steeper to the lee, their crests bent by `bend` (in metres)."""
    phase = 2 * np.pi * (x * np.cos(heading) + y * np.sin(heading) + bend) / length
    return 0.5 + 0.5 * np.sin(phase + 0.45 * np.sin(phase))


def terrain() -> np.ndarray:
    """Return (GRID, GRID) heights in metres; the top row is +y, the left column is -x."""
    rng = np.random.default_rng(2015)
    axis = np.linspace(-EXTENT / 2, EXTENT / 2, GRID)
    x, y = np.meshgrid(axis, -axis)
    z = 0.70 * fractal(rng, 2.0, 3.0) + 0.03 * fractal(rng, 1.5, 0.7)
    bend = fractal(rng, 2.0, 2.5)
    sand = 1 / (1 + np.exp(-3.0 * fractal(rng, 1.6, 4.0)))  # against bare ground
    z += 0.24 * sand * dunes(x, y, 2.6 * bend, 4.2, 0.35)
    z += 0.06 * (1.1 - sand) * dunes(x, y, 1.2 * bend, 1.3, -0.25)

    for px, py in PILES:  # scour: a pit around the foot, deepest at the wall, and a low rim
        r = np.hypot(x - px, y - py) / PILE_RADIUS
        z += 0.12 * np.exp(-((r - 3.4) ** 2)) - 0.55 * np.exp(-((r / 2.2) ** 4))
    r = np.hypot(x - SPHERE[0], y - SPHERE[1]) / SPHERE_RADIUS
    z += 0.15 * np.exp(-4 * (r - 1.5) ** 2) - 0.30 * np.exp(-((r / 1.1) ** 4))

    lumps = 1 + 0.13 * fractal(rng, 1.6, 0.5)
    # boulders, half buried, most of them small; the current dug a hollow on their +x side
    for _ in range(40):
        bx, by = rng.uniform((-17, -23), (16, 23))
        angle, squeeze, lift = rng.uniform((0, 0.6, 0.4), (np.pi, 1.0, 0.8))
        a = min(0.45 * rng.uniform(0.1, 1) ** -0.5, 1.4)
        if min(np.hypot(bx - px, by - py) for px, py in (*PILES, SPHERE)) < 3.5:
            continue
        u = (x - bx) * np.cos(angle) + (y - by) * np.sin(angle)
        v = ((y - by) * np.cos(angle) - (x - bx) * np.sin(angle)) / squeeze
        r = np.hypot(u, v) / a
        ahead = 0.5 + 0.5 * (x - bx) / np.hypot(np.hypot(x - bx, y - by), 0.1)
        z -= 0.10 * a * ahead * np.exp(-(((r - 1.4) / 0.4) ** 2))
        z += lift * a * np.maximum(1 - (r * lumps) ** 2, 0) ** 0.7
    return z


def height_at(z, x: float, y: float) -> float:
    """Return the height of the nearest grid point."""
    step = EXTENT / (GRID - 1)
    return float(z[round((EXTENT / 2 - y) / step), round((x + EXTENT / 2) / step)])


def make_ocean_floor(out: Path):
    """Write terrain, a row of piles and a sphere."""
    z = terrain()
    relief = round(float(np.ptp(z)), 2)
    grey = np.round((z - z.min()) / np.ptp(z) * 65535).astype(np.uint16)
    cv2.imwrite(str(out / "ocean_floor.png"), grey, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    base = -12.0
    z = base + grey / 65535 * relief

    level = round(height_at(z, *SONAR_XY) + 3.8, 2)
    root, world = new_world("ocean_floor", (*SONAR_XY, level, 0, 0.25, 0))
    floor = {"uri": "ocean_floor.png", "size": (EXTENT, EXTENT, relief), "pos": (0, 0, base)}
    place(model(world, "floor"), "floor", "sand", "heightmap", **floor)
    for i, (x, y) in enumerate(PILES, 1):
        bottom, top = round(height_at(z, x, y) - 2.0, 2), 1.0
        link = model(world, f"pile_{i}", (x, y, (bottom + top) / 2, 0, 0, 0))
        place(link, "pile", "steel", "cylinder", radius=PILE_RADIUS, length=top - bottom)
    sunk = round(height_at(z, *SPHERE) + 0.75 * SPHERE_RADIUS, 2)
    place(model(world, "sphere", (*SPHERE, sunk, 0, 0, 0)), "sphere", "steel", "sphere", radius=SPHERE_RADIUS)
    text = "Sand and boulders, 60 x 60 m in 524 288 triangles; three piles and a sunken sphere. Range 30 m."
    save(out / "ocean_floor.sdf", root, text)


def main():
    """Write all scenes."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.docs.make_scenes", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=SCENES, help="folder to write to (default: scenes/)")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    make_divers(out)
    make_harbour(out)
    make_ocean_floor(out)


if __name__ == "__main__":
    main()
