"""Triangle meshes: simple shapes, transforms, and the topology of edges.

The vertices of a curved shape lie on the true surface.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SAGITTA_M = 5e-4  # largest distance from a chord to its arc: a fifth of the finest range bins in use
# testing whether a larger mesh is closed costs more than culling its back faces saves
MAX_CLOSED_FACES = 50_000
# side of the square that represents an infinite plane: beyond imaging sonars' range and the way of their vehicles
INFINITE_PLANE_M = 22_000.0
# Of a plane that is larger, a square of this side about the origin has faces of its own: those of one larger face are a
# ten-thousandth off in the images of OpenGL, whose vertices are single precision.
NEAR_PLANE_M = 2000.0


class Triangles(NamedTuple):
    """A triangle mesh as pings need it: (V, 3) float64 vertices, metres, and (F, 3) int64 faces."""

    vertices: np.ndarray
    faces: np.ndarray

    def to_trimesh(self):
        """Return a trimesh.Trimesh with the same vertices and faces."""
        import trimesh  # takes half a second and 45 MB, and no ping needs it

        # copies, since a trimesh may be changed in place
        return trimesh.Trimesh(self.vertices.copy(), self.faces.copy(), process=False)


class Shape(NamedTuple):
    """A mesh with shading normals.

    mesh : Triangles
    normals : (V, 3) float32 of unit length, zero at vertices that are shaded flat; None if all are
    """

    mesh: Triangles
    normals: np.ndarray | None


def make_shape(vertices, faces, normals=None) -> Shape:
    """Return a shape of (V, 3) vertices, metres, (F, 3) faces, and None or (V, 3) normals of any length."""
    mesh = Triangles(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64))
    return Shape(mesh, None if normals is None else _unit_normals(normals))


def box(size) -> Shape:
    """Return an axis-aligned box of `size` (x, y, z) metres about the origin; flat faces."""
    corners = (np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)]) - 0.5) * size
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return make_shape(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def facets_around(radius: float) -> int:
    """Return the number of facets around a circle of `radius` metres: a multiple of four, 24 to 256.

    >>> facets_around(0.1), facets_around(1.0), facets_around(50.0)
    (32, 100, 256)
    """
    needed = np.pi / np.arccos(1 - min(SAGITTA_M / radius, 1.0))
    return int(4 * np.clip(np.ceil(needed / 4), 6, 64))


def _lathe(n: int, *profiles) -> Shape:
    """Return a surface of revolution about z, with n facets around.

    A profile is a list of rows (radius, z, radial part of the normal, z of the normal), from the bottom up.
    Each profile has its own vertices, so that the edge between two profiles stays sharp.
    """
    angle = np.arange(n) * (2 * np.pi / n)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    circle[np.abs(circle) < 1e-15] = 0.0  # the extremes lie exactly on the axes
    around, following = np.arange(n), (np.arange(n) + 1) % n
    vertices, normals, faces, count = [], [], [], 0
    for profile in profiles:
        for radius, z, normal_radial, normal_z in profile:
            vertices.append(np.column_stack([radius * circle, np.full(n, z)]))
            normals.append(np.column_stack([normal_radial * circle, np.full(n, normal_z)]))
        for row in range(len(profile) - 1):
            low, high = count + row * n, count + (row + 1) * n
            if profile[row][0] > 0:  # at a pole this triangle has no area
                faces.append(np.column_stack([low + around, low + following, high + following]))
            if profile[row + 1][0] > 0:
                faces.append(np.column_stack([low + around, high + following, high + around]))
        count += len(profile) * n
    return make_shape(np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals))


def _arc(n: int, radius: float, start_deg: float, stop_deg: float, z: float = 0.0):
    """Return the profile of a sphere about (0, 0, z) between two latitudes; n/2 steps span pole to pole."""
    steps = round(n / 2 * (stop_deg - start_deg) / 180)
    rows = []
    for latitude in np.radians(np.linspace(start_deg, stop_deg, steps + 1)):
        cos, sin = np.cos(latitude), np.sin(latitude)
        cos = 0.0 if cos < 1e-15 else cos
        rows.append((radius * cos, z + radius * sin, cos, sin))
    return rows


def cylinder(radius: float, length: float) -> Shape:
    """Return a cylinder along z about the origin, metres; smooth side, flat ends with sharp edges."""
    h = length / 2
    return _lathe(
        facets_around(radius),
        [(0, -h, 0, -1), (radius, -h, 0, -1)],
        [(radius, -h, 1, 0), (radius, h, 1, 0)],
        [(radius, h, 0, 1), (0, h, 0, 1)],
    )


def cone(radius: float, length: float) -> Shape:
    """Return a cone along z, metres, its tip at +length/2; smooth side, flat base with a sharp edge."""
    h, side = length / 2, np.hypot(radius, length)
    n, (across, up) = facets_around(radius), (length / side, radius / side)
    return _lathe(n, [(0, -h, 0, -1), (radius, -h, 0, -1)], [(radius, -h, across, up), (0, h, across, up)])


def extrude(rings, height: float) -> Shape:
    """Return a prism from z = 0 to `height`, metres, over polygons.

    rings : (n, 2) corners of each polygon, in either sense; those inside of another are holes in it
    """
    rings = [ring if _area(ring) > 0 else ring[::-1] for ring in rings]
    rings.sort(key=_area, reverse=True)
    groups = []  # an outer polygon and the holes in it
    for ring in rings:
        outer = next((group for group in groups if _is_inside(ring[0], group[0])), None)
        groups.append([ring]) if outer is None else outer.append(ring[::-1])
    vertices, faces, count = [], [], 0
    for group in groups:
        corners = np.concatenate(group)
        n, ends = len(corners), np.cumsum([len(ring) for ring in group])
        top = triangulated(corners, ends)
        first = np.arange(n)
        following = np.concatenate([np.roll(part, -1) for part in np.split(first, ends[:-1])])
        vertices += [np.column_stack([corners, np.full(n, z)]) for z in (0.0, height)]
        side = [first, following, following + n], [first, following + n, first + n]
        faces += [count + part for part in (top[:, ::-1], top + n, *(np.column_stack(s) for s in side))]
        count += 2 * n
    return make_shape(np.concatenate(vertices), np.concatenate(faces))


def triangulated(corners: np.ndarray, ends) -> np.ndarray:
    """Return (F, 3) corners of triangles that cover a polygon, counter-clockwise.

    corners : (n, 2) of the polygon, and of the holes in it
    ends : number of corners up to the end of each ring
    """
    from mapbox_earcut import triangulate_float64

    faces = triangulate_float64(np.ascontiguousarray(corners), np.asarray(ends, np.uint32)).reshape(-1, 3)
    (ux, uy), (wx, wy) = ((corners[faces[:, k]] - corners[faces[:, 0]]).T for k in (1, 2))
    turned = ux * wy < uy * wx
    faces[turned] = faces[turned][:, ::-1]
    return faces.astype(np.int64)


def _area(ring) -> float:
    """Return the area of a polygon, negative if it runs clockwise."""
    x, y = np.asarray(ring).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _is_inside(point, ring) -> bool:
    """Return whether a point lies in a polygon: a ray from it crosses the border an odd number of times."""
    (x, y), (x0, y0), (x1, y1) = point, np.asarray(ring).T, np.roll(ring, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return bool((crosses & (at > x)).sum() % 2)


def sphere(radius: float) -> Shape:
    """Return a sphere about the origin, metres; half as many facets from pole to pole as around."""
    n = facets_around(radius)
    return _lathe(n, _arc(n, radius, -90, 90))


def capsule(radius: float, length: float) -> Shape:
    """Return a cylinder of `length` along z about the origin with a half sphere on each end, metres."""
    h, n = length / 2, facets_around(radius)
    return _lathe(n, _arc(n, radius, -90, 0, -h) + _arc(n, radius, 0, 90, h))


def ellipsoid(radii) -> Shape:
    """Return an ellipsoid about the origin with half-axes `radii` (x, y, z), metres."""
    largest = float(np.max(radii))
    mesh, normals = sphere(largest)
    radii = np.asarray(radii) / largest
    return make_shape(mesh.vertices * radii, mesh.faces, normals / radii)


def plane(normal=(0.0, 0.0, 1.0), size=(INFINITE_PLANE_M, INFINITE_PLANE_M)) -> Shape:
    """Return a rectangle of `size` (x, y) metres about the origin, rotated from +z to `normal`."""
    x, y = (
        np.unique([-length, -min(length, NEAR_PLANE_M), min(length, NEAR_PLANE_M), length]) / 2
        for length in size
    )
    corners = np.array([[at_x, at_y, 0.0] for at_y in y for at_x in x])
    first = [row * len(x) + column for row in range(len(y) - 1) for column in range(len(x) - 1)]
    quads = [(n, n + 1, n + len(x) + 1, n + len(x)) for n in first]
    nx, ny, nz = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    if nz < -1 + 1e-12:
        rotation = np.diag([1.0, -1.0, -1.0])
    else:  # the smallest rotation from z to the normal
        k = 1 / (1 + nz)
        rotation = np.array(
            [[1 - k * nx * nx, -k * nx * ny, nx], [-k * nx * ny, 1 - k * ny * ny, ny], [-nx, -ny, nz]]
        )
    return make_shape(corners @ rotation.T, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def terrain(heights, size, pos=(0.0, 0.0, 0.0)) -> Shape:
    """Return a sheet of flat triangles over a grid of heights.

    heights : (R, C) metres; the first row is at +y, the first column at -x
    size : x, y extent, metres; the outer heights lie on its edges
    pos : centre, metres
    """
    rows, columns = heights.shape
    x, y = np.meshgrid(
        pos[0] + np.linspace(-size[0] / 2, size[0] / 2, columns),
        pos[1] + np.linspace(size[1] / 2, -size[1] / 2, rows),
    )
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    below, right, across = corner + columns, corner + 1, corner + columns + 1
    faces = np.empty((2, len(corner), 3), np.int64)
    for column, vertices in enumerate(((corner, corner), (below, across), (across, right))):
        faces[:, :, column] = vertices
    vertices = np.stack([x.ravel(), y.ravel(), pos[2] + heights.ravel()], axis=1)
    return make_shape(vertices, faces.reshape(-1, 3))


def transform(shape: Shape, matrix) -> Shape:
    """Return the shape under an affine (4, 4) matrix; mirroring reverses the faces: outside stays outside.

    Under the identity it is the same object, whose mesh bodies then share.
    """
    if np.array_equal(matrix, np.eye(4)):
        return shape
    mesh, normals = shape
    linear = np.asarray(matrix)[:3, :3]
    mirrored = np.linalg.det(linear) < 0
    faces = mesh.faces[:, ::-1] if mirrored else mesh.faces
    if normals is not None:
        # the cofactor matrix is the inverse transpose times the determinant, and exists for singular matrices
        cofactors = np.cross(linear[[1, 2, 0]], linear[[2, 0, 1]])
        normals = normals @ (-cofactors if mirrored else cofactors).T
    return make_shape(mesh.vertices @ linear.T + np.asarray(matrix)[:3, 3], faces, normals)


def rotation_and_stretch(linear) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation, (3, 3), and what is to be done before it, of a linear (3, 3) transform: linear = R S.

    S is symmetric where there is no mirroring; a mirrored transform has S mirrored in x.

    >>> rotation, stretch = rotation_and_stretch([[0, -2, 0], [2, 0, 0], [0, 0, 2]])
    >>> rotation.round().astype(int).tolist(), stretch.round().astype(int).tolist()
    ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [[2, 0, 0], [0, 2, 0], [0, 0, 2]])
    """
    left, scales, right = np.linalg.svd(np.asarray(linear, np.float64))
    rotation, stretch = left @ right, (right.T * scales) @ right
    if np.linalg.det(rotation) < 0:
        mirror = np.diag([-1.0, 1.0, 1.0])
        rotation, stretch = rotation @ mirror, mirror @ stretch
    return rotation, stretch


