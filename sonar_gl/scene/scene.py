"""Scenes: rigid bodies, bubble plumes and the water's surface."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.core.checks import (
    ArraysStayReadOnly,
    check_iterable,
    check_kind,
    check_number,
    count_axes,
    frozen_array,
    is_iterable,
    shown,
)
from sonar_gl.core.errors import Error, errors_at, nearest_of_many
from sonar_gl.core.names import matching_names, names_of
from sonar_gl.core.poses import MAX_POSITION_M, check_pose
from sonar_gl.core.warn import warn_caller
from sonar_gl.scene.materials import Material, material, materials
from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.primitives import Triangles
from sonar_gl.scene.sonar_sensor import SonarSensor
from sonar_gl.sonar.sonar import Sonar

if TYPE_CHECKING:
    import trimesh

# Bounds of roughness_rad: below, the lobe is narrower than a sample; above, facets shadow one another.
ROUGHNESS_BOUNDS_RAD = 0.01, 0.5
SPECKLE_SHAPE_BOUNDS = 0.05, 1e4
DEFAULT_REFLECTIVITY = 0.5
ECHO_DEFAULTS = {"reflectivity": DEFAULT_REFLECTIVITY, "specular": 0.0, "roughness_rad": 0.1}
MAX_BODIES = 65535  # labels are uint16, and 0 is for bins without echo
SEPARATOR = re.compile("(?=::)")  # between the names of a model and of what is in it


class _LazyMesh:
    """Descriptor of `Body.mesh`, which converts `Body.surface` to a trimesh.Trimesh when first read.

    Bodies read from files hold `Triangles`: pings need no more, and importing trimesh takes half a second.
    """

    def __get__(self, body, owner=None):
        if body is None:  # the dataclass looks for a default value; there is none
            raise AttributeError("mesh")
        if isinstance(body.surface, Triangles):
            object.__setattr__(body, "surface", body.surface.to_trimesh())
        return body.surface

    def __set__(self, body, mesh):
        object.__setattr__(body, "surface", mesh)


@dataclass(frozen=True, eq=False)
class Body(ArraysStayReadOnly):
    """A rigid body.

    Parameters
    ----------
    name : unique in its scene
    mesh : trimesh.Trimesh, metres; need not be closed: both sides of a face echo. A simulator copies it when it takes
        the body: what is changed in it later acts on bodies that are added later
    pose : (4, 4) world_from_body; None is the identity
    reflectivity : μ, 0..1, or (F,), one value a face; or the name of a material, which also sets `specular` and
        `roughness_rad` unless these are given. None: the material's, or 0.5
    normals : None (flat faces) or (V, 3) shading normals, used only for the incidence angle
    specular : strength of the specular lobe, 0..1: the intensity reflection coefficient |R|² of the smooth
        part of the surface at normal incidence. Profiles with `specular` add the lobe to the diffuse echo.
        Energy is conserved while μ + specular is at most 1; for a material the sum is its |R|². None: the
        material's, or 0
    roughness_rad : 0.01..0.5, rms slope of the facets along any one direction, which sets the width of the specular
        (Kirchhoff) lobe; docs/acoustics.md has its formula. None: the material's, or 0.1
    material : name of the material; it sets what is left out of `reflectivity`, `specular` and `roughness_rad`, or all
        of them where they are those of another material, as in `dataclasses.replace(body, material="glass")`
    speckle_shape : ν of the K distribution (Abraham, Lyons 2002), 0.05..1e4: where noise has speckle, a Gamma(ν, 1/ν)
        texture also multiplies the body's diffuse echo, as of a floor with few or patchy scatterers, and the contrast
        becomes √(1 + 2/ν); None for fully developed speckle

    Notes
    -----
    Arrays are copied, except for a `reflectivity` of float64 and `normals` of float32 that are read-only, in C order,
    and own their numbers: bodies that are given the same one share it. Do not make such an array writeable again.

    Attributes
    ----------
    surface : the mesh as given, with `vertices` (V, 3), metres, and `faces` (F, 3). In bodies from files it
        is `Triangles` until `mesh` is read for the first time

    Raises
    ------
    Error
        if there are no faces, a vertex is not finite, a number is out of bounds, or a name is unknown.
    """

    name: str
    mesh: trimesh.Trimesh = _LazyMesh()
    pose: np.ndarray = None
    reflectivity: float | np.ndarray | str | None = None
    normals: np.ndarray | None = None
    specular: float = None
    roughness_rad: float = None
    material: str | None = None
    speckle_shape: float | None = None
    surface: trimesh.Trimesh | Triangles = field(init=False, repr=False)

    def __post_init__(self):
        check_kind("the name of a body", self.name, str, 'such as "diver"')
        location = f"body {self.name!r}"
        n_vertices, n_faces = self._check_mesh(location)
        self._set("pose", check_pose(np.eye(4) if self.pose is None else self.pose, f"{location}: pose"))
        self._apply_material(location)
        for key, bounds in (("specular", (0, 1)), ("roughness_rad", ROUGHNESS_BOUNDS_RAD)):
            self._set(key, check_number(f"{location}: {key}", getattr(self, key), *bounds))
        if self.speckle_shape is not None:
            what, hint = f"{location}: speckle_shape", "below 1 is spiky, None is fully developed"
            self._set("speckle_shape", check_number(what, self.speckle_shape, *SPECKLE_SHAPE_BOUNDS, hint))
        one_value = count_axes(self.reflectivity) == 0
        if isinstance(self.reflectivity, bool | np.bool_):
            got = shown(self.reflectivity)
            raise Error(
                f"{location}: reflectivity must be a number, or an array of one for each face (got {got})"
            )
        shape, what = () if one_value else (n_faces,), f"{location}: reflectivity"
        hint = "give one number, or one for each face"
        mu = frozen_array(self.reflectivity, np.float64, shape, what, hint, shares=True)
        if mu.min() < 0 or mu.max() > 1:
            raise Error(
                f"{location}: reflectivity must lie in 0..1 (got {mu.min():g} to {mu.max():g}; "
                "laser_retro is divided by 255)"
            )
        self._set("reflectivity", float(mu) if one_value else mu)
        if self.normals is not None:
            shape, what = (n_vertices, 3), f"{location}: normals"
            self._set("normals", frozen_array(self.normals, np.float32, shape, what, shares=True))

    def _set(self, key: str, value):
        object.__setattr__(self, key, value)

    def _check_mesh(self, location: str) -> tuple[int, int]:
        """Check the mesh; return the numbers of vertices and faces."""
        vertices, faces = getattr(self.surface, "vertices", None), getattr(self.surface, "faces", None)
        if vertices is None or faces is None:
            raise Error(
                f"{location}: mesh must be a trimesh.Trimesh (got {type(self.surface).__name__}; sonar_gl.load_scene "
                "makes bodies of a file or of a trimesh.Scene)"
            )
        if isinstance(faces, np.ndarray) and faces.shape[:1] == (0,):
            raise Error(
                f"{location}: mesh must have at least one face (got {len(vertices)} vertices, 0 faces)"
            )
        if not (isinstance(faces, np.ndarray) and faces.shape[1:] == (3,) and faces.dtype.kind in "iu"):
            got = type(faces).__name__
            if isinstance(faces, np.ndarray):
                got = f"shape {faces.shape}, {faces.dtype}"
            raise Error(
                f"{location}: mesh faces must be an array of whole numbers of shape (F, 3) (got {got}; "
                "trimesh.Trimesh(vertices, faces) makes one, also of quadrilaterals)"
            )
        given = frozen_array(vertices, np.float64, (None, 3), f"{location}: mesh vertices", shares=True)
        if abs(furthest := max(given.max(initial=0), given.min(initial=0), key=abs)) > MAX_POSITION_M:
            raise Error(
                f"{location}: mesh vertices must lie within {MAX_POSITION_M:g} m of the mesh's origin (got "
                f"{furthest:g}; give metres, and leave out vertices that stand for missing data)"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            got = faces.min() if faces.min() < 0 else faces.max()
            raise Error(f"{location}: faces must name vertices 0..{len(vertices) - 1} (got {got})")
        warn_of_unit(self.surface)
        return len(vertices), len(faces)

    def _apply_material(self, location: str):
        """Look up the material by name, and fill in the fields that are left out.

        `dataclasses.replace` gives what the previous material filled in: by another material it goes.
        """
        by_name = isinstance(self.reflectivity, str)
        name = self.reflectivity if by_name else self.material
        with errors_at(location):
            found = None if name is None else material(name)
        echo = {key: getattr(self, key) for key in ECHO_DEFAULTS}
        if by_name:
            echo["reflectivity"] = None
            if self.material not in (None, found.name):
                echo = dict.fromkeys(ECHO_DEFAULTS)
        elif found is not None and _is_of_material(echo):
            echo = dict.fromkeys(ECHO_DEFAULTS)
        self._set("material", found and found.name)
        for key, value in _echo_of(found).items():
            self._set(key, value if echo[key] is None else echo[key])


def _is_of_material(echo: dict) -> bool:
    """Return whether all that was given for the echo are the numbers of one material."""
    are_numbers = all(isinstance(value, float) for value in echo.values())
    return are_numbers and any(echo == _echo_of(one) for one in materials().values())


def _echo_of(found: Material | None) -> dict[str, float]:
    """Return what a body of a material, or of none, has where nothing else is given."""
    of_material = {key: getattr(found, key, None) for key in ECHO_DEFAULTS}
    return ECHO_DEFAULTS | {key: value for key, value in of_material.items() if value is not None}


NO_OTHER_UNIT = ("", "none", "metre", "metres")


def warn_of_unit(mesh) -> None:
    """Warn of a mesh of trimesh that states another unit than metres.

    It is not converted: trimesh keeps the statement when a mesh is scaled by hand.
    """
    unit = getattr(mesh, "units", None)
    # trimesh makes a text of None, too, where a mesh without a unit is copied
    if not isinstance(unit, str) or unit.strip().lower() in NO_OTHER_UNIT:
        return
    from trimesh.units import unit_conversion  # loaded already, by who made the mesh

    try:
        length_m = unit_conversion(unit, "m")
    except (ValueError, KeyError):  # of no unit of length
        length_m = None
    if length_m is None or not np.isclose(length_m, 1.0):
        warn_caller(
            f"a mesh states the unit {shown(unit)}, and its coordinates are taken as metres (convert it, by trimesh's "
            "convert_units('m') of mesh or scene; if it is in metres, set mesh.units = 'm')"
        )


def hull_text(model: str) -> str:
    """Return that a sonar that moves leaves the model behind that carries it."""
    return (
        f"poses move the sonar alone: model {model!r}, which carries it, stays where it is, and returns echo"
    )


def hull_patterns(scene: Scene, model: str) -> list[str]:
    """Return patterns of names that match what is in a model, and nothing beside it: "rov*" matches "rov_dock", too."""
    parts, pattern = list(scene.parts_of(model)), f"{model}*"
    matched = matching_names([pattern], (thing.name for thing in scene.bodies_and_plumes))
    return [pattern] if set(matched) == set(parts) else parts


class Scene(ArraysStayReadOnly):
    """Bodies, bubble plumes, the water's surface, and the pose of the sonar if the scene's file has one.

    A scene does not change: methods return another one, and simulators place and add bodies on their own.

    Parameters
    ----------
    bodies : Body and Bubbles objects with unique names; at most 65535 bodies
    sonar_pose : (4, 4) world_from_sonar, or None
    name : stem of the names of files made from the scene
    surface_z_m : height of the water's surface, metres, a planar reflector; None = out of reach
    surface_roughness_m : rms height of the surface's waves, metres, a tenth of a millimetre unless given. At 900 kHz
        that costs each reflection 0.7 dB at a grazing angle of 31°, 2.5 dB from straight below; a millimetre leaves
        no coherent reflection but at low grazing angles
    sensors : SonarSensor objects, the one at `sonar_pose` first
    models : names to (4, 4) world_from_model, of models whose bodies and plumes are named `model` or `model::part`

    Attributes
    ----------
    bodies, plumes : tuples of Body and of Bubbles
    sensors : tuple of SonarSensor: the sensors of the scene's file that stand for sonars
    models : dict, the models of the scene's file

    Raises
    ------
    Error
        if two names are equal, or the surface's numbers are out of bounds; if an attribute is set later.
    """

    bodies: tuple[Body, ...]
    plumes: tuple[Bubbles, ...]
    sonar_pose: np.ndarray | None
    name: str
    surface_z_m: float | None
    surface_roughness_m: float
    sensors: tuple[SonarSensor, ...]
    models: dict[str, np.ndarray]

    def __init__(
        self,
        bodies: Iterable[Body | Bubbles],
        sonar_pose: ArrayLike | None = None,
        name: str = "scene",
        surface_z_m: float | None = None,
        surface_roughness_m: float = 1e-4,
        sensors: Iterable[SonarSensor] = (),
        models: dict | None = None,
    ):
        things = list(bodies) if is_iterable(bodies) and not isinstance(bodies, str) else [bodies]
        bodies, plumes = _bodies_and_plumes(things)
        pose = None if sonar_pose is None else check_pose(sonar_pose, "sonar_pose")
        check_kind("the name of a scene", name, str, 'the stem of file names, such as "harbour"')
        check_iterable("sensors of a scene", sensors, "those of another scene are `scene.sensors`")
        models = {} if models is None else models
        check_kind("models of a scene", models, dict, "those of another scene are `scene.models`")
        for model in models:
            check_kind("the name of a model", model, str, 'such as "boat"')
        models = {model: check_pose(where, f"the pose of model {model!r}") for model, where in models.items()}
        sensors = tuple(sensors)
        for sensor in sensors:
            check_kind(
                "a sensor of a scene", sensor, SonarSensor, "those of another scene are `scene.sensors`"
            )
        if surface_z_m is not None:
            surface_z_m = check_number("surface_z_m of a scene", surface_z_m, -1e5, 1e5, "give metres")
        roughness = check_number("surface_roughness_m of a scene", surface_roughness_m, 0, 100, "give metres")
        check_added([*bodies, *plumes])
        vars(self).update(bodies=bodies, plumes=plumes, sonar_pose=pose, name=name, surface_z_m=surface_z_m)
        vars(self).update(surface_roughness_m=roughness, sensors=sensors, models=models)

    def __setattr__(self, name: str, value):
        raise Error(
            f"a Scene must not be changed (got a new value of {name!r}; with_bodies, with_more, without, only "
            "and with_surface return another scene, and a Simulator places and adds bodies)"
        )

    def with_bodies(self, bodies: Iterable[Body]) -> Scene:
        """Return the same scene with these bodies in the place of its own; its plumes stay.

        Examples
        --------
        Another material for one body of a file:

        >>> from dataclasses import replace
        >>> from sonar_gl import load_scene
        >>> scene = load_scene("pylon")
        >>> with_wood = scene.with_bodies(
        ...     replace(body, reflectivity="wood") if body.name == "box" else body for body in scene.bodies
        ... )
        >>> [body.name for body in with_wood.bodies if body.material == "wood"]
        ['box']
        """
        check_iterable("bodies of a scene", bodies, "give several, as in scene.with_bodies([body])")
        bodies = list(bodies)
        for body in bodies:
            check_kind("each of the bodies", body, Body, "the plumes of the scene stay")
        return self._with([*bodies, *self.plumes])

    def with_more(self, bodies: Iterable[Body | Bubbles]) -> Scene:
        """Return the same scene with more bodies and plumes, after its own."""
        check_iterable("bodies to add", bodies, "give several, as in scene.with_more([body])")
        added, added_plumes = _bodies_and_plumes(bodies)
        # the bodies of this scene are not checked again but for their names
        out = self._with(())
        vars(out).update(bodies=(*self.bodies, *added), plumes=(*self.plumes, *added_plumes))
        check_added(out.bodies_and_plumes)
        return out

    def without(self, *patterns: str) -> Scene:
        """Return the same scene without the bodies and plumes of these names.

        Parameters
        ----------
        patterns : names, in which * stands for any text and ? for one character, as in "boat*"

        Raises
        ------
        Error
            if a pattern matches nothing.
        """
        left_out = self._matching(patterns)
        return self._with([thing for thing in self.bodies_and_plumes if thing.name not in left_out])

    def only(self, *patterns: str) -> Scene:
        """Return the same scene with the bodies and plumes of these names alone; parameters as for `without`."""
        kept = self._matching(patterns)
        return self._with([thing for thing in self.bodies_and_plumes if thing.name in kept])

    def parts_of(self, model: str) -> dict[str, np.ndarray]:
        """Return (4, 4) model_from_body of each body and plume of a model, by name; none of other names."""
        if not isinstance(model, str) or model not in self.models:
            return {}
        home = self.models[model]
        model_from_world = np.linalg.inv(home)
        return {
            thing.name: np.eye(4)
            if thing.name == model or np.array_equal(thing.pose, home)
            else model_from_world @ thing.pose
            for thing in self._things_of_models.get(model, ())
        }

    def vehicle(self) -> str | None:
        """Return the outermost model that holds the first sensor; None if no body or plume of the scene is in it.

        A sonar that moves leaves what is in this model behind, unless it is moved, too.

        >>> from sonar_gl import load_scene
        >>> load_scene("pylon").vehicle() is None  # the sensor is alone in its model
        True
        """
        model = self.sensors[0].model.partition("::")[0] if self.sensors else ""
        return model if self.parts_of(model) else None

    @cached_property
    def _things_of_models(self) -> dict[str, list[Body | Bubbles]]:
        """The bodies and plumes of each model that has any, found for all at once: there may be a thousand models."""
        out = {}
        for thing in self.bodies_and_plumes:
            ends = [match.start() for match in SEPARATOR.finditer(thing.name)]
            for model in {thing.name, *(thing.name[:end] for end in ends)} & self.models.keys():
                out.setdefault(model, []).append(thing)
        return out

    def with_surface(self, surface_z_m: float | None) -> Scene:
        """Return the same scene with the water's surface at this height, metres; None = out of reach."""
        return self._with(self.bodies_and_plumes, surface_z_m=surface_z_m)

    def _with(self, things, **changed) -> Scene:
        fields = "sonar_pose", "name", "surface_z_m", "surface_roughness_m", "sensors", "models"
        return Scene(things, **{field: getattr(self, field) for field in fields} | changed)

    def _matching(self, patterns) -> set[str]:
        names, found = dict.fromkeys(thing.name for thing in self.bodies_and_plumes), set()
        for pattern in patterns:
            check_kind("a name of bodies", pattern, str, 'such as "boat*"')
            matching = names_of(pattern, names)
            if not matching:
                hint = nearest_of_many(pattern, names)
                raise Error(f"names must be those of bodies of the scene (got {pattern!r}; {hint})")
            found.update(matching)
        return found

    @property
    def sonar(self) -> Sonar | None:
        """The sonar that the scene's file describes, at `sonar_pose`; None if it describes none."""
        return self.sensors[0].sonar if self.sensors else None

    @property
    def bodies_and_plumes(self) -> tuple[Body | Bubbles, ...]:
        """The bodies and then the plumes: all that names stand for, and that moves."""
        return (*self.bodies, *self.plumes)

    @property
    def n_triangles(self) -> int:
        """Number of triangles of all bodies."""
        return sum(len(body.surface.faces) for body in self.bodies)

    def __repr__(self):
        return f"Scene({self.name!r}, {len(self.bodies)} bodies, {self.n_triangles} triangles)"


