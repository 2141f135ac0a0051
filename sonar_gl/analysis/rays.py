"""Ray casting for the reference: the scene in Embree, a low-discrepancy set of rays, and the sums of their echoes.

The records below are NamedTuples, since compiled functions take them as they are. Finding their types takes some
60 µs per call, one per cent of the time that a batch of rays takes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import uint32

from sonar_gl.core.compiled import compiled, inlined
from sonar_gl.core.extras import missing_extra
from sonar_gl.sonar.fan import SURFACE_MARGIN_M


def embree_classes() -> tuple[type, type]:
    """Return Embree's classes EmbreeScene and TriangleMesh, or raise Error where Embree is missing."""
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError:
        raise missing_extra("reference", "the reference needs Embree (got no module embreex)") from None
    return EmbreeScene, TriangleMesh


class Aperture(NamedTuple):
    """The directions of the rays: azimuths from `start_rad`, `span_rad` wide; sine of the highest elevation.

    With `are_cones` each azimuth is that of a cone about the axis of a line array, as the array shows it, and rays are
    spread evenly around the cone, up to the elevation and the true azimuth that have `max_sine` and `max_tan`.
    """

    start_rad: float
    span_rad: float
    max_sine: float
    are_cones: bool = False
    max_tan: float = 0.0


class Rays(NamedTuple):
    """n rays."""

    azimuth_rad: np.ndarray  # (n,) float64, where the sonar shows the ray
    origin: np.ndarray  # (n, 3) float32, metres, `start_m` from the sonar along the ray
    direction: np.ndarray  # (n, 3) float32, unit vectors in the sonar frame
    start_m: float  # range at which the rays start, metres
    # (n,) float64, of the solid angle for which a ray stands, over the mean that upright beams have
    share: np.ndarray


class Hits(NamedTuple):
    """The first face on each of n rays, as Embree returns it."""

    distance_m: np.ndarray  # (n,) float32 from the ray's origin
    normal: np.ndarray  # (n, 3) float32 of the face, of any length
    # u, v: (n,) float32 barycentric coordinates of the second and third corner
    u: np.ndarray
    v: np.ndarray
    body: np.ndarray  # (n,) int32 index of the body; -1 where the ray hits nothing
    face: np.ndarray  # (n,) int32 index of the face in its body


class Surfaces(NamedTuple):
    """What M bodies with F faces reflect."""

    first_face: np.ndarray  # (M + 1,) int64 index of the first face of each body in the arrays of faces
    reflectivity: np.ndarray  # (F,) float64
    # (F, 3, 3) float32 normals at the corners of each face in the sonar frame, or (0, 3, 3) if no body has any; a face
    # whose normals have no length is flat
    corner_normals: np.ndarray
    lobe: np.ndarray  # (M, 2) float64 strength and rms slope, radians, of each body's specular lobe


class Nodes(NamedTuple):
    """Azimuths at which the echoes of one block of the fan are summed before they are formed into beams."""

    azimuth_rad: np.ndarray  # (N,) rising, enclosing all rays of the block
    # True divides an echo between its two neighbours, linearly; False adds it to the node before it
    interpolated: bool
    total_weight: np.ndarray  # (N,) weight of an echo at each node in the sum of all beams


class Bins(NamedTuple):
    """K range bins: where the first begins, bins per metre, and the (K,) float64 range gain."""

    range_min_m: float
    per_m: float
    gain: np.ndarray


