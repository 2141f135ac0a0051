"""Labels of a ping: in each bin the body with the strongest echo, and what is known of that echo."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.beams import BeamTiles, beam_tiles
from sonar_gl.beamform.kernels.body_sums import LabelRoom, sum_bodies
from sonar_gl.beamform.kernels.range_bins import BinTable
from sonar_gl.beamform.kernels.runs import sort_runs, sum_body_echo
from sonar_gl.beamform.kernels.strongest import PingEcho, StrongestEcho, find_strongest
from sonar_gl.beamform.weights import BeamWeights
from sonar_gl.beamform.workspace import ColumnSums, Workspace
from sonar_gl.core.compiled import compiled, rounded_alike
from sonar_gl.sonar.fan import Fan
from sonar_gl.sonar.samples import ViewSamples, whole_rows

# A bin is in shadow where less than this remains of the echo that the background alone would return: nine
# tenths of the beam are covered there, and what side lobes receive from beside a shadow (−13 dB for a uniform
# line array) is less.
MAX_SHADOW_ECHO = 0.1
# Columns are joined for labels while there are so many across a beam: a coarser picture of the beam pattern than echoes
# have. With four, P900-45 before `pylon` gives 0.4 % of the labelled bins to another body, and finer samples do so with
# 0.6 %.
COLUMNS_PER_BEAM = 4
# Where beams overlap, all of them together receive neighbouring columns alike. Columns are joined only if what all
# beams return of each is within this share of their mean: it bounds the error of a body's echo, whichever hold it.
UNEVEN = 2e-3
# Bins at a time of which labels are cleared, if any of them has one.
BLOCK_BINS = 64
# Of a bin: so far beyond the range of a body a bin may begin, or end, that has its label.
BEYOND_BODY = 1 / 8


@dataclass(frozen=True, eq=False)
class Labels:
    """Fields of a `Ping` that say what the strongest echo in each bin is; see there."""

    body_id: np.ndarray
    elevation_rad: np.ndarray
    incidence_rad: np.ndarray
    true_range_m: np.ndarray
    share: np.ndarray
    body_echo: np.ndarray
    shadow: np.ndarray | None


class BodySums(NamedTuple):
    """The echo of each body in columns and bins; valid until bodies are summed again in the same workspace.

    runs : plain tuple of Runs
    body_bins : of `bins_of_bodies`
    direct : (B, K) float32, all direct echo with the gain, in an array that is overwritten later; empty if the runs
        hold all of it, which is so without far side lobes and bubbles
    is_little : whether there is so little work that one thread does it
    """

    runs: tuple
    body_bins: np.ndarray
    direct: np.ndarray
    is_little: bool


def bins_of_bodies(body_spans: np.ndarray, bin_edges_m: np.ndarray) -> np.ndarray:
    """Return (numbers, 2) int64, the first bin in which each body may have labels, and past the last.

    Half a sample beyond the edge of a face that is seen nearly edge-on, its plane lies before or behind the body. Such
    echo is faint, but it would be labelled.

    body_spans : of `ViewSamples`; of no length where a host does not tell where its bodies are, as is then the result
    bin_edges_m : (K + 1,) evenly spaced

    >>> bins_of_bodies(np.array([[0, 0], [1 / 3.05, 1 / 2.05], [0.1, np.inf]]), np.linspace(2, 4, 21)).tolist()
    [[20, 20], [0, 11], [0, 20]]
    """
    out = np.empty((len(body_spans), 2), np.int64)
    _find_bins_of_bodies(body_spans, bin_edges_m, out)
    return out


@rounded_alike
def _find_bins_of_bodies(body_spans, bin_edges_m, out):
    """Fill out with what `bins_of_bodies` returns: NumPy's steps take ten times as long for few bodies."""
    n_bins, first_m, last_m = bin_edges_m.shape[0] - 1, bin_edges_m[0], bin_edges_m[-1]
    for n in range(out.shape[0]):
        first = (1 / body_spans[n, 1] - first_m) * n_bins / (last_m - first_m)
        past = (1 / body_spans[n, 0] - first_m) * n_bins / (last_m - first_m)
        out[n, 0] = min(max(np.floor(first - BEYOND_BODY), 0), n_bins)
        out[n, 1] = min(max(np.ceil(past + BEYOND_BODY), 0), n_bins)


def without_weaker(labels: Labels, direct: np.ndarray, other: np.ndarray) -> Labels:
    """Return the labels of bins whose strongest body is at least as strong as an echo without body; others have none.

    labels : with shares of the direct echo; its arrays are overwritten
    direct : (B, K) float32, direct echo before the matched filter
    other : (B, K) float32, the echo without body, likewise
    """
    _clear(labels, direct, other)
    return labels


def of_all_echo(labels: Labels, direct: np.ndarray, other: np.ndarray) -> Labels:
    """Return labels with shares of all echo, for those of the direct echo.

    labels : its shares are overwritten
    direct : (B, K) float32, direct echo before the matched filter
    other : (B, K) float32, all other echo, likewise
    """
    total = direct + other
    labels.share[...] *= np.divide(direct, total, out=total, where=total > 0)
    return labels


