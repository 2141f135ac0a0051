"""Gazebo's scene files, SDF: worlds and bare models."""

from __future__ import annotations

import warnings
from collections import Counter
from pathlib import Path

import numpy as np

from sonar_gl.frames import Frame, Scope
from sonar_gl.links import Link, ShapeReader, sonar_of
from sonar_gl.own_tags import own_children, read_bubbles, read_surface
from sonar_gl.resources import Finder
from sonar_gl.scene import Scene
from sonar_gl.types import Error

MAX_NESTING = 32
MAX_MODELS = 65535


def read_sdf(path, resource_paths=(), skip_missing: bool = False) -> Scene:
    """The bodies of an SDF file, world or bare model, and the place of its sonar.

    A link is a body, named after its model, or `model::link` where a model has several links with geometry.
    Of a link the collisions count, unless it has none or `<laser_retro>` stands in its visuals alone.
    Reflectivity is laser_retro / 255, or 0.5, with one warning, where the tag is absent. Beside that tag may
    stand `<sonar_gl:material>`, a name; `<sonar_gl:specular>` and `<sonar_gl:roughness>`, numbers of `Body`,
    which go before the material, as laser_retro does; and `<sonar_gl:reflectivity_map>`, an image that is
    laid on the shape from above, first row at the highest y, and goes before all others. Shapes of a link
    whose lobes differ are bodies of their own, `model::shape`, after the first. The sonar is the
    first `<sensor type="custom">`, else the first sensor whose own name or plugin, else whose model, speaks
    of a sonar; the link that carries it does not echo. A link may hold `<sonar_gl:bubbles>`, a plume, and a
    world `<sonar_gl:surface>`, see `own_tags`. Tags of no acoustic meaning are passed over.

    Parameters
    ----------
    path : an .sdf or .world file
    resource_paths : folders that `model://` is looked for in, before those of the environment variables
        GZ_SIM_RESOURCE_PATH and GAZEBO_MODEL_PATH and the file's own folder; nothing outside them is read
    skip_missing : warn of missing models and meshes, and carry on without them

    Raises
    ------
    Error
        with file and element: broken XML, numbers that make no sense, unknown or double names, missing files.
    """
    path = Path(path)
    finder = Finder(path, resource_paths)
    reader = _Reader(finder)
    world = reader.read(path)
    bodies, sonar_pose, silent = reader.bodies(world)
    if missing := finder.missing(path):
        if not skip_missing:
            raise Error(
                f"{missing}\nGive the folders that hold them (--resource-path, resource_paths=), "
                "or carry on without them (--skip-missing, skip_missing=True)."
            )
        warnings.warn(f"{missing}\nThe scene is read without them.", stacklevel=2)
    if silent:
        some = ", ".join(silent[:10]) + (f" and {len(silent) - 10} more" if len(silent) > 10 else "")
        warnings.warn(
            f"{path}: no <laser_retro> in {len(silent)} of {len(bodies)} bodies ({some}); "
            "their reflectivity is taken as 0.5",
            stacklevel=2,
        )
    try:
        return Scene([*bodies, *reader.plumes(world)], sonar_pose, path.stem, **reader.surface)
    except Error as why:
        raise Error(f"{path}: {why}") from None


