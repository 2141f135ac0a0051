"""Where the sonar of a live session is: where it was put, or on a track that plays."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from sonar_gl.core.checks import check_number
from sonar_gl.core.errors import Error
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.poses import check_pose


class TimedPose(NamedTuple):
    """A pose, (4, 4) world_from_sonar, and the time in seconds that belongs to it."""

    pose: np.ndarray
    time_s: float


class Playback(NamedTuple):
    """What a track does at a moment; the fields are those of `LiveState`."""

    is_following: bool
    is_playing: bool
    position_s: float
    duration_s: float


class SonarMotion:
    """The pose of a sonar over time. To be used by one thread at a time.

    The time of the track stands still until `start`, or until `play`.

    pose : (4, 4) world_from_sonar at the start, where there is no track
    track : that the sonar follows at first; None for none
    began_s : `time.monotonic` at which the time of a sonar that follows no track is 0
    """

    def __init__(self, pose: np.ndarray, track: PoseTrack | None, began_s: float):
        self._pose, self._track, self._began_s = check_pose(pose), track, began_s
        self._is_following, self._is_playing = track is not None, True
        self._has_started = False
        self._position_s, self._position_at_s = 0.0, time.monotonic()

    def now(self) -> TimedPose:
        """Return the pose; its time is that of the track while the sonar follows it, else since `began_s`."""
        if not self._is_following:
            return TimedPose(self._pose, time.monotonic() - self._began_s)
        position_s = self._position_now()
        return TimedPose(self._track.at(position_s), position_s)

    def playback(self) -> Playback:
        """Return what the track does now; without one it is 0 seconds long."""
        duration_s = 0.0 if self._track is None else self._track.duration_s
        position_s = self._position_now()
        return Playback(
            is_following=self._is_following,
            is_playing=self._is_following and self._is_playing and position_s < duration_s,
            position_s=position_s,
            duration_s=duration_s,
        )

    def put(self, pose: np.ndarray) -> None:
        """Put the sonar somewhere; it then follows the track no more, until `play`, `pause` or `seek`."""
        pose = check_pose(pose)
        self._hold_position()
        self._pose, self._is_following = pose, False

    def start(self) -> None:
        """Let the track's time run from now on, if it does not yet."""
        if not self._has_started:
            self._hold_position()
            self._has_started = True

    def play(self) -> None:
        """Follow the track from where it was left; after its end from the beginning."""
        self._follow(True)
        self._has_started = True

    def pause(self) -> None:
        """Let the sonar stand where the track has brought it."""
        self._follow(False)

    def seek(self, time_s: float) -> None:
        """Go to a time of the track, seconds since its first pose; it plays on if it was playing."""
        self._check_track()
        time_s = check_number("time_s of a trajectory", time_s, 0.0, self._track.duration_s, "give seconds")
        self._hold_position()
        self._position_s, self._is_following = time_s, True

    def _follow(self, plays: bool) -> None:
        self._check_track()
        self._hold_position()
        if plays and self._position_s >= self._track.duration_s:
            self._position_s = 0.0
        self._is_following, self._is_playing = True, plays

    def _check_track(self) -> None:
        if self._track is None:
            raise Error("there is no trajectory to follow (give a file of poses by --poses)")

    def _position_now(self) -> float:
        """Return the seconds of the track that have gone."""
        if self._track is None:
            return 0.0
        goes_on = self._is_following and self._is_playing and self._has_started
        gone_s = time.monotonic() - self._position_at_s if goes_on else 0.0
        return min(self._position_s + gone_s, self._track.duration_s)

    def _hold_position(self) -> None:
        """Count the track's time from where it is now."""
        self._position_s, self._position_at_s = self._position_now(), time.monotonic()
