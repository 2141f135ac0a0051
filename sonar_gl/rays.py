"""Rays of the reference: the scene that they meet, where they go, into which bins their echoes fall."""

from __future__ import annotations

import math

import numpy as np
from numba import uint32

from sonar_gl.compiled import compiled
from sonar_gl.types import Error


class Target:
    """A Scene in Embree, in the frame of a sonar at `pose`; taken there in float64 before it is rounded.

    Attributes
    ----------
    n_bodies : count of bodies; faces, lobes : of `land`
    """

    def __init__(self, scene, pose, specular: bool = False):
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise Error(
                "the reference needs Embree (got no module embreex); install it with "
                "\"pip install 'sonar_gl[reference]'\""
            ) from None
        self.embree = EmbreeScene(robust=True)  # no ray slips through between two triangles
        z = scene.surface_z_m
        self.ceiling = None if z is None or pose[2, 3] >= z else (pose[2, :3], z - pose[2, 3])
        self.n_bodies = len(scene.bodies)
        lobes = [(body.specular * specular, body.roughness_rad) for body in scene.bodies]
        self.lobes = np.array(lobes, np.float64).reshape(-1, 2)
        self._keep, reflectivity, normals = [], [np.zeros(0)], [np.zeros((0, 3, 3), np.float32)]
        smooth = any(body.normals is not None for body in scene.bodies)
        for body in scene.bodies:
            rotation = pose[:3, :3].T @ body.pose[:3, :3]
            offset = pose[:3, :3].T @ (body.pose[:3, 3] - pose[:3, 3])
            vertices = np.asarray(body.surface.vertices, np.float64) @ rotation.T + offset
            faces = np.asarray(body.surface.faces)
            self._keep.append(TriangleMesh(self.embree, vertices[faces].astype(np.float32)))
            reflectivity.append(np.broadcast_to(body.reflectivity, len(faces)))
            if smooth:
                at_vertices = np.zeros_like(vertices) if body.normals is None else body.normals @ rotation.T
                normals.append(at_vertices[faces].astype(np.float32))
        counts = [len(body.surface.faces) for body in scene.bodies]
        self.faces = (np.cumsum([0, *counts]), np.concatenate(reflectivity), np.concatenate(normals))
        if self.n_bodies:
            self.hits(np.zeros((1, 3), np.float32), np.eye(3, dtype=np.float32)[:1])  # builds Embree's tree

    def hits(self, origin, ray):
        """Embree's tfar, Ng, u, v, geomID, primID; other Python threads go on meanwhile."""
        found = self.embree.run(origin, ray, output=True)
        if self.ceiling is not None:  # what is met above the water's surface is not
            up, height = self.ceiling
            found["geomID"][(origin + found["tfar"][:, None] * ray) @ up > height] = -1
        return tuple(found[key] for key in ("tfar", "Ng", "u", "v", "geomID", "primID"))


@compiled
def _reverse(x):
    """The 32 bits of x in the opposite order."""
    x = uint32(((x & uint32(0x55555555)) << uint32(1)) | ((x >> uint32(1)) & uint32(0x55555555)))
    x = uint32(((x & uint32(0x33333333)) << uint32(2)) | ((x >> uint32(2)) & uint32(0x33333333)))
    x = uint32(((x & uint32(0x0F0F0F0F)) << uint32(4)) | ((x >> uint32(4)) & uint32(0x0F0F0F0F)))
    x = uint32(((x & uint32(0x00FF00FF)) << uint32(8)) | ((x >> uint32(8)) & uint32(0x00FF00FF)))
    return uint32((x << uint32(16)) | (x >> uint32(16)))


@compiled
def _scramble(x, key):
    """A random permutation in which a bit depends on the bits below it alone (Laine, Karras 2011)."""
    x = uint32(x ^ uint32(x * uint32(0x3D20ADEA)))
    x = uint32(x + key)
    x = uint32(x * uint32((key >> uint32(16)) | uint32(1)))
    x = uint32(x ^ uint32(x * uint32(0x05526C56)))
    return uint32(x ^ uint32(x * uint32(0x53A22864)))


@compiled
def shoot(first, block, log2_blocks, keys, start_rad, span_rad, top, near_m, azimuth, origin, ray):
    """Rays `first` and following of one block of azimuth, out of a scrambled (0, 2)-sequence over the fan.

    Any 2^k rays of the fan, from the first on, have exactly one in every box of 2^-a of the azimuths by
    2^-(k - a) of the elevations: strata of all shapes at once, and twice the rays refine them all.

    Parameters
    ----------
    first : number of the first ray, counted in its block; as many are made as `azimuth` has places
    block, log2_blocks : the fan is 2^log2_blocks blocks of equal azimuth; the keys decide which lies where
    keys : (4,) uint32, random; of them come an own permutation and an own shift for either coordinate
    start_rad, span_rad : first azimuth of the fan, its width; top : sine of the highest elevation
    near_m : rays start this far from the sonar

    azimuth, origin, ray : (n,) float64, (n, 3) float32, (n, 3) float32, overwritten
    """
    directions = np.empty(32, np.uint32)  # of the second Sobol coordinate, one for each bit of a ray's number
    directions[0] = uint32(0x80000000)
    for bit in range(1, 32):
        directions[bit] = directions[bit - 1] ^ (directions[bit - 1] >> uint32(1))
    # numbers run in Gray's order, which changes one bit at a time
    i = (uint32(first ^ (first >> 1)) << uint32(log2_blocks)) | uint32(block)
    y = uint32(0)
    for bit in range(32):
        if (i >> uint32(bit)) & uint32(1):
            y ^= directions[bit]
    for n in range(azimuth.shape[0]):
        across = _reverse(_scramble(i, keys[0])) ^ keys[1]
        up = _reverse(_scramble(_reverse(y), keys[2])) ^ keys[3]
        azimuth[n] = start_rad + span_rad * ((across + 0.5) / 4294967296.0)
        sine = top * ((up + 0.5) / 2147483648.0 - 1.0)
        cosine = math.sqrt(1.0 - sine * sine)
        ray[n, 0] = cosine * math.cos(azimuth[n])
        ray[n, 1] = cosine * math.sin(azimuth[n])
        ray[n, 2] = sine
        for axis in range(3):
            origin[n, axis] = near_m * ray[n, axis]
        bit, number = log2_blocks, first + n + 1
        while number & 1 == 0:
            bit, number = bit + 1, number >> 1
        i ^= uint32(1) << uint32(bit)
        y ^= directions[bit]


