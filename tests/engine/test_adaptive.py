"""Samples for a tolerance, revised as the sonar and bodies move, and what is said where they do not keep it."""

import contextlib
import math
import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine import adaptive, error_model, pipeline
from sonar_gl.engine import run as run_module
from sonar_gl.engine.level_search import LevelSearch
from sonar_gl.engine.multipath import COARSEST, ImageSources
from sonar_gl.engine.no_echo import ECHO_LOST, NoEchoWarning
from sonar_gl.engine.replan_trigger import CHECK_EVERY
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.stage import KEPT_VIEWS, Coverage, Stage, StageCache
from sonar_gl.sonar.sampling import FINEST_LEVEL, ToleranceWarning, sampling_at
from tests.support.errors import error_of
from tests.support.estimates import record_estimates
from tests.support.interrupts import Interrupter
from tests.support.sampled_scenes import (
    IDEAL,
    SONAR,
    WALL_AND_RODS,
    ball,
    ball_and_floor,
    level_of,
    make_alone,
)

pytestmark = pytest.mark.usefixtures("few_first_rays")


def cost_of(n_samples, coverage):
    """Return what a ping of SONAR costs, in samples."""
    return adaptive.cost_of(SONAR, IDEAL, n_samples, coverage)


def times(share, coverage):
    """Return a coverage of so many times the samples, and the same faces."""
    return coverage._replace(share=share * coverage.share)


def received_of(setup, total):
    """Return what of a ReceivedPing tells whether the view has changed."""
    return SimpleNamespace(drawn=SimpleNamespace(setup=setup), direct=SimpleNamespace(total=total))


MURKY = replace(IDEAL, volume_reverberation=True, water=sg.Water(volume_backscatter_db=0.0))


