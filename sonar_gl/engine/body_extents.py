"""What each body of a scene could return at most, if nothing stood in front of it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.boundary import cos_of_greatest_lobe, specular_lobe
from sonar_gl.core.compiled import compiled
from sonar_gl.core.poses import scale_of, scales_of
from sonar_gl.engine.reception import Reception
from sonar_gl.scene.state import GreatestReflectivity, SceneState
from sonar_gl.sonar.sonar import Sonar

MAX_FACES = 200_000  # of larger meshes the box stands for the area: summing their faces costs too much
GLINT_REACH = 4.0  # times the rms slope: beyond, a specular lobe has 10⁻⁴ of its echo
MAX_FLAT_FACES = 12  # directions of a body whose faces are flat: it is a glint as a whole, or not at all
NO_GLINT = 1e-26  # of the greatest lobe: a sample with less returns nothing
LEAST_ROUND = 0.2  # of a sphere's normals in one direction: cylinders, and no floors, have more in two
MAX_CLIPPED_FACES = 1024  # of larger meshes about so many: their edges are short
FLAT = 1e-6  # of a radius: a surface that departs no more from a plane has no edge that returns an echo
EDGE_ON_RAD = 1e-6  # about the rounding of samples: a plane that is seen at less has none


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


def plane_of(points) -> np.ndarray:
    """Return the unit normal of the plane in which (n, 3) points lie and its distance from the origin, (4,), or NaN.

    Some of the points find it, and all of them are tested.
    """
    some = points[:: 1 + len(points) // MAX_CLIPPED_FACES] - points[0]
    axis = some[(some * some).sum(axis=1).argmax()]
    across = np.cross(axis, some)
    normal = across[(across * across).sum(axis=1).argmax()]
    length, radius_m = np.linalg.norm(normal), np.linalg.norm(axis)
    most = FLAT * radius_m * length
    if length == 0.0 or any(np.abs(away @ normal).max() > most for away in (some, points - points[0])):
        return np.full(4, np.nan)
    return np.append(normal, points[0] @ normal) / length


def _silhouette_m2(surface) -> float:
    """Return half of the area of a surface, which its silhouette does not exceed; infinite for one of many faces."""
    if len(surface.faces) > MAX_FACES:
        return np.inf
    a, b, c = np.asarray(surface.vertices, np.float64)[np.asarray(surface.faces).T]
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 4)


def glint_share(surface, roughness_rad: float) -> float:
    """Return the share of a smooth body's outline that returns nearly all of its echo, 1 where its faces are flat.

    Facets within GLINT_REACH times the roughness of the direction of the sonar do, all but 10⁻⁴ of the lobe: of a round
    body, a part of its outline as wide as that share in both directions; of a cylinder, which is round in one direction
    alone, a strip.
    """
    normals, areas = _normals_and_areas(surface)
    if _has_flat_faces(normals):
        return 1.0
    _, axes = np.linalg.eigh(normals.T @ (areas[:, None] * normals))
    is_beside = np.abs(normals @ axes[:, 0]) < 0.1  # the axis that the fewest normals follow
    is_round_once = areas[is_beside].sum() > 0.7 * areas.sum()
    return min(1.0, GLINT_REACH * roughness_rad) ** (1 if is_round_once else 2)


def is_round(surface) -> bool:
    """Return whether a surface is curved all round, about a point or an axis, as neither a box nor a floor is."""
    normals, areas = _normals_and_areas(surface)
    if _has_flat_faces(normals):
        return False
    spread = np.linalg.eigvalsh(normals.T @ (areas[:, None] * normals))
    return bool(
        spread[1] > LEAST_ROUND * areas.sum() / 3 and np.linalg.norm(areas @ normals) < 0.1 * areas.sum()
    )


def _normals_and_areas(surface) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals (n, 3) of about MAX_CLIPPED_FACES faces that have an area, and twice these areas (n,)."""
    faces = np.asarray(surface.faces)
    a, b, c = np.asarray(surface.vertices, np.float64)[faces[:: 1 + len(faces) // MAX_CLIPPED_FACES].T]
    cross = np.cross(b - a, c - a)
    areas = np.linalg.norm(cross, axis=1)
    return cross[areas > 0] / areas[areas > 0, None], areas[areas > 0]


def _has_flat_faces(normals) -> bool:
    return len(np.unique(normals.round(2), axis=0)) <= MAX_FLAT_FACES


def greatest_lobe(body, body_pose, pose, reception: Reception) -> float:
    """Return the most that the specular lobe of a body with flat faces may return per steradian in the fan.

    A ray of the fan meets a flat face at no less than the angle between the face's normal and the fan, nor than where
    the face is nearest to the sonar. Faces with other shading normals, and those of large meshes, count as those at
    the angle where their lobe is greatest, which is face on but for large roughness.

    body, body_pose, pose : of `is_unobstructed`
    """
    greatest_cosine = cos_of_greatest_lobe(body.roughness_rad)
    greatest = float(specular_lobe(greatest_cosine, body.specular, body.roughness_rad))
    surface, to_sonar = body.surface, pose[:3, :3].T @ body_pose[:3, :3]
    scale = scale_of(body_pose)
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
    normals = normals @ to_sonar.T / scale
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
    planes : (n, 4), of `plane_of`, in its frame
    lobes : (n,), the greatest of the specular lobe
    glint_shares : (n,), 1 of bodies without a lobe
    mean_lobes : (n,), what a sphere returns per steradian of its outline by the lobe; 0 of bodies without a lobe, and
        of those with a vertex without a shading normal
    by_face : (n,) bool, whether the reflectivity is one value a face
    are_round : (n,) bool, of `is_round`
    own, per_unit : of `GreatestReflectivity`
    """

    centres: np.ndarray
    radii_m: np.ndarray
    areas_m2: np.ndarray
    planes: np.ndarray
    lobes: np.ndarray
    glint_shares: np.ndarray
    mean_lobes: np.ndarray
    by_face: np.ndarray
    are_round: np.ndarray
    own: np.ndarray
    per_unit: np.ndarray


def _extents(bodies, specular: bool) -> _Extents:
    surfaces = [body.surface for body in bodies]
    different = {id(surface): surface for surface in surfaces}  # bodies may share one
    measured = {key: _measured(surface) for key, surface in different.items()}
    of_bodies = [measured[id(surface)] for surface in surfaces]
    spheres, planes, silhouettes_m2, are_round = zip(*of_bodies, strict=True) if surfaces else ((),) * 4
    radii_m = np.array([sphere.radius_m for sphere in spheres])
    lobes = [
        specular_lobe(cos_of_greatest_lobe(body.roughness_rad), body.specular * specular, body.roughness_rad)
        for body in bodies
    ]
    shares = [
        glint_share(surface, body.roughness_rad) if specular and body.specular > 0 else 1.0
        for surface, body in zip(surfaces, bodies, strict=True)
    ]
    return _Extents(
        np.array([sphere.centre for sphere in spheres]).reshape(-1, 3),
        radii_m,
        np.minimum(np.pi * radii_m**2, silhouettes_m2),  # inside that of the sphere
        np.array(planes).reshape(-1, 4),
        np.array(lobes),
        np.array(shares),
        np.array([body.specular * specular / 4 if _is_shaded(body) else 0.0 for body in bodies]),
        np.array([np.ndim(body.reflectivity) > 0 for body in bodies], bool),
        np.array(are_round, bool),
        *GreatestReflectivity.of(bodies),
    )


def _measured(surface) -> tuple[Sphere, np.ndarray, float, bool]:
    """Return the sphere about a surface, its plane, its greatest silhouette, and whether it is round."""
    points = _used_vertices(surface)
    return sphere_about(points), plane_of(points), _silhouette_m2(surface), is_round(surface)


def _is_shaded(body) -> bool:
    """Return whether a body has shading normals all over, so that its lobe is a mean over each sample."""
    if body.normals is None:
        return False
    has_normal = np.any(body.normals, axis=1)
    # vertices that no face uses need none
    return bool(has_normal.all() or has_normal[np.asarray(body.surface.faces)].all())


@compiled
def _fill_greatest(bodies, limits, gain, elevation_table, out):
    """Fill `out`, (bodies + 1,), with what `BodyExtents.greatest_echo` returns.

    bodies : centres of spheres in the frame of the sonar, (n, 3); their radii, the greatest silhouettes, and the most
        that each body may return per steradian, 0 of absent ones
    limits : least and greatest range, length of a bin, half of the azimuths, greatest elevation; are_cones
    gain, elevation_table : of `Reception`
    """
    centres, radii_m, areas_m2, backscatter = bodies
    range_min_m, range_max_m, bin_size_m, half_azimuth_rad, max_elevation_rad, are_cones = limits
    for n in range(len(radii_m)):
        x, y, z, radius_m = centres[n, 0], centres[n, 1], centres[n, 2], radii_m[n]
        distance_m = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        nearest_m, farthest_m = distance_m - radius_m, distance_m + radius_m
        if backscatter[n] <= 0.0 or nearest_m >= range_max_m or farthest_m <= range_min_m:
            continue
        sine = min(radius_m / distance_m, 1.0)  # of half the angle that the sphere fills
        half_rad = math.asin(sine) if sine < 1.0 else math.pi  # the sonar inside it: all directions
        elevation_rad = math.asin(z / distance_m)
        if abs(elevation_rad) - half_rad >= max_elevation_rad:
            continue
        if are_cones:
            shown_rad, beside_rad = math.asin(min(max(y / distance_m, -1.0), 1.0)), half_rad
            if x <= -radius_m:
                continue
        else:
            shown_rad, cosine = math.atan2(y, x), math.cos(elevation_rad)
            beside_rad = math.asin(min(sine / max(cosine, 1e-9), 1.0)) if sine < cosine else math.pi
        if abs(shown_rad) - beside_rad >= half_azimuth_rad:
            continue
        angle_sr = min(areas_m2[n] / max(nearest_m, distance_m / 2) ** 2, 4 * math.pi)
        low_rad = max(elevation_rad - half_rad, -math.pi / 2)
        high_rad = min(elevation_rad + half_rad, math.pi / 2)
        weight = greatest_gain(gain, range_min_m, bin_size_m, nearest_m, farthest_m)
        weight *= greatest_pattern(elevation_table, math.sin(low_rad), math.sin(high_rad))
        out[n + 1] = angle_sr * weight * backscatter[n]


@compiled
def greatest_gain(gain, range_min_m, bin_size_m, nearest_m, farthest_m):
    """Return the greatest (K,) gain of the bins between two ranges, of which a part lies in the bins."""
    first, last = (nearest_m - range_min_m) / bin_size_m, (farthest_m - range_min_m) / bin_size_m
    return _greatest(gain, math.floor(first), math.floor(last))


@compiled
def greatest_pattern(elevation_table, low_sine, high_sine):
    """Return the greatest two-way elevation pattern between two sines; elevation_table : of `Reception`."""
    if not elevation_table.shape[0]:
        return 1.0
    per_sine = (elevation_table.shape[0] - 1) / 2
    first, last = per_sine + per_sine * low_sine, per_sine + per_sine * high_sine
    return _greatest(elevation_table, math.floor(first), math.ceil(last))


@compiled
def _greatest(values, first, last):
    """Return the greatest of some values from one place to another, both included, as far as there are such places."""
    out, n = 0.0, len(values)
    for k in range(int(min(max(first, 0), n - 1)), int(min(max(last, 0), n - 1)) + 1):
        out = max(out, values[k])
    return out


class BodyExtents:
    """How much echo each body of a scene could return at most, if nothing stood in front of it.

    bodies : of the scene
    specular : with the specular lobes of smooth bodies
    """

    def __init__(self, bodies, specular: bool = False):
        self._specular, self._columns = specular, _extents(bodies, specular)

    @property
    def n_bodies(self) -> int:
        """How many bodies there are."""
        return len(self._columns.radii_m)

    def glint_shares(self, echo: np.ndarray, greatest: np.ndarray, state: SceneState) -> np.ndarray:
        """Return (bodies + 1,) by number, which share of the samples on a body tell how well its glint is met.

        Those in it, by `glint_share`. Where a lobe is a mean over each sample, no glint is too narrow for the samples,
        but one on too small a part of the body may be: as many count as a sphere of that echo would have, if these are
        more. By its lobe a sphere returns |R|²/4 per steradian of its outline. Bodies without a lobe have 1.

        echo : as of `BodyCounts`
        greatest : as of `greatest_echo`
        """
        columns = self._columns
        backscatter, diffuse = self.greatest_backscatter(state), self._greatest_diffuse(state)
        mean = echo[1:] / np.maximum(greatest[1:], 1e-30) * backscatter
        by_echo = (mean - diffuse) / np.where(columns.mean_lobes > 0.0, columns.mean_lobes, np.inf)
        return np.concatenate([[1.0], np.clip(by_echo, columns.glint_shares, 1.0)])

    @property
    def by_face(self) -> np.ndarray:
        """(bodies + 1,) bool by number, whether the reflectivity is one value a face."""
        return np.concatenate([[False], self._columns.by_face])

    @property
    def are_round(self) -> np.ndarray:
        """(bodies + 1,) bool by number, whether the surface is curved and faces all directions."""
        return np.concatenate([[False], self._columns.are_round])

    @property
    def are_smooth(self) -> np.ndarray:
        """(bodies + 1,) bool by number, whether the body has a specular lobe."""
        return np.concatenate([[False], self._columns.lobes > 0.0])

    @property
    def are_means(self) -> np.ndarray:
        """(bodies + 1,) bool by number, whether the body has a lobe, which is a mean about each sample."""
        return np.concatenate([[False], self._columns.mean_lobes > 0.0])

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
        centres = np.einsum("nij,nj->ni", state.poses[:, :3, :3], self._columns.centres)
        centres += state.poses[:, :3, 3] - pose[:3, 3]
        scales = scales_of(state.poses)
        spheres = np.ascontiguousarray(centres @ pose[:3, :3]), scales * self._columns.radii_m
        backscatter = self.greatest_backscatter(state) * state.present
        bodies = *spheres, scales**2 * self._columns.areas_m2, backscatter
        sonar = reception.sonar
        # those of a sonar may be whole numbers, for which the function would be compiled once more
        ranges_m = float(sonar.range_min_m), float(sonar.range_max_m), sonar.bin_size_m
        half_azimuth_rad = math.radians(sonar.azimuth_fov_deg) / 2 + reception.reach_rad
        limits = *ranges_m, half_azimuth_rad, reception.max_elevation_rad, reception.are_cones
        _fill_greatest(bodies, limits, reception.gain, reception.elevation_table, out)
        return out

    def share_in_view(self, number: int, body, state: SceneState, pose, reception: Reception) -> float:
        """Return what share of `greatest_echo` a body may return at most from where it is seen.

        Its lobe need not be seen where it is greatest, and a body in one plane not face on.

        number : of the body, from 1
        """
        open_share = self._open_share(number, state.poses[number - 1], pose, reception.sonar)
        lobe, greatest = self._columns.lobes[number - 1], self.greatest_backscatter(state)[number - 1]
        if lobe <= 0.0 or greatest <= 0.0 or open_share <= 0.0:
            return open_share
        in_view = greatest_lobe(body, state.poses[number - 1], pose, reception)
        return open_share * float((greatest - lobe + in_view) / greatest)

    def _open_share(self, number: int, body_pose, pose, sonar: Sonar) -> float:
        """Return what share of its greatest silhouette a body may show in range: less than 1 of one in a plane.

        0 where the sonar lies in that plane, within rounding.
        """
        columns = self._columns
        normal, distance = columns.planes[number - 1, :3], columns.planes[number - 1, 3]
        if np.isnan(distance):
            return 1.0
        scale = scale_of(body_pose)
        at = body_pose[:3, :3].T @ (pose[:3, 3] - body_pose[:3, 3]) / scale**2
        radius_m = columns.radii_m[number - 1]
        nearest = np.linalg.norm(at - columns.centres[number - 1]) - radius_m
        sine = abs(normal @ at - distance) / max(nearest, sonar.range_min_m / scale, 1e-9)
        if sine < EDGE_ON_RAD:
            return 0.0
        # no layer of the plane hides another, so that those that are seen lie inside the circle about it
        return float(min(1.0, np.pi * radius_m**2 * sine / columns.areas_m2[number - 1]))

    def greatest_backscatter(self, state: SceneState) -> np.ndarray:
        """Return (bodies,) the most that each may return per steradian: reflectivity and the greatest lobe."""
        return self._greatest_diffuse(state) + self._columns.lobes

    def _greatest_diffuse(self, state: SceneState) -> np.ndarray:
        return GreatestReflectivity(self._columns.own, self._columns.per_unit).in_state(state)
