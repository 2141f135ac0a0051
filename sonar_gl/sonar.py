"""What a sonar's data sheet says, and the presets."""

from __future__ import annotations

import math
import warnings
from dataclasses import MISSING, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from sonar_gl.types import Error, frozen_array, nearest_names

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

PRESETS = Path(__file__).with_name("sonars.toml")


@dataclass(frozen=True)
class Sonar:
    """A multibeam imaging sonar.

    Parameters
    ----------
    name : what it is called
    frequency_hz : centre frequency, 1e3..1e8
    n_beams, n_bins : counts of beams across the fan and of range bins in [range_min_m, range_max_m)
    azimuth_fov_deg : width of the fan, up to 360; beam b points at −fov/2 + (b + ½) fov / n_beams
    elevation_fov_deg : height of a beam, up to 170; at −3 dB both ways, if Acoustics has an elevation_pattern
    beam_width_deg : −3 dB width of a beam in azimuth; may exceed the spacing, beams then overlap
    range_min_m, range_max_m : slant range, metres
    beam_azimuths_deg : None, or a table of n_beams rising azimuths, positive to port, within the fan
    source : where the numbers come from

    Raises
    ------
    Error
        if a number makes no sense.
    """

    name: str
    frequency_hz: float
    n_beams: int
    n_bins: int
    azimuth_fov_deg: float
    elevation_fov_deg: float
    beam_width_deg: float
    range_min_m: float
    range_max_m: float
    beam_azimuths_deg: tuple[float, ...] | None = None
    source: str = ""

    def __post_init__(self):
        where = f"sonar {self.name!r}"
        for key in ("n_beams", "n_bins"):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= 65536:
                raise Error(f"{where}: {key} must be a whole number in 1..65536 (got {value!r})")
        for key, low, high, hint in (
            ("frequency_hz", 1e3, 1e8, "give hertz, 900e3 for 900 kHz"),
            ("azimuth_fov_deg", 0.01, 360.0, "give degrees"),
            ("elevation_fov_deg", 0.01, 170.0, "give degrees"),
            ("beam_width_deg", 1e-3, 180.0, "give degrees"),
            ("range_min_m", 0.0, 1e5, "give metres"),
            ("range_max_m", 1e-3, 1e5, "give metres"),
        ):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise Error(f"{where}: {key} must be a number (got {value!r})")
            if not low <= value <= high:  # NaN too
                raise Error(f"{where}: {key} must lie in {low:g}..{high:g} (got {value:g}; {hint})")
        if self.range_min_m >= self.range_max_m:
            raise Error(
                f"{where}: range_min_m must be less than range_max_m "
                f"(got {self.range_min_m:g} and {self.range_max_m:g})"
            )
        # 2π wide at most, beams finer than any sonar's: not impossible, so no error
        if self.n_beams > 8 and self.azimuth_fov_deg <= 6.2832 and self.azimuth_fov_deg / self.n_beams < 0.02:
            warnings.warn(
                f"{where}: azimuth_fov_deg = {self.azimuth_fov_deg:g} puts {self.n_beams} beams within less "
                f"than 7 degrees; if it is in radians, give {math.degrees(self.azimuth_fov_deg):.4g}",
                stacklevel=3,
            )
        if self.beam_azimuths_deg is not None:
            table = frozen_array(
                self.beam_azimuths_deg, np.float64, (self.n_beams,), f"{where}: beam_azimuths_deg"
            )
            if (np.diff(table) <= 0).any():
                raise Error(f"{where}: beam_azimuths_deg must rise (starboard first, positive to port)")
            if np.abs(table).max() > self.azimuth_fov_deg / 2:
                raise Error(
                    f"{where}: beam_azimuths_deg must lie within ±azimuth_fov_deg/2 = "
                    f"±{self.azimuth_fov_deg / 2:g} (got {table[0]:g} to {table[-1]:g})"
                )
            object.__setattr__(self, "beam_azimuths_deg", tuple(table.tolist()))

    @property
    def azimuth_rad(self) -> np.ndarray:
        """(B,) beam centres, radians, rising, positive to port."""
        if self.beam_azimuths_deg is not None:
            return np.radians(self.beam_azimuths_deg)
        return np.radians(self.azimuth_fov_deg * ((np.arange(self.n_beams) + 0.5) / self.n_beams - 0.5))

    @property
    def bin_edges_m(self) -> np.ndarray:
        """(K + 1,) edges of the bins, metres."""
        return np.linspace(self.range_min_m, self.range_max_m, self.n_bins + 1)

    @property
    def range_m(self) -> np.ndarray:
        """(K,) bin centres, metres."""
        edges = self.bin_edges_m
        return (edges[1:] + edges[:-1]) / 2

    @property
    def bin_size_m(self) -> float:
        """Length of a bin, metres."""
        return (self.range_max_m - self.range_min_m) / self.n_bins

    def max_ping_rate_hz(self, sound_speed_m_s: float) -> float:
        """Pings a second at most: the next may leave when the echo from range_max_m is back, after 2R/c.

        >>> round(load_sonar("p900-45").with_range(30.0).max_ping_rate_hz(1500.0), 6)
        25.0
        """
        return sound_speed_m_s / (2 * self.range_max_m)

    def with_range(self, range_max_m: float) -> Sonar:
        """The same sonar set to another maximum range, with bins of the same size."""
        if not (math.isfinite(range_max_m) and range_max_m > self.range_min_m):
            raise Error(
                f"sonar {self.name!r}: the range must exceed range_min_m = {self.range_min_m:g} m "
                f"(got {range_max_m:g})"
            )
        n_bins = max(1, round((range_max_m - self.range_min_m) / self.bin_size_m))
        return replace(self, range_max_m=range_max_m, n_bins=n_bins)


