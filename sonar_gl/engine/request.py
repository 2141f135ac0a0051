"""The requests of pings, with checked arguments."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from sonar_gl.acoustics.water import Water
from sonar_gl.core.checks import check_kind, check_number, check_whole_number, is_iterable, shown
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import check_pose
from sonar_gl.engine.motion import check_velocity
from sonar_gl.noise.settings import Noise
from sonar_gl.sonar.counts import LEVEL_BOUND_DB

# arguments with one value a pose: the field of `PingRequest` that it is
FIELDS = {"bodies": "bodies", "times_s": "time_s", "velocities": "velocity"}
FIELDS |= {"reflectivities": "reflectivity", "waters": "water"}


@dataclass(frozen=True, eq=False)
class PingRequest:
    """One ping: the pose of the sonar, the outputs, and what differs from the defaults of the run.

    Raises Error if an argument is invalid in every scene.

    pose : (4, 4) world_from_sonar, metres
    noise : Noise, or None for none
    seed, number : of the noise; the same two give the same bytes
    labels : find the strongest body in each bin
    background : with labels, names of bodies on whose echo others cast a shadow; or None
    bodies : names to (4, 4) world_from_body, or to None for a body that is absent; or None
    time_s : seconds, at which plumes of bubbles are seen; None = 0
    velocity : (6,) vx vy vz, m/s, wx wy wz, rad/s, of the sonar in its frame; or None
    reflectivity : names of bodies to μ, 0..1; or None
    water : Water of this ping; or None for that of the acoustics
    noise_parts : find what specular lobes return, and textures, by themselves, for speckle that is added later
    alone : choose the samples for a tolerance from this ping alone, whatever pings came before or were planned
    label_level_db : with labels, the level of a body's mean echo in a bin, dB, from which on it is labelled; None for
        what the display of the sonar shows, above the noise
    labels_above_noise : also with a `label_level_db`, noise that is added takes the labels of bins that it hides
    """

    pose: np.ndarray
    noise: Noise | None = None
    seed: int = 0
    number: int = 0
    labels: bool = False
    background: tuple[str, ...] | None = None
    bodies: dict | None = None
    time_s: float | None = None
    velocity: np.ndarray | None = None
    reflectivity: dict | None = None
    water: Water | None = None
    noise_parts: bool = False
    alone: bool = False
    label_level_db: float | None = None
    labels_above_noise: bool = False

    @property
    def needs_noise_parts(self) -> bool:
        """Whether it needs the specular lobes, and the textures of bodies, by themselves."""
        return self.noise_parts or (self.noise is not None and self.noise.speckle)

    @property
    def noise_hides_labels(self) -> bool:
        """Whether noise that is added, with the ping or later, takes the labels of bins that it hides."""
        return self.labels and (self.label_level_db is None or self.labels_above_noise)

    def __post_init__(self):
        check_kind("noise", self.noise, Noise | None, "such as sonar_gl.Noise.physical()")
        if not isinstance(self.labels, (bool, np.bool_)):
            raise Error(f"labels must be True or False (got {shown(self.labels)})")
        checked = {
            "pose": check_pose(self.pose),
            "seed": check_whole_number("seed", self.seed),
            "velocity": check_velocity(self.velocity),
            "number": check_whole_number("ping_number", self.number),
            "labels": bool(self.labels),
            "background": _names(self.background),
        }
        vars(self).update(checked)
        if self.label_level_db is not None:
            level_db = check_number(
                "label_level_db", self.label_level_db, -LEVEL_BOUND_DB, LEVEL_BOUND_DB, "give dB"
            )
            object.__setattr__(self, "label_level_db", level_db)
            if not self.labels:
                raise Error("label_level_db needs labels=True (got labels=False)")
        if self.background is not None and not self.labels:
            raise Error("background needs labels=True (got labels=False; shadows are labels)")


def _names(background) -> tuple[str, ...] | None:
    if background is None:
        return None
    if isinstance(background, str) or not is_iterable(background):
        raise Error(
            f"background must be several names of bodies (got {shown(background)}; make [name] of one)"
        )
    return tuple(str(name) for name in background)


def requests_of(poses, per_ping: dict, **common) -> Iterator[PingRequest]:
    """Yield the request of each ping.

    Raises Error if one of these is not one value per ping: at once where lengths are known, else at the first pose
    without a value. Values are checked one by one.

    poses : (4, 4) world_from_sonar of each
    per_ping : key of FIELDS -> value of each ping, or None for none
    common : fields of `PingRequest` that all have in common
    """
    given = {name: values for name, values in per_ping.items() if values is not None}
    columns = [(name, iter(_per_ping(values, name, poses))) for name, values in given.items()]
    poses = several_poses(poses)

    def requests():
        for number, pose in enumerate(poses):
            values = {FIELDS[name]: _next_value(column, name, number) for name, column in columns}
            yield PingRequest(pose, number=number, **common, **values)

    return requests()


def _next_value(column: Iterator, name: str, number: int):
    """Return the value of the ping of this number, counted from 0; an Error if there is none."""
    for value in column:
        return value
    raise Error(f"{name} must be as many as poses (got {number}; pose {number}, counted from 0, has none)")


def several_poses(poses) -> Iterable:
    """Return the poses, or raise an Error if this is not several of them."""
    if not is_iterable(poses) or (isinstance(poses, np.ndarray) and poses.ndim == 2):
        raise Error(f"poses must be several poses (got {type(poses).__name__}; make [pose] of one)")
    return poses


def _per_ping(values, name: str, poses) -> Iterable:
    """Return one value per ping; an Error if it is one value alone, or of another number."""
    if not is_iterable(values) or isinstance(values, (dict, str)):
        raise Error(f"{name} must be several, one a pose (got {shown(values)})")
    counted = hasattr(values, "__len__") and hasattr(poses, "__len__")
    if counted and len(values) != len(poses):
        raise Error(f"{name} must be as many as poses (got {len(values)} for {len(poses)} poses)")
    return values
