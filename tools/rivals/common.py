"""What all rivals have in common."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

import sonar_gl as sg
from sonar_gl.fan import beam_weights, make_fan
from sonar_gl.lattice import make_parts
from sonar_gl.reduce import Reducer


class Rival:
    """What all have in common: columns, sums, two threads, beams and gain."""

    def __init__(self, scene, sonar, acoustics, sampling=None, n_columns=None):
        reach, pattern = acoustics.beam_reach_rad(sonar), acoustics.beam_pattern_function(sonar)
        fan = make_fan(sonar, sampling or sg.Sampling(1, 16), reach, box=pattern is None)
        if n_columns:
            edges = fan.column_edges_rad
            edges = np.linspace(edges[0], edges[-1], n_columns + 1)
            sectors = tuple(replace(sector, parts=make_parts(sector, edges)) for sector in fan.sectors)
            fan = replace(fan, sectors=sectors, column_edges_rad=edges)
        self.sonar, self.fan = sonar, fan
        self.reducer = Reducer(fan, *beam_weights(fan, pattern, reach))
        self.gain = acoustics.gain(sonar.range_m, sonar).astype(np.float32)
        self.r_first, self.per_metre = (
            sonar.range_min_m,
            sonar.n_bins / (sonar.range_max_m - sonar.range_min_m),
        )
        self.top = math.radians(sonar.elevation_fov_deg) / 2

    def cells(self, per_spacing):
        """Pieces of the fan's columns about as wide as asked for: (C,) columns, (C + 1,) edges, radians."""
        edges = self.fan.column_edges_rad
        wanted = math.radians(self.sonar.azimuth_fov_deg) / self.sonar.n_beams / per_spacing
        n = np.maximum(np.rint(np.diff(edges) / wanted), 1).astype(int)
        parts = [np.linspace(edges[c], edges[c + 1], m, endpoint=False) for c, m in enumerate(n)]
        return np.repeat(np.arange(len(n)), n), np.append(np.concatenate(parts), edges[-1])

    def beams(self) -> np.ndarray:
        """(B, K) from the columns' sums."""
        out = self.reducer._beams(self.reducer.sums)
        out *= self.gain
        return out

    def both(self, work):
        """work(0) and work(1), in two threads."""
        self.reducer._both(work)

    def close(self):
        """Nothing is held that needs it."""
