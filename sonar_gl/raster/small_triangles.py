"""Rasterise small triangles in software, and pass the large ones on to the driver.

A software driver spends ten times as much on a triangle as it takes to find the few samples in it. So it gets
the large triangles only, as renderers of microscopic triangles on graphics cards do, too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.core.compiled import compiled

ROUNDING = 5e-7  # of a vertex's position, relative to the distance of its body
MAX_SAMPLES = 48  # in the box about a triangle that is rasterised here
GRID = 256  # steps to a sample: the driver snaps corners to these


class PatchFaces(NamedTuple):
    """Faces of all patches: fields of `Levels`."""

    first_vertex: np.ndarray
    n_vertices: np.ndarray
    first_face: np.ndarray
    n_faces: np.ndarray
    faces: np.ndarray


class Vertices(NamedTuple):
    """Vertices of all patches: (W, 3) float32 positions; (W, 3) normals and (W,) reflectivity, or of no
    length.
    """

    points: np.ndarray
    normals: np.ndarray
    reflectivity: np.ndarray


class PlacedBodies(NamedTuple):
    """Bodies as seen from one pose.

    matrices : (n, 3, 4) sonar_from_body
    rows : (n, 16), of which 12 is the reflectivity, 14 and 15 strength and slope of the specular lobe
    is_cut : (n,) bool, bodies that a clip plane cuts: the driver draws all of their triangles
    closed : (n,) 0 for open meshes
    outside : back faces of closed bodies are not visible
    """

    matrices: np.ndarray
    rows: np.ndarray
    is_cut: np.ndarray
    closed: np.ndarray
    outside: bool


class SampleList(NamedTuple):
    """Samples that were rasterised here, as the shader would write them; overwritten.

    places : (P, 2) int32 columns and rows; values : (P, 4) float32; bodies : (P,) uint16
    """

    places: np.ndarray
    values: np.ndarray
    bodies: np.ndarray


class DrawnTriangles(NamedTuple):
    """The triangles that are left to the driver; overwritten.

    draws : (M, 5) uint32, as of `draw_patches`, one a body; room for those of all patches
    indices : (n,) uint32 of vertices; room for those of all patches
    first_index : where `indices` stands in the index buffer
    first_row : of the table of bodies, where this pose's begin
    """

    draws: np.ndarray
    indices: np.ndarray
    first_index: int
    first_row: int


class Corners(NamedTuple):
    """Columns (i) and rows (j) of a triangle's corners a, b and c, in samples."""

    ai: float
    aj: float
    bi: float
    bj: float
    ci: float
    cj: float


class Box(NamedTuple):
    """The samples about a triangle: first and last column, first and last row."""

    left: int
    right: int
    bottom: int
    top: int


class Face(NamedTuple):
    """A face of a patch: numbers of its vertices a, b and c in the patch, which begin at `start` among all."""

    a: int
    b: int
    c: int
    start: int


@compiled
def _project(points, start, count, p, columns, rows, depths):
    """Project a patch's vertices to columns, rows and depths; return the least depth.

    p : (3, 4) of column x, row x, x
    """
    p00, p01, p02, p03 = p[0, 0], p[0, 1], p[0, 2], p[0, 3]
    p10, p11, p12, p13 = p[1, 0], p[1, 1], p[1, 2], p[1, 3]
    p20, p21, p22, p23 = p[2, 0], p[2, 1], p[2, 2], p[2, 3]
    nearest = np.inf
    for w in range(count):
        x, y, z = points[start + w, 0], points[start + w, 1], points[start + w, 2]
        depth = p20 * x + p21 * y + p22 * z + p23
        inverse = 1.0 / depth
        columns[w] = (p00 * x + p01 * y + p02 * z + p03) * inverse
        rows[w] = (p10 * x + p11 * y + p12 * z + p13) * inverse
        depths[w] = depth
        nearest = min(nearest, depth)
    return nearest


