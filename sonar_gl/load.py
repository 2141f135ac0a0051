"""Scenes from wherever they are: bundled, files, trimesh and pyrender scenes."""

from __future__ import annotations

import html
import os
import re
import sys
from pathlib import Path

import numpy as np

from sonar_gl import mesh_files, meshes
from sonar_gl.scene import Body, Scene
from sonar_gl.sdf import read_sdf
from sonar_gl.types import Error, nearest_names

SDF_SUFFIXES = (".sdf", ".world")
TRIANGLES = 4  # OpenGL's number for the mode


def data_folder(name: str) -> Path:
    """The folder `shaders` or `scenes`: inside the installed package, or at the top of the checkout."""
    here = Path(__file__).resolve().parent
    for folder in (here / name, here.parent / name):
        if folder.is_dir():
            return folder
    raise Error(f"the folder {name!r} is neither in {here} nor beside it (install sonar_gl again)")


def bundled_scenes() -> dict[str, Path]:
    """Name -> file of the scenes that come with the package, sorted by name."""
    return {path.stem: path for path in sorted(data_folder("scenes").glob("*.sdf"))}


def scene_description(path) -> str:
    """What a scene file says of itself: its first comment, else its first `<description>`, on one line."""
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    for pattern in (r"<!--(.*?)-->", r"<description>(.*?)</description>"):
        if found := re.search(pattern, text, re.DOTALL):
            return " ".join(html.unescape(found[1]).split())
    return ""


def load_scene(what, resource_paths=(), skip_missing: bool = False) -> Scene:
    """A scene from a bundled name, a file, or a scene or mesh of trimesh or pyrender.

    Parameters
    ----------
    what : name of a bundled scene; path to an SDF file (.sdf .world) or a mesh (.glb .gltf .obj .stl .ply
        .dae); trimesh.Trimesh; trimesh.Scene; pyrender.Scene
    resource_paths, skip_missing : for SDF files, as in `sonar_gl.sdf.read_sdf`

    Raises
    ------
    Error
        if there is no such scene, or its file makes no sense.

    Notes
    -----
    Convention: z is up. A glTF file, which is y-up by its standard, is turned by (x, y, z) -> (x, -z, y); all
    other files and objects keep their coordinates. Each placed geometry of a mesh file is a body of
    reflectivity 0.5. Objects of trimesh are flat shaded, for trimesh makes up normals where there are none;
    pyrender's normals are those that it draws with, and are kept.
    """
    if hasattr(what, "mesh_nodes") and hasattr(what, "get_pose"):
        return _from_pyrender(what)
    if hasattr(what, "graph") and hasattr(what, "geometry"):
        placed = [(node, *what.graph[node]) for node in sorted(what.graph.nodes_geometry)]
        parts = [(node, what.geometry[key], matrix) for node, matrix, key in placed]
        parts = [(node, mesh, matrix) for node, mesh, matrix in parts if hasattr(mesh, "faces")]
        return Scene([_placed(str(node), (mesh, None), matrix) for node, mesh, matrix in parts])
    if hasattr(what, "vertices") and hasattr(what, "faces"):
        return Scene([Body("mesh", what)])
    if not isinstance(what, (str, os.PathLike)):
        raise Error(
            "a scene must be a bundled name, a path, or a scene or mesh of trimesh or pyrender "
            f"(got {type(what).__name__})"
        )
    path, bundled = Path(what), bundled_scenes()
    if isinstance(what, str) and what in bundled:
        return read_sdf(bundled[what], resource_paths, skip_missing)
    suffix = path.suffix.lower()
    if suffix in SDF_SUFFIXES or suffix in mesh_files.SUFFIXES:
        if path.is_dir():
            raise Error(f"{path}: a scene must be a file, and this is a folder")
        if not path.is_file():
            raise Error(f"{path}: there is no such file (bundled scenes are named without an ending)")
        if suffix in mesh_files.SUFFIXES:
            return _from_mesh_file(path)
        return read_sdf(path, resource_paths, skip_missing)
    endings = " ".join((*SDF_SUFFIXES, *mesh_files.SUFFIXES))
    if path.exists() or suffix or path.name != str(what):
        raise Error(f"{path}: a scene file must end in one of {endings} (got {suffix!r})")
    raise Error(
        f"there is no bundled scene {str(what)!r} ({nearest_names(str(what), bundled)}; "
        f"a file must end in one of {endings})"
    )


