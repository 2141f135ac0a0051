"""The fan of a sonar: how densely it is sampled, its sectors, columns and beams.

The fan is split into perspective views (sectors). Samples are gathered into columns of azimuth, and a beam is
a weighted sum of columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from sonar_gl.lattice import SHEAR, Sector, distinct, make_parts, make_sector
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, frozen_array

# A perspective view samples its edges 1/cos² of the half-width more densely than its middle.
MAX_SECTOR_RAD = math.radians(60.0)
# A column is heard with the mean of a smooth beam pattern over it: it is as wide as a sample, but no wider
# than half a beam spacing, and no narrower than the reach of the pattern (some four beam widths) over this.
COLUMNS_PER_REACH = 128
MAX_COLUMNS_PER_BEAM, MAX_ROWS = 1024, 16_000
MIN_COLUMNS, MIN_ROWS = 24, 16  # of what is chosen for a tolerance
# Nor are rows higher than this: where two rows meet on a floor at grazing incidence a bin may come short, by
# some per cent where they are a degree high, by less than one where half of that.
MAX_ROW_DEG = 0.5
REDUCERS = ("footprint", "point")


@dataclass(frozen=True)
class Sampling:
    """How densely the fan is sampled.

    Parameters
    ----------
    columns_per_beam : samples across one beam spacing, in azimuth
    rows : samples up the elevation aperture
    reducer : "footprint" spreads a sample over the ranges that it covers, "point" drops it into one bin
    """

    columns_per_beam: float
    rows: int
    reducer: str = "footprint"

    def __post_init__(self):
        if not (
            isinstance(self.columns_per_beam, (int, float, np.number))
            and 0 < self.columns_per_beam <= MAX_COLUMNS_PER_BEAM
        ):
            raise Error(f"columns_per_beam must be a number in 0..1024 (got {self.columns_per_beam!r})")
        if not (isinstance(self.rows, (int, np.integer)) and 1 <= self.rows <= MAX_ROWS):
            raise Error(f"rows must be a whole number in 1..16000 (got {self.rows!r})")
        if self.reducer not in REDUCERS:
            raise Error(f"reducer must be one of {', '.join(REDUCERS)} (got {self.reducer!r})")


def rung_sampling(sonar: Sonar, sample_deg: float) -> Sampling:
    """Samples about so many degrees wide and, up to MAX_ROW_DEG, as high, which errs least."""
    columns = max(MIN_COLUMNS, sonar.azimuth_fov_deg / sample_deg)
    # rows are even in tan φ: as dense on the boresight as asked for, denser above and below
    aperture_deg = math.degrees(2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2))
    rows = max(MIN_ROWS, math.ceil(aperture_deg / min(sample_deg, MAX_ROW_DEG)))
    return Sampling(min(columns / sonar.n_beams, MAX_COLUMNS_PER_BEAM), min(rows, MAX_ROWS))


def half_of(sampling: Sampling) -> Sampling:
    """Half the samples."""
    return Sampling(
        sampling.columns_per_beam / math.sqrt(2),
        max(1, round(sampling.rows / math.sqrt(2))),
        sampling.reducer,
    )


def up_to(sampling: Sampling, sonar: Sonar, drawn: Sonar) -> Sampling:
    """The same rows to a degree over the higher aperture of `drawn`."""
    taller = math.tan(math.radians(drawn.elevation_fov_deg) / 2)
    taller /= math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    return replace(sampling, rows=min(math.ceil(sampling.rows * taller - 1e-9), MAX_ROWS))


@dataclass(frozen=True, eq=False)
class Fan:
    """All that the samples of a sonar need, fixed once per run.

    Attributes
    ----------
    sectors : perspective views from starboard to port
    column_edges_rad : (columns + 1,) azimuths between which the fan's columns lie, rising
    """

    sonar: Sonar
    sampling: Sampling
    sectors: tuple[Sector, ...]
    column_edges_rad: np.ndarray = field(repr=False)

    @property
    def n_columns(self) -> int:
        """Columns of the whole fan."""
        return len(self.column_edges_rad) - 1


def make_fan(
    sonar: Sonar,
    sampling: Sampling,
    reach_rad: float,
    box: bool = True,
    shear: float = SHEAR,
    widest: float = 0.5,
) -> Fan:
    """Lay the sectors, samples and columns of a sonar.

    Parameters
    ----------
    reach_rad : how far from their axes the beams hear
    box : the beams are boxes of that half-width: columns end where beams end
    shear : of the lattice, samples from row to row; a negative one gives the lattice's mirror image
    widest : of columns, in spacings of beams, unless the beams are boxes
    """
    azimuths = sonar.azimuth_rad
    start, stop = azimuths[0] - reach_rad, azimuths[-1] + reach_rad
    if stop - start > 2 * math.pi - 1e-9:
        start, stop = -math.pi, math.pi
    span = stop - start
    n_sectors = max(1, math.ceil(span / MAX_SECTOR_RAD - 1e-9))
    n_samples = sampling.columns_per_beam * sonar.n_beams * span / math.radians(sonar.azimuth_fov_deg)
    per_sector = max(2, math.ceil(n_samples / n_sectors))
    half_width = span / n_sectors / 2
    tan_elevation = math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    sectors = [
        make_sector(
            start + half_width * (2 * k + 1), half_width, per_sector, sampling.rows, tan_elevation, shear
        )
        for k in range(n_sectors)
    ]
    if box:
        ends = np.concatenate([azimuths - reach_rad, azimuths + reach_rad])
        if span > 2 * math.pi - 1e-9:
            ends = (ends + math.pi) % (2 * math.pi) - math.pi
    else:
        spacing = np.diff(azimuths).min(initial=span)
        width = max(min(span / n_samples, widest * spacing), reach_rad / COLUMNS_PER_REACH)
        ends = np.linspace(start, stop, 1 + math.ceil(span / width - 1e-6))
    seams = start + 2 * half_width * np.arange(n_sectors + 1)
    edges = distinct(np.clip(np.concatenate([ends, seams]), start, stop))
    sectors = tuple(replace(sector, parts=make_parts(sector, edges)) for sector in sectors)
    return Fan(sonar, sampling, sectors, frozen_array(edges, np.float64, (None,), "column edges"))


def beam_weights(
    fan: Fan, pattern, reach_rad: float, transmit=None, elevation=None
) -> tuple[np.ndarray, np.ndarray]:
    """What a beam hears of each column, over the beam's solid angle.

    Parameters
    ----------
    pattern : function (azimuth_rad, steer_rad) -> power pattern, 1 on the axis, or None for a box
    reach_rad : the pattern counts as zero further than this from the axis
    transmit : function (azimuth_rad) -> power pattern of the projector, which the beam's solid angle does not
        hold: where it is weak the beams are; or None for an even one
    elevation : function (sine of elevation) -> power pattern both ways, or None for a box

    Returns
    -------
    first : (B,) int64, first column of each beam (may be negative: columns are modulo n_columns)
    weights : (B, W) float32, 1/sr, rows of equal length
    """
    sonar, n_columns = fan.sonar, fan.n_columns
    edges, axes = fan.column_edges_rad, sonar.azimuth_rad
    reach_rad = min(reach_rad, math.pi)
    # the columns laid out three times round, so that a beam's stretch never breaks at the seam
    turns = np.array([-2 * math.pi, 0, 2 * math.pi])[:, None]
    if edges[-1] - edges[0] > 2 * math.pi - 1e-9:
        edges = np.append((edges[:-1] + turns).ravel(), edges[-1] + 2 * math.pi)
        origin = n_columns
    else:
        origin = 0
    first = np.searchsorted(edges, axes - reach_rad + 1e-12, side="right") - 1
    last = np.searchsorted(edges, axes + reach_rad - 1e-12, side="left")
    first, last = np.maximum(first, 0), np.minimum(last, len(edges) - 1)
    width = int((last - first).max())
    first = np.minimum(first, len(edges) - 1 - width)
    low = edges[first[:, None] + np.arange(width)] - axes[:, None]
    high = edges[first[:, None] + np.arange(width) + 1] - axes[:, None]
    low, high = np.clip(low, -reach_rad, reach_rad), np.clip(high, -reach_rad, reach_rad)
    heard = high - low
    nodes, shares = np.polynomial.legendre.leggauss(8)
    steer, echoed = axes[:, None, None], 1.0
    azimuths = steer + low[..., None] + heard[..., None] * (nodes + 1) / 2
    if pattern is not None:
        echoed = pattern(azimuths, steer)
        heard = heard * (echoed @ (shares / 2))
    top = math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    height = 2 * top
    if elevation is not None:
        sines, parts = np.polynomial.legendre.leggauss(64)
        height = top * (elevation(top * sines) @ parts)
    solid_angle = heard.sum(axis=1) * height
    if transmit is not None:
        heard = (high - low) * ((echoed * transmit(azimuths)) @ (shares / 2))
    # a column hears of its whole width: its sums already hold the azimuth
    share = heard / np.diff(edges)[first[:, None] + np.arange(width)]
    return first - origin, np.ascontiguousarray(share / solid_angle[:, None], np.float32)
