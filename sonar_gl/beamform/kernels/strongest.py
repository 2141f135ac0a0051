"""The body with the strongest echo in each bin of each beam, for labels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.beams import TILE_BEAMS, BeamTiles
from sonar_gl.beamform.kernels.moments import MOMENTS
from sonar_gl.beamform.kernels.runs import COLUMN, FIRST_BIN, PAST_BIN, PLACE, Runs
from sonar_gl.core.compiled import compiled, inlined, uncounted

# Bins at a time, so that what a tile's beams read and write stays in fast memory; and the moments of these bins,
# one row after the other.
TILE_BINS = 64
TILE_ROW = MOMENTS * TILE_BINS
# A fainter echo counts as none: a float32 holds neither its inverse nor its moments.
FAINTEST = np.float32(1e-37)


class StrongestEcho(NamedTuple):
    """What is known of the strongest body's echo in each bin: (B, K) arrays, overwritten.

    share : float32, of all direct echo in the bin; body_id : uint16
    background : float32, the echo of background bodies; of no length if it is not wanted
    means : (3, B, K) float32: mean elevation and incidence, radians, and range, metres
    """

    share: np.ndarray
    body_id: np.ndarray
    background: np.ndarray
    means: np.ndarray


class PingEcho(NamedTuple):
    """What labels need of a ping beside its runs.

    is_background : (numbers,) bool
    body_bins : (numbers, 2) int64, first bin in which a body may be and past the last; of no length if not known
    middle_m : (K,) float32, of BinTable
    direct : (B, K) float32, direct echo with the gain; of no length where runs hold all of it
    gain : (K,) float32
    """

    is_background: np.ndarray
    body_bins: np.ndarray
    middle_m: np.ndarray
    direct: np.ndarray
    gain: np.ndarray


class TileRoom(NamedTuple):
    """Where the beams of one tile are summed in one block of bins; overwritten.

    weights : (4 * TILE_BEAMS,) float32, of four runs
    rows, best : (TILE_BEAMS * TILE_ROW,) float32, moments of one body, and of the strongest
    total : (TILE_BEAMS * TILE_BINS,) float32, echo of all bodies
    body_id : (TILE_BEAMS * TILE_BINS,) int32, the strongest body: as wide as floats, to select both alike
    stronger : (TILE_BINS,) int32, in which bins of one beam a body is stronger than those before it
    """

    weights: np.ndarray
    rows: np.ndarray
    best: np.ndarray
    total: np.ndarray
    body_id: np.ndarray
    stronger: np.ndarray


class Panel(NamedTuple):
    """The runs of all bodies in one block of bins, side by side; those of one body in one column are added up.

    begins : (m + 1,) where the runs of each body begin and end
    column : (n,) of each run, rising in each body, counted on from the tiles' first column
    moments : ((n + 3) TILE_ROW,) float32; what follows a body's last run is finite
    """

    begins: np.ndarray
    column: np.ndarray
    moments: np.ndarray


@compiled
def find_strongest(runs, tiles, part, n_columns, ping, strongest):
    """Find in each bin of some beams the body with the strongest echo, and what is known of that echo.

    runs, tiles, ping, strongest : tuples of Runs, BeamTiles, PingEcho and StrongestEcho
    part : (2,) first and past the last of the tiles that are done
    n_columns : of `LabelColumns`
    """
    runs, tiles, ping, strongest = Runs(*runs), BeamTiles(*tiles), PingEcho(*ping), StrongestEcho(*strongest)
    t0, t1 = part
    if t0 >= t1:  # of few beams the other half has all
        return
    origin, end = tiles.first[t0:t1].min(), tiles.first[t0:t1].max() + tiles.weights.shape[1]
    room = TileRoom(
        np.empty(4 * TILE_BEAMS, np.float32),
        np.empty(TILE_BEAMS * TILE_ROW, np.float32),
        np.empty(TILE_BEAMS * TILE_ROW, np.float32),
        np.empty(TILE_BEAMS * TILE_BINS, np.float32),
        np.empty(TILE_BEAMS * TILE_BINS, np.int32),
        np.empty(TILE_BINS, np.int32),
    )
    panel, pasts = _make_panel(runs, n_columns, origin, end, ping.gain.shape[0]), _pasts_of(tiles, t0, t1)
    _find_in_tiles(runs, tiles, pasts, (t0, t1), (origin, end, n_columns), panel, ping, room, strongest)


@inlined
def _pasts_of(tiles, t0, t1):
    """Return (T,) past the last column that a beam of each tile receives, of tiles t0 to t1."""
    pasts = tiles.first + tiles.weights.shape[1]
    for t in range(t0, t1):
        while pasts[t] > tiles.first[t] and not tiles.weights[t, pasts[t] - tiles.first[t] - 1].any():
            pasts[t] -= 1
    return pasts


@uncounted
def _find_in_tiles(runs, tiles, pasts, part, columns, panel, ping, room, strongest):
    """Find the strongest body in each bin of some tiles' beams, one block of bins after the other.

    pasts : of `_pasts_of`
    part : first and past the last of the tiles
    columns : first and past the last of these tiles, and `n_columns` of `LabelColumns`
    """
    for k0 in range(0, ping.gain.shape[0], TILE_BINS):
        _pack_panel(panel, runs, k0, columns)
        for t in range(part[0], part[1]):
            _clear_background(strongest.background, t, k0)
            room.total[:] = 0.0
            is_first = True
            for m in range(runs.bodies.shape[0]):
                first = _first_from(panel, m, tiles.first[t])
                past = _first_from(panel, m, pasts[t])
                if first == past:
                    continue
                body, mine = runs.bodies[m], room.best if is_first else room.rows
                _weigh_runs(panel, first, past, tiles.first[t], tiles.weights[t], room.weights, mine)
                if ping.is_background[body]:
                    _add_background(strongest.background, mine, t, k0)
                if ping.body_bins.shape[0] > 0:
                    _clear_outside(mine, room.total, ping.body_bins, body, k0)
                if is_first:
                    _begin_comparison(np.int32(body), room)
                else:
                    _compare(np.int32(body), room)
                is_first = False
            for b in range(TILE_BEAMS * t, min(TILE_BEAMS * (t + 1), strongest.share.shape[0])):
                if is_first:
                    _write_nothing(b, k0, strongest)
                else:
                    _write_strongest(room, b - TILE_BEAMS * t, ping, b, k0, strongest)


@inlined
def _first_from(panel, m, column):
    """Return the first run of the m-th body whose column is at least this one, or past its last."""
    low, high = panel.begins[m], panel.begins[m + 1]
    while low < high:
        middle = (low + high) // 2
        if panel.column[middle] < column:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _clear_background(background, t, k0):
    """Set the echo of background bodies to zero in a tile's beams and a block of bins, if it is wanted."""
    for b in range(TILE_BEAMS * t, min(TILE_BEAMS * (t + 1), background.shape[0])):
        for k in range(k0, min(k0 + TILE_BINS, background.shape[1])):
            background[b, k] = 0.0


