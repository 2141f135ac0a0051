"""What labels say of a ping: in each bin the body with the strongest echo, and what is known of that echo."""

from __future__ import annotations

import numpy as np

from sonar_gl.given import Given
from sonar_gl.moments import BODY, COLUMN, PLACE, gather
from sonar_gl.scatter import CELL, middle_of
from sonar_gl.strongest import choose, tiles_of

# A bin is in shadow where less than this is left of what the background alone would echo: nine tenths of the
# beam are covered then, and what side lobes hear beside a shadow (−13 dB of an even line array) is not much.
LEFT_IN_SHADOW = 0.1
SLOTS, RUNS, POOL = 4, 1024, 1 << 18  # room to begin with: bodies in a column, runs of bins, numbers


class Labeller:
    """Finds labels; owns what every ping uses again.

    Parameters
    ----------
    fan : Fan
    first, weights : of `fan.beam_weights`
    tables, elevation, arcs : of `moments.gather`
    """

    def __init__(self, fan, first, weights, tables, elevation, arcs):
        shape = len(first), fan.sonar.n_bins
        self.fan, self.tables, self.elevation, self.arcs = fan, tables, elevation, arcs
        self.edges, self.middle_m = fan.sonar.bin_edges_m, middle_of(tables[0]).astype(np.float32)
        self.tiles = tiles_of(first, weights)
        n_tiles = len(self.tiles[0])
        self.halves = (0, (n_tiles + 1) // 2), ((n_tiles + 1) // 2, n_tiles)
        self._floats, self._numbers, self._means = Given(shape), Given(shape, np.uint16), Given((3, *shape))
        self._kept = [
            (
                np.zeros((SLOTS, shape[1], CELL)),
                np.empty((RUNS, PLACE + 1), np.int64),
                np.empty(POOL, np.float32),
            )
            for _ in range(2)
        ]

    def find(self, views, jobs, run, gain, n_bodies: int, background=None, alone=None) -> dict:
        """Fields of a Ping.

        Parameters
        ----------
        views : (sector, (R, C, 4) plane and echo, (R, C) body) of each sector
        jobs : (half, index of the sector, parts) of each
        run : function (work) that does work(0) and work(1)
        gain : (K,) float32
        n_bodies : the highest number of a body
        background : (n_bodies + 1,) bool by number, or None for no shadow
        alone : (B, K) what it would echo alone, without the gain
        """
        used = [(0, 0), (0, 0)]
        spread = self.fan.sampling.reducer == "footprint"

        def sum_up(half):
            for owner, index, parts in jobs:
                if owner == half:
                    sector, plane_echo, bodies = views[index]
                    lattice = sector.u, sector.v, sector.tan_elevation
                    tables = self.edges, self.tables, spread, self.elevation, self.arcs
                    *kept, n_runs, n = gather(
                        plane_echo, bodies, *lattice, *parts, *tables, *self._kept[half], *used[half]
                    )
                    self._kept[half], used[half] = tuple(kept), (n_runs, n)

        run(sum_up)
        runs = np.concatenate([kept[1][:n] for kept, (n, _) in zip(self._kept, used, strict=True)])
        owner = np.repeat([0, 1], [n for n, _ in used])
        order = np.lexsort((runs[:, COLUMN], runs[:, BODY]))
        runs, owner = runs[order], owner[order]
        bodies, begins = np.unique(runs[:, BODY], return_index=True)
        begins = np.append(begins, len(runs))
        strongest, share, means = self._floats.any(), self._floats.any(), self._means.any()
        body_id, body_echo = self._numbers.any(), np.zeros((2, n_bodies + 1))
        left = np.empty((0, 0), np.float32) if background is None else self._floats.zeros()
        is_background = np.zeros(n_bodies + 1, bool) if background is None else background
        pools = tuple(kept[2] for kept in self._kept)

        def pick(half):
            choose(
                bodies, begins, runs, owner, pools, self.fan.n_columns, *self.tiles, self.halves[half], gain,
                self.middle_m, is_background, body_echo[half], strongest, share, body_id, left, means,
            )  # fmt: skip

        run(pick)
        elevation, incidence, range_m = means
        return {
            "body_id": body_id,
            "elevation_rad": elevation,
            "incidence_rad": incidence,
            "true_range_m": range_m,
            "share": share,
            "body_echo": body_echo.sum(axis=0),
            "shadow": None if background is None else (alone > 0) & (left < LEFT_IN_SHADOW * alone),
        }
