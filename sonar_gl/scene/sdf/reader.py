"""Scenes from SDF files: worlds, and models on their own."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from sonar_gl.core.errors import Error, errors_at, some_names
from sonar_gl.core.warn import warn_caller
from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.scene import DEFAULT_REFLECTIVITY, MAX_BODIES, Body, Scene
from sonar_gl.scene.sdf.extensions import check_extensions, read_bubbles, read_surface
from sonar_gl.scene.sdf.frames import Frame, Scope
from sonar_gl.scene.sdf.links import Link, links_of, models_of
from sonar_gl.scene.sdf.resources import GIVE_FOLDERS, SKIP_MISSING, Resources
from sonar_gl.scene.sdf.saved_state import apply_state
from sonar_gl.scene.sdf.sensors import SensorOfLink, find_sonars, ray_sensors_of, read_sensor
from sonar_gl.scene.sdf.shapes import MAX_RETRO, BodyReader, echoing_shapes, left_out_shapes
from sonar_gl.scene.sdf.urdf import model_of
from sonar_gl.scene.sdf.water import is_mark, is_water
from sonar_gl.scene.sdf.xacro import expand, split_arguments
from sonar_gl.scene.sonar_sensor import SonarSensor

MAX_NESTING = 32
MAX_MODELS = MAX_BODIES
# What is read in an element, by which a tag that is misspelt is found: a body would be absent, or stand at the origin,
# without a word.
READ = {
    "world": ("frame", "include", "model"),
    "model": ("frame", "include", "link", "model", "pose"),
    "link": ("collision", "pose", "sensor", "visual"),
    **dict.fromkeys(("collision", "frame", "include", "visual"), ("pose",)),
}
ONCE = "geometry", "pose", "uri"  # in one element; Gazebo, too, takes the first of several
NO_POSES = "origin", "position"  # less similar tags that mean a pose
MISSPELT = 0.8  # least similarity of tags, by `difflib`; the tags that SDF knows beside these reach 0.67
CHANGES_OF_INCLUDED = "}params", "experimental:params"  # in an include, whether the prefix is declared or not
NOT_READ = "actor", "population", "road"  # in a world
OTHER_ROOTS = {  # what a file of this root element is, and what to do with it
    "COLLADA": "this is a mesh: name it .dae",
    "launch": "this is a launch file of ROS: give the world or robot that it starts",
    "mujoco": "this is a model of MuJoCo: name it .xml",
    "world": "put it into <sdf>",
    "model": "put it into <sdf>; or give the folder, if it is a model.config",
}


def read_sdf(path, resource_paths=(), skip_missing: bool = False) -> Scene:
    """Read a scene from an SDF file, a world or a model on its own.

    Raises Error with file and element: broken XML, invalid numbers, unknown or duplicate names, missing files.

    path : a file of SDF (.sdf, .world), URDF (.urdf) or xacro (.xacro, also with arguments), or the folder of a model
    resource_paths, skip_missing : as for `load_scene`; no file outside the folders of `Resources` is read

    docs/conventions.md, "Scenes in SDF", says which links become bodies, and which tags count.
    """
    text, arguments = split_arguments(str(path))
    path = Path(text)
    if path.is_dir():
        name, resources = path.resolve().name, Resources(path / "model.sdf", resource_paths)
        path = resources.file_of_model(path)
    else:
        name, resources = path.stem.removesuffix(".urdf"), Resources(path, resource_paths)
    top, scope, beside = _read_root(resources, path, arguments)
    surface = {}
    for child in check_extensions(top, ("surface",), scope.location):
        surface = read_surface(child, scope.location_of("sonar_gl:surface"))
    tree = TreeReader(resources, beside)
    tree.fill(scope, top, (path.resolve(),))
    moved = apply_state(scope, top)
    links = list(links_of(scope, np.eye(4)))
    sonars = find_sonars(links)
    sensors, changed = _read_sensors(sonars)
    reader = BodyReader(resources)
    bodies = _read_bodies(links, sonars[0].link if sonars else None, reader)
    _warn_of_broken_xml(path, resources)
    water, height_m = _read_water(links, resources)
    if surface:
        height_m = None  # the file states the surface
    elif height_m is not None:
        surface = {"surface_z_m": height_m}
    rays = [] if sonars else ray_sensors_of(links)
    _warn(path, [*_notes(water, height_m, rays), *tree.notes(path), moved])
    _check_missing(path, resources, skip_missing)
    _warn_of_shapes(path, reader, tree.misplaced, len(bodies))
    _warn(path, changed)
    plumes = _read_plumes(links)
    _warn_of_angles(path, scope.large_angles)
    with errors_at(str(path)):
        sonar_pose, models = sensors[0].pose if sensors else None, dict(models_of(scope, np.eye(4)))
        return Scene([*bodies, *plumes], sonar_pose, name, **surface, sensors=sensors, models=models)


def _warn(path: Path, notes: Iterable[str]) -> None:
    """Warn once of all notes that are not empty."""
    if said := "; ".join(filter(None, notes)):
        warn_caller(f"{path}: {said}")


def _warn_of_broken_xml(path: Path, resources: Resources) -> None:
    """Warn of files that are no good XML."""
    if resources.recovered:
        files = [
            ", ".join(filter(None, ("" if file == path else str(file), why))) or str(file)
            for file, why in resources.recovered.items()
        ]
        warn_caller(f"{path}: broken XML, read as Gazebo reads it: {'; '.join(files)}")


def _notes(water: list[str], height_m: float | None, rays: list[str]) -> Iterator[str]:
    """Yield what to say of shapes of water that are left out, the surface that one gives, and ray sensors."""
    if water:
        yield f"water and marks are no bodies, and are left out ({some_names(water)})"
    if height_m is not None:
        yield f"the water's surface is taken from its shape, z = {height_m:g} m"
    if rays:
        yield (
            f"no sensor is named after a sonar; if a ray sensor stands for one ({some_names(rays)}), write 'sonar' "
            "into its name, and its place and settings are taken"
        )


def _check_missing(path: Path, resources: Resources, skip_missing: bool) -> None:
    """Raise an Error if files are missing or shapes cannot be read; with `skip_missing` warn of them."""
    missing, unsupported = resources.missing(path), resources.unsupported()
    if not missing and not unsupported:
        return
    if not skip_missing:
        message = "\n".join(filter(None, (missing, unsupported)))
        folders = f"Give the folders that hold them ({GIVE_FOLDERS}), or carry"
        raise Error(f"{message}\n{folders if missing else 'Carry'} on without them ({SKIP_MISSING}True).")
    without = [f"what is missing ({some_names(resources.missing_uris())})"] if missing else []
    without += [f"shapes that cannot be read ({unsupported})"] if unsupported else []
    warn_caller(f"{path}: read without {', and without '.join(without)}")


def _warn_of_shapes(path: Path, reader: BodyReader, misplaced: list[str], n_bodies: int) -> None:
    """Warn of what is assumed of shapes, and of tags of them that are left out."""
    for found, what, reflectivity in (
        (reader.unspecified, "no <laser_retro>", DEFAULT_REFLECTIVITY),
        (reader.saturated, f"<laser_retro> is more than {MAX_RETRO}", 1),
    ):
        if found:
            names = some_names([name for names in found.values() for name in names])
            warn_caller(
                f"{path}: {what} in {len(found)} of {n_bodies} bodies ({names}); "
                f"their reflectivity is taken as {reflectivity}"
            )
    if misplaced or reader.misspelt:
        names = _places([*misplaced, *reader.misspelt], path)
        warn_caller(f"{path}: tags that SDF does not know there are left out: {names}")
    if reader.unsized:
        names = _places(reader.unsized, path)
        warn_caller(
            f"{path}: height maps without <size> are 1 m wide and long, which is SDF's default: {names}"
        )
    if 0 < max(reader.retros, default=0) <= 1:
        got = some_names([f"{value:g}" for value in sorted(reader.retros)])
        warn_caller(
            f"{path}: no <laser_retro> is more than 1 (got {got}), where {MAX_RETRO} stands for a reflectivity of 1; "
            f"multiply them by {MAX_RETRO} if they are reflectivities"
        )


def _warn_of_angles(path: Path, large_angles: dict[str, bool]) -> None:
    """Warn of poses whose radians were probably meant as degrees."""
    for of_origin, cure in (
        (False, 'write <pose degrees="true">'),
        (True, "multiply them by π/180, as URDF has no degrees"),
    ):
        if places := [place for place, is_one in large_angles.items() if is_one == of_origin]:
            warn_caller(
                f"{path}: {len(places)} pose{'s have' if len(places) > 1 else ' has'} angles of more than 2.5π, read "
                f"as radians, as by Gazebo; if they are degrees, {cure} ({_places(places, path)})"
            )


def _places(texts: Iterable[str], path: Path) -> str:
    """Return some of the places in a file, for a message that names the file."""
    return some_names([text.removeprefix(f"{path}: ") for text in texts])


def _read_root(resources: Resources, path: Path, arguments: dict[str, str]):
    """Return the element that holds the models of a file, or the links of a robot, and an empty scope for it.

    The third is a list of the places of worlds, models and includes that stand beside the world, and are not read.
    """
    if path.suffix.lower() == ".xacro":
        root = resources.parse_xml(expand(path, arguments, resources), path)
    else:
        if arguments:
            raise Error(f"{path}: only a .xacro file takes arguments (got {', '.join(arguments)})")
        root = resources.parse(path)
    if root.tag == "robot":
        return model_of(root, str(path)), Scope(f"{path}: ", path.parent, is_world=True), []
    if root.tag not in ("sdf", "gazebo"):
        known = f"; {OTHER_ROOTS[root.tag]}" if root.tag in OTHER_ROOTS else ""
        raise Error(f"{path}: the root element must be <sdf>, or <robot> of URDF (got <{root.tag}>{known})")
    world = root.find("world")
    if world is None and all(root.find(tag) is None for tag in ("model", "include", "light", "actor")):
        raise Error(f"{path}: must hold a <world> or a <model>")
    scope = Scope(f"{path}: " + ("" if world is None else "world"), path.parent, is_world=True)
    if world is None:
        return root, scope, []
    beside = [one for tag in ("world", "model", "include") for one in root.findall(tag) if one is not world]
    return world, scope, [f"{path}: {one.tag}[{_name_of(one)}]" for one in beside]


def _read_sensors(sonars: list[SensorOfLink]) -> tuple[list[SonarSensor], list[str]]:
    """Return the sensors, and what of the first one, whose sonar is used, had to be changed."""
    sensors, changed = [], []
    for sonar in sonars:
        try:
            sensor, notes = read_sensor(sonar)
        except Error:
            if not sensors:
                raise
            continue  # its pose is wrong, but nobody asked for it
        changed += [] if sensors else [f"{sensor}: {note}" for note in notes]
        sensors.append(sensor)
    return sensors, changed


def _read_bodies(links: list[Link], carrier: Link | None, reader: BodyReader) -> list[Body]:
    """Return the bodies of all links but the sonar's."""
    n_with_geometry = Counter(link.model for link in links if echoing_shapes(link))
    bodies = []
    for link in links:
        if link is carrier:
            continue
        name = link.model if n_with_geometry[link.model] == 1 and link.model else link.path
        bodies += reader.read(link, name)
    return bodies


