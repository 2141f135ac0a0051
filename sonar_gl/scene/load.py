"""Scenes by name, from files, and from objects of trimesh, pyrender and MuJoCo."""

from __future__ import annotations

import difflib
import html
import os
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sonar_gl.core.checks import shown
from sonar_gl.core.data_files import data_folder
from sonar_gl.core.errors import Error, errors_at, nearest_names, similar_names, some_names
from sonar_gl.core.input_files import check_is_file, check_no_link_loop
from sonar_gl.core.warn import warn_caller
from sonar_gl.scene import mesh_files, mujoco_model
from sonar_gl.scene.mujoco_model import convert_mujoco_model, is_mujoco_model
from sonar_gl.scene.placed_shapes import PlacedShapes
from sonar_gl.scene.primitives import Shape, transform
from sonar_gl.scene.pyrender_scene import convert_pyrender_scene, is_pyrender_scene
from sonar_gl.scene.scene import DEFAULT_REFLECTIVITY, Body, Scene
from sonar_gl.scene.sdf.reader import read_sdf
from sonar_gl.scene.sdf.resources import Resources
from sonar_gl.scene.sdf.xacro import split_arguments
from sonar_gl.scene.shading_normals import rounded_text

SDF_SUFFIXES = (".sdf", ".world", ".urdf", ".xacro")
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
ADDRESS = "[A-Za-z][A-Za-z0-9+.-]*://"  # how one begins, by RFC 3986, section 3.1
SUFFIXES = (*SDF_SUFFIXES, *mujoco_model.SUFFIXES, *mesh_files.SUFFIXES)


def bundled_scenes() -> dict[str, Path]:
    """Return name -> file of the scenes that come with the package, sorted by name."""
    return {path.stem: path for path in sorted(data_folder("scenes").glob("*.sdf"))}


def is_sdf(what: str) -> bool:
    """Return whether a name or path of a scene is one that `read_sdf` reads: SDF, URDF, or a model's folder."""
    path = Path(split_arguments(what)[0])
    return what in bundled_scenes() or path.is_dir() or path.suffix.lower() in SDF_SUFFIXES


def is_turned(what: str) -> bool:
    """Return whether a name or path of a scene is one whose y-up axes `load_scene` turns to z-up: glTF."""
    return not is_sdf(what) and Path(what).suffix.lower() in mesh_files.Y_UP_SUFFIXES


def scene_description(path) -> str:
    """Return the first comment of a scene file, else its first `<description>`, on one line; else ""."""
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    for pattern in (r"<!--(.*?)-->", r"<description>(.*?)</description>"):
        if found := re.search(pattern, text, re.DOTALL):
            return " ".join(html.unescape(found[1]).split())
    return ""


def load_scene(what, resource_paths: Iterable[str | os.PathLike] = (), skip_missing: bool = False) -> Scene:
    """Load a scene by a bundled name, from a file, or from an object of trimesh, pyrender or MuJoCo.

    Parameters
    ----------
    what : name of a bundled scene; path of a file of SDF (.sdf .world), URDF (.urdf) or xacro (.xacro, with
        arguments after it as in "robot.xacro debug:=1"), of a model's folder, of a mesh
        (.glb .gltf .obj .stl .ply .dae), or of a MuJoCo model (.xml .mjcf); trimesh.Trimesh; trimesh.Scene;
        pyrender.Scene; mujoco.MjModel; mujoco.MjData
    resource_paths : folders in which SDF, URDF and xacro look for `model://` and `package://` first, and in which files
        of a MuJoCo model may lie; not for meshes
    skip_missing : of SDF, URDF and xacro: leave out, with a warning, what is missing, unreadable or unknown, in place
        of an error

    Raises
    ------
    Error
        if there is no such scene, or its file is invalid.

    Notes
    -----
    Convention: z is up. A glTF file, which is y-up by its standard, is turned by (x, y, z) -> (x, -z, y); all
    other files and objects keep their coordinates. Each placed geometry of a mesh file becomes a body of
    reflectivity 0.5, with one warning. Objects of trimesh are shaded flat, because trimesh computes normals
    where a mesh has none; those of pyrender keep the normals that pyrender renders with. docs/conventions.md
    describes scenes of each format.

    Warns
    -----
    UserWarning
        of what is left out or assumed, and of bodies whose shading normals round the edges of flat faces.
    """
    if not isinstance(skip_missing, bool | np.bool_):
        raise Error(f"skip_missing must be True or False (got {shown(skip_missing)})")
    is_named = isinstance(what, (str, os.PathLike))
    scene = _load_named(what, resource_paths, skip_missing) if is_named else _convert(what)
    if text := rounded_text(scene.bodies):
        warn_caller(f"{what}: {text}" if is_named else text)
    return scene


def _convert(what) -> Scene:
    """Return the scene of an object of another library; errors as of `load_scene`."""
    if is_pyrender_scene(what):
        return convert_pyrender_scene(what)
    if is_mujoco_model(what):
        return convert_mujoco_model(what)
    if hasattr(what, "graph") and hasattr(what, "geometry"):
        return _convert_trimesh_scene(what)
    if hasattr(what, "vertices") and hasattr(what, "faces"):
        return Scene([Body("mesh", what)])
    raise Error(
        "a scene must be a bundled name, a path, or a scene or mesh of trimesh, pyrender or MuJoCo "
        f"(got {type(what).__name__})"
    )


