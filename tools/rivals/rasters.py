"""Ours, and what else can be made of what it draws."""

from __future__ import annotations

import numpy as np

import sonar_gl as sg
from rivals.common import Rival
from rivals.sums import mean_bins


class Raster:
    """Ours, whole, with footprints or with point bins."""

    def __init__(self, scene, sonar, acoustics, pose, rung, reducer="footprint"):
        self.simulator = sg.Simulator(scene, sonar, acoustics, sg.Sampling(*rung, reducer))
        self.samples = sum(sector.rows * sector.columns for sector in self.simulator.fan.sectors)
        self.close = self.simulator.close

    def ping(self, pose):
        """(B, K) intensity."""
        return self.simulator.ping(pose).intensity


class MeanRaster(Rival):
    """Our raster; a bin holds the mean, not the sum, of what falls into it in each strip.

    Its scale is arbitrary: `factor` is set from outside, to what fits best.
    """

    factor = 1.0

    def __init__(self, scene, sonar, acoustics, pose, rung):
        super().__init__(scene, sonar, acoustics, sampling=sg.Sampling(*rung))
        self.simulator = sg.Simulator(scene, sonar, acoustics, sg.Sampling(*rung))
        self.samples = sum(sector.rows * sector.columns for sector in self.simulator.fan.sectors)
        self.work = np.zeros((2, 2, sonar.n_bins), np.float32)
        self.close = self.simulator.close

    def ping(self, pose):
        """(B, K) intensity."""
        sums = self.reducer.sums
        with self.simulator._drawing():
            views = self.simulator._samples.now.views(pose)

            def work(half):
                for owner, index, parts in self.reducer.jobs:
                    if owner == half:
                        sector, plane_echo, _ = views[index]
                        sums[np.unique(parts[0])] = 0
                        mean_bins(
                            plane_echo, sector.u, sector.v, sector.tan_elevation, *parts,
                            self.r_first, self.per_metre, self.work[half], sums,
                        )  # fmt: skip

            self.both(work)
        out = self.beams()
        out *= np.float32(self.factor)
        return out
