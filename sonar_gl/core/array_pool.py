"""Pools of arrays, reused once no caller holds a reference."""

from __future__ import annotations

import sys

import numpy as np

MAX_ARRAYS = 32


class ArrayPool:
    """A pool of arrays of one shape and type; fresh memory costs as much as filling it, by its page faults.

    A caller that holds an array, or a view of one, holds a reference to it. An array is free when it has no more
    references than one that was never returned.
    """

    def __init__(self, shape, dtype=np.float32):
        self._shape, self._dtype, self._arrays = shape, dtype, [np.empty(0, dtype)]
        self._free_count = self._references(0)
        self._arrays.clear()

    def _references(self, number: int) -> int:
        return sys.getrefcount(self._arrays[number])

    def empty(self) -> np.ndarray:
        """Return an array with arbitrary contents. The caller owns it."""
        for number in range(len(self._arrays)):
            if self._references(number) == self._free_count:
                array = self._arrays[number]
                array.setflags(write=True)
                return array
        array = np.empty(self._shape, self._dtype)
        if len(self._arrays) < MAX_ARRAYS:
            self._arrays.append(array)
        return array


class ArrayPools:
    """Pools by shape and type. Those who share this object share arrays, as long as they run one at a time."""

    def __init__(self):
        self._pools: dict[tuple, ArrayPool] = {}

    def pool(self, shape, dtype=np.float32) -> ArrayPool:
        """Return the pool of arrays of this shape and type."""
        return self._pools.setdefault((shape, np.dtype(dtype)), ArrayPool(shape, dtype))
