"""Choose what a sector draws of a scene: patches as coarse as its samples allow, and the window about them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.core.compiled import compiled, inlined

BEYOND = 60.0  # what lies wholly beyond the last bin may have so many times more geometric error
MARGIN = 2  # samples about what is visible, so that the outermost of a window meet nothing

PER_BODY = 16  # floats: the rows of sonar_from_body, reflectivity, number, strength and slope of the lobe
REFLECTIVITY, LOBE = 12, 14  # of these; LOBE is the strength


class BodyBoxes(NamedTuple):
    """The n bodies of a scene, which do not change while they move.

    centres, bounds : (n, 3) and (n, 2, 3) of the meshes; bounds count from the centres
    extremes : (n, EXTREMES, 3) vertices, of `extreme_points`, counted likewise
    spheres : (n, 2) of `radii_about`
    closed : (n,) 0 for open meshes
    roots : (n, 2) first patch of each body and the one after its last
    order : (n,) bodies, closed ones first
    """

    centres: np.ndarray
    bounds: np.ndarray
    extremes: np.ndarray
    spheres: np.ndarray
    closed: np.ndarray
    roots: np.ndarray
    order: np.ndarray


class PatchTree(NamedTuple):
    """Patches of all meshes, one after the other, to choose among: fields of `Levels`."""

    skip: np.ndarray
    leaf: np.ndarray
    error_m: np.ndarray
    box: np.ndarray
    cone: np.ndarray
    moment: np.ndarray
    whole: np.ndarray
    n_faces: np.ndarray


class SectorGeometry(NamedTuple):
    """Where a sector looks.

    rotation : (3, 3) sector_from_sonar
    limits : low and high u, low and high v of its lattice
    inverse, corner : (2, 2) samples per (u, v), and (u, v) of its first sample
    size : columns and rows
    u, v : (3,) each, of its lattice
    """

    rotation: np.ndarray
    limits: np.ndarray
    inverse: np.ndarray
    corner: np.ndarray
    size: np.ndarray
    u: np.ndarray
    v: np.ndarray


class DetailLimits(NamedTuple):
    """How coarse a patch may be.

    near_m, far_m : nearer is cut, further is not drawn
    range_max_m : end of the last bin
    error_per_m : geometric error of a patch, per metre of range
    echo_error : relative error of its echo; of a body with a specular lobe none
    """

    near_m: float
    far_m: float
    range_max_m: float
    error_per_m: float
    echo_error: float


# The square of a scale that differs from 1 by no more is that of rotations, as rounded: of `sonar_gl.core.poses`, whose
# constants these functions must not read.
UNSCALED = 1e-5
# Distance of the near plane's furthest corner over that of the plane: at most 13.2, tan 85 deg / cos 30 deg up at the
# side of the widest sector.
CORNER = 14


@inlined
def _square_of_scale(m):
    """Return the square of the scale of a (3, 4) matrix, exactly 1 of one that only turns and moves."""
    square = m[0, 0] * m[0, 0] + m[1, 0] * m[1, 0] + m[2, 0] * m[2, 0]
    return 1.0 if abs(square - 1.0) <= UNSCALED else square


@compiled
def place_bodies(poses, present, bodies, pose, near_m, matrices, table):
    """Compute the poses of bodies relative to the sonar, in float64 before they are rounded.

    Returns whether back faces may be culled: the sonar is in the box of no closed body.

    poses : (n, 4, 4) world_from_body; present : (n,) bool
    bodies : tuple of BodyBoxes
    pose : (4, 4) world_from_sonar
    matrices : (n, 3, 4) sonar_from_body about the centre, overwritten; table : (n, PER_BODY), the same in float32, in
        the first 12 of its columns
    """
    centres, bounds, _, _, closed, _, _ = bodies
    outside = True
    for n in range(poses.shape[0]):
        if not present[n]:
            continue
        m = matrices[n]
        for i in range(3):
            moved = 0.0
            for k in range(3):
                moved += pose[k, i] * (poses[n, k, 3] - pose[k, 3])
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += pose[k, i] * poses[n, k, j]
                m[i, j] = total
                moved += total * centres[n, j]
            m[i, 3] = moved
            for j in range(4):
                table[n, 4 * i + j] = m[i, j]
        if closed[n] != 0:
            inside, square = True, _square_of_scale(m)
            near = CORNER * near_m / math.sqrt(square)
            for j in range(3):
                sonar = -(m[0, j] * m[0, 3] + m[1, j] * m[1, 3] + m[2, j] * m[2, 3]) / square
                inside &= bounds[n, 0, j] - near < sonar < bounds[n, 1, j] + near
            if inside:
                outside = False
    return outside


def body_spans(
    matrices: np.ndarray, bounds: np.ndarray, extremes: np.ndarray, spheres: np.ndarray, near_m: float
) -> np.ndarray:
    """Return `body_spans` of `ViewSamples`: 1/range of the furthest place of each body, and of the nearest of its box.

    What a sphere within the body hides does not count: of a ball, all behind its outline. Where the sonar is in the box
    of a closed body it sees its back faces, and all counts.

    matrices, near_m : of `place_bodies`
    bounds, extremes, spheres : of BodyBoxes, the last one zeros where a body is cut open
    """
    out = np.empty((len(matrices) + 1, 2))
    _find_body_spans(matrices, bounds, extremes, spheres, near_m, out)
    return out


@compiled
def _find_body_spans(matrices, bounds, extremes, spheres, near_m, out):
    """Fill `out` with what `body_spans` returns."""
    out[0, 0], out[0, 1] = 0.0, np.inf
    sonar = np.empty(3)  # in the body's frame
    for n in range(matrices.shape[0]):
        m, near2, far2 = matrices[n], 0.0, 0.0
        square = _square_of_scale(m)
        scale = math.sqrt(square)
        for j in range(3):
            sonar[j] = -(m[0, j] * m[0, 3] + m[1, j] * m[1, 3] + m[2, j] * m[2, 3]) / square
            near2 += max(bounds[n, 0, j] - sonar[j], sonar[j] - bounds[n, 1, j], 0.0) ** 2
        for k in range(extremes.shape[1]):
            apart2 = 0.0
            for j in range(3):
                apart2 += (extremes[n, k, j] - sonar[j]) ** 2
            far2 = max(far2, apart2)
        inner2, outer2 = spheres[n, 0] ** 2, spheres[n, 1] ** 2
        away2 = sonar[0] ** 2 + sonar[1] ** 2 + sonar[2] ** 2
        is_outside = near2 * square > 3 * (CORNER * near_m) ** 2
        # the furthest ray that passes the inner sphere ends at the outer one
        if is_outside and 0.0 < inner2 < away2:
            far2 = min(far2, (math.sqrt(away2 - inner2) + math.sqrt(outer2 - inner2)) ** 2)
        out[n + 1, 0] = 1.0 / (scale * math.sqrt(far2)) if far2 > 0.0 else np.inf
        out[n + 1, 1] = 1.0 / (scale * math.sqrt(near2)) if near2 > 0.0 else np.inf


@compiled
def _extend(window, x, y, z, inverse, u0, v0):
    """Extend (low column, high column, low row, high row) to the sample that looks at a point."""
    u, v = -y / x - u0, z / x - v0
    for axis in range(2):
        at = inverse[axis, 0] * u + inverse[axis, 1] * v
        window[2 * axis] = min(window[2 * axis], at)
        window[2 * axis + 1] = max(window[2 * axis + 1], at)


@compiled
def _cover(box, m, near_m, inverse, u0, v0, window):
    """Extend `window` over a box, as far as it lies before the sector; m : (3, 4) sector_from_body."""
    x, y, z = np.empty(8), np.empty(8), np.empty(8)
    for corner in range(8):
        a, b, c = box[corner & 1, 0], box[(corner >> 1) & 1, 1], box[(corner >> 2) & 1, 2]
        x[corner] = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y[corner] = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z[corner] = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        if x[corner] >= near_m:
            _extend(window, x[corner], y[corner], z[corner], inverse, u0, v0)
    # an edge that passes the sonar is visible from where it comes in front
    for k in range(8):
        for axis in range(3):
            o = k ^ (1 << axis)
            if x[k] < near_m <= x[o]:
                t = (near_m - x[k]) / (x[o] - x[k])
                ys, zs = y[k] + t * (y[o] - y[k]), z[k] + t * (z[o] - z[k])
                _extend(window, near_m, ys, zs, inverse, u0, v0)


@compiled
def _form(a, d):
    """Return dᵀ A d of a symmetric matrix: xx, yy, zz, xy, xz, yz."""
    off = a[3] * d[0] * d[1] + a[4] * d[0] * d[2] + a[5] * d[1] * d[2]
    return a[0] * d[0] * d[0] + a[1] * d[1] * d[1] + a[2] * d[2] * d[2] + 2 * off


@compiled
def _whole_samples(low, high, count):
    """Return the first, and how many, of `count` samples there are from low to high, with a margin."""
    if not low < high:
        return 0, 0
    first, last = min(max(low - MARGIN, 0.0), count), min(max(high + MARGIN + 1, 0.0), count)
    return int(first), int(last) - int(first)


@inlined
def _find_planes(planes_uv, planes):
    """Fill planes, (5, 3) zeros, with the normals inwards of a sector's sides: u and v between their limits, ahead."""
    for k in range(2):
        side = 1.0 - 2.0 * k
        u, v = planes_uv[k], planes_uv[2 + k]
        planes[k, 0], planes[k, 1] = -side * u, -side
        planes[2 + k, 0], planes[2 + k, 2] = -side * v, side
    planes[4, 0] = 1.0


