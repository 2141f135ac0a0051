"""The error that a plan states."""

from dataclasses import replace

import pytest

import sonar_gl as sg
from sonar_gl.engine.flow import Plan


class TestPlan:
    @pytest.mark.parametrize(
        "total, body, met, expected",
        [(0.01, 0.2, True, 0.01), (0.01, 0.6, False, 0.12), (0.2, 0.6, False, 0.2)],
    )
    def test_where_a_body_breaks_the_promise_a_fifth_of_its_error_is_the_estimate(
        self, total, body, met, expected
    ):
        """If that is more than the error of the ping, which may lie far below the tolerance, 0.05 here."""
        plan = Plan(sg.Sampling(1.0, 64), 0, total, body, 2, met, 1000)
        assert plan.bound == pytest.approx(expected, rel=1e-15)  # rounding of one division


def test_the_bound_of_a_plan_is_above_the_tolerance_if_it_is_not_met():
    """The promise of a body's echo is five times the tolerance: a body at 20 % breaks that of 1, 2 and 3 %."""
    plan = Plan(sg.Sampling(1, 16), 3, 0.01, 0.2, 7, True, 1000)
    assert plan.bound == 0.01
    assert replace(plan, met=False).bound == pytest.approx(0.04, rel=1e-15)
    assert replace(plan, met=False, error_estimate=0.05).bound == 0.05
