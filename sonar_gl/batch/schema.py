"""What a job stores of its pings: arrays and their encoding, numbers of bodies and classes, attributes.

Arrays have as few bits as their meaning needs, in forms that readers of CF conventions decode.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np

from sonar_gl._version import __version__
from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.batch.job import check_patterns
from sonar_gl.batch.manifest import Manifest
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.compiled import compiled
from sonar_gl.core.errors import Error
from sonar_gl.core.names import matching_names
from sonar_gl.sonar.sonar import Sonar

BACKGROUND_WORDS = "floor", "ground", "seabed", "terrain", "heightmap", "wall"  # in names of bodies
ELEVATION_STEP_RAD, NO_ELEVATION = 1e-4, -32768
INCIDENCE_STEP_RAD, NO_INCIDENCE = math.pi / 2 / 254, 255
SHARE_STEP, NO_SHARE = 1 / 254, 255  # of pings that failed; xarray warns where integers for floats have none
STRONGEST = "of the strongest echo"

# ---- arrays and their encoding ----------------------------------------------------------------------


@dataclass(frozen=True)
class ArraySpec:
    """One array of the store, with a first dimension of pings.

    name, dtype : of the array
    shape, dims : lengths and names of the dimensions beyond the first
    fill : value where nothing is stored
    attributes : of the array: its long name, units, the scale by which readers multiply
    values : function that computes it. Of an array with a value for each bin, (ping, class_id, first_body) -> (B, K)
        array of `dtype`; class_id is (bodies of the scene + 1,), the class of each body's number, and first_body the
        number of bodies in earlier scenes. Of one with a few numbers for each ping, rows of the `PingTable` -> (N, ...)
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    dims: tuple[str, ...]
    fill: float
    attributes: dict
    values: Callable[..., np.ndarray] | None = None

    @property
    def bytes_per_ping(self) -> int:
        return np.dtype(self.dtype).itemsize * math.prod(self.shape)


def round_mantissa(values: np.ndarray, bits: int) -> np.ndarray:
    """Round float32 values to the nearest with so many bits of mantissa; halves round up.

    The relative error is 2^-(bits + 1) at most, and 0 stays 0. The bits dropped are 0, which packs well.

    >>> round_mantissa(np.float32([1.0, 1.01, 0.0]), 5).tolist()
    [1.0, 1.0, 0.0]
    """
    if bits >= 23:
        return values
    drop = 23 - bits
    rounded = np.ascontiguousarray(values, np.float32).view(np.uint32) + np.uint32(1 << (drop - 1))
    rounded &= np.uint32((0xFFFFFFFF << drop) & 0xFFFFFFFF)
    return rounded.view(np.float32)


def _quantize(values: np.ndarray, step: float, missing: int, dtype) -> np.ndarray:
    """Return values as numbers of steps, rounded, and `missing` for NaN."""
    out = np.empty(values.shape, dtype)
    _count_steps(values.ravel(), np.float32(1 / step), missing, out.ravel())
    return out


@compiled
def _count_steps(values, per_step, missing, out):
    """Quantize in one pass; NumPy would need five."""
    for k in range(values.size):
        value = values[k]
        out[k] = missing if value != value else np.int32(np.rint(value * per_step))


