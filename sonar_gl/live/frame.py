"""What a live session hands out: a ping with its picture and settings, and what stands in a bin or under a pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sonar_gl.core.checks import check_whole_number, unknown_body_error
from sonar_gl.live.settings import LiveSettings
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """A ping of a live session as the device shows it."""

    number: int  # of the ping, from 0
    clock_s: float  # seconds since the session began
    time_s: float  # seconds: of the trajectory while the sonar follows one, else since the session began
    pose: np.ndarray  # (4, 4) world_from_sonar
    ping: Ping  # whose sonar has the law of counts of the settings
    picture: np.ndarray  # (H, W, 3) uint8 RGB; of a still in gray of 16 bits (H, W) uint16
    settings: LiveSettings  # that it was made with
    # pings per second, the mean of the last three seconds; 0 for the first since somebody listens, or since the
    # settings were changed
    rate_hz: float = 0.0
    samples: int = 0  # number of samples that were drawn for it
    # names of the bodies that were moved to (4, 4) world_from_body
    bodies: Mapping[str, np.ndarray] = field(default_factory=dict)
    # (H, W) bool, pixels of the body that `LiveSession.highlight` names; None without one
    highlight: np.ndarray | None = None
    notes: tuple[str, ...] = ()  # sentences, such as why there is no echo


@dataclass(frozen=True)
class LiveState:
    """What a live session does at a moment."""

    settings: LiveSettings  # of the next ping
    # a sentence about why the last ping failed, or the last settings were not taken; "" if all is well
    problem: str
    is_following: bool  # whether the sonar follows the trajectory; False once it was moved otherwise
    is_playing: bool  # whether the trajectory goes on; False at its end
    position_s: float  # seconds since the trajectory's first pose
    duration_s: float  # of the trajectory, seconds; 0 without one
    rate_hz: float  # as of the last frame


@dataclass(frozen=True)
class Reading:
    """What stands in one bin of a ping."""

    # beam, bin: indices
    beam: int
    bin: int
    # azimuth_rad, range_m: centre of the bin
    azimuth_rad: float
    range_m: float
    body: str  # name of the body with the strongest echo, "" where no display shows one
    # mean elevation of that echo in the head's frame; None where there is no body
    elevation_rad: float | None
    level_db: float  # 10 log10 of the intensity; -inf where there is none
    count: int  # what the device delivers


@dataclass(frozen=True, eq=False)
class Surface:
    """The visible surface whose echo falls into a bin: points at the middles of samples."""

    points_m: np.ndarray  # (N, 3) float64, in the world
    normals: np.ndarray  # (N, 3) float32, unit normals in the world, turned towards the sonar
    body_id: np.ndarray  # (N,) uint16, 1 + index into `scene.bodies`


def check_bin(frame: LiveFrame, beam: int, bin: int) -> tuple[int, int]:
    """Return the indices of a bin of a frame's ping; raise Error if there is no such bin."""
    beams, bins = frame.ping.intensity.shape
    return check_whole_number("beam", beam, 0, beams - 1), check_whole_number("bin", bin, 0, bins - 1)


def body_number(scene: Scene, name: str) -> int:
    """Return a body's number in labels, 1 + its index in the scene; raise Error if there is none of this name."""
    names = [one.name for one in scene.bodies]
    if name not in names:
        raise unknown_body_error(name, names, "a body must be one of the scene")
    return 1 + names.index(name)


def reading_of(scene: Scene, ping: Ping, labels: Ping, beam: int, bin: int) -> Reading:
    """Return what stands in a bin of a ping; `labels` is the same ping with labels, perhaps without noise."""
    place = beam, bin
    intensity, number = float(ping.intensity[place]), int(labels.body_id[place])
    elevation_rad = float(labels.elevation_rad[place])
    return Reading(
        beam=beam,
        bin=bin,
        azimuth_rad=float(ping.azimuth_rad[beam]),
        range_m=float(ping.range_m[bin]),
        body=scene.bodies[number - 1].name if number else "",
        elevation_rad=elevation_rad if math.isfinite(elevation_rad) else None,
        level_db=10 * math.log10(intensity) if intensity > 0 else -math.inf,
        count=int(ping.counts()[place]),
    )
