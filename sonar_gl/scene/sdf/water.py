"""Shapes of a world that are no solids: the water itself, and marks such as coordinate axes.

Gazebo's worlds show the sea as shapes, which an optical camera sees. A sonar would find walls in the water. A
shape is taken for water by its material or its name; for a mark by its name, or since it is fully transparent, if
nothing can collide with it.
"""

from __future__ import annotations

import re

import numpy as np

from sonar_gl.scene.sdf.links import Link

# names of materials: UUVSimulator/StaticDeepWater, UUVSimulator/SeaWall, UUVSimulator/SimpleWaves
WATER_MATERIAL = re.compile(
    r"water(?!.*(tower|proof))|sea_?wall|waves?$|ocean_?(surface|water)", re.IGNORECASE
)
SURFACE_NAME = re.compile(r"(sea|ocean|lake|river|water)[ _-]?(surface|level|plane)", re.IGNORECASE)
WATER_NAME = re.compile(
    r"(sea|ocean|lake|river|water)([ _-]?(surface|level|plane|below|link|body|volume))?"
    r"|((coast|ocean|sea|regular|open)[ _-])?waves?([ _-](visual|link|surface))?",
    re.IGNORECASE,
)
GROUND_NAME = re.compile(r"floor|bottom|bed|ground|terrain|sand|rock", re.IGNORECASE)
MARK_NAME = re.compile(
    r"((world|map|odom|reference|coordinate)s?[ _-]?)?(ned|enu|axes|axis|origin|frame)([ _-]?(frame|axes))?",
    re.IGNORECASE,
)
IS_SHEET = 0.01  # of the width: what is thinner is a surface or a wall, not a volume


def is_water(link: Link, element) -> bool:
    """Return whether a collision or visual of a link is water."""
    material = (element.findtext("material/script/name") or "").strip().rpartition("/")[2]
    if element.tag == "visual" and WATER_MATERIAL.search(material):
        return True
    name = (element.get("name") or "").strip()
    if WATER_NAME.fullmatch(name):
        return True
    if GROUND_NAME.search(name):
        return False
    owners = link.name, link.model.rpartition("::")[2]
    pattern = SURFACE_NAME if link.element.find("collision") is not None else WATER_NAME
    return any(pattern.fullmatch(owner.strip()) for owner in owners)


def is_mark(link: Link) -> bool:
    """Return whether a link shows coordinate axes, or the like."""
    if link.element.find("collision") is not None or link.element.find("inertial") is not None:
        return False
    return any(MARK_NAME.fullmatch(name.strip()) for name in (link.name, link.model.rpartition("::")[2]))


def is_invisible(link: Link, element) -> bool:
    """Return whether a visual is fully transparent, and nothing can collide with its link."""
    if element.tag != "visual" or link.element.find("collision") is not None:
        return False
    try:
        return float(element.findtext("transparency") or 0.0) >= 1.0
    except ValueError:  # it does not count otherwise
        return False


def surface_z_m(vertices) -> float | None:
    """Return the height of the surface of a shape of water, (V, 3) vertices in the world; None of a wall, metres."""
    low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
    size = high - low
    if min(size[:2]) < IS_SHEET * max(size):
        return None
    return float((low[2] + high[2]) / 2 if size[2] < IS_SHEET * min(size[:2]) else high[2])