def load_sonar(what: str | Path) -> Sonar:
    """The sonar of this name, or of this file.

    Parameters
    ----------
    what : a preset's name in any case, or the path of a .toml file that holds one sonar, as top-level keys
        or as a table; "path.toml#table" picks one of several tables

    Raises
    ------
    Error
        if there is no such preset, file or table, or the file does not describe a sonar.

    >>> load_sonar("P900-45").n_beams
    256
    """
    if not isinstance(what, (str, Path)):
        raise Error(f"a sonar must be a preset's name or the path of a .toml file (got {what!r})")
    known = presets()
    text = str(what)
    if isinstance(what, str) and text.casefold() in known:
        return known[text.casefold()]
    stem, mark, table = text.rpartition(".toml#")
    path = Path(stem + ".toml") if mark and not Path(text).exists() else Path(text)
    if not path.is_file():
        if isinstance(what, str) and path.name == text and path.suffix != ".toml":
            raise Error(f"unknown sonar (got {text!r}; {nearest_names(text.casefold(), known)})")
        raise Error(f"{path}: the sonar's file must exist (got none there; paths start at {Path.cwd()})")
    tables = _read_tables(path)
    if path != Path(text):  # a table was asked for
        if table not in tables:
            raise Error(f"{path}: unknown table (got {table!r}; {nearest_names(table, tables)})")
    elif len(tables) > 1:
        raise Error(
            f"{path}: must hold one sonar, or be told which of its tables is meant "
            f"(got {', '.join(tables)}; say {path}#{next(iter(tables))})"
        )
    else:
        (table,) = tables
    return _sonar_from_table(f"{path} [{table}]", table, tables[table])


def presets() -> dict[str, Sonar]:
    """The sonars that come with the package, by name."""
    return dict(_presets())


@lru_cache(maxsize=1)
def _presets() -> dict[str, Sonar]:
    return {
        name: _sonar_from_table(f"{PRESETS} [{name}]", name, t) for name, t in _read_tables(PRESETS).items()
    }


def _read_tables(path: Path) -> dict[str, dict]:
    """Tables of a file by name; top-level keys count as one table named after the file."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as why:
        raise Error(f"{path}: the sonar's file must be readable ({why.strerror})") from None
    except ValueError as why:  # not TOML (says the line), or not UTF-8
        raise Error(f"{path}: the sonar's file must be TOML ({why})") from None
    tables = {key: value for key, value in data.items() if isinstance(value, dict)}
    if not data:
        raise Error(f"{path}: must hold one sonar (got an empty file; copy a table of {PRESETS})")
    if not tables:
        return {path.stem: data}
    if len(tables) < len(data):
        key = next(key for key in data if key not in tables)
        raise Error(
            f"{path}: must hold either a sonar's keys or tables, not both "
            f"(got key {key!r} and table {next(iter(tables))!r})"
        )
    return tables


def _sonar_from_table(where: str, name: str, table: dict) -> Sonar:
    """A sonar from one table of a file; errors say where."""
    keys = {f.name: f.default is MISSING for f in fields(Sonar)}
    for key in table:
        if key not in keys:
            raise Error(f"{where}: unknown key (got {key!r}; {nearest_names(key, keys)})")
    for key in ("name", "source"):
        if not isinstance(table.get(key, ""), str):
            raise Error(f"{where}: {key} must be text (got {table[key]!r}; put it in quotes)")
    table = {"name": name} | table
    missing = [key for key, needed in keys.items() if needed and key not in table]
    if missing:
        raise Error(f"{where}: every key that a sonar needs must be given (missing: {', '.join(missing)})")
    try:
        return Sonar(**table)
    except Error as why:
        raise Error(f"{where}: {why}") from None
