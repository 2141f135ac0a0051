"""What is in the water: bodies and where they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sonar_gl.materials import material
from sonar_gl.types import Error, frozen_array

SLOPES = 0.01, 0.5  # roughness_rad: below, a lobe is narrower than samples; above, facets hide one another


def check_pose(matrix, what: str = "pose") -> np.ndarray:
    """A rigid (4, 4) float64 `world_from_x`, or an `Error`."""
    out = frozen_array(matrix, np.float64, (4, 4), what)
    # in plain numbers: a sixth of the time that NumPy takes for nine of them, at every ping
    (a, b, c), (d, e, f), (g, h, i) = out[:3, :3].tolist()
    lengths = a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1
    angles = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    turn = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if max(map(abs, lengths + angles)) > 1e-5 or turn < 0:
        raise Error(
            f"{what} must be a rotation and a translation (its 3x3 part scales, shears or mirrors; "
            "scale the mesh instead)"
        )
    if not np.array_equal(out[3], [0, 0, 0, 1]):
        raise Error(f"{what} must have the last row 0 0 0 1 (got {out[3].tolist()})")
    return out


def pose(x=0.0, y=0.0, z=0.0, roll=0.0, pitch=0.0, yaw=0.0) -> np.ndarray:
    """`world_from_sonar` from SDF's six numbers: metres, and fixed-axis x-y-z angles in radians.

    Convention: R = Rz(yaw) Ry(pitch) Rx(roll), x forward, y left (port), z up.

    Returns
    -------
    (4, 4) float64

    Raises
    ------
    Error
        if a number is not finite, or an angle is beyond 2π, as degrees would be.

    >>> (pose(1, 2, 3, yaw=np.pi / 2) @ [1, 0, 0, 1]).round(6).tolist()
    [1.0, 3.0, 3.0, 1.0]
    """
    numbers = frozen_array([x, y, z, roll, pitch, yaw], np.float64, (6,), "pose x y z roll pitch yaw")
    if np.abs(numbers[3:]).max() > 2 * np.pi + 1e-6:
        raise Error(
            f"pose angles must be radians, within ±2π (got roll pitch yaw = {roll:g} {pitch:g} {yaw:g}; "
            "if these are degrees, multiply by π/180; if they are unwrapped radians, wrap them)"
        )
    (sr, sp, sy), (cr, cp, cy) = np.sin(numbers[3:]), np.cos(numbers[3:])
    out = np.eye(4)
    out[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    out[:3, 3] = numbers[:3]
    return out


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid thing in the water.

    Parameters
    ----------
    name : unique in its scene
    mesh : trimesh.Trimesh, metres; need not be closed, both sides echo
    pose : (4, 4) world_from_body
    reflectivity : μ, 0..1, or an (F,) array, one value a face; or the name of a material, which gives
        `specular` and `roughness_rad` too, where these are left out
    normals : None (flat faces) or (V, 3) shading normals, which give cos θ alone
    specular : |R|² of its smooth part at normal incidence, 0..1: the strength of the lobe that profiles with
        `specular` add to the diffuse echo. No energy is made as long as μ + specular is at most 1; of a
        material both together are its |R|²
    roughness_rad : 0.01..0.5, rms slope of its facets along any one direction: the lobe's width
    material : name of the material, if it was given by name

    Raises
    ------
    Error
        if there are no faces, a vertex is not finite, a number lies out of its bounds, or a name is unknown.
    """

    name: str
    mesh: object
    pose: np.ndarray = None
    reflectivity: float | np.ndarray = 0.5
    normals: np.ndarray | None = None
    specular: float = None
    roughness_rad: float = None
    material: str | None = None

    def __post_init__(self):
        def put(key, value):
            object.__setattr__(self, key, value)

        where = f"body {self.name!r}"
        vertices, faces = getattr(self.surface, "vertices", None), getattr(self.surface, "faces", None)
        if vertices is None or faces is None:
            raise Error(f"{where}: mesh must be a trimesh.Trimesh (got {type(self.surface).__name__})")
        if len(faces) == 0:
            raise Error(f"{where}: mesh must have at least one face (got {len(vertices)} vertices, 0 faces)")
        frozen_array(vertices, np.float64, (None, 3), f"{where}: mesh vertices")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise Error(f"{where}: faces must name vertices 0..{len(vertices) - 1} (got {faces.max()})")
        put("pose", check_pose(np.eye(4) if self.pose is None else self.pose, f"{where}: pose"))
        made_of = None
        if isinstance(self.reflectivity, str):
            try:
                made_of = material(self.reflectivity)
            except Error as why:
                raise Error(f"{where}: {why}") from None
            put("reflectivity", made_of.reflectivity)
            put("material", made_of.name)
        for key, default, (low, high) in (("specular", 0.0, (0, 1)), ("roughness_rad", 0.1, SLOPES)):
            value = getattr(self, key)
            if value is None:
                value = getattr(made_of, key, None)
            value = frozen_array(default if value is None else value, np.float64, (), f"{where}: {key}")
            if not low <= value <= high:
                raise Error(f"{where}: {key} must lie in {low:g}..{high:g} (got {value:g})")
            put(key, float(value))
        mu = frozen_array(
            self.reflectivity,
            np.float64,
            () if np.ndim(self.reflectivity) == 0 else (len(faces),),
            f"{where}: reflectivity",
        )
        if mu.min() < 0 or mu.max() > 1:
            raise Error(
                f"{where}: reflectivity must lie in 0..1 (got {mu.min():g} to {mu.max():g}; "
                "laser_retro is divided by 255)"
            )
        put("reflectivity", float(mu) if mu.ndim == 0 else mu)
        if self.normals is not None:
            put("normals", frozen_array(self.normals, np.float32, (len(vertices), 3), f"{where}: normals"))


