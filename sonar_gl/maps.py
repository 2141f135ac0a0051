"""Reflectivity maps: images laid on a mesh, baked into faces so small that each has one reflectivity."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sonar_gl.meshes import make_shape
from sonar_gl.scene import Body
from sonar_gl.types import Error, frozen_array

WIDEST = 1.5  # texels, of an edge: the diagonal of a texel is not split further
MAX_FACES = 2_000_000
SPOTS = 4  # a face's mean is taken at SPOTS² places


def textured_body(
    name: str, mesh, image, uv=None, pose=None, normals=None, specular=None, roughness_rad=None
) -> Body:
    """A body whose reflectivity is an image on its mesh.

    Parameters
    ----------
    name, pose, normals, specular, roughness_rad : as for `Body`; mesh : before its faces are split
    image, uv : of `textured`; uv None takes those that trimesh read with the mesh (`mesh.visual.uv`)

    Raises
    ------
    Error
        as `textured` and `Body` do, or if there are no texture coordinates.
    """
    where, own = f"body {name!r}", getattr(getattr(mesh, "visual", None), "uv", None)
    if uv is None and own is None:
        raise Error(f"{where}: a mesh with an image needs texture coordinates (give uv, (V, 2))")
    try:
        (triangles, normals), reflectivity = textured(mesh, own if uv is None else uv, image, normals)
    except Error as why:
        raise Error(f"{where}: {why}") from None
    return Body(name, triangles, pose, reflectivity, normals, specular, roughness_rad)


def textured(mesh, uv, image, normals=None):
    """Split faces until the image is about constant over each.

    Edges are split as wholes, in both faces that they join, so that no cracks arise.

    Parameters
    ----------
    mesh : (V, 3) vertices and (F, 3) faces
    uv : (V, 2), as of glTF and OBJ that trimesh has loaded: (0, 0) is the lower left corner of the image,
        (1, 1) the upper right; beyond, the image is repeated
    image : (H, W) reflectivity, 0..1, first row on top; whole numbers are divided by the most that their
        type holds; or the path of an image of 8 or 16 bits. Colours are averaged. A texel has one value
    normals : None or (V, 3), rounded between vertices as the driver would

    Returns
    -------
    shape : (Triangles, normals or None)
    reflectivity : (F,) float64, mean of the image over each face

    Raises
    ------
    Error
        if a shape or a number makes no sense, or there would be more than two million faces.
    """
    image = read_image(image)
    faces = np.asarray(mesh.faces, np.int64)
    vertices = frozen_array(mesh.vertices, np.float64, (None, 3), "mesh vertices")
    uv = frozen_array(uv, np.float64, (len(vertices), 2), "texture coordinates")
    columns = [vertices, texels(uv, image)]
    if normals is not None:
        columns.append(frozen_array(normals, np.float64, (len(vertices), 3), "normals"))
    columns = np.concatenate(columns, axis=1)
    place = np.unique(vertices, axis=0, return_inverse=True)[1].ravel()  # one for all sides of a seam
    changes = _changes(image)
    while True:
        at = columns[faces, 3:5]
        long = np.linalg.norm(at - np.roll(at, -1, axis=1), axis=2) > WIDEST  # edges ab, bc, ca
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


def laid_from_above(shape, image):
    """As `textured`, the image over the x-y extent of a shape, its first row at the highest y."""
    mesh, normals = shape
    low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
    if (high <= low).any():
        raise Error(f"an image laid from above needs a shape with some width (got {(high - low).tolist()} m)")
    return textured(mesh, (mesh.vertices[:, :2] - low) / (high - low), image, normals)


def read_image(image) -> np.ndarray:
    """(H, W) float64, 0..1, of an array or a path; see `textured`."""
    what = "an image"
    if isinstance(image, (str, Path)):
        import cv2

        what = str(image)
        if not Path(image).is_file():
            raise Error(f"{image}: there is no such file")
        image = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise Error(f"{what}: must be an image that OpenCV reads (such as PNG of 8 or 16 bits)")
    image = np.asarray(image)
    scale = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1
    if image.ndim == 3:
        image = image[:, :, :3].mean(axis=2)
    image = frozen_array(image / scale, np.float64, (None, None), f"{what}: its values")
    if not image.size:
        raise Error(f"{what}: must have a texel at least (got {image.shape[1]} x {image.shape[0]})")
    if image.min() < 0 or image.max() > 1:
        raise Error(f"{what}: reflectivity must lie in 0..1 (got {image.min():g} to {image.max():g})")
    return image


def texels(uv, image) -> np.ndarray:
    """(..., 2) column and row of texture coordinates; texel (i, j) reaches from there to one more."""
    rows, columns = image.shape
    return np.stack([uv[..., 0] * columns, (1 - uv[..., 1]) * rows], axis=-1)


def _changes(image) -> tuple[np.ndarray, np.ndarray]:
    """(H + 1, W + 1) sums over all texels above and left: from how many the next one, to the right, differs.

    And from how many the one below.
    """
    right, below = np.zeros(image.shape, np.int64), np.zeros(image.shape, np.int64)
    right[:, :-1], below[:-1] = image[:, :-1] != image[:, 1:], image[:-1] != image[1:]
    return tuple(np.pad(k.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))) for k in (right, below))


def _varies(at, changes) -> np.ndarray:
    """(n,) whether the image does so in the box about each of (n, 3, 2) triangles."""
    size = np.array(changes[0].shape)[::-1] - 1
    low = np.floor(at.min(axis=1) + 1e-9).astype(np.int64)
    high = np.maximum(np.ceil(at.max(axis=1) - 1e-9).astype(np.int64) - 1, low)
    turns = low // size
    low, high = low - turns * size, high - turns * size
    over = (high >= size).any(axis=1)  # into the next repetition
    (i, j), (k, m) = low.T, np.minimum(high, size - 1).T

    def count(table, last_row, last_column):
        ends = table[last_row, last_column] - table[j, last_column] - table[last_row, i]
        return ends + table[j, i]

    found = count(changes[0], m + 1, k) + count(changes[1], m, k + 1)
    return (found > 0) | (over & (changes[0][-1, -1] + changes[1][-1, -1] > 0))


def _split(columns, faces, place, long):
    """Halve the long edges, wherever they occur: columns, faces and places as they are then."""
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
        # turned so that the edges that are cut come first
        turn = np.argmax(cut[some], axis=1) if n == 1 else (np.argmin(cut[some], axis=1) + 1) % 3
        order = (np.arange(3) + turn[:, None]) % 3
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
    """(F,) means of the image over (F, 3, 2) triangles: at the middles of SPOTS² parts of each."""
    rows, columns = image.shape
    total = np.zeros(len(at))
    for i in range(SPOTS):
        for j in range(SPOTS - i):
            for shift in (1, 2) if i + j < SPOTS - 1 else (1,):
                b, c = (i + shift / 3) / SPOTS, (j + shift / 3) / SPOTS
                spot = (1 - b - c) * at[:, 0] + b * at[:, 1] + c * at[:, 2]
                # a face along the image's far edge, as on the side of a box, has the border before it
                spot = np.floor(np.where(spot == at.max(axis=(0, 1)), spot - 0.5, spot)).astype(np.int64)
                total += image[spot[:, 1] % rows, spot[:, 0] % columns]
    return total / SPOTS**2
