"""Reflectivity maps: images on meshes, turned into one reflectivity per face by splitting the faces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.core.checks import frozen_array, holds_numbers, shown
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.scene.image_files import read_image_file
from sonar_gl.scene.primitives import Shape, make_shape
from sonar_gl.scene.scene import Body

if TYPE_CHECKING:
    import trimesh

MAX_EDGE_TEXELS = 1.5  # longer edges are split; the diagonal of a texel, √2, is not
MAX_FACES = 2_000_000
SPLITS_OF_MEAN = 4  # the mean over a face is taken at the centres of 4² equal parts


def textured_body(
    name: str,
    mesh: trimesh.Trimesh,
    image: ArrayLike | str | Path,
    uv: ArrayLike | None = None,
    pose: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    specular: float | None = None,
    roughness_rad: float | None = None,
) -> Body:
    """Return a body whose reflectivity is an image on its mesh.

    Parameters
    ----------
    name, pose, normals, specular, roughness_rad : as for `Body`
    mesh : trimesh.Trimesh, metres; the body's mesh has more faces, since these are split
    image : (H, W) reflectivity, 0..1, first row at the top; unsigned integers are divided by the largest number of
        their type, colours are averaged. Or the path of an image of 8 or 16 bits
    uv : (V, 2) texture coordinates, (0, 0) the lower left corner of the image, (1, 1) the upper right; beyond, the
        image repeats. None takes those that trimesh read with the mesh (`mesh.visual.uv`)

    Raises
    ------
    Error
        if an array has the wrong shape, a number is out of bounds, there would be more than two million faces, or there
        are no texture coordinates.
    """
    # raises the errors of name and mesh, and warns of a unit, which the split mesh does not state
    Body(name, mesh)
    location, own_uv = f"body {name!r}", getattr(getattr(mesh, "visual", None), "uv", None)
    if uv is None and own_uv is None:
        raise Error(f"{location}: a mesh with an image needs texture coordinates (give uv, (V, 2))")
    with errors_at(location):
        shape, reflectivity = textured(mesh, own_uv if uv is None else uv, image, normals)
    return Body(name, shape.mesh, pose, reflectivity, shape.normals, specular, roughness_rad)


def textured(mesh, uv, image, normals=None) -> tuple[Shape, np.ndarray]:
    """Split the faces of a mesh until the image is about constant over each; return the shape, and the means, (F,).

    An edge is split in both faces that share it, so that no cracks arise.

    Raises Error if an array has the wrong shape, a number is out of bounds, or there would be more than two million
    faces.

    mesh : has (V, 3) `vertices`, metres, and (F, 3) `faces`
    uv, image : as for `textured_body`; the image is constant over each texel
    normals : None or (V, 3) shading normals, interpolated between vertices
    """
    image = read_image(image)
    faces = np.asarray(mesh.faces, np.int64)
    vertices = frozen_array(mesh.vertices, np.float64, (None, 3), "mesh vertices")
    uv = frozen_array(uv, np.float64, (len(vertices), 2), "texture coordinates")
    columns = [vertices, texels(uv, image)]
    if normals is not None:
        columns.append(frozen_array(normals, np.float64, (len(vertices), 3), "normals"))
    columns = np.concatenate(columns, axis=1)
    # vertices at one place have one number: the sides of a seam are split alike
    place = np.unique(vertices, axis=0, return_inverse=True)[1].ravel()
    changes = _count_changes(image)
    while True:
        at = columns[faces, 3:5]
        long = np.linalg.norm(at - np.roll(at, -1, axis=1), axis=2) > MAX_EDGE_TEXELS  # edges ab, bc, ca
        wide = np.flatnonzero(long.any(axis=1))
        long[wide] &= _varies(at[wide], changes)[:, None]
        if not long.any():
            break
        columns, faces, place = _split(columns, faces, place, long)
        if len(faces) > MAX_FACES:
            raise Error(
                f"a mesh with an image must have at most {MAX_FACES} faces of a texel each (got more, of an "
                f"image of {image.shape[1]} x {image.shape[0]}; make it smaller, or repeat it less often)"
            )
    mean = _means(columns[faces, 3:5], image)
    return make_shape(columns[:, :3], faces, None if normals is None else columns[:, 5:]), mean


def textured_from_above(shape: Shape, image) -> tuple[Shape, np.ndarray]:
    """Apply `textured` with the image over the x-y extent of a shape, its first row at the highest y."""
    mesh, normals = shape
    low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
    if (high <= low).any():
        raise Error(f"an image laid from above needs a shape with some width (got {(high - low).tolist()} m)")
    return textured(mesh, (mesh.vertices[:, :2] - low) / (high - low), image, normals)


def read_image(image) -> np.ndarray:
    """Return (H, W) float64 reflectivity, 0..1, from an array or a path, as `textured` takes them."""
    what = "an image"
    if isinstance(image, (str, Path)):
        what = str(image)
        image = read_image_file(image, "a reflectivity map", "such as PNG of 8 or 16 bits")
    given, image = image, np.asarray(image)
    if not holds_numbers(image):
        raise Error(f"{what} must be an array of numbers, or the path of a file (got {shown(given)})")
    # such as colours first, of which a mean would be no image
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise Error(f"{what} must have shape (H, W), or (H, W, 1, 3 or 4) of colours (got {image.shape})")
    scale = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1
    if image.ndim == 3:
        image = image[:, :, :3].mean(axis=2)
    image = frozen_array(image / scale, np.float64, (None, None), f"{what}: its values")
    if not image.size:
        raise Error(f"{what}: must have a texel at least (got {image.shape[1]} x {image.shape[0]})")
    if image.min() < 0 or image.max() > 1:
        got, cure = f"{image.min():g} to {image.max():g}", "divide by 255, or give unsigned integers"
        raise Error(f"{what}: reflectivity must lie in 0..1 (got {got}; {cure})")
    return image


def texels(uv, image) -> np.ndarray:
    """Return (..., 2) column and row of texture coordinates; texel (i, j) covers [i, i + 1) x [j, j + 1)."""
    rows, columns = image.shape
    return np.stack([uv[..., 0] * columns, (1 - uv[..., 1]) * rows], axis=-1)


def _count_changes(image) -> tuple[np.ndarray, np.ndarray]:
    """Return two (H + 1, W + 1) summed-area tables, which count texels that differ from a neighbour.

    The neighbour is the one to the right in the first table, and the one below in the second.
    """
    right, below = np.zeros(image.shape, np.int64), np.zeros(image.shape, np.int64)
    right[:, :-1], below[:-1] = image[:, :-1] != image[:, 1:], image[:-1] != image[1:]
    return tuple(np.pad(k.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))) for k in (right, below))


def _varies(at, changes) -> np.ndarray:
    """Return (n,) bool: whether the image varies within the bounding box of each of (n, 3, 2) triangles."""
    size = np.array(changes[0].shape)[::-1] - 1
    low = np.floor(at.min(axis=1) + 1e-9).astype(np.int64)
    high = np.maximum(np.ceil(at.max(axis=1) - 1e-9).astype(np.int64) - 1, low)
    repetition = low // size
    low, high = low - repetition * size, high - repetition * size
    over = (high >= size).any(axis=1)  # extends into the next repetition
    (i, j), (k, m) = low.T, np.minimum(high, size - 1).T

    def count(table, last_row, last_column):
        ends = table[last_row, last_column] - table[j, last_column] - table[last_row, i]
        return ends + table[j, i]

    found = count(changes[0], m + 1, k) + count(changes[1], m, k + 1)
    return (found > 0) | (over & (changes[0][-1, -1] + changes[1][-1, -1] > 0))


def _split(columns, faces, place, long):
    """Halve the long edges in all faces that have them; return the new columns, faces and places."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)  # ab, bc, ca
    joined = np.sort(place[edges], axis=2)
    _, spot = np.unique(joined[..., 0] * (place.max() + 1) + joined[..., 1], return_inverse=True)
    spot = spot.reshape(faces.shape)
    cut = np.zeros(spot.max() + 1, bool)
    cut[spot[long]] = True
    cut = cut[spot]
    key, first, number = np.unique(
        edges[cut][:, 0] * len(columns) + edges[cut][:, 1], return_index=True, return_inverse=True
    )
    ends = np.stack([key // len(columns), key % len(columns)])
    middle = np.full(faces.shape, -1)
    middle[cut] = len(columns) + number.ravel()
    place = np.concatenate([place, place.max() + 1 + spot[cut][first]])
    columns = np.concatenate([columns, columns[ends].mean(axis=0)])
    out, n_cut = [faces[~cut.any(axis=1)]], cut.sum(axis=1)
    for n in (1, 2, 3):
        some = n_cut == n
        # rotate the corners so that the edges to be cut come first
        first_corner = np.argmax(cut[some], axis=1) if n == 1 else (np.argmin(cut[some], axis=1) + 1) % 3
        order = (np.arange(3) + first_corner[:, None]) % 3
        a, b, c = np.take_along_axis(faces[some], order, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[some], order, axis=1).T
        parts = {
            1: ((a, ab, c), (ab, b, c)),
            2: ((ab, b, bc), (a, ab, bc), (a, bc, c)),
            3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
        }[n]
        out += [np.stack(part, axis=1) for part in parts]
    return columns, np.concatenate(out), place


def _means(at, image) -> np.ndarray:
    """Return (F,) means of the image over (F, 3, 2) triangles, sampled at the centres of n² parts of each."""
    rows, columns = image.shape
    total, n = np.zeros(len(at)), SPLITS_OF_MEAN
    for i in range(n):
        for j in range(n - i):
            for shift in (1, 2) if i + j < n - 1 else (1,):
                b, c = (i + shift / 3) / n, (j + shift / 3) / n
                spot = (1 - b - c) * at[:, 0] + b * at[:, 1] + c * at[:, 2]
                # a face that lies on the image's far edge, as the side of a box does, takes the last texels
                spot = np.floor(np.where(spot == at.max(axis=(0, 1)), spot - 0.5, spot)).astype(np.int64)
                total += image[spot[:, 1] % rows, spot[:, 0] % columns]
    return total / n**2
