"""Ours, and another sum over the samples that it renders."""

from __future__ import annotations

import numpy as np

import sonar_gl as sg
from tools import internals
from tools.chart.rivals.common import Rival
from tools.chart.rivals.sums import mean_bins


class Raster:
    """Ours, as users have it, with footprints or with point bins."""

    def __init__(self, scene, sonar, acoustics, pose, resolution, reducer="footprint", engine="cpu"):
        sampling = sg.Sampling(*resolution, reducer)
        self.simulator = sg.Simulator(scene, sonar, acoustics, sampling, engine=engine)
        self.renderer = self.simulator.gl_info["renderer"]
        self.samples = sum(sector.rows * sector.columns for sector in self.simulator.fan.sectors)
        self.close = self.simulator.close

    def ping(self, pose):
        """Return (B, K) intensity."""
        return self.simulator.ping(pose).intensity


class MeanRaster(Rival):
    """Our raster; a bin holds the mean, not the sum, of the echoes that fall into it in each strip.

    Attributes
    ----------
    factor : the scale, which is arbitrary; the caller sets it to what fits best
    """

    factor = 1.0

    def __init__(self, scene, sonar, acoustics, pose, resolution):
        super().__init__(sonar, acoustics, sampling=sg.Sampling(*resolution))
        self.simulator = sg.Simulator(scene, sonar, acoustics, sg.Sampling(*resolution), engine="cpu")
        self.samples = sum(sector.rows * sector.columns for sector in self.simulator.fan.sectors)
        self.work = np.zeros((2, 2, sonar.n_bins), np.float32)

    def close(self):
        """End the simulator and the second thread."""
        self.simulator.close()
        super().close()

    def ping(self, pose):
        """Return (B, K) intensity."""
        with internals.rendered(self.simulator, pose) as samples:

            def work(half):
                columns = self.halves[half]
                self.sums[columns] = 0
                for sector, plane_echo, *_ in samples:
                    strips = sector.strips
                    mine = slice(*np.searchsorted(strips.column, [columns.start, columns.stop]))
                    mean_bins(
                        plane_echo, sector.u, sector.v, sector.tan_high,
                        strips.column[mine], strips.middle[mine], strips.width[mine],
                        self.r_first, self.per_metre, self.work[half], self.sums,
                    )  # fmt: skip

            self.both(work)
        out = self.beams()
        out *= np.float32(self.factor)
        return out
