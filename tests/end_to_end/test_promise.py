"""A tolerance is a promise: a few random worlds here, a hundred by `python -m tools.promise`."""

import warnings

import pytest

from tools import promise

pytestmark = pytest.mark.slow

# At least ninety-five of a hundred worlds keep the promise; the chance that fewer than fourteen of sixteen do
# is then one in twenty. The worlds are the same in every run: the first from 700 on whose truths take fewer
# than 20 million rays; 704 and 708 take 60 million, half of all the time.
WORLDS, LEAST = (*range(700, 704), 705, 706, 707, 709), 14


@pytest.fixture(scope="module")
def outcomes():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        # the truths are coarser than the tool's: halves differ by 1 %, their mean errs by about half of that
        tried = [promise.try_world(seed, (0.05, 0.02), 0.1, costs=False) for seed in WORLDS]
    return [outcome for one in tried for outcome in one]


def test_promises_are_kept(outcomes):
    assert len(outcomes) == 2 * len(WORLDS)  # all of these worlds return an echo
    broken = [outcome for outcome in outcomes if not outcome.kept]
    assert len(outcomes) - len(broken) >= LEAST, broken


def test_estimates_bound_errors(outcomes):
    """An estimate is nearly always above the error, and not many times above it."""
    uncertainty = 0.006  # of these truths
    assert sum(o.error_estimate >= o.error - uncertainty for o in outcomes) >= LEAST
    ratios = sorted(o.error_estimate / o.error for o in outcomes if o.error > uncertainty)
    assert 1.0 < ratios[len(ratios) // 2] < 3.0
    assert all(o.error_estimate <= o.tolerance for o in outcomes if o.met)