@compiled
def _candidates(faces, first, count, cell_column, cell_row, found):
    """Find faces that do not lie between two columns of samples, or two rows; return how many."""
    n = 0
    for f in range(first, first + count):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        column, row = cell_column[a], cell_row[a]
        beside = (column ^ cell_column[b]) | (column ^ cell_column[c])
        above = (row ^ cell_row[b]) | (row ^ cell_row[c])
        found[n] = f
        n += (beside != 0) & (above != 0)
    return n


@compiled
def _snap(at):
    return math.floor(at * GRID + 0.5) / GRID


@compiled
def _fill(corners, box, n, places):
    """Write the samples of a triangle after the n that there are; return how many there are then."""
    ai, aj, bi, bj, ci, cj = corners
    # to the driver's grid, so that no sample falls between this triangle and one that is drawn
    ai, aj, bi, bj, ci, cj = _snap(ai), _snap(aj), _snap(bi), _snap(bj), _snap(ci), _snap(cj)
    ui, uj, vi, vj, wi, wj = bi - ai, bj - aj, ci - bi, cj - bj, ai - ci, aj - cj
    side = 1.0 if ui * vj - uj * vi >= 0.0 else -1.0
    for j in range(box.bottom, box.top + 1):
        for i in range(box.left, box.right + 1):
            places[n, 0], places[n, 1] = i, j
            first = side * (ui * (j - aj) - uj * (i - ai))
            second = side * (vi * (j - bj) - vj * (i - bi))
            third = side * (wi * (j - cj) - wj * (i - ci))
            n += min(first, second, third) >= 0.0
    return n


@compiled
def _shade(first, last, places, values, face, corners, depths, normals, mu, u, v, turn):
    """Compute the echo of a triangle's samples by the shading normals at its corners, where it has any.

    face, corners : Face and Corners
    depths : of the patch's vertices; normals : of all
    turn : (3, 3) body_from_sector
    """
    a, b, c, start = face
    ai, aj, bi, bj, ci, cj = corners
    for s in range(first, last):
        i, j, q, along, up = places[s, 0], places[s, 1], values[s, 0], values[s, 1], values[s, 2]
        # barycentric coordinates on the image, and from these on the face
        wa = ((bi - i) * (cj - j) - (bj - j) * (ci - i)) / depths[a]
        wb = ((ci - i) * (aj - j) - (cj - j) * (ai - i)) / depths[b]
        wc = ((ai - i) * (bj - j) - (aj - j) * (bi - i)) / depths[c]
        at_u, at_v = u[0] + u[1] * i + u[2] * j, v[0] + v[1] * i + v[2] * j
        squares = toward = echo = 0.0
        for k in range(3):
            m = wa * normals[start + a, k] + wb * normals[start + b, k] + wc * normals[start + c, k]
            squares += m * m
            # p . x = 1: minus the plane looks at the sonar
            toward -= m * (turn[k, 0] * (q - along * at_u - up * at_v) - turn[k, 1] * along + turn[k, 2] * up)
            echo -= m * (turn[k, 0] - turn[k, 1] * at_u + turn[k, 2] * at_v)
        total = abs(wa) + abs(wb) + abs(wc)
        if squares > 1e-6 * total * total:
            echo = echo if toward > 0.0 else -echo
            values[s, 3] = mu * max(echo, 0.0) / (math.sqrt(squares) * q)


@compiled
def add_lobe(first, last, places, values, mu, strength, slope, u, v):
    """Turn cos θ of a triangle's samples into μ cos θ and the specular lobe; see `specular_lobe`."""
    for s in range(first, last):
        at_u = u[0] + u[1] * places[s, 0] + u[2] * places[s, 1]
        at_v = v[0] + v[1] * places[s, 0] + v[2] * places[s, 1]
        range_m = math.sqrt(1.0 + at_u * at_u + at_v * at_v) / values[s, 0]
        c = min(max(values[s, 3] / range_m, 1e-3), 1.0)
        square, s2 = c * c, slope * slope
        lobe = strength * math.exp(-0.5 * (1.0 - square) / (square * s2)) / (8.0 * s2 * square * square * c)
        values[s, 3] = mu * values[s, 3] + lobe * range_m


