"""Draws of one ping or several, gathered before they are sent to the driver."""

from __future__ import annotations

import numpy as np

from sonar_gl.core.compiled import compiled

MAX_KEPT_DRAWS = 1 << 20  # 20 MB


class DrawList:
    """A list of draws that grows.

    Attributes
    ----------
    used : how many there are
    """

    def __init__(self):
        self._draws, self.used = np.empty((64, 5), np.uint32), 0

    def reserve(self, count: int) -> np.ndarray:
        """Return room for so many draws more; add to `used` how many were written."""
        if self.used + count > len(self._draws):
            old = self._draws
            self._draws = np.empty((2 * (self.used + count), 5), np.uint32)
            self._draws[: self.used] = old[: self.used]
        return self._draws[self.used :]

    def clear(self) -> None:
        """Drop all draws, and an array of very many, since coarse pings would keep the memory of a fine one."""
        self.used = 0
        if len(self._draws) > MAX_KEPT_DRAWS:
            self._draws = np.empty((64, 5), np.uint32)

    def filled(self) -> np.ndarray:
        """Return the (n, 5) uint32 draws: indices, instances, first index, first vertex, body's row."""
        return self._draws[: self.used]


@compiled
def draw_patches(chosen, first_face, n_faces, closed, row, draws):
    """Write patches as draws: (M, 5) uint32 of indices, instances, first index, first vertex, body's row.

    Returns
    -------
    how many of them, the first, are of closed bodies
    """
    n_closed = 0
    for k in range(chosen.shape[0]):
        patch, body = chosen[k, 0], chosen[k, 1]
        n_closed += closed[body] != 0
        draws[k, 0], draws[k, 1], draws[k, 2] = 3 * n_faces[patch], 1, 3 * first_face[patch]
        draws[k, 3], draws[k, 4] = 0, row + body
    return n_closed
