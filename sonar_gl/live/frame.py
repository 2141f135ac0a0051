"""What a live session hands out: a ping with its picture and settings, and what stands under a pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sonar_gl.live.settings import LiveSettings
from sonar_gl.ping import Ping


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