class TestMoving:
    @pytest.fixture
    def simulator(self, request):
        """A simulator that has made a ping, with other acoustics than IDEAL if they are its parameter."""
        with sg.Simulator(ball_and_floor(), SONAR, getattr(request, "param", IDEAL)) as simulator:
            simulator.ping(np.eye(4))
            yield simulator

    def estimates(self, poses, monkeypatch, **settings):
        """Return, for each pose, whether the error was estimated, and the number of rows."""
        out = []
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL, **settings) as simulator:
            calls = record_estimates(monkeypatch)
            for pose in poses:
                before = len(calls)
                ping = simulator.ping(pose)
                out.append((len(calls) > before, ping.meta["sampling"]["rows"]))
        return out

    def test_a_still_sonar_is_estimated_once(self, monkeypatch):
        estimates = self.estimates([np.eye(4)] * 40, monkeypatch)
        assert [estimated for estimated, _ in estimates] == [True] + [False] * 39

    def test_a_slow_sonar_is_estimated_every_few_pings(self, monkeypatch):
        slow = [sg.pose(0.001 * k) for k in range(1 + 3 * CHECK_EVERY)]
        estimates = self.estimates(slow, monkeypatch, tolerance=0.05)
        # the first one by itself, later ones by two pings of the loop
        at = [0, CHECK_EVERY, CHECK_EVERY + 1, 2 * CHECK_EVERY, 2 * CHECK_EVERY + 1, 3 * CHECK_EVERY]
        assert [k for k, (estimated, _) in enumerate(estimates) if estimated] == at

    def test_a_fifth_more_or_less_of_the_echo_is_a_change(self):
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            total = simulator.ping(sg.pose()).intensity.sum(dtype=np.float64)
            sampler = simulator.run.sampler
            setup = sampler.choice.last_check.setup
            received = [received_of(setup, share * total) for share in (0, 0.79, 0.81, 1.19, 1.21)]
            changed = [sampler.has_changed(one) for one in received]
        assert changed == [True, True, False, False, True]

    @pytest.mark.parametrize(
        ("level", "finest", "steps", "expected"),
        [
            (8, FINEST_LEVEL, 3, (11, FINEST_LEVEL, True)),
            (20, FINEST_LEVEL, 9, (22, FINEST_LEVEL, True)),  # twice as many samples at most, of so many
            (8, 9, 3, (9, 9, True)),  # more do not fit
            (8, 8, 3, (8, 8, False)),
            (8, FINEST_LEVEL, 0, (8, FINEST_LEVEL, False)),
            (8, 9, -3, (8, 9, False)),
            (8, 9, -4, (4, FINEST_LEVEL, True)),  # half as wide again in both directions
            (2, FINEST_LEVEL, -4, (0, FINEST_LEVEL, True)),
            (0, FINEST_LEVEL, -4, (0, FINEST_LEVEL, False)),
        ],
    )
    def test_a_check_moves_the_level_as_far_as_there_are_samples(
        self, simulator, level, finest, steps, expected, monkeypatch
    ):
        """And has the new level checked; at any cost, here. Two pings make its stages, and no memory is given back."""
        judge, make, made, dropped = error_model.ErrorModel.judge, StageCache.make, [], []

        def judged(*arguments):
            found = judge(*arguments)
            return found._replace(steps=steps, plan=replace(found.plan, met=steps <= 0))

        sampler = simulator.run.sampler
        sampler.choice = replace(sampler.choice, level=level, finest=finest, is_due=True)
        sampler.history = sampler.history._replace(
            costs=(1e12,) * 8
        )  # fewer than a loop, which shares checks
        monkeypatch.setattr(error_model.ErrorModel, "judge", judged)
        monkeypatch.setattr(StageCache, "make", lambda *of: made.append(of[1]) or make(*of))
        monkeypatch.setattr(StageCache, "drop_large", lambda _: dropped.append(1))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            simulator.ping(np.eye(4))
            made.clear()
            n_made = []
            for _ in range(2 * (expected[0] != level)):
                assert sampler.choice.level == level
                assert simulator.ping(np.eye(4)).meta["sampling"] == vars(sampling_at(SONAR, level))
                n_made.append(len(made))
        choice = sampler.choice
        with simulator.run.drawing():
            assert sampler.resolution.stage.sampling == sampling_at(SONAR, choice.level)
            sampler.search.model.coarser_stage(sampler.resolution.stage)
        assert (choice.level, choice.finest, choice.is_due, choice.next_level) == (*expected, None)
        assert n_made in ([], [0, 0], [0, 1], [1, 1], [1, 2]) and not dropped
        assert len(made) == (n_made or [0])[-1]
        assert [one.category for one in caught] == [ToleranceWarning] * (steps > 0 and level == finest)

    @pytest.mark.parametrize("share", [0.4, 1.01])
    def test_finer_samples_get_their_memory_in_parts(self, simulator, share, monkeypatch):
        """New memory of as many samples at a time as a tenth of a ping costs, after pings that make both stages."""
        sampler, shares = simulator.run.sampler, []
        level, setup = sampler.choice.level, simulator.run.set_up(PingRequest(np.eye(4)))
        with simulator.run.drawing():
            coarse, fine = (sampler.search.model.stage_at(n) for n in (level, level + 3))
            (view,) = coarse.draw([setup.head_pose], [setup.state])
        n_new = view.n_samples * (fine.fan.n_samples / coarse.fan.n_samples - 1)
        assert n_new > 0
        wanted = math.ceil(view.n_samples * fine.fan.n_samples / coarse.fan.n_samples)
        sizes = []

        def prepared(_, n_samples, share):
            sizes.append(n_samples)
            shares.append(share)

        monkeypatch.setattr(type(fine.renderer), "prepare", prepared)
        sampler.choice = replace(sampler.choice, next_level=level + 3, is_due=True)
        sampler.history = sampler.history._replace(costs=(share * n_new / 0.1,) * 99)
        for number, _ in enumerate(
            expected := [[], [0.0], [0.4], [0.8], [1.0]] if share < 1 else [[], [1.0]]
        ):
            assert sampler.choice.level == level
            simulator.ping(np.eye(4))
            found = [one for of_ping in expected[: number + 1] for one in 2 * of_ping]
            assert shares == pytest.approx(found, abs=1e-9)  # rounding
        assert (sampler.choice.level, sampler.choice.next_level) == (level + 3, None)
        assert set(sizes[::2]) == {wanted}  # and those of the view to compare with
        assert sizes[1::2] == pytest.approx(
            [wanted / 2] * len(shares[1::2]), rel=0.1
        )  # whole columns and rows

    @pytest.mark.parametrize(("share", "is_due"), [(1.001, True), (0.999, False)])
    def test_a_check_waits_until_it_costs_no_more_than_a_ping_may(self, simulator, share, is_due):
        """Half of it makes a ping cost 1.6 times as much, which may be 2.3 times the median."""
        sampler = simulator.run.sampler
        sampler.choice = replace(sampler.choice, is_due=True)
        median = share * 1.6 / 2.3 * cost_of(sampler.plan.n_samples, sampler.choice.coverage)
        assert sampler.is_check_due(sampler.history._replace(costs=(median,) * 9)) == is_due

    @pytest.mark.parametrize(("median", "is_estimated"), [(1e12, True), (1.0, False)])
    def test_a_change_of_the_echo_is_estimated_at_once_if_that_costs_no_more(
        self, simulator, median, is_estimated, monkeypatch
    ):
        """And as soon as it does otherwise."""
        sampler = simulator.run.sampler
        checked = sampler.choice.last_check
        sampler.choice = replace(sampler.choice, last_check=checked._replace(total=2 * checked.total))
        sampler.history = sampler.history._replace(costs=(median,) * 9)
        calls = record_estimates(monkeypatch)
        simulator.ping(np.eye(4))
        assert bool(calls) == is_estimated
        assert sampler.choice.is_due == (not is_estimated)

    @pytest.mark.parametrize(("share", "level"), [(1.001, 5), pytest.param(0.999, 4, marks=pytest.mark.slow)])
    def test_samples_get_as_fine_at_once_as_a_ping_may_cost(self, share, level, monkeypatch):
        """By up to eight levels, that a check asks for, but for no more than 2.3 / 1.6 times the median."""
        judge = error_model.ErrorModel.judge
        monkeypatch.setattr(adaptive, "MOST_COST", math.inf)  # of checks
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            simulator.ping(np.eye(4))
            monkeypatch.setattr(error_model.ErrorModel, "judge", lambda *of: judge(*of)._replace(steps=8))
            sampler = simulator.run.sampler
            sampler.choice = replace(sampler.choice, level=2, is_due=True)
            setup = simulator.run.set_up(PingRequest(np.eye(4)))
            with simulator.run.drawing():
                stage = sampler.resolution.stage
                (view,) = stage.draw([setup.head_pose], [setup.state], with_bodies=True)
                coverage = stage.coverage(view)
            times = sampler.search.model.sampling_at(5).count(SONAR) / stage.sampling.count(SONAR)
            median = share * cost_of(times * stage.fan.n_samples, coverage) / (2.3 / 1.6)
            sampler.history = sampler.history._replace(costs=(median,) * 8)
            simulator.ping(np.eye(4))
            assert (sampler.choice.level, sampler.choice.next_level) == (2, level) and sampler.choice.is_due

    @pytest.mark.parametrize("is_checked", [False, True])
    @pytest.mark.parametrize("most", [2.3, math.inf])
    def test_a_view_that_fills_has_fewer_samples_at_once(self, simulator, is_checked, most, monkeypatch):
        """Fine samples cost little where few meet a body. Without a limit they stay as a body comes into view."""
        for name in ("MOST_COST", "MOST_FULL_COST") if most == math.inf else ():
            monkeypatch.setattr(adaptive, name, most)
        calls, sampler = record_estimates(monkeypatch), simulator.run.sampler
        coverage = sampler.choice.coverage
        with simulator.run.drawing():
            n_fine, n_coarse = (sampler.search.model.stage_at(n).fan.n_samples for n in (18, 12))
        # what 18 levels cost before the body came; to draw them and then 12 costs now just as much as a ping may
        sampler.choice = replace(sampler.choice, level=18, coverage=times(0, coverage), is_due=is_checked)
        spent = 0.6 * (cost_of(n_fine, coverage) - cost_of(0, coverage._replace(n_faces=0)))
        usual = 1.01 * (spent + cost_of(n_coarse, coverage)) / 2.3
        assert 2.3 * usual < cost_of(n_fine, times(0.99, coverage))
        sampler.history = sampler.history._replace(costs=(usual,) * 20)
        ping = simulator.ping(sg.pose(0.001))
        choice = sampler.choice
        if most == math.inf:
            assert ping.meta["sampling"] == vars(sampler.search.model.sampling_at(18))
            return
        assert not calls and choice.is_due
        assert choice.level == 12 and ping.meta["sampling"] == vars(sampler.search.model.sampling_at(12))
        assert choice.coverage.share == pytest.approx(coverage.share, rel=0.02)
        assert ping.error_estimate == pytest.approx(2 ** (1.3 * 6 / 4) * sampler.tolerance)
        prepared, model = [], error_model.ErrorModel
        make = model.coarser_stage
        monkeypatch.setattr(model, "coarser_stage", lambda *more: prepared.append(more[1]) or make(*more))
        sampler.history = sampler.history._replace(costs=(cost_of(n_coarse, coverage) / 1.7,) * 20)
        simulator.ping(sg.pose(0.002))
        assert sampler.choice.level == 12 and not calls  # a check costs more than a ping may
        assert prepared == [sampler.resolution.stage]  # what the check needs, which would have to make it

    def test_a_view_that_would_be_drawn_twice_for_nothing_keeps_its_samples(self, simulator, monkeypatch):
        """All of its time is spent once it is drawn. The next pings have fewer samples."""
        monkeypatch.setattr(adaptive, "DRAWN", 1.0)
        sampler = simulator.run.sampler
        fine, coverage = sampler.search.model.sampling_at(16), sampler.choice.coverage
        sampler.choice = replace(sampler.choice, level=16, coverage=times(0, coverage))
        sampler.history = sampler.history._replace(costs=(cost_of(0, coverage),) * 20)
        rows = [simulator.ping(sg.pose(0.001 * k)).meta["sampling"]["rows"] for k in range(4)]
        assert rows[0] == fine.rows > rows[-1]

    @pytest.mark.parametrize(("is_begun", "fills_again"), [(False, False), (True, False), (False, True)])
    def test_pings_after_one_that_cost_much_have_fewer_samples(self, simulator, is_begun, fills_again):
        """Though it was not too much itself. Two of them make their stages, and the estimate is that of fewer.

        A check that has begun is given up: of the samples before it would ask for others. Stages that are being made
        are not begun anew where the next ping costs more than was expected, too.
        """
        sampler = simulator.run.sampler
        if is_begun:
            sampler.choice = replace(sampler.choice, is_due=True)
            sampler.history = sampler.history._replace(costs=(1e12,) * 20)
            simulator.ping(np.eye(4))
        assert (sampler.choice.begun is not None) == is_begun
        model, coverage = sampler.search.model, sampler.choice.coverage
        with simulator.run.drawing():
            costs = [cost_of(model.stage_at(n).fan.n_samples, coverage) for n in range(17)]
        usual = costs[16] / 2.2
        level = max(n for n in range(17) if costs[n] <= 2.3 / 1.6 * usual)
        assert level < 16
        sampler.choice = replace(sampler.choice, level=16, coverage=times(0, coverage))
        sampler.history = sampler.history._replace(costs=(usual,) * 20)
        pings = []
        for k in range(4):
            if k == 1 and fills_again:
                assert (sampler.choice.next_level, sampler.choice.n_made) == (level, 1)
                sampler.choice = replace(sampler.choice, coverage=times(0, coverage))
            pings.append(simulator.ping(sg.pose(0.001 * k)))
        levels = [model.sampling_at(n) for n in (16, 16, level, level)]
        assert [ping.meta["sampling"] for ping in pings] == list(map(vars, levels))
        raised = 2 ** (1.3 * (16 - level) / 4) * sampler.tolerance
        assert [ping.error_estimate for ping in pings[:3]] == pytest.approx([raised] * 3)

    @pytest.mark.parametrize(
        ("simulator", "between"),
        [(IDEAL, "nothing"), (IDEAL, "a ping alone"), (MURKY, "nothing")],
        indirect=["simulator"],
        ids=["clear", "a ping alone between", "murky"],
    )
    def test_two_pings_of_a_loop_share_a_check(self, simulator, between, monkeypatch):
        """The first one draws the view to compare with, the second one sums it: as one ping alone would find.

        The first one adds the echo of the water to that of the bodies, after it has begun the check.
        """
        run, sampler = simulator.run, simulator.run.sampler
        model, level = sampler.search.model, sampler.choice.level
        pose = sg.pose(0.001)
        setup = run.set_up(PingRequest(pose))
        with run.drawing():
            expected = model.judge(setup, level, model.draw(setup, level)).plan
        sampler.choice = replace(sampler.choice, is_due=True)
        sampler.history = sampler.history._replace(costs=(1e12,) * 20)
        before, calls = sampler.plan, record_estimates(monkeypatch)
        ping = simulator.ping(pose)
        assert len(calls) == 1 and sampler.plan is before and ping.error_estimate == before.bound
        if between == "a ping alone":  # draws over the view
            make_alone(simulator, sg.pose(yaw=0.3))
        ping = simulator.ping(sg.pose(0.002))
        assert sampler.plan == expected and ping.error_estimate == expected.bound
        assert sampler.choice.begun is None and not sampler.choice.is_due

    def test_a_shared_check_is_begun_anew_where_bodies_were_added(self, simulator):
        sampler = simulator.run.sampler
        sampler.choice = replace(sampler.choice, is_due=True)
        sampler.history = sampler.history._replace(costs=(1e12,) * 20)
        simulator.ping(np.eye(4))
        before = sampler.plan
        assert sampler.choice.begun is not None
        simulator.add(ball(20.0, name="another"))
        simulator.ping(np.eye(4))
        assert sampler.choice.begun is None and sampler.choice.is_due
        assert before.met and not sampler.plan.met

    @pytest.fixture
    def with_buoy(self):
        """A simulator that has made pings, with another body that hardly changes the echo of all."""
        scene = sg.Scene([*ball_and_floor().bodies, ball(6.0, 0.05, name="buoy")])
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.05) as simulator:
            both, without = (
                simulator.ping(np.eye(4), bodies=of).intensity.sum() for of in (None, {"buoy": None})
            )
            assert both != without and abs(both - without) < 0.1 * both
            yield simulator

    def test_bodies_that_come_between_both_pings_of_a_check_are_not_taken_for_checked(
        self, with_buoy, monkeypatch
    ):
        """Where the check finds that the same samples do, of the ping before."""
        simulator, sampler, gone = with_buoy, with_buoy.run.sampler, {"buoy": None}
        model, concluded = sampler.search.model, sampler.search.model.concluded
        monkeypatch.setattr(model, "concluded", lambda begun: concluded(begun)._replace(steps=0))
        sampler.history = sampler.history._replace(costs=(1e12,) * 20)
        sampler.choice = replace(sampler.choice, is_due=True)
        assert simulator.ping(np.eye(4), bodies=gone).error_estimate <= sampler.tolerance
        assert sampler.choice.begun is not None
        ping = simulator.ping(np.eye(4))
        assert sampler.choice.begun is None and sampler.choice.next_level is None
        assert sampler.choice.is_due and ping.error_estimate > sampler.tolerance

    def test_bodies_that_came_are_unverified_while_a_check_costs_too_much(self, with_buoy):
        sampler = with_buoy.run.sampler
        usual = cost_of(sampler.plan.n_samples, sampler.choice.coverage) / 1.5
        sampler.history = sampler.history._replace(costs=(usual,) * 20)
        assert sampler.plan.met
        ping = with_buoy.ping(np.eye(4))
        assert ping.error_estimate > sampler.tolerance and sampler.choice.is_due

    def test_a_check_that_a_ping_may_cost_alone_is_not_shared_where_the_estimate_is_above(self, simulator):
        """Its estimate is then that of this ping."""
        sampler = simulator.run.sampler
        plan = replace(sampler.plan, met=False, error_estimate=0.5)
        cases = (1.08, False), (1.11, True)  # 2.1 times as much may be 2.3 times the usual
        for times_usual, is_shared in cases:
            sampler.choice = replace(sampler.choice, is_due=True, plan=plan, begun=None)
            cost = cost_of(plan.n_samples, sampler.choice.coverage)
            sampler.history = sampler.history._replace(costs=(cost / times_usual,) * 20)
            ping = simulator.ping(np.eye(4))
            assert (sampler.choice.begun is not None) == is_shared == (ping.error_estimate == 0.5)

    @pytest.mark.parametrize(("n_pings", "is_checked"), [(20, False), (5, True)])
    def test_a_check_waits_where_the_view_has_filled(self, simulator, n_pings, is_checked, monkeypatch):
        """By what was seen before it was affordable. Fewer pings than a loop has are checked at any cost."""
        calls, sampler = record_estimates(monkeypatch), simulator.run.sampler
        choice = sampler.choice
        sampler.choice = replace(choice, coverage=times(0.1, choice.coverage), is_due=True)
        usual = 0.99 * 1.6 / 2.3 * cost_of(sampler.plan.n_samples, choice.coverage)
        sampler.history = sampler.history._replace(costs=(usual,) * n_pings)
        assert choice.plan.met
        ping = simulator.ping(np.eye(4))
        assert is_checked or ping.error_estimate > sampler.tolerance
        assert bool(calls) == is_checked and sampler.choice.is_due == (not is_checked)
        assert sampler.choice.level == choice.level and sampler.choice.coverage == choice.coverage

    @pytest.mark.parametrize(("times_more", "is_expected"), [(1, True), (1.01, True), (30, False)])
    def test_faces_that_come_into_view_cost_time(self, simulator, times_more, is_expected):
        """A floor of many small faces costs more than its samples. Those of the ball and the floor are drawn."""
        coverage = simulator.run.sampler.choice.coverage
        assert 0 < coverage.n_faces <= sum(len(one.mesh.faces) for one in ball_and_floor().bodies)
        more = coverage._replace(n_faces=round(times_more * coverage.n_faces))
        assert simulator.run.sampler.costs_as_expected(more) == is_expected

    @pytest.mark.parametrize(("share", "is_made_again"), [(0.8, True), (0.95, False), (1.0, False)])
    def test_a_ping_made_ahead_that_costs_other_than_expected_is_made_again(
        self, simulator, share, is_made_again
    ):
        """As a single ping, it changes what the next ones may cost."""
        run = simulator.run
        setup = run.set_up(PingRequest(np.eye(4)))
        with run.drawing():
            (drawn,) = pipeline.draw(None, [setup], run.resolution_ahead)
            received = pipeline.receive(drawn)
            received = replace(received, coverage=times(share, received.coverage))
            assert run.review_ahead(received, run.sampler.choice) == is_made_again

    @pytest.mark.slow
    def test_memory_is_given_back_once_many_pings_had_far_fewer_samples(self, simulator, monkeypatch):
        """A sonar that turns to and fro would take it anew each time, which takes longer than its samples."""
        dropped = []
        sampler = simulator.run.sampler
        monkeypatch.setattr(StageCache, "drop_large", lambda _: dropped.append(1))
        for level in (12, 11, 2):  # some fewer are not far fewer
            sampler.choice = replace(sampler.choice, level=level, is_due=False)
            for number in range(KEPT_VIEWS):
                assert not dropped, number
                simulator.ping(np.eye(4))
        assert len(dropped) == 1

    def test_memory_is_given_back_by_a_ping_without_a_check(self, simulator, monkeypatch):
        """With one it takes longer already."""
        dropped, stages = [], simulator.run.stages
        monkeypatch.setattr(StageCache, "drop_large", lambda _: dropped.append(1))
        stages.settle(10**7)
        for _ in range(KEPT_VIEWS + 1):
            stages.settle(1000, may_drop=False)
        assert not dropped
        settled = []
        monkeypatch.setattr(StageCache, "settle", lambda _, n, may_drop: settled.append(may_drop))
        sampler = simulator.run.sampler
        sampler.choice = replace(sampler.choice, is_due=True)
        sampler.history = sampler.history._replace(costs=(1e12,) * 20)
        for _ in range(3):  # two of which share a check
            simulator.ping(np.eye(4))
        assert settled == [False, False, True]

    def test_the_next_pings_follow_one_whose_samples_were_chosen_alone(self, monkeypatch):
        """With its costs alone, and no finer samples than fit there; not where its request asked for that."""
        monkeypatch.setattr(adaptive, "RECENT", 5)
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            simulator.ping(np.eye(4))
            run, plan = simulator.run, simulator.run.sampler.plan
            sampler, unmet, half = run.sampler, replace(plan, level=5, met=False), Coverage(0.5, 1000)
            for _ in range(10):
                simulator.ping(np.eye(4))
            history = sampler.history
            assert history.n_pings == 11 and len(history.costs) == 5
            setup = run.set_up(PingRequest(np.eye(4)))
            before = sampler.choice
            sampler.follow(
                run.set_up(PingRequest(np.eye(4), alone=True)), plan, 7.0, half, history.n_pings + 1
            )
            assert (sampler.choice, sampler.history) == (before, history)
            ended = sampler.history_with_apart(setup)
            assert (ended.n_pings, ended.last, ended.costs) == (history.n_pings + 1, setup, ())
            assert not sampler.is_check_due(sampler.history_with(setup))
            sampler.history = ended  # the next one is checked, in whatever place
            assert sampler.is_check_due(sampler.history_with(setup))
            sampler.history = history
            sampler.follow(setup, plan, 7.0, half, history.n_pings - 1)  # later ones were added meanwhile
            assert sampler.history is history
            assert (sampler.choice.level, sampler.choice.finest) == (plan.level, FINEST_LEVEL)
            assert (sampler.choice.last_check, sampler.choice.coverage) == (
                (setup, 7.0, history.n_pings - 1),
                half,
            )
            for n_pings in (history.n_pings, history.n_pings + 3):
                with (
                    contextlib.nullcontext() if n_pings > history.n_pings else pytest.warns(ToleranceWarning)
                ):
                    sampler.follow(setup, unmet, 7.0, half, n_pings)
                assert sampler.history == (n_pings, setup, (cost_of(plan.n_samples, half),))
                assert (sampler.choice.level, sampler.choice.finest) == (5, 5)

    def test_no_ping_tries_what_did_not_fit_in_the_first(self, monkeypatch):
        find = LevelSearch.find_coarsest
        monkeypatch.setattr(LevelSearch, "find_coarsest", lambda *of: find(*of)._replace(finest=9))
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            simulator.ping(np.eye(4))
            assert simulator.run.sampler.choice.finest == 9

    def test_samples_that_do_not_fit_have_the_next_coarser_level_checked(self, simulator):
        """Down to the coarsest; planned ones stay."""
        error = SampleLimitError("too many")
        sampler = simulator.run.sampler
        sampler.choice = replace(sampler.choice, is_due=True)
        sampler.history = sampler.history._replace(costs=(1e12,) * 20)
        simulator.ping(np.eye(4))
        assert sampler.choice.begun is not None and sampler.is_deciding(sampler.history)
        sampler.choice = replace(sampler.choice, level=1)
        with simulator.run.drawing():
            resolution = sampler.fewer_samples(error)
        assert sampler.choice.begun is None  # a check of finer samples
        assert resolution.check and resolution.stage.sampling == sampling_at(SONAR, 0)
        assert (sampler.choice.level, sampler.choice.finest, sampler.choice.is_due) == (0, 0, True)
        assert not sampler.plan.met and sampler.plan.bound > sampler.tolerance  # it was of finer samples
        with pytest.raises(SampleLimitError):
            sampler.fewer_samples(error)
        plan = simulator.plan([np.eye(4)])
        before, history = sampler.choice, sampler.history
        assert before.is_planned and plan.level > 0 and before.finest == FINEST_LEVEL
        with pytest.raises(SampleLimitError):
            sampler.fewer_samples(error)
        simulator.ping(sg.pose(5, yaw=2.0))  # far, and not in the history
        assert sampler.choice is before and sampler.history is history

    def test_an_interrupted_choice_is_made_anew(self, monkeypatch):
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            expected = simulator.ping(np.eye(4)).intensity
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            count, calls = error_model.count_bodies, []

            def broken_off(*arguments):
                calls.append(1)
                if len(calls) == 3:
                    raise KeyboardInterrupt
                return count(*arguments)

            monkeypatch.setattr(error_model, "count_bodies", broken_off)
            with pytest.raises(KeyboardInterrupt):
                simulator.ping(np.eye(4))
            monkeypatch.setattr(error_model, "count_bodies", count)
            ping = simulator.ping(np.eye(4))
        assert ping.error_estimate <= 0.01
        np.testing.assert_array_equal(ping.intensity, expected)

    def test_a_large_step_or_turn_is_estimated_at_once(self, monkeypatch):
        poses = [sg.pose(), sg.pose(), sg.pose(3), sg.pose(3), sg.pose(3, yaw=1.0), sg.pose(3, yaw=1.0)]
        estimates = self.estimates(poses, monkeypatch)
        assert [estimated for estimated, _ in estimates] == [True, False, True, False, True, False]

    @pytest.mark.parametrize(
        "first, second",
        [
            pytest.param(sg.pose(x=-12.6), sg.pose(x=-11.8), marks=pytest.mark.slow),
            (sg.pose(yaw=0.5), sg.pose(yaw=0.35)),
        ],
        ids=["ahead", "yaw"],
    )
    def test_a_body_that_comes_into_view_is_estimated_after_any_motion(self, first, second):
        """The plan of the first ping, which sees nothing, is not used for the second."""
        scene = sg.Scene([ball(x=8.0, radius=0.3)])
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.02) as simulator:
            with pytest.warns(UserWarning, match="no echo came back"):
                simulator.ping(first)
            ping = simulator.ping(second)
        truth = sg.reference_ping(scene, SONAR, second, IDEAL, error=0.05)
        assert truth.intensity.any()
        assert ping.error_estimate > 0 and ping_error(ping, truth) < 0.02

    @pytest.mark.parametrize("n_before", [0, adaptive.LOOP_PINGS - 2, adaptive.LOOP_PINGS])
    def test_the_first_echo_is_sampled_for_the_tolerance_but_in_a_loop(self, n_before, monkeypatch):
        """In a loop that had echoes before, where side lobes met a wall, the search took a hundred medians."""
        with sg.Simulator(sg.Scene([ball(x=8.0, radius=0.3)]), SONAR, IDEAL, tolerance=0.02) as simulator:
            with pytest.warns(UserWarning, match="no echo came back"):
                simulator.ping(sg.pose(x=-12.6))
            sampler, n_drawn, draw = simulator.run.sampler, [], Stage.draw
            before, costs = sampler.choice.level, sampler.history.costs
            sampler.history = sampler.history._replace(costs=costs[:1] * n_before or costs)
            monkeypatch.setattr(Stage, "draw", lambda *of, **more: n_drawn.append(1) or draw(*of, **more))
            estimate = simulator.ping(sg.pose(x=-11.8)).error_estimate
            sampled = sampler.choice.next_level or sampler.choice.level
            assert sampled > before
            if n_before < adaptive.LOOP_PINGS:
                assert 0 < estimate <= 0.02 and sampler.plan.met
            else:
                assert estimate > 0.02 and not sampler.plan.met and len(n_drawn) == 2

    def test_pings_after_one_with_echo_are_not_explained_in_detail(self, monkeypatch):
        """In a live loop; each took up to a second with a floor of a million triangles."""
        explained = []
        monkeypatch.setattr(run_module, "why_no_echo", lambda *_: explained.append(1) or "no echo: far")
        scene, away = sg.Scene([ball(x=8.0)]), sg.pose(yaw=0.6)
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.1) as simulator:
            simulator.ping(sg.pose(yaw=0.5))
            with collected_warnings(NoEchoWarning) as found:
                for yaw in (0.6, 0.61, 0.62):
                    simulator.ping(sg.pose(yaw=yaw))
            assert [one.text for one in found] == [ECHO_LOST] and not explained
            simulator.run.silent_pings.start_again()  # as before each frame of a page
            with pytest.warns(NoEchoWarning, match="far"):
                simulator.ping(sg.pose(yaw=0.62))
            with pytest.warns(NoEchoWarning, match="far"):
                simulator.ping(sg.pose(yaw=3.0))  # far from the last one
            simulator.plan([away])
            with pytest.warns(NoEchoWarning, match="far"):
                simulator.ping(away)

    def test_pings_without_echo_do_not_count_among_those_that_cost_as_much(self):
        """A finer level would soon be checked, by a ping that costs several times those before the pause."""
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL, tolerance=0.05) as simulator:
            simulator.ping(np.eye(4))
            simulator.ping(np.eye(4))
            sampler = simulator.run.sampler
            costs, setup = sampler.history.costs, sampler.history.last
            sampler.choice = replace(sampler.choice, last_check=sampler.choice.last_check._replace(total=0.0))
            assert sampler.history_with(setup).costs == costs

    def test_the_first_echo_of_all_is_drawn_once_where_its_samples_keep_the_tolerance(self, monkeypatch):
        n_drawn, draw, judge = [], Stage.draw, error_model.ErrorModel.judge
        with sg.Simulator(sg.Scene([ball()]), SONAR, IDEAL) as simulator:
            with pytest.warns(UserWarning, match="no echo came back"):
                simulator.ping(sg.pose(x=-13.0))
            monkeypatch.setattr(Stage, "draw", lambda *args, **more: n_drawn.append(1) or draw(*args, **more))
            monkeypatch.setattr(error_model.ErrorModel, "judge", lambda *args: judge(*args)._replace(steps=0))
            assert simulator.ping(sg.pose(x=-12.4)).intensity.any()
        assert len(n_drawn) == 2  # and with fewer samples, to compare it with

    @pytest.mark.parametrize("n_before", [1, 2, 3])
    def test_a_ping_far_from_the_last_one_is_the_same_after_any_others(self, n_before):
        """Its samples are chosen from it alone, as those of batches are."""
        poses = [sg.pose(0.2, yaw=0.1), sg.pose(3.0, yaw=2.0), sg.pose(-2.0, z=1.0, yaw=-1.0)][:n_before]
        far = sg.pose(1.0, -3.0, yaw=0.4)
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            alone = make_alone(simulator, far)
        with sg.Simulator(ball_and_floor(), SONAR, IDEAL) as simulator:
            *_, ping = [simulator.ping(pose) for pose in [*poses, far]]
            *_, again = simulator.pings([*poses, far])
        assert alone.intensity.any() and ping.error_estimate == alone.error_estimate <= 0.01
        for one in (ping, again):
            np.testing.assert_array_equal(one.intensity, alone.intensity)
            assert one.meta["sampling"] == alone.meta["sampling"]

    @pytest.mark.slow
    def test_a_far_ping_that_is_interrupted_was_never_asked_for(self):
        """A ping near the one before it follows that one, and has not the samples and the error of the far one."""
        of_rods, of_wall, near = sg.pose(yaw=math.pi), sg.pose(), sg.pose(0.01, yaw=math.pi)

        def result_of(*poses, at=None):
            with sg.Simulator(WALL_AND_RODS, SONAR, IDEAL, tolerance=0.02) as simulator:
                simulator.ping(of_rods)
                for pose in poses:
                    with contextlib.suppress(KeyboardInterrupt), Interrupter(at) as interrupter:
                        simulator.ping(pose)
                ping = simulator.ping(near)
            return (ping.intensity.tobytes(), ping.error_estimate), interrupter.places if poses else []

        never, _ = result_of()
        come_out, places = result_of(of_wall)
        assert never != come_out
        files = [f"engine/{name}.py" for name in ("adaptive", "level_search", "replan_trigger")]
        places = [place for place in dict.fromkeys(places) if place[0] in files]
        results = [result_of(of_wall, at=place)[0] for place in places]
        assert len(places) > 30 and set(results) == {never}

    @pytest.mark.parametrize("why", [KeyboardInterrupt, MemoryError])
    def test_pings_after_one_that_failed_are_those_without_it(self, why, monkeypatch):
        """It counted among those between two checks of the error, so that the next check came a ping too early."""
        poses = [sg.pose(0.002 * k) for k in range(CHECK_EVERY + 2)]

        def pings(fails_at=None):
            with sg.Simulator(ball_and_floor(), SONAR, IDEAL, tolerance=0.05, engine="cpu") as simulator:
                for number, pose in enumerate(poses):
                    if number == fails_at:
                        with monkeypatch.context() as patched, pytest.raises(why):
                            patched.setattr(pipeline, "receive", raising)
                            simulator.ping(pose)
                    yield simulator.ping(pose)

        def raising(_):
            raise why

        for one, other in zip(pings(), pings(fails_at=9), strict=True):
            np.testing.assert_array_equal(one.intensity, other.intensity)
            assert one.error_estimate == other.error_estimate

    def test_multipath_of_a_ping_far_from_the_last_one_is_the_same_after_any_others(self):
        """Image sources are sampled by the ping alone, too: a strong reflector before would have them finer."""
        floor = sg.Body("floor", trimesh.creation.box((80, 80, 1)), sg.pose(0, 0, -3.5))
        scene = sg.Scene([ball(4.0, 0.3), floor], surface_z_m=1.0)
        away, strong, far = sg.pose(pitch=0.3, yaw=-3.0), sg.pose(-6.0, yaw=0.05), sg.pose(-6.0, yaw=0.4)
        acoustics, pings = replace(IDEAL, multipath="incoherent"), []
        for before in (away, strong):
            with sg.Simulator(scene, SONAR, acoustics, tolerance=0.1) as simulator:
                simulator.ping(before)
                halvings = simulator.run.image_sampling.choice.halvings
                pings.append((halvings, simulator.ping(far), simulator.run.image_sampling.choice.halvings))
        (first, one, n_one), (second, other, n_other) = pings
        assert first == COARSEST > n_one == n_other > second
        np.testing.assert_array_equal(one.intensity, other.intensity)
        assert one.error_estimate == other.error_estimate

    def test_a_ping_with_bodies_of_a_quite_other_reflectivity_is_the_same_after_any_others(self):
        """As in training data: such pings followed the samples of the ones before."""
        looks = [{"ball": ball, "floor": floor} for ball, floor in ((0.01, 0.9), (0.9, 0.01), (0.05, 0.6))]
        runs = []
        for order in (0, 1, 2), (0, 2, 1):
            with sg.Simulator(ball_and_floor(), SONAR, IDEAL, tolerance=0.02) as simulator:
                simulator.ping(np.eye(4))
                found = {k: simulator.ping(np.eye(4), reflectivity=looks[k]) for k in order}
            runs.append([found[k] for k in range(3)])
        for one, other in zip(*runs, strict=True):
            assert 0 < one.error_estimate <= 0.02
            np.testing.assert_array_equal(one.intensity, other.intensity)

    def test_a_far_ping_whose_image_sources_do_not_fit_has_coarser_samples(self, monkeypatch):
        """As one near the ping before has: an error ended it, and the next try of the same ping came out."""
        floor = sg.Body("floor", trimesh.creation.box((80, 80, 1)), sg.pose(0, 0, -3.5))
        scene, acoustics = sg.Scene([ball(4.0, 0.3), floor]), replace(IDEAL, multipath="incoherent")
        real, refused = ImageSources.draw, []

        def draw(sources, stage, *args, **more):
            if stage.sampling.rows > 60:
                refused.append(stage.sampling.rows)
                raise SampleLimitError("too many")
            return real(sources, stage, *args, **more)

        with sg.Simulator(scene, SONAR, acoustics, tolerance=0.014) as simulator:
            simulator.ping(sg.pose(yaw=2.0))
            monkeypatch.setattr(ImageSources, "draw", draw)
            with pytest.warns(ToleranceWarning):
                ping = simulator.ping(sg.pose(-2.0))
        assert refused and ping.meta["sampling"]["rows"] <= 60
        assert ping.intensity.any() and ping.error_estimate > 0.014

    def test_samples_get_finer_and_coarser_again(self):
        """The sonar turns from a wall to a row of rods and back."""
        with sg.Simulator(WALL_AND_RODS, SONAR, IDEAL) as simulator:
            levels = []
            for yaw in (0, math.pi, 0):
                # the first choice after a turn may be too fine, which a check after CHECK_EVERY pings finds
                for k in range(CHECK_EVERY + 6):
                    simulator.ping(sg.pose(y=1e-3 * k, yaw=yaw))
                levels.append(level_of(simulator))
        assert levels[0] == levels[2] == 0 and levels[1] > 8


