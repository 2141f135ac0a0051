"""Scenes from models of MuJoCo, and the poses of their bodies in a simulation."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_gl.core.checks import check_kind
from sonar_gl.core.errors import Error, errors_at, nearest_names, some_names
from sonar_gl.core.extras import missing_extra
from sonar_gl.core.input_files import note_file
from sonar_gl.core.warn import warn_caller
from sonar_gl.scene import primitives
from sonar_gl.scene.joined_shapes import EchoingShape, SurfaceKind, body_of_shapes
from sonar_gl.scene.materials import Material, find_material
from sonar_gl.scene.primitives import Shape, make_shape
from sonar_gl.scene.scene import DEFAULT_REFLECTIVITY, Scene
from sonar_gl.scene.sdf.resources import Resources
from sonar_gl.scene.sonar_sensor import SONAR_WORDS

SUFFIXES = (".xml", ".mjcf")
VISIBLE_GROUPS = 2  # geoms of groups 0 to 2 are what MuJoCo's viewer shows; models keep collisions in group 3
DEFAULT_RGBA = np.float32([0.5, 0.5, 0.5, 1.0])  # of a geom that leaves the colour to its material
# attributes of <compiler> that name the folder of textures, and of all other files
FOLDERS = {"texture": ("texturedir", "assetdir"), "mesh": ("meshdir", "assetdir")}
SEPARATORS = r"[/\\]"  # of folders, on every system
FILE_KEYS = "file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back"))  # of a cube
URDF_FILE_KEYS = ("filename",)
# A camera looks along -z with x to the right and y up; a sonar along x with y to port and z up.
CAMERA_FROM_SONAR = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])


class Part(NamedTuple):
    """The geoms that make one body of the scene.

    body : number of MuJoCo's body; 0 is the world
    """

    name: str
    body: int
    geoms: list[int]


def is_mujoco_model(what) -> bool:
    """Return whether an object is a mujoco.MjModel or mujoco.MjData, without importing mujoco."""
    kind = type(what)
    return kind.__module__.partition(".")[0] == "mujoco" and kind.__name__ in ("MjModel", "MjData")


def convert_mujoco_model(what, name: str = "scene", path: Path | None = None) -> Scene:
    """Return the scene of a mujoco.MjModel at its reference configuration, or of a mujoco.MjData as it is now.

    Raises Error if a geom that MuJoCo shows has no surface. docs/conventions.md, "Scenes of MuJoCo", says what becomes
    of bodies, geoms and materials, and which site or camera is the sonar.

    path : file that warnings name; None for an object
    """
    import mujoco

    model = what.model if hasattr(what, "model") else what
    data = mujoco.MjData(model)  # a simulation of its own: that of the caller stays as it is
    if what is not model:
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = what.qpos, what.mocap_pos, what.mocap_quat
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    bodies, unspecified = [], []
    for part in _parts(model):
        group = [EchoingShape(_shape_in_body(model, g), *_reflectivity(model, g)) for g in part.geoms]
        found = _material(model, part.geoms[0])
        with errors_at(f"body {part.name!r} of the MuJoCo model"):
            pose = _pose(data.xpos[part.body], data.xmat[part.body])
            bodies.append(body_of_shapes(part.name, group, pose, _kind(found)))
        if any(_material(model, g) is None for g in part.geoms):
            unspecified.append(part.name)
    where = "" if path is None else f"{path}: "
    if unspecified:
        warn_caller(
            f"{where}no material of a known name in {len(unspecified)} of {len(bodies)} bodies "
            f"({some_names(unspecified)}); their reflectivity is taken as {DEFAULT_REFLECTIVITY}"
        )
    if model.nflex or model.nskin:
        warn_caller(f"{where}flexes and skins of the MuJoCo model are left out (they deform)")
    carrier = _sonar(model)
    return Scene(bodies, None if carrier is None else _sonar_pose(data, carrier), name)


def mujoco_poses(scene: Scene, data) -> dict[str, np.ndarray]:
    """Return the poses of a scene's bodies in a MuJoCo simulation, for `Simulator.ping` and `Simulator.place`.

    Parameters
    ----------
    scene : made by `load_scene` of the model; bodies may have been left out or added
    data : mujoco.MjData after mj_step or mj_forward, whose positions are taken as they are

    Returns
    -------
    dict
        name -> (4, 4) world_from_body, for the bodies that MuJoCo can move: not for geoms of the world.

    Raises
    ------
    Error
        if `scene` is no Scene, `data` is no mujoco.MjData, or it has no positions yet.
    """
    check_kind("scene", scene, Scene, "sonar_gl.load_scene makes one of the model")
    _check_data(data)
    numbers = {body.name: _body_number(data.model, body.name) for body in scene.bodies}
    return {name: _pose(data.xpos[number], data.xmat[number]) for name, number in numbers.items() if number}


def mujoco_sonar_pose(data, name: str | None = None) -> np.ndarray:
    """Return the (4, 4) world_from_sonar of the model's sonar in a MuJoCo simulation; see `load_scene`.

    Parameters
    ----------
    data : mujoco.MjData after mj_step or mj_forward, whose positions are taken as they are
    name : of a site or camera that carries a further sonar; None for the sonar of the scene

    Raises
    ------
    Error
        if the model has no site or camera of this name, or none named after a sonar, or `data` has no positions yet.
    """
    _check_data(data)
    if name is not None:
        return _sonar_pose(data, _named_carrier(data.model, name))
    carrier = _sonar(data.model)
    if carrier is None:
        words = ", ".join(SONAR_WORDS)
        raise Error(
            f"a MuJoCo model must have a site or camera for the sonar, named after it ({words}; got none)"
        )
    return _sonar_pose(data, carrier)


def read_mjcf(path: Path, resource_paths) -> Scene:
    """Read a scene from a MuJoCo model in a file.

    Raises Error if MuJoCo is not installed or cannot read the model, or the model names files that are missing or
    elsewhere.

    resource_paths : folders from which the model may read files, besides its own
    """
    resources = Resources(path, resource_paths)
    _check_files(path, resources)
    if missing := resources.missing(path):
        raise Error(f"{missing}\nMuJoCo reads no model without them.")
    try:
        import mujoco
    except ModuleNotFoundError as why:
        raise missing_extra(
            "mujoco", f"{path}: a model of MuJoCo needs MuJoCo (got no module {why.name})"
        ) from None
    except Exception as why:  # its OpenGL, which nothing here needs
        raise Error(f"{path}: MuJoCo cannot be imported ({why}); try another value of MUJOCO_GL") from None
    try:
        # by a relative path it would miss files that lie beside an included one
        model = mujoco.MjModel.from_xml_path(str(path.absolute()))
    except ValueError as why:
        raise Error(f"{path}: MuJoCo cannot read this model ({' '.join(str(why).split())})") from None
    with errors_at(str(path)):
        return convert_mujoco_model(model, path.stem, path)


def _check_files(main: Path, resources: Resources) -> None:
    """Raise an Error if a model names a file outside the resource paths; note missing files in `resources`.

    A model that it attaches has folders of its own.
    """
    waiting, checked = [main], set()
    while waiting:
        model = waiting.pop()
        if model.resolve() not in checked:
            checked.add(model.resolve())
            waiting += _check_files_of_one(model, resources)


def _check_files_of_one(main: Path, resources: Resources) -> list[Path]:
    """Check the files that one model names; return the models that it attaches."""
    is_urdf = resources.parse(main).tag == "robot"
    strips, folders, models, elements = is_urdf, dict.fromkeys(FOLDERS, ""), [], []
    for path, element in _elements(main, resources):
        if element.tag == "compiler":  # of several the last counts
            strips = element.get("strippath", str(strips).lower()) == "true"
            for kind, keys in FOLDERS.items():
                folders[kind] = next(
                    (element.get(key) for key in keys if key in element.attrib), folders[kind]
                )
        elif element.tag == "model" and (file := element.get("file")):
            models.append(_find(file, "", main, path, resources, f"{path}: model[{file}]"))
        elif element.tag != "include":
            elements.append((path, element))
    for path, element in elements:
        for file in filter(None, map(element.get, URDF_FILE_KEYS if is_urdf else FILE_KEYS)):
            folder = folders["texture" if element.tag == "texture" else "mesh"]
            where = f"{path}: {element.tag}[{element.get('name') or file}]"
            if strips:
                file = re.split(SEPARATORS, file)[-1]
            _find(file, folder, main, path, resources, where)
    return [model for model in models if model is not None]


def _elements(main: Path, resources: Resources) -> Iterator[tuple]:
    """Yield file and element of a model, with those of a file that it includes in place of the `<include>`."""
    included = {main.resolve()}  # MuJoCo refuses a file that is included twice
    waiting = [(main, resources.parse(main).iter())]
    while waiting:
        path, rest = waiting[-1]
        element = next(rest, None)
        if element is None:
            waiting.pop()
            continue
        yield path, element
        if element.tag == "include" and (file := element.get("file")):
            found = _find(file, "", main, path, resources, f"{path}: include[{file}]")
            if found is not None and found.resolve() not in included:
                included.add(found.resolve())
                waiting.append((found, resources.parse(found).iter()))


def _find(file: str, folder: str, main: Path, path: Path, resources: Resources, location: str) -> Path | None:
    """Return the file that MuJoCo reads; None if it is missing, which is noted in `resources`.

    file : its name, as in the model; relative to the main file's folder, else to that of the file that names it
    folder : of the main file's folder in which it is, as the model's compiler names it
    main, path : the main file, and the one that names it
    """
    names = [(main.parent, _reduced(f"{folder}/{file}" if folder else file)), (path.parent, _reduced(file))]
    if re.match(SEPARATORS, file):
        names = names[1:]
    candidates = [os.path.join(base.absolute(), name) for base, name in names]
    chosen = next(filter(os.path.exists, candidates), candidates[0])
    found = resources.find(chosen, main.parent, location)
    if found is not None:
        note_file(found)  # MuJoCo reads it
    return found


def _reduced(name: str) -> str:
    """Return a path as MuJoCo has it: with either slash, and without a folder that `..` leaves again.

    >>> _reduced("meshes\\\\old/../hull.stl")
    'meshes/hull.stl'
    """
    return os.path.normpath(re.sub(SEPARATORS, "/", name))


def _check_data(data) -> None:
    if not (is_mujoco_model(data) and hasattr(data, "model")):
        raise Error(f"data must be a mujoco.MjData (got {type(data).__name__})")
    if not data.xmat[0].any():
        raise Error("data must have positions; call mujoco.mj_forward(model, data) first")


def _parts(model) -> Iterator[Part]:
    """Yield what becomes of the model's geoms, in their order."""
    left_out = 0
    if (carrier := _sonar(model)) is not None:
        kind, number = carrier
        left_out = int((model.site_bodyid if kind == "site" else model.cam_bodyid)[number])
    names = {_name(model, "body", body) for body in range(1, model.nbody)}
    parts: dict[tuple, Part] = {}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if not _echoes(model, geom) or (body and body == left_out):
            continue
        own = _name(model, "geom", geom)
        if body == 0:
            parts[0, geom] = Part(f"world::{own}" if own in names else own, 0, [geom])
            continue
        key = body, _kind(_material(model, geom))
        if key not in parts:
            name = _name(model, "body", body)
            is_first = not any(number == body for number, _ in parts)
            parts[key] = Part(name if is_first else f"{name}::{own}", body, [])
        parts[key].geoms.append(geom)
    yield from parts.values()


