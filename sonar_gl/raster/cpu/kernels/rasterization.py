"""Rasterise triangles: find the nearest one of each sample.

The triangles of patches are drawn into a visibility buffer with OpenGL's rules: corners are rounded to 1/256 of a
sample, and the nearest triangle wins. 1/x is linear on the image plane, so that depth, the near plane and slopes come
from one linear form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import as_table, inlined, uncounted
from sonar_gl.raster.cpu.kernels.tables import FLAT, FLAT_DIFFUSE, ROW_REFLECTIVITY, ROW_STRENGTH

GRID = 256  # steps to a sample: corners are rounded to these, as drivers do
# samples in the box about a triangle that are tried one by one; larger triangles are drawn row by row
FEW = 16
MAX_PATCH_VERTICES = 6144 + 24  # three for each of MAX_PATCH_FACES; no multiple of a page of memory
BODY_STEP = 0x9E3779B1  # odd, and far from small multiples of 2^31
# Height of a triangle, in samples, below which rounding of its corners to float32 decides its plane: 6e-8 of columns
# and rows up to some thousands.
THINNEST = 1e-4
HALF_STEP = 0.5 / GRID**2  # of what tells on which side of an edge between corners on the grid a sample lies
NO_FORM = (0.0, 0.0, 0.0)  # of a triangle that is not seen
# What lies between two samples is further from both than its corners are rounded: half a step of GRID, and what float32
# rounds of vertices.
BETWEEN = 1 / 32
ON_EDGE = 1e-6  # of a sample: rounding of the ends of rows where corners are not on the grid


class Scratch(NamedTuple):
    """Projected vertices of one patch: columns, rows, 1/x, x; columns and rows rounded to the grid, and in its steps.

    They are rows of tables of one size, so that the compiler knows their places, see `as_table`.
    """

    columns: np.ndarray
    rows: np.ndarray
    inverses: np.ndarray
    depths: np.ndarray
    rounded_columns: np.ndarray
    rounded_rows: np.ndarray
    column_steps: np.ndarray
    row_steps: np.ndarray


class RasterRoom(NamedTuple):
    """Room for a patch and one of its triangles, as what is `uncounted` makes no arrays; overwritten.

    exact, steps : (6, MAX_PATCH_VERTICES) float64 and (2, MAX_PATCH_VERTICES) int32, rows of Scratch
    m, p : (3, 4) of `_place`
    selected : (MAX_PATCH_VERTICES,) faces; a patch has a third as many
    in_column, in_row : (FEW + 1,) samples inside a triangle, of `_find_samples_inside`
    corners : (3, 3) of `_find_corners`
    cuts, ends : (8, 3) of `_fill_rows`
    """

    exact: np.ndarray
    steps: np.ndarray
    m: np.ndarray
    p: np.ndarray
    selected: np.ndarray
    in_column: np.ndarray
    in_row: np.ndarray
    corners: np.ndarray
    cuts: np.ndarray
    ends: np.ndarray


@inlined
def make_room():
    """Return room for a patch and a triangle."""
    return RasterRoom(
        np.empty((6, MAX_PATCH_VERTICES)),
        np.empty((2, MAX_PATCH_VERTICES), np.int32),
        np.empty((3, 4)),
        np.empty((3, 4)),
        np.empty(MAX_PATCH_VERTICES, np.int64),
        np.empty(FEW + 1, np.int64),
        np.empty(FEW + 1, np.int64),
        np.empty((3, 3)),
        np.empty((8, 3)),
        np.empty((8, 3)),
    )


@inlined
def _scratch_in(room):
    """Return the Scratch whose rows a RasterRoom holds."""
    exact, steps = as_table(room.exact, 6, MAX_PATCH_VERTICES), as_table(room.steps, 2, MAX_PATCH_VERTICES)
    return Scratch(exact[0], exact[1], exact[2], exact[3], exact[4], exact[5], steps[0], steps[1])


class DrawnPatch(NamedTuple):
    """What decides how the triangles of a patch are drawn.

    is_one_sided : back faces are not visible
    is_whole : neither near, far nor clip plane cuts off any of it
    is_cut : the clip plane cuts its body
    near_m, far_m : near and far plane
    plane : (4,) clip plane, of PlacedBodies
    """

    is_one_sided: bool
    is_whole: bool
    is_cut: bool
    near_m: float
    far_m: float
    plane: np.ndarray


@inlined
def _project(points, start, count, p, scratch):
    """Project a patch's vertices to columns, rows and 1/x; return the least and the greatest x.

    p : (3, 4) of column x, row x, x
    """
    columns, rows, inverses, depths, rounded_columns, rounded_rows, column_steps, row_steps = scratch
    p00, p01, p02, p03 = p[0, 0], p[0, 1], p[0, 2], p[0, 3]
    p10, p11, p12, p13 = p[1, 0], p[1, 1], p[1, 2], p[1, 3]
    p20, p21, p22, p23 = p[2, 0], p[2, 1], p[2, 2], p[2, 3]
    for w in range(uint64(count)):
        at = uint64(start) + w
        x, y, z = np.float64(points[at, 0]), np.float64(points[at, 1]), np.float64(points[at, 2])
        depth = p20 * x + p21 * y + p22 * z + p23
        inverse = 1.0 / depth
        columns[w] = (p00 * x + p01 * y + p02 * z + p03) * inverse
        rows[w] = (p10 * x + p11 * y + p12 * z + p13) * inverse
        depths[w], inverses[w] = depth, inverse
    for w in range(uint64(count)):
        column, row = math.floor(columns[w] * GRID + 0.5), math.floor(rows[w] * GRID + 0.5)
        rounded_columns[w], rounded_rows[w] = column / GRID, row / GRID
        # vertices behind the sonar may have any values; triangles that have some are not selected by these
        column_steps[w] = np.int32(min(max(column, -1e9), 1e9))
        row_steps[w] = np.int32(min(max(row, -1e9), 1e9))
    # Not in a loop above, which would not be vectorised. Two of each, as each waits for its last.
    nearest, furthest, near, far, last = np.inf, -np.inf, np.inf, -np.inf, uint64(count - 1)
    for w in range(uint64(0), uint64(count), uint64(2)):
        even, odd = depths[w], depths[min(w + uint64(1), last)]
        nearest, furthest = min(nearest, even), max(furthest, even)
        near, far = min(near, odd), max(far, odd)
    return min(nearest, near), max(furthest, far)


@inlined
def _select_faces(faces, first, count, are_in_front, scratch, window, found):
    """Select the faces with a sample of the window in the box about them; return how many.

    are_in_front : whether no vertex is nearer than the near plane; else the boxes mean nothing, and all are selected
    """
    if not are_in_front:
        for f in range(count):
            found[f] = first + f
        return count
    n, last, shift = 0, np.int32(GRID - 1), np.int32(8)  # 2 ** 8 = GRID
    column_steps, row_steps, (i0, i1, j0, j1) = scratch.column_steps, scratch.row_steps, window
    for f in range(uint64(first), uint64(first + count)):
        a, b, c = uint64(faces[f, 0]), uint64(faces[f, 1]), uint64(faces[f, 2])
        x0, x1, x2 = column_steps[a], column_steps[b], column_steps[c]
        y0, y1, y2 = row_steps[a], row_steps[b], row_steps[c]
        left, low = (min(x0, x1, x2) + last) >> shift, (min(y0, y1, y2) + last) >> shift
        end, high = max(x0, x1, x2) >> shift, max(y0, y1, y2) >> shift
        found[n] = f
        n += (left <= end) & (low <= high) & (end >= i0) & (high >= j0) & (left <= i1) & (low <= j1)
    return n


@uncounted
def _fill_rows(cuts, n_cuts, window, bottom, top, form, t, depth, triangle, ends):
    """Draw what lies within half-planes g0 + g1 column + g2 row >= 0; return how many samples were tried.

    cuts : (n_cuts, 3) of g; form : (3,) of 1/x likewise; t : row of `Triangles`
    window : first and last column, first and last row of the buffer, in the sector; bottom, top : rows of it
    ends : (8, 3) float64, overwritten
    """
    tried, (i0, i1, j0, _), (q0, q_column, q_row) = 0, window, form
    for k in range(n_cuts):
        g0, g1, g2 = cuts[k, 0], cuts[k, 1], cuts[k, 2]
        if g1 > 0.0:  # where rows begin
            ends[k, 0], ends[k, 1], ends[k, 2] = 1.0, -g2 / g1, -g0 / g1
        elif g1 < 0.0:  # where they end
            ends[k, 0], ends[k, 1], ends[k, 2] = -1.0, -g2 / g1, -g0 / g1
        else:
            ends[k, 0], ends[k, 1], ends[k, 2] = 0.0, g2, g0
    for row in range(bottom, top + 1):
        low, high, y, j = float(i0), float(i1), float(row), uint64(row - j0)
        for k in range(n_cuts):
            edge = ends[k, 2] + ends[k, 1] * y
            if ends[k, 0] > 0.0:
                low = max(low, edge)
            elif ends[k, 0] < 0.0:
                high = min(high, edge)
            elif edge < 0.0:
                high = -np.inf  # not less than low by some number: beyond 2^53 that would be low itself
        if not low <= high:
            continue
        first, last = math.ceil(low), math.floor(high)
        base = q0 + q_row * y
        for i in range(uint64(first - i0), uint64(max(last + 1, first) - i0)):
            q = np.float32(base + q_column * np.float64(np.int64(i) + i0))
            was, who = depth[j, i], triangle[j, i]
            is_nearer = q > was
            depth[j, i] = q if is_nearer else was
            triangle[j, i] = t if is_nearer else who
        tried += max(last + 1 - first, 0)
    return tried


@inlined
def _place(view, matrix, m, p):
    """Fill m, (3, 4) sector_from_body, and p, (3, 4) of column x, row x and x of a point of the body."""
    sector, _, inverse, corner, _, _, _ = view
    for i in range(3):
        for j in range(4):
            m[i, j] = 0.0
            for k in range(3):
                m[i, j] += sector[i, k] * matrix[k, j]
    for i in range(2):  # of (u, v) = (-y / x, z / x)
        offset = inverse[i, 0] * corner[0] + inverse[i, 1] * corner[1]
        for j in range(4):
            p[i, j] = -inverse[i, 0] * m[1, j] + inverse[i, 1] * m[2, j] - offset * m[0, j]
    for j in range(4):
        p[2, j] = m[0, j]


@inlined
def _is_below(box, p, axis, edge, side):
    """Return whether all of a box lies at lower columns than an edge, or rows; at higher ones if `side` is −1.

    What lies behind the sonar counts the other way round.

    p : (3, 4) of `_place`; axis : 0 for columns, 1 for rows
    """
    at, reach = 0.0, 0.0
    for k in range(4):  # of (column - edge) x
        g = side * (p[axis, k] - edge * p[2, k])
        at += g * box[k] if k < 3 else g
        reach += abs(g) * box[3 + k] if k < 3 else 0.0
    return at + reach < 0.0


@inlined
def _meets_no_sample(box, p, window):
    """Return whether a box lies beside the window, or between two columns or two rows; p : (3, 4) of `_place`.

    Between samples lie whole bodies in the coarse sectors of the side lobes: to project them would take as long as in
    the dense ones.
    """
    is_beside = False
    for end in range(4):
        side = -1.0 if (end & 1) == 1 else 1.0
        is_beside |= _is_below(box, p, end >> 1, window[end] - side, side)
    if is_beside:
        return True
    depth = p[2, 0] * box[0] + p[2, 1] * box[1] + p[2, 2] * box[2] + p[2, 3]
    is_between = False
    for axis in range(2):
        # of what is behind the sonar only one of both is true
        at = p[axis, 0] * box[0] + p[axis, 1] * box[1] + p[axis, 2] * box[2] + p[axis, 3]
        below = np.floor(at / depth)
        is_above = _is_below(box, p, axis, below + BETWEEN, -1.0)
        is_between |= is_above and _is_below(box, p, axis, below + 1.0 - BETWEEN, 1.0)
    return is_between


@inlined
def _toward(g1, g2):
    """Return half a step, negative where a sample on an edge is not of the side to which g1 column + g2 row rises."""
    return HALF_STEP if g1 > 0.0 or (g1 == 0.0 and g2 > 0.0) else -HALF_STEP


@inlined
def _are_in_front(inverses, a, b, c, near_m):
    """Return whether no corner of a triangle is nearer than the near plane."""
    qa, qb, qc = inverses[a], inverses[b], inverses[c]
    return min(qa, qb, qc) >= 0.0 and max(qa, qb, qc) <= 1.0 / near_m


@inlined
def _half_planes(ax, ay, bx, by, cx, cy, area):
    """Return (e, f, g): a sample lies inside a triangle where all of e[0] + e[1] column + e[2] row are positive.

    A sample on an edge is that of the triangle to the right of the edge, or above it, as of drivers. At samples these
    sums are whole numbers of 1 / GRID², but for half a step, so that their rounding decides nothing.
    """
    side = 1.0 if area > 0.0 else -1.0
    e1, e2 = -side * (by - ay), side * (bx - ax)
    f1, f2 = -side * (cy - by), side * (cx - bx)
    g1, g2 = -side * (ay - cy), side * (ax - cx)
    e0 = _toward(e1, e2) - e1 * ax - e2 * ay
    f0 = _toward(f1, f2) - f1 * bx - f2 * by
    g0 = _toward(g1, g2) - g1 * cx - g2 * cy
    return (e0, e1, e2), (f0, f1, f2), (g0, g1, g2)


@inlined
def _find_samples_inside(half_planes, left, right, bottom, top, in_column, in_row):
    """Find the samples of a box inside a triangle, without branches; return how many."""
    (e0, e1, e2), (f0, f1, f2), (g0, g1, g2) = half_planes
    n = 0
    for j in range(bottom, top + 1):
        y = float(j)
        ey, fy, gy = e0 + e2 * y, f0 + f2 * y, g0 + g2 * y
        for i in range(left, right + 1):
            x = float(i)
            in_column[uint64(n)], in_row[uint64(n)] = i, j
            n += min(ey + e1 * x, fy + f1 * x, gy + g1 * x) >= 0.0
    return n


@inlined
def _fit_inverse_depth(columns, rows, inverses, a, b, c):
    """Return (q0, q_column, q_row) of a triangle's 1/x, from corners before rounding, and whether it is too thin.

    The numbers of a triangle that is too thin mean nothing.
    """
    qa, qb, qc = inverses[a], inverses[b], inverses[c]
    ai, aj = columns[a], rows[a]
    bi, bj, ci, cj = columns[b] - ai, rows[b] - aj, columns[c] - ai, rows[c] - aj
    determinant = bi * cj - bj * ci
    longest2 = max(bi * bi + bj * bj, ci * ci + cj * cj, (ci - bi) ** 2 + (cj - bj) ** 2)
    is_thin = determinant * determinant <= THINNEST * THINNEST * longest2
    q_column = ((qb - qa) * cj - (qc - qa) * bj) / determinant
    q_row = (bi * (qc - qa) - ci * (qb - qa)) / determinant
    return (qa - q_column * ai - q_row * aj, q_column, q_row), is_thin


@inlined
def _draw_samples(in_column, in_row, count, window, form, t, depth, triangle):
    """Draw some samples of a triangle, row `t` of `Triangles`; return how many are nearest."""
    n_nearest, (q0, q_column, q_row) = 0, form
    for o in range(uint64(count)):
        i, j = uint64(in_column[o] - window[0]), uint64(in_row[o] - window[2])
        q = np.float32(q0 + q_column * float(in_column[o]) + q_row * float(in_row[o]))
        if q > depth[j, i]:
            depth[j, i], triangle[j, i] = q, t
            n_nearest += 1
    return n_nearest


@inlined
def _find_corners(points, at, p, near_m, corners):
    """Fill corners, (3, 3), with column x, row x and x of a triangle's vertices; return how many are too near."""
    n_behind = 0
    for o in range(3):
        w = at[o]
        x, y, z = points[w, 0], points[w, 1], points[w, 2]
        for i in range(3):
            corners[o, i] = p[i, 0] * x + p[i, 1] * y + p[i, 2] * z + p[i, 3]
        n_behind += corners[o, 2] < near_m
    return n_behind


