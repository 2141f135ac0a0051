"""What a plan chooses for image sources: the finest samples that any of its poses needs, and the largest error."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine import planning
from sonar_gl.engine.image_sampling import MultipathError
from sonar_gl.engine.request import PingRequest

SONAR = sg.Sonar("plan", 900e3, 16, 40, 45.0, 20.0, 3.0, 0.5, 20.0)
MULTIPATH = sg.Acoustics("ideal", multipath="incoherent")
# halvings and error of each pose; where the same error was found with more rows, it is larger with few
FOUND = [(3, None), (1, MultipathError(0.4, 10.0)), (2, MultipathError(0.3, 40.0)), (3, None), (2, None)]


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (2, 1, 0, 4, 3), (4, 3, 0, 1, 2)])
def test_image_sources_have_the_samples_of_the_hardest_pose_in_any_order(monkeypatch, order):
    """Each pose is looked at as if it were the first of all, with the samples that were planned for what is in view.

    A plan that is broken off leaves the one before.
    """
    scene = sg.Scene([sg.Body("wall", trimesh.creation.box((1, 9, 9)), sg.pose(8))])
    with sg.Simulator(scene, SONAR, MULTIPATH) as simulator:
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
    with sg.Simulator(sg.Scene([wall]), SONAR, sg.Acoustics.ideal(), tolerance=0.05) as simulator:

        def requests():
            yield PingRequest(sg.pose())
            simulator.add(rod)
            yield PingRequest(sg.pose(yaw=3.0))  # away from both

        assert planning.plan(simulator.run, requests()).worst_body != 2
        assert simulator.plan([sg.pose()]).worst_body == 2
