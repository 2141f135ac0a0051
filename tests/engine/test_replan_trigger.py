"""When the error is estimated again: how far the sonar and bodies have moved, and how bodies have changed."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.engine.instrument import Instrument
from sonar_gl.engine.replan_trigger import CHECK_EVERY, ReplanTrigger
from sonar_gl.engine.request import PingRequest
from sonar_gl.scene.state import SceneState
from tests.support.sampled_scenes import IDEAL, SONAR


@pytest.mark.parametrize(
    ("azimuth_fov_deg", "elevation_fov_deg", "bound_deg"),
    [(45.0, 20.0, 10.0), (30.0, 60.0, 7.5), (180.0, 90.0, 30.0)],
)
def test_the_trigger_s_angle_is_that_of_the_rotation(azimuth_fov_deg, elevation_fov_deg, bound_deg):
    """A quarter of the field of view, half the aperture, or 30 degrees: the smallest counts, about any axis."""
    state = SceneState(np.empty((0, 4, 4)), np.empty(0, bool))
    sonar = replace(SONAR, azimuth_fov_deg=azimuth_fov_deg, elevation_fov_deg=elevation_fov_deg)
    trigger, instrument = (
        ReplanTrigger(sonar, lambda state: np.ones(len(state.poses))),
        Instrument(sonar, IDEAL),
    )
    for axis in ("roll", "pitch", "yaw"):
        for more_deg, is_due in ((-0.1, False), (0.1, True), (150.0, True)):
            for side in (1, -1):
                turned = sg.pose(**{axis: side * math.radians(bound_deg + more_deg)})
                before, after = (instrument.set_up(PingRequest(at), state, 0) for at in (np.eye(4), turned))
                assert trigger.is_due(before, after, 1) == is_due


FAR_M = 0.05 * SONAR.range_max_m


@pytest.mark.parametrize(
    ("pose", "second", "mu", "present", "due_after", "is_far"),
    [
        (sg.pose(), sg.pose(), [0.2, 0.8], [1, 1], None, False),  # nothing changes
        (sg.pose(0, 0.98 * FAR_M), sg.pose(), [0.2, 0.8], [1, 1], CHECK_EVERY, False),
        (sg.pose(0, 1.02 * FAR_M), sg.pose(), [0.2, 0.8], [1, 1], 1, True),
        (sg.pose(yaw=1e-3), sg.pose(), [0.2, 0.8], [1, 1], CHECK_EVERY, False),
        (sg.pose(), sg.pose(0.98 * FAR_M), [0.2, 0.8], [1, 1], CHECK_EVERY, False),
        (sg.pose(), sg.pose(1.02 * FAR_M), [0.2, 0.8], [1, 1], 1, True),
        (sg.pose(), sg.pose(roll=0.5), [0.2, 0.8], [1, 1], 1, True),
        (sg.pose(), sg.pose(), [0.2, 0.41], [1, 1], CHECK_EVERY, False),
        (sg.pose(), sg.pose(), [0.2, 0.39], [1, 1], 1, True),
        (sg.pose(), sg.pose(), [0.41, 0.8], [1, 1], 1, True),
        (sg.pose(), sg.pose(), [0.2, 0.8], [0, 1], 1, False),
        (sg.pose(), sg.pose(1.02 * FAR_M), [0.2, 0.8], [1, 0], 1, False),  # of a body that has gone
        (sg.pose(0, 1.02 * FAR_M), sg.pose(), [0.2, 0.8], [0, 1], 1, True),
    ],
)
def test_what_has_the_error_estimated_again(pose, second, mu, present, due_after, is_far):
    """At once, after CHECK_EVERY pings, or never; of three bodies the last is absent, however it changes."""
    trigger, instrument = ReplanTrigger(SONAR, lambda state: state.reflectivity), Instrument(SONAR, IDEAL)
    still = SceneState(
        np.tile(np.eye(4), (3, 1, 1)), np.array([1, 1, 0], bool), reflectivity=np.array([0.2, 0.8, 0.1])
    )
    moved = replace(
        still, poses=np.array([np.eye(4), second, np.eye(4)]), present=np.array([*present, 0], bool)
    )
    moved = replace(moved, reflectivity=np.array([*mu, 0.9]))
    before = instrument.set_up(PingRequest(np.eye(4)), still, 0)
    after = instrument.set_up(PingRequest(pose), moved, 0)
    due = [n for n in (1, CHECK_EVERY - 1, CHECK_EVERY) if trigger.is_due(before, after, n)]
    assert due == [n for n in (1, CHECK_EVERY - 1, CHECK_EVERY) if due_after is not None and n >= due_after]
    assert trigger.is_far(before, after) == is_far
