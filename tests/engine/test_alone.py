"""Pings whose samples are chosen from each ping alone: any order gives the same bytes."""

import warnings

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.engine import error_model, level_search, sequence
from sonar_gl.engine import stage as stage_module
from sonar_gl.engine.error_model import ErrorModel, Judgement
from sonar_gl.engine.flow import Plan
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.stage import Stage, StageCache
from sonar_gl.ping import BIN_LABELS
from sonar_gl.sonar.sampling import ToleranceWarning
from tests.support.wall_and_rods import row_of_rods, wall

SONAR = sg.Sonar("alone", 900e3, 64, 200, 45.0, 20.0, 1.0, 0.5, 20.0)
BALL = sg.Body("ball", trimesh.creation.icosphere(3, 0.5), sg.pose(5, 0.5))
ONE_BALL = sg.Scene([sg.Body("ball", trimesh.creation.icosphere(4, 0.3), sg.pose(9))])
SCENE = sg.Scene([wall(), BALL, *row_of_rods()], surface_z_m=3.0)
# of the wall, along it, of the rods, and from aside
POSES = [sg.pose(yaw=yaw) for yaw in (0.0, 1.57, np.pi, 0.4, 2.9)]
MORE = {
    "plain": ({}, {}),
    "labels": ({}, {"labels": True}),
    "shadows": ({}, {"labels": True, "background": ["wall"]}),
    "multipath": ({"acoustics": sg.Acoustics.physical(multipath="incoherent")}, {"labels": True}),
}

ARRAYS = ("intensity", *BIN_LABELS, "body_echo")

pytestmark = pytest.mark.filterwarnings("ignore:no echo came back")


def assert_same(one, other):
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def requests(**more):
    return [PingRequest(pose, alone=True, **more) for pose in POSES]


def fast_kinds(*fast):
    """Return the kinds of MORE, of which those that are not among the fast ones are slow."""
    return [kind if kind in fast else pytest.param(kind, marks=pytest.mark.slow) for kind in MORE]


@pytest.mark.parametrize("kind", fast_kinds("plain", "multipath"))
def test_any_order_and_company_gives_the_same_bytes(kind, monkeypatch):
    """Also those of a sequence; threads may not choose their samples, which have image sources as planned."""
    monkeypatch.setattr(sequence, "FEW_SAMPLES", 0)  # else the caller makes pings as small as these
    monkeypatch.setattr(sequence, "n_threads", lambda: 2)
    settings, more = MORE[kind]
    wanted = requests(**more)
    with sg.Simulator(SCENE, SONAR, tolerance=0.1, **settings) as simulator:
        first = [make_ping(simulator.run, request) for request in wanted]
    with sg.Simulator(SCENE, SONAR, tolerance=0.1, **settings) as simulator:
        simulator.ping(sg.pose(-4, 1))  # another ping, and then a plan
        backward = list(sequence.make_pings(simulator.run, iter(wanted[::-1])))[::-1]
        simulator.plan(POSES[:1])
        planned = [make_ping(simulator.run, wanted[2]), *sequence.make_pings(simulator.run, iter(wanted))]
    for one, other in zip([*first, first[2], *first], [*backward, *planned], strict=True):
        assert_same(one, other)
        assert one.error_estimate == other.error_estimate and one.meta["sampling"] == other.meta["sampling"]


@pytest.mark.parametrize("kind", fast_kinds("multipath"))
def test_the_ping_is_that_of_the_samples_it_states(kind):
    """So a ping of a data set can be made again by its samples; with multipath, by its tolerance, too."""
    settings, more = MORE[kind]
    with sg.Simulator(SCENE, SONAR, tolerance=0.05, **settings) as simulator:
        pings = [make_ping(simulator.run, request) for request in requests(**more)]
    for ping in pings:
        sampling = sg.Sampling(**ping.meta["sampling"])
        with sg.Simulator(SCENE, SONAR, sampling=sampling, tolerance=0.05, **settings) as fixed:
            assert_same(fixed.ping(ping.pose, **more), ping)


def test_a_hard_view_makes_no_other_ping_finer():
    """A wall with a ball takes the first samples that are tried, before and after the rods, which take more."""
    with sg.Simulator(SCENE, SONAR, tolerance=0.01) as simulator:
        of_wall, _, of_rods, *_ = requests()
        rows = [make_ping(simulator.run, one).meta["sampling"]["rows"] for one in (of_wall, of_rods, of_wall)]
    assert rows[0] == rows[2] < rows[1]


