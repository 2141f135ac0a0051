"""The fan of a sonar: its sectors, its columns, and how it is laid out for a sampling.

The fan is divided into perspective views (sectors). Samples are summed into columns, which are cells of azimuth; a
beam is a weighted sum of columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from sonar_gl.core.checks import frozen_array
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sector import SHEAR, Sector, make_sector, make_strips, merge_close_azimuths
from sonar_gl.sonar.sonar import Sonar

# The far plane lies at this multiple of the last bin's range: near grazing incidence, the footprint of a sample
# whose middle lies beyond the last bin still extends into it.
FAR_FACTOR = 8.0

# Distance of the near plane: surfaces nearer than this, such as the sonar's own housing, return no echo.
NEAR_M = 1e-3

# A perspective view samples its edges 1/cos² of the half-width more densely than its middle.
MAX_SECTOR_RAD = math.radians(60.0)
# A column takes the mean of a smooth beam pattern over its width. It is as wide as a sample, but at most half a beam
# spacing, and at least the half-width of the pattern's support (about four beam widths) over this number.
COLUMNS_PER_SUPPORT = 128


@dataclass(frozen=True, eq=False)
class Fan:
    """The views and columns of a sonar for one sampling.

    Attributes
    ----------
    sonar : Sonar
    sampling : Sampling
    sectors : perspective views from starboard to port
    column_edges_rad : (columns + 1,) float64, azimuths between which the columns lie, rising
    """

    sonar: Sonar
    sampling: Sampling
    sectors: tuple[Sector, ...]
    column_edges_rad: np.ndarray = field(repr=False)

    @property
    def n_columns(self) -> int:
        """Number of columns of the whole fan."""
        return len(self.column_edges_rad) - 1


def make_fan(
    sonar: Sonar,
    sampling: Sampling,
    support_rad: float,
    box: bool = True,
    shear: float = SHEAR,
    max_column_width: float = 0.5,
) -> Fan:
    """Return the fan of a sonar: its sectors with their samples and strips, and its columns.

    Parameters
    ----------
    sonar, sampling : Sonar, Sampling
    support_rad : half-width of the receive beam pattern's support, radians: the outer beams reach this far beyond
        their axes
    box : whether the beams are boxes of that half-width; columns then end where beams end
    shear : of the lattice, samples from row to row; a negative one gives the lattice's mirror image
    max_column_width : largest width of a column, in beam spacings; without effect on boxes
    """
    azimuths = sonar.azimuth_rad
    start, stop = azimuths[0] - support_rad, azimuths[-1] + support_rad
    if stop - start > 2 * math.pi - 1e-9:
        start, stop = -math.pi, math.pi
    span = stop - start
    n_sectors = max(1, math.ceil(span / MAX_SECTOR_RAD - 1e-9))
    n_samples = sampling.columns_per_beam * sonar.n_beams * span / math.radians(sonar.azimuth_fov_deg)
    samples_per_sector = max(2, math.ceil(n_samples / n_sectors))
    half_width = span / n_sectors / 2
    tan_elevation = math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    sectors = [
        make_sector(
            start + half_width * (2 * k + 1),
            half_width,
            samples_per_sector,
            sampling.rows,
            tan_elevation,
            shear,
        )
        for k in range(n_sectors)
    ]
    if box:
        ends = np.concatenate([azimuths - support_rad, azimuths + support_rad])
        if span > 2 * math.pi - 1e-9:
            ends = (ends + math.pi) % (2 * math.pi) - math.pi
    else:
        spacing = np.diff(azimuths).min(initial=span)
        width = max(min(span / n_samples, max_column_width * spacing), support_rad / COLUMNS_PER_SUPPORT)
        ends = np.linspace(start, stop, 1 + math.ceil(span / width - 1e-6))
    seams = start + 2 * half_width * np.arange(n_sectors + 1)
    edges = merge_close_azimuths(np.clip(np.concatenate([ends, seams]), start, stop))
    sectors = tuple(replace(sector, strips=make_strips(sector, edges)) for sector in sectors)
    return Fan(sonar, sampling, sectors, frozen_array(edges, np.float64, (None,), "column edges"))
