"""Rigid poses: construction from six numbers, checks, and CSV files."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from sonar_gl.core.checks import frozen_array
from sonar_gl.core.errors import Error


def check_pose(matrix, what: str = "pose") -> np.ndarray:
    """Return a rigid (4, 4) float64 `world_from_x`; raise an `Error` if the matrix is not rigid."""
    out = frozen_array(matrix, np.float64, (4, 4), what)
    # Python floats take a sixth of NumPy's time for nine numbers, and this runs at every ping.
    (a, b, c), (d, e, f), (g, h, i) = out[:3, :3].tolist()
    lengths = a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1
    angles = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    turn = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if max(map(abs, lengths + angles)) > 1e-5 or turn < 0:
        raise Error(
            f"{what} must be a rotation and a translation (its 3x3 part scales, shears or reflects; "
            "scale the mesh instead)"
        )
    if not np.array_equal(out[3], [0, 0, 0, 1]):
        raise Error(f"{what} must have the last row 0 0 0 1 (got {out[3].tolist()})")
    return out


def pose_numbers(matrix: np.ndarray) -> tuple[float, ...]:
    """Return x y z roll pitch yaw of a (4, 4) pose, metres and radians: the arguments of `pose`.

    >>> [round(x, 9) for x in pose_numbers(pose(1, 2, 3, 0.1, -0.2, 0.3))]
    [1.0, 2.0, 3.0, 0.1, -0.2, 0.3]
    """
    (a, b, _), (d, e, _), (g, h, i) = matrix[:3, :3].tolist()
    pitch = np.arctan2(-g, np.hypot(a, d))
    if np.hypot(a, d) < 1e-9:  # straight up or down: roll and yaw have the same axis
        roll, yaw = 0.0, np.arctan2(-b, e)
    else:
        roll, yaw = np.arctan2(h, i), np.arctan2(d, a)
    return (*matrix[:3, 3].tolist(), float(roll), float(pitch), float(yaw))


def pose(x=0.0, y=0.0, z=0.0, roll=0.0, pitch=0.0, yaw=0.0) -> np.ndarray:
    """Return `world_from_sonar` for SDF's six numbers: metres, and fixed-axis x-y-z angles in radians.

    Convention: R = Rz(yaw) Ry(pitch) Rx(roll), x forward, y left (port), z up.

    Returns
    -------
    (4, 4) float64

    Raises
    ------
    Error
        if a number is not finite, or an angle is beyond 2π, as degrees would be.

    >>> (pose(1, 2, 3, yaw=np.pi / 2) @ [1, 0, 0, 1]).round(6).tolist()
    [1.0, 3.0, 3.0, 1.0]
    """
    numbers = frozen_array([x, y, z, roll, pitch, yaw], np.float64, (6,), "pose x y z roll pitch yaw")
    if np.abs(numbers[3:]).max() > 2 * np.pi + 1e-6:
        raise Error(
            f"pose angles must be radians, within ±2π (got roll pitch yaw = {roll:g} {pitch:g} {yaw:g}; "
            "if these are degrees, multiply by π/180; if they are unwrapped radians, wrap them)"
        )
    (sr, sp, sy), (cr, cp, cy) = np.sin(numbers[3:]), np.cos(numbers[3:])
    out = np.eye(4)
    out[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    out[:3, 3] = numbers[:3]
    return out


COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")


def read_poses(path) -> tuple[np.ndarray, np.ndarray]:
    """Read times and poses from a CSV file whose first line names its columns: t,x,y,z,roll,pitch,yaw.

    Parameters
    ----------
    path : file with seconds, metres and radians. The order of columns is free; other columns and empty lines are
        ignored

    Returns
    -------
    times_s : (N,) float64
    poses : (N, 4, 4) float64, world_from_sonar

    Raises
    ------
    Error
        if a column is missing, a line has too few or too many cells, a cell is not a finite number, an angle looks
        like degrees, or the file has no pose. The message names file, line and column.
    """
    path = Path(path)
    times, poses = [], []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file, skipinitialspace=True)
            columns = None
            for cells in rows:
                location = f"{path}: line {rows.line_num}"
                if not any(cell.strip() for cell in cells):
                    continue
                if columns is None:
                    columns, n_columns = (
                        _column_indices(location, [cell.strip() for cell in cells]),
                        len(cells),
                    )
                    continue
                if len(cells) != n_columns:
                    raise Error(
                        f"{location}: must have {n_columns} cells, as the header has (got {len(cells)})"
                    )
                time, *numbers = (_number(location, name, cells[at]) for name, at in columns.items())
                try:
                    poses.append(pose(*numbers))
                except Error as why:
                    raise Error(f"{location}: {why}") from None
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


def _column_indices(location: str, header: list[str]) -> dict[str, int]:
    """Return a dict from the name of each column to its index in a line."""
    wanted = ",".join(COLUMNS)
    for name in COLUMNS:
        if header.count(name) != 1:
            what = "more than once" if name in header else "not there"
            raise Error(
                f"{location}: column {name} is {what}; the first line must name the columns {wanted} "
                f"(got {','.join(header)!r})"
            )
    return {name: header.index(name) for name in COLUMNS}


def _number(location: str, name: str, cell: str) -> float:
    """Return the finite number of a cell."""
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise Error(f"{location}, column {name}: must be a finite number (got {cell.strip()!r})")
    return number