def _name(model, kind: str, number: int) -> str:
    """Return the name of a body or geom; of one without, `body_3` by its number, or `body_3_` if that is taken."""
    import mujoco

    if name := getattr(model, kind)(number).name:
        return name
    name, of_kind = f"{kind}_{number}", getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    while mujoco.mj_name2id(model, of_kind, name) >= 0:
        name += "_"
    return name


def _body_number(model, name: str) -> int:
    """Return the number of MuJoCo's body from which `_parts` made a body of this name; 0 if there is none."""
    import mujoco

    for candidate in (name, name.rpartition("::")[0]):
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, candidate)
        if number >= 0:
            return number
        found = re.fullmatch(r"body_(\d+)_*", candidate)
        if found and int(found[1]) < model.nbody and not model.body(int(found[1])).name:
            return int(found[1])
    return 0


def _echoes(model, geom: int) -> bool:
    """Return whether a geom is one that MuJoCo's viewer shows."""
    rgba, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.array_equal(rgba, DEFAULT_RGBA):
        rgba = model.mat_rgba[material]
    return model.geom_group[geom] <= VISIBLE_GROUPS and rgba[3] > 0


def _material(model, geom: int) -> Material | None:
    """Return the acoustic material of a geom, if its MuJoCo material has the name of one."""
    number = model.geom_matid[geom]
    return find_material(model.mat(number).name) if number >= 0 else None


