"""Links of SDF: their shapes as bodies, and which of them carries the sonar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl import maps, mesh_files, meshes
from sonar_gl.frames import Scope, matrix_of, numbers
from sonar_gl.materials import material
from sonar_gl.resources import Finder, tag, tags
from sonar_gl.scene import SLOPES, Body
from sonar_gl.types import Error, nearest_names

SONAR_WORDS = ("sonar", "fls", "multibeam")
# of a model whose name speaks of a sonar, only these can be one: it may carry an IMU as well
SEEING_SENSORS = {"camera", "depth", "depth_camera", "rgbd_camera", "ray", "gpu_ray", "lidar", "gpu_lidar"}
KNOWN_SHAPES = "box, capsule, cylinder, ellipsoid, heightmap, mesh, plane, sphere"

TAGS = ("material", "reflectivity_map", "roughness", "specular")  # of a shape, after sonar_gl:
SILENT = 127.5  # laser_retro, of shapes that say nothing


@dataclass(frozen=True)
class Link:
    """A link, where it is, and what it holds."""

    scope: Scope
    name: str
    element: object
    model: str  # scoped name of its model
    world_from_model: np.ndarray

    @property
    def where(self):
        return self.scope.frames[self.name].where

    def shapes(self) -> list:
        """The collisions or the visuals, whichever count."""
        collisions, visuals = (
            [e for e in self.element.findall(kind) if e.find("geometry/empty") is None]
            for kind in ("collision", "visual")
        )
        marked = [any(map(says, kind)) for kind in (collisions, visuals)]
        return visuals if not collisions or marked == [False, True] else collisions

    def world_pose(self) -> np.ndarray:
        return self.world_from_model @ self.scope.find(self.name, self.where)

    def pose_in_link(self, element, where: str) -> np.ndarray:
        """(4, 4) link_from_shape, or of a sensor."""
        pose_element, where = element.find("pose"), f"{where}/pose"
        if pose_element is None or not (pose_element.get("relative_to") or pose_element.get("frame")):
            return matrix_of(pose_element, where)
        in_model = self.scope.relative(pose_element, where, self.name)
        return np.linalg.inv(self.scope.find(self.name, self.where)) @ in_model


def says(element) -> bool:
    """Whether a collision or visual tells how it echoes."""
    return element.find("laser_retro") is not None or bool(tags(element))


def finish_of(element, where: str):
    """μ, and strength and slope of the lobe, and the name of the material, as a collision or visual says.

    What stands there by itself goes before the material, `<laser_retro>` for one.
    """
    for name in tags(element):
        if name not in TAGS:
            raise Error(f"{where}: unknown tag (got 'sonar_gl:{name}'; {nearest_names(name, TAGS)})")

    def number(child, default, low, high, name):
        if child is None:
            return default
        value = numbers(child, f"{where}/{name}", 1)[0]
        if not low <= value <= high:
            raise Error(f"{where}/{name}: must lie in {low:g}..{high:g} (got {value:g})")
        return float(value)

    made, named = None, tag(element, "material")
    if named is not None:
        try:
            made = material((named.text or "").strip())
        except Error as why:
            raise Error(f"{where}/sonar_gl:material: {why}") from None
    mu = number(element.find("laser_retro"), None, 0, 255, "laser_retro")
    mu = getattr(made, "reflectivity", SILENT / 255) if mu is None else mu / 255
    strength = getattr(made, "specular", 0.0)
    strength = number(tag(element, "specular"), strength, 0, 1, "sonar_gl:specular")
    slope = number(
        tag(element, "roughness"), getattr(made, "roughness_rad", None), *SLOPES, "sonar_gl:roughness"
    )
    return mu, (strength, slope if strength else None), getattr(made, "name", None)


class ShapeReader:
    """Makes the bodies of links; meshes that occur several times are read once."""

    def __init__(self, finder: Finder):
        self.finder = finder
        self.meshes = {}

    def bodies(self, link: Link, name: str):
        """A link's shapes as bodies in the link's frame, and whether all say how they echo.

        One body, or none; but shapes of other lobes than the first are bodies of their own, `name::shape`.
        """
        groups, complete = {}, True
        for element in link.shapes():
            where = f"{link.where}/{element.tag}[{element.get('name') or ''}]"
            matrix = link.pose_in_link(element, where)
            shape = self.shape(link, element, where)
            if shape is None:
                continue
            mu, lobe, made_of = finish_of(element, where)
            chart = tag(element, "reflectivity_map")
            if chart is not None:
                shape, mu = self.charted(link, element, shape, mu, f"{where}/sonar_gl:reflectivity_map")
            said = element.find("laser_retro"), tag(element, "material"), chart
            complete &= any(child is not None for child in said)
            own = f"{name}::{element.get('name')}" if groups and lobe not in groups else name
            _, parts = groups.setdefault(lobe, (own, []))
            parts.append((meshes.transform(shape, matrix), mu, made_of))
        pose, bodies = link.world_pose(), []
        for lobe, (own, parts) in groups.items():
            shapes, mus, materials = zip(*parts, strict=True)
            mesh, normals = shapes[0] if len(shapes) == 1 else meshes.concatenate(shapes)
            mu = mus[0]
            if len(mus) > 1 and (any(map(np.ndim, mus)) or len(set(mus)) > 1):
                counts = [len(shape[0].faces) for shape in shapes]
                mu = np.concatenate([np.broadcast_to(m, n) for m, n in zip(mus, counts, strict=True)])
            made_of = materials[0] if len(set(materials)) == 1 else None
            try:
                bodies.append(Body(own, mesh, pose, mu, normals, *lobe, made_of))
            except Error as why:
                raise Error(f"{link.where}: {why}") from None
        return bodies, complete

    def charted(self, link: Link, element, shape, mu, where: str):
        """A shape with an image laid on it from above, in its own frame, and μ of its faces."""
        if element.tag == "collision" and element.find("geometry/plane") is not None:
            raise Error(f"{where}: must lie on a shape of some size (the plane of a collision is infinite)")
        uri = (tag(element, "reflectivity_map").text or "").strip()
        path = self.finder.find(uri, link.scope.folder, where)
        if path is None:
            return shape, mu
        try:
            return maps.laid_from_above(shape, path)
        except Error as why:
            raise Error(f"{where}: {why}") from None

    def shape(self, link: Link, element, where: str):
        """(mesh, normals) of a collision or visual, or None where its file is missing, which is noted."""
        geometry = element.find("geometry")
        if geometry is None or len(geometry) == 0:
            raise Error(f"{where}: must hold a <geometry> with a shape in it")
        shape = geometry[0]
        where = f"{where}/geometry/{shape.tag}"

        def get(tag, count=1, default=None, positive=True):
            if default is not None and shape.find(tag) is None:
                return default
            out = numbers(shape.find(tag), f"{where}/{tag}", count, positive)
            return out if count > 1 else out[0]

        if shape.tag == "box":
            return meshes.box(get("size", 3))
        if shape.tag in ("cylinder", "capsule"):
            return getattr(meshes, shape.tag)(get("radius"), get("length"))
        if shape.tag == "sphere":
            return meshes.sphere(get("radius"))
        if shape.tag == "ellipsoid":
            return meshes.ellipsoid(get("radii", 3))
        if shape.tag == "plane":
            normal = get("normal", 3, (0.0, 0.0, 1.0), positive=False)
            if not np.any(normal):
                raise Error(f"{where}/normal: must not be zero (got {shape.findtext('normal').strip()!r})")
            infinite = element.tag == "collision"  # there, <size> is for show
            return meshes.plane(normal) if infinite else meshes.plane(normal, get("size", 2, (1.0, 1.0)))
        if shape.tag not in ("mesh", "heightmap"):
            raise Error(f"{where}: unknown geometry (known are {KNOWN_SHAPES}; anything can be a mesh)")
        uri = (shape.findtext("uri") or shape.findtext("filename") or "").strip()
        path = self.finder.find(uri, link.scope.folder, f"{where}/uri")
        if path is None:
            return None
        try:
            if shape.tag == "heightmap":
                size, pos = get("size", 3, (1.0, 1.0, 1.0)), get("pos", 3, (0.0, 0.0, 0.0), positive=False)
                return mesh_files.heightmap(path, size, pos)
            scale = get("scale", 3, (1.0, 1.0, 1.0), positive=False)
            if not np.all(scale):
                raise Error(f"{where}/scale: must not be zero (got {shape.findtext('scale').strip()!r})")
            key = (path, shape.findtext("submesh/name"), (shape.findtext("submesh/center") or "").strip())
            if key not in self.meshes:
                self.meshes[key] = mesh_files.read_mesh(path, key[1], key[2] in ("true", "1"))
            return meshes.transform(self.meshes[key], np.diag([*scale, 1.0]))
        except Error as why:
            raise why if str(why).startswith(where) else Error(f"{where}: {why}") from None


def sonar_of(links):
    """The link that carries the sonar and the sonar's world pose, or (None, None)."""
    found = []
    for link in links:
        for sensor in link.element.findall("sensor"):
            own = [sensor.get("name") or ""]
            own += [p.get(key) or "" for p in sensor.findall("plugin") for key in ("name", "filename")]
            kind = (sensor.get("type") or "").strip()
            speaks = [
                any(word in text.lower() for word in SONAR_WORDS) for text in (" ".join(own), link.model)
            ]
            if kind == "custom" or speaks[0] or (speaks[1] and kind in SEEING_SENSORS):
                found.append((0 if kind == "custom" else 1 if speaks[0] else 2, len(found), link, sensor))
    if not found:
        return None, None
    _, _, link, sensor = min(found, key=lambda f: f[:2])
    where = f"{link.where}/sensor[{sensor.get('name') or ''}]"
    return link, link.world_pose() @ link.pose_in_link(sensor, where)
