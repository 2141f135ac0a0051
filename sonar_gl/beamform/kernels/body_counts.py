"""Counts the samples on each body, and sums about what they return, to judge how well they show it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.strips import Lattice
from sonar_gl.core.compiled import compiled, from_column, inlined, uncounted

# Sums over the samples of a sector on a body: how many, and how many runs of neighbours along rows and across them;
# moments of the columns i and rows j.
N, RUNS_ALONG, RUNS_ACROSS, I, J, II, IJ, JJ = range(8)
# The samples on many thin parts, as of a net, spread over more than so many samples in any direction, in shorter runs
# than these on average. Those on one rod lie along a line, which the sheared lattice meets evenly.
MIN_WIDTH, MAX_RUN = 6.0, 3.0


class CountedSamples(NamedTuple):
    """The samples of a view.

    plane_echo, body_id, table : of `ViewSamples`
    is_counted : (bodies + 1,) bool by number, whether the samples of a body are added
    every : of the rows, every so-manieth is counted, and stands for those between
    """

    plane_echo: np.ndarray
    body_id: np.ndarray
    table: tuple
    is_counted: np.ndarray
    every: int


class ReceivedParts(NamedTuple):
    """The parts of S sectors that the beams receive, and the strips that take their samples.

    sines : (S, 2) of `Strips`: beyond them no beam receives, in sectors whose beams are cones
    widest_u : (S,) |u| beyond which samples only fill sheared rows
    first_u, u : (S + 1,) where the intervals of each sector begin in `u`, those of `Beamformer.received_u`
    first_strip, middle, end : (S + 1,) where the strips of each sector begin in `middle`; `Uprights` of all sectors,
        whose ends are one more in each sector
    """

    sines: np.ndarray
    widest_u: np.ndarray
    first_u: np.ndarray
    u: np.ndarray
    first_strip: np.ndarray
    middle: np.ndarray
    end: np.ndarray

    def received_u(self, sector: int) -> np.ndarray:
        """Return the `Beamformer.received_u` of one sector."""
        return self.u[self.first_u[sector] : self.first_u[sector + 1]]


class EchoWeights(NamedTuple):
    """How strongly an echo is received, by its range and its elevation.

    first_m, per_metre : where the first bin begins, and bins per metre
    gain : (K,) of the bins
    elevation_table : of `Beamformer`, taken at the nearest sine
    """

    first_m: float
    per_metre: float
    gain: np.ndarray
    elevation_table: np.ndarray


class BodyTotals(NamedTuple):
    """Sums over the samples on each body, (bodies + 1,) float64 by number; an echo is μ cos θ ΔΩ times its weights.

    counts : how many samples
    echo : of them
    of_strips : the echo as the strips take it
    along, across : squared differences of neighbours on one body, along rows and across
    strands : how many runs of neighbours there are, in sectors where these are short and spread in two directions
    runs : how many runs of neighbours there are along rows
    """

    counts: np.ndarray
    echo: np.ndarray
    of_strips: np.ndarray
    along: np.ndarray
    across: np.ndarray
    strands: np.ndarray
    runs: np.ndarray


class SampleRow(NamedTuple):
    """What is known of one row of C samples, (C,) float64 or, of bodies, uint16; overwritten.

    inverse_x : 1/x of what each sample met
    bin : the bin of its echo, with a fraction; negative where no beam receives it
    place : its place in `EchoWeights.elevation_table`
    echo : without gain and pattern, then with both
    share : how much of it the strips take
    body : which one it met; 0, which none has, where it does not count
    echo_over, body_over : echo and body in the row before
    """

    inverse_x: np.ndarray
    bin: np.ndarray
    place: np.ndarray
    echo: np.ndarray
    share: np.ndarray
    body: np.ndarray
    echo_over: np.ndarray
    body_over: np.ndarray


@compiled
def count_samples(samples, parts, weights, totals):
    """Add the samples of a view to the totals of the bodies that they met.

    One call counts those of all sectors: to hand arrays over takes as long as the samples of a sector of side lobes.

    samples, parts, weights, totals : tuples of CountedSamples, ReceivedParts, EchoWeights and BodyTotals
    """
    plane_echo, body_id, (places, u, v, limits), is_counted, every = samples
    sums, strands = np.empty((is_counted.shape[0], JJ + 1)), BodyTotals(*totals).strands
    most = places[:, 1].max()
    row = SampleRow(
        np.empty(most),
        np.empty(most),
        np.empty(most),
        np.empty(most),
        np.empty(most),
        np.empty(most, np.uint16),
        np.empty(most),
        np.empty(most, np.uint16),
    )
    for s in range(places.shape[0]):
        left, columns, rows = places[s, 0], places[s, 1], places[s, 2]
        if rows == 0:
            continue
        sums[:], row.body_over[:] = 0.0, 0
        image = from_column(plane_echo, left, rows), from_column(body_id, left, rows), is_counted, every
        lattice = Lattice(u[s], v[s], limits[s, 0], limits[s, 1], columns, limits[s, 2], limits[s, 3])
        _count_sector(image, lattice, parts, s, weights, totals, sums, row)
        for body in range(sums.shape[0]):
            strands[body] += _strands(sums, body)


@uncounted
def _count_sector(image, lattice, parts, s, weights, totals, sums, row):
    """Add the samples of sector `s` to the totals, and to `sums`, (bodies + 1, 8) of N to JJ."""
    parts, weights, totals = ReceivedParts(*parts), EchoWeights(*weights), BodyTotals(*totals)
    for j in range(0, image[0].shape[0], image[3]):
        _find_received(image[0], j, lattice, parts, s, weights, row)
        _find_shares(j, lattice, parts, s, row.share)
        _find_bodies(image, j, lattice, parts, s, weights, totals.of_strips, row)
        _add_runs(j, lattice.columns, totals, sums, row)


@inlined
def _find_received(plane_echo, j, lattice, parts, s, weights, row):
    """Find the bin, the place and the echo of each sample of row j, in a loop that does several at a time."""
    u0, u1 = lattice.u[0] + lattice.u[2] * j, lattice.u[1]
    v0, v1 = lattice.v[0] + lattice.v[2] * j, lattice.v[1]
    low2, high2 = lattice.tan_low * abs(lattice.tan_low), lattice.tan_high * abs(lattice.tan_high)
    sine, cosine = lattice.sine, lattice.cosine
    lowest_sine, highest_sine = parts.sines[s, 0], parts.sines[s, 1]
    # the outermost strips may take samples beyond them
    has_strips = parts.first_strip[s + 1] > parts.first_strip[s]
    reach = parts.widest_u[s] + (u1 / 2 if has_strips else 0.0)
    first_m, per_metre, K = weights.first_m, weights.per_metre, weights.gain.shape[0]
    per_sine = (weights.elevation_table.shape[0] - 1) / 2
    area = u1 * lattice.v[2] - lattice.u[2] * v1
    inverse_x, bins, places, echo = row.inverse_x, row.bin, row.place, row.echo
    for i in range(uint64(lattice.columns)):
        inverse_x[i], echo[i] = plane_echo[uint64(j), i, 0], plane_echo[uint64(j), i, 3]
    for i in range(uint64(lattice.columns)):
        q, mine = inverse_x[i], echo[i]
        uc, vc = u0 + u1 * i, v0 + v1 * i
        v2, u2 = vc * abs(vc), 1.0 + uc * uc
        L2 = u2 + vc * vc
        L = math.sqrt(L2)
        inverse = 1.0 / (L2 * q)  # one division for three
        per_L2, along = inverse * q, sine - cosine * uc
        k = (L * L2 * inverse - first_m) * per_metre
        is_in = (abs(uc) <= reach) & (v2 <= high2 * u2) & (v2 >= low2 * u2)
        is_in &= (lowest_sine * L <= along) & (along <= highest_sine * L)
        is_in &= (q > 0.0) & (mine > 0.0) & (k >= 0.0) & (k < K)
        bins[i] = k if is_in else -1.0
        places[i] = per_sine + vc * L * per_L2 * per_sine + 0.5
        echo[i] = mine * q * area * per_L2 * per_L2


@inlined
def _find_shares(j, lattice, parts, s, share):
    """Find how much of each sample of row j the strips take, each of them the nearest one; without strips all of it."""
    first, past = parts.first_strip[s], parts.first_strip[s + 1]
    share[:] = 0.0 if past > first else 1.0
    middle, end, u1 = parts.middle, parts.end, lattice.u[1]
    u0 = lattice.u[0] + lattice.u[2] * j - u1 / 2
    for p in range(uint64(first), uint64(past)):
        i, at = (middle[p] - u0) / u1, p + uint64(s)
        if 0.0 <= i < lattice.columns:
            share[uint64(i)] += (end[at + uint64(1)] - end[at]) / u1


@inlined
def _find_bodies(image, j, lattice, parts, s, weights, of_strips, row):
    """Find the body and the echo of the samples of row j that count. Those beside the sector only fill its strips."""
    (_, body_id, is_counted, every), (u, widest_u) = image, (lattice.u, parts.widest_u[s])
    gain, elevation_table = weights.gain, weights.elevation_table
    received_u = parts.u[parts.first_u[s] : parts.first_u[s + 1]]
    bins, places, echo, body = row.bin, row.place, row.echo, row.body
    for i in range(uint64(lattice.columns)):
        number, body[i] = body_id[uint64(j), i], 0
        if bins[i] < 0.0 or not is_counted[number]:
            continue
        uc = u[0] + u[1] * i + u[2] * j
        if len(received_u) and np.searchsorted(received_u, uc) % 2 == 0:
            continue  # between two beams
        pattern = elevation_table[uint64(places[i])] if elevation_table.shape[0] else 1.0
        echo[i] *= every * gain[uint64(bins[i])] * pattern
        if abs(uc) <= widest_u:
            body[i] = number
        else:
            of_strips[number] += echo[i] * row.share[i]


@inlined
def _add_runs(j, columns, totals, sums, row):
    """Add each run of samples of row j on one body to the totals, and to `sums`."""
    counts, echo, of_strips, along, across, _, runs = totals
    mine, share, bodies, over, body_over = row.echo, row.share, row.body, row.echo_over, row.body_over
    i, past = uint64(0), uint64(columns)
    while i < past:
        first, body = i, bodies[i]
        if body == 0:
            i += uint64(1)
            continue
        returned, taken, beside2, over2 = 0.0, 0.0, 0.0, 0.0
        n_over, sum_i, sum_ii = 0, 0, 0
        while i < past and bodies[i] == body:
            if i > first:
                beside2 += (mine[i] - mine[i - uint64(1)]) ** 2
            if body_over[i] == body:
                over2 += (mine[i] - over[i]) ** 2
                n_over += 1
            returned, taken = returned + mine[i], taken + mine[i] * share[i]
            sum_i, sum_ii = sum_i + np.int64(i), sum_ii + np.int64(i * i)
            i += uint64(1)
        n = np.int64(i - first)
        counts[body], runs[body] = counts[body] + n, runs[body] + 1
        echo[body], of_strips[body] = echo[body] + returned, of_strips[body] + taken
        along[body], across[body] = along[body] + beside2, across[body] + over2
        sums[body, N] += n
        sums[body, RUNS_ALONG] += 1
        sums[body, RUNS_ACROSS] += n - n_over
        sums[body, I] += sum_i
        sums[body, J] += n * j
        sums[body, II] += sum_ii
        sums[body, IJ] += sum_i * j
        sums[body, JJ] += n * j * j
    for i in range(past):
        over[i], body_over[i] = mine[i], bodies[i]


@inlined
def _strands(sums, body):
    """Return the `BodyTotals.strands` of a body in a sector; sums : (bodies + 1, 8) of N to JJ."""
    n, strands = sums[body, N], min(sums[body, RUNS_ALONG], sums[body, RUNS_ACROSS])
    if n >= MAX_RUN * strands:
        return 0.0
    i, j = sums[body, I] / n, sums[body, J] / n
    of_i, of_j, of_both = sums[body, II] / n - i * i, sums[body, JJ] / n - j * j, sums[body, IJ] / n - i * j
    least = (of_i + of_j) / 2 - math.hypot((of_i - of_j) / 2, of_both)
    # an even strip of a width has a twelfth of its square as the variance across it
    return strands if 12 * least > MIN_WIDTH**2 else 0.0
