"""How densely the fan is sampled, and the sampling levels among which a tolerance chooses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from sonar_gl.core.checks import is_number, is_whole_number, make_numbers_plain, shown
from sonar_gl.core.errors import Error
from sonar_gl.sonar.sonar import Sonar

MAX_COLUMNS_PER_BEAM, MAX_ROWS = 1024, 16_000
MIN_COLUMNS, MIN_ROWS = 24, 16  # of a sampling chosen for a tolerance
# In a fan of a few degrees such columns are far narrower than rows are high, and columns of one beam average out all
# errors but those by the height of rows, which two lattices make alike. As many samples, HIGHEST times as high as wide,
# err less there; of fewer columns than LEAST_COLUMNS too few average out an upright edge.
HIGHEST, LEAST_COLUMNS = 2.0, 8
# Maximum height of a row. Where two rows meet on a floor at grazing incidence, a bin may lack echo: some per cent of it
# with rows a degree high, less than one per cent with rows half as high.
MAX_ROW_DEG = 0.5
REDUCERS = ("footprint", "point")


@dataclass(frozen=True)
class Sampling:
    """How densely the fan is sampled.

    Parameters
    ----------
    columns_per_beam : samples across one beam spacing, in azimuth, above 0 and up to 1024
    rows : samples up the elevation aperture, 1..16000
    reducer : "footprint" spreads a sample over the ranges that it covers, "point" adds it to one bin

    Raises
    ------
    Error
        if a number is out of bounds, or the reducer is unknown.
    """

    columns_per_beam: float
    rows: int
    reducer: str = "footprint"

    def __post_init__(self):
        make_numbers_plain(self)
        if not (is_number(self.columns_per_beam) and 0 < self.columns_per_beam <= MAX_COLUMNS_PER_BEAM):
            raise Error(f"columns_per_beam must be a number in 0..1024 (got {shown(self.columns_per_beam)})")
        if not (is_whole_number(self.rows) and 1 <= self.rows <= MAX_ROWS):
            raise Error(f"rows must be a whole number in 1..16000 (got {shown(self.rows)})")
        if not isinstance(self.reducer, str) or self.reducer not in REDUCERS:
            raise Error(f"reducer must be one of {', '.join(REDUCERS)} (got {shown(self.reducer)})")

    def count(self, sonar: Sonar) -> int:
        """Return the number of samples over field of view and aperture."""
        return round(self.columns_per_beam * sonar.n_beams) * self.rows


COARSEST_DEG, LEVELS_PER_HALF = 1.0, 4  # width of samples at level 0; levels that halve it
FINEST_LEVEL = 40  # unless the driver allows fewer samples
ERROR_RATE = 1.3  # the error falls as the width of samples to this power
WORST_BODY = 5.0  # times the tolerance: promised bound of the relative error of a single body's echo


class ToleranceWarning(UserWarning):
    """A tolerance cannot be met: the samples that fit are too few."""


def check_tolerance(tolerance) -> float:
    """Return the tolerance as a float.

    Raises Error if it lies outside 0.001..0.5.
    """
    if not (is_number(tolerance) and 0.001 <= tolerance <= 0.5):
        raise Error(
            f"tolerance must be a number in 0.001..0.5 (got {shown(tolerance)}; 0.01 is one per cent)"
        )
    return float(tolerance)


def fewest_rows(sonar: Sonar) -> int:
    """Return the number of rows of the coarsest sampling that is chosen for a tolerance."""
    return max(MIN_ROWS, math.ceil(_aperture_deg(sonar) / MAX_ROW_DEG))


def _aperture_deg(sonar: Sonar) -> float:
    """Return the aperture as rows share it, which are even in tan φ: as high as requested on the boresight."""
    return math.degrees(2 * math.tan(math.radians(sonar.elevation_fov_deg) / 2))


def sampling_of_width(sonar: Sonar, sample_deg: float) -> Sampling:
    """Return the sampling with samples of a width, degrees, and of the same height up to MAX_ROW_DEG.

    Where MIN_COLUMNS would make them higher than HIGHEST times their width, as many are less high.
    """
    columns = max(MIN_COLUMNS, sonar.azimuth_fov_deg / sample_deg)
    rows = max(math.ceil(_aperture_deg(sonar) / sample_deg), fewest_rows(sonar))
    if columns == MIN_COLUMNS:
        too_high = columns * _aperture_deg(sonar) / (HIGHEST * sonar.azimuth_fov_deg * rows)
        columns = max(MIN_COLUMNS / max(math.sqrt(too_high), 1.0), LEAST_COLUMNS)
        rows = math.ceil(rows * MIN_COLUMNS / columns - 1e-9)
    return Sampling(min(columns / sonar.n_beams, MAX_COLUMNS_PER_BEAM), min(rows, MAX_ROWS))


def sampling_at(sonar: Sonar, level: int) -> Sampling:
    """Return the samples of a sampling level, 0 the coarsest."""
    return sampling_of_width(sonar, COARSEST_DEG * 2 ** (-level / LEVELS_PER_HALF))


def level_of(sonar: Sonar, n_samples: int) -> int:
    """Return the finest sampling level that has at most so many samples, or 0."""
    level = 0
    while level < FINEST_LEVEL and sampling_at(sonar, level + 1).count(sonar) <= n_samples:
        level += 1
    return level


def typical_level(tolerance: float) -> int:
    """Return the sampling level that most scenes need for a tolerance: of 0.2 degrees for 0.02."""
    finer = COARSEST_DEG / 0.2 * (0.02 / tolerance) ** (1 / ERROR_RATE)
    return min(max(0, round(LEVELS_PER_HALF * math.log2(finer))), FINEST_LEVEL)


def part_of(sampling: Sampling, share: float) -> Sampling:
    """Return a share of the samples, fewer in both directions alike."""
    root = math.sqrt(share)
    return Sampling(sampling.columns_per_beam * root, max(1, round(sampling.rows * root)), sampling.reducer)


def extend_rows(sampling: Sampling, sonar: Sonar, true_range_sonar: Sonar) -> Sampling:
    """Return the same rows per degree over the higher aperture of `Acoustics.true_range_sonar`."""
    ratio = math.tan(math.radians(true_range_sonar.elevation_fov_deg) / 2)
    ratio /= math.tan(math.radians(sonar.elevation_fov_deg) / 2)
    return replace(sampling, rows=min(math.ceil(sampling.rows * ratio - 1e-9), MAX_ROWS))
