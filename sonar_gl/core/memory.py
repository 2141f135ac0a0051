"""Memory of arrays: what is reused or grows, since fresh memory costs page faults, and what is given back."""

from __future__ import annotations

import ctypes
import math
import mmap
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress

import numpy as np

MAX_ARRAYS = 32  # of an ArrayPool
GROWTH = 2  # times the rows before, where a DynamicArrays has no room for another append

# A ReusedArray has room for more than needed, so that finer samples use the memory of the coarser ones, and need new
# memory for the rest alone: the system provides memory only for what is used. Where the room is 4 MiB or more, it does
# so in pages of 2 MB, which NumPy asks for: an array that needs less than LARGE_BYTES has room for SMALL_ROOM_BYTES.
# Another one has room for ROOM_ROWS, as many as the samples of a view for which they are chosen, or for
# LARGE_ROOM_BYTES.
RESERVE, LARGE_BYTES, SMALL_ROOM_BYTES = 2, 2_000_000, 4_000_000
ROOM_ROWS, LARGE_ROOM_BYTES = 1 << 23, 1 << 27
# It is replaced by a smaller one where so many uses in a row have needed less than one of MAX_ROWS_PER_NEEDED rows, or
# else coarse pings would keep the memory of a fine one; not below MIN_KEPT rows. The sectors of a ping take turns, and
# those of side lobes need few rows: a smaller array at once would be replaced by a larger one in each ping. Under "When
# memory is given back" docs/architecture.md says why there are other rules, too.
MAX_ROWS_PER_NEEDED, MIN_KEPT, USES_BEFORE_SMALLER = 4, 1 << 16, 256
MAX_KEPT_ROWS = 1 << 18
PAGE_BYTES = 4096


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