def test_each_further_try_is_compared_with_the_one_before(monkeypatch):
    """Views: of the rods some tries, and one coarser than the first; of the wall one, and one coarser."""
    monkeypatch.setattr(level_search, "MOST_STEPS_ALONE", 2)
    count, judge, views, tries = error_model.count_bodies, ErrorModel.judge, [], []
    monkeypatch.setattr(error_model, "count_bodies", lambda *args: views.append(args) or count(*args))
    monkeypatch.setattr(ErrorModel, "judge", lambda *args: tries.append(args) or judge(*args))
    with sg.Simulator(SCENE, SONAR, tolerance=0.008) as simulator:
        counts = []
        for one in (requests()[2], requests()[0]):
            views.clear()
            tries.clear()
            make_ping(simulator.run, one)
            counts.append((len(tries), len(views)))
    (of_rods, views_of_rods), of_wall = counts
    assert of_rods > 2 and views_of_rods == of_rods + 1 and of_wall == (1, 2)


@pytest.mark.parametrize(("sonar", "level"), [("imagenex-deltat", 10), ("p900-45", 3), ("didson-hf", 2)])
def test_each_further_try_has_more_samples(sonar, level, monkeypatch):
    """Columns of whole fractions of a beam let some levels have the same samples, which differ by nothing.

    Where no finer level is left, the last try is compared with a coarser view, as the first one is.
    """
    preset, counts = sg.load_sonar(sonar), []

    def judge(model, setup, level, tried, before=None):
        counts.append([one.stage.sampling.count(preset) for one in (before, tried) if one is not None])
        plan = Plan(tried.stage.sampling, level, 1.0, 1.0, 0, False, tried.stage.fan.n_samples)
        return Judgement(plan, steps=1)

    monkeypatch.setattr(ErrorModel, "judge", judge)
    monkeypatch.setattr(level_search, "level_of", lambda sonar, n_samples: level)
    with sg.Simulator(ONE_BALL, preset, tolerance=0.5) as simulator:
        search = simulator.run.sampler.search
        for search.finest in (level + 5, level + 1):
            counts.clear()
            make_ping(simulator.run, PingRequest(np.eye(4), alone=True))
            if search.finest > level + 1:
                assert len(counts) > 2 and all(more > 1.25 * fewer for fewer, more in counts[1:])
    (first,), (last,) = counts
    assert first == last


def test_further_views_are_drawn_with_the_one_that_is_tried(monkeypatch):
    """Lobes and textures alone, for noise: a view of their own would place and draw all bodies once more."""
    real, states = Stage.draw, []
    monkeypatch.setattr(
        Stage, "draw", lambda stage, *args, **more: states.append(len(args[1])) or real(stage, *args, **more)
    )
    polished = sg.Scene([wall(), sg.Body("plate", trimesh.creation.box((0.02, 1, 1)), sg.pose(5), "steel")])
    with sg.Simulator(polished, SONAR, tolerance=0.1, acoustics=sg.Acoustics.physical()) as simulator:
        make_ping(simulator.run, PingRequest(sg.pose(), alone=True, noise_parts=True))
    assert states == [2, 1]  # with the lobes, and the coarser view beside


def test_a_ping_takes_no_more_than_four_times_the_samples_at_once(monkeypatch):
    """Estimates from few samples led to 45 times as many in a view of `diver`, where 6 times were enough."""
    real, wanted = ErrorModel.judge, []

    def judge(model, setup, level, tried, before=None):
        judgement = real(model, setup, level, tried, before)
        wanted.append((tried.stage.sampling.count(SONAR), judgement.steps))
        return judgement._replace(steps=8) if len(wanted) == 1 else judgement

    monkeypatch.setattr(ErrorModel, "judge", judge)
    with sg.Simulator(SCENE, SONAR, tolerance=0.1) as simulator:
        make_ping(simulator.run, requests()[0])
    (first, _), (second, steps) = wanted
    assert steps <= 0 and second == pytest.approx(4 * first, rel=0.05)  # rows are whole numbers


