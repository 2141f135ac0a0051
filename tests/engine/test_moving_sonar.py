"""A sonar that moves: no ping costs much more than those before it, and each says what its error may be."""

import math
from itertools import pairwise
from statistics import median

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.engine import adaptive
from sonar_gl.engine.adaptive import AdaptiveSampling
from sonar_gl.engine.error_model import ErrorModel
from sonar_gl.engine.stage import WHOLE, Stage, StageCache
from sonar_gl.raster.views import MAX_CHOSEN_SAMPLES
from sonar_gl.sonar.sampling import ToleranceWarning
from tests.support.wall_and_rods import row_of_rods, wall

SONAR = sg.Sonar("moving", 900e3, 64, 200, 45.0, 20.0, 1.0, 0.5, 20.0)
IDEAL = sg.Acoustics.ideal()
TOLERANCE = 0.018
N = 240
FLOOR = sg.Body("floor", trimesh.creation.box((80, 80, 1)), sg.pose(0, 0, -2.5), 0.2)
SCENE = sg.Scene([wall(), FLOOR, *row_of_rods()])
BALL = sg.Scene([sg.Body("ball", trimesh.creation.icosphere(4, 0.3), sg.pose(9))])
APPROACH = [sg.pose(0.4 * k) for k in range(18)]


def poses(n=N):
    """Turn once round in `n` pings: the wall, the rods, the wall."""
    return [sg.pose(yaw=2 * math.pi * k / n) for k in range(n)]


def record_costs(monkeypatch):
    """Return a list to which the cost of each drawing is appended, in samples."""
    costs, draw = [], Stage.draw

    def counted(stage, *arguments, **more):
        costs.append(adaptive.cost_of(SONAR, IDEAL, stage.fan.n_samples, WHOLE))
        return draw(stage, *arguments, **more)

    monkeypatch.setattr(Stage, "draw", counted)
    return costs


def swim(monkeypatch):
    """Return the cost, the error estimate and the rows of each ping."""
    out, costs = [], record_costs(monkeypatch)
    with sg.Simulator(SCENE, SONAR, IDEAL, tolerance=TOLERANCE) as simulator:
        for pose in (*poses(), *[np.eye(4)] * 60):  # and stay
            costs.clear()
            ping = simulator.ping(pose)
            out.append((sum(costs), ping.error_estimate, ping.meta["sampling"]["rows"]))
    return [np.array(column) for column in zip(*out, strict=True)]


def worst_of(costs):
    """Return the most that a ping but the first costs, over the median of up to a hundred before it."""
    return max(costs[k] / median(costs[max(0, k - 100) : k]) for k in range(1, len(costs)))


@pytest.mark.slow
def test_no_ping_costs_three_times_the_median_of_the_last_hundred(monkeypatch):
    costs, estimates, rows = swim(monkeypatch)
    assert rows.max() > 1.9 * rows.min()
    assert worst_of(costs[1:]) < 3  # the first one is searched
    # in both views the samples suffice in the end, and until they do the estimate says so
    assert estimates[0] <= TOLERANCE and estimates[-1] <= TOLERANCE
    assert (estimates > TOLERANCE).any() and (estimates[rows == rows.max()] <= TOLERANCE).any()


def away_and_back(k):
    """Turn from the wall to where nothing is, stay, and turn back."""
    return sg.pose(yaw=math.radians(3 * (min(max(k - 40, 0), 30) - min(max(k - 130, 0), 30)))), None


def through_the_wall(k):
    """Drive on into the wall, whose side lobes alone are seen in the end, and through it."""
    return sg.pose(0.05 * k), None


def without_wall(k):
    """Stay where the wall vanishes and comes back."""
    return sg.pose(0.001 * k), {"wall": None} if k % 60 >= 30 else None


@pytest.mark.parametrize(
    "loop",
    [
        through_the_wall,
        *(pytest.param(one, marks=pytest.mark.slow) for one in (away_and_back, without_wall)),
    ],
)
@pytest.mark.filterwarnings("ignore::sonar_gl.sonar.sampling.ToleranceWarning", "ignore:no echo came back")
def test_an_echo_that_comes_back_costs_no_more(monkeypatch, loop):
    """It was searched for its samples in one ping, or they were chosen from that ping alone."""
    in_water = sg.Scene([wall(), *row_of_rods()[-3:]])
    spent, costs, totals = [], record_costs(monkeypatch), []
    with sg.Simulator(in_water, SONAR, IDEAL, tolerance=TOLERANCE) as simulator:
        for k in range(200):
            pose, bodies = loop(k)
            costs.clear()
            totals.append(simulator.ping(pose, bodies=bodies).intensity.sum())
            spent.append(sum(costs))
    assert max(totals[100:]) > 0
    assert worst_of(spent[1:]) < 3  # the first one is searched


