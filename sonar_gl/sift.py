"""Of some patches the triangles that meet a sample: small ones are filled in here, the others drawn.

What a software driver spends on a triangle is ten times what it takes to find the samples in it, where these
are few. So it gets the large ones alone, as renderers of microscopic triangles do on graphics cards, too.
"""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.compiled import compiled

ROUNDING = 5e-7  # of a vertex's place, of the distance of its body
MOST_SAMPLES = 48  # in the box about a triangle that is filled in here
GRID = 256  # to a sample: the driver moves corners to whole ones


@compiled
def _project(points, start, count, p, columns, rows, depths):
    """Columns, rows, depths of a patch's vertices; the least depth. p : (3, 4) of column x, row x, x."""
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
    """Faces that do not lie between two columns of samples, or two rows: their numbers, how many."""
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
def _fill(left, right, bottom, top, ai, aj, bi, bj, ci, cj, n, places):
    """Write the samples of a triangle, by columns and rows of its corners; how many there are then."""
    # to the driver's grid, so that no sample falls between this triangle and one that is drawn
    ai, aj, bi, bj, ci, cj = _snap(ai), _snap(aj), _snap(bi), _snap(bj), _snap(ci), _snap(cj)
    ui, uj, vi, vj, wi, wj = bi - ai, bj - aj, ci - bi, cj - bj, ai - ci, aj - cj
    side = 1.0 if ui * vj - uj * vi >= 0.0 else -1.0
    for j in range(bottom, top + 1):
        for i in range(left, right + 1):
            places[n, 0], places[n, 1] = i, j
            first = side * (ui * (j - aj) - uj * (i - ai))
            second = side * (vi * (j - bj) - vj * (i - bi))
            third = side * (wi * (j - cj) - wj * (i - ci))
            n += min(first, second, third) >= 0.0
    return n


@compiled
def _shade(first, last, places, values, columns, rows, depths, a, b, c, normals, start, mu, u, v, turn):
    """Echo of a triangle's samples by the normals at its corners a, b, c, where these have any.

    turn : (3, 3) body_from_sector
    """
    ai, aj, bi, bj, ci, cj = columns[a], rows[a], columns[b], rows[b], columns[c], rows[c]
    for s in range(first, last):
        i, j, q, along, up = places[s, 0], places[s, 1], values[s, 0], values[s, 1], values[s, 2]
        # barycentric coordinates on the picture, and from these on the face
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
def _shine(first, last, places, values, mu, strength, slope, u, v):
    """μ cos θ and the lobe of a triangle's samples, whose echo is cos θ so far; see `specular_lobe`."""
    for s in range(first, last):
        at_u = u[0] + u[1] * places[s, 0] + u[2] * places[s, 1]
        at_v = v[0] + v[1] * places[s, 0] + v[2] * places[s, 1]
        range_m = math.sqrt(1.0 + at_u * at_u + at_v * at_v) / values[s, 0]
        c = min(max(values[s, 3] / range_m, 1e-3), 1.0)
        square, s2 = c * c, slope * slope
        lobe = strength * math.exp(-0.5 * (1.0 - square) / (square * s2)) / (8.0 * s2 * square * square * c)
        values[s, 3] = mu * values[s, 3] + lobe * range_m


@compiled
def sift_patches(
    chosen, first_vertex, n_vertices, first_face, n_faces, points, normals, reflectivity, faces,
    matrices, body_rows, cut, closed, sector, inverse, corner, size, near_m, outside, row, first_index,
    indices, draws, u, v, places, values, bodies,
):  # fmt: skip
    """Of some patches the triangles that meet a sample: small ones as samples, the others as draws.

    Parameters
    ----------
    chosen : (K, 2) of `see`, or a part of it
    first_vertex .. faces : of all meshes' `detail.Levels`; points : (W, 3) float32 of their vertices
    normals, reflectivity : (W, 3) and (W,) float32 of these, or of no length
    body_rows : (n, 16), of which 12 is the reflectivity, 14 and 15 strength and slope of the lobe
    cut : (n,) bool, bodies of which nothing is filled in, for the driver is to leave a part of them out
    matrices, closed, sector, inverse, corner, near_m, outside : as for `see`
    size : columns and rows of the sector's lattice
    row : of the table of bodies, where this pose's begin
    first_index : where `indices` stands in the index buffer
    indices, draws : uint32; (M, 5) uint32, as of `draw_patches`, one a body; overwritten
    u, v : of the lattice
    places, values, bodies : (P, 2) int32 columns and rows, (P, 4) float32 and (P,) uint16 of samples, as the
        shader would write them; overwritten. Where they do not suffice triangles are drawn

    Returns
    -------
    n_closed, n_draws, n_indices, n_samples : the first of the draws are those of closed bodies
    """
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
            if n and draws[n - 1, 0] == 0:  # nothing of the body before is drawn
                n -= 1
                n_closed = min(n_closed, n)
            draws[n, 0], draws[n, 1], draws[n, 2] = 0, 1, first_index + used
            draws[n, 3], draws[n, 4] = 0, row + body
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
        else:  # columns and rows may be out of all bounds
            for f in range(n_candidates):
                candidates[f] = begin + f
        # what the driver's float32 and its grid may do
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
                if count <= MOST_SAMPLES and filled + count <= places.shape[0] and not cut[body]:
                    more = _fill(left, right, bottom, top, ai, aj, bi, bj, ci, cj, filled, places)
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
                        _shade(
                            filled, more, places, values, columns, rows, depths, a, b, c, normals, start,
                            weight, u, v, to_body,
                        )  # fmt: skip
                    if lobe > 0.0:
                        _shine(filled, more, places, values, mu, lobe, body_rows[body, 15], u, v)
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
