"""Arrays to which rows are appended one by one, in time in proportion to these rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

GROWTH = 2  # times the rows before, where there is no room for another append


class Room:
    """Memory behind arrays, by a name for each.

    An array and the longer one that `append` returns share memory, and neither changes. Where another array has the
    memory behind it, as after an append whose result nobody kept, the rows are copied.
    """

    def __init__(self):
        self._rooms: dict[
            str, tuple[np.ndarray, np.ndarray]
        ] = {}  # the last array returned, and all of its memory

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