@pytest.mark.slow
def test_without_that_limit_single_pings_stall(monkeypatch):
    for name in ("MOST_COST", "MOST_FULL_COST"):
        monkeypatch.setattr(adaptive, name, math.inf)
    assert worst_of(swim(monkeypatch)[0][1:]) > 5


def test_pings_that_wait_for_a_check_have_made_what_it_needs(monkeypatch):
    """The weights of its coarser samples take about a ping; with the check itself it would be too much for one ping."""
    made, checks = [], []
    make, begun = StageCache.make, ErrorModel.begun

    def noted(stages, *arguments):
        made.append(0)
        return make(stages, *arguments)

    def checked(*arguments, **more):
        before = len(made)
        out = begun(*arguments, **more)
        checks.append(len(made) - before)
        return out

    monkeypatch.setattr(StageCache, "make", noted)
    monkeypatch.setattr(ErrorModel, "begun", checked)
    n_waiting, n_late_checks = 0, 0
    with sg.Simulator(SCENE, SONAR, IDEAL, tolerance=TOLERANCE) as simulator:
        simulator.ping(np.eye(4))
        for pose in poses():
            checks.clear()
            level = simulator.run.sampler.choice.level
            simulator.ping(pose)
            if checks and n_waiting >= 2:
                assert checks == [0]
                n_late_checks += 1
            choice = simulator.run.sampler.choice
            waits = not checks and choice.is_due and choice.level == level
            n_waiting = n_waiting + 1 if waits else 0
    assert n_late_checks > 0


@pytest.mark.slow
def test_no_ping_makes_two_stages_and_none_that_is_checked_makes_any(monkeypatch):
    """Each takes as long as a ping where samples are fine. The check that asked for them made one, or the ping after it
    both.
    """
    made, make = [], StageCache.make
    monkeypatch.setattr(StageCache, "make", lambda *arguments: made.append(0) or make(*arguments))
    checks, begun = [], ErrorModel.begun
    monkeypatch.setattr(
        ErrorModel, "begun", lambda *arguments, **more: checks.append(0) or begun(*arguments, **more)
    )
    counts = []
    with sg.Simulator(SCENE, SONAR, IDEAL, tolerance=TOLERANCE) as simulator:
        simulator.ping(np.eye(4))  # searched
        for pose in poses():
            made.clear()
            checks.clear()
            simulator.ping(pose)
            counts.append((len(made), len(checks)))
    assert max(n for n, is_checked in counts) == 1
    assert max(n for n, is_checked in counts if is_checked) == 0


@pytest.mark.slow
def test_an_estimate_is_of_the_samples_of_the_ping_or_of_coarser_ones_and_then_above_the_tolerance():
    """Finer samples may wait for their check; the first ping with coarser ones is checked, since it costs less."""
    n_finer, rows = 0, []
    with sg.Simulator(SCENE, SONAR, IDEAL, tolerance=TOLERANCE) as simulator:
        for pose in poses():
            ping, plan = simulator.ping(pose), simulator.run.sampler.plan
            rows.append(ping.meta["sampling"]["rows"])
            if rows[-1] == plan.sampling.rows:
                assert (ping.error_estimate <= TOLERANCE) == plan.met
            else:
                assert rows[-1] > plan.sampling.rows and ping.error_estimate > TOLERANCE
                n_finer += 1
    assert 0 < n_finer < len(rows)
    assert any(after < before for before, after in pairwise(rows))


@pytest.mark.slow
@pytest.mark.parametrize("labels", [pytest.param(False, marks=pytest.mark.slow), True])
def test_sequences_are_the_pings_of_single_calls_to_the_bit(labels):
    """Pings that were started before a check changed the samples are made again."""
    with sg.Simulator(SCENE, SONAR, IDEAL, tolerance=TOLERANCE) as simulator:
        single = [simulator.ping(pose, labels=labels) for pose in poses(80)]
    with sg.Simulator(SCENE, SONAR, IDEAL, tolerance=TOLERANCE) as simulator:
        together = list(simulator.pings(poses(80), labels=labels))
    assert len({tuple(ping.meta["sampling"].values()) for ping in single}) > 3
    for one, other in zip(together, single, strict=True):
        assert (one.error_estimate, one.meta["sampling"]) == (other.error_estimate, other.meta["sampling"])
        np.testing.assert_array_equal(one.intensity, other.intensity)
        np.testing.assert_array_equal(one.body_id, other.body_id)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sonar_gl.sonar.sampling.ToleranceWarning", "ignore:no echo came back")