def _kind(found: Material | None) -> SurfaceKind:
    """Return the kind of surface that a material has, or that of none."""
    if found is None or not found.specular:
        return SurfaceKind()
    return SurfaceKind(found.specular, found.roughness_rad)


def _reflectivity(model, geom: int) -> tuple[float, str | None]:
    found = _material(model, geom)
    return (DEFAULT_REFLECTIVITY, None) if found is None else (found.reflectivity, found.name)


def _shape_in_body(model, geom: int) -> Shape:
    """Return the surface of a geom in the frame of its body; of one of the world, in the world's."""
    import mujoco

    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return primitives.transform(_shape(model, geom), _pose(model.geom_pos[geom], rotation))


def _shape(model, geom: int) -> Shape:
    """Return the surface of a geom in its own frame."""
    import mujoco

    kind, size, number = int(model.geom_type[geom]), model.geom_size[geom], int(model.geom_dataid[geom])
    kinds = mujoco.mjtGeom
    if kind == kinds.mjGEOM_PLANE:
        return primitives.plane(size=np.where(size[:2] > 0, 2 * size[:2], primitives.INFINITE_PLANE_M))
    if kind == kinds.mjGEOM_SPHERE:
        return primitives.sphere(size[0])
    if kind == kinds.mjGEOM_CAPSULE:
        return primitives.capsule(size[0], 2 * size[1])
    if kind == kinds.mjGEOM_ELLIPSOID:
        return primitives.ellipsoid(size)
    if kind == kinds.mjGEOM_CYLINDER:
        return primitives.cylinder(size[0], 2 * size[1])
    if kind == kinds.mjGEOM_BOX:
        return primitives.box(2 * size)
    if kind == kinds.mjGEOM_HFIELD:
        first, rows, columns = model.hfield_adr[number], model.hfield_nrow[number], model.hfield_ncol[number]
        heights = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
        x_m, y_m, z_m, _ = model.hfield_size[number]
        return primitives.terrain(heights[::-1] * z_m, (2 * x_m, 2 * y_m))  # its first row is at -y
    if number >= 0:  # a mesh, or a signed distance field with the mesh that MuJoCo draws
        first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
        start, n_faces = model.mesh_faceadr[number], model.mesh_facenum[number]
        return make_shape(model.mesh_vert[first : first + count], model.mesh_face[start : start + n_faces])
    raise Error(
        f"geom {_name(model, 'geom', geom)!r} must be of a kind with a surface (got {kinds(kind).name})"
    )


