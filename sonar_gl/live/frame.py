"""What a live session hands out: a ping with its picture and settings, and what stands under a pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sonar_gl.live.settings import LiveSettings
from sonar_gl.ping import Ping


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """A ping of a live session as the device shows it.

    Attributes
    ----------
    number : of the ping, from 0
    clock_s : seconds since the session began
    time_s : seconds: of the trajectory while the sonar follows one, else since the session began
    pose : (4, 4) world_from_sonar
    ping : Ping, whose sonar has the law of counts of the settings
    picture : (H, W, 3) uint8 RGB; of a still in gray of 16 bits (H, W) uint16
    settings : LiveSettings that it was made with
    rate_hz : pings per second, the mean of the last three seconds; 0 for the first since somebody listens, or since the
        settings were changed
    samples : number of samples that were drawn for it
    bodies : names of the bodies that were moved to (4, 4) world_from_body
    highlight : (H, W) bool, pixels of the body that `LiveSession.highlight` names; None without one
    notes : sentences, such as why there is no echo
    """

    number: int
    clock_s: float
    time_s: float
    pose: np.ndarray
    ping: Ping
    picture: np.ndarray
    settings: LiveSettings
    rate_hz: float = 0.0
    samples: int = 0
    bodies: Mapping[str, np.ndarray] = field(default_factory=dict)
    highlight: np.ndarray | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LiveState:
    """What a live session does at a moment.

    Attributes
    ----------
    settings : LiveSettings of the next ping
    problem : a sentence about why the last ping failed, or the last settings were not taken; "" if all is well
    is_following : whether the sonar follows the trajectory; False once it was moved otherwise
    is_playing : whether the trajectory goes on; False at its end
    position_s : seconds since the trajectory's first pose
    duration_s : of the trajectory, seconds; 0 without one
    rate_hz : as of the last frame
    """

    settings: LiveSettings
    problem: str
    is_following: bool
    is_playing: bool
    position_s: float
    duration_s: float
    rate_hz: float


@dataclass(frozen=True)
class Reading:
    """What stands in one bin of a ping.

    Attributes
    ----------
    beam, bin : indices
    azimuth_rad, range_m : centre of the bin
    body : name of the body with the strongest echo, "" where no display shows one
    elevation_rad : mean elevation of that echo in the head's frame; None where there is no body
    level_db : 10 log10 of the intensity; -inf where there is none
    count : what the device delivers
    """

    beam: int
    bin: int
    azimuth_rad: float
    range_m: float
    body: str
    elevation_rad: float | None
    level_db: float
    count: int


@dataclass(frozen=True, eq=False)
class Surface:
    """The visible surface whose echo falls into a bin: points at the middles of samples.

    Attributes
    ----------
    points_m : (N, 3) float64, in the world
    normals : (N, 3) float32, unit normals in the world, turned towards the sonar
    body_id : (N,) uint16, 1 + index into `scene.bodies`
    """

    points_m: np.ndarray
    normals: np.ndarray
    body_id: np.ndarray