def _read_water(links: list[Link], resources: Resources) -> tuple[list[str], float | None]:
    """Return the names of shapes that are left out, as water or marks, and the height of the water's surface."""
    reader, names, heights = BodyReader(resources), {}, []
    for link in links:
        names |= dict.fromkeys(left_out_shapes(link))
        for element in link.element.findall("collision") + link.element.findall("visual"):
            if is_water(link, element) and not is_mark(link):
                heights.append(reader.height_of_water(link, element))
    heights = [height for height in heights if height is not None]
    return list(names), max(heights, default=None)


def _read_plumes(links: list[Link]) -> list[Bubbles]:
    """Return the bubble plumes of links, each named after its model unless it has a name."""
    out = []
    for link in links:
        for child in check_extensions(link.element, ("bubbles",), link.location):
            location = f"{link.location}/sonar_gl:bubbles"
            name = child.get("name") or f"{link.model or link.name}::bubbles"
            pose = link.world_pose() @ link.pose_in_link(child, location)
            out.append(read_bubbles(child, name, pose, location))
    return out


class TreeReader:
    """Makes the tree of scopes of a scene.

    repeated : places of elements that are not read, since one before them is
    misplaced : what to say of shapes out of links, and of misspelt tags
    """

    def __init__(self, resources: Resources, repeated: list[str]):
        self.resources, self.misplaced, self._n_models = resources, [], 0
        self._repeated = list(repeated)
        self._left_out = []  # kinds and names of what Gazebo shows, and is not read
        self._changed = []  # names of included models whose elements the scene changes, which is not read

    def notes(self, path: Path) -> Iterator[str]:
        """Yield what to say of what is not read."""
        if self._repeated:
            places = _places(dict.fromkeys(self._repeated), path)
            yield f"where one element may stand, the first is read, and others are left out ({places})"
        if self._changed:
            names = some_names(self._changed)
            yield f"changes of included models by <experimental:params> are left out ({names})"
        if self._left_out:
            yield f"actors, populations and roads are left out ({some_names(self._left_out)})"

    def fill(self, scope: Scope, element, stack: tuple) -> None:
        """Add the frames, links and models of a world or model to its scope, with those of included models.

        element : its `<world>`, `<model>` or root element
        stack : for each model or file that led here, the file, or None for a model within a file
        """
        self._note_tags(element, scope.location_of(""))
        for child in element:
            self._read_child(scope, child, stack)
        for joint in element.findall("joint"):  # last, since old files give joints the names of links
            name, base = _name_of(joint), (joint.findtext("child") or "").strip()
            frame = Frame(joint.find("pose"), scope.location_of(f"joint[{name}]"), base)
            scope.frames.setdefault(name, frame)
        for name in map(_name_of, element.findall("frame")):
            scope.find(name, scope.frames[name].location)  # raises errors of frames that nothing refers to

    def _read_child(self, scope: Scope, child, stack: tuple):
        """Add what a child of a world or model holds, but for joints; arguments as of `fill`."""
        name = _name_of(child)
        location = scope.location_of(
            _include_text(child) if child.tag == "include" else f"{child.tag}[{name}]"
        )
        if child.tag in ("frame", "include", "link"):
            self._note_tags(child, f"{location}/")
        if child.tag == "model":
            placement = child.get("placement_frame") or ""
            inner = scope.inner(location, scope.folder)
            frame = Frame(child.find("pose"), location, "", inner, placement)
            self._add_model(scope, name, frame, child, (*stack, None), location)
        elif child.tag == "include":
            self._include(scope, child, stack)
        elif child.tag == "link":
            scope.add(name, Frame(child.find("pose"), location))
            scope.links[name] = child
            for tag in ("collision", "visual", "sensor"):
                for one in child.findall(tag):
                    self._note_tags(one, f"{location}/{tag}[{_name_of(one)}]/")
        elif child.tag == "frame":
            base = (child.get("attached_to") or "").strip()
            scope.add(name, Frame(child.find("pose"), location, base))
        elif child.tag in ("collision", "visual"):
            self.misplaced.append(f"{location} (it must be in a link)")
        elif child.tag in NOT_READ:
            self._left_out.append(f"{child.tag} {name}")

    def _note_tags(self, element, location: str):
        """Note the tags in an element that are misspelt, or repeated; `location` ends where theirs follow."""
        self.misplaced += [f"{location}{text}" for text in _misspelt_tags(element)]
        self._repeated += [f"{location}{tag}" for tag in ONCE if len(element.findall(tag)) > 1]

    def _add_model(self, scope: Scope, name: str, frame: Frame, element, stack: tuple, location: str):
        self._n_models += 1
        if len(stack) > MAX_NESTING or self._n_models > MAX_MODELS:
            raise Error(
                f"{location}: a scene must hold at most {MAX_MODELS} models, at most {MAX_NESTING} deep"
            )
        scope.add(name, frame, location)
        self.fill(frame.scope, element, stack)

    def _include(self, scope: Scope, element, stack: tuple):
        uri = (element.findtext("uri") or "").strip()
        name = (element.findtext("name") or "").strip()
        location = scope.location_of(_include_text(element))
        path = self.resources.find_model(uri, scope.folder, location)
        if isinstance(path, Path) and uri.lower().startswith("http") and path.resolve() in stack:
            # a file may stand for the model of Fuel that has the name of the file's own folder
            self.resources.note_missing(uri, location, [])
            path = None
        if path is None:
            # the file is noted as missing; poses relative to the model must still resolve
            name = name or uri.rstrip("/").rpartition("/")[2]
            scope.frames.setdefault(name, Frame(element.find("pose"), location))
            return
        built_in = not isinstance(path, Path)
        file = path if built_in else path.resolve()
        if file in stack:
            names = " -> ".join(str(f) for f in [*stack[stack.index(file) :], file] if f is not None)
            raise Error(f"{location}: a model must not include itself (got {names})")
        root = self.resources.parse(path)
        model = model_of(root, str(path)) if root.tag == "robot" else root.find("model")
        if model is None:
            if root.find("light") is None and root.find("actor") is None:
                raise Error(f"{path}: must hold a <model> (included by {location})")
            self._left_out += [f"actor {_name_of(one)}" for one in root.findall("actor")]
            return
        self._repeated += [
            f"{path}: model[{_name_of(one)}]" for one in root.findall("model") if one is not model
        ]
        name = name or _name_of(model)
        if any(str(child.tag).endswith(CHANGES_OF_INCLUDED) for child in element):
            self._changed.append(name)
        model_location = f"{path}: model[{name}]"
        pose_element, pose_location = element.find("pose"), location
        if pose_element is None:
            pose_element, pose_location = model.find("pose"), model_location
        placement = (element.findtext("placement_frame") or model.get("placement_frame") or "").strip()
        inner = scope.inner(model_location, scope.folder if built_in else path.parent)
        frame = Frame(pose_element, pose_location, "", inner, placement)
        if (element.get("merge") or "").strip() in ("true", "1"):
            self._merge_model(scope, name, frame, model, (*stack, file), location)
        else:
            self._add_model(scope, name, frame, model, (*stack, file), location)

    def _merge_model(self, scope: Scope, name: str, frame: Frame, element, stack: tuple, location: str):
        """Add a model whose frames, links and models are those of the scope that includes it."""
        own_name = f"_merged__{name}__model__"  # Gazebo's, too
        if scope.holds(own_name):
            raise Error(
                f"{location}: model {name!r} must be merged once (got it twice, so that links would have the same "
                'names; leave merge="true" out of one <include>)'
            )
        self._add_model(scope, own_name, frame, element, stack, location)
        if scope.is_world and (names := frame.scope.link_names()):
            raise Error(
                f'{location}: a world holds models, no links (got merge="true" of a model with link {names[0]!r}; '
                "leave merge out)"
            )
        scope.merge(own_name, location)


def _name_of(element) -> str:
    """Return the name of an element, empty if it gives none."""
    return (element.get("name") or "").strip()


def _include_text(element) -> str:
    """Return the name of an `<include>` for messages, or what it includes if it gives no name."""
    texts = [(element.findtext(tag) or "").strip() for tag in ("name", "uri")]
    return f"include[{texts[0] or texts[1]}]"


def _misspelt_tags(element) -> Iterator[str]:
    """Yield what to say of tags in an element that mean one that is read there; of poses, one that is absent."""
    for child in element:
        meant = _meant_tag(element.tag, child.tag) if isinstance(child.tag, str) else None  # no comment
        if meant is not None and not (meant == "pose" and element.find("pose") is not None):
            yield f"{child.tag} (did you mean {meant!r}?)"


@lru_cache
def _meant_tag(parent: str, tag: str) -> str | None:
    """Return the tag that a misspelt one in an element of the tag `parent` means; None of one that is not misspelt."""
    read = READ.get(parent, ())
    if tag in read:
        return None
    if tag in NO_POSES and "pose" in read:
        return "pose"
    return next(iter(difflib.get_close_matches(tag.lower(), read, 1, MISSPELT)), None)
