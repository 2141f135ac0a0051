"""Random waves of place-locked speckle, kept from ping to ping."""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np

from sonar_gl.noise.gaussian import standard_normal

CHUNK = 64  # waves per random stream
RECENT_USES = 8  # of waves: two pings take those of four cells each


class Waves(NamedTuple):
    """Random waves of a cell of the sea.

    chunks : their numbers, CHUNK waves each
    coefficients : (waves, 2, bins) float32, complex amplitudes, read-only
    """

    chunks: range
    coefficients: np.ndarray


class WaveCache:
    """The waves that the last pings received: those of a sonar that moves are mostly the same.

    Those that were not used for longest make room, unless that was a moment ago: of cells that are used in turn and do
    not all fit, each would go just before it is used again.

    max_bytes : of the waves that it keeps
    """

    def __init__(self, max_bytes: int):
        self._max_bytes = max_bytes
        # With the number of their last use, the oldest first. It is replaced at once and never changed, for other
        # threads: a signal handler that pings would wait for ever for a lock that the code below it holds.
        self._cells: dict[Hashable, tuple[int, Waves]] = {}
        self._n_uses = 0

    def waves(self, key: Hashable, chunks: range, n_bins: int, generator) -> Waves:
        """Return waves of a cell: these chunks, or more.

        key : with `n_bins` what determines the waves, besides the numbers of their chunks
        generator : function (chunk) -> numpy.random.Generator
        """
        key = key, n_bins
        _, old = self._cells.get(key, (0, None))
        if old is None or chunks.start < old.chunks.start or old.chunks.stop < chunks.stop:
            found = Waves(chunks, np.empty((len(chunks) * CHUNK, 2, n_bins), np.float32))
            for chunk in chunks:
                known = old is not None and chunk in old.chunks
                _chunk_of(found, chunk)[:] = (
                    _chunk_of(old, chunk) if known else standard_normal(generator(chunk), (CHUNK, 2, n_bins))
                )
            found.coefficients.setflags(write=False)
        else:
            found = old
        self._n_uses = n_uses = self._n_uses + 1
        cells = dict(self._cells)
        cells.pop(key, None)
        if self._make_room(cells, found.coefficients.nbytes, n_uses):
            cells[key] = n_uses, found
        self._cells = cells
        return found

    def _make_room(self, cells: dict, n_bytes: int, n_uses: int) -> bool:
        """Return whether so many bytes fit, after those of the cells have gone that may go."""
        room = self._max_bytes - n_bytes - sum(waves.coefficients.nbytes for _, waves in cells.values())
        while room < 0 and cells:
            oldest = next(iter(cells))
            last_use, waves = cells[oldest]
            if last_use > n_uses - RECENT_USES:
                return False
            room += waves.coefficients.nbytes
            del cells[oldest]
        return room >= 0


def _chunk_of(waves: Waves, chunk: int) -> np.ndarray:
    """Return the coefficients of a chunk."""
    first = (chunk - waves.chunks.start) * CHUNK
    return waves.coefficients[first : first + CHUNK]
