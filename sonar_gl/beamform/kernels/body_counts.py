"""Counts the samples on each body, and sums about what they return, to judge how well they show it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.kernels.strips import Lattice
from sonar_gl.core.compiled import compiled, from_column, inlined

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
    """

    counts: np.ndarray
    echo: np.ndarray
    of_strips: np.ndarray
    along: np.ndarray
    across: np.ndarray
    strands: np.ndarray


@compiled
def count_samples(samples, parts, weights, totals):
    """Add the samples of a view to the totals of the bodies that they met.

    One call counts those of all sectors: to hand arrays over takes as long as the samples of a sector of side lobes.

    samples, parts, weights, totals : tuples of CountedSamples, ReceivedParts, EchoWeights and BodyTotals
    """
    plane_echo, body_id, (places, u, v, limits), is_counted, every = samples
    sums, strands = np.empty((is_counted.shape[0], JJ + 1)), BodyTotals(*totals).strands
    for s in range(places.shape[0]):
        left, columns, rows = places[s, 0], places[s, 1], places[s, 2]
        if rows == 0:
            continue
        for body in range(sums.shape[0]):
            for n in range(JJ + 1):
                sums[body, n] = 0.0
        image = from_column(plane_echo, left, rows), from_column(body_id, left, rows), is_counted, every
        lattice = Lattice(u[s], v[s], limits[s, 0], limits[s, 1], columns, limits[s, 2], limits[s, 3])
        _count_sector(image, lattice, parts, s, weights, totals, sums)
        for body in range(sums.shape[0]):
            strands[body] += _strands(sums, body)


@inlined
def _count_sector(image, lattice, parts, s, weights, totals, sums):
    """Add the samples of sector `s` to the totals, and to `sums`, (bodies + 1, 8) of N to JJ."""
    (plane_echo, body_id, is_counted, every), (counts, echo, of_strips, along, across, _) = image, totals
    parts, (first_m, per_metre, gain, elevation_table) = ReceivedParts(*parts), weights
    (u, v), columns, sine, cosine = lattice[:2], lattice.columns, lattice.sine, lattice.cosine
    low2, high2 = lattice.tan_low * abs(lattice.tan_low), lattice.tan_high * abs(lattice.tan_high)
    lowest_sine, highest_sine, widest_u = parts.sines[s, 0], parts.sines[s, 1], parts.widest_u[s]
    received_u = parts.u[parts.first_u[s] : parts.first_u[s + 1]]
    middles = parts.middle[parts.first_strip[s] : parts.first_strip[s + 1]]
    first_end = parts.first_strip[s] + s
    n_strips, half = len(middles), u[1] / 2
    # the outermost strips may take samples beyond them
    reach = widest_u + (half if n_strips else 0.0)
    per_sine, K = (elevation_table.shape[0] - 1) / 2, gain.shape[0]
    area = (u[1] * v[2] - u[2] * v[1]) * every
    # of the row before; of bodies 0, which none has, where no sample counts
    above, body_above = np.zeros(columns), np.zeros(columns, np.uint16)
    for j in range(0, plane_echo.shape[0], every):
        beside, body_beside = 0.0, 0
        before, past = 0, 0  # of the strips to which the sample is the nearest one of its row
        for i in range(columns):
            body_over, over = body_above[i], above[i]
            body_left, body_beside, body_above[i] = body_beside, 0, 0
            q = plane_echo[j, i, 0]
            if q <= 0.0 or plane_echo[j, i, 3] <= 0.0:
                continue
            body = body_id[j, i]
            if not is_counted[body]:
                continue
            uc, vc = u[0] + u[1] * i + u[2] * j, v[0] + v[1] * i + v[2] * j
            v2, u2 = vc * abs(vc), 1.0 + uc * uc
            if abs(uc) > reach or v2 > high2 * u2 or v2 < low2 * u2:
                continue
            if len(received_u) and np.searchsorted(received_u, uc) % 2 == 0:
                continue  # between two beams
            L2 = u2 + vc * vc
            L = math.sqrt(L2)
            if not lowest_sine * L <= sine - cosine * uc <= highest_sine * L:
                continue
            inverse = 1.0 / (L2 * q)  # one division for three
            k = (L * L2 * inverse - first_m) * per_metre
            if not 0.0 <= k < K:
                continue
            per_L2 = inverse * q
            place = int(per_sine + vc * L * per_L2 * per_sine + 0.5)
            pattern = elevation_table[place] if elevation_table.shape[0] else 1.0
            returned = plane_echo[j, i, 3] * q * area * per_L2 * per_L2 * gain[int(k)] * pattern
            taken = returned
            if n_strips:
                past = _pass_by(middles, past, uc + half)
                before = _pass_by(middles, before, uc - half)
                taken = returned * (parts.end[first_end + past] - parts.end[first_end + before]) / u[1]
            of_strips[body] += taken
            if abs(uc) > widest_u:
                continue
            counts[body] += 1.0
            echo[body] += returned
            if body == body_left:
                along[body] += (returned - beside) ** 2
            else:
                sums[body, RUNS_ALONG] += 1.0
            if body == body_over:
                across[body] += (returned - over) ** 2
            else:
                sums[body, RUNS_ACROSS] += 1.0
            _add_place(sums, body, i, j)
            beside, body_beside, above[i], body_above[i] = returned, body, returned, body


@inlined
def _pass_by(middles, n, u):
    """Return the first of rising `middles` from number n on that is above u."""
    while n < len(middles) and middles[n] <= u:
        n += 1
    return n


@inlined
def _add_place(sums, body, i, j):
    """Add a sample to the moments of its body."""
    sums[body, N] += 1.0
    sums[body, I] += i
    sums[body, J] += j
    sums[body, II] += i * i
    sums[body, IJ] += i * j
    sums[body, JJ] += j * j


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