def concatenate(shapes) -> Shape:
    """Return one shape from several; vertices are not merged, so that creases stay."""
    meshes, normals = zip(*shapes, strict=True)
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    joined = None
    if any(n is not None for n in normals):
        flat = [np.zeros((len(m.vertices), 3), np.float32) if n is None else n for m, n in shapes]
        joined = np.concatenate(flat)
        joined.flags.writeable = False  # as in `_unit_normals`
    faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)])
    return make_shape(np.concatenate([m.vertices for m in meshes]), faces)._replace(normals=joined)


def _unit_normals(normals):
    """Return unit normals, zero (shaded flat) where one is zero or not finite; None if all are."""
    normals = np.asarray(normals, np.float64)
    length = np.linalg.norm(normals, axis=1)
    good = np.isfinite(length) & (length > 1e-12)
    if not good.any():
        return None
    out = np.zeros(normals.shape, np.float32)
    out[good] = normals[good] / length[good, None]
    out.flags.writeable = False  # bodies that share a shape then share its normals, too
    return out


def closedness(vertices, faces) -> int:
    """Return the sign of the volume of a closed, consistently oriented mesh: +1, or -1 if inside out.

    Return 0 for other meshes, and for those of more than MAX_CLOSED_FACES faces.
    """
    if len(faces) > MAX_CLOSED_FACES:
        return 0
    # from their corner: far from the origin of the mesh, as in UTM, keys of a tiny mesh would overflow
    from_corner = vertices - vertices.min(axis=0)
    extent = from_corner.max()
    # merge coincident vertices: creases and seams duplicate them
    keys = np.ascontiguousarray(np.round(from_corner / (extent or 1.0) * 1e9).astype(np.int64))
    _, same = np.unique(keys.view([("", np.int64)] * 3).ravel(), return_inverse=True)
    triangles = same.ravel()[faces]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    a, b = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    n = len(vertices)
    forward, backward = np.sort(a * n + b), np.sort(b * n + a)
    if len(forward) == 0 or (np.diff(forward) == 0).any() or not np.array_equal(forward, backward):
        return 0
    middle = vertices - vertices.mean(axis=0)
    x, y, z = (middle[faces[:, k]] for k in range(3))
    return int(np.sign(np.einsum("ij,ij->", x, np.cross(y, z))))


def fixed_vertices(faces, n_vertices: int) -> np.ndarray:
    """Return (V,) bool: whether a vertex lies on an edge without exactly two faces."""
    out = np.zeros(n_vertices, bool)
    keys = np.empty((3, len(faces)), np.int64)
    for k in range(3):  # one after the other, since all at once would take three times the memory
        a, b = faces[:, k], faces[:, k - 1]
        keys[k] = np.minimum(a, b)
        keys[k] *= n_vertices
        keys[k] += np.maximum(a, b)
    keys = keys.ravel()
    keys.sort()
    is_new = np.ones(len(keys), bool)
    is_new[1:] = keys[1:] != keys[:-1]
    new = np.flatnonzero(is_new)
    odd = keys[new[np.diff(new, append=len(keys)) != 2]]
    out[odd // n_vertices] = out[odd % n_vertices] = True
    return out
