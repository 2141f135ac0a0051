"""Mesh simplification by half-edge collapses, in order of the quadric error.

The error metric is that of Garland and Heckbert, "Surface simplification using quadric error metrics" (SIGGRAPH 1997).
Each pass collapses independent edges. No vertex moves, so meshes that share locked vertices stay without cracks, and a
vertex keeps its normal and reflectivity; installable simplifiers do not offer this.
"""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.core.compiled import rounded_alike

MAX_PASSES = 16
MIN_SQUARED_SINE = 1e-8  # of a face's angle after a collapse
MIN_NORMAL_COSINE = 0.5  # between a face's normals before and after a collapse
PASS_SLACK = 1.5  # a pass collapses edges up to this many times the error of the last one it needs


@rounded_alike
def _add_quadrics(points, faces, quadrics):
    """Add to the quadric of each vertex, (V, 11), the area-weighted squared distance to the planes of its faces."""
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        wx, wy, wz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        area = math.sqrt(nx * nx + ny * ny + nz * nz)
        if area <= 0.0:
            continue
        nx, ny, nz = nx / area, ny / area, nz / area
        d = -(nx * points[a, 0] + ny * points[a, 1] + nz * points[a, 2])
        for k in range(3):
            q = quadrics[faces[f, k]]
            q[0] += area * nx * nx
            q[1] += area * ny * ny
            q[2] += area * nz * nz
            q[3] += area * nx * ny
            q[4] += area * nx * nz
            q[5] += area * ny * nz
            q[6] += area * nx * d
            q[7] += area * ny * d
            q[8] += area * nz * d
            q[9] += area * d * d
            q[10] += area


@rounded_alike
def _cost(q, p):
    """Return the mean squared distance of p to the planes of a quadric."""
    x, y, z = p[0], p[1], p[2]
    total = q[0] * x * x + q[1] * y * y + q[2] * z * z + 2 * (q[3] * x * y + q[4] * x * z + q[5] * y * z)
    total += 2 * (q[6] * x + q[7] * y + q[8] * z) + q[9]
    return max(total, 0.0) / max(q[10], 1e-300)


@rounded_alike
def _neighbours(faces, n_vertices):
    """Return the faces around each vertex: offsets of each vertex's list, and the lists of faces."""
    start = np.zeros(n_vertices + 1, np.int32)
    for f in range(faces.shape[0]):
        for k in range(3):
            start[faces[f, k] + 1] += 1
    for v in range(n_vertices):
        start[v + 1] += start[v]
    fill, about = start[:-1].copy(), np.empty(3 * faces.shape[0], np.int32)
    for f in range(faces.shape[0]):
        for k in range(3):
            about[fill[faces[f, k]]] = f
            fill[faces[f, k]] += 1
    return start, about


@rounded_alike
def _flips(points, faces, start, about, remap, a, b):
    """Return whether moving vertex `a` onto `b` turns a face around `a` too far, or makes it degenerate."""
    for n in range(start[a], start[a + 1]):
        f = about[n]
        i, j, k = remap[faces[f, 0]], remap[faces[f, 1]], remap[faces[f, 2]]
        if b in (i, j, k) or i == j or j == k or k == i:
            continue
        while i != a:
            i, j, k = j, k, i
        ex, ey, ez = points[k, 0] - points[j, 0], points[k, 1] - points[j, 1], points[k, 2] - points[j, 2]
        ux, uy, uz = points[a, 0] - points[j, 0], points[a, 1] - points[j, 1], points[a, 2] - points[j, 2]
        wx, wy, wz = points[b, 0] - points[j, 0], points[b, 1] - points[j, 1], points[b, 2] - points[j, 2]
        nx, ny, nz = ey * uz - ez * uy, ez * ux - ex * uz, ex * uy - ey * ux
        mx, my, mz = ey * wz - ez * wy, ez * wx - ex * wz, ex * wy - ey * wx
        before, after = nx * nx + ny * ny + nz * nz, mx * mx + my * my + mz * mz
        # a face that is nearly a line has no stable normal
        thin = after <= MIN_SQUARED_SINE * (ex * ex + ey * ey + ez * ez) * (wx * wx + wy * wy + wz * wz)
        if before > 0.0 and (
            thin or nx * mx + ny * my + nz * mz < MIN_NORMAL_COSINE * math.sqrt(before * after)
        ):
            return True
    return False


