"""The job file: which pings to make, and what to keep of them."""

from __future__ import annotations

import hashlib
import json
import os
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from sonar_gl.batch.tables import Decibels, Table, Varied, VariedMetres, VariedRadians, VariedShare, read
from sonar_gl.image import colorize
from sonar_gl.types import Error

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

PLACES = "where", "folder"  # of the job file; they do not count
LAYERS = ("body", "class", "elevation", "range", "incidence", "share", "shadow", "boxes")
Mount = Annotated[list[float], Field(min_length=6, max_length=6)]
Names = Annotated[list[str], Field(min_length=1)]


class SonarTable(Table):
    """One sonar of the vehicle.

    sonar : a preset or a .toml file; name : of its arrays and topics; range_m, bins : other than the data
    sheet's; mount : x y z roll pitch yaw of the sonar on the vehicle, metres and radians
    """

    sonar: str
    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")] = None
    range_m: Annotated[float, Field(gt=0)] = None
    bins: Annotated[int, Field(ge=1)] = None
    mount: Mount = Field([0.0] * 6)


class MovedTable(Table):
    """Bodies that lie elsewhere in each ping, all by the same draw unless they move `apart`.

    names : of bodies, with * and ?; x_m ... yaw_rad : shifts in the world and turns about the body's own
    axes; there : the chance that they are there at all; reflectivity : μ of each ping
    """

    names: Names
    apart: bool = False
    x_m: VariedMetres = 0.0
    y_m: VariedMetres = 0.0
    z_m: VariedMetres = 0.0
    roll_rad: VariedRadians = 0.0
    pitch_rad: VariedRadians = 0.0
    yaw_rad: VariedRadians = 0.0
    there: Annotated[float, Field(ge=0, le=1)] = 1.0
    reflectivity: VariedShare = None


class VaryTable(Table):
    """What differs from ping to ping, drawn evenly between two numbers.

    bodies : see `MovedTable`; water : fields of Acoustics that say what water it is; noise : amounts of
    Noise
    """

    bodies: list[MovedTable] = Field([])
    water: dict[str, Varied] = Field({})
    noise: dict[str, Varied] = Field({})


class LabelsTable(Table):
    """What is kept of where echoes come from.

    layers : of LAYERS, unless said the first three; classes : names of classes, in their order, and the
    bodies of each, with * and ?; background : bodies that shadows fall on; height : of the fan image whose
    pixels boxes are given in; level_db : boxes go round what is as bright, as side lobes reach far
    """

    layers: Annotated[list[Literal[LAYERS]], Field(min_length=1)] = Field(list(LAYERS[:3]))
    classes: dict[str, Names] = Field({})
    background: Names = None
    height: Annotated[int, Field(ge=16, le=8192)] = 512
    level_db: float = -60.0


class ArraysTable(Table):
    """mantissa_bits : of intensities, 23 is exact float32; a bit less doubles the error."""

    mantissa_bits: Annotated[int, Field(ge=1, le=23)] = 5


def _known_map(name: str) -> str:
    colorize(np.zeros((1, 1), np.float32), name)
    return name


class PicturesTable(Table):
    """Fan images, NPZ files and films, as of `sonar-gl render`."""

    formats: Annotated[list[Literal["png", "npz", "mp4"]], Field(min_length=1)] = Field(["png"])
    height: Annotated[int, Field(ge=16, le=8192)] = 800
    scale: Literal["db", "linear"] = "db"
    db_range: Decibels = Field([-60.0, 0.0])
    colormap: Annotated[str, AfterValidator(_known_map)] = "jet"
    axes: bool = False
    fps: Annotated[float, Field(ge=0.01, le=120)] = 10.0


class CocoTable(Table):
    """Instances in gray fan images: COCO JSON, PNG masks."""

    height: Annotated[int, Field(ge=16, le=8192)] = 512
    db_range: Decibels = Field([-60.0, 0.0])


class RosTable(Table):
    """A ROS 2 bag; see `ros_records.BagSettings`. image_height : of fan images in it, 0 for none."""

    image_height: Annotated[int, Field(ge=0, le=8192)] = 0
    y_sign: Literal["port", "starboard"] = "port"
    bits: Literal[8, 16, 32] = 8
    scale: Literal["db", "linear"] = "db"
    db_range: Decibels = Field([-60.0, 0.0])


class OpticalTable(Table):
    """A camera beside the sonar: RGB as PNG, depth as 16-bit PNG of millimetres."""

    width: Annotated[int, Field(ge=16, le=8192)] = 640
    height: Annotated[int, Field(ge=16, le=8192)] = 480
    fov_x_rad: Annotated[float, Field(gt=0.01, lt=3.0)] = 1.2
    mount: Mount = Field([0.0] * 6)


class Job(Table):
    """A job file as it was read; what it names is made by `sonar_gl.batch.made`."""

    name: Annotated[str, Field(pattern=r"^[\w.-]+$")] = "batch"
    seed: Annotated[int, Field(ge=0)] = 0
    tolerance: Annotated[float, Field(ge=0.001, le=0.5)] = 0.01
    scenes: Names
    resource_paths: list[str] = Field([])
    skip_missing: bool = False
    pings_per_part: Annotated[int, Field(ge=1, le=4096)] = None
    acoustics: dict = Field({})
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
        """As plain values, of which `Job(**plain)` makes it again."""
        return self.model_dump(exclude_none=True)

    @cached_property
    def digest(self) -> str:
        """Of all that decides what the pings are, contents of files that it names included."""
        plain = {key: value for key, value in self.plain.items() if key not in PLACES}
        classes = list(self.labels.classes) if self.labels else []  # their order is that of their numbers
        parts = [json.dumps(plain, sort_keys=True), json.dumps(classes)]
        for path in sorted(self.files()):
            parts.append(f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}")
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def path(self, name: str) -> Path:
        """A file that the job names, beside the job's own file unless it is absolute."""
        return Path(self.folder, os.path.expanduser(name))

    def files(self) -> list[Path]:
        """Scene, sonar and pose files that the job names."""
        names = [*self.scenes, *(table.sonar.partition("#")[0] for table in self.sonars)]
        names += [str(table.get("file", "")) for table in self.poses]
        return [path for name in names if name and (path := self.path(name)).is_file()]


def read_job(path) -> Job:
    """The job of a TOML file.

    Raises
    ------
    Error
        naming file, table and key of all that is wrong.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as why:
        raise Error(f"{path}: the job file must be readable ({(why.strerror or str(why)).lower()})") from None
    except ValueError as why:  # not TOML (says the line), or not UTF-8
        raise Error(f"{path}: the job file must be TOML ({why})") from None
    for key in PLACES:
        if key in data:
            raise Error(f"{path}: the job: unknown key (got {key!r})")
    job = read(Job, data | {"where": str(path), "folder": str(path.resolve().parent)}, str(path))
    if job.coco is not None and job.labels is None:
        raise Error(f"{path}: coco must stand with labels (got none; add a line [labels])")
    return job