def bin_layers(
    names: Iterable[str],
    sonar: Sonar,
    acoustics: Acoustics,
    mantissa_bits: int,
    n_bodies: int,
    n_classes: int,
) -> list[ArraySpec]:
    """Return the layers of a sonar: intensity, and those of `job.LAYERS` that are named.

    n_bodies counts the bodies of all scenes.
    """
    range_step_m = acoustics.true_range_sonar(sonar).range_max_m * 1.001 / 65535
    body_dtype = "uint16" if n_bodies < 65536 else "uint32"
    class_dtype = "uint8" if n_classes < 256 else "uint16"
    error = 2.0 ** -(mantissa_bits + 1) if mantissa_bits < 23 else 0.0

    def encode_body(ping, _class_id, first):
        found = ping.body_id.astype(body_dtype)
        return np.where(found > 0, found + np.asarray(first, body_dtype), found) if first else found

    def encode_class(ping, class_id, _first):
        return np.take(class_id, ping.body_id)

    def layer(name, dtype, encode, long_name, fill=0, **more):
        dims, attributes = ("beam", "range"), {"long_name": long_name, **more}
        return ArraySpec(name, dtype, (sonar.n_beams, sonar.n_bins), dims, fill, attributes, encode)

    def quantized(name, dtype, step, long_name, units, missing):
        """The field `name` of a ping, in steps."""

        def encode(ping, *_):
            return _quantize(getattr(ping, name), step, missing, dtype)

        more = {"units": units, "scale_factor": step, "_FillValue": missing}
        return layer(name, dtype, encode, long_name, missing, **more)

    known = {
        "intensity": layer(
            "intensity",
            "float32",
            lambda ping, *_: round_mantissa(ping.intensity, mantissa_bits),
            "echo intensity",
            fill=0.0,
            units="1",
            comment="linear, power-like; a sphere of reflectivity μ about the sonar reads μ G(r)",
            mantissa_bits=mantissa_bits,
            relative_error_max=error,
        ),
        "body": layer("body_id", body_dtype, encode_body, f"body {STRONGEST}, 0 for none"),
        "class": layer("class_id", class_dtype, encode_class, f"class of the body {STRONGEST}, 0 for none"),
        "elevation": quantized(
            "elevation_rad", "int16", ELEVATION_STEP_RAD, f"elevation {STRONGEST}", "rad", NO_ELEVATION
        ),
        "range": quantized("true_range_m", "uint16", range_step_m, f"slant range {STRONGEST}", "m", 0),
        "incidence": quantized(
            "incidence_rad", "uint8", INCIDENCE_STEP_RAD, f"incidence {STRONGEST}", "rad", NO_INCIDENCE
        ),
        "share": quantized(
            "share", "uint8", SHARE_STEP, "share of the strongest body in the echo", "1", NO_SHARE
        ),
        "shadow": layer(
            "shadow",
            "uint8",
            lambda ping, *_: ping.shadow.astype(np.uint8),
            "1 where the background would echo but for a body before it",
            units="1",
        ),
    }
    return [layer for name, layer in known.items() if name == "intensity" or name in names]


