"""Samples for a tolerance: chosen by what is seen, looked at again as the sonar moves, and told."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.census import census
from sonar_gl.plan import sampling_of
from sonar_gl.verify import ping_error
from sonar_gl.watch import CHECK_EVERY

SONAR = sg.Sonar("plan", 900e3, 64, 200, 45.0, 20.0, 1.0, 0.5, 20.0)
IDEAL = sg.Acoustics.ideal()


def ball(x=8.0, radius=1.0, name="ball", **more):
    return sg.Body(name, trimesh.creation.icosphere(4, radius), sg.pose(x), **more)


def rung(simulator):
    return simulator._samples.plan.rung


def test_a_smaller_tolerance_takes_more_samples_and_errs_less():
    scene = sg.Scene([ball()])
    truth = sg.reference_ping(scene, SONAR, np.eye(4), IDEAL, error=0.02)
    rungs, errors = [], []
    for tolerance in (0.1, 0.03, 0.01):
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=tolerance) as simulator:
            ping = simulator.ping(np.eye(4))
            rungs.append(rung(simulator))
        errors.append(ping_error(ping, truth))
        assert errors[-1] <= tolerance
        assert 0 < ping.error_estimate <= tolerance
        assert ping.meta["tolerance"] == tolerance
    assert rungs == sorted(set(rungs)) and errors == sorted(errors, reverse=True)


def test_what_the_scene_asks_for():
    """A wall takes the coarsest rung, a picket of rods a fine one."""
    wall = sg.Scene([sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(8))])
    rods = sg.Scene(
        [
            sg.Body(f"rod {y}", trimesh.creation.cylinder(0.02, 3.0, sections=16), sg.pose(8, 0.3 * y))
            for y in range(-9, 10)
        ]
    )
    with sg.Simulator(wall, SONAR, IDEAL) as simulator:
        simulator.ping(np.eye(4))
        assert rung(simulator) == 0
    with sg.Simulator(rods, SONAR, IDEAL) as simulator:
        simulator.ping(np.eye(4))
        assert rung(simulator) > 8


def test_small_bodies_get_the_samples_that_their_own_echo_asks_for():
    wall = sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(19), reflectivity=0.05)
    scene = sg.Scene([wall, ball(x=12, radius=0.07, reflectivity=1.0)])
    truth = sg.reference_ping(scene, SONAR, np.eye(4), IDEAL, error=0.02)
    assert 1e-3 < truth.body_echo[2] / truth.body_echo.sum() < 1e-2
    with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.02) as simulator:
        ping = simulator.ping(np.eye(4), labels=True)
        hits = rung_hits(simulator)
        assert abs(ping.body_echo[2] / truth.body_echo[2] - 1) < 5 * 0.02
        # at the coarsest rung, good enough for the wall, not even twenty samples meet the ball
        coarse = sampling_of(SONAR, 0)
    with sg.Simulator(scene, SONAR, IDEAL, coarse) as simulator:
        assert rung_hits(simulator)[2] < 20 < hits[2]


def rung_hits(simulator):
    now = simulator._samples.now
    with simulator._drawing():
        views, evenly = now.views(np.eye(4), labels=True), now.reducer.elevation
        return census(views, len(simulator.scene.bodies), SONAR, now.gain, evenly)[0]


@pytest.mark.parametrize("tolerance, radius", [(0.05, 0.008), (0.01, 0.02)])
def test_a_body_that_the_first_samples_miss_is_looked_for(tolerance, radius):
    """Far too small for the coarse lattice; alone in the water it is the whole echo."""
    speck = sg.Scene([ball(x=18, radius=radius)])
    with sg.Simulator(speck, SONAR, IDEAL, sampling_of(SONAR, 4)) as simulator, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert not simulator.ping(np.eye(4)).intensity.any()
    with sg.Simulator(speck, SONAR, IDEAL, tolerance=tolerance) as simulator:
        ping = simulator.ping(np.eye(4))
        assert simulator._samples.plan.met
    truth = sg.reference_ping(
        sg.Scene([ball(x=18, radius=radius)]),
        replace(SONAR, n_beams=1, azimuth_fov_deg=1.0),
        np.eye(4),
        IDEAL,
        0.1,
    )
    # the one beam hears all of it; every beam within half a degree does too
    assert ping.intensity.max(axis=0).sum() == pytest.approx(truth.intensity.sum(), rel=0.1)


class TestMoving:
    def scene(self):
        return sg.Scene([ball(), sg.Body("floor", trimesh.creation.box((80, 80, 1)), sg.pose(0, 0, -3.5))])

    def looks(self, poses, monkeypatch, **settings):
        """How often a planner looked, at each pose; and the rungs."""
        out = []
        with sg.Simulator(self.scene(), SONAR, IDEAL, **settings) as simulator:
            judged = []
            judge = simulator._samples._judge
            monkeypatch.setattr(simulator._samples, "_judge", lambda *a: judged.append(1) or judge(*a))
            for pose in poses:
                before = len(judged)
                ping = simulator.ping(pose)
                out.append((len(judged) > before, ping.meta["sampling"]["rows"]))
        return out

    def test_a_still_sonar_is_looked_at_once(self, monkeypatch):
        looks = self.looks([np.eye(4)] * 40, monkeypatch)
        assert [look for look, _ in looks] == [True] + [False] * 39

    def test_a_slow_one_now_and_then(self, monkeypatch):
        looks = self.looks([sg.pose(0.001 * k) for k in range(1 + 3 * CHECK_EVERY)], monkeypatch)
        assert [k for k, (look, _) in enumerate(looks) if look] == [k * CHECK_EVERY for k in range(4)]

    def test_after_a_choice_that_was_broken_off_it_is_made_anew(self, monkeypatch):
        """A pass that was let go of meanwhile has no thread any more: its ping would never end."""
        with sg.Simulator(self.scene(), SONAR, IDEAL) as simulator:
            samples, judge, left = simulator._samples, simulator._samples._judge, [2]

            def broken_off(*arguments):
                left[0] -= 1
                if left[0] == 0:
                    raise KeyboardInterrupt
                out = judge(*arguments)
                return out[0], 8  # and finer yet

            monkeypatch.setattr(samples, "_judge", broken_off)
            with pytest.raises(KeyboardInterrupt):
                simulator.ping(np.eye(4))
            monkeypatch.setattr(samples, "_judge", judge)
            assert simulator.ping(np.eye(4)).error_estimate <= 0.01

    def test_a_leap_or_a_turn_at_once(self, monkeypatch):
        poses = [sg.pose(), sg.pose(), sg.pose(3), sg.pose(3), sg.pose(3, yaw=1.0), sg.pose(3, yaw=1.0)]
        looks = self.looks(poses, monkeypatch)
        assert [look for look, _ in looks] == [True, False, True, False, True, False]

    @pytest.mark.parametrize(
        "first, second",
        [
            (sg.pose(x=-12.6), sg.pose(x=-11.8)),
            (sg.pose(yaw=0.5), sg.pose(yaw=0.35)),
        ],
        ids=["ahead", "yaw"],
    )
    def test_what_comes_into_view_is_looked_at_however_little_the_sonar_moved(self, first, second):
        """The first ping sees nothing; a plan that was content with that is not for the second."""
        scene = sg.Scene([ball(x=8.0, radius=0.3)])
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.02) as simulator:
            with pytest.warns(UserWarning, match="no echo came back"):
                simulator.ping(first)
            ping = simulator.ping(second)
        truth = sg.reference_ping(scene, SONAR, second, IDEAL, error=0.05)
        assert truth.intensity.any()
        assert ping.error_estimate > 0 and ping_error(ping, truth) < 0.02

    def test_the_same_pings_the_same_bytes(self):
        poses = [sg.pose(0.2 * k, yaw=0.05 * k) for k in range(20)]
        runs = []
        for _ in range(2):
            with sg.Simulator(self.scene(), SONAR, IDEAL) as simulator:
                runs.append([simulator.ping(pose).intensity.tobytes() for pose in poses])
        assert runs[0] == runs[1]

    def test_it_grows_finer_and_coarser_again(self):
        """From a wall to a picket of rods and back."""
        rods = [
            sg.Body(f"rod {y}", trimesh.creation.cylinder(0.02, 3.0, sections=16), sg.pose(-8, 0.3 * y))
            for y in range(-9, 10)
        ]
        scene = sg.Scene([sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(8)), *rods])
        with sg.Simulator(scene, SONAR, IDEAL) as simulator:
            rungs = []
            for yaw in (0, math.pi, 0):
                simulator.ping(sg.pose(yaw=yaw))
                rungs.append(rung(simulator))
        assert rungs[0] == rungs[2] == 0 and rungs[1] > 8


class TestPlan:
    def test_it_fixes_the_samples_for_good(self):
        scene = TestMoving().scene()
        poses = [sg.pose(yaw=0.3 * k) for k in range(10)]
        with sg.Simulator(scene, SONAR, IDEAL) as simulator:
            plan = simulator.plan(poses)
            forward = [simulator.ping(pose).intensity.tobytes() for pose in poses]
            backward = [simulator.ping(pose).intensity.tobytes() for pose in poses[::-1]]
            assert simulator.ping(poses[3]).error_estimate == plan.error_estimate
            assert simulator.sampling == plan.sampling and plan.met
            # elsewhere nothing is promised
            assert simulator.ping(sg.pose(x=-1)).error_estimate is None
        assert forward == backward[::-1]
        with sg.Simulator(scene, SONAR, IDEAL) as simulator:
            alone = [simulator.plan([pose]).rung for pose in poses]
        assert plan.rung == max(alone)

    def test_given_samples_are_not_planned(self):
        with sg.Simulator(TestMoving().scene(), SONAR, IDEAL, sg.Sampling(2, 32)) as simulator:
            assert simulator.plan([np.eye(4)]) is None
            ping = simulator.ping(np.eye(4))
        assert ping.error_estimate is None and ping.meta["tolerance"] is None

    def test_a_tolerance_out_of_reach_is_told_and_the_best_given(self, monkeypatch):
        monkeypatch.setattr("sonar_gl.plan.FINEST_RUNG", 6)
        scene = sg.Scene([ball(x=10, radius=0.5)])
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.001) as simulator:
            with pytest.warns(UserWarning, match="^tolerance 0.001 cannot be met here: ") as told:
                ping = simulator.ping(np.eye(4))
            assert "worst body ('ball'); go nearer" in str(told[0].message)
            assert rung(simulator) == 6 and ping.error_estimate > 0.001
            assert not simulator._samples.plan.met
            with warnings.catch_warnings():  # once is enough
                warnings.simplefilter("error")
                simulator.ping(sg.pose(2.5))

    @pytest.mark.parametrize(
        "poses, message",
        [
            ([], "poses must hold at least one pose (got none)"),
            (None, "poses must be several poses (got NoneType; make [pose] of one)"),
            (np.eye(4), "poses must be several poses (got ndarray; make [pose] of one)"),
        ],
    )
    def test_poses_that_make_no_sense(self, poses, message):
        with sg.Simulator(sg.Scene([]), SONAR) as simulator, pytest.raises(sg.Error) as caught:
            simulator.plan(poses)
        assert str(caught.value) == message


@pytest.mark.parametrize("tolerance", [0.0, 0.9, float("nan"), "fine", None, True])
def test_tolerances_that_make_no_sense(tolerance):
    with pytest.raises(sg.Error) as caught:
        sg.Simulator(sg.Scene([]), SONAR, tolerance=tolerance)
    assert str(caught.value) == (
        f"tolerance must be a number in 0.001..0.5 (got {tolerance!r}; 0.01 is one per cent)"
    )


def test_an_empty_scene_needs_no_samples():
    with sg.Simulator(sg.Scene([]), SONAR) as simulator, pytest.warns(UserWarning, match="no bodies"):
        ping = simulator.ping(np.eye(4))
    assert ping.error_estimate == 0.0