@inlined
def _cut_by_corners(corners, cuts):
    """Fill three of `cuts` with a triangle's half-planes, whatever lies behind the sonar.

    Returns the determinant, whose sign tells the side that is seen, 0 of a triangle that is seen edge on; and (q0,
    q_column, q_row) of 1/x.
    """
    determinant = 0.0
    for o in range(3):  # the plane through the sonar and an edge
        r, s = (o + 1) % 3, (o + 2) % 3
        cuts[o, 1] = corners[r, 1] * corners[s, 2] - corners[r, 2] * corners[s, 1]
        cuts[o, 2] = corners[r, 2] * corners[s, 0] - corners[r, 0] * corners[s, 2]
        cuts[o, 0] = corners[r, 0] * corners[s, 1] - corners[r, 1] * corners[s, 0]
    for i in range(3):
        determinant += corners[0, i] * cuts[0, (i + 1) % 3]
    q0 = (cuts[0, 0] + cuts[1, 0] + cuts[2, 0]) / determinant
    q_column = (cuts[0, 1] + cuts[1, 1] + cuts[2, 1]) / determinant
    q_row = (cuts[0, 2] + cuts[1, 2] + cuts[2, 2]) / determinant
    if determinant < 0.0:
        for o in range(3):
            for i in range(3):
                cuts[o, i] = -cuts[o, i]
    return determinant, (q0, q_column, q_row)


