"""Levels of detail of a mesh: a tree of patches, each a coarser stand-in for those below it.

Faces are split in halves down to patches of LEAF. Upwards, two patches are joined and made half as many
faces again; vertices on the edge to another patch stay, so that any cut through the tree is sewn together.
Above the whole mesh come ever coarser ones.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sonar_gl.compiled import compiled
from sonar_gl.meshes import fixed_vertices
from sonar_gl.simplify import simplify

LEAF = 512  # faces; of a tree's lowest patches. Draws of fewer than some hundred cost more than their faces
MANY = 100_000  # faces; smaller meshes have no coarser levels, which would change more than they save
COARSEST = 48  # faces; of the whole mesh, further away than the sonar hears
LEAST = 0.8  # of the faces: what is not made fewer than this is not a level
MOST = 4 * LEAF  # faces in a patch: what cannot be made fewer is not joined further


@dataclass(frozen=True, eq=False)
class Levels:
    """The tree of a mesh, from the coarsest down, depth first: N patches, each with vertices of its own.

    Attributes
    ----------
    vertices : (W,) int64, of all patches one after the other, which of the mesh's vertices each is
    faces : (I, 3) uint16, of all patches likewise; they count from their patch's first vertex
    first_vertex, n_vertices, first_face, n_faces : (N,) int64
    skip : (N,) the patch that comes next if those below one are passed over
    leaf : (N,) bool, whether nothing is below
    error_m : (N,) how far it strays from the mesh; infinite where it is no stand-in
    box : (N, 6) middle and half the sides of what it stands for
    cone : (N, 4) axis of its normals and the least cosine to it (−1: any)
    moment : (N, 6) Σ A n nᵀ of its own faces: xx, yy, zz, xy, xz, yz
    whole : (N, 6) the same of the mesh's faces that it stands for
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


@compiled
def _normal(points, faces, f, n):
    """Twice the area times the normal of a face, into (3,) n; its length."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    wx, wy, wz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    n[0], n[1], n[2] = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    return math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])


@compiled
def measure(points, faces, box, cone, moment):
    """Fill a patch's box, cone and moment; see `Levels`."""
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


