"""Planes that mirror sound: the water's surface, floors, the walls of a tank."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.materials import Material, coherent_loss, material, rayleigh_reflection
from sonar_gl.scene import Body, Scene

# Of a body, what lies in one plane must be so large: a mirror must be wide against √(λ r), 13 cm at 900 kHz
# and 10 m. Of the body's area it must be a share: the facets of terrain are no mirrors.
MIN_AREA_M2, MIN_SHARE = 0.5, 0.02
MAX_FACES = 50_000  # larger meshes are terrain, which is not flat
MAX_PLANES = 6  # of a body, the largest
FLAT = 1e-4  # metres, and radians, by which faces of one plane may differ
ROUGH_M = 1e-3  # rms height of a flat body of which no more is known than its reflectivity
TABLE = 257  # losses are looked up by the sine of the grazing angle


@dataclass(frozen=True, eq=False)
class Mirror:
    """A plane in the frame of a body, or of the world.

    Attributes
    ----------
    body : index into `scene.bodies`, or None
    normal, offset_m : the plane is normal · x = offset_m
    loss : (TABLE,) intensity that a reflection leaves, by the sine of the grazing angle, 0 to 1
    """

    body: int | None
    normal: np.ndarray
    offset_m: float
    loss: np.ndarray

    def in_world(self, poses) -> tuple[np.ndarray, float]:
        """Normal and offset in the world, where bodies are at (n, 4, 4) poses."""
        if self.body is None:
            return self.normal, self.offset_m
        pose = poses[self.body]
        normal = pose[:3, :3] @ self.normal
        return normal, self.offset_m + float(normal @ pose[:3, 3])


def reflection_loss(reflects, roughness_m: float, wavenumber_rad_m: float) -> np.ndarray:
    """(TABLE,) what a reflection leaves of the intensity, by the sine of the grazing angle from 0 to 1.

    Parameters
    ----------
    reflects : Material, whose Rayleigh coefficient counts if density and speed are known; or |R|², 0..1
    roughness_m : rms height; what it leaves of the reflection is still a mirror's
    wavenumber_rad_m : 2π / λ in the water
    """
    grazing_rad = np.arcsin(np.linspace(0.0, 1.0, TABLE))
    if not isinstance(reflects, Material):
        intensity = np.full(TABLE, float(reflects))
    elif reflects.density_ratio is None:
        intensity = np.full(TABLE, reflects.reflectivity + reflects.specular)
    else:
        of = reflects.density_ratio, reflects.speed_ratio, reflects.loss
        intensity = np.abs(rayleigh_reflection(grazing_rad, *of)) ** 2
    return intensity * coherent_loss(grazing_rad, roughness_m, wavenumber_rad_m) ** 2


def _loss_of(body: Body, wavenumber_rad_m: float) -> np.ndarray | None:
    """What a flat part of a body leaves; None if it is too rough to mirror."""
    if body.material is not None:
        made_of = material(body.material)
        if made_of.height_m is None:
            return None
        return reflection_loss(made_of, made_of.height_m, wavenumber_rad_m)
    if body.specular > 0:  # what roughness leaves of it is told
        return reflection_loss(body.specular, 0.0, wavenumber_rad_m)
    return reflection_loss(float(np.mean(body.reflectivity)), ROUGH_M, wavenumber_rad_m)


def flat_parts(surface) -> list[tuple[np.ndarray, float]]:
    """Normal and offset of the planes that hold enough of a mesh, the largest first.

    Parameters
    ----------
    surface : has (V, 3) `vertices`, metres, and (F, 3) `faces`
    """
    faces = np.asarray(surface.faces)
    if len(faces) > MAX_FACES:
        return []
    a, b, c = np.asarray(surface.vertices, np.float64)[faces.T]
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1) / 2
    some = area > 0
    normals, area, a = normals[some] / (2 * area[some, None]), area[some], a[some]
    offsets, out = (normals * a).sum(axis=1), []
    left = np.ones(len(area), bool)
    while left.any() and len(out) < MAX_PLANES:
        first = np.flatnonzero(left)[area[left].argmax()]
        normal, offset = normals[first], offsets[first]
        reach = FLAT * (1 + np.abs(a).max())
        same = left & (normals @ normal > 1 - FLAT**2) & (np.abs(offsets - offset) < reach)
        left &= ~same
        if area[same].sum() < max(MIN_AREA_M2, MIN_SHARE * area.sum()):
            break  # what is left has smaller faces, of which no mirror is made
        out.append((normal, float(offset)))
    return out


def find_mirrors(scene: Scene, wavenumber_rad_m: float) -> list[Mirror]:
    """The water's surface and the flat parts of bodies, as far as they leave anything of a reflection."""
    out = []
    if scene.surface_z_m is not None:
        loss = reflection_loss(1.0, scene.surface_roughness_m, wavenumber_rad_m)
        out.append(Mirror(None, np.array([0.0, 0.0, 1.0]), scene.surface_z_m, loss))
    for index, body in enumerate(scene.bodies):
        loss = _loss_of(body, wavenumber_rad_m)
        if loss is not None and loss.max() > 0:
            out += [Mirror(index, normal, offset, loss) for normal, offset in flat_parts(body.surface)]
    return out