@inlined
def _cut_by_clip_plane(plane, view, form, cuts, n):
    """Fill row n of `cuts` with the half-plane in front of the clip plane: a · (1, -u, v) + a_3 / x >= 0."""
    sector, lattice_u, lattice_v, (q0, q_column, q_row) = view[0], view[5], view[6], form
    ahead = sector[0, 0] * plane[0] + sector[0, 1] * plane[1] + sector[0, 2] * plane[2]
    port = sector[1, 0] * plane[0] + sector[1, 1] * plane[1] + sector[1, 2] * plane[2]
    up = sector[2, 0] * plane[0] + sector[2, 1] * plane[1] + sector[2, 2] * plane[2]
    cuts[n, 0] = ahead - port * lattice_u[0] + up * lattice_v[0] + plane[3] * q0
    cuts[n, 1] = -port * lattice_u[1] + up * lattice_v[1] + plane[3] * q_column
    cuts[n, 2] = -port * lattice_u[2] + up * lattice_v[2] + plane[3] * q_row


@inlined
def _write_plane(inverse, u0, v0, form, planes, n):
    """Write the slopes of 1/x and the distance of a triangle's plane into row n of `Triangles.planes`.

    u0, v0 : of the sample in column 0 and row 0; form : (q0, q_column, q_row) of 1/x
    """
    q0, q_column, q_row = form
    along_u = q_column * inverse[0, 0] + q_row * inverse[1, 0]
    along_v = q_column * inverse[0, 1] + q_row * inverse[1, 1]
    # of the plane p · x = 1, whose other parts are the slopes
    ahead = q0 - along_u * u0 - along_v * v0
    planes[n, 0], planes[n, 1] = along_u, along_v
    planes[n, 2] = 1.0 / math.sqrt(ahead * ahead + along_u * along_u + along_v * along_v)


