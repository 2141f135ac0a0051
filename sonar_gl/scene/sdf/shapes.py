"""The shapes of a link, as bodies: geometry and surface properties."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from sonar_gl.core.checks import check_number
from sonar_gl.core.errors import Error, errors_at, one_line, similar_names
from sonar_gl.scene import mesh_files, primitives
from sonar_gl.scene.joined_shapes import EchoingShape, SurfaceKind, body_of_shapes
from sonar_gl.scene.materials import material
from sonar_gl.scene.primitives import Shape
from sonar_gl.scene.reflectivity_map import textured_from_above
from sonar_gl.scene.scene import DEFAULT_REFLECTIVITY, ROUGHNESS_BOUNDS_RAD, SPECKLE_SHAPE_BOUNDS, Body
from sonar_gl.scene.sdf.extensions import check_extensions, find_extension, list_extensions
from sonar_gl.scene.sdf.frames import read_numbers
from sonar_gl.scene.sdf.links import Link
from sonar_gl.scene.sdf.resources import Resources
from sonar_gl.scene.sdf.water import is_invisible, is_mark, is_water, surface_z_m

# Sizes of the shapes, by which a tag that is misspelt is found: SDF's default would take its place without a word.
SIZES = {
    "box": ("size",),
    "capsule": ("length", "radius"),
    "cone": ("length", "radius"),
    "cylinder": ("length", "radius"),
    "ellipsoid": ("radii",),
    "heightmap": ("pos", "size"),
    "mesh": ("scale", "submesh"),
    "plane": ("normal", "size"),
    "polyline": ("height", "point"),
    "sphere": ("radius",),
}
# shapes in which another tag with numbers stands in the place of a size that is absent, as a diameter does
SOLIDS = "box", "capsule", "cone", "cylinder", "ellipsoid", "sphere"
MAX_RETRO = 255  # of laser_retro, for which SDF has no limit: what is more reflects all
MAX_NUMBER = 100_000  # of laser_retro: more is a mistake
# of a shape, in namespace sonar_gl
EXTENSIONS = "material", "reflectivity_map", "roughness", "speckle_shape", "specular"


class SurfaceProperties(NamedTuple):
    """The surface properties of a shape, as `Body` takes them; roughness_rad of its kind is None without a lobe."""

    reflectivity: float
    material: str | None
    kind: SurfaceKind


def echoing_shapes(link: Link) -> list:
    """Return the elements of a link that make its bodies: collisions, or visuals, but for water and marks.

    Visuals are taken if there are no collisions, or if visuals have surface properties and collisions have
    none.
    """
    return [element for element in _solid_shapes(link) if not _is_left_out(link, element)]


def left_out_shapes(link: Link) -> list[str]:
    """Return the names of the shapes of a link that would make bodies if they were not water or marks."""
    solid = _solid_shapes(link)
    return names_at_fault(link.path, [e for e in solid if _is_left_out(link, e)], solid)


def names_at_fault(owner: str, elements: list, among: list) -> list[str]:
    """Return the names for a message about some elements of a link: of the owner alone if it is about all of them."""
    if elements and len(elements) == len(among):
        return [owner]
    return [f"{owner}/{element.tag}[{element.get('name') or ''}]" for element in elements]


def _is_left_out(link: Link, element) -> bool:
    is_no_solid = is_mark(link) or is_water(link, element) or is_invisible(link, element)
    return is_no_solid and not _has_surface_properties(element)


def _solid_shapes(link: Link) -> list:
    collisions, visuals = (
        [e for e in link.element.findall(kind) if e.find("geometry/empty") is None]
        for kind in ("collision", "visual")
    )
    only_visuals_specified = any(map(_has_surface_properties, visuals)) and not any(
        map(_has_surface_properties, collisions)
    )
    return visuals if not collisions or only_visuals_specified else collisions


def _has_surface_properties(element) -> bool:
    return element.find("laser_retro") is not None or bool(list_extensions(element))


def read_surface_properties(element, location: str) -> SurfaceProperties:
    """Return the surface properties of a collision or visual.

    `<laser_retro>` and the elements for single properties override the material's.

    Raises Error if an element or a material is unknown, or a number is invalid.
    """
    check_extensions(element, EXTENSIONS, location)

    def number(child, name, low, high):
        if child is None:
            return None
        value = read_numbers(child, f"{location}/{name}", 1)[0]
        return check_number(f"{location}/{name}:", value, low, high)

    found, named = None, find_extension(element, "material")
    if named is not None:
        with errors_at(f"{location}/sonar_gl:material"):
            found = material((named.text or "").strip())
    retro = number(element.find("laser_retro"), "laser_retro", 0, MAX_NUMBER)
    reflectivity = found.reflectivity if found else DEFAULT_REFLECTIVITY
    if retro is not None:
        reflectivity = min(retro / MAX_RETRO, 1.0)
    specular = number(find_extension(element, "specular"), "sonar_gl:specular", 0, 1)
    if specular is None:
        specular = found.specular if found else 0.0
    child = find_extension(element, "roughness")
    roughness_rad = number(child, "sonar_gl:roughness", *ROUGHNESS_BOUNDS_RAD)
    if roughness_rad is None and found:
        roughness_rad = found.roughness_rad
    child = find_extension(element, "speckle_shape")
    speckle_shape = number(child, "sonar_gl:speckle_shape", *SPECKLE_SHAPE_BOUNDS)
    kind = SurfaceKind(specular, roughness_rad if specular else None, speckle_shape)
    return SurfaceProperties(reflectivity, found and found.name, kind)


class BodyReader:
    """Makes the bodies of links. Each mesh file is read once; bodies that show it in one size and place share it.

    unspecified : name of a body -> names of shapes whose reflectivity the file does not specify, or of the body
    saturated : the same of shapes whose laser_retro is more than MAX_RETRO
    retros : the values of laser_retro that shapes state, and that no image overrides
    misspelt : what to say of tags of shapes that are none, but similar to one that is absent
    unsized : locations of height maps without `<size>`, of which SDF's default is 1 m x 1 m
    """

    def __init__(self, resources: Resources):
        self.resources = resources
        self.unspecified, self.saturated, self.retros = {}, {}, set()
        self.misspelt: list[str] = []
        self.unsized: list[str] = []
        self._meshes, self._sized_meshes = {}, {}

    def read(self, link: Link, name: str) -> list[Body]:
        """Return the bodies of a link.

        Shapes of one `SurfaceKind` are joined. The body of the first shape has the name `name`,
        those with others `name::shape`. Named after its model, a body has the model's pose, since what moves it by
        that name means the model; else the link's.
        """
        groups, names, read, unspecified, saturated = {}, {}, [], [], []
        pose, body_from_link = link.world_pose(), np.eye(4)
        if name == link.model:
            pose, body_from_link = link.world_from_model, link.pose_in_model()
        for element in echoing_shapes(link):
            location = f"{link.location}/{element.tag}[{element.get('name') or ''}]"
            matrix = link.pose_in_link(element, location)
            shape = self._read_geometry(link, element, location)
            if shape is None:
                continue
            surface = read_surface_properties(element, location)
            reflectivity, image = surface.reflectivity, find_extension(element, "reflectivity_map")
            if image is not None:
                location = f"{location}/sonar_gl:reflectivity_map"
                shape, reflectivity = self._apply_map(link, element, shape, reflectivity, location)
            retro = element.find("laser_retro")
            read.append(element)
            if retro is not None and float(retro.text) > MAX_RETRO:
                saturated.append(element)
            if retro is not None and image is None:
                self.retros.add(float(retro.text))
            if retro is None and find_extension(element, "material") is None and image is None:
                unspecified.append(element)
            names.setdefault(surface.kind, f"{name}::{element.get('name')}" if groups else name)
            shape = primitives.transform(shape, body_from_link @ matrix)
            groups.setdefault(surface.kind, []).append(EchoingShape(shape, reflectivity, surface.material))
        for found, elements in ((self.unspecified, unspecified), (self.saturated, saturated)):
            if elements:
                found[name] = names_at_fault(name, elements, read)
        with errors_at(link.location):
            return [body_of_shapes(names[kind], group, pose, kind) for kind, group in groups.items()]

    def height_of_water(self, link: Link, element) -> float | None:
        """Return the height of the surface that a shape of water has, metres; None of a wall.

        A mesh is not read: it lies in its own plane z = 0, and may be missing.
        """
        location = f"{link.location}/{element.tag}[{element.get('name') or ''}]"
        world_from_shape = link.world_pose() @ link.pose_in_link(element, location)
        if element.find("geometry/mesh") is not None:
            return float(world_from_shape[2, 3])
        shape = self._read_geometry(link, element, location)
        if shape is None:
            return None
        return surface_z_m(primitives.transform(shape, world_from_shape).mesh.vertices)

    def _apply_map(self, link: Link, element, shape: Shape, reflectivity, location: str):
        """Return a shape with its reflectivity map applied from above, and the (F,) reflectivity.

        If the map's file is missing, `resources` notes it, and the shape and reflectivity stay as they are.
        """
        if element.tag == "collision" and element.find("geometry/plane") is not None:
            raise Error(
                f"{location}: must lie on a shape of some size (the plane of a collision is infinite)"
            )
        uri = (find_extension(element, "reflectivity_map").text or "").strip()
        path = self.resources.find(uri, link.scope.folder, location)
        if path is None:
            return shape, reflectivity
        with errors_at(location):
            return textured_from_above(shape, path)

    def _read_geometry(self, link: Link, element, location: str) -> Shape | None:
        """Return the shape of a collision or visual; None if `resources` notes that it cannot be had."""
        geometry = element.find("geometry")
        if geometry is None or len(geometry) == 0:
            self.resources.note_unsupported(f"{location}: must hold a <geometry> with a shape in it")
            return None
        shape = geometry[0]
        location = f"{location}/geometry/{shape.tag}"
        self._note_misspelt(shape, location)
        if shape.tag in ("mesh", "heightmap"):
            return self._read_named_file(link, shape, location)
        if shape.tag in SIZES:
            return _read_primitive(geometry, location, is_collision=element.tag == "collision")
        self.resources.note_unsupported(
            f"{location}: unknown geometry (known are {', '.join(SIZES)}; anything can be a mesh)"
        )
        return None

    def _read_named_file(self, link: Link, shape, location: str) -> Shape | None:
        """Return the shape of a mesh or height map; None if `resources` notes that it cannot be had."""
        uri = (shape.findtext("uri") or shape.findtext("filename") or "").strip()
        path = self.resources.find(uri, link.scope.folder, f"{location}/uri")
        if path is None:
            return None
        get = partial(_read_size, shape, location)
        if shape.tag == "heightmap":
            size, pos = get("size", (1.0, 1.0, 1.0)), get("pos", (0.0, 0.0, 0.0), positive=False)
            terrain = self._read_file(location, lambda: mesh_files.heightmap(path, size, pos))
            if terrain is not None and shape.find("size") is None and location not in self.unsized:
                self.unsized.append(location)
            return terrain
        scale = get("scale", (1.0, 1.0, 1.0), positive=False)
        if not np.all(scale):
            raise Error(f"{location}/scale: must not be zero (got {shape.findtext('scale').strip()!r})")
        key = (path, shape.findtext("submesh/name"), (shape.findtext("submesh/center") or "").strip())
        if key not in self._meshes:
            self._meshes[key] = self._read_file(
                location,
                lambda: mesh_files.read_mesh(path, key[1], key[2] in ("true", "1"), self.resources.roots),
            )
        mesh, sized = self._meshes[key], (*key, *scale)
        if mesh is not None and sized not in self._sized_meshes:
            self._sized_meshes[sized] = primitives.transform(mesh, np.diag([*scale, 1.0]))
        return self._sized_meshes.get(sized)

    def _note_misspelt(self, shape, location: str) -> None:
        """Note tags of a shape that mean a size of it that is absent; refuse a size that is an attribute."""
        absent = [tag for tag in SIZES.get(shape.tag, ()) if shape.find(tag) is None]
        for tag in absent:
            if shape.get(tag) is not None:
                raise Error(
                    f"{location}: {tag!r} must be an element (got an attribute, as in SDF 1.2; write "
                    f"<{tag}>{one_line(shape.get(tag))}</{tag}>)"
                )
        for child in shape:
            known = not isinstance(child.tag, str) or child.tag in SIZES.get(shape.tag, ())
            hint = "" if known else similar_names(child.tag.lower(), absent)
            if absent and not known and not hint and shape.tag in SOLIDS and _holds_numbers(child.text):
                hint = f"known are {', '.join(SIZES[shape.tag])}"
            text = f"{location}/{child.tag} ({hint})"
            if hint and text not in self.misspelt:  # a shape of water is read for its surface, too
                self.misspelt.append(text)

    def _read_file(self, location: str, read: Callable[[], Shape]) -> Shape | None:
        """Return the shape of a file that is there; None if it cannot be read, which `resources` notes."""
        try:
            with errors_at(location):
                return read()
        except Error as why:
            self.resources.note_unsupported(str(why))
            return None


def _read_primitive(geometry, location: str, is_collision: bool) -> Shape:
    """Return the shape of a geometry that names no file."""
    shape = geometry[0]
    get = partial(_read_size, shape, location)
    if shape.tag == "box":
        return primitives.box(get("size", (1.0, 1.0, 1.0)))
    if shape.tag in ("cylinder", "capsule", "cone"):
        radius_m = 1.0 if shape.tag == "cylinder" else 0.5
        return getattr(primitives, shape.tag)(get("radius", radius_m), get("length", 1.0))
    if shape.tag == "sphere":
        return primitives.sphere(get("radius", 1.0))
    if shape.tag == "ellipsoid":
        return primitives.ellipsoid(get("radii", (1.0, 1.0, 1.0)))
    if shape.tag == "polyline":
        return _read_polylines(geometry.findall("polyline"), location, get("height", 1.0))
    normal = get("normal", (0.0, 0.0, 1.0), positive=False)
    if not np.any(normal):
        got = shape.findtext("normal").strip()
        raise Error(f"{location}/normal: must not be zero (got {got!r})")
    if is_collision:  # infinite: its <size> is only for display
        return primitives.plane(normal)
    return primitives.plane(normal, get("size", (1.0, 1.0)))


def _read_size(shape, location: str, tag: str, default, positive: bool = True):
    """Return the number of a tag of a shape, or as many as the default has; SDF's default if the tag is absent."""
    if shape.find(tag) is None:
        return default
    out = read_numbers(shape.find(tag), f"{location}/{tag}", np.size(default), positive)
    return out if np.ndim(default) else out[0]


def _read_polylines(elements, location: str, height_m: float) -> Shape:
    """Return the prism over all polylines of a geometry."""
    rings = []
    for element in elements:
        points = [read_numbers(point, f"{location}/point", 2) for point in element.findall("point")]
        # the last may be the first
        ring = [point for k, point in enumerate(points) if np.any(point != points[k - 1])]
        if len(ring) < 3:
            raise Error(f"{location}: must have three different points or more (got {len(ring)})")
        rings.append(np.array(ring))
    return primitives.extrude(rings, height_m)


def _holds_numbers(text: str | None) -> bool:
    """Return whether a text is one number or several."""
    try:
        return bool([float(word) for word in (text or "").split()])
    except ValueError:
        return False
