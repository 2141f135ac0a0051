"""A tolerance is a promise: a few random worlds here, a hundred by `tools/promise.py`."""

import sys
import warnings
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import promise

# Of a hundred worlds ninety-five keep the promise or more; that of sixteen fewer than fourteen do is then a
# chance of one in twenty. The worlds are the same in every run: the first from 700 on whose truths take fewer
# than 20 million rays, for 704 and 708 take 60 million, half of all the time.
WORLDS, LEAST = (*range(700, 704), 705, 706, 707, 709), 14


@pytest.fixture(scope="module")
def outcomes():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        # truths some times as rough as the tool: halves differ by 1 %, their mean errs by about half of that
        tried = [promise.try_world(seed, (0.05, 0.02), 0.1, costs=False) for seed in WORLDS]
    return [outcome for one in tried for outcome in one]


def test_promises_are_kept(outcomes):
    assert len(outcomes) == 2 * len(WORLDS)  # none of these worlds is dark
    broken = [outcome for outcome in outcomes if not outcome.kept]
    assert len(outcomes) - len(broken) >= LEAST, broken


def test_estimates_are_told_apart_from_errors(outcomes):
    """An estimate is above the error nearly always, and no more than some times above it."""
    doubt = 0.006  # of these truths
    assert sum(o.error_estimate >= o.error - doubt for o in outcomes) >= LEAST
    ratios = sorted(o.error_estimate / o.error for o in outcomes if o.error > doubt)
    assert 1.0 < ratios[len(ratios) // 2] < 3.0
    assert all(o.error_estimate <= o.tolerance for o in outcomes if o.met)
