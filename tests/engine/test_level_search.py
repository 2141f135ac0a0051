"""The search for the sampling level of a ping, among levels that keep the tolerance, break it, or do not fit."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.engine import level_search
from sonar_gl.engine.error_model import Judgement
from sonar_gl.engine.flow import Plan
from sonar_gl.engine.stage import StageCache
from sonar_gl.sonar.sampling import sampling_at
from tests.support.sampled_scenes import IDEAL, SONAR, ball, level_of
from tests.support.wall_and_rods import row_of_rods, wall

pytestmark = pytest.mark.usefixtures("few_first_rays")

FEW_BEAMS = sg.Sonar("search", 900e3, 16, 40, 45.0, 20.0, 3.0, 0.5, 20.0)
MOST = 20  # levels that there are


class Model:
    """Judges levels as it is told; a level can be looked at in any ping, which is a number here.

    needed : of each ping, the coarsest level that keeps the tolerance
    fits : of each ping, the finest level whose samples fit
    """

    def __init__(self, needed, fits, seed=None):
        self.needed, self.fits, self.tried, self.compared = needed, fits, [], []
        self._random = None if seed is None else np.random.default_rng(seed)

    def draw(self, ping, level, **_more):
        self.tried.append((ping, level))
        if level > self.fits[ping]:
            raise SampleLimitError("too many")
        return SimpleNamespace(
            echo=SimpleNamespace(total=total_of(level)), coverage=1 / (1 + level), level=level
        )

    def judge(self, ping, level, tried, before=None):
        assert tried.level == level
        self.compared.append(before and before.level)
        missing = self.needed[ping] - level
        # a rough estimate knows no more than whether finer samples are needed
        rough = missing
        if self._random is not None:
            rough = self._random.integers(1, 9) if missing > 0 else -self._random.integers(9)
        plan = Plan(sg.Sampling(1, 8), level, 0.01 * (ping + 1), 0.1 / (ping + 1), ping, missing <= 0, level)
        return Judgement(plan, int(rough))

    def sampling_at(self, level):
        return SimpleNamespace(count=lambda sonar: 2 ** (level / 2))

    def stage_at(self, level):
        def draw(poses, states, with_bodies):
            self.draw(states[0], level)

        sector = SimpleNamespace(columns=4000, rows=4000 if level > min(self.fits) else 1)
        return SimpleNamespace(fan=SimpleNamespace(sectors=[sector]), draw=draw)


def total_of(level):
    """The sum of an echo that finer samples see more of."""
    return float(level**2)


@pytest.fixture
def search_with():
    """Return a function of a Model to a LevelSearch that asks it."""
    with sg.Simulator(sg.Scene([]), FEW_BEAMS, sg.Acoustics.ideal()) as simulator:
        search = simulator.run.sampler.search

        def of(model):
            search.model, search.finest = model, MOST
            return search

        yield of


@pytest.mark.parametrize("seed", [None, *range(3)])
def test_the_coarsest_level_that_keeps_the_tolerance_is_found_from_any_other(search_with, seed):
    """However rough estimates are; none is tried twice, and what is returned is of that level."""
    for needed in range(0, MOST + 3, 2):
        for fits in (3, 11, MOST):
            for first in range(0, MOST + 1, 3):
                model = Model([needed], [fits], seed)
                found = search_with(model).find_coarsest(0, first)
                case, level = (needed, fits, first), found.plan.level
                assert len(set(model.tried)) == len(model.tried), case
                assert (found.total, found.coverage) == (total_of(level), 1 / (1 + level)), case
                assert found.plan.met == (level >= needed), case
                refused = [tried for _, tried in model.tried if tried > fits]
                assert found.finest == (min(refused) - 1 if refused else MOST), case
                if needed >= fits:
                    assert level == fits or fits > level == needed, case
                elif seed is None:
                    assert level == needed, case
                    assert len(model.tried) <= 4 + len(refused), case
                else:  # or than the last estimate asked for
                    assert level == needed or model.tried[-1][1] == level > needed, case


def test_memory_of_finer_samples_that_were_tried_is_given_back(search_with, monkeypatch):
    dropped = []
    monkeypatch.setattr(StageCache, "drop_large", lambda _: dropped.append(1))
    search_with(Model([5], [MOST])).find_coarsest(0, 9)
    assert dropped == [1]


def test_the_coarsest_level_may_have_to_fit(search_with):
    for way in ("find_coarsest", "choose"):
        more = {"first": 9} if way == "find_coarsest" else {}
        setup = 0 if way == "find_coarsest" else Setup(0)
        with pytest.raises(SampleLimitError):
            getattr(search_with(Model([2], [-1])), way)(setup, **more)


class Setup(int):
    """A ping that is asked for without labels."""

    request = SimpleNamespace(labels=False)
    head_pose = None

    @property
    def state(self):
        """The number of the ping, as for `Model`."""
        return int(self)


@pytest.mark.parametrize(
    ("needed", "fits", "tried", "compared"),
    [
        (3, MOST, [8], [None]),
        (8, MOST, [8], [None]),
        (10, MOST, [8, 10], [None, 8]),
        (18, MOST, [8, 12, 16, 18], [None, 8, 12, 16]),  # at most 4 levels at once
        (99, MOST, [8, 12, 16, 20], [None, 8, 12, 16]),
        # one that does not fit leaves nothing to compare the next with
        (13, 10, [8, 12, 11, 10], [None, None]),
        (5, 6, [8, 7, 6], [None]),
    ],
)
def test_a_ping_alone_takes_the_first_level_that_keeps_the_tolerance(
    search_with, monkeypatch, needed, fits, tried, compared
):
    monkeypatch.setattr(level_search, "level_of", lambda sonar, n_samples: 8)
    model = Model([needed], [fits])
    with sg.Simulator(sg.Scene([]), FEW_BEAMS, sg.Acoustics.ideal(), tolerance=0.5) as simulator:
        search = simulator.run.sampler.search
        search.model, search.finest = model, MOST
        chosen = search.choose(Setup(0))
    assert [level for _, level in model.tried] == tried
    assert model.compared == compared
    assert chosen.plan.level == chosen.tried.level == tried[-1] and chosen.plan.met == (tried[-1] >= needed)


@pytest.mark.parametrize(
    ("needed", "fits", "level", "of", "met"),
    [
        ([2, 9, 5], [MOST] * 3, 9, [1], True),
        ([9, 5, 9], [MOST] * 3, 9, [0, 2], True),
        # the finest is coarser where it does not fit in a ping that needs fewer
        ([2, 9, 5], [MOST, MOST, 7], 7, [1], False),
        ([9, 9, 2], [MOST, MOST, 6], 6, [0, 1], False),
        ([0, 12, 0], [3, MOST, MOST], 3, [1], False),
        ([4, 9, 5], [MOST, 6, MOST], 6, [1], False),
        ([12, 9, 2], [MOST, 6, MOST], 6, [0, 1], False),
    ],
)
def test_a_plan_has_the_finest_level_that_fits_in_all_pings(search_with, needed, fits, level, of, met):
    """Its estimates are the largest of the pings that need it, here by their numbers: `of`."""
    search = search_with(Model(needed, fits))
    plan = search.find_for_all([Setup(k) for k in range(3)])
    assert (plan.level, plan.met) == (level, met)
    assert (plan.error_estimate, plan.worst_body_estimate) == (0.01 * (max(of) + 1), 0.1 / (min(of) + 1))
    assert plan.worst_body == min(of)


def test_a_smaller_tolerance_takes_more_samples_and_errs_less():
    scene, sonar = sg.Scene([ball()]), replace(SONAR, n_bins=100)
    truth = sg.reference_ping(scene, sonar, np.eye(4), IDEAL, error=0.02)
    levels, errors = [], []
    for tolerance in (0.03, 0.01, 0.003):
        with sg.Simulator(scene, sonar, IDEAL, tolerance=tolerance) as simulator:
            ping = simulator.ping(np.eye(4))
            levels.append(level_of(simulator))
        errors.append(ping_error(ping, truth))
        assert errors[-1] <= tolerance
        assert 0 < ping.error_estimate <= tolerance
        assert ping.meta["tolerance"] == tolerance
    assert levels == sorted(set(levels)) and errors == sorted(errors, reverse=True)


def test_the_level_depends_on_the_scene():
    """A wall needs the coarsest level, a row of rods a fine one."""
    with sg.Simulator(sg.Scene([wall()]), SONAR, IDEAL) as simulator:
        simulator.ping(np.eye(4))
        assert level_of(simulator) == 0
    with sg.Simulator(sg.Scene(row_of_rods(8)), SONAR, IDEAL) as simulator:
        simulator.ping(np.eye(4))
        assert level_of(simulator) > 8


@pytest.mark.parametrize("tolerance, radius", [(0.05, 0.008), (0.01, 0.02)])
def test_a_body_missed_by_the_first_samples_is_found(tolerance, radius):
    """The ball is too small for the coarse lattice, and the only source of echo."""
    speck = sg.Scene([ball(x=18, radius=radius)])
    with sg.Simulator(speck, SONAR, IDEAL, sampling_at(SONAR, 4)) as simulator, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert not simulator.ping(np.eye(4)).intensity.any()
    with sg.Simulator(speck, SONAR, IDEAL, tolerance=tolerance) as simulator:
        ping = simulator.ping(np.eye(4))
        assert simulator.run.sampler.plan.met
    truth = sg.reference_ping(
        sg.Scene([ball(x=18, radius=radius)]),
        replace(SONAR, n_beams=1, azimuth_fov_deg=1.0),
        np.eye(4),
        IDEAL,
        0.1,
    )
    # the single beam receives all of the echo, as does every beam within half a degree
    assert ping.intensity.max(axis=0).sum() == pytest.approx(truth.intensity.sum(), rel=0.1)


def test_an_empty_scene_needs_no_samples():
    with sg.Simulator(sg.Scene([]), SONAR) as simulator, pytest.warns(UserWarning, match="no bodies"):
        ping = simulator.ping(np.eye(4))
    assert ping.error_estimate == 0.0
