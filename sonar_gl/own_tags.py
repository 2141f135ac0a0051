"""Our own tags of a scene file that are no part of a shape: plumes of bubbles, and the water's surface."""

from __future__ import annotations

from sonar_gl.bubbles import Bubbles
from sonar_gl.frames import numbers
from sonar_gl.resources import NAMESPACE, tags
from sonar_gl.types import Error, nearest_names

FIELDS = {  # child of <sonar_gl:bubbles>: field of Bubbles; units as there
    "rate": "rate_hz",
    "radius": "radius_m",
    "spread": "radius_spread",
    "rise": "rise_m_s",
    "half_angle_deg": "half_angle_deg",
    "mouth": "mouth_m",
    "height": "height_m",
    "breath": "breath_s",
    "exhaling": "exhaling",
    "seed": "seed",
}


def own_children(element, known: tuple, where: str) -> list:
    """Children of our own of a world or a link, all of one name that is known there.

    Raises
    ------
    Error
        if there is another.
    """
    for name in tags(element):
        if name not in known:
            raise Error(f"{where}: unknown tag (got 'sonar_gl:{name}'; {nearest_names(name, known)})")
    return [
        child for child in element if isinstance(child.tag, str) and child.tag.startswith("{" + NAMESPACE)
    ]


def read_bubbles(element, name: str, pose, where: str) -> Bubbles:
    """The plume that `<sonar_gl:bubbles>` in a link stands for.

    Parameters
    ----------
    element : its children are those of FIELDS, each one number, each may be absent
    name, pose : of `Bubbles`; where : what errors begin with

    Raises
    ------
    Error
        if a child is unknown, comes twice, or holds no number that makes sense.
    """
    settings = {}
    for child in element:
        if not isinstance(child.tag, str) or child.tag == "pose":
            continue  # comments; the pose is the caller's
        if child.tag not in FIELDS:
            raise Error(f"{where}: unknown tag (got {child.tag!r}; {nearest_names(child.tag, FIELDS)})")
        field = FIELDS[child.tag]
        if field in settings:
            raise Error(f"{where}: <{child.tag}> must stand there once (got it twice)")
        value = float(numbers(child, f"{where}/{child.tag}", 1)[0])
        settings[field] = int(value) if field == "seed" and value == int(value) else value
    try:
        return Bubbles(name, pose, **settings)
    except Error as why:
        raise Error(f"{where}: {why}") from None


def read_surface(element, where: str) -> dict:
    """What `Scene` takes of `<sonar_gl:surface>`: its height in metres, and perhaps its attribute roughness.

    Raises
    ------
    Error
        if one of the two is no number.
    """
    settings = {"surface_z_m": float(numbers(element, where, 1)[0])}
    if (text := element.get("roughness")) is not None:
        try:
            settings["surface_roughness_m"] = float(text)
        except ValueError:
            raise Error(f"{where}: roughness must be a number, metres (got {text!r})") from None
    return settings
