"""What a plan chooses for several poses: the finest samples that any of them needs, and the largest error."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine import planning
from sonar_gl.engine.image_sampling import MultipathError
from sonar_gl.engine.request import PingRequest
from tests.support.errors import error_of
from tests.support.sampled_scenes import IDEAL, SONAR, WALL_AND_RODS, ball, ball_and_floor
from tests.support.wall_and_rods import wall

FEW_BEAMS = sg.Sonar("plan", 900e3, 16, 40, 45.0, 20.0, 3.0, 0.5, 20.0)
MULTIPATH = sg.Acoustics("ideal", multipath="incoherent")
# halvings and error of each pose; where the same error was found with more rows, it is larger with few
FOUND = [(3, None), (1, MultipathError(0.4, 10.0)), (2, MultipathError(0.3, 40.0)), (3, None), (2, None)]


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (2, 1, 0, 4, 3), (4, 3, 0, 1, 2)])
def test_image_sources_have_the_samples_of_the_hardest_pose_in_any_order(monkeypatch, order):
    """Each pose is looked at as if it were the first of all, with the samples that were planned for what is in view.

    A plan that is broken off leaves the one before.
    """
    scene = sg.Scene([sg.Body("wall", trimesh.creation.box((1, 9, 9)), sg.pose(8))])
    with sg.Simulator(scene, FEW_BEAMS, MULTIPATH) as simulator:
        sampler, images, seen = simulator.run.sampler, simulator.run.image_sampling, []

        def fix(setups):
            sampler.choice = replace(sampler.choice, planned=frozenset())
            return "plan"

        monkeypatch.setattr(sampler, "fix", fix)

        def sample(run, setup):
            assert sampler.choice.is_planned
            seen.append((images.choice.is_new, images.choice.is_fixed, len(setup.state.present)))
            halvings, error = FOUND[order[round(setup.head_pose[0, 3])]]
            images.choice = images.choice._replace(halvings=halvings, error=error, is_new=False)
            drawn = SimpleNamespace(images=SimpleNamespace(halvings=halvings))
            return SimpleNamespace(drawn=drawn), None

        monkeypatch.setattr(planning, "sample", sample)
        for _ in range(2):  # the second plan replaces the first
            assert simulator.plan([sg.pose(k) for k in range(5)]) == "plan"
            assert images.choice.is_fixed and images.choice.halvings == 1
            assert images.choice.error == MultipathError(0.3, 40.0)
        before = sampler.choice, images.choice

        def broken(run, setup):
            raise KeyboardInterrupt

        monkeypatch.setattr(planning, "sample", broken)
        with pytest.raises(KeyboardInterrupt):
            simulator.plan([np.eye(4)])
        assert sampler.choice is before[0] and images.choice is before[1]
    assert seen == [(True, False, 1)] * 10


def test_a_body_that_is_added_while_pings_are_set_up_is_absent_from_those_before():
    """As by another thread: the ping that was set up with fewer bodies than there are could not be drawn."""
    wall, rod = (
        sg.Body(name, trimesh.creation.box(size), sg.pose(x))
        for name, size, x in (("wall", (1, 60, 60), 12), ("rod", (0.02, 0.02, 1.0), 6))
    )
    with sg.Simulator(sg.Scene([wall]), FEW_BEAMS, sg.Acoustics.ideal(), tolerance=0.05) as simulator:

        def requests():
            yield PingRequest(sg.pose())
            simulator.add(rod)
            yield PingRequest(sg.pose(yaw=3.0))  # away from both

        assert planning.plan(simulator.run, requests()).worst_body != 2
        assert simulator.plan([sg.pose()]).worst_body == 2


class TestPlan:
    def test_a_single_pose_among_many_decides(self):
        """The twelfth of 24 poses looks at rods, the others at open water or a wall."""
        poses = [sg.pose(yaw=math.pi if k == 11 else 0.01 * k) for k in range(24)]
        with sg.Simulator(WALL_AND_RODS, SONAR, IDEAL, tolerance=0.05) as simulator:
            alone = simulator.plan([poses[11]]).level
        with sg.Simulator(WALL_AND_RODS, SONAR, IDEAL, tolerance=0.05) as simulator:
            assert simulator.plan(poses).level == alone > 0

    @pytest.mark.parametrize("tolerance", [0.1, 0.02])
    def test_a_plan_that_is_met_promises_each_body_five_times_the_tolerance(self, tolerance):
        """It stops at the coarsest samples that do: those of half the number do not."""
        scene = sg.Scene([wall(19, reflectivity=0.05), ball(x=12, radius=0.1, reflectivity=1.0)])
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=tolerance) as simulator:
            plan = simulator.plan([np.eye(4)])
        assert plan.met and plan.worst_body == 2
        assert 2.5 * tolerance < plan.worst_body_estimate <= 5 * tolerance
        assert plan.error_estimate <= tolerance

    def test_a_plan_fixes_the_samples(self):
        scene = ball_and_floor()
        poses = [sg.pose(yaw=0.3 * k) for k in range(10)]
        with sg.Simulator(scene, SONAR, IDEAL) as simulator:
            plan = simulator.plan(poses)
            forward = [simulator.ping(pose).intensity.tobytes() for pose in poses]
            backward = [simulator.ping(pose).intensity.tobytes() for pose in poses[::-1]]
            assert simulator.ping(poses[3]).error_estimate == plan.error_estimate
            assert simulator.sampling == plan.sampling and plan.met
            # at other poses the plan gives no error estimate
            assert simulator.ping(sg.pose(x=-1)).error_estimate is None
        assert forward == backward[::-1]
        with sg.Simulator(scene, SONAR, IDEAL) as simulator:
            alone = [simulator.plan([pose]).level for pose in poses]
        assert plan.level == max(alone)

    @pytest.mark.parametrize("change", ["bodies", "reflectivity"])
    def test_a_plan_estimates_no_error_of_other_bodies_and_water(self, change):
        """The estimate was that of the plan: a thousandth, where rods that came into view erred by a sixth."""
        moved = {"rod 0": sg.pose(5)}
        more, of_several = {
            "bodies": ({"bodies": moved}, {"bodies": [moved]}),
            "reflectivity": ({"reflectivity": {"wall": 0.1}}, {"reflectivities": [{"wall": 0.1}]}),
            "water": ({"water": sg.Water(temperature_c=30.0)}, {"waters": [sg.Water(temperature_c=30.0)]}),
        }.get(change, ({}, {}))
        acoustics = sg.Acoustics.physical(tvg_absorption_db_m=0.2)  # else the TVG follows the water
        with sg.Simulator(WALL_AND_RODS, SONAR, acoustics) as simulator:
            plan = simulator.plan([sg.pose(), sg.pose(yaw=0.1)], bodies=[None, moved])
            assert simulator.ping(sg.pose(yaw=0.1), bodies=moved).error_estimate == plan.bound
            assert simulator.ping(sg.pose(yaw=0.1)).error_estimate is None
            # `sg.pose` has a zero that is negative
            assert simulator.ping(np.eye(4)).error_estimate == plan.bound
            if change == "place":
                simulator.place(moved)
            if change == "add":
                simulator.add(ball(5.0, 0.1))
            assert simulator.ping(sg.pose(), **more).error_estimate is None
            (ping,) = simulator.pings([sg.pose()], **of_several)
            assert ping.error_estimate is None
            simulator.place({"rod 0": sg.pose(-8)})
            assert simulator.ping(sg.pose()).error_estimate == (None if change == "add" else plan.bound)

    def test_a_plan_estimates_no_error_of_other_bubbles_nor_at_another_gain(self):
        scene = sg.Scene([wall(12), sg.Bubbles("plume", sg.pose(8, 0, -1))])
        acoustics = sg.Acoustics.physical(tvg_absorption_db_m=0.2)  # else the TVG follows the water
        with sg.Simulator(scene, SONAR, acoustics) as simulator:
            plan = simulator.plan([sg.pose()])
            assert simulator.ping(sg.pose()).error_estimate == plan.bound
            for other in (
                {"bodies": {"plume": None}},
                {"time_s": 4.0},
                {"water": replace(acoustics.water, absorption_db_m=0.5)},
            ):
                assert simulator.ping(sg.pose(), **other).error_estimate is None

    def test_fixed_samples_need_no_plan(self):
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL, sg.Sampling(2, 32)) as simulator:
            assert simulator.plan([np.eye(4)]) is None
            ping = simulator.ping(np.eye(4))
        assert ping.error_estimate is None and ping.meta["tolerance"] is None

    @pytest.mark.parametrize(
        "poses, message",
        [
            ([], "poses must hold at least one pose (got none)"),
            (None, "poses must be several poses (got NoneType; make [pose] of one)"),
            (np.eye(4), "poses must be several poses (got ndarray; make [pose] of one)"),
        ],
    )
    def test_invalid_poses_raise_errors(self, poses, message):
        with sg.Simulator(sg.Scene([]), SONAR) as simulator:
            assert error_of(simulator.plan, poses) == message
