"""What the beamformers of a sonar share, so that another sampling costs neither time nor memory for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sonar_gl.beamform.kernels import work_table
from sonar_gl.beamform.kernels.body_sums import LabelRoom
from sonar_gl.beamform.kernels.moments import MOMENTS
from sonar_gl.beamform.kernels.runs import RUN, RunStore
from sonar_gl.core.memory import ArrayPools

# Initial room of labels: bodies in a column, runs of bins, numbers. Where it is too small, samples are summed twice;
# what is not used takes no memory.
SLOTS, RUNS, POOL = 16, 1 << 14, 1 << 22
# Weights of beams are kept for so many lattices of columns at least, a lattice and its mirror image, and for more while
# they are no more than so many bytes.
KEPT_COLUMNS, KEPT_BYTES = 2, 4e6
# Room for so many times the columns that are asked for. What is not used takes no memory. A table that has to grow in a
# live loop is new memory, whose first use takes longer than the sums.
ROOM = 1.5
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ColumnSums:
    """Sums of samples in columns and bins, rows of two larger arrays in which those of the wide columns follow.

    sums : (columns, K) float32
    spans : (columns, 2) first and past last bin that may differ from 0
    all_sums, all_spans : the same, with the wide columns
    """

    sums: np.ndarray
    spans: np.ndarray
    all_sums: np.ndarray
    all_spans: np.ndarray


class LabelSums:
    """Sums of samples by body, of two halves of the columns; the arrays are replaced by larger ones as needed.

    cells : (bodies, MOMENTS, K) float32 of each half
    stores : RunStore of each half
    """

    def __init__(self, n_bins: int):
        self.cells = [np.zeros((SLOTS, MOMENTS, n_bins), np.float32) for _ in range(2)]
        self.stores = [_empty_store(RUNS, POOL) for _ in range(2)]

    def clear(self, half: int) -> None:
        """Have the store of a half hold nothing."""
        self.stores[half] = self.stores[half]._replace(n_runs=0, n_pool=0)

    def take(self, half: int, needed: LabelRoom) -> bool:
        """Note what a half has in use; return False, with an empty and larger one, where it needs more than it has."""
        cells, store = self.cells[half], self.stores[half]
        room = LabelRoom(len(cells), len(store.runs), len(store.pool))
        if all(n <= of_room for n, of_room in zip(needed, room, strict=True)):
            self.stores[half] = store._replace(n_runs=needed.n_runs, n_pool=needed.n_pool)
            return True
        if needed.n_slots > room.n_slots:
            self.cells[half] = np.zeros((needed.n_slots, *cells.shape[1:]), np.float32)
        # twice as much: other sectors, and other pings, need more
        if needed.n_runs > room.n_runs or needed.n_pool > room.n_pool:
            self.stores[half] = _empty_store(
                max(room.n_runs, 2 * needed.n_runs), max(room.n_pool, 2 * needed.n_pool)
            )
        return False


def _empty_store(n_runs: int, n_pool: int) -> RunStore:
    """Return a store with room for so many runs, and numbers of them."""
    return RunStore(np.empty((n_runs, RUN), np.int64), 0, np.empty(n_pool, np.float32), 0)


class Workspace:
    """What beamformers of one sonar and its acoustics share. They must sum one at a time.

    pools : of the arrays that are returned; None for its own
    works : what the kernels sum each half of the strips in
    """

    def __init__(self, pools: ArrayPools | None = None):
        self.pools = ArrayPools() if pools is None else pools
        self._sums = self._label_sums = self._moments = None, None
        self._weights, self._made_once = {}, {}
        self.works = work_table.make_work(), work_table.make_work()

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return what depends on the sonar and its acoustics alone: made when it is first asked for."""
        if key not in self._made_once:
            self._made_once[key] = make()
        return self._made_once[key]

    def weights(self, column_edges_rad: np.ndarray, make: Callable[[], tuple]) -> tuple:
        """Return the weights of beams over some columns: BeamWeights, and FarLobes or None.

        Those used last are kept: coarse samplings have the same columns, and so have those that they are compared with.
        A live loop that comes back to them from fine ones would find them anew, which takes as long as a ping. The
        weights of fine ones of large fans are large.
        """
        key = column_edges_rad.tobytes()
        found = self._weights.pop(key, None)
        self._weights[key] = make() if found is None else found  # the last ones used are last
        n_bytes = sum(weights.weights.nbytes for weights, _ in self._weights.values())
        while len(self._weights) > KEPT_COLUMNS and n_bytes > KEPT_BYTES:
            n_bytes -= self._weights.pop(next(iter(self._weights)))[0].weights.nbytes
        return self._weights[key]

    def moments(
        self, n_column_moments: int, n_beam_moments: int, n_bins: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return room for the moments of blocks of columns, and of blocks of beams; arbitrary contents."""
        key = n_column_moments, n_beam_moments, n_bins
        if self._moments[0] != key:
            self._moments = key, tuple(np.empty((n, n_bins), np.float32) for n in key[:2])
        return self._moments[1]

    def column_sums(self, n_columns: int, n_bins: int, n_wide_columns: int = 0) -> ColumnSums:
        """Return room for sums; what was summed before may be there still, within its spans.

        All samplings share one table, which grows: a check of the error, which sums two of them, would else make and
        clear two. There may be room for more wide columns, since image sources have two kinds of them.
        """
        n_rows = n_columns + n_wide_columns
        kept_columns, kept = self._sums
        if kept is None or kept.all_sums.shape[1] != n_bins or len(kept.all_sums) < n_rows:
            n_rows = math.ceil(ROOM * n_rows)
            sums, spans = np.zeros((n_rows, n_bins), np.float32), np.tile([n_bins, 0], (n_rows, 1))
        elif kept_columns == n_columns:
            return kept
        else:
            sums, spans = kept.all_sums, kept.all_spans
        self._sums = n_columns, ColumnSums(sums[:n_columns], spans[:n_columns], sums, spans)
        return self._sums[1]

    def label_sums(self, n_bins: int) -> LabelSums:
        """Return room for labels."""
        if self._label_sums[0] != n_bins:
            self._label_sums = n_bins, LabelSums(n_bins)
        return self._label_sums[1]