@inlined
def _add_background(background, rows, t, k0):
    """Add the echo of a background body to that of the others, if it is wanted; rows : of TileRoom."""
    for b in range(TILE_BEAMS * t, min(TILE_BEAMS * (t + 1), background.shape[0])):
        at = uint64((b - TILE_BEAMS * t) * TILE_ROW)
        for k in range(uint64(min(TILE_BINS, background.shape[1] - k0))):
            background[b, uint64(k0) + k] += rows[at + k]


@inlined
def _make_panel(runs, n_columns, origin, end, n_bins):
    """Return a Panel with room for the runs of any block of bins, in columns `origin` to `end`."""
    table, n_blocks = runs.table, (n_bins - 1) // TILE_BINS + 1
    counts = np.zeros(n_blocks, np.int64)
    for n in range(table.shape[0]):
        for block in range(table[n, FIRST_BIN] // TILE_BINS, (table[n, PAST_BIN] - 1) // TILE_BINS + 1):
            counts[block] += 1
    most = counts.max() * ((end - 1) // n_columns - origin // n_columns + 1)
    begins = np.zeros(runs.bodies.shape[0] + 1, np.int64)
    return Panel(begins, np.empty(most, np.int64), np.empty((most + 3) * TILE_ROW, np.float32))


@inlined
def _pack_panel(panel, runs, k0, columns):
    """Lay the runs in a block of bins from `k0` on side by side; columns : as of `_find_in_tiles`."""
    table, moments, n_packed = runs.table, panel.moments, 0
    origin, end, n_columns = columns
    for m in range(runs.bodies.shape[0]):
        panel.begins[m] = n_packed
        # columns repeat where the fan is a circle
        for turn in range(origin // n_columns * n_columns, end, n_columns):
            for n in range(runs.begins[m], runs.begins[m + 1]):
                x, first, past = turn + table[n, COLUMN], table[n, FIRST_BIN], table[n, PAST_BIN]
                if not (origin <= x < end and first < k0 + TILE_BINS and past > k0):
                    continue
                pool, share = runs.pools[runs.owner[n]], runs.share[n]
                low, high = uint64(max(first - k0, 0)), uint64(min(past - k0, TILE_BINS))
                # main lobe and side lobes, and wide columns, make several runs of one body in one column
                is_new = n_packed == panel.begins[m] or panel.column[n_packed - 1] != x
                if is_new:
                    panel.column[n_packed] = x
                    n_packed += 1
                is_whole = is_new and high - low == TILE_BINS
                if is_new and not is_whole:
                    for k in range(uint64((n_packed - 1) * TILE_ROW), uint64(n_packed * TILE_ROW)):
                        moments[k] = 0.0
                for moment in range(MOMENTS):
                    from_ = uint64(table[n, PLACE] + moment * (past - first) + max(k0 - first, 0))
                    to = uint64((n_packed - 1) * TILE_ROW + moment * TILE_BINS) + low
                    if is_whole:  # as most are of long runs: the compiler knows the length of this loop
                        for k in range(uint64(TILE_BINS)):
                            moments[to + k] = share * pool[from_ + k]
                    else:
                        for k in range(high - low):
                            moments[to + k] += share * pool[from_ + k]
    panel.begins[runs.bodies.shape[0]] = n_packed
    for k in range(uint64(n_packed * TILE_ROW), uint64((n_packed + 3) * TILE_ROW)):
        moments[k] = 0.0


@inlined
def _weigh_runs(panel, first, past, start, weights, w, rows):
    """Weigh some runs of a panel into the beams of one tile.

    start, weights : first column and weights of the tile; w, rows : `weights`, and `rows` or `best`, of TileRoom
    """
    moments = panel.moments
    for k in range(uint64(rows.shape[0])):
        rows[k] = 0.0
    for n in range(first, past, 4):  # four at a time: beams are read and written less often
        for i in range(uint64(4)):
            x = uint64(panel.column[min(n + i, past - 1)] - start)
            is_one = np.float32(n + i < past)
            for r in range(uint64(TILE_BEAMS)):
                w[uint64(TILE_BEAMS) * i + r] = weights[x, r] * is_one
        at = uint64(n * TILE_ROW)
        a0, a1, a2, a3 = w[0], w[1], w[2], w[3]
        b0, b1, b2, b3 = w[4], w[5], w[6], w[7]
        c0, c1, c2, c3 = w[8], w[9], w[10], w[11]
        d0, d1, d2, d3 = w[12], w[13], w[14], w[15]
        for k in range(uint64(TILE_ROW)):
            a, b = moments[at + k], moments[at + uint64(TILE_ROW) + k]
            c, d = moments[at + uint64(2 * TILE_ROW) + k], moments[at + uint64(3 * TILE_ROW) + k]
            rows[k] += (a0 * a + b0 * b) + (c0 * c + d0 * d)
            rows[uint64(TILE_ROW) + k] += (a1 * a + b1 * b) + (c1 * c + d1 * d)
            rows[uint64(2 * TILE_ROW) + k] += (a2 * a + b2 * b) + (c2 * c + d2 * d)
            rows[uint64(3 * TILE_ROW) + k] += (a3 * a + b3 * b) + (c3 * c + d3 * d)


@inlined
def _begin_comparison(body, room):
    """Begin with the first body in a tile's beams, whose moments `room.best` holds."""
    best, total, body_id = room.best, room.total, room.body_id
    for r in range(TILE_BEAMS):
        at, bins = uint64(r * TILE_ROW), uint64(r * TILE_BINS)
        for k in range(uint64(TILE_BINS)):
            total[bins + k] += best[at + k]
            body_id[bins + k] = body if best[at + k] > np.float32(0.0) else np.int32(0)


@inlined
def _compare(body, room):
    """Keep what is known of the stronger echo in each bin of a tile's beams, and add up all; `room.rows` holds one."""
    rows, best, total, body_id, stronger = room.rows, room.best, room.total, room.body_id, room.stronger
    for r in range(TILE_BEAMS):
        at, bins, n_stronger = uint64(r * TILE_ROW), uint64(r * TILE_BINS), np.int32(0)
        for k in range(uint64(TILE_BINS)):
            total[bins + k] += rows[at + k]
            is_stronger = np.int32(rows[at + k] > best[at + k])
            stronger[k] = is_stronger
            n_stronger += is_stronger
        if n_stronger == 0:
            continue
        # both are read before the choice: the compiler vectorises no other one
        for k in range(uint64(TILE_BINS)):
            before = body_id[bins + k]
            body_id[bins + k] = body if stronger[k] else before
        for moment in range(MOMENTS):
            mine = at + uint64(moment * TILE_BINS)
            for k in range(uint64(TILE_BINS)):
                one, other = rows[mine + k], best[mine + k]
                best[mine + k] = one if stronger[k] else other


@inlined
def _clear_outside(rows, total, body_bins, body, k0):
    """Set the echo of a body to zero in those bins from k0 on in which it cannot be; it stays a part of the total.

    rows, total : of TileRoom
    """
    low, high = max(body_bins[body, 0] - k0, 0), max(body_bins[body, 1] - k0, 0)
    for r in range(TILE_BEAMS):
        for k in range(TILE_BINS):
            if k < low or k >= high:
                total[r * TILE_BINS + k] += rows[r * TILE_ROW + k]
                rows[r * TILE_ROW + k] = 0.0


@inlined
def _write_strongest(room, r, ping, b, k0, strongest):
    """Write what is known of the strongest echo in a block of a beam's bins, the r-th of its tile."""
    best, total, body_id = room.best, room.total, room.body_id
    middle_m, direct, gain, n = ping.middle_m, ping.direct, ping.gain, min(TILE_BINS, ping.gain.shape[0] - k0)
    at, bins, b, k0 = uint64(r * TILE_ROW), uint64(r * TILE_BINS), uint64(b), uint64(k0)
    share, means, whole, nothing = strongest.share, strongest.means, np.float32(1.0), np.float32(0.0)
    if direct.shape[0] > 0:
        for k in range(uint64(n)):  # joined columns may give more of a faint echo than there is
            total[bins + k] = max(total[bins + k], direct[b, k0 + k] / gain[k0 + k])
    for k in range(uint64(n)):
        share[b, k0 + k] = min(best[at + k] / total[bins + k], whole) if best[at + k] > FAINTEST else nothing
    for k in range(uint64(n)):
        strongest.body_id[b, k0 + k] = body_id[bins + k] if best[at + k] > FAINTEST else np.int32(0)
    for k in range(uint64(TILE_BINS)):
        best[at + k] = whole / best[at + k] if best[at + k] > FAINTEST else np.float32(np.nan)
    for moment in range(uint64(MOMENTS - 2)):
        mine = at + (moment + uint64(1)) * uint64(TILE_BINS)
        for k in range(uint64(n)):
            means[moment, b, k0 + k] = best[mine + k] * best[at + k]
    # the range in fast memory first: to add to what was just written takes longer than all the rest
    mine = at + uint64((MOMENTS - 1) * TILE_BINS)
    for k in range(uint64(TILE_BINS)):
        best[mine + k] *= best[at + k]
    for k in range(uint64(n)):
        means[MOMENTS - 2, b, k0 + k] = best[mine + k] + middle_m[k0 + k]


@inlined
def _write_nothing(b, k0, strongest):
    """Write that no body has an echo in a block of a beam's bins."""
    share, means, body_id, b = strongest.share, strongest.means, strongest.body_id, uint64(b)
    first, past = uint64(k0), uint64(min(k0 + TILE_BINS, share.shape[1]))
    for k in range(first, past):
        share[b, k] = 0.0
    for k in range(first, past):
        body_id[b, k] = 0
    for moment in range(uint64(MOMENTS - 1)):
        for k in range(first, past):
            means[moment, b, k] = np.nan
