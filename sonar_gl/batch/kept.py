"""What a job keeps of its pings: layers of bins, numbers of bodies and classes, and what is said of all."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict

import numpy as np

from sonar_gl._version import __version__
from sonar_gl.batch.layers import layers_of
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.tables import matching, meant
from sonar_gl.types import Error

BACKGROUND = "floor", "ground", "seabed", "terrain", "heightmap", "wall"  # in names of bodies


class Kept:
    """Layers, bodies and classes of a job.

    Attributes
    ----------
    bodies : names of all scenes' bodies; those of scene k begin at first_body[k], and a body's number in the
        arrays is 1 + its index here
    classes : names; a class's number is 1 + its index
    class_id : (bodies + 1,) number of the class of each body's number, 0 for none

    Raises
    ------
    Error
        naming table and key, where labels name no body.
    """

    def __init__(self, orders: Orders):
        self.orders, self.job, self.labels = orders, orders.job, orders.job.labels
        self.first_body, self.bodies, self._of_scene = [], [], []
        self._digest = hashlib.sha256(self.job.digest.encode())
        for index in range(len(self.job.scenes)):  # once: to load one may take seconds
            self.first_body.append(len(self.bodies))
            self._of_scene.append([body.name for body in orders.scene(index).bodies])
            self.bodies += self._of_scene[-1]
            for body in orders.scene(index).bodies:
                self._digest.update(body.name.encode())
                for array in (body.pose, body.surface.vertices, body.surface.faces, body.reflectivity):
                    self._digest.update(np.ascontiguousarray(array).tobytes())
        self.classes, of_body = self._classes()
        self.class_id = np.array([0, *of_body], np.uint8 if len(self.classes) < 256 else np.uint16)
        self._backgrounds = [self._background(index) for index in range(len(self.job.scenes))]

    def _classes(self):
        asked = self.labels.classes if self.labels else {}
        if not asked:  # bodies that differ by a number alone are of one class
            plain = [re.sub(r"[_\W]*\d+$", "", name) or name for name in self.bodies]
            classes = list(dict.fromkeys(plain))
            return classes, [1 + classes.index(name) for name in plain]
        out = [0] * len(self.bodies)
        for number, (name, patterns) in enumerate(asked.items(), 1):
            where = f"{self.job.where}: labels.classes.{name}"
            for body in matching(patterns, dict.fromkeys(self.bodies), where):
                for at in (k for k, other in enumerate(self.bodies) if other == body):
                    if out[at]:
                        first = list(asked)[out[at] - 1]
                        raise Error(
                            f"{where} must hold bodies of no other class (got {body!r}, of {first!r})"
                        )
                    out[at] = number
        return list(asked), out

    def _background(self, scene: int):
        if self.labels is None or "shadow" not in self.labels.layers:
            return None
        names = self._of_scene[scene]
        where = f"{self.job.where}: labels.background"
        if self.labels.background is not None:
            matching(self.labels.background, dict.fromkeys(self.bodies), where)
            found = meant(self.labels.background, names)
        else:
            found = [name for name in names if any(word in name.lower() for word in BACKGROUND)]
        if not found:
            raise Error(
                f"{where} must name the bodies that shadows fall on, for the layer shadow (got none of scene "
                f"{self.job.scenes[scene]!r}, whose are {', '.join(names)[:200]}; unsaid, those called a "
                "floor or a wall)"
            )
        return found

    def digest(self) -> str:
        """Of the job, and of the bodies of its scenes: their meshes may lie in files of their own."""
        return self._digest.hexdigest()

    def background(self, scene: int):
        """Names of the bodies that shadows fall on, or None where nobody asks."""
        return self._backgrounds[scene]

    def classes_of(self, scene: int) -> np.ndarray:
        """Number of the class of each body of a scene, by its number there."""
        first = self.first_body[scene]
        return np.concatenate([self.class_id[:1], self.class_id[1 + first :]])

    def layers(self, sonar: str) -> tuple[list, list]:
        """Layers of bins, and arrays with a few numbers for each body: (name, dtype, shape, dims, fill,
        attributes)."""
        asked = self.labels.layers if self.labels else []
        orders, sizes = self.orders, (len(self.bodies), len(self.classes))
        kept = layers_of(asked, orders.sonars[sonar], orders.acoustics, self.job.arrays.mantissa_bits, *sizes)
        if "boxes" not in asked:
            return kept, []
        n, height = len(self.bodies), self.labels.height
        return kept, [
            ("body_echo", "float32", (n,), ("body",), 0.0, {"long_name": "sum of the body's echo"}),
            ("body_bins", "int32", (n,), ("body",), 0, {"long_name": "bins where it is the strongest"}),
            ("body_box", "int32", (n, 4), ("body", "box"), -1, {
                "long_name": "first and last beam, first and last bin of these, -1 for none"}),
            ("body_pixels", "int32", (n, 4), ("body", "rectangle"), -1, {
                "long_name": "left, top, width, height of these in the fan image, -1 for none",
                "fan_image_height": height}),
        ]  # fmt: skip

    @property
    def bytes_per_ping(self) -> int:
        """Of all sonars' arrays, before they are packed."""
        total = 0
        for name, sonar in self.orders.sonars.items():
            kept, per_body = self.layers(name)
            total += sonar.n_beams * sonar.n_bins * sum(np.dtype(layer.dtype).itemsize for layer in kept)
            total += sum(np.dtype(dtype).itemsize * int(np.prod(shape)) for _, dtype, shape, *_ in per_body)
        return total

    def about(self, planned, sonar: str) -> dict:
        """What the store says of a sonar; tables as JSON text, as netCDF's attributes hold none."""
        orders = self.orders
        tables = {
            "specification": asdict(orders.sonars[sonar]),
            "mount": orders.mounts[sonar].tolist(),
            "acoustics": orders.acoustics.meta(),
            "noise": asdict(orders.noise),
            "samplings": [of_scene[sonar] for of_scene in planned.samplings],
        }
        about = {"sonar": sonar, "noise_seed": orders.noise_seed(sonar)}
        return about | {name: json.dumps(table) for name, table in tables.items()}

    def attributes(self, planned) -> dict:
        """What the store says of all pings."""
        job = self.job
        return {
            "Conventions": "CF-1.11",
            "title": job.name,
            "source": f"sonar_gl {__version__}",
            "gl_renderer": planned.gl_renderer,
            "seed": job.seed,
            "tolerance": job.tolerance,
            "scenes": job.scenes,
            "bodies": self.bodies,
            "classes": self.classes,
            "class_of_body": self.class_id[1:].tolist(),
            "digest": planned.digest,
        }
