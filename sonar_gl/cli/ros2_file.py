"""The TOML file of `sonar-gl ros2`: options of the command, and settings of topics, frames and transports."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError

from sonar_gl.core.toml import read_toml
from sonar_gl.core.toml_tables import Mount, Names, Table, table_error
from sonar_gl.sonar.sonar_files import split_sonar


def _check_topic(value):
    if value is not False and not isinstance(value, str):
        raise ValueError("should be the name of a topic, or false for none")
    return value


def _text_like(example: str):
    """Return the type of a key whose value is one text, as on the command line; in job files it is a table."""
    return Annotated[str, Field(description=f'give text as on the command line, such as "{example}"')]


TopicName = Annotated[Any, BeforeValidator(_check_topic)]
Port = Annotated[int, Field(ge=0, le=65535)]


class TopicsTable(Table):
    """Names of topics; false for those that are not published."""

    projected_image: TopicName = None
    raw_image: TopicName = None
    image: TopicName = None
    points: TopicName = None
    tf: TopicName = None
    clock: TopicName = None


class ImageTable(Table):
    """The fan image: height in pixels, and a colour map for one in RGB."""

    height: int = None
    colormap: str = None


class PointsTable(Table):
    """The point cloud: number of rays in azimuth and elevation."""

    columns: int = None
    rows: int = None


class ZenohTable(Table):
    """The transport zenoh: address of a router, and whether its ROS has hashes of types, as since Iron."""

    connect: str = None
    type_hashes: bool = None


class DdsTable(Table):
    """The transport DDS: the network interface, and the ROS that lists nodes."""

    interface: str = None
    distribution: Literal["humble", "jazzy"] = None


class FoxgloveTable(Table):
    """The transport Foxglove: where its server listens."""

    host: str = None
    port: Port = None


class Ros2File(Table):
    """What a file holds: options of the command, fields of `PublisherSettings`, and tables.

    Options that it does not name have the command's defaults.
    """

    sonar: str = None
    range: float = None
    bins: int = None
    pose: _text_like("0 0 -1 0 0 0") = None
    poses: str = None
    profile: Literal["ideal", "demarco2015", "physical"] = None
    acoustics: _text_like("tvg_k=30,multipath=coherent") = None
    water: _text_like("temperature_c=4,salinity_psu=8") = None
    noise: _text_like("physical,looks=2") = None
    counts: _text_like("law=db,low_db=-50") = None
    tolerance: float = None
    seed: Annotated[int, Field(ge=0)] = None
    only: Names = None
    without: Names = None
    surface: float = None
    rate: float = None
    duration: Annotated[float, Field(gt=0)] = None
    transport: Annotated[list[Literal["dds", "zenoh", "foxglove"]], Field(min_length=1)] = None
    clock: Literal["own", "ros", "system"] = None
    name: str = None
    pose_from: str = None
    bodies_from: str = None
    domain: Annotated[int, Field(ge=0, le=232)] = None
    world_frame: str = None
    vehicle_frame: str = None
    mount: Mount = None
    y_sign: Literal["port", "starboard"] = None
    topics: TopicsTable = TopicsTable()
    image: ImageTable = ImageTable()
    points: PointsTable = PointsTable()
    zenoh: ZenohTable = ZenohTable()
    dds: DdsTable = DdsTable()
    foxglove: FoxgloveTable = FoxgloveTable()


# keys that are options of the command
OPTIONS = tuple(Ros2File.model_fields)[: list(Ros2File.model_fields).index("domain") + 1]


def read_ros2_file(path) -> Ros2File:
    """Read the settings of a TOML file; the files that it names may lie beside it.

    Raises Error if the file cannot be read or is invalid; names file, table and key of every fault.
    """
    path = Path(path)
    data = read_toml(path, "the file of --config")
    try:
        found = Ros2File.model_validate(data)
    except ValidationError as why:
        raise table_error(why, Ros2File, str(path)) from None
    folder, here = path.resolve().parent, {}
    if found.poses is not None:
        here["poses"] = _beside(folder, found.poses)
    if found.sonar is not None:
        file, rest = split_sonar(found.sonar)
        here["sonar"] = _beside(folder, file) + rest
    return found.model_copy(update=here)


def _beside(folder: Path, name: str) -> str:
    """Return the path of a file in a folder, or the text as it is if there is none."""
    return str(folder / name) if (folder / name).is_file() else name