@inlined
def _draw_rows(room, n_cuts, n_on_grid, form, patch, view, window, bottom, top, t, buffer):
    """Draw a triangle row by row, as far as the far plane and the clip plane leave it; return as `_fill_rows` does.

    room : RasterRoom, whose `cuts` are `n_cuts` half-planes, the first `n_on_grid` of them between corners on the grid
    patch, view, buffer : DrawnPatch, SectorGeometry and VisibilityBuffer
    form, window, bottom, top, t : of `_fill_rows`
    """
    cuts, (depth, triangle) = room.cuts, buffer
    if not patch.is_whole:
        cuts[n_cuts, 0], cuts[n_cuts, 1], cuts[n_cuts, 2] = form[0] - 1.0 / patch.far_m, form[1], form[2]
        n_cuts += 1
    if patch.is_cut:
        _cut_by_clip_plane(patch.plane, view, form, cuts, n_cuts)
        n_cuts += 1
    for o in range(n_on_grid, n_cuts):
        cuts[o, 0] += ON_EDGE * abs(cuts[o, 1])
    return _fill_rows(cuts, n_cuts, window, bottom, top, form, np.int32(t), depth, triangle, room.ends)


@inlined
def _draw_in_front(scratch, a, b, c, patch, view, window, t, buffer, room):
    """Draw a triangle of which no corner is nearer than the near plane, by its corners on the grid.

    Returns whether any sample may show it, and (q0, q_column, q_row) of its 1/x, if it is seen.

    scratch, patch, view, buffer, room : Scratch, DrawnPatch, SectorGeometry, VisibilityBuffer and RasterRoom
    a, b, c : corners, places in `scratch`
    t : row of `Triangles`
    """
    ax, ay = scratch.rounded_columns[a], scratch.rounded_rows[a]
    bx, by = scratch.rounded_columns[b], scratch.rounded_rows[b]
    cx, cy = scratch.rounded_columns[c], scratch.rounded_rows[c]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area == 0.0 or (patch.is_one_sided and area < 0.0):
        return False, NO_FORM
    left = math.ceil(max(min(ax, bx, cx), float(window[0])))
    right = math.floor(min(max(ax, bx, cx), float(window[1])))
    bottom = math.ceil(max(min(ay, by, cy), float(window[2])))
    top = math.floor(min(max(ay, by, cy), float(window[3])))
    if left > right or bottom > top:
        return False, NO_FORM
    half_planes = _half_planes(ax, ay, bx, by, cx, cy, area)
    is_small = patch.is_whole and (right - left + 1) * (top - bottom + 1) <= FEW
    n_inside = 0
    if is_small:
        n_inside = _find_samples_inside(half_planes, left, right, bottom, top, room.in_column, room.in_row)
        if n_inside == 0:
            return False, NO_FORM
    form, is_thin = _fit_inverse_depth(scratch.columns, scratch.rows, scratch.inverses, a, b, c)
    if is_thin:
        return False, form
    depth, triangle = buffer
    if is_small:
        n_nearest = _draw_samples(room.in_column, room.in_row, n_inside, window, form, t, depth, triangle)
        return n_nearest > 0, form
    for o in range(3):
        room.cuts[o, 0], room.cuts[o, 1], room.cuts[o, 2] = half_planes[o]
    n_tried = _draw_rows(room, 3, 3, form, patch, view, window, bottom, top, t, buffer)
    return n_tried > 0, form