def _bodies_and_plumes(things: Iterable) -> tuple[tuple[Body, ...], tuple[Bubbles, ...]]:
    things = list(things)
    for thing in things:
        cure = "give several, as in Scene([body])"
        if hasattr(thing, "faces"):
            cure = "as in Scene([sonar_gl.Body('box', mesh)])"
        elif hasattr(thing, "geometry"):
            cure = "sonar_gl.load_scene makes a scene of that"
        check_kind("a body of a scene", thing, Body | Bubbles, cure)
    bodies = tuple(thing for thing in things if not isinstance(thing, Bubbles))
    return bodies, tuple(thing for thing in things if isinstance(thing, Bubbles))


def check_added(things: Sequence[Body | Bubbles], n_bodies: int = 0, names: Container[str] = ()) -> None:
    """Check the names of things that are added to a scene, and how many bodies it has then.

    Raises Error if two have one name, or there are too many bodies.

    n_bodies, names : what the scene has
    """
    twice = [
        name for name, count in Counter(thing.name for thing in things).items() if count > 1 or name in names
    ]
    if twice:
        raise Error(f"names of bodies must be unique (got {min(twice)!r} more than once)")
    n_bodies += sum(not isinstance(thing, Bubbles) for thing in things)
    if n_bodies > MAX_BODIES:
        raise Error(
            f"a scene holds at most {MAX_BODIES} bodies (got {n_bodies}; join some meshes, or `place` absent bodies "
            "again in place of adding others)"
        )


def poses_of_parts(
    poses: dict[str, np.ndarray | None], parts_of: Callable[[str], dict[str, np.ndarray]]
) -> dict[str, np.ndarray | None]:
    """Return poses of bodies and plumes in which all that is in a model has taken its place.

    A part that is named itself has the pose that is given for it, whatever the order.

    poses : names to (4, 4) world_from_body, or world_from_model, or to None for what is absent
    """
    out, own = {}, {}
    for name in sorted(poses, key=lambda name: str(name).count("::")):  # outer models before inner ones
        pose, parts = poses[name], parts_of(name)
        if not parts:
            own[name] = pose
            continue
        if pose is not None:
            pose = check_pose(pose, f"the pose of model {name!r}", may_scale=True)
        out |= {part: pose if pose is None else pose @ at for part, at in parts.items()}
    return out | own
