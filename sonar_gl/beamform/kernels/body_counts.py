"""Counts the samples on each body, and sums about what they return, to judge how well they show it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.beamform.kernels.strips import Lattice
from sonar_gl.core.compiled import compiled

# Sums over the samples on a body: how many, and how many runs of neighbours along rows and across them; moments of the
# columns i and rows j.
N, RUNS_ALONG, RUNS_ACROSS, I, J, II, IJ, JJ = range(8)


class SectorImage(NamedTuple):
    """The samples of one sector.

    plane_echo, body_id : of `SectorSamples`, in `whole_rows`
    lattice : plain tuple of Lattice
    """

    plane_echo: np.ndarray
    body_id: np.ndarray
    lattice: tuple


class ReceivedPart(NamedTuple):
    """The part of a sector that the beams receive, and the strips that take its samples.

    sines : of `Strips`: beyond them no beam receives, in sectors whose beams are cones
    widest_u : |u| beyond which samples only fill sheared rows
    received_u : of `Beamformer`
    uprights : plain tuple of `Uprights`
    """

    sines: tuple[float, float]
    widest_u: float
    received_u: np.ndarray
    uprights: tuple


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
    """Sums over the samples on each body, by number, float64; an echo is μ cos θ ΔΩ times its weights.

    counts : (bodies + 1,) how many samples
    echo : (bodies + 1,)
    of_strips : (bodies + 1,) echo as the strips take it
    unlike : (2, bodies + 1) squared differences of neighbours on one body, along rows and across
    places : (bodies + 1, 8) the sums N..JJ of one sector
    """

    counts: np.ndarray
    echo: np.ndarray
    of_strips: np.ndarray
    unlike: np.ndarray
    places: np.ndarray


@compiled
def count_samples(image, received, weights, totals):
    """Add the samples of one sector to the totals of the bodies that they met.

    image, received, weights, totals : tuples of SectorImage, ReceivedPart, EchoWeights and BodyTotals
    """
    (plane_echo, body_id, lattice), (counts, echo, of_strips, unlike, places) = image, totals
    sines, widest_u, received_u, (middles, ends) = received
    first_m, per_metre, gain, elevation_table = weights
    lattice = Lattice(*lattice)
    (u, v), columns, sine, cosine = lattice[:2], lattice.columns, lattice.sine, lattice.cosine
    low2, high2 = lattice.tan_low * abs(lattice.tan_low), lattice.tan_high * abs(lattice.tan_high)
    n_strips, half = len(middles), u[1] / 2
    # the outermost strips may take samples beyond them
    reach = widest_u + (half if n_strips else 0.0)
    per_sine, K = (elevation_table.shape[0] - 1) / 2, gain.shape[0]
    area = u[1] * v[2] - u[2] * v[1]
    # of the row before; of bodies 0, which none has, where no sample counts
    above, body_above = np.zeros(columns), np.zeros(columns, np.uint16)
    for j in range(plane_echo.shape[0]):
        beside, body_beside = 0.0, 0
        before, past = 0, 0  # of the strips to which the sample is the nearest one of its row
        for i in range(columns):
            body_over, over = body_above[i], above[i]
            body_left, body_beside, body_above[i] = body_beside, 0, 0
            q = plane_echo[j, i, 0]
            if q <= 0.0 or plane_echo[j, i, 3] <= 0.0:
                continue
            uc, vc = u[0] + u[1] * i + u[2] * j, v[0] + v[1] * i + v[2] * j
            v2, u2 = vc * abs(vc), 1.0 + uc * uc
            if abs(uc) > reach or v2 > high2 * u2 or v2 < low2 * u2:
                continue
            if len(received_u) and np.searchsorted(received_u, uc) % 2 == 0:
                continue  # between two beams
            L2 = u2 + vc * vc
            L = math.sqrt(L2)
            if not sines[0] * L <= sine - cosine * uc <= sines[1] * L:
                continue
            inverse = 1.0 / (L2 * q)  # one division for three
            k = (L * L2 * inverse - first_m) * per_metre
            if not 0.0 <= k < K:
                continue
            per_L2 = inverse * q
            place = int(per_sine + vc * L * per_L2 * per_sine + 0.5)
            pattern = elevation_table[place] if elevation_table.shape[0] else 1.0
            returned = plane_echo[j, i, 3] * q * area * per_L2 * per_L2 * gain[int(k)] * pattern
            body = body_id[j, i]
            taken = returned
            if n_strips:
                while past < n_strips and middles[past] <= uc + half:
                    past += 1
                while before < n_strips and middles[before] <= uc - half:
                    before += 1
                taken = returned * (ends[past] - ends[before]) / u[1]
            of_strips[body] += taken
            if abs(uc) > widest_u:
                continue
            counts[body] += 1.0
            echo[body] += returned
            if body == body_left:
                unlike[0, body] += (returned - beside) ** 2
            else:
                places[body, RUNS_ALONG] += 1.0
            if body == body_over:
                unlike[1, body] += (returned - over) ** 2
            else:
                places[body, RUNS_ACROSS] += 1.0
            places[body, N] += 1.0
            places[body, I] += i
            places[body, J] += j
            places[body, II] += i * i
            places[body, IJ] += i * j
            places[body, JJ] += j * j
            beside, body_beside, above[i], body_above[i] = returned, body, returned, body