def _mesh(body):
    """The body's mesh; where it came as plain triangles, as from files, it is made now."""
    if hasattr(body.surface, "to_trimesh"):
        object.__setattr__(body, "surface", body.surface.to_trimesh())
    return body.surface


# `surface` is what the mesh was given as: its `vertices` and `faces` are all that pings need, and trimesh is
# slow to load. The property comes after the class, which would take it for the field's default.
Body.mesh = property(_mesh, lambda body, mesh: object.__setattr__(body, "surface", mesh))


def _number(name: str, value, low: float, high: float) -> float:
    """A number within bounds, or an `Error`."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not low <= value <= high:
        raise Error(f"{name} of a scene must be metres in {low:g}..{high:g} (got {value!r})")
    return float(value)


class Scene:
    """Bodies, and where the scene's file puts its sonar.

    Parameters
    ----------
    bodies : of unique names, at most 65535
    sonar_pose : (4, 4) world_from_sonar, or None
    name : what files made from it are called
    surface_z_m : height of the water's surface, metres, which mirrors sound; None = far away
    surface_roughness_m : rms height of its waves, metres; at 900 kHz a millimetre leaves no mirror

    Raises
    ------
    Error
        if names of bodies are not unique, or the surface makes no sense.
    """

    def __init__(
        self,
        bodies: Iterable[Body],
        sonar_pose=None,
        name: str = "scene",
        surface_z_m: float | None = None,
        surface_roughness_m: float = 1e-4,
    ):
        self.bodies = tuple(bodies)
        self.sonar_pose = None if sonar_pose is None else check_pose(sonar_pose, "sonar_pose")
        self.name = name
        self.surface_z_m = None if surface_z_m is None else _number("surface_z_m", surface_z_m, -1e5, 1e5)
        self.surface_roughness_m = _number("surface_roughness_m", surface_roughness_m, 0, 100)
        names = [body.name for body in self.bodies]
        twice = sorted({n for n in names if names.count(n) > 1}) if len(set(names)) < len(names) else []
        if twice:
            raise Error(f"names of bodies must be unique (got {twice[0]!r} more than once)")
        if len(names) > 65535:
            raise Error(f"a scene holds at most 65535 bodies (got {len(names)}; join some meshes)")

    def with_more(self, bodies: Iterable[Body]) -> Scene:
        """The same scene with more bodies in it, after its own."""
        bodies = [*self.bodies, *bodies]
        return Scene(bodies, self.sonar_pose, self.name, self.surface_z_m, self.surface_roughness_m)

    @property
    def n_triangles(self) -> int:
        """Triangles of all bodies."""
        return sum(len(body.surface.faces) for body in self.bodies)

    def __repr__(self):
        return f"Scene({self.name!r}, {len(self.bodies)} bodies, {self.n_triangles} triangles)"