@inlined
def _draw_across_near_plane(points, at, p, patch, view, window, t, buffer, room):
    """Draw a triangle with a corner before the near plane, or behind the sonar; return as `_draw_in_front` does.

    points, at : vertices of all patches, and which of them are the corners
    p : of `_project`
    """
    if _find_corners(points, at, p, patch.near_m, room.corners) == 3:
        return False, NO_FORM
    determinant, form = _cut_by_corners(room.corners, room.cuts)
    if determinant == 0.0 or (patch.is_one_sided and determinant < 0.0):
        return False, form
    room.cuts[3, 0], room.cuts[3, 1], room.cuts[3, 2] = 1.0 / patch.near_m - form[0], -form[1], -form[2]
    n_tried = _draw_rows(room, 4, 0, form, patch, view, window, window[2], window[3], t, buffer)
    return n_tried > 0, form


@inlined
def _write_triangle(form, view, vertices, start, f, faces, body, body_rows, triangles, n, room):
    """Write a triangle into row n of `triangles`: face `f` of a patch whose vertices begin at `start`."""
    (planes, bodies, normal_forms), (points, normals, reflectivity) = triangles, vertices
    _write_plane(view[2], view[5][0], view[6][0], form, planes, n)
    planes[n, 3] = body_rows[body, ROW_REFLECTIVITY]
    if reflectivity.shape[0]:
        planes[n, 3] *= reflectivity[uint64(start) + uint64(faces[f, 0])]
    # the same whichever window is drawn; that two neighbours share it by chance is one case in 2^31
    bodies[n, 2] = np.int32((np.int64(f) + np.int64(body) * BODY_STEP) & 0x7FFFFFFF)
    has_lobe = body_rows[body, ROW_STRENGTH] > np.float32(0.0)
    bodies[n, 0], bodies[n, 1] = body, FLAT if has_lobe else FLAT_DIFFUSE
    if normal_forms.shape[0] > 0 and _has_normals(normals, start, f, faces):
        bodies[n, 1] = n
        _fit_normals(normals, start, f, faces, points, room.m, room.p, room.corners, normal_forms[n])


