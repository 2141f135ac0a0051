"""Levels of detail of a mesh: a tree of patches, each a simplified version of its children.

The mesh is halved recursively down to leaves of LEAF_FACES faces. Each parent joins two patches and simplifies them to
half the number of faces. Vertices on the border of a patch stay, so every cut through the tree is a mesh without
cracks. Above the patch of the whole mesh the tree goes on with ever coarser ones.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from sonar_gl.core.compiled import rounded_alike
from sonar_gl.raster.simplify import simplify
from sonar_gl.scene.primitives import closedness, fixed_vertices

LEAF_FACES = 512  # faces of a leaf; a draw call costs as much as some hundred faces
MIN_FACES_TO_SIMPLIFY = 100_000  # smaller meshes have leaves only: coarser levels would save too little
COARSEST_FACES = 48  # the coarsening of the whole mesh ends here: no range of a sonar needs fewer faces
MAX_LEVEL_RATIO = 0.8  # a coarser level with more than this share of the faces is dropped
EXTREMES = 48  # directions; one is within 23 degrees: how far a ball reaches is found to 8 % of its radius
MAX_PATCH_FACES = 4 * LEAF_FACES  # patches whose union cannot be simplified to this are not joined


@dataclass(frozen=True, eq=False)
class Levels:
    """The patch tree of a mesh: N patches in depth-first order from the root, each with its own vertices.

    vertices : (W,) int64, index of the mesh's vertex for each vertex of the patches, patch after patch
    faces : (I, 3) uint16, patch after patch; indices count from the first vertex of the patch
    first_vertex, n_vertices, first_face, n_faces : (N,) int64
    skip : (N,) index of the next patch that is not a descendant
    leaf : (N,) bool, whether the patch has no children
    error_m : (N,) geometric error, the distance from the mesh; infinite for a patch without faces
    box : (N, 6) centre and half extents of the patch's part of the mesh
    cone : (N, 4) axis of the normals, and the least cosine of a normal to it (-1 for any direction)
    moment : (N, 6) Σ A n nᵀ over the faces of the patch: xx, yy, zz, xy, xz, yz
    whole : (N, 6) the same sum over the patch's part of the mesh at full detail
    """

    vertices: np.ndarray
    faces: np.ndarray
    first_vertex: np.ndarray
    n_vertices: np.ndarray
    first_face: np.ndarray
    n_faces: np.ndarray
    skip: np.ndarray
    leaf: np.ndarray
    error_m: np.ndarray
    box: np.ndarray
    cone: np.ndarray
    moment: np.ndarray
    whole: np.ndarray


@rounded_alike
def _normal(points, faces, f, n):
    """Fill n, (3,), with twice the area vector of a face; return its length."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    wx, wy, wz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    n[0], n[1], n[2] = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    return math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])


@rounded_alike
def measure_patch(points, faces, box, cone, moment):
    """Fill the box, cone and moment of a patch; see `Levels`."""
    n, low, high = np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        low[k], high[k], cone[k] = np.inf, -np.inf, 0.0
    for f in range(faces.shape[0]):
        length = _normal(points, faces, f, n)
        for k in range(3):
            cone[k] += n[k]
            for corner in range(3):
                at = points[faces[f, corner], k]
                low[k], high[k] = min(low[k], at), max(high[k], at)
            if length > 0.0:
                moment[k] += n[k] * n[k] / length / 2
                # xy, xz, yz
                moment[3 + k] += n[1 if k == 2 else 0] * n[1 if k == 0 else 2] / length / 2
    for k in range(3):
        box[k], box[3 + k] = (low[k] + high[k]) / 2, (high[k] - low[k]) / 2
    total = math.sqrt(cone[0] * cone[0] + cone[1] * cone[1] + cone[2] * cone[2])
    cone[3] = -1.0
    if total > 0.0:
        cone[3] = 1.0
        for k in range(3):
            cone[k] /= total
        for f in range(faces.shape[0]):
            length = _normal(points, faces, f, n)
            if length > 0.0:
                cosine = (n[0] * cone[0] + n[1] * cone[1] + n[2] * cone[2]) / length
                cone[3] = min(cone[3], cosine)


@rounded_alike
def _longest_axis(points):
    """Return the axis, 0..2, along which the points, (N, 3), extend furthest; the first of equal ones."""
    low, high = np.full(3, np.inf, points.dtype), np.full(3, -np.inf, points.dtype)
    for n in range(points.shape[0]):
        for k in range(3):
            low[k], high[k] = min(low[k], points[n, k]), max(high[k], points[n, k])
    return (high - low).argmax()


