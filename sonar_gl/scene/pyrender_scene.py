"""Scenes of pyrender: their conversion to ours, and an import of pyrender that works headless."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shlex
import sys
from collections.abc import Iterator

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.core.extras import pip_install
from sonar_gl.scene.placed_shapes import PlacedShapes
from sonar_gl.scene.primitives import Shape, concatenate, make_shape, transform
from sonar_gl.scene.scene import Scene

NEW_PYOPENGL = 3, 1, 6  # 3.1.0 cannot pass arrays in Python 3.14
TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6  # glTF's numbers of the primitive modes; None is the first


def is_pyrender_scene(what) -> bool:
    """Return whether an object has the interface of a pyrender.Scene, without importing pyrender."""
    return hasattr(what, "mesh_nodes") and hasattr(what, "get_pose")


def convert_pyrender_scene(scene) -> Scene:
    """Return a scene with one body for each node that has triangles, its primitives and instances joined.

    The shading normals are those that pyrender renders with.
    """
    # scene.mesh_nodes is a set, whose order changes from run to run; pyrender's graph has the order of adding
    graph = getattr(scene, "_digraph", None)
    nodes = list(graph.nodes) if graph is not None else sorted(scene.mesh_nodes, key=lambda n: str(n.name))
    bodies, names, joined, make = [], set(), {}, PlacedShapes().body
    for node in nodes:
        mesh = getattr(node, "mesh", None)
        if id(mesh) not in joined:
            shapes = [s for primitive in mesh.primitives for s in _instances(primitive)] if mesh else []
            joined[id(mesh)] = concatenate(shapes) if shapes else None
        if joined[id(mesh)] is None:
            continue
        name = stem = str(node.name or mesh.name or "mesh")
        count = 1
        while name in names:
            count += 1
            name = f"{stem}_{count}"
        names.add(name)
        bodies.append(make(name, joined[id(mesh)], scene.get_pose(node)))
    return Scene(bodies, name=str(getattr(scene, "name", None) or "scene"))


def _instances(primitive) -> Iterator[Shape]:
    """Yield a shape for each instance of a pyrender primitive; nothing if it holds lines or points."""
    vertices = np.asarray(primitive.positions, np.float64)
    indices = np.arange(len(vertices)) if primitive.indices is None else np.ravel(primitive.indices)
    faces = _faces(indices, TRIANGLES if primitive.mode is None else primitive.mode)
    if len(faces) == 0:
        return
    shape = make_shape(vertices, faces, primitive.normals)
    for matrix in [np.eye(4)] if primitive.poses is None else primitive.poses:
        yield transform(shape, matrix)


def _faces(indices: np.ndarray, mode: int) -> np.ndarray:
    """Return the corners, (F, 3), of the triangles that OpenGL draws from indices; none in modes of lines or points.

    >>> _faces(np.arange(4), TRIANGLE_STRIP).tolist(), _faces(np.arange(4), TRIANGLE_FAN).tolist()
    ([[0, 1, 2], [2, 1, 3]], [[0, 1, 2], [0, 2, 3]])
    """
    if mode == TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode not in (TRIANGLE_STRIP, TRIANGLE_FAN) or len(indices) < 3:
        return np.empty((0, 3), np.int64)
    if mode == TRIANGLE_FAN:
        return np.column_stack((np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]))
    faces = np.column_stack((indices[:-2], indices[1:-1], indices[2:]))
    faces[1::2] = faces[1::2, [1, 0, 2]]  # every second triangle of a strip is turned
    return faces


class _NumpyWithInfty:
    """NumPy with the name `infty`, which pyrender.mesh uses and NumPy 2 removed."""

    infty = np.inf

    def __getattr__(self, name):
        return getattr(np, name)


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers of a version, up to the first that is none."""
    return tuple(int(part) for part in re.match(r"[\d.]*\d|", version)[0].split(".") if part)


def import_pyrender():
    """Return the module pyrender, made to work headless and with NumPy 2; NumPy itself is not changed.

    Raises
    ------
    Error
        if pyrender or the OpenGL libraries that it needs are not installed, or PyOpenGL is too old for this Python.
    """
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("PYGLET_HEADLESS", "1")
    try:
        import pyrender
    except Exception as why:  # a missing libGL comes as ImportError, AttributeError or others
        raise Error(f"pyrender cannot be imported ({why}; it needs the packages libegl1 and libgl1)") from why
    installed = importlib.metadata.version("PyOpenGL")
    if sys.version_info >= (3, 14) and _numbers(installed) < NEW_PYOPENGL:
        newer = f"PyOpenGL>={'.'.join(map(str, NEW_PYOPENGL))}"
        raise Error(
            f"pyrender must have {newer} to draw in Python 3.14 (got {installed}, which pyrender itself asks for; to "
            f"add it: {pip_install(shlex.quote(newer))}, and do not mind that pip then says so)"
        )
    if not hasattr(np, "infty"):
        sys.modules["pyrender.mesh"].np = _NumpyWithInfty()
    return pyrender