@uncounted
def rasterize(chosen, patches, vertices, placed, view, window, limits, buffer, triangles, room):
    """Draw the triangles of some patches into a visibility buffer.

    Returns how many triangles were drawn.

    chosen : (K, 2) patch and body, of `choose_patches`; `triangles` must have room for all of their faces
    patches, vertices, placed, view, buffer, triangles, room : tuples of PatchFaces, Vertices, PlacedBodies,
        SectorGeometry, VisibilityBuffer and Triangles, and RasterRoom
    window : first and last column, first and last row of the buffer, in the sector
    limits : (2,) near and far plane, metres
    """
    first_vertex, n_vertices, first_face, n_faces, faces, boxes = patches
    matrices, body_rows, is_cut, closed, outside, plane = placed
    (depth, _), points = buffer, vertices[0]
    near_m, far_m = limits[0], limits[1]
    scratch, m, p, selected = _scratch_in(room), room.m, room.p, room.selected
    for j in range(uint64(depth.shape[0])):
        for i in range(uint64(depth.shape[1])):
            depth[j, i] = 0.0
    n, last = 0, -1
    for k in range(chosen.shape[0]):
        patch, body = chosen[k, 0], chosen[k, 1]
        if body != last:
            last = body
            _place(view, matrices[body], m, p)
        if _meets_no_sample(boxes[patch], p, window):
            continue
        start = first_vertex[patch]
        nearest, furthest = _project(points, start, n_vertices[patch], p, scratch)
        n_selected = _select_faces(
            faces, first_face[patch], n_faces[patch], nearest >= near_m, scratch, window, selected
        )
        is_whole = nearest >= near_m and furthest <= far_m and not is_cut[body]
        drawn = DrawnPatch(outside and closed[body] != 0, is_whole, is_cut[body], near_m, far_m, plane)
        for number in range(uint64(n_selected)):
            f = uint64(selected[number])
            a, b, c = uint64(faces[f, 0]), uint64(faces[f, 1]), uint64(faces[f, 2])
            if is_whole or _are_in_front(scratch.inverses, a, b, c, near_m):
                is_seen, form = _draw_in_front(scratch, a, b, c, drawn, view, window, n, buffer, room)
            else:
                at = uint64(start) + a, uint64(start) + b, uint64(start) + c
                is_seen, form = _draw_across_near_plane(points, at, p, drawn, view, window, n, buffer, room)
            if is_seen:
                _write_triangle(form, view, vertices, start, f, faces, body, body_rows, triangles, n, room)
                n += 1
    return n


