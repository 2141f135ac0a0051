"""Random waves of place-locked speckle, kept from ping to ping."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable

import numpy as np

from sonar_gl.noise.gaussian import standard_normal

CHUNK = 4  # waves per random stream
RECENT_USES = 8  # of waves: two pings take those of four cells each

# Waves of a cell of the sea, by the places of their chunks: (CHUNK, 2, bins) float32, complex amplitudes, read-only
Waves = dict[Hashable, np.ndarray]


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

    def waves(
        self,
        key: Hashable,
        chunks: Collection[Hashable],
        n_bins: int,
        generator: Callable[[Hashable], np.random.Generator],
    ) -> Waves:
        """Return waves of a cell: these chunks, or more.

        key : with `n_bins` what determines the waves, besides the places of their chunks
        generator : function (chunk) -> numpy.random.Generator
        """
        key = key, n_bins
        _, found = self._cells.get(key, (0, {}))
        if not all(chunk in found for chunk in chunks):
            old, found = found, {}
            for chunk in chunks:
                found[chunk] = old[chunk] if chunk in old else _new_chunk(generator(chunk), n_bins)
        self._n_uses = n_uses = self._n_uses + 1
        cells = dict(self._cells)
        cells.pop(key, None)
        if self._make_room(cells, _n_bytes(found), n_uses):
            cells[key] = n_uses, found
        self._cells = cells
        return found

    def _make_room(self, cells: dict, n_bytes: int, n_uses: int) -> bool:
        """Return whether so many bytes fit, after those of the cells have gone that may go."""
        room = self._max_bytes - n_bytes - sum(_n_bytes(waves) for _, waves in cells.values())
        while room < 0 and cells:
            oldest = next(iter(cells))
            last_use, waves = cells[oldest]
            if last_use > n_uses - RECENT_USES:
                return False
            room += _n_bytes(waves)
            del cells[oldest]
        return room >= 0


def _new_chunk(generator: np.random.Generator, n_bins: int) -> np.ndarray:
    """Return the waves of a chunk."""
    out = standard_normal(generator, (CHUNK, 2, n_bins))
    out.setflags(write=False)
    return out


def _n_bytes(waves: Waves) -> int:
    """Return the size of waves, whose chunks are all alike."""
    return len(waves) * next(iter(waves.values())).nbytes if waves else 0