class TestPlan:
    def test_an_unreachable_tolerance_warns_and_uses_the_finest_level(self, monkeypatch):
        monkeypatch.setattr("sonar_gl.engine.level_search.FINEST_LEVEL", 6)
        scene = sg.Scene([ball(x=10, radius=0.5)])
        with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.001) as simulator:
            with pytest.warns(ToleranceWarning, match="^tolerance 0.001 cannot be met here: ") as caught:
                ping = simulator.ping(np.eye(4))
            assert "worst body ('ball'); go nearer" in str(caught[0].message)
            columns = round(ping.meta["sampling"]["columns_per_beam"] * SONAR.n_beams)
            assert f"fit, {columns} x {ping.meta['sampling']['rows']}, the" in str(caught[0].message)
            assert level_of(simulator) == 6 and ping.error_estimate > 0.001
            assert not simulator.run.sampler.plan.met
            with warnings.catch_warnings():  # the warning comes once
                warnings.simplefilter("error")
                simulator.ping(sg.pose(2.5))

    @pytest.mark.parametrize("specular", [True, False])
    def test_the_warning_names_the_cure_of_a_body_with_a_glint(self, monkeypatch, specular):
        monkeypatch.setattr("sonar_gl.engine.level_search.FINEST_LEVEL", 6)
        scene = sg.Scene([ball(x=10, radius=0.1, reflectivity="steel")])
        warns = pytest.warns(ToleranceWarning, match="worst body [(]'ball'[)]; go nearer")
        acoustics = replace(IDEAL, specular=specular)
        with sg.Simulator(scene, SONAR, acoustics, tolerance=0.001) as simulator, warns as caught:
            simulator.ping(np.eye(4))
        ends = ", or ask for a larger tolerance" + ", or give that body a rough material" * specular
        assert str(caught[0].message).endswith(ends)

    def test_an_unreachable_tolerance_is_warned_of_again_once_it_was_met(self, monkeypatch):
        monkeypatch.setattr("sonar_gl.engine.run.MAX_CHOSEN_SAMPLES", 20_000)
        wall, rods = sg.pose(), sg.pose(yaw=math.pi)
        with collected_warnings(ToleranceWarning) as found, sg.Simulator(WALL_AND_RODS, SONAR, IDEAL) as it:
            for pose in (rods, rods, wall, rods):
                it.ping(pose)
        assert len(found) == 2

    def test_an_estimate_just_above_the_tolerance_reads_so(self, monkeypatch):
        """It read "tolerance 0.02 cannot be met: the estimate is 0.02"."""
        monkeypatch.setattr("sonar_gl.engine.level_search.FINEST_LEVEL", 6)
        scene = sg.Scene([ball(x=10, radius=0.5)])
        tolerance = 0.001
        for _ in range(2):
            with sg.Simulator(scene, SONAR, IDEAL, tolerance=tolerance) as simulator:
                with pytest.warns(ToleranceWarning) as caught:
                    simulator.ping(np.eye(4))
                estimate = simulator.run.sampler.plan.error_estimate
            text = re.search(r"the estimate is ([\d.e-]+), and", str(caught[0].message))[1]
            assert tolerance < float(text) == pytest.approx(estimate, rel=0.005)
            tolerance = estimate / 1.0002

    def test_a_warning_that_is_an_error_comes_of_each_ping_and_plan_and_changes_no_other(self, monkeypatch):
        """The second try gave a ping, or a plan, that does not keep the tolerance, without a word."""
        monkeypatch.setattr("sonar_gl.engine.run.MAX_CHOSEN_SAMPLES", 20_000)
        good, bad, near = sg.pose(), sg.pose(yaw=math.pi), sg.pose(0.01)
        with sg.Simulator(WALL_AND_RODS, SONAR, IDEAL) as simulator:
            expected = [simulator.ping(pose) for pose in (good, near)]
        with sg.Simulator(WALL_AND_RODS, SONAR, IDEAL) as simulator, warnings.catch_warnings():
            warnings.simplefilter("error", ToleranceWarning)
            calls = [lambda: simulator.ping(bad)] * 2 + [lambda: simulator.plan([good, bad])] * 2
            for call in calls:  # before any ping
                with pytest.raises(ToleranceWarning):
                    call()
            pings = [simulator.ping(good)]
            for call in calls:
                with pytest.raises(ToleranceWarning):
                    call()
            pings.append(simulator.ping(near))
        for one, other in zip(pings, expected, strict=True):
            np.testing.assert_array_equal(one.intensity, other.intensity)
            assert one.error_estimate == other.error_estimate <= 0.01


