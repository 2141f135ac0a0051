"""Shapes from mesh files and height maps."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.input_files import check_is_file
from sonar_gl.core.warn import warn_caller
from sonar_gl.scene.collada_files import read_collada
from sonar_gl.scene.gltf_accessors import check_geometry
from sonar_gl.scene.image_files import read_image_file
from sonar_gl.scene.mesh_buffers import MeshBuffers, NoFiles
from sonar_gl.scene.obj_text import tidy_obj
from sonar_gl.scene.ply_faces import has_doubles, tidy_ply
from sonar_gl.scene.primitives import Shape, concatenate, make_shape, terrain, transform

# What positions may be rounded by before there is a warning, metres: about the finest bins of an imaging sonar
MAX_STEP_M = 0.01
ELEVATION_SUFFIXES = (".tif", ".tiff")  # of height maps whose values are metres
NO_HEIGHT_M = -9999.0  # stands for a gap in such a file, and so does less, as for Gazebo
SUFFIXES = (".glb", ".gltf", ".obj", ".stl", ".ply", ".dae")
TIDY = {".obj": tidy_obj, ".ply": tidy_ply}  # functions of a file's bytes, which make them ready for trimesh
# of text that is read in double precision: that single precision holds it, too, as whole metres, says nothing
DECIMAL_SUFFIXES = (".obj",)
STL_HEAD, STL_TRIANGLE = 84, 50  # bytes of a binary STL: the head ends with the number of triangles
Y_UP_SUFFIXES = (".glb", ".gltf")
BUFFER_SUFFIXES = (
    ".glb",
    ".gltf",
)  # of files that are checked by `check_geometry`, and may name files of buffers
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


class MeshPart(NamedTuple):
    """A placed geometry of a mesh file: the names of its node and geometry, its shape, and where that is, metres.

    Nodes of several parts, in glTF, have one name. Nodes of one geometry share its shape.

    shape : in the axes of the geometry
    matrix : (4, 4) affine, to the axes of the file
    """

    node: str
    geometry: str
    shape: Shape
    matrix: np.ndarray


def heightmap(path, size=(1.0, 1.0, 1.0), pos=(0.0, 0.0, 0.0)) -> Shape:
    """Return terrain from a grey image: one vertex per pixel, flat triangles between them.

    Raises Error if the file is missing, no image, smaller than 2 x 2, larger than 20 million pixels, or not finite.

    Convention: the top row of the image is +y, its left column −x; the outer pixels lie on the edges of
    `size`. Both kinds of image are read as by Gazebo, for which a TIFF is an elevation model.

    path : 8 or 16 bit PNG, whose values are divided by the largest, or TIFF, whose values are heights, metres
    size : x, y extent of the terrain, metres; z is the factor of a PNG's values, and of a TIFF the height from
        its lowest to its highest value, or 1 for heights as they are
    pos : centre of the terrain, metres; its z is added to all heights
    """
    image = read_image_file(path, "a height map", "8 or 16 bit PNG, float TIFF")
    is_elevation = image.dtype.kind != "u" or Path(path).suffix.lower() in ELEVATION_SUFFIXES
    if image.ndim == 3:
        image = image[:, :, :3].mean(axis=2)
    rows, columns = image.shape
    if min(rows, columns) < 2:
        raise Error(f"{path}: a height map must have 2 x 2 pixels or more (got {columns} x {rows})")
    if not np.isfinite(image).all():
        raise Error(f"{path}: heights must be finite (got NaN or infinity; fill the gaps first)")
    heights = _elevations(path, image, size[2]) if is_elevation else image / (image.max() or 1) * size[2]
    return terrain(heights, size, pos)


def _elevations(path, values: np.ndarray, size_z_m: float) -> np.ndarray:
    """Return the heights of an elevation model, (R, C) metres, of a `<size>` whose z is size_z_m; warn of gaps."""
    values = values.astype(np.float64)
    gaps = values <= NO_HEIGHT_M
    if gaps.all():
        raise Error(f"{path}: heights must be more than {NO_HEIGHT_M:g} m (got none; fill the gaps first)")
    low_m, high_m = values[~gaps].min(), values.max()
    if gaps.any():
        warn_caller(
            f"{path}: heights of {NO_HEIGHT_M:g} m or less ({gaps.sum()} of {gaps.size}) stand for gaps, and are taken "
            f"as the lowest other one, {low_m:g} m"
        )
        values[gaps] = low_m
    if size_z_m == 1 or low_m == high_m:
        return values
    return low_m + (values - low_m) * (size_z_m / (high_m - low_m))


def read_mesh_parts(path, roots: Collection[Path] = ()) -> list[MeshPart]:
    """Read every placed geometry of a mesh file, in metres.

    Only normals that the file itself holds are used. COLLADA's `<unit meter>` is applied and its `<up_axis>`
    is not, as in Gazebo. Degenerate, duplicate, inverted and open triangles stay as they are.

    Raises Error with the name of the file, if it is missing or unreadable, has no faces (a point cloud), a vertex is
    not finite, or it names a file that may not be read.

    roots : folders in which files may lie that the mesh names, such as a glTF's buffers; by default the mesh's own
    """
    path = Path(path)
    check_is_file(path)
    try:
        return _read_parts(_load_file(path, roots), path)
    except Error:
        raise
    # trimesh and its parsers raise anything, also when what they have read is looked at
    except Exception as why:
        text = ": ".join(filter(None, (type(why).__name__, _first_line(why))))  # some have no text
        raise Error(f"{path}: trimesh cannot read this mesh ({text})") from None


def _load_file(path: Path, roots: Collection[Path]):
    """Return the trimesh.Scene of a file, after it is checked or made ready for trimesh."""
    suffix = path.suffix.lower()
    if suffix == ".dae":
        return _load_collada(path)
    if suffix in BUFFER_SUFFIXES:
        check_geometry(path)
        return _load(path, resolver=MeshBuffers(path, roots or [path.parent]))
    if suffix in TIDY:
        with errors_at(str(path)):
            data = TIDY[suffix](path.read_bytes())
    elif suffix == ".stl" and (end := _end_of_binary_stl(path)):
        data = path.read_bytes()[:end]
    else:
        return _load(path, resolver=NoFiles(path))
    return _load(io.BytesIO(data), file_type=suffix[1:], resolver=NoFiles(path))


def _load(source, **options):
    """Return the trimesh.Scene of a file, without materials."""
    import trimesh

    log = logging.getLogger("trimesh")
    before = log.level
    log.setLevel(logging.CRITICAL)  # it logs tracebacks about textures, which have no acoustic meaning
    try:
        return trimesh.load(
            source, force="scene", process=False, skip_materials=True, split_objects=True, **options
        )
    finally:
        log.setLevel(before)


def _end_of_binary_stl(path: Path) -> int | None:
    """Return where the triangles of a binary STL end, and warn, if bytes follow, for which trimesh refuses it.

    In an STL of text, characters in the place of the number would state more triangles than any file has.
    """
    with open(path, "rb") as file:
        head = file.read(STL_HEAD)
    count, size = int.from_bytes(head[-4:], "little"), path.stat().st_size
    end = STL_HEAD + STL_TRIANGLE * count
    if count == 0 or size <= end:
        return None
    warn_caller(f"{path}: {size - end} bytes after the {count} triangles that the file states are left out")
    return end


def _load_collada(path: Path):
    """Return the trimesh.Scene of a COLLADA file; warn of what is broken in it, and of bones."""
    from collada.common import DaeError

    file, n_skinned = read_collada(path)
    options = {"file_type": "dae", "resolver": NoFiles(path)}
    try:
        scene = _load(file, ignore_broken=False, **options)
    except DaeError as why:
        file.seek(0)
        scene = _load(file, **options)
        warn_caller(f"{path}: read without what is broken in it ({_first_line(why.msg)})")
    if n_skinned:
        warn_caller(
            f"{path}: {n_skinned} skinned mesh{'es are' if n_skinned > 1 else ' is'} read without the pose of the bones"
        )
    return scene


def _first_line(why: Exception | str) -> str:
    return str(why).strip().partition("\n")[0][:200]


def _read_parts(scene, path: Path) -> list[MeshPart]:
    """Return the placed geometries of a trimesh.Scene that was read from a file; warn of positions that are rounded."""
    parts, shapes, step_m = [], {}, 0.0
    for node in scene.graph.nodes_geometry:
        matrix, key = scene.graph[node]
        mesh = scene.geometry[key]
        if len(getattr(mesh, "faces", ())) == 0:  # points and lines
            continue
        if not np.isfinite(matrix).all():
            raise Error(
                f"{path}: nodes must have finite transforms (got NaN or infinity in node {str(node)!r}; correct its "
                "translation, rotation and scale, or those of its parents)"
            )
        if key not in shapes:
            shapes[key] = _shape_of(mesh, key, path)
        units = str(mesh.metadata.get("units", "")).split(" * ")
        scale = np.diag([float(units[0])] * 3 + [1.0]) if len(units) == 2 else np.eye(4)
        shape, step = shapes[key]
        step_m = max(step_m, step * float(np.abs((scale @ matrix)[:3, :3]).max()))
        parts.append(MeshPart(_name_in_file(scene, node, mesh), key, shape, scale @ matrix))
    if not parts:
        raise Error(
            f"{path}: a mesh must have at least one face (got none: the file is cut short, or a point cloud)"
        )
    if step_m > MAX_STEP_M:
        warn_caller(
            f"{path}: positions of vertices are rounded to steps of {step_m:.2g} m, since they are far from the file's "
            "origin and in single precision (move the mesh to the origin before it is written, and place it by a pose; "
            "or write an OBJ or a PLY of doubles)"
        )
    return parts


def _shape_of(mesh, key: str, path: Path) -> tuple[Shape, float]:
    """Return the shape of a geometry of a file, and the step to which its positions are rounded; 0 for none."""
    # `vertex_normals` computes missing normals; before it is read, only those of the file are in the cache
    normals = mesh.vertex_normals if "vertex_normals" in mesh._cache else None
    if mesh.vertices.ndim != 2 or mesh.vertices.shape[1] != 3:
        raise Error(f"{path}: vertices must have x, y and z (got {mesh.vertices.shape} in geometry {key!r})")
    if not np.isfinite(mesh.vertices).all():
        n_bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise Error(
            f"{path}: vertices must be finite (got NaN or infinity in {n_bad} of {len(mesh.vertices)} of geometry "
            f"{key!r}; fill the gaps, or leave out these vertices and their faces)"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise Error(f"{path}: faces must name vertices that exist (not so in geometry {key!r})")
    shape = make_shape(mesh.vertices, mesh.faces, normals)
    suffix = path.suffix.lower()
    is_double = suffix in DECIMAL_SUFFIXES or (suffix == ".ply" and has_doubles(path))
    vertices = shape.mesh.vertices
    if is_double or (vertices != vertices.astype(np.float32)).any():
        return shape, 0.0
    return shape, float(np.spacing(np.abs(vertices).max().astype(np.float32)))


def _name_in_file(scene, node: str, mesh) -> str:
    """Return the name of a node in its file: trimesh adds random letters where a node of a glTF has several parts."""
    if not mesh.metadata.get("from_gltf_primitive"):
        return node
    parent = str(scene.graph.transforms.parents.get(node))
    return parent if re.fullmatch(rf"{re.escape(parent)}_[0-9a-f]{{6}}", node) else node


def read_mesh(path, submesh: str | None = None, center: bool = False, roots: Collection[Path] = ()) -> Shape:
    """Read a mesh file as one shape.

    Raises Error as `read_mesh_parts` does, or if there is no such submesh.

    Convention: the file's own axes, as in Gazebo, even for glTF, which is y-up. A `.glb` loaded on its own as
    a scene is turned to z-up.

    submesh : name of the node or geometry to read, without regard to case and prefix if none has just
        this name; None reads all
    center : whether to move the centre of the bounding box to the origin
    roots : as for `read_mesh_parts`
    """
    parts = read_mesh_parts(path, roots)
    chosen = [part for part in parts if submesh in (None, part.node, part.geometry)]
    if not chosen:  # exporters add prefixes such as "geom-", and change case
        ending = re.compile(rf"(.*[^a-z0-9])?{re.escape(submesh)}", re.IGNORECASE)
        chosen = [part for part in parts if ending.fullmatch(part.node) or ending.fullmatch(part.geometry)]
    if not chosen:
        known = ", ".join(sorted(part.node for part in parts))
        raise Error(f"{path}: there is no submesh {submesh!r} (it has {known})")
    shape = concatenate([transform(part.shape, part.matrix) for part in chosen])
    if center:
        mesh, normals = shape
        used = mesh.vertices[np.unique(mesh.faces)]
        middle = (used.min(axis=0) + used.max(axis=0)) / 2
        shape = make_shape(mesh.vertices - middle, mesh.faces, normals)
    return shape
