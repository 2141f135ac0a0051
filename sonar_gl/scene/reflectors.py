"""Planar reflectors of a scene, which make multipath echoes: the water's surface and flat parts of bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.acoustics.boundary import coherent_loss, rayleigh_reflection
from sonar_gl.core.poses import scale_of
from sonar_gl.scene.materials import Material, material
from sonar_gl.scene.scene import Body, Scene

# A planar part of a body must be wide compared with √(λ r), which is 13 cm at 900 kHz and 10 m. And it must
# be a share of the body's area: the facets of terrain do not reflect coherently.
MIN_AREA_M2, MIN_AREA_SHARE = 0.5, 0.02
MAX_FACES = 50_000  # larger meshes are taken for terrain, which is not flat
MAX_PLANES = 6  # of a body; the largest are taken
# Radians, and share of half the size of the mesh, by which faces of one plane may differ. On a mesh of 400 m steps of
# 2 cm are one plane, too.
COPLANAR = 1e-4
DEFAULT_ROUGHNESS_M = 1e-3  # assumed rms height of bodies that have neither a material nor a specular lobe
N_SINES = 257  # reflection coefficients are tabulated by the sine of the grazing angle


@dataclass(frozen=True, eq=False)
class PlanarReflector:
    """A plane that reflects coherently, in the frame of a body or of the world.

    body : index into `scene.bodies`; None for the water's surface
    normal, offset_m : the plane is normal · x = offset_m, in the body's frame or the world's
    reflection_coefficient : (N_SINES,) of the intensity, by the sine of the grazing angle from 0 to 1
    area_m2 : of the faces in this plane
    """

    body: int | None
    normal: np.ndarray
    offset_m: float
    reflection_coefficient: np.ndarray
    area_m2: float

    def in_world(self, poses) -> tuple[np.ndarray, float]:
        """Return the normal and offset in the world, for (n, 4, 4) world_from_body poses of all bodies."""
        if self.body is None:
            return self.normal, self.offset_m
        pose = poses[self.body]
        scale = scale_of(pose)
        normal = pose[:3, :3] @ self.normal / scale
        return normal, scale * self.offset_m + float(normal @ pose[:3, 3])


def tabulate_reflection(reflects, roughness_m: float, wavenumber_rad_m: float) -> np.ndarray:
    """Return the intensity reflection coefficient of a rough plane by the sine of the grazing angle, (N_SINES,).

    reflects : Material, of which the Rayleigh reflection coefficient is taken if density and speed are known;
        or the intensity reflection coefficient |R|² of the smooth plane, 0..1
    roughness_m : rms height; only the coherent part of the reflection counts
    wavenumber_rad_m : 2π / λ in the water
    """
    grazing_rad = np.arcsin(np.linspace(0.0, 1.0, N_SINES))
    if not isinstance(reflects, Material):
        intensity = np.full(N_SINES, float(reflects))
    elif reflects.density_ratio is None:
        intensity = np.full(N_SINES, reflects.reflected)
    else:
        ratios = reflects.density_ratio, reflects.speed_ratio, reflects.loss
        intensity = np.abs(rayleigh_reflection(grazing_rad, *ratios)) ** 2
    return intensity * coherent_loss(grazing_rad, roughness_m, wavenumber_rad_m) ** 2


def _coefficient_of_body(body: Body, wavenumber_rad_m: float) -> np.ndarray | None:
    """Return the intensity reflection coefficient of a body's planes; None if it is too rough to have one."""
    if body.material is not None:
        known = material(body.material)
        if known.height_m is None:
            return None
        return tabulate_reflection(known, known.height_m, wavenumber_rad_m)
    if body.specular > 0:  # |R|² of the coherent part alone, so roughness is already taken into account
        return tabulate_reflection(body.specular, 0.0, wavenumber_rad_m)
    return tabulate_reflection(float(np.mean(body.reflectivity)), DEFAULT_ROUGHNESS_M, wavenumber_rad_m)


def find_planes(surface) -> list[tuple[np.ndarray, float, float]]:
    """Return unit normal, offset, metres, and area, m², of the planes that hold enough of a mesh, the largest first.

    Planes of less than MIN_AREA_M2 are among them, since bodies may be larger in a ping.

    surface : has (V, 3) `vertices`, metres, and (F, 3) `faces`
    """
    faces = np.asarray(surface.faces)
    if len(faces) > MAX_FACES:
        return []
    vertices = np.asarray(surface.vertices, np.float64)
    # Relative to the middle of the mesh: far from its origin, as in UTM, a rounded normal moves the plane by much, and
    # the tolerance that allows for it would join parallel planes.
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    a, b, c = (vertices - middle)[faces.T]
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1) / 2
    valid = area > 0
    normals, area, a = normals[valid] / (2 * area[valid, None]), area[valid], a[valid]
    offsets, out = (normals * a).sum(axis=1), []
    enough_m2 = MIN_AREA_SHARE * area.sum()
    tolerance_m = COPLANAR * np.abs(vertices - middle).max()  # relative, since the body may be scaled
    # The largest face need not lie in the largest plane, as where a wall is meshed finely. Cells twice as wide as the
    # tolerances part a plane among 16 of them at most, so that one of these has this share of its area.
    cells = np.rint(np.column_stack([normals / COPLANAR, offsets / tolerance_m]) / 2).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.ravel()  # some releases of NumPy return a column
    cell_area = np.bincount(cell, area)
    remaining = np.ones(len(area), bool)
    for number in np.argsort(-cell_area, kind="stable"):
        if cell_area[number] < enough_m2 / 16:
            break  # all other cells are smaller still
        members = np.flatnonzero(remaining & (cell == number))
        if not members.size:
            continue
        first = members[area[members].argmax()]
        normal, offset = normals[first], offsets[first]
        coplanar = remaining & (normals @ normal > 1 - COPLANAR**2) & (np.abs(offsets - offset) < tolerance_m)
        area_m2 = float(area[coplanar].sum())
        if area_m2 >= enough_m2:
            remaining &= ~coplanar
            out.append((normal, float(offset + normal @ middle), area_m2))
    out.sort(key=lambda plane: -plane[2])
    return out[:MAX_PLANES]


def planar_reflectors(
    scene: Scene, wavenumber_rad_m: float, wave_height_m: float = 0.0
) -> list[PlanarReflector]:
    """Return the water's surface and the planes of bodies, those that reflect anything coherently.

    wavenumber_rad_m : 2π / λ in the water
    wave_height_m : rms height of the waves under wind; the surface is at least as rough
    """
    out = []
    if scene.surface_z_m is not None:
        roughness_m = max(scene.surface_roughness_m, wave_height_m)
        coefficient = tabulate_reflection(1.0, roughness_m, wavenumber_rad_m)
        out.append(PlanarReflector(None, np.array([0.0, 0.0, 1.0]), scene.surface_z_m, coefficient, np.inf))
    for index, body in enumerate(scene.bodies):
        coefficient = _coefficient_of_body(body, wavenumber_rad_m)
        if coefficient is not None and coefficient.max() > 0:
            for normal, offset_m, area_m2 in find_planes(body.surface):
                out.append(PlanarReflector(index, normal, offset_m, coefficient, area_m2))
    return out
