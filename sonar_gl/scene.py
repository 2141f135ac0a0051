"""What is in the water: bodies and where they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sonar_gl.bubbles import Bubbles
from sonar_gl.materials import material
from sonar_gl.rigid import check_pose, pose
from sonar_gl.types import Error, check_kind, frozen_array

__all__ = ["SLOPES", "Body", "Scene", "check_pose", "pose", "without_bubbles"]

SLOPES = 0.01, 0.5  # roughness_rad: below, a lobe is narrower than samples; above, facets hide one another


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
        named, made_of = isinstance(self.reflectivity, str), None
        try:
            known = (
                material(self.reflectivity if named else self.material) if named or self.material else None
            )
        except Error as why:
            raise Error(f"{where}: {why}") from None
        if named:
            if self.material not in (None, known.name):  # replaced: what the other one had goes with it
                put("specular", None), put("roughness_rad", None)
            made_of = known
            put("reflectivity", made_of.reflectivity)
        put("material", known and known.name)
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
    """Bodies and plumes of bubbles, and where the scene's file puts its sonar.

    Parameters
    ----------
    bodies : Bodies, and plumes of Bubbles, of unique names; of the former at most 65535
    sonar_pose : (4, 4) world_from_sonar, or None
    name : what files made from it are called
    surface_z_m : height of the water's surface, metres, which mirrors sound; None = far away
    surface_roughness_m : rms height of its waves, metres; at 900 kHz a millimetre leaves no mirror

    Attributes
    ----------
    bodies, plumes : tuples of the two kinds

    Raises
    ------
    Error
        if names of bodies are not unique, or the surface makes no sense.
    """

    def __init__(
        self,
        bodies: Iterable[Body | Bubbles],
        sonar_pose=None,
        name: str = "scene",
        surface_z_m: float | None = None,
        surface_roughness_m: float = 1e-4,
    ):
        things = list(bodies) if isinstance(bodies, Iterable) and not isinstance(bodies, str) else [bodies]
        for thing in things:
            check_kind("a body of a scene", thing, Body | Bubbles, "give several, as in Scene([body])")
        self.bodies = tuple(thing for thing in things if not isinstance(thing, Bubbles))
        self.plumes = tuple(thing for thing in things if isinstance(thing, Bubbles))
        self.sonar_pose = None if sonar_pose is None else check_pose(sonar_pose, "sonar_pose")
        self.name = name
        self.surface_z_m = None if surface_z_m is None else _number("surface_z_m", surface_z_m, -1e5, 1e5)
        self.surface_roughness_m = _number("surface_roughness_m", surface_roughness_m, 0, 100)
        names = [thing.name for thing in things]
        twice = sorted({n for n in names if names.count(n) > 1}) if len(set(names)) < len(names) else []
        if twice:
            raise Error(f"names of bodies must be unique (got {twice[0]!r} more than once)")
        if len(self.bodies) > 65535:
            raise Error(f"a scene holds at most 65535 bodies (got {len(self.bodies)}; join some meshes)")

    def with_more(self, bodies: Iterable[Body | Bubbles]) -> Scene:
        """The same scene with more bodies in it, after its own."""
        bodies = [*self.bodies, *self.plumes, *bodies]
        return Scene(bodies, self.sonar_pose, self.name, self.surface_z_m, self.surface_roughness_m)

    @property
    def n_triangles(self) -> int:
        """Triangles of all bodies."""
        return sum(len(body.surface.faces) for body in self.bodies)

    def __repr__(self):
        return f"Scene({self.name!r}, {len(self.bodies)} bodies, {self.n_triangles} triangles)"


def without_bubbles(scene: Scene, acoustics) -> Scene:
    """The scene, for what knows no bubbles.

    Raises
    ------
    Error
        if it has plumes, and these acoustics hear them.
    """
    if scene.plumes and acoustics.bubbles:
        raise Error(
            f"the reference knows no bubbles (got {scene.plumes[0].name!r} in the scene; leave them out of "
            "both pings by acoustics with bubbles=False)"
        )
    return scene