def split(points, faces) -> tuple[np.ndarray, np.ndarray]:
    """Faces in halves, and these in halves, along their longest side: an order, and where leaves begin."""
    middles = (points[faces[:, 0]] + points[faces[:, 1]] + points[faces[:, 2]]).astype(np.float32)
    order = np.arange(len(faces))
    depth = max(0, math.ceil(math.log2(len(faces) / LEAF)))
    bounds = np.linspace(0, len(faces), 2**depth + 1).astype(int)
    for level in range(depth):
        step = 2 ** (depth - level)
        cuts = bounds[:-1:step], bounds[step // 2 :: step], bounds[step::step]
        for low, middle, high in zip(*cuts, strict=True):
            mine = order[low:high]
            at = middles[mine]
            axis = np.ptp(at, axis=0).argmax()
            order[low:high] = mine[np.argpartition(at[:, axis], middle - low)]
    return order, bounds


def leaves_of(faces, bounds, n_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest leaf about each vertex; `faces` are in the order of leaves."""
    leaf = np.repeat(np.arange(len(bounds) - 1, dtype=np.int32), np.diff(bounds))
    lowest, highest = np.full(n_vertices, len(bounds), np.int32), np.full(n_vertices, -1, np.int32)
    for k in range(3):  # of what is written to one place the last stays
        last = np.full(n_vertices, -1, np.int32)
        last[faces[:, k]] = leaf
        highest = np.maximum(highest, last)
        last[faces[::-1, k]] = leaf[::-1]
        lowest = np.minimum(lowest, np.where(last < 0, len(bounds), last))
    return lowest, highest


@dataclass
class _Patch:
    """A patch while the tree is made: its vertices' numbers, faces of these; none if not to be had."""

    used: np.ndarray | None
    faces: np.ndarray | None
    error_m: float
    below: tuple = ()


def _patch(faces, error_m, below=()) -> _Patch:
    used, local = np.unique(faces, return_inverse=True)
    return _Patch(used, local.reshape(-1, 3).astype(np.int32), error_m, below)


def make_levels(points, faces) -> Levels:
    """The levels of a mesh.

    Parameters
    ----------
    points : (V, 3) float64, metres
    faces : (F, 3) whole numbers
    """
    points, faces = np.ascontiguousarray(points, np.float64), np.asarray(faces, np.int32)
    if len(faces) <= LEAF:
        return _flatten(points, _patch(faces, 0.0))
    order, bounds = split(points, faces)
    coarse, faces = len(faces) > MANY, faces[order]
    if coarse:
        lowest, highest = leaves_of(faces, bounds, len(points))
        fixed = fixed_vertices(faces, len(points))

    def coarser(patch, low, high, below):
        """Half the faces of a patch of the leaves low..high."""
        used = patch.used
        locked = fixed[used] | (lowest[used] < low) | (highest[used] >= high)
        fewer, error_m = simplify(points[used] - points[used[0]], patch.faces, locked, len(patch.faces) // 2)
        kept, fewer = np.unique(fewer, return_inverse=True)
        return _Patch(used[kept], fewer.reshape(-1, 3).astype(np.int32), patch.error_m + error_m, below)

    def join(work):
        one, other, low, high = work
        if coarse and one.faces is not None and other.faces is not None:
            both = np.concatenate([one.used[one.faces], other.used[other.faces]])
            joined = coarser(_patch(both, max(one.error_m, other.error_m)), low, high, (one, other))
            if len(joined.faces) <= MOST:
                return joined
        return _Patch(None, None, np.inf, (one, other))

    patches = [_patch(faces[a:b], 0.0) for a, b in pairwise(bounds)]
    width = 1
    with ThreadPoolExecutor(2) as pool:
        while len(patches) > 1:
            ranges = [(k * width, (k + 2) * width) for k in range(0, len(patches), 2)]
            pairs = zip(patches[::2], patches[1::2], ranges, strict=True)
            patches = list(pool.map(join, [(one, other, *leaves) for one, other, leaves in pairs]))
            width *= 2
    top = patches[0]
    while top.faces is not None and len(top.faces) > COARSEST:
        fewer = coarser(top, 0, len(bounds), (top,))
        if len(fewer.faces) > LEAST * len(top.faces):
            break
        top = fewer
    return _flatten(points, top)


def _flatten(points, top: _Patch) -> Levels:
    """The tree as arrays."""
    found, skip = [], []

    def walk(patch):
        number = len(found)
        found.append(patch)
        skip.append(0)
        for one in patch.below:
            walk(one)
        skip[number] = len(found)

    walk(top)
    n = len(found)
    box, cone, moment, whole = np.zeros((n, 6)), np.zeros((n, 4)), np.zeros((n, 6)), np.zeros((n, 6))
    for number in range(n - 1, -1, -1):
        patch = found[number]
        if patch.faces is None:
            cone[number, 3] = -1.0
        else:
            measure(points[patch.used], patch.faces, box[number], cone[number], moment[number])
        whole[number] = moment[number]
        if patch.below:
            below = [number + 1, skip[number + 1]][: len(patch.below)]
            whole[number] = sum(whole[k] for k in below)
            # nothing that it stands for may be missed
            held = box[below] if patch.faces is None else box[[number, *below]]
            low, high = (held[:, :3] - held[:, 3:]).min(axis=0), (held[:, :3] + held[:, 3:]).max(axis=0)
            box[number] = *(low + high) / 2, *(high - low) / 2
    real = [patch for patch in found if patch.faces is not None]
    n_vertices = np.array([0 if patch.faces is None else len(patch.used) for patch in found])
    n_faces = np.array([0 if patch.faces is None else len(patch.faces) for patch in found])
    return Levels(
        vertices=np.concatenate([patch.used for patch in real]),
        faces=np.concatenate([patch.faces.astype(np.uint16) for patch in real]),
        first_vertex=np.cumsum(n_vertices) - n_vertices,
        n_vertices=n_vertices,
        first_face=np.cumsum(n_faces) - n_faces,
        n_faces=n_faces,
        skip=np.array(skip),
        leaf=np.array([not patch.below for patch in found]),
        error_m=np.array([patch.error_m for patch in found]),
        box=box,
        cone=cone,
        moment=moment,
        whole=whole,
    )