def _carriers(model) -> Iterator[tuple[str, int, str]]:
    """Yield kind, number and name of all sites, then of all cameras."""
    for kind, count in (("site", model.nsite), ("camera", model.ncam)):
        for number in range(count):
            yield kind, number, getattr(model, kind)(number).name


def _sonar(model) -> tuple[str, int] | None:
    """Return the kind and number of the site or camera that is the sonar."""
    for kind, number, name in _carriers(model):
        if any(word in name.lower() for word in SONAR_WORDS):
            return kind, number
    return None


def _named_carrier(model, name: str) -> tuple[str, int]:
    """Return the kind and number of the site of this name, else of the camera."""
    check_kind("name", name, str, "that of a site or camera of the MuJoCo model")
    found = [carrier for carrier in _carriers(model) if carrier[2]]
    for kind, number, own in found:
        if own == name:
            return kind, number
    known = nearest_names(name, {own for *_, own in found}) if found else "there are none"
    raise Error(f"name must be that of a site or camera of the MuJoCo model (got {name!r}; {known})")


def _sonar_pose(data, carrier: tuple[str, int]) -> np.ndarray:
    kind, number = carrier
    if kind == "site":
        return _pose(data.site_xpos[number], data.site_xmat[number])
    return _pose(data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3) @ CAMERA_FROM_SONAR)


def _pose(position, rotation) -> np.ndarray:
    """Return the (4, 4) matrix of a position and a rotation of nine numbers."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = np.reshape(rotation, (3, 3)), position
    return out
