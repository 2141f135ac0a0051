"""The tables that the rasteriser reads and writes: patches, bodies, triangles, and the visibility buffer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# of `PlacedBodies.table`, as in `sonar_gl/raster/cull.py`, whose constants these functions must not read
ROW_REFLECTIVITY, ROW_STRENGTH, ROW_SLOPE = 12, 14, 15
# of `Triangles.bodies`: faces without shading normals; the echo of FLAT_DIFFUSE is μ cos θ alone
FLAT, FLAT_DIFFUSE = -1, -2
NOTHING, SINGLE = -1, -2  # of `SectorSamples.face_id`


class PatchFaces(NamedTuple):
    """Faces of all patches: fields of `Levels`."""

    first_vertex: np.ndarray
    n_vertices: np.ndarray
    first_face: np.ndarray
    n_faces: np.ndarray
    faces: np.ndarray
    box: np.ndarray


class Vertices(NamedTuple):
    """Vertices of all patches.

    points : (W, 3) float32 positions
    normals, reflectivity : (W, 3) and (W,), or of no length
    """

    points: np.ndarray
    normals: np.ndarray
    reflectivity: np.ndarray


class PlacedBodies(NamedTuple):
    """Bodies as seen from one pose.

    matrices : (n, 3, 4) sonar_from_body
    table : (n, 16), of which ROW_REFLECTIVITY is the reflectivity, ROW_STRENGTH and ROW_SLOPE are of the specular lobe
    is_cut : (n,) bool, bodies that the clip plane cuts
    closed : (n,) 0 for open meshes
    outside : back faces of closed bodies are not visible
    plane : (4,) clip plane in the sonar's frame: only a · (x, y, z, 1) > 0 is drawn
    """

    matrices: np.ndarray
    table: np.ndarray
    is_cut: np.ndarray
    closed: np.ndarray
    outside: bool
    plane: np.ndarray


class Triangles(NamedTuple):
    """The triangles of a visibility buffer; overwritten.

    planes : (T, 4) float32: slopes of 1/x along u and v, distance of the plane (cos θ times range), reflectivity
    bodies : (T, 3) int32: index of the body; row of `normals`, or FLAT, or FLAT_DIFFUSE; number of the face among those
        of all bodies
    normals : (T', 9) normal over x, as a linear form of the sample's column and row, in the sector's frame; T' is T
        where meshes have shading normals, else 0
    """

    planes: np.ndarray
    bodies: np.ndarray
    normals: np.ndarray


class VisibilityBuffer(NamedTuple):
    """What is nearest in each sample of a window; overwritten.

    depth : (H, W) float32, 1/x; 0 where there is nothing
    triangle : (H, W) int32 row of `Triangles`, where `depth` > 0
    """

    depth: np.ndarray
    triangle: np.ndarray