def test_the_samples_of_a_ping_keep_the_tolerance_or_its_estimate_says_so(monkeypatch):
    with sg.Simulator(SCENE, SONAR, tolerance=0.02) as simulator:
        assert all(make_ping(simulator.run, one).error_estimate <= 0.02 for one in requests())
    monkeypatch.setattr("sonar_gl.engine.level_search.FINEST_LEVEL", 2)
    warns = pytest.warns(ToleranceWarning, match="cannot be met here")
    with sg.Simulator(SCENE, SONAR, tolerance=0.02) as simulator, warns:
        assert make_ping(simulator.run, requests()[2]).error_estimate > 0.02


def test_a_level_that_does_not_fit_takes_the_finest_that_does(monkeypatch):
    real = ErrorModel.draw

    def draw(model, setup, level, **more):
        if level > 9:
            raise SampleLimitError("too many")
        return real(model, setup, level, **more)

    def level_of(order):
        with sg.Simulator(SCENE, SONAR, tolerance=0.005) as simulator:
            return [make_ping(simulator.run, requests()[k]).meta["sampling"]["rows"] for k in order]

    monkeypatch.setattr(ErrorModel, "draw", draw)
    with pytest.warns(ToleranceWarning):
        forward, backward = level_of((0, 2)), level_of((2, 0))
    assert forward == backward[::-1]


@pytest.mark.slow
def test_a_near_view_does_not_limit_the_samples_of_others(monkeypatch):
    """How many samples fit depends on how much of the fan a body fills: a ball at 0.5 m all of it, at 8 m little."""
    monkeypatch.setattr("sonar_gl.engine.run.MAX_CHOSEN_SAMPLES", 20_000)
    near, far = (PingRequest(sg.pose(x), alone=True) for x in (8.2, 1.0))

    def rows_of(*order):
        with sg.Simulator(ONE_BALL, SONAR, tolerance=0.002) as simulator, warnings.catch_warnings():
            warnings.simplefilter("ignore", ToleranceWarning)  # of the near view
            return [make_ping(simulator.run, one).meta["sampling"]["rows"] for one in order]

    assert rows_of(near, far) == rows_of(far, near)[::-1]
    assert rows_of(near) < rows_of(far)


def test_a_choice_that_is_broken_off_leaves_no_limit_of_its_view(monkeypatch):
    """As many samples fit as before it, which pings near the one before may need."""
    monkeypatch.setattr("sonar_gl.engine.run.MAX_CHOSEN_SAMPLES", 20_000)
    real, n_refused = ErrorModel.draw, 0

    def draw(model, *args, **more):
        nonlocal n_refused
        if n_refused:  # the near view has met its limit
            raise KeyboardInterrupt
        try:
            return real(model, *args, **more)
        except SampleLimitError:
            n_refused += 1
            raise

    with sg.Simulator(ONE_BALL, SONAR, tolerance=0.002) as simulator:
        simulator.ping(sg.pose(1.0))
        before = simulator.run.sampler.choice
        monkeypatch.setattr(ErrorModel, "draw", draw)
        with pytest.raises(KeyboardInterrupt):
            simulator.ping(sg.pose(8.2))
        assert n_refused == 1
        assert simulator.run.sampler.choice is before


def test_memory_is_given_back_where_some_pings_in_a_row_need_far_fewer_samples(monkeypatch):
    """Not while others need as many: they would take the time to get it anew."""
    given_back = []
    monkeypatch.setattr(stage_module, "KEPT_VIEWS", 2)
    monkeypatch.setattr(stage_module, "MUCH_FEWER", 2)
    monkeypatch.setattr(StageCache, "drop_large", lambda _: given_back.append(len(n_samples)))
    of_wall, of_rods, n_samples = POSES[0], POSES[2], []
    with sg.Simulator(SCENE, SONAR, tolerance=0.01) as simulator:
        for pose in (of_rods, of_wall, of_rods, of_rods, *[of_wall] * 3, of_rods, of_wall):
            ping = make_ping(simulator.run, PingRequest(pose, alone=True))
            stage = simulator.run.stages.stage(sg.Sampling(**ping.meta["sampling"]))
            n_samples.append(stage.fan.n_samples)
    assert n_samples[0] > 2 * n_samples[1]  # else there is nothing to give back
    assert given_back == [5]  # as the second ping of the wall in a row has been chosen
