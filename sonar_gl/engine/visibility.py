"""Which bodies are in view: how many samples meet each, what it returns, and what it could return."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.boundary import cos_of_greatest_lobe, specular_lobe
from sonar_gl.beamform.beamformer import Beamformer
from sonar_gl.beamform.kernels.body_counts import (
    BodyTotals,
    CountedSamples,
    EchoWeights,
    ReceivedParts,
    count_samples,
)
from sonar_gl.core.compiled import compiled
from sonar_gl.scene.state import GreatestReflectivity, SceneState
from sonar_gl.sonar.fan import SURFACE_MARGIN_M
from sonar_gl.sonar.samples import SectorSamples, ViewSamples
from sonar_gl.sonar.sector import Sector
from sonar_gl.sonar.sonar import Sonar

MAX_FACES = 200_000  # of larger meshes the box stands for the area: summing their faces costs too much
POINTS = 256  # at most, on the edges of a body in a sector, are compared with the samples
GLINT_REACH = 4.0  # times the rms slope: beyond, a specular lobe has 10⁻⁴ of its echo
MAX_FLAT_FACES = 12  # directions of a body whose faces are flat: it is a glint as a whole, or not at all
NO_GLINT = 1e-26  # of the greatest lobe: a sample with less returns nothing
MAX_CLIPPED_FACES = 1024  # of larger meshes about so many: their edges are short
STAGGER = 0.618034  # of the step between points, from edge to edge: so those of parallel edges lie apart
BODY_ERROR_FACTOR, BODY_ERROR_RATE = 1.8, 0.75
MIN_BODY_SAMPLES = 8  # with fewer, the echo of a body is taken as unknown
# 1/x over that of the plane of the sample there: a point at the foot of a body lies on that of the floor
IN_FRONT = 1.001


class Reception(NamedTuple):
    """From where a sonar receives an echo, and how strongly, by its range and its elevation.

    Attributes
    ----------
    sonar : with true ranges
    reach_rad : how far beyond their axes the outermost beams receive
    max_elevation_rad : beyond which nothing is received, side lobes included
    are_cones : of `Fan`
    gain : (K,) of the bins
    elevation_table, parts : of `Beamformer`, whose `received_parts` the parts are
    """

    sonar: Sonar
    reach_rad: float
    max_elevation_rad: float
    are_cones: bool
    gain: np.ndarray
    elevation_table: np.ndarray
    parts: ReceivedParts

    def greatest_gain(self, nearest_m, farthest_m) -> np.ndarray:
        """Return the greatest gain between ranges, (n,) metres, of which a part lies in the bins."""
        bins = (np.stack([nearest_m, farthest_m]) - self.sonar.range_min_m) / self.sonar.bin_size_m
        return _greatest(self.gain, *np.floor(bins))

    def greatest_pattern(self, low_sine, high_sine) -> np.ndarray:
        """Return the greatest two-way elevation pattern between sines of elevation, (n,)."""
        if not len(self.elevation_table):
            return np.ones(len(low_sine))
        per_sine = (len(self.elevation_table) - 1) / 2
        low, high = per_sine + per_sine * low_sine, per_sine + per_sine * high_sine
        return _greatest(self.elevation_table, np.floor(low), np.ceil(high))


def reception_of(beamformer: Beamformer, reach_rad: float, gain: np.ndarray) -> Reception:
    """Return how a beamformer receives; reach_rad and gain as of `Reception`."""
    fan = beamformer.fan
    tables = beamformer.elevation_table, beamformer.received_parts
    return Reception(fan.sonar, reach_rad, fan.max_elevation_rad, fan.are_cones, gain, *tables)


class BodyCounts(NamedTuple):
    """What each body contributes to a ping, by number, 0 for none: (bodies + 1,) float64 arrays.

    samples : how many met it, inside the fan, its aperture and range, and in some beam
    echo : about the sum of its echo with the gain
    unevenness : how uncertain that sum is because neighbouring samples of the body return unlike echoes: its standard
        deviation, were they met at random
    of_strips : that sum as the fan's strips take it. Each takes the nearest sample of a row, so that those not as wide
        as a sample take too much or too little of what is thin and upright, in all rows alike
    strands : how many runs of neighbouring samples on it there are, along rows or across them, whichever are fewer;
        0 in sectors where these are long, or all lie along one line
    """

    samples: np.ndarray
    echo: np.ndarray
    of_strips: np.ndarray
    unevenness: np.ndarray
    strands: np.ndarray


def count_bodies(
    view: ViewSamples,
    n_bodies: int,
    reception: Reception,
    is_counted: np.ndarray | None = None,
    every: int = 1,
) -> BodyCounts:
    """Count the samples on each body, and about the echo of each.

    Parameters
    ----------
    view : not of a host
    is_counted : (bodies + 1,) bool by number, of which bodies; None for all. Those of others are 0
    every : of the rows of samples, every so-manieth is counted, and stands for those between
    """
    sonar, n = reception.sonar, n_bodies + 1
    if is_counted is None:
        is_counted = np.ones(n, bool)
    elif not is_counted.any():
        return BodyCounts(*np.zeros((5, n)))
    samples = CountedSamples(view.plane_echo, view.body_id, view.table, is_counted, every)
    weights = EchoWeights(
        sonar.range_min_m, 1.0 / sonar.bin_size_m, reception.gain, reception.elevation_table
    )
    totals = BodyTotals(*np.zeros((6, n)))
    count_samples(tuple(samples), tuple(reception.parts), tuple(weights), tuple(totals))
    # half the mean square of the differences of two is their variance; stripes show across them alone
    unevenness = np.sqrt(np.maximum(totals.along, totals.across) / 2)
    return BodyCounts(totals.counts, totals.echo, totals.of_strips, unevenness, totals.strands)


def body_error(samples, strands=0.0):
    """Return the relative error of a body's echo by its samples: few may all lie along a thin body, or beside it.

    Stratified samples err along an outline only. Of n samples on a compact body about √n lie there, and the error
    decreases as n^-0.75, the root of √n over n. On many thin wires nearly all do. Fitted to random worlds.

    strands : of `BodyCounts`
    """
    compact = BODY_ERROR_FACTOR * (1 + MIN_BODY_SAMPLES / samples) / samples**BODY_ERROR_RATE
    return compact * np.sqrt(np.maximum(strands / np.sqrt(samples), 1.0))


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

    Parameters
    ----------
    number : of the body in the samples
    body, sphere, body_pose : Body, the Sphere about it in its frame, and its (4, 4) world_from_body
    pose : (4, 4) world_from_sonar, of the head
    surface_z_m : height of the water's surface; None if there is none
    """
    sonar, sonar_from_body = reception.sonar, np.linalg.inv(pose) @ body_pose
    centre = sonar_from_body[:3, :3] @ sphere.centre + sonar_from_body[:3, 3]
    surface = []  # what lies below it, as a plane of the body's frame
    if surface_z_m is not None and pose[2, 3] < surface_z_m:
        surface = [np.array([0.0, 0.0, -1.0, surface_z_m - SURFACE_MARGIN_M]) @ body_pose]
    edges = None  # taken from the body where a sector may hold it
    for place, (sector, plane_echo, body_id, _) in enumerate(samples):
        frustum = _frustum(sector, sonar.range_max_m)
        if _is_beside(frustum, Sphere(centre, sphere.radius_m)):
            continue
        edges = _edges_of(body.surface) if edges is None else edges
        points = points_within(np.stack([*(frustum @ sonar_from_body), *surface]), edges)
        if not len(points):
            continue
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
                is_own &= _in_a_beam(sector, *at, there, sonar, ())  # of beams without gaps
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


