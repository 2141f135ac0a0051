"""URDF, the robot format of ROS: converted to SDF, as Gazebo does it, so that one reader serves both."""

from __future__ import annotations

from sonar_gl.core.errors import Error
from sonar_gl.scene.sdf.extensions import list_extensions
from sonar_gl.scene.sdf.frames import OF_ORIGIN, read_numbers

XACRO = "{http://www.ros.org/wiki/xacro}", "{http://ros.org/wiki/xacro}"  # namespace of macros
SIZES = {  # geometry: attributes that it must have; each is an element of this name in SDF
    "box": ("size",),
    "capsule": ("radius", "length"),
    "cylinder": ("radius", "length"),
    "ellipsoid": ("radii",),
    "sphere": ("radius",),
}
ORIGIN = {"xyz": 3, "rpy": 3, "quat_xyzw": 4}  # attribute of an origin: how many numbers it holds
RETRO = "laserRetro", "laser_retro"


def model_of(robot, location: str):
    """Return the SDF `<model>` element of a `<robot>`, its joints at zero.

    Raises Error if there are no links, a link has two parents or is unknown, a geometry lacks a size, or an origin has
    two rotations or other text than numbers.

    Each link stays a link of its own, also at fixed joints. Of `<gazebo reference="link">` the sensors and
    bubbles go to the link; laserRetro (or laser_retro) and the other elements of namespace sonar_gl to its
    shapes.
    """
    for element in robot.iter():
        if isinstance(element.tag, str) and element.tag.startswith(XACRO):
            name = element.tag.partition("}")[2]
            raise Error(
                f"{location}: holds xacro macros (<xacro:{name}>), which are expanded only in a .xacro file that "
                "is itself the scene"
            )
    links = {(link.get("name") or "").strip(): link for link in robot.findall("link")}
    if not links:
        raise Error(
            f"{location}: <robot> must hold a <link> (got none; a file of macros has none: give the file "
            "that includes it)"
        )
    joints = _joints_by_child(robot, links, location)
    model = robot.makeelement("model", {"name": (robot.get("name") or "").strip()})
    for link in robot.findall("link"):
        name = (link.get("name") or "").strip()
        converted = _add(model, "link", name=name)
        if (joint := joints.get(name)) is not None:
            parent = joint.find("parent")
            parent = "" if parent is None else (parent.get("link") or "").strip()
            where = f"{location}: joint[{joint.get('name') or ''}]"
            if parent not in links:
                raise Error(f"{where}: unknown link (got {parent!r})")
            _add_pose(converted, joint, where, relative_to=parent)
        if link.find("inertial") is not None:
            _add(converted, "inertial")
        for kind in ("collision", "visual"):
            for number, shape in enumerate(link.findall(kind)):
                where = f"{location}: link[{name}]/{kind}[{shape.get('name') or number}]"
                _add_shape(converted, shape, where)
        for block in robot.findall("gazebo"):
            if (block.get("reference") or "").strip() == name:
                _add_properties(converted, block)
    return model


def _joints_by_child(robot, links: dict, location: str) -> dict:
    """Return name of a link -> the `<joint>` that holds it."""
    joints = {}
    for joint in robot.findall("joint"):
        where, child = f"{location}: joint[{joint.get('name') or ''}]", joint.find("child")
        name = "" if child is None else (child.get("link") or "").strip()
        if name not in links:
            raise Error(f"{where}: unknown link (got {name!r})")
        if name in joints:
            raise Error(
                f"{where}: a link must have one parent (got link {name!r} as the child of two joints)"
            )
        joints[name] = joint
    return joints


def _add(parent, tag: str, text: str | None = None, **attributes: str):
    """Add a child to an element, and return it."""
    child = parent.makeelement(tag, attributes)
    child.text = text
    parent.append(child)
    return child


def _add_pose(converted, element, location: str, **attributes: str) -> None:
    """Add the `<pose>` of an element that may have an `<origin>`, with a quaternion as in URDF 1.2 or without."""
    origin = {} if (found := element.find("origin")) is None else found.attrib
    for key, count in ORIGIN.items():
        if origin.get(key):  # here, since the pose is an element that the file does not hold
            numbers = found.makeelement(key, {})
            numbers.text = origin[key]
            read_numbers(numbers, f"{location}/origin/{key}", count)
    xyz, rotation = origin.get("xyz") or "0 0 0", origin.get("rpy") or "0 0 0"
    if origin.get("quat_xyzw"):
        if origin.get("rpy"):
            raise Error(f"{location}/origin: must have rpy or quat_xyzw (got both)")
        rotation, attributes["rotation_format"] = origin["quat_xyzw"], "quat_xyzw"
    _add(converted, "pose", f"{xyz} {rotation}", **attributes, **{OF_ORIGIN: f"{location}/origin"})


def _add_shape(link, shape, location: str) -> None:
    """Add a collision or visual of URDF to a link of SDF."""
    converted = _add(link, shape.tag, name=location.rpartition("[")[2][:-1])
    _add_pose(converted, shape, location)
    geometry = _add(converted, "geometry")
    for form in [] if shape.find("geometry") is None else shape.find("geometry"):
        if not isinstance(form.tag, str):  # a comment
            continue
        kind = _add(geometry, form.tag)
        for key in SIZES.get(form.tag, ()):
            if form.get(key) is None:
                raise Error(f"{location}/geometry/{form.tag}: must have the attribute {key!r}")
            _add(kind, key, form.get(key))
        if form.tag == "mesh":
            _add(kind, "uri", form.get("filename") or "")
            if form.get("scale"):
                _add(kind, "scale", form.get("scale"))


def _add_properties(link, block) -> None:
    """Add what a `<gazebo reference="link">` says of a link and its surfaces."""
    link.extend(block.findall("sensor"))
    surface = [("laser_retro", child) for child in block if child.tag in RETRO]
    surface += [(child.tag, child) for child in list_extensions(block)]
    for tag, child in surface:
        if tag.endswith("}bubbles"):
            link.append(child)
            continue
        for shape in link.findall("collision") + link.findall("visual"):
            _add(shape, tag, child.text)
