"""The base of all rivals: columns, sums, two threads, beams and range gain."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

import sonar_gl as sg
from sonar_gl.beamform.kernels.beams import beam_tiles, weigh_columns
from sonar_gl.beamform.kernels.range_bins import bin_table
from sonar_gl.beamform.weights import beam_weights
from sonar_gl.core.worker import SecondThread
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.sector import make_strips


class Rival:
    """Columns, sums, two threads, beams and range gain, as ours has them.

    Attributes
    ----------
    fan : Fan
    halves : two slices of its columns, one for each thread
    sums : (columns, K) float32, which the rivals fill; all of it counts
    bins : BinTable
    gain : (K,) float32
    renderer : what draws, as in `Simulator.gl_info`
    """

    renderer = "CPU"

    def __init__(self, sonar, acoustics, sampling=None, n_columns=None):
        reach, pattern = acoustics.receive_support_rad(sonar), acoustics.receive_pattern(sonar)
        fan = make_fan(sonar, sampling or sg.Sampling(1, 16), BeamShape(reach, pattern is None))
        if n_columns:
            edges = fan.column_edges_rad
            edges = np.linspace(edges[0], edges[-1], n_columns + 1)
            strips = make_strips(fan.sectors, edges)
            sectors = tuple(
                replace(sector, strips=mine) for sector, mine in zip(fan.sectors, strips, strict=True)
            )
            fan = replace(fan, sectors=sectors, column_edges_rad=edges)
        self.sonar, self.fan, self.thread = sonar, fan, SecondThread()
        self.weights, self.is_box = beam_weights(fan, pattern, reach), pattern is None
        self.tiles = tuple(beam_tiles(self.weights.first, self.weights.weights))
        n_tiles = len(self.tiles[0])
        self.parts = (0, (n_tiles + 1) // 2), ((n_tiles + 1) // 2, n_tiles)
        self.sums = np.zeros((fan.n_columns, sonar.n_bins), np.float32)
        self.spans = np.tile([0, sonar.n_bins], (fan.n_columns, 1))
        middle = (fan.n_columns + 1) // 2
        self.halves = slice(0, middle), slice(middle, fan.n_columns)
        self.bins = bin_table(sonar.bin_edges_m)
        self.gain = acoustics.range_gain(sonar.range_m, sonar).astype(np.float32)
        self.r_first = sonar.range_min_m
        self.per_metre = sonar.n_bins / (sonar.range_max_m - sonar.range_min_m)
        self.top = math.radians(sonar.elevation_fov_deg) / 2

    def cells(self, per_spacing):
        """Cut the fan's columns into cells, `per_spacing` to a beam spacing or nearly so.

        Returns
        -------
        columns : (C,) int, that the cells lie in
        edges : (C + 1,) radians
        """
        edges = self.fan.column_edges_rad
        wanted = math.radians(self.sonar.azimuth_fov_deg) / self.sonar.n_beams / per_spacing
        n = np.maximum(np.rint(np.diff(edges) / wanted), 1).astype(int)
        parts = [np.linspace(edges[c], edges[c + 1], m, endpoint=False) for c, m in enumerate(n)]
        return np.repeat(np.arange(len(n)), n), np.append(np.concatenate(parts), edges[-1])

    def beams(self) -> np.ndarray:
        """Return (B, K) intensity from the columns' sums."""
        out = np.zeros((self.sonar.n_beams, self.sonar.n_bins), np.float32)

        def work(half):
            weigh_columns(self.sums, self.spans, self.tiles, self.parts[half], self.gain, out)

        self.both(work)
        return out

    def both(self, work):
        """Call work(0) and work(1) in two threads."""
        self.thread.run_halves(work)

    def close(self):
        """End the second thread."""
        self.thread.close()