class RayScene:
    """A Scene in Embree, in the frame of a sonar at `pose`; transformed in float64 before it is rounded to float32.

    scene : Scene
    pose : (4, 4) world_from_sonar
    specular : whether bodies have specular lobes
    """

    def __init__(self, scene, pose, specular: bool):
        EmbreeScene, TriangleMesh = embree_classes()
        self._embree = EmbreeScene(robust=True)  # no ray passes between two adjacent triangles
        self._meshes = []  # Embree holds no reference to them
        self._water_surface = None  # its normal and offset, if the sonar is below it
        if scene.surface_z_m is not None and pose[2, 3] < scene.surface_z_m:
            self._water_surface = pose[2, :3], scene.surface_z_m - SURFACE_MARGIN_M - pose[2, 3]
        self.n_bodies = len(scene.bodies)
        reflectivity, normals = [np.zeros(0)], [np.zeros((0, 3, 3), np.float32)]
        has_normals = any(body.normals is not None for body in scene.bodies)
        for body in scene.bodies:
            rotation = pose[:3, :3].T @ body.pose[:3, :3]
            offset = pose[:3, :3].T @ (body.pose[:3, 3] - pose[:3, 3])
            vertices = np.asarray(body.surface.vertices, np.float64) @ rotation.T + offset
            faces = np.asarray(body.surface.faces)
            self._meshes.append(TriangleMesh(self._embree, vertices[faces].astype(np.float32)))
            reflectivity.append(np.broadcast_to(body.reflectivity, len(faces)))
            if has_normals:
                at_vertices = np.zeros_like(vertices) if body.normals is None else body.normals @ rotation.T
                normals.append(at_vertices[faces].astype(np.float32))
        lobe = [(body.specular * specular, body.roughness_rad) for body in scene.bodies]
        self.surfaces = Surfaces(
            first_face=np.cumsum([0, *(len(body.surface.faces) for body in scene.bodies)]),
            reflectivity=np.concatenate(reflectivity),
            corner_normals=np.concatenate(normals),
            lobe=np.array(lobe, np.float64).reshape(-1, 2),
        )
        if self.n_bodies:  # the first query builds Embree's tree, which threads must not do at once
            self._embree.run(np.zeros((1, 3), np.float32), np.eye(3, dtype=np.float32)[:1])

    def hits(self, rays: Rays) -> Hits:
        """Return what the rays hit. Other Python threads run meanwhile."""
        found = self._embree.run(rays.origin, rays.direction, output=True)
        hits = Hits(*(found[key] for key in ("tfar", "Ng", "u", "v", "geomID", "primID")))
        if self._water_surface is not None:  # the water's surface hides what is above it
            normal, offset = self._water_surface
            point = rays.origin + hits.distance_m[:, None] * rays.direction
            hits.body[point @ normal > offset] = -1
        return hits


@compiled
def _reverse_bits(x):
    """Return the 32 bits of x in the opposite order."""
    x = uint32(((x & uint32(0x55555555)) << uint32(1)) | ((x >> uint32(1)) & uint32(0x55555555)))
    x = uint32(((x & uint32(0x33333333)) << uint32(2)) | ((x >> uint32(2)) & uint32(0x33333333)))
    x = uint32(((x & uint32(0x0F0F0F0F)) << uint32(4)) | ((x >> uint32(4)) & uint32(0x0F0F0F0F)))
    x = uint32(((x & uint32(0x00FF00FF)) << uint32(8)) | ((x >> uint32(8)) & uint32(0x00FF00FF)))
    return uint32((x << uint32(16)) | (x >> uint32(16)))


@compiled
def _scramble(x, key):
    """Return a random permutation of x in which each bit depends on lower bits only.

    Source: Laine, Karras, "Stratified sampling for stochastic transparency", 2011.
    """
    x = uint32(x ^ uint32(x * uint32(0x3D20ADEA)))
    x = uint32(x + key)
    x = uint32(x * uint32((key >> uint32(16)) | uint32(1)))
    x = uint32(x ^ uint32(x * uint32(0x05526C56)))
    return uint32(x ^ uint32(x * uint32(0x53A22864)))


@compiled
def _end_of_cone(azimuth, aperture):
    """Return the angle around a cone, from the horizon, at which the highest elevation or greatest azimuth lies."""
    above = math.asin(min(aperture.max_sine / math.cos(azimuth), 1.0))
    return min(above, math.acos(min(abs(math.tan(azimuth)) / aperture.max_tan, 1.0)))


