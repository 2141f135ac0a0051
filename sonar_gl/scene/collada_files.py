"""COLLADA files, made ready for trimesh: only what is geometry, and all of it.

trimesh drops a geometry whose material cannot be read, such as one whose picture is missing, and the skinned meshes of
animated bodies; both without a word.
"""

from __future__ import annotations

import io
from pathlib import Path
from xml.parsers import expat

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error
from sonar_gl.scene.scene import MAX_BODIES

# A material has no acoustic meaning, and one that is broken must not take its geometry along. What is never a surface
# goes, too, so that an error in what remains is one of geometry.
LEFT_OUT = {
    *("library_animations", "library_animation_clips", "library_cameras", "library_controllers"),
    *("library_effects", "library_images", "library_lights", "library_materials"),
    *("bind_material", "instance_camera", "instance_light", "extra"),
}


def read_collada(path: Path) -> tuple[io.BytesIO, int]:
    """Return a COLLADA file without what is no geometry, and how many skinned meshes it places.

    A skinned mesh becomes a plain one, in the shape that its bones are bound to, at the node that holds it.

    Raises Error if it places more than MAX_BODIES geometries, has no scene, a <lookat> or <skew> places geometry, or a
    polygon has holes; ValueError if it declares a document type, or is no XML.
    """
    from lxml import etree

    data = path.read_bytes()
    _refuse_dtd(data)
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True, remove_comments=True)
    root = etree.fromstring(data, parser)
    if root.tag.endswith("COLLADA") and root.find("{*}scene/{*}instance_visual_scene") is None:
        raise Error(
            f"{path}: a COLLADA file must place its geometries by a <scene> with an <instance_visual_scene> (got none; "
            "export a scene, not a library of shapes)"
        )
    n_skinned = 0
    sources = {}  # id of a controller -> id of what it deforms, and the matrix that it has bound it with
    for skin in root.iterfind(".//{*}controller/{*}*[@source]"):
        matrix = skin.findtext("{*}bind_shape_matrix")
        sources["#" + skin.getparent().get("id", "")] = skin.get("source"), matrix
    for element in list(root.iter("{*}*")):
        kind = etree.QName(element).localname
        if kind in LEFT_OUT:
            element.getparent().remove(element)
        elif kind == "instance_controller":
            n_skinned += _replace_by_geometry(element, sources)
    _check_transforms(root, path)
    if (holed := root.find(".//{*}geometry/{*}mesh/{*}polygons/{*}ph")) is not None:
        name = next(holed.iterancestors("{*}geometry")).get("id") or ""
        raise Error(  # since the parser leaves such a polygon out
            f"{path}: geometry {name!r}: polygons must have no holes (got <ph>; triangulate the mesh in the program "
            "that wrote it)"
        )
    if (n_placed := _placed_geometries(root)) > MAX_BODIES:
        raise Error(
            f"{path}: a COLLADA file must place at most {MAX_BODIES} geometries (got {shown(n_placed)}; nodes that "
            "hold others several times multiply them)"
        )
    return io.BytesIO(etree.tostring(root)), n_skinned


def _check_transforms(root, path: Path) -> None:
    """Raise an Error where <lookat> or <skew> places geometry, which the parser misreads; leave out others."""
    for element in [*root.iterfind(".//{*}node/{*}lookat"), *root.iterfind(".//{*}node/{*}skew")]:
        node, kind = element.getparent(), element.tag.rpartition("}")[2]
        if next(node.iter("{*}instance_geometry", "{*}instance_node"), None) is not None:
            name = node.get("name") or node.get("id") or ""
            raise Error(
                f"{path}: node {name!r}: <{kind}> is not supported where it places geometry (write a <matrix> in its "
                "place, as by exporting the scene with transforms as matrices)"
            )
        node.remove(element)


def _placed_geometries(root) -> int:
    """Return how many geometries the visual scenes of a file place: nodes may name others that name others."""
    named = {"#" + node.get("id"): node for node in root.iterfind(".//{*}node[@id]")}
    of_named = dict.fromkeys(named)  # the number of each named node, once it is counted

    def count(element) -> int:
        found = 0
        for child in element.iterchildren("{*}node", "{*}instance_node", "{*}instance_geometry"):
            url = child.get("url", "")
            if child.tag.endswith("}node"):
                found += count(child)
            elif child.tag.endswith("}instance_geometry"):
                found += 1
            elif url in named:
                if of_named[url] is None:
                    of_named[url] = 0  # for those that name themselves, which the parser refuses
                    of_named[url] = count(named[url])
                found += of_named[url]
        return found

    return sum(count(scene) for scene in root.iterfind(".//{*}visual_scene"))


def _replace_by_geometry(element, sources: dict) -> bool:
    """Put the geometry that a controller deforms in place of its instance; return whether there is one."""
    source, matrices = element.get("url", ""), []
    while source in sources and len(matrices) < len(sources):
        source, matrix = sources[source]
        matrices.append(matrix)
    if not matrices:
        return False
    prefix = element.tag.removesuffix("instance_controller")
    parent = element.getparent()
    node = parent.makeelement(f"{prefix}node", {})
    for matrix in filter(None, matrices):
        node.append(node.makeelement(f"{prefix}matrix", {}))
        node[-1].text = matrix
    node.append(node.makeelement(f"{prefix}instance_geometry", {"url": source}))
    parent.replace(element, node)
    return True


def _refuse_dtd(data: bytes) -> None:
    """Raise a ValueError if a file declares a document type, through which entities could attack."""

    def refuse(*_):
        raise ValueError("a document type declaration is refused")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(data, True)
