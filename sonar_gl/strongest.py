"""The compiled sums of labels: columns into beams, and in each bin the body with the strongest echo."""

from __future__ import annotations

import numpy as np
from numba import uint64

from sonar_gl import moments, scatter
from sonar_gl.compiled import compiled, compiled_with
from sonar_gl.moments import COLUMN, FIRST, PAST, PLACE
from sonar_gl.scatter import MOMENTS

# Beams at a time, so that what is read of columns serves several; bins at a time, so that what several beams
# hear stays in fast memory; and what is known of these bins, one row after the other.
BEAMS, BINS = 4, 64
ROW = MOMENTS * BINS


def tiles_of(first, weights):
    """Weights of BEAMS beams at a time, and the column where they begin.

    first : (B,), weights : (B, W), of `fan.beam_weights`

    Returns
    -------
    (T,) int64 columns, which may be negative; (T, W', BEAMS) float32, the last BEAMS rows of zeros
    """
    (B, W), corners = weights.shape, range(0, len(first), BEAMS)
    starts = np.array([first[b : b + BEAMS].min() for b in corners])
    stops = np.array([first[b : b + BEAMS].max() for b in corners])
    out = np.zeros((len(starts), W + BEAMS + (stops - starts).max(), BEAMS), np.float32)
    for b in range(B):
        at = first[b] - starts[b // BEAMS]
        out[b // BEAMS, at : at + W, b % BEAMS] = weights[b]
    return starts, out


@compiled
def _weigh(panel, low, high, origin, start, weights, rows):
    """Beams of one tile, in one block of bins; whether they hear anything.

    panel : (columns * ROW,), from column `origin` on, zeros for BEAMS columns from `high` on
    low, high : columns of it with an echo; start, weights : of the tile; rows : (BEAMS * ROW,)
    """
    low, high = max(low, start), min(high, start + weights.shape[0] - BEAMS)
    if low >= high:
        return False
    rows[:] = 0.0
    for x in range(low, high, 4):
        at, w = uint64((x - origin) * ROW), weights[uint64(x - start) : uint64(x - start + 4)]
        a0, a1, a2, a3 = w[0, 0], w[0, 1], w[0, 2], w[0, 3]
        b0, b1, b2, b3 = w[1, 0], w[1, 1], w[1, 2], w[1, 3]
        c0, c1, c2, c3 = w[2, 0], w[2, 1], w[2, 2], w[2, 3]
        d0, d1, d2, d3 = w[3, 0], w[3, 1], w[3, 2], w[3, 3]
        for k in range(uint64(ROW)):
            a, b = panel[at + k], panel[at + uint64(ROW) + k]
            c, d = panel[at + uint64(2 * ROW) + k], panel[at + uint64(3 * ROW) + k]
            rows[k] += (a0 * a + b0 * b) + (c0 * c + d0 * d)
            rows[uint64(ROW) + k] += (a1 * a + b1 * b) + (c1 * c + d1 * d)
            rows[uint64(2 * ROW) + k] += (a2 * a + b2 * b) + (c2 * c + d2 * d)
            rows[uint64(3 * ROW) + k] += (a3 * a + b3 * b) + (c3 * c + d3 * d)
    return True


@compiled
def _pack(runs, owner, pools, k0, n_columns, origin, end, panel):
    """Lay a body's runs in a block of bins side by side; the columns between which something lies."""
    low, high = end, origin
    for n in range(runs.shape[0]):
        if runs[n, FIRST] < k0 + BINS and runs[n, PAST] > k0:
            for x in range(origin + (runs[n, COLUMN] - origin) % n_columns, end, n_columns):
                low, high = min(low, x), max(high, x + 1)
    if low < high:
        panel[(low - origin) * ROW : (high - origin + BEAMS) * ROW] = 0.0
    for n in range(runs.shape[0]):
        first, past = max(runs[n, FIRST], k0), min(runs[n, PAST], k0 + BINS)
        if first < past:
            pool, length = pools[owner[n]], runs[n, PAST] - runs[n, FIRST]
            # columns come again where the fan is a circle
            for x in range(origin + (runs[n, COLUMN] - origin) % n_columns, end, n_columns):
                for moment in range(MOMENTS):
                    begin = uint64(runs[n, PLACE] + moment * length + first - runs[n, FIRST])
                    at = uint64((x - origin) * ROW + moment * BINS + first - k0)
                    for k in range(uint64(past - first)):
                        panel[at + k] = pool[begin + k]
    return low, high


@compiled
def _divide(rows, at, middle_m, k0, n):
    """Make means of a beam's sums, which begin at `at`, in place."""
    at, k0 = uint64(at), uint64(k0)
    for k in range(uint64(n)):
        over = np.float32(1.0) / rows[at + k]
        rows[at + uint64(BINS) + k] *= over
        rows[at + uint64(2 * BINS) + k] *= over
        rows[at + uint64(3 * BINS) + k] = rows[at + uint64(3 * BINS) + k] * over + middle_m[k0 + k]


@compiled
def _place(rows, at, body, b, k0, n, strongest, share, body_id, means):
    """Have a beam's bins know the echo and means of the first body there, which begin at `at`."""
    at, b, k0 = uint64(at), uint64(b), uint64(k0)
    for moment in range(uint64(1), uint64(MOMENTS)):
        mine, which = at + moment * uint64(BINS), moment - uint64(1)
        for k in range(uint64(n)):
            means[which, b, k0 + k] = rows[mine + k] if rows[at + k] > np.float32(0.0) else np.float32(np.nan)
    for k in range(uint64(n)):
        strongest[b, k0 + k] = max(rows[at + k], np.float32(0.0))
        share[b, k0 + k] = np.float32(1.0) if rows[at + k] > np.float32(0.0) else np.float32(0.0)
    for k in range(uint64(n)):
        body_id[b, k0 + k] = body if rows[at + k] > np.float32(0.0) else 0


@compiled
def _compare(rows, at, body, b, k0, n, is_second, strongest, total, body_id, means):
    """Have a beam's bins know another body's echo; from the second one on there is a total."""
    at, b, k0 = uint64(at), uint64(b), uint64(k0)
    for moment in range(uint64(1), uint64(MOMENTS)):
        mine, which = at + moment * uint64(BINS), moment - uint64(1)
        for k in range(uint64(n)):
            stronger = rows[at + k] > strongest[b, k0 + k]
            means[which, b, k0 + k] = rows[mine + k] if stronger else means[which, b, k0 + k]
    for k in range(uint64(n)):
        stronger = rows[at + k] > strongest[b, k0 + k]
        body_id[b, k0 + k] = body if stronger else body_id[b, k0 + k]
    for k in range(uint64(n)):
        total[b, k0 + k] = rows[at + k] + (strongest[b, k0 + k] if is_second else total[b, k0 + k])
        strongest[b, k0 + k] = max(rows[at + k], strongest[b, k0 + k])


@compiled
def _sum(rows, at, gain, k0, n):
    """The sum of a beam's echo times the gain."""
    at, k0, first, second = uint64(at), uint64(k0), 0.0, 0.0
    for k in range(uint64(0), uint64(n - n % 2), uint64(2)):  # two: each addition waits for the one before
        first += np.float64(rows[at + k]) * gain[k0 + k]
        second += np.float64(rows[at + k + uint64(1)]) * gain[k0 + k + uint64(1)]
    if n % 2:
        first += np.float64(rows[at + uint64(n - 1)]) * gain[k0 + uint64(n - 1)]
    return first + second


@compiled_with(moments, scatter)
def choose(
    bodies, begins, runs, owner, pools, n_columns, tile_starts, tile_weights, tiles, gain, middle_m,
    background, body_echo, strongest, share, body_id, left, means,
):  # fmt: skip
    """In each bin of some beams the body with the strongest echo, and what is known of that echo.

    Parameters
    ----------
    bodies : (m,) numbers, rising; begins : (m + 1,) where each one's runs begin and end
    runs, owner : (n, 5) of `moments.gather`, by body and column, and (n,) in which of the pools they are
    pools : two, of `moments.gather`
    tile_starts, tile_weights : of `tiles_of`; tiles : (2,) first and past the last of them that are done
    gain : (K,); middle_m : (K,) float32, of `scatter.middle_of`
    background : (numbers,) bool
    body_echo : (numbers,) float64, added to: the echo with the gain
    strongest, share : (B, K) float32: that body's echo, and its share of all
    body_id : (B, K) uint16
    left : (B, K) float32, zeros: the echo of background; only where there is any
    means : (3, B, K) float32: mean elevation and incidence, radians, and range, metres
    """
    B, K = strongest.shape
    t0, t1 = tiles
    if t0 >= t1:  # of few beams the other half has all
        return
    origin, end = tile_starts[t0], 0
    for t in range(t0, t1):
        origin, end = min(origin, tile_starts[t]), max(end, tile_starts[t] + tile_weights.shape[1])
    panel, rows = np.zeros((end - origin + BEAMS) * ROW, np.float32), np.empty(BEAMS * ROW, np.float32)
    n_heard = np.zeros((B, K // BINS + 1), np.int64)
    for m in range(bodies.shape[0]):
        body, mine = bodies[m], slice(begins[m], begins[m + 1])
        k_first, k_past = K, 0
        for n in range(begins[m], begins[m + 1]):
            k_first, k_past = min(k_first, runs[n, FIRST]), max(k_past, runs[n, PAST])
        for k0 in range(k_first // BINS * BINS, k_past, BINS):
            low, high = _pack(runs[mine], owner[mine], pools, k0, n_columns, origin, end, panel)
            n_bins = min(BINS, K - k0)
            for t in range(t0, t1):
                if not _weigh(panel, low, high, origin, tile_starts[t], tile_weights[t], rows):
                    continue
                for b in range(BEAMS * t, min(BEAMS * (t + 1), B)):
                    at, known = (b - BEAMS * t) * ROW, (strongest, share, body_id, means)
                    count = n_heard[b, k0 // BINS]
                    body_echo[body] += _sum(rows, at, gain, k0, n_bins)
                    _divide(rows, at, middle_m, k0, n_bins)
                    if count == 0:
                        _place(rows, at, body, b, k0, n_bins, *known)
                    else:
                        _compare(rows, at, body, b, k0, n_bins, count == 1, *known)
                    n_heard[b, k0 // BINS] = min(count + 1, 2)
                    if background[body]:
                        for k in range(n_bins):
                            left[b, k0 + k] += rows[at + k]
    for b in range(BEAMS * t0, min(BEAMS * t1, B)):
        for k0 in range(0, K, BINS):
            k1 = min(k0 + BINS, K)
            if n_heard[b, k0 // BINS] == 0:
                share[b, k0:k1], body_id[b, k0:k1], means[:, b, k0:k1] = 0.0, 0, np.nan
            elif n_heard[b, k0 // BINS] > 1:
                for k in range(uint64(k0), uint64(k1)):
                    part = min(strongest[b, k] / share[b, k], np.float32(1.0))
                    share[b, k] = part if strongest[b, k] > 0.0 else np.float32(0.0)