@compiled
def generate_rays(rays, first, block, log2_blocks, keys, aperture):
    """Overwrite `rays` with consecutive rays of one block of azimuth, from a scrambled (0, 2)-sequence.

    Any 2^k rays of the aperture, from the first on, have exactly one in every box of 2^-a of the azimuths by
    2^-(k - a) of the sines of elevation: strata of all shapes at once, and twice the rays refine all of them.

    rays : Rays, overwritten but for `start_m`
    first : index of the first ray in its block
    block, log2_blocks : the aperture is 2^log2_blocks blocks of equal azimuth; the keys decide which one has which
        index
    keys : (4,) uint32, random: a permutation and a digital shift for each of the two coordinates
    """
    directions = np.empty(32, np.uint32)  # of the second Sobol coordinate, one for each bit of a ray's index
    directions[0] = uint32(0x80000000)
    for bit in range(1, 32):
        directions[bit] = directions[bit - 1] ^ (directions[bit - 1] >> uint32(1))
    # indices follow the Gray code, which changes one bit at a time
    i = (uint32(first ^ (first >> 1)) << uint32(log2_blocks)) | uint32(block)
    y = uint32(0)
    for bit in range(32):
        if (i >> uint32(bit)) & uint32(1):
            y ^= directions[bit]
    for n in range(rays.azimuth_rad.shape[0]):
        across = _reverse_bits(_scramble(i, keys[0])) ^ keys[1]
        up = _reverse_bits(_scramble(_reverse_bits(y), keys[2])) ^ keys[3]
        azimuth = aperture.start_rad + aperture.span_rad * ((across + 0.5) / 4294967296.0)
        sine = aperture.max_sine * ((up + 0.5) / 2147483648.0 - 1.0)
        cosine = math.sqrt(1.0 - sine * sine)
        rays.azimuth_rad[n], rays.share[n] = azimuth, 1.0
        if aperture.are_cones:
            end = _end_of_cone(azimuth, aperture)
            turn, level = end * sine / aperture.max_sine, math.cos(azimuth)
            rays.share[n] = level * end / aperture.max_sine
            rays.direction[n, 0] = level * math.cos(turn)
            rays.direction[n, 1] = math.sin(azimuth)
            rays.direction[n, 2] = level * math.sin(turn)
        else:
            rays.direction[n, 0] = cosine * math.cos(azimuth)
            rays.direction[n, 1] = cosine * math.sin(azimuth)
            rays.direction[n, 2] = sine
        for axis in range(3):
            rays.origin[n, axis] = rays.start_m * rays.direction[n, axis]
        bit, number = log2_blocks, first + n + 1
        while number & 1 == 0:
            bit, number = bit + 1, number >> 1
        i ^= uint32(1) << uint32(bit)
        y ^= directions[bit]


@inlined
def _cos_incidence(rays, hits, n, corner_normals, face):
    """Return cos θ of ray number n on the face that it hits, 0..1; 0 if the face has no area.

    Interpolated normals are turned to the side of the face that the sonar is on. Where they still point away from
    the sonar, cos θ is 0.
    """
    dx, dy, dz = float(rays.direction[n, 0]), float(rays.direction[n, 1]), float(rays.direction[n, 2])
    nx, ny, nz = float(hits.normal[n, 0]), float(hits.normal[n, 1]), float(hits.normal[n, 2])
    length2 = nx * nx + ny * ny + nz * nz
    cosine = 0.0
    if length2 > 0.0:
        cosine = -(nx * dx + ny * dy + nz * dz) / math.sqrt(length2)
        if corner_normals.shape[0] > 0:
            b, c = float(hits.u[n]), float(hits.v[n])
            a = 1.0 - b - c
            # not in a loop, where the compiler would join other products and sums, so that the last bits differ
            sx = (
                a * corner_normals[face, 0, 0]
                + b * corner_normals[face, 1, 0]
                + c * corner_normals[face, 2, 0]
            )
            sy = (
                a * corner_normals[face, 0, 1]
                + b * corner_normals[face, 1, 1]
                + c * corner_normals[face, 2, 1]
            )
            sz = (
                a * corner_normals[face, 0, 2]
                + b * corner_normals[face, 1, 2]
                + c * corner_normals[face, 2, 2]
            )
            shading2 = sx * sx + sy * sy + sz * sz
            if shading2 > 1e-6:
                same_side = (sx * nx + sy * ny + sz * nz) * cosine >= 0.0
                cosine = -(sx * dx + sy * dy + sz * dz) / math.sqrt(shading2)
                cosine = max(cosine if same_side else -cosine, 0.0)
    return min(abs(cosine), 1.0)