def body_arrays(n_bodies: int, image_height: int) -> list[ArraySpec]:
    """Return the arrays with a few numbers for each body: echo, bins, bounding boxes."""
    n = n_bodies
    return [
        ArraySpec("body_echo", "float32", (n,), ("body",), 0.0, {"long_name": "sum of the body's echo"}),
        ArraySpec("body_bins", "int32", (n,), ("body",), 0, {"long_name": "bins of it that its box encloses"}),
        ArraySpec("body_box", "int32", (n, 4), ("body", "box"), -1, {
            "long_name": "first and last beam, first and last bin of these, -1 for none"}),
        ArraySpec("body_pixels", "int32", (n, 4), ("body", "rectangle"), -1, {
            "long_name": "left, top, width, height of these in the fan image, -1 for none",
            "fan_image_height": image_height}),
    ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Instances:
    """The instances of COCO in a scene, each with the number of its first body.

    number_of : (bodies + 1,) uint16, the instance of each body, by number
    names : of each instance, by number: that of its body, or what the names of its bodies have before `::`
    """

    number_of: np.ndarray
    names: list[str]

    @cached_property
    def are_bodies(self) -> bool:
        """Whether each body is an instance of its own."""
        return bool((self.number_of == np.arange(len(self.number_of))).all())


# ---- the schema of a job ----------------------------------------------------------------------------


class Schema:
    """Arrays, bodies and classes of a job. Build it once per process: for it every scene is read.

    Raises Error if labels match no body; names table and key.

    bodies : names of the bodies of all scenes; those of scene k begin at first_body[k]. The number of a body
        in the arrays is 1 + its index here
    classes : names of the classes; the number of a class is 1 + its index
    class_id : (bodies + 1,), the class of each body's number, 0 for none
    body_arrays : arrays with a few numbers for each body, the same for each sonar; empty without the layer
        `boxes`
    """

    def __init__(self, requests: BatchRequests):
        self._requests, self._job, self._labels = requests, requests.job, requests.job.labels
        self.first_body, self.bodies, self._names_by_scene = [], [], []
        for contents in requests.scenes.contents:
            self.first_body.append(len(self.bodies))
            self._names_by_scene.append(contents.bodies)
            self.bodies += contents.bodies
        self.classes, of_body = self._number_classes()
        self.class_id = np.array([0, *of_body], np.uint8 if len(self.classes) < 256 else np.uint16)
        self._backgrounds = [self._find_background(index) for index in range(len(self._job.scenes))]
        has_boxes = self._labels is not None and "boxes" in self._labels.layers
        self.body_arrays = body_arrays(len(self.bodies), self._labels.height) if has_boxes else []

    def _number_classes(self) -> tuple[list[str], list[int]]:
        """Return the names of classes, and the number of the class of each body, 0 for none."""
        patterns_of = self._labels.classes if self._labels else {}
        if not patterns_of:  # bodies whose names differ only by a final number form a class
            stems = [re.sub(r"[_\W]*\d+$", "", name) or name for name in self.bodies]
            classes = list(dict.fromkeys(stems))
            return classes, [1 + classes.index(stem) for stem in stems]
        numbers, classes = [0] * len(self.bodies), list(patterns_of)
        for number, (name, patterns) in enumerate(patterns_of.items(), 1):
            where = f"{self._job.where}: labels.classes.{name}"
            check_patterns(patterns, dict.fromkeys(self.bodies), where)
            matched = set(matching_names(patterns, self.bodies))
            for index in (k for k, body in enumerate(self.bodies) if body in matched):
                if numbers[index]:
                    other = classes[numbers[index] - 1]
                    raise Error(
                        f"{where} must hold bodies of no other class (got {self.bodies[index]!r}, which is "
                        f"in {other!r})"
                    )
                numbers[index] = number
        return classes, numbers

    def _find_background(self, scene: int) -> list[str] | None:
        """Return the background of a scene: that of the job, or else bodies named like a floor or wall."""
        if self._labels is None or "shadow" not in self._labels.layers:
            return None
        names, patterns = self._names_by_scene[scene], self._labels.background
        where = f"{self._job.where}: labels.background"
        if patterns is not None:
            check_patterns(patterns, dict.fromkeys(self.bodies), where)
            found = matching_names(patterns, names)
        else:
            found = [name for name in names if any(word in name.lower() for word in BACKGROUND_WORDS)]
        if not found:
            raise Error(
                f"{where} must name the bodies on which shadows fall, for the layer shadow (got none of "
                f"scene {self._job.scenes[scene]!r}, which has {', '.join(names)[:200]}; without this key "
                "they are the bodies named like a floor or a wall)"
            )
        return found

    def background(self, scene: int) -> list[str] | None:
        """Return the names of the bodies on which shadows fall, or None without the layer `shadow`."""
        return self._backgrounds[scene]

    def scene_class_id(self, scene: int) -> np.ndarray:
        """Return the class of each body of a scene by its number in that scene, (bodies + 1,)."""
        first, n_bodies = 1 + self.first_body[scene], len(self._names_by_scene[scene])
        return np.concatenate([self.class_id[:1], self.class_id[first : first + n_bodies]])

    def instances(self, scene: int) -> Instances:
        """Return the instances of COCO in a scene: bodies of one model that are of one class are one."""
        names, class_id = self._names_by_scene[scene], self.scene_class_id(scene)
        number_of, members = [0], {}
        for number, name in enumerate(names, 1):
            model = name.partition("::")[0]
            # bodies of no class stay themselves
            key = (model, class_id[number]) if class_id[number] else number
            members.setdefault(key, []).append(number)
            number_of.append(members[key][0])
        shown = ["", *names]
        for numbers in members.values():
            if len(numbers) > 1:
                shown[numbers[0]] = names[numbers[0] - 1].partition("::")[0]
        return Instances(np.array(number_of, np.uint16), shown)

    def layers(self, sonar: str) -> list[ArraySpec]:
        """Return the arrays of a sonar with a value for each bin."""
        return bin_layers(
            self._labels.layers if self._labels else [],
            self._requests.sonars[sonar],
            self._requests.acoustics,
            self._job.arrays.mantissa_bits,
            len(self.bodies),
            len(self.classes),
        )

    def arrays(self, sonar: str) -> list[ArraySpec]:
        """Return all arrays of a sonar that are written part by part."""
        return [*self.layers(sonar), *self.body_arrays]

    @property
    def bytes_per_ping(self) -> int:
        """Size of all sonars' arrays before compression."""
        return sum(array.bytes_per_ping for sonar in self._requests.sonars for array in self.arrays(sonar))

    def sonar_attributes(self, sonar: str) -> dict:
        """Return the attributes of a sonar's group; tables are JSON text, since netCDF has no nested ones."""
        requests = self._requests
        tables = {
            "specification": asdict(requests.sonars[sonar]),
            "mount": requests.mounts[sonar].tolist(),
            "acoustics": requests.acoustics.meta(),
            "noise": asdict(requests.noise),
        }
        attributes = {"sonar": sonar, "noise_seed": requests.noise_seed(sonar)}
        return attributes | {name: json.dumps(table) for name, table in tables.items()}

    def attributes(self, manifest: Manifest) -> dict:
        """Return the attributes of the whole data set."""
        return {
            "Conventions": "CF-1.11",
            "title": self._job.name,
            "source": f"sonar_gl {__version__}",
            **asdict(manifest.system),
            "seed": self._job.seed,
            "tolerance": self._job.tolerance,
            "scenes": self._job.scenes,
            "bodies": self.bodies,
            "classes": self.classes,
            "class_of_body": self.class_id[1:].tolist(),
            "digest": manifest.digest,
        }