def _load_named(what, resource_paths: Iterable[str | os.PathLike], skip_missing: bool) -> Scene:
    """Load a scene by a bundled name or a path; arguments and errors as of `load_scene`."""
    if not os.fspath(what):
        raise Error("a scene must be a bundled name or a path (got an empty text)")
    path, bundled = Path(split_arguments(str(what))[0]), bundled_scenes()
    if isinstance(what, str) and what in bundled:
        return read_sdf(bundled[what], resource_paths, skip_missing)
    if isinstance(what, str) and re.match(ADDRESS, what):
        raise Error(
            f"a scene must be a bundled name or a path (got the address {shown(what)}; give the path of its file or "
            "folder on this machine)"
        )
    check_no_link_loop(path)
    if (path / "model.sdf").is_file() or (path / "model.config").is_file():
        return read_sdf(path, resource_paths, skip_missing)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise _no_scene_error(what, path)
    if path.is_dir():
        raise Error(f"{path}: must be a file, or the folder of a model (it has no model.sdf)")
    if not path.exists():
        hint = _similar_files(path) or "bundled scenes are named without an ending"
        raise Error(f"{path}: there is no such file ({hint})")
    check_is_file(path)
    if suffix in mesh_files.SUFFIXES:
        return _read_mesh_scene(path)
    if suffix in mujoco_model.SUFFIXES and Resources(path).parse(path).tag == "mujoco":
        return mujoco_model.read_mjcf(path, resource_paths)
    return read_sdf(what, resource_paths, skip_missing)


def _no_scene_error(what, path: Path) -> Error:
    """Return the error of a name or path that is that of no scene.

    path : without arguments of xacro
    """
    endings, suffix, bundled = " ".join(SUFFIXES), path.suffix.lower(), bundled_scenes()
    if suffix in USD_SUFFIXES:
        return Error(f"{path}: USD is not read; convert it to .glb, for instance by Blender")
    if path.is_dir():
        hint = _files_hint(path)
        return Error(
            f"{path}: a folder must be that of a model (it has neither model.config nor model.sdf{hint})"
        )
    if re.search(r"\.xacro\s+\w+=", str(what)) and not path.exists():
        return Error(f"{path}: arguments of xacro are given as name:=value, with a colon")
    if path.exists() or suffix or path.name != str(what):
        return Error(f"{path}: a scene file must end in one of {endings} (got {suffix!r})")
    hint = nearest_names(str(what), bundled)
    if str(what) in bundled:
        hint = "a Path is that of a file: name a bundled scene by text"
    return Error(f"there is no bundled scene {str(what)!r} ({hint}; a file must end in one of {endings})")


def _files_hint(folder: Path) -> str:
    """Return what to give in place of a folder that holds files of scenes; empty if it holds none."""
    files = _scene_files(folder)
    if not files:
        return ""
    hint = f"; give one of its files: {some_names([one.name for one in files])}"
    if len(files) > 1 and all(one.suffix.lower() in mesh_files.SUFFIXES for one in files):
        hint += "; or an SDF file with a model for each mesh"
    return hint


def _scene_files(folder: Path) -> list[Path]:
    """Return the files in a folder that have the ending of a scene, sorted; none if it cannot be read."""
    try:
        return sorted(one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES)
    except OSError:
        return []


def _similar_files(path: Path) -> str:
    """Return a question about files of scenes beside a missing one that have similar names; empty if there are none."""
    files = _scene_files(path.parent)
    # endings are alike in any two names
    near = difflib.get_close_matches(path.stem.lower(), {one.stem.lower() for one in files}, cutoff=0.6)
    return similar_names(path.name, [one.name for one in files if one.stem.lower() in near])


def _read_mesh_scene(path: Path) -> Scene:
    """Return a scene with one body for each placed geometry of a mesh file."""
    z_up = mesh_files.Z_UP_FROM_Y_UP if is_turned(str(path)) else np.eye(4)
    parts = mesh_files.read_mesh_parts(path)
    names = _numbered([part.node for part in parts]) if len(parts) > 1 else [path.stem]
    shapes = {part.geometry: part.shape for part in parts}  # of copies once
    turned = {geometry: transform(shape, z_up) for geometry, shape in shapes.items()}
    with errors_at(str(path)):
        make = PlacedShapes().body
        bodies = [
            make(name, turned[part.geometry], z_up @ part.matrix @ z_up.T)
            for name, part in zip(names, parts, strict=True)
        ]
        scene = Scene(bodies, name=path.stem)
    warn_caller(
        f"{path}: a mesh file states no reflectivity; it is taken as {DEFAULT_REFLECTIVITY} (give another in Python, "
        "or by an SDF file that includes the mesh)"
    )
    return scene


def _numbered(names: list[str]) -> list[str]:
    """Return different names: of several that are the same the first stays, and the others have numbers.

    >>> _numbered(["hull", "hull", "hull_1", "mast"])
    ['hull', 'hull_2', 'hull_1', 'mast']
    """
    given, taken, out = set(names), set(), []
    numbers = Counter()
    for name in names:
        new = name
        while new in taken or (new != name and new in given):
            numbers[name] += 1
            new = f"{name}_{numbers[name]}"
        taken.add(new)
        out.append(new)
    return out


def _convert_trimesh_scene(scene) -> Scene:
    """Return a scene with one body for each node of a trimesh.Scene that has faces, sorted by name."""
    bodies, make = [], PlacedShapes().body
    for node in sorted(scene.graph.nodes_geometry):
        matrix, key = scene.graph[node]
        mesh = scene.geometry[key]
        if hasattr(mesh, "faces"):  # neither points nor lines
            bodies.append(make(str(node), Shape(mesh, None), matrix))
    return Scene(bodies)