@inlined
def backscatter(cosine, reflectivity, strength, slope_rad):
    """Return the diffuse (Lambert) backscatter μ cos θ plus the specular (Kirchhoff) lobe.

    The lobe is strength / (8 s²) exp(−tan²θ / (2 s²)) / cos⁵θ with the rms slope s.

    >>> backscatter(0.5, 0.8, 0.0, 0.1)
    0.4
    """
    out = reflectivity * cosine
    if strength > 0.0 and cosine > 1e-3:
        steep = (1.0 / (cosine * cosine) - 1.0) / (2.0 * slope_rad * slope_rad)
        out += strength / (8.0 * slope_rad * slope_rad) * math.exp(-steep) * cosine**-5
    return out


@compiled
def add_echoes(rays, hits, weights, surfaces, nodes, bins, node_sums, body_sums):
    """Add the echo of each ray to the bin of its range.

    weights : (n,) factor of each ray's echo
    node_sums : (N, K) float64, backscatter without gain; added to
    body_sums : (M + 1,) float64, backscatter with gain in the sum of all beams, by number of the body; added to
    """
    K = node_sums.shape[1]
    for n in range(rays.azimuth_rad.shape[0]):
        body = hits.body[n]
        if body < 0:
            continue
        position = (float(hits.distance_m[n]) + rays.start_m - bins.range_min_m) * bins.per_m
        if position < 0.0 or position >= K:
            continue
        face = surfaces.first_face[body] + hits.face[n]
        cosine = _cos_incidence(rays, hits, n, surfaces.corner_normals, face)
        echo = backscatter(
            cosine, surfaces.reflectivity[face], surfaces.lobe[body, 0], surfaces.lobe[body, 1]
        )
        echo *= weights[n]
        k = min(int(position), K - 1)
        azimuth = nodes.azimuth_rad
        i = np.searchsorted(azimuth, rays.azimuth_rad[n], side="right") - 1
        i = min(max(i, 0), azimuth.shape[0] - 2)
        if nodes.interpolated:
            t = (rays.azimuth_rad[n] - azimuth[i]) / (azimuth[i + 1] - azimuth[i])
            node_sums[i, k] += (1.0 - t) * echo
            node_sums[i + 1, k] += t * echo
            total_weight = (1.0 - t) * nodes.total_weight[i] + t * nodes.total_weight[i + 1]
        else:
            node_sums[i, k] += echo
            total_weight = nodes.total_weight[i]
        body_sums[body + 1] += bins.gain[k] * echo * total_weight


@compiled
def form_beams(node_sums, beams, weights, out):
    """Add to the rows `beams` of `out` their weighted sums of the rows of `node_sums`.

    NumPy's matrix product, called from two threads at once, is ten times slower.

    node_sums : (N, K) float64
    beams : (b,) int64 indices of beams
    weights : (b, N) float64
    out : (B, K) float64, added to
    """
    for b in range(len(beams)):
        for i in range(node_sums.shape[0]):
            weight = weights[b, i]
            if weight != 0.0:
                for k in range(node_sums.shape[1]):
                    out[beams[b], k] += weight * node_sums[i, k]