@inlined
def _turn_to_body(sector, matrices, b, planes, m, eye, normals):
    """Fill m, (3, 4) sector_from_body, and the sonar's place and the planes' normals in the frame of body `b`.

    Return the scale of the body: lengths in its frame are as many times as long.
    """
    for i in range(3):
        for j in range(4):
            m[i, j] = 0.0
            for k in range(3):
                m[i, j] += sector[i, k] * matrices[b, k, j]
    square = _square_of_scale(m)
    for j in range(3):
        eye[j] = -(m[0, j] * m[0, 3] + m[1, j] * m[1, 3] + m[2, j] * m[2, 3]) / square
        for k in range(5):
            normals[k, j] = planes[k, 0] * m[0, j] + planes[k, 1] * m[1, j] + planes[k, 2] * m[2, j]
    return math.sqrt(square)


@inlined
def _look_at(box, i, eye, ray):
    """Fill ray, (3,), from the sonar to the middle of box `i`, and return the distance of the box."""
    squares = 0.0
    for j in range(3):
        ray[j] = box[i, j] - eye[j]
        apart = max(abs(ray[j]) - box[i, 3 + j], 0.0)
        squares += apart * apart
    return math.sqrt(squares)


@inlined
def _is_beyond(box, i, ray, normals):
    """Return whether box `i` lies behind one of the planes by which the sector ends."""
    beyond = False
    for k in range(5):
        reach, at = 0.0, 0.0
        for j in range(3):
            reach += abs(normals[k, j]) * box[i, 3 + j]
            at += normals[k, j] * ray[j]
        beyond |= at < -reach
    return beyond


