"""The methods of the chart: how each is made, its resolutions, how it is drawn.

A resolution is (samples a beam spacing, rows). They differ for wide and narrow beams; each method has the
ratio of columns to rows that served it best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from tools.chart.rivals.rasters import MeanRaster, Raster
from tools.chart.rivals.rays import PAPER, Lattice, PointRays, Tubes
from tools.chart.rivals.slices import Slices


@dataclass(frozen=True)
class Method:
    """One line of the chart."""

    label: str
    make: Callable
    wide: tuple
    narrow: tuple
    colour: str
    marker: str
    scenes: tuple = ()  # all, if empty

    def resolutions(self, beams: str, quick: bool) -> tuple:
        """Return the resolutions; every other one if quick."""
        found = self.wide if beams == "wide" else self.narrow
        return found[1:-1:2] if quick and len(found) > 1 else found


# about as wide as high: 0.176 degrees / c by 20 degrees / (114 c)
LATTICE = tuple((c, round(114 * c)) for c in (0.35, 0.5, 0.7, 1, 1.4, 2, 2.8, 4, 5))
TUBES_WIDE = ((1, 16), (1, 32), (1, 64), (2, 96), (2, 128), (2, 192), (3, 256), (4, 384), (5, 512))
TUBES_NARROW = ((1, 24), (1, 48), (1, 96), (2, 128), (2, 192), (3, 256), (4, 320), (5, 400), (6, 512))
POINT_WIDE = ((2, 32), (2, 64), (2, 128), (2, 256), (2, 512), (3, 768), (4, 1024), (5, 1600), (6, 2400))
POINT_NARROW = ((1, 64), (1, 128), (1, 256), (1, 512), (2, 512), (2, 1024), (3, 1600), (4, 2400), (5, 3600))
RASTER_WIDE = ((1, 64), (1, 128), (1.5, 192), (2, 384), (3, 512), (4, 768), (5, 1024), (6, 1400))
RASTER_NARROW = ((1, 64), (1, 128), (1, 256), (1.5, 384), (2, 768), (2.5, 1200), (3, 1600), (4, 2000))

METHODS = {
    "ours": Method("ours: footprints, engine cpu", Raster, LATTICE, LATTICE, "#c00000", "o"),
    "ours_opengl": Method(
        "ours: footprints, OpenGL", partial(Raster, engine="opengl"), LATTICE, LATTICE, "#f08080", "p"
    ),
    "rays_footprints": Method("rays, our footprints", Lattice, LATTICE, LATTICE, "#e08000", "D"),
    "tubes": Method("tubes of four rays", Tubes, TUBES_WIDE, TUBES_NARROW, "#208030", "s"),
    "rays_regular": Method("rays, point bins, regular", PointRays, POINT_WIDE, POINT_NARROW, "#2060c0", "^"),
    "rays_jittered": Method(
        "rays, point bins, jittered",
        partial(PointRays, jittered=True),
        POINT_WIDE,
        POINT_NARROW,
        "#40b0e0",
        "v",
    ),
    "paper": Method(
        "founding paper's 19 600 rays",
        partial(PointRays, even=PAPER),
        ((1, PAPER),),
        ((1, PAPER),),
        "#000000",
        "*",
    ),
    "raster_point": Method(
        "raster, point bins", partial(Raster, reducer="point"), RASTER_WIDE, RASTER_NARROW, "#8040a0", "P"
    ),
    "raster_mean": Method("raster, mean per bin", MeanRaster, LATTICE, LATTICE, "#909090", "X"),
    "slices": Method(
        "exact slices, no sampling in elevation",
        Slices,
        tuple((n, 0) for n in (1, 4, 6, 8, 12, 16, 24, 32)),
        tuple((n, 0) for n in (1, 2, 3, 4, 6, 8, 12, 16)),
        "#b06030",
        "h",
        scenes=("grazing", "tank"),
    ),
}


def best_factor(echo, truth) -> float:
    """Return the factor that minimises Σ|factor echo − truth|: the weighted median of truth / echo."""
    echo, truth = np.asarray(echo, np.float64).ravel(), np.asarray(truth, np.float64).ravel()
    above = echo > 0
    ratio = truth[above] / echo[above]
    order = np.argsort(ratio)
    below = np.cumsum(echo[above][order])
    return float(ratio[order][np.searchsorted(below, below[-1] / 2)])