@pytest.mark.parametrize("sampling", [None, sg.Sampling(1, 20)])  # with samples, too: multipath keeps it
@pytest.mark.parametrize("tolerance", [0.0, 0.9, float("nan"), "fine", None, True])
def test_invalid_tolerances_raise_errors(tolerance, sampling):
    message = error_of(sg.Simulator, sg.Scene([]), SONAR, sampling=sampling, tolerance=tolerance)
    assert message == f"tolerance must be a number in 0.001..0.5 (got {tolerance!r}; 0.01 is one per cent)"


def test_reflectivity_that_is_the_bodies_own_asks_for_no_check(monkeypatch):
    """Given in every other ping it did so in nearly all."""
    checks, judge = [], error_model.ErrorModel.judge
    monkeypatch.setattr(
        error_model.ErrorModel, "judge", lambda self, *of: checks.append(of) or judge(self, *of)
    )
    body = sg.Body("b", trimesh.creation.box((1, 2, 2)), sg.pose(6), 0.5)
    with sg.Simulator(sg.Scene([body]), SONAR, IDEAL) as simulator:
        simulator.ping(sg.pose())
        checks.clear()
        for k in range(20):
            simulator.ping(sg.pose(), reflectivity={"b": 0.5} if k % 2 else None)
    assert checks == []