def split_faces(points, faces) -> tuple[np.ndarray, np.ndarray]:
    """Halve the faces recursively along their longest extent; return their order and the bounds of leaves in it."""
    middles, order = np.empty((len(faces), 3), np.float32), np.arange(len(faces), dtype=np.int32)
    a, b, c = faces.T
    for k, at in enumerate(points.T):  # one after the other: all at once would take three times the memory
        middles[:, k] = at[a] + at[b] + at[c]
    n_leaves = 2 ** max(0, math.ceil(math.log2(len(faces) / LEAF_FACES)))
    bounds = np.linspace(0, len(faces), n_leaves + 1).astype(int)

    def split(low, high):
        """Halve the faces of the leaves low..high - 1, down to single leaves."""
        if high - low == 1:
            return
        middle = (low + high) // 2
        part = slice(bounds[low], bounds[high])
        along = middles[part, _longest_axis(middles[part])]
        picked = np.argpartition(along, bounds[middle] - bounds[low])
        # the middles move, too, so that those of a part stay together in memory
        order[part], middles[part] = order[part].take(picked), middles[part].take(picked, axis=0)
        split(low, middle)
        split(middle, high)

    split(0, n_leaves)
    return order, bounds


def leaf_range(faces, bounds, n_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest leaf that uses each vertex; `faces` are in the order of leaves."""
    leaf = np.repeat(np.arange(len(bounds) - 1, dtype=np.int32), 3 * np.diff(bounds))
    lowest, highest = np.full(n_vertices, len(bounds), np.int32), np.full(n_vertices, -1, np.int32)
    np.minimum.at(lowest, faces.ravel(), leaf)
    np.maximum.at(highest, faces.ravel(), leaf)
    return lowest, highest


@dataclass
class _Patch:
    """A patch during construction of the tree.

    vertices : (n,) int32 indices of the mesh's vertices; none of a patch that could not be simplified
    faces : (m, 3) int32 indices into `vertices`
    error_m : geometric error
    children : patches below
    """

    vertices: np.ndarray
    faces: np.ndarray
    error_m: float
    children: tuple = ()


def _compacted(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop the vertices that no face uses; return the (n,) others in their order, and the faces by them.

    faces : (m, 3) int32 indices into `vertices`
    """
    is_used = np.zeros(len(vertices), bool)
    is_used[faces] = True
    return vertices[is_used], (np.cumsum(is_used, dtype=np.int32) - 1)[faces]


def _joined(
    vertices: np.ndarray, faces: np.ndarray, more_vertices: np.ndarray, more_faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Join two patches; return the (n,) rising vertices of both, each once, and the (m, 3) int32 faces by them.

    vertices, more_vertices : rising; faces, more_faces : int32 indices into them
    """
    both = np.union1d(vertices, more_vertices)
    numbers = (np.searchsorted(both, one).astype(np.int32) for one in (vertices, more_vertices))
    return both, np.concatenate([of[one] for of, one in zip(numbers, (faces, more_faces), strict=True)])


def _patch(faces) -> _Patch:
    """Return a patch of faces that are indices of the mesh's vertices, without an error."""
    vertices, local = np.unique(faces, return_inverse=True)
    return _Patch(vertices, local.reshape(-1, 3).astype(np.int32), 0.0)


def make_levels(points, faces) -> Levels:
    """Build the patch tree of a mesh.

    points : (V, 3) float64, metres
    faces : (F, 3) indices of vertices
    """
    points, faces = np.ascontiguousarray(points, np.float64), np.asarray(faces, np.int32)
    if len(faces) <= LEAF_FACES:
        return _flatten(points, _patch(faces))
    order, bounds = split_faces(points, faces)
    is_simplified, faces = len(faces) > MIN_FACES_TO_SIMPLIFY, faces[order]
    if is_simplified:
        lowest, highest = leaf_range(faces, bounds, len(points))
        fixed = fixed_vertices(faces, len(points))

    def coarsen(patch, low, high, children):
        """Return a patch of the leaves low..high - 1 with half the faces of `patch`."""
        used = patch.vertices
        locked = fixed[used] | (lowest[used] < low) | (highest[used] >= high)
        fewer, error_m = simplify(points[used] - points[used[0]], patch.faces, locked, len(patch.faces) // 2)
        return _Patch(*_compacted(used, fewer), patch.error_m + error_m, children)

    def join(one, other, leaves):
        """Return the parent of two patches; it has no faces where it cannot be simplified enough."""
        if is_simplified and len(one.faces) and len(other.faces):
            both = _joined(one.vertices, one.faces, other.vertices, other.faces)
            error_m = max(one.error_m, other.error_m)
            joined = coarsen(_Patch(*both, error_m), *leaves, (one, other))
            if len(joined.faces) <= MAX_PATCH_FACES:
                return joined
        return _Patch(np.empty(0, np.int32), np.empty((0, 3), np.int32), np.inf, (one, other))

    def subtree(low, high):
        """Return the patch of the leaves low..high - 1, with those below it."""
        if high - low == 1:
            return _patch(faces[bounds[low] : bounds[high]])
        middle = (low + high) // 2
        return join(subtree(low, middle), subtree(middle, high), (low, high))

    n_leaves = len(bounds) - 1  # a power of 2, and at least 2
    with ThreadPoolExecutor(1) as other_thread:
        second_half = other_thread.submit(subtree, n_leaves // 2, n_leaves)
        first_half = subtree(0, n_leaves // 2)
        top = join(first_half, second_half.result(), (0, n_leaves))
    while len(top.faces) > COARSEST_FACES:
        fewer = coarsen(top, 0, n_leaves, (top,))
        if len(fewer.faces) > MAX_LEVEL_RATIO * len(top.faces):
            break
        top = fewer
    return _flatten(points, top)


def _flatten(points, top: _Patch) -> Levels:
    """Return the tree below `top` as arrays."""
    patches, skip = [], []

    def walk(patch):
        number = len(patches)
        patches.append(patch)
        skip.append(0)
        for child in patch.children:
            walk(child)
        skip[number] = len(patches)

    walk(top)
    n = len(patches)
    box, cone, moment, whole = np.zeros((n, 6)), np.zeros((n, 4)), np.zeros((n, 6)), np.zeros((n, 6))
    for number in range(n - 1, -1, -1):
        patch = patches[number]
        measure_patch(points[patch.vertices], patch.faces, box[number], cone[number], moment[number])
        whole[number] = moment[number]
        if patch.children:
            children = [number + 1, skip[number + 1]][: len(patch.children)]
            whole[number] = sum(whole[k] for k in children)
            # The box encloses the children, or culling could drop visible parts of the mesh. The vertices of
            # the patch itself are among theirs.
            low = (box[children, :3] - box[children, 3:]).min(axis=0)
            high = (box[children, :3] + box[children, 3:]).max(axis=0)
            box[number] = *(low + high) / 2, *(high - low) / 2
    n_vertices = np.array([len(patch.vertices) for patch in patches])
    n_faces = np.array([len(patch.faces) for patch in patches])
    return Levels(
        vertices=np.concatenate([patch.vertices for patch in patches]),
        faces=np.concatenate([patch.faces.astype(np.uint16) for patch in patches]),
        first_vertex=np.cumsum(n_vertices) - n_vertices,
        n_vertices=n_vertices,
        first_face=np.cumsum(n_faces) - n_faces,
        n_faces=n_faces,
        skip=np.array(skip),
        leaf=np.array([not patch.children for patch in patches]),
        error_m=np.array([patch.error_m for patch in patches]),
        box=box,
        cone=cone,
        moment=moment,
        whole=whole,
    )


@dataclass(frozen=True, eq=False)
class MeshWithLevels:
    """The mesh of a body with its levels of detail, independent of the body's pose.

    centre : (3,) float64, centre of the mesh's box in the body's frame; origin of all other coordinates
    bounds : (2, 3) low and high corner of the box
    extremes : (EXTREMES, 3) float64, outermost vertices
    radii : (2,) of `radii_about` the centre; zeros of an open mesh
    closed : +1 if every edge joins two faces of the same orientation, with normals that point outwards; otherwise 0
    points : (W, 3) float32, position of each vertex of the levels
    normals : (W, 3) float32 of the same vertices, or None
    reflectivity : (W,) float32, equal at the corners of each face, or None where the body has one value
    """

    centre: np.ndarray
    bounds: np.ndarray
    extremes: np.ndarray
    radii: np.ndarray
    closed: int
    levels: Levels
    points: np.ndarray
    normals: np.ndarray | None
    reflectivity: np.ndarray | None


def extreme_points(points: np.ndarray) -> np.ndarray:
    """Return the outermost of some points, (n, 3), in each of EXTREMES directions; (EXTREMES, 3), some repeatedly.

    The directions are those of a Fibonacci lattice on the sphere.
    """
    k = np.arange(EXTREMES) + 0.5
    z, turn = 1 - 2 * k / EXTREMES, math.pi * (1 + math.sqrt(5)) * k
    level = np.sqrt(1 - z * z)
    directions = np.column_stack([level * np.cos(turn), level * np.sin(turn), z])
    # one after the other: all at once would take as much memory as 16 meshes
    return points[[int((points @ direction).argmax()) for direction in directions]]


def radii_about(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (2,): the radius of a sphere about the origin that a closed mesh fills, and of one that holds the mesh.

    The first is 0 where a face does not look away from the origin, as of a ring, whose origin lies outside of it.

    points : (V, 3); faces : (F, 3), anticlockwise as seen from outside
    """
    a, b, c = points[faces].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)  # vectors of twice the area
    lengths = np.linalg.norm(areas, axis=1)
    is_proper = lengths > 0
    # of the origin below the faces' planes
    heights = np.einsum("fi,fi->f", areas, a)[is_proper] / lengths[is_proper]
    outer = np.linalg.norm(points[faces], axis=2).max()
    return np.array([max(heights.min(initial=outer), 0.0), outer])


def _merge_vertices(rows, faces):
    """Merge vertices with equal attributes; return the indices of those that remain, and the faces by them.

    Faces that collapse to a line or a point are dropped, unless all do.
    """
    bits = (rows + 0.0).view(np.uint64)  # adding 0 turns -0 into 0
    hashes = np.zeros(len(rows), np.uint64)
    for column in bits.T:
        hashes = (hashes ^ column) * np.uint64(0x9E3779B97F4A7C15)
        hashes ^= hashes >> np.uint64(29)
    first = np.argsort(hashes)  # four times as fast as np.unique, which must keep equal ones in order
    inverse = np.empty(len(first), np.int32)
    inverse[first] = np.arange(len(first), dtype=np.int32)
    ordered = hashes[first]
    if (ordered[1:] == ordered[:-1]).any():
        _, first, inverse = np.unique(hashes, return_index=True, return_inverse=True)
        inverse = inverse.ravel()
        if not (bits == bits[first][inverse]).all():  # a hash collision
            _, first, inverse = np.unique(bits, axis=0, return_index=True, return_inverse=True)
            inverse = inverse.ravel()
    faces = inverse[faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return first, faces[proper] if proper.any() else faces


def mesh_with_levels(body) -> MeshWithLevels:
    """Return the mesh of a body with its levels of detail."""
    points, faces = np.asarray(body.surface.vertices, np.float64), np.asarray(body.surface.faces)
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    centre = bounds.mean(axis=0)
    closed = closedness(points, faces)
    points, normals, reflectivity = points - centre, body.normals, None
    if closed < 0:
        faces = faces[:, ::-1]
    radii = radii_about(points, faces) if closed else np.zeros(2)
    if np.ndim(body.reflectivity):  # each corner gets the reflectivity of its face, and so its own vertex
        reflectivity = np.repeat(np.asarray(body.reflectivity, np.float64), 3)
        corners = np.ascontiguousarray(faces).ravel()
        points, faces = points[corners], np.arange(len(corners)).reshape(-1, 3)
        normals = None if normals is None else normals[corners]
    if len(faces) > MIN_FACES_TO_SIMPLIFY or reflectivity is not None:
        columns = [column for column in (points, normals, reflectivity) if column is not None]
        remaining, faces = _merge_vertices(np.column_stack(columns), faces)
        del columns  # the levels take memory enough
        points = points[remaining]
        normals = None if normals is None else normals[remaining]
        reflectivity = None if reflectivity is None else reflectivity[remaining].astype(np.float32)
    levels = make_levels(points, faces)
    vertices = levels.vertices
    return MeshWithLevels(
        centre=centre,
        bounds=bounds - centre,
        extremes=extreme_points(points),
        radii=radii,
        closed=abs(closed),
        points=points.astype(np.float32)[vertices],
        normals=None if normals is None else normals[vertices],
        reflectivity=None if reflectivity is None else reflectivity[vertices],
        levels=levels,
    )
