"""The job file of a batch: its tables, and what its keys may hold. docs/batch.md says what each key means."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Iterable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator

from sonar_gl.core.checks import check_choice, is_finite
from sonar_gl.core.errors import Error, errors_at, nearest_names, nearest_of_many
from sonar_gl.core.names import names_of
from sonar_gl.core.toml import read_toml
from sonar_gl.core.toml_tables import IDENTIFIER, WORD, Mount, Names, Table, known_keys, table_error
from sonar_gl.imaging.colormaps import DEFAULT_COLORMAP
from sonar_gl.imaging.fan_image import colours
from sonar_gl.imaging.styles import FanStyle, what_lacks_16_bits
from sonar_gl.scene.sdf.xacro import split_arguments
from sonar_gl.sonar.counts import DEFAULT_COUNTS, LEVEL_BOUND_DB
from sonar_gl.sonar.sonar import MAX_BINS
from sonar_gl.sonar.sonar_files import split_sonar

LOCATION_KEYS = "where", "folder"  # say where the job file is; not part of what decides the pings
# keys of former versions: what stands in their place
REPLACED_BY_COUNTS = {
    "scale": 'counts = { law = "db" }, or { law = "power", exponent = 1 } for a linear scale',
    "db_range": 'counts = { law = "db", low_db = -50, high_db = 0 }',
    "bits": "counts = { bits = 16 }",
}
# of keys, in messages: the cure of a wrong value
METRES, RADIANS = "give metres", "give radians: degrees times π/180"
SONAR = (
    "name a preset, as 'sonar-gl sonars' lists them, or a file; 'sonar-gl sonars --scene world.sdf > mine.toml' writes "
    "that of a scene's sensor"
)
LAYERS = ("body", "class", "elevation", "range", "incidence", "share", "shadow", "boxes")

# ---- values -----------------------------------------------------------------------------------------


def _check_varied(value, low: float, high: float):
    bounds = value if isinstance(value, list) else [value, value]
    if len(bounds) != 2 or not all(map(is_finite, bounds)) or bounds[0] > bounds[1]:
        raise ValueError("should be a number, or [low, high]")
    if not low <= bounds[0] <= bounds[1] <= high:
        raise ValueError(f"should lie in {low:g}..{high:g}")
    return value


def _check_no_layer_twice(value: list[str]) -> list[str]:
    for layer in value:
        if value.count(layer) > 1:
            raise ValueError(f"should name each layer once (got {layer!r} {value.count(layer)} times)")
    return value


def _check_counts(value):
    if not isinstance(value, dict):
        raise ValueError('should be a table, such as { law = "db", low_db = -50 }')
    try:
        # without a law that of the sonar counts, which is not known here
        DEFAULT_COUNTS.changed({"law": "power" if "exponent" in value else "db", **value})
    except Error as why:
        raise ValueError(str(why)) from None
    return value


def _check_colormap(name: str) -> str:
    colours(name)
    return name


def _varied(low: float = -math.inf, high: float = math.inf, cure: str | None = None):
    """Return the type of one number, or of [low, high] for a uniform random draw in each ping, within bounds."""
    check = partial(_check_varied, low=low, high=high)
    return Annotated[Any, BeforeValidator(check), Field(description=cure)]


Varied, VariedShare, VariedScale = (
    _varied(),
    _varied(0.0, 1.0),
    _varied(0.01, 100.0, "1 is the size in the scene"),
)
VariedMetres, VariedRadians = _varied(-1e8, 1e8, METRES), _varied(-6.283, 6.283, RADIANS)
Height = Annotated[int, Field(ge=16, le=8192)]  # pixels
CountsChanges = Annotated[dict, BeforeValidator(_check_counts)]
# one name alone is a list of one
PathFiles = Annotated[
    list[str],
    BeforeValidator(lambda value: [value] if isinstance(value, str) else value),
    Field(min_length=1, description="name a CSV file of poses, or several in a list"),
]
# ---- tables -----------------------------------------------------------------------------------------


class SonarTable(Table):
    """One sonar on the vehicle."""

    sonar: Annotated[str, Field(description=SONAR)]
    name: Annotated[str, Field(pattern=IDENTIFIER, description="arrays and topics have this name")] = None
    range_m: Annotated[float, Field(gt=0)] = None
    bins: Annotated[int, Field(ge=1, le=MAX_BINS)] = None
    mount: Mount = Field([0.0] * 6)


class MovedTable(Table):
    """Bodies whose pose, size or reflectivity changes from ping to ping; `path` None: they stay in place."""

    names: Names
    apart: bool = False
    one_of: bool = None  # not False, which would change the digest of jobs without it
    rests_on: Annotated[str, Field(description="name a body, such as the floor")] = None
    clearance_m: Annotated[float, Field(ge=0, description=METRES)] = None
    path: PathFiles = None
    x_m: VariedMetres = 0.0
    y_m: VariedMetres = 0.0
    z_m: VariedMetres = 0.0
    roll_rad: VariedRadians = 0.0
    pitch_rad: VariedRadians = 0.0
    yaw_rad: VariedRadians = 0.0
    scale: VariedScale = None
    there: Annotated[float, Field(ge=0, le=1)] = 1.0
    reflectivity: VariedShare = None

    @model_validator(mode="after")
    def _check_exclusive(self):
        if self.apart and self.one_of:
            raise ValueError(
                "apart and one_of exclude each other (got both; leave apart out: one alone moves)"
            )
        if self.path is not None and self.clearance_m is not None:
            raise ValueError(
                "path and clearance_m exclude each other (got both; leave clearance_m out: a path is not drawn again)"
            )
        return self


class VaryTable(Table):
    """What changes from ping to ping, by uniform random draws."""

    hold_pings: Annotated[int, Field(ge=1)] = None
    bodies: list[MovedTable] = Field([])
    water: dict[str, Varied] = Field({})
    noise: dict[str, Varied] = Field({})


class LabelsTable(Table):
    """Labels to store; `level_db` None: bins are labelled that the display of each sonar shows above the noise."""

    layers: Annotated[list[Literal[LAYERS]], Field(min_length=1), AfterValidator(_check_no_layer_twice)] = (
        Field(list(LAYERS[:3]))
    )
    classes: dict[str, Names] = Field({})
    background: Names = None
    height: Height = 512
    level_db: Annotated[float, Field(ge=-LEVEL_BOUND_DB, le=LEVEL_BOUND_DB)] = None

    @model_validator(mode="after")
    def _check_background(self):
        if self.background is not None and "shadow" not in self.layers:
            raise ValueError(
                "background needs the layer shadow, since it names the bodies on which shadows fall (got layers "
                f'{self.layers}; add "shadow", or leave background out)'
            )
        return self


class ArraysTable(Table):
    """How the store keeps intensities; 23 bits of mantissa keep float32 as it is."""

    mantissa_bits: Annotated[int, Field(ge=1, le=23)] = 5


class PicturesTable(Table):
    """Fan images, NPZ files and films, with the options of `sonar-gl render`; `counts` changes those of the sonars."""

    REPLACED: ClassVar = REPLACED_BY_COUNTS

    formats: Annotated[list[Literal["png", "npz", "mp4"]], Field(min_length=1)] = Field(["png"])
    height: Height = 800
    counts: CountsChanges = Field({})
    colormap: Annotated[str, AfterValidator(_check_colormap)] = DEFAULT_COLORMAP
    axes: bool = False
    fps: Annotated[float, Field(ge=0.01, le=120)] = 10.0

    @property
    def style(self) -> FanStyle:
        """The style of the pictures."""
        return FanStyle(self.height, self.colormap, self.axes)

    @model_validator(mode="after")
    def _check_bits(self):
        lacking = what_lacks_16_bits(self.style, self.formats)
        if self.counts.get("bits") == 16 and lacking is not None:
            raise ValueError(
                "counts of 16 bits need gray PNG pictures without axes, since others have 8 bits "
                f'(got {lacking}; give colormap = "gray" and formats = ["png"])'
            )
        return self


class CocoTable(Table):
    """Instances in gray fan images: COCO JSON and PNG masks; `counts` changes those of the sonars.

    Bodies of fewer than `min_area` pixels have no annotation; None for no such bound. Masks keep them.
    """

    REPLACED: ClassVar = REPLACED_BY_COUNTS

    height: Height = 512
    min_area: Annotated[int, Field(ge=1)] = None
    counts: CountsChanges = Field({})


class RosTable(Table):
    """A ROS 2 bag, see `ros.write_part`; fan images `image_height` pixels high are added if it is not 0.

    `counts` changes those of the sonars.
    """

    REPLACED: ClassVar = REPLACED_BY_COUNTS

    image_height: Annotated[int, Field(ge=0, le=8192)] = 0
    y_sign: Literal["port", "starboard"] = "port"
    counts: CountsChanges = Field({})


class OpticalTable(Table):
    """A camera on the vehicle: RGB as PNG, depth as 16-bit PNG in millimetres."""

    width: Height = 640
    height: Height = 480
    fov_x_rad: Annotated[float, Field(gt=0.01, lt=3.0)] = 1.2
    mount: Mount = Field([0.0] * 6)


class Job(Table):
    """A job file as read. `requests.BatchRequests` builds the objects that it describes.

    where : the job file's name in error messages
    folder : folder of the job file; relative paths in the job start there
    """

    NOT_IN_FILES: ClassVar = LOCATION_KEYS

    name: Annotated[str, Field(pattern=WORD, description="the store has it as its title")] = "batch"
    seed: Annotated[int, Field(ge=0)] = 0
    tolerance: Annotated[float, Field(ge=0.001, le=0.5)] = 0.01
    scenes: Names
    resource_paths: list[str] = Field([])
    skip_missing: bool = False
    only: Names = None
    without: Names = None
    surface_z_m: Annotated[float, Field(ge=-1e5, le=1e5)] = None
    pings_per_part: Annotated[int, Field(ge=1, le=4096)] = None
    acoustics: dict = Field({})
    water: dict = Field({})
    noise: dict = Field({})
    sonars: Annotated[list[SonarTable], Field(min_length=1)]
    poses: Annotated[list[dict], Field(min_length=1)]
    vary: VaryTable = VaryTable()
    labels: LabelsTable = None
    arrays: ArraysTable = ArraysTable()
    pictures: PicturesTable = None
    coco: CocoTable = None
    ros: RosTable = None
    optical: OpticalTable = None
    where: str = "the job"
    folder: str = "."

    @property
    def plain(self) -> dict:
        """The job as plain values; `Job(**job.plain)` is the same job."""
        return self.model_dump(exclude_none=True)

    @property
    def changes_scenes(self) -> bool:
        """Whether scenes differ from their files."""
        return any(value is not None for value in (self.only, self.without, self.surface_z_m))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that decides the pings, including the files that the job names."""
        plain = {key: value for key, value in self.plain.items() if key not in LOCATION_KEYS}
        classes = list(self.labels.classes) if self.labels else []  # their order is that of their numbers
        texts = [json.dumps(plain, sort_keys=True), json.dumps(classes)]
        for path in sorted(self.files()):
            texts.append(f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}")
        return hashlib.sha256("\n".join(texts).encode()).hexdigest()

    def path(self, name: str) -> Path:
        """Return the path of a file that the job names."""
        return Path(self.folder, os.path.expanduser(name))

    def files(self) -> list[Path]:
        """Return the files that the job names: of scenes, sonars, poses, and paths of bodies."""
        scenes = [split_arguments(name)[0] for name in self.scenes]
        names = [*scenes, *(split_sonar(table.sonar)[0] for table in self.sonars)]
        names += [name for table in self.poses if isinstance(name := table.get("file"), str)]
        names += [name for table in self.vary.bodies for name in table.path or []]
        return [path for name in names if name and (path := self.path(name)).is_file()]