@compiled
def land(azimuth, ray, near_m, hits, heard_of, faces, lobes, nodes, hat, heard, bins, gain, sums, bodies):
    """Add the echoes of rays to bins.

    Parameters
    ----------
    azimuth, ray, near_m : of `shoot`
    hits : Embree's tfar, Ng, u, v, geomID, primID
    heard_of : (n,) what counts of each ray's echo
    faces : first face of each body, reflectivity of each face, (F, 3, 3) normals of each face's corners in
        the sonar frame, or (0, 3, 3); a normal of no length leaves the face flat
    lobes : (M - 1, 2) strength and rms slope of each body's lobe
    nodes : (N,) rising azimuths, which enclose these rays
    hat : False: an echo goes to the last node before it; True: to both its neighbours, by closeness
    heard : (N,) how much of an echo at each node all beams together hear
    bins : range_min_m, bins per metre
    gain : (K,) of the bins

    sums : (N, K) float64, μ cos θ and lobes; bodies : (M,) float64, by number of the body, as heard;
        both are added to
    """
    tfar, Ng, bary_u, bary_v, geom, prim = hits
    first_face, reflectivity, normals = faces
    K = sums.shape[1]
    for n in range(azimuth.shape[0]):
        if geom[n] < 0:
            continue
        share = (float(tfar[n]) + near_m - bins[0]) * bins[1]
        if share < 0.0 or share >= K:
            continue
        dx, dy, dz = float(ray[n, 0]), float(ray[n, 1]), float(ray[n, 2])
        nx, ny, nz = float(Ng[n, 0]), float(Ng[n, 1]), float(Ng[n, 2])
        length2 = nx * nx + ny * ny + nz * nz
        if length2 == 0.0:
            continue
        cosine = -(nx * dx + ny * dy + nz * dz) / math.sqrt(length2)
        face = first_face[geom[n]] + prim[n]
        if normals.shape[0] > 0:
            b, c = float(bary_u[n]), float(bary_v[n])
            sx, sy, sz = (
                (1.0 - b - c) * normals[face, 0, 0] + b * normals[face, 1, 0] + c * normals[face, 2, 0],
                (1.0 - b - c) * normals[face, 0, 1] + b * normals[face, 1, 1] + c * normals[face, 2, 1],
                (1.0 - b - c) * normals[face, 0, 2] + b * normals[face, 1, 2] + c * normals[face, 2, 2],
            )
            shading2 = sx * sx + sy * sy + sz * sz
            if shading2 > 1e-6:
                # turned to the side of the face that the sonar sees: what then still looks away is dark
                same_side = (sx * nx + sy * ny + sz * nz) * cosine >= 0.0
                cosine = -(sx * dx + sy * dy + sz * dz) / math.sqrt(shading2)
                cosine = max(cosine if same_side else -cosine, 0.0)
        cosine = min(abs(cosine), 1.0)
        echo = reflectivity[face] * cosine
        strength, slope = lobes[geom[n], 0], lobes[geom[n], 1]
        if strength > 0.0 and cosine > 1e-3:
            steep = (1.0 / (cosine * cosine) - 1.0) / (2.0 * slope * slope)
            echo += strength / (8.0 * slope * slope) * math.exp(-steep) * cosine**-5
        echo *= heard_of[n]
        k = min(int(share), K - 1)
        i = np.searchsorted(nodes, azimuth[n], side="right") - 1
        i = min(max(i, 0), nodes.shape[0] - 2)
        if hat:
            t = (azimuth[n] - nodes[i]) / (nodes[i + 1] - nodes[i])
            sums[i, k] += (1.0 - t) * echo
            sums[i + 1, k] += t * echo
            bodies[geom[n] + 1] += gain[k] * echo * ((1.0 - t) * heard[i] + t * heard[i + 1])
        else:
            sums[i, k] += echo
            bodies[geom[n] + 1] += gain[k] * echo * heard[i]


@compiled
def hear(sums, beams, weights, out):
    """Add to each of `beams`, rows of out, its weighted sum of the rows of sums.

    NumPy's product of matrices, called from two threads at once, is ten times slower.

    Parameters
    ----------
    sums : (N, K); beams : (b,) whole numbers; weights : (b, N); out : (B, K) float64
    """
    for b in range(len(beams)):
        for i in range(sums.shape[0]):
            weight = weights[b, i]
            if weight != 0.0:
                for k in range(sums.shape[1]):
                    out[beams[b], k] += weight * sums[i, k]
