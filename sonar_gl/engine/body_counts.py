"""How many samples of a view meet each body, what it returns, and how well so many samples show it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.kernels.body_counts import BodyTotals, CountedSamples, EchoWeights, count_samples
from sonar_gl.engine.reception import Reception
from sonar_gl.sonar.samples import ViewSamples

BODY_ERROR_FACTOR, BODY_ERROR_RATE = 1.8, 0.75
MIN_BODY_SAMPLES = 8  # with fewer, the echo of a body is taken as unknown


class BodyCounts(NamedTuple):
    """What each body contributes to a ping, by number, 0 for none: (bodies + 1,) float64 arrays.

    samples : how many met it, inside the fan, its aperture and range, and in some beam
    echo : about the sum of its echo with the gain
    unevenness : how uncertain that sum is because neighbouring samples of the body return unlike echoes: its standard
        deviation, were they met at random
    of_strips : that sum as the fan's strips take it. Each takes the nearest sample of a row, so that those not as wide
        as a sample take too much or too little of what is thin and upright, in all rows alike
    strands : how many runs of neighbouring samples on it there are, along rows or across them, whichever are fewer;
        0 in sectors where these are long, or all lie along one line
    runs : how many runs of neighbouring samples on it there are along rows
    """

    samples: np.ndarray
    echo: np.ndarray
    of_strips: np.ndarray
    unevenness: np.ndarray
    strands: np.ndarray
    runs: np.ndarray


def count_bodies(
    view: ViewSamples,
    n_bodies: int,
    reception: Reception,
    is_counted: np.ndarray | None = None,
    every: int = 1,
) -> BodyCounts:
    """Count the samples on each body, and about the echo of each.

    view : not of a host
    is_counted : (bodies + 1,) bool by number, of which bodies; None for all. Those of others are 0
    every : of the rows of samples, every so-manieth is counted, and stands for those between
    """
    sonar, n = reception.sonar, n_bodies + 1
    if is_counted is None:
        is_counted = np.ones(n, bool)
    elif not is_counted.any():
        return BodyCounts(*np.zeros((6, n)))
    samples = CountedSamples(view.plane_echo, view.body_id, view.table, is_counted, every)
    weights = EchoWeights(
        float(sonar.range_min_m), 1.0 / sonar.bin_size_m, reception.gain, reception.elevation_table
    )
    totals = BodyTotals(*np.zeros((7, n)))
    count_samples(tuple(samples), tuple(reception.parts), tuple(weights), tuple(totals))
    # half the mean square of the differences of two is their variance; stripes show across them alone
    unevenness = np.sqrt(np.maximum(totals.along, totals.across) / 2)
    return BodyCounts(totals.counts, totals.echo, totals.of_strips, unevenness, totals.strands, totals.runs)


def body_error(samples, strands=0.0):
    """Return the relative error of a body's echo by its samples: few may all lie along a thin body, or beside it.

    Stratified samples err along an outline only. Of n samples on a compact body about √n lie there, and the error
    decreases as n^-0.75, the root of √n over n. On many thin wires nearly all do. Fitted to random worlds.

    strands : of `BodyCounts`
    """
    compact = BODY_ERROR_FACTOR * (1 + MIN_BODY_SAMPLES / samples) / samples**BODY_ERROR_RATE
    return compact * np.sqrt(np.maximum(strands / np.sqrt(samples), 1.0))