def without_faint(labels: Labels, intensity: np.ndarray, least: float) -> Labels:
    """Return the labels of bins in which the body itself has so much mean echo; others have none.

    Shadows and sums of bodies stay. A body has its share of the bin's echo: the far side lobes and the multipath of
    others, which lie over it, do not make it visible.

    labels : with shares of all echo; its arrays are overwritten
    intensity : (B, K) float32, mean echo of the ping
    least : intensity from which on bins are labelled
    """
    _clear(labels, intensity, np.full((1, 1), least, np.float32))
    return labels


def _clear(labels: Labels, echo: np.ndarray, least: np.ndarray) -> None:
    """Take the labels of bins whose body has less echo, but shadows and sums of bodies; arguments of `_clear_bins`."""
    means = labels.elevation_rad, labels.incidence_rad, labels.true_range_m
    _clear_bins(echo, least, labels.body_id, labels.share, *means)


@compiled
def _clear_bins(echo, least, body_id, share, elevation_rad, incidence_rad, true_range_m):
    """Set labels to those of bins without echo where the share of the echo is less than the least; all arrays (B, K).

    least : of one entry where it is the same in all bins
    """
    nothing, unknown = np.float32(0.0), np.float32(np.nan)
    cleared, is_one = np.zeros(BLOCK_BINS, np.bool_), least.size == 1
    for b in range(uint64(share.shape[0])):
        for k0 in range(0, share.shape[1], BLOCK_BINS):
            first, n = uint64(k0), uint64(min(BLOCK_BINS, share.shape[1] - k0))
            if is_one:
                for k in range(n):
                    cleared[k] = share[b, first + k] * echo[b, first + k] < least[0, 0]
            else:
                for k in range(n):
                    cleared[k] = share[b, first + k] * echo[b, first + k] < least[b, first + k]
            # most bins that are to be cleared have no echo, and need nothing
            is_any = False
            for k in range(n):  # without branches, so that the compiler can vectorise it
                is_any |= cleared[k] & (elevation_rad[b, first + k] == elevation_rad[b, first + k])
            if not is_any:
                continue
            for k in range(n):
                at = first + k
                body_id[b, at] = np.uint16(0) if cleared[k] else body_id[b, at]
                share[b, at] = nothing if cleared[k] else share[b, at]
                elevation_rad[b, at] = unknown if cleared[k] else elevation_rad[b, at]
                incidence_rad[b, at] = unknown if cleared[k] else incidence_rad[b, at]
                true_range_m[b, at] = unknown if cleared[k] else true_range_m[b, at]


class LabelColumns(NamedTuple):
    """Neighbouring columns joined, in which the echoes of bodies are summed: these need not be as narrow.

    of_columns : (columns + W,) int64, the joined column of each of the fan's columns, then of its wide ones, which
        follow the joined columns
    count : number of joined columns
    wide_edges : (W + 1,) int64, joined columns between which the wide ones lie
    wide_shares : (count,) float32, the share of its wide column that a joined column takes
    tiles : BeamTiles of joined columns
    response : (count,) float64, what all beams together return of the echo in a joined column
    """

    of_columns: np.ndarray
    count: int
    wide_edges: np.ndarray
    wide_shares: np.ndarray
    tiles: BeamTiles
    response: np.ndarray