@inlined
def _is_turned_away(box, cone, i, ray):
    """Return whether all faces of patch `i` show the sonar their backs, by the cone of their normals."""
    radius, distance, along = 0.0, 0.0, 0.0
    for j in range(3):
        radius += box[i, 3 + j] * box[i, 3 + j]
        distance += ray[j] * ray[j]
        along += ray[j] * cone[i, j]
    radius, distance = math.sqrt(radius), math.sqrt(distance)
    return along >= math.sqrt(1 - cone[i, 3] * cone[i, 3]) * distance + radius


@compiled
def choose_patches(tree, bodies, placed, view, limits, chosen):
    """Choose the patches that a sector draws, and the window of samples about their bodies.

    Returns how many are chosen, how many faces they have, and of the window the first column, the first row, the
    columns and the rows, all 0 where no sample may meet a body.

    tree, bodies, view, limits : PatchTree, BodyBoxes, SectorGeometry and DetailLimits, as plain tuples
    placed : (n,) bool, which bodies are present; matrices and table of `place_bodies`; and whether back faces of closed
        bodies are not visible
    chosen : (M, 2) int32, patch and body; overwritten
    """
    skip, leaf, error_m, box, cone, moment, whole, n_faces = tree
    _, bounds, _, _, closed, roots, order = bodies
    present, matrices, table, outside = placed
    sector, planes_uv, inverse, corner, size, _, _ = view
    near_m, far_m, range_max_m, error_per_m, most_echo_error = limits
    n, faces_of_all = 0, 0
    m, normals, eye, ray = np.empty((3, 4)), np.empty((5, 3)), np.empty(3), np.empty(3)
    extent = np.array([np.inf, -np.inf, np.inf, -np.inf])  # low and high column, low and high row
    planes = np.zeros((5, 3))
    _find_planes(planes_uv, planes)
    for place_in_order in range(order.shape[0]):
        b = order[place_in_order]
        if not present[b]:
            continue
        echo_error = 0.0 if table[b, LOBE] > 0.0 else most_echo_error
        scale = _turn_to_body(sector, matrices, b, planes, m, eye, normals)
        covered = False
        i, end = roots[b, 0], roots[b, 1]
        while i < end:
            nearest = scale * _look_at(box, i, eye, ray)
            if _is_beyond(box, i, ray, normals) or nearest > far_m:
                i = skip[i]
                continue
            if not covered:
                covered = True
                _cover(bounds[b], m, near_m, inverse, corner[0], corner[1], extent)
            if not leaf[i]:
                wrong_m = scale * error_m[i]
                if nearest - wrong_m > range_max_m:  # no echo, but for the last samples of a floor
                    enough = wrong_m <= BEYOND * error_per_m * nearest
                else:
                    enough = wrong_m <= error_per_m * max(nearest, near_m)
                    own, stood = _form(moment[i], ray), _form(whole[i], ray)
                    enough &= abs(own - stood) <= echo_error * stood
                if not enough:
                    i += 1
                    continue
            hidden = outside and closed[b] != 0 and cone[i, 3] > 0.0 and _is_turned_away(box, cone, i, ray)
            if not hidden and n_faces[i] > 0:
                chosen[n, 0], chosen[n, 1] = i, b
                n, faces_of_all = n + 1, faces_of_all + n_faces[i]
            i = skip[i]
    first_column, columns = _whole_samples(extent[0], extent[1], size[0])
    first_row, rows_drawn = _whole_samples(extent[2], extent[3], size[1])
    if columns <= 0 or rows_drawn <= 0:
        return n, faces_of_all, 0, 0, 0, 0
    return n, faces_of_all, first_column, first_row, columns, rows_drawn


@compiled
def choose_in_sectors(tree, bodies, placed, views, limits, chosen, found):
    """Choose the patches that each of S sectors draws, in one call: handing arrays over takes as long as a small scene.

    tree, bodies, placed : of `choose_patches`
    views, limits : of each sector, tuples of SectorGeometry and DetailLimits, whose parts are stacked
    chosen : (S, M, 2) int32, of each sector; overwritten
    found : (S, 6) int64, overwritten with what `choose_patches` returns
    """
    near_m, far_m, range_max_m, error_per_m, echo_error = limits
    for s in range(found.shape[0]):
        view = (views[0][s], views[1][s], views[2][s], views[3][s], views[4][s], views[5][s], views[6][s])
        own = near_m[s], far_m[s], range_max_m[s], error_per_m[s], echo_error[s]
        one = choose_patches(tree, bodies, placed, view, own, chosen[s])
        for k in range(6):
            found[s, k] = one[k]