def read_job(path) -> Job:
    """Read a job from a TOML file.

    Raises Error if the file cannot be read or the job is invalid; names file, table and key of every fault.
    """
    path = Path(path)
    data = read_toml(path, "the job file")
    for key in LOCATION_KEYS:
        if key in data:
            hint = nearest_names(key, known_keys(Job))
            raise Error(f"{path}: the job: unknown key (got {key!r}; {hint})")
    try:
        job = Job.model_validate(data | {"where": str(path), "folder": str(path.resolve().parent)})
    except ValidationError as why:
        raise table_error(why, Job, str(path), whole="the job") from None
    if job.coco is not None and job.labels is None:
        raise Error(f"{path}: coco needs labels (got none; add a line [labels])")
    return job


def check_keys(kind: type, table: Mapping, where: str, also: Iterable[str] = ()) -> None:
    """Raise an Error if a table has keys that a dataclass does not, or lacks one that it needs.

    also : keys that the table may have in the file, too, which errors suggest
    """
    needed = {
        field.name: field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        for field in dataclasses.fields(kind)
    }
    for key in table:
        check_choice("key", key, [*needed, *also], where)
    if missing := [key for key, is_needed in needed.items() if is_needed and key not in table]:
        raise Error(f"{where}: {' and '.join(missing)} must be given")


def build(kind: type, table: Mapping, where: str):
    """Return a dataclass that checks itself, built from a table of its fields; errors name the table."""
    check_keys(kind, table, where)
    try:
        with errors_at(where):
            return kind(**{key: tuple(v) if isinstance(v, list) else v for key, v in table.items()})
    except TypeError as why:
        raise Error(f"{where}: must hold what {kind.__name__} takes ({why})") from None


def check_patterns(patterns: Iterable[str], names: Iterable[str], where: str) -> None:
    """Raise an Error for a pattern that matches no name. For that of a model it states the pattern of its bodies."""
    names = set(names)
    for pattern in patterns:
        if not names_of(pattern, names):
            parts = f"{pattern}::*"
            is_model = names_of(parts, names)
            hint = (
                f"give {parts!r}, the bodies of this model" if is_model else nearest_of_many(pattern, names)
            )
            raise Error(f"{where} must name bodies of the scene (got {pattern!r}; {hint})")
