"""Arrays that are given away, and given again when nobody holds them any more."""

from __future__ import annotations

import sys

import numpy as np

MOST = 16  # that are kept to be given again


class Given:
    """Arrays of zeros of one shape. Fresh memory costs as much as filling it: a page fault every 4 kilobytes.

    Whoever has one, or a part of one, holds a reference to it. One that has no more references than an array
    that was never given away is free.
    """

    def __init__(self, shape, dtype=np.float32):
        self.shape, self.dtype, self.arrays = shape, dtype, [np.empty(0, dtype)]
        self.unheld = self._references(0)
        self.arrays.clear()

    def _references(self, number: int) -> int:
        return sys.getrefcount(self.arrays[number])

    def zeros(self) -> np.ndarray:
        """(…) of the dtype, which its owner may write to, keep or let go of."""
        array = self.any()
        array.fill(0)
        return array

    def any(self) -> np.ndarray:
        """The same, with whatever it holds."""
        for number in range(len(self.arrays)):
            if self._references(number) == self.unheld:
                array = self.arrays[number]
                array.setflags(write=True)
                return array
        array = np.empty(self.shape, self.dtype)
        if len(self.arrays) < MOST:
            self.arrays.append(array)
        return array
