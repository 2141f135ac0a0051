"""Extensions of SDF: the elements of namespace `sonar_gl`.

A link may hold `<sonar_gl:bubbles>`, a world `<sonar_gl:surface>`, and a shape those that `shapes` reads.
"""

from __future__ import annotations

import re

from sonar_gl.core.errors import Error, errors_at, nearest_names
from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.sdf.frames import read_numbers

NAMESPACE = "urn:sonar_gl"  # of the prefix, whatever namespace a file declares for it
FIELDS = {  # child of <sonar_gl:bubbles>: field of Bubbles, in the same unit
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


def declare_namespace(xml: bytes) -> bytes:
    """Return a file in which the prefix sonar_gl is declared; Gazebo requires no declaration.

    >>> declare_namespace(b"<sdf><sonar_gl:material/></sdf>")
    b'<sdf xmlns:sonar_gl="urn:sonar_gl"><sonar_gl:material/></sdf>'
    """
    if b"sonar_gl:" not in xml:
        return xml
    declaration = f'xmlns:sonar_gl="{NAMESPACE}"'.encode()
    xml, found = re.subn(rb"xmlns:sonar_gl\s*=\s*(\"[^\"]*\"|'[^']*')", declaration, xml)
    return xml if found else re.sub(rb"<(sdf|robot|gazebo)(?=[\s>])", rb"<\1 " + declaration, xml, count=1)


def find_extension(element, name: str):
    """Return the child `<sonar_gl:name>` of an element, or None."""
    return element.find(f"{{{NAMESPACE}}}{name}")


def list_extensions(element) -> list:
    """Return the children of an element that are in the namespace."""
    return [
        child for child in element if isinstance(child.tag, str) and child.tag.startswith(f"{{{NAMESPACE}}}")
    ]


def check_extensions(element, known: tuple, location: str) -> list:
    """Return the children of an element that are in the namespace, all of them of known names.

    Raises Error if the name of one is not in `known`.
    """
    found = list_extensions(element)
    for child in found:
        name = child.tag.partition("}")[2]
        if name not in known:
            hint = nearest_names(name, known)
            raise Error(f"{location}: unknown tag (got 'sonar_gl:{name}'; {hint})")
    return found


def read_bubbles(element, name: str, pose, location: str) -> Bubbles:
    """Return the plume that a `<sonar_gl:bubbles>` element describes.

    Raises Error if a child is unknown or occurs twice, or its number is invalid.

    element : its children are those of FIELDS, each with one number, all optional
    """
    settings = {}
    for child in element:
        if not isinstance(child.tag, str) or child.tag == "pose":
            continue  # a comment; or the pose, which the caller has read
        if child.tag not in FIELDS:
            raise Error(f"{location}: unknown tag (got {child.tag!r}; {nearest_names(child.tag, FIELDS)})")
        key = FIELDS[child.tag]
        if key in settings:
            raise Error(f"{location}: <{child.tag}> must be given once (got it twice)")
        value = float(read_numbers(child, f"{location}/{child.tag}", 1)[0])
        settings[key] = int(value) if key == "seed" and value == int(value) else value
    with errors_at(location):
        return Bubbles(name, pose, **settings)


def read_surface(element, location: str) -> dict:
    """Return the parameters of `Scene` that a `<sonar_gl:surface>` element sets.

    Its text is the height, metres; its attribute `roughness`, optional, is the rms height of waves, metres.

    Raises Error if one of the two is not a number.
    """
    settings = {"surface_z_m": float(read_numbers(element, location, 1)[0])}
    if (text := element.get("roughness")) is not None:
        try:
            settings["surface_roughness_m"] = float(text)
        except ValueError:
            raise Error(f"{location}: roughness must be a number, metres (got {text!r})") from None
    return settings