@rounded_alike
def _pinches(faces, start, about, remap, a, b):
    """Return whether moving vertex `a` onto `b` makes one edge of two, at which more faces then meet.

    The two edges lead from `a` and from `b` to one vertex, and no face has both: the link condition of Dey,
    Edelsbrunner, Guha and Nekhayev, "Topology preserving edge contraction", 1999.
    """
    for n in range(start[a], start[a + 1]):
        i, j, k = remap[faces[about[n], 0]], remap[faces[about[n], 1]], remap[faces[about[n], 2]]
        if i == j or j == k or k == i or b in (i, j, k):
            continue
        for c in (i, j, k):
            if c == a:
                continue
            is_met, is_joined = False, False
            for m in range(start[b], start[b + 1]):
                i, j, k = remap[faces[about[m], 0]], remap[faces[about[m], 1]], remap[faces[about[m], 2]]
                if i == j or j == k or k == i or c not in (i, j, k):
                    continue
                is_met, is_joined = True, is_joined or a in (i, j, k)
            if is_met and not is_joined:
                return True
    return False


def simplify(points: np.ndarray, faces: np.ndarray, locked: np.ndarray, target: int) -> tuple:
    """Collapse edges of a mesh until `target` faces remain.

    Returns (F', 3) int32 faces over a subset of the vertices, and the largest rms distance, metres, between the end of
    a collapsed edge and the planes of the vertex it replaces.

    points : (V, 3) float64, metres
    faces : (F, 3) int32
    locked : (V,) bool, vertices that stay; they must include the vertices of open edges
    target : number of faces at which to stop; the result may have more
    """
    quadrics, remap = np.zeros((len(points), 11)), np.arange(len(points), dtype=np.int32)
    _add_quadrics(points, faces, quadrics)
    pairs, costs, worst = np.empty((3 * len(faces), 2), np.int32), np.empty(3 * len(faces)), 0.0
    for _ in range(MAX_PASSES):
        if len(faces) <= target:
            break
        count = _rate_edges(points, faces, locked, quadrics, pairs, costs)
        if count == 0:
            break
        n_needed = (len(faces) - target + 1) // 2
        place = min(n_needed, count - 1)
        limit = np.partition(costs[:count], place)[place] * PASS_SLACK + 1e-30
        cheap = np.flatnonzero(
            costs[:count] <= limit
        )  # only these are sorted, since the pass ends at the limit
        cheap = cheap[np.argsort(costs[cheap], kind="stable")]
        done, most = _collapse(pairs[cheap], costs[cheap], n_needed, points, faces, quadrics, remap)
        if done == 0:
            break
        worst, faces = max(worst, most), remap[faces]
        i, j, k = faces.T
        faces = faces[(i != j) & (j != k) & (k != i)]
    return faces, math.sqrt(worst)


@rounded_alike
def _rate_edges(points, faces, locked, quadrics, pairs, costs):
    """Write, for each edge that may be collapsed, the vertices from and to, and the cost; return how many there are.

    pairs, costs : (3 F, 2) int32 and (3 F,); overwritten
    """
    count = 0
    for f in range(faces.shape[0]):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            # an inner edge appears twice, once in each direction; use one of them
            if a > b or (locked[a] and locked[b]):
                continue
            there = np.inf if locked[a] else _cost(quadrics[a], points[b])
            back = np.inf if locked[b] else _cost(quadrics[b], points[a])
            pairs[count, 0], pairs[count, 1] = (a, b) if there <= back else (b, a)
            costs[count] = min(there, back)
            count += 1
    return count


@rounded_alike
def _collapse(pairs, costs, n_needed, points, faces, quadrics, remap):
    """Collapse edges that are independent of each other, in their order; return how many, and the largest cost.

    pairs, costs : of `_rate_edges`, by rising cost
    quadrics, remap : of the vertices that stay, and where each vertex has gone; both are updated
    """
    start, about = _neighbours(faces, points.shape[0])
    touched, done, worst = np.zeros(points.shape[0], np.bool_), 0, 0.0
    for n in range(len(costs)):
        if done >= n_needed:
            break
        a, b = pairs[n, 0], pairs[n, 1]
        if touched[a] or touched[b] or _flips(points, faces, start, about, remap, a, b):
            continue
        if _pinches(faces, start, about, remap, a, b):
            continue
        touched[a] = touched[b] = True
        remap[a] = b
        for k in range(11):  # Numba takes two seconds to compile `quadrics[b] += quadrics[a]`
            quadrics[b, k] += quadrics[a, k]
        worst = max(worst, costs[n])
        done += 1
    return done, worst