def test_sequences_in_which_bodies_come_and_go_are_single_calls_to_the_bit(monkeypatch):
    """Pings whose samples turned out to be too dear are made again with fewer."""
    affordable, n_fewer = AdaptiveSampling.affordable, []

    def counted(sampler, drawn):
        found = affordable(sampler, drawn)
        n_fewer.append(found.stage is not drawn.resolution.stage)
        return found

    monkeypatch.setattr(AdaptiveSampling, "affordable", counted)
    small = sg.Body("small", trimesh.creation.icosphere(3, 0.15), sg.pose(6, 1.5, 0.5))
    scene = sg.Scene([wall(), small])
    loop = [(sg.pose(0.001 * k), {"wall": None} if k < 40 else None) for k in range(60)]
    settings = {"acoustics": IDEAL, "tolerance": 0.01}
    with sg.Simulator(scene, SONAR, **settings) as simulator:
        single = [simulator.ping(pose, bodies=bodies) for pose, bodies in loop]
    assert sum(n_fewer) > 0
    with sg.Simulator(scene, SONAR, **settings) as simulator:
        together = list(simulator.pings([pose for pose, _ in loop], bodies=[bodies for _, bodies in loop]))
    for one, other in zip(together, single, strict=True):
        assert (one.error_estimate, one.meta["sampling"]) == (other.error_estimate, other.meta["sampling"])
        np.testing.assert_array_equal(one.intensity, other.intensity)


@pytest.mark.slow
@pytest.mark.parametrize(("way", "engine"), [("ping", "cpu"), ("pings", "cpu"), ("pings", "opengl")])
def test_samples_get_coarser_where_more_do_not_fit(monkeypatch, way, engine):
    """A ball fills more and more of a window of samples as the sonar comes near.

    Of a sequence, threads find that there are too many, or by OpenGL the caller, who draws.
    """
    monkeypatch.setattr("sonar_gl.engine.sequence.FEW_SAMPLES", 0)  # else the caller makes them all
    monkeypatch.setattr("sonar_gl.engine.sequence.n_threads", lambda: 2)
    rows = []
    for most in (MAX_CHOSEN_SAMPLES, 2000):
        monkeypatch.setattr("sonar_gl.engine.run.MAX_CHOSEN_SAMPLES", most)
        with sg.Simulator(BALL, SONAR, IDEAL, tolerance=TOLERANCE, engine=engine) as simulator:
            pings = simulator.pings(APPROACH) if way == "pings" else map(simulator.ping, APPROACH)
            rows.append([ping.meta["sampling"]["rows"] for ping in pings])
    assert any(few < many for many, few in zip(*rows, strict=True))


@pytest.mark.slow
def test_planned_samples_fit_in_all_planned_pings(monkeypatch):
    """Far from a ball many samples fit, and were planned; near it, where it fills the fan, they ended the pings."""
    monkeypatch.setattr("sonar_gl.engine.run.MAX_CHOSEN_SAMPLES", 2000)
    with sg.Simulator(BALL, SONAR, IDEAL, tolerance=TOLERANCE, engine="cpu") as simulator:
        with pytest.warns(ToleranceWarning) as warned:
            plan = simulator.plan(APPROACH)
        pings = [simulator.ping(pose) for pose in APPROACH]
    assert len(warned) == 1 and not plan.met
    assert {ping.meta["sampling"]["rows"] for ping in pings} == {plan.sampling.rows}
    assert {ping.error_estimate for ping in pings} == {plan.bound}


@pytest.mark.parametrize("way", ["ping", "pings"])
def test_planned_samples_that_do_not_fit_at_another_pose_are_an_error_that_names_the_plan(monkeypatch, way):
    monkeypatch.setattr("sonar_gl.engine.run.MAX_CHOSEN_SAMPLES", 2000)
    with sg.Simulator(BALL, SONAR, IDEAL, tolerance=TOLERANCE, engine="cpu") as simulator:
        plan = simulator.plan([sg.pose(0)])
        with pytest.raises(
            SampleLimitError, match=r"planned samples must fit .* no more than 2000 .* plan for this"
        ):
            simulator.ping(sg.pose(8)) if way == "ping" else list(simulator.pings([sg.pose(8)]))
        assert simulator.ping(sg.pose(0)).error_estimate == plan.bound  # it goes on as planned


def test_given_samples_that_do_not_fit_are_an_error(monkeypatch):
    monkeypatch.setattr("sonar_gl.engine.run.MAX_SAMPLES", 600)
    ball = sg.Scene([sg.Body("ball", trimesh.creation.icosphere(4, 0.3), sg.pose(2))])
    with (
        sg.Simulator(ball, SONAR, IDEAL, sg.Sampling(4, 400), engine="cpu") as simulator,
        pytest.raises(SampleLimitError, match="samples with bodies before them must be no more than 600"),
    ):
        simulator.ping(np.eye(4))