@compiled
def rasterize_small_triangles(chosen, patches, vertices, placed, view, near_m, drawn, samples):
    """Rasterise the small triangles of some patches, and list those of the others that meet a sample as
    draws.

    Parameters
    ----------
    chosen : (K, 2) patch and body, of `choose_patches`, or a part of it
    patches, vertices, placed, view, drawn, samples : tuples of PatchFaces, Vertices, PlacedBodies,
        SectorGeometry, DrawnTriangles and SampleList. Where the room for samples does not suffice, triangles
        are drawn

    Returns
    -------
    n_closed, n_draws, n_indices, n_samples : the first of the draws are those of closed bodies
    """
    first_vertex, n_vertices, first_face, n_faces, faces = patches
    points, normals, reflectivity = vertices
    matrices, body_rows, cut, closed, outside = placed
    sector, _, inverse, corner, size, u, v = view
    draws, indices, first_index, first_row = drawn
    places, values, bodies = samples
    n, n_closed, used, last, filled = 0, 0, 0, -1, 0
    one, lobe = np.float32(1.0), np.float32(0.0)
    m, p, to_body = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 3))
    columns, rows, depths = np.empty(0), np.empty(0), np.empty(0)
    cell_column, cell_row = np.empty(0, np.int32), np.empty(0, np.int32)
    candidates = np.empty(0, np.int64)
    smooth = normals.shape[0] > 0
    scale = max(abs(inverse[0, 0]), abs(inverse[0, 1]), abs(inverse[1, 0]), abs(inverse[1, 1]))
    for k in range(chosen.shape[0]):
        patch, body = chosen[k, 0], chosen[k, 1]
        if body != last:
            last = body
            for i in range(3):
                for j in range(4):
                    m[i, j] = 0.0
                    for o in range(3):
                        m[i, j] += sector[i, o] * matrices[body, o, j]
            for j in range(4):  # column x and row x, of (u, v) = (-y / x, z / x)
                for i in range(2):
                    offset = inverse[i, 0] * corner[0] + inverse[i, 1] * corner[1]
                    p[i, j] = -inverse[i, 0] * m[1, j] + inverse[i, 1] * m[2, j] - offset * m[0, j]
                p[2, j] = m[0, j]
                for i in range(3):
                    if j < 3:
                        to_body[j, i] = m[i, j]
            lobe = body_rows[body, 14]
            offset = abs(m[0, 3]) + abs(m[1, 3]) + abs(m[2, 3])
            if n and draws[n - 1, 0] == 0:  # no triangle of the body before is drawn
                n -= 1
                n_closed = min(n_closed, n)
            draws[n, 0], draws[n, 1], draws[n, 2] = 0, 1, first_index + used
            draws[n, 3], draws[n, 4] = 0, first_row + body
            n += 1
            n_closed += closed[body] != 0
        start, count = first_vertex[patch], n_vertices[patch]
        if columns.shape[0] < count:
            columns, rows, depths = np.empty(count), np.empty(count), np.empty(count)
            cell_column, cell_row = np.empty(count, np.int32), np.empty(count, np.int32)
        nearest = _project(points, start, count, p, columns, rows, depths)
        begin, n_candidates = first_face[patch], n_faces[patch]
        if candidates.shape[0] < n_candidates + 1:
            candidates = np.empty(n_candidates + 1, np.int64)
        if nearest >= near_m:
            for w in range(count):
                cell_column[w], cell_row[w] = np.int32(np.floor(columns[w])), np.int32(np.floor(rows[w]))
            n_candidates = _candidates(faces, begin, n_candidates, cell_column, cell_row, candidates)
        else:  # columns and rows may exceed all bounds
            for f in range(n_candidates):
                candidates[f] = begin + f
        # by how much the driver's float32 and its grid may move a corner
        margin = 1 / GRID + ROUNDING * offset * scale / max(nearest, near_m)
        turned = outside and closed[body] != 0
        low = used
        for candidate in range(n_candidates):
            f = candidates[candidate]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            if nearest >= near_m or min(depths[a], depths[b], depths[c]) >= near_m:
                ai, aj, bi, bj, ci, cj = columns[a], rows[a], columns[b], rows[b], columns[c], rows[c]
                if turned and (bi - ai) * (cj - aj) - (bj - aj) * (ci - ai) < -margin * margin:
                    continue
                left = math.ceil(max(min(ai, bi, ci) - margin, 0.0))
                right = math.floor(min(max(ai, bi, ci) + margin, size[0] - 1.0))
                if left > right:
                    continue
                bottom = math.ceil(max(min(aj, bj, cj) - margin, 0.0))
                top = math.floor(min(max(aj, bj, cj) + margin, size[1] - 1.0))
                if bottom > top:
                    continue
                count = (right - left + 1) * (top - bottom + 1)
                if count <= MAX_SAMPLES and filled + count <= places.shape[0] and not cut[body]:
                    corners = Corners(ai, aj, bi, bj, ci, cj)
                    more = _fill(corners, Box(left, right, bottom, top), filled, places)
                    if more == filled:
                        continue
                    # 1/x is linear in column and row
                    qa, qb, qc = 1.0 / depths[a], 1.0 / depths[b], 1.0 / depths[c]
                    area = (bi - ai) * (cj - aj) - (bj - aj) * (ci - ai)
                    if area == 0.0:
                        continue
                    by_column = ((qb - qa) * (cj - aj) - (qc - qa) * (bj - aj)) / area
                    by_row = ((bi - ai) * (qc - qa) - (ci - ai) * (qb - qa)) / area
                    along = by_column * inverse[0, 0] + by_row * inverse[1, 0]
                    up = by_column * inverse[0, 1] + by_row * inverse[1, 1]
                    at_u, at_v = u[0] + u[1] * ai + u[2] * aj, v[0] + v[1] * ai + v[2] * aj
                    ahead = qa - along * at_u - up * at_v
                    mu = body_rows[body, 12] * (reflectivity[start + a] if reflectivity.shape[0] else one)
                    weight = one if lobe > 0.0 else mu
                    echo = weight / math.sqrt(ahead * ahead + along * along + up * up)
                    for s in range(filled, more):
                        values[s, 0] = qa + by_column * (places[s, 0] - ai) + by_row * (places[s, 1] - aj)
                        values[s, 1], values[s, 2], values[s, 3] = along, up, echo
                        bodies[s] = body + 1
                    if smooth:
                        face = Face(a, b, c, start)
                        _shade(
                            filled, more, places, values, face, corners, depths, normals, weight, u, v,
                            to_body,
                        )  # fmt: skip
                    if lobe > 0.0:
                        add_lobe(filled, more, places, values, mu, lobe, body_rows[body, 15], u, v)
                    filled = more
                    continue
            elif max(depths[a], depths[b], depths[c]) < near_m:
                continue
            indices[used], indices[used + 1], indices[used + 2] = start + a, start + b, start + c
            used += 3
        draws[n - 1, 0] += used - low
    if n and draws[n - 1, 0] == 0:
        n -= 1
        n_closed = min(n_closed, n)
    return n_closed, n, used, filled


@compiled
def merge_samples(samples, first_column, first_row, left, plane_echo, body_id):
    """Write samples into an image that was drawn, where they are nearer.

    Parameters
    ----------
    samples : tuple of SampleList
    first_column, first_row : of the sector's window; left : where it lies in the image
    plane_echo, body_id : (H, W, 4) and (H, W) of all windows; body_id of no length if it is not wanted
    """
    places, values, bodies = samples
    for s in range(places.shape[0]):
        i, j = places[s, 0] - first_column + left, places[s, 1] - first_row
        if values[s, 0] > plane_echo[j, i, 0]:
            for k in range(4):
                plane_echo[j, i, k] = values[s, k]
            if body_id.shape[0]:
                body_id[j, i] = bodies[s]
