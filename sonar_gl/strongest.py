"""The compiled sums of labels: columns into beams, and in each bin the body with the strongest echo."""

from __future__ import annotations

import numpy as np
from numba import uint64

from sonar_gl import moments
from sonar_gl.compiled import compiled, compiled_with
from sonar_gl.moments import COLUMN, FIRST, PAST, PLACE

# Bins and beams at a time: so much of the columns that they hear stays in the fastest memory.
BINS, BEAMS = 64, 4


def tiles_of(first, weights):
    """Weights of BEAMS beams at a time, and the column where they begin.

    first : (B,), weights : (B, W), of `fan.beam_weights`

    Returns
    -------
    (T,) int64 columns, which may be negative; (T, W', BEAMS) float32, the last BEAMS rows of zeros
    """
    B, W = weights.shape
    starts = np.array([first[b : b + BEAMS].min() for b in range(0, B, BEAMS)])
    width = (
        W
        + BEAMS
        + max(int(first[b : b + BEAMS].max()) - start for b, start in zip(range(0, B, BEAMS), starts))
    )
    out = np.zeros((len(starts), width, BEAMS), np.float32)
    for b in range(B):
        at = first[b] - starts[b // BEAMS]
        out[b // BEAMS, at : at + W, b % BEAMS] = weights[b]
    return starts, out


@compiled
def _weigh(panel, low, high, origin, start, weights, rows):
    """Beams of one tile, in one block of bins.

    panel : (columns * BINS,), from column `origin` on, zeros for BEAMS columns from `high` on
    low, high : columns of it with an echo; start, weights : of the tile; rows : (BEAMS * BINS,)
    """
    rows[:] = 0.0
    low, high = max(low, start), min(high, start + weights.shape[0] - BEAMS)
    for x in range(low, high, 4):
        at, w = uint64((x - origin) * BINS), weights[uint64(x - start) : uint64(x - start + 4)]
        a0, a1, a2, a3 = w[0, 0], w[0, 1], w[0, 2], w[0, 3]
        b0, b1, b2, b3 = w[1, 0], w[1, 1], w[1, 2], w[1, 3]
        c0, c1, c2, c3 = w[2, 0], w[2, 1], w[2, 2], w[2, 3]
        d0, d1, d2, d3 = w[3, 0], w[3, 1], w[3, 2], w[3, 3]
        for k in range(uint64(BINS)):
            a, b = panel[at + k], panel[at + uint64(BINS) + k]
            c, d = panel[at + uint64(2 * BINS) + k], panel[at + uint64(3 * BINS) + k]
            rows[k] += (a0 * a + b0 * b) + (c0 * c + d0 * d)
            rows[uint64(BINS) + k] += (a1 * a + b1 * b) + (c1 * c + d1 * d)
            rows[uint64(2 * BINS) + k] += (a2 * a + b2 * b) + (c2 * c + d2 * d)
            rows[uint64(3 * BINS) + k] += (a3 * a + b3 * b) + (c3 * c + d3 * d)
    return low < high


@compiled
def _pack(runs, owner, pools, moment, k0, n_columns, origin, n_panel, panel):
    """Lay a body's runs in a block of bins side by side; the columns between which something lies."""
    low, high = origin + n_panel, origin
    turn = -(-(origin + n_panel) // n_columns)  # columns come again where the fan is a circle
    for way in range(-turn, turn + 1):
        for n in range(runs.shape[0]):
            x = runs[n, COLUMN] + way * n_columns
            if origin <= x < origin + n_panel and runs[n, FIRST] < k0 + BINS and runs[n, PAST] > k0:
                low, high = min(low, x), max(high, x + 1)
    if low >= high:
        return low, high
    panel[(low - origin) * BINS : (high - origin + BEAMS) * BINS] = 0.0
    for way in range(-turn, turn + 1):
        for n in range(runs.shape[0]):
            x = runs[n, COLUMN] + way * n_columns
            first, past = max(runs[n, FIRST], k0), min(runs[n, PAST], k0 + BINS)
            if origin <= x < origin + n_panel and first < past:
                pool, length = pools[owner[n]], runs[n, PAST] - runs[n, FIRST]
                begin = runs[n, PLACE] + moment * length + first - runs[n, FIRST]
                at = (x - origin) * BINS + first - k0
                for k in range(uint64(past - first)):
                    panel[uint64(at) + k] = pool[uint64(begin) + k]
    return low, high


@compiled
def _compare(rows, body, gain, strongest, total, body_id):
    """Have a beam's bins know a body's echo; its sum with the gain."""
    first = second = 0.0
    for k in range(uint64(strongest.shape[0])):
        echo = rows[k]
        total[k] += echo
        stronger = echo > strongest[k]
        strongest[k] = echo if stronger else strongest[k]
        body_id[k] = body if stronger else body_id[k]
    for k in range(0, strongest.shape[0] - 1, 2):  # two sums: each addition waits for the one before
        first += np.float64(rows[k]) * gain[k]
        second += np.float64(rows[k + 1]) * gain[k + 1]
    if strongest.shape[0] % 2:
        first += np.float64(rows[strongest.shape[0] - 1]) * gain[strongest.shape[0] - 1]
    return first + second


@compiled
def _bins_of(runs):
    """First and past the last bin of a body, the first on a block's edge."""
    first, past = runs[0, FIRST], 0
    for n in range(runs.shape[0]):
        first, past = min(first, runs[n, FIRST]), max(past, runs[n, PAST])
    return first // BINS * BINS, past


@compiled_with(moments)
def choose(
    bodies, begins, runs, owner, pools, n_columns, tile_starts, tile_weights, tiles, gain, background,
    body_echo, strongest, share, body_id, left, means,
):  # fmt: skip
    """In each bin of some beams the body with the strongest echo, and what is known of that echo.

    Parameters
    ----------
    bodies : (m,) numbers, rising; begins : (m + 1,) where each one's runs begin and end
    runs, owner : (n, 5) of `moments.gather`, by body and column, and (n,) in which of the pools they are
    pools : two, of `moments.gather`
    tile_starts, tile_weights : of `tiles_of`; tiles : (2,) first and past the last of them that are done
    gain : (K,)
    background : (numbers,) bool
    body_echo : (numbers,) float64, added to: the echo with the gain
    strongest, share, left : (B, K) float32, zeros: that body's echo, its share of all, the echo of background
    body_id : (B, K) uint16, zeros
    means : (3, B, K) float32, zeros: mean elevation and incidence, radians, and mean range less `middle_of`
    """
    B, K = strongest.shape
    t0, t1 = tiles
    origin, end = tile_starts[t0], 0
    for t in range(t0, t1):
        origin, end = min(origin, tile_starts[t]), max(end, tile_starts[t] + tile_weights.shape[1])
    n_panel = end - origin
    panel, rows = np.zeros((n_panel + BEAMS) * BINS, np.float32), np.empty(BEAMS * BINS, np.float32)
    for m in range(bodies.shape[0]):
        body, mine = bodies[m], slice(begins[m], begins[m + 1])
        k_first, k_past = _bins_of(runs[mine])
        for k0 in range(k_first, k_past, BINS):
            k1 = min(k0 + BINS, K)
            low, high = _pack(runs[mine], owner[mine], pools, 0, k0, n_columns, origin, n_panel, panel)
            for t in range(t0, t1 if low < high else t0):
                if not _weigh(panel, low, high, origin, tile_starts[t], tile_weights[t], rows):
                    continue
                for b in range(BEAMS * t, min(BEAMS * (t + 1), B)):
                    row = rows[(b - BEAMS * t) * BINS : (b - BEAMS * t + 1) * BINS]
                    body_echo[body] += _compare(
                        row, body, gain[k0:k1], strongest[b, k0:k1], share[b, k0:k1], body_id[b, k0:k1]
                    )
                    if background[body]:
                        for k in range(k0, k1):
                            left[b, k] += row[k - k0]
    has_won = np.zeros(t1, np.bool_)
    for m in range(bodies.shape[0]):
        body, mine = bodies[m], slice(begins[m], begins[m + 1])
        k_first, k_past = _bins_of(runs[mine])
        for k0 in range(k_first, k_past, BINS):
            k1, wins = min(k0 + BINS, K), 0
            for t in range(t0, t1):
                has_won[t] = False
                for b in range(BEAMS * t, min(BEAMS * (t + 1), B)):
                    count = 0
                    for k in range(uint64(k0), uint64(k1)):
                        count += body_id[b, k] == body
                    has_won[t] |= count > 0
                wins += has_won[t]
            for moment in range(1, 4 if wins else 1):
                low, high = _pack(
                    runs[mine], owner[mine], pools, moment, k0, n_columns, origin, n_panel, panel
                )
                for t in range(t0, t1 if low < high else t0):
                    if not has_won[t]:
                        continue
                    _weigh(panel, low, high, origin, tile_starts[t], tile_weights[t], rows)
                    for b in range(BEAMS * t, min(BEAMS * (t + 1), B)):
                        out, at = means[moment - 1, b], (b - BEAMS * t) * BINS
                        for k in range(uint64(k0), uint64(k1)):
                            mean = rows[at + k - k0] / strongest[b, k]
                            out[k] = mean if body_id[b, k] == body else out[k]
    for b in range(BEAMS * t0, min(BEAMS * t1, B)):
        for k in range(K):
            if strongest[b, k] > 0.0:
                share[b, k] = strongest[b, k] / share[b, k]
            else:
                share[b, k] = 0.0
                means[0, b, k] = means[1, b, k] = means[2, b, k] = np.nan
