"""What a sector sees of a scene: patches as coarse as its samples allow, and the window about them."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.compiled import compiled

BEYOND = 60.0  # what lies wholly beyond the last bin may stray so many times more


@compiled
def place(poses, shown, centres, bounds, closed, pose, near_m, matrices, rows):
    """Bodies relative to the sonar, taken in float64 before they are rounded.

    Parameters
    ----------
    poses : (n, 4, 4) world_from_body; shown : (n,) bool
    centres, bounds : (n, 3), (n, 2, 3) of the meshes; bounds count from the centres
    closed : (n,) 0 for open meshes
    pose : (4, 4) world_from_sonar
    matrices : (n, 3, 4) sonar_from_body about the centre, overwritten; rows : the same in float32, in the
        first 12 of its columns

    Returns
    -------
    outside : whether back faces may be left out: the sonar is in the box of no closed body
    """
    outside = True
    for n in range(poses.shape[0]):
        if not shown[n]:
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
                rows[n, 4 * i + j] = m[i, j]
        if closed[n] != 0:
            inside = True
            for j in range(3):
                sonar = -(m[0, j] * m[0, 3] + m[1, j] * m[1, 3] + m[2, j] * m[2, 3])
                inside &= bounds[n, 0, j] - 2 * near_m < sonar < bounds[n, 1, j] + 2 * near_m
            if inside:
                outside = False
    return outside


@compiled
def _extend(found, x, y, z, inverse, u0, v0):
    """Stretch (low column, high column, low row, high row) to the sample that looks at a point."""
    u, v = -y / x - u0, z / x - v0
    for axis in range(2):
        at = inverse[axis, 0] * u + inverse[axis, 1] * v
        found[2 * axis] = min(found[2 * axis], at)
        found[2 * axis + 1] = max(found[2 * axis + 1], at)


@compiled
def _cover(box, m, near_m, inverse, u0, v0, found):
    """Stretch `found` over a box, as far as it lies before the sector; m : (3, 4) sector_from_body."""
    x, y, z = np.empty(8), np.empty(8), np.empty(8)
    for corner in range(8):
        a, b, c = box[corner & 1, 0], box[(corner >> 1) & 1, 1], box[(corner >> 2) & 1, 2]
        x[corner] = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y[corner] = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z[corner] = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        if x[corner] >= near_m:
            _extend(found, x[corner], y[corner], z[corner], inverse, u0, v0)
    # an edge that passes the sonar is seen from where it comes before it
    for k in range(8):
        for axis in range(3):
            o = k ^ (1 << axis)
            if x[k] < near_m <= x[o]:
                t = (near_m - x[k]) / (x[o] - x[k])
                ys, zs = y[k] + t * (y[o] - y[k]), z[k] + t * (z[o] - z[k])
                _extend(found, near_m, ys, zs, inverse, u0, v0)


@compiled
def _form(a, d):
    """dᵀ A d of a symmetric matrix: xx, yy, zz, xy, xz, yz."""
    off = a[3] * d[0] * d[1] + a[4] * d[0] * d[2] + a[5] * d[1] * d[2]
    return a[0] * d[0] * d[0] + a[1] * d[1] * d[1] + a[2] * d[2] * d[2] + 2 * off


@compiled
def see(
    skip, leaf, error_m, box, cone, moment, whole, n_faces, roots, order, shown, closed, bounds,
    matrices, sector, limits, inverse, corner, near_m, far_m, range_max_m, strays, echoes, outside,
    chosen, found,
):  # fmt: skip
    """Patches that a sector draws, and the window of samples about their bodies.

    Parameters
    ----------
    skip .. n_faces : of all meshes' `detail.Levels`, one after the other
    roots : (n, 2) first patch of each body and the one after its last
    order : (n,) bodies, closed ones first
    shown, closed, bounds, matrices : of `place`
    sector : (3, 3) sector_from_sonar
    limits : low and high u, low and high v of its lattice
    inverse, corner : (2, 2) samples per (u, v), and (u, v) of its first sample
    strays : a patch may stray from the mesh by so much, per metre of range
    echoes : (n,) and its echo from what it stands for by this share, of each body
    outside : back faces of closed bodies are not seen
    chosen : (M, 2) int32, patch and body; overwritten
    found : low and high column, low and high row; stretched

    Returns
    -------
    how many are chosen
    """
    n = 0
    m, normals, eye, ray = np.empty((3, 4)), np.empty((5, 3)), np.empty(3), np.empty(3)
    planes = np.zeros((5, 3))  # inwards, in the sector's frame: u and v between their limits, ahead
    for k in range(2):
        side = 1.0 - 2.0 * k
        u, v = limits[k], limits[2 + k]
        planes[k, 0], planes[k, 1] = -side * u, -side
        planes[2 + k, 0], planes[2 + k, 2] = -side * v, side
    planes[4, 0] = 1.0
    for place_in_order in range(order.shape[0]):
        b = order[place_in_order]
        if not shown[b]:
            continue
        for i in range(3):
            for j in range(4):
                m[i, j] = 0.0
                for k in range(3):
                    m[i, j] += sector[i, k] * matrices[b, k, j]
        for j in range(3):  # all in the body's frame
            eye[j] = -(m[0, j] * m[0, 3] + m[1, j] * m[1, 3] + m[2, j] * m[2, 3])
            for k in range(5):
                normals[k, j] = planes[k, 0] * m[0, j] + planes[k, 1] * m[1, j] + planes[k, 2] * m[2, j]
        covered = False
        i, end = roots[b, 0], roots[b, 1]
        while i < end:
            beyond, nearest = False, 0.0
            for j in range(3):
                ray[j] = box[i, j] - eye[j]
                apart = max(abs(ray[j]) - box[i, 3 + j], 0.0)
                nearest += apart * apart
            nearest = math.sqrt(nearest)
            for k in range(5):
                reach, at = 0.0, 0.0
                for j in range(3):
                    reach += abs(normals[k, j]) * box[i, 3 + j]
                    at += normals[k, j] * ray[j]
                beyond |= at < -reach
            if beyond or nearest > far_m:
                i = skip[i]
                continue
            if not covered:
                covered = True
                _cover(bounds[b], m, near_m, inverse, corner[0], corner[1], found)
            if not leaf[i]:
                if nearest - error_m[i] > range_max_m:  # not heard, but for the last samples of a floor
                    enough = error_m[i] <= BEYOND * strays * nearest
                else:
                    enough = error_m[i] <= strays * max(nearest, near_m)
                    own, stood = _form(moment[i], ray), _form(whole[i], ray)
                    enough &= abs(own - stood) <= echoes[b] * stood
                if not enough:
                    i += 1
                    continue
            hidden = False
            if outside and closed[b] != 0 and cone[i, 3] > 0.0:
                radius, distance, along = 0.0, 0.0, 0.0
                for j in range(3):
                    radius += box[i, 3 + j] * box[i, 3 + j]
                    distance += ray[j] * ray[j]
                    along += ray[j] * cone[i, j]
                radius, distance = math.sqrt(radius), math.sqrt(distance)
                hidden = along >= math.sqrt(1 - cone[i, 3] * cone[i, 3]) * distance + radius
            if not hidden and n_faces[i] > 0:
                chosen[n, 0], chosen[n, 1] = i, b
                n += 1
            i = skip[i]
    return n


@compiled
def draw_patches(chosen, first_face, n_faces, closed, row, draws):
    """Patches as draws: (M, 5) uint32 of indices, instances, first index, first vertex, body's row.

    Returns
    -------
    how many of them, the first, are of closed bodies
    """
    n_closed = 0
    for k in range(chosen.shape[0]):
        patch, body = chosen[k, 0], chosen[k, 1]
        n_closed += closed[body] != 0
        draws[k, 0], draws[k, 1], draws[k, 2] = 3 * n_faces[patch], 1, 3 * first_face[patch]
        draws[k, 3], draws[k, 4] = 0, row + body
    return n_closed


@compiled
def merge(places, values, bodies, first_column, first_row, left, plane_echo, body_id):
    """Put samples into what was drawn where they are nearer.

    Parameters
    ----------
    places, values, bodies : of `sift_patches`
    first_column, first_row : of the sector's window; left : where it lies in the picture
    plane_echo, body_id : (H, W, 4) and (H, W) of all windows; body_id of no length if it is not asked for
    """
    for s in range(places.shape[0]):
        i, j = places[s, 0] - first_column + left, places[s, 1] - first_row
        if values[s, 0] > plane_echo[j, i, 0]:
            for k in range(4):
                plane_echo[j, i, k] = values[s, k]
            if body_id.shape[0]:
                body_id[j, i] = bodies[s]
