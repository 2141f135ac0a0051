"""The pose of a live session's sonar over time, by a clock that the tests set."""

import math
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.live import sonar_motion as sonar_motion_module
from sonar_gl.live.sonar_motion import Playback, SonarMotion

TRACK = PoseTrack([sg.pose(0), sg.pose(2, yaw=0.4)], [10.0, 14.0])


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands at `now_s` seconds."""
    stands = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(sonar_motion_module, "time", SimpleNamespace(monotonic=lambda: stands.now_s))
    return stands


def test_a_track_stands_until_it_is_started_and_at_its_end(clock):
    motion = SonarMotion(np.eye(4), TRACK, began_s=100.0)
    clock.now_s = 105.0
    assert motion.playback() == Playback(True, True, 0.0, 4.0)
    motion.start()
    clock.now_s = 107.5
    motion.start()  # again, which changes nothing
    assert motion.playback() == Playback(True, True, 2.5, 4.0)
    clock.now_s = 109.0
    assert motion.playback() == Playback(True, False, 4.0, 4.0)
    assert motion.now().pose.tolist() == sg.pose(2, yaw=0.4).tolist()


def test_a_track_goes_on_where_it_was_left_and_after_its_end_from_the_beginning(clock):
    motion = SonarMotion(np.eye(4), TRACK, began_s=100.0)
    motion.play()  # starts it
    clock.now_s = 101.0
    motion.put(sg.pose(y=7))
    clock.now_s = 102.5
    assert motion.now().pose.tolist() == sg.pose(y=7).tolist()
    assert motion.now().time_s == 2.5  # since the session began
    assert motion.playback() == Playback(False, False, 1.0, 4.0)
    motion.pause()
    clock.now_s = 110.0
    assert motion.now().pose.tolist() == TRACK.at(1.0).tolist()
    motion.play()
    clock.now_s = 112.0
    assert motion.playback() == Playback(True, True, 3.0, 4.0)
    motion.seek(4.0)
    assert motion.playback() == Playback(True, False, 4.0, 4.0)
    motion.play()
    assert motion.playback() == Playback(True, True, 0.0, 4.0)


def test_a_pose_and_its_time_are_of_one_moment(monkeypatch):
    ticks = count(100.0, 0.125)  # a clock that goes on with each look at it
    monkeypatch.setattr(sonar_motion_module, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    motion = SonarMotion(np.eye(4), TRACK, began_s=0.0)
    motion.start()
    place = motion.now()
    assert 0 < place.time_s < 4
    assert place.pose.tolist() == TRACK.at(place.time_s).tolist()


def test_without_a_track_the_sonar_stands(clock):
    motion = SonarMotion(sg.pose(yaw=math.pi), None, began_s=98.0)
    motion.start()
    clock.now_s = 103.0
    assert motion.now().pose.tolist() == sg.pose(yaw=math.pi).tolist()
    assert motion.now().time_s == 5.0
    assert motion.playback() == Playback(False, False, 0.0, 0.0)