def label_columns(fan: Fan, weights: BeamWeights, is_box: bool, response: np.ndarray) -> LabelColumns:
    """Join columns where COLUMNS_PER_BEAM remain and all beams together receive them alike.

    is_box : beams are boxes, whose ends would lie within joined columns
    response : (columns,) `column_response` of the far lobes, or of the weights where there are none
    """
    widest_rad = 0.0 if is_box else weights.width_rad.min() / COLUMNS_PER_BEAM
    widths_rad, n = np.diff(fan.column_edges_rad), fan.n_columns
    limits = fan.wide_edges if fan.n_wide_columns else np.array([0, n])
    begins = []
    for first, past in itertools.pairwise(limits.tolist()):
        most = max(int(widest_rad / widths_rad[first:past].max() + 1e-9), 1)
        count = math.ceil((past - first) / most)
        begins.append(first + (np.arange(count) * (past - first)) // count)
    begins = np.concatenate(begins)
    counts = np.diff(np.append(begins, n))
    means = np.add.reduceat(response * widths_rad, begins) / np.add.reduceat(widths_rad, begins)
    off = np.abs(response - np.repeat(means, counts))
    uneven = np.maximum.reduceat(off, begins) > UNEVEN * means
    begins = np.union1d(begins, np.flatnonzero(np.repeat(uneven, counts)))
    of_columns = np.repeat(np.arange(len(begins)), np.diff(np.append(begins, n)))
    # of each beam, counted on from its first one: a fan that is a full circle goes on at its seam
    columns = weights.first[:, None] + np.arange(weights.weights.shape[1])
    joined = columns // n * len(begins) + of_columns[columns % n]
    first, place = joined[:, 0], joined - joined[:, :1]
    n_beams, width = len(first), int(place.max()) + 1
    cell = (np.arange(n_beams)[:, None] * width + place).ravel()
    received = np.bincount(cell, (weights.weights * widths_rad[columns % n]).ravel(), n_beams * width)
    joined_rad = np.add.reduceat(widths_rad, begins)
    of_all = np.add.reduceat(response * widths_rad, begins) / joined_rad
    of_beams = joined_rad[(first[:, None] + np.arange(width)) % len(begins)]
    return LabelColumns(
        np.append(of_columns, len(begins) + np.arange(fan.n_wide_columns)),
        len(begins),
        np.searchsorted(begins, fan.wide_edges) if fan.n_wide_columns else fan.wide_edges,
        np.add.reduceat(fan.wide_shares, begins) if fan.n_wide_columns else np.ones(len(begins), np.float32),
        beam_tiles(first, np.float32(received.reshape(n_beams, width) / of_beams)),
        of_all,
    )


class Labeller:
    """Finds labels.

    spreading : bins, spread and elevation_pattern of `sum_bodies`
    parts : which of the tiles of beams each half does
    n_beams : number of beams
    """

    def __init__(self, columns: LabelColumns, spreading: tuple, parts, n_beams: int, workspace: Workspace):
        self._columns, self._spreading, self._parts, self._workspace = columns, spreading, parts, workspace
        self._middle_m = BinTable(*spreading[0]).middle_m.astype(np.float32)
        shape, pools = (n_beams, len(self._middle_m)), workspace.pools
        self._floats, self._numbers = pools.pool(shape), pools.pool(shape, np.uint16)
        self._means = pools.pool((3, *shape))

    def sum_up(
        self, view: ViewSamples, strips, run: Callable, columns: ColumnSums, clear: Callable[[int], None]
    ) -> tuple:
        """Return the sums of each body, a plain tuple of Runs, which stay as they are until the next call.

        view : whose samples hold the numbers of bodies
        strips : of each half of the columns, StripTable of each sector as plain tuples
        run : function (work) that does work(0) and work(1)
        columns : the sums of all bodies are written to it, as by `Beamformer.sum_footprints`
        clear : function (half) that sets the sums of its columns to zero
        """
        room = self._workspace.label_sums(len(self._middle_m))
        # strips go along columns: read by rows, each number would come from another line of memory
        of_sectors = [
            (
                whole_rows(one.plane_echo),
                whole_rows(one.face_id),
                np.ascontiguousarray(one.body_id.T),
                view.body_spans,
                one.lattice,
            )
            for one in view.sectors
        ]

        def sum_sector(half, arrays, mine):
            used = sum_bodies(
                self._workspace.works[half],
                *arrays,
                mine,
                *self._spreading,
                self._columns.of_columns,
                room.cells[half],
                tuple(room.stores[half]),
                columns.all_sums,
                columns.all_spans,
            )
            return room.take(half, LabelRoom(*used))

        def work(half):
            is_done = False
            while not is_done:  # again where there was too little room, which is larger then
                clear(half)
                room.clear(half)
                sectors = zip(of_sectors, strips[half], strict=True)
                is_done = all(sum_sector(half, arrays, mine) for arrays, mine in sectors)

        run(work)
        joined = self._columns.count, self._columns.wide_edges, self._columns.wide_shares
        return sort_runs(tuple(tuple(store) for store in room.stores), *joined)

    def find(
        self,
        bodies: BodySums,
        run: Callable,
        gain: np.ndarray,
        n_bodies: int,
        is_background: np.ndarray | None = None,
        unshadowed: np.ndarray | None = None,
    ) -> Labels:
        """Return the labels of a ping.

        bodies : BodySums, whose runs `sum_up` returned
        run : as there
        gain : (K,) float32
        n_bodies : the highest number of a body
        is_background : (n_bodies + 1,) bool by number, or None for no shadow
        unshadowed : (B, K) echo of the background alone, without the gain
        """
        strongest = StrongestEcho(
            share=self._floats.empty(),
            body_id=self._numbers.empty(),
            background=np.empty((0, 0), np.float32) if is_background is None else self._floats.empty(),
            means=self._means.empty(),
        )
        mask = np.zeros(n_bodies + 1, bool) if is_background is None else is_background
        ping = PingEcho(mask, bodies.body_bins, self._middle_m, bodies.direct, gain)
        body_echo = np.zeros((2, n_bodies + 1))

        def pick(half):
            sum_body_echo(bodies.runs, self._columns.response, gain, half, body_echo[half])
            find_strongest(
                bodies.runs,
                tuple(self._columns.tiles),
                self._parts[half],
                self._columns.count,
                tuple(ping),
                tuple(strongest),
            )

        run(pick)
        elevation_rad, incidence_rad, true_range_m = strongest.means
        shadow = None
        if is_background is not None:
            shadow = (unshadowed > 0) & (strongest.background < MAX_SHADOW_ECHO * unshadowed)
        return Labels(
            body_id=strongest.body_id,
            elevation_rad=elevation_rad,
            incidence_rad=incidence_rad,
            true_range_m=true_range_m,
            share=strongest.share,
            body_echo=body_echo[0] + body_echo[1],
            shadow=shadow,
        )
