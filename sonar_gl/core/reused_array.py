"""An array that is used again and again, for more or fewer rows."""

from __future__ import annotations

import numpy as np

# It is made so many times larger than needed: the system provides memory only for what is used. It is replaced by a
# smaller one where so many uses in a row have needed less than one of MAX_ROWS_PER_NEEDED rows, or else coarse pings
# would keep the memory of a fine one; not below MIN_KEPT rows. The sectors of a ping take turns, and those of side
# lobes need few rows: a smaller array at once would be replaced by a larger one in each ping. Under "When memory is
# given back" docs/architecture.md says why there are other rules, too.
RESERVE, MAX_ROWS_PER_NEEDED, MIN_KEPT, USES_BEFORE_SMALLER = 2, 4, 1 << 16, 256
MAX_KEPT_ROWS = 1 << 18


class ReusedArray:
    """An array that is used again, for as many rows as are asked for.

    row : shape of a row
    """

    def __init__(self, dtype, *row: int):
        self._array = np.empty((0, *row), dtype)
        self._most, self._n_uses = 0, 0  # rows asked for, and how often, since most of it was in use

    def __len__(self) -> int:
        return len(self._array)

    def take(self, count: int) -> np.ndarray:
        """Return an array of so many rows; what was in it may be there still."""
        size = len(self._array)
        if size <= MIN_KEPT or size <= MAX_ROWS_PER_NEEDED * count:
            self._most = self._n_uses = 0
        else:
            self._most, self._n_uses = max(self._most, count), self._n_uses + 1
        if size < count or self._n_uses > USES_BEFORE_SMALLER:
            self._array = np.empty(
                (RESERVE * max(count, self._most), *self._array.shape[1:]), self._array.dtype
            )
            self._most = self._n_uses = 0
        return self._array[:count]

    def drop_large(self) -> None:
        """Drop an array of more than MAX_KEPT_ROWS rows; what was taken stays valid."""
        if len(self._array) > MAX_KEPT_ROWS:
            self._array = self._array[:0].copy()
