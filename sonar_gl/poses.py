"""Where the sonar goes: a table of poses over time, as CSV."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from sonar_gl.scene import pose
from sonar_gl.types import Error

COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")


def read_poses(path) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses of a CSV file whose first line names its columns: t,x,y,z,roll,pitch,yaw.

    Parameters
    ----------
    path : seconds, metres and radians; columns in any order, others are passed over, and so are empty lines

    Returns
    -------
    times_s : (N,) float64
    poses : (N, 4, 4) float64, world_from_sonar

    Raises
    ------
    Error
        with file, line and column: a missing column, too few or many cells, what is no finite number,
        angles that look like degrees, no pose at all.
    """
    path = Path(path)
    times, poses = [], []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file, skipinitialspace=True)
            places = None
            for cells in rows:
                where = f"{path}: line {rows.line_num}"
                if not any(cell.strip() for cell in cells):
                    continue
                if places is None:
                    places, n_columns = _places(where, [cell.strip() for cell in cells]), len(cells)
                    continue
                if len(cells) != n_columns:
                    raise Error(f"{where}: must have {n_columns} cells, as the header has (got {len(cells)})")
                time, *numbers = (_number(where, name, cells[at]) for name, at in places.items())
                try:
                    poses.append(pose(*numbers))
                except Error as why:
                    raise Error(f"{where}: {why}") from None
                times.append(time)
    except OSError as why:
        raise Error(
            f"{path}: the file of poses must be readable ({(why.strerror or str(why)).lower()})"
        ) from None
    except UnicodeDecodeError:
        raise Error(f"{path}: the file of poses must be text in UTF-8") from None
    except csv.Error as why:
        raise Error(f"{path}: line {rows.line_num}: must be CSV ({why})") from None
    if not poses:
        raise Error(f"{path}: must hold at least one pose, under the header {','.join(COLUMNS)} (got none)")
    return np.array(times), np.array(poses)


def _places(where: str, header: list[str]) -> dict[str, int]:
    """Column name -> its place in a line."""
    wanted = ",".join(COLUMNS)
    for name in COLUMNS:
        if header.count(name) != 1:
            what = "more than once" if name in header else "not there"
            raise Error(
                f"{where}: column {name} is {what}; the first line must name the columns {wanted} "
                f"(got {','.join(header)!r})"
            )
    return {name: header.index(name) for name in COLUMNS}


def _number(where: str, name: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise Error(f"{where}, column {name}: must be a finite number (got {cell.strip()!r})")
    return number
