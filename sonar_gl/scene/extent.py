"""The space that bodies take in the world."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sonar_gl.scene.primitives import INFINITE_PLANE_M
from sonar_gl.scene.scene import Body, Scene
from sonar_gl.sonar.fan import SURFACE_MARGIN_M

PLANE_FACES = 18  # of an infinite plane
# A line up from a place passes so far beside corners and edges of meshes, x and y in metres: in the middle of a box it
# would meet the edge between two triangles.
BESIDE_M = 1.3e-6, 0.7e-6
# Of corners and triangles that are compared at once: few, since the lowest corners often decide.
PAIRS = 1 << 13
LONG_M, HIGH_M = 500.0, 100.0  # terrain may be as long; what is as long and as high is in other units


class AirWarning(UserWarning):
    """A sonar is above the water's surface."""


class InsideWarning(UserWarning):
    """A sonar is inside a body, or below a terrain."""


def body_bounds(body: Body, pose: np.ndarray | None = None) -> np.ndarray:
    """Return the (2, 3) least and greatest coordinates of a body in the world, metres, by default at its own pose."""
    pose = body.pose if pose is None else pose
    vertices = np.asarray(body.surface.vertices, np.float64) @ pose[:3, :3].T + pose[:3, 3]
    return np.array([vertices.min(axis=0), vertices.max(axis=0)])


def is_infinite(body: Body) -> bool:
    """Return whether a body is the plane of a collision, which is infinite in SDF."""
    if len(body.surface.faces) != PLANE_FACES:
        return False
    edges_m = np.ptp(np.asarray(body.surface.vertices, np.float64), axis=0)
    return bool(np.isclose(np.sort(edges_m)[1:], INFINITE_PLANE_M).all())


def bounds_of(bodies: Iterable[Body]) -> np.ndarray | None:
    """Return the (2, 3) least and greatest coordinates of all bodies but infinite planes; None if there are none."""
    bounds = [body_bounds(body) for body in bodies if not is_infinite(body)]
    if not bounds:
        return None
    return np.array([np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]])


def bodies_beyond(bodies: Iterable[Body], places: np.ndarray, range_m: float) -> list[str]:
    """Return the names of bodies of which nothing lies within a range of any of some places.

    Bodies are taken as boxes with sides along x, y and z: some that lie a little beyond the range are left out.

    places : (n, 3) x, y, z in the world, metres
    """
    out = []
    for body in bodies:
        low, high = body_bounds(body)
        x, y, z = np.maximum(np.maximum(low - places, places - high), 0.0).T
        if np.hypot(np.hypot(x, y), z).min() > range_m:
            out.append(body.name)
    return out


def body_around(
    bodies: Sequence[Body],
    poses: np.ndarray,
    present: np.ndarray,
    place: np.ndarray,
    surface_z_m: float | None = None,
) -> str:
    """Return the name of the first body that a place lies in, or below if it is a terrain; "" if there is none.

    A line straight up from there leaves such a body through more faces that look up than it enters through faces that
    look down. A mesh that is inside out, such as the walls of a tank, holds no place. Nor does a body in the surface of
    the water or above it, such as a sheet that shows the surface: a sonar in the water does not see it.

    poses : (n, 4, 4) world_from_body
    present : (n,) bool
    place : (3,) x, y, z in the world, metres
    surface_z_m : height of the water's surface; None if there is none
    """
    top_m = np.inf if surface_z_m is None or place[2] >= surface_z_m else surface_z_m - SURFACE_MARGIN_M
    for body, pose, is_present in zip(bodies, poses, present, strict=True):
        if not is_present:
            continue
        vertices, faces = np.asarray(body.surface.vertices, np.float64), np.asarray(body.surface.faces)
        offset = pose[:3, 3] - place + (*BESIDE_M, 0.0)
        for axis in (0, 1):  # faces that the line may meet: few of a terrain
            turn, (x, y, z) = pose[axis, :3], vertices.T
            is_beyond = turn[0] * x + turn[1] * y + turn[2] * z > -offset[axis]
            first, second, third = (is_beyond[faces[:, k]] for k in range(3))
            faces = faces[(first != second) | (second != third)]
        if not len(faces):
            continue
        a, b, c = (vertices[faces[:, k]] @ pose[:3, :3].T + offset for k in range(3))
        # twice the areas of the triangles between the line and each edge, as seen from above
        sides = np.stack([_cross(a, b), _cross(b, c), _cross(c, a)])
        way = np.where((sides > 0).all(axis=0), 1, np.where((sides < 0).all(axis=0), -1, 0))
        met = np.flatnonzero(way)
        (bc, ca, ab), corner_z = sides[[1, 2, 0]][:, met], (a[met, 2], b[met, 2], c[met, 2])
        is_above = np.sign(ab + bc + ca) * (bc * corner_z[0] + ca * corner_z[1] + ab * corner_z[2]) > 0
        if way[met][is_above].sum() > 0 and (vertices @ pose[2, :3]).min() + pose[2, 3] < top_m:
            return body.name
    return ""


