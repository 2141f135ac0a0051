"""Poses between those of a file."""

import numpy as np
import pytest

from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.poses import pose


def test_sonar_moves_and_turns_evenly():
    track = PoseTrack([pose(0, 0, 0, yaw=0.2), pose(4, -2, 1, yaw=1.0)], [10.0, 14.0])
    # turns about one axis: the angle grows evenly
    assert track.at(1.0) == pytest.approx(pose(1, -0.5, 0.25, yaw=0.4), abs=1e-12)


def test_sonar_stands_before_and_after_its_poses():
    first, last = pose(1, 2, 3), pose(4, 5, 6, pitch=0.3)
    track = PoseTrack([first, last], [0.0, 1.0])
    assert track.at(-1.0).tolist() == first.tolist()
    assert track.at(7.0).tolist() == last.tolist()


def test_sonar_without_times_stands():
    assert PoseTrack([pose(1)]).at(5.0).tolist() == pose(1).tolist()


def test_poses_of_one_time_are_a_jump():
    track = PoseTrack([pose(0), pose(1), pose(5), pose(5)], [0.0, 1.0, 1.0, 2.0])
    assert track.at(np.nextafter(1.0, 0.0))[0, 3] == pytest.approx(1.0)
    assert track.at(1.0)[0, 3] == 5.0