def _frustum(sector: Sector, range_max_m: float) -> np.ndarray:
    """Return the frustum of a sector, and a little more, in the frame of the sonar.

    (6, 4) planes of any length, its sides, its lowest and highest elevation between them, and the range ahead: for
    points inside, planes @ (x, y, z, 1) > 0.
    """
    beside, aside = math.tan(sector.half_width_rad), 1 / math.cos(sector.half_width_rad)
    above, below = (max(tan, tan * aside) for tan in (sector.tan_high, -sector.tan_low))
    c, s = math.cos(sector.azimuth_rad), math.sin(sector.azimuth_rad)
    ahead, left = np.array([c, s, 0.0, 0.0]), np.array([-s, c, 0.0, 0.0])
    up, one = np.array([0.0, 0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    ends = ahead - 1e-3 * one, range_max_m * one - ahead
    return np.stack(
        [*ends, beside * ahead + left, beside * ahead - left, above * ahead - up, below * ahead + up]
    )


def _is_beside(frustum: np.ndarray, sphere: Sphere) -> bool:
    """Return whether a sphere lies outside one of the planes of a frustum."""
    normals, offsets_m = frustum[:, :3], frustum[:, 3]
    reach_m = np.linalg.norm(normals, axis=1) * sphere.radius_m
    return bool((normals @ sphere.centre + offsets_m <= -reach_m).any())


def _edges_of(surface) -> np.ndarray:
    """Return the edges of all faces, of many faces those of every so-manieth: (m, 2, 3) float64."""
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
    held = held[:: max(math.ceil(len(held) / POINTS), 1)]
    n = POINTS // max(len(held), 1)
    places = (np.arange(n) + (np.arange(len(held))[:, None] * STAGGER) % 1) / max(n, 1)
    places = low[held, None] + places * (high - low)[held, None]
    first, last = edges[held, None, 0], edges[held, None, 1]
    return (first + places[..., None] * (last - first)).reshape(-1, 3)


def _greatest(values, first, last) -> np.ndarray:
    """Return the greatest of some values within each span of places, (n,), both ends included."""
    first, last = (np.clip(places, 0, len(values) - 1).astype(np.int64) for places in (first, last))
    ends = np.stack([first, last + 1], axis=1).ravel()
    # a span may end with the last value: `reduceat` takes no end beyond it
    return np.maximum.reduceat(np.append(values, values[-1]), ends)[::2]


class Sphere(NamedTuple):
    """A sphere about some points, in their frame."""

    centre: np.ndarray
    radius_m: float


def sphere_about(points) -> Sphere:
    """Return a sphere about (n, 3) points, around the middle of their box."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return Sphere(centre, float(np.linalg.norm(points - centre, axis=1).max()))


def _used_vertices(surface) -> np.ndarray:
    """Return the vertices that faces use, (n, 3) float64."""
    used = np.zeros(len(surface.vertices), bool)
    used[np.asarray(surface.faces)] = True
    return np.asarray(surface.vertices, np.float64)[used]


def _area_m2(surface) -> float:
    a, b, c = np.asarray(surface.vertices, np.float64)[np.asarray(surface.faces).T]
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def glint_share(surface, roughness_rad: float) -> float:
    """Return the share of a smooth body's outline that returns nearly all of its echo, 1 where its faces are flat.

    Facets within GLINT_REACH times the roughness of the direction of the sonar do, all but 10⁻⁴ of the lobe: of a round
    body, a part of its outline as wide as that share in both directions; of a cylinder, which is round in one direction
    alone, a strip.
    """
    faces = np.asarray(surface.faces)
    a, b, c = np.asarray(surface.vertices, np.float64)[faces[:: 1 + len(faces) // MAX_CLIPPED_FACES].T]
    cross = np.cross(b - a, c - a)
    areas = np.linalg.norm(cross, axis=1)
    normals, areas = cross[areas > 0] / areas[areas > 0, None], areas[areas > 0]
    if len(np.unique(normals.round(2), axis=0)) <= MAX_FLAT_FACES:
        return 1.0
    _, axes = np.linalg.eigh(normals.T @ (areas[:, None] * normals))
    is_beside = np.abs(normals @ axes[:, 0]) < 0.1  # the axis that the fewest normals follow
    is_round_once = areas[is_beside].sum() > 0.7 * areas.sum()
    return min(1.0, GLINT_REACH * roughness_rad) ** (1 if is_round_once else 2)


def greatest_lobe(body, body_pose, pose, reception: Reception) -> float:
    """Return the most that the specular lobe of a body with flat faces may return per steradian in the fan.

    A ray of the fan meets a flat face at no less than the angle between the face's normal and the fan, nor than where
    the face is nearest to the sonar. Faces with other shading normals, and those of large meshes, count as those at
    the angle where their lobe is greatest, which is face on but for large roughness.

    Parameters
    ----------
    body, body_pose, pose : of `is_unobstructed`
    """
    greatest_cosine = cos_of_greatest_lobe(body.roughness_rad)
    greatest = float(specular_lobe(greatest_cosine, body.specular, body.roughness_rad))
    surface, to_sonar = body.surface, pose[:3, :3].T @ body_pose[:3, :3]
    if len(surface.faces) > MAX_CLIPPED_FACES:
        return greatest
    corners = np.asarray(surface.vertices, np.float64)[np.asarray(surface.faces)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(cross, axis=1)
    corners, normals, faces = (one[areas > 0] for one in (corners, cross, surface.faces))
    normals = normals / areas[areas > 0, None]
    if body.normals is not None:
        shading = np.asarray(body.normals, np.float64)[faces]
        is_flat = (np.abs((shading * normals[:, None]).sum(axis=2)) > 1 - 1e-4) | ~shading.any(axis=2)
        if not is_flat.all():
            return greatest
    corners = corners @ to_sonar.T + pose[:3, :3].T @ (body_pose[:3, 3] - pose[:3, 3])
    normals = normals @ to_sonar.T
    apart_m = (normals * corners[:, 0]).sum(axis=1)  # of the planes of the faces from the sonar
    # a face is nearest where the perpendicular meets it, if it does so between the edges
    along = np.roll(corners, -1, axis=1) - corners
    place = -(corners * along).sum(axis=2) / np.maximum((along * along).sum(axis=2), 1e-30)
    edges_m = np.linalg.norm(corners + place.clip(0.0, 1.0)[..., None] * along, axis=2).min(axis=1)
    to_foot = (normals * apart_m[:, None])[:, None] - corners
    is_within = ((np.cross(along, to_foot) * normals[:, None]).sum(axis=2) >= 0.0).all(axis=1)
    cosines = np.abs(apart_m) / np.maximum(edges_m, 1e-9)
    angles = np.where(is_within, 0.0, np.arccos(np.clip(cosines, 0.0, 1.0)))
    angles = np.maximum(angles, _beside_fan_rad(normals * np.sign(apart_m)[:, None], reception))
    cosines = np.minimum(np.cos(angles), greatest_cosine)
    lobe = specular_lobe(cosines, body.specular, body.roughness_rad).max(initial=0.0)
    return float(lobe) if lobe > NO_GLINT * greatest else 0.0


def _beside_fan_rad(directions, reception: Reception) -> np.ndarray:
    """Return by which angle at least (n, 3) directions in the frame of the sonar lie beside its fan, 0 inside."""
    x, y, z = directions.T
    half_azimuth = math.radians(reception.sonar.azimuth_fov_deg) / 2 + reception.reach_rad
    above = np.abs(np.arcsin(np.clip(z, -1.0, 1.0))) - reception.max_elevation_rad
    if reception.are_cones:
        beside = np.abs(np.arcsin(np.clip(y, -1.0, 1.0))) - half_azimuth
    else:
        beside = np.clip(np.abs(np.arctan2(y, x)) - half_azimuth, 0.0, np.pi / 2)
        beside = np.arcsin(np.sin(beside) * np.hypot(x, y).clip(0.0, 1.0))  # meridians meet at the poles
    return np.maximum(np.maximum(above, beside), 0.0)


class _Extents(NamedTuple):
    """What `BodyExtents` measures of n bodies.

    centres, radii_m : (n, 3) and (n,), of a sphere about each, in its frame
    areas_m2 : (n,), the greatest silhouette
    lobes : (n,), the greatest of the specular lobe
    glint_shares : (n,), 1 of bodies without a lobe
    by_face : (n,) bool, whether the reflectivity is one value a face
    own, per_unit : of `GreatestReflectivity`
    """

    centres: np.ndarray
    radii_m: np.ndarray
    areas_m2: np.ndarray
    lobes: np.ndarray
    glint_shares: np.ndarray
    by_face: np.ndarray
    own: np.ndarray
    per_unit: np.ndarray


def _extents(bodies, specular: bool) -> _Extents:
    surfaces = [body.surface for body in bodies]
    spheres = [sphere_about(_used_vertices(surface)) for surface in surfaces]
    radii_m = np.array([sphere.radius_m for sphere in spheres])
    lobes = [
        specular_lobe(cos_of_greatest_lobe(body.roughness_rad), body.specular * specular, body.roughness_rad)
        for body in bodies
    ]
    shares = [
        glint_share(surface, body.roughness_rad) if specular and body.specular > 0 else 1.0
        for surface, body in zip(surfaces, bodies, strict=True)
    ]
    # the silhouette of a surface is half of its area at most, and inside that of its sphere
    silhouettes = [_area_m2(s) / 2 if len(s.faces) <= MAX_FACES else np.inf for s in surfaces]
    return _Extents(
        np.array([sphere.centre for sphere in spheres]).reshape(-1, 3),
        radii_m,
        np.minimum(np.pi * radii_m**2, silhouettes),
        np.array(lobes),
        np.array(shares),
        np.array([np.ndim(body.reflectivity) > 0 for body in bodies], bool),
        *GreatestReflectivity.of(bodies),
    )


class BodyExtents:
    """How much echo each body of a scene could return at most, if nothing stood in front of it.

    Parameters
    ----------
    bodies : of the scene
    specular : with the specular lobes of smooth bodies
    """

    def __init__(self, bodies, specular: bool = False):
        self._specular, self._columns = specular, _extents(bodies, specular)

    @property
    def n_bodies(self) -> int:
        """How many bodies there are."""
        return len(self._columns.radii_m)

    @property
    def glint_shares(self) -> np.ndarray:
        """(bodies + 1,) by number; of bodies without a lobe 1."""
        return np.concatenate([[1.0], self._columns.glint_shares])

    @property
    def by_face(self) -> np.ndarray:
        """(bodies + 1,) bool by number, whether the reflectivity is one value a face."""
        return np.concatenate([[False], self._columns.by_face])

    def sphere_about(self, number: int) -> Sphere:
        """Return the sphere about a body, in its frame; number : of the body, from 1."""
        return Sphere(self._columns.centres[number - 1], float(self._columns.radii_m[number - 1]))

    def add(self, bodies) -> None:
        """Append bodies; those that are there are not measured again."""
        columns = zip(self._columns, _extents(bodies, self._specular), strict=True)
        self._columns = _Extents(*(np.concatenate(pair) for pair in columns))

    def greatest_echo(self, state: SceneState, pose, reception: Reception) -> np.ndarray:
        """Return (bodies + 1,) the most that each body may add to `BodyCounts.echo`; 0 where its sphere is not in view.

        The largest gain and elevation pattern within its sphere weigh all of the solid angle that it may fill.
        """
        out = np.zeros(self.n_bodies + 1)
        if not self.n_bodies:
            return out
        sonar, radii_m = reception.sonar, self._columns.radii_m
        rotations, places = state.poses[:, :3, :3], state.poses[:, :3, 3]
        centres = np.einsum("nij,nj->ni", rotations, self._columns.centres) + places
        x, y, z = ((centres - pose[:3, 3]) @ pose[:3, :3]).T
        distance = np.maximum(np.sqrt(x * x + y * y + z * z), 1e-9)
        sine = np.minimum(radii_m / distance, 1.0)  # of half the angle that the sphere fills
        half_angle = np.where(sine < 1.0, np.arcsin(sine), np.pi)  # the sonar inside it: all directions
        elevation = np.arcsin(z / distance)
        low, high = elevation - half_angle, elevation + half_angle
        half_azimuth = math.radians(sonar.azimuth_fov_deg) / 2 + reception.reach_rad
        cosine = np.cos(elevation)
        beside = np.where(sine < cosine, np.arcsin(np.minimum(sine / np.maximum(cosine, 1e-9), 1.0)), np.pi)
        shown, is_ahead = np.arctan2(y, x), True
        if reception.are_cones:
            shown, beside = np.arcsin(np.clip(y / distance, -1.0, 1.0)), half_angle
            is_ahead = x > -radii_m
        nearest, farthest = distance - radii_m, distance + radii_m
        inside = (
            state.present
            & (nearest < sonar.range_max_m)
            & (farthest > sonar.range_min_m)
            & (np.abs(elevation) - half_angle < reception.max_elevation_rad)
            & (np.abs(shown) - beside < half_azimuth)
            & is_ahead
        )
        angle = np.minimum(self._columns.areas_m2 / np.maximum(nearest, distance / 2) ** 2, 4 * np.pi)
        sines = (np.sin(np.clip(end, -np.pi / 2, np.pi / 2)) for end in (low, high))
        weight = reception.greatest_gain(nearest, farthest) * reception.greatest_pattern(*sines)
        out[1:] = np.where(inside, angle * weight, 0.0) * self.greatest_backscatter(state)
        return out

    def share_in_view(self, number: int, body, state: SceneState, pose, reception: Reception) -> float:
        """Return what share of `greatest_echo` a body may return, as its lobe need not be seen where it is greatest.

        number : of the body, from 1
        """
        lobe, greatest = self._columns.lobes[number - 1], self.greatest_backscatter(state)[number - 1]
        if lobe <= 0.0 or greatest <= 0.0:
            return 1.0
        in_view = greatest_lobe(body, state.poses[number - 1], pose, reception)
        return float((greatest - lobe + in_view) / greatest)

    def greatest_backscatter(self, state: SceneState) -> np.ndarray:
        """Return (bodies,) the most that each may return per steradian: reflectivity and the greatest lobe."""
        greatest = GreatestReflectivity(self._columns.own, self._columns.per_unit)
        return greatest.in_state(state) + self._columns.lobes