@inlined
def _has_normals(normals, start, f, faces):
    """Return whether a corner of a face has a normal: as soon as one mesh has some, those of others are zero."""
    largest = np.float32(0.0)
    for o in range(3):
        corner = uint64(start) + faces[f, o]
        for axis in range(3):
            largest = max(largest, abs(normals[corner, axis]))
    return largest > np.float32(0.0)


@inlined
def _fit_normals(normals, start, f, faces, points, m, p, h, out):
    """Fill out, (9,), with the normal over x, turned to the sector's frame, as a linear form of column and row.

    A normal over x is linear over the image, as 1/x is: barycentric coordinates of a point are linear in the point's
    (column x, row x, x).

    h : (3, 3), overwritten
    """
    a, b, c = uint64(start) + faces[f, 0], uint64(start) + faces[f, 1], uint64(start) + faces[f, 2]
    _find_corners(points, (a, b, c), p, 0.0, h)
    # rows of the inverse of h, which give w over x at (column, row, 1)
    c0x, c0y = h[1, 1] * h[2, 2] - h[1, 2] * h[2, 1], h[1, 2] * h[2, 0] - h[1, 0] * h[2, 2]
    c0z = h[1, 0] * h[2, 1] - h[1, 1] * h[2, 0]
    c1x, c1y = h[2, 1] * h[0, 2] - h[2, 2] * h[0, 1], h[2, 2] * h[0, 0] - h[2, 0] * h[0, 2]
    c1z = h[2, 0] * h[0, 1] - h[2, 1] * h[0, 0]
    c2x, c2y = h[0, 1] * h[1, 2] - h[0, 2] * h[1, 1], h[0, 2] * h[1, 0] - h[0, 0] * h[1, 2]
    c2z = h[0, 0] * h[1, 1] - h[0, 1] * h[1, 0]
    over = 1.0 / (h[0, 0] * c0x + h[0, 1] * c0y + h[0, 2] * c0z)
    for axis in range(3):
        na = m[axis, 0] * normals[a, 0] + m[axis, 1] * normals[a, 1] + m[axis, 2] * normals[a, 2]
        nb = m[axis, 0] * normals[b, 0] + m[axis, 1] * normals[b, 1] + m[axis, 2] * normals[b, 2]
        nc = m[axis, 0] * normals[c, 0] + m[axis, 1] * normals[c, 1] + m[axis, 2] * normals[c, 2]
        out[3 * axis] = (na * c0z + nb * c1z + nc * c2z) * over
        out[3 * axis + 1] = (na * c0x + nb * c1x + nc * c2x) * over
        out[3 * axis + 2] = (na * c0y + nb * c1y + nc * c2y) * over