def _from_mesh_file(path: Path) -> Scene:
    up = mesh_files.Z_UP_FROM_Y_UP if path.suffix.lower() in mesh_files.Y_UP_SUFFIXES else np.eye(4)
    parts = mesh_files.read_mesh_parts(path)
    names = [names[0] for names, _ in parts] if len(parts) > 1 else [path.stem]
    shapes = [meshes.transform(shape, up) for _, shape in parts]
    try:
        bodies = [Body(n, s[0], normals=s[1]) for n, s in zip(names, shapes, strict=True)]
        return Scene(bodies, name=path.stem)
    except Error as why:
        raise Error(f"{path}: {why}") from None


def _placed(name: str, shape, matrix) -> Body:
    """A body at an affine `world_from_body`; what is not rigid in that goes into the vertices."""
    pose = np.array(matrix, np.float64)
    linear = pose[:3, :3].copy()
    if not np.allclose(linear @ linear.T, np.eye(3), atol=1e-6) or np.linalg.det(linear) < 0:
        rest = np.eye(4)
        rest[:3, :3], pose[:3, :3] = linear, np.eye(3)
        shape = meshes.transform(shape, rest)
    return Body(name, shape[0], pose, normals=shape[1])


def _from_pyrender(scene) -> Scene:
    """Bodies of a pyrender scene, one a node with triangles, all its primitives and instances joined."""
    # scene.mesh_nodes is a set, whose order changes from run to run; the graph keeps the order of adding
    graph = getattr(scene, "_digraph", None)
    nodes = list(graph.nodes) if graph is not None else sorted(scene.mesh_nodes, key=lambda n: str(n.name))
    bodies, names = [], set()
    for node in nodes:
        mesh = getattr(node, "mesh", None)
        shapes = [s for primitive in mesh.primitives for s in _of_primitive(primitive)] if mesh else []
        if not shapes:
            continue
        name = stem = str(node.name or mesh.name or "mesh")
        count = 1
        while name in names:
            count += 1
            name = f"{stem}_{count}"
        names.add(name)
        bodies.append(_placed(name, meshes.concatenate(shapes), scene.get_pose(node)))
    return Scene(bodies, name=str(getattr(scene, "name", None) or "scene"))


def _of_primitive(primitive):
    """Shapes of a pyrender primitive, one an instance; none if it holds lines or points."""
    if (TRIANGLES if primitive.mode is None else primitive.mode) != TRIANGLES:
        return
    vertices = np.asarray(primitive.positions, np.float64)
    if primitive.indices is None:
        faces = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    else:
        faces = np.asarray(primitive.indices).reshape(-1, 3)
    shape = meshes.make_shape(vertices, faces, primitive.normals)
    for matrix in [np.eye(4)] if primitive.poses is None else primitive.poses:
        yield meshes.transform(shape, matrix)


class _NumpyWithInfty:
    """numpy as pyrender knew it: numpy 2 dropped the name `infty`, which pyrender.mesh uses."""

    infty = np.inf

    def __getattr__(self, name):
        return getattr(np, name)


def import_pyrender():
    """The module pyrender, made to work headless and with numpy 2; numpy itself stays untouched.

    Raises
    ------
    Error
        if pyrender or the OpenGL libraries that it needs are not installed.
    """
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("PYGLET_HEADLESS", "1")
    try:
        import pyrender
    except Exception as why:  # a missing libGL comes as ImportError, AttributeError or others
        raise Error(f"pyrender cannot be imported ({why}; it needs the packages libegl1 and libgl1)") from why
    if not hasattr(np, "infty"):
        sys.modules["pyrender.mesh"].np = _NumpyWithInfty()
    return pyrender
