"""Whether a body that few samples met, or none, is hidden behind others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from sonar_gl.core.compiled import compiled
from sonar_gl.core.poses import scale_of
from sonar_gl.engine.body_extents import MAX_CLIPPED_FACES, Sphere
from sonar_gl.engine.reception import Reception
from sonar_gl.sonar.fan import SURFACE_MARGIN_M
from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sector import Sector
from sonar_gl.sonar.sonar import Sonar

POINTS = 256  # at most, on the edges of a body in a sector, are compared with the samples
STAGGER = 0.618034  # of the step between points, from edge to edge: so those of parallel edges lie apart
# 1/x over that of the plane of the sample there: a point at the foot of a body lies on that of the floor
IN_FRONT = 1.001


def is_unobstructed(
    samples: Sequence[SectorSamples],
    number: int,
    body,
    sphere: Sphere,
    body_pose,
    pose,
    reception: Reception,
    surface_z_m: float | None = None,
) -> bool:
    """Return whether some point of a body that few samples met, or none, lies in a beam, in front of others around it.

    Points on the edges of its faces are tested, within each sector and the range: the vertices of a long body may all
    lie beside the fan. A point must lie in front of the planes that all nine met, but for samples of the body itself in
    the fan: the corners of a body in the place of another lie beside samples of that. The samples themselves are nearer
    than what lies on a floor that they meet at a grazing angle. Samples of the body beside the fan show that only an
    edge of it reaches in; those in a gap between box beams do not. What lies above the water's surface is not drawn for
    a sonar in the water.

    number : of the body in the samples
    body, sphere, body_pose : Body, the Sphere about it in its frame, and its (4, 4) world_from_body
    pose : (4, 4) world_from_sonar, of the head
    surface_z_m : height of the water's surface; None if there is none
    """
    sonar, sonar_from_body = reception.sonar, np.linalg.inv(pose) @ body_pose
    centre = sonar_from_body[:3, :3] @ sphere.centre + sonar_from_body[:3, 3]
    surface = np.empty((0, 4))  # what lies below it, as a plane of the body's frame
    if surface_z_m is not None and pose[2, 3] < surface_z_m:
        surface = np.array([[0.0, 0.0, -1.0, surface_z_m - SURFACE_MARGIN_M]]) @ body_pose
    frusta = _frusta([one.sector for one in samples], sonar.range_max_m)
    radius_m = scale_of(body_pose) * sphere.radius_m
    reaching = np.flatnonzero(~_are_beside(frusta, Sphere(centre, radius_m)))
    if not len(reaching):
        return False
    edges, planes = _edges_of(body.surface), frusta @ sonar_from_body
    for place in reaching:
        points = points_within(np.concatenate([planes[place], surface]), edges)
        if not len(points):
            continue
        sector, plane_echo, body_id, _ = samples[place]
        to_sector = sector.rotation() @ sonar_from_body[:3]
        x, y, z = to_sector[:, :3] @ points.T + to_sector[:, 3:]
        u, v, q = -y / x, z / x, 1 / x
        steps, origin = sector.steps, np.array([[sector.u[0]], [sector.v[0]]])
        i, j = np.rint(np.linalg.inv(steps) @ (np.stack([u, v]) - origin)).astype(int)
        in_front = _in_a_beam(sector, u, v, q, sonar, reception.parts.received_u(place))
        in_front &= (i >= 0) & (i < sector.columns) & (j >= 0) & (j < sector.rows)
        u, v, i, j, q = (one[in_front] for one in (u, v, i, j, q))
        for row, column in product((-1, 0, 1), repeat=2):
            if not len(q):  # soon, of most bodies: they are hidden
                break
            at_j, at_i = (j + row).clip(0, sector.rows - 1), (i + column).clip(0, sector.columns - 1)
            there, along_u, along_v = plane_echo[at_j, at_i, :3].astype(np.float64).T
            at = origin + steps @ np.stack([at_i, at_j])
            plane = np.where(there > 0, there + along_u * (u - at[0]) + along_v * (v - at[1]), 0.0)
            is_own = body_id[at_j, at_i] == number
            if is_own.any():
                is_own &= _in_the_fan([one.sector for one in samples], sector, *at, there, sonar)
            in_front = (q > plane * IN_FRONT) | is_own
            u, v, i, j, q = (one[in_front] for one in (u, v, i, j, q))
        if len(q):
            return True
    return False


def _in_a_beam(sector: Sector, u, v, q, sonar: Sonar, received) -> np.ndarray:
    """Return whether points, seen at (u, v) with 1/x = q, lie in the fan, the range and some beam."""
    range_m = np.sqrt(1 + u * u + v * v) / np.maximum(q, 1e-30)
    out = (range_m > sonar.range_min_m) & (range_m < sonar.range_max_m)
    out &= sector.holds_elevation(u, v) & (np.abs(np.arctan(u)) < sector.half_width_rad)
    out &= sector.is_received(u, v)
    return out & (np.searchsorted(received, u) % 2 == 1) if len(received) else out


def _in_the_fan(sectors: Sequence[Sector], sector: Sector, u, v, q, sonar: Sonar) -> np.ndarray:
    """Return whether points, seen in a sector at (u, v) with 1/x = q, lie in the range and in any of the sectors.

    Those beside their own sector may lie in its neighbour, whose samples may all miss a small body at their border.
    """
    azimuth, level = sector.azimuth_rad - np.arctan(u), np.sqrt(1 + u * u)
    out = np.zeros(len(u), bool)
    for one in sectors:
        within = (azimuth - one.azimuth_rad + np.pi) % (2 * np.pi) - np.pi
        is_before, x = np.abs(within) < one.half_width_rad, np.cos(within)
        out |= is_before & _in_a_beam(one, -np.tan(within), v / (level * x), q / (level * x), sonar, ())
    return out


def _frusta(sectors: Sequence[Sector], range_max_m: float) -> np.ndarray:
    """Return the frustum of each sector, and a little more, in the frame of the sonar.

    (sectors, 6, 4) planes of any length, their sides, their lowest and highest elevation between them, and the range
    ahead: for points inside, planes @ (x, y, z, 1) > 0.
    """
    azimuth, half_width, low, high = np.array(
        [(one.azimuth_rad, one.half_width_rad, one.tan_low, one.tan_high) for one in sectors]
    ).T[..., None]
    beside, aside = np.tan(half_width), 1 / np.cos(half_width)
    above, below = (np.maximum(tan, tan * aside) for tan in (high, -low))
    up, one = np.eye(4)[2:]
    ahead = np.cos(azimuth) * [1.0, 0.0, 0.0, 0.0] + np.sin(azimuth) * [0.0, 1.0, 0.0, 0.0]
    left = np.cos(azimuth) * [0.0, 1.0, 0.0, 0.0] - np.sin(azimuth) * [1.0, 0.0, 0.0, 0.0]
    ends = ahead - 1e-3 * one, range_max_m * one - ahead
    sides = beside * ahead + left, beside * ahead - left, above * ahead - up, below * ahead + up
    return np.stack([*ends, *sides], axis=1)


def _are_beside(frusta: np.ndarray, sphere: Sphere) -> np.ndarray:
    """Return (n,) bool, whether a sphere lies outside one of the planes of each frustum."""
    normals, offsets_m = frusta[..., :3], frusta[..., 3]
    reach_m = np.linalg.norm(normals, axis=-1) * sphere.radius_m
    return (normals @ sphere.centre + offsets_m <= -reach_m).any(axis=1)


def _edges_of(surface) -> np.ndarray:
    """Return the edges of all faces, of many faces those of every nth: (m, 2, 3) float64."""
    faces = np.asarray(surface.faces)
    ends = faces[:: 1 + len(faces) // MAX_CLIPPED_FACES, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return np.asarray(surface.vertices, np.float64)[ends]


@compiled
def _cut_edges(planes, edges, low, high):
    """Fill low and high, (m,), with where each edge, from 0 to 1, enters and leaves some planes; low >= high if never.

    planes, edges : of `points_within`
    """
    for e in range(edges.shape[0]):
        low[e], high[e] = 0.0, 1.0
        for k in range(planes.shape[0]):
            begin = end = planes[k, 3]
            for axis in range(3):
                begin += planes[k, axis] * edges[e, 0, axis]
                end += planes[k, axis] * edges[e, 1, axis]
            if begin <= 0.0 and end <= 0.0:
                high[e] = -1.0
                break
            if begin <= 0.0:
                low[e] = max(low[e], begin / (begin - end))
            elif end <= 0.0:
                high[e] = min(high[e], begin / (begin - end))


def points_within(planes, edges) -> np.ndarray:
    """Return (n, 3) points on the parts of edges before all of some planes, POINTS at most, even on each part.

    planes : (p, 4), before which planes @ (x, y, z, 1) > 0; edges : (m, 2, 3), of the same frame
    """
    low, high = np.empty(len(edges)), np.empty(len(edges))
    _cut_edges(planes, edges, low, high)
    held = np.flatnonzero(low < high)
    if not len(held):
        return np.empty((0, 3))
    held = held[:: math.ceil(len(held) / POINTS)]
    n = POINTS // len(held)
    places = (np.arange(n) + (np.arange(len(held))[:, None] * STAGGER) % 1) / n
    places = low[held, None] + places * (high - low)[held, None]
    first, last = edges[held, None, 0], edges[held, None, 1]
    return (first + places[..., None] * (last - first)).reshape(-1, 3)
