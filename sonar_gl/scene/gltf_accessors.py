"""What a glTF file states of its geometry, checked before trimesh makes arrays of it: its sizes, and what trimesh would
read wrongly without a word."""

from __future__ import annotations

import json
import struct
from importlib.util import find_spec
from pathlib import Path

from sonar_gl.core.checks import is_whole_number, shown
from sonar_gl.core.errors import Error, some_names
from sonar_gl.core.warn import warn_caller

MAX_ZEROS = 5_000_000  # elements that no buffer holds: trimesh takes a second for a million
COMPRESSIONS = "EXT_meshopt_compression", "KHR_meshopt_compression"  # of a bufferView
DRACO = "KHR_draco_mesh_compression"
TRIANGLE_FAN = 6  # a mode of primitives


def check_geometry(path: Path) -> None:
    """Refuse a glTF file of which trimesh would make too large arrays, or wrong vertices; warn of what it leaves out.

    A file whose header is broken in another way passes: trimesh says what is wrong with it.

    Raises Error if accessors that name no buffer have more than MAX_ZEROS elements together: they are zeros, of which a
    few bytes could state any number. Also if positions of a mesh are compressed, sparse, or normalized integers.
    """
    header = _read_header(path)
    counts = [one.get("count") for one in _dicts(header, "accessors") if "bufferView" not in one]
    n_zeros = sum(count for count in counts if is_whole_number(count) and count > 0)
    if n_zeros > MAX_ZEROS:
        raise Error(
            f"{path}: accessors without a bufferView must have at most {MAX_ZEROS} elements together (got "
            f"{shown(n_zeros)}; they are zeros)"
        )
    fans = []
    for number, mesh in enumerate(_dicts(header, "meshes")):
        name = str(mesh.get("name") or number)
        for primitive in _dicts(mesh, "primitives"):
            form = _form_of_positions(primitive, header)
            if form is not None:
                raise Error(
                    f"{path}: the positions of mesh {name!r} must be plain numbers (got {form}; "
                    "import the file into Blender, and export it without compression)"
                )
            if primitive.get("mode") == TRIANGLE_FAN:
                fans.append(name)
    nodes = [(str(node.get("name") or number), node) for number, node in enumerate(_dicts(header, "nodes"))]
    left_out = {
        "the pose of bones": [name for name, node in nodes if "skin" in node],
        "morph targets": [name for name, node in nodes if _is_morphed(node, header)],
        "copies by EXT_mesh_gpu_instancing": [
            name for name, node in nodes if "EXT_mesh_gpu_instancing" in _extensions(node)
        ],
        "triangle fans": fans,
    }
    said = [f"{what} ({some_names(names)})" for what, names in left_out.items() if names]
    if said:
        warn_caller(f"{path}: read without {', and without '.join(said)}")


def _form_of_positions(primitive: dict, header: dict) -> str | None:
    """Return in words what the positions of a primitive are if they are no plain numbers; else None."""
    attributes = primitive.get("attributes")
    accessor = _entry(
        header, "accessors", attributes.get("POSITION") if isinstance(attributes, dict) else None
    )
    if accessor is None:
        return None
    if "sparse" in accessor:
        return "a sparse accessor"
    if "bufferView" not in accessor:
        if DRACO in _extensions(primitive):
            return (
                None if find_spec("DracoPy") else "compression by Draco, which the package DracoPy would read"
            )
        return "none" if accessor.get("count") else None
    view = _entry(header, "bufferViews", accessor["bufferView"]) or {}
    if any(name in _extensions(view) for name in COMPRESSIONS):
        return "compression by meshopt"
    return "normalized integers" if accessor.get("normalized") is True else None


def _is_morphed(node: dict, header: dict) -> bool:
    """Return whether a node shows its mesh deformed by morph targets."""
    mesh = _entry(header, "meshes", node.get("mesh")) or {}
    weights = node.get("weights", mesh.get("weights"))
    return isinstance(weights, list) and any(weights)


def _extensions(element: dict) -> dict:
    found = element.get("extensions")
    return found if isinstance(found, dict) else {}


def _read_header(path: Path) -> dict:
    """Return the JSON of a .gltf or .glb file; {} if there is none."""
    with open(path, "rb") as file:
        start = file.read(20)
        if start[:4] == b"glTF":
            n_bytes = struct.unpack("<I", start[12:16])[0] if len(start) == 20 else 0
            text = file.read(n_bytes)
        else:
            text = start + file.read()
    try:
        header = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return header if isinstance(header, dict) else {}


def _dicts(header: dict, key: str) -> list[dict]:
    """Return the objects in a list of the header; {} stands for what is none."""
    found = header.get(key)
    return [one if isinstance(one, dict) else {} for one in found] if isinstance(found, list) else []


def _entry(header: dict, key: str, number) -> dict | None:
    """Return the object of a number in a list of the header; None if there is none of this number."""
    found = _dicts(header, key)
    return found[number] if is_whole_number(number) and 0 <= number < len(found) else None
