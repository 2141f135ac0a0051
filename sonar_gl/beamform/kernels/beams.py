"""Columns to beams: weighs the sums of columns, and adds far side lobes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import added_in_any_order, compiled, inlined

TILE_BEAMS = 4  # beams at a time, so that what is read of columns serves several


class BeamTiles(NamedTuple):
    """Weights of TILE_BEAMS beams at a time: see `beam_tiles`.

    first : (T,) int64, column where each tile begins, may be negative; weights : (T, W', TILE_BEAMS) float32,
        W' a multiple of 4
    """

    first: np.ndarray
    weights: np.ndarray


def beam_tiles(first, weights) -> BeamTiles:
    """Lay the weights of beams side by side, TILE_BEAMS at a time; arguments as `beam_weights` returns them."""
    (B, W), corners = weights.shape, np.arange(0, len(first), TILE_BEAMS)
    starts = np.minimum.reduceat(first, corners)
    n_columns = W + (np.maximum.reduceat(first, corners) - starts).max()
    out = np.zeros((len(starts), n_columns + -n_columns % 4, TILE_BEAMS), np.float32)
    tile, of_tile = np.divmod(np.arange(B), TILE_BEAMS)
    columns = (first - starts[tile])[:, None] + np.arange(W)
    out[tile[:, None], columns, of_tile[:, None]] = weights
    return BeamTiles(starts, out)


@compiled
def weigh_columns(column_sums, spans, tiles, part, gain, out):
    """Write some beams as weighted sums of columns, times a gain; return their sum.

    column_sums, spans : (columns, K), zero outside of spans, (columns, 2)
    tiles : tuple of BeamTiles
    part : (2,) first and past the last of the tiles that are done
    gain : (K,) or of no length
    out : (B, K) of all beams
    """
    tiles = BeamTiles(*tiles)
    n_columns, K, total = column_sums.shape[0], out.shape[1], 0.0
    rows = np.zeros((TILE_BEAMS, K), np.float32)
    for t in range(part[0], part[1]):
        begin, end = K, 0
        for x in range(0, tiles.weights.shape[1], 4):  # four at a time: beams are read and written less often
            at, w = tiles.first[t] + x, tiles.weights[t, x : x + 4]
            c0, c1 = uint64(at % n_columns), uint64((at + 1) % n_columns)
            c2, c3 = uint64((at + 2) % n_columns), uint64((at + 3) % n_columns)
            low = min(spans[c0, 0], spans[c1, 0], spans[c2, 0], spans[c3, 0])
            high = max(spans[c0, 1], spans[c1, 1], spans[c2, 1], spans[c3, 1])
            if low >= high or not w.any():
                continue
            begin, end = min(begin, low), max(end, high)
            a0, a1, a2, a3 = w[0, 0], w[0, 1], w[0, 2], w[0, 3]
            b0, b1, b2, b3 = w[1, 0], w[1, 1], w[1, 2], w[1, 3]
            w0, w1, w2, w3 = w[2, 0], w[2, 1], w[2, 2], w[2, 3]
            d0, d1, d2, d3 = w[3, 0], w[3, 1], w[3, 2], w[3, 3]
            for k in range(uint64(low), uint64(high)):
                a, b, c, d = column_sums[c0, k], column_sums[c1, k], column_sums[c2, k], column_sums[c3, k]
                rows[0, k] += (a0 * a + b0 * b) + (w0 * c + d0 * d)
                rows[1, k] += (a1 * a + b1 * b) + (w1 * c + d1 * d)
                rows[2, k] += (a2 * a + b2 * b) + (w2 * c + d2 * d)
                rows[3, k] += (a3 * a + b3 * b) + (w3 * c + d3 * d)
        end = max(begin, end)
        for r in range(min(TILE_BEAMS, out.shape[0] - TILE_BEAMS * t)):
            total += _write_beam(rows, uint64(r), begin, end, gain, out, uint64(TILE_BEAMS * t + r))
        for r in range(uint64(TILE_BEAMS)):
            for k in range(uint64(begin), uint64(end)):
                rows[r, k] = 0.0
    return total


@inlined
def _write_beam(rows, r, begin, end, gain, out, b):
    """Write a row of sums as a beam, times the gain, and return its sum."""
    for k in range(uint64(0), uint64(begin)):
        out[b, k] = 0.0
    for k in range(uint64(end), uint64(out.shape[1])):
        out[b, k] = 0.0
    for k in range(uint64(begin), uint64(end)):
        out[b, k] = rows[r, k] * gain[k] if gain.shape[0] else rows[r, k]
    return _sum_of(out, b, begin, end)


@added_in_any_order
def _sum_of(out, b, begin, end):
    """Return the sum of some bins of a beam."""
    total = 0.0
    for k in range(uint64(begin), uint64(end)):
        total += out[b, k]
    return total


@compiled
def add_far_lobes(moments, first_moment, expansion, part, span, gain, out):
    """Add what some beams receive by far side lobes, times the gain; return the sum of these beams.

    Where the pattern has a null, errors of the far side lobes may leave less than nothing, which counts as nothing.

    moments : (n, K) of blocks of beams
    first_moment, expansion : (B,) int64 and (B, rank) float32; the rank is a multiple of 4
    part : (2,) first and past the last of the beams
    span : (2,) first bin and past the last that may differ from 0
    gain, out : as in `weigh_columns`
    """
    total = 0.0
    begin, end = uint64(span[0]), uint64(span[1])
    n = expansion.shape[1]
    row = np.empty(out.shape[1], np.float32)
    for b in range(part[0], part[1]):
        for k in range(begin, end):
            row[k] = 0.0
        for r in range(0, n, 4):
            m = first_moment[b] + r
            m0, m1, m2, m3 = uint64(m), uint64(m + 1), uint64(m + 2), uint64(m + 3)
            w0, w1, w2, w3 = expansion[b, r], expansion[b, r + 1], expansion[b, r + 2], expansion[b, r + 3]
            for k in range(begin, end):
                row[k] += (w0 * moments[m0, k] + w1 * moments[m1, k]) + (
                    w2 * moments[m2, k] + w3 * moments[m3, k]
                )
        ub = uint64(b)
        if gain.shape[0]:
            for k in range(begin, end):
                row[k] *= gain[k]
        for k in range(begin, end):
            out[ub, k] = max(out[ub, k] + row[k], np.float32(0.0))
        total += _sum_of(out, ub, begin, end)
    return total
