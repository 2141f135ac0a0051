"""A tolerance is a promise: a few random worlds here, a hundred by `python -m tools.promise`."""

import warnings

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.sonar.sampling import sampling_at
from tests.support.worlds import ROD_SONAR, rods_before_a_wall, wires_before_a_wall
from tools import promise

# truths of the whole device take 20 to 50 s each
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

# At least ninety-five of a hundred worlds keep the promise; the chance that fewer than fourteen of sixteen do
# is then one in twenty. The worlds are the same in every run: the first from 700 on whose truths take fewer
# than 20 million rays; 704 and 708 take 60 million, half of all the time.
WORLDS, LEAST = (*range(700, 704), 705, 706, 707, 709), 14


# Worlds of `rods_before_a_wall` that keep the promise by little: each of the planner's terms and constants decides
# in some of them. Without the compared lattices 107 and 143 break it; with both lattices sheared alike, 196;
# with no regard for bodies of few samples, 63, 143, 151, 184 and 257; with bodies of 1/200 of the echo neglected, 1,
# 43 and 249; with a bound of ten times the tolerance for a body, 20, 143, 151, 187, 214 and 257; with half the
# difference of two lattices, 2, 46, 65, 130, 146 and 227.
MARGINAL = (1, 2, 20, 43, 46, 63, 65, 107, 130, 143, 146, 151, 184, 187, 196, 214, 227, 249, 257)
# Worlds of `wires_before_a_wall` whose nets break the promise if the samples on them count as those on a solid body.
WIRES = (10, 30, 55, 66)
FINEST = 26  # sampling level of their truths, with at least 30 times the samples


@pytest.fixture(scope="module")
def outcomes():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        # the truths are coarser than the tool's: halves differ by 1 %, their mean errs by about half of that
        worlds = [promise.World(seed, truth_error=0.1) for seed in WORLDS]
        tried = [promise.try_tolerances(world, promise.try_plan, (0.05, 0.02)) for world in worlds]
    return [outcome for one in tried for outcome in one]


def test_promises_are_kept(outcomes):
    assert len(outcomes) == 2 * len(WORLDS)  # all of these worlds return an echo
    broken = [outcome for outcome in outcomes if not outcome.kept]
    assert len(outcomes) - len(broken) >= LEAST, broken


def test_estimates_bound_errors(outcomes):
    """An estimate is nearly always above the error, and not many times above it."""
    uncertainty = 0.006  # of these truths
    assert sum(o.error_estimate >= o.errors.echo - uncertainty for o in outcomes) >= LEAST
    ratios = sorted(o.error_estimate / o.errors.echo for o in outcomes if o.errors.echo > uncertainty)
    assert 1.0 < ratios[len(ratios) // 2] < 3.0
    assert all(o.error_estimate <= o.tolerance for o in outcomes if o.met)


@pytest.mark.parametrize("seed", [7000, 8110])
def test_a_rod_along_the_rows_of_samples_keeps_the_promise(seed):
    """They erred by 0.40 and 0.37: the finer lattice met them along all of their length, by rows higher than these."""
    outcome = promise.try_plan(promise.World(seed, truth_error=0.5), 0.05)
    assert outcome.errors.are_within(0.05), outcome


def over_the_promise(world, seed):
    """Return the larger of the error over the tolerance and that of the worst body over its bound; None if not met."""
    scene, tolerance = world(seed)
    acoustics = sg.Acoustics.ideal()
    with sg.Simulator(scene, ROD_SONAR, acoustics, sampling_at(ROD_SONAR, FINEST)) as simulator:
        truth = simulator.ping(np.eye(4), labels=True)
    with sg.Simulator(scene, ROD_SONAR, acoustics, tolerance=tolerance) as simulator:
        ping = simulator.ping(np.eye(4), labels=True)
        if not simulator.run.sampler.plan.met:
            return None
    counts = truth.body_echo[1:] > 1e-3 * truth.body_echo.sum()
    errors = np.abs(ping.body_echo[1:][counts] / truth.body_echo[1:][counts] - 1)
    return max(ping_error(ping, truth), errors.max() / 5) / tolerance


@pytest.mark.parametrize(
    "world, seed",
    [*((rods_before_a_wall, seed) for seed in MARGINAL), *((wires_before_a_wall, seed) for seed in WIRES)],
)
def test_marginal_worlds_keep_the_promise(world, seed):
    assert over_the_promise(world, seed) <= 1


def test_rods_before_a_wall_keep_the_promise_in_19_of_20_worlds():
    """Worlds that nothing was tuned on; the hardest that are known, since a body of few samples decides."""
    found = [over_the_promise(rods_before_a_wall, seed) for seed in range(2000, 2200)]
    assert found.count(None) == 0
    assert sum(one > 1 for one in found) <= 10


def too_many(*_):
    raise SampleLimitError("samples must be fewer")


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
def test_the_truth_of_a_pool_is_the_finest_that_fits(monkeypatch, share):
    ping, counts = promise.internals.ping_with_all_samples, []

    def limited(simulator, pose):
        counts.append(simulator.sampling.count(simulator.sonar))
        return too_many() if counts[-1] > share * counts[0] else ping(simulator, pose)

    monkeypatch.setattr(promise.internals, "ping_with_all_samples", limited)
    outcomes = promise.try_pool(409)
    assert [one.tolerance for one in outcomes] == [0.05, 0.01] and all(one.error < 0.05 for one in outcomes)
    assert counts[-1] <= share * counts[0]
    # each trial has half as many samples as the one before it, but for whole columns and rows
    assert np.array(counts[1:]) * 2 == pytest.approx(np.array(counts[:-1]), rel=0.02)
    assert all(count > share * counts[0] for count in counts[:-1])


def test_a_pool_without_a_truth_is_left_out_and_counted(monkeypatch, capsys):
    monkeypatch.setattr(promise.internals, "ping_with_all_samples", too_many)
    assert promise.try_pool(409) is None
    monkeypatch.undo()
    of_next = promise.try_pool(410)
    monkeypatch.setattr(promise, "try_pool", lambda seed: None if seed == 409 else of_next)
    monkeypatch.setattr("sys.argv", ["promise", "--pools", "1", "--first", "409"])
    promise.main()
    shown = capsys.readouterr().out
    assert shown.startswith("seeds 409 to 410, on ")
    assert "left out, as no truth fits that is finer than what it judges: 1, seeds [409]\n" in shown