class _Reader:
    """Reads one scene: first the tree of models, then the links in it."""

    def __init__(self, finder: Finder):
        self.finder = finder
        self.n_models, self.surface = 0, {}
        self.shapes = ShapeReader(finder)

    def read(self, path: Path) -> Scope:
        root = self.finder.parse(path)
        if root.tag not in ("sdf", "gazebo"):
            raise Error(f"{path}: the root element must be <sdf> (got <{root.tag}>)")
        world = root.find("world")
        if world is None and root.find("model") is None:
            raise Error(f"{path}: must hold a <world> or a <model>")
        scope = Scope(f"{path}: " + ("" if world is None else "world"), path.parent, is_world=True)
        top = root if world is None else world
        for child in own_children(top, ("surface",), scope.where):
            self.surface = read_surface(child, scope.at("sonar_gl:surface"))
        return self.fill(scope, top, (path.resolve(),))

    def fill(self, scope: Scope, element, stack: tuple) -> Scope:
        """Put the frames, links and models of a world or model into its scope, with all that it includes."""
        for child in element:
            name = (child.get("name") or "").strip()
            where = scope.at(f"{child.tag}[{name}]")
            if child.tag == "model":
                placement = child.get("placement_frame") or ""
                frame = Frame(child.find("pose"), where, "", Scope(where, scope.folder), placement)
                self.model(scope, name, frame, child, (*stack, None), where)
            elif child.tag == "include":
                self.include(scope, child, stack)
            elif child.tag == "link":
                scope.add(name, Frame(child.find("pose"), where))
                scope.links[name] = child
            elif child.tag == "frame":
                scope.add(name, Frame(child.find("pose"), where, (child.get("attached_to") or "").strip()))
        for joint in element.findall("joint"):  # last: old files give joints the names of links
            name = (joint.get("name") or "").strip()
            base = (joint.findtext("child") or "").strip()
            scope.frames.setdefault(name, Frame(joint.find("pose"), scope.at(f"joint[{name}]"), base))
        for name in [(frame.get("name") or "").strip() for frame in element.findall("frame")]:
            scope.find(name, scope.frames[name].where)
        return scope

    def model(self, scope: Scope, name: str, frame: Frame, element, stack: tuple, where: str):
        self.n_models += 1
        if len(stack) > MAX_NESTING or self.n_models > MAX_MODELS:
            raise Error(f"{where}: a scene must hold at most {MAX_MODELS} models, at most {MAX_NESTING} deep")
        scope.add(name, frame, where)
        self.fill(frame.scope, element, stack)

    def include(self, scope: Scope, element, stack: tuple):
        uri = (element.findtext("uri") or "").strip()
        name = (element.findtext("name") or "").strip()
        where = scope.at(f"include[{name or uri}]")
        path = self.finder.find_model(uri, scope.folder, where)
        if path is None:  # noted; what is placed relative to it must not fail for it
            scope.frames.setdefault(
                name or uri.rstrip("/").rpartition("/")[2], Frame(element.find("pose"), where)
            )
            return
        built_in = not isinstance(path, Path)
        file = path if built_in else path.resolve()
        if file in stack:
            names = " -> ".join(str(f) for f in [*stack[stack.index(file) :], file] if f is not None)
            raise Error(f"{where}: a model must not include itself (got {names})")
        root = self.finder.parse(path)
        model = root.find("model")
        if model is None:
            if root.find("light") is None and root.find("actor") is None:
                raise Error(f"{path}: must hold a <model> (included by {where})")
            return
        name = name or (model.get("name") or "").strip()
        model_where = f"{path}: model[{name}]"
        pose_element, pose_where = element.find("pose"), where
        placement = (element.findtext("placement_frame") or model.get("placement_frame") or "").strip()
        if pose_element is None:
            pose_element, pose_where = model.find("pose"), model_where
        inner = Scope(model_where, scope.folder if built_in else path.parent)
        frame = Frame(pose_element, pose_where, "", inner, placement)
        self.model(scope, name, frame, model, (*stack, file), where)

    def links(self, scope: Scope, world_from_scope: np.ndarray, model: str = ""):
        """Every link, in the order of the file."""
        for name, frame in scope.frames.items():
            if frame.scope is not None:
                inner = world_from_scope @ scope.find(name, frame.where)
                yield from self.links(frame.scope, inner, f"{model}::{name}" if model else name)
            elif name in scope.links:
                yield Link(scope, name, scope.links[name], model, world_from_scope)

    def plumes(self, world: Scope):
        """Bubbles of all links, named after the model unless they have a name."""
        for link in self.links(world, np.eye(4)):
            for child in own_children(link.element, ("bubbles",), link.where):
                where, name = f"{link.where}/sonar_gl:bubbles", child.get("name") or f"{link.model}::bubbles"
                pose = link.world_pose() @ link.pose_in_link(child, where)
                yield read_bubbles(child, name, pose, where)

    def bodies(self, world: Scope):
        """Bodies, the sonar's pose or None, and the names of bodies without <laser_retro>."""
        links = list(self.links(world, np.eye(4)))
        carrier, sonar_pose = sonar_of(links)
        with_geometry = Counter(link.model for link in links if link.shapes())
        bodies, silent = [], []
        for link in links:
            if link is carrier:
                continue
            name = link.model if with_geometry[link.model] == 1 else f"{link.model}::{link.name}"
            found, complete = self.shapes.bodies(link, name)
            bodies += found
            if not complete:
                silent.append(name)
        return bodies, sonar_pose, silent