def gap_m(placed: Sequence[tuple[Body, np.ndarray]], floor: Body, floor_pose: np.ndarray) -> float:
    """Return how far bodies can sink until one of them touches a floor, metres; negative if one reaches below it.

    Corners of the bodies touch faces of the floor, or corners of the floor touch faces of the bodies; that edges may
    cross before is left out. Parts beyond the floor's edge do not count; infinite if all parts lie there.

    placed : bodies, each with its (4, 4) world_from_body
    floor_pose : (4, 4) world_from_body of the floor
    """
    origin, gap = floor_pose[:3, 3], np.inf  # near the origin float64 is exact, also in UTM
    ground, ground_faces = _corners(floor, floor_pose, origin), np.asarray(floor.surface.faces)
    for body, pose in placed:
        corners, faces = _corners(body, pose, origin), np.asarray(body.surface.faces)
        is_beside = np.zeros(len(ground_faces), bool)
        for axis in (0, 1):
            for side in (ground[:, axis] < corners[:, axis].min(), ground[:, axis] > corners[:, axis].max()):
                is_beside |= side[ground_faces].all(axis=1)
        below = ground_faces[~is_beside]
        gap = _least_gap_m(corners, faces, ground[below], gap)
        gap = _least_gap_m(-ground, below, -corners[faces], gap)  # upside down, where the floor is above
    return gap


def _corners(body: Body, pose: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the (n, 3) vertices of a body in the world, relative to an origin."""
    return np.asarray(body.surface.vertices, np.float64) @ pose[:3, :3].T + (pose[:3, 3] - origin)


def _least_gap_m(vertices: np.ndarray, faces: np.ndarray, lower: np.ndarray, gap: float) -> float:
    """Return the least height of the corners of faces above (n, 3, 3) triangles, or `gap` if that is less."""
    if not len(lower):
        return gap
    corners, top = vertices[np.unique(faces)], lower[..., 2].max()
    corners = corners[np.argsort(corners[:, 2])]
    at_once = max(1, PAIRS // len(lower))
    for first in range(0, len(corners), at_once):
        some = corners[first : first + at_once]
        if some[0, 2] - top >= gap:  # so are all further ones
            break
        edges = lower[None] - some[:, None, None]  # (corners, triangles, 3, 3)
        ends = np.roll(edges, -1, axis=2)
        # twice the areas of the triangles between a corner and each edge, as seen from above
        areas = np.roll(edges[..., 0] * ends[..., 1] - edges[..., 1] * ends[..., 0], -1, axis=2)
        whole = areas.sum(axis=2)
        meets = (whole != 0) & (np.all(areas >= 0, axis=2) | np.all(areas <= 0, axis=2))
        heights = (areas * edges[..., 2]).sum(axis=2)[meets] / whole[meets]
        gap = min(gap, -heights.max(initial=-gap))
    return float(gap)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return (n,) the z of the cross products of (n, 3) vectors."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def air_text(scene: Scene, pose: np.ndarray) -> str:
    """Return the warning of a sonar above the water's surface; "" if it is in the water, or there is no surface."""
    if scene.surface_z_m is None or pose[2, 3] <= scene.surface_z_m:
        return ""
    return (
        f"the sonar at z = {pose[2, 3]:.4g} m is above the water's surface at z = {scene.surface_z_m:.4g} m, which "
        "has no effect on it; give it a lower pose, or the scene another surface (--surface, Scene.with_surface)"
    )


def place_texts(scene: Scene, poses: np.ndarray, present: np.ndarray, pose: np.ndarray) -> list[str]:
    """Return the warnings of a sonar in the air and inside a body, as far as there are any.

    poses, present : of `body_around`
    pose : (4, 4) world_from_sonar
    """
    inside = inside_text(scene.bodies, poses, present, pose[:3, 3], scene.surface_z_m)
    texts = air_text(scene, pose), inside
    return [text for text in texts if text]


def inside_text(
    bodies: Sequence[Body],
    poses: np.ndarray,
    present: np.ndarray,
    place: np.ndarray,
    surface_z_m: float | None = None,
) -> str:
    """Return the warning of a sonar inside a body, or below a terrain; "" without one; parameters of `body_around`.

    >>> inside_text([], [], [], np.zeros(3))
    ''
    """
    name = body_around(bodies, poses, present, place, surface_z_m)
    if not name:
        return ""
    at = ", ".join(f"{round(number, 3) + 0.0:.10g}" for number in map(float, place))
    return (
        f"the sonar at ({at}) m is inside body {name!r}, or below it if it is a terrain, and sees what no sonar does "
        "from there; give it another pose, have the body absent in its pings (Simulator.ping(bodies=...)), or, if it "
        "is a tank, turn its faces to the inside (mesh.invert())"
    )


def other_unit_text(scene: Scene) -> str:
    """Return the warning of a scene that is too large for imaging sonars in all directions, and its cure; else ""."""
    bounds = bounds_of(scene.bodies)
    if bounds is None:
        return ""
    size_m = np.ptp(bounds, axis=0)
    if size_m.max() < LONG_M or size_m.min() < HIGH_M:
        return ""
    return (
        f"the scene measures {size_text(size_m)}: if it was made in centimetres or millimetres, scale it by 0.01 "
        "or 0.001 (<scale>0.001 0.001 0.001</scale> of a mesh in SDF, mesh.apply_scale(0.001) in Python)"
    )


def size_text(size_m) -> str:
    """Return three lengths in words.

    >>> size_text([1, 20, 20.5]), size_text([12000, 999.7, 45])
    ('1 x 20 x 20.5 m', '12000 x 1000 x 45 m')
    """
    return " x ".join(f"{length:.0f}" if length >= 999.5 else f"{length:.3g}" for length in size_m) + " m"