class ReusedArray:
    """An array that is used again, for as many rows as are asked for.

    row : shape of a row

    n_last : rows that were asked for last
    """

    def __init__(self, dtype, *row: int):
        self._array = np.empty((0, *row), dtype)
        self._n_ready, self.n_last = 0, 0  # rows that have memory, and that were asked for last
        # a larger one that is being made ready, and how many of its rows are
        self._next, self._n_next_ready = None, 0
        self._most, self._n_uses = 0, 0  # rows asked for, and how often, since most of it was in use

    def __len__(self) -> int:
        return len(self._array)

    @property
    def _size(self) -> int:
        """Rows that have memory, or may soon."""
        return min(len(self._array), RESERVE * self._n_ready)

    @property
    def _row_bytes(self) -> int:
        """Bytes of a row."""
        return self._array.dtype.itemsize * math.prod(self._array.shape[1:])

    def _made(self, count: int) -> np.ndarray:
        """Return an array with room for so many rows and more."""
        room_bytes = SMALL_ROOM_BYTES if count * self._row_bytes < LARGE_BYTES else LARGE_ROOM_BYTES
        n_rows = max(RESERVE * count, min(room_bytes // self._row_bytes, ROOM_ROWS))
        return np.empty((n_rows, *self._array.shape[1:]), self._array.dtype)

    def take(self, count: int) -> np.ndarray:
        """Return an array of so many rows; what was in it may be there still."""
        if self._size <= MIN_KEPT or self._size <= MAX_ROWS_PER_NEEDED * count:
            self._most = self._n_uses = 0
        else:
            self._most, self._n_uses = max(self._most, count), self._n_uses + 1
        if len(self._array) < count and self._next is not None and count <= len(self._next):
            self._array, self._n_ready, self._next = self._next, self._n_next_ready, None
        elif len(self._array) < count or self._n_uses > USES_BEFORE_SMALLER:
            self._array, self._n_ready, self._next = self._made(max(count, self._most)), 0, None
            self._most = self._n_uses = 0
        self._n_ready, self.n_last = max(self._n_ready, count), count
        return self._array[:count]

    def missing_bytes(self, count: int) -> int:
        """Return what `prepare` uses in all, before so many rows are taken."""
        n_there = self.n_last if count <= len(self._array) else 0
        return max(count - n_there, 0) * self._row_bytes

    def prepare(self, count: int, share: float) -> None:
        """Have memory ready before so many rows are taken; a share of what is missing. What was taken stays as it is.

        Where there is no room for them it is that of another array, which `take` will go on with.
        """
        if count <= len(self._array):
            end = self.n_last + math.ceil(share * (count - self.n_last))
            self._n_ready = _used(self._array, self._n_ready, end)
            return
        if self._next is None or len(self._next) < count:
            self._next, self._n_next_ready = self._made(count), 0
        self._n_next_ready = _used(self._next, self._n_next_ready, math.ceil(share * count))

    def drop_large(self) -> None:
        """Drop an array of more than MAX_KEPT_ROWS rows; what was taken stays valid."""
        self._next = None
        if self._size > MAX_KEPT_ROWS:
            self._array, self._n_ready = self._array[:0].copy(), 0


def prepare_in_turn(arrays: Iterable[tuple[ReusedArray, int]], share: float) -> None:
    """As `ReusedArray.prepare` of several arrays and their rows, one after the other: a share of what all are missing.

    A share of each would take as many large pages as there are arrays, however small it is.
    """
    missing = [(one, count, one.missing_bytes(count)) for one, count in arrays]
    ready = share * sum(n_bytes for _, _, n_bytes in missing)
    for one, count, n_bytes in missing:
        if n_bytes and ready > 0:
            one.prepare(count, min(ready / n_bytes, 1.0))
        ready -= n_bytes


def _used(array: np.ndarray, first: int, end: int) -> int:
    """Use the rows of an array from one up to another for the first time; return how many have been used then."""
    if first < end:
        array[first:end].reshape(-1).view(np.uint8)[::PAGE_BYTES] = 0
    return max(first, end)


class DynamicArrays:
    """Arrays by name, to which rows are appended in time in proportion to these rows.

    An array and the longer one that `append` returns share memory, and neither changes. Where another array has the
    memory behind it, as after an append whose result nobody kept, the rows are copied.
    """

    def __init__(self):
        # by name: the last array returned, and all of its memory
        self._rooms: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def append(self, name: str, rows: np.ndarray, parts: Sequence) -> np.ndarray:
        """Return an array of these rows and of those of some parts, of its type, behind them."""
        last, room = self._rooms.get(name, (None, None))
        is_last = last is rows
        if not is_last:
            room = rows
        start = len(rows)
        count = start + sum(map(len, parts))
        if count == start:
            return rows
        if count > len(room):
            # exactly what is needed at first: most scenes are loaded, and never grow
            size = max(count, GROWTH * start) if is_last else count
            room = np.empty((size, *rows.shape[1:]), rows.dtype)
            room[:start] = rows
        for part in parts:
            room[start : start + len(part)] = part
            start += len(part)
        out = room[:count]
        self._rooms[name] = out, room
        return out


def sparse_table(n_rows: int, n_columns: int) -> np.ndarray:
    """Return a table of float64 zeros, of which only what is written becomes resident memory, page by page.

    NumPy asks Linux for pages of 2 MB for arrays of 4 MB and more: one number a row would make all of it resident.
    """
    private = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
    try:
        memory = mmap.mmap(-1, 8 * n_rows * n_columns, **private)
    except OSError as why:
        raise MemoryError(f"no room for {8 * n_rows * n_columns} bytes: {why}") from None
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        with suppress(OSError):  # a kernel without such pages
            memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory).reshape(n_rows, n_columns)


def return_free_memory() -> None:
    """Give freed memory back to the operating system; takes milliseconds.

    By itself glibc keeps what lies below memory in use: after large arrays were freed, hundreds of megabytes.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library; TypeError: of Windows
        ctypes.CDLL(None).malloc_trim(0)
